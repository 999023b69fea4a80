"""Tables with named columns: CSV, Parquet and the properties of GeoJSON features, behind one `Table`."""

from __future__ import annotations

import csv
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError, similar, suggestion
from evermap.interrupts import raises
from evermap.io.arrow import (
    arrow_cells,
    arrow_csv,
    dates_as_text,
    encode_words,
    mapped,
    numbers_of,
    numbers_of_text,
    one_array,
    pa,
    pc,
    read_parquet,
)
from evermap.io.bad_rows import Flaw, count_text, order_of_stray, refuse_many, sound_rows
from evermap.io.text import clock_of_date, date_s, decode_text, parse_float, quote, reason
from evermap.types import UNKNOWN, Clock, FloatArray, IntArray, landmark_id_of
from evermap.valid import STAMP_S, Quantity

ENDINGS = (".csv", ".csv.gz", ".parquet")
FORMULA = r"^'*[=+@\t\r-]"
"""Begin of a cell that a spreadsheet would execute, or that looks as if it had been guarded against that."""
GUARDED = r"^'+[=+@\t\r-]"
_NO_NAME = ("none", "null", "n/a", "nan", "unknown", "?", "-")
"""Texts that detectors write where they do not know what they see."""
_LARGEST_ID = 2**53
"""Whole numbers beyond this lose digits as float64, in which Parquet tables made by others often hold ids."""


@dataclass(frozen=True, slots=True)
class NamedColumns(ABC):
    """Columns of a file by name, however their cells are held.

    Attributes:
        path: file it came from, for messages.
        columns: name -> R cells.
        line: (R,) line numbers in the file; for Parquet the row, for GeoJSON the feature, counted from 1.
        header_line: where the names of the columns stand, None where that is not a line of text.
    """

    path: Path
    columns: Mapping[str, Any]
    line: IntArray
    header_line: int | None = None

    def __len__(self) -> int:
        return len(self.line)

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def error(self, problem: str, *, row: int | None, field: str | None = None, hint: str | None = None) -> InputError:
        """Return an error that names file, line and column; `row` None blames the header."""
        line = self.header_line if row is None else int(self.line[row])
        return InputError(problem, path=self.path, line=line, field=field, hint=hint)

    def expect(self, required: Sequence[str], optional: Sequence[str] = ()) -> None:
        """Raise InputError unless all of `required` and nothing beside `required` and `optional` is there."""
        known = [*required, *optional]
        for name in self.columns:
            if name not in known:
                unused = [other for other in known if other not in self.columns]
                hint = similar(name, unused) or suggestion(name, known)
                raise self.error("unknown column", row=None, field=name[:40], hint=hint)
        for name in required:
            if name not in self.columns:
                has = ", ".join(self.columns) or "none"
                raise self.error("missing column", row=None, field=name, hint=f"the file has {has}")

    def has_any(self, names: Iterable[str]) -> bool:
        """Return whether at least one of the columns is there."""
        return any(name in self.columns for name in names)

    def has_all(self, names: Sequence[str], hint: str) -> bool:
        """Return whether columns are there; raise InputError where only some of them are."""
        for name in names if self.has_any(names) else ():
            if name not in self:
                raise self.error("missing column", row=None, field=name, hint=hint)
        return self.has_any(names)

    @abstractmethod
    def numbers(self, quantity: Quantity) -> FloatArray:
        """Return a numeric column, checked against its limits. Shape (R,); nan where an optional cell is empty."""

    def filled(self, quantity: Quantity, default: float) -> FloatArray:
        """Return an optional column (R,), with what an empty cell, or no such column, means."""
        if quantity.name not in self:
            return np.full(len(self), float(default))
        values = self.numbers(quantity)
        return np.where(np.isnan(values), default, values)


