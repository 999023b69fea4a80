"""Maps of square tags in the files of other projects: where each entry is in the file, and files of their kinds.

The frame of a tag has x to the right, y up and z towards the viewer, as AprilTag's corners and ArUco have it; in WPILib
it is x that points to the viewer, and z up.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.map_entries import (
    ANGLES,
    POSITION,
    QUATERNION,
    VECTOR,
    VIEWED,
    FileEntry,
    Number,
    Units,
    angles_of,
    number_json,
    number_yaml,
    pose_of,
)
from evermap.io.spatial import AT
from evermap.io.spatial import QUATERNION as QUATERNION_COLUMNS
from evermap.io.table import Table
from evermap.io.text import parse_json
from evermap.io.yaml import parse_yaml
from evermap.types import FloatArray, Landmarks
from evermap.valid import Quantity

WPILIB_UNITS = Units(is_viewed=True)
TAGSLAM_UNITS = Units(decimals=((3, 6), (4, 8)))
DEGREES = Units(radian=math.pi / 180.0, decimals=((3, 6), (2, 6)))
WPILIB_TAGS = ("tags", "field-tags")
"""Where the tags are listed in layouts of 2022 to 2026, and from 2027 on."""
FIDUCIAL = ("id", "x", "y", "z", "roll", "pitch", "yaw", "variance")
_WORD = re.compile(r"\S+")
_PRIORS = re.compile(r"Marker[/\\]Priors\s*[=:]\s*\"?([^\"\r\n]*)")
"""rtabmap's parameter in a file of settings."""


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
        **dict(zip(QUATERNION_COLUMNS, rotation.T, strict=True)),
        "tag_size_m": table.numbers(Quantity("size_m", 0.0, 1e3, positive=True, hint="metres")),
    }
    return replace(table, columns=columns)


def entries_of_tagslam(text: str, path: Path) -> list[FileEntry]:
    """Return the tags of a `tagslam.yaml` that are stated on static bodies whose poses are stated.

    Raises:
        InputError: not YAML, or its bodies are not described as TagSLAM describes them.
    """
    parse_yaml(text.encode(), path)  # mistakes are told as they are written
    numbered, numbers = number_yaml(text)
    document = parse_yaml(numbered.encode(), path)
    listed = document.get("bodies") if isinstance(document, dict) else None
    if not isinstance(listed, list):
        raise InputError("contains no bodies with tags", path=path, field="bodies", hint="TagSLAM's tagslam.yaml")
    found: list[FileEntry] = []
    for item in listed:
        for name, body in item.items() if isinstance(item, dict) else ():
            if not isinstance(body, dict) or not body.get("is_static") or "pose" not in body:
                continue
            where = pose_of(_values(_pose_numbers(body["pose"], numbers, path, name)), TAGSLAM_UNITS, se3.identity())
            for tag in body.get("tags") or ():
                if isinstance(tag, dict) and "pose" in tag:
                    field = f"{name}.tags"
                    own = _pose_numbers(tag["pose"], numbers, path, field)
                    size = tag.get("size", body.get("default_tag_size"))
                    edge = math.nan if size is None else _number(size, numbers, path, field).value
                    label = _number(tag.get("id"), numbers, path, field).text
                    found.append(FileEntry(label, len(found) + 1, own, where, edge))
    return found


def _pose_numbers(content: Any, numbers: Sequence[Number], path: Path, field: str) -> dict[str, Number]:
    """Numbers of TagSLAM's `pose`: a `position` and a rotation vector `rotation`."""
    parts = [content.get(part) if isinstance(content, dict) else None for part in ("position", "rotation")]
    if not all(isinstance(part, dict) and not {*"xyz"} - part.keys() for part in parts):
        raise InputError("needs position and rotation, with x, y and z", path=path, field=f"{field}.pose")
    values = [part[axis] for part in parts if part is not None for axis in "xyz"]
    return dict(
        zip((*POSITION, *VECTOR), (_number(value, numbers, path, f"{field}.pose") for value in values), strict=True)
    )


