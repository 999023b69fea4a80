"""Maps in tables that others wrote: which column means what, and where in the file its cells are.

A column is recognised by its name, in any order and case: `id, x, y[, z]`, with units where these are not metres and
radians (`x_mm`, `yaw [deg]`), an orientation as `qx, qy, qz, qw`, as `roll, pitch, yaw`, or as `yaw` alone, the
direction in which a tag on a wall looks. Other columns are of no interest here.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.map_entries import (
    ANGLES,
    FACING,
    POSITION,
    QUATERNION,
    FileEntry,
    Number,
    Units,
    pose_of,
    rotation_roles,
)
from evermap.io.spatial import AT, COVARIANCE, TURN_COVARIANCE
from evermap.io.spatial import QUATERNION as QUATERNION_COLUMNS
from evermap.io.table import Table, parse_by_line
from evermap.io.tag_maps import lines_of
from evermap.types import FloatArray
from evermap.valid import Quantity

IDENTITIES = ("landmark_id", "tag_id", "april_id", "apriltag_id", "marker_id", "fiducial_id", "anchor_id", "id", "name")
"""Columns that name landmarks, the most specific first: beside `tag_id`, `id` counts rows."""
WPILIB_CSV = ("ID", "X", "Y", "Z", "Z-Rotation", "X-Rotation")
"""Columns of WPILib's own tables of a field, in inches and degrees; 'X-Rotation' is the tilt about the tag's left."""
WPILIB_CSV_UNITS = Units(metre=0.0254, radian=math.pi / 180.0, is_viewed=True, decimals=((2, 3), (1, 3)))
_METRES = {"": 1.0, "m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254, "inch": 0.0254, "inches": 0.0254, "ft": 0.3048}
_RADIANS = {"": 1.0, "rad": 1.0, "deg": math.pi / 180.0, "degrees": math.pi / 180.0}
_NATIVE = dict(zip((*AT, *QUATERNION_COLUMNS, "sigma_m", "sigma_rad"),
                   (*POSITION, *QUATERNION, "sigma", "sigma_turn"), strict=True))  # fmt: skip
_NAMED = {
    **{f"{word}{axis}": axis for axis in "xyz" for word in ("", "pos_", "position_", "t", "translation_")},
    **{f"{word}{axis}": f"q{axis}" for axis in "xyzw" for word in ("q", "q_", "quat_", "quaternion_", "orientation_")},
    **{angle: angle for angle in ANGLES},
    "heading": "yaw", "theta": "yaw", "sigma": "sigma", "size": "size", "tag_size": "size",
}  # fmt: skip
"""Roles of columns that others wrote."""


class MapColumns(NamedTuple):
    """What the columns of a table mean.

    Attributes:
        identity: column of the ids.
        roles: column of each role.
        units: of its numbers.
    """

    identity: str
    roles: Mapping[str, str]
    units: Units


def roles_of(names: Sequence[str], path: Path) -> MapColumns | None:
    """Return what the columns of a table that others wrote mean; None where it is no map.

    Raises:
        InputError: lengths or angles in several units.
    """
    plain = {_plain(name): name for name in names}
    identity = next((plain[name] for name in IDENTITIES if name in plain), None)
    roles: dict[str, str] = {}
    metres, radians = set[float](), set[float]()
    for key, name in plain.items():
        role, unit = _role(key)
        if role is None or role in roles or name == identity:
            continue
        roles[role] = name
        if role in ANGLES:
            radians.add(_RADIANS[unit])
        elif role not in QUATERNION:
            metres.add(_METRES[unit])
    if identity is None or not {"x", "y"} <= roles.keys():
        return None
    if len(metres) > 1 or len(radians) > 1:
        raise InputError("columns are in several units", path=path, hint="one unit for lengths, one for angles")
    if "z" not in roles:  # in the plane a landmark is a point
        roles = {role: name for role, name in roles.items() if role not in (*ANGLES, *QUATERNION)}
    elif "yaw" in roles and not {"roll", "pitch"} <= roles.keys():
        roles = {FACING[0] if role == "yaw" else role: name for role, name in roles.items()}
    metre, radian = metres.pop(), (radians or {1.0}).pop()
    lengths = (3, 6) if metre == 1.0 else (2, 4) if metre > 0.01 else (1, 3)
    angles = (4, 8) if radian == 1.0 else (2, 6)
    return MapColumns(identity, roles, Units(metre, radian, decimals=(lengths, angles)))


def native_columns(names: Sequence[str]) -> MapColumns:
    """Return what the columns of evermap's own tables mean, and of TagSLAM's tables of surveyed tags."""
    identity = "landmark_id" if "landmark_id" in names else "tag_id"
    vector = {f"r{axis}": f"r{axis}_rad" for axis in "xyz"} if identity == "tag_id" else {}
    own = {role: name for name, role in _NATIVE.items()}
    spread = {name: name for name in (*COVARIANCE, *TURN_COVARIANCE)}
    roles = {role: name for role, name in {**own, **vector, **spread}.items() if name in names}
    return MapColumns(identity, roles, Units())


def wpilib_columns() -> MapColumns:
    """Return what the columns of WPILib's tables mean."""
    identity, *names = WPILIB_CSV
    return MapColumns(identity, dict(zip((*POSITION, *FACING), names, strict=True)), WPILIB_CSV_UNITS)


