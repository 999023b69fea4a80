"""Detections beside where the map expects them, along the trajectory and with the calibration that were estimated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2, se3
from evermap.types import (
    ANY_BEARING_RAD,
    AnyRecording,
    BoolArray,
    FloatArray,
    IntArray,
    Landmarks,
    ParameterEstimate,
    Recording,
    SlamResult,
    Trajectory,
    is_in_space,
)

USED = 0.5
"""Probability to be no outlier from which a detection counts as used, as in the metrics."""
FEWEST = 10
"""Values of which a median says something: half of them are wrong by chance in one of a thousand cases."""
PER_LANDMARK = 5
"""Detections of a landmark, in each half of the drive, of which a mean says something."""
FARTHEST_S = 0.1
"""Time between a frame and the pose it is compared with; trajectories in the plane have one every so often."""


@dataclass(frozen=True, slots=True)
class Compared:
    """Detections beside where the map expects them, one row each, as a detection would have read them without noise.

    Attributes:
        detection: (K,) row of the recording's detections.
        taken_s, landmark_id, used: (K,) when, by the clock of the poses, of which landmark, and whether it is used.
        range_m: (K,) expected range.
        off: (K, D) detection less expectation over the expected range; of ranges only one number.
        point_m: (K, D) where detections are in the robot's frame; nan where they have a direction or a range only.
    """

    detection: IntArray
    taken_s: FloatArray
    landmark_id: IntArray
    used: BoolArray
    range_m: FloatArray
    off: FloatArray
    point_m: FloatArray

    @property
    def misfit(self) -> FloatArray:
        """Return (K,) lengths of what detections are off by, over their ranges."""
        return np.asarray(np.linalg.norm(self.off, axis=1))


def compare_detections(recording: AnyRecording, result: SlamResult) -> Compared:
    """Return detections beside expectations, of those that have both, in the plane with the estimated calibration."""
    innovations, places = result.innovations, result.landmarks
    row, known = _rows_of(places, innovations.landmark_id)
    rows = np.minimum(innovations.detection, max(len(recording.detections) - 1, 0))
    taken_s = innovations.stamp_s - _find_delays_s(recording, result)[rows]
    pose, near = find_poses_at(result.trajectory, taken_s)
    keep = np.flatnonzero(known & near & (innovations.detection < len(recording.detections)))
    detection, row, pose = innovations.detection[keep], row[keep], pose[keep]
    if is_in_space(recording):
        from evermap.slam.space.intake import positions_of, without_range

        mounts = np.array([one.mount_robot_sensor for one in recording.sensors])
        mounts = mounts[recording.detections.sensor[detection]]
        expected = se3.transform(se3.inverse(se3.compose(pose, mounts)), places.position_m[row])
        read = positions_of(recording)[detection]
        range_m = np.linalg.norm(expected, axis=1)
        blind = without_range(recording)[detection]
        length = np.maximum(np.linalg.norm(read, axis=1), 1e-9)
        read = np.where(blind[:, None], read * (range_m / length)[:, None], read)
    else:
        seen = recording.detections
        expected = _predict_readings(pose, places.position_m[row], recording, result.parameters)
        range_m, known = expected[:, 0], has_bearing(recording)[detection]
        bearing = np.where(known, seen.bearing_rad[detection], expected[:, 1])
        read = _points(seen.range_m[detection], bearing)
        expected = _points(range_m, expected[:, 1])
    off = (read - expected) / np.maximum(range_m, 1e-9)[:, None]
    good = np.isfinite(off).all(axis=1)
    named, used = innovations.landmark_id[keep[good]], innovations.p_inlier[keep[good]] >= USED
    point = locate_detections(recording, result.parameters)[detection[good]]
    return Compared(detection[good], taken_s[keep[good]], named, used, range_m[good], off[good], point)


def locate_detections(recording: AnyRecording, parameters: tuple[ParameterEstimate, ...] = ()) -> FloatArray:
    """Return (M, D) where detections are in the robot's frame [m]; nan of those with a direction or a range only.

    `parameters` in the plane are the estimated calibration, which is taken off.
    """
    if not is_in_space(recording):
        seen = recording.detections
        bearing = np.where(has_bearing(recording), seen.bearing_rad, np.nan)
        return np.asarray(se2.transform(*_correct_readings(seen.range_m, bearing, recording, parameters)))
    from evermap.slam.space.intake import positions_of, without_range

    mounts = np.array([one.mount_robot_sensor for one in recording.sensors])[recording.detections.sensor]
    point = se3.transform(mounts, positions_of(recording))
    return np.where(without_range(recording)[:, None], np.nan, point)


def find_instants(recording: AnyRecording, result: SlamResult) -> FloatArray:
    """Return (M,) when detections were taken, by the clock of a result's poses [s]."""
    return recording.frames.stamp_s[recording.detections.frame] - _find_delays_s(recording, result)


