"""`object_changes.csv` of Khronos, with the places of its objects."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from evermap_score.episodes import Episodes, episodes_from_rows, read_rows
from evermap_score.errors import ScoreError

_SYMBOL = re.compile(r"(\w)\((\d+)\)")


def read_khronos(path: str | Path) -> Episodes:
    """Read changes of objects: an episode for each row.

    An object is there from the middle between the last evidence of its absence and the first of its presence, to the
    middle between the last evidence of its presence and the first of its absence; where only the absence is known, from
    or to that. 0 is no evidence: since ever, or still there. Stamps are nanoseconds.

    The file has no places. They are columns `x_m, y_m[, z_m]` of the same file, as evermap writes, or in `objects.csv`
    beside it with `ID, CentroidX, CentroidY, CentroidZ`, which the evaluation of Khronos writes (`O(12)` is an id).

    Raises:
        ScoreError: a column is missing, or the place of an object is unknown.
    """
    path = Path(path)
    beside = path.parent / "objects.csv"
    places = _read_places(beside) if beside.is_file() else {}
    rows = []
    for line, row in enumerate(read_rows(path), start=2):
        try:
            node = int(row["node_id"])
            stamps = {name: int(row[name]) for name in
                      ("first_absent", "last_absent", "first_persistent", "last_persistent")}  # fmt: skip
        except (KeyError, TypeError, ValueError):
            raise ScoreError("not a row of object_changes.csv", path=path, line=line) from None
        if row.get("x_m"):
            place = {name: row.get(name) for name in ("x_m", "y_m", "z_m")} | {"class_id": row.get("class")}
        elif node in places:
            place = places[node]
        else:
            raise ScoreError(f"no place of object {node}", path=path, line=line, hint=f"objects.csv in {path.parent}")
        rows.append({
            "landmark_id": node,
            "t_from_s": _middle_s(stamps["first_absent"], stamps["first_persistent"]),
            "t_to_s": _middle_s(stamps["last_absent"], stamps["last_persistent"]),
            "p": row.get("p_exists") if row.get("place") == "after" else None,
            **place,
        })  # fmt: skip
    return episodes_from_rows(rows, path)


def _middle_s(absent_ns: int, persistent_ns: int) -> float | None:
    if absent_ns == 0:
        return None
    return 1e-9 * (absent_ns if persistent_ns == 0 else absent_ns + 0.5 * (persistent_ns - absent_ns))


def _read_places(path: Path) -> dict[int, dict[str, Any]]:
    """Return the place of each object by its number; of several rows of an object the last counts."""
    places: dict[int, dict[str, Any]] = {}
    for line, row in enumerate(read_rows(path), start=2):
        if str(row.get("IsGT", "0")).strip() == "1":
            continue
        symbol = _SYMBOL.fullmatch(str(row.get("ID", "")).strip())
        try:
            node = (ord(symbol[1]) << 56) + int(symbol[2]) if symbol else int(row["ID"])
            x_m, y_m, z_m = (float(row[f"Centroid{axis}"]) for axis in "XYZ")
        except (KeyError, TypeError, ValueError):
            raise ScoreError("needed are ID, CentroidX, CentroidY, CentroidZ", path=path, line=line) from None
        places[node] = {"x_m": x_m, "y_m": y_m, "z_m": z_m, "class_id": row.get("Label")}
    return places
