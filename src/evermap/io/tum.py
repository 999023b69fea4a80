"""Trajectories in the TUM format: a line a pose, `stamp x y z qx qy qz qw`, understood by evo and most SLAM tools."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from evermap.errors import DataError
from evermap.geometry import se3
from evermap.io.assemble import check_forward, last_of_equal
from evermap.io.files import content_of, write_atomic
from evermap.io.spatial import unit
from evermap.io.text import Rows, parse_rows
from evermap.types import Clock, FloatArray, Trajectory
from evermap.valid import QUATERNION, STAMP_S, X_M, Y_M, Z_M

_COLUMNS = (STAMP_S, X_M, Y_M, Z_M, *QUATERNION)


def write_tum(trajectory: Trajectory, path: str | Path) -> Path:
    """Write a trajectory, one of the plane with z = 0 and rotations about z; covariances have no place in this format.

    Numbers are written in the shortest form that reads back the same.
    """
    pose, lines = trajectory.pose_world_robot, []
    in_plane = pose.shape[1] == 3
    poses = (se3.from_plane(pose) if in_plane else pose).tolist()
    for stamp, row in zip(trajectory.stamp_s.tolist(), poses, strict=True):
        words = [*map(repr, (stamp, *row))]
        if in_plane:
            words[3:6] = "0", "0", "0"
        lines.append(" ".join(words) + "\n")
    return write_atomic(path, "".join(lines))


def read_tum(
    path: str | Path, *, frame: str = "truth", clock: Clock = Clock.RECORDING, in_space: bool = False
) -> Trajectory:
    """Return a trajectory with zero covariance, from a file that may be gzipped.

    Unless it is to be `in_space`, the heading is taken from the quaternion, and z and tilt are left out.

    Raises:
        InputError: the file is missing or malformed, time runs backwards, or a quaternion is not of unit length.
        DataError: it contains no pose.
    """
    path = Path(path)
    rows = pose_rows(content_of(path), path, [])
    stamps, pose = poses_in_order(rows, [])
    if in_space:
        return Trajectory(stamps, pose, np.zeros((len(pose), 6, 6)), frame=frame, clock=clock)
    qx, qy, qz, qw = pose[:, 3:].T
    theta = np.arctan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy**2 + qz**2))
    planar = np.stack([pose[:, 0], pose[:, 1], theta], axis=1)
    return Trajectory(stamps, planar, np.zeros((len(pose), 3, 3)), frame=frame, clock=clock)


def poses_in_order(rows: Rows, warnings: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return stamps (N,) and poses (N, 7) of the rows of a TUM file; `warnings` counts repeated stamps.

    Raises:
        InputError: time runs backwards.
        DataError: there is no pose.
    """
    if len(rows) == 0:
        raise DataError("contains no pose", path=rows.path)
    check_forward(rows.column(0), path=rows.path, line=rows.line)
    values = rows.values[last_of_equal(rows.column(0), path=rows.path, warnings=warnings)]
    return np.ascontiguousarray(values[:, 0]), np.ascontiguousarray(values[:, 1:])


def pose_rows(data: bytes, path: Path, warnings: list[str], *, zeros: bool = False) -> Rows:
    """Return the rows of a TUM file, stamp and pose, with quaternions at unit length.

    `warnings` gets a remark on an unfinished last line; `zeros`: seven zeros may stand for no pose.

    Raises:
        InputError: a line is malformed, or a quaternion is not of unit length within a hundredth.
    """
    rows = parse_rows(data, path, _COLUMNS, warnings)
    wrong = np.abs(np.linalg.norm(rows.values[:, 4:], axis=1) - 1.0) > 0.01
    if zeros:
        wrong &= rows.values[:, 1:].any(axis=1)
    if wrong.any():
        raise rows.error("is not a unit quaternion", row=int(np.argmax(wrong)), field="qx qy qz qw")
    values = rows.values.copy()
    given = values[:, 4:].any(axis=1)
    values[given, 4:] = unit(values[given, 4:])
    return replace(rows, values=values)