def header_of(text: str) -> list[str]:
    """Return the names of the columns of a CSV text: the first line that is no comment."""
    for line, _ in lines_of(text.removeprefix("\ufeff")):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                return [cell.strip() for cell in next(csv.reader([line]))]
            except (csv.Error, StopIteration):
                return []
    return []


def map_of_columns(table: Table, columns: MapColumns) -> Table:
    """Return a table of others with the columns of a map.

    Raises:
        InputError: a cell that cannot be.
    """
    values = {role: _numbers(table, role, name, columns) for role, name in columns.roles.items()}
    identity = table.columns[columns.identity]
    found: dict[str, Any] = {"landmark_id": identity}
    metre = columns.units.metre
    found |= {at: metre * values[role] for at, role in zip(AT, POSITION, strict=True) if role in values}
    if "sigma" in values:
        found["sigma_m"] = metre * values["sigma"]
    if "size" in values:
        found["tag_size_m"] = metre * values["size"]
    if stated := rotation_roles(values):
        poses = [
            pose_of({role: float(values[role][row]) for role in stated}, columns.units, se3.identity())
            for row in range(len(table))
        ]
        found |= dict(zip(QUATERNION_COLUMNS, np.reshape(poses, (-1, 7))[:, 3:].T, strict=True))
    return replace(table, columns=found)


def _numbers(table: Table, role: str, name: str, columns: MapColumns) -> FloatArray:
    """A column, with the limits of what it means."""
    unit = columns.units
    if role in QUATERNION:
        return table.numbers(Quantity(name, -1.001, 1.001, optional=True, hint="of a unit quaternion"))
    if role in (*ANGLES, *FACING):
        most = 7.0 / unit.radian
        return table.numbers(Quantity(name, -most, most, hint=f"radians; or name the column {name}_deg"))
    if role in POSITION:
        return table.numbers(Quantity(name, hint="a number"))
    return table.numbers(Quantity(name, 0.0, 1e9, optional=True, hint="a length"))


def entries_of_csv(text: str, columns: MapColumns, path: Path) -> list[FileEntry]:
    """Return the rows of a CSV text with where their cells are."""
    table = parse_by_line(text.encode(), path, [])
    names = list(table.columns)
    at = {role: names.index(name) for role, name in columns.roles.items()}
    identity, lines = names.index(columns.identity), lines_of(text)
    found = []
    for number in table.line.tolist():
        line, start = lines[number - 1]
        shift = start + len(line) - len(line.removeprefix("\ufeff"))
        cells = [
            Number(cell.text, cell.start + shift, cell.end + shift) for cell in _cells(line.removeprefix("\ufeff"))
        ]
        numbers = {role: cells[column] for role, column in at.items() if _is_filled(cells[column])}
        found.append(FileEntry(cells[identity].text, number, numbers))
    return found


def _cells(line: str) -> list[Number]:
    """Cells of a line without the blanks and the quotation marks around them."""
    found, start, quoted = [], 0, False
    for place, sign in enumerate(f"{line},"):
        if sign == '"':
            quoted = not quoted
        elif sign == "," and not quoted:
            cell = line[start:place]
            text = cell.strip().strip('"').strip()
            begin = start + cell.index(text) if text else start
            found.append(Number(text, begin, begin + len(text)))
            start = place + 1
    return found


def _is_filled(cell: Number) -> bool:
    return bool(cell.text) and math.isfinite(cell.value)


def _plain(name: str) -> str:
    """A name of a column in lower case, its words joined by underscores."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _role(key: str) -> tuple[str | None, str]:
    """The role of a column and its unit; None for another column."""
    for unit in sorted({*_METRES, *_RADIANS}, key=len, reverse=True):
        stem = key if not unit else key.removesuffix(f"_{unit}")
        if (unit and stem == key) or stem not in _NAMED:
            continue
        role = _NAMED[stem]
        known = _RADIANS if role in ANGLES else {"": 1.0} if role in QUATERNION else _METRES
        if unit in known:
            return role, unit
    return None, ""
