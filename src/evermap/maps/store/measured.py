"""Stored recordings of sessions, for replays, where their robots drove, and the evidence of every clique, as bytes.

Of a recording is kept what the estimate may see: odometry, frames, detections, measurements, sensor and objects, bit
by bit, and no truth. Evidence is one chunk a clique, some ten bytes a look, and an index of them.
"""

from __future__ import annotations

import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import EvermapError
from evermap.estimate.measurements import find_kinds
from evermap.existence.sites import Evidence
from evermap.geometry import se3
from evermap.maps.living import Members
from evermap.maps.store.content import Chunk, DamagedError, name_of, text_chunk
from evermap.types import (
    AnyRecording,
    Clock,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Measurements,
    Odometry,
    Recording,
    Sensor,
    SensorKind,
    SpatialDetections,
    SpatialOdometry,
    SpatialSensor,
    Trajectory,
    is_in_space,
    landmark_id_of,
)

RECORDING, TRAJECTORY, LOOKS = "recording", "trajectory", "looks"
"""Names of the attachments; looks are those of a late session and of all that were brought in again after it."""
_MOST_POSES = 200
"""Of a stored trajectory, which is for pictures."""
_TABLES: dict[str, Any] = {"odometry": Odometry, "frames": Frames, "detections": Detections, "sensor": Sensor}
_IN_SPACE: dict[str, Any] = {"odometry": SpatialOdometry, "frames": Frames, "detections": SpatialDetections}
_LATER = (
    "features", "feature_names", "kind", "sigma_scale", "sigma_offset_m", "sigma_angle_rad", "sigma_position_m",
    "sigma_odometer_scale", "sigma_askew_rad", "z_up", "is_measured", "measures_positions",
)  # fmt: skip
"""What is kept only where there is any: equal recordings have the bytes that they had before there was."""
_PLAIN = ("name", "source", "class_names", "clock")
UNREADABLE = (
    AttributeError, EOFError, EvermapError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError,
    struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Errors of damaged archives and tables; an absurd shape finds no memory."""


def pack_recording(recording: AnyRecording) -> bytes:
    """Return the bytes of a recording; equal recordings have equal bytes."""
    arrays: dict[str, Any] = {}
    values: dict[str, Any] = {name: getattr(recording, name) for name in _PLAIN}
    values["landmark_texts"] = sorted(recording.landmark_names.values())
    if is_in_space(recording):
        values["sensors"] = len(recording.sensors)
        if recording.symmetries:  # equal recordings have the bytes that they had before there were any
            values["symmetries"] = {name: list(texts) for name, texts in recording.symmetries.items()}
        tables = {table: getattr(recording, table) for table in _IN_SPACE}
        tables |= {f"sensor {k}": sensor for k, sensor in enumerate(recording.sensors)}
        if len(recording.objects):  # as above
            arrays["objects"] = recording.objects
    else:
        arrays["objects"] = recording.objects
        tables = {table: getattr(recording, table) for table in _TABLES}
    for table, part in tables.items():
        for item in fields(part) if part is not None else ():
            value = getattr(part, item.name)
            if item.name in _LATER and isinstance(value, tuple | bool | None) and not value:
                continue
            (arrays if isinstance(value, np.ndarray) else values)[f"{table}.{item.name}"] = value
    if recording.measurements:  # as above
        values["measurements"] = {table.kind: list(table.columns) for table in recording.measurements}
    for measured in recording.measurements:
        own = {"stamp_s": measured.stamp_s, "landmark_id": measured.landmark_id, **measured.columns}
        arrays |= {f"{measured.kind}.{name}": column for name, column in own.items()}
    arrays["values"] = np.frombuffer(json.dumps(values).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def unpack_recording(data: bytes) -> AnyRecording:
    """Return what `pack_recording` wrote.

    Raises:
        DamagedError: anything else.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        values = json.loads(arrays.pop("values").tobytes())
        about: dict[str, Any] = {
            "name": values["name"],
            "source": values["source"],
            "class_names": tuple(values["class_names"]),
            "clock": Clock(values["clock"]),
            "landmark_names": {landmark_id_of(text): text for text in values["landmark_texts"]},
            "measurements": tuple(
                Measurements(
                    find_kinds()[kind].name,
                    arrays[f"{kind}.stamp_s"],
                    {name: arrays[f"{kind}.{name}"] for name in columns},
                    arrays[f"{kind}.landmark_id"],
                )
                for kind, columns in values.get("measurements", {}).items()
            ),
        }
        if "sensors" not in values:
            tables = {table: _table(table, kind, arrays, values) for table, kind in _TABLES.items()}
            return Recording(**about, **tables, objects=arrays["objects"])
        carried = "odometry.clock" in values
        tables = {
            table: _table(table, kind, arrays, values) if carried or table != "odometry" else None
            for table, kind in _IN_SPACE.items()
        }
        sensors = (_table(f"sensor {k}", SpatialSensor, arrays, values) for k in range(values["sensors"]))
        symmetries = {name: tuple(texts) for name, texts in values.get("symmetries", {}).items()}
        objects = arrays.get("objects", np.zeros((0, 2), dtype=np.int64))
        return Recording(**about, **tables, sensors=tuple(sensors), symmetries=symmetries, objects=objects)
    except UNREADABLE as error:
        raise DamagedError(f"a recording that was kept cannot be read: {error}") from None


def pack_trajectory(trajectory: Trajectory) -> bytes:
    """Return up to 200 poses of a trajectory, evenly chosen and with the last one, seen from above."""
    rows = np.unique(np.linspace(0.0, max(len(trajectory) - 1, 0), _MOST_POSES).astype(np.int64))[: len(trajectory)]
    pose = trajectory.pose_world_robot[rows]
    if pose.shape[1] == 7:  # where its x axis points
        ahead = se3.transform(pose, [1.0, 0.0, 0.0]) - pose[:, :3]
        pose = np.column_stack([pose[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0])])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, stamp_s=trajectory.stamp_s[rows], pose=pose.astype(np.float32))
    return buffer.getvalue()


