"""What labels say of cars that stand and drive, made by hand; and a claim for each thing that is expected."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evermap.cli.bench import load_benchmarks

load_benchmarks()

from benchmarks.kitti import Table  # noqa: E402
from benchmarks.kitti_stays import Labelled, as_markdown, claims  # noqa: E402

STAMP_S = 0.1 * np.arange(101)


def labelled(*paths: np.ndarray, range_scale: float = 1.0, speed_mps: float = 0.0) -> Labelled:
    """Tracks of cars in the world, seen from a robot that drives along x; a stretch without a label has no row."""
    pose = np.zeros((len(STAMP_S), 7))
    pose[:, 0], pose[:, 6] = speed_mps * STAMP_S, 1.0
    rows = [(k, t) for k, path in enumerate(paths) for t in range(len(STAMP_S)) if np.isfinite(path[t, 0])]
    at = np.array([(paths[k][t] - pose[t, :2]) / range_scale for k, t in rows])
    columns = {
        "stamp_s": np.array([STAMP_S[t] for _, t in rows]), "track_id": np.array([float(k) for k, _ in rows]),
        "x_m": at[:, 0], "y_m": at[:, 1], "z_m": np.zeros(len(rows)),
    }  # fmt: skip
    recording: Any = SimpleNamespace(odometry=SimpleNamespace(stamp_s=STAMP_S, pose_world_robot=pose))
    return Labelled(recording, Table(columns, np.array(["Car"] * len(rows))), range_scale)  # type: ignore[arg-type]


def at(x_m: float, y_m: float, leaves_s: float = np.inf) -> np.ndarray:
    """A car that stands, and from some time on drives along x with 5 m/s."""
    return np.column_stack([x_m + 5.0 * np.maximum(STAMP_S - leaves_s, 0.0), np.full(len(STAMP_S), y_m)])


@pytest.mark.parametrize("range_scale", [1.0, 1.03])
def test_labels_tell_what_drove_off_in_the_metre_of_the_odometry(range_scale: float) -> None:
    truth = labelled(at(40.0, 3.0), at(40.0, -3.0, leaves_s=4.0), range_scale=range_scale, speed_mps=8.0)
    assert truth.fate_of(np.array([40.0, 3.0]), 4.0) == "stands"
    assert truth.fate_of(np.array([40.3, -3.0]), 4.0) == "drove off"
    assert truth.fate_of(np.array([60.0, 0.0]), 4.0) == "no label"
    assert truth.count_stood_and_drove() == (1, 1)


def test_what_is_seen_for_a_moment_or_always_drives_neither_stood_nor_both() -> None:
    short = at(0.0, 0.0)
    short[15:] = np.nan
    assert labelled(short, at(0.0, 9.0, leaves_s=-1.0)).count_stood_and_drove() == (0, 0)


def test_claims_are_of_the_least_probable_car_and_of_all_ends_with_a_label() -> None:
    end = {"landmark": "Car-7@0", "class": "Car", "from_s": 1.0, "last_s": 4.0, "gone_s": 5.0, "p": 0.99}
    row = {
        "sequence": "0011", "verdict": "weak", "stays": 43, "stays_of_cars": 41, "cars_there": 40, "p_hour": 0.93,
        "p_hour_least": 0.89, "labelled_stood": 3, "labelled_stood_and_drove": 1, "cpu_s": 3.0, "commit": None,
        "ended": [{**end, "labels": "drove off"}, {**end, "labels": "stands"}, {**end, "labels": "no label"}],
    }  # fmt: skip
    assert [one[2:] for one in claims([row])] == [("0.890", "**no**"), ("1 of 2", "**no**")]
    good = {**row, "p_hour_least": 0.9, "ended": []}
    assert [one[2:] for one in claims([good])] == [("0.900", "yes")]
    empty = {**row, "sequence": "0017", "p_hour": None, "p_hour_least": None, "ended": []}
    assert "| 0017 | weak | 43 (41) | 0 | 40 | – | – |" in as_markdown([good, empty])
