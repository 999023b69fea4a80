"""Landmarks of a given map in space that moved together before the session: told as one, with one motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap import run_slam
from evermap.types import ChangeKind, Landmarks, SlamResult, rows_of

from .corridors import World, tagged_corridor

SHELF = np.array([4, 5, 6, 7])


def before(tags: Landmarks, members: np.ndarray, shift: np.ndarray, turn: np.ndarray) -> Landmarks:
    """The map as it was before some tags turned about their centroid and were shifted."""
    position, rotation = tags.position_m.copy(), tags.rotation.copy()
    back, centre = Rotation.from_rotvec(turn).inv(), position[members].mean(axis=0)
    position[members] = back.apply(position[members] - centre) + centre - shift
    rotation[members] = (back * Rotation.from_quat(rotation[members])).as_quat()
    return replace(tags.as_prior(0.01), position_m=position, rotation=rotation)


def as_points(tags: Landmarks) -> Landmarks:
    """The same map without orientations."""
    return Landmarks.in_space(tags.landmark_id, tags.position_m).as_prior(0.01)


def gap_m(result: SlamResult, world: World) -> np.ndarray:
    """By how much the robot is off, in the frame of the map."""
    row = np.searchsorted(world.recording.frames.stamp_s, result.trajectory.stamp_s - 1e-6)
    return np.linalg.norm(result.trajectory.pose_world_robot[:, :3] - world.true_pose[row, :3], axis=1)


@pytest.mark.parametrize("turn", [pytest.param((0.0, 0.0, 0.0), marks=pytest.mark.slow), (0.0, 0.1, 0.4)])
@pytest.mark.parametrize(
    ("seed", "odometry", "points"),
    [*(pytest.param(seed, True, False, marks=pytest.mark.slow) for seed in (0, 3)), (5, True, True)],
)
def test_a_shelf_with_four_tags_moved_as_one(seed, odometry, points, turn):
    world, shift = tagged_corridor(seed, odometry=odometry, drift=0.04), np.array([0.4, 0.0, 0.2])
    known = before(world.tags, SHELF, shift, np.array(turn))
    result = run_slam(world.recording, prior_map=as_points(known) if points else known)
    (change,) = result.changes
    assert change.landmark_ids == tuple(SHELF)
    assert change.kind is (ChangeKind.ROTATED if any(turn) else ChangeKind.MOVED)
    assert change.probability > 0.9
    assert change.n_hits > 50
    # as sure as one of its places is, and the map where the others stand
    own = result.landmarks.covariance_m2[np.isin(result.landmarks.landmark_id, SHELF)].mean(axis=0)
    off = np.array(change.displacement_m) - shift
    assert off @ np.linalg.solve(own + 0.01**2 * np.eye(3), off) < 3.0**2 + 3.0
    assert change.rotation_rad == pytest.approx(np.linalg.norm(turn), abs=0.03)


def test_without_odometry_no_group_is_told():
    """The frames that see a part of a map alone may as well be elsewhere: each place is asked by itself."""
    world = tagged_corridor(3, odometry=False)
    known = before(world.tags, SHELF, np.array([0.4, 0.0, 0.2]), np.zeros(3))
    told = [change.landmark_ids for change in run_slam(world.recording, prior_map=known).changes]
    assert sorted(told) == [(tag,) for tag in SHELF]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 3))])
def test_a_moved_shelf_that_is_alone_in_view_draws_the_robot_nowhere(seed):
    """For a while the robot sees nothing else: tag by tag, each is where the map has it beside the others."""
    world = tagged_corridor(seed, drift=0.02)
    seen = world.recording.detections
    recording = replace(world.recording, detections=rows_of(seen, ~np.isin(seen.landmark_id, [3, 8])))
    known = before(world.tags, SHELF, np.array([0.4, 0.0, 0.2]), np.zeros(3))
    result = run_slam(recording, prior_map=known)
    (moved,) = (change for change in result.changes if change.kind is not ChangeKind.VANISHED)
    assert moved.landmark_ids == tuple(SHELF)
    assert moved.displacement_m == pytest.approx((0.4, 0.0, 0.2), abs=0.05)
    assert moved.probability == pytest.approx(0.8, abs=0.05)  # four of ten, or the other six
    assert {change.landmark_ids for change in result.changes} <= {tuple(SHELF), (3,), (8,)}
    assert gap_m(result, world).max() < 0.1


@pytest.mark.slow
def test_single_tags_that_moved_are_no_group():
    world = tagged_corridor(0, drift=0.04)
    known, none = world.tags, np.zeros(3)
    for tag, shift, turn in ((2, [0.2, 0, 0], none), (5, [1.6, 0, 0.9], none), (9, [0, 0, -0.6], [0, 0.5, 0])):
        known = before(known, np.array([tag]), np.array(shift), np.array(turn))
    told = {change.landmark_ids: change for change in run_slam(world.recording, prior_map=known).changes}
    assert told.keys() == {(2,), (5,), (9,)}
    assert min(change.probability for change in told.values()) > 0.99
    assert told[9,].rotation_rad == pytest.approx(0.5, abs=0.03)


@pytest.mark.slow
def test_two_tags_that_were_exchanged_are_each_where_the_other_was():
    world, order = tagged_corridor(3, drift=0.04), np.arange(12)
    order[[2, 9]] = 9, 2
    known = replace(
        world.tags.as_prior(0.01), position_m=world.tags.position_m[order], rotation=world.tags.rotation[order]
    )
    result = run_slam(world.recording, prior_map=known)
    told = {change.landmark_ids: np.array(change.displacement_m) for change in result.changes}
    assert told.keys() == {(2,), (9,)}
    np.testing.assert_allclose(told[2,], -told[9,], atol=0.05)


@pytest.mark.parametrize(
    "seed", [301, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (300, *range(302, 310)))]
)
def test_nothing_is_told_where_nothing_moved(seed):
    random = np.random.default_rng(seed)
    world = tagged_corridor(seed, drift=0.04 if seed % 3 else 0.01, p_wrong=0.03 * (seed % 2), odometry=seed % 4 > 0)
    surveyed = world.tags.as_prior(0.02)
    surveyed = replace(surveyed, position_m=surveyed.position_m + random.normal(0.0, 0.02, (12, 3)))
    assert not run_slam(world.recording, prior_map=surveyed).changes
