"""What a number may be: its name, its limits, and what a violation usually means. And what a recording has to be.

Readers of files and entry points from Python use the same: a reader knows file and line, an array its row. The limits
are far beyond any robot. They catch wrong units (degrees, milliseconds, millimetres) and damaged files.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, pi
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import DataError, InputError
from evermap.types import UNKNOWN, FloatArray, IntArray, Landmarks, Recording, Sensor, Trajectory


@dataclass(frozen=True, slots=True)
class Quantity:
    """A numeric column.

    Attributes:
        name: column name, with its unit.
        low, high: inclusive limits, unless `positive`, which excludes zero and below.
        positive: whether values must be greater than zero.
        optional: whether a cell may be empty (nan then).
        hint: what to try when a value is out of its limits.
        dates: whether a cell may be a date (ISO 8601) instead of seconds.
    """

    name: str
    low: float = -inf
    high: float = inf
    positive: bool = False
    optional: bool = False
    hint: str = ""
    dates: bool = False

    def check(self, values: FloatArray, *, path: Path, line: IntArray) -> None:
        """Raise InputError at the first value that is not finite (or not given, if needed) or out of limits."""
        if (row := self._first_bad(values)) is not None:
            problem = self._complaint(float(values[row]))
            raise InputError(problem, path=path, line=int(line[row]), field=self.name, hint=self.hint or None)

    def check_array(self, values: FloatArray, field: str) -> None:
        """Check an array that came from no file: the message names `field` and the row, counted from 0."""
        if (row := self._first_bad(values)) is not None:
            problem = f"row {row}: {self._complaint(float(values[row]))}"
            raise InputError(problem, field=field, hint=self.hint or None)

    def _first_bad(self, values: FloatArray) -> int | None:
        absent = np.isnan(values) if self.optional else np.zeros(len(values), dtype=bool)
        with np.errstate(invalid="ignore"):
            fine = np.isfinite(values) & (values >= self.low) & (values <= self.high)
            if self.positive:
                fine &= values > 0
        bad = np.flatnonzero(~fine & ~absent)
        return int(bad[0]) if len(bad) else None

    def _complaint(self, value: float) -> str:
        if not np.isfinite(value):
            return f"{value} where a finite number is needed"
        if self.positive and value <= 0:
            return f"{value:g} where a number greater than zero is needed"
        return f"{value:g} is outside [{self.low:g}, {self.high:g}]"


LATEST_S = 9.2e9
"""Stamps beyond this, the year 2261, do not fit into 64 bits of nanoseconds; they are milliseconds or garbage."""
STAMP_S = Quantity("stamp_s", -LATEST_S, LATEST_S, hint="stamps in seconds, not in milli- or nanoseconds", dates=True)
FORWARD_MPS = Quantity("forward_mps", -1e3, 1e3, hint="metres per second")
LATERAL_MPS = Quantity("lateral_mps", -1e3, 1e3, hint="metres per second")
ANGULAR_RADPS = Quantity("angular_radps", -1e3, 1e3, hint="radians per second")
DX_M = Quantity("dx_m", -1e5, 1e5, hint="metres since the previous row")
DY_M = Quantity("dy_m", -1e5, 1e5, hint="metres since the previous row")
DTHETA_RAD = Quantity("dtheta_rad", -pi, pi, hint="radians since the previous row, at most half a turn")
RANGE_M = Quantity("range_m", 0.0, 1e6, positive=True, hint="metres; leave out readings that mean 'no return'")
BEARING_RAD = Quantity("bearing_rad", -2 * pi, 2 * pi, hint="radians, not degrees")
X_M = Quantity("x_m", -1e8, 1e8, hint="metres")
Y_M = Quantity("y_m", -1e8, 1e8, hint="metres")
THETA_RAD = Quantity("theta_rad", -1e6, 1e6, hint="radians")
SIGMA_RANGE_M = Quantity("sigma_range_m", 0.0, 1e6, positive=True, optional=True, hint="leave empty where unknown")
SIGMA_BEARING_RAD = Quantity(
    "sigma_bearing_rad", 0.0, 1e6, positive=True, optional=True, hint="leave empty where unknown"
)
P_EXISTS = Quantity("p_exists", 0.0, 1.0, hint="a probability")


def validate(recording: Any) -> None:
    """Check that something is a recording from which a session can be estimated.

    Every reader ends with this, and every function that takes a `Recording` begins with it; only `run_session` mends
    first what a robot on duty logs.

    Raises:
        InputError: not a `Recording`, or a value that cannot be; the message names the array and the row.
        DataError: fewer than two rows of odometry, or no detection.
    """
    check_type(recording)
    odometry, frames, detections = recording.odometry, recording.frames, recording.detections
    if len(odometry) < 2:
        raise DataError("the odometry needs at least two rows", path=recording.source or None, field="odometry")
    if len(frames) == 0 or len(detections) == 0:
        problem = "no landmark was seen in the whole recording"
        raise DataError(problem, path=recording.source or None, hint="look at the detections")
    _check_stamps(odometry.stamp_s, "odometry.stamp_s")
    for quantity in (FORWARD_MPS, LATERAL_MPS, ANGULAR_RADPS):
        quantity.check_array(getattr(odometry, quantity.name), f"odometry.{quantity.name}")
    _check_stamps(frames.stamp_s, "frames.stamp_s")
    for quantity in (RANGE_M, BEARING_RAD, SIGMA_RANGE_M, SIGMA_BEARING_RAD):
        quantity.check_array(getattr(detections, quantity.name), f"detections.{quantity.name}")
    _require((detections.frame >= 0) & (detections.frame < len(frames)), detections.frame, "detections.frame",
             f"is not a row of {len(frames)} frames", "the row of frames in which it was made")  # fmt: skip
    _require(np.diff(detections.frame, prepend=0) >= 0, detections.frame, "detections.frame",
             "comes after a later frame", "sort the detections by frame")  # fmt: skip
    for name in ("landmark_id", "class_id"):
        ids = getattr(detections, name)
        _require(ids >= UNKNOWN, ids, f"detections.{name}", "is not an identity", "whole numbers from 0; -1: unknown")
    _check_sensor(recording.sensor)
    if recording.truth is not None:
        _check_trajectory(recording.truth, "truth")
    if recording.true_landmarks is not None:
        check_landmarks(recording.true_landmarks, "true_landmarks")


def check_type(recording: Any) -> None:
    """Raise InputError for anything but a `Recording`, with the way to get one."""
    if not isinstance(recording, Recording):
        hint = f"evermap.read_recording({str(recording)!r})" if isinstance(recording, str | Path) else "a Recording"
        raise InputError(f"a Recording is needed, not {type(recording).__name__}", field="recording", hint=hint)


def check_landmarks(landmarks: Any, field: str) -> None:
    """Raise InputError unless `landmarks` are records of a map, each once and with numbers that can be."""
    if not isinstance(landmarks, Landmarks):
        hint = "evermap.io.read_prior_map(FILE)"
        raise InputError(f"Landmarks are needed, not {type(landmarks).__name__}", field=field, hint=hint)
    for quantity, column in zip((X_M, Y_M), landmarks.position_m.T, strict=True):
        quantity.check_array(column, f"{field}.position_m")
    P_EXISTS.check_array(landmarks.p_exists, f"{field}.p_exists")
    ids, covariance = landmarks.landmark_id, landmarks.covariance_m2
    again = np.ones(len(ids), dtype=bool)
    again[np.unique(ids, return_index=True)[1]] = False
    _require(~again, ids, f"{field}.landmark_id", "is listed twice", "one row a landmark")
    variance = covariance[:, [0, 1], [0, 1]]
    size = variance.prod(axis=1) - covariance[:, 0, 1] * covariance[:, 1, 0]
    with np.errstate(invalid="ignore"):
        fine = np.isfinite(covariance).all(axis=(1, 2)) & (variance >= 0.0).all(axis=1)
        fine &= size >= -1e-6 * variance.prod(axis=1) - 1e-30
    _require(fine, ids, f"{field}.covariance_m2", "is not a covariance: not positive semidefinite", "square metres")


def _check_trajectory(trajectory: Trajectory, field: str) -> None:
    _check_stamps(trajectory.stamp_s, f"{field}.stamp_s")
    for quantity, column in zip((X_M, Y_M, THETA_RAD), trajectory.pose_world_robot.T, strict=True):
        quantity.check_array(column, f"{field}.pose_world_robot")


def _check_sensor(sensor: Sensor) -> None:
    for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
        if not getattr(sensor, low) < getattr(sensor, high):
            problem = f"{getattr(sensor, low)} is not below {high} = {getattr(sensor, high)}"
            raise InputError(problem, field=f"sensor.{low}", hint="metres, and radians counter-clockwise")
    for name in ("p_detect", "p_false"):
        if not 0.0 <= getattr(sensor, name) <= 1.0:
            raise InputError(f"{getattr(sensor, name)} is not a probability", field=f"sensor.{name}", hint="0 to 1")
    for name in ("sigma_range_m", "sigma_bearing_rad"):
        sigma = getattr(sensor, name)
        if sigma is not None and not 0.0 < sigma < inf:
            raise InputError(f"{sigma} is not a standard deviation", field=f"sensor.{name}", hint="None where unknown")
    mount = np.asarray(sensor.mount_robot_sensor, dtype=np.float64)
    if mount.shape != (3,) or not np.isfinite(mount).all():
        raise InputError(
            f"{sensor.mount_robot_sensor} is not a pose", field="sensor.mount_robot_sensor", hint="x, y, theta"
        )


def _check_stamps(stamp_s: FloatArray, field: str) -> None:
    STAMP_S.check_array(stamp_s, field)
    step_s = np.diff(stamp_s)
    if np.any(step_s <= 0.0):
        row = int(np.argmax(step_s <= 0.0)) + 1
        problem = (
            "repeats the one before" if step_s[row - 1] == 0.0 else f"time runs backwards by {-step_s[row - 1]:.6g} s"
        )
        raise InputError(f"row {row}: {problem}", field=field, hint="sort by time, one row a stamp")


def _require(fine: Any, values: Any, field: str, problem: str, hint: str) -> None:
    """Raise InputError for the first value that is not fine."""
    if not np.all(fine):
        row = int(np.argmin(fine))
        raise InputError(f"row {row}: {values[row]} {problem}", field=field, hint=hint)
