"""What readers of recordings in space share: columns of poses and covariances, detections, tags' poses from corners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.geometry.camera import unproject
from evermap.geometry.group import accumulate
from evermap.geometry.square import with_square_poses
from evermap.io.assemble import forward_stamps, last_of_equal
from evermap.io.bad_rows import Flaw
from evermap.io.table import Table
from evermap.io.text import counted
from evermap.types import (
    ANY_RANGE_M2,
    UNKNOWN,
    Clock,
    FloatArray,
    IntArray,
    SpatialDetections,
    SpatialOdometry,
    SpatialSensor,
    Trajectory,
)
from evermap.valid import QUATERNION as QUANTITIES
from evermap.valid import STAMP_S, THETA_RAD, X_M, Y_M, Z_M, Quantity, is_covariance

AT = ("x_m", "y_m", "z_m")
QUATERNION = tuple(quantity.name for quantity in QUANTITIES)
BOX = ("length_m", "width_m", "height_m")
COVARIANCE = tuple(f"cov_{pair}_m2" for pair in ("xx", "xy", "xz", "yy", "yz", "zz"))
"""The upper triangle of a position's covariance, row by row."""
TURN_COVARIANCE = tuple(f"cov_{pair}_rad2" for pair in ("rxrx", "rxry", "rxrz", "ryry", "ryrz", "rzrz"))


def positions(table: Table, *, optional: bool = False) -> FloatArray:
    """Return the columns `x_m, y_m, z_m`. Shape (R, 3)."""
    table.expect(AT, tuple(table.columns))
    return np.stack([table.numbers(replace(axis, optional=optional)) for axis in (X_M, Y_M, Z_M)], axis=1)


def quaternions(table: Table, *, optional: bool = False) -> FloatArray:
    """Return the columns `qx, qy, qz, qw` as unit quaternions of the sign of `se3`. Shape (R, 4); nan where empty.

    Raises:
        InputError: a column is missing, or numbers are not a unit quaternion within a hundredth.
    """
    table.expect(QUATERNION, tuple(table.columns))
    for flaw in turn_flaws(table, optional=optional):
        if flaw.bad.any():
            raise flaw.error(int(np.argmax(flaw.bad)))
    given = np.stack([table.numbers(replace(one, optional=optional)) for one in QUANTITIES], axis=1)
    return unit(given)


def turn_flaws(table: Table, *, optional: bool = False) -> list[Flaw]:
    """Return the rows whose quaternion is none, of a table that has some; where `optional` it may be empty."""
    if not all(name in table for name in QUATERNION):
        return []
    given = np.stack([table.numbers(replace(one, optional=optional)) for one in QUANTITIES], axis=1)
    length = np.linalg.norm(given, axis=1)
    absent = np.isnan(given).all(axis=1)

    def error(row: int) -> InputError:
        odd = f"is not a unit quaternion, its length is {length[row]:g}"
        problem = "is incomplete" if np.isnan(length[row]) else odd
        return table.error(problem, row=row, field="qx, qy, qz, qw", hint="scalar last; all four or none")

    return [Flaw(~(np.abs(length - 1.0) <= 1e-2) & ~absent, error)]


def without_zero_turns(table: Table, warnings: list[str]) -> Table:
    """Return detections in which four zeros, as detectors write that know no orientation, are empty cells."""
    if not all(name in table for name in QUATERNION):
        return table
    given = np.stack([table.numbers(replace(one, optional=True)) for one in QUANTITIES], axis=1)
    zero = (given == 0.0).all(axis=1)
    if not zero.any():
        return table
    given[zero] = np.nan
    warnings.append(f"{table.path.name}: {counted(int(zero.sum()), 'orientation')} of four zeros taken as unknown")
    turned = dict(zip(QUATERNION, np.ascontiguousarray(given.T), strict=True))
    return replace(table, columns={**table.columns, **turned})


def unit(quaternion: FloatArray) -> FloatArray:
    """Return quaternions (..., 4) at unit length and of the sign of `se3`; those that have it keep every bit."""
    pose = np.concatenate([np.zeros((*quaternion.shape[:-1], 3)), quaternion], axis=-1)
    there = np.abs(np.linalg.norm(quaternion, axis=-1, keepdims=True) - 1.0) < 1e-12
    with np.errstate(invalid="ignore"):
        normal = se3.normalise_poses(pose)[..., 3:]
    same = np.where(np.sum(normal * quaternion, axis=-1, keepdims=True) < 0.0, -quaternion, quaternion)
    return np.where(there, same, normal)


