"""Kinds of measurements: derivatives against differences, residuals against gtsam's, places against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.estimate.kind import MeasurementKind
from evermap.estimate.measurements import find_kinds
from evermap.geometry import se3

STEP = 1e-6
MEASURED = {
    "gnss": {"x_m": 4.0, "y_m": -2.0, "z_m": 0.7, "lever_x_m": 0.3, "lever_y_m": -0.1, "lever_z_m": 1.2},
    "closures": {"x_m": 1.0, "y_m": 0.4, "z_m": -0.2, "roll_rad": 0.1, "pitch_rad": -0.2, "yaw_rad": 0.8},
    "floor": {"z_m": 0.2, "up_x": 0.05, "up_y": -0.02},
    "gravity": {"ax_mps2": 0.8, "ay_mps2": -0.4, "az_mps2": 9.7},
    "bearings": {"azimuth_rad": 2.9, "elevation_rad": 0.2},
    "ranges": {"range_m": 5.0, "lever_x_m": 0.2, "lever_y_m": 0.1, "lever_z_m": 0.4},
}
KINDS = sorted(find_kinds())


def columns_of(kind: MeasurementKind, count: int, **given) -> dict[str, np.ndarray]:
    return {name: np.full(count, value, dtype=float) for name, value in {**kind.optional, **given}.items()}


def poses(seed: int, count: int) -> np.ndarray:
    return se3.exp(np.random.default_rng(seed).normal(0.0, [2.0, 2.0, 2.0, 0.6, 0.6, 0.6], (count, 6)))


def others(kind: MeasurementKind, seed: int, count: int) -> np.ndarray:
    other = poses(100 + seed, count)
    return {"pose": np.zeros((count, 0)), "pose_pose": other, "pose_place": 3.0 * other[:, :3]}[kind.ties]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
@pytest.mark.parametrize("name", KINDS)
def test_derivatives_are_those_of_differences(name, seed):
    kind, count = find_kinds()[name], 5
    pose, other = poses(seed, count), others(kind, seed, count)
    columns = columns_of(kind, count, **MEASURED[name])

    def residual(pose, other):
        found = kind.linearise(pose, other, columns).residual
        return np.where(np.isfinite(found), found, 0.0)

    found = kind.linearise(pose, other, columns)
    assert found.residual.shape == (count, len(kind.sigma))
    for axis in range(6):
        by = STEP * np.eye(6)[axis]
        slope = residual(se3.retract(pose, by), other) - residual(se3.retract(pose, -by), other)
        np.testing.assert_allclose(found.by_pose[..., axis], slope / (2.0 * STEP), atol=1e-6)
    for axis in range({"pose": 0, "pose_pose": 6, "pose_place": 3}[kind.ties]):
        by = STEP * np.eye(6)[axis]
        ends = [se3.retract(other, s * by) if kind.ties == "pose_pose" else other + s * by[:3] for s in (1.0, -1.0)]
        slope = residual(pose, ends[0]) - residual(pose, ends[1])
        np.testing.assert_allclose(found.by_other[..., axis], slope / (2.0 * STEP), atol=1e-6)


def gtsam_pose(pose: np.ndarray):
    gtsam = pytest.importorskip("gtsam")
    return gtsam.Pose3(gtsam.Rot3.Quaternion(pose[6], *pose[3:6]), pose[:3])


def gtsam_factor(name: str, columns):
    """The factor with unit noise, of pose 0 and of pose or point 1."""
    gtsam = pytest.importorskip("gtsam")
    one = {key: float(value[0]) for key, value in columns.items()}

    def vector(*names):
        return np.array([one[key] for key in names])

    unit = gtsam.noiseModel.Unit.Create
    if name == "gnss":
        at, lever = vector("x_m", "y_m", "z_m"), vector("lever_x_m", "lever_y_m", "lever_z_m")
        return gtsam.GPSFactorArm(0, at, lever, unit(3))
    if name == "closures":
        turn = se3.from_angles(vector("roll_rad", "pitch_rad", "yaw_rad"))[3:]
        return gtsam.BetweenFactorPose3(0, 1, gtsam_pose(np.append(vector("x_m", "y_m", "z_m"), turn)), unit(6))
    if name == "ranges":
        return gtsam.RangeFactor3D(0, 1, one["range_m"], unit(1))
    raise NotImplementedError(name)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
@pytest.mark.parametrize("name", ["gnss", "closures", "ranges"])
def test_residuals_and_derivatives_are_those_of_gtsam(name, seed):
    gtsam = pytest.importorskip("gtsam")
    kind = find_kinds()[name]
    pose, other = poses(seed, 1), others(kind, seed, 1)
    given = dict(MEASURED[name])
    if name == "ranges":
        given.update(lever_x_m=0.0, lever_y_m=0.0, lever_z_m=0.0)
    columns = columns_of(kind, 1, **given)
    factor, values = gtsam_factor(name, columns), gtsam.Values()
    values.insert(0, gtsam_pose(pose[0]))
    if kind.ties == "pose_pose":
        values.insert(1, gtsam_pose(other[0]))
    elif kind.ties == "pose_place":
        values.insert(1, other[0])
    found = kind.linearise(pose, other, columns)
    by, right = factor.linearize(values).jacobian()
    # gtsam's are predicted less measured, and its twists have the rotation first
    order = [3, 4, 5, 0, 1, 2]
    rows = order if name == "closures" else list(range(len(kind.sigma)))
    parts = [found.by_pose[0][:, order]]
    if kind.ties == "pose_pose":
        parts.append(found.by_other[0][:, order])
    elif kind.ties == "pose_place":
        parts.append(found.by_other[0])
    np.testing.assert_allclose(found.residual[0][rows], right, atol=1e-9)
    np.testing.assert_allclose(-np.hstack(parts)[rows], by, atol=1e-6)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
@pytest.mark.parametrize("name", ["gravity", "bearings"])
def test_directions_that_are_a_little_off_are_as_far_off_as_gtsam_says(name, seed):
    gtsam = pytest.importorskip("gtsam")
    random, kind, unit = np.random.default_rng(seed), find_kinds()[name], gtsam.noiseModel.Unit.Create(2)
    pose, off, values = poses(seed, 1), 1e-4 * random.normal(size=3), gtsam.Values()
    values.insert(0, gtsam_pose(pose[0]))
    if name == "gravity":
        reads = se3.rotation_of(pose[0])[2] + off
        columns = columns_of(kind, 1, **dict(zip(kind.columns, 9.81 * reads, strict=True)))
        up = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))
        factor, other = gtsam.AttitudeFactorPose3(0, up, unit, gtsam.Unit3(reads)), np.zeros((1, 0))
    else:
        other = se3.transform(pose, np.array([3.0, 1.0, 0.4]) * random.uniform(0.5, 1.5, 3))
        x, y, z = seen = se3.transform(se3.inverse(pose), other)[0] + off
        columns = columns_of(kind, 1, azimuth_rad=np.arctan2(y, x), elevation_rad=np.arctan2(z, np.hypot(x, y)))
        values.insert(1, other[0])
        factor = gtsam.BearingFactor3D(0, 1, gtsam.Unit3(seen), unit)
    found = kind.linearise(pose, other, columns).residual[0]
    if name == "bearings":
        found = found * [np.cos(columns["elevation_rad"][0]), 1.0]  # a degree of azimuth is shorter high up
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(factor.unwhitenedError(values)), rel=1e-3)


def test_a_robot_that_is_level_reads_gravity_upward_and_stands_at_its_height():
    pose = se3.compose(np.array([1.0, 2.0, 0.3, 0, 0, 0, 1.0]), se3.exp(np.array([0, 0, 0, 0, 0, 1.1])))[None]
    nothing = np.zeros((1, 0))
    gravity, floor = find_kinds()["gravity"], find_kinds()["floor"]
    reads = columns_of(gravity, 1, ax_mps2=0.0, ay_mps2=0.0, az_mps2=9.81)
    assert gravity.linearise(pose, nothing, reads).residual == pytest.approx(0.0, abs=1e-12)
    assert floor.linearise(pose, nothing, columns_of(floor, 1, z_m=0.3)).residual == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 4))])
@pytest.mark.parametrize("name", ["bearings", "ranges"])
def test_a_landmark_is_located_where_its_measurements_meet(name, seed):
    kind, count = find_kinds()[name], 12
    pose = poses(seed, count)
    place = np.random.default_rng(50 + seed).normal(0.0, 6.0, 3)
    seen = se3.transform(se3.inverse(pose), place)
    given = {
        "bearings": {
            "azimuth_rad": np.arctan2(seen[:, 1], seen[:, 0]),
            "elevation_rad": np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1])),
        },
        "ranges": {"range_m": np.linalg.norm(seen, axis=1)},
    }[name]
    columns = {**columns_of(kind, count), **given}
    assert kind.place(pose, columns) == pytest.approx(place, abs=1e-6)
    assert kind.linearise(pose, np.tile(place, (count, 1)), columns).residual == pytest.approx(0.0, abs=1e-9)


def test_ranges_from_a_line_locate_nothing_and_from_a_floor_what_is_above_it():
    kind = find_kinds()["ranges"]
    along = np.linspace(-4.0, 4.0, 15)
    line = np.column_stack([along, *np.zeros((5, 15)), np.ones(15)])
    place = np.array([1.0, 3.0, 2.0])
    far = np.linalg.norm(place - line[:, :3], axis=1)
    assert kind.place(line, {**columns_of(kind, 15), "range_m": far}) is None
    bend = line.copy()
    bend[:, 1] = 0.3 * along**2
    far = np.linalg.norm(place - bend[:, :3], axis=1)
    assert kind.place(bend, {**columns_of(kind, 15), "range_m": far}) == pytest.approx(place, abs=1e-6)


@pytest.mark.parametrize("name", ["bearings", "ranges"])
def test_a_landmark_overhead_or_where_the_robot_is_has_finite_derivatives(name):
    kind, pose = find_kinds()[name], se3.identity(2)
    columns = columns_of(kind, 2, **MEASURED[name])
    found = kind.linearise(pose, np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]), columns)
    for part in (found.residual[:, :1], found.by_pose, found.by_other):
        assert np.isfinite(part).all()
