"""The poses of a square tag that explain its four corners in an image: usually two, of which one is nearer.

A square that is far away, or seen head on, looks the same when it is tilted the other way. Both poses follow in closed
form from the homography of the plane (Collins, Bartoli: Infinitesimal Plane-Based Pose Estimation, IJCV 109, 2014) and
are refined by Gauss-Newton on the pixels, damped after Levenberg and Marquardt.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.geometry import se3
from evermap.geometry.camera import project, unproject
from evermap.types import BoolArray, FloatArray, SpatialDetections, SpatialSensor

CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""Corners of a square of edge 1 in its own frame (x right, y up, z towards who looks at it), in the order of
`SpatialDetections.corner_px`: counter-clockwise from the lower left as one looks at it."""

_STEPS = 20
_FEW = 5000
"""Squares of one call up to which its poses are kept: 700 bytes each."""


class SquarePoses(NamedTuple):
    """The two poses of each square, the better first; both are the same where only one explains the view.

    Attributes:
        pose: (2, M, 7) of the square in the camera's frame; nan where the corners are those of no square ahead.
        error_px: (2, M) root mean square of the eight residuals of the corners.
        information: (2, M, 6, 6) of `pose` (right perturbation, se3), for corners of a standard deviation of 1 px.
    """

    pose: FloatArray
    error_px: FloatArray
    information: FloatArray


def square_poses(corner_px: FloatArray, size_m: FloatArray, sensor: SpatialSensor) -> SquarePoses:
    """Return the poses of square tags, with edges (M,), in the camera's frame.

    Corners (M, 4, 2) are in the order of `SpatialDetections.corner_px`. A run asks for the poses of the same corners
    once for each cause that it considers, so those of the last calls are kept: they can't be written to.
    """
    corner_px, size_m = np.asarray(corner_px, dtype=np.float64), np.asarray(size_m, dtype=np.float64)
    lens = SpatialSensor(
        intrinsics=sensor.intrinsics, distortion=tuple(sensor.distortion), distortion_model=sensor.distortion_model
    )
    if len(size_m) > _FEW:
        return _square_poses(corner_px, size_m, lens)
    return _solve_once(corner_px.tobytes(), size_m.tobytes(), lens)


@functools.lru_cache(maxsize=16)
def _solve_once(corner_px: bytes, size_m: bytes, lens: SpatialSensor) -> SquarePoses:
    found = _square_poses(np.frombuffer(corner_px).reshape(-1, 4, 2), np.frombuffer(size_m), lens)
    for array in found:
        array.flags.writeable = False
    return found


def _square_poses(corner_px: FloatArray, size_m: FloatArray, sensor: SpatialSensor) -> SquarePoses:
    ray = unproject(corner_px, sensor)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(ray[..., 2:] > 0.0, ray[..., :2] / ray[..., 2:], np.nan)
        start = _infinitesimal(plane, size_m)
    corner_m = CORNERS * size_m[:, None, None]
    solved = [_refine_poses(pose, corner_m, corner_px, sensor) for pose in start]
    pose, error, information = (np.stack(each) for each in zip(*solved, strict=True))
    order = np.argsort(np.where(np.isnan(error), np.inf, error), axis=0, kind="stable")
    rows = np.arange(len(size_m))
    return SquarePoses(pose[order, rows], error[order, rows], information[order, rows])


def with_square_poses(
    detections: SpatialDetections, sensors: Sequence[SpatialSensor], wanted: BoolArray
) -> SpatialDetections:
    """Return detections (M,) with the better pose by their corners of those `wanted` whose camera is calibrated."""
    position, rotation = detections.position_sensor_m.copy(), detections.rotation.copy()
    for number, sensor in enumerate(sensors):
        rows = np.flatnonzero(wanted & (detections.sensor == number))
        if len(rows) and sensor.intrinsics is not None:
            found = square_poses(detections.corner_px[rows], detections.tag_size_m[rows], sensor).pose[0]
            position[rows], rotation[rows] = found[:, :3], found[:, 3:]
    return replace(detections, position_sensor_m=position, rotation=rotation)


