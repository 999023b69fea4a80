"""`object_changes.csv`: the rows of `changes.jsonl` by landmark and place, with nothing that a spreadsheet runs."""

from __future__ import annotations

import csv
import io
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap.runs.folder import write_run
from evermap.runs.object_changes import COLUMNS, object_changes_text
from evermap.types import ChangeKind, Landmarks, MapChange, SlamResult

sys.path.insert(0, str(Path(__file__).parents[1] / "metrics"))

KHRONOS = ("node_id", "merged_id", "first_absent", "last_absent", "first_persistent", "last_persistent")
"""Columns that its reader requires."""


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def change(kind: ChangeKind, *ids: int, **more: Any) -> MapChange:
    values = {
        "stamp_from_s": 10.0, "stamp_to_s": 12.5, "displacement_m": (1.0, -2.0), "rotation_rad": 0.0,
        "probability": 0.9, "n_hits": 3, "n_misses": 4,
    }  # fmt: skip
    return MapChange(ids, kind, **{**values, **more})


@pytest.fixture(scope="module")
def run() -> Any:
    from synthetic_run import make_run

    return make_run(duration_s=120.0)


@pytest.fixture
def result(run: Any) -> SlamResult:
    nowhere = (np.nan, np.nan)
    ids = run[1].landmarks.landmark_id
    gone = Landmarks.at([900], [[7.0, 8.0]], class_id=[0], class_names=("=cmd()",))
    return replace(
        run[1],
        gone=gone,
        changes=(
            change(ChangeKind.MOVED, int(ids[0]), int(ids[1])),
            change(ChangeKind.APPEARED, int(ids[2]), displacement_m=nowhere).named({int(ids[2]): "+1; =HYPERLINK()"}),
            change(ChangeKind.VANISHED, 900, displacement_m=nowhere, stamp_from_s=np.nan),
            change(ChangeKind.VANISHED, 12345, displacement_m=nowhere),
        ),
    )


def test_rows_are_those_of_changes_jsonl(run: Any, result: SlamResult, tmp_path: Any) -> None:
    write_run(tmp_path / "run", run[0], result, figures=False, report=False)
    told = [json.loads(line) for line in (tmp_path / "run" / "changes.jsonl").read_text().splitlines()]
    rows = table((tmp_path / "run" / "object_changes.csv").read_text())
    again: dict[int, set[int]] = {}
    for row in rows:
        one = told[int(row["change"]) - 1]
        again.setdefault(int(row["change"]), set()).add(int(row["node_id"]))
        assert row["kind"] == one["kind"]
        for column, key in (("from_s", "stamp_from_s"), ("to_s", "stamp_to_s"), ("probability", "probability")):
            assert (float(row[column]) if row[column] else None) == one[key]
        assert (int(row["hits"]), int(row["misses"])) == (one["hits"], one["misses"])
    assert again == {number: set(one["landmarks"]) for number, one in enumerate(told, start=1)}


def test_places_and_evidence(result: SlamResult) -> None:
    rows = table(object_changes_text(result))
    assert tuple(rows[0]) == COLUMNS
    assert COLUMNS[:6] == KHRONOS
    before, after = (row for row in rows if row["node_id"] == str(result.landmarks.landmark_id[0]))
    at = result.landmarks.position_m[0]
    assert [float(after[axis]) for axis in ("x_m", "y_m")] == at.tolist()
    np.testing.assert_allclose([float(before[axis]) for axis in ("x_m", "y_m")], at - [1.0, -2.0])
    assert [before[name] for name in KHRONOS[2:]] == ["0", "12500000000", "0", "10000000000"]
    assert [after[name] for name in KHRONOS[2:]] == ["10000000000", "0", "12500000000", "0"]
    assert before["last_seen_s"] == ""
    (gone,) = (row for row in rows if row["node_id"] == "900")
    assert (gone["place"], gone["x_m"], gone["from_s"], gone["last_persistent"]) == ("before", "7.0", "", "0")
    (nowhere,) = (row for row in rows if row["node_id"] == "12345")
    assert (nowhere["x_m"], nowhere["class"]) == ("", "")


def test_no_cell_is_a_formula(result: SlamResult) -> None:
    for row in table(object_changes_text(result)):
        for name in ("name", "class", "kind", "place"):
            assert not row[name].startswith(("=", "+", "-", "@", "\t", "\r"))
    assert "'+1; =HYPERLINK()" in object_changes_text(result)
    assert "'=cmd()" in object_changes_text(result)


def test_without_changes_there_is_the_head(run: Any) -> None:
    assert object_changes_text(replace(run[1], changes=())) == ",".join(COLUMNS) + "\n"
