"""What all lifetime models share: a model supplies its hazard and the integral of it, the rest follows.

The primitive is `log H(a, b)`, the logarithm of the integrated hazard between two times. From it,
`log q = -H(a, b)` and `log(1 - q) = log(1 - exp(-H(a, b)))` lose no digit, however close `a` and `b` are and however
little is left of `S(a)`. The logarithm matters: `1 - q` may be 1e-800, whose logarithm is an ordinary number.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from evermap.survival import checks
from evermap.survival.logmath import log_one_minus_exp_of_minus_exp
from evermap.survival.protocol import Seed
from evermap.types import FloatArray

_LOG_TIME_RANGE = (-690.0, 690.0)
"""Natural logarithms of the times between which quantiles are sought."""


class Lifetime(ABC):
    """Base of the lifetime models: implements `LifetimePrior` on top of two formulas."""

    __slots__ = ()

    @abstractmethod
    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """`log int_a^b h`, for checked `a <= b` of one shape; `-inf` where `a = b`, `+inf` for certain death."""

    @abstractmethod
    def _log_hazard(self, t: FloatArray) -> FloatArray:
        """`log h(t)` for checked times; `+inf` where `S(t) = 0`."""

    @abstractmethod
    def mean(self) -> float:
        """`E[T]` in seconds, possibly `inf`."""

    @property
    def p_never_leaves(self) -> float:
        """`P(T = inf)`."""
        return 0.0

    def log_survival(self, t: ArrayLike) -> FloatArray:
        return 0.0 - self.cumulative_hazard(t)

    def log_conditional_survival(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        first, last = checks.intervals(a, b)
        with np.errstate(all="ignore"):
            return _plain(0.0 - self._integrated_hazard(first, last))

    def log_conditional_death(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        first, last = checks.intervals(a, b)
        with np.errstate(all="ignore"):
            return _plain(log_one_minus_exp_of_minus_exp(self._log_integrated_hazard(first, last)))

    def hazard(self, t: ArrayLike) -> FloatArray:
        values = checks.times(t)
        with np.errstate(all="ignore"):
            return _plain(np.exp(self._log_hazard(values)))

    def cumulative_hazard(self, t: ArrayLike) -> FloatArray:
        values = checks.times(t)
        with np.errstate(all="ignore"):
            return _plain(self._integrated_hazard(np.zeros_like(values), values))

    def log_density(self, t: ArrayLike) -> FloatArray:
        values = checks.times(t)
        with np.errstate(all="ignore"):
            cumulative = self._integrated_hazard(np.zeros_like(values), values)
            # Where nobody is left the hazard is infinite and the density is zero.
            return _plain(np.where(np.isinf(cumulative), -np.inf, self._log_hazard(values) - cumulative))

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        # H(T) of a continuous lifetime is a standard exponential variable.
        with np.errstate(all="ignore"):
            return _plain(self._time_of_log_hazard(np.log(np.asarray(generator.standard_exponential(size)))))

    def quantile(self, p: ArrayLike) -> FloatArray:
        values = checks.probabilities(p)
        with np.errstate(all="ignore"):
            return _plain(self._time_of_log_hazard(np.log(-np.log1p(-values))))

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """`int_a^b h`; overridden where it has a form that needs no logarithm."""
        return np.asarray(np.exp(self._log_integrated_hazard(a, b)))

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        """Smallest `t` with `log H(t) >= log_target`; by bisection in log t unless overridden."""
        low = np.full(log_target.shape, _LOG_TIME_RANGE[0])
        high = np.full(log_target.shape, _LOG_TIME_RANGE[1])
        zero = np.zeros_like(log_target)
        reached = self._log_integrated_hazard(zero, np.exp(high)) >= log_target
        for _ in range(64):
            middle = 0.5 * (low + high)
            enough = self._log_integrated_hazard(zero, np.exp(middle)) >= log_target
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.where(np.isneginf(log_target), 0.0, np.where(reached, np.exp(high), np.inf))


def _plain(values: FloatArray) -> FloatArray:
    """An array of no dimensions as a numpy scalar, any other as it is."""
    return np.asarray(values, dtype=np.float64)[()]