def pose_of_tagslam(content: Any, path: Path, field: str) -> FloatArray:
    """Return the pose (7,) of TagSLAM's `pose`: a `position` and a rotation vector `rotation`.

    Raises:
        InputError: other contents, named by the file and the field that the pose is of.
    """
    numbers: list[Number] = []

    def told(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: told(inner) for key, inner in value.items()}
        if isinstance(value, bool) or not isinstance(value, int | float):
            return value
        numbers.append(Number(repr(value), 0, 0))
        return len(numbers) - 1

    given = _values(_pose_numbers(told(content), numbers, path, field))
    if not np.isfinite([*given.values()]).all():
        raise InputError("must be finite numbers", path=path, field=f"{field}.pose")
    return pose_of(given, TAGSLAM_UNITS, se3.identity())


def is_tagslam(text: str) -> bool:
    """Return whether a text has bodies as TagSLAM has them."""
    return re.search(r"(?m)^bodies\s*:", text) is not None


def entries_of_wpilib(text: str, path: Path) -> list[FileEntry]:
    """Return the tags of a field layout of WPILib, of either generation.

    Raises:
        InputError: a tag has no ID or pose.
    """
    parse_json(text.encode(), path)
    numbered, numbers = number_json(text.removeprefix("\ufeff"))
    shift = len(text) - len(text.removeprefix("\ufeff"))
    numbers = [Number(one.text, one.start + shift, one.end + shift) for one in numbers]
    document = json.loads(numbered)
    key = next(key for key in WPILIB_TAGS if key in document)
    found = []
    for row, tag in enumerate(document[key]):
        field = f"{key}[{row}]"
        try:
            at, turn = tag["pose"]["translation"], tag["pose"]["rotation"]["quaternion"]
            values = [tag["ID"], *(at[axis] for axis in "xyz"), *(turn[axis] for axis in "XYZW")]
        except (KeyError, TypeError):
            problem = "has no ID, translation x, y, z and quaternion W, X, Y, Z"
            raise InputError(problem, path=path, field=field, hint="a field layout of WPILib") from None
        label, *pose = (_number(value, numbers, path, field) for value in values)
        if not 0.9 < math.hypot(*(one.value for one in pose[3:])) < 1.1:
            raise InputError("is not a unit quaternion", path=path, field=f"{field}.pose.rotation.quaternion")
        found.append(FileEntry(label.text, row + 1, dict(zip((*POSITION, *QUATERNION), pose, strict=True))))
    return found


def is_wpilib(text: str) -> bool:
    """Return whether a text is a field layout of WPILib, of either generation."""
    try:
        document = json.loads(text.removeprefix("\ufeff"))
    except (ValueError, RecursionError):
        return False
    if not isinstance(document, dict):
        return False
    return (isinstance(document.get("tags"), list) and "field" in document) or isinstance(
        document.get("field-tags"), list
    )


def entries_of_fiducials(text: str, path: Path) -> list[FileEntry]:
    """Return the tags of a map of fiducial_slam: id, x, y, z, roll, pitch, yaw [deg], variance, and so on.

    Raises:
        InputError: a line is not that of a tag.
    """
    found = []
    for number, (line, start) in enumerate(lines_of(text.replace("\ufeff", " ", 1)), 1):
        words = [Number(word[0], start + word.start(), start + word.end()) for word in _WORD.finditer(line)][:8]
        if not words or words[0].text.startswith("#"):
            continue
        if len(words) != 8 or not all(map(_is_finite, words)) or not words[0].value.is_integer():
            problem = "is not a tag of fiducial_slam"
            raise InputError(problem, path=path, line=number, hint=f"{' '.join(FIDUCIAL)}, angles in degrees")
        found.append(FileEntry(words[0].text, number, dict(zip((*POSITION, *ANGLES), words[1:], strict=False))))
    return found