class Table(NamedColumns):
    """Columns as cells of text, in a list or a pyarrow array, or as numbers (nan where empty)."""

    __slots__ = ()
    columns: Mapping[str, Any]

    def screened(self, quantities: Iterable[Quantity], warnings: list[str], further: Sequence[Flaw] = ()) -> Table:
        """Return the table without rows in which a quantity (of which it may lack some) is not what it may be.

        With stamps among them, a few rows that are out of order are sorted. `warnings` counts both; `further` flaws
        are those of several columns.

        Raises:
            InputError: so many are bad that the file is.
        """
        quantities = [quantity for quantity in quantities if quantity.name in self]
        flaws = [flaw for quantity in quantities if (flaw := self._flaw(quantity)) is not None]
        sound = sound_rows([*flaws, *further], len(self), self.path, warnings)
        table = self if sound is None else self.rows(np.flatnonzero(sound))
        if all(quantity.name != STAMP_S.name for quantity in quantities):
            return table
        order = order_of_stray(table.numbers(STAMP_S), path=self.path, line=table.line, warnings=warnings)
        return table if order is None else table.rows(order)

    def rows(self, rows: IntArray) -> Table:
        """Return some of the rows, in their order."""
        return replace(self, columns={name: _cells_of(column, rows) for name, column in self.columns.items()},
                       line=self.line[rows])  # fmt: skip

    def _flaw(self, quantity: Quantity) -> Flaw | None:
        """Which rows a quantity makes bad; None for none."""
        try:
            self.numbers(quantity)
        except InputError:
            pass
        else:
            return None
        cells = self.columns[quantity.name]
        values = cells if isinstance(cells, np.ndarray) else self._read_each(quantity, texts_of(cells))
        fine = quantity.is_fine(values)

        def error(row: int) -> InputError:
            try:  # after a good one, which says whether cells are dates
                self.rows(np.append(np.flatnonzero(fine)[:1], row)).numbers(quantity)
            except InputError as found:
                return found
            return self.error("cannot be read", row=row, field=quantity.name)

        return Flaw(~fine, error)

    def _read_each(self, quantity: Quantity, cells: Sequence[str]) -> FloatArray:
        """Return the numbers or dates in cells (R,), inf where one cannot be read."""
        read = date_s if quantity.dates and self.clock(quantity.name) is not None else parse_float
        values = np.full(len(cells), np.inf)
        for row, cell in enumerate(cells):
            if cell.strip():
                with suppress(ValueError, OverflowError):
                    values[row] = read(cell)
            elif quantity.optional:
                values[row] = np.nan
        return values

    def one_form(self, first: tuple[str, ...], second: tuple[str, ...]) -> tuple[str, ...]:
        """Return which of two ways to say the same the table uses; raises InputError where it mixes them."""
        if self.has_any(first) and self.has_any(second):
            problem = f"mixes {', '.join(first)} with {', '.join(second)}"
            raise self.error(problem, row=None, hint="keep one form")
        return second if self.has_any(second) else first

    def numbers(self, quantity: Quantity) -> FloatArray:
        cells = self.columns[quantity.name]
        if isinstance(cells, np.ndarray):
            values: FloatArray = cells
        else:
            converted = None if isinstance(cells, Sequence) else numbers_of_text(cells, optional=quantity.optional)
            values = self._parse(quantity, texts_of(cells)) if converted is None else converted
        quantity.check(values, path=self.path, line=self.line)
        return values

    def ids(self, name: str, *, optional: bool, names: dict[int, str] | None = None) -> IntArray:
        """Return whole numbers from 0; empty or -1, or no such column, means `UNKNOWN` if `optional`. Shape (R,).

        `names` takes up the texts of cells that are not numbers, by their id (`landmark_id_of`); None refuses them.

        Raises:
            InputError: a fraction, a negative number, or nothing where an id is needed; two texts with one id.
        """
        if optional and name not in self:
            return np.full(len(self), UNKNOWN, dtype=np.int64)
        if names is not None and not isinstance(self.columns[name], np.ndarray):
            return self._name_ids(name, optional, names)
        values = self.numbers(Quantity(name, UNKNOWN, _LARGEST_ID, optional=True, hint="whole numbers from 0"))
        absent = np.isnan(values) | (values == UNKNOWN)
        whole = np.where(absent, float(UNKNOWN), values)
        wrong = (whole != np.floor(whole)) | (absent if not optional else False)
        if wrong.any():
            row = int(np.argmax(wrong))
            problem = "is empty" if absent[row] else f"{values[row]:g} is not a whole number"
            raise self.error(problem, row=row, field=name, hint="an id is a whole number from 0")
        return whole.astype(np.int64)

    def counts(self, name: str) -> IntArray:
        """Return whole numbers from 0; zeros where there is no such column. Shape (R,)."""
        return self.ids(name, optional=False) if name in self else np.zeros(len(self), dtype=np.int64)

    def _name_ids(self, name: str, optional: bool, names: dict[int, str]) -> IntArray:
        """Ids of a column in which some may be texts."""
        row_label, labels = self.labels(name)
        nameless = {label for label in labels if optional and label.lower() in _NO_NAME}
        labels = ["" if label in nameless else label for label in labels]
        texts = {label for label in labels if label and not _is_number(label)}
        for text in sorted(texts):
            if names.setdefault(landmark_id_of(text), text) != text:
                other, row = names[landmark_id_of(text)], int(np.argmax(row_label == labels.index(text)))
                problem = f"{quote(text)} and {quote(other)} have the same hash"
                raise self.error(problem, row=row, field=name, hint="rename one of them")
        plain = [str(landmark_id_of(label)) if label in texts else label for label in labels]
        cells = arrow_cells(plain).take(arrow_cells(row_label)) if texts or nameless else self.columns[name]
        return replace(self, columns={name: cells}).ids(name, optional=optional)

    def labels(self, name: str) -> tuple[IntArray, list[str]]:
        """Return which of the different names in a column each row (R,) has, and these, in the order of their first
        rows; '' where a cell is empty. Whole numbers are converted to text.
        """
        cells = self.columns[name]
        if isinstance(cells, np.ndarray):
            return distinct(["" if np.isnan(value) else f"{value:.17g}" for value in cells.tolist()])
        row_word, words = distinct(cells) if isinstance(cells, Sequence) else encode_words(cells)
        for code, word in enumerate(words):
            if not word.isprintable():
                row = int(np.argmax(row_word == code))
                raise self.error("contains a character that cannot be printed", row=row, field=name)
        word_label, labels = distinct([word.strip() for word in words])
        return word_label[row_word], labels

    def clock(self, name: str = STAMP_S.name) -> Clock | None:
        """Return what the stamps of a column count, where they are dates (ISO 8601): with a zone, or without; else
        None.
        """
        cells = self.columns.get(name, ())
        first = "" if isinstance(cells, np.ndarray) else next((str(cell) for cell in cells if str(cell).strip()), "")
        return None if not first or _is_number(first) else clock_of_date(first)

    def _parse(self, quantity: Quantity, cells: Sequence[str]) -> FloatArray:
        if quantity.dates and self.clock(quantity.name) is not None:
            return self._parse_dates(quantity, cells)
        if not any("_" in cell for cell in cells):
            try:
                if quantity.optional:
                    return np.array([float(cell) if cell.strip() else np.nan for cell in cells], dtype=np.float64)
                return np.array([float(cell) for cell in cells], dtype=np.float64)
            except ValueError:
                pass
        for row, cell in enumerate(cells):
            if quantity.optional and not cell.strip():
                continue
            try:
                parse_float(cell)
            except ValueError:
                problem = f"{quote(cell)} is not a number" if cell.strip() else "is empty"
                raise self.error(problem, row=row, field=quantity.name) from None
        raise AssertionError("one of the cells failed to parse a moment ago")

    def _parse_dates(self, quantity: Quantity, cells: Sequence[str]) -> FloatArray:
        seconds, clock = np.full(len(cells), np.nan), self.clock(quantity.name)
        for row, cell in enumerate(cells):
            try:
                if cell.strip() or not quantity.optional:
                    seconds[row] = date_s(cell)
                    other = clock_of_date(cell)
                else:
                    continue
            except (ValueError, OverflowError):
                hint = "2026-03-01T12:00:00.5, with or without a zone such as +01:00 or Z; or seconds throughout"
                raise self.error(f"{quote(cell)} is not a date", row=row, field=quantity.name, hint=hint) from None
            if other is not clock:
                problem = f"{quote(cell)} has {'a' if other is Clock.UNIX else 'no'} zone, unlike the dates above"
                raise self.error(problem, row=row, field=quantity.name, hint="a zone everywhere, or nowhere")
        return seconds


