"""The recursion, compiled: streams of observations, and one look at each of many rows with a closed-form prior.

A kernel writes into arrays it is given and returns whether any row was refused; who refused and why is for `checks` to
find out, off the fast path. Refused are times running back, probabilities outside [0, 1], parameters out of range and
observations that are impossible under both states.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from evermap.persistence.elementary import exp, expm1, exponential_integral, inlined, kernel, parallel_kernel
from evermap.persistence.state import LARGEST, LOG_LARGEST, SMALLEST
from evermap.types import BoolArray, FloatArray, IntArray

TINY_TIME = 1e-80
"""Stands for time 0 where a logarithm or a quotient is taken: S is 1 there to every digit."""
DIFFERENCE_TRUSTED = 1e-3
"""Odds of dying in a gap above which S(a) - S(t) has lost at most three digits."""
NODE = 0.7745966692414834
"""Outer nodes of Gauss-Legendre quadrature with three points; weights 5/18, 8/18, 5/18."""


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
        there = 1.0 - p_miss[i] if detected[i] else p_miss[i]
        gone = p_false[i] if detected[i] else 1.0 - p_false[i]
        new = observed(predicted, there, gone)
        after[i] = new
        survives = exp(-max(min(rate * horizon_s, LOG_LARGEST), 0.0))
        probability[i] = survives / (1.0 + new)
        fine = (gap >= 0.0) & (time_s[i] < np.inf) & (rate >= 0.0) & (rate < np.inf) & (new >= 0.0)
        fine &= (p_miss[i] >= 0.0) & (p_miss[i] <= 1.0) & (p_false[i] >= 0.0) & (p_false[i] <= 1.0)
        refused |= 0 if fine else 1
    return refused != 0


@inlined
def _scaled_survival(low: Any, high: Any, time: Any) -> Any:
    """`e^(low t) (E1(low t) - E1(high t))`, Rosen eq. 28 without its constant and without its exponential decay."""
    x, y = low * max(time, TINY_TIME), high * max(time, TINY_TIME)
    grown = exp(min(x, 1.0))
    decayed = exp(-min(y - x, 700.0))
    first = exponential_integral(x) * (grown if x < 1.0 else 1.0)
    return first - exponential_integral(y) * (grown if y < 1.0 else decayed)


@inlined
def _death_density(low: Any, high: Any, time: Any, end: Any) -> Any:
    """`e^(low end) (e^(-low t) - e^(-high t))`: density of the lifetime times t, scaled as above."""
    u = low * (end - time)  # at most the odds of dying in the gap, which are small where this is used
    return (1.0 + u * (1.0 + u * (0.5 + u * (1.0 / 6.0)))) * -expm1(-min((high - low) * time, 700.0))


@inlined
def general_purpose_death_odds(low: Any, high: Any, start: Any, stop: Any) -> Any:
    """`(1 - q) / q` of a gap for the unknown-rate prior (Rosen eqs. 26-29).

    The difference of two survivals where they differ; the integral of the density where they nearly agree.
    """
    gap = stop - start
    at_stop = _scaled_survival(low, high, stop)
    at_start = _scaled_survival(low, high, start)
    difference = expm1(max(min(low * gap, LOG_LARGEST), 0.0)) * at_start + (at_start - at_stop)
    middle = max(start + 0.5 * gap, TINY_TIME)
    reach = 0.5 * gap * NODE
    left, right = middle - reach, middle + reach
    outer = _death_density(low, high, left, stop) * right + _death_density(low, high, right, stop) * left
    mass = gap * (8.0 * _death_density(low, high, middle, stop) * left * right + 5.0 * middle * outer)
    apart = difference > DIFFERENCE_TRUSTED * at_stop
    quotient = (difference if apart else mass) / (at_stop if apart else at_stop * (18.0 * middle * left * right))
    return min(quotient, LARGEST)


@kernel
def general_purpose_gap(low: float, high: float, start: float, stop: float) -> float:
    """`general_purpose_death_odds` of a single gap, to be called from Python."""
    return float(general_purpose_death_odds(low, high, start, stop))


@kernel
def general_purpose_gaps(low: float, high: float, start_s: FloatArray, stop_s: FloatArray, odds: FloatArray) -> None:
    """`general_purpose_death_odds` of many gaps under one prior."""
    for i in range(odds.size):
        odds[i] = general_purpose_death_odds(low, high, start_s[i], stop_s[i])


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
    refused = 0
    for i in range(inverse_odds.size):
        low, high, start, stop = low_hz[i], high_hz[i], stamp_s[i], time_s[i]
        predicted = aged(inverse_odds[i], general_purpose_death_odds(low, high, start, stop))
        there = 1.0 - p_miss[i] if detected[i] else p_miss[i]
        gone = p_false[i] if detected[i] else 1.0 - p_false[i]
        new = observed(predicted, there, gone)
        after[i] = new
        probability[i] = 1.0 / (1.0 + new)
        fine = (stop >= start) & (stop < np.inf) & (low > 0.0) & (high > low) & (high < np.inf) & (new >= 0.0)
        fine &= (p_miss[i] >= 0.0) & (p_miss[i] <= 1.0) & (p_false[i] >= 0.0) & (p_false[i] <= 1.0)
        refused |= 0 if fine else 1
    if horizon_s > 0.0:
        for i in range(inverse_odds.size):
            later = general_purpose_death_odds(low_hz[i], high_hz[i], time_s[i], time_s[i] + horizon_s)
            probability[i] = 1.0 / (1.0 + aged(after[i], later))
    return refused != 0


@parallel_kernel
def exponential_parallel(
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
    chunk: int,
) -> bool:
    """`exponential` over all threads, in chunks of rows."""
    n = inverse_odds.size
    chunks = (n + chunk - 1) // chunk
    refused = np.zeros(chunks, dtype=np.bool_)
    for c in prange(chunks):
        a, b = c * chunk, min(n, (c + 1) * chunk)
        refused[c] = exponential(
            inverse_odds[a:b], stamp_s[a:b], rate_hz[a:b], time_s[a:b], detected[a:b], p_miss[a:b], p_false[a:b],
            horizon_s, after[a:b], probability[a:b],
        )  # fmt: skip
    return bool(refused.any())


@parallel_kernel
def general_purpose_parallel(
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
    chunk: int,
) -> bool:
    """`general_purpose` over all threads, in chunks of rows."""
    n = inverse_odds.size
    chunks = (n + chunk - 1) // chunk
    refused = np.zeros(chunks, dtype=np.bool_)
    for c in prange(chunks):
        a, b = c * chunk, min(n, (c + 1) * chunk)
        refused[c] = general_purpose(
            inverse_odds[a:b], stamp_s[a:b], low_hz[a:b], high_hz[a:b], time_s[a:b], detected[a:b], p_miss[a:b],
            p_false[a:b], horizon_s, after[a:b], probability[a:b],
        )  # fmt: skip
    return bool(refused.any())
