"""Measurements beside odometry and detections, in space: what each is worth to a drive whose odometry drifts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from evermap import read_recording, run_slam
from evermap.config import Config
from evermap.geometry import se3
from evermap.io.native_write import write_native
from evermap.metrics.summary import compare_with_truth
from evermap.slam.space.intake import prepare_space, start_noise
from evermap.slam.space.starts import by_constellations
from evermap.types import UNKNOWN, Measurements, SlamResult, SpatialRecording, rows_of

from .halls import hall


@cache
def drive() -> SpatialRecording:
    """Two laps of a hall, of whose landmarks only those that are seen in the first seconds are detected."""
    made = hall(3, n_points=40, n_frames=440, drift=0.05)
    seen = made.detections
    return replace(made, detections=rows_of(seen, np.flatnonzero(seen.frame < 40)))


def true_pose(stamp_s: np.ndarray) -> np.ndarray:
    truth = drive().truth
    return se3.interpolate(truth.stamp_s, truth.pose_world_robot, stamp_s)


def measured(kind: str, stamp_s: np.ndarray, landmark_id: np.ndarray | None = None, **columns) -> SpatialRecording:
    """The drive with measurements of a kind."""
    place = np.full(len(stamp_s), UNKNOWN) if landmark_id is None else landmark_id
    return replace(drive(), measurements=(Measurements(kind, stamp_s, columns, place),))


def position_error(result: SlamResult) -> float:
    """RMSE in the frame that the result states."""
    found = compare_with_truth(drive(), result, rate_hz=10.0)
    return float(np.sqrt(np.mean(found.poses.position_error_m**2)))


@cache
def error_without() -> float:
    return position_error(run_slam(drive()))


def fixes(random: np.random.Generator, p_wrong: float = 0.0) -> dict[str, np.ndarray]:
    stamp_s = np.arange(0.3, 175.6, 1.0)
    lever = np.array([-0.4, 0.1, 1.1])
    at = se3.transform(true_pose(stamp_s), lever) + random.normal(0.0, 0.1, (len(stamp_s), 3))
    at[random.random(len(at)) < p_wrong] += [6.0, -9.0, 4.0]
    full = dict(zip(("lever_x_m", "lever_y_m", "lever_z_m"), np.tile(lever[:, None], len(at)), strict=True))
    sigma = {"sigma_xy_m": np.full(len(at), 0.1), "sigma_z_m": np.full(len(at), 0.1)}
    return {"stamp_s": stamp_s, "x_m": at[:, 0], "y_m": at[:, 1], "z_m": at[:, 2], **full, **sigma}


@pytest.mark.parametrize("p_wrong", [pytest.param(0.0, marks=pytest.mark.slow), 0.1])
def test_fixes_put_the_drive_where_it_was(p_wrong):
    result = run_slam(measured("gnss", **fixes(np.random.default_rng(0), p_wrong)))
    assert result.trajectory.frame == result.landmarks.frame == "gnss"
    assert error_without() > 0.5
    assert position_error(result) < 0.12  # nothing is aligned: the frame is that of the fixes
    stamp_s = result.trajectory.stamp_s
    away = np.linalg.norm(result.trajectory.pose_world_robot[:, :3] - true_pose(stamp_s)[:, :3], axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.12


def test_closures_take_back_what_drifted():
    random, stamp_s = np.random.default_rng(1), np.arange(0.5, 60.0, 10.0)
    to_s = stamp_s + 70.4  # the next lap
    between = se3.retract(se3.between(true_pose(stamp_s), true_pose(to_s)), random.normal(0.0, 0.02, (len(to_s), 6)))
    angles = np.array([rotation_angles(one) for one in between])
    columns = dict(zip(("x_m", "y_m", "z_m"), between[:, :3].T, strict=True))
    columns |= dict(zip(("roll_rad", "pitch_rad", "yaw_rad"), angles.T, strict=True))
    sigma = {"sigma_m": np.full(len(to_s), 0.02), "sigma_rad": np.full(len(to_s), 0.02)}
    result = run_slam(measured("closures", stamp_s, to_stamp_s=to_s, **columns, **sigma))
    assert result.trajectory.frame == "first_pose"
    assert position_error(result) < 0.7 * error_without()


def rotation_angles(pose: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(pose[3:]).as_euler("xyz")


@pytest.mark.parametrize("kind", ["gravity", "floor"])
def test_tilt_and_height_are_held(kind):
    random, stamp_s = np.random.default_rng(2), np.arange(0.1, 175.6, 0.8)
    true = true_pose(stamp_s)
    up = se3.rotation_of(true)[:, 2]
    noisy = up + random.normal(0.0, 0.01, up.shape)
    if kind == "gravity":
        columns = dict(zip(("ax_mps2", "ay_mps2", "az_mps2"), 9.81 * noisy.T, strict=True))
        columns["sigma_rad"] = np.full(len(up), 0.01)
    else:
        columns = {"z_m": true[:, 2], "up_x": noisy[:, 0], "up_y": noisy[:, 1]}
    found = run_slam(measured(kind, stamp_s, **columns)).trajectory
    plain = run_slam(drive()).trajectory
    level = se3.rotation_of(true_pose(found.stamp_s))[:, 2]

    def leans(pose: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.sum((se3.rotation_of(pose)[:, 2] - level) ** 2, axis=1))))

    assert leans(found.pose_world_robot) < min(0.02, 0.5 * leans(plain.pose_world_robot))
    if kind == "floor":
        height = found.pose_world_robot[:, 2] - true_pose(found.stamp_s)[:, 2]
        assert np.sqrt(np.mean(height**2)) < 0.025


@pytest.mark.parametrize(
    ("kind", "begin_s"), [("ranges", 0.3), pytest.param("bearings", 0.3, marks=pytest.mark.slow), ("bearings", None)]
)
def test_landmarks_that_are_only_measured_are_mapped_and_hold_the_drive(kind, begin_s):
    """Also from the first pose on, at the origin, where a place that nobody located would be in no direction."""
    begin_s = float(drive().frames.stamp_s[0]) if begin_s is None else begin_s
    random = np.random.default_rng(4)
    beacon = np.array([[1.0, 1.0, 2.5], [22.0, 2.0, 2.8], [20.0, 15.0, 0.4], [3.0, 14.0, 2.2], [12.0, 8.0, 3.0]])
    stamp_s = np.repeat(np.arange(begin_s, 175.6, 1.0), len(beacon))
    which = np.tile(np.arange(len(beacon)), len(stamp_s) // len(beacon))
    seen = se3.transform(se3.inverse(true_pose(stamp_s)), beacon[which])
    if kind == "ranges":
        columns = {"range_m": np.linalg.norm(seen, axis=1) + random.normal(0.0, 0.05, len(seen))}
        columns["sigma_m"] = np.full(len(seen), 0.05)
    else:
        azimuth = np.arctan2(seen[:, 1], seen[:, 0]) + random.normal(0.0, 0.01, len(seen))
        elevation = np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1])) + random.normal(0.0, 0.01, len(seen))
        columns = {"azimuth_rad": azimuth, "elevation_rad": elevation, "sigma_rad": np.full(len(seen), 0.01)}
    result = run_slam(measured(kind, stamp_s, 100 + which, **columns))
    assert position_error(result) < 0.4 * error_without()
    assert set(100 + np.arange(len(beacon))) <= set(result.landmarks.landmark_id.tolist())
    hits = result.landmarks.n_hits[np.isin(result.landmarks.landmark_id, 100 + which)]
    assert np.all(hits == len(stamp_s) // len(beacon))


@pytest.mark.parametrize("kind", ["ranges", pytest.param("bearings", marks=pytest.mark.slow)])
def test_landmarks_that_are_only_measured_are_mapped_without_odometry(kind):
    """Points are begun from constellations; from the origin ranges would draw the drive elsewhere."""
    random, recording = np.random.default_rng(4), hall(3, n_points=40, n_frames=150, drift=0.05)
    beacon = np.array([[1.0, 1.0, 2.5], [22.0, 2.0, 2.8], [20.0, 15.0, 2.4], [3.0, 14.0, 2.2]])
    stamp_s = np.repeat(recording.frames.stamp_s, len(beacon))
    which = np.tile(np.arange(len(beacon)), len(recording.frames))
    way, frame_s = recording.truth, recording.frames.stamp_s
    true = se3.interpolate(way.stamp_s, way.pose_world_robot, frame_s)
    seen = se3.transform(se3.inverse(np.repeat(true, len(beacon), axis=0)), beacon[which])
    columns = {"range_m": np.linalg.norm(seen, axis=1) + random.normal(0.0, 0.05, len(seen))}
    if kind == "bearings":
        columns = {
            "azimuth_rad": np.arctan2(seen[:, 1], seen[:, 0]) + random.normal(0.0, 0.01, len(seen)),
            "elevation_rad": np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1])),
        }
    table = Measurements(kind, stamp_s, columns, 100 + which)
    result = run_slam(replace(recording, odometry=None, measurements=(table,)))
    found = result.landmarks
    ours = np.searchsorted(found.landmark_id, 100 + np.arange(len(beacon)))
    assert found.landmark_id[ours].tolist() == [100, 101, 102, 103]
    first = np.flatnonzero(frame_s == result.trajectory.stamp_s[0])
    there = se3.transform(se3.inverse(true[first]), beacon)
    numbers = 2 if kind == "ranges" else 3  # by ranges from a floor it may be below as well
    assert np.linalg.norm((found.position_m[ours] - there)[:, :numbers], axis=1).max() < 0.5


def test_starts_from_constellations_know_what_is_only_measured():
    """A place that stood at the origin would draw every start there."""
    recording, beacon = hall(3, n_points=40, n_frames=150, drift=0.05), np.array([[12.0, 8.0, 3.0]])
    way, stamp_s = recording.truth, recording.frames.stamp_s
    true = se3.interpolate(way.stamp_s, way.pose_world_robot, stamp_s)
    far = np.linalg.norm(se3.transform(true, np.zeros(3)) - beacon, axis=1)
    table = Measurements("ranges", stamp_s, {"range_m": far}, np.full(len(far), 100))
    problem = prepare_space(replace(recording, odometry=None, measurements=(table,)), Config().slam.space).problem
    (begun,) = by_constellations(problem, start_noise(problem.settings, driven=False), 1)
    apart = np.linalg.norm(begun.pose[:, :3] - begun.place[-1, :3], axis=1)
    assert np.median(np.abs(apart - far)) < 0.1 * np.median(far)


def test_tables_of_measurements_are_written_and_read_back(tmp_path):
    recording = measured("gnss", **fixes(np.random.default_rng(0)))
    read = read_recording(write_native(recording, tmp_path / "drive"))
    assert [table.kind for table in read.measurements] == ["gnss"]
    found, given = read.measurements[0], recording.measurements[0]
    np.testing.assert_array_equal(found.stamp_s, given.stamp_s)
    for name, column in given.columns.items():
        np.testing.assert_allclose(found.columns[name], column, rtol=1e-12)
