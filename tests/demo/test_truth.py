"""What is taken for true against the simulation's own list of events, and what the robot could see of it."""

from __future__ import annotations

import numpy as np
import pytest

from evermap import se2
from evermap.demo import Scenario
from evermap.demo.truth import truth_of
from evermap.sim import BuildingSimulation
from evermap.sim.detect import Scene, in_view


@pytest.fixture(scope="module")
def building() -> BuildingSimulation:
    return Scenario(days=6, change_rate=2.0).simulate(4)


def test_positions_and_changes_are_what_the_events_add_up_to(building: BuildingSimulation) -> None:
    """Replays the events, object by object, from the first session on."""
    truth = truth_of(building)
    pose = {item.object_id: item.home for item in building.objects if item.kind.mount == "wall"}
    begin = {stay.object_id: stay for stay in reversed(building.stays)}
    pose |= {k: stay.pose for k, stay in begin.items() if stay.start_s <= building.truths[0].start_s}
    events = list(building.events)
    before: dict[int, np.ndarray] = {}
    for k, session in enumerate(building.truths):
        while events and events[0].stamp_s <= session.start_s:
            event = events.pop(0)
            if event.pose_after is None:
                pose.pop(event.object_id)
            else:
                pose[event.object_id] = event.pose_after
        now = {
            name: at
            for object_id, where in pose.items()
            for name, at in zip(
                building.objects[object_id].landmark_ids, building.objects[object_id].landmarks_at(where), strict=True
            )
        }
        assert set(np.flatnonzero(truth.there[k])) == set(now)
        for name, at in now.items():
            np.testing.assert_allclose(truth.position_m[k, name], at)
        if k:
            changed = {n for n in now.keys() | before.keys() if not np.array_equal(now.get(n), before.get(n))}
            assert set(np.flatnonzero(truth.changed[k])) == changed
        before = now
    assert truth.changed.sum() > 20
    assert not truth.changed[0].any()


def test_last_place_is_that_of_the_last_session_in_which_it_stood_somewhere(building: BuildingSimulation) -> None:
    truth = truth_of(building)
    seen_away = 0
    for name in range(building.n_landmarks):
        for k in range(len(truth)):
            then = [j for j in range(k + 1) if truth.there[j, name]]
            if then:
                np.testing.assert_array_equal(truth.last_m[k, name], truth.position_m[then[-1], name])
                seen_away += then[-1] < k
            else:
                assert np.isnan(truth.last_m[k, name]).all()
    assert seen_away > 10


def test_met_is_whatever_was_detected_under_its_own_name(building: BuildingSimulation) -> None:
    truth = truth_of(building)
    met: set[int] = set()
    for k, (recording, known) in enumerate(zip(building.sessions, building.truths, strict=True)):
        pairs = zip(recording.detections.landmark_id.tolist(), known.detection_landmark_id.tolist(), strict=True)
        met |= {name for name, really in pairs if name == really >= 0}
        assert set(np.flatnonzero(truth.met[k])) == met


@pytest.mark.parametrize("seed", range(3))
def test_a_lap_passes_all_that_there_is(seed: int) -> None:
    """Nothing is left out of the scores, so everything has to be where the robot can see it."""
    building = Scenario(days=2).simulate(seed)
    sensor = building.config.sensor
    for recording in building.sessions:
        row = np.searchsorted(recording.truth.stamp_s, recording.frames.stamp_s).clip(max=len(recording.truth) - 1)
        pose = se2.compose(recording.truth.pose_world_robot[row], np.array(sensor.mount_robot_sensor))
        scene = Scene(recording.true_landmarks.position_m, recording.true_landmarks.class_id, 0)
        visible, range_m, _ = in_view(pose, scene, building.plan, sensor)
        assert (visible * sensor.detection_probability(range_m)).sum(axis=1).min() > 3.0
