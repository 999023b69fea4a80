"""Readers and writers: recordings, maps and trajectories in files. `docs/formats.md` lists every format."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from evermap.errors import InputError
from evermap.io.bag import BAG, read_bag
from evermap.io.columns import DataFrame
from evermap.io.file_kinds import kind_of_file, kind_of_folder
from evermap.io.files import Reader, file_sets, find_file_set, head_of, refuse_pointer
from evermap.io.landmarks import write_map_geojson, write_map_parquet
from evermap.io.map_formats import read_landmarks, read_prior_map
from evermap.io.mrclam import MRCLAM, read_mrclam
from evermap.io.native import NATIVE, read_native, read_tables
from evermap.io.native_write import write_native
from evermap.io.pose_graph import POSE_GRAPH
from evermap.io.shifts import Shift, parse_shift, shifted
from evermap.io.tagslam import TAGSLAM
from evermap.io.template import write_template
from evermap.io.tum import read_tum, write_tum
from evermap.io.ycbv import YCBV
from evermap.plugins import found, load
from evermap.types import Recording, SpatialRecording, is_in_space

__all__ = [
    "READERS",
    "Reader",
    "Shift",
    "add_reader",
    "find_readers",
    "list_robots",
    "parse_shift",
    "read_landmarks",
    "read_mrclam",
    "read_native",
    "read_planar",
    "read_prior_map",
    "read_recording",
    "read_tables",
    "read_tum",
    "reader_for",
    "shifted",
    "write_map_geojson",
    "write_map_parquet",
    "write_native",
    "write_template",
    "write_tum",
]

READERS: tuple[Reader, ...] = (MRCLAM, TAGSLAM, YCBV, BAG, NATIVE, POSE_GRAPH)
"""The readers of evermap, in the order in which they are tried. Add a new reader here and nowhere else."""
PLUGINS = "evermap.readers"
"""Entry points of readers in other packages."""
_ADDED: list[Reader] = []


def add_reader(reader: Reader) -> None:
    """Read recordings of another format from now on, in this process; packages name theirs as entry points.

    It is tried before all others, and takes the place of one with its name.
    """
    _ADDED[:] = [reader, *(other for other in _ADDED if other.name != reader.name)]


def find_readers() -> Iterator[Reader]:
    """Yield all readers in the order in which they are tried: added ones, those of evermap, those of packages.

    A package is imported only where no other reader was the one, so that one that is broken spoils no other format.
    """
    yield from _ADDED
    yield from (reader for reader in READERS if reader.name not in {one.name for one in _ADDED})
    yield from (load(PLUGINS, name) for name in found(PLUGINS))


def reader_for(path: str | Path) -> Reader:
    """Return the first reader that recognises the path.

    Raises:
        InputError: nothing is there, a zip is damaged, or no reader recognises it; the message says what is looked for.
    """
    path = Path(path)
    sets = file_sets(path)
    if path.is_file():
        refuse_pointer(head_of(path), path)
    for reader in find_readers():
        if reader.matches(path):
            return reader
    if path.is_file() and not sets:
        kind, hint = kind_of_file(path), f"its folder {path.parent}, or a zip of it"
        if kind is not None:
            is_table = kind.hint == "its folder"
            raise InputError(f"is {kind.what}, not a recording", path=path, hint=hint if is_table else kind.hint)
        raise InputError("a single file is not a recording", path=path, hint=hint)
    kind = kind_of_folder(sets, path)
    if kind is not None:
        raise InputError(f"is not a recording: it holds {kind.what}", path=path, hint=kind.hint)
    names = sorted(name for files in sets for name in files.members)
    holds = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "") if names else "no files"
    wanted = "; ".join(f"{reader.name}: {reader.looks_for}" for reader in find_readers())
    raise InputError(f"no recording found, it contains {holds}; looked for {wanted}", path=path)


def read_recording(
    source: str | Path | Mapping[str, DataFrame | Mapping[str, Any]],
    robot: int | None = None,
    *,
    topics: str | Path | None = None,
) -> Recording | SpatialRecording:
    """Read a recording of any known format, in the plane or in space.

    Args:
        source: folder, zip or file; or data frames by name, as of `read_tables`.
        robot: number of the robot where the format has several; None for its first complete one.
        topics: file that states which topics of a bag are what; None for the one beside it, or a guess.

    Raises:
        InputError: missing, malformed or of an unknown format.
        DataError: well-formed, but nothing can be estimated from it.
    """
    if isinstance(source, Mapping):
        if robot is not None or topics is not None:
            raise InputError("data frames are of one robot, without topics", hint="omit robot and topics")
        return read_tables(source)
    reader = reader_for(source)
    if topics is None:
        return reader.read(Path(source), robot)
    if reader is not BAG:
        raise InputError("has no topics", path=source, hint="omit --topics; it is for bags")
    return read_bag(source, robot, topics)


def read_planar(path: str | Path, robot: int | None = None) -> Recording:
    """Read a recording as `read_recording`, and refuse one that is in space.

    Raises:
        InputError: as `read_recording`, or the recording is in space.
        DataError: well-formed, but nothing can be estimated from it.
    """
    recording = read_recording(path, robot)
    if is_in_space(recording):
        raise InputError("the recording is in space; this works in the plane only", path=path)
    return recording


def list_robots(path: str | Path) -> tuple[int, ...]:
    """Return robots of a recording that can be read, in ascending order; empty where they have no numbers."""
    reader = reader_for(path)
    if Path(path).is_file() and reader.endings and str(path).endswith(reader.endings):
        return ()
    files = find_file_set(path, reader.holds)
    return () if files is None else reader.robots(files)
