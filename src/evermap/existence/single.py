"""The persistence filter (Rosen 2016, Algorithm 1) in inverse odds: `init`, `predict`, `update`, `observe`, and `run`.

All functions are pure. Rows are independent; every row has its own clock (seconds since its birth), its own prior and,
at every observation, its own `P_M` (miss although there) and `P_F` (detection although gone). A feature exists at
`t <= T`. With `r = (1 - p) / p` a gap of conditional survival `q` gives `r <- r + (1 + r) (1 - q) / q`, and an
observation multiplies `r` by its likelihood when gone over its likelihood when there (MATH.md section 2).
`update` takes a detector's yes or no, `observe` the likelihoods of any model of detection, `run` a stream.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.errors import InputError, NumericalError
from evermap.existence import checks
from evermap.existence.death import log_death_odds
from evermap.existence.state import LARGEST, LOG_LARGEST, SMALLEST, Belief, init
from evermap.types import BoolArray, FloatArray, IntArray

__all__ = ["Belief", "init", "observe", "predict", "run", "update"]


def predict(state: Belief, stamp_s: Any, *, rows: Any = None) -> FloatArray:
    """Probability that each feature exists at `stamp_s`; the state stays as it is.

    Args:
        state: beliefs of N features.
        stamp_s: scalar, (N,) or (len(rows),) times since birth, none before the row's last observation.
        rows: row numbers asked about; all where None.

    Returns:
        (N,) or (len(rows),) probabilities.

    Raises:
        InputError: a time that is not finite or lies before the last observation.
    """
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state), twice=True)
    time = checks.as_rows(stamp_s, len(index), "stamp_s")
    checks.check_times(time, state.stamp_s[index], index)
    return 1.0 / (1.0 + _gap(state, index, time))


def update(state: Belief, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, *, rows: Any = None) -> Belief:
    """Beliefs after one look at each feature.

    Args:
        state: beliefs of N features.
        stamp_s: scalar, (N,) or (len(rows),) times of the looks since birth; a row whose time is NaN was not looked at.
        detected: 1 or 0, of the same shape.
        p_miss: `P(no detection | there)`, of the same shape.
        p_false: `P(detection | gone)`, of the same shape.
        rows: the rows looked at, each once; all where None.

    Raises:
        InputError: a probability outside [0, 1], time running back, or a row that does not exist.
        DataError: a row twice (use `run`).
        NumericalError: an observation that is impossible under both states.
    """
    columns = {"stamp_s": stamp_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
    index, (time, hit, miss, false) = _looked_at(state, rows, columns)
    checks.check_looks(time, hit, miss, false, state.stamp_s[index], index)
    there, gone = checks.likelihoods(hit, miss, false)
    predicted = _gap(state, index, time)
    with np.errstate(all="ignore"):
        after = predicted * gone / there
    after = _clamp(after, predicted, there > 0.0, gone > 0.0)
    return _settle(state, index, time, after, lambda: _log_evidence(predicted, there, gone))


def observe(state: Belief, stamp_s: Any, log_there: Any, log_gone: Any = 0.0, *, rows: Any = None) -> Belief:
    """Beliefs after one look at each feature, whatever model of detection says how likely its outcome was.

    With `log p(y | there) - log p(y | gone)` in the place of `log_there` the beliefs are the same; the evidence is then
    relative to that of a world without the features.

    Args:
        state: beliefs of N features.
        stamp_s: scalar, (N,) or (len(rows),) times of the looks since birth; a row whose time is NaN was not looked at.
        log_there: `log p(y | there)`, of the same shape; -inf where the outcome proves that the feature is gone.
        log_gone: `log p(y | gone)`, of the same shape.
        rows: the rows looked at, each once; all where None.

    Raises:
        InputError: a likelihood that is no number, time running back, or a row that does not exist.
        DataError: a row twice.
        NumericalError: an observation that is impossible under both states.
    """
    columns = {"stamp_s": stamp_s, "log_there": log_there, "log_gone": log_gone}
    index, (time, there, gone) = _looked_at(state, rows, columns)
    checks.check_times(time, state.stamp_s[index], index)
    checks.check_log_likelihood(there, "log_there", index)
    checks.check_log_likelihood(gone, "log_gone", index)
    predicted = _gap(state, index, time)
    with np.errstate(all="ignore"):
        ratio = there - gone
        # Many landmarks may weigh more than exp can hold: in two halves, each cut where the clamp would cut anyway.
        half = np.where(np.isfinite(ratio), np.clip(0.5 * ratio, -LOG_LARGEST, LOG_LARGEST), ratio)
        factor = np.exp(-half)
        after = predicted * factor * factor
    after = _clamp(after, predicted, ratio > -np.inf, ratio < np.inf)
    return _settle(state, index, time, after, lambda: _log_evidence_of_logs(predicted, there, gone))


def run(
    state: Belief, feature: Any, stamp_s: Any, detected: Any, p_miss: Any, p_false: Any
) -> tuple[Belief, FloatArray]:
    """Apply a stream of observations in one call, in whatever order its rows come.

    Rows are taken by feature and time; those of one feature at one time keep their order. The prior is asked once for
    all gaps, then one compiled pass does the recursion.

    Args:
        state: beliefs of N features.
        feature: (M,) row of `state` that each observation is of.
        stamp_s: (M,) time since that feature's birth.
        detected: (M,) 1 or 0.
        p_miss: scalar or (M,), `P(no detection | there)`.
        p_false: scalar or (M,), `P(detection | gone)`.

    Returns:
        The beliefs after the stream, and (M,) the probability right after each observation, in the order given.

    Raises:
        InputError, NumericalError: as `update`; messages count the stream's rows from 0.
    """
    from evermap.existence.kernels import stream

    entry = np.asarray(feature)
    if entry.ndim != 1 or (entry.size and entry.dtype.kind not in "iu"):
        raise InputError("features are row numbers", field="feature", hint="whole numbers from 0")
    m = len(entry)
    entry = entry.astype(np.int64)
    wrong = np.flatnonzero((entry < 0) | (entry >= len(state)))
    if wrong.size:
        raise InputError(f"row {wrong[0]}: feature {entry[wrong[0]]} of {len(state)} does not exist", field="feature")
    time, there, gone = checks.as_looks(stamp_s, detected, p_miss, p_false, state.stamp_s[entry])

    order = np.lexsort((time, entry))
    entry, time = entry[order], time[order]
    before = np.empty(m)
    before[1:] = time[:-1]
    first = np.ones(m, dtype=np.bool_)
    first[1:] = entry[1:] != entry[:-1]
    before[first] = state.stamp_s[entry[first]]
    odds = log_death_odds(state.priors, state.prior_of_row[entry], before, time)

    inverse_odds, stamps = state.inverse_odds.copy(), state.stamp_s.copy()
    evidence = np.zeros(len(state)) if state.log_evidence is None else state.log_evidence.copy()
    posterior = np.empty(m)
    bad = int(stream(entry, odds, there[order], gone[order], inverse_odds, evidence, posterior))
    if bad >= 0:
        row = int(order[bad])
        raise NumericalError(
            checks.impossible(f"row {row} (feature {entry[bad]} at {time[bad]} s)"),
            hint="P_M and P_F strictly between 0 and 1",
        )
    stamps[entry] = time  # sorted by time, and the last assignment holds
    unsorted = np.empty(m)
    unsorted[order] = posterior
    kept = None if state.log_evidence is None else evidence
    return replace(state, inverse_odds=inverse_odds, stamp_s=stamps, log_evidence=kept), unsorted


def _gap(state: Belief, index: IntArray, time: FloatArray) -> FloatArray:
    """Inverse odds at `time`, before any new observation; certainties stay exact, the rest within the clamp."""
    odds = log_death_odds(state.priors, state.prior_of_row[index], state.stamp_s[index], time)
    inverse_odds = state.inverse_odds[index]
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        ratio = np.where(np.isinf(odds), np.exp(odds), np.exp(np.clip(odds, -LOG_LARGEST, LOG_LARGEST)))
        after = inverse_odds + (1.0 + inverse_odds) * ratio
    certain = np.isinf(inverse_odds) | np.isposinf(odds)
    return np.where(certain, np.inf, np.minimum(after, LARGEST))


def _looked_at(state: Belief, rows: Any, columns: dict[str, Any]) -> tuple[IntArray, list[FloatArray]]:
    """The rows looked at, and their part of each column; the first column is the times."""
    index = np.arange(len(state)) if rows is None else checks.check_rows(rows, len(state))
    values = [checks.as_rows(column, len(index), field) for field, column in columns.items()]
    looked = ~np.isnan(values[0])
    if looked.all():
        return index, values
    return index[looked], [column[looked] for column in values]


def _clamp(after: FloatArray, predicted: FloatArray, there: BoolArray, gone: BoolArray) -> FloatArray:
    """Inverse odds after an observation that is possible if `there` and if `gone`; NaN where under neither state.

    Only what excludes a state makes a certainty; a finite doubt stays one.
    """
    after = np.where((predicted > 0.0) & gone, np.maximum(after, SMALLEST), after)
    return np.where(np.isfinite(predicted) & there, np.minimum(after, LARGEST), after)


def _settle(
    state: Belief, index: IntArray, time: FloatArray, after: FloatArray, log_evidence: Callable[[], FloatArray]
) -> Belief:
    """The state with these rows renewed, and the evidence of their looks if anybody keeps it."""
    checks.check_possible(after, index)
    inverse_odds, stamps, evidence = state.inverse_odds.copy(), state.stamp_s.copy(), state.log_evidence
    inverse_odds[index] = after
    stamps[index] = time
    if evidence is not None:
        evidence = evidence.copy()
        evidence[index] += log_evidence()
    return replace(state, inverse_odds=inverse_odds, stamp_s=stamps, log_evidence=evidence)


def _log_evidence(predicted: FloatArray, there: FloatArray, gone: FloatArray) -> FloatArray:
    """`log p(y_n | y_1:n-1)`: the two likelihoods weighted by the predicted belief."""
    probability = 1.0 / (1.0 + predicted)
    complement = np.where(np.isinf(predicted), 1.0, np.minimum(predicted, LARGEST) * probability)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(probability * there + complement * gone), dtype=np.float64)


def _log_evidence_of_logs(predicted: FloatArray, log_there: FloatArray, log_gone: FloatArray) -> FloatArray:
    """As `_log_evidence`, of likelihoods that only their logarithms can hold."""
    with np.errstate(divide="ignore", invalid="ignore"):
        log_alive = -np.log1p(predicted)
        log_dead = np.where(np.isinf(predicted), 0.0, np.log(predicted) + log_alive)
        return np.asarray(np.logaddexp(log_alive + log_there, log_dead + log_gone), dtype=np.float64)
