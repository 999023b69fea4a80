"""A hazard that the user writes down: one constant rate per stretch of time (Rosen 2016 section V-B)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.survival import checks
from evermap.survival.base import Lifetime
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class PiecewiseConstantHazard(Lifetime):
    """`h(t) = rates[i]` for `edges_s[i] <= t < edges_s[i + 1]`; the last rate holds for ever.

    A last rate of 0 means that those still there by then never leave.

    Attributes:
        edges_s: starts of the stretches in seconds, the first 0, strictly increasing.
        rates: hazards in 1/s, as many, none negative.
    """

    edges_s: tuple[float, ...]
    rates: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges_s", tuple(float(e) for e in self.edges_s))
        object.__setattr__(self, "rates", tuple(float(r) for r in self.rates))
        checks.increasing_from_zero(self.edges_s)
        if len(self.rates) != len(self.edges_s):
            raise ConfigError(f"{len(self.edges_s)} edges need as many rates, not {len(self.rates)}", field="rates")
        checks.hazard_rates(self.rates)

    @property
    def p_never_leaves(self) -> float:
        if self.rates[-1] > 0.0:
            return 0.0
        return math.exp(-math.fsum(np.diff(self.edges_s) * self.rates[:-1]))

    def mean(self) -> float:
        lasts = np.append(np.diff(self.edges_s), np.inf)
        return mean_of_stretches(lasts, np.asarray(self.rates))[0]

    def integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """`int_a^b h`, for arrays of one shape with `a <= b`, unchecked."""
        return integrate_steps(np.append(self.edges_s, np.inf), np.asarray(self.rates), a, b)

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return self.integrated_hazard(a, b)

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(np.log(self._integrated_hazard(a, b)))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        stretch = np.searchsorted(self.edges_s, t, side="right") - 1
        return np.asarray(np.log(np.asarray(self.rates)[stretch]))


def integrate_steps(edges: FloatArray, rates: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """`int_a^b h` for a step function with `len(rates) + 1` edges; in neighbouring steps nothing cancels.

    Two ends and the whole steps between them, all positive; only these are a difference, of sums of whole steps.
    """
    first = np.clip(np.searchsorted(edges, a, side="right") - 1, 0, len(rates) - 1)
    last = np.clip(np.searchsorted(edges, b, side="right") - 1, 0, len(rates) - 1)
    whole = np.concatenate([[0.0], np.cumsum(rates[:-1] * np.diff(edges[:-1]))])  # up to the begin of every step
    within = rates[first] * (b - a)
    with np.errstate(invalid="ignore"):  # the last step has no end, nor anything after it
        begun = rates[first] * (edges[first + 1] - a)
    between = whole[last] - whole[np.minimum(first + 1, len(rates) - 1)]
    across = begun + between + rates[last] * (b - edges[last])
    return np.asarray(np.where(first == last, within, across))


def mean_of_stretches(lasts: FloatArray, rates: FloatArray) -> tuple[float, float]:
    """`int S dt` over consecutive stretches of given lengths, and `S` after the last of them."""
    total, survival = 0.0, 1.0
    for length, rate in zip(lasts, rates, strict=True):
        if survival == 0.0:
            break
        total += survival * (float(length) if rate == 0.0 else -math.expm1(-rate * length) / float(rate))
        survival *= 1.0 if rate == 0.0 else math.exp(-rate * length)
    return total, survival
