"""Detections in the world, put together into frames: what a run of the tracker reads; and from a sensor that moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.text import counted
from evermap.types import FloatArray, IntArray
from evermap.valid import STAMP_S

_NEAR_S = 1e-3
"""Stamps of two tables that differ by less are the same."""
_FRAME_SHARE = 0.75
"""Poses that come at least this share of the detections' usual step apart are one a frame."""


@dataclass(frozen=True, slots=True)
class DetectionTable:
    """M detections in F frames, by time.

    Attributes:
        stamp_s: (F,) increasing.
        first: (F + 1,) where each frame's detections start; an empty frame has none.
        position_m: (M, 3) in the world.
        class_names: classes in use, in natural order; one without a name where the table names none.
        class_id: (M,) index into them, `UNKNOWN` where none is given.
        covariance_m2: (M, 3, 3) of the positions, nan where none is given; None if nowhere.
        appearance: (M, A) vectors, zeros where there is none; None if nowhere.
        sensor_m: (F, 3) where the sensor was; None where the table does not say.
        box: (M, 4) length, width, height [m] and heading in the world [rad]; None where detections are points.
        score: (M,) the detector's, nan where none is given; None where the table has none.
        sensor_yaw_rad: (F,) where the sensor looked; None where the table is in the world.
        line: (M,) line of each detection in the file.
        source: file it came from, '' if none.
        n_weak: detections left out because of their score.
        warnings: remarks of the reader.
    """

    stamp_s: FloatArray
    first: IntArray
    position_m: FloatArray
    class_names: tuple[str, ...]
    class_id: IntArray
    covariance_m2: FloatArray | None
    appearance: FloatArray | None
    sensor_m: FloatArray | None
    line: IntArray
    source: str
    box: FloatArray | None = None
    score: FloatArray | None = None
    sensor_yaw_rad: FloatArray | None = None
    n_weak: int = 0
    warnings: tuple[str, ...] = ()

    @property
    def n_frames(self) -> int:
        """F."""
        return len(self.stamp_s)

    def __len__(self) -> int:
        return len(self.position_m)


def said_of(table: DetectionTable) -> list[str]:
    """Return remarks on what was read: its own, and what was left out."""
    weak = [f"{counted(table.n_weak, 'detection')} of low score left out"] if table.n_weak else []
    return [*table.warnings, *weak]


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
    stamp_s, counts = with_empty_frames(stamp_s, counts, poses.stamp_s)
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


def with_empty_frames(stamp_s: FloatArray, counts: IntArray, pose_s: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return stamps and numbers of detections of all frames, those too of which only a pose tells."""
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
