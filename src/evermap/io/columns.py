"""Long tables of looks and the like: CSV (also gzipped) and Parquet, a million rows in a fraction of a second.

Columns stay pyarrow arrays, of which whole columns are converted. Whatever that refuses goes through `Table`, which
finds line and cell at fault.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from evermap.errors import InputError
from evermap.io.arrow import (
    arrow_cells,
    arrow_csv,
    dates_as_text,
    encode_words,
    floats_of,
    mapped,
    numbers_of_text,
    one_array,
    pa,
    pc,
    pq,
    read_parquet,
)
from evermap.io.files import unpacked
from evermap.io.table import FORMULA, NamedColumns, Table, guard, parse_csv
from evermap.io.text import quote, reason
from evermap.types import UNKNOWN, Clock, FloatArray, IntArray
from evermap.valid import Quantity

_BATCH_ROWS = 1 << 18
_FLAGS = {"1": 1.0, "0": 0.0, "true": 1.0, "false": 0.0, "1.0": 1.0, "0.0": 0.0, "": np.nan, "nan": np.nan}


@runtime_checkable
class DataFrame(Protocol):
    """A table in memory that exports an Arrow stream: of pandas, polars, pyarrow, DuckDB."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Return a capsule of the stream (Arrow PyCapsule interface)."""


TableSource: TypeAlias = str | Path | DataFrame
"""A file with a table, or a data frame."""


class Columns(NamedColumns):
    """Columns as pyarrow arrays: text from CSV, any type from Parquet."""

    __slots__ = ()

    def numbers(self, quantity: Quantity) -> FloatArray:
        cells = self.columns[quantity.name]
        if _is_text(cells.type):
            converted = numbers_of_text(cells, optional=quantity.optional)
            if converted is None:
                return self._table({quantity.name: cells.to_pylist()}).numbers(quantity)
            values = converted
        else:
            values = self._convert_cells(cells, quantity.name)
        quantity.check(values, path=self.path, line=self.line)
        return values

    def clock(self, name: str = "stamp_s") -> Clock | None:
        """Return what the stamps of a column count, where they are dates; else None."""
        cells = self.columns[name][:1]
        text = dates_as_text(cells) if pa.types.is_timestamp(cells.type) else cells.to_pylist()
        return self._table({name: text}).clock(name) if _is_text(cells.type) or text != cells.to_pylist() else None

    def flags(self, name: str, *, hint: str) -> FloatArray:
        """Return a column of 1 or true, 0 or false; nan where it is empty. Shape (R,).

        Raises:
            InputError: another word or number.
        """
        cells = self.columns[name]
        if not _is_text(cells.type):
            values = self._convert_cells(cells, name)
            wrong = np.flatnonzero(~((values == 0.0) | (values == 1.0) | np.isnan(values)))
            if wrong.size:
                raise self.error(f"{values[wrong[0]]:g} is neither 1 nor 0", row=int(wrong[0]), field=name, hint=hint)
            return values
        words = pc.utf8_lower(pc.utf8_trim_whitespace(cells))
        row_word, known = encode_words(words)
        unknown = [k for k, word in enumerate(known) if word not in _FLAGS]
        if unknown:
            row = int(np.flatnonzero(np.isin(row_word, unknown))[0])
            raise self.error(f"{quote(cells[row].as_py())} is neither 1 nor 0", row=row, field=name, hint=hint)
        return np.array([*(_FLAGS[word] for word in known), np.nan])[row_word]

    def labels(self, name: str) -> tuple[list[str], IntArray]:
        """Return a column of names or whole numbers: the different ones in natural order, and which each row has.

        Returns:
            The names (numbers in order of size, else by alphabet), and (R,) the index of each row's, `UNKNOWN` where
            the cell is empty.

        Raises:
            InputError: numbers that are not whole, or characters that cannot be printed.
        """
        cells = self.columns[name]
        if pa.types.is_floating(cells.type):
            values = self._convert_cells(cells, name)
            wrong = np.flatnonzero(~np.isnan(values) & ~((values == np.floor(values)) & (np.abs(values) < 2.0**63)))
            if wrong.size:
                problem = f"{values[wrong[0]]:g} is not a name"
                raise self.error(problem, row=int(wrong[0]), field=name, hint="text or whole numbers")
            cells = arrow_cells(values, ~np.isnan(values)).cast(pa.int64())
        elif not _is_text(cells.type) and not pa.types.is_integer(cells.type) and not pa.types.is_null(cells.type):
            raise self.error(f"contains {cells.type}, not names", row=None, field=name, hint="text or whole numbers")
        row_name, names = encode_words(pc.utf8_trim_whitespace(cells.cast(pa.string())))
        for code, text in enumerate(names):
            if not text.isprintable():
                row = int(np.argmax(row_name == code))
                raise self.error("contains a character that cannot be printed", row=row, field=name)
        order = sorted((code for code, text in enumerate(names) if text), key=_natural(names))
        rank = np.full(len(names) + 1, UNKNOWN, dtype=np.int64)  # one more for the code -1 of a missing cell
        rank[order] = np.arange(len(order))
        return [names[code] for code in order], rank[row_name]

    def _table(self, columns: Mapping[str, Any]) -> Table:
        return Table(self.path, columns, self.line, self.header_line)

    def _convert_cells(self, cells: Any, name: str) -> FloatArray:
        """Cells that are not text as float64."""
        kind = cells.type
        if pa.types.is_timestamp(kind):
            return self._table({name: dates_as_text(cells)}).numbers(Quantity(name, optional=True, dates=True))
        fits = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean, pa.types.is_null)
        if not any(is_kind(kind) for is_kind in fits):
            raise self.error(f"contains {kind}, not numbers", row=None, field=name, hint="cast the column to float64")
        return floats_of(cells)


