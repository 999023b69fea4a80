"""Recordings as if something had moved, left or come back: the changes that a recording of a static world lacks.

What the sensor reports of a landmark is changed by the difference between what it would report of the landmark at its
new and at its old place, so that its errors stay in. What has left is not reported; the frames stay, so that they are
looks that miss it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se2
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks, Recording, rows_of

DEPTH_LAW = (0.0, 0.0, -0.5)
"""Range law of a camera that reports depth: slope, skew [1/rad] and curvature [1/rad^2]."""


def edited(
    recording: Recording,
    pose_world_robot: FloatArray,
    before: Landmarks,
    after: Landmarks,
    at_s: float,
    range_law: tuple[float, float, float] = DEPTH_LAW,
) -> Recording:
    """The recording as if its landmarks had moved from `before` to `after` at `at_s`, or vanished.

    Readings that leave the sensor's limits are dropped. Those that would have come into view are not invented: a
    moved landmark is seen a little less often than it would have been.

    Args:
        recording: of a static world.
        pose_world_robot: (F, 3) true pose at every frame.
        before: true landmarks; readings of others stay.
        after: the same landmarks where they are in the end; those it lacks have vanished.
        at_s: from this stamp on they are at their new places; -inf for the whole recording.
        range_law: slope, skew and curvature of reported range over bearing, see `slam.calibration`.
    """
    detections = recording.detections
    old_row, new_row = (_rows_of(landmarks, detections.landmark_id) for landmarks in (before, after))
    from_then_on = (old_row >= 0) & (recording.frames.stamp_s[detections.frame] >= at_s)
    vanished = from_then_on & (new_row < 0)
    change = from_then_on & ~vanished
    old_m, new_m = before.position_m[old_row[change]], after.position_m[new_row[change]]
    change[change] = np.any(old_m != new_m, axis=1)  # readings of what stays are left as they are, to the last bit
    old_m, new_m = before.position_m[old_row[change]], after.position_m[new_row[change]]
    sensor = se2.compose(pose_world_robot[detections.frame], np.array(recording.sensor.mount_robot_sensor))
    old, new = (_reading(sensor[change], position_m, range_law) for position_m in (old_m, new_m))
    range_m, bearing_rad = detections.range_m.copy(), detections.bearing_rad.copy()
    range_m[change] += new[:, 0] - old[:, 0]
    bearing_rad[change] = se2.wrap(bearing_rad[change] + new[:, 1] - old[:, 1])
    changed = replace(recording, detections=replace(detections, range_m=range_m, bearing_rad=bearing_rad))
    return _selected(changed, ~vanished & (~change | _within(changed, recording.sensor.range_max_m, None)))


def later(recording: Recording, by_s: float) -> Recording:
    """The recording as if it had been made later, with its truth."""
    shifted = {
        name: replace(part, stamp_s=part.stamp_s + by_s)
        for name in ("odometry", "frames", "truth", "robot_sightings")
        if (part := getattr(recording, name)) is not None
    }
    return replace(recording, **shifted)


def limited(recording: Recording, range_max_m: float, bearing_max_rad: float) -> Recording:
    """The recording without detections farther away than this, or farther from the sensor's axis."""
    return _selected(recording, _within(recording, range_max_m, bearing_max_rad))


def _rows_of(landmarks: Landmarks, landmark_id: IntArray) -> IntArray:
    """(M,) row of each id, -1 where it is not among them."""
    if len(landmarks) == 0:
        return np.full(len(landmark_id), -1)
    row = np.minimum(np.searchsorted(landmarks.landmark_id, landmark_id), len(landmarks) - 1)
    return np.where(landmarks.landmark_id[row] == landmark_id, row, -1)


def _reading(pose: FloatArray, position_m: FloatArray, law: tuple[float, float, float]) -> FloatArray:
    """(M, 2) range and bearing, without the biases that cancel in a difference."""
    offset = position_m - pose[:, :2]
    range_m = np.hypot(offset[:, 0], offset[:, 1])
    bearing = se2.wrap(np.arctan2(offset[:, 1], offset[:, 0]) - pose[:, 2])
    slope, skew, curvature = law
    return np.column_stack([range_m * (1.0 + slope + skew * bearing + curvature * bearing**2), bearing])


def _within(recording: Recording, range_max_m: float, bearing_max_rad: float | None) -> BoolArray:
    """(M,) detections inside the limits; those of the sensor where no bearing is given."""
    detections, sensor = recording.detections, recording.sensor
    low, high = sensor.bearing_min_rad, sensor.bearing_max_rad
    if bearing_max_rad is not None:
        low, high = -bearing_max_rad, bearing_max_rad
    inside = (detections.range_m >= sensor.range_min_m) & (detections.range_m <= range_max_m)
    inside &= (detections.bearing_rad >= low) & (detections.bearing_rad <= high)
    return inside


def _selected(recording: Recording, keep: BoolArray) -> Recording:
    return replace(recording, detections=rows_of(recording.detections, keep))
