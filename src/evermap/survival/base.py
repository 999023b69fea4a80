"""The protocol of a lifetime prior, the checks of its arguments, and the base class that all models share.

A model supplies mathematics only (see `families.Weibull`): the hazard and the logarithm of its integral between two
times, `log H(a, b)`. From it, `log q = -H(a, b)` and `log(1 - q) = log(1 - exp(-H(a, b)))` lose no digit, however close
`a` and `b` are and however small `S(a)` is. The logarithm matters: `1 - q` may be 1e-800, whose logarithm is an
ordinary number.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.show import Shown, draw
from evermap.survival.logmath import log_integral_of_smooth_hazard, log_one_minus_exp_of_minus_exp
from evermap.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Seed = np.random.Generator | int
"""A generator, or the seed of a new one."""
_LOG_TIME_RANGE = (-690.0, 690.0)
"""Natural logarithms of the times between which quantiles are sought."""


@runtime_checkable
class LifetimePrior(Protocol):
    """Distribution of the survival time `T` of a feature that is first seen at t = 0 (MATH.md section 1).

    Times are seconds, finite and not negative; arrays broadcast, and scalars give numpy scalars.
    `S(t) = P(T > t)`, and `q(a, b) = S(b) / S(a)` is the probability to see `b` for one that saw `a`.
    Where `S(a) = 0` the condition is void: then `q(a, b) = 0` for `b > a`, and `q(a, a) = 1` always.

    Raises (all methods): ConfigError for a time that is NaN, infinite or negative, or for `a > b`.
    """

    @property
    def p_never_leaves(self) -> float:
        """Return `P(T = inf)`: positive where the hazard has a finite integral."""
        ...

    def log_survival(self, t: ArrayLike) -> FloatArray:
        """Return `log S(t)`."""
        ...

    def log_conditional_survival(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        """Return `log q(a, b)`, for `a <= b`."""
        ...

    def log_conditional_death(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        """Return `log(1 - q(a, b))`, for `a <= b`; `-inf` where `a = b`."""
        ...

    def hazard(self, t: ArrayLike) -> FloatArray:
        """Return `h(t) = p(t) / S(t)` in 1/s; `inf` on a point of positive mass and where `S(t) = 0`."""
        ...

    def cumulative_hazard(self, t: ArrayLike) -> FloatArray:
        """Return `H(t) = -log S(t)`."""
        ...

    def log_density(self, t: ArrayLike) -> FloatArray:
        """Return `log p(t)`, `p` in 1/s; `+inf` on a point of positive mass."""
        ...

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        """Draw survival times in seconds, `inf` for features that never leave."""
        ...

    def mean(self) -> float:
        """Return `E[T]` in seconds, possibly `inf`."""
        ...

    def quantile(self, p: ArrayLike) -> FloatArray:
        """Return the smallest `t` with `P(T <= t) >= p`, for `p` in [0, 1]; `inf` where there is none."""
        ...


class Lifetime(Shown, ABC):
    """Base of the lifetime models: implements `LifetimePrior` on top of two formulas.

    A model overrides `_log_hazard`, `mean`, and at least one of `_log_integrated_hazard` and `_integrated_hazard`;
    any other method where it has a closed form.
    """

    __slots__ = ()

    @abstractmethod
    def _log_hazard(self, t: FloatArray) -> FloatArray:
        """Return `log h(t)` for checked times; `+inf` where `S(t) = 0`."""

    @abstractmethod
    def mean(self) -> float:
        """Return `E[T]` in seconds, possibly `inf`."""

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return `log int_a^b h`, for checked `a <= b` of one shape; `-inf` where `a = b`, `+inf` for certain death."""
        return np.asarray(np.log(self._integrated_hazard(a, b)))

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Return `int_a^b h`, likewise."""
        return np.asarray(np.exp(self._log_integrated_hazard(a, b)))

    @property
    def p_never_leaves(self) -> float:
        return 0.0

    def log_survival(self, t: ArrayLike) -> FloatArray:
        return 0.0 - self.cumulative_hazard(t)

    def log_conditional_survival(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        first, last = check_intervals(a, b)
        with np.errstate(all="ignore"):
            return _plain(0.0 - self._integrated_hazard(first, last))

    def log_conditional_death(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        first, last = check_intervals(a, b)
        with np.errstate(all="ignore"):
            return _plain(log_one_minus_exp_of_minus_exp(self._log_integrated_hazard(first, last)))

    def hazard(self, t: ArrayLike) -> FloatArray:
        values = check_times(t)
        with np.errstate(all="ignore"):
            return _plain(np.exp(self._log_hazard(values)))

    def cumulative_hazard(self, t: ArrayLike) -> FloatArray:
        values = check_times(t)
        with np.errstate(all="ignore"):
            return _plain(self._integrated_hazard(np.zeros_like(values), values))

    def log_density(self, t: ArrayLike) -> FloatArray:
        values = check_times(t)
        with np.errstate(all="ignore"):
            cumulative = self._integrated_hazard(np.zeros_like(values), values)
            # Where S(t) = 0 the hazard is infinite and the density is zero.
            return _plain(np.where(np.isinf(cumulative), -np.inf, self._log_hazard(values) - cumulative))

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        # H(T) of a continuous lifetime is a standard exponential variable.
        with np.errstate(all="ignore"):
            return _plain(self._time_of_log_hazard(np.log(np.asarray(generator.standard_exponential(size)))))

    def quantile(self, p: ArrayLike) -> FloatArray:
        values = check_probabilities(p)
        with np.errstate(all="ignore"):
            return _plain(self._time_of_log_hazard(np.log(-np.log1p(-values))))

    def plot(self, **options: Any) -> Figure:
        """Draw hazard, survival and density, with the options of `viz.lifetime_figures.plot_lifetimes`."""
        return draw("plot_lifetimes", self, **options)

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        """Return the smallest `t` with `log H(t) >= log_target`; by bisection in log t unless overridden."""
        low = np.full(log_target.shape, _LOG_TIME_RANGE[0])
        high = np.full(log_target.shape, _LOG_TIME_RANGE[1])
        zero = np.zeros_like(log_target)
        reached = self._log_integrated_hazard(zero, np.exp(high)) >= log_target
        for _ in range(64):
            middle = 0.5 * (low + high)
            enough = self._log_integrated_hazard(zero, np.exp(middle)) >= log_target
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.where(np.isneginf(log_target), 0.0, np.where(reached, np.exp(high), np.inf))


class SmoothLifetime(Lifetime):
    """Base of models whose hazard is smooth in log t: `_log_cumulative` takes the place of an integral."""

    __slots__ = ()

    @abstractmethod
    def _log_cumulative(self, t: FloatArray) -> FloatArray:
        """Return `log H(t)`."""

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return log_integral_of_smooth_hazard(a, b, self._log_cumulative, self._log_hazard)


class SurvivalEstimate(Shown):
    """Mixin of estimates of a survival function."""

    __slots__ = ()

    def plot(self, **options: Any) -> Figure:
        """Draw the survival function and its band, with the options of `viz.lifetime_figures.plot_survival`."""
        return draw("plot_survival", {type(self).__name__: self}, **options)


def _plain(values: FloatArray) -> FloatArray:
    """Return an array of no dimensions as a numpy scalar, any other unchanged."""
    return np.asarray(values, dtype=np.float64)[()]


def check_times(t: ArrayLike, name: str = "t") -> FloatArray:
    """Return `t` as float64; raise a ConfigError if any is NaN, infinite or negative."""
    values = np.asarray(t, dtype=np.float64)
    good = (values >= 0.0) & np.isfinite(values)
    if not good.all():
        _refuse(values, good, name, "a time since the first sighting must be finite and not negative, in seconds")
    return values


def check_intervals(a: ArrayLike, b: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Broadcast `a` and `b` against each other; raise a ConfigError if any time is invalid or `a > b`."""
    first, last = np.broadcast_arrays(check_times(a, "a"), check_times(b, "b"))
    good = first <= last
    if not good.all():
        _refuse(last, good, "b", f"time goes back from a = {float(first[~good].flat[0])!r}", hint="a <= b")
    return first, last


