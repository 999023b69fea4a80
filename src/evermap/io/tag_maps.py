"""Maps of square tags in the files of other projects, as tables with the columns of a map in space.

The frame of a tag has x to the right, y up and z towards the viewer, as AprilTag's corners and ArUco have it; in WPILib
it is x that points to the viewer, and z up.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.spatial import AT, QUATERNION
from evermap.io.table import Table
from evermap.io.text import decode_text
from evermap.io.yaml import parse_yaml
from evermap.types import FloatArray
from evermap.valid import Quantity

_VIEWED = np.array([0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5])
"""Rotation of the frame of a tag to WPILib's: its x is their y, its y their z, its z their x."""
_FIDUCIAL = ("id", "x", "y", "z", "roll", "pitch", "yaw", "variance")


def map_of_survey(table: Table) -> Table:
    """Return TagSLAM's table of surveyed tags, `tag_id, size_m, x_m, y_m, z_m` and rotation vectors `rx_rad, ry_rad,
    rz_rad`, with the columns of a map.
    """
    turns = ("rx_rad", "ry_rad", "rz_rad")
    table.expect(("tag_id", "size_m", *AT, *turns))
    turn = np.stack([table.numbers(Quantity(name, -10.0, 10.0, hint="radians")) for name in turns], axis=1)
    rotation = se3.exp(np.concatenate([np.zeros_like(turn), turn], axis=1))[:, 3:]
    columns: dict[str, Sequence[str] | FloatArray] = {
        "landmark_id": table.ids("tag_id", optional=False).astype(np.float64),
        **{name: table.columns[name] for name in AT},
        **dict(zip(QUATERNION, rotation.T, strict=True)),
        "tag_size_m": table.numbers(Quantity("size_m", 0.0, 1e3, positive=True, hint="metres")),
    }
    return replace(table, columns=columns)


def tags_of_tagslam(data: bytes, path: Path) -> Table:
    """Return the tags of a `tagslam.yaml` that are stated on static bodies whose poses are stated.

    Raises:
        InputError: not YAML, or its bodies are not described as TagSLAM describes them.
    """
    document = parse_yaml(data, path)
    listed = document.get("bodies") if isinstance(document, dict) else None
    if not isinstance(listed, list):
        raise InputError("contains no bodies with tags", path=path, field="bodies", hint="TagSLAM's tagslam.yaml")
    rows: list[tuple[float, ...]] = []
    for entry in listed:
        for name, body in entry.items() if isinstance(entry, dict) else ():
            if not isinstance(body, dict) or not body.get("is_static") or "pose" not in body:
                continue
            where = pose_of(body["pose"], path, name)
            for tag in body.get("tags") or ():
                if isinstance(tag, dict) and "pose" in tag:
                    field = f"{name}.tags"
                    pose = se3.compose(where, pose_of(tag["pose"], path, field))
                    size = _number(tag.get("size", body.get("default_tag_size", math.nan)), path, field)
                    rows.append((_number(tag.get("id"), path, field), *pose, size))
    return _table(path, rows, range(1, len(rows) + 1))


def tags_of_wpilib(data: bytes, path: Path) -> Table:
    """Return the tags of a field layout of WPILib (`is_wpilib`).

    Raises:
        InputError: a tag has no ID or pose.
    """
    rows = []
    for number, tag in enumerate(json.loads(data)["tags"]):
        field = f"tags[{number}]"
        try:
            at, turn = tag["pose"]["translation"], tag["pose"]["rotation"]["quaternion"]
            values = [tag["ID"], *(at[axis] for axis in "xyz"), *(turn[axis] for axis in "XYZW")]
        except (KeyError, TypeError):
            problem = "has no ID, translation x, y, z and quaternion W, X, Y, Z"
            raise InputError(problem, path=path, field=field, hint="a field layout of WPILib") from None
        name, *pose = (_number(value, path, field) for value in values)
        if not 0.9 < math.hypot(*pose[3:]) < 1.1:
            raise InputError("is not a unit quaternion", path=path, field=f"{field}.pose.rotation.quaternion")
        rows.append((name, *se3.compose(se3.normalised(pose), _VIEWED), math.nan))
    return _table(path, rows, range(1, len(rows) + 1))


def is_wpilib(data: bytes) -> bool:
    """Return whether a JSON file is a field layout of WPILib."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return False
    return isinstance(document, dict) and isinstance(document.get("tags"), list) and "field" in document


def tags_of_fiducials(data: bytes, path: Path) -> Table:
    """Return the tags of a `map.txt` of fiducial_slam: id, x, y, z, roll, pitch, yaw [deg], variance, and so on.

    Raises:
        InputError: a line is not that of a tag.
    """
    rows, lines = [], []
    for number, line in enumerate(decode_text(data, path).splitlines(), 1):
        cells = line.split()
        if not cells:
            continue
        try:
            name, *values = (float(cell) for cell in cells[:8])
        except ValueError:
            values = []
        if len(values) != 7 or not all(map(math.isfinite, values)) or not name.is_integer():
            problem = "is not a tag of fiducial_slam"
            raise InputError(problem, path=path, line=number, hint=f"{' '.join(_FIDUCIAL)}, angles in degrees")
        rows.append((name, *values[:3], *se3.from_angles(np.radians(values[3:6]))[3:], math.nan))
        lines.append(number)
    return _table(path, rows, lines)


def pose_of(content: Any, path: Path, field: str) -> FloatArray:
    """Return the pose (7,) of TagSLAM's `pose`: a `position` and a rotation vector `rotation`.

    Raises:
        InputError: other contents, named by the file and the field that the pose is of.
    """
    parts = [content.get(part) if isinstance(content, dict) else None for part in ("position", "rotation")]
    if not all(isinstance(part, dict) and not {*"xyz"} - part.keys() for part in parts):
        raise InputError("needs position and rotation, with x, y and z", path=path, field=f"{field}.pose")
    at, turn = ([_number(part[axis], path, f"{field}.pose") for axis in "xyz"] for part in parts if part is not None)
    if not np.isfinite([*at, *turn]).all():
        raise InputError("must be finite numbers", path=path, field=f"{field}.pose")
    pose = se3.exp(np.array([0.0, 0.0, 0.0, *turn]))
    pose[:3] = at
    return pose


def _number(value: Any, path: Path, field: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"must be numbers, not {type(value).__name__}", path=path, field=field)
    return float(value)


def _table(path: Path, rows: Sequence[Sequence[float]], lines: Sequence[int]) -> Table:
    """A map of tags: id, pose and edge of each."""
    values = np.array(rows, dtype=np.float64).reshape(-1, 9)
    names = ("landmark_id", *AT, *QUATERNION, "tag_size_m")
    columns = {name: np.ascontiguousarray(column) for name, column in zip(names, values.T, strict=True)}
    if np.isnan(values[:, 8]).all():
        del columns["tag_size_m"]
    return Table(path, columns, np.array(lines, dtype=np.int64))
