"""Surveys before and after: field layouts of WPILib, `tagslam.yaml`, tables with an id and coordinates."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from evermap_score.episodes import Episodes, FloatArray, episodes_from_rows, read_rows, rows_of
from evermap_score.errors import ScoreError
from evermap_score.importers.yaml import parse_yaml

INCH_M = 0.0254
IDS = ("landmark_id", "tag_id", "marker_id", "fiducial_id", "anchor_id", "id", "name")


def read_survey(path: str | Path) -> Episodes:
    """Read one survey: an episode without ends for each landmark.

    Raises:
        ScoreError: it is none that is known.
    """
    path = Path(path)
    try:
        if path.suffix in (".yaml", ".yml"):
            rows = _tagslam_rows(parse_yaml(path.read_text(encoding="utf-8")))
        elif path.suffix == ".json":
            rows = _layout_rows(json.loads(path.read_text(encoding="utf-8")))
        else:
            rows = _table_rows(path)
    except OSError as error:
        raise ScoreError(f"cannot be read: {error.strerror}", path=path) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise ScoreError("not a field layout, tagslam.yaml, or table with id, x, y", path=path) from None
    if not rows:
        raise ScoreError("a survey without landmarks", path=path)
    return episodes_from_rows((row | {"t_from_s": None, "t_to_s": None} for row in rows), path)


def read_surveys(before: str | Path, after: str | Path, stamp_s: float = 0.0) -> Episodes:
    """Read two surveys of one site: what differs changed at `stamp_s`, everything else was always there.

    Raises:
        ScoreError: one of them is none that is known.
    """
    first, second = ({row["landmark_id"]: row for row in rows_of(read_survey(path))} for path in (before, after))
    rows = []
    for name in sorted(first.keys() | second.keys()):
        old, new = first.get(name), second.get(name)
        if old and new and all(old[axis] == new[axis] for axis in ("x_m", "y_m", "z_m")):
            rows.append(new)
            continue
        rows += [old | {"t_to_s": stamp_s}] if old else []
        rows += [new | {"t_from_s": stamp_s}] if new else []
    return episodes_from_rows(rows)


def _layout_rows(layout: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the tags of a field layout of WPILib, of 2022 to 2026 (`tags`) or from 2027 on (`field-tags`)."""
    rows = []
    for tag in layout["tags"] if "tags" in layout else layout["field-tags"]:
        place, turn = tag["pose"]["translation"], tag["pose"]["rotation"]["quaternion"]
        rows.append(
            {"landmark_id": tag["ID"]}
            | {f"{axis}_m": place[axis] for axis in "xyz"}
            | {f"q{axis}": turn[axis.upper()] for axis in "wxyz"}
        )
    return rows


def _table_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table with an id and x, y, perhaps z, in metres; WPILib's own table is in inches."""
    rows = [{str(name).strip().lower(): value for name, value in row.items()} for row in read_rows(path)]
    if not rows:
        return []
    key = next(name for name in IDS if name in rows[0]) if set(IDS) & rows[0].keys() else None
    if key is None:
        raise KeyError
    unit_m = INCH_M if "z-rotation" in rows[0] else 1.0
    found = []
    for row in rows:
        place = {f"{axis}_m": row.get(f"{axis}_m", row.get(axis)) for axis in "xyz"}
        found.append({"landmark_id": row[key]} | {
            name: float(value) * unit_m for name, value in place.items() if value not in (None, "")
        })  # fmt: skip
    if not {"x_m", "y_m"} <= found[0].keys():
        raise KeyError
    return found


def _tagslam_rows(survey: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the tags of static bodies, in the frame of the world; rotations are rotation vectors."""
    rows = []
    for entry in survey["bodies"]:
        for body in entry.values():
            if not body.get("is_static") or "pose" not in body:
                continue
            turn, shift_m = _pose(body["pose"])
            for tag in body.get("tags") or []:
                if "pose" in tag:
                    place = turn @ _pose(tag["pose"])[1] + shift_m
                    size = {"length_m": tag.get("size"), "width_m": tag.get("size"), "height_m": 0.0}
                    rows.append({"landmark_id": tag["id"], **size}
                                | dict(zip(("x_m", "y_m", "z_m"), place.tolist(), strict=True)))  # fmt: skip
    return rows


def _pose(pose: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    vector, place = (np.array([float(pose[part][axis]) for axis in "xyz"]) for part in ("rotation", "position"))
    angle = math.sqrt(float(vector @ vector))
    if angle < 1e-12:
        return np.eye(3), place
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross, place  # Rodrigues