def _cells_of(column: Any, rows: IntArray) -> Any:
    """Some cells of a column, in the form in which it is held."""
    if isinstance(column, np.ndarray):
        return column[rows]
    return [column[row] for row in rows.tolist()] if isinstance(column, Sequence) else column.take(arrow_cells(rows))


def parse_table(data: bytes, path: Path, warnings: list[str]) -> Table:
    """Return a table by the ending of its name: one of `ENDINGS`. Arguments and errors as `parse_csv`; a few lines with
    the wrong number of cells are left out, which `warnings` counts.
    """
    return parse_parquet(data, path) if path.name.endswith(".parquet") else parse_csv(data, path, warnings, few=True)


def parse_csv(data: bytes, path: Path, warnings: list[str], *, few: bool = False) -> Table:
    """Return a CSV table: comma separated, the first line that is not a comment names the columns, `#` starts a comment
    line.

    A last line with too few cells, or without line end and with an empty or broken last cell, was cut off while it
    was written: it is left out, and `warnings` gets a remark. pyarrow reads a plain file; one that is not, or has a
    fault, is read line by line, with the same result.

    Raises:
        InputError: no header, a repeated column name, a line with the wrong number of cells, bytes that are not text.
    """
    return _parse_plain(data, path) or parse_by_line(data, path, warnings, few=few)


