"""A chain of phases in a robot: `init`, `predict`, `update`, pure functions on many features at once.

As `evermap.existence.single`, with a row of phase probabilities for every feature in the place of one number.
Mean times until a feature leaves or returns are exact, with a rhythm too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.existence import protocol as checks
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, Looks
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S, bin_of_week
from evermap.show import Shown
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PhaseBelief(Shown):
    """Presence of N features, one row each.

    Attributes:
        model: how they come and go.
        phases: (N, n) probability of each phase at `stamp_s`.
        stamp_s: (N,) time of the last look, or of `init`.
        log_evidence: (N,) `log p(looks)` so far.
    """

    model: PhaseType
    phases: FloatArray
    stamp_s: FloatArray
    log_evidence: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    @property
    def probability(self) -> FloatArray:
        """(N,) probability of presence at `stamp_s`."""
        return _presence(self.model, self.phases)


def init(n: int, model: PhaseType, stamp_s: Any) -> PhaseBelief:
    """Return beliefs in `n` features before their first look: the model's start, or its long run at this time.

    Args:
        n: number of features.
        model: how they come and go.
        stamp_s: scalar or (n,), when.

    Raises:
        InputError: a time that is not finite.
    """
    time = checks.as_rows(stamp_s, n, "stamp_s")
    checks.check_times(time, np.full(n, -np.inf))
    if model.start is not None:
        phases = np.tile(model.start, (n, 1))
    else:
        instants, which = np.unique(time, return_inverse=True)
        phases = np.array([model.stationary(float(t)) for t in instants]).reshape(-1, model.n_phases)[which]
    return PhaseBelief(model, phases, time, np.zeros(n))


def after(model: PhaseType, looks: Looks) -> PhaseBelief:
    """Return beliefs after all looks, one row a feature; what was never looked at is heard of at the last look of all.

    Args:
        model: how features come and go.
        looks: at F features.

    Raises:
        InputError: no look at all.
        NumericalError: a look that is impossible, whether the feature is there or not.
    """
    if not len(looks.stamp_s):
        raise InputError("there is no look", field="looks", hint="init(), which needs none")
    # asked at the last look: presence is not wanted, but it is where a feature without looks begins
    stamp_s = np.full(looks.n_features, looks.stamp_s.max())
    looked = np.diff(looks.first) > 0
    stamp_s[looked] = looks.stamp_s[looks.first[1:][looked] - 1]
    _, evidence, phases = model.filtered(looks, Instants(np.arange(looks.n_features + 1), stamp_s))
    return PhaseBelief(model, phases, stamp_s, evidence)


def predict(state: PhaseBelief, stamp_s: Any, *, rows: Any = None) -> FloatArray:
    """Return the probability that each feature is there at `stamp_s`; the state stays as it is.

    Args:
        state: beliefs in N features.
        stamp_s: scalar or (N,) or (len(rows),), not before the row's last look.
        rows: row numbers asked about; all where None.

    Raises:
        InputError: a time that is not finite or lies before the last look.
    """
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state), twice=True)
    return _presence(state.model, _at(state, index, checks.as_rows(stamp_s, len(index), "stamp_s")))


def update(
    state: PhaseBelief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, *, rows: Any = None
) -> PhaseBelief:
    """Return beliefs after one look at each feature.

    Args:
        state: beliefs in N features.
        stamp_s: scalar, (N,) or (len(rows),) times of the looks.
        detected: 1 or 0, of the same shape.
        p_miss: `P(no detection | there)`, of the same shape.
        p_false: `P(detection | not there)`, of the same shape.
        rows: the rows looked at, each once; all where None.

    Raises:
        InputError: a probability outside [0, 1], time running back, or a row that does not exist.
        DataError: a row twice.
        NumericalError: a look that is impossible, whether the feature is there or not.
    """
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state))
    time, there, gone = checks.as_looks(stamp_s, detected, p_miss, p_false, state.stamp_s[index], index)
    weighed = _at(state, index, time) * np.where(state.model.present, there[:, None], gone[:, None])
    likelihood = weighed.sum(1)
    checks.check_possible(np.where(likelihood > 0.0, likelihood, np.nan), index)

    phases, stamps, evidence = state.phases.copy(), state.stamp_s.copy(), state.log_evidence.copy()
    phases[index] = weighed / likelihood[:, None]
    stamps[index] = time
    evidence[index] += np.log(likelihood)
    return replace(state, phases=phases, stamp_s=stamps, log_evidence=evidence)


def _at(state: PhaseBelief, index: IntArray, time: FloatArray) -> FloatArray:
    """(K, n) phases of some rows at a later time."""
    from evermap.existence.phase_kernels import travel_rows

    checks.check_times(time, state.stamp_s[index], index)
    phases = state.phases[index]
    travel_rows(phases, state.model.chain, state.stamp_s[index], time)
    return phases


def _presence(model: PhaseType, phases: FloatArray) -> FloatArray:
    """Probability of presence of (K, n) phases."""
    return np.asarray(np.minimum(phases[:, model.present].sum(1), 1.0), dtype=np.float64)


def time_to_leave(state: PhaseBelief) -> FloatArray:
    """Return the expected time until each feature leaves, if it is there.

    Returns:
        (N,) seconds from `state.stamp_s` on; `inf` where some stay for ever, NaN where the feature is certainly away.
    """
    return _time_in(state, state.model.present)


def time_to_return(state: PhaseBelief) -> FloatArray:
    """Return the expected time until each feature returns, if it is away.

    Returns:
        (N,) seconds from `state.stamp_s` on; `inf` where some never return, NaN where the feature is certainly there.
    """
    return _time_in(state, ~state.model.present)


def _time_in(state: PhaseBelief, inside: BoolArray) -> FloatArray:
    """Mean time until some phases are left, given that they hold now."""
    model = state.model
    rates = model.rates_by_bin
    for_ever = _may_last(model, inside)
    kept = np.flatnonzero(inside)[~for_ever]  # from these nothing leads to where one stays for ever
    times = np.full((len(state), model.n_phases), np.inf)
    if kept.size:
        generators = rates[:, kept][:, :, kept] - np.eye(kept.size) * rates[:, kept].sum(2)[:, :, None]
        if len(rates) == 1:
            times[:, kept] = np.linalg.solve(-generators[0], np.ones(kept.size))
        else:
            instants, which = np.unique(state.stamp_s, return_inverse=True)
            times[:, kept] = _with_rhythm(generators, instants)[which]
    weights = np.where(inside, state.phases, 0.0)
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
    """Of the phases inside, those from which one may come to where nothing leads outside."""
    changes = model.rates_hz > 0.0
    within = changes[np.ix_(inside, inside)]
    leaves = np.asarray(changes[np.ix_(inside, ~inside)].any(1), dtype=np.bool_)
    for _ in range(len(within)):
        leaves |= within @ leaves
    stuck = ~leaves
    for _ in range(len(within)):
        stuck |= within @ stuck
    return stuck
