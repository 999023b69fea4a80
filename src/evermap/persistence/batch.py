"""The fast road: one look at each of many features whose lifetimes have a closed form, compiled.

Every row has its own clock, lifetime parameters, `P_M` and `P_F`. State and answers are arrays of the caller, so that
nothing is allocated at a million rows: the new stamps are `time_s` itself, and `out` may be reused from look to look
(but must not overlap the inputs).
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import InputError, NumericalError
from evermap.persistence import checks
from evermap.types import BoolArray, FloatArray

CHUNK_ROWS = 65536
"""Rows that a thread takes at a time: much longer than handing them out, short enough to share them out evenly."""


class Look(NamedTuple):
    """Answers of one look at N features.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` right after the look; with `time_s` the state for the next one.
        probability: (N,) that the feature exists `horizon_s` after the look.
    """

    inverse_odds: FloatArray
    probability: FloatArray


def look_exponential(
    inverse_odds: FloatArray,
    stamp_s: FloatArray,
    rate_hz: FloatArray,
    time_s: FloatArray,
    detected: BoolArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    *,
    horizon_s: float = 0.0,
    out: Look | None = None,
    threads: bool = False,
) -> Look:
    """Predict to the look, take it in, predict `horizon_s` further: exponential lifetimes (MATH.md section 2).

    Args:
        inverse_odds: (N,) the state after the last look, 0 at birth.
        stamp_s: (N,) time of that look, in seconds since each feature's birth.
        rate_hz: (N,) hazard of each feature in 1/s; 0 never leaves.
        time_s: (N,) time of the look on each feature's own clock.
        detected: (N,) bool.
        p_miss: (N,) `P(no detection | there)`.
        p_false: (N,) `P(detection | gone)`.
        horizon_s: how far after the look the probability is wanted.
        out: arrays to fill.
        threads: spread the rows over all threads.

    Raises:
        InputError: shapes, times running back, numbers out of range; the row is named.
        NumericalError: an observation that is impossible under both states.
    """
    from evermap.persistence import kernels

    arrays = _contiguous(
        inverse_odds=inverse_odds, stamp_s=stamp_s, rate_hz=rate_hz, time_s=time_s, p_miss=p_miss, p_false=p_false
    )
    seen, answer = _prepared(arrays, detected, horizon_s, out)
    odds, stamp, rate, time, miss, false = arrays.values()
    if _apply(kernels.exponential, (odds, stamp, rate, time, seen, miss, false), horizon_s, answer, threads):
        _refuse(arrays, answer, (rate >= 0.0) & np.isfinite(rate), "rate_hz", "no rate: a finite number >= 0 is needed")
    return answer


def look_general_purpose(
    inverse_odds: FloatArray,
    stamp_s: FloatArray,
    low_hz: FloatArray,
    high_hz: FloatArray,
    time_s: FloatArray,
    detected: BoolArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    *,
    horizon_s: float = 0.0,
    out: Look | None = None,
    threads: bool = False,
) -> Look:
    """As `look_exponential`, for lifetimes of unknown rate between `low_hz` and `high_hz` (Rosen 2016 eqs. 26-29)."""
    from evermap.persistence import kernels

    arrays = _contiguous(
        inverse_odds=inverse_odds,
        stamp_s=stamp_s,
        low_hz=low_hz,
        high_hz=high_hz,
        time_s=time_s,
        p_miss=p_miss,
        p_false=p_false,
    )
    seen, answer = _prepared(arrays, detected, horizon_s, out)
    odds, stamp, low, high, time, miss, false = arrays.values()
    if _apply(kernels.general_purpose, (odds, stamp, low, high, time, seen, miss, false), horizon_s, answer, threads):
        _refuse(
            arrays, answer, (low > 0.0) & (high > low) & np.isfinite(high), "low_hz", "rates are not 0 < low < high"
        )
    return answer


def _apply(kernel: Any, columns: tuple[Any, ...], horizon_s: float, answer: Look, threads: bool) -> bool:
    """Run a kernel over all rows, at once or chunk by chunk on all cores; True if it refused a row."""
    n, horizon = len(answer.probability), float(horizon_s)

    def chunk(first: int) -> bool:
        rows = slice(first, first + CHUNK_ROWS)
        return bool(kernel(*(column[rows] for column in columns), horizon, *(array[rows] for array in answer)))

    if not threads or n <= CHUNK_ROWS:
        return bool(kernel(*columns, horizon, *answer))
    return any(list(_pool().map(chunk, range(0, n, CHUNK_ROWS))))  # a list: all of them, also after a refusal


@cache
def _pool() -> ThreadPoolExecutor:
    """A thread for each core that this process may use, started at the first call and kept."""
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive into a child
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)))


def _contiguous(**columns: Any) -> dict[str, FloatArray]:
    """Columns as contiguous float64 of one length."""
    n = np.size(columns["inverse_odds"])
    arrays = {name: np.ascontiguousarray(column, dtype=np.float64) for name, column in columns.items()}
    for name, array in arrays.items():
        if array.shape != (n,):
            raise InputError(f"shape {array.shape} instead of ({n},)", field=name)
    return arrays


def _prepared(
    arrays: dict[str, FloatArray], detected: Any, horizon_s: float, out: Look | None
) -> tuple[BoolArray, Look]:
    """The detections as booleans, and the arrays to fill."""
    n = len(arrays["time_s"])
    if not 0.0 <= horizon_s < np.inf:
        raise InputError(f"{horizon_s} s is no time after the look", field="horizon_s", hint="a finite number >= 0")
    seen = np.ascontiguousarray(detected)
    if seen.dtype != np.bool_ or seen.shape != (n,):
        raise InputError(f"{seen.dtype} of shape {seen.shape} instead of bool ({n},)", field="detected")
    answer = Look(np.empty(n), np.empty(n)) if out is None else out
    if any(a.shape != (n,) or a.dtype != np.float64 or not a.flags.c_contiguous for a in answer):
        raise InputError(f"not contiguous float64 arrays of shape ({n},)", field="out")
    if out is not None and any(np.may_share_memory(a, b) for a in answer for b in arrays.values()):
        raise InputError("shares memory with an input", field="out", hint="two sets of arrays, used in turn")
    return seen, answer


def _refuse(arrays: dict[str, FloatArray], answer: Look, fine: BoolArray, field: str, problem: str) -> None:
    """Find the row that a kernel refused, and raise its error."""
    checks.check_times(arrays["time_s"], arrays["stamp_s"])
    checks.check_probability(arrays["p_miss"], "p_miss")
    checks.check_probability(arrays["p_false"], "p_false")
    if not fine.all():
        raise InputError(f"row {int(np.argmin(fine))}: {problem}", field=field)
    odds = arrays["inverse_odds"]
    if not (odds >= 0.0).all():
        row = int(np.argmin(odds >= 0.0))
        raise InputError(f"row {row}: {odds[row]} are no inverse odds", field="inverse_odds", hint="a number >= 0")
    checks.check_possible(answer.inverse_odds)
    raise NumericalError("a row was refused for no reason that can be found")
