"""The fast road: one look at each of many features whose lifetimes have a closed form, compiled or on tensors.

Every row has its own clock, lifetime parameters, `P_M` and `P_F`. State and answers are arrays of the caller: the new
stamps are `time_s` itself, and `out` may be reused from look to look (but must not overlap the inputs), so that nothing
is allocated at a million rows.

Columns are numpy arrays, or torch tensors of float32 or float64 on any one device; tensors give tensors, of the type of
`inverse_odds`, and stay on their device. Probabilities from float32 are within 1e-6 of those from the same numbers in
double precision. Mind that float32 keeps seven digits of a time: a week to a twentieth of a second.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from evermap.errors import InputError, NumericalError
from evermap.existence import checks
from evermap.types import FloatArray

Column = TypeVar("Column")
"""A numpy array or a torch tensor."""

CHUNK_ROWS = 65536
"""Most rows that a thread takes at a time: much longer than handing them out, short enough for busy cores to help."""


class Look(NamedTuple, Generic[Column]):
    """Answers of one look at N features.

    Attributes:
        inverse_odds: (N,) `(1 - p) / p` right after the look; with `time_s` the state for the next one.
        probability: (N,) that the feature exists `horizon_s` after the look.
    """

    inverse_odds: Column
    probability: Column


def look_exponential(
    inverse_odds: Column,
    stamp_s: Column,
    rate_hz: Column,
    time_s: Column,
    detected: Any,
    p_miss: Column,
    p_false: Column,
    *,
    horizon_s: float = 0.0,
    out: Look[Column] | None = None,
    threads: bool = False,
) -> Look[Column]:
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
        out: arrays to fill; not for tensors.
        threads: spread the rows over all cores; tensors have their own threads.

    Raises:
        InputError: shapes, times running back, numbers out of range; the row is named.
        NumericalError: an observation that is impossible under both states.
    """
    columns = {"inverse_odds": inverse_odds, "stamp_s": stamp_s, "rate_hz": rate_hz, "time_s": time_s}
    columns |= {"detected": detected, "p_miss": p_miss, "p_false": p_false}
    return _look("exponential", columns, horizon_s, out, threads)


