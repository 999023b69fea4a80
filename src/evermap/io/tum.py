"""Trajectories in the TUM format: a line a pose, `stamp x y z qx qy qz qw`, understood by evo and most SLAM tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evermap.errors import DataError, InputError
from evermap.io.assemble import check_forward, last_of_equal
from evermap.io.files import write_atomic
from evermap.io.rows import parse_rows
from evermap.types import Clock, Trajectory
from evermap.valid import STAMP_S, X_M, Y_M, Quantity

_QUATERNION = tuple(Quantity(f"q{axis}", -2.0, 2.0, hint="a unit quaternion, scalar last") for axis in "xyzw")
_COLUMNS = (STAMP_S, X_M, Y_M, Quantity("z_m", -1e8, 1e8), *_QUATERNION)


def write_tum(trajectory: Trajectory, path: str | Path) -> Path:
    """Write a trajectory with z = 0 and rotations about z; covariances have no place in this format.

    Numbers are written in the shortest form that reads back the same.
    """
    half = trajectory.pose_world_robot[:, 2] / 2.0
    columns = (trajectory.stamp_s, *trajectory.pose_world_robot[:, :2].T, np.sin(half), np.cos(half))
    rows = zip(*(column.tolist() for column in columns), strict=True)
    lines = [f"{stamp!r} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}\n" for stamp, x, y, qz, qw in rows]
    return write_atomic(path, "".join(lines))


def read_tum(path: str | Path, *, frame: str = "truth", clock: Clock = Clock.RECORDING) -> Trajectory:
    """Return a trajectory with its heading taken from the quaternion (z and tilt are left out) and zero covariance.

    Raises:
        InputError: the file is missing or malformed, time runs backwards, or a quaternion is not of unit length.
        DataError: it holds no pose.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", path=path) from error
    rows = parse_rows(data, path, _COLUMNS, [])
    if len(rows) == 0:
        raise DataError("holds no pose", path=path)
    check_forward(rows.column(0), path=path, line=rows.line)
    values = rows.values[last_of_equal(rows.column(0), path=path, warnings=[])]
    off_unit = np.flatnonzero(np.abs(np.linalg.norm(rows.values[:, 4:], axis=1) - 1.0) > 0.01)
    if len(off_unit):
        raise rows.error("is not a unit quaternion", row=int(off_unit[0]), field="qx qy qz qw")
    qx, qy, qz, qw = values[:, 4:].T
    theta = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2))
    pose = np.stack([values[:, 1], values[:, 2], theta], axis=1)
    stamps = np.ascontiguousarray(values[:, 0])
    return Trajectory(stamps, pose, np.zeros((len(values), 3, 3)), frame=frame, clock=clock)
