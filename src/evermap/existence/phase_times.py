"""How long until it leaves, and until it is back: mean times of a chain of phases, exact with a rhythm too."""

from __future__ import annotations

import numpy as np

from evermap.existence.phase_belief import PhaseBelief
from evermap.existence.phase_type import PhaseType
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S, bin_of_week
from evermap.types import BoolArray, FloatArray


def time_to_leave(state: PhaseBelief) -> FloatArray:
    """Expected time until each feature leaves, if it is there.

    Returns:
        (N,) seconds from `state.stamp_s` on; `inf` where some stay for ever, NaN where the feature is certainly away.
    """
    return _time_in(state, state.model.present)


def time_to_return(state: PhaseBelief) -> FloatArray:
    """Expected time until each feature returns, if it is away.

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
