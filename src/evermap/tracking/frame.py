"""A frame: its detections, checked, as the kernels take them; and tables of many frames, from sensors that move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.types import UNKNOWN, Clock, FloatArray, IntArray, SpatialRecording
from evermap.valid import STAMP_S


class Frame(NamedTuple):
    """Detections of one frame.

    Attributes:
        stamp_s: when.
        position: (M, 3) in the world.
        noise: (M, 3, 3) covariances, or (1, 3, 3) for all.
        class_id: (M,) or `UNKNOWN`.
        appearance: (M, A) unit vectors, or zeros.
        box: (M, 4) length, width, height, heading; (M, 0) where the tracker follows points.
        box_noise: (M, 4) their variances.
        level: (M, 1) log odds by the score that a detection is real, inf without one; (M, 0) where none has a score.
    """

    stamp_s: float
    position: FloatArray
    noise: FloatArray
    class_id: IntArray
    appearance: FloatArray
    box: FloatArray
    box_noise: FloatArray
    level: FloatArray


def p_real_of(score: FloatArray, midpoint: float, scale: float) -> FloatArray:
    """Return (M,) probabilities that detections are real: scores themselves if all are in [0, 1], else logistic.

    Args:
        score: (M,) of one detector, nan for none.
        midpoint: score of even odds, where scores are any numbers.
        scale: score by which the log odds grow by one.
    """
    from scipy.special import expit

    given = score[~np.isnan(score)]
    if len(given) == 0 or (given.min() >= 0.0 and given.max() <= 1.0):
        return score
    return np.asarray(expit((score - midpoint) / scale))


def positions(values: Any) -> FloatArray:
    """Return (M, 3) finite positions; InputError for another shape, or a number that is not finite."""
    try:
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("not numbers", field="position_m", hint="three coordinates a detection") from error
    if array.size == 0:
        return np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"shape {array.shape} instead of (M, 3)", field="position_m")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise InputError(f"detection {row}: {array[row].tolist()} is not finite", field="position_m")
    return array


def _check_shape(array: Any, shape: tuple[int, ...], field: str, hint: str | None = None) -> None:
    if array.shape != shape:
        raise InputError(f"shape {array.shape} instead of {shape}", field=field, hint=hint)


def boxes(values: Any, m: int) -> FloatArray:
    """Return (M, 4) sizes and headings; InputError for another shape, a size not positive, a heading not finite."""
    array = np.ascontiguousarray(values, dtype=np.float64) if m else np.empty((0, 4))
    _check_shape(array, (m, 4), "box", hint="length, width, height, heading")
    wrong = np.flatnonzero(~(np.isfinite(array).all(axis=1) & (array[:, :3] > 0.0).all(axis=1)))
    if wrong.size:
        what = f"detection {wrong[0]}: {array[wrong[0]].tolist()} is not a box"
        raise InputError(what, field="box", hint="positive sizes [m] and a heading [rad]")
    return array


def probabilities(values: Any, m: int) -> FloatArray:
    """Return (M,) probabilities, nan where none is given; InputError for another shape, or no probability."""
    if values is None:
        return np.full(m, np.nan)
    array = np.asarray(values, dtype=np.float64)
    _check_shape(array, (m,), "p_real")
    wrong = np.flatnonzero((array < 0.0) | (array > 1.0))
    if wrong.size:
        raise InputError(f"detection {wrong[0]}: {array[wrong[0]]} is not a probability", field="p_real")
    return array


def classes(values: Any, m: int, n_classes: int) -> IntArray:
    """Return (M,) classes, `UNKNOWN` where none is given; InputError for another shape, or a class that is none."""
    if values is None:
        return np.full(m, UNKNOWN)
    array = np.asarray(values)
    _check_shape(array, (m,), "class_id")
    if array.size and array.dtype.kind not in "iu":
        raise InputError("classes are whole numbers", field="class_id")
    ids = array.astype(np.int64)
    if m and not (ids.min() >= UNKNOWN and ids.max() < n_classes):
        row = int(np.flatnonzero((ids < UNKNOWN) | (ids >= n_classes))[0])
        raise InputError(
            f"detection {row}: class {ids[row]} of {n_classes} does not exist",
            field="class_id",
            hint=f"0 to {n_classes - 1}, or {UNKNOWN} for unknown",
        )
    return ids


def covariances(values: Any, m: int, default: FloatArray) -> FloatArray:
    """Return (M, 3, 3) covariances, or `default` (1, 3, 3); InputError unless symmetric and positive definite."""
    if values is None or m == 0:
        return default
    array = np.ascontiguousarray(values, dtype=np.float64)
    _check_shape(array, (m, 3, 3), "covariance_m2")
    symmetric = np.isclose(array, array.transpose(0, 2, 1), rtol=1e-6, atol=1e-12).all(axis=(1, 2))
    minors = np.stack([array[:, 0, 0], np.linalg.det(array[:, :2, :2]), np.linalg.det(array)])
    wrong = np.flatnonzero(~(symmetric & (minors > 0.0).all(axis=0) & np.isfinite(array).all(axis=(1, 2))))
    if wrong.size:
        raise InputError(
            f"detection {wrong[0]}: the matrix is not symmetric and positive definite", field="covariance_m2"
        )
    return array


def appearances(values: Any, m: int, n_appearance: int) -> FloatArray:
    """Return (M, A) unit vectors, or zeros for a row without a finite length; InputError for another shape."""
    if values is None:
        return np.zeros((m, n_appearance))
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 and m == 0:
        return np.zeros((0, n_appearance))
    _check_shape(array, (m, n_appearance), "appearance")
    length = np.linalg.norm(array, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.ascontiguousarray(np.where((length > 0.0) & np.isfinite(length), array / length, 0.0))


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
        clock: of the stamps; a recording's own unless they are dates.
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
    clock: Clock = Clock.RECORDING

    @property
    def n_frames(self) -> int:
        """F."""
        return len(self.stamp_s)

    def __len__(self) -> int:
        return len(self.position_m)


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
        """Return (F, 7) poses, along the shortest screw; InputError for a stamp before the first or after the last."""
        outside = (stamp_s < self.stamp_s[0] - _NEAR_S) | (stamp_s > self.stamp_s[-1] + _NEAR_S)
        if outside.any():
            problem = f"has no pose at {stamp_s[np.argmax(outside)]:g} s, where there are detections"
            raise InputError(problem, path=self.path, field=STAMP_S.name, hint="poses from the first frame to the last")
        return se3.interpolate(self.stamp_s, self.pose, stamp_s)


def boxes_of(recording: SpatialRecording) -> IntArray:
    """Return rows of boxes without identity."""
    given = recording.detections
    return np.flatnonzero((given.landmark_id == UNKNOWN) & np.isfinite(given.size_m).all(axis=1))


def mounts_of(recording: SpatialRecording) -> FloatArray:
    """Return (M, 7) poses on the robot of the sensor of each detection."""
    return np.array([sensor.mount_robot_sensor for sensor in recording.sensors])[recording.detections.sensor]


def box_table(recording: SpatialRecording, range_scale: float = 1.0) -> DetectionTable:
    """Return the boxes of a recording, on the robot, as the tracker takes them; a frame of the recording each.

    Args:
        recording: with boxes.
        range_scale: by which measured ranges are too short.
    """
    given, rows, stamps = recording.detections, boxes_of(recording), recording.frames.stamp_s
    mount = mounts_of(recording)[rows]
    local = np.column_stack([range_scale * given.position_sensor_m[rows], given.rotation[rows]])
    local[:, 3:] = np.where(np.isfinite(local[:, 3:]), local[:, 3:], se3.NO_TURN)
    local = se3.compose(mount, local)
    names = recording.class_names or ("",)
    turn = se3.rotation_of(mount)
    covariance = turn @ given.covariance_sensor_m2[rows] @ turn.transpose(0, 2, 1)
    return DetectionTable(
        stamp_s=stamps,
        first=np.searchsorted(given.frame[rows], np.arange(len(stamps) + 1)),
        position_m=local[:, :3].copy(),
        class_names=names,
        class_id=given.class_id[rows],
        covariance_m2=covariance if np.isfinite(covariance).any() else None,
        appearance=None,
        sensor_m=None,
        line=given.source_line[rows],
        source=recording.source,
        box=np.column_stack([given.size_m[rows], heading_of(local)]),
        score=given.score[rows] if np.isfinite(given.score[rows]).any() else None,
        warnings=(),
        clock=recording.clock,
    )


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
        raise InputError("says where the sensor was", path=table.source or None, field="sensor_x_m", hint=hint)
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
    """Return stamps and numbers of detections of all frames, including those with a pose only."""
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
