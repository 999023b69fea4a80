"""Families of lifetimes: exponential, uniform, Weibull, log-normal, gamma, an unknown rate, and mixtures of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, LifetimePrior, Seed, SmoothLifetime, check_positive
from evermap.survival.logmath import (
    entire_exponential_integral,
    gauss_legendre,
    log_one_minus_exp,
    log_ratio,
    log_sum_exp,
    scaled_e1,
)
from evermap.types import BoolArray, FloatArray


class _OfPositives(Lifetime):
    """Base of the families whose parameters are all positive."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]  # of the dataclasses below
            check_positive(getattr(self, item.name), item.name)


@dataclass(frozen=True, slots=True)
class Exponential(_OfPositives):
    """A constant hazard, `S(t) = exp(-rate t)`: memoryless (Rosen 2016 eqs. 21-24).

    Attributes:
        rate: hazard in 1/s, positive.
    """

    rate: float

    @classmethod
    def from_half_life(cls, seconds: float) -> Self:
        """Return the prior by which half of the features are gone after `seconds`."""
        check_positive(seconds, "half_life")
        return cls(math.log(2.0) / seconds)

    @classmethod
    def from_mean(cls, seconds: float) -> Self:
        """Return the prior by which features stay for `seconds` on average."""
        check_positive(seconds, "mean_stay")
        return cls(1.0 / seconds)

    def mean(self) -> float:
        return 1.0 / self.rate

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return self.rate * (b - a)

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(math.log(self.rate) + np.log(b - a))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        return np.full(t.shape, math.log(self.rate))

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        return np.asarray(np.exp(log_target) / self.rate)


@dataclass(frozen=True, slots=True)
class Uniform(_OfPositives):
    """`S(t) = 1 - t / limit_s` up to `limit_s`, then 0 (the truth in Rosen 2016 section VII).

    Attributes:
        limit_s: longest lifetime in seconds, positive.
    """

    limit_s: float

    def mean(self) -> float:
        return 0.5 * self.limit_s

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        left = self.limit_s - a
        gone = (b - a) / left
        # Both differences are exact; which form keeps the last digit depends on how much is left.
        value = np.where(gone < 0.5, -np.log1p(-gone), -np.log((self.limit_s - b) / left))
        return np.where(a == b, 0.0, np.where(b >= self.limit_s, np.inf, value))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        return np.where(t < self.limit_s, -np.log(self.limit_s - t), np.inf)

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        return np.asarray(-self.limit_s * np.expm1(-np.exp(log_target)))


@dataclass(frozen=True, slots=True)
class Weibull(_OfPositives):
    """`S(t) = exp(-(t / scale_s)^shape)`; a shape below 1 means a hazard that falls with age.

    Attributes:
        scale_s: time by which 63 % are gone, in seconds, positive.
        shape: exponent, positive.
    """

    scale_s: float
    shape: float

    def mean(self) -> float:
        return self.scale_s * math.gamma(1.0 + 1.0 / self.shape)

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        # H(b) - H(a) = H(b) (1 - exp(-shape log(b / a)))
        share = np.where(a > 0.0, self.shape * log_ratio(a, b), np.inf)
        value = self.shape * np.log(b / self.scale_s) + log_one_minus_exp(share)
        return np.where(a == b, -np.inf, value)

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        from scipy.special import xlogy

        return np.asarray(math.log(self.shape / self.scale_s) + xlogy(self.shape - 1.0, t / self.scale_s))

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        return np.asarray(self.scale_s * np.exp(log_target / self.shape))


