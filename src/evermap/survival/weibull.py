"""Weibull lifetimes: a hazard that grows or falls as a power of time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.survival.base import Lifetime, check_positive
from evermap.survival.logmath import log_one_minus_exp, log_ratio
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class Weibull(Lifetime):
    """`S(t) = exp(-(t / scale_s)^shape)`; a shape below 1 means that what has stayed long stays longer.

    Attributes:
        scale_s: time by which 63 % are gone, in seconds, positive.
        shape: exponent, positive.
    """

    scale_s: float
    shape: float

    def __post_init__(self) -> None:
        check_positive(self.scale_s, "scale_s")
        check_positive(self.shape, "shape")

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