def _infinitesimal(plane: FloatArray, size_m: FloatArray) -> FloatArray:
    """Both poses (2, M, 7) from corners (M, 4, 2) in units of the focal length: section 3 of the paper."""
    homography = _homography(plane)
    at, row = homography[:, :2, 2], homography[:, 2, :2]
    slope = homography[:, :2, :2] - at[:, :, None] * row[:, None, :]
    turn = _to_axis(at)
    narrow = turn[:, :2, :2] - at[:, :, None] * turn[:, 2:, :2]
    flat = _solve_systems(np.where(np.isfinite(narrow), narrow, np.eye(2)), slope)
    gram = np.swapaxes(flat, 1, 2) @ flat
    trace = gram[:, 0, 0] + gram[:, 1, 1]
    determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] * gram[:, 1, 0]
    largest = 0.5 * (trace + np.sqrt(np.maximum(trace**2 - 4.0 * determinant, 0.0)))
    flat = flat / np.sqrt(largest)[:, None, None]
    rest = np.eye(2) - np.swapaxes(flat, 1, 2) @ flat
    lift = np.sqrt(np.maximum(rest[:, [0, 1], [0, 1]], 0.0))
    lift[:, 1] *= np.where(rest[:, 0, 1] < 0.0, -1.0, 1.0)
    poses = []
    for sign in (1.0, -1.0):
        first = np.concatenate([flat, sign * lift[:, None, :]], axis=1)
        rotation = turn @ np.concatenate([first, np.cross(first[..., 0], first[..., 1])[..., None]], axis=2)
        position = _position(rotation, plane, size_m)
        poses.append(np.concatenate([position, _quaternion(rotation)], axis=1))
    return np.stack(poses)


def _homography(plane: FloatArray) -> FloatArray:
    """Matrices (M, 3, 3) that take the unit square's (x, y, 1) to the corners (M, 4, 2), with a last element of 1."""
    x, y = CORNERS[:, 0], CORNERS[:, 1]
    system = np.zeros((len(plane), 4, 2, 8))
    for axis in range(2):
        system[:, :, axis, 3 * axis : 3 * axis + 3] = np.stack([x, y, np.ones(4)], axis=1)
        system[:, :, axis, 6] = -x * plane[:, :, axis]
        system[:, :, axis, 7] = -y * plane[:, :, axis]
    matrix = system.reshape(-1, 8, 8)
    fine = np.flatnonzero(np.isfinite(matrix).all(axis=(1, 2)))
    fine = fine[np.abs(np.linalg.det(matrix[fine])) > 1e-14]
    found = np.full((len(plane), 8), np.nan)
    found[fine] = np.linalg.solve(matrix[fine], plane.reshape(-1, 8, 1)[fine])[..., 0]
    return np.concatenate([found, np.ones((len(plane), 1))], axis=1).reshape(-1, 3, 3)


def _to_axis(at: FloatArray) -> FloatArray:
    """The smallest rotations (M, 3, 3) that turn the optical axis to points (M, 2) of the image plane."""
    x, y = at[:, 0], at[:, 1]
    length = np.sqrt(x * x + y * y + 1.0)
    x, y, z = x / length, y / length, 1.0 / length
    turn = np.empty((len(at), 3, 3))
    turn[:, 0, 0], turn[:, 1, 1], turn[:, 2, 2] = 1.0 - x * x / (1.0 + z), 1.0 - y * y / (1.0 + z), z
    turn[:, 0, 1] = turn[:, 1, 0] = -x * y / (1.0 + z)
    turn[:, 0, 2], turn[:, 1, 2] = x, y
    turn[:, 2, 0], turn[:, 2, 1] = -x, -y
    return turn