def poses(table: Table) -> FloatArray:
    """Return the columns `x_m, y_m, z_m, qx, qy, qz, qw`. Shape (R, 7)."""
    return np.concatenate([positions(table), quaternions(table)], axis=1)


def pose_odometry(table: Table, variances: tuple[str, ...], clock: Clock, warnings: list[str]) -> SpatialOdometry:
    """Return the odometry in a table of poses, with the columns of their six variances as far as it has them."""
    table = table.screened((STAMP_S, X_M, Y_M, Z_M, *QUANTITIES), warnings)
    table = table.screened((), warnings, turn_flaws(table))
    stamp_s = forward_stamps(table)
    keep = last_of_equal(stamp_s, path=table.path, warnings=warnings)
    variance = [table.filled(Quantity(name, 0.0, 1e12, optional=True), np.nan) for name in variances]
    return SpatialOdometry(stamp_s[keep], poses(table)[keep], np.stack(variance, axis=1)[keep], clock=clock)


def true_poses(
    table: Table, clock: Clock, warnings: list[str], of: Callable[[Table], FloatArray] = poses
) -> Trajectory:
    """Return the truth in a table of poses (R, 3) or (R, 7), which a function reads."""
    table = table.screened((STAMP_S, X_M, Y_M, Z_M, THETA_RAD, *QUANTITIES), warnings)
    table = table.screened((), warnings, turn_flaws(table))
    stamp_s = forward_stamps(table)
    keep = last_of_equal(stamp_s, path=table.path, warnings=warnings)
    pose = of(table)[keep]
    size = 6 if pose.shape[1] == 7 else 3
    return Trajectory(stamp_s[keep], pose, np.zeros((len(pose), size, size)), frame="truth", clock=clock)


def sensor_rows(table: Table, column: str, sensors: Sequence[SpatialSensor], file: str) -> IntArray:
    """Return which of the sensors (R,) a column names.

    Raises:
        InputError: a name that `file` does not describe.
    """
    known = {sensor.name: row for row, sensor in enumerate(sensors)}
    of_row, labels = table.labels(column)
    for k, label in enumerate(labels):
        if label not in known:
            row, hint = int(np.argmax(of_row == k)), "one of " + ", ".join(known)
            raise table.error(f"no {column} '{label}' in {file}", row=row, field=column, hint=hint)
    return np.array([known[label] for label in labels], dtype=np.int64)[of_row]


def covariances(table: Table, names: tuple[str, ...], *, optional: bool = False) -> FloatArray | None:
    """Return matrices (R, K, K) from the columns of their upper triangle; None where there is no such column.

    Raises:
        InputError: a column is missing, or a matrix is not positive semidefinite.
    """
    if not table.has_any(names):
        return None
    table.expect(names, tuple(table.columns))
    size = {3: 2, 6: 3}[len(names)]
    cells = np.stack([table.numbers(Quantity(name, -1e12, 1e12, optional=optional)) for name in names], axis=1)
    covariance = np.empty((len(table), size, size))
    upper, right = np.triu_indices(size)
    covariance[:, upper, right] = covariance[:, right, upper] = cells
    # estimates of well-known landmarks may miss being positive by rounding
    wrong = np.flatnonzero(~is_covariance(covariance) & ~np.isnan(cells).all(axis=1))
    if len(wrong):
        raise table.error("is not a covariance: not positive semidefinite", row=int(wrong[0]), field=names[0])
    return covariance


def upper_triangle(matrix: FloatArray, names: tuple[str, ...]) -> dict[str, FloatArray]:
    """Return the columns from which `covariances` makes matrices (R, K, K)."""
    upper, right = np.triu_indices(matrix.shape[-1])
    return dict(zip(names, np.ascontiguousarray(matrix[:, upper, right].T), strict=True))


def boxes(table: Table, *, flat: bool = False) -> FloatArray:
    """Return the columns `length_m, width_m, height_m`, of which none is zero unless `flat`. Shape (R, 3), nan where
    empty.
    """
    table.expect(BOX, tuple(table.columns))
    sides = (Quantity(name, 0.0, 1e4, positive=not flat, optional=True, hint="metres") for name in BOX)
    return np.stack([table.numbers(side) for side in sides], axis=1)


