"""Text files: lines, with any line end and with the number of one that is not text; numbers between blanks; JSON."""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.io.bad_rows import count_text, flaw_of, refuse_many, sound_rows
from evermap.types import Clock, FloatArray, IntArray, Tabular
from evermap.valid import Quantity


def decode_text(data: bytes, path: Path) -> str:
    """Return UTF-8 text with newlines as line ends, whatever they were; a byte order mark is dropped.

    Raises:
        InputError: the bytes are not text, with the line where that shows first.
    """
    nul = data.find(b"\0")
    try:
        text = data.decode("utf-8-sig")
        first_bad = nul
    except UnicodeDecodeError as error:
        first_bad = error.start if nul < 0 else min(nul, error.start)
    if first_bad >= 0:
        line = data.count(b"\n", 0, first_bad) + 1
        raise InputError("is not plain text (UTF-8)", path=path, line=line, hint="was the file damaged, or packed?")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_float(cell: str) -> float:
    """Return a number as people write it; unlike `float`, no digit grouping by underscores.

    Raises:
        ValueError: the cell holds none.
    """
    if "_" in cell:
        raise ValueError(f"could not convert string to float: {cell!r}")
    return float(cell)


def date_s(cell: str) -> float:
    """Return seconds since 1970-01-01 of an ISO 8601 date: UTC if it has a zone, else as the clocks on the wall show
    them.

    Raises:
        ValueError, OverflowError: it is none.
    """
    date = datetime.fromisoformat(cell.strip())
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def clock_of_date(cell: str) -> Clock | None:
    """Return `unix` for a date with a zone, `local_wall` for one without, None for other text."""
    try:
        return Clock.UNIX if datetime.fromisoformat(cell.strip()).tzinfo else Clock.LOCAL_WALL
    except ValueError:
        return None


def parse_json(data: bytes, path: Path, **how: Any) -> Any:
    """Return a JSON document; arguments as of `json.loads`.

    Raises:
        InputError: it is none.
    """
    try:
        return json.loads(decode_text(data, path), **how)
    except json.JSONDecodeError as error:
        raise InputError(f"not valid JSON: {error.msg}", path=path, line=error.lineno) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"not valid JSON: {reason(error)}", path=path) from None


def is_number(value: Any) -> bool:
    """Return whether a value of a document is a finite number, and no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf


def counted(count: int, noun: str) -> str:
    """Return '1 row', '2 rows'."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def reason(error: BaseException) -> str:
    """Return what a library has to say about a file, in a short printable line."""
    first = (str(error).splitlines() or [""])[0] or type(error).__name__
    short = first if len(first) <= 120 else first[:117] + "..."
    return "".join(c if c.isprintable() else "?" for c in short)


def quote(cell: str) -> str:
    """Return a cell of the user's file for a message: short and printable."""
    short = cell if len(cell) <= 24 else cell[:21] + "..."
    return f"'{''.join(c if c.isprintable() else '?' for c in short)}'"


@dataclass(frozen=True, slots=True)
class Rows(Tabular):
    """A table of numbers without a header, as in MRCLAM's `.dat` and TUM files, each within the limits of its quantity.

    Attributes:
        values: (R, C) one column a quantity.
        line: (R,) line numbers in the file.
        path: file it came from, for messages.
    """

    values: FloatArray
    line: IntArray
    path: Path

    def error(self, problem: str, *, row: int, field: str | None = None, hint: str | None = None) -> InputError:
        """Return an error that names file, line and column."""
        return InputError(problem, path=self.path, line=int(self.line[row]), field=field, hint=hint)

    def column(self, index: int) -> FloatArray:
        """Return one column, contiguous. Shape (R,)."""
        return np.ascontiguousarray(self.values[:, index])


def parse_rows(data: bytes, path: Path, quantities: tuple[Quantity, ...], warnings: list[str]) -> Rows:
    """Return numbers of a file; `#` starts a comment anywhere, lines may end in any way.

    A last line with too few numbers, or with a broken number and no line end, was cut off while it was written:
    it is left out, and so are a few bad lines elsewhere (`bad_rows`); `warnings` gets a remark.

    Raises:
        InputError: many lines have the wrong number of columns or something that is not a number, or a value that is
            not finite or out of its limits; the file is not text.
    """
    text = decode_text(data, path)
    lines = text.split("\n")
    given = [number for number, content in enumerate(lines, 1) if content.strip() and content.lstrip()[0] != "#"]
    line = np.array(given, dtype=np.int64)
    values = _parse_fast(text, len(quantities)) if len(line) else np.zeros((0, len(quantities)))
    if values is None or len(values) != len(line):
        values, line = _parse_carefully(lines, line, path, quantities, warnings)
    flaws = [flaw_of(quantity, values[:, index], path, line) for index, quantity in enumerate(quantities)]
    sound = sound_rows(flaws, len(line), path, warnings)
    rows = Rows(values, line, path)
    return rows if sound is None else rows[sound]


def _parse_fast(text: str, columns: int) -> FloatArray | None:
    try:
        values = np.loadtxt(io.StringIO(text), comments="#", ndmin=2)
    except ValueError:
        return None
    return values if values.shape[1] == columns else None


def _parse_carefully(
    lines: list[str], line: IntArray, path: Path, quantities: tuple[Quantity, ...], warnings: list[str]
) -> tuple[FloatArray, IntArray]:
    """Parse what numpy could not, to find the lines at fault; a few are left out."""
    cut: dict[int, InputError] = {}
    values = np.empty((len(line), len(quantities)))
    for row, number in enumerate(line):
        cells = lines[number - 1].split("#")[0].split()
        last = row == len(line) - 1
        unfinished = last and number == len(lines)
        problem: InputError | None = None
        if len(cells) != len(quantities):
            unfinished = last and len(cells) < len(quantities)
            wanted = f"{len(quantities)} ({' '.join(quantity.name for quantity in quantities)})"
            problem = InputError(f"{len(cells)} columns instead of {wanted}", path=path, line=int(number))
        for column, (cell, quantity) in enumerate(zip(cells, quantities, strict=False)):
            try:
                values[row, column] = parse_float(cell)
            except ValueError:
                wrong = f"{quote(cell)} is not a number"
                problem = problem or InputError(wrong, path=path, line=int(number), field=quantity.name)
        if problem is not None and unfinished:
            warnings.append(f"{path.name}: 1 unfinished last line ({number}) left out")
            values, line = values[:row], line[:row]
        elif problem is not None:
            cut[row] = problem
    if cut:
        first = next(iter(cut.values()))
        refuse_many(len(cut), len(line), first)
        warnings.append(f"{path.name}: {count_text(len(cut), len(line))} left out: {first.problem} (line {first.line})")
    sound = ~np.isin(np.arange(len(line)), list(cut))
    return values[sound], line[sound]
