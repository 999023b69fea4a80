"""Gamma lifetimes: the sum of `shape` exponential stages; with a shape below 1, a hazard that falls to a floor."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from evermap.survival.base import Lifetime, check_positive
from evermap.survival.logmath import log_integral_of_smooth_hazard
from evermap.types import FloatArray

_UNDERFLOW = 1e-200


@dataclass(frozen=True, slots=True)
class Gamma(Lifetime):
    """`p(t) ~ t^(shape - 1) exp(-t / scale_s)`.

    Attributes:
        scale_s: seconds, positive; the hazard tends to `1 / scale_s`.
        shape: positive.
    """

    scale_s: float
    shape: float

    def __post_init__(self) -> None:
        check_positive(self.scale_s, "scale_s")
        check_positive(self.shape, "shape")

    def mean(self) -> float:
        return self.scale_s * self.shape

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return log_integral_of_smooth_hazard(a, b, self._log_cumulative, self._log_hazard)

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
