"""Incoming readings in space: poses of the odometry; points, poses and corners of landmarks. As `inbox`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from evermap.config import Config
from evermap.errors import InputError
from evermap.geometry import se3
from evermap.live.inbox import Inbox, LiveFrame, check_number
from evermap.types import (
    UNKNOWN,
    FloatArray,
    Frames,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
)
from evermap.valid import STAMP_S, check_frame_in_space

WIDTHS: Mapping[str, tuple[int, ...]] = {
    "position_sensor_m": (3,), "rotation": (4,), "covariance_sensor_m2": (3, 3), "sigma_rad": (),
    "corner_px": (4, 2), "tag_size_m": (),
}  # fmt: skip
"""Columns of numbers behind id, sensor and class, and their shapes."""


class SpatialInbox(Inbox):
    """Readings in space. A row of odometry is a stamp and a pose (7,); see `detections_of` for those of a frame."""

    def __init__(self, about: SpatialRecording, config: Config) -> None:
        super().__init__(about, config, width=8)
        self._rig: tuple[SpatialSensor, ...] = about.sensors
        self._driven: tuple[float, FloatArray, FloatArray] | None = None

    def pose(self, stamp_s: float, pose: Any) -> None:
        """Add a pose (7,) of the odometry.

        Raises:
            InputError: no pose, or the stamp is before frames that were processed.
        """
        check_number(STAMP_S, stamp_s)
        given = np.asarray(pose, dtype=np.float64)
        if given.shape != (7,) or not np.isfinite(given).all() or abs(np.linalg.norm(given[3:]) - 1.0) > 1e-3:
            raise InputError(f"{pose} is not a pose", field="pose", hint="x, y, z, qx, qy, qz, qw")
        row = float(stamp_s), *se3.normalise_poses(given).tolist()
        with self._lock:
            self._refuse_late(row[0], "odometry")
            self._in_time(row[0], partial(self._put_odometry, row, -np.inf))

    def twist(self, stamp_s: float, twist: Any) -> None:
        """Add velocities (6,) along and about the robot's axes, which hold from a stamp on, until the next ones.

        Raises:
            InputError: no finite numbers, or not in the order of their stamps.
        """
        check_number(STAMP_S, stamp_s)
        given = np.asarray(twist, dtype=np.float64)
        if given.shape != (6,) or not np.isfinite(given).all():
            raise InputError(f"{twist} is not a twist", field="twist", hint="metres and radians a second, x, y, z each")
        with self._lock:
            pose = se3.identity()
            if self._driven is not None:
                since_s, before, speed = self._driven
                if stamp_s <= since_s:
                    hint = "velocities in space in the order of their stamps, or poses"
                    raise InputError(f"{stamp_s:.3f} s is not after {since_s:.3f} s", field="stamp_s", hint=hint)
                pose = se3.retract(before, (stamp_s - since_s) * speed)
            self._driven = float(stamp_s), pose, given
        self.pose(stamp_s, pose)

    def _rows(self, *columns: Any) -> FloatArray:
        """(M, 29) id, sensor, class and `WIDTHS` of the detections of a frame."""
        ids, classes, sensors, given = columns
        names = [ids] if isinstance(ids, str) else list(ids)
        count = len(names)
        about = [np.array([self._number(name) for name in names], dtype=np.float64)]
        which = np.broadcast_to(np.asarray(0 if sensors is None else sensors), (count,))
        labels: Sequence[Any] = [None] * count if classes is None else list(classes)
        if len(labels) != count:
            raise InputError(
                f"{len(labels)} values for {count} detections", field="class_name", hint="one per detection"
            )
        about += [which.astype(np.float64), np.array([self._class(one) for one in labels], dtype=np.float64)]
        parts: dict[str, FloatArray] = {}
        for name, shape in WIDTHS.items():
            value = given.get(name)
            parts[name] = np.full((count, *shape), np.nan)
            if value is not None:
                told = np.asarray(value, dtype=np.float64)
                if told.shape != (count, *shape):
                    problem = f"shape {told.shape} instead of {(count, *shape)}"
                    raise InputError(problem, field=name, hint="one row per detection")
                parts[name] = told
        flat = [part.reshape(count, int(np.prod(part.shape[1:]))) for part in parts.values()]
        rows = np.hstack([np.column_stack(about), *flat]) if count else np.zeros((0, row_width()))
        if count:
            check_frame_in_space(detections_of(rows, np.zeros(count, dtype=np.int64)), len(self._rig))
        return rows

    def _record(
        self, odometry: FloatArray, frames: list[LiveFrame], classes: tuple[str, ...], texts: dict[int, str]
    ) -> Any:
        about, clock = self._about, self._about.clock
        rows = np.concatenate([np.zeros((0, row_width())), *(one.rows for one in frames)])
        frame = np.repeat(np.arange(len(frames)), [len(one.rows) for one in frames])
        path = SpatialOdometry(
            np.ascontiguousarray(odometry[:, 0]), odometry[:, 1:], np.full((len(odometry), 6), np.nan), clock
        )
        return Recording(
            about.name, path, Frames(np.array([one.stamp_s for one in frames]), clock=clock),
            detections_of(rows, frame), sensors=self._rig, class_names=classes, clock=clock, landmark_names=texts,
            symmetries=about.symmetries,
        )  # fmt: skip


def row_width() -> int:
    """Return the numbers of a detection."""
    return 3 + sum(int(np.prod(shape)) for shape in WIDTHS.values())


def detections_of(rows: FloatArray, frame: Any) -> SpatialDetections:
    """Return the detections (M, 29) of frames (M,) as a table."""
    count, at = len(rows), 3
    parts: dict[str, Any] = {}
    for name, shape in WIDTHS.items():
        size = int(np.prod(shape))
        parts[name] = np.ascontiguousarray(rows[:, at : at + size]).reshape(count, *shape)
        at += size
    nothing = np.full(count, np.nan)
    return SpatialDetections(
        frame=frame,
        sensor=rows[:, 1].astype(np.int64),
        landmark_id=rows[:, 0].astype(np.int64),
        class_id=np.where(np.isfinite(rows[:, 2]), rows[:, 2], UNKNOWN).astype(np.int64),
        size_m=np.full((count, 3), np.nan),
        score=nothing,
        source_line=np.zeros(count, dtype=np.int64),
        **parts,
    )
