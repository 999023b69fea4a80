"""The building, what stands in it, and how that changes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from evermap_studies.sim import BuildingConfig, Duration, EventKind, ObjectClass, simulate_building
from evermap_studies.sim.building import ROUTE_CLEARANCE_M
from evermap_studies.sim.changes import Timeline
from evermap_studies.sim.config import DAY_S
from evermap_studies.sim.patrol import patrol_route

SHORT = BuildingConfig(days=6, patrol_s=5.0)


def crosses(a, b, c, d) -> bool:
    """Whether the segments a-b and c-d cross: each has the other's ends on different sides."""

    def side(p, q, r) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 5))])
def test_everything_stands_inside_and_clear_of_the_route(seed):
    simulation = simulate_building(SHORT, seed)
    plan = simulation.plan
    route = np.concatenate([patrol_route(plan), patrol_route(plan, reverse=True)])
    for stay in simulation.stays:
        item = simulation.objects[stay.object_id]
        position = item.landmarks_at(stay.pose)
        assert np.all((position > 0.0) & (position < [plan.length_m, plan.depth_m]))
        gap = np.linalg.norm(position[:, None] - route[None], axis=-1).min()
        if item.kind.mount == "floor":
            assert gap > ROUTE_CLEARANCE_M - 0.01
            assert len({plan.room_of(point) for point in position}) == 1  # no object stands across a wall
            assert plan.room_of(position[0]) >= 0
        else:
            assert gap > 0.3


def test_objects_of_day_zero_do_not_overlap():
    simulation = simulate_building(SHORT, 3)
    first = [item for item in simulation.objects if item.kind.mount == "floor"]
    first = [item for item in first if simulation.stays[[s.object_id for s in simulation.stays].index(item.object_id)]
             .start_s == SHORT.first_day_unix_s]  # fmt: skip
    assert len(first) == 23
    for i, a in enumerate(first):
        for b in first[:i]:
            assert math.dist(a.home[:2], b.home[:2]) >= a.radius_m + b.radius_m


def test_landmark_ids_are_unique_and_belong_to_one_object_each():
    simulation = simulate_building(SHORT, 1)
    ids = [i for item in simulation.objects for i in item.landmark_ids]
    assert ids == list(range(simulation.n_landmarks))
    assert [item.object_id for item in simulation.objects] == list(range(len(simulation.objects)))
    for item in simulation.objects:
        fewest, most = item.kind.landmarks
        assert fewest <= len(item.landmark_ids) <= most


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_events_replayed_give_the_landmarks_of_every_session(seed):
    """Day 0 and the events alone, replayed by an independent rule, tell what every session's truth says."""
    config = replace(SHORT, days=12, change_rate=2.0)
    simulation = simulate_building(config, seed)
    pose = {}
    appeared = {event.object_id for event in simulation.events if event.kind is EventKind.APPEARED}
    for item in simulation.objects:
        if item.object_id not in appeared:
            pose[item.object_id] = item.home
    events = list(simulation.events)
    assert [event.stamp_s for event in events] == sorted(event.stamp_s for event in events)
    for recording, truth in zip(simulation.sessions, simulation.truths, strict=True):
        while events and events[0].stamp_s <= truth.start_s:
            event = events.pop(0)
            assert pose.get(event.object_id) == event.pose_before or event.kind is EventKind.RETURNED
            if event.pose_after is None:
                assert event.kind is EventKind.VANISHED
                del pose[event.object_id]
            else:
                pose[event.object_id] = event.pose_after
        expected = {}
        for object_id, (x, y, theta) in pose.items():
            item = simulation.objects[object_id]
            for landmark, (u, v) in zip(item.landmark_ids, item.offset_m, strict=True):
                z = complex(x, y) + np.exp(1j * theta) * complex(u, v)
                expected[landmark] = (z.real, z.imag)
        landmarks = recording.true_landmarks
        assert sorted(expected) == landmarks.landmark_id.tolist()
        np.testing.assert_allclose(landmarks.position_m, [expected[i] for i in sorted(expected)], atol=1e-12)
        # the world stands still while the robot looks
        assert not any(truth.start_s <= event.stamp_s < truth.end_s for event in simulation.events)


def test_events_say_what_they_mean():
    simulation = simulate_building(replace(SHORT, days=30), 5)
    seen = {event.kind for event in simulation.events}
    assert seen == set(EventKind)
    moves = [event.displacement_m for event in simulation.events if event.kind is EventKind.MOVED]
    assert min(moves) > 0.0
    back = np.array([event.displacement_m for event in simulation.events if event.kind is EventKind.RETURNED])
    assert (back == 0.0).any()
    assert (back > 0.3).any()
    for event in simulation.events:
        item = simulation.objects[event.object_id]
        assert event.landmark_ids == item.landmark_ids
        assert event.class_name == item.kind.name
        if event.kind in (EventKind.OPENED, EventKind.CLOSED):
            # the handle travels a quarter circle's chord
            assert item.kind.mount == "hinge"
            assert event.displacement_m == pytest.approx(item.kind.size_m[0] * math.sqrt(2.0))
        if item.kind.mount == "wall":
            pytest.fail("a wall marker changed")


