"""A living map as columns of bytes, cut into chunks that are named by their checksums.

Common parts of two revisions are therefore stored once: an edit writes two short columns, and of a long history
of stays only the rows that changed. A *manifest* lists the columns of a map and their chunks; its name is that of the
whole map.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import math
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evermap.errors import EvermapError, InputError
from evermap.existence.rhythm import BINS
from evermap.geometry.chunked import ChunkedCovariance, Part, blocks
from evermap.maps import shelves
from evermap.maps.lives import Life
from evermap.maps.living import AXES, TURNS, LivingMap
from evermap.sensing.sightlines import SightLines, Views
from evermap.survival.base import LifetimePrior
from evermap.survival.text import prior_from_dict, prior_to_dict
from evermap.types import UNKNOWN, FloatArray

FORMAT = 2
"""Of manifests; how columns are named and cut. Format 1 is read, see `_of_format_1`."""
IN_SPACE = 3
"""The same of maps in space, which an older evermap cannot read."""
_CHUNK = 4096
"""Values a chunk, as a rule: some 30 kB, so that one changed row costs little, and a large map has some hundred."""
_SHORTEST, _LONGEST = _CHUNK // 4, 4 * _CHUNK
_HISTORY = "stays."
"""Table that grows with every session at its end, and loses its oldest rows once it is full."""
_SHORTER = 16
"""How much shorter its pieces are, 256 values: the name of each is 32 bytes in the manifest of every session."""
_HASH = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio (Knuth 1973, 6.4)."""
_PARTS = ("covariance_m2.parts", "sight.lines.parts", "sight.views.parts")
"""Columns of large maps: one piece a part, so that what changes shifts no other."""
_KINDS = {"b": "|b1", "i": "<i8", "f": "<f8", "u": "|u1"}
DTYPES = tuple(_KINDS.values())
"""Types of the values of a chunk."""
PLAIN = b"\x00"
"""First of the stored bytes of a chunk that are not deflated, as those of a pack (`packs`)."""
NAME_BYTES = 32
MEMBERS = "members."
"""The table that is kept of a pruned revision: landmarks of its evidence, and operators' edits."""
_LIFE = ("lives.life", "lives.prior")
_NEWER = ("lives.prior_class_id", "lives.prior", "dated.site_id", "dated.stamp_s", "places.rotation",
          "places.rotation_covariance", "boxes.landmark_id", "boxes.size_m", "metres.robot_id",
          "metres.log_metre", "metres.log_variance", "metres.information", "traits.landmark_id",
          "traits.column_id", "traits.value", "traits.sessions", "renamed.landmark_id", "renamed.name",
          "glimpses.position_m", "glimpses.stamp_s", "lives.log_factor", "lives.hourly_class_id",
          "lives.hours_known", "sightlines.open_space", "sight.lines.like.open_space")  # fmt: skip
"""Written only if present, so that an older evermap reads the map."""

Fetch = Callable[[Iterable[bytes]], Mapping[bytes, bytes]]
"""Stored bytes of chunks by their names, all of them; `DamagedError` if one is missing."""


class DamagedError(Exception):
    """Bytes that differ from those written."""


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
        """Compress values, all first bytes of the values in front, then all second ones: neighbours are alike in
        them.
        """
        planes = np.frombuffer(self.raw, np.uint8).reshape(-1, np.dtype(self.dtype).itemsize).T
        return deflate(PLAIN + planes.tobytes())

    @classmethod
    def of_stored(cls, name: bytes, dtype: str, stored: bytes) -> Chunk:
        """Return what `stored` wrote under a name; `DamagedError` if it is anything else."""
        try:
            planes = np.frombuffer(inflate(stored), np.uint8).reshape(np.dtype(dtype).itemsize, -1)
        except ValueError as error:
            raise DamagedError(f"a part cannot be unpacked: {error}") from None
        chunk = cls(dtype, planes.T.tobytes())
        if chunk.name != name:
            raise DamagedError("a checksum does not match")
        return chunk


def deflate(stored: bytes) -> bytes:
    """Return stored bytes deflated, as every chunk is that is in no pack."""
    # covariances are most of a map, and more levels gain 3 %
    return zlib.compress(memoryview(stored)[1:], level=1) if stored[:1] == PLAIN else stored