def read_columns(source: TableSource, warnings: list[str]) -> Columns:
    """Return a `.csv`, `.csv.gz` or `.parquet` file, a folder of the latter, or a data frame; `warnings` gets a remark
    on an unfinished last line.

    Raises:
        InputError: it is missing, damaged, or no table.
    """
    if isinstance(source, DataFrame):
        return _of_arrow(arrow_table(source), path_of(source))
    path = path_of(source)
    if path.is_dir() and parquet_files(path):
        return _join_files(list(parquet_batches(path)))
    data = _content(path)
    if data[:4] == b"PAR1":
        return _of_arrow(read_parquet(data, path), path)
    parsed = parse_csv(data, path, warnings)
    cells = {name: arrow_cells(list(c)) if isinstance(c, Sequence) else c for name, c in parsed.columns.items()}
    return Columns(path, cells, parsed.line, parsed.header_line)


def path_of(source: object) -> Path:
    """Return the path of a table for messages, of a data frame what it is.

    Raises:
        InputError: neither a path nor a data frame.
    """
    if isinstance(source, str | Path):
        return Path(source)
    if isinstance(source, DataFrame):
        return Path(f"{type(source).__module__.partition('.')[0]} data frame")
    problem = f"{type(source).__name__} is neither a file nor a data frame"
    raise InputError(problem, hint="a path, or a table of pandas, polars or pyarrow")


def arrow_table(frame: DataFrame) -> Any:
    """Return a data frame as a pyarrow table, without an index that has no name.

    Raises:
        InputError: cells of a column are of several types, or a column appears twice.
    """
    path = path_of(frame)
    try:
        table = pa.table(frame)
    except (pa.ArrowException, ValueError, TypeError) as error:
        raise InputError(f"cannot be read: {reason(error)}", path=path, hint="one type a column") from error
    names = [name for name in table.column_names if not name.startswith("__index_level_")]
    twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
    if twice is not None:
        raise InputError("appears twice", path=path, field=twice, hint="one column a name")
    return table.select(names)


def _of_arrow(table: Any, path: Path) -> Columns:
    cells = {name: one_array(column) for name, column in zip(table.column_names, table.columns, strict=True)}
    return Columns(path, cells, np.arange(1, table.num_rows + 1))


def _join_files(parts: Sequence[Columns]) -> Columns:
    if not parts:
        return Columns(Path(), {}, np.zeros(0, dtype=np.int64))
    cells = {name: pa.concat_arrays([part.columns[name] for part in parts]) for name in parts[0].columns}
    return Columns(parts[0].path, cells, np.concatenate([part.line for part in parts]))


def parquet_files(path: Path) -> list[Path]:
    """Return the Parquet files of a folder and the folders in it, by name; the path itself where it is a file."""
    return sorted(path.rglob("*.parquet")) if path.is_dir() else [path]


