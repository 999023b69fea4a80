"""A living map as columns of bytes, cut into chunks that are named by what is in them.

What two revisions have in common is therefore in the file once: an edit writes two short columns, and of a long history
of stays only the rows that changed. A *manifest* lists the columns of a map and their chunks; its name is that of the
whole map.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evermap.maps.lives import Life
from evermap.maps.living import LivingMap
from evermap.survival.plain import prior_from_dict, prior_to_dict
from evermap.types import FloatArray

FORMAT = 1
"""Of manifests; how columns are named and cut."""
_CHUNK = 4096
"""Values a chunk: some 30 kB, so that one changed row costs little and a large map has some hundred chunks."""
_KINDS = {"b": "|b1", "i": "<i8", "f": "<f8", "u": "|u1"}
_LIFE = "lives.life"

Fetch = Callable[[Iterable[bytes]], Mapping[bytes, bytes]]
"""Stored bytes of chunks by their names, all of them; `DamagedError` if one is missing."""


class DamagedError(Exception):
    """Bytes that are not what was written."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """A run of values of one column.

    Attributes:
        dtype: of the values, in numpy's notation.
        raw: their bytes, little-endian.
    """

    dtype: str
    raw: bytes

    @property
    def name(self) -> bytes:
        """SHA-256 of what is in it."""
        return hashlib.sha256(self.dtype.encode() + self.raw).digest()

    def stored(self) -> bytes:
        """Compressed, all first bytes of the values in front, then all second ones: neighbours are alike in them."""
        planes = np.frombuffer(self.raw, np.uint8).reshape(-1, np.dtype(self.dtype).itemsize).T
        return zlib.compress(planes.tobytes(), level=1)  # covariances are most of a map, and more levels gain 3 %

    @classmethod
    def of_stored(cls, name: bytes, dtype: str, stored: bytes) -> Chunk:
        """What `stored` wrote under a name; `DamagedError` if it is anything else."""
        try:
            planes = np.frombuffer(zlib.decompress(stored), np.uint8).reshape(np.dtype(dtype).itemsize, -1)
        except (zlib.error, ValueError) as error:
            raise DamagedError(f"a part cannot be unpacked: {error}") from None
        chunk = cls(dtype, planes.T.tobytes())
        if chunk.name != name:
            raise DamagedError("a checksum does not match")
        return chunk


def text_chunk(text: str) -> Chunk:
    """Any text."""
    return Chunk("|u1", text.encode())


def read_text(name: bytes, stored: bytes) -> str:
    """What `text_chunk` held."""
    return Chunk.of_stored(name, "|u1", stored).raw.decode()


def pack(living: LivingMap) -> tuple[bytes, dict[bytes, Chunk]]:
    """Name of a map, and all its chunks, its manifest among them, by their names.

    Raises:
        ConfigError: a lifetime prior that cannot be written down.
    """
    arrays: dict[str, NDArray[Any]] = {}
    values: dict[str, Any] = {}
    _collect(living, "", arrays, values)
    chunks: dict[bytes, Chunk] = {}
    columns = {}
    for column, array in arrays.items():
        shape = list(array.shape)
        flat = _flat(column, array)
        dtype = _KINDS[flat.dtype.kind]
        cut = [Chunk(dtype, flat[at : at + _CHUNK].astype(dtype).tobytes()) for at in range(0, len(flat), _CHUNK)]
        names = [chunk.name for chunk in cut]
        chunks.update(zip(names, cut, strict=True))
        lower = len(flat) != array.size
        columns[column] = [dtype, shape, lower, [name.hex() for name in names]]
    manifest = text_chunk(json.dumps({"format": FORMAT, "values": values, "columns": columns}, default=_scalar))
    return manifest.name, {**chunks, manifest.name: manifest}


def unpack(name: bytes, fetch: Fetch) -> LivingMap:
    """The map of this name.

    Raises:
        DamagedError: a chunk is missing or is not what was written.
    """
    manifest = _manifest(name, fetch)
    parts = {**manifest["values"], **_arrays(manifest["columns"], fetch)}
    living: LivingMap = _build(LivingMap(), "", parts)
    if parts:
        raise DamagedError(f"it holds '{min(parts)}', which this evermap does not know; a newer one wrote it")
    for table in ("members", "sites", "places", "stays"):
        rows = getattr(living, table)
        if len({len(getattr(rows, item.name)) for item in fields(rows)}) > 1:
            raise DamagedError(f"columns of different lengths in '{table}'")
    return living


def unpack_columns(name: bytes, columns: Iterable[str], fetch: Fetch) -> dict[str, NDArray[Any]]:
    """Some columns of a map, such as 'members.landmark_id', without reading the rest. Errors as `unpack`."""
    listed = _manifest(name, fetch)["columns"]
    return _arrays({column: listed[column] for column in columns}, fetch)


def _collect(value: Any, prefix: str, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> None:
    """Arrays and plain values of a dataclass and of those within it, by their dotted names."""
    for item in fields(value):
        name, part = prefix + item.name, getattr(value, item.name)
        if name == _LIFE:
            text = json.dumps([_life_to_dict(life) for life in part], default=_scalar)
            arrays[name] = np.frombuffer(text.encode(), np.uint8)
        elif isinstance(part, np.ndarray):
            arrays[name] = part
        elif is_dataclass(part):
            _collect(part, name + ".", arrays, values)
        else:
            values[name] = part


def _build(default: Any, prefix: str, parts: dict[str, Any]) -> Any:
    """A dataclass of the type of `default`, of parts that are taken out.

    What an older evermap did not write is as in `default`. A new column of a table has no such default: that needs
    another `FORMAT`, and who reads the old one.
    """
    content: dict[str, Any] = {}
    for item in fields(default):
        name, part = prefix + item.name, getattr(default, item.name)
        if is_dataclass(part):
            content[item.name] = _build(part, name + ".", parts)
        elif name not in parts:
            content[item.name] = part
        elif name == _LIFE:
            content[item.name] = tuple(_life_from_dict(life) for life in json.loads(parts.pop(name).tobytes()))
        elif isinstance(part, np.ndarray):
            content[item.name] = parts.pop(name)
        else:
            content[item.name] = type(part)(parts.pop(name))
    return type(default)(**content)


def _flat(column: str, array: NDArray[Any]) -> NDArray[Any]:
    """All values in a row; of a symmetric matrix only those up to the diagonal."""
    if column == "covariance_m2" and array.ndim == 2 and len(array) > 1:
        bits = np.ascontiguousarray(array).view(np.int64)
        if np.array_equal(bits, bits.T):
            return array[np.tril_indices(len(array))]
    return np.ascontiguousarray(array).reshape(-1)


def _arrays(columns: Mapping[str, Any], fetch: Fetch) -> dict[str, NDArray[Any]]:
    stored = fetch({bytes.fromhex(name) for _, _, _, names in columns.values() for name in names})
    arrays = {}
    for column, (dtype, shape, lower, names) in columns.items():
        keys = [bytes.fromhex(name) for name in names]
        raw = b"".join(Chunk.of_stored(key, dtype, stored[key]).raw for key in keys)
        flat = np.frombuffer(bytearray(raw), dtype)  # of a bytearray it can be written to, as any other array
        arrays[column] = _unfolded(flat, shape[0]) if lower else flat.reshape(shape)
    return arrays


def _unfolded(lower: FloatArray, size: int) -> FloatArray:
    """The symmetric matrix of its values up to the diagonal."""
    matrix = np.empty((size, size))
    rows, columns = np.tril_indices(size)
    matrix[rows, columns] = lower
    matrix[columns, rows] = lower
    return matrix


def _manifest(name: bytes, fetch: Fetch) -> Any:
    content = json.loads(read_text(name, fetch([name])[name]))
    if content["format"] != FORMAT:
        raise DamagedError(f"columns of format {content['format']}, this evermap reads {FORMAT}")
    return content


def _life_to_dict(life: Life) -> dict[str, Any]:
    values = {item.name: getattr(life, item.name) for item in fields(life)}
    return {name: _plain(value) for name, value in values.items()}


def _life_from_dict(content: Mapping[str, Any]) -> Life:
    values: dict[str, Any] = {
        name: prior_from_dict(part) if isinstance(part, dict) else part for name, part in content.items()
    }
    return Life(**values)


def _plain(value: Any) -> Any:
    return value if isinstance(value, int | float | np.number) else prior_to_dict(value)


def _scalar(value: Any) -> Any:
    """Of numpy's numbers, for JSON."""
    return value.item()