def inflate(stored: bytes) -> bytes:
    """Return the values of stored bytes, as `Chunk.stored` arranges them; `DamagedError` if they are anything else."""
    try:
        return stored[1:] if stored[:1] == PLAIN else zlib.decompress(stored)
    except zlib.error as error:
        raise DamagedError(f"a part cannot be unpacked: {error}") from None


def is_chunk(name: bytes, stored: bytes) -> bool:
    """Return whether stored bytes match their name, of any type."""
    for dtype in DTYPES:
        with suppress(DamagedError):
            Chunk.of_stored(name, dtype, stored)
            return True
    return False


def text_chunk(text: str) -> Chunk:
    """Return the value as text."""
    return Chunk("|u1", text.encode("utf-8", "surrogatepass"))


def read_text(name: bytes, stored: bytes) -> str:
    """Read what `text_chunk` held."""
    try:
        return Chunk.of_stored(name, "|u1", stored).raw.decode("utf-8", "surrogatepass")
    except UnicodeDecodeError as error:
        raise DamagedError(f"a text is not valid UTF-8: {error}") from None


def text_of(name: bytes, fetch: Fetch) -> str:
    """Read a text by its name."""
    return read_text(name, fetch([name])[name])


def json_object(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        DamagedError: it is anything else.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DamagedError(f"a description cannot be parsed: {error}") from None
    if not isinstance(content, dict):
        raise DamagedError("a description is not a JSON object")
    return content


def name_of(text: Any) -> bytes:
    """Parse the name of a chunk from 64 hexadecimal digits; `DamagedError` if it is anything else."""
    try:
        name = bytes.fromhex(text)
    except (ValueError, TypeError):
        name = b""
    if len(name) != NAME_BYTES:
        raise DamagedError("the name of a part is not valid")
    return name


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
        flat = flat.astype(dtype)
        cut = [Chunk(dtype, flat[a:b].tobytes()) for a, b in itertools.pairwise(_cuts(flat, column))]
        names = [chunk.name for chunk in cut]
        chunks.update(zip(names, cut, strict=True))
        lower = len(flat) != array.size
        columns[column] = [dtype, shape, lower, [name.hex() for name in names]]
    for column, parts in _parts_of(living).items():
        kept = [_of_part(part) for part in parts]
        chunks.update((chunk.name, chunk) for chunk in kept)
        columns[column] = ["<f8", [len(kept)], False, [chunk.name.hex() for chunk in kept]]
    form = FORMAT if living.dim == 2 else IN_SPACE
    manifest = text_chunk(json.dumps({"format": form, "values": values, "columns": columns}, default=_plain))
    return manifest.name, {**chunks, manifest.name: manifest}


@dataclass(frozen=True, slots=True)
class _PartChunk(Chunk):
    """A part of a large map under its stored name; its bytes are read only on demand.

    Attributes:
        part: of its covariance, lines of sight or views.
    """

    part: Part = field(default_factory=lambda: Part(np.zeros(0)))

    @property
    def name(self) -> bytes:
        """As it was found."""
        return self.part.name

    def stored(self) -> bytes:
        """Compress the values."""
        return Chunk(self.dtype, self.part.values.tobytes()).stored()


def _of_part(part: Part) -> Chunk:
    part.name = part.name or Chunk("<f8", part.values.tobytes()).name
    return _PartChunk("<f8", b"", part)


def _part_values(name: bytes, stored: bytes) -> FloatArray:
    return np.frombuffer(Chunk.of_stored(name, "<f8", stored).raw, "<f8")


def _read_part(name: bytes, stored: bytes) -> FloatArray:
    """What `_part_values` returns, long after the map was unpacked."""
    try:
        return _part_values(name, stored)
    except DamagedError as error:
        problem = f"a part of the data of its places is damaged: {error}"
        raise InputError(problem, hint="evermap map verify FILE, which lists the intact revisions") from None


def _cuts(flat: NDArray[Any], column: str = "") -> list[int]:
    """Return the cuts of a column: before values chosen by a hash, so that inserted rows do not shift later cuts."""
    shorter = _SHORTER if column.startswith(_HISTORY) else 1
    usual, shortest, longest = (size // shorter for size in (_CHUNK, _SHORTEST, _LONGEST))
    if len(flat) <= (longest if shorter == 1 else usual):
        return [*range(0, len(flat), usual), len(flat)] if len(flat) else []
    wide = np.ascontiguousarray(flat).view(np.uint64 if flat.itemsize == 8 else np.uint8).astype(np.uint64)
    with np.errstate(over="ignore"):
        share = np.uint64(64 - (usual.bit_length() - 1))
        marked = np.flatnonzero((wide * _HASH) >> share == 1)  # one in 4,096, or as many as `usual`, but no zero
    cuts = [0]
    for at in [*marked.tolist(), len(flat)]:
        while at - cuts[-1] > longest:
            cuts.append(cuts[-1] + usual)
        if at - cuts[-1] >= shortest or at == len(flat):
            cuts.append(at)
    return cuts


def _parts_of(living: LivingMap) -> dict[str, tuple[Part, ...]]:
    found = {}
    if isinstance(living.covariance_m2, ChunkedCovariance):
        found["covariance_m2.parts"] = living.covariance_m2.parts
    if living.sight is not None:
        found |= {"sight.lines.parts": living.sight.lines.parts, "sight.views.parts": living.sight.views.parts}
    return found


def unpack(name: bytes, fetch: Fetch, *, lazily: bool = False) -> LivingMap:
    """Return the map of this name.

    Args:
        name: of its manifest.
        fetch: of stored bytes.
        lazily: unpack parts of large maps where they are asked for only; damage of them raises `InputError` then.

    Raises:
        DamagedError: a chunk is missing or is not what was written, or the content contradicts itself.
    """
    manifest = _manifest(name, fetch)
    columns = manifest["columns"]
    in_parts = {column: columns.pop(column) for column in _PARTS if column in columns}
    parts = {**manifest["values"], **_arrays(columns, fetch)}
    for column, listed in in_parts.items():
        names = [name_of(part) for part in listed[3]]
        stored = fetch(set(names))
        parts[column] = tuple(
            Part(functools.partial(_read_part, key, stored[key]) if lazily else _part_values(key, stored[key]), key)
            for key in names
        )
    if manifest["format"] == 1:
        _of_format_1(parts)
    living: LivingMap = _build(LivingMap.in_space() if manifest["format"] == IN_SPACE else LivingMap(), "", parts)
    if parts:
        raise DamagedError(f"it contains '{min(parts)}', which this evermap does not know; a newer one wrote it")
    problem = flaw(living)
    if problem:
        raise DamagedError(problem)
    return living


def _of_format_1(parts: dict[str, Any]) -> None:
    """Return columns that format 1 lacks; its lines of sight, between cells of the floor, are learned again."""
    for column in ("key", "hits", "looks", "cell_m"):
        parts.pop(f"sightlines.{column}", None)
    if isinstance(parts.get("sites.p_here"), np.ndarray):
        parts["sites.p_kept"] = parts["sites.p_here"]
    if isinstance(parts.get("stays.gone_s"), np.ndarray):
        parts["stays.p_gone"] = np.isfinite(parts["stays.gone_s"]).astype(np.float64)
    if "stamp_s" in parts:
        parts["session_start_s"] = parts["stamp_s"]
    variance = parts.get("log_size_variance")
    if isinstance(variance, float) and variance > 0.0:
        parts["log_size_information"] = 1.0 / variance


def unpack_columns(name: bytes, columns: Iterable[str], fetch: Fetch) -> dict[str, NDArray[Any]]:
    """Return some columns of a map, such as 'members.landmark_id', without reading the rest. Errors as `unpack`."""
    return unpack_columns_of({name}, columns, fetch)[name]


def unpack_columns_of(
    names: Collection[bytes], columns: Iterable[str], fetch: Fetch
) -> dict[bytes, dict[str, NDArray[Any]]]:
    """Return some columns of each of several maps, by their names, with two fetches. Errors as `unpack`."""
    columns, manifests = [*columns], fetch(names)
    listed = {name: _manifest(name, lambda _: manifests, columns)["columns"] for name in names}
    if any(column not in some for some in listed.values() for column in columns):
        raise DamagedError("a column is missing")
    # revisions share columns, of which each is unpacked once
    distinct = {(column, str(some[column])): some[column] for some in listed.values() for column in columns}
    keyed = {f"{k}": value for k, value in enumerate(distinct.values())}
    arrays = dict(zip(distinct, _arrays(keyed, fetch).values(), strict=True))
    return {name: {column: arrays[column, str(some[column])] for column in columns} for name, some in listed.items()}


def parts_of(name: bytes, fetch: Fetch, table: str = "") -> dict[str, list[bytes]]:
    """Return the names of the chunks of a map by column, or of one of its tables, '' for its manifest. Errors as
    `unpack`.
    """
    columns = _manifest(name, fetch)["columns"].items()
    listed = {column: names for column, (_, _, _, names) in columns if column.startswith(table)}
    return {"": [name], **{column: [name_of(part) for part in names] for column, names in listed.items()}}


def names_in(name: bytes, fetch: Fetch, table: str = "") -> set[bytes]:
    """Return the names of all chunks of a map, or of one of its tables, its manifest's among them. Errors as
    `unpack`.
    """
    return {part for names in parts_of(name, fetch, table).values() for part in names}


_TABLES = (
    "members", "sites", "places", "stays", "dated", "boxes", "traits", "metres", "lives", "sightlines", "views",
    "glimpses",
)  # fmt: skip
_LEAST = {
    "members.class_id": UNKNOWN, "stays.class_id": UNKNOWN, "lives.class_id": UNKNOWN, "lives.prior_class_id": UNKNOWN,
    "lives.hourly_class_id": UNKNOWN,
    "members.clique_id": 0, "sites.clique_id": 0, "stays.clique_id": 0, "sites.site_id": 0, "stays.site_id": 0,
    "places.n_hits": 0, "places.n_misses": 0, "traits.sessions": 1,
}  # fmt: skip
"""Smallest numbers of columns."""
_NEXT_FREE = {
    "sites.site_id": "n_sites_ever", "stays.site_id": "n_sites_ever", "sites.clique_id": "n_cliques_ever",
    "stays.clique_id": "n_cliques_ever", "members.clique_id": "n_cliques_ever",
}  # fmt: skip
"""Columns of ids, and the next one that is free."""
_FINITE = (
    "places.position_m", "stays.position_m", "log_size_variance", "dated.stamp_s", "lives.chunk_m",
    "sightlines.cell_m", "sightlines.hits", "sightlines.looks", "sightlines.hidden", "sightlines.shown",
    "sightlines.open_space", "boxes.size_m", "traits.value", "views.cell_m", "views.stamp_s", "views.frames",
    "stays.first_s", "stays.last_s", "sites.since_s", "sites.seen_s", "metres.log_metre", "metres.log_variance",
    "glimpses.position_m", "glimpses.stamp_s", "lives.log_factor",
)  # fmt: skip
_NUMBERS = ("stays.elsewhere_s", "stays.gone_s", "lives.looks_s", "lives.hours_known", "stamp_s", "session_start_s")
_PROBABILITIES = ("sites.p_here", "sites.p_kept", "stays.p_gone")
_COUNTS = ("sightlines.hits", "sightlines.looks", "sightlines.hidden", "sightlines.shown",
           "sightlines.open_space", "views.frames")  # fmt: skip


def flaw(living: LivingMap) -> str:
    """Return a description of an inconsistency of a map; '' if it is consistent.

    The rules are those that the rest of the package relies on: columns of equal length, sorted unique ids, references
    that lead somewhere, finite positions, probabilities in [0, 1].
    """
    rules = (_flaws_of_shapes, _flaws_of_ids, _flaws_of_values)  # each needs that those before found nothing
    return next((problem for rule in rules for problem in rule(living)), "")


def _flaws_of_shapes(living: LivingMap) -> Iterator[str]:
    """Columns of one length."""
    for name in _TABLES:
        table = getattr(living, name)
        if len({len(getattr(table, column)) for column in shelves.columns(table)}) > 1:
            yield f"columns of different lengths in '{name}'"
    if living.sight is not None and (problem := living.sight.flaw()):
        yield problem
    if len(living.renamed.landmark_id) != len(living.renamed.name):
        yield "columns of different lengths in 'renamed'"
    if len(living.lives.prior_class_id) != len(living.lives.prior):
        yield "columns of different lengths in 'lives'"
    if len(living.lives.log_factor) not in (0, BINS) or len(living.lives.hours_known) not in (0, 2):
        yield "hours of the week of another length in 'lives'"
    lines, places = living.sightlines, len(living.places)
    if len(lines.hidden) != len(lines.rules.p_hidden) or len(lines.shown) != len(lines.rules.p_hidden):
        yield "'sightlines.hidden' of another length"
    if len(lines.open_space) not in (0, len(lines.rules.open_space)):
        yield "'sightlines.open_space' of another length"
    dim, covariance = living.dim, living.covariance_m2
    of_row = {"position_m": (dim,), "rotation": (TURNS[dim],), "rotation_covariance": (AXES[dim], AXES[dim])}
    for column in ("places.position_m", "stays.position_m", "places.rotation", "places.rotation_covariance"):
        shape, wanted = attrgetter(column)(living).shape[1:], of_row[column.split(".")[1]]
        if shape != wanted:
            yield f"'{column}' has rows of shape {shape}, not {wanted}"
    if isinstance(covariance, ChunkedCovariance):
        if problem := covariance.flaw(places, dim):
            yield problem
    elif covariance.shape != (dim * places, dim * places):
        yield f"a covariance of shape {covariance.shape} for {places} places"


def _flaws_of_ids(living: LivingMap) -> Iterator[str]:
    """Sorted unique ids, references that lead somewhere."""
    for column in ("members.landmark_id", "sites.site_id", "dated.site_id", "boxes.landmark_id", "renamed.landmark_id"):
        ids = attrgetter(column)(living)
        if np.any(ids[1:] <= ids[:-1]):
            yield f"'{column}' is not sorted, or not unique"
    site, name = living.places.site_id, living.places.landmark_id
    if np.any((site[1:] < site[:-1]) | ((site[1:] == site[:-1]) & (name[1:] <= name[:-1]))):
        yield "'places' are not sorted by site and landmark, or not unique"
    for column, known in (
        ("dated.site_id", living.sites.site_id),
        ("places.site_id", living.sites.site_id),
        ("places.landmark_id", living.members.landmark_id),
        ("boxes.landmark_id", living.members.landmark_id),
        ("traits.landmark_id", living.members.landmark_id),
    ):
        if not np.isin(attrgetter(column)(living), known).all():
            yield f"'{column}' names one that is not there"
    for column, least in _LEAST.items():
        if np.any(attrgetter(column)(living) < least):
            yield f"'{column}' has a number below {least}"
    for column, free in _NEXT_FREE.items():
        ids, ever = attrgetter(column)(living), getattr(living, free)
        if len(ids) and ids.max() >= ever:
            yield f"'{column}' has {ids.max()}, but the next free one is {ever}"


def _flaws_of_values(living: LivingMap) -> Iterator[str]:
    """Finite numbers, sizes and variances that are positive, probabilities in [0, 1]."""
    for column in _FINITE:
        if not np.isfinite(attrgetter(column)(living)).all():
            yield f"'{column}' is not finite"
    for column in _NUMBERS:
        if np.isnan(attrgetter(column)(living)).any():
            yield f"'{column}' is not a number"
    if living.lives.chunk_m <= 0.0 or living.sightlines.cell_m <= 0.0 or living.views.cell_m <= 0.0:
        yield "a cell without size"
    covariance = living.covariance_m2
    if isinstance(covariance, ChunkedCovariance):
        read = [covariance.each_m2, *(part.values for part in covariance.parts if part.is_read)]
    else:
        read = [covariance]
    if not all(np.isfinite(values).all() for values in read):
        yield "'covariance_m2' is not finite"
        return
    if living.log_size_variance < 0.0 or np.any(_variances(blocks(covariance, living.dim)) < -1e-9):
        yield "a negative variance"
    known = ~np.isnan(living.places.rotation).all(axis=1)
    rotation, spread = living.places.rotation[known], living.places.rotation_covariance[known]
    if not np.all(np.abs(np.linalg.norm(rotation, axis=1) - 1.0) < 1e-6):
        yield "'places.rotation' has a quaternion that is not of length 1"
    if not (np.isfinite(spread).all() and np.all(_variances(spread) >= -1e-9)):
        yield "'places.rotation_covariance' is not a covariance"
    for column in _PROBABILITIES:
        values = attrgetter(column)(living)
        if not np.all((values >= 0.0) & (values <= 1.0 + 1e-6)):
            yield f"'{column}' is not a probability"
    if living.up.source and not (
        living.up.direction.shape == (3,)
        and abs(np.linalg.norm(living.up.direction) - 1.0) < 1e-6
        and 0.0 < living.up.sigma_rad < np.inf
    ):
        yield "'up' is not a direction with a standard deviation"
    if not (living.log_size_information > 0.0 and np.all(living.metres.information > 0.0)):
        yield "'log_size_information' is not positive"
    if any(np.any(attrgetter(column)(living) < 0.0) for column in _COUNTS):
        yield "a negative count in 'sightlines' or 'views'"


def _variances(each: FloatArray) -> FloatArray:
    return np.diagonal(each, axis1=1, axis2=2)


_NOT_STORED = {"sightlines.rules", "sight.lines.like.rules"}
"""Settings, which each session brings; a revision keeps them with its configuration."""


def _collect(value: Any, prefix: str, arrays: dict[str, NDArray[Any]], values: dict[str, Any]) -> None:
    """Arrays and plain values of a dataclass and of those within it, by their dotted names."""
    for item in fields(value):
        name, part = prefix + item.name, getattr(value, item.name)
        if name == "up" and not np.isfinite(part.direction).all():
            continue  # so that an older evermap reads the map
        if name in {*_NOT_STORED, *_PARTS} or part is None or (name in _NEWER and not np.size(part)):
            continue
        if name in _LIFE:
            lives = [{item.name: getattr(life, item.name) for item in fields(life)} for life in part]
            text = json.dumps(lives, default=_plain)
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
    another `FORMAT`, and a reader of the old one.
    """
    content: dict[str, Any] = {}
    for item in fields(default):
        name, part = prefix + item.name, getattr(default, item.name)
        if name in _NOT_STORED:
            content[item.name] = part
        elif name == "covariance_m2" and "covariance_m2.parts" in parts:
            content[item.name] = _build(ChunkedCovariance.empty(default.dim), name + ".", parts)
        elif name == "sight":
            large = "sight.lines.parts" in parts
            content[item.name] = (
                _build(shelves.Sight.of(SightLines.empty(), Views.empty()), "sight.", parts) if large else None
            )
        elif is_dataclass(part):
            content[item.name] = _build(part, name + ".", parts)
        elif name not in parts:
            content[item.name] = part
        elif name in _PARTS:
            content[item.name] = parts.pop(name)
        elif name in _LIFE:
            content[item.name] = _lives_from_bytes(parts.pop(name))
        elif isinstance(part, np.ndarray):
            content[item.name] = _column(name, part, parts.pop(name))
        else:
            content[item.name] = _value(name, part, parts.pop(name))
    return type(default)(**content)


def _column(name: str, like: NDArray[Any], found: Any) -> NDArray[Any]:
    """A column, if it has the type and the shape of rows that the empty one has."""
    kinds = {"f": "fi"}.get(like.dtype.kind, like.dtype.kind)
    if not isinstance(found, np.ndarray) or found.dtype.kind not in kinds or found.ndim != like.ndim:
        raise DamagedError(f"column '{name}' is of another type")
    if like.ndim == 2 and like.shape[1] and found.shape[1] != like.shape[1]:
        raise DamagedError(f"column '{name}' has rows of {found.shape[1]}, not {like.shape[1]}")
    return found


def _value(name: str, like: Any, found: Any) -> Any:
    """A single value, if it is of the type of `like`."""
    if isinstance(like, Enum):
        with suppress(ValueError):
            return type(like)(found)
    elif isinstance(like, str):
        if isinstance(found, str):
            return found
    elif isinstance(like, tuple):
        if isinstance(found, list) and all(isinstance(item, str) for item in found):
            return tuple(found)
    elif isinstance(like, float):
        if isinstance(found, float | int) and not isinstance(found, bool) and abs(found) < 2**1023:
            return float(found)
        if isinstance(found, float):  # infinite, or nan
            return found
    elif isinstance(found, int) and isinstance(found, bool) == isinstance(like, bool) and abs(found) < 2**63:
        return type(like)(found)
    raise DamagedError(f"'{name}' is of another type")


def _flat(column: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return all values in a row; of a symmetric matrix only those up to the diagonal."""
    if column == "covariance_m2" and array.ndim == 2 and len(array) > 1:
        bits = np.ascontiguousarray(array).view(np.int64)
        if np.array_equal(bits, bits.T):
            return array[np.tril_indices(len(array))]
    return np.ascontiguousarray(array).reshape(-1)


def _arrays(columns: Mapping[str, Any], fetch: Fetch) -> dict[str, NDArray[Any]]:
    stored = fetch({name_of(name) for _, _, _, names in columns.values() for name in names})
    arrays = {}
    for column, (dtype, shape, lower, names) in columns.items():
        keys = [name_of(name) for name in names]
        raw = b"".join(Chunk.of_stored(key, dtype, stored[key]).raw for key in keys)
        flat = np.frombuffer(bytearray(raw), dtype)  # of a bytearray it can be written to, as any other array
        if len(flat) != (shape[0] * (shape[0] + 1) // 2 if lower else math.prod(shape)):
            raise DamagedError(f"column '{column}' has {len(flat)} values, which is not its shape {shape}")
        arrays[column] = _unfold(flat, shape[0]) if lower else flat.reshape(shape)
    return arrays


def _unfold(lower: FloatArray, size: int) -> FloatArray:
    """The symmetric matrix of its values up to the diagonal."""
    matrix = np.empty((size, size))
    rows, columns = np.tril_indices(size)
    matrix[rows, columns] = lower
    matrix[columns, rows] = lower
    return matrix


def _manifest(name: bytes, fetch: Fetch, wanted: Collection[str] | None = None) -> Any:
    """The values and the columns of a map, of the types that they have to have; None checks all columns."""
    content = json_object(text_of(name, fetch))
    if content.get("format") not in (1, FORMAT, IN_SPACE):
        raise DamagedError(f"columns of format {content.get('format')!r}, this evermap reads 1 to {IN_SPACE}")
    columns = content.get("columns")
    if not isinstance(content.get("values"), dict) or not isinstance(columns, dict):
        raise DamagedError("a list of columns is missing")
    for column in columns if wanted is None else columns.keys() & wanted:
        listed = columns[column]
        if not (isinstance(listed, list) and len(listed) == 4 and _is_column(*listed)):
            raise DamagedError(f"column '{column}' is not described as columns are")
    return content


def _is_column(dtype: Any, shape: Any, lower: Any, names: Any) -> bool:
    return (
        dtype in DTYPES
        and isinstance(lower, bool)
        and isinstance(names, list)
        and isinstance(shape, list)
        and len(shape) in (1, 2, 3)
        and all(type(size) is int and 0 <= size < 2**31 for size in shape)
        and (not lower or (dtype == "<f8" and len(shape) == 2 and shape[0] == shape[1]))
    )


def _lives_from_bytes(values: NDArray[Any]) -> tuple[Life, ...]:
    """What `_collect` wrote of `lives.life`."""
    try:
        listed: list[dict[str, Any]] = [
            {name: prior_from_dict(part) if isinstance(part, dict) else part for name, part in life.items()}
            for life in json.loads(values.tobytes())
        ]
        lives = tuple(Life(**life) for life in listed)
    except (ValueError, TypeError, AttributeError, RecursionError, EvermapError) as error:
        raise DamagedError(f"the learned lifetimes cannot be read: {error}") from None
    for life in lives:
        parts: tuple[Any, ...] = (life.stay, life.absence, life.p_hop, life.p_known, life.n_stays, life.n_ended)
        numbers = all(isinstance(value, int | float) and 0 <= value < 2**53 for value in parts[2:])
        if not (all(isinstance(value, LifetimePrior) for value in parts[:2]) and numbers and max(parts[2:4]) <= 1):
            raise DamagedError("the learned lifetimes have another type")
    return lives


def _plain(value: Any) -> Any:
    """Return a prior, or one of numpy's numbers, as JSON has it."""
    return value.item() if isinstance(value, np.generic) else prior_to_dict(value)
