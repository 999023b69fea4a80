"""What is taken for true against the simulation's own list of events, and what of it could be known."""

from __future__ import annotations

import numpy as np
import pytest

from evermap_studies.demo.scenario import Scenario
from evermap_studies.demo.truth import _observed_one, truth_of
from evermap_studies.sim import BuildingSimulation, looked_at


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


def test_seen_is_where_it_was_last_detected_under_its_own_name(building: BuildingSimulation) -> None:
    truth = truth_of(building)
    seen: dict[int, np.ndarray] = {}
    for k, (recording, known) in enumerate(zip(building.sessions, building.truths, strict=True)):
        pairs = zip(recording.detections.landmark_id.tolist(), known.detection_landmark_id.tolist(), strict=True)
        now = {name for name, really in pairs if name == really >= 0}
        assert set(np.flatnonzero(truth.detected[k])) == now
        there = recording.true_landmarks
        seen |= {name: there.position_m[there.landmark_id == name][0] for name in now}
        asked = truth.asked(k)
        assert asked.landmark_id.tolist() == sorted(seen)
        np.testing.assert_allclose(asked.position_m, [seen[name] for name in sorted(seen)])
    assert len(seen) > 40


def test_what_is_known_is_where_it_was_really_looked_at_since_it_came(building: BuildingSimulation) -> None:
    """From the table of looks, session by session, for every landmark by itself."""
    truth, looks = truth_of(building), looked_at(building)
    for name in range(building.n_landmarks):
        for k in range(len(truth)):
            known, j = False, k
            while (
                j >= 0 and truth.there[k, name] and np.array_equal(truth.position_m[j, name], truth.position_m[k, name])
            ):
                row = np.flatnonzero((looks.landmark_id == name) & looks.present[j])
                known |= bool(looks.looked_at[j, row].any())
                j -= 1
            if known:
                assert truth.known[k, name]
            elif truth.known[k, name]:  # it went and came back, or was nudged: where it stands it was seen before
                assert truth.there[k, name]
                gap = np.linalg.norm(truth.position_m[:k, name] - truth.position_m[k, name], axis=1)
                assert np.nanmin(gap) <= 0.25
    assert 0.4 < truth.known.sum() / truth.there.sum() < 0.95


A, B, AWAY = 0, 1, -1


@pytest.mark.parametrize(
    ("stands", "looked", "changes", "known"),
    [
        ([A, A, B, B], [{A, B}] * 4, [(2, 2)], [1, 1, 1, 1]),  # moved
        ([A, AWAY, AWAY, A], [{A}] * 4, [(1, 1), (2, 3)], [1, 0, 0, 1]),  # left and came back
        ([AWAY, AWAY, A, A], [{A}] * 4, [(2, 2)], [0, 0, 1, 1]),  # came to a place that had been seen empty
        ([AWAY, AWAY, A, A], [{B}, {B}, {A}, {A}], [], [0, 0, 1, 1]),  # first seen where nobody had looked
        ([A, AWAY, AWAY, AWAY], [{A}, set(), {B}, {A}], [(1, 3)], [1, 0, 0, 0]),  # gone unseen, until it was looked at
        ([A, B, B, B], [{A}, set(), set(), {B}], [(1, 3)], [1, 0, 0, 1]),  # found elsewhere, its old place unseen
        ([A, B, A, A], [{A}, set(), {A}, {A, B}], [], [1, 0, 1, 1]),  # away and back between two looks
        ([A, B, B, B], [{A}, {A}, {B}, {B}], [(1, 1), (2, 2)], [1, 0, 1, 1]),  # missing, then found elsewhere
        ([A, A, A, A], [{A}, {B}, set(), {A}], [], [1, 1, 1, 1]),  # nothing happened
    ],
)
def test_changes_that_can_be_known(stands, looked, changes, known) -> None:
    """One landmark, two places 2 m apart, four sessions."""
    present = np.array([[where == place for place in (A, B)] for where in stands])
    seen = np.array([[place in places for place in (A, B)] for places in looked])
    is_known, found = _observed_one(present, seen, np.array([[0.0, 0.0], [2.0, 0.0]]))
    assert found == changes
    assert is_known.astype(int).tolist() == known


def test_changes_that_can_be_known_have_happened(building: BuildingSimulation) -> None:
    truth = truth_of(building)
    assert len(truth.knowable) > 20
    for name, first, k, until in truth.knowable.tolist():
        assert truth.changed[: k + 1, name].any()
        assert first <= k < until <= len(truth)
        assert truth.detected[:, name].any() or not truth.there[k, name]
