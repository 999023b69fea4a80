"""The recursion, compiled: streams of observations, and one look at each of many rows with a closed-form prior.

A kernel writes into arrays it is given and returns whether any row was refused; who refused and why is for `checks` to
find out, off the fast path. Refused are times running back, probabilities outside [0, 1], parameters out of range and
observations that are impossible under both states.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.existence.elementary import aligned_stack, exp, expm1, inlined, kernel
from evermap.existence.state import LARGEST, LOG_LARGEST, SMALLEST
from evermap.existence.unknown_rate import conditional_survival, gap_odds, odds_of_dying, scaled_survival
from evermap.types import BoolArray, FloatArray, IntArray


@inlined
def aged(inverse_odds: Any, death_odds: Any) -> Any:
    """Inverse odds after a gap; `death_odds` is `(1 - q) / q`, infinite for certain death."""
    after = inverse_odds + (1.0 + inverse_odds) * death_odds
    finite = (inverse_odds < np.inf) & (death_odds < np.inf)
    return min(after, LARGEST) if finite else np.inf


@inlined
def observed(predicted: Any, there: Any, gone: Any) -> Any:
    """Inverse odds after an observation of these likelihoods; NaN where it is impossible under both states."""
    after = predicted * gone / there
    after = max(after, SMALLEST) if (predicted > 0.0) & (gone > 0.0) else after
    return min(after, LARGEST) if (predicted < np.inf) & (there > 0.0) else after


@kernel
def stream(
    row: IntArray,
    log_death_odds: FloatArray,
    there: FloatArray,
    gone: FloatArray,
    inverse_odds: FloatArray,
    log_evidence: FloatArray,
    posterior: FloatArray,
) -> int:
    """Apply M observations in order; those of one row must be in order of time.

    Args:
        row: (M,) which feature each is of.
        log_death_odds: (M,) of the gap before it.
        there: (M,) its likelihood if the feature is there.
        gone: (M,) its likelihood if not.
        inverse_odds: (N,) state, updated in place.
        log_evidence: (N,) running sum, updated in place.
        posterior: (M,) belief after each, filled in.

    Returns:
        Position of the first impossible observation, or -1.
    """
    for i in range(row.size):
        k = row[i]
        gap = log_death_odds[i]
        death_odds = np.exp(min(max(gap, -LOG_LARGEST), LOG_LARGEST)) if np.abs(gap) < np.inf else np.exp(gap)
        predicted = aged(inverse_odds[k], death_odds)
        after = observed(predicted, there[i], gone[i])
        if np.isnan(after):
            return i
        probability = 1.0 / (1.0 + predicted)
        complement = predicted * probability if predicted < np.inf else 1.0
        log_evidence[k] += np.log(probability * there[i] + complement * gone[i])
        inverse_odds[k] = after
        posterior[i] = 1.0 / (1.0 + after)
    return -1


@inlined
def _looked(predicted: Any, detected: Any, p_miss: Any, p_false: Any) -> Any:
    """Inverse odds after a look, and whether its numbers were in order."""
    there = 1.0 - p_miss if detected else p_miss
    gone = p_false if detected else 1.0 - p_false
    new = observed(predicted, there, gone)
    return new, (new >= 0.0) & (p_miss >= 0.0) & (p_miss <= 1.0) & (p_false >= 0.0) & (p_false <= 1.0)


@kernel
def exponential(
    inverse_odds: FloatArray,
    stamp_s: FloatArray,
    rate_hz: FloatArray,
    time_s: FloatArray,
    detected: BoolArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    horizon_s: float,
    after: FloatArray,
    probability: FloatArray,
) -> bool:
    """One look at each row of an exponential lifetime, and its belief `horizon_s` later; True if a row was refused."""
    refused = 0
    for i in range(inverse_odds.size):
        gap = time_s[i] - stamp_s[i]
        rate = rate_hz[i]
        predicted = aged(inverse_odds[i], expm1(max(min(rate * gap, LOG_LARGEST), 0.0)))
        new, fine = _looked(predicted, detected[i], p_miss[i], p_false[i])
        after[i] = new
        survives = exp(-max(min(rate * horizon_s, LOG_LARGEST), 0.0))
        probability[i] = survives / (1.0 + new)
        fine &= (gap >= 0.0) & (time_s[i] < np.inf) & (rate >= 0.0) & (rate < np.inf)
        refused |= 0 if fine else 1
    return refused != 0


@inlined
def _mixed(inverse_odds: Any, leave: Any, comes: Any, gap: Any) -> Any:
    """Inverse odds after a gap in which a feature may leave and return any number of times; sums of positive terms."""
    total = leave + comes
    x = max(min(total * gap, LOG_LARGEST), 0.0)
    fresh, kept = -expm1(-x), exp(-x)
    scale = 1.0 / max(total, SMALLEST)
    leaving = leave * scale if total > 0.0 else 1.0  # who neither leaves nor returns stays as it is
    returning = comes * scale
    bounded = min(inverse_odds, LARGEST)
    gone = leaving * fresh + bounded * (leaving + returning * kept)
    there = (returning + leaving * kept) + bounded * returning * fresh
    return min(gone / there, LARGEST)


@kernel
def two_state(
    inverse_odds: FloatArray,
    stamp_s: FloatArray,
    leave_hz: FloatArray,
    return_hz: FloatArray,
    time_s: FloatArray,
    detected: BoolArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    horizon_s: float,
    after: FloatArray,
    probability: FloatArray,
) -> bool:
    """One look at each row of a feature that comes and goes, and its belief `horizon_s` later; True if refused."""
    refused = 0
    for i in range(inverse_odds.size):
        gap, leave, comes = time_s[i] - stamp_s[i], leave_hz[i], return_hz[i]
        predicted = _mixed(inverse_odds[i], leave, comes, gap)
        gone_for_good = (inverse_odds[i] == np.inf) & (comes * gap == 0.0)
        new, fine = _looked(np.inf if gone_for_good else predicted, detected[i], p_miss[i], p_false[i])
        after[i] = new
        probability[i] = 1.0 / (1.0 + _mixed(new, leave, comes, horizon_s))
        fine &= (inverse_odds[i] >= 0.0) & (gap >= 0.0) & (time_s[i] < np.inf)
        fine &= (leave >= 0.0) & (leave < np.inf) & (comes >= 0.0) & (comes < np.inf)
        refused |= 0 if fine else 1
    return refused != 0


@kernel
def general_purpose_gap(low: float, high: float, start: float, stop: float) -> float:
    """Odds of dying within one gap under an unknown rate, to be called from Python."""
    return float(gap_odds(low, high, start, stop))


@kernel
def general_purpose_gaps(low: float, high: float, start_s: FloatArray, stop_s: FloatArray, odds: FloatArray) -> None:
    """The same for many gaps under one prior."""
    for i in range(odds.size):
        odds[i] = gap_odds(low, high, start_s[i], stop_s[i])


@kernel
def general_purpose(
    inverse_odds: FloatArray,
    stamp_s: FloatArray,
    low_hz: FloatArray,
    high_hz: FloatArray,
    time_s: FloatArray,
    detected: BoolArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    horizon_s: float,
    after: FloatArray,
    probability: FloatArray,
) -> bool:
    """One look at each row of an unknown-rate lifetime, and its belief `horizon_s` later; True if a row was refused."""
    aligned_stack()
    refused = 0
    if horizon_s > 0.0:
        for i in range(inverse_odds.size):
            low, high, stop = low_hz[i], high_hz[i], time_s[i]
            new, at_stop, fine = _look_general_purpose(
                inverse_odds[i], stamp_s[i], low, high, stop, detected[i], p_miss[i], p_false[i]
            )
            at_end, _ = scaled_survival(low, high, stop + horizon_s)
            after[i] = new
            probability[i] = conditional_survival(low, stop, stop + horizon_s, at_stop * (1.0 + new), at_end)
            refused |= 0 if fine else 1
    else:
        for i in range(inverse_odds.size):
            new, _, fine = _look_general_purpose(
                inverse_odds[i], stamp_s[i], low_hz[i], high_hz[i], time_s[i], detected[i], p_miss[i], p_false[i]
            )
            after[i] = new
            probability[i] = 1.0 / (1.0 + new)
            refused |= 0 if fine else 1
    return refused != 0


@inlined
def _look_general_purpose(
    inverse_odds: Any, start: Any, low: Any, high: Any, stop: Any, detected: Any, p_miss: Any, p_false: Any
) -> Any:
    """Inverse odds after a look, the scaled survival at its time, and whether all was in order."""
    at_start, _ = scaled_survival(low, high, start)
    at_stop, decay = scaled_survival(low, high, stop)
    predicted = aged(inverse_odds, odds_of_dying(low, high, start, stop, at_start, at_stop, decay))
    new, fine = _looked(predicted, detected, p_miss, p_false)
    fine &= (stop >= start) & (stop < np.inf) & (low > 0.0) & (high > low) & (high < np.inf)
    return new, at_stop, fine
