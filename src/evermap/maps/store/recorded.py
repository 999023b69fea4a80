"""A recording as bytes: what a session measured is kept with its revision, so that it can be brought in once more.

Kept is what the estimate may see: odometry, frames, detections, sensor and objects, bit by bit, and no truth.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import fields
from typing import Any

import numpy as np

from evermap.maps.store.content import DamagedError
from evermap.types import Clock, Detections, Frames, Odometry, Recording, Sensor, landmark_id_of

RECORDING = "recording"
"""Name of the attachment."""
_TABLES: dict[str, Any] = {"odometry": Odometry, "frames": Frames, "detections": Detections, "sensor": Sensor}
_PLAIN = ("name", "source", "class_names", "clock")


def pack_recording(recording: Recording) -> bytes:
    """The bytes of a recording; equal recordings have equal bytes."""
    arrays: dict[str, Any] = {"objects": recording.objects}
    values: dict[str, Any] = {name: getattr(recording, name) for name in _PLAIN}
    values["landmark_texts"] = sorted(recording.landmark_names.values())
    for table in _TABLES:
        part = getattr(recording, table)
        for item in fields(part):
            value = getattr(part, item.name)
            (arrays if isinstance(value, np.ndarray) else values)[f"{table}.{item.name}"] = value
    arrays["values"] = np.frombuffer(json.dumps(values).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def unpack_recording(data: bytes) -> Recording:
    """What `pack_recording` wrote.

    Raises:
        DamagedError: anything else.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        values = json.loads(arrays.pop("values").tobytes())
        tables: dict[str, Any] = {
            table: kind(
                **{item.name: _part(f"{table}.{item.name}", item.name, arrays, values) for item in fields(kind)}
            )
            for table, kind in _TABLES.items()
        }
        return Recording(
            name=values["name"],
            source=values["source"],
            objects=arrays["objects"],
            class_names=tuple(values["class_names"]),
            clock=Clock(values["clock"]),
            landmark_names={landmark_id_of(text): text for text in values["landmark_texts"]},
            **tables,
        )
    except (KeyError, ValueError, TypeError, OSError, zipfile.BadZipFile) as error:
        raise DamagedError(f"a recording that was kept cannot be read: {error}") from None


def _part(column: str, name: str, arrays: dict[str, Any], values: dict[str, Any]) -> Any:
    if column in arrays:
        return arrays[column]
    value = values[column]
    if name == "clock":
        return Clock(value)
    return tuple(value) if isinstance(value, list) else value
