"""Entries of a map in a text file: where in the text each number is, what it means, and the text with other numbers.

An entry has a number for each *role* that its file states: `x, y, z`; a rotation as `qx, qy, qz, qw`, as `roll, pitch,
yaw` about fixed axes, as a rotation vector `rx, ry, rz`, or as the direction `facing` in which a tag on a wall looks;
and standard deviations or covariances. A file has its own units and its own frame of a tag; here they become metres,
radians and the frame of AprilTag (x to the right, y up, z towards the viewer), and back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from evermap.geometry import se3
from evermap.io.landmarks import ellipse_polygons
from evermap.io.spatial import COVARIANCE, TURN_COVARIANCE
from evermap.types import FloatArray

POSITION = ("x", "y", "z")
QUATERNION = ("qx", "qy", "qz", "qw")
ANGLES = ("roll", "pitch", "yaw")
VECTOR = ("rx", "ry", "rz")
FACING = ("facing", "tilt")
ROTATIONS = (QUATERNION, ANGLES, VECTOR, FACING, FACING[:1])
"""Ways to state a rotation, the fullest first."""
PLANE_COVARIANCE = ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
VIEWED = np.array([0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5])
"""Rotation of the frame of a tag to that of WPILib: its x is their y, its y their z, its z their x."""

_JSON = re.compile(r'"(?:[^"\\]|\\.)*"|(-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)')
_YAML = re.compile(
    r"(?:^|(?<=\s))\#[^\r\n]*|\"[^\"\r\n]*\"|'[^'\r\n]*'"
    r"|(?<![^\s\[{,])([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?=[\s,\]}]|$)"
)
_DECIMALS = re.compile(r"[-+]?\d*(?:\.(\d*))?$")
_PRINTED = 12
"""Decimals from which on a number was printed by a computer as it is, and not typed or rounded."""


class Number(NamedTuple):
    """A number of a file: its text, and where that is."""

    text: str
    start: int
    end: int

    @property
    def value(self) -> float:
        """Return the number."""
        return float(self.text)


@dataclass(frozen=True, slots=True)
class Units:
    """What the numbers of a format count.

    Attributes:
        metre: of one unit of length.
        radian: of one unit of angle.
        is_viewed: whether the frame of a tag is that of WPILib, x towards the viewer.
        decimals: least and most of them that a measured number is written with: lengths, angles.
    """

    metre: float = 1.0
    radian: float = 1.0
    is_viewed: bool = False
    decimals: tuple[tuple[int, int], tuple[int, int]] = ((3, 6), (4, 8))


@dataclass(frozen=True, slots=True)
class FileEntry:
    """A landmark of a map file.

    Attributes:
        label: its id as the file has it.
        line: in the file, or number in its list.
        numbers: by role.
        within: pose (7,) in the map of what its pose is relative to.
        tag_size_m: edge of a tag, nan where the file does not say.
    """

    label: str
    line: int
    numbers: Mapping[str, Number]
    within: FloatArray = field(default_factory=se3.identity)
    tag_size_m: float = math.nan


@dataclass(frozen=True, slots=True)
class Correction:
    """What is to be written of an entry; None keeps what the file has.

    Attributes:
        landmark_id: which.
        position_m, covariance_m2: (D,), (D, D) where it is.
        rotation, rotation_covariance: (4,), (3, 3) how it is turned.
        like_id: another entry whose numbers it gets as they are, instead of all these.
    """

    landmark_id: int
    position_m: FloatArray | None = None
    covariance_m2: FloatArray | None = None
    rotation: FloatArray | None = None
    rotation_covariance: FloatArray | None = None
    like_id: int | None = None


def number_json(text: str) -> tuple[str, list[Number]]:
    """Return a JSON text in which every number is replaced by its place in the list that is returned, too."""
    return _find_numbers(_JSON, text)


def number_yaml(text: str) -> tuple[str, list[Number]]:
    """Return a YAML text in which every number is replaced by its place in the list that is returned, too."""
    return _find_numbers(_YAML, text)


def _find_numbers(pattern: re.Pattern[str], text: str) -> tuple[str, list[Number]]:
    numbers: list[Number] = []

    def replaced(found: re.Match[str]) -> str:
        if found[1] is None:
            return found[0]
        numbers.append(Number(found[1], *found.span(1)))
        return str(len(numbers) - 1)

    return pattern.sub(replaced, text), numbers


def rotation_roles(roles: Iterable[str]) -> tuple[str, ...]:
    """Return by which roles a rotation is stated; empty where none is."""
    names = set(roles)
    return next((way for way in ROTATIONS if names.issuperset(way)), ())


def pose_of(values: Mapping[str, float], units: Units, within: FloatArray) -> FloatArray:
    """Return the pose (7,) in the map of the numbers of an entry by role; without a rotation its quaternion is nan."""
    stated = rotation_roles(values)
    turn = np.array([values[role] for role in stated])
    pose = se3.identity()
    if stated == QUATERNION:
        pose[3:] = turn
        pose = se3.normalise_poses(pose)
    elif stated == ANGLES:
        pose = se3.from_angles(turn * units.radian)
    elif stated == VECTOR:
        pose = se3.exp(np.concatenate([np.zeros(3), turn * units.radian]))
    elif stated:  # turned about up by where it looks, and tilted about its own axis to the left
        facing, tilt = (*turn * units.radian, 0.0)[:2]
        pose = se3.from_angles([0.0, tilt, facing])
    if units.is_viewed or stated[:1] == FACING[:1]:
        pose = se3.compose(pose, VIEWED)
    pose[:3] = [units.metre * values.get(role, 0.0) for role in POSITION]
    pose = se3.compose(within, pose)
    if not stated:
        pose[3:] = np.nan
    return pose


def values_of(entry: FileEntry, units: Units, correction: Correction) -> dict[str, float]:
    """Return the numbers of an entry, by role and in the units of its file, as they are corrected."""
    found: dict[str, float] = {}
    back = se3.inverse(entry.within)
    if correction.position_m is not None:
        at, size = np.zeros(3), len(correction.position_m)
        at[:size] = correction.position_m
        found |= dict(zip(POSITION[:size], (se3.transform(back, at) / units.metre).tolist(), strict=False))
        found |= {f"at_{axis}": value for axis, value in found.items()}
        found |= _outline(entry, correction)
    if correction.covariance_m2 is not None:
        found |= _spread(correction.covariance_m2, "sigma", units.metre)
    stated = rotation_roles(entry.numbers)
    if correction.rotation is not None and stated:
        found |= _rotation(entry, stated, units, back, correction.rotation)
    if correction.rotation_covariance is not None:
        found |= _spread(correction.rotation_covariance, "sigma_turn", units.radian)
    return {role: value for role, value in found.items() if role in entry.numbers}


def _outline(entry: FileEntry, correction: Correction) -> dict[str, float]:
    """The outline of an entry that has one, about where it is now: its ellipse, or its old outline."""
    ring = [role for role in entry.numbers if role.startswith("ring_")]
    at = correction.position_m
    if not ring or at is None:
        return {}
    if correction.covariance_m2 is not None:
        outline = ellipse_polygons(at[None, :2], correction.covariance_m2[None, :2, :2])[0]
        if len(ring) == outline.size:
            return {f"ring_{axis}{k}": float(outline[k, c]) for k in range(len(outline)) for c, axis in enumerate("xy")}
    shift = {axis: float(at[c]) - entry.numbers[f"at_{axis}"].value for c, axis in enumerate("xy")}
    return {role: entry.numbers[role].value + shift[role[5]] for role in ring}


def _spread(covariance: FloatArray, sigma: str, unit: float) -> dict[str, float]:
    """One standard deviation, and the upper triangle of a covariance."""
    size = len(covariance)
    found = {sigma: math.sqrt(np.trace(covariance) / size) / unit}
    names = PLANE_COVARIANCE if size == 2 else COVARIANCE if sigma == "sigma" else TURN_COVARIANCE
    return found | dict(zip(names, covariance[np.triu_indices(size)].tolist(), strict=True))


def _rotation(
    entry: FileEntry, stated: tuple[str, ...], units: Units, back: FloatArray, rotation: FloatArray
) -> dict[str, float]:
    """A rotation as an entry states it, the nearest of equal ones to what it states."""
    pose = se3.compose(back, np.concatenate([np.zeros(3), rotation]))
    if units.is_viewed or stated[:1] == FACING[:1]:
        pose = se3.compose(pose, se3.inverse(VIEWED))
    before = np.array([entry.numbers[role].value for role in stated])
    if stated == QUATERNION:
        turn = pose[3:] if pose[3:] @ before >= 0.0 else -pose[3:]
    elif stated == VECTOR:
        turn = se3.log(pose)[3:]
        length = float(np.linalg.norm(turn))
        if length > 0.0 and turn @ before < 0.0 and length > 0.5 * np.pi:
            turn = turn * (1.0 - 2.0 * np.pi / length)
        turn = turn / units.radian
    else:
        angles = angles_of(pose)
        turn = (angles if stated == ANGLES else angles[[2, 1]][: len(stated)]) / units.radian
        whole = 2.0 * np.pi / units.radian
        turn = turn + whole * np.round((before - turn) / whole)
    return dict(zip(stated, turn.tolist(), strict=True))


def angles_of(pose: FloatArray) -> FloatArray:
    """Return roll, pitch and yaw (3,) about fixed axes [rad] of a pose (7,); upright or upside down without roll."""
    axes = se3.rotation_of(pose)
    pitch = math.asin(float(np.clip(-axes[2, 0], -1.0, 1.0)))
    if abs(axes[2, 0]) > 1.0 - 1e-9:
        return np.array([0.0, pitch, math.atan2(-axes[0, 1], axes[1, 1])])
    return np.array([math.atan2(axes[2, 1], axes[2, 2]), pitch, math.atan2(axes[1, 0], axes[0, 0])])


def edit_text(
    text: str, entries: Sequence[FileEntry], ids: Sequence[int], corrections: Iterable[Correction], units: Units
) -> str:
    """Return a text in which nothing but the numbers of some entries is changed, written as others of its kind are.

    Args:
        text: of the file.
        entries: that it has.
        ids: their ids.
        corrections: of some of them.
        units: of its numbers.
    """
    by_id = dict(zip(ids, entries, strict=True))
    style = {role: [one.numbers[kind].text for one in entries for kind in family if kind in one.numbers]
             for family in _FAMILIES for role in family}  # fmt: skip
    edits: list[tuple[Number, str]] = []
    for correction in corrections:
        entry = by_id[correction.landmark_id]
        if correction.like_id is not None:
            like = by_id[correction.like_id].numbers
            edits += [(old, like[role].text) for role, old in entry.numbers.items() if role in like]
            continue
        for role, value in values_of(entry, units, correction).items():
            old, others = entry.numbers[role], style.get(role)
            if role.startswith(("at_", "ring_")):
                others = style["x"] or [old.text]
            new = f"{value:.6g}" if others is None else number_like(others, value, _decimals(role, units))
            edits.append((old, old.text if float(new) == old.value else new))
    for number, new in sorted(edits, key=lambda edit: -edit[0].start):
        text = text[: number.start] + new + text[number.end :]
    return text


_FAMILIES = (POSITION, QUATERNION, ANGLES, VECTOR, FACING)
"""Roles that are written alike."""


def _decimals(role: str, units: Units) -> tuple[int, int]:
    if role in QUATERNION:
        return (6, 9)
    return units.decimals[1] if role in (*ANGLES, *VECTOR, *FACING) else units.decimals[0]


def number_like(others: Sequence[str], value: float, decimals: tuple[int, int]) -> str:
    """Return a number as the others of its kind are written: their decimals, between the least and the most that a
    measured number has, and zeros at the end where all of them have these.
    """
    counts = [_count_decimals(text) for text in others]
    typed = [count for count in counts if count is not None and count < _PRINTED]
    least, most = decimals
    places = most if len(typed) < len(counts) else min(max(max(typed, default=most), least), most)
    text = f"{value:.{places}f}"
    if float(text) == 0.0:
        text = text.removeprefix("-")
    if len(typed) == len(counts) and len(set(typed)) == 1 and typed[0] == places:
        return text
    short = text.rstrip("0").removesuffix(".")
    return short if "." in short or 0 in counts else f"{short}.0"


def _count_decimals(text: str) -> int | None:
    """Digits behind the point; None of a number with an exponent."""
    found = _DECIMALS.match(text)
    return None if found is None else len(found[1] or "")