def _position(rotation: FloatArray, plane: FloatArray, size_m: FloatArray) -> FloatArray:
    """Positions (M, 3) by linear least squares on `plane * z = (x, y)` at the corners."""
    corner = np.einsum("mij,kj->mki", rotation, CORNERS) * size_m[:, None, None]
    system = np.zeros((len(plane), 4, 2, 3))
    system[..., 0, 0] = system[..., 1, 1] = 1.0
    system[..., 2] = -plane
    wanted = (plane * corner[..., 2:] - corner[..., :2]).reshape(-1, 8, 1)
    matrix = system.reshape(-1, 8, 3)
    across = np.swapaxes(matrix, 1, 2)
    normal = across @ matrix
    normal = np.where(np.isfinite(normal).all(axis=(1, 2), keepdims=True), normal, np.eye(3))
    return _solve_systems(normal, across @ wanted)[..., 0]


def _refine_poses(
    pose: FloatArray, corner_m: FloatArray, corner_px: FloatArray, sensor: SpatialSensor
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses (M, 7) at the nearest minimum of the reprojection error, these errors (M,) and information (M, 6, 6)."""
    pose = pose.copy()
    residual, normal, gradient = _linearise_errors(pose, corner_m, corner_px, sensor)
    damping = np.full(len(pose), 1e-6)
    rows = np.flatnonzero(np.isfinite(residual))
    for _ in range(_STEPS):
        diagonal = np.einsum("mii->mi", normal[rows])
        damped = normal[rows] + np.einsum("mi,ij->mij", damping[rows, None] * diagonal + 1e-12, np.eye(6))
        step = -_solve_systems(damped, gradient[rows][..., None])[..., 0]
        going = -np.sum(gradient[rows] * step, axis=1) > 1e-10 * residual[rows] + 1e-18  # what the step would gain
        rows, step = rows[going], step[going]
        if not len(rows):
            break
        tried = se3.retract(pose[rows], step)
        after = _linearise_errors(tried, corner_m[rows], corner_px[rows], sensor)
        better = (after[0] < residual[rows]) & (tried[:, 2] > 0.0)
        gained = rows[better]
        pose[gained], residual[gained] = tried[better], after[0][better]
        normal[gained], gradient[gained] = after[1][better], after[2][better]
        damping[rows] *= np.where(better, 0.1, 10.0)
    return pose, np.sqrt(residual / 8.0), normal


def _linearise_errors(
    pose: FloatArray, corner_m: FloatArray, corner_px: FloatArray, sensor: SpatialSensor
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum of squares (M,), its normal matrices (M, 6, 6) and gradients (M, 6) by the perturbation of the pose."""
    point = se3.transform(pose[:, None], corner_m)
    pixel, slope = project(point, sensor)
    miss = (pixel - corner_px).reshape(-1, 8)
    rotation = se3.rotation_of(pose)[:, None]
    by_shift = slope @ rotation
    # the derivative of `rotation exp(w) corner` by w is that of the shift, crossed with the corner
    by_turn = np.cross(corner_m[:, :, None, :], by_shift)
    jacobian = np.concatenate([by_shift, by_turn], axis=-1).reshape(-1, 8, 6)
    across = np.swapaxes(jacobian, 1, 2)
    return np.sum(miss * miss, axis=1), across @ jacobian, (across @ miss[..., None])[..., 0]


def _quaternion(rotation: FloatArray) -> FloatArray:
    """Quaternions (M, 4) of rotation matrices (M, 3, 3): the column of the largest norm of a matrix of rank one."""
    r = rotation
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    outer = np.empty((len(r), 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[:, i, i] = 1.0 + 2.0 * r[:, i, i] - trace
        outer[:, i, j] = outer[:, j, i] = r[:, i, j] + r[:, j, i]
        outer[:, i, 3] = outer[:, 3, i] = r[:, k, j] - r[:, j, k]
    outer[:, 3, 3] = 1.0 + trace
    best = np.argmax(np.einsum("mii->mi", outer), axis=1)
    column = outer[np.arange(len(r)), best]
    return np.asarray(column / np.linalg.norm(column, axis=1, keepdims=True))


def _solve_systems(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solutions (M, K, L) of systems (M, K, K), nan of those that have none: corners that are hardly a square."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        found = np.full(right.shape, np.nan)
        fine = np.linalg.slogdet(matrix)[0] != 0.0
        found[fine] = np.linalg.solve(matrix[fine], right[fine])
        return found