def parquet_batches(path: Path) -> Iterator[Columns]:
    """Yield a Parquet file, or all in a folder as one table, some rows at a time; rows count through all files.

    Raises:
        InputError: none is there, one is damaged, or files have different columns.
    """
    files, start, schema = parquet_files(path), 1, None
    for file in files:
        try:
            with pq.ParquetFile(file, page_checksum_verification=True) as source:
                schema = schema or source.schema_arrow
                if not source.schema_arrow.equals(schema):
                    hint = f"the columns of {files[0].name}, of the same types"
                    raise InputError("has other columns than the files before it", path=file, hint=hint)
                for batch in source.iter_batches(_BATCH_ROWS, use_threads=False):
                    cells = dict(zip(batch.schema.names, map(one_array, batch.columns), strict=True))
                    yield Columns(path, cells, np.arange(start, start + batch.num_rows))
                    start += batch.num_rows
        except (pa.ArrowException, OSError, ValueError) as error:
            problem = f"not a readable Parquet file: {reason(error)}"
            raise InputError(problem, path=file, hint="write it again") from error
    if schema is None:
        raise InputError("holds no Parquet file", path=path, hint="a folder of .parquet files, or one file")


def is_parted(path: Path, most: int, but: str = "") -> bool:
    """Return whether a Parquet file, or all in a folder together, have more rows than `most`, and no column `but`."""
    try:
        about = [pq.read_metadata(file) for file in parquet_files(path)]
    except (pa.ArrowException, OSError):  # none, or reading it will tell
        return False
    return sum(one.num_rows for one in about) > most and but not in about[0].schema.names


def natural_order(names: Sequence[str]) -> list[int]:
    """Return the order of names: by size where all are whole numbers, else by alphabet."""
    return sorted(range(len(names)), key=_natural(list(names)))


def named(names: Sequence[str], index: IntArray) -> Any:
    """Return a column of names for `csv_bytes`: which of `names` each row has."""
    return arrow_cells(list(names)).take(arrow_cells(index))


def csv_bytes(columns: Mapping[str, Any], *, quoted: bool = False, header: bool = True) -> bytes:
    """Return a CSV file of arrays of numbers and of `named` columns; floats in the shortest form that reads back the
    same.

    Missing numbers (nan) are empty cells. Of a file in pieces, all have `quoted` where one needs it, and the first has
    the `header`.
    """
    arrays = {name: _cells(column) for name, column in columns.items()}
    marks = quoted or any(_is_text(cells.type) and needs_quotes(cells) for cells in arrays.values())
    options = arrow_csv.WriteOptions(include_header=False, quoting_style="needed" if marks else "none")
    sink = pa.BufferOutputStream()
    if header:
        sink.write((",".join(columns) + "\n").encode())
    if len(next(iter(arrays.values()))):
        arrow_csv.write_csv(pa.table(arrays), sink, options)
    return bytes(sink.getvalue())


def needs_quotes(cells: Any) -> bool:
    """Return whether a pyarrow array of text has a cell that a CSV file must quote."""
    return bool(pc.any(pc.match_substring_regex(cells, r'[",\r\n#]|^\s|\s$')).as_py())


def _cells(column: Any) -> Any:
    """A column for a CSV file, nan as null, and without text that a spreadsheet would execute."""
    if not isinstance(column, np.ndarray):
        return mapped(column, FORMULA, guard) if _is_text(column.type) else column
    return arrow_cells(column, ~np.isnan(column) if column.dtype.kind == "f" else None)


def _content(path: Path) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError("no such file", path=path, hint="check the path") from None
    except IsADirectoryError:
        raise InputError("is a folder", path=path, hint="a .csv, .csv.gz or .parquet file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {reason(error)}", path=path) from error
    return unpacked(data, path)


def _is_text(kind: Any) -> bool:
    return bool(pa.types.is_string(kind))


def _natural(names: list[str]) -> Any:
    """Order of the names: by size where all are whole numbers, else by alphabet."""
    numbers = all(re.fullmatch(r"-?\d{1,1000}", name) for name in names if name)  # Python converts no longer ones
    return (lambda code: (int(names[code]), names[code])) if numbers else (lambda code: names[code])