def check_probabilities(p: ArrayLike) -> FloatArray:
    """Return `p` as float64; raise a ConfigError if any is outside [0, 1]."""
    values = np.asarray(p, dtype=np.float64)
    good = (values >= 0.0) & (values <= 1.0)
    if not good.all():
        _refuse(values, good, "p", "a probability must lie in [0, 1]")
    return values


def check_open_share(value: float, name: str = "confidence") -> None:
    """Raise a ConfigError unless `value` lies in (0, 1)."""
    if not 0.0 < value < 1.0:
        raise ConfigError(f"must lie in (0, 1), not {value!r}", field=name)


def check_positive(value: float, name: str) -> None:
    """Raise a ConfigError unless `value` is finite and positive."""
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"must be finite and positive, not {value!r}", field=name)


def check_rates(rates: Sequence[float], name: str = "rates") -> None:
    """Raise a ConfigError unless every rate is finite and not negative."""
    for row, rate in enumerate(rates):
        if not (math.isfinite(rate) and rate >= 0.0):
            raise ConfigError(
                f"a hazard must be finite and not negative, row {row} is {rate!r}",
                field=name,
                hint="a rate of 0 where nothing ever leaves",
            )


def _refuse(values: FloatArray, good: BoolArray, name: str, problem: str, hint: str | None = None) -> None:
    where = tuple(int(i) for i in np.argwhere(~good)[0])
    row = "" if not where else f", row {where[0] if len(where) == 1 else where}"
    raise ConfigError(f"{problem}: found {float(values[where])!r}{row}", field=name, hint=hint)