def find_poses_at(path: Trajectory, stamp_s: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the poses at stamps (K,), in the plane the nearest ones, and whether the nearest are near enough."""
    if not len(path):
        return np.zeros((len(stamp_s), path.pose_world_robot.shape[1])), np.zeros(len(stamp_s), dtype=np.bool_)
    after = np.clip(np.searchsorted(path.stamp_s, stamp_s), 1, max(len(path) - 1, 1))
    after = np.minimum(after, len(path) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(path.stamp_s[before] - stamp_s) <= np.abs(path.stamp_s[after] - stamp_s)
    row = np.where(nearer, before, after)
    pose = path.pose_world_robot
    at = pose[row] if pose.shape[1] == 3 else se3.interpolate(path.stamp_s, pose, stamp_s)
    return at, np.asarray(np.abs(path.stamp_s[row] - stamp_s) <= FARTHEST_S)


def has_bearing(recording: Recording) -> BoolArray:
    """Return (M,) whether detections in the plane were read with a bearing."""
    seen = recording.detections
    return np.isfinite(seen.bearing_rad) & ~(seen.sigma_bearing_rad >= ANY_BEARING_RAD)


def _find_delays_s(recording: AnyRecording, result: SlamResult) -> FloatArray:
    """Return (M,) by how much stamps of detections are late, as was estimated of the sensors in space."""
    if not is_in_space(recording):
        return np.zeros(len(recording.detections))
    value = {each.name: each.value for each in result.parameters}
    delay_s = np.array([value.get(f"{one.name}_delay_s", 0.0) for one in recording.sensors])
    return np.asarray(delay_s[recording.detections.sensor])


def _points(range_m: FloatArray, bearing_rad: FloatArray) -> FloatArray:
    return np.asarray(range_m[:, None] * np.column_stack([np.cos(bearing_rad), np.sin(bearing_rad)]))


def _predict_readings(
    pose: FloatArray, place_m: FloatArray, recording: Recording, parameters: tuple[ParameterEstimate, ...]
) -> FloatArray:
    """Return (K, 2) ranges and bearings as the estimated sensor reads them without noise (`slam.calibration.SPECS`)."""
    value = PlanarCalibration(parameters)
    x, y = se2.transform(se2.inverse(se2.compose(pose, value.find_mount(recording))), place_m).T
    range_m, bearing = np.hypot(x, y), np.arctan2(y, x)
    read_m = value["range_bias_m"] + range_m * value.find_factor(bearing)
    return np.column_stack([np.maximum(read_m, 1e-3), bearing + value["bearing_bias_rad"]])


def _correct_readings(
    range_m: FloatArray, bearing_rad: FloatArray, recording: Recording, parameters: tuple[ParameterEstimate, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the mount (3,), and points (M, 2) in the frame of the sensor that it would read so (M,), (M,)."""
    value = PlanarCalibration(parameters)
    bearing = bearing_rad - value["bearing_bias_rad"]
    read = (range_m - value["range_bias_m"]) / value.find_factor(bearing)
    return value.find_mount(recording), _points(np.maximum(read, 1e-3), bearing)


class PlanarCalibration:
    """Values of the estimated calibration of a sensor in the plane, by name; 0 of what was not estimated."""

    def __init__(self, parameters: tuple[ParameterEstimate, ...]) -> None:
        self._value = {each.name: each.value for each in parameters}

    def __getitem__(self, name: str) -> float:
        return self._value.get(name, 0.0)

    def find_mount(self, recording: Recording) -> FloatArray:
        """Return the mount (3,) of the sensor."""
        mount = np.array(recording.sensor.mount_robot_sensor, dtype=np.float64)
        return mount + [self["mount_forward_m"], self["mount_left_m"], 0.0]

    def find_factor(self, bearing_rad: FloatArray) -> FloatArray:
        """Return by what ranges are multiplied in directions (...)."""
        skew, curve = self["range_skew_per_rad"], self["range_curvature_per_rad2"]
        return np.asarray(1.0 + self["range_slope"] + skew * bearing_rad + curve * bearing_rad**2)


def _rows_of(places: Landmarks, landmark_id: IntArray) -> tuple[IntArray, BoolArray]:
    """Return rows of landmarks by their ids, and which are there."""
    if not len(places):
        return np.zeros(len(landmark_id), dtype=np.int64), np.zeros(len(landmark_id), dtype=np.bool_)
    row = np.minimum(np.searchsorted(places.landmark_id, landmark_id), len(places) - 1)
    return row, np.asarray(places.landmark_id[row] == landmark_id)
