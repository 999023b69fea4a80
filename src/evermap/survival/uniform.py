"""Lifetimes uniform up to a limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.survival.base import Lifetime, check_positive
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class Uniform(Lifetime):
    """`S(t) = 1 - t / limit_s` up to `limit_s`, then 0 (the truth in Rosen 2016 section VII).

    Attributes:
        limit_s: longest lifetime in seconds, positive.
    """

    limit_s: float

    def __post_init__(self) -> None:
        check_positive(self.limit_s, "limit_s")

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
