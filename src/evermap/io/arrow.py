"""Columns of pyarrow as numbers and text, and Parquet files of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.io.text import reason
from evermap.types import BoolArray, FloatArray, IntArray


class _Lazy:
    """A package that is loaded when something of it is first used."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


pa, pc, pq, arrow_csv = map(_Lazy, ("pyarrow", "pyarrow.compute", "pyarrow.parquet", "pyarrow.csv"))


def read_parquet(data: bytes, path: Path) -> Any:
    """Return a Parquet file as a pyarrow table.

    Raises:
        InputError: not Parquet, damaged, or a repeated column name.
    """
    try:
        # without threads: one that still runs while the process ends aborts it
        table = pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True).read(use_threads=False)
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError) as error:
        raise InputError(f"not a readable Parquet file: {reason(error)}", path=path, hint="write it again") from error
    for name in table.column_names:
        if table.column_names.count(name) > 1:
            raise InputError("column appears twice", path=path, field=name)
    return table


def parquet_bytes(columns: Mapping[str, Any], metadata: dict[str, str] | None = None) -> bytes:
    """Return a Parquet file of arrays and lists of text ('' becomes null), with checksums against later damage."""
    arrays = [
        arrow_cells(cells, np.array([*map(bool, cells)], dtype=np.bool_) if isinstance(cells, list) else None)
        for cells in columns.values()
    ]
    return parquet_of(pa.Table.from_arrays(arrays, names=list(columns)).replace_schema_metadata(metadata or {}))


def parquet_of(table: Any) -> bytes:
    """Return a pyarrow table as a Parquet file, with checksums against later damage."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    return bytes(sink.getvalue().to_pybytes())


def arrow_cells(cells: Any, known: BoolArray | None = None) -> Any:
    """Return a pyarrow array of numbers or of a list of text.

    It is made of its buffers, and `numbers_of` reads them: what converts for us imports pandas, which takes 0.4 s.

    Args:
        cells: R cells.
        known: (R,) False where a cell is null; None for no null.
    """
    valid = None if known is None else pa.py_buffer(np.packbits(known, bitorder="little"))
    if not isinstance(cells, list):
        values = np.ascontiguousarray(cells)
        if values.dtype.kind not in "iuf":
            return pa.array(values)
        return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [valid, pa.py_buffer(values)])
    texts = [cell.encode() for cell in cells]
    end = np.cumsum([0, *map(len, texts)])
    if end[-1] > np.iinfo(np.int32).max:  # more than an array of strings holds
        return pa.array(cells, mask=None if known is None else ~known, type=pa.string())
    parts = [valid, pa.py_buffer(end.astype(np.int32)), pa.py_buffer(b"".join(texts))]
    return pa.Array.from_buffers(pa.string(), len(texts), parts)


def numbers_of(cells: Any, kind: Any) -> tuple[Any, BoolArray]:
    """Return the values (R,) of a pyarrow array of numbers of a numpy type, and which of them are not null."""
    valid, data = cells.buffers()
    stop = cells.offset + len(cells)
    values = np.frombuffer(data, kind)[cells.offset : stop] if stop else np.zeros(0, kind)
    if valid is None or not cells.null_count:
        return values, np.ones(len(cells), dtype=np.bool_)
    known = np.unpackbits(np.frombuffer(valid, np.uint8), count=stop, bitorder="little")[cells.offset :]
    return values, known.astype(np.bool_)


def one_array(column: Any) -> Any:
    """Return one pyarrow array in place of chunks and dictionaries, of text as `pa.string()`."""
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_large_string(column.type) or pa.types.is_string_view(column.type):
        column = column.cast(pa.string())
    return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column


def numbers_of_text(cells: Any, *, optional: bool) -> FloatArray | None:
    """Return the numbers (R,) in a pyarrow array of text, nan where a cell is empty or null; None where one is no
    number, or is empty without being `optional`.
    """
    text = pc.utf8_trim_whitespace(cells)
    length, given = numbers_of(pc.binary_length(text), np.int32)
    blank = given & (length == 0)
    if not optional and blank.any():
        return None
    valid = np.packbits(np.concatenate([np.zeros(text.offset, dtype=np.bool_), given & ~blank]), bitorder="little")
    buffers = [pa.py_buffer(valid), *text.buffers()[1:]]
    try:
        values = floats_of(pa.Array.from_buffers(text.type, len(text), buffers, offset=text.offset))
    except pa.ArrowInvalid:
        return None
    odd = np.isnan(values).any() and pc.any(pc.match_substring(text, "(")).as_py()  # nan(1) is a number to Arrow only
    return None if odd else values


def floats_of(cells: Any) -> FloatArray:
    """Return a pyarrow array that can be cast to numbers as such (R,), nan where null."""
    if pa.types.is_boolean(cells.type):
        cells = cells.cast(pa.int8())
    values, known = numbers_of(cells.cast(pa.float64(), safe=False), np.float64)
    return np.where(known, values, np.nan)


def encode_words(words: Any) -> tuple[IntArray, list[str]]:
    """Return the index (R,) of each cell of a pyarrow array among the distinct ones, -1 if null, and these."""
    found = words.dictionary_encode()
    codes, known = numbers_of(found.indices, np.int32)
    return np.where(known, codes, -1).astype(np.int64), found.dictionary.to_pylist()


def mapped(cells: Any, pattern: str, change: Callable[[str], str]) -> Any:
    """Return a pyarrow array of text with a change of each different one, if any matches the pattern."""
    if not pc.any(pc.match_substring_regex(cells, pattern)).as_py():
        return cells
    code, words = encode_words(cells)
    return arrow_cells([*map(change, words), ""], np.arange(len(words) + 1) < len(words)).take(arrow_cells(code))


def dates_as_text(column: Any) -> list[str]:
    """Return timestamps of a Parquet column, with or without a zone, as ISO 8601; '' where null."""
    dates = column.cast(pa.timestamp("us", tz=column.type.tz), safe=False).to_pylist()
    return ["" if date is None else date.isoformat() for date in dates]
