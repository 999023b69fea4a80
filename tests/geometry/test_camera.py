"""Cameras against the formulas of their papers, written again in plain numbers; tags against made and real views."""

from __future__ import annotations

import csv
import gzip
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from evermap.geometry import square
from evermap.geometry.camera import project, project_each, unproject
from evermap.geometry.square import CORNERS, square_poses
from evermap.types import SpatialSensor

PINHOLE = SpatialSensor(intrinsics=(600.0, 610.0, 650.0, 550.0))
RADTAN = SpatialSensor(
    intrinsics=(1500.0, 1490.0, 1025.0, 1030.0),
    distortion=(-0.16, 0.09, -0.0002, -0.0003, -0.02),
    distortion_model="radtan",
)
FISHEYE = SpatialSensor(
    intrinsics=(603.0, 602.0, 665.0, 554.0),
    distortion=(-0.012, -0.010, 0.0075, -0.0025),
    distortion_model="equidistant",
)
CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, RADTAN, FISHEYE], ids=["pinhole", "radtan", "equidistant"])


def by_hand(point: np.ndarray, camera: SpatialSensor) -> tuple[float, float]:
    """One point, in Python's numbers: Brown 1966 as OpenCV writes it, Kannala and Brandt 2006 equation 6."""
    x, y, z = map(float, point)
    fx, fy, cx, cy = camera.intrinsics or (0.0, 0.0, 0.0, 0.0)
    if camera.distortion_model == "equidistant":
        k = camera.distortion
        angle, around = math.atan2(math.hypot(x, y), z), math.atan2(y, x)
        r = angle + sum(k[i] * angle ** (2 * i + 3) for i in range(4))
        return fx * r * math.cos(around) + cx, fy * r * math.sin(around) + cy
    a, b = x / z, y / z
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    r2 = a * a + b * b
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        fx * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + cx,
        fy * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + cy,
    )


def points(count: int = 200, *, wide: float = 0.5) -> np.ndarray:
    random = np.random.default_rng(1)
    plane = np.column_stack([random.uniform(-wide, wide, (count, 2)), np.ones(count)])
    return plane * random.uniform(0.3, 20.0, (count, 1))


@CAMERAS
def test_pixels_are_those_of_the_papers(camera: SpatialSensor) -> None:
    at = points()
    np.testing.assert_allclose(project(at, camera)[0], [by_hand(point, camera) for point in at], rtol=0, atol=1e-9)


@CAMERAS
def test_derivatives_are_those_of_differences(camera: SpatialSensor) -> None:
    at, step = points(), 1e-6
    at[0, :2], at[1, :2] = 0.0, 1e-9  # on the axis, and so near that the fisheye takes its series
    at[2, :2] = at[2, 2] * 2e-6  # just beyond it
    scale = at[:, 2, None, None]
    there = [project(at + step * scale[:, 0] * axis, camera)[0] for axis in np.eye(3)]
    before = [project(at - step * scale[:, 0] * axis, camera)[0] for axis in np.eye(3)]
    numeric = (np.stack(there, axis=-1) - np.stack(before, axis=-1)) / (2 * step * scale)
    np.testing.assert_allclose(project(at, camera)[1] * scale, numeric * scale, rtol=0, atol=2e-4)


@CAMERAS
def test_rays_lead_back(camera: SpatialSensor) -> None:
    at = points(wide=0.6)
    ray = unproject(project(at, camera)[0], camera)
    np.testing.assert_allclose(ray, at / np.linalg.norm(at, axis=1, keepdims=True), rtol=0, atol=1e-12)


def test_a_fisheye_sees_beside_and_behind_itself() -> None:
    angle = np.linspace(0.0, 1.9, 50)  # up to 109 degrees off its axis
    at = np.column_stack([np.sin(angle) * 0.6, np.sin(angle) * 0.8, np.cos(angle)])
    wide = replace(FISHEYE, distortion=(0.02, -0.004, 0.001, 0.0))
    pixel = project(at, wide)[0]
    np.testing.assert_allclose(pixel, [by_hand(point, wide) for point in at], rtol=0, atol=1e-9)
    np.testing.assert_allclose(unproject(pixel, wide), at, rtol=0, atol=1e-12)


def test_a_pixel_that_nothing_is_imaged_at_has_no_ray() -> None:
    assert np.isnan(unproject(np.array([[1e5, 0.0]]), FISHEYE)).all()
    barrel = SpatialSensor(
        intrinsics=(100.0, 100.0, 0.0, 0.0), distortion=(-0.3, 0.0, 0.0, 0.0), distortion_model="radtan"
    )
    assert np.isnan(unproject(np.array([[90.0, 0.0]]), barrel)).all()  # x (1 - 0.3 x^2) is at most 0.70