def look_general_purpose(
    inverse_odds: Column,
    stamp_s: Column,
    low_hz: Column,
    high_hz: Column,
    time_s: Column,
    detected: Any,
    p_miss: Column,
    p_false: Column,
    *,
    horizon_s: float = 0.0,
    out: Look[Column] | None = None,
    threads: bool = False,
) -> Look[Column]:
    """As `look_exponential`, for lifetimes of unknown rate between `low_hz` and `high_hz` (Rosen 2016 eqs. 26-29)."""
    columns = {"inverse_odds": inverse_odds, "stamp_s": stamp_s, "low_hz": low_hz, "high_hz": high_hz}
    columns |= {"time_s": time_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
    return _look("general_purpose", columns, horizon_s, out, threads)


def look_two_state(
    inverse_odds: Column,
    stamp_s: Column,
    leave_hz: Column,
    return_hz: Column,
    time_s: Column,
    detected: Any,
    p_miss: Column,
    p_false: Column,
    *,
    horizon_s: float = 0.0,
    out: Look[Column] | None = None,
    threads: bool = False,
) -> Look[Column]:
    """As `look_exponential`, for features that leave and return: exponential stays and absences (MATH.md section 4).

    At birth the inverse odds are 0; of a feature that may have come and gone for long they are
    `leave_hz / return_hz`. With `return_hz = 0` this is `look_exponential`.
    """
    columns = {"inverse_odds": inverse_odds, "stamp_s": stamp_s, "leave_hz": leave_hz, "return_hz": return_hz}
    columns |= {"time_s": time_s, "detected": detected, "p_miss": p_miss, "p_false": p_false}
    return _look("two_state", columns, horizon_s, out, threads)


def _look(kind: str, columns: dict[str, Any], horizon_s: float, out: Look[Any] | None, threads: bool) -> Look[Any]:
    """The look under the lifetimes of this kind, by the kernels or by torch, whichever the columns are of."""
    if not 0.0 <= horizon_s < np.inf:
        raise InputError(f"{horizon_s} s is no time after the look", field="horizon_s", hint="a finite number >= 0")
    torch = sys.modules.get("torch")  # who has tensors has loaded it
    if torch is not None and isinstance(columns["inverse_odds"], torch.Tensor):
        from evermap.existence import tensors

        if out is not None:
            raise InputError("is for arrays only", field="out", hint="leave it out: torch keeps memory for reuse")
        _check_tensors(columns, torch)
        *found, refused = getattr(tensors, kind)(*columns.values(), float(horizon_s))
        answer: Look[Any] = Look(*found)
        if refused:
            _refuse({name: column.cpu().numpy() for name, column in columns.items()}, answer[0].cpu().numpy())
        return answer

    from evermap.existence import kernels

    columns = _contiguous(columns)
    answer = _space(columns, out)
    if _apply(getattr(kernels, kind), tuple(columns.values()), float(horizon_s), answer, threads):
        _refuse(columns, answer.inverse_odds)
    return answer


def _apply(
    kernel: Callable[..., bool], columns: tuple[Any, ...], horizon_s: float, answer: Look[Any], threads: bool
) -> bool:
    """Run a kernel over all rows, at once or chunk by chunk on all cores; True if it refused a row."""
    n = len(answer.probability)

    def chunk(rows: slice) -> bool:
        return kernel(*(column[rows] for column in columns), horizon_s, *(array[rows] for array in answer))

    if not threads or n <= CHUNK_ROWS:
        return chunk(slice(None))
    cores, pool = _pool()
    count = cores * -(-n // (cores * CHUNK_ROWS))  # as many for each core
    edges = [n * k // count for k in range(count + 1)]
    return any(list(pool.map(chunk, map(slice, edges, edges[1:]))))  # a list: all of them, also after a refusal


@cache
def _pool() -> tuple[int, ThreadPoolExecutor]:
    """How many cores this process may use, and a thread for each, started at the first call and kept."""
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive into a child
    cores = len(os.sched_getaffinity(0))
    return cores, ThreadPoolExecutor(cores)


def _contiguous(columns: dict[str, Any]) -> dict[str, Any]:
    """Columns as contiguous float64 of one length, the detections as booleans."""
    n = np.size(columns["inverse_odds"])
    arrays: dict[str, Any] = {}
    for name, column in columns.items():
        arrays[name] = np.ascontiguousarray(column, dtype=None if name == "detected" else np.float64)
        if arrays[name].shape != (n,):
            raise InputError(f"shape {arrays[name].shape} instead of ({n},)", field=name)
    if arrays["detected"].dtype != np.bool_:
        raise InputError(f"{arrays['detected'].dtype} instead of bool", field="detected")
    return arrays


def _space(columns: dict[str, Any], out: Look[FloatArray] | None) -> Look[FloatArray]:
    """The arrays to fill."""
    n = len(columns["time_s"])
    if out is None:
        return Look(np.empty(n), np.empty(n))
    if any(a.shape != (n,) or a.dtype != np.float64 or not a.flags.c_contiguous for a in out):
        raise InputError(f"not contiguous float64 arrays of shape ({n},)", field="out")
    if any(np.may_share_memory(a, b) for a in out for b in columns.values()):
        raise InputError("shares memory with an input", field="out", hint="two sets of arrays, used in turn")
    return out


def _check_tensors(columns: dict[str, Any], torch: Any) -> None:
    """Raise `InputError` unless all are tensors of one length on one device, of types that can be computed with."""
    first = columns["inverse_odds"]
    for name, column in columns.items():
        if not isinstance(column, torch.Tensor) or column.device != first.device:
            raise InputError(f"is no tensor on {first.device}", field=name, hint="all columns on one device")
        if column.ndim != 1 or column.shape != first.shape:
            raise InputError(f"shape {tuple(column.shape)} instead of ({first.numel()},)", field=name)
        if column.dtype not in ((torch.bool,) if name == "detected" else (torch.float32, torch.float64)):
            raise InputError(f"is of {column.dtype}", field=name, hint="float32 or float64, detections bool")


def _refuse(columns: dict[str, Any], after: FloatArray) -> None:
    """Find the row that was refused, and raise its error."""
    checks.check_times(columns["time_s"], columns["stamp_s"])
    checks.check_probability(columns["p_miss"], "p_miss")
    checks.check_probability(columns["p_false"], "p_false")
    for field in ("rate_hz", "leave_hz", "return_hz"):
        rate = columns.get(field, np.zeros(1))
        fine = (rate >= 0.0) & np.isfinite(rate)
        if not fine.all():
            raise InputError(f"row {int(np.argmin(fine))}: no rate: a finite number >= 0 is needed", field=field)
    if "low_hz" in columns:
        low, high = columns["low_hz"], columns["high_hz"]
        fine = (low > 0.0) & (high > low) & np.isfinite(high)
        if not fine.all():
            raise InputError(f"row {int(np.argmin(fine))}: rates are not 0 < low < high", field="low_hz")
    odds = columns["inverse_odds"]
    if not (odds >= 0.0).all():
        row = int(np.argmin(odds >= 0.0))
        raise InputError(f"row {row}: {odds[row]} are no inverse odds", field="inverse_odds", hint="a number >= 0")
    checks.check_possible(after)
    raise NumericalError("a row was refused for no reason that can be found")
