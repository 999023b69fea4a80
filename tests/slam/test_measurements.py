"""Measurements beside odometry and detections, in the plane: the residuals of space, on a floor."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recordings import building, with_detections

from evermap import Config, run_slam
from evermap.geometry import se2
from evermap.metrics.summary import compare_with_truth
from evermap.metrics.trajectory import interpolate
from evermap.types import UNKNOWN, Measurements, Recording, SlamResult


@cache
def drive() -> Recording:
    """A patrol that sees nothing after its first quarter."""
    made = building(2, patrol_s=90.0).sessions[0]
    count = len(made.frames)
    keep = (made.detections.frame < count // 4) | (made.detections.frame >= count - 3)
    return with_detections(made, keep)


def true_pose(stamp_s: np.ndarray) -> np.ndarray:
    truth = drive().truth
    return interpolate(truth, stamp_s)[0]


def measured(kind: str, stamp_s: np.ndarray, landmark_id: np.ndarray | None = None, **columns) -> Recording:
    place = np.full(len(stamp_s), UNKNOWN) if landmark_id is None else landmark_id
    return replace(drive(), measurements=(Measurements(kind, stamp_s, columns, place),))


def position_error(result: SlamResult) -> float:
    found = compare_with_truth(drive(), result, rate_hz=10.0)
    return float(np.sqrt(np.mean(found.poses.position_error_m**2)))


def shape_error(result: SlamResult) -> float:
    """RMSE of positions after the best similarity transform (Umeyama 1991), as complex numbers."""
    found, true = (
        pose[:, 0] + 1j * pose[:, 1]
        for pose in (result.trajectory.pose_world_robot, true_pose(result.trajectory.stamp_s))
    )
    found, true = found - found.mean(), true - true.mean()
    motion = np.vdot(found, true) / np.vdot(found, found)
    return float(np.sqrt(np.mean(np.abs(motion * found - true) ** 2)))


@cache
def error_without() -> float:
    return position_error(run_slam(drive()))


def test_closures_take_back_what_drifted():
    random, first_s = np.random.default_rng(1), drive().frames.stamp_s[0]
    stamp_s, to_s = first_s + np.full(12, 2.3), first_s + np.linspace(20.0, 88.0, 12)
    between = se2.between(true_pose(stamp_s), true_pose(to_s)) + random.normal(0.0, [0.02, 0.02, 0.005], (12, 3))
    columns = dict(zip(("x_m", "y_m", "yaw_rad"), between.T, strict=True))
    sigma = {"sigma_m": np.full(12, 0.02), "sigma_rad": np.full(12, 0.005)}
    result = run_slam(measured("closures", stamp_s, to_stamp_s=to_s, **columns, **sigma))
    assert error_without() > 0.1
    assert position_error(result) < 0.4 * error_without()
    assert len(result.trajectory) > 12


@pytest.mark.parametrize("kind", ["gravity", "floor"])
def test_what_is_said_of_height_and_tilt_changes_nothing(kind):
    stamp_s = drive().frames.stamp_s[[1, 40, 80]]
    columns = {"gravity": {"ax_mps2": 0.3, "ay_mps2": 0.1, "az_mps2": 9.7}, "floor": {"z_m": 0.4, "up_x": 0.1}}[kind]
    found = run_slam(measured(kind, stamp_s, **{name: np.full(3, value) for name, value in columns.items()}))
    plain = run_slam(drive()).trajectory
    both = np.isin(found.trajectory.stamp_s, plain.stamp_s)
    np.testing.assert_allclose(found.trajectory.pose_world_robot[both], plain.pose_world_robot, atol=2e-3)


def absolute_error(result: SlamResult) -> float:
    """RMSE in the frame of the truth; nothing is aligned."""
    away = result.trajectory.pose_world_robot[:, :2] - true_pose(result.trajectory.stamp_s)[:, :2]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


@pytest.mark.parametrize("online", [False, True])
@pytest.mark.parametrize("p_wrong", [0.0, 0.1])
def test_fixes_put_the_drive_where_it_was(p_wrong, online):
    random, truth = np.random.default_rng(0), drive().truth
    stamp_s = np.arange(truth.stamp_s[0] + 0.3, truth.stamp_s[-1] - 0.3, 1.0)
    at = se2.transform(true_pose(stamp_s), np.array([-0.4, 0.1])) + random.normal(0.0, 0.1, (len(stamp_s), 2))
    at[random.random(len(at)) < p_wrong] += [6.0, -9.0]
    lever = {"lever_x_m": np.full(len(at), -0.4), "lever_y_m": np.full(len(at), 0.1)}
    recording = measured("gnss", stamp_s, x_m=at[:, 0], y_m=at[:, 1], sigma_xy_m=np.full(len(at), 0.1), **lever)
    result = run_slam(recording, Config(slam={"online": online}))
    assert result.trajectory.frame == result.landmarks.frame == "gnss"
    assert absolute_error(result) < 0.1


def test_heights_of_fixes_are_no_measurement_in_the_plane():
    """An antenna on a mast above a hill, whose heights are far beyond their stated deviation: all fixes are used."""
    random, stamp_s = np.random.default_rng(3), drive().frames.stamp_s[5::5]
    fix = se2.transform(true_pose(stamp_s), np.array([0.3, -0.1])) + random.normal(0.0, 0.02, (len(stamp_s), 2))
    said = {"x_m": fix[:, 0], "y_m": fix[:, 1], "z_m": 35.0 + random.normal(0.0, 1.0, len(fix))}
    said |= {"lever_x_m": 0.3, "lever_y_m": -0.1, "lever_z_m": 1.2, "sigma_xy_m": 0.02, "sigma_z_m": 0.02}
    columns = {name: np.broadcast_to(value, len(fix)) for name, value in said.items()}
    assert absolute_error(run_slam(measured("gnss", stamp_s, **columns))) < 0.03


@pytest.mark.parametrize("kind", ["ranges", "bearings"])
def test_landmarks_that_are_only_measured_are_mapped_and_hold_the_drive(kind):
    random, truth = np.random.default_rng(4), drive().truth
    low, high = truth.pose_world_robot[:, :2].min(axis=0) - 3.0, truth.pose_world_robot[:, :2].max(axis=0) + 3.0
    beacon = np.array([low, [low[0], high[1]], high, [high[0], low[1]]])
    when = np.arange(truth.stamp_s[0] + 0.3, truth.stamp_s[-1] - 0.3, 1.0)
    stamp_s, which = np.repeat(when, 4), np.tile(np.arange(4), len(when))
    seen = np.array(
        [se2.transform(se2.inverse(pose), beacon[k]) for pose, k in zip(true_pose(stamp_s), which, strict=True)]
    )
    if kind == "ranges":
        columns = {"range_m": np.hypot(*seen.T) + random.normal(0.0, 0.05, len(seen))}
        columns["sigma_m"] = np.full(len(seen), 0.05)
    else:
        columns = {"azimuth_rad": np.arctan2(seen[:, 1], seen[:, 0]) + random.normal(0.0, 0.01, len(seen))}
        columns["sigma_rad"] = np.full(len(seen), 0.01)
    result = run_slam(measured(kind, stamp_s, 100_000 + which, **columns))
    if kind == "ranges":
        assert position_error(result) < 0.5 * error_without()
    # what a metre is bearings cannot tell: it is that of the odometry, which is 2 % off
    assert shape_error(result) < 0.25 * shape_error(run_slam(drive()))
    mine = result.landmarks.landmark_id >= 100_000
    assert result.landmarks.n_hits[mine].tolist() == [len(when)] * 4