def test_points_by_their_cameras() -> None:
    at = points(9).reshape(3, 3, 3)
    lidar = SpatialSensor(name="lidar")
    pixel, slope = project_each(at, np.array([1, 0, 2]), (PINHOLE, FISHEYE, lidar))
    for row, camera in ((0, FISHEYE), (1, PINHOLE)):
        np.testing.assert_array_equal(pixel[row], project(at[row], camera)[0])
        np.testing.assert_array_equal(slope[row], project(at[row], camera)[1])
    assert np.isnan(pixel[2]).all()
    assert np.isnan(slope[2]).all()


def tag_views(camera: SpatialSensor, count: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of tags ahead of a camera and turned to it by up to 65 degrees, their sizes, and their corners."""
    random = np.random.default_rng(2)
    position = points(count, wide=0.4)
    position *= random.uniform(0.5, 4.0, (count, 1)) / position[:, 2:]
    size = random.uniform(0.1, 0.3, count)
    tilt = random.uniform(0.0, np.radians(65.0), count)
    around = random.uniform(-np.pi, np.pi, (2, count))
    facing = Rotation.from_euler("x", np.pi) * Rotation.from_euler("z", around[0][:, None])
    axis = np.column_stack([np.cos(around[1]), np.sin(around[1]), np.zeros(count)])
    rotation = Rotation.from_rotvec(axis * tilt[:, None]) * facing
    corner = np.einsum("mij,kj->mki", rotation.as_matrix(), CORNERS) * size[:, None, None] + position[:, None]
    pose = np.column_stack([position, rotation.as_quat()])
    return pose, size, np.array([[by_hand(point, camera) for point in four] for four in corner])


def apart(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    turn = (Rotation.from_quat(a[:, 3:]).inv() * Rotation.from_quat(b[:, 3:])).magnitude()
    return np.linalg.norm(a[:, :3] - b[:, :3], axis=1), turn


@CAMERAS
def test_exact_corners_give_the_tag_back(camera: SpatialSensor) -> None:
    pose, size, corner = tag_views(camera)
    found = square_poses(corner, size, camera)
    shift, turn = apart(pose, found.pose[0])
    assert shift.max() < 1e-6
    assert turn.max() < 1e-5
    assert found.error_px[0].max() < 1e-6
    assert (found.error_px[1] >= found.error_px[0]).all()
    assert np.mean(apart(found.pose[0], found.pose[1])[1] > 0.1) > 0.7  # most views have a second explanation


def test_poses_that_are_kept_are_those_of_the_same_corners_sizes_and_lens(monkeypatch: pytest.MonkeyPatch) -> None:
    """What else a sensor has, as its mount, is nothing to them; what is kept cannot be spoilt."""
    _, size, corner = tag_views(RADTAN, 5)
    asked: list[SpatialSensor] = []
    compute = square._square_poses
    monkeypatch.setattr(square, "_square_poses", lambda *given: asked.append(given[2]) or compute(*given))
    square._solve_once.cache_clear()

    def check(number: int, corner: np.ndarray, size: np.ndarray, sensor: SpatialSensor) -> None:
        found = square_poses(corner, size, sensor)
        assert len(asked) == number
        for mine, theirs in zip(found, compute(corner, size, sensor), strict=True):
            np.testing.assert_array_equal(mine, theirs)

    check(1, corner, size, RADTAN)
    check(1, corner.copy(), size, replace(RADTAN, name="b", mount_robot_sensor=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
    check(2, corner, 2.0 * size, RADTAN)
    check(3, corner[::-1], size[::-1], RADTAN)
    check(4, corner, size, replace(RADTAN, distortion=()))
    check(5, corner, size, replace(RADTAN, distortion_model="equidistant", distortion=RADTAN.distortion[:2]))
    check(6, corner, size, replace(RADTAN, intrinsics=(500.0, 500.0, 320.0, 240.0)))
    corner[0] += 0.5
    check(7, corner, size, RADTAN)
    with pytest.raises(ValueError, match="read-only"):
        square_poses(corner, size, RADTAN).pose[:] = 0.0
    monkeypatch.setattr(square, "_FEW", 4)
    check(8, corner, size, RADTAN)


def test_noisy_corners_give_the_least_reprojection_error() -> None:
    """Both poses are minima, the better one the least of all that scipy finds from many starts."""
    pose, size, corner = tag_views(FISHEYE, 12)
    corner = corner + 0.3 * np.random.default_rng(3).standard_normal(corner.shape)
    found = square_poses(corner, size, FISHEYE)

    def residual(state: np.ndarray, row: int) -> np.ndarray:
        at = Rotation.from_rotvec(state[3:]).apply(CORNERS * size[row]) + state[:3]
        return (np.array([by_hand(point, FISHEYE) for point in at]) - corner[row]).ravel()

    for row in range(12):
        best = math.inf
        for start in (pose[row], found.pose[0, row], found.pose[1, row]):
            state = np.concatenate([start[:3], Rotation.from_quat(start[3:]).as_rotvec()])
            best = min(best, float(np.sum(least_squares(residual, state, args=(row,), method="lm").fun ** 2)))
        assert found.error_px[0, row] == pytest.approx(math.sqrt(best / 8.0), rel=1e-4, abs=1e-6)


def test_the_information_is_that_of_the_pixels() -> None:
    """Poses of many noisy views of one tag scatter as the information says."""
    pose, size, corner = tag_views(RADTAN, 3)
    pose, size, corner = (np.repeat(each[2:3], 2000, axis=0) for each in (pose, size, corner))
    noisy = corner + 0.1 * np.random.default_rng(4).standard_normal(corner.shape)
    found = square_poses(noisy, size, RADTAN)
    turn = Rotation.from_quat(pose[:, 3:])
    local = turn.inv().apply(found.pose[0][:, :3] - pose[:, :3])
    twist = np.column_stack([local, (turn.inv() * Rotation.from_quat(found.pose[0][:, 3:])).as_rotvec()])
    expected = 0.01 * np.linalg.inv(square_poses(corner[:1], size[:1], RADTAN).information[0, 0])
    near = np.linalg.norm(twist[:, 3:], axis=1) < 0.5  # the other solution now and then
    assert near.mean() > 0.9
    np.testing.assert_allclose(np.std(twist[near], axis=0), np.sqrt(np.diag(expected)), rtol=0.15)


def test_corners_of_no_square_have_no_pose() -> None:
    line = np.array([[[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [30.0, 0.0]]])
    found = square_poses(line, np.array([0.2]), PINHOLE)
    assert np.isnan(found.pose).all()
    assert square_poses(np.zeros((0, 4, 2)), np.zeros(0), PINHOLE).pose.shape == (2, 0, 7)


def test_damaged_corners_spoil_no_other_tag() -> None:
    random = np.random.default_rng(0)
    square = np.array([[270.0, 190.0], [370.0, 190.0], [370.0, 290.0], [270.0, 290.0]])
    corner = np.tile(square.ravel(), (500, 1))
    damaged = random.random(corner.shape) < 0.5
    corner[damaged] = random.choice([1e308, -1e308, 1e100, -1e30, 1e18, 1e8, 5e-324, 0.0, np.nan], damaged.sum())
    corner[0] = square.ravel()
    with np.errstate(all="ignore"):
        found = square_poses(corner.reshape(-1, 4, 2), np.full(500, 0.2), PINHOLE)
    np.testing.assert_array_equal(found.pose[:, 0], square_poses(square[None], np.array([0.2]), PINHOLE).pose[:, 0])


@pytest.mark.data
@pytest.mark.parametrize(
    ("recording", "size", "camera"),
    [
        (
            "test_9",
            0.15,
            SpatialSensor(
                intrinsics=(601.868, 601.536, 677.135, 559.507),
                distortion=(-0.00896302, -0.016849, 0.0134772, -0.00439917),
                distortion_model="equidistant",
            ),
        ),
        (
            "test_13",
            0.12,
            SpatialSensor(
                intrinsics=(1502.3643772338376, 1500.5878284249407, 1025.6942606592718, 1030.4834154577413),
                distortion=(-0.16362577331649863, 0.09153792940542683, -0.00018620069216787472, -0.0002030253527345204),
                distortion_model="radtan",
            ),
        ),
    ],
)
def test_real_tags_are_where_another_program_finds_them(
    shared_data: Path, recording: str, size: float, camera: SpatialSensor
) -> None:
    """Another implementation of the same paper, without the last refinement on the pixels."""
    data = gzip.decompress((shared_data / "tagslam" / recording / "detections.csv.gz").read_bytes()).decode()
    rows = [row for row in csv.DictReader(io.StringIO(data)) if row["camera"] == "cam0"][:3000]

    def columns(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    corner = columns(*(f"{axis}{k}_px" for k in range(4) for axis in "uv")).reshape(-1, 4, 2)
    theirs = columns("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    error = columns("reproj_px", "reproj_alt_px")
    found = square_poses(corner, np.full(len(corner), size), camera)
    shift, turn = apart(found.pose[0], theirs)
    other = apart(found.pose[1], theirs)[1]
    distance = np.linalg.norm(theirs[:, :3], axis=1)
    assert np.median(shift / distance) < 3e-4
    assert np.mean(shift / distance < 0.02) > 0.98
    assert np.median(turn) < 2e-3
    assert np.mean(np.minimum(turn, other) < 0.05) > 0.98
    assert np.mean(found.error_px[0] <= error[:, 0] + 2e-3) > 0.98  # no worse than before the refinement
    assert np.mean(found.error_px[1] <= error[:, 1] + 2e-3) > 0.98
    clear = error[:, 0] < 0.3  # of large errors the two measure differently, with and without distortion
    assert np.corrcoef(found.error_px[0][clear], error[clear, 0])[0, 1] > 0.75
