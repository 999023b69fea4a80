"""A hazard that repeats, as days do: an office from which nothing vanishes at night (Rosen 2016 Fig. 2, blue)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.errors import ConfigError
from evermap.survival import checks
from evermap.survival.base import Lifetime
from evermap.survival.piecewise import integrate_steps, mean_of_stretches
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class PeriodicHazard(Lifetime):
    """`h(t) = rates[i]` while `(start_s + t) mod period_s` lies in stretch `i`.

    Attributes:
        period_s: length of the period in seconds, positive.
        edges_s: starts of the stretches within the period, the first 0, strictly increasing, below `period_s`.
        rates: hazards in 1/s, as many, none negative.
        start_s: where in the period the feature was first seen, in [0, period_s).
    """

    period_s: float
    edges_s: tuple[float, ...]
    rates: tuple[float, ...]
    start_s: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges_s", tuple(float(e) for e in self.edges_s))
        object.__setattr__(self, "rates", tuple(float(r) for r in self.rates))
        checks.positive(self.period_s, "period_s")
        checks.increasing_from_zero(self.edges_s)
        if self.edges_s[-1] >= self.period_s:
            raise ConfigError(f"edges must lie below the period, not at {self.edges_s[-1]!r}", field="edges_s")
        if len(self.rates) != len(self.edges_s):
            raise ConfigError(f"{len(self.edges_s)} edges need as many rates, not {len(self.rates)}", field="rates")
        checks.hazard_rates(self.rates)
        if not 0.0 <= self.start_s < self.period_s:
            raise ConfigError(f"must lie in [0, {self.period_s!r}), not {self.start_s!r}", field="start_s")

    @property
    def p_never_leaves(self) -> float:
        return 0.0 if any(rate > 0.0 for rate in self.rates) else 1.0

    def mean(self) -> float:
        if self.p_never_leaves > 0.0:
            return math.inf
        edges, rates = self._pattern()
        one_period, survival = mean_of_stretches(np.diff(edges), rates)
        return one_period / -math.expm1(math.log(survival)) if survival > 0.0 else one_period

    def _pattern(self) -> tuple[FloatArray, FloatArray]:
        """Edges from 0 to the period and rates, turned so that the feature's own time needs no offset.

        An offset would be added to times of any size and cost their last digits; the remainder by the period is exact.
        """
        edges, rates = np.append(self.edges_s, self.period_s), np.asarray(self.rates)
        if self.start_s == 0.0:
            return edges, rates
        first = int(np.searchsorted(edges, self.start_s, side="right")) - 1
        after, before = edges[first + 1 :] - self.start_s, edges[1 : first + 1] + (self.period_s - self.start_s)
        turned = np.concatenate(([0.0], after, before, [self.period_s]))
        return turned, np.concatenate((rates[first:], rates[: first + 1]))

    def _integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        edges, rates = self._pattern()
        in_a, in_b = np.fmod(a, self.period_s), np.fmod(b, self.period_s)
        turns = np.rint((b - in_b) / self.period_s) - np.rint((a - in_a) / self.period_s)
        nothing, whole = np.zeros_like(in_a), np.full_like(in_a, self.period_s)
        per_turn = integrate_steps(edges, rates, nothing, whole)
        within = integrate_steps(edges, rates, in_a, np.where(turns > 0, whole, in_b))
        return within + np.where(
            turns > 0, (turns - 1.0) * per_turn + integrate_steps(edges, rates, nothing, in_b), 0.0
        )

    def _log_integrated_hazard(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(np.log(self._integrated_hazard(a, b)))

    def _log_hazard(self, t: FloatArray) -> FloatArray:
        edges, rates = self._pattern()
        stretch = np.searchsorted(edges, np.fmod(t, self.period_s), side="right") - 1
        return np.asarray(np.log(rates[np.minimum(stretch, len(rates) - 1)]))
