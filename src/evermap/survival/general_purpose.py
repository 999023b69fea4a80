"""A constant hazard of unknown size: the least informative lifetime prior (Rosen 2016 eqs. 25-29)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from evermap.errors import ConfigError
from evermap.survival.base import Seed, SmoothLifetime, check_positive
from evermap.survival.logmath import (
    entire_exponential_integral,
    gauss_legendre,
    log_one_minus_exp,
    scaled_e1,
)
from evermap.types import BoolArray, FloatArray

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
        died = self._died(t)
        late = self.low * t - (np.log(self._d(t)) - math.log(self._span))
        return np.where(died < 0.5, np.log(-np.log1p(-np.minimum(died, 0.5))), np.log(late))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        # h = (exp(-low t) - exp(-high t)) / (t span S), both divided by exp(-low t)
        later = log_one_minus_exp((self.high - self.low) * t) - np.log(t) - np.log(self._d(t))
        return np.where(t > 0.0, later, math.log((self.high - self.low) / self._span))

    def _is_smooth(self, t: FloatArray) -> BoolArray:
        return np.asarray(((self.high - self.low) * t < 2.0) & (self._span < _NARROW))

    def _died(self, t: FloatArray) -> FloatArray:
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
            value[early] = np.exp(self.low * t[early]) * self._span * (1.0 - self._died(t[early]))
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
