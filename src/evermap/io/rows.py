"""Tables of numbers between blanks without a header, as in MRCLAM's `.dat` and TUM files.

One fast pass by numpy; only where that fails, a careful one that finds the line at fault.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.io.text import decode_text, parse_float, quote
from evermap.types import FloatArray, IntArray
from evermap.valid import Quantity


@dataclass(frozen=True, slots=True)
class Rows:
    """A table of numbers, every value within the limits of its quantity.

    Attributes:
        path: file it came from, for messages.
        values: (R, C) one column a quantity.
        line: (R,) line numbers in the file.
    """

    path: Path
    values: FloatArray
    line: IntArray

    def __len__(self) -> int:
        return len(self.values)

    def error(self, problem: str, *, row: int, field: str | None = None, hint: str | None = None) -> InputError:
        """Return an error that names file, line and column."""
        return InputError(problem, path=self.path, line=int(self.line[row]), field=field, hint=hint)

    def column(self, index: int) -> FloatArray:
        """Return one column, contiguous. Shape (R,)."""
        return np.ascontiguousarray(self.values[:, index])


def parse_rows(data: bytes, path: Path, quantities: tuple[Quantity, ...], warnings: list[str]) -> Rows:
    """Return numbers of a file; `#` starts a comment anywhere, lines may end in any way.

    A last line with too few numbers, or with a broken number and no line end, was cut off while it was written:
    it is left out, and `warnings` gets a remark.

    Raises:
        InputError: a line has the wrong number of columns or something that is not a number; a value is not finite or
            out of its limits; the file is not text.
    """
    text = decode_text(data, path)
    lines = text.split("\n")
    line = np.array([number for number, content in enumerate(lines, 1) if _is_data(content)], dtype=np.int64)
    values = _parse_fast(text, len(quantities)) if len(line) else np.zeros((0, len(quantities)))
    if values is None or len(values) != len(line):
        values, line = _parse_carefully(lines, line, path, quantities, warnings)
    for index, quantity in enumerate(quantities):
        quantity.check(values[:, index], path=path, line=line)
    return Rows(path, values, line)


def _is_data(content: str) -> bool:
    head = content.lstrip()
    return bool(head) and head[0] != "#"


def _parse_fast(text: str, columns: int) -> FloatArray | None:
    try:
        values = np.loadtxt(io.StringIO(text), comments="#", ndmin=2)
    except ValueError:
        return None
    return values if values.shape[1] == columns else None


def _parse_carefully(
    lines: list[str], line: IntArray, path: Path, quantities: tuple[Quantity, ...], warnings: list[str]
) -> tuple[FloatArray, IntArray]:
    values = np.empty((len(line), len(quantities)))
    for row, number in enumerate(line):
        cells = lines[number - 1].split("#")[0].split()
        last = row == len(line) - 1
        unfinished = last and number == len(lines)
        problem: InputError | None = None
        if len(cells) != len(quantities):
            unfinished = last and len(cells) < len(quantities)
            names = " ".join(quantity.name for quantity in quantities)
            problem = InputError(
                f"{len(cells)} columns instead of {len(quantities)} ({names})", path=path, line=int(number)
            )
        for column, (cell, quantity) in enumerate(zip(cells, quantities, strict=False)):
            try:
                values[row, column] = parse_float(cell)
            except ValueError:
                problem = problem or InputError(
                    f"{quote(cell)} is not a number", path=path, line=int(number), field=quantity.name
                )
        if problem is not None and unfinished:
            warnings.append(f"{path.name}: 1 unfinished last line ({number}) left out")
            return values[:row], line[:row]
        if problem is not None:
            raise problem
    return values, line
