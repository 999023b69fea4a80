"""Measurements beside odometry and detections, in the plane: the residuals of space, on a floor."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recordings import building, with_detections

from evermap import run_slam
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
