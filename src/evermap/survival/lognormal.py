"""Log-normal lifetimes: one typical stay, and a long tail."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Lifetime, check_positive
from evermap.survival.logmath import log_integral_of_smooth_hazard
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class LogNormal(Lifetime):
    """`log T ~ N(mu, sigma^2)`, `T` in seconds.

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

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return log_integral_of_smooth_hazard(a, b, self._log_cumulative, self._log_hazard)

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
