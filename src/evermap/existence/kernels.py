"""The recursion compiled: streams of looks, and one look at each of many rows with a lifetime in closed form.

A kernel writes into arrays it is given and returns whether any row was refused; which one and why is for `batch` to
find out, off the fast path. Refused are times running back, probabilities outside [0, 1], parameters out of range and
looks that are impossible under both states.
"""

from __future__ import annotations

from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from evermap.existence import elementary, recursion
from evermap.existence.elementary import aligned_stack, inlined, kernel
from evermap.existence.recursion import RowLooks, RowState
from evermap.types import FloatArray, IntArray


def _compile_formulas() -> dict[str, Any]:
    """The formulas of `recursion`, inlined into the kernels that call them, with exponentials that are not calls."""
    space = dict(vars(recursion))
    for name, formula in vars(recursion).items():
        if isinstance(formula, FunctionType):
            space[name] = inlined(FunctionType(formula.__code__, space, name))
    for name in ("exp", "expm1", "split", "log_of_split"):
        space[name] = getattr(elementary, name)
    return space


_FORMULAS = _compile_formulas()
aged, observed, weighed = _FORMULAS["aged"], _FORMULAS["observed"], _FORMULAS["weighed"]
odds_of, gap_odds = _FORMULAS["odds_of"], _FORMULAS["gap_odds"]
scaled_survival = _FORMULAS["scaled_survival"]
_look_exponential, _later_exponential = _FORMULAS["look_exponential"], _FORMULAS["later_exponential"]
_look_two_state, _later_two_state = _FORMULAS["look_two_state"], _FORMULAS["later_two_state"]
_look_general, _later_general = _FORMULAS["look_general_purpose"], _FORMULAS["later_general_purpose"]


class Stream(NamedTuple):
    """M looks in order; those of one row are in order of time.

    Attributes:
        row: (M,) which feature each is of.
        log_death_odds: (M,) of the gap before it.
        there: (M,) its likelihood if the feature is there, or the logarithm of that.
        gone: (M,) the same if it is not.
    """

    row: IntArray
    log_death_odds: FloatArray
    there: FloatArray
    gone: FloatArray


@kernel
def predict_rows(inverse_odds: FloatArray, log_death_odds: FloatArray, predicted: FloatArray) -> None:
    """Fill in the inverse odds of rows after a gap."""
    for i in range(predicted.size):
        predicted[i] = aged(inverse_odds[i], odds_of(log_death_odds[i]))


@kernel
def stream(looks: Stream, inverse_odds: FloatArray, log_evidence: FloatArray, posterior: FloatArray) -> int:
    """Apply M looks in order.

    Args:
        looks: with likelihoods.
        inverse_odds: (N,) state, updated in place.
        log_evidence: (N,) running sum, updated in place.
        posterior: (M,) belief after each, filled in.

    Returns:
        Position of the first impossible look, or -1.
    """
    row, log_death_odds, there, gone = looks
    for i in range(row.size):
        k = row[i]
        predicted = aged(inverse_odds[k], odds_of(log_death_odds[i]))
        after, evidence = observed(predicted, there[i], gone[i])
        if np.isnan(after):
            return i
        log_evidence[k] += np.log(evidence)
        inverse_odds[k] = after
        posterior[i] = 1.0 / (1.0 + after)
    return -1


@kernel
def stream_of_logs(looks: Stream, inverse_odds: FloatArray, log_evidence: FloatArray) -> int:
    """Return stream as `stream` does, for likelihoods that only their logarithms can hold."""
    row, log_death_odds, there, gone = looks
    for i in range(row.size):
        k = row[i]
        predicted = aged(inverse_odds[k], odds_of(log_death_odds[i]))
        ratio = there[i] - gone[i]
        after = weighed(predicted, ratio)
        if np.isnan(ratio) or np.isnan(after):
            return i
        log_alive = -np.log1p(predicted)
        log_dead = 0.0 if predicted == np.inf else np.log(predicted) + log_alive
        log_evidence[k] += np.logaddexp(log_alive + there[i], log_dead + gone[i])
        inverse_odds[k] = after
    return -1


@kernel
def general_purpose_gap(low: float, high: float, start: float, stop: float) -> float:
    """Return the odds of dying within one gap under an unknown rate, to be called from Python."""
    return float(gap_odds(low, high, start, stop))


@kernel
def general_purpose_gaps(low: float, high: float, start_s: FloatArray, stop_s: FloatArray, odds: FloatArray) -> None:
    """Fill in the same for many gaps under one prior."""
    for i in range(odds.size):
        odds[i] = gap_odds(low, high, start_s[i], stop_s[i])


@kernel
def exponential(before: RowState, rates: Any, sight: RowLooks, horizon_s: float, after: Any) -> bool:
    """Look at each row of an exponential lifetime, and fill in its belief `horizon_s` later; True if refused."""
    inverse_odds, stamp_s = before
    (rate_hz,) = rates
    time_s, detected, p_miss, p_false = sight
    new_odds, probability = after
    refused = 0
    for i in range(inverse_odds.size):
        new, fine = _look_exponential(
            inverse_odds[i], stamp_s[i], rate_hz[i], time_s[i], detected[i], p_miss[i], p_false[i]
        )
        new_odds[i] = new
        probability[i] = _later_exponential(new, rate_hz[i], horizon_s)
        refused |= 0 if fine else 1
    return refused != 0


@kernel
def two_state(before: RowState, rates: Any, sight: RowLooks, horizon_s: float, after: Any) -> bool:
    """Look at each row of a feature that comes and goes; as `exponential`."""
    inverse_odds, stamp_s = before
    leave_hz, return_hz = rates
    time_s, detected, p_miss, p_false = sight
    new_odds, probability = after
    refused = 0
    for i in range(inverse_odds.size):
        leave, comes = leave_hz[i], return_hz[i]
        new, fine = _look_two_state(
            inverse_odds[i], stamp_s[i], leave, comes, time_s[i], detected[i], p_miss[i], p_false[i]
        )
        new_odds[i] = new
        probability[i] = _later_two_state(new, leave, comes, horizon_s)
        refused |= 0 if fine else 1
    return refused != 0


@kernel
def general_purpose(before: RowState, rates: Any, sight: RowLooks, horizon_s: float, after: Any) -> bool:
    """Look at each row of an unknown-rate lifetime; as `exponential`."""
    aligned_stack()
    inverse_odds, stamp_s = before
    low_hz, high_hz = rates
    time_s, detected, p_miss, p_false = sight
    new_odds, probability = after
    refused = 0
    if horizon_s > 0.0:
        for i in range(inverse_odds.size):
            low, high, stop = low_hz[i], high_hz[i], time_s[i]
            new, at_stop, fine = _look_general(
                inverse_odds[i], stamp_s[i], low, high, stop, detected[i], p_miss[i], p_false[i]
            )
            new_odds[i] = new
            probability[i] = _later_general(new, low, high, stop, horizon_s, at_stop)
            refused |= 0 if fine else 1
    else:
        for i in range(inverse_odds.size):
            new, _, fine = _look_general(
                inverse_odds[i], stamp_s[i], low_hz[i], high_hz[i], time_s[i], detected[i], p_miss[i], p_false[i]
            )
            new_odds[i] = new
            probability[i] = 1.0 / (1.0 + new)
            refused |= 0 if fine else 1
    return refused != 0
