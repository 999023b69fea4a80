"""Data frames instead of files: the same values, whichever library made them, and errors that name the column."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evermap as em
from evermap.errors import InputError
from evermap.io import write_template
from evermap.runs.persist.table import LookTable, read_looks
from evermap.tracking.detections import read_detections

pa = pytest.importorskip("pyarrow")
LOOKS = {
    "stamp_s": [0.0, 1.0, 2.0, 0.5, 1.5, 2.5],
    "feature_id": [10, 10, 10, 2, 2, 2],
    "detected": [1, 0, 0, 1, 1, 1],
    "class_id": ["cart", "cart", "cart", "wall", "wall", "wall"],
}


def as_frame(columns: dict[str, Any], library: str) -> Any:
    if library == "pyarrow":
        return pa.table(columns)
    module = pytest.importorskip(library, reason=f"{library} is not installed")
    frame = module.DataFrame(columns)
    if library == "pandas":  # rows that were chosen have an index without a name; classes are categories, flags truths
        frame = frame.astype({name: "category" for name in ("class_id",) if name in columns})
        frame = frame.astype({name: bool for name in ("detected",) if name in columns})
        frame = frame[frame["stamp_s"] >= 0.0].set_index(frame.index + 7)
    return frame


def as_file(columns: dict[str, Any], path: Path) -> Path:
    rows = zip(*columns.values(), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("library", ["pyarrow", "pandas", "polars"])
def test_looks_are_those_of_the_file(library: str, tmp_path: Path) -> None:
    expected = read_looks(as_file(LOOKS, tmp_path / "looks.csv"), p_miss=0.2)
    found = read_looks(as_frame(LOOKS, library), p_miss=0.2)
    assert found.names == expected.names == ("2", "10")
    assert found.class_names == expected.class_names
    assert found.source == ""
    for name in ("feature", "stamp_s", "detected", "p_miss", "p_false", "class_of_feature"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_a_frame_and_its_file_have_one_result(tmp_path: Path) -> None:
    """With the detector's error rates of the configuration, and rows and ids as they were given."""
    pandas = pytest.importorskip("pandas")
    config = em.PersistConfig(p_miss=0.3, p_false=0.02)
    result = em.run_persist(pandas.DataFrame(LOOKS), config)
    file = as_file(LOOKS, tmp_path / "looks.csv")
    expected = em.run_persist(read_looks(file, p_miss=0.3, p_false=0.02), config)
    assert em.run_persist(file, config).totals.p_now.tolist() == expected.totals.p_now.tolist()
    beliefs = result.to_pandas()
    assert beliefs["feature_id"].tolist() == LOOKS["feature_id"]
    assert beliefs["stamp_s"].tolist() == LOOKS["stamp_s"]
    assert beliefs["p_exists"].tolist() == expected.beliefs.p_exists.tolist()
    lone = em.PersistenceFilter()  # the default prior, from the birth on
    lone.update(0.0, True, 0.3, 0.02)
    assert beliefs["p_exists"][1] == pytest.approx(lone.update(1.0, False, 0.3, 0.02), rel=1e-9)
    assert "source=''" in repr(result)
    assert len(repr(result)) < 500
    assert "<table>" in result._repr_html_()
    assert result.plot().axes


def test_changes_and_forecasts_become_rows() -> None:
    pytest.importorskip("pandas")
    stamp_s = np.arange(40.0)
    gone = pa.table({"stamp_s": stamp_s, "feature_id": ["box"] * 40, "detected": (stamp_s < 20.0).astype(int)})
    result = em.run_persist(gone)
    changes = result.to_pandas("changes")
    assert changes["feature_id"].tolist() == ["box"]
    assert changes["kind"].tolist() == ["vanished"]
    assert 19.0 <= changes["stamp_s"][0] <= 20.0
    forecasts = result.to_pandas("forecasts")
    assert forecasts["stamp_s"].tolist() == result.forecasts.stamp_s.tolist()
    assert forecasts["p_exists"].tolist() == result.forecasts.p_exists[0].tolist()
    assert forecasts["median_stay_s"][0] == result.forecasts.median_stay_s[0]
    assert forecasts["median_stay_s"][1:].isna().all()


def test_detections_are_tracked_from_a_frame(tmp_path: Path) -> None:
    columns = {"stamp_s": np.repeat(np.arange(30.0), 2), "x_m": np.tile([0.0, 5.0], 30), "y_m": np.tile([1.0, 2.0], 30),
               "z_m": np.zeros(60)}  # fmt: skip
    file = as_file(columns, tmp_path / "detections.csv")
    found, expected = em.read_detections(pa.table(columns)), read_detections(file)
    np.testing.assert_array_equal(found.position_m, expected.position_m)
    np.testing.assert_array_equal(found.first, expected.first)
    tracked = em.run_track(pa.table(columns))
    again = em.run_track(expected)
    np.testing.assert_array_equal(tracked.tracks.position_m, again.tracks.position_m)
    assert len(tracked.first_rows()) == 2


def test_a_recording_is_read_from_frames(tmp_path: Path) -> None:
    """The same as from its files, bit by bit."""
    pandas = pytest.importorskip("pandas")
    folder = tmp_path / "drive"
    write_template(folder)
    names = ("odometry", "detections", "frames", "truth", "landmarks")
    tables = {name: pandas.read_csv(folder / f"{name}.csv", comment="#") for name in names}
    sensor = tomllib.loads((folder / "sensor.toml").read_text(encoding="utf-8"))
    found, expected = em.read_recording({**tables, "sensor": sensor}), em.read_recording(folder)
    for part in ("odometry", "frames", "detections", "truth", "true_landmarks"):
        mine, theirs = getattr(found, part), getattr(expected, part)
        for column in dataclasses.fields(theirs):
            if column.name not in ("source_line", "up"):
                np.testing.assert_equal(getattr(mine, column.name), getattr(theirs, column.name))
    assert found.sensor == expected.sensor
    assert found.class_names == expected.class_names
    assert (found.name, found.source) == (expected.name, "")


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"odometri": pa.table({})}, "is no table of a recording.*odometry"),
        ({"odometry": [1, 2]}, "is no data frame"),
        ({"sensor": "sensor.toml"}, "is no dictionary"),
        ({"odometry": pa.table({"stamp_s": [0.0]})}, "file is missing"),
    ],
)
def test_what_is_no_recording_is_named(tables: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        em.read_recording(tables)


def test_errors_name_library_and_column() -> None:
    with pytest.raises(InputError, match=r"pyarrow data frame.*detected"):
        em.run_persist(pa.table({**LOOKS, "detected": [2] * 6}))
    with pytest.raises(InputError, match="neither a file nor a data frame"):
        em.run_persist([1, 2, 3])  # type: ignore[arg-type]
    pandas = pytest.importorskip("pandas")
    mixed = pandas.DataFrame({**LOOKS, "stamp_s": [0, "a", 2, object(), 1, 2]})
    with pytest.raises(InputError, match="one type a column"):
        em.run_persist(mixed)
    twice = pandas.DataFrame([[0.0, 0.0]], columns=["stamp_s", "stamp_s"])
    with pytest.raises(InputError, match=r"stamp_s|Duplicate"):
        em.run_persist(twice)


def test_a_table_of_looks_is_one_line() -> None:
    assert isinstance(table := read_looks(pa.table(LOOKS)), LookTable)
    assert len(repr(table)) < 900
