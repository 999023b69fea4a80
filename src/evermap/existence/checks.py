"""Errors of the callers of the filters: each names the row and what to try."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.errors import DataError, InputError, NumericalError
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray


def as_prior(prior: LifetimePrior | str) -> LifetimePrior:
    """A lifetime prior, or the one that a text such as `exponential:half-life=30d` describes.

    Raises:
        ConfigError: a text that describes none.
        InputError: something else.
    """
    if isinstance(prior, str):
        from evermap.survival.text import parse_prior

        return parse_prior(prior)
    if isinstance(prior, type) or not hasattr(prior, "log_conditional_survival"):
        name = prior.__name__ if isinstance(prior, type) else type(prior).__name__
        hint = "'exponential:half-life=30d', or a distribution of evermap.survival"
        raise InputError(f"a lifetime prior is needed, not {name}", field="prior", hint=hint)
    return prior


def as_rows(values: Any, n: int, field: str) -> FloatArray:
    """`values` as float64 of shape (n,): a scalar serves all rows.

    Raises:
        InputError: not numbers, or a shape that does not fit.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("not numbers", field=field) from error
    if array.shape == (n,):
        return np.ascontiguousarray(array)
    if array.ndim:
        raise InputError(f"shape {array.shape} instead of ({n},)", field=field)
    return np.full(n, float(array))


def _first(wrong: BoolArray, rows: IntArray | None) -> tuple[int, int] | None:
    """Position of the first offender in the arrays, and the row it stands for."""
    where = np.flatnonzero(wrong)
    if not where.size:
        return None
    position = int(where[0])
    return position, position if rows is None else int(rows[position])


def check_probability(values: FloatArray, field: str, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `InputError` unless all of `values` lie in [0, 1]."""
    if first := _first(~((values >= 0.0) & (values <= 1.0)), rows):
        position, row = first
        raise InputError(
            f"{noun} {row}: {values[position]} is no probability", field=field, hint="a number between 0 and 1"
        )


def check_log_likelihood(values: FloatArray, field: str, rows: IntArray | None = None) -> None:
    """Raise `InputError` unless all of `values` are numbers; an infinity is a certainty."""
    if first := _first(np.isnan(values), rows):
        raise InputError(f"row {first[1]}: nan is no log-likelihood", field=field, hint="a number, or an infinity")


def check_detected(values: FloatArray, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `InputError` unless all of `values` are 0 or 1."""
    if first := _first(~((values == 0.0) | (values == 1.0)), rows):
        position, row = first
        raise InputError(
            f"{noun} {row}: {values[position]} is neither a detection nor a miss", field="detected", hint="1 or 0"
        )


def check_times(time_s: FloatArray, last_s: FloatArray, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `InputError` unless every time is finite and not before the row's last observation."""
    if first := _first(~np.isfinite(time_s), rows):
        position, row = first
        raise InputError(f"{noun} {row}: time {time_s[position]} is no instant", field="stamp_s", hint="a finite time")
    if first := _first(time_s < last_s, rows):
        position, row = first
        past = "its birth" if last_s[position] == 0.0 else f"its last observation at {last_s[position]} s"
        raise InputError(
            f"{noun} {row}: time {time_s[position]} s lies before {past}",
            field="stamp_s",
            hint="sort by time, count from the feature's birth",
        )


def check_possible(inverse_odds: FloatArray, rows: IntArray | None = None, noun: str = "row") -> None:
    """Raise `NumericalError` where an update came out as 0 / 0: impossible under both states."""
    if first := _first(np.isnan(inverse_odds), rows):
        _, row = first
        raise NumericalError(impossible(f"{noun} {row}"), hint="P_M and P_F strictly between 0 and 1")


def check_looks(
    time_s: FloatArray,
    detected: FloatArray,
    p_miss: FloatArray,
    p_false: FloatArray,
    last_s: FloatArray,
    rows: IntArray | None = None,
) -> None:
    """Raise `InputError` unless times do not run back, detections are 0 or 1, and error rates are probabilities."""
    check_times(time_s, last_s, rows)
    check_detected(detected, rows)
    check_probability(p_miss, "p_miss", rows)
    check_probability(p_false, "p_false", rows)


def as_looks(
    stamp_s: Any, detected: Any, p_miss: Any, p_false: Any, last_s: FloatArray, rows: IntArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Looks at as many rows as `last_s` has: their times, and their likelihoods if the feature is there and if not.

    Raises:
        InputError: shapes, or numbers that `check_looks` refuses.
    """
    n = len(last_s)
    time, hit, miss, false = (
        as_rows(column, n, field)
        for column, field in ((stamp_s, "stamp_s"), (detected, "detected"), (p_miss, "p_miss"), (p_false, "p_false"))
    )
    check_looks(time, hit, miss, false, last_s, rows)
    return time, *likelihoods(hit, miss, false)


def likelihoods(detected: FloatArray, p_miss: FloatArray, p_false: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Likelihood of each look if the feature is there, and if it is not."""
    seen = detected == 1.0
    return np.where(seen, 1.0 - p_miss, p_miss), np.where(seen, p_false, 1.0 - p_false)


def impossible(who: str) -> str:
    """The one sentence for an observation that neither state of the feature can have caused."""
    return f"{who}: this observation is impossible, whether the feature is there or gone"


def check_rows(rows: Any, n: int, *, twice: bool = False, field: str = "rows") -> IntArray:
    """Row numbers as int64, each in range and, unless `twice` is allowed, at most once.

    Raises:
        InputError: a row that does not exist.
        DataError: a row twice in one update.
    """
    index = np.asarray(rows)
    if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
        raise InputError("row numbers are a list of whole numbers", field=field)
    index = index.astype(np.int64)
    if first := _first((index < 0) | (index >= n), None):
        raise InputError(f"entry {first[0]}: row {index[first[0]]} of {n} does not exist", field=field)
    if not twice and np.bincount(index, minlength=1).max() > 1:
        row = int(np.argmax(np.bincount(index)))
        raise DataError(f"row {row} is observed twice in one update", field="rows", hint="run(), which takes streams")
    return index
