"""Trackers and their tables show themselves: short texts, data frames, pictures."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import evermap as em
from evermap.errors import MissingExtraError
from evermap.tracking.record import Recorder
from evermap.tracking.views import View


@pytest.fixture(scope="module")
def watched() -> tuple[em.Tracker, Recorder]:
    """One object that stays, and one that moves along x."""
    tracker, recorder = em.Tracker(), Recorder()
    for k in range(60):
        places = np.array([[0.0, 3.0, 0.0], [0.1 * k, 0.0, 1.0]])
        _, events = tracker.step(0.1 * k, places, view=View.ball(np.zeros(3), 20.0, 0.9))
        recorder.add(tracker.followed(), events)
    return tracker, recorder


def test_texts_are_short_and_say_what_counts(watched: tuple[em.Tracker, Recorder]) -> None:
    tracker, recorder = watched
    assert repr(tracker) == "Tracker(stamp_s=5.9, birth=0, alive=2, lost=0, working_set=0, objects_ever=2)"
    assert repr(em.Tracker()) == "Tracker(birth=0, alive=0, lost=0, working_set=0, objects_ever=0)"
    assert repr(recorder.tracks()) == "Tracks(rows=120, objects=2)"
    for shown in (tracker, recorder.tracks(), tracker.followed(), tracker.static_spells()):
        assert len(repr(shown)) < 1000
        assert "<table>" in shown._repr_html_()


def test_tables_become_data_frames(watched: tuple[em.Tracker, Recorder]) -> None:
    pytest.importorskip("pandas")
    tracker, recorder = watched
    tracks = recorder.tracks()
    frame = tracks.to_pandas()
    assert len(frame) == 120
    np.testing.assert_array_equal(frame[["x_m", "y_m", "z_m"]].to_numpy(), tracks.position_m)
    np.testing.assert_array_equal(frame[["vx_mps", "vy_mps", "vz_mps"]].to_numpy(), tracks.velocity_mps)
    assert set(frame["state"]) == {"birth", "alive"}
    assert tracker.to_pandas()["static"].sum() == 1
    spells = tracker.static_spells().to_pandas()
    assert spells["class_id"].tolist() == [0] * len(spells)


def test_a_missing_pandas_is_said_in_a_line(
    watched: tuple[em.Tracker, Recorder], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pandas") as error:
        watched[0].to_pandas()
    assert "\n" not in str(error.value)


def test_a_tracker_draws_what_it_follows(watched: tuple[em.Tracker, Recorder]) -> None:
    axes = watched[0].plot().axes[0]
    labels = axes.get_legend_handles_labels()[1]
    assert labels == ["at rest", "moving"]
    assert axes.get_xlabel() == "x [m]"
    assert not em.Tracker().plot().axes[0].lines