def is_fiducials(text: str) -> bool:
    """Return whether a text begins as a map of fiducial_slam: a whole number and at least seven more."""
    lines = (line.split() for line in text.removeprefix("\ufeff").splitlines())
    words = next((words for words in lines if words and not words[0].startswith("#")), [])
    numbers = [Number(word, 0, 0) for word in words]
    return len(words) >= 9 and all(map(_is_finite, numbers)) and re.fullmatch(r"\d+", words[0]) is not None


def entries_of_rtabmap(text: str, path: Path) -> list[FileEntry]:
    """Return the priors of rtabmap's markers, `id x y z roll pitch yaw|...` [m, rad], alone or as the parameter
    `Marker/Priors` of its settings.

    Raises:
        InputError: one of them has other than seven numbers.
    """
    start, end = _span_of_priors(text)
    found = []
    for part in re.finditer(r"[^|]+", text[start:end]):
        at = start + part.start()
        words = [Number(word[0], at + word.start(), at + word.end()) for word in _WORD.finditer(part[0])]
        if not words:
            continue
        line = text.count("\n", 0, words[0].start) + 1
        if len(words) != 7 or not all(map(_is_finite, words)) or not words[0].value.is_integer():
            problem, hint = "is not a prior of rtabmap's markers", "id x y z roll pitch yaw, in metres and radians"
            raise InputError(problem, path=path, line=line, hint=hint)
        found.append(FileEntry(words[0].text, line, dict(zip((*POSITION, *ANGLES), words[1:], strict=True))))
    return found


def is_rtabmap(text: str) -> bool:
    """Return whether a text has priors of rtabmap's markers."""
    if _PRIORS.search(text):
        return True
    parts = [part.split() for part in text.removeprefix("\ufeff").split("|") if part.strip()]
    return bool(parts) and all(
        len(words) == 7 and all(_is_finite(Number(word, 0, 0)) for word in words) for words in parts
    )


def _span_of_priors(text: str) -> tuple[int, int]:
    found = _PRIORS.search(text)
    return (1 if text.startswith("\ufeff") else 0, len(text)) if found is None else found.span(1)


def lines_of(text: str) -> list[tuple[str, int]]:
    """Return the lines of a text without their ends, whatever these are, and where each begins."""
    found, start = [], 0
    for end in re.finditer(r"\r\n|\r|\n", text):
        found.append((text[start : end.start()], start))
        start = end.end()
    return [*found, (text[start:], start)]


def table_of_tags(entries: Sequence[FileEntry], units: Units, path: Path) -> Table:
    """Return entries with poses as a table with the columns of a map in space."""
    rows = [(float(one.label), *pose_of(_values(one.numbers), units, one.within), one.tag_size_m) for one in entries]
    values = np.array(rows, dtype=np.float64).reshape(-1, 9)
    names = ("landmark_id", *AT, *QUATERNION_COLUMNS, "tag_size_m")
    columns = {name: np.ascontiguousarray(column) for name, column in zip(names, values.T, strict=True)}
    if np.isnan(values[:, 8]).all():
        del columns["tag_size_m"]
    return Table(path, columns, np.array([one.line for one in entries], dtype=np.int64))


def _values(numbers: Mapping[str, Number]) -> dict[str, float]:
    return {role: number.value for role, number in numbers.items()}


