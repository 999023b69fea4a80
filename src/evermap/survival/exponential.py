"""Constant hazard: how long a feature has stayed says nothing about how long it will (Rosen 2016 eqs. 21-24)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from evermap.survival.base import Lifetime, check_positive
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class Exponential(Lifetime):
    """`S(t) = exp(-rate t)`.

    Attributes:
        rate: hazard in 1/s, positive.
    """

    rate: float

    def __post_init__(self) -> None:
        check_positive(self.rate, "rate")

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


def half_life(seconds: float) -> Exponential:
    """Return the prior by which half of what is there now is gone after `seconds`."""
    return Exponential.from_half_life(seconds)


def mean_stay(seconds: float) -> Exponential:
    """Return the prior of stays of `seconds` on average, of which nothing else is known."""
    return Exponential.from_mean(seconds)
