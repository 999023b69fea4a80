"""What a number may be: its name, its limits, and what a violation usually means. And what a recording has to be.

Readers of files and entry points from Python use the same: a reader knows file and line, an array its row. The limits
are far beyond any robot. They catch wrong units (degrees, milliseconds, millimetres) and damaged files.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import inf, pi
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import DataError, InputError
from evermap.types import (
    MASK_ID,
    UNKNOWN,
    AnyRecording,
    BoolArray,
    Clock,
    Detections,
    FloatArray,
    IntArray,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    SpatialDetections,
    SpatialOdometry,
    SpatialSensor,
    Trajectory,
    is_in_space,
    landmark_label,
)

WITHOUT_IDS = "`unknown_ids` associates detections without a landmark_id by geometry"
"""What to try where nothing has an identity."""


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

    def is_fine(self, values: FloatArray) -> BoolArray:
        """Return which values (R,) are within the limits, or not given where they need not be."""
        with np.errstate(invalid="ignore"):
            fine = np.isfinite(values) & (values >= self.low) & (values <= self.high)
            if self.positive:
                fine &= values > 0
        return fine | np.isnan(values) if self.optional else fine

    def _first_bad(self, values: FloatArray) -> int | None:
        bad = np.flatnonzero(~self.is_fine(values))
        return int(bad[0]) if len(bad) else None

    def _complaint(self, value: float) -> str:
        if not np.isfinite(value):
            return f"{value} where a finite number is needed"
        if self.positive and value <= 0:
            return f"{value:g} where a number greater than zero is needed"
        return f"{value:g} is outside [{self.low:g}, {self.high:g}]"


SINCE_1970_S = 1e8
"""Larger stamps count from 1970, whatever a recording says of its clock; smaller ones from the start of something."""
OVERLAP_S = 1.0
"""Sessions of one robot may overlap by so much: parts of a drive share their seam."""
LATEST_S = 9.2e9
"""Stamps beyond this, the year 2261, do not fit into 64 bits of nanoseconds; they are milliseconds or garbage."""
STAMP_S = Quantity("stamp_s", -LATEST_S, LATEST_S, hint="stamps in seconds, not in milli- or nanoseconds", dates=True)
FORWARD_MPS = Quantity("forward_mps", -1e3, 1e3, hint="metres per second")
LATERAL_MPS = Quantity("lateral_mps", -1e3, 1e3, hint="metres per second")
ANGULAR_RADPS = Quantity("angular_radps", -1e3, 1e3, hint="radians per second")
DX_M = Quantity("dx_m", -1e5, 1e5, hint="metres since the previous row")
DY_M = Quantity("dy_m", -1e5, 1e5, hint="metres since the previous row")
DTHETA_RAD = Quantity("dtheta_rad", -pi, pi, hint="radians since the previous row, at most half a turn")
RANGE_M = Quantity("range_m", 0.0, 1e6, positive=True, hint="metres; drop readings that mean 'no return'")
BEARING_RAD = Quantity("bearing_rad", -2 * pi, 2 * pi, hint="radians, not degrees")
X_M = Quantity("x_m", -1e8, 1e8, hint="metres")
Y_M = Quantity("y_m", -1e8, 1e8, hint="metres")
Z_M = Quantity("z_m", -1e8, 1e8, hint="metres")
THETA_RAD = Quantity("theta_rad", -1e6, 1e6, hint="radians")
QUATERNION = tuple(Quantity(f"q{axis}", -2.0, 2.0, hint="a unit quaternion, scalar last") for axis in "xyzw")
TWIST = (
    *(Quantity(f"v{axis}_mps", -1e3, 1e3, hint="metres per second") for axis in "xyz"),
    *(Quantity(f"w{axis}_radps", -1e3, 1e3, hint="radians per second") for axis in "xyz"),
)
SIGMA_RANGE_M = Quantity("sigma_range_m", 0.0, 1e6, positive=True, optional=True, hint="leave empty where unknown")
SIGMA_BEARING_RAD = Quantity(
    "sigma_bearing_rad", 0.0, 1e6, positive=True, optional=True, hint="leave empty where unknown"
)
MOST_MASKS = 2.0**53
"""Numbers up to this are exact as float64."""
FEATURES = (
    Quantity("radius_m", 0.0, 1e3, positive=True, optional=True, hint="metres; leave empty where it was not measured"),
    *(
        Quantity(f"colour_{one}", -1e6, 1e6, optional=True, hint="leave empty where it was not measured")
        for one in "rgb"
    ),
    Quantity(MASK_ID, -MOST_MASKS, MOST_MASKS, optional=True, hint="the number of a mask; leave empty outside of all"),
)
"""Of a landmark itself, and of its mask; beside these `descriptor_0`, `descriptor_1` ... may be any numbers."""
CAMERA_MODELS: dict[str, tuple[int, ...]] = {"pinhole": (0,), "radtan": (4, 5), "equidistant": (4,)}
"""Number of distortion coefficients per camera model."""
P_EXISTS = Quantity("p_exists", 0.0, 1.0, hint="a probability")


def validate(recording: Any) -> None:
    """Check that something is a recording, in the plane or in space, from which a session can be estimated.

    Every reader ends with this, and every function that takes a `Recording` begins with it; only `run_session` mends
    first what a robot on duty logs.

    Raises:
        InputError: not a `Recording`, or a value that cannot be; the message names the array and the row.
        DataError: fewer than two rows of odometry, or no detection.
    """
    check_type(recording)
    _check_content(recording)
    if recording.odometry is not None:
        _check_odometry(recording.odometry)
    _check_stamps(recording.frames.stamp_s, "frames.stamp_s")
    if is_in_space(recording):
        _check_spatial_detections(recording.detections, len(recording.frames), len(recording.sensors))
        check_rig(recording.sensors)
    else:
        _check_detections(recording.detections, len(recording.frames))
        check_sensor(recording.sensor)
    if recording.truth is not None:
        _check_trajectory(recording.truth, "truth")
    if recording.true_landmarks is not None:
        check_landmarks(recording.true_landmarks, "true_landmarks")


def has_own_clock(recording: AnyRecording) -> bool:
    """Return whether stamps count from a start that only this recording, or its simulation, knows."""
    stamp_s = recording.frames.stamp_s
    return recording.clock is Clock.RECORDING and len(stamp_s) > 0 and bool(np.nanmin(stamp_s) < SINCE_1970_S)


def check_frame_in_space(detections: SpatialDetections, sensors: int) -> None:
    """Raise InputError for detections of one frame in space that cannot be."""
    _check_spatial_detections(detections, 1, sensors)


def check_rig(sensors: Iterable[SpatialSensor]) -> None:
    """Raise InputError for sensors in space that cannot be."""
    for sensor in sensors:
        _check_spatial_sensor(sensor)


def _check_content(recording: AnyRecording) -> None:
    source = recording.source or None
    if type(recording.odometry) not in ((Odometry,) if recording.dim == 2 else (SpatialOdometry, type(None))):
        problem = f"{type(recording.odometry).__name__} and {type(recording.detections).__name__} do not go together"
        raise InputError(problem, field="odometry", hint="both in the plane, or both in space")
    if (recording.dim == 3) != (len(recording.sensors) > 0):
        problem = f"{len(recording.sensors)} sensors in space with {type(recording.detections).__name__}"
        raise InputError(problem, field="sensors", hint="sensor in the plane, one or more sensors in space")
    if recording.odometry is not None and len(recording.odometry) < 2:
        raise DataError("the odometry needs at least two rows", path=source, field="odometry")
    if len(recording.frames) == 0 or len(recording.detections) == 0:
        raise DataError("no landmark was seen in the whole recording", path=source, hint="look at the detections")


def _check_odometry(odometry: Odometry | SpatialOdometry) -> None:
    _check_stamps(odometry.stamp_s, "odometry.stamp_s")
    if isinstance(odometry, Odometry):
        for quantity in (FORWARD_MPS, LATERAL_MPS, ANGULAR_RADPS):
            quantity.check_array(getattr(odometry, quantity.name), f"odometry.{quantity.name}")
        return
    _check_poses(odometry.pose_world_robot, "odometry.pose_world_robot")
    variance = odometry.variance
    _require(~(variance < 0.0).any(axis=1), variance, "odometry.variance", "is negative", "nan where unknown")


def _check_detections(detections: Detections, frames: int) -> None:
    for quantity in (RANGE_M, replace(BEARING_RAD, optional=True), SIGMA_RANGE_M, SIGMA_BEARING_RAD):
        quantity.check_array(getattr(detections, quantity.name), f"detections.{quantity.name}")
    _check_frames(detections.frame, frames)
    for name in ("landmark_id", "class_id"):
        _check_ids(getattr(detections, name), f"detections.{name}")
    _check_features(detections)


def _check_spatial_detections(detections: SpatialDetections, frames: int, sensors: int) -> None:
    _check_frames(detections.frame, frames)
    row, field = detections.sensor, "detections"
    _require((row >= 0) & (row < sensors), row, f"{field}.sensor", f"is not one of {sensors} sensors", "count from 0")
    for name in ("landmark_id", "class_id"):
        _check_ids(getattr(detections, name), f"{field}.{name}")
    _check_features(detections)
    position, corner = detections.position_sensor_m, detections.corner_px.reshape(len(row), -1)
    placed, cornered = np.isfinite(position).all(axis=1), np.isfinite(corner).all(axis=1)
    hint = "a position in the sensor's frame, or the four corners of a tag"
    _require(placed | cornered, position, f"{field}.position_sensor_m", "has no position", hint)
    turned = ~np.isnan(detections.rotation).all(axis=1)
    _require(~turned | _is_unit(detections.rotation), detections.rotation, f"{field}.rotation",
             "is not a unit quaternion", "x, y, z, w; nan of points")  # fmt: skip
    covariance = detections.covariance_sensor_m2
    given = ~np.isnan(covariance).all(axis=(1, 2))
    fine = np.ones(len(row), dtype=np.bool_)
    fine[given] = is_covariance(covariance[given])
    _require(fine, row, f"{field}.covariance_sensor_m2",
             "is not a covariance: not positive semidefinite", "square metres; nan where unknown")  # fmt: skip
    for name in ("sigma_rad", "tag_size_m"):
        value = getattr(detections, name)
        _require(np.isnan(value) | (value > 0.0), value, f"{field}.{name}", "is not positive", "nan where unknown")
    size = detections.size_m
    _require(~(size <= 0.0).any(axis=1), size, f"{field}.size_m", "is not positive", "nan where there is no box")


def _check_features(detections: Detections | SpatialDetections) -> None:
    features, field = detections.features, "detections.features"
    wanted = (len(detections), len(detections.feature_names))
    if features is None and not wanted[1]:
        return
    if features is None or features.shape != wanted:
        given = None if features is None else features.shape
        raise InputError(f"shape {given} instead of {wanted}", field=field, hint="a column for each of feature_names")
    _require(~np.isinf(features).any(axis=1), features, field, "is not finite", "nan where it was not measured")


def _check_spatial_sensor(sensor: SpatialSensor) -> None:
    where = f"sensor '{sensor.name}'"
    pose = np.asarray(sensor.mount_robot_sensor, dtype=np.float64)
    if pose.shape != (7,) or not np.isfinite(pose).all() or abs(np.linalg.norm(pose[3:]) - 1.0) > 1e-3:
        raise InputError(f"{where}: {sensor.mount_robot_sensor} is not a pose", field="sensors.mount_robot_sensor",
                         hint="x, y, z, qx, qy, qz, qw")  # fmt: skip
    if sensor.intrinsics is not None and not (
        min(sensor.intrinsics[:2]) > 0.0 and np.isfinite(sensor.intrinsics).all()
    ):
        raise InputError(f"{where}: {sensor.intrinsics} are not focal lengths and a principal point",
                         field="sensors.intrinsics", hint="fx, fy, cx, cy in pixels")  # fmt: skip
    counts = CAMERA_MODELS.get(sensor.distortion_model)
    if counts is None:
        problem = f"{where}: no camera model '{sensor.distortion_model}'"
        raise InputError(problem, field="sensors.distortion_model", hint="one of " + ", ".join(CAMERA_MODELS))
    if len(sensor.distortion) not in (0, *counts):
        wanted = " or ".join(map(str, counts))
        problem = f"{where}: {sensor.distortion_model} needs {wanted} coefficients, not {len(sensor.distortion)}"
        raise InputError(problem, field="sensors.distortion")
    if not sensor.range_min_m < sensor.range_max_m:
        problem = f"{where}: {sensor.range_min_m} is not below range_max_m = {sensor.range_max_m}"
        raise InputError(problem, field="sensors.range_min_m")
    _check_chances(sensor, "sensors", ("sigma_m", "sigma_rad", "sigma_px"), f"{where}: ")
    known = ("sigma_scale", "sigma_angle_rad", "sigma_position_m", "sigma_odometer_scale")
    _check_chances(sensor, "sensors", known, f"{where}: ", zero=True)


def _check_chances(
    sensor: Sensor | SpatialSensor, field: str, sigmas: Iterable[str], whose: str = "", *, zero: bool = False
) -> None:
    """Raise InputError for a probability, or a stated standard deviation, that cannot be; `zero`: it may be 0."""
    for name in ("p_detect", "p_false"):
        if not 0.0 <= getattr(sensor, name) <= 1.0:
            problem = f"{whose}{getattr(sensor, name)} is not a probability"
            raise InputError(problem, field=f"{field}.{name}", hint="0 to 1")
    for name in sigmas:
        sigma = getattr(sensor, name)
        if sigma is not None and not (0.0 < sigma < inf or (zero and sigma == 0.0)):
            problem = f"{whose}{sigma} is not a standard deviation"
            raise InputError(problem, field=f"{field}.{name}", hint="None where unknown")


def is_covariance(covariance: FloatArray) -> Any:
    """Return which matrices (M, K, K) are symmetric and, but for rounding, positive semidefinite. Shape (M,)."""
    size = covariance.shape[-1]
    variance = covariance[:, range(size), range(size)]
    with np.errstate(invalid="ignore"):
        fine = np.asarray(np.isfinite(covariance).all(axis=(1, 2)) & (variance >= 0.0).all(axis=1))
        least = 1e-12 * variance.max(axis=1, initial=0.0, keepdims=True) + 1e-30
        scale = np.sqrt(np.maximum(variance, least))
        scaled = np.where(fine[:, None, None], covariance / scale[:, :, None] / scale[:, None, :], 0.0)
        same = np.abs(scaled - np.swapaxes(scaled, 1, 2)).max(axis=(1, 2), initial=0.0) <= 1e-6
    return fine & same & (np.linalg.eigvalsh(scaled)[:, 0] >= -1e-6)


def _is_unit(quaternion: FloatArray) -> BoolArray:
    return np.asarray(np.abs(np.linalg.norm(quaternion, axis=-1) - 1.0) <= 1e-3)


def _check_poses(pose: FloatArray, field: str) -> None:
    plane = pose.shape[1] == 3
    for quantity, column in zip((X_M, Y_M, THETA_RAD if plane else Z_M), pose.T, strict=False):
        quantity.check_array(column, field)
    if not plane:
        _require(_is_unit(pose[:, 3:]), pose, field, "does not end in a unit quaternion", "x, y, z, qx, qy, qz, qw")


def check_type(recording: Any) -> None:
    """Raise InputError for anything but a recording, with the way to get one."""
    if not isinstance(recording, Recording):
        hint = f"evermap.read_recording({str(recording)!r})" if isinstance(recording, str | Path) else "a Recording"
        raise InputError(f"a Recording is needed, not {type(recording).__name__}", field="recording", hint=hint)


def strangers(landmarks: Landmarks, recordings: Iterable[AnyRecording]) -> str:
    """Return one line on a map and recordings that have no landmark id in common; '' where they have one, or where
    there are none to compare.
    """
    every = list(recordings)
    seen = np.unique(np.concatenate([one.detections.landmark_id for one in every]))
    seen = seen[seen >= 0]
    if not len(seen) or not len(landmarks) or np.isin(seen, landmarks.landmark_id).any():
        return ""
    names = {**landmarks.names, **{key: name for one in every for key, name in one.landmark_names.items()}}
    listed = []
    for ids in (landmarks.landmark_id.tolist(), seen.tolist()):
        called = [landmark_label(identity, names) for identity in ids]
        listed.append(", ".join(called[:4]) + (f" to {called[-1]}" if len(called) > 4 else ""))
    return f"no landmark of the map was ever seen: the map has {listed[0]}, the recording has {listed[1]}"


def check_landmarks(landmarks: Any, field: str) -> None:
    """Raise InputError unless `landmarks` are records of a map, each once and with numbers that can be."""
    if not isinstance(landmarks, Landmarks):
        hint = "evermap.io.read_prior_map(FILE)"
        raise InputError(f"Landmarks are needed, not {type(landmarks).__name__}", field=field, hint=hint)
    for quantity, column in zip((X_M, Y_M, Z_M), landmarks.position_m.T, strict=False):
        quantity.check_array(column, f"{field}.position_m")
    P_EXISTS.check_array(landmarks.p_exists, f"{field}.p_exists")
    ids, covariance = landmarks.landmark_id, landmarks.covariance_m2
    again = np.ones(len(ids), dtype=bool)
    again[np.unique(ids, return_index=True)[1]] = False
    _require(~again, ids, f"{field}.landmark_id", "is listed twice", "one row per landmark")
    problem = "is not a covariance: not positive semidefinite"
    _require(is_covariance(covariance), ids, f"{field}.covariance_m2", problem, "square metres")


def _check_trajectory(trajectory: Trajectory, field: str) -> None:
    _check_stamps(trajectory.stamp_s, f"{field}.stamp_s")
    _check_poses(trajectory.pose_world_robot, f"{field}.pose_world_robot")


def check_sensor(sensor: Sensor) -> None:
    """Raise InputError for limits, probabilities or a mount that cannot be."""
    for low, high in (("range_min_m", "range_max_m"), ("bearing_min_rad", "bearing_max_rad")):
        if not getattr(sensor, low) < getattr(sensor, high):
            problem = f"{getattr(sensor, low)} is not below {high} = {getattr(sensor, high)}"
            raise InputError(problem, field=f"sensor.{low}", hint="metres, and radians counter-clockwise")
    _check_chances(sensor, "sensor", ("sigma_range_m", "sigma_bearing_rad"))
    mount = np.asarray(sensor.mount_robot_sensor, dtype=np.float64)
    if mount.shape != (3,) or not np.isfinite(mount).all():
        raise InputError(
            f"{sensor.mount_robot_sensor} is not a pose", field="sensor.mount_robot_sensor", hint="x, y, theta"
        )


def _check_frames(frame: IntArray, count: int) -> None:
    _require((frame >= 0) & (frame < count), frame, "detections.frame", f"is not a row of {count} frames",
             "the row of frames in which it was made")  # fmt: skip
    _require(np.diff(frame, prepend=0) >= 0, frame, "detections.frame", "comes after a later frame",
             "sort the detections by frame")  # fmt: skip


def _check_ids(ids: IntArray, field: str) -> None:
    _require(ids >= UNKNOWN, ids, field, "is not an identity", "whole numbers from 0; -1: unknown")


def _check_stamps(stamp_s: FloatArray, field: str) -> None:
    STAMP_S.check_array(stamp_s, field)
    step_s = np.diff(stamp_s)
    if np.any(step_s <= 0.0):
        row = int(np.argmax(step_s <= 0.0)) + 1
        back_s = -step_s[row - 1]
        problem = f"time runs backwards by {back_s:.6g} s" if back_s else "repeats the previous one"
        raise InputError(f"row {row}: {problem}", field=field, hint="sort by time, one row per stamp")


def _require(fine: Any, values: Any, field: str, problem: str, hint: str) -> None:
    """Raise InputError for the first value that is not fine."""
    if not np.all(fine):
        row = int(np.argmin(fine))
        raise InputError(f"row {row}: {values[row]} {problem}", field=field, hint=hint)