def parse_by_line(data: bytes, path: Path, warnings: list[str], *, few: bool = False) -> Table:
    """Return a CSV table as `parse_csv`, slowly; errors name the line. `few`: lines that are cut may be left out."""
    lines = decode_text(data, path).split("\n")
    content = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"]
    if not content:
        raise InputError("is empty; the first line must name the columns", path=path)
    names = _header(content[0][1], path, content[0][0])
    rows: list[list[str]] = []
    numbers: list[int] = []
    cut: list[InputError] = []
    for number, line in content[1:]:
        try:
            cells = _split(line, path, number)
        except InputError as error:
            cut.append(error)
            continue
        if len(cells) == len(names) or (len(cells) == len(names) + 1 and not cells[-1].strip()):
            rows.append(cells[: len(names)])
            numbers.append(number)
        elif number == content[-1][0] and len(cells) < len(names):
            warnings.append(f"{path.name}: 1 unfinished last line ({number}) left out")
        else:
            problem = f"{len(cells)} cells instead of {len(names)} ({', '.join(names)})"
            cut.append(InputError(problem, path=path, line=number))
    if cut and not few:
        raise cut[0]
    if cut:
        refuse_many(len(cut), len(content) - 1, cut[0])
        left_out = count_text(len(cut), len(content) - 1)
        warnings.append(f"{path.name}: {left_out} left out: {cut[0].problem} (line {cut[0].line})")
    unended = bool(numbers) and numbers[-1] == content[-1][0] == len(lines)
    if unended and _is_broken([row[-1] for row in rows]):
        warnings.append(f"{path.name}: 1 unfinished last line ({len(lines)}) left out")
        rows.pop()
        numbers.pop()
    columns: Iterable[Sequence[str]] = zip(*rows, strict=True) if rows else [()] * len(names)
    if b"'" in data:
        columns = [[unguard(cell) for cell in column] for column in columns]
    return Table(path, dict(zip(names, columns, strict=True)), np.array(numbers, dtype=np.int64), content[0][0])


def _parse_plain(data: bytes, path: Path) -> Table | None:
    """The table, if it is plain: no comments and empty lines after the header, as many cells as names everywhere."""
    head = re.match(rb"(?:\xef\xbb\xbf)?(?:[ \t]*(?:#[^\n]*)?\r?\n)*[^\n]*\n", data)
    if head is None or b"\0" in data or re.search(rb"\n\s*#", data[head.end() - 1 :]):
        return None
    if b"\r" in data and data.count(b"\r") != data.count(b"\r\n"):  # lone ones end lines, too
        return None
    header = parse_by_line(head[0], path, [])
    names = list(header.columns)
    if not raises():
        pa.enable_signal_handlers(False)  # Arrow's own lose a signal that comes as a table ends, one in ten
    unended = not data.endswith(b"\n")
    rows = data.count(b"\n", head.end()) + unended
    try:
        table = arrow_csv.read_csv(
            pa.BufferReader(pa.py_buffer(data).slice(head.end())),
            read_options=arrow_csv.ReadOptions(column_names=names, use_threads=False),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False
            ),
        )
    except pa.ArrowInvalid:
        return None
    if table.num_rows != rows or header.header_line is None:
        return None
    cells = {name: one_array(column) for name, column in zip(names, table.columns, strict=True)}
    last = cells[names[-1]]
    if unended and _is_broken(last[-9:].to_pylist()):
        return None
    if len(names) == 1 and not numbers_of(pc.binary_length(pc.utf8_trim_whitespace(last)), np.int32)[0].all():
        return None  # empty lines
    if b"'" in data:
        cells = {name: mapped(column, GUARDED, unguard) for name, column in cells.items()}
    return Table(path, cells, header.header_line + 1 + np.arange(rows), header.header_line)


