"""Bad rows of a file: a few are left out and counted, many are an error that says so.

A sensor that reports -2 m once in a thousand readings, a line that was cut, a quaternion of zeros: none of these is
worth a recording. Where more than `MOST_BAD` of a table is like that, the unit or the file is wrong.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evermap.errors import InputError
from evermap.types import BoolArray, FloatArray, IntArray
from evermap.valid import Quantity

MOST_BAD = 0.05
"""Share of the rows of a table that may be bad, or out of order."""
_SHOWN = 3


class Flaw(NamedTuple):
    """Something that is wrong with rows (R,) of a table, and the error that says so of one of them."""

    bad: BoolArray
    error: Callable[[int], InputError]


def count_allowed_bad(rows: int) -> int:
    """Return how many of some rows may be bad."""
    return int(MOST_BAD * rows)


def flaw_of(quantity: Quantity, values: FloatArray, path: Path, line: IntArray) -> Flaw:
    """Return which rows (R,) with some values and lines a quantity makes bad."""

    def error(row: int) -> InputError:
        try:
            quantity.check(values[row : row + 1], path=path, line=line[row : row + 1])
        except InputError as found:
            return found
        raise AssertionError("the value was bad a moment ago")

    return Flaw(~quantity.is_fine(values), error)


def sound_rows(flaws: Sequence[Flaw], rows: int, path: Path, warnings: list[str]) -> BoolArray | None:
    """Return which rows (R,) have no flaw; None if all of them are sound. `warnings` gets the number of the others.

    Raises:
        InputError: more than `MOST_BAD` of them have one; it is that of the first.
    """
    flaws = [flaw for flaw in flaws if flaw.bad.any()]
    if not flaws:
        return None
    bad = np.any([flaw.bad for flaw in flaws], axis=0)
    first = [flaw.error(int(np.argmax(flaw.bad))) for flaw in flaws]
    refuse_many(int(bad.sum()), rows, first[int(np.argmin([np.argmax(flaw.bad) for flaw in flaws]))])
    warnings.append(
        f"{path.name}: {count_text(int(bad.sum()), rows)} left out: {'; '.join(map(_brief, first[:_SHOWN]))}"
    )
    return np.asarray(~bad)


def refuse_many(bad: int, rows: int, first: InputError) -> None:
    """Raise the error of the first bad row where there are more than `MOST_BAD` of them."""
    if bad <= count_allowed_bad(rows):
        return
    if bad == 1:
        raise first
    problem = f"{first.problem}, and {bad - 1} more of {rows} rows are bad"
    raise InputError(problem, path=first.path, line=first.line, field=first.field, hint=first.hint)


def count_text(bad: int, rows: int) -> str:
    """Return '1 of 200 rows', for a remark."""
    return f"{bad} of {rows} rows"


def _brief(error: InputError) -> str:
    where = [f"{error.field}: " if error.field else "", f" (line {error.line})" if error.line else ""]
    return f"{where[0]}{error.problem}{where[1]}"


def order_of_stray(stamp_s: FloatArray, *, path: Path, line: IntArray, warnings: list[str]) -> IntArray | None:
    """Return the order by time of stamps (R,) of which a few are out of order, which `warnings` counts.

    None where they are in order, or where so many are not that the clock was set back or the file is another one.
    """
    back = np.flatnonzero(np.diff(stamp_s) < 0.0)
    if not len(back):
        return None
    stray = len(stamp_s) - longest_forward(stamp_s)
    if stray > count_allowed_bad(len(stamp_s)):
        return None
    where = f"time runs backwards at line {line[back[0] + 1]}"
    warnings.append(f"{path.name}: {count_text(stray, len(stamp_s))} out of order sorted ({where})")
    return np.argsort(stamp_s, kind="stable")


def longest_forward(stamp_s: FloatArray) -> int:
    """Return the length of the longest subsequence that never runs backwards (patience sorting)."""
    ends: list[float] = []
    for stamp in stamp_s.tolist():
        place = bisect_right(ends, stamp)
        ends[place : place + 1] = [stamp]
    return len(ends)
