"""Runs and maps of evermap: `map.parquet`, `object_changes.csv` and `trajectory.tum` of a run; maps alone."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from evermap_score.episodes import COVARIANCE, QUATERNION, SIZE, Episodes, episodes_from_rows, read_rows
from evermap_score.errors import ScoreError

_PLACE = ("x_m", "y_m", "z_m")
_OF_MAP = (*_PLACE, *COVARIANCE, *SIZE)


def read_map(path: str | Path) -> Episodes:
    """Read a map of evermap, Parquet, CSV or GeoJSON: one open episode for each landmark, `p_exists` as `p`.

    Raises:
        ScoreError: it is not such a map.
    """
    return episodes_from_rows((_open_episode(row, None) for row in _map_rows(Path(path))), path)


def read_run(path: str | Path) -> Episodes:
    """Read the folder of one run, with the changes that it found.

    A landmark of a change was at its place before until the middle of the interval in which it happened, and is at its
    place afterwards since then. The last place has the covariance and `p_exists` of the map.

    Raises:
        ScoreError: a file is missing or is not such a one.
    """
    path = Path(path)
    return episodes_from_rows(_history(_change_rows(path), _map_rows(path / "map.parquet")), path)


def read_runs(path: str | Path) -> Episodes:
    """Read a folder of runs that follow each other in one map: after each session there is a map, its robot time.

    The robot time is the last stamp of `trajectory.tum`. Of a landmark all changes until then are known. A place before
    a change has the covariance of the map before that session.

    Raises:
        ScoreError: no folder in it is a run, or one has no trajectory.
    """
    path = Path(path)
    runs = []
    for folder in sorted(each.parent for each in path.glob("*/map.parquet")):
        try:
            last = (folder / "trajectory.tum").read_text(encoding="utf-8").split("\n")
            runs.append((float(next(line for line in reversed(last) if line.strip()).split()[0]), folder))
        except (OSError, StopIteration, ValueError):
            raise ScoreError("no stamp of the end of this run", path=folder / "trajectory.tum") from None
    if not runs:
        raise ScoreError("neither a run of evermap nor a folder of runs", path=path, hint="map.parquet is missing")
    rows: list[dict[str, Any]] = []
    changes: list[dict[str, Any]] = []
    covariances: dict[str, dict[str, Any]] = {}
    for robot_time_s, folder in sorted(runs):
        changes += [row | covariances.get(str(row["id"]), {}) for row in _change_rows(folder)]
        landmarks = _map_rows(folder / "map.parquet")
        now = _history(changes, landmarks)
        covariances = {str(row["landmark_id"]): {name: row.get(name) for name in COVARIANCE} for row in landmarks}
        rows += [row | {"robot_time_s": robot_time_s} for row in now]
    return episodes_from_rows(rows, path)


def _map_rows(path: Path) -> list[dict[str, Any]]:
    if path.suffix != ".geojson":
        rows = read_rows(path)
    else:
        try:
            features = json.loads(path.read_text(encoding="utf-8"))["features"]
            rows = [
                each["properties"] | dict(zip(_PLACE, each["geometry"]["coordinates"], strict=False))
                for each in features
                if each["properties"].get("kind", "landmark") == "landmark"
            ]
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            raise ScoreError("not a map in GeoJSON", path=path) from None
    if rows and not {"landmark_id", "x_m", "y_m"} <= rows[0].keys():
        raise ScoreError("no map: landmark_id, x_m or y_m is missing", path=path)
    return rows


def _open_episode(row: dict[str, Any], from_s: float | None) -> dict[str, Any]:
    return {
        "landmark_id": row["landmark_id"],
        "class_id": row.get("class_id"),
        "t_from_s": from_s,
        "t_to_s": None,
        "p": row.get("p_exists"),
        **{name: row.get(name) for name in _OF_MAP},
        **dict(zip(QUATERNION, (row.get(name) for name in ("qw", "qx", "qy", "qz")), strict=True)),
    }


def _change_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of the changes of a run with their instants, in order of time."""
    file = path / "object_changes.csv"
    if not file.is_file():
        return []
    rows = []
    for line, row in enumerate(read_rows(file), start=2):
        try:
            known = [float(row[name]) for name in ("from_s", "to_s") if row.get(name)]
            places = {name: float(row[name]) for name in _PLACE if row.get(name)}
        except (TypeError, ValueError):
            raise ScoreError("not a number", path=file, line=line) from None
        if known and {"x_m", "y_m"} <= places.keys():
            rows.append({"id": row["node_id"], "class": row.get("class"), "where": row.get("place"),
                         "stamp_s": float(np.mean(known)), **places})  # fmt: skip
    return sorted(rows, key=lambda row: float(row["stamp_s"]))


def _history(changes: Iterable[dict[str, Any]], landmarks: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the episodes of all landmarks, from their changes in order of time and the map after these."""
    ended: list[dict[str, Any]] = []
    begun: dict[str, dict[str, Any]] = {}
    last_s: dict[str, float] = {}
    for row in changes:
        name, stamp_s = str(row["id"]), float(row["stamp_s"])
        episode = {"landmark_id": name, "class_id": row["class"], **{axis: row.get(axis) for axis in _PLACE}}
        if row["where"] == "before":
            known = {each: row[each] for each in COVARIANCE if row.get(each) is not None}
            open_one = begun.pop(name, episode | {"t_from_s": last_s.get(name)}) | known
            if open_one["t_from_s"] is None or float(open_one["t_from_s"]) < stamp_s:
                ended.append(open_one | {"t_to_s": stamp_s})
        else:
            if name in begun and float(begun[name]["t_from_s"]) < stamp_s:
                ended.append(begun.pop(name) | {"t_to_s": stamp_s})
            begun[name] = episode | {"t_from_s": stamp_s, "t_to_s": None}
        last_s[name] = stamp_s
    for row in landmarks:
        name = str(row["landmark_id"])
        # present since its last change, or, after one that ended its stay, present then with the map's probability
        begun.pop(name, None)
        ended.append(_open_episode(row, last_s.get(name)))
    return ended + list(begun.values())