def parse_parquet(data: bytes, path: Path) -> Table:
    """Return a Parquet table of numbers and strings.

    Raises:
        InputError: not Parquet, damaged, a repeated column name, or a column of another type.
    """
    table = read_parquet(data, path)
    names = table.column_names
    columns = {name: _arrow_column(column, path, name) for name, column in zip(names, table.columns, strict=True)}
    return Table(path, columns, np.arange(1, table.num_rows + 1))


def distinct(words: Sequence[str]) -> tuple[IntArray, list[str]]:
    """Return the index (R,) of each text among the distinct ones, and these, in the order of their first rows."""
    code_of: dict[str, int] = {}
    codes = [code_of.setdefault(word, len(code_of)) for word in words]
    return np.array(codes, dtype=np.int64), list(code_of)


def texts_of(cells: Any) -> Sequence[str]:
    """Return cells of text as a sequence."""
    texts: Sequence[str] = cells if isinstance(cells, Sequence) else cells.to_pylist()
    return texts


def csv_text(columns: dict[str, Any], comment: str = "") -> str:
    """Return a CSV file of arrays and lists of text; floats in the shortest form that reads back the same, nan as
    empty.
    """
    head = "".join(f"# {line}\n" for line in comment.splitlines())
    cells = [_csv_cells(column) for column in columns.values()]
    body = "".join(",".join(row) + "\n" for row in zip(*cells, strict=True))
    return f"{head}{','.join(columns)}\n{body}"


def _csv_cells(column: Any) -> list[str]:
    if isinstance(column, list):
        return [_quote(guard(cell)) for cell in column]
    if column.dtype.kind == "i":
        return ["" if value == UNKNOWN else str(value) for value in column.tolist()]
    return ["" if isnan(value) else repr(value) for value in column.tolist()]


def guard(cell: str) -> str:
    """Return a text as a cell of a CSV file: a quote precedes what a spreadsheet would read as a formula."""
    return f"'{cell}" if re.match(FORMULA, cell) and not _is_number(cell) else cell


def unguard(cell: str) -> str:
    """Return the text of a cell that `guard` made."""
    return cell[1:] if re.match(GUARDED, cell) else cell


def _quote(cell: str) -> str:
    return '"' + cell.replace('"', '""') + '"' if any(c in cell for c in ',"#') else cell


def _header(line: str, path: Path, number: int) -> list[str]:
    names = [name.strip() for name in _split(line, path, number)]
    while len(names) > 1 and not names[-1]:
        names.pop()
    if len(names) == 1 and any(mark in line for mark in ";\t"):
        raise InputError("columns must be separated by commas", path=path, line=number, field=line.strip()[:40])
    for name in names:
        if not name or _is_number(name):
            problem = f"the first line must name the columns, found {quote(line.strip())}"
            raise InputError(problem, path=path, line=number)
        if names.count(name) > 1:
            raise InputError("column appears twice", path=path, line=number, field=name)
    return names


def _split(line: str, path: Path, number: int) -> list[str]:
    if '"' not in line:
        return line.split(",")
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise InputError(f"quotation marks do not match ({error})", path=path, line=number) from None


def _is_broken(column: list[str]) -> bool:
    """Return whether the last cell is not a number, in a column of numbers."""
    return len(column) > 1 and not _is_number(column[-1]) and all(map(_is_number, column[-9:-1]))


def _is_number(cell: str) -> bool:
    try:
        parse_float(cell)
    except ValueError:
        return False
    return True


def _arrow_column(column: Any, path: Path, name: str) -> list[str] | FloatArray:
    kind = column.type
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
        column = column.cast(kind)
    try:
        if pa.types.is_string(kind) or pa.types.is_large_string(kind):
            return [cell or "" for cell in column.to_pylist()]
        if pa.types.is_timestamp(kind):
            return dates_as_text(column)
        if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind):
            values, known = numbers_of(column.cast(pa.float64(), safe=False).combine_chunks(), np.float64)
            return np.where(known, values, np.nan)
    except (pa.ArrowException, ValueError) as error:
        raise InputError(f"damaged column: {reason(error)}", path=path, field=name) from error
    raise InputError(f"contains {kind}, not numbers", path=path, field=name, hint="cast the column to float64")
