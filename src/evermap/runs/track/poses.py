"""Detections in the frame of a sensor that moves: its poses, and the same detections in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.columns import read_columns
from evermap.runs.track.detections import POSITION, DetectionTable, read_detections
from evermap.types import FloatArray, IntArray
from evermap.valid import STAMP_S, Quantity

_QUATERNION = tuple(Quantity(name, -2.0, 2.0, hint="a unit quaternion") for name in ("qx", "qy", "qz", "qw"))
_PLACE = tuple(Quantity(quantity.name, quantity.low, quantity.high, hint="metres") for quantity in POSITION)
_NEAR_S = 1e-3
"""Stamps of two tables that differ by less are the same."""
_FRAME_SHARE = 0.75
"""Poses that come at least this share of the detections' usual step apart are one a frame."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of a sensor.

    Attributes:
        stamp_s: (P,) increasing.
        pose: (P, 7) `x, y, z, qx, qy, qz, qw` of the sensor in the world.
        path: the file.
    """

    stamp_s: FloatArray
    pose: FloatArray
    path: Path

    def at(self, stamp_s: FloatArray) -> FloatArray:
        """Return (F, 7) poses, interpolated along the shortest screw.

        Raises:
            InputError: a stamp before the first or after the last pose.
        """
        outside = (stamp_s < self.stamp_s[0] - _NEAR_S) | (stamp_s > self.stamp_s[-1] + _NEAR_S)
        if outside.any():
            problem = f"has no pose at {stamp_s[np.argmax(outside)]:g} s, where there are detections"
            raise InputError(problem, path=self.path, field=STAMP_S.name, hint="poses from the first frame to the last")
        return se3.interpolate(self.stamp_s, self.pose, stamp_s)


def read_input(path: str | Path, *, min_score: float | None = None) -> DetectionTable:
    """Return the detections of a table, or of a folder with the tables `detections`, in a sensor's frame, and
    `odometry`, its poses.

    Args:
        path: what `read_detections` takes, or a folder.
        min_score: detections with a lower score are left out.

    Raises:
        InputError: a folder without these tables, or anything wrong in them.
    """
    if not Path(path).is_dir():
        return read_detections(path, min_score=min_score)
    detections = read_detections(_table_of(Path(path), "detections"), min_score=min_score)
    return in_world(detections, read_poses(_table_of(Path(path), "odometry")))


def _table_of(folder: Path, name: str) -> Path:
    """Return the table of a name in a folder, of whichever kind it is."""
    for ending in (".csv", ".csv.gz", ".parquet"):
        if (folder / f"{name}{ending}").is_file():
            return folder / f"{name}{ending}"
    hint = "detections.csv in the sensor's frame and odometry.csv, or the table itself for detections in the world"
    raise InputError(f"has no table '{name}'", path=folder, hint=hint)


def read_poses(path: Path) -> Poses:
    """Return a table with `stamp_s, x_m, y_m, z_m, qx, qy, qz, qw`; more columns are not read.

    Raises:
        InputError: anything wrong in the file, by line and column.
    """
    table = read_columns(path, [])
    table.expect((STAMP_S.name, *(q.name for q in (*_PLACE, *_QUATERNION))), tuple(table.cells))
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path, hint="one row a pose")
    stamp_s = table.numbers(STAMP_S)
    pose = np.stack([table.numbers(quantity) for quantity in (*_PLACE, *_QUATERNION)], axis=1)
    short = np.flatnonzero(np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1.0) > 1e-2)
    if short.size:
        raise table.error("is not of length one", row=int(short[0]), field="qx", hint="a unit quaternion")
    order = np.argsort(stamp_s, kind="stable")
    again = np.flatnonzero(np.diff(stamp_s[order]) <= 0.0)
    if again.size:
        problem = f"a second pose at {stamp_s[order[again[0]]]:g} s"
        raise table.error(problem, row=int(order[again[0] + 1]), field=STAMP_S.name)
    return Poses(stamp_s[order], se3.normalised(pose[order]), path)


def in_world(table: DetectionTable, poses: Poses) -> DetectionTable:
    """Return detections in the frame of a sensor as detections in the world.

    Boxes stay upright: of the sensor's attitude only its heading turns them. A pose without detections is a frame in
    which nothing was detected, unless poses come more often than frames do.

    Args:
        table: in the sensor's frame.
        poses: the sensor in the world, from the first frame to the last.

    Raises:
        InputError: a frame without a pose, or a table that says where the sensor was.
    """
    if table.sensor_m is not None:
        hint = "no columns sensor_x_m, sensor_y_m, sensor_z_m beside `odometry`"
        raise InputError("says where the sensor was", path=table.source, field="sensor_x_m", hint=hint)
    counts, stamp_s = np.diff(table.first), table.stamp_s
    stamp_s, counts = _with_empty_frames(stamp_s, counts, poses.stamp_s)
    pose = poses.at(stamp_s)
    of = np.repeat(pose, counts, axis=0)
    rotation, yaw_rad = se3.rotation_of(of), heading_of(pose)
    box, covariance = table.box, table.covariance_m2
    if box is not None:
        box = np.column_stack([box[:, :3], np.remainder(box[:, 3] + heading_of(of) + np.pi, 2.0 * np.pi) - np.pi])
    if covariance is not None:
        covariance = rotation @ covariance @ rotation.transpose(0, 2, 1)
    return replace(
        table,
        stamp_s=stamp_s,
        first=np.concatenate([[0], np.cumsum(counts)]),
        position_m=se3.transform(of, table.position_m),
        covariance_m2=covariance,
        sensor_m=pose[:, :3].copy(),
        box=box,
        sensor_yaw_rad=yaw_rad,
    )


def _with_empty_frames(stamp_s: FloatArray, counts: IntArray, pose_s: FloatArray) -> tuple[FloatArray, IntArray]:
    """Stamps and numbers of detections of all frames, those too of which only a pose tells."""
    if len(pose_s) < 2 or (
        len(stamp_s) > 1 and np.median(np.diff(pose_s)) < _FRAME_SHARE * float(np.median(np.diff(stamp_s)))
    ):
        return stamp_s, counts
    after = np.searchsorted(stamp_s, pose_s)
    beside = stamp_s[np.clip(np.stack([after, after - 1]), 0, len(stamp_s) - 1)]
    empty = pose_s[np.abs(beside - pose_s).min(axis=0) > _NEAR_S]
    order = np.argsort(np.concatenate([stamp_s, empty]), kind="stable")
    return (
        np.concatenate([stamp_s, empty])[order],
        np.concatenate([counts, np.zeros(len(empty), dtype=np.int64)])[order],
    )


def heading_of(pose: FloatArray) -> FloatArray:
    """Return (F,) angles [rad] of the x axes of poses (F, 7) from above."""
    ahead = se3.rotation_of(pose)[..., 0]
    return np.arctan2(ahead[..., 1], ahead[..., 0])
