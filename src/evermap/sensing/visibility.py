"""Which landmarks a sensor should have seen, and with what probability: the other half of a detection is a miss."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import log_ndtr

from evermap.geometry import se2
from evermap.types import Detections, FloatArray, IntArray, Landmarks, Misses, Sensor

RANGE_MARGIN_M = 0.2
BEARING_MARGIN_RAD = 0.05
"""Softness of the field of view's edge, where pose and map errors decide."""
WORTH_A_MISS = 0.5
"""Share of the sensor's detection probability below which not seeing a landmark is no miss."""


def detection_probability(pose_world_robot: FloatArray, position_m: FloatArray, sensor: Sensor) -> FloatArray:
    """P(detect | it is there) of every landmark from every pose.

    The limits of range and bearing are smoothed by normal distribution functions (`P_D0 P(r < r_max) P(|b| < b_max)`,
    Nielsen 2024 section 7.2, with both limits of each).

    Args:
        pose_world_robot: (F, 3) poses.
        position_m: (L, 2) landmarks, in the same frame.
        sensor: limits, mounting and detection probability.

    Returns:
        (F, L) probabilities.
    """
    pose = se2.compose(pose_world_robot, np.asarray(sensor.mount_robot_sensor))
    offset = position_m[None, :, :] - pose[:, None, :2]
    range_m = np.hypot(offset[..., 0], offset[..., 1])
    bearing = se2.wrap(np.arctan2(offset[..., 1], offset[..., 0]) - pose[:, None, 2])
    return sensor.p_detect * np.exp(log_in_view(range_m, bearing, sensor))


def log_in_view(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    sensor: Sensor,
    *,
    range_margin_m: FloatArray | float = RANGE_MARGIN_M,
    bearing_margin_rad: FloatArray | float = BEARING_MARGIN_RAD,
) -> FloatArray:
    """`log P(inside the limits of the sensor)` of landmarks whose range and bearing are known to some margin.

    Args:
        range_m: from the sensor, of any shape.
        bearing_rad: from the sensor's x axis, in [-pi, pi), of the same shape.
        sensor: limits.
        range_margin_m: standard deviation of the range, of the same shape or a number.
        bearing_margin_rad: standard deviation of the bearing, likewise.
    """
    inside = _log_within(range_m, sensor.range_min_m, sensor.range_max_m, range_margin_m)
    if sensor.bearing_max_rad - sensor.bearing_min_rad < 2 * math.pi - 1e-6:
        inside += _log_within(bearing_rad, sensor.bearing_min_rad, sensor.bearing_max_rad, bearing_margin_rad)
    return inside


def find_misses(
    frame: IntArray,
    pose_world_robot: FloatArray,
    detections: Detections,
    landmarks: Landmarks,
    frame_stamp_s: FloatArray,
    sensor: Sensor,
) -> Misses:
    """Landmarks that should have been detected and were not, from the first time on that each was seen.

    Args:
        frame: (F,) rows of frames that have a pose.
        pose_world_robot: (F, 3) poses at those frames.
        detections: what was seen.
        landmarks: what is there to be seen.
        frame_stamp_s: stamps of all frames.
        sensor: limits, mounting and detection probability.
    """
    rows: list[IntArray] = []
    ids: list[IntArray] = []
    probabilities: list[FloatArray] = []
    column = {int(identity): k for k, identity in enumerate(landmarks.landmark_id)}
    seen_column = np.array([column.get(int(i), -1) for i in detections.landmark_id], dtype=np.int64)
    chunk = max(1, 2_000_000 // max(len(landmarks), 1))
    for start in range(0, len(frame), chunk):
        part = frame[start : start + chunk]
        p = detection_probability(pose_world_robot[start : start + chunk], landmarks.position_m, sensor)
        expected = p >= WORTH_A_MISS * sensor.p_detect
        expected &= frame_stamp_s[part][:, None] > landmarks.first_seen_s[None, :]
        hit = np.isin(detections.frame, part) & (seen_column >= 0)
        expected[np.searchsorted(part, detections.frame[hit]), seen_column[hit]] = False
        missed_frame, missed_column = np.nonzero(expected)
        rows.append(part[missed_frame].astype(np.int64))
        ids.append(landmarks.landmark_id[missed_column])
        probabilities.append(p[missed_frame, missed_column])
    if not rows:
        return Misses(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))
    return Misses(
        np.concatenate(rows).astype(np.int64), np.concatenate(ids).astype(np.int64), np.concatenate(probabilities)
    )


def _log_within(value: FloatArray, low: float, high: float, margin: FloatArray | float) -> FloatArray:
    """`log P(low < x)` and `log P(x < high)` in sum, of a value known to `margin`."""
    inside = np.zeros_like(value)
    if low > -math.inf:
        inside += log_ndtr((value - low) / margin)
    if high < math.inf:
        inside += log_ndtr((high - value) / margin)
    return inside