def test_doors_have_two_positions():
    simulation = simulate_building(replace(SHORT, days=30), 2)
    for item in simulation.objects:
        if item.kind.mount == "hinge":
            stays = [stay for stay in simulation.stays if stay.object_id == item.object_id]
            assert len({stay.pose for stay in stays}) == 2
            assert all(a.is_open != b.is_open for a, b in itertools.pairwise(stays))
            assert all(a.end_s == b.start_s for a, b in itertools.pairwise(stays))


@pytest.mark.parametrize("shape", [1.0, 3.0])
def test_lifetimes_follow_their_distribution(shape):
    """First stays are drawn at the same time for all objects and never cut: an unbiased sample of the lifetime."""
    mean_days = 2.5
    kind = ObjectClass("box", count=40, landmarks=(1, 1), size_m=(0.2, 0.2), stay=Duration(mean_days, shape))
    lengths = []
    for seed in range(10):
        simulation = simulate_building(BuildingConfig(days=1, patrol_s=5.0, classes=(kind,)), seed)
        first = {}
        for stay in simulation.stays:
            first.setdefault(stay.object_id, stay.end_s - stay.start_s)
        lengths += list(first.values())
    assert len(lengths) == 400
    reference = stats.gamma(shape, scale=mean_days * DAY_S / shape)
    assert stats.kstest(lengths, reference.cdf).pvalue > 0.01


def test_absences_and_outcomes_follow_their_distributions():
    kind = ObjectClass(
        "box", count=30, landmarks=(1, 1), size_m=(0.2, 0.2), stay=Duration(1.0), absence=Duration(0.5, 2.0),
        p_vanish=0.4, p_return=1.0, p_same_place=0.7,
    )  # fmt: skip
    simulation = simulate_building(BuildingConfig(days=36, patrol_s=5.0, rooms_per_side=2, classes=(kind,)), 0)
    by_object = {}
    for stay in simulation.stays:
        by_object.setdefault(stay.object_id, []).append(stay)
    pairs = [pair for stays in by_object.values() for pair in itertools.pairwise(stays)]
    # leave out the end of the month, where long absences have not ended yet
    pairs = [(a, b) for a, b in pairs if a.end_s < BuildingConfig().first_day_unix_s + 28 * DAY_S]
    absences = [(a, b) for a, b in pairs if a.end_s < b.start_s]
    assert (
        stats.kstest([b.start_s - a.end_s for a, b in absences], stats.gamma(2.0, scale=0.25 * DAY_S).cdf).pvalue > 0.01
    )
    assert stats.binomtest(len(absences), len(pairs), 0.4).pvalue > 0.01
    same = sum(a.pose == b.pose for a, b in absences)
    assert stats.binomtest(same, len(absences), 0.7).pvalue > 0.01


def test_rate_of_change_scales_the_number_of_events():
    """Doors swing as a renewal process, so the count over a month is Poisson with the configured rate."""
    kind = ObjectClass("door", "hinge", count=6, landmarks=(1, 1), size_m=(0.9, 0.05), stay=Duration(1.0))
    for rate in (0.5, 2.0):
        config = BuildingConfig(days=40, patrol_s=5.0, change_rate=rate, classes=(kind,))
        simulation = simulate_building(config, 4)
        span_days = (simulation.truths[-1].end_s - config.first_day_unix_s) / DAY_S
        mean = 6 * rate * span_days
        assert abs(len(simulation.events) - mean) < 3.5 * math.sqrt(mean)


def test_without_changes_nothing_happens():
    simulation = simulate_building(replace(SHORT, change_rate=0.0), 0)
    assert simulation.events == ()
    first = simulation.sessions[0].true_landmarks
    for recording in simulation.sessions[1:]:
        np.testing.assert_array_equal(recording.true_landmarks.position_m, first.position_m)
    np.testing.assert_array_equal(first.position_m, simulate_building(SHORT, 0).landmarks_at(
        SHORT.first_day_unix_s).position_m)  # fmt: skip


def test_changes_during_a_session_wait_for_its_end():
    timeline = Timeline(0.0, 100.0, np.array([[10.0, 20.0], [50.0, 60.0]]))
    assert [timeline.defer(t) for t in (0.0, 9.9, 10.0, 15.0, 20.0, 30.0, 55.0, 99.0)] == [
        0.0, 9.9, 20.0, 20.0, 20.0, 30.0, 60.0, 99.0,
    ]  # fmt: skip


def test_line_of_sight_against_brute_force():
    simulation = simulate_building(SHORT, 0)
    rng = np.random.default_rng(0)
    start, end = rng.uniform([0.1, 0.1], [27.9, 14.9], (2, 400, 2))
    walls = simulation.plan.walls_m
    expected = [not any(crosses(a, b, w[0], w[1]) for w in walls) for a, b in zip(start, end, strict=True)]
    seen = simulation.plan.line_of_sight(start, end)
    assert seen.tolist() == expected
    assert 0.05 < seen.mean() < 0.95
