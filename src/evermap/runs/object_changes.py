"""`object_changes.csv`: the changes of a run as a table with a row for every landmark and place, for spreadsheets.

Its first six columns are those in which Khronos (Schmid et al., RSS 2024) writes the changes of objects: nanoseconds of
evidence of absence and of presence, 0 where there is none.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from typing import Any

from evermap.io.landmarks import labels_of
from evermap.io.table import guard
from evermap.types import ChangeKind, Landmarks, MapChange, SlamResult
from evermap.viz.map_figure import places_of

BEFORE, AFTER = "before", "after"
COLUMNS = (
    "node_id", "merged_id", "first_absent", "last_absent", "first_persistent", "last_persistent",
    "change", "kind", "place", "name", "class", "x_m", "y_m", "z_m", "from_s", "to_s", "first_seen_s", "last_seen_s",
    "probability", "p_exists", "hits", "misses",
)  # fmt: skip
_PLACES = {ChangeKind.APPEARED: (AFTER,), ChangeKind.RETURNED: (AFTER,), ChangeKind.VANISHED: (BEFORE,)}
"""Places of a change by its kind; both if it is not listed."""


def object_changes_text(result: SlamResult) -> str:
    """Return the content of `object_changes.csv`: the changes of `changes.jsonl`, each landmark with its places."""
    out = io.StringIO()
    table = csv.DictWriter(out, COLUMNS, lineterminator="\n", restval="")
    table.writeheader()
    for row in _rows(result):
        table.writerow({name: _cell(value) for name, value in row.items()})
    return out.getvalue()


def _rows(result: SlamResult) -> Iterator[dict[str, Any]]:
    known = {**_records(result.gone), **_records(result.landmarks)}
    where = {}
    for change, ids, before, after in places_of((result.landmarks, result.gone), result.changes):
        for identity, *pair in zip(ids, before.tolist(), after.tolist(), strict=True):
            where[id(change), identity] = dict(zip((BEFORE, AFTER), pair, strict=True))
    for number, change in enumerate(result.changes, start=1):
        for identity, name in zip(change.landmark_ids, change.labels, strict=True):
            places = _PLACES.get(change.kind, (BEFORE, AFTER))
            if change.kind is ChangeKind.REPLACED:
                half = len(change.landmark_ids) // 2
                places = (BEFORE,) if identity in change.landmark_ids[:half] else (AFTER,)
            for place in places:
                at = where.get((id(change), identity), {}).get(place, [])
                now = place == AFTER or len(places) == 1
                yield {
                    "node_id": identity,
                    "merged_id": 0,
                    **_evidence(change, place),
                    "change": number,
                    "kind": change.kind.value,
                    "place": place,
                    "name": name,
                    **dict(zip(("x_m", "y_m", "z_m"), at, strict=False)),
                    "from_s": change.stamp_from_s,
                    "to_s": change.stamp_to_s,
                    "probability": change.probability,
                    "hits": change.n_hits,
                    "misses": change.n_misses,
                    **{key: value for key, value in known.get(identity, {}).items() if now or key == "class"},
                }


def _evidence(change: MapChange, place: str) -> dict[str, int]:
    """When the place was last empty before it was taken, and last taken before it was empty [ns]."""
    first_s, last_s = change.stamp_from_s, change.stamp_to_s
    names = ("first_absent", "first_persistent") if place == AFTER else ("last_persistent", "last_absent")
    told = dict.fromkeys(COLUMNS[2:6], 0)
    return told | {name: _nanoseconds(stamp_s) for name, stamp_s in zip(names, (first_s, last_s), strict=True)}


def _nanoseconds(stamp_s: float) -> int:
    return max(round(1e9 * stamp_s), 0) if math.isfinite(stamp_s) else 0


def _records(landmarks: Landmarks) -> dict[int, dict[str, Any]]:
    """Return the record of each landmark, by its id."""
    classes = labels_of(landmarks.class_id, landmarks.class_names)
    columns = (landmarks.first_seen_s, landmarks.last_seen_s, landmarks.p_exists)
    names = ("class", "first_seen_s", "last_seen_s", "p_exists")
    rows = zip(classes, *(column.tolist() for column in columns), strict=True)
    return dict(zip(landmarks.landmark_id.tolist(), (dict(zip(names, row, strict=True)) for row in rows), strict=True))


def _cell(value: Any) -> Any:
    """Return the cell of a value: empty if unknown, and without text that a spreadsheet would execute."""
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else ""
    return guard(value) if isinstance(value, str) else value