def _number(value: Any, numbers: Sequence[Number], path: Path, field: str) -> Number:
    """The number of a document whose numbers are places in a list."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"must be numbers, not {type(value).__name__}", path=path, field=field)
    return numbers[int(value)]


def _is_finite(word: Number) -> bool:
    try:
        return "_" not in word.text and math.isfinite(word.value)
    except ValueError:
        return False


def wpilib_text(landmarks: Landmarks) -> str:
    """Return tags as a field layout of WPILib, of 2022 to 2026; its field is what they span."""
    high = landmarks.position_m.max(axis=0, initial=0.0)
    field = {"length": round(float(high[0]), 6), "width": round(float(high[1]), 6)}
    return _json_text({"tags": _layout(landmarks), "field": field})


def wpilib_2027_text(landmarks: Landmarks) -> str:
    """Return tags as a field layout of WPILib, from 2027 on."""
    high = landmarks.position_m.max(axis=0, initial=0.0)
    field = {"length": round(float(high[0]), 6), "width": round(float(high[1]), 6)}
    return _json_text({"name": "evermap", "field-dimensions": field, "field-tags": _layout(landmarks)})


def _json_text(content: Any) -> str:
    return json.dumps(content, indent=2) + "\n"


def _layout(landmarks: Landmarks) -> list[dict[str, Any]]:
    viewed = se3.inverse(VIEWED)
    tags = []
    for identity, pose in zip(landmarks.landmark_id.tolist(), _poses(landmarks), strict=True):
        x, y, z, *turn = se3.compose(pose, viewed).tolist()
        quaternion = dict(zip("WXYZ", (turn[3], *turn[:3]), strict=True))
        translation = {"x": x, "y": y, "z": z}
        tags.append({"ID": identity, "pose": {"translation": translation, "rotation": {"quaternion": quaternion}}})
    return tags


def tagslam_text(landmarks: Landmarks) -> str:
    """Return tags as the static body of a `tagslam.yaml`."""
    edge = None if landmarks.size_m is None else landmarks.size_m[:, 0]
    lines = ["bodies:", " - map:", "     is_static: true"]
    lines += _yaml_pose(np.zeros(6), 5)
    lines += ["     tags:"]
    for row, (identity, pose) in enumerate(zip(landmarks.landmark_id.tolist(), _poses(landmarks), strict=True)):
        lines.append(f"       - id: {identity}")
        if edge is not None and math.isfinite(edge[row]):
            lines.append(f"         size: {float(edge[row])!r}")
        turn = se3.log(np.concatenate([np.zeros(3), pose[3:]]))[3:]
        lines += _yaml_pose(np.concatenate([pose[:3], turn]), 9)
    return "\n".join(lines) + "\n"


def _yaml_pose(numbers: FloatArray, indent: int) -> list[str]:
    lines = [f"{' ' * indent}pose:"]
    for part, values in (("position", numbers[:3]), ("rotation", numbers[3:])):
        lines.append(f"{' ' * indent}  {part}:")
        lines += [f"{' ' * indent}    {axis}: {value!r}" for axis, value in zip("xyz", values.tolist(), strict=True)]
    return lines


def fiducials_text(landmarks: Landmarks) -> str:
    """Return tags as a map of fiducial_slam."""
    spread = np.einsum("lii->l", landmarks.covariance_m2) / 3.0
    known = zip(landmarks.landmark_id.tolist(), spread.tolist(), landmarks.n_hits.tolist(), strict=True)
    lines = []
    for (identity, variance, hits), pose in zip(known, _poses(landmarks), strict=True):
        numbers = [*pose[:3].tolist(), *np.degrees(angles_of(pose)).tolist(), variance]
        lines.append(f"{identity} {' '.join(f'{number:.6f}' for number in numbers)} {hits}")
    return "\n".join(lines) + "\n"


def rtabmap_text(landmarks: Landmarks) -> str:
    """Return tags as priors of rtabmap's markers."""
    rows = zip(landmarks.landmark_id.tolist(), _poses(landmarks), strict=True)
    parts = [
        f"{identity} {' '.join(f'{number:.6f}' for number in [*pose[:3].tolist(), *angles_of(pose).tolist()])}"
        for identity, pose in rows
    ]
    return "|".join(parts) + "\n"


def _poses(landmarks: Landmarks) -> FloatArray:
    """(L, 7) poses of landmarks, all of which have one."""
    assert landmarks.rotation is not None
    return np.concatenate([landmarks.position_m, landmarks.rotation], axis=1)