def spatial_detections(frame: IntArray, **given: Any) -> SpatialDetections:
    """Return detections in frames (M,) with the given columns: in all others ids are `UNKNOWN` and numbers nan."""
    count = len(frame)
    shapes: dict[str, tuple[int, ...]] = {
        "position_sensor_m": (3,), "rotation": (4,), "covariance_sensor_m2": (3, 3), "sigma_rad": (),
        "corner_px": (4, 2), "tag_size_m": (), "size_m": (3,), "score": (),
    }  # fmt: skip
    columns: dict[str, Any] = {
        "sensor": np.zeros(count, dtype=np.int64),
        "landmark_id": np.full(count, UNKNOWN),
        "class_id": np.full(count, UNKNOWN),
        "source_line": np.zeros(count, dtype=np.int64),
        **{name: np.full((count, *shape), np.nan) for name, shape in shapes.items()},
    }
    return SpatialDetections(frame=frame, **{**columns, **given})


def with_tag_poses(
    detections: SpatialDetections, sensors: Sequence[SpatialSensor], warnings: list[str]
) -> SpatialDetections:
    """Return the detections with the better pose of every tag of which only corners were given.

    Tags whose corners cannot be those of a square ahead of the camera, or whose size is not known, are left out;
    `warnings` gets their number.
    """
    wanted = np.asarray(np.isnan(detections.position_sensor_m).any(axis=1))
    wanted &= np.isfinite(detections.corner_px).all(axis=(1, 2))
    filled = with_square_poses(detections, sensors, wanted)
    sizeless = wanted & np.isnan(detections.tag_size_m)
    broken = wanted & ~sizeless & np.isnan(filled.position_sensor_m).any(axis=1)
    if sizeless.any():
        ids = np.unique(detections.landmark_id[sizeless])
        shown = ", ".join(map(str, ids[:5].tolist())) + (", ..." if len(ids) > 5 else "")
        warnings.append(f"{counted(int(sizeless.sum()), 'tag')} of unknown size left out (ids {shown})")
    if broken.any():
        warnings.append(f"{counted(int(broken.sum()), 'tag')} left out: their corners are not those of a square")
    return filled[~sizeless & ~broken] if (sizeless | broken).any() else filled


def directions(pixel: FloatArray, sensor: IntArray, sensors: Sequence[SpatialSensor]) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors (M, 3) to points that one camera saw, with the covariance of a pixel across, and any range.

    Args:
        pixel: (M, 2) right and down in the image.
        sensor: (M,) rows of sensors.
        sensors: those that are no cameras see nothing: nan.
    """
    position, covariance = np.full((len(pixel), 3), np.nan), np.full((len(pixel), 3, 3), np.nan)
    for number, one in enumerate(sensors):
        rows = np.flatnonzero(sensor == number)
        if len(rows) and one.intrinsics is not None:
            ray = unproject(pixel[rows], one)
            along = ray[:, :, None] * ray[:, None, :]
            sigma = (one.sigma_px or 1.0) / float(np.mean(one.intrinsics[:2]))
            position[rows] = ray
            covariance[rows] = sigma**2 * (np.eye(3) - along) + 1e3 * ANY_RANGE_M2 * along
    return position, covariance


def integrated(stamp_s: FloatArray, twist: FloatArray, clock: Clock) -> SpatialOdometry:
    """Return poses from the origin, each velocity (N, 6) held until the next stamp."""
    pose = accumulate(se3.exp(twist[:-1] * np.diff(stamp_s)[:, None]))
    return SpatialOdometry(stamp_s, pose, np.full((len(pose), 6), np.nan), clock=clock)


def of_rig(odometry: SpatialOdometry, mount: FloatArray) -> SpatialOdometry:
    """Return poses of the robot from those of the odometry's body, mounted at a pose (7,) on it.

    Variances, which ROS states along the axes of the odometry's frame, become those along the robot's.
    """
    pose = se3.compose(odometry.pose_world_robot, se3.inverse(mount))
    share = se3.rotation_of(pose) ** 2
    variance = [np.einsum("nij,ni->nj", share, half) for half in (odometry.variance[:, :3], odometry.variance[:, 3:])]
    return replace(odometry, pose_world_robot=pose, variance=np.concatenate(variance, axis=1))