def unpack_trajectory(data: bytes) -> tuple[FloatArray, FloatArray]:
    """Return the stamps (N,) and poses (N, 3) that `pack_trajectory` wrote: x, y [m] and heading [rad].

    Raises:
        DamagedError: anything else.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            stamp_s, pose = archive["stamp_s"].astype(np.float64), archive["pose"].astype(np.float64)
        if pose.shape != (len(stamp_s), 3) or not np.isfinite(pose).all():
            raise ValueError("another shape")
    except UNREADABLE as error:
        raise DamagedError(f"a trajectory that was kept cannot be read: {error}") from None
    return stamp_s, pose


def _table(table: str, kind: Any, arrays: dict[str, Any], values: dict[str, Any]) -> Any:
    names = [
        item.name for item in fields(kind) if item.name not in _LATER or f"{table}.{item.name}" in {*arrays, *values}
    ]
    return kind(**{name: _part(f"{table}.{name}", name, arrays, values) for name in names})


def _part(column: str, name: str, arrays: dict[str, Any], values: dict[str, Any]) -> Any:
    if column in arrays:
        return arrays[column]
    value = values[column]
    if name == "clock":
        return Clock(value)
    if name == "kind" and value is not None:
        return SensorKind(value)
    return tuple(value) if isinstance(value, list) else value


_COLUMNS = {
    "stamp_s": "<f8",
    "n_hits": "<i4",
    "n_misses": "<i4",
    "expected": "<f4",
    "log_odds": "<f4",
    "p_exists": "<f4",
}
"""Evidence only explains decisions: 7 digits are enough."""


class CliqueLooks(NamedTuple):
    """Location of the stored looks at one clique.

    Attributes:
        clique_id: whose.
        first_s, last_s: stamps of the first and the last one.
        name: of the chunk.
    """

    clique_id: int
    first_s: float
    last_s: float
    name: bytes


def evidence_to_chunks(evidence: Evidence | None) -> list[Chunk]:
    """Return the index of what a session saw, then a chunk for each clique; nothing where it saw nothing."""
    if evidence is None or not len(evidence):
        return []
    listed, parts = [], []
    for clique in np.unique(evidence.clique_id):
        mine = evidence[evidence.clique_id == clique]
        parts.append(Chunk("|u1", _looks_to_bytes(mine)))
        listed.append([int(clique), float(mine.stamp_s.min()), float(mine.stamp_s.max()), parts[-1].name.hex()])
    return [text_chunk(json.dumps(listed)), *parts]


def join_by_time(parts: Sequence[Evidence], since_s: float) -> Evidence:
    """Return evidence joined by time, without what is older.

    Of a long history most parts are one clique's, in order.
    """
    every = parts[0].joined(*parts[1:]) if parts else Evidence.empty()
    if len(every) and (every.stamp_s[0] < since_s or np.any(np.diff(every.stamp_s) < 0.0)):
        every = every[every.stamp_s >= since_s]
        every = every[np.argsort(every.stamp_s, kind="stable")]
    return every


def read_index(text: str) -> list[CliqueLooks]:
    """Read the index that `evidence_to_chunks` made; `DamagedError` if it is anything else."""
    try:
        listed = json.loads(text)
        looks = [CliqueLooks(clique, float(first), float(last), name_of(name)) for clique, first, last, name in listed]
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DamagedError(f"the index of the evidence is not valid: {error}") from None
    if not all(type(item.clique_id) is int and abs(item.clique_id) < 2**63 for item in looks):
        raise DamagedError("the index of the evidence is not valid")
    return looks


def looks_of(clique_id: int, stored: bytes, name: bytes) -> Evidence:
    """Return the looks at one clique; `DamagedError` if the chunk is not what was written."""
    planes = np.frombuffer(Chunk.of_stored(name, "|u1", stored).raw, np.uint8)
    sizes = [np.dtype(dtype).itemsize for dtype in _COLUMNS.values()]
    count, rest = divmod(len(planes), sum(sizes))
    if rest:
        raise DamagedError("a part of the evidence has another length")
    parts = np.split(planes, np.cumsum(np.multiply(sizes, count))[:-1])
    columns: dict[str, Any] = {
        name: part.reshape(size, count).T.copy().view(dtype)[:, 0].astype(np.float64 if "f" in dtype else np.int64)
        for (name, dtype), part, size in zip(_COLUMNS.items(), parts, sizes, strict=True)
    }
    if not all(map(math.isfinite, columns["stamp_s"].tolist())):
        raise DamagedError("a look without a stamp")
    return Evidence(clique_id=np.full(count, clique_id, dtype=np.int64), **columns)


def _looks_to_bytes(evidence: Evidence) -> bytes:
    """All columns but the clique's id, each with the first bytes of its values in front: neighbours are alike there."""
    planes = []
    for name, dtype in _COLUMNS.items():
        column = np.ascontiguousarray(getattr(evidence, name), dtype=dtype)
        planes.append(column.view(np.uint8).reshape(len(column), column.itemsize).T.tobytes())
    return b"".join(planes)


