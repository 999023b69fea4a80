"""A chain of phases in a robot: beliefs about many features, each a row of phase probabilities.

Mean times until a feature leaves or returns are exact, with a rhythm too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, Looks, RecurrentBeliefTable, check_possible
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S, bin_of_week
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PhaseBelief(RecurrentBeliefTable):
    """Presence of N features, one row each.

    Attributes:
        model: how they come and go.
        phases: (N, n) probability of each phase at `stamp_s`.
        stamp_s: (N,) time of the last look, or of the first belief.
        log_evidence: (N,) `log p(looks)` so far.
    """

    model: PhaseType
    phases: FloatArray
    stamp_s: FloatArray
    log_evidence: FloatArray

    @property
    def probability(self) -> FloatArray:
        """(N,) probability of presence at `stamp_s`."""
        return self._present(self.phases)

    def _present(self, phases: FloatArray) -> FloatArray:
        return np.asarray(np.minimum(phases[:, self.model.present].sum(1), 1.0), dtype=np.float64)

    @classmethod
    def _first(cls, model: PhaseType, time: FloatArray) -> Self:
        if model.start is not None:
            phases = np.tile(model.start, (len(time), 1))
        else:
            instants, which = np.unique(time, return_inverse=True)
            phases = np.array([model.stationary(float(t)) for t in instants]).reshape(-1, model.n_phases)[which]
        return cls(model, phases, time, np.zeros(len(time)))

    @classmethod
    def _after(cls, model: PhaseType, looks: Looks, ends_s: FloatArray) -> Self:
        last_s = ends_s[1]
        # asked at the last look: presence is not wanted, but it is where a feature without looks begins
        _, evidence, phases = model.filtered(looks, Instants(np.arange(looks.n_features + 1), last_s))
        return cls(model, phases, last_s, evidence)

    def _at(self, index: IntArray, time: FloatArray) -> FloatArray:
        """(K, n) phases of some rows at a later time."""
        from evermap.existence.phase_kernels import travel_rows

        phases = self.phases[index]
        travel_rows(phases, self.model.chain, self.stamp_s[index], time)
        return phases

    def _presence(self, index: IntArray, time: FloatArray) -> FloatArray:
        return self._present(self._at(index, time))

    def _look(self, index: IntArray, time: FloatArray, there: FloatArray, gone: FloatArray) -> Self:
        weighed = self._at(index, time) * np.where(self.model.present, there[:, None], gone[:, None])
        likelihood = weighed.sum(1)
        check_possible(np.where(likelihood > 0.0, likelihood, np.nan), index)
        phases, stamps, evidence = self.phases.copy(), self.stamp_s.copy(), self.log_evidence.copy()
        phases[index] = weighed / likelihood[:, None]
        stamps[index] = time
        evidence[index] += np.log(likelihood)
        return replace(self, phases=phases, stamp_s=stamps, log_evidence=evidence)

    def _mean_time(self, present: bool) -> FloatArray:
        model, inside = self.model, self.model.present == present
        rates = model.rates_by_bin
        for_ever = _may_last(model, inside)
        kept = np.flatnonzero(inside)[~for_ever]  # no phase without exit can be reached from these
        times = np.full((len(self), model.n_phases), np.inf)
        if kept.size:
            generators = rates[:, kept][:, :, kept] - np.eye(kept.size) * rates[:, kept].sum(2)[:, :, None]
            if len(rates) == 1:
                times[:, kept] = np.linalg.solve(-generators[0], np.ones(kept.size))
            else:
                instants, which = np.unique(self.stamp_s, return_inverse=True)
                times[:, kept] = _with_rhythm(generators, instants)[which]
        weights = np.where(inside, self.phases, 0.0)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.where(weights > 0.0, weights * times, 0.0).sum(1) / weights.sum(1), dtype=np.float64)


def _with_rhythm(generators: FloatArray, stamp_s: FloatArray) -> FloatArray:
    """Mean time from each phase: `m(bin) = c(bin) + P(bin) m(next bin)`, closed after a week.

    Args:
        generators: (1008, k, k) of the phases that are to be left, rows of sum <= 0.
        stamp_s: (T,) now.

    Returns:
        (T, k) seconds.
    """
    k = generators.shape[1]
    survive, spent = _bin_terms(generators, BIN_S)
    week, total = np.eye(k), np.zeros(k)
    for b in range(BINS):
        total += week @ spent[b]
        week = week @ survive[b]
    begin = np.empty((BINS + 1, k))  # from the begin of each bin
    begin[BINS] = np.linalg.solve(np.eye(k) - week, total)
    for b in range(BINS - 1, -1, -1):
        begin[b] = spent[b] + survive[b] @ begin[b + 1]
    times = np.empty((len(stamp_s), k))
    for row, (now_s, b) in enumerate(zip(stamp_s, bin_of_week(stamp_s), strict=True)):
        rest_s = (b + 1) * BIN_S - (now_s - MONDAY_S) % WEEK_S
        survived, meanwhile = _bin_terms(generators[b : b + 1], rest_s)
        times[row] = meanwhile[0] + survived[0] @ begin[b + 1]
    return times


def _bin_terms(generators: FloatArray, span_s: float) -> tuple[FloatArray, FloatArray]:
    """`exp(G t)` and `int_0^t exp(G s) 1 ds`, both from one exponential (Van Loan 1978)."""
    from scipy.linalg import expm

    k = generators.shape[1]
    block = np.zeros((len(generators), k + 1, k + 1))
    block[:, :k, :k] = generators
    block[:, :k, k] = 1.0 / span_s
    whole = expm(block * span_s)
    return whole[:, :k, :k], whole[:, :k, k] * span_s


def _may_last(model: PhaseType, inside: BoolArray) -> BoolArray:
    """Return the phases inside from which a phase without exit can be reached."""
    changes = model.rates_hz > 0.0
    within = changes[np.ix_(inside, inside)]
    leaves = np.asarray(changes[np.ix_(inside, ~inside)].any(1), dtype=np.bool_)
    for _ in range(len(within)):
        leaves |= within @ leaves
    stuck = ~leaves
    for _ in range(len(within)):
        stuck |= within @ stuck
    return stuck
