"""The five states and what leads from one to another (Bateman 2020, section 4.1)."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import TrackerConfig
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import EventKind, TrackState
from evermap.tracking.views import View

from .observer import kinds, look

NOTHING = np.empty((0, 3))
ONE = np.array([[1.0, 2.0, 0.5]])


def states(tracker: Tracker) -> list[TrackState]:
    return [TrackState(s) for s in tracker.followed().state]


def test_birth_lasts_as_long_as_the_warm_up() -> None:
    tracker = Tracker(TrackerConfig(warm_up=4))
    for k in range(3):
        assert look(tracker, 0.1 * k, 1, ONE) == []
        assert states(tracker) == [TrackState.BIRTH]
    events = look(tracker, 0.3, 1, ONE)
    assert kinds(events) == [EventKind.BORN]
    assert states(tracker) == [TrackState.ALIVE]


def test_a_false_alarm_dies_unheard() -> None:
    tracker = Tracker()
    events = look(tracker, 0.0, 1, ONE) + look(tracker, 0.1, 5, NOTHING)
    assert events == []
    assert len(tracker) == 0


def test_belief_is_the_persistence_filters() -> None:
    """After a detection it is the product of prior odds and likelihood ratios, worked out by hand."""
    tracker = Tracker(TrackerConfig(vanish_rate_hz=1.0, clutter_per_m3=1e-2, p_real=0.4))
    tracker.step(0.0, ONE)
    odds = 0.6 / 0.4
    assert tracker.followed().p_exists[0] == pytest.approx(0.4)
    q = np.exp(-0.1)
    odds = (odds + (1 - q)) / q / (1 - 0.9)
    tracker.step(0.1, NOTHING)
    assert tracker.followed().p_exists[0] == pytest.approx(1 / (1 + odds))
    position_variance = 2 * 0.09 + 1.0 * 0.2**2 + 0.25 * 0.2**4 / 4 + _jerk_noise()
    density = (2 * np.pi * position_variance) ** -1.5
    tracker.step(0.2, ONE)
    odds = (odds + (1 - q)) / q * 1e-2 / (0.9 * density)
    assert tracker.followed().p_exists[0] == pytest.approx(1 / (1 + odds))


def _jerk_noise() -> float:
    return 0.1 * 0.2**5 / 20.0


def test_lost_and_found() -> None:
    tracker = Tracker(TrackerConfig(lost_after=3, max_missed=10))
    look(tracker, 0.0, 30, ONE)
    assert look(tracker, 3.0, 2, NOTHING) == []
    assert kinds(look(tracker, 3.2, 1, NOTHING)) == [EventKind.LOST]
    assert states(tracker) == [TrackState.LOST]
    assert kinds(look(tracker, 3.3, 1, ONE)) == [EventKind.FOUND]
    assert states(tracker) == [TrackState.ALIVE]


def test_a_static_one_is_stored_and_found_again() -> None:
    tracker = Tracker()
    look(tracker, 0.0, 30, ONE)
    name = tracker.followed().track_id[0]
    events = look(tracker, 3.0, 11, NOTHING)
    assert kinds(events) == [EventKind.LOST, EventKind.STORED]
    assert (len(tracker), len(tracker.working_set)) == (0, 1)
    ids, events = tracker.step(5000.0, ONE + 0.1)
    assert kinds(events) == [EventKind.REIDENTIFIED]
    assert ids.tolist() == [name]
    assert (len(tracker), len(tracker.working_set)) == (1, 0)
    assert states(tracker) == [TrackState.ALIVE]


def test_a_fast_one_dies() -> None:
    tracker = Tracker()
    for k in range(40):
        tracker.step(0.1 * k, ONE + [0.15 * k, 0.0, 0.0])  # 1.5 m/s
    assert not tracker.followed().static[0]
    events = look(tracker, 4.0, 11, NOTHING)
    assert kinds(events) == [EventKind.LOST, EventKind.DIED]
    assert (len(tracker), len(tracker.working_set)) == (0, 0)


def test_the_class_decides_what_is_fast() -> None:
    tracker = Tracker(TrackerConfig(class_speed_mps=(0.5, 5.0)), n_classes=2)
    for k in range(40):
        both = np.array([[0.15 * k, 0.0, 0.0], [0.15 * k, 50.0, 0.0]])
        tracker.step(0.1 * k, both, [0, 1])
    events = look(tracker, 4.0, 11, NOTHING)
    assert kinds(events)[2:] == [EventKind.DIED, EventKind.STORED]


def test_what_should_be_seen_and_is_not_dies(here: View, elsewhere: View) -> None:
    tracker = Tracker(TrackerConfig(judge_every_s=1.0))
    look(tracker, 0.0, 30, ONE, view=here)
    look(tracker, 3.0, 11, NOTHING, view=elsewhere)
    assert len(tracker.working_set) == 1  # not seen because not to be seen
    events = [e for k in range(3) for e in tracker.step(100.0 + k, NOTHING, view=elsewhere)[1]]
    assert events == []
    events = [e for k in range(12) for e in tracker.step(200.0 + k, NOTHING, view=here)[1]]
    assert kinds(events) == [EventKind.DIED]
    assert len(tracker.working_set) == 0


def test_looks_closer_together_than_a_judgement_count_once(here: View, elsewhere: View) -> None:
    def survives(step_s: float) -> int:
        tracker = Tracker(TrackerConfig(judge_every_s=1.0))
        look(tracker, 0.0, 30, ONE, view=here)
        look(tracker, 3.0, 11, NOTHING, view=elsewhere)
        for k in range(12):
            tracker.step(200.0 + step_s * k, NOTHING, view=here)
        return len(tracker.working_set)

    assert (survives(0.01), survives(1.0)) == (1, 0)


def test_an_active_one_in_view_dies_sooner_than_it_is_given_up(here: View) -> None:
    tracker = Tracker(TrackerConfig(max_missed=100))
    look(tracker, 0.0, 50, ONE, view=here)
    events = look(tracker, 5.0, 20, NOTHING, view=here)
    assert kinds(events) == [EventKind.LOST, EventKind.DIED]
    assert len(tracker) == 0


def test_states_are_those_of_the_enumeration_in_the_kernels() -> None:
    assert [s.name for s in TrackState] == ["BIRTH", "ALIVE", "LOST", "WORKING_SET", "DEAD"]
