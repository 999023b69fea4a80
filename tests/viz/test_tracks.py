"""Figure and recording of tracks: what they show are the numbers that they were given."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from evermap.errors import MissingExtraError
from evermap.viz.rerun_scene import log_tracks
from evermap.viz.style import DYNAMIC, STATIC, house_style, new_figure
from evermap_studies.lifetimes.tracks_now import ARROW_S, TracksNow, draw_tracks

POSITION = np.array([[0.0, 1.0, 0.0], [5.0, 2.0, 0.0], [9.0, -3.0, 1.0]])
VELOCITY = np.array([[0.01, 0.0, 0.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
REST = np.array([True, False, True])
RESTING = np.array([[20.0, 20.0, 0.0], [-20.0, 3.0, 0.0]])


@pytest.fixture
def axes():
    with house_style():
        figure = new_figure(4.0, 4.0)
        axes = figure.add_subplot()
        draw_tracks(
            axes,
            TracksNow(POSITION, VELOCITY, REST, RESTING, sensor_m=np.array([1.0, 2.0, 0.0]), reach_m=7.0),
            detected_m=POSITION[:2],
        )
    return axes


def test_marks_stand_where_the_tracklets_are(axes) -> None:
    shown = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(shown["static"].get_xydata(), POSITION[REST, :2])
    np.testing.assert_array_equal(shown["dynamic"].get_xydata(), POSITION[~REST, :2])
    np.testing.assert_array_equal(shown["static, in the working set"].get_xydata(), RESTING[:, :2])
    np.testing.assert_array_equal(shown["detection"].get_xydata(), POSITION[:2, :2])
    assert (shown["static"].get_color(), shown["dynamic"].get_color()) == (STATIC, DYNAMIC)
    assert shown["static, in the working set"].get_markerfacecolor() == "none"


def test_only_what_moves_has_an_arrow_of_its_way(axes) -> None:
    (way,) = [line for line in axes.lines if line.get_label().startswith("_")]
    np.testing.assert_allclose(way.get_xydata(), [POSITION[1, :2], POSITION[1, :2] + ARROW_S * VELOCITY[1, :2]])


def test_the_circle_is_the_reach(axes) -> None:
    (circle,) = axes.patches
    assert (circle.center, circle.radius) == ((1.0, 2.0), 7.0)


def record(path):
    """Three frames: of three tracklets, of none, of one."""
    return log_tracks(
        path,
        stamp_s=np.array([0.0, 0.5, 1.5]),
        track_id=[np.array([4, 7, 9]), np.zeros(0, dtype=np.int64), np.array([7])],
        position_m=[POSITION, np.empty((0, 3)), POSITION[1:2]],
        static=[REST, np.zeros(0, dtype=bool), REST[1:2]],
        resting_m=[RESTING[:0], RESTING, RESTING[:1]],
        sensor_m=np.arange(9.0).reshape(3, 3),
        reach_m=7.0,
    )


@pytest.fixture
def rows(tmp_path):
    reader = pytest.importorskip("rerun.experimental", reason="rerun-sdk is not installed")
    found: dict[str, list] = {}
    for chunk in reader.RrdReader(str(record(tmp_path / "tracks.rrd"))).stream():
        if not chunk.is_static:
            found.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return found


def test_recording_holds_what_was_tracked(rows) -> None:
    active = rows["/world/active"]
    assert [len(row["Points3D:positions"]) for row in active] == [3, 0, 1]
    np.testing.assert_allclose(active[0]["Points3D:positions"], POSITION)
    assert active[0]["Points3D:labels"] == ["4", "7", "9"]
    assert [len(row["Points3D:positions"]) for row in rows["/world/working_set"]] == [0, 2, 1]
    assert [row["Scalars:scalars"] for row in rows["/count/static"]] == [[2.0], [0.0], [0.0]]
    assert [row["Scalars:scalars"] for row in rows["/count/dynamic"]] == [[1.0], [0.0], [1.0]]
    blue, purple = (int(c[1:] + "ff", 16) for c in (STATIC, DYNAMIC))
    assert active[0]["Points3D:colors"] == [blue, purple, blue]


def test_missing_rerun_is_said_in_one_line(tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"evermap\[rerun\]"):
        record(tmp_path / "tracks.rrd")
    assert not (tmp_path / "tracks.rrd").exists()
