"""Families of lifetimes in closed form: exponential, uniform, Weibull, log-normal and gamma."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, SmoothLifetime, check_positive
from evermap.survival.logmath import log_one_minus_exp, log_ratio
from evermap.types import FloatArray


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
        log_hazard[far] = -np.log(x[far] * self._continued_fraction(x[far]))
        return log_hazard - math.log(self.scale_s)

    def _is_far(self, x: FloatArray) -> FloatArray:
        """Return where the continued fraction converges in a few dozen steps."""
        return np.asarray(x > self.shape + 10.0 + 3.0 * math.sqrt(self.shape))

    def _continued_fraction(self, x: FloatArray) -> FloatArray:
        """Return `Gamma(shape, x) exp(x) x^-shape` (Legendre's continued fraction, DLMF 8.9.2), from its tail back."""
        x = np.where(self._is_far(x), x, self.shape + 10.0 + 3.0 * math.sqrt(self.shape))
        value = np.zeros_like(x)
        for n in range(200, 0, -1):
            value = n * (self.shape - n) / (x + 2.0 * n + 1.0 - self.shape + value)
        return np.asarray(1.0 / (x + 1.0 - self.shape + value))

    def _log_upper_tail(self, x: FloatArray) -> FloatArray:
        return np.asarray(
            self.shape * np.log(x) - x - math.lgamma(self.shape) + np.log(self._continued_fraction(x)),
        )

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
