"""Drives through a tagged corridor: where robot and tags are, what is wrong with identities, and with a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap import Config, run_slam
from evermap.config import SpaceConfig
from evermap.errors import DataError
from evermap.geometry import se3
from evermap.metrics.summary import compare_with_truth
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.space.estimate import converge
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.repair import repaired
from evermap.slam.space.solve import solve_space
from evermap.types import ChangeKind, Frames, Landmarks, SlamResult, SpatialSensor, rows_of

from .corridors import World, as_directions, tagged_corridor
from .halls import hall


def errors(result: SlamResult, world: World) -> tuple[float, float]:
    """Position RMSE of robot and of tags, with the frame of the result aligned where it is its own."""
    found = compare_with_truth(world.recording, result, rate_hz=10.0)
    assert found.poses is not None
    robot = float(np.sqrt(np.mean(found.poses.position_error_m**2)))
    assert found.landmarks is not None
    return robot, float(found.landmarks.rmse_m)


def moved(tags: Landmarks, shift: dict[int, tuple[float, float, float]]) -> Landmarks:
    """The map before some tags were moved by `shift`."""
    position = tags.position_m.copy()
    for tag, by in shift.items():
        position[tag] -= by
    return replace(tags.as_prior(0.01), position_m=position)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_drive_with_odometry_is_mapped_from_scratch(seed):
    world = tagged_corridor(seed, drift=0.03)
    result = run_slam(world.recording)
    robot, tags = errors(result, world)
    dead = compare_with_truth(world.recording, result, rate_hz=10.0).dead_reckoning
    assert dead is not None
    assert robot < 0.3 * float(np.sqrt(np.mean(dead.position_error_m**2)))
    assert robot < 0.06
    assert tags < 0.06
    assert result.trajectory.frame == "first_pose"
    assert result.landmarks.rotation is not None


@pytest.mark.slow
def test_a_wrong_metre_of_the_odometry_is_found_where_it_is_not_believed():
    config, off, wrong = Config(slam={"space": {"scale_sigma": 0.03}}), [], []
    for seed in range(6):
        world = tagged_corridor(seed, drift=0.03)
        odometry = world.recording.odometry
        longer = replace(odometry, pose_world_robot=odometry.pose_world_robot * ([1.04] * 3 + [1.0] * 4))
        recording = replace(world.recording, odometry=longer)
        found = run_slam(recording, config)
        scale = next(one for one in found.parameters if one.name == "odometry_scale")
        off.append((scale.value * 1.04 - 1.0) / scale.sigma)
        wrong.append([errors(one, world)[1] for one in (found, run_slam(recording))])
    assert np.mean(np.square(off)) < 2.5
    found, believed = np.median(wrong, axis=0)
    assert found < 0.7 * believed


@pytest.mark.parametrize(("differs", "bounds"), [(0.0, (1.0, 2.5)), (0.04, (4.0, 100.0))])
def test_a_scale_that_differs_along_the_drive_is_worth_little(differs, bounds):
    world = tagged_corridor(1, drift=0.01)
    odometry = world.recording.odometry
    pose = odometry.pose_world_robot
    step = se3.between(pose[:-1], pose[1:])
    part = np.arange(len(step)) * 10 // len(step)
    step[:, :3] *= 1.0 + differs * (-1.0) ** part[:, None]
    driven = [pose[0]]
    for one in step:
        driven.append(se3.compose(driven[-1], one))
    recording = replace(world.recording, odometry=replace(odometry, pose_world_robot=np.array(driven)))
    optimum = solve_space(prepare_space(recording, SpaceConfig()), None).optimum
    smoother = optimum.smoother
    variance, worth = smoother.worth_by_stretches(optimum.now, -1)
    border = smoother.factorised(optimum.now).border_covariance()
    assert variance == pytest.approx(border[-1, -1], rel=1e-9)
    assert bounds[0] <= worth < bounds[1]


def test_a_robot_that_stands_says_nothing_of_its_odometry():
    world = tagged_corridor(2)
    count = len(world.recording.frames)
    seen = world.recording.detections
    first = rows_of(seen, np.flatnonzero(seen.frame == seen.frame[0]))
    many = np.repeat(np.arange(len(first)), count)
    still = replace(rows_of(first, many), frame=np.tile(np.arange(count), len(first)))
    still = rows_of(still, np.argsort(still.frame, kind="stable"))
    odometry = world.recording.odometry
    pose = np.tile(odometry.pose_world_robot[:1], (len(odometry), 1))
    found = run_slam(replace(world.recording, detections=still, odometry=replace(odometry, pose_world_robot=pose)))
    scale = next(one for one in found.parameters if one.name == "odometry_scale")
    assert scale.value == pytest.approx(1.0, abs=1e-3)
    assert scale.prior_sigma == 0.005


def test_a_wrong_identity_alone_in_view_is_no_place_of_the_robot():
    """Two jumps of the odometry explain it, from which no descent leads back."""
    world = tagged_corridor(5)
    seen, middle = world.recording.detections, len(world.recording.frames) // 2
    alone = np.flatnonzero(seen.frame == middle)[0]
    names = seen.landmark_id.copy()
    tags = world.tags
    away = np.linalg.norm(tags.position_m - tags.position_m[tags.landmark_id == names[alone]], axis=1)
    names[alone] = tags.landmark_id[np.argsort(away)[1]]  # its neighbour
    kept = (np.abs(seen.frame - middle) > 2) | (np.arange(len(names)) == alone)
    recording = replace(world.recording, detections=rows_of(replace(seen, landmark_id=names), kept))
    intake = prepare_space(recording, SpaceConfig())
    middle = int(np.searchsorted(intake.pose_frame, middle))  # frames around it saw nothing
    optimum = solve_space(intake, None).optimum
    problem, true = optimum.smoother.problem, optimum.estimate.pose
    row = int(np.flatnonzero(problem.pose_row == middle)[0])
    sensed = se3.compose(optimum.estimate.mount(problem)[problem.sensor[row]], problem.measured[row])
    pose = true.copy()
    pose[middle] = se3.compose(optimum.estimate.place[problem.place[row]], se3.inverse(sensed))
    astray = converge(problem, replace(optimum.estimate, pose=pose), optimum.noise, heavy_rounds=0)
    assert np.linalg.norm(astray.estimate.pose[middle, :3] - true[middle, :3]) > 1.0
    assert (astray.now.odometry_weight < 0.5).sum() == 2
    found = repaired(astray)
    assert np.linalg.norm(found.estimate.pose[middle, :3] - true[middle, :3]) < 0.01
    assert found.now.cost < astray.now.cost


def test_noise_levels_are_those_of_the_world():
    world = tagged_corridor(3, sigma_px=0.5, drift=0.04)
    levels = {p.name: p.value for p in run_slam(world.recording).parameters}
    assert levels["sigma_corner_px"] == pytest.approx(0.5, rel=0.1)
    assert levels["sigma_odometry_m"] == pytest.approx(0.04, rel=0.35)


def test_wrong_identities_are_outliers():
    world = tagged_corridor(4, p_wrong=0.05, drift=0.03)
    robot, tags = errors(run_slam(world.recording), world)
    assert robot < 0.04
    assert tags < 0.04


def test_without_odometry_a_map_is_enough():
    world = tagged_corridor(5, odometry=False)
    result = run_slam(world.recording, prior_map=world.tags.as_prior(0.01))
    off = result.trajectory.pose_world_robot
    rows = np.searchsorted(world.recording.frames.stamp_s, result.trajectory.stamp_s)
    gap = np.linalg.norm(off[:, :3] - world.true_pose[rows, :3], axis=1)
    assert np.median(gap) < 0.04  # one tag in view: a pixel of it is 5 mrad
    assert np.mean(gap < 0.2) > 0.98
    assert len(result.dead_reckoning) == 0
    assert not result.changes


def test_two_tags_with_one_identity_are_two_landmarks():
    world = tagged_corridor(6, rename={10: 1})
    result = run_slam(world.recording)
    called = {result.landmarks.names.get(int(i), str(i)) for i in result.landmarks.landmark_id}
    assert "1#2" in called
    assert any("1#2" in warning for warning in result.warnings)
    at = {
        result.landmarks.names.get(int(i), str(i)): p
        for i, p in zip(result.landmarks.landmark_id, result.landmarks.position_m, strict=True)
    }
    apart = np.linalg.norm(world.tags.position_m[10] - world.tags.position_m[1])
    assert np.linalg.norm(at["1#2"] - at["1"]) == pytest.approx(apart, abs=0.1)


def test_points_without_odometry_locate_the_robot_where_three_are_in_view():
    random = np.random.default_rng(9)
    world = tagged_corridor(8, odometry=False)
    n, count = len(world.true_pose), 20
    point = np.column_stack([random.uniform(0.0, 15.0, count), *random.uniform(-3.0, 3.0, (2, count))])
    frame, place = np.nonzero(np.abs(world.true_pose[:, None, 0] - point[:, 0]) < 4.0)
    turn = Rotation.from_quat(world.true_pose[frame, 3:])
    seen = turn.inv().apply(point[place] - world.true_pose[frame, :3]) + random.normal(0.0, 0.02, (len(frame), 3))
    rows, unsaid = len(frame), np.full(len(frame), np.nan)
    detections = replace(
        world.recording.detections,
        frame=frame,
        sensor=np.zeros(rows, dtype=np.int64),
        landmark_id=place,
        position_sensor_m=seen,
        rotation=np.full((rows, 4), np.nan),
        covariance_sensor_m2=np.full((rows, 3, 3), np.nan),
        sigma_rad=unsaid,
        corner_px=np.full((rows, 4, 2), np.nan),
        tag_size_m=unsaid,
        size_m=np.full((rows, 3), np.nan),
        class_id=np.full(rows, -1),
        score=unsaid,
        source_line=np.zeros(rows, dtype=np.int64),
    )
    recording = replace(world.recording, detections=detections, sensors=(SpatialSensor(sigma_m=0.02),))
    result = run_slam(recording, prior_map=Landmarks.in_space(np.arange(count), point).as_prior(0.01))
    assert len(result.trajectory) == n
    gap = np.linalg.norm(result.trajectory.pose_world_robot[:, :3] - world.true_pose[:, :3], axis=1)
    assert np.max(gap) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("odometry", [True, False])
def test_a_wrong_map_is_told_where_it_is_wrong(odometry):
    world = tagged_corridor(7, odometry=odometry)
    shift = {3: (0.3, 0.0, 0.0), 8: (0.0, -0.1, 0.4)}
    result = run_slam(world.recording, prior_map=moved(world.tags, shift))
    told = {change.landmark_ids[0]: change for change in result.changes}
    assert told.keys() == shift.keys()
    for tag, by in shift.items():
        assert told[tag].displacement_m == pytest.approx(by, abs=0.06)
        assert told[tag].probability > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 14])
def test_what_was_moved_by_metres_draws_no_others_along(seed):
    """Nor is it another landmark of its identity. The others are moved by less, or not."""
    world = tagged_corridor(seed, drift=0.04, p_wrong=0.03, odometry=seed != 11)
    shift = {5: (1.6, 0.0, 0.9), 2: (0.2, 0.0, 0.0), 9: (0.0, 0.0, -0.6)}
    result = run_slam(world.recording, prior_map=moved(world.tags, shift))
    told = {change.landmark_ids[0]: change for change in result.changes}
    assert told.keys() == shift.keys()
    for tag, by in shift.items():
        assert told[tag].displacement_m == pytest.approx(by, abs=0.03)
        assert told[tag].probability > 0.95
    assert not any("#2" in warning for warning in result.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22])
def test_two_tags_that_were_carried_away_together_do_not_carry_the_robot_away(seed):
    """For some frames the robot sees nothing else, so that the two agree that it is where they had been."""
    world = tagged_corridor(seed)
    seen = world.recording.detections
    recording = replace(world.recording, detections=rows_of(seen, ~np.isin(seen.landmark_id, [4, 7])))
    result = run_slam(recording, prior_map=moved(world.tags, {5: (0.0, 9.0, 0.0), 6: (0.0, 9.0, 0.0)}))
    gap = np.linalg.norm(result.trajectory.pose_world_robot[:, :3] - _true_at(world, result), axis=1)
    assert np.max(gap) < 0.1
    told = {kind: set[int]() for kind in ChangeKind}
    for change in result.changes:
        told[change.kind] |= set(change.landmark_ids)
    assert told.pop(ChangeKind.VANISHED) <= {4, 7}
    assert set().union(*told.values()) <= {5, 6}


def _true_at(world: World, result: SlamResult) -> np.ndarray:
    row = np.searchsorted(world.recording.frames.stamp_s, result.trajectory.stamp_s - 1e-6)
    return world.true_pose[row, :3]


@pytest.mark.slow
def test_probabilities_of_moves_are_calibrated():
    """Moves are reported right, and as surely as they should be, of maps with stated errors and wrong identities."""
    told, truth = [], []
    for seed in range(200, 216):
        random = np.random.default_rng(seed)
        world = tagged_corridor(seed, drift=0.04, p_wrong=0.03, odometry=seed % 2 == 0)
        shift = {int(tag): random.normal(0.0, 0.2, 3) for tag in random.choice(12, 2, replace=False)}
        known = moved(world.tags, shift)
        surveyed = replace(known.as_prior(0.02), position_m=known.position_m + random.normal(0.0, 0.02, (12, 3)))
        changes = {c.landmark_ids[0]: c.probability for c in run_slam(world.recording, prior_map=surveyed).changes}
        told += [changes.get(tag, 0.0) for tag in range(12)]
        truth += [tag in shift for tag in range(12)]
    p, true = np.array(told), np.array(truth)
    assert np.mean(p[~true] > 0.5) <= 0.01
    assert np.mean(p[true] > 0.5) > 0.85
    assert np.mean(true[p > 0.9]) > 0.95


@pytest.mark.slow
def test_places_and_poses_are_as_sure_as_they_say():
    """Squared errors by their covariances average their degrees of freedom, over worlds and tags."""
    of_tags, of_poses = [], []
    for seed in range(100, 112):
        world = tagged_corridor(seed, drift=0.03)
        result = run_slam(world.recording, prior_map=world.tags.as_prior(0.01))
        off = result.landmarks.position_m - world.tags.position_m[result.landmarks.landmark_id]
        # where the map was drawn: its own errors are zero here, so the estimate leans on it by what it says
        of_tags += [d @ np.linalg.solve(c, d) for d, c in zip(off, result.landmarks.covariance_m2, strict=True)]
        turn = Rotation.from_quat(result.trajectory.pose_world_robot[:, 3:])
        gap = turn.inv().apply(world.true_pose[:, :3] - result.trajectory.pose_world_robot[:, :3])
        cov = result.trajectory.covariance[:, :3, :3]
        of_poses += [float(g @ np.linalg.solve(c, g)) for g, c in zip(gap[::10], cov[::10], strict=True)]
    assert np.mean(of_tags) < 3.0
    assert 1.0 < np.mean(of_poses) < 3.6


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_points_of_which_only_the_direction_is_seen_are_triangulated_along_the_odometry(seed):
    world = tagged_corridor(seed, n_frames=320)
    recording = as_directions(world, seed)
    result = run_slam(recording)
    robot, tags = errors(result, replace(world, recording=recording))
    found = compare_with_truth(recording, result, rate_hz=10.0)
    assert found.dead_reckoning is not None
    assert robot < 0.7 * np.sqrt(np.mean(found.dead_reckoning.position_error_m**2))
    assert tags < 0.05
    assert len(result.landmarks) == 12
    assert 0.8 < np.nanmean(result.innovations.nis / result.innovations.dof) < 1.2


@pytest.mark.parametrize("drift", [pytest.param(0.003, marks=pytest.mark.slow), 0.02])
def test_directions_shrink_no_world(drift):
    """Rounds in a hall: nothing but the odometry tells the size, and the path is better than by that alone."""
    recording = hall(1, n_points=40, n_frames=400, drift=drift)
    seen = recording.detections
    ray = seen.position_sensor_m / np.linalg.norm(seen.position_sensor_m, axis=1, keepdims=True)
    along = ray[:, :, None] * ray[:, None, :]
    covariance = 0.01**2 * (np.eye(3) - along) + 1e9 * along
    directions = replace(seen, position_sensor_m=ray, covariance_sensor_m2=covariance)
    told = replace(recording, detections=rows_of(directions, seen.landmark_id >= 0))
    result = run_slam(told)
    found = compare_with_truth(told, result, rate_hz=2.5)
    robot, alone = (float(np.sqrt(np.mean(of.position_error_m**2))) for of in (found.poses, found.dead_reckoning))
    assert robot < 0.75 * alone
    at, true = (each.pose_world_robot[:, :3] for each in (result.trajectory, recording.truth))
    assert np.ptp(at, axis=0)[:2].sum() == pytest.approx(np.ptp(true, axis=0)[:2].sum(), rel=0.1)


def test_directions_know_no_better_metre_than_the_odometry():
    """Of rounds by an odometer that is 1 % off: without ranges or a map it is the only one that knows a metre."""
    world = tagged_corridor(0, n_frames=200)
    recording = as_directions(world, 0)
    driven = recording.odometry
    recording = replace(recording, odometry=replace(driven, pose_world_robot=se3.scaled(driven.pose_world_robot, 0.99)))
    exact, usual = (run_slam(recording, Config(slam={"space": {"scale_sigma": sigma}})) for sigma in (0.0, 0.01))
    np.testing.assert_array_equal(usual.landmarks.position_m, exact.landmarks.position_m)
    at = usual.landmarks.position_m
    more = usual.landmarks.covariance_m2 - exact.landmarks.covariance_m2
    np.testing.assert_allclose(more, 0.01**2 * at[:, :, None] * at[:, None, :], atol=1e-12)
    far = usual.trajectory.pose_world_robot[-1, :3]
    told = [np.trace(result.trajectory.covariance[-1, :3, :3]) for result in (usual, exact)]
    assert told[0] - told[1] == pytest.approx(0.01**2 * far @ far, rel=1e-6)
    in_map = [
        run_slam(recording, Config(slam={"space": {"scale_sigma": sigma}}), prior_map=world.tags.as_prior(0.01))
        for sigma in (0.0, 0.01)
    ]
    np.testing.assert_array_equal(*(one.landmarks.covariance_m2 for one in in_map))
    stated = replace(recording, sensors=tuple(replace(one, sigma_odometer_scale=0.0) for one in recording.sensors))
    knows = run_slam(stated, Config(slam={"space": {"scale_sigma": 0.01}}))
    np.testing.assert_array_equal(knows.landmarks.covariance_m2, exact.landmarks.covariance_m2)
    seen = recording.detections
    one_range = seen.covariance_sensor_m2.copy()
    one_range[0] = 0.01**2 * np.eye(3)
    near = replace(recording, detections=replace(seen, covariance_sensor_m2=one_range))
    measured = [run_slam(near, Config(slam={"space": {"scale_sigma": sigma}})) for sigma in (0.0, 0.01)]
    np.testing.assert_array_equal(*(one.landmarks.covariance_m2 for one in measured))


def test_directions_without_odometry_are_left_out():
    recording = as_directions(tagged_corridor(0, odometry=False), 0)
    with pytest.raises(DataError, match="seen in 0 frames"):
        run_slam(recording)


@pytest.mark.parametrize(
    ("late_s", "seeds"),
    [(0.2, (10,)), *(pytest.param(late_s, (10, 12, 15), marks=pytest.mark.slow) for late_s in (0.2, -0.2))],
)
def test_a_delay_is_as_uncertain_as_it_says_where_the_odometry_is_noisy(late_s, seeds):
    off = []
    for seed in seeds:
        recording = hall(seed, n_points=40, n_frames=300, drift=0.02)
        late = replace(recording, frames=Frames(recording.frames.stamp_s + late_s))
        found = run_slam(late, Config(slam={"space": {"delay_sigma_s": 0.3}}))
        delay = next(each for each in found.parameters if each.name.endswith("delay_s"))
        assert 0.01 < delay.sigma < 0.04
        off.append((delay.value - late_s) / delay.sigma)
    assert np.abs(off).max() < 2.5
    assert np.abs(np.mean(off)) < 1.5


@pytest.mark.slow
def test_a_late_camera_is_found_by_default_and_a_right_one_is_left_alone():
    whole = hall(20, n_points=40, n_frames=400, step_s=0.1, drift=0.01)
    odometry = whole.odometry
    stamp_s = np.append(odometry.stamp_s, odometry.stamp_s[:-1] + 0.04)  # other stamps than the frames, too
    pose = se3.interpolate(odometry.stamp_s, odometry.pose_world_robot, stamp_s)
    order = np.argsort(stamp_s)
    variance = np.vstack([odometry.variance, odometry.variance[:-1]])[order]
    denser = replace(odometry, stamp_s=stamp_s[order], pose_world_robot=pose[order], variance=variance)
    recording = replace(whole, odometry=denser)
    trusted = Config(slam={"space": {"delay_sigma_s": 0.0}})
    for late_s in (0.0, 0.12):
        late = replace(recording, frames=Frames(recording.frames.stamp_s + late_s))
        found, without = run_slam(late), run_slam(late, trusted)
        delay = next(each for each in found.parameters if each.name.endswith("delay_s"))
        assert abs(delay.value - late_s) < 3.0 * delay.sigma < 0.05
        off = [evaluate_trajectory(each.trajectory, recording.truth).rmse_m for each in (found, without)]
        if late_s:
            assert delay.p_needed > 0.99
            assert off[0] < 0.5 * off[1]
        else:
            assert delay.p_needed < 0.1
            assert np.array_equal(found.trajectory.pose_world_robot, without.trajectory.pose_world_robot)
    of_frames = run_slam(whole)  # as visual odometry, which has the clock of the camera
    assert not any(each.name.endswith("delay_s") for each in of_frames.parameters)


def test_a_loop_that_stamps_all_it_logs_alike_hides_no_late_camera():
    """The odometry has the stamps of the frames, as visual odometry has, but the camera is late by two steps."""
    whole = hall(20, n_points=40, n_frames=200, step_s=0.1, drift=0.01)
    odometry, late_s = whole.odometry, 0.2
    loop = odometry.stamp_s[(odometry.stamp_s >= late_s) & (odometry.stamp_s <= odometry.stamp_s[-1] - late_s)]
    assert np.isin(np.round(whole.frames.stamp_s + late_s, 6), np.round(loop, 6)).mean() > 0.95
    late = replace(whole, frames=Frames(whole.frames.stamp_s + late_s))
    found = run_slam(late)
    delay = next(each for each in found.parameters if each.name.endswith("delay_s"))
    assert delay.value == pytest.approx(late_s, abs=4.0 * delay.sigma)
    assert delay.sigma < 0.02
    right = run_slam(whole)  # as visual odometry: it may have been made of the frames
    assert not any(each.name.endswith("delay_s") for each in right.parameters)


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.15, -0.3])
def test_stamps_that_are_late_are_found(late_s):
    """From the changes of speed of a drive around a hall, with points; and the path is that of the right stamps."""
    recording = hall(1, n_points=40, n_frames=300, drift=0.003)
    late = replace(recording, frames=Frames(recording.frames.stamp_s + late_s))
    # causes off: they would find the clock that is held, too
    config, trusted = (
        Config(slam={"space": {"delay_sigma_s": sigma_s}, "explain": {"on": False}}) for sigma_s in (0.5, 0.0)
    )
    found = run_slam(late, config)
    delay = next(each for each in found.parameters if each.name.endswith("delay_s"))
    assert delay.value == pytest.approx(late_s, abs=0.03)
    believing = (run_slam(each, trusted) for each in (late, recording))
    off = [evaluate_trajectory(one.trajectory, recording.truth).rmse_m for one in (found, *believing)]
    assert off[0] < 0.9 * off[1]
    assert off[0] < 1.5 * off[2]