def pack_looks(sessions: Mapping[int, tuple[Evidence, Members]]) -> bytes:
    """Return the bytes of what sessions saw, by the revisions of their recordings (0: the one that these belong to),
    each with the members of the cliques of its evidence.
    """
    looks, of_look, members = [Evidence.empty()], list[IntArray](), list[IntArray]()
    for number, (seen, known) in sessions.items():
        looks.append(seen)
        of_look.append(np.full(len(seen), number))
        mine = known[np.isin(known.clique_id, seen.clique_id)]
        members.append(np.column_stack([np.full(len(mine), number), mine.landmark_id, mine.clique_id]))
    every = looks[0].joined(*looks[1:])
    columns = {name: getattr(every, name).astype(dtype) for name, dtype in _COLUMNS.items()}
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        sessions=np.array([*sessions], dtype=np.int64),
        of_look=np.concatenate([*of_look, np.zeros(0, dtype=np.int64)]),
        clique_id=every.clique_id,
        members=np.concatenate([*members, np.zeros((0, 3), dtype=np.int64)]),
        **columns,
    )
    return stream.getvalue()


def read_looks(data: bytes, revision: int, landmark_id: int) -> dict[int, Evidence]:
    """Read what `pack_looks` wrote for a revision, of the clique of one landmark: by session, empty where that saw
    nothing of it; `DamagedError` if it is anything else.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
        columns = {name: found[name].astype(np.float64 if "f" in kind else np.int64) for name, kind in _COLUMNS.items()}
        every = Evidence(clique_id=found["clique_id"], **columns)
        members, of_look = found["members"], found["of_look"]
        mine = members[members[:, 1] == landmark_id]
        sessions = {}
        for number in found["sessions"].tolist():
            seen = every[(of_look == number) & np.isin(every.clique_id, mine[mine[:, 0] == number, 2])]
            sessions[number or revision] = seen[np.argsort(seen.stamp_s, kind="stable")]
    except UNREADABLE as error:
        raise DamagedError(f"the looks of revision {revision} are not valid: {error}") from None
    return sessions