@dataclass(frozen=True, slots=True)
class LogNormal(SmoothLifetime):
    """One typical stay and a long tail: `log T ~ N(mu, sigma^2)`, `T` in seconds.

    Attributes:
        mu: mean of `log T`; half of the features are gone after `exp(mu)` seconds.
        sigma: standard deviation of `log T`, positive.
    """

    mu: float
    sigma: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.mu):
            raise ConfigError(f"must be finite, not {self.mu!r}", field="mu")
        check_positive(self.sigma, "sigma")

    @classmethod
    def from_half_life(cls, seconds: float, sigma: float) -> Self:
        """Return the prior by which half of the features are gone after `seconds`."""
        check_positive(seconds, "half_life")
        return cls(math.log(seconds), sigma)

    def mean(self) -> float:
        exponent = self.mu + 0.5 * self.sigma**2
        return math.exp(exponent) if exponent < 709.0 else math.inf

    def _standard(self, t: FloatArray) -> FloatArray:
        return np.asarray((np.log(t) - self.mu) / self.sigma)

    def _log_cumulative(self, t: FloatArray) -> FloatArray:
        """Return `log H(t) = log(-log Phi(-z))`."""
        from scipy.special import erfcx, log_ndtr, ndtr

        z = self._standard(t)
        early = ndtr(np.minimum(z, 0.0))
        # -log(1 - F) / F tends to 1 as F vanishes; log F itself never underflows.
        bracket = np.where(early > 0.0, -np.log1p(-early) / np.where(early > 0.0, early, 1.0), 1.0)
        z_late = np.maximum(z, 0.0)
        late = 0.5 * z_late**2 - np.log(0.5 * erfcx(z_late / math.sqrt(2.0)))
        return np.where(z < 0.0, log_ndtr(z) + np.log(bracket), np.log(late))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        from scipy.special import erfcx, log_ndtr

        z = self._standard(t)
        z_late = np.maximum(z, 0.0)
        early = -0.5 * z**2 - 0.5 * math.log(2.0 * math.pi) - log_ndtr(np.maximum(-z, 0.0))
        # Scaled, because exp(-z^2 / 2) and Phi(-z) both underflow while their ratio is about z.
        late = 0.5 * math.log(2.0 / math.pi) - np.log(erfcx(z_late / math.sqrt(2.0)))
        per_log_time = np.where(z < 0.0, early, late) - math.log(self.sigma)
        return np.where(t > 0.0, per_log_time - np.log(t), -np.inf)

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        from scipy.special import ndtri_exp

        hazard = np.exp(log_target)
        # From the smaller tail: z = -Phi^-1(S), or Phi^-1(F).
        early = ndtri_exp(np.log(-np.expm1(-hazard)))
        return np.asarray(np.exp(self.mu + self.sigma * np.where(hazard < 0.5, early, -ndtri_exp(-hazard))))


_UNDERFLOW = 1e-200


@dataclass(frozen=True, slots=True)
class Gamma(_OfPositives, SmoothLifetime):
    """`p(t) ~ t^(shape - 1) exp(-t / scale_s)`: `shape` exponential stages; below 1, a hazard that falls to a floor.

    Attributes:
        scale_s: seconds, positive; the hazard tends to `1 / scale_s`.
        shape: positive.
    """

    scale_s: float
    shape: float

    def mean(self) -> float:
        return self.scale_s * self.shape

    def _log_cumulative(self, t: FloatArray) -> FloatArray:
        """Return `log H(t) = log(-log Q(shape, x))`."""
        from scipy.special import gammainc, gammaincc

        x = np.asarray(t / self.scale_s)
        below, above = np.asarray(gammainc(self.shape, x), np.float64), np.asarray(gammaincc(self.shape, x), np.float64)
        # -log(1 - F) / F tends to 1 as F vanishes.
        bracket = np.where(below > _UNDERFLOW, -np.log1p(-below) / np.maximum(below, _UNDERFLOW), 1.0)
        log_below = _log_or_else(below, x, self._log_lower_series)
        log_above = _log_or_else(above, x, self._log_upper_tail)
        return np.where(below < 0.5, log_below + np.log(bracket), np.log(-log_above))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        from scipy.special import gammaincc, gammaln, xlogy

        x = np.asarray(t / self.scale_s)
        above = gammaincc(self.shape, x)
        far = self._is_far(x)
        log_hazard = np.asarray(xlogy(self.shape - 1.0, x) - x - gammaln(self.shape) - np.log(above))
        log_hazard[far] = -np.log(x[far] * self._find_gamma_tail(x[far]))
        return log_hazard - math.log(self.scale_s)

    def _is_far(self, x: FloatArray) -> FloatArray:
        """Return where the continued fraction converges in a few dozen steps."""
        return np.asarray(x > self.shape + 10.0 + 3.0 * math.sqrt(self.shape))

    def _find_gamma_tail(self, x: FloatArray) -> FloatArray:
        """Return `Gamma(shape, x) exp(x) x^-shape` (Legendre's continued fraction, DLMF 8.9.2), from its tail back."""
        x = np.where(self._is_far(x), x, self.shape + 10.0 + 3.0 * math.sqrt(self.shape))
        value = np.zeros_like(x)
        for n in range(200, 0, -1):
            value = n * (self.shape - n) / (x + 2.0 * n + 1.0 - self.shape + value)
        return np.asarray(1.0 / (x + 1.0 - self.shape + value))

    def _log_upper_tail(self, x: FloatArray) -> FloatArray:
        return np.asarray(self.shape * np.log(x) - x - math.lgamma(self.shape) + np.log(self._find_gamma_tail(x)))

    def _log_lower_series(self, x: FloatArray) -> FloatArray:
        """Return `log P(shape, x)` where it underflows, so `x` is far below `shape` or tiny (DLMF 8.7.1)."""
        ratio = np.minimum(x, self.shape)
        term = np.ones_like(x)
        total = np.ones_like(x)
        for n in range(1, 200):
            term = term * ratio / (self.shape + n)
            total = total + term
        return np.asarray(self.shape * np.log(x) - x - math.lgamma(self.shape + 1.0) + np.log(total))

    def _time_of_log_hazard(self, log_target: FloatArray) -> FloatArray:
        from scipy.special import gammainccinv, gammaincinv

        hazard = np.exp(log_target)
        early = gammaincinv(self.shape, -np.expm1(-hazard))
        return np.asarray(self.scale_s * np.where(hazard < 0.5, early, gammainccinv(self.shape, np.exp(-hazard))))


