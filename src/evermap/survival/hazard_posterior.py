"""The posterior of the hazard of one class as weighted draws: its survival with bounds, and its lifetime as a prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evermap.survival.base import LifetimePrior, SurvivalEstimate, check_open_share, check_times
from evermap.survival.hazard_regression import overlaps
from evermap.survival.hazards import PiecewiseConstantHazard, scale_hazard
from evermap.survival.logmath import TINY, log_sum_exp
from evermap.types import FloatArray

CERTAIN = 800.0
"""Integrated hazard that nothing survives."""


@dataclass(frozen=True, slots=True, eq=False)
class HazardPosterior(SurvivalEstimate):
    """Posterior of the hazard of one class, as weighted draws.

    Attributes:
        edges_s: (K,) starts of the stretches in seconds, the first 0; the last hazard holds for ever.
        rates: (S, K) hazards in 1/s.
        weight: (S,) of sum 1.
        said: the lifetime that a user stated; None where nothing was stated.
        before: (K,) log of the ratio of the stated hazard to the one expected without any stay; 0 where `said` is
            None, and wherever not nearly all are gone.
        risk: (K,) number of stays that were at risk in each stretch, as far as they spent time there.
    """

    edges_s: FloatArray
    rates: FloatArray
    weight: FloatArray
    said: LifetimePrior | None
    before: FloatArray
    risk: FloatArray

    @property
    def seen_s(self) -> tuple[float, float]:
        """Return the ages between which stays were at risk; below and above, the prior holds. (inf, 0) for none."""
        seen = np.flatnonzero(self.risk > 0.0)
        if not len(seen):
            return np.inf, 0.0
        low, high = int(seen[0]), int(seen[-1])
        ends_s = np.append(self.edges_s[1:], np.inf)
        return float(self.edges_s[low]), float(ends_s[high])

    def survival(self, t: ArrayLike, confidence: float = 0.95) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the expected `P(T > t)`, and its pointwise lower and upper credible bounds.

        Raises:
            ConfigError: `confidence` is not in (0, 1), or an invalid time.
        """
        check_open_share(confidence)
        times = check_times(t)
        alive = np.exp(-overlaps(np.zeros(times.size), times.ravel(), self.edges_s) @ self.rates.T)
        order = np.argsort(alive, axis=1)
        below = np.cumsum(self.weight[order], axis=1)
        tail = 0.5 * (1.0 - confidence)
        rows = np.arange(len(alive))
        lower, upper = (
            alive[rows, order[rows, np.minimum((below < share).sum(axis=1), alive.shape[1] - 1)]]
            for share in (tail, 1.0 - tail)
        )
        found = (alive @ self.weight, lower, upper)
        mean, lower, upper = (np.asarray(values.reshape(times.shape))[()] for values in found)
        return mean, lower, upper

    def prior(self) -> LifetimePrior:
        """Return the lifetime whose survival is the expected one at every edge; what was stated keeps its form, unless
        ends were seen at ages at which nothing was stated to end.
        """
        integrated = integrate_expected(self.rates, self.weight, self.edges_s)
        ends_s = np.append(self.edges_s[1:], 2.0 * self.edges_s[-1])
        if self.said is None:
            return PiecewiseConstantHazard(tuple(self.edges_s), tuple(integrated / (ends_s - self.edges_s)))
        said = 0.0 - np.asarray(self.said.log_conditional_survival(self.edges_s, ends_s))
        known = (said > 0.0) & np.isfinite(said) & (integrated > 0.0)
        factors = np.where(known, integrated / np.where(known, said, 1.0), 1.0) * np.exp(self.before)
        impossible = (said == 0.0) & (integrated > 0.0)
        if impossible.any():
            hazards = np.where(impossible, integrated, np.where(np.isfinite(said), said, CERTAIN) * factors)
            return PiecewiseConstantHazard(tuple(self.edges_s), tuple(hazards / (ends_s - self.edges_s)))
        if np.abs(factors - 1.0).max() < 1e-10:
            return self.said
        return scale_hazard(self.said, tuple(self.edges_s.tolist()), tuple(factors.tolist()))


def integrate_expected(rates: FloatArray, weight: FloatArray, edges_s: FloatArray) -> FloatArray:
    """Return integrals (K,) over the stretches of the hazard of the expected survival."""
    steps = np.diff(np.append(edges_s, 2.0 * edges_s[-1]))
    cumulative = np.concatenate([np.zeros((len(rates), 1)), np.cumsum(rates * steps, axis=1)], axis=1)
    log_expected = log_sum_exp((np.log(np.maximum(weight, TINY))[:, None] - cumulative).T)
    return np.asarray(np.maximum(-np.diff(log_expected), 0.0))