def _log_or_else(values: FloatArray, x: FloatArray, series: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return `log values`, or `series(x)` where they underflow; series are long and rarely needed."""
    tiny = np.asarray(values <= _UNDERFLOW)
    result = np.asarray(np.log(np.where(tiny, 1.0, values)))
    if tiny.any():
        result[tiny] = series(x[tiny])
    return result


_NARROW = 2.0
"""Below this `log(high / low)` the integral over the rate is taken numerically where its integrand is smooth."""


@dataclass(frozen=True, slots=True)
class GeneralPurpose(SmoothLifetime):
    """`S(t) = (E1(low t) - E1(high t)) / log(high / low)`: an exponential whose rate is log-uniform.

    Three forms, each where it keeps all digits, with `D(t) = int_low^high exp(-(rate - low) t) / rate d rate`:
    quadrature over a narrow range of rates, `Ein` (E1 without its logarithm) for early times, scaled E1 for the rest.

    Attributes:
        low: smallest rate in 1/s, positive.
        high: largest rate in 1/s, above `low`.
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        check_positive(self.low, "low")
        check_positive(self.high, "high")
        if not self.high > self.low:
            raise ConfigError(f"rates must satisfy low < high, not {self.low!r} and {self.high!r}", field="high")

    @classmethod
    def from_mean_stays(cls, shortest_s: float, longest_s: float) -> Self:
        """Return the prior of mean stays between `shortest_s` and `longest_s` seconds."""
        check_positive(shortest_s, "shortest_s")
        check_positive(longest_s, "longest_s")
        return cls(1.0 / longest_s, 1.0 / shortest_s)

    def mean(self) -> float:
        return (self.high - self.low) / (self.low * self.high * self._span)

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        rate = self.low * np.exp(self._span * np.asarray(generator.random(size)))
        return np.asarray(np.asarray(generator.standard_exponential(size)) / rate)[()]

    @property
    def _span(self) -> float:
        """Return `log(high / low)`."""
        return math.log1p((self.high - self.low) / self.low)

    def _log_cumulative(self, t: FloatArray) -> FloatArray:
        died = self._find_p_died(t)
        late = self.low * t - (np.log(self._d(t)) - math.log(self._span))
        return np.where(died < 0.5, np.log(-np.log1p(-np.minimum(died, 0.5))), np.log(late))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        # h = (exp(-low t) - exp(-high t)) / (t span S), both divided by exp(-low t)
        later = log_one_minus_exp((self.high - self.low) * t) - np.log(t) - np.log(self._d(t))
        return np.where(t > 0.0, later, math.log((self.high - self.low) / self._span))

    def _is_smooth(self, t: FloatArray) -> BoolArray:
        return np.asarray(((self.high - self.low) * t < 2.0) & (self._span < _NARROW))

    def _find_p_died(self, t: FloatArray) -> FloatArray:
        """Return `1 - S(t)`."""
        wide = np.asarray(entire_exponential_integral(self.high * t) - entire_exponential_integral(self.low * t))
        wide /= self._span
        smooth = self._is_smooth(t)
        if smooth.any():
            wide[smooth] = -self._mean_over_rates(lambda rate: np.expm1(-rate * t[smooth][:, None]))
        return wide

    def _d(self, t: FloatArray) -> FloatArray:
        """Return `S(t) span exp(low t)`."""
        value = np.asarray(scaled_e1(self.low * t) - np.exp(-(self.high - self.low) * t) * scaled_e1(self.high * t))
        early = self.high * t < 1.0
        if early.any():
            value[early] = np.exp(self.low * t[early]) * self._span * (1.0 - self._find_p_died(t[early]))
        smooth = self._is_smooth(t)
        if smooth.any():
            value[smooth] = self._span * self._mean_over_rates(
                lambda rate: np.exp(-(rate - self.low) * t[smooth][:, None])
            )
        return value

    def _mean_over_rates(self, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Average a smooth function over the log-uniform rate; meaningless unless the range of rates is narrow."""
        nodes, weights = gauss_legendre(24)
        rate = self.low * np.exp(min(self._span, _NARROW) * nodes)
        return np.asarray(function(rate) @ weights)


@dataclass(frozen=True, slots=True)
class Mixture(Lifetime):
    """`S(t) = sum_i weights[i] S_i(t)`; every sum below is of positive terms, so nothing cancels.

    Attributes:
        components: the priors, at least one.
        weights: their probabilities, positive, of sum 1.
    """

    components: tuple[LifetimePrior, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.components) == 0 or len(self.components) != len(self.weights):
            raise ConfigError(f"{len(self.components)} components need as many weights (at least one)", field="weights")
        if not all(math.isfinite(w) and w > 0.0 for w in self.weights):
            raise ConfigError(f"weights must be finite and positive, not {self.weights}", field="weights")
        if abs(math.fsum(self.weights) - 1.0) > 1e-9:
            raise ConfigError(f"weights must sum to 1, not {math.fsum(self.weights)!r}", field="weights")

    @classmethod
    def of(cls, components: Sequence[LifetimePrior], shares: Sequence[float]) -> Self:
        """Mix priors in proportion to `shares`, which need not sum to 1."""
        total = math.fsum(shares)
        if not (math.isfinite(total) and total > 0.0):
            raise ConfigError(f"shares must be positive, not {tuple(shares)}", field="shares")
        return cls(tuple(components), tuple(share / total for share in shares))

    @property
    def p_never_leaves(self) -> float:
        return math.fsum(w * c.p_never_leaves for w, c in zip(self.weights, self.components, strict=True))

    def mean(self) -> float:
        return sum(w * c.mean() for w, c in zip(self.weights, self.components, strict=True))

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        generator = np.random.default_rng(rng)
        chosen = np.asarray(
            generator.choice(len(self.weights), size=size, p=np.divide(self.weights, sum(self.weights)))
        )
        lifetime = np.empty(chosen.shape)
        for index, component in enumerate(self.components):
            mine = chosen == index
            lifetime[mine] = component.sample(generator, int(mine.sum()))
        return lifetime[()]

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        weights = self._log_weights_at(a)
        died = self._log_died(weights, a, b)
        survival = [c.log_conditional_survival(a, b) for c in self.components]
        lived = log_sum_exp(weights + np.stack(survival, axis=-1))
        return np.where(died < math.log(0.5), -np.log1p(-np.exp(died)), np.maximum(-lived, 0.0))

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        died = self._log_died(self._log_weights_at(a), a, b)
        # Where 1 - q is tiny, H = 1 - q to the last digit, and only its logarithm may be representable.
        return np.where(died < -40.0, died, np.log(self._integrated_hazard(a, b)))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        hazards = np.stack([np.log(c.hazard(t)) for c in self.components], axis=-1)
        weights = self._log_weights_at(t)
        # A component with S(t) = 0 has an infinite hazard, and weight 0.
        alive = np.where(np.isneginf(weights), -np.inf, weights + hazards)
        return np.where(np.isneginf(weights).all(axis=-1), np.inf, log_sum_exp(alive))

    def _log_weights_at(self, t: FloatArray) -> FloatArray:
        """Return log probabilities (..., components) given survival until `t`; all -inf if `S(t) = 0`."""
        joint = np.stack([np.asarray(c.log_survival(t)) for c in self.components], axis=-1) + np.log(self.weights)
        total = log_sum_exp(joint)
        return np.where(np.isneginf(total)[..., None], -np.inf, joint - total[..., None])

    def _log_died(self, weights: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
        died = log_sum_exp(weights + np.stack([c.log_conditional_death(a, b) for c in self.components], axis=-1))
        void = np.isneginf(weights).all(axis=-1)
        return np.where(void, np.where(a == b, -np.inf, 0.0), died)
