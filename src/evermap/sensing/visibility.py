"""What a look is, what a hit and what a miss, and with what probability landmarks are detected that are there.

A *look* is a landmark, or one of the places where it may stand, in a frame in which it should be detected:
`P(detect | there)` is at least `WORTH_A_LOOK` of what the sensor does at best. A detection is a look too, wherever the
field of view is said to end. A look with a detection is a *hit*, one without is a *miss*. Whether a miss says anything
depends on the line of sight (`sightlines`); a model without them takes every line for clear.

`P(detect | there)` comes from a `DetectionModel`: `NominalField` here, what was learned of lines of sight in
`sightlines`, and of sensors in space in `learned`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.special import log_ndtr

from evermap.geometry import se2
from evermap.types import BoolArray, FloatArray, IntArray, Sensor

RANGE_MARGIN_M = 0.2
BEARING_MARGIN_RAD = 0.05
"""Softness of the field of view's edge, where pose and map errors decide."""
WORTH_A_LOOK = 0.3
"""Share of the sensor's detection probability from which on a landmark counts as looked at."""
AT_ONCE = 64
"""Consecutive poses that are compared with the landmarks near any of them."""


class DetectionModel(Protocol):
    """What is known of a sensor: the probability to detect a landmark that is there.

    Poses are (F, 3) in the plane, or (F, 4, 4) in space; landmarks (L, 2) or (L, 3) in the same frame. Models that
    know each landmark by itself are asked of all of these, in their order.
    """

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        """Return (F, L) probabilities: of every landmark from every pose."""
        ...


@dataclass(frozen=True, slots=True)
class NominalField:
    """The field of view as the sensor's data sheet has it, with soft edges.

    The limits of range and bearing are smoothed by normal distribution functions (`P_D0 P(r < r_max) P(|b| < b_max)`,
    Nielsen 2024 section 7.2, with both limits of each).

    Attributes:
        sensor: limits, mounting and detection probability.
    """

    sensor: Sensor

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        """Return (F, L) probabilities of landmarks (L, 2) from robot poses (F, 3) in the same frame."""
        eye = se2.compose(pose, np.asarray(self.sensor.mount_robot_sensor))
        offset = position_m[None, :, :] - eye[:, None, :2]
        range_m = np.hypot(offset[..., 0], offset[..., 1])
        bearing = se2.wrap(np.arctan2(offset[..., 1], offset[..., 0]) - eye[:, None, 2])
        return self.sensor.p_detect * np.exp(log_in_view(range_m, bearing, self.sensor))

    def worth_a_look(self, p_detect: FloatArray) -> BoolArray:
        """Return which probabilities of any shape are large enough for a look."""
        return np.asarray(p_detect >= WORTH_A_LOOK * self.sensor.p_detect)


class LooksAt(NamedTuple):
    """Looks at L landmarks from F poses: (N,) rows sorted by pose, then by landmark.

    Attributes:
        pose, landmark: (N,) rows of poses and landmarks.
        p_detect: (N,) nominal probability of a detection, were the landmark there.
        hit: (N,) whether it was detected.
    """

    pose: IntArray
    landmark: IntArray
    p_detect: FloatArray
    hit: BoolArray

    def rows(self, some: IntArray | BoolArray) -> LooksAt:
        """Return some looks, by number, in that order, or by a mask."""
        return LooksAt(self.pose[some], self.landmark[some], self.p_detect[some], self.hit[some])


def looks_at(sensor: Sensor, pose: FloatArray, position_m: FloatArray, seen: tuple[IntArray, IntArray]) -> LooksAt:
    """List the looks at landmarks, hits and misses.

    Args:
        sensor: its nominal field of view.
        pose: (F, 3) of the robot.
        position_m: (L, 2) landmarks in the same frame, taken to be there.
        seen: (H,) rows of poses and (H,) rows of landmarks: the detections.
    """
    field = NominalField(sensor)
    eye = se2.compose(pose, np.asarray(sensor.mount_robot_sensor))[:, :2]
    reach = sensor.range_max_m + 3.0 * RANGE_MARGIN_M
    by_pose = np.argsort(seen[0], kind="stable")
    first_seen = np.searchsorted(seen[0][by_pose], np.arange(0, max(len(pose), 1) + AT_ONCE, AT_ONCE))
    parts = []
    for k, start in enumerate(range(0, max(len(pose), 1), AT_ONCE)):
        some = pose[start : start + AT_ONCE]
        mine = by_pose[first_seen[k] : first_seen[k + 1]]
        # consecutive poses are near each other: what none of them reaches is not worth a look of any
        low = eye[start : start + AT_ONCE].min(axis=0, initial=np.inf) - reach
        high = eye[start : start + AT_ONCE].max(axis=0, initial=-np.inf) + reach
        near = ((position_m >= low) & (position_m <= high)).all(axis=1)
        near[seen[1][mine]] = True
        rows = np.flatnonzero(near)
        p = field.p_detect(some, position_m[rows])
        hit = np.zeros(p.shape, dtype=np.bool_)
        hit[seen[0][mine] - start, np.searchsorted(rows, seen[1][mine])] = True
        row, column = np.nonzero(field.worth_a_look(p) | hit)
        parts.append((row + start, rows[column], p[row, column], hit[row, column]))
    return LooksAt(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def log_in_view(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    sensor: Sensor,
    *,
    range_margin_m: FloatArray | float = RANGE_MARGIN_M,
    bearing_margin_rad: FloatArray | float = BEARING_MARGIN_RAD,
) -> FloatArray:
    """Return `log P(inside the limits of the sensor)` of landmarks whose range and bearing are known to some margin.

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


def _log_within(value: FloatArray, low: float, high: float, margin: FloatArray | float) -> FloatArray:
    """Return `log P(low < x) + log P(x < high)` of a value known to `margin`."""
    inside = np.zeros_like(value)
    if low > -math.inf:
        inside += log_ndtr((value - low) / margin)
    if high < math.inf:
        inside += log_ndtr((high - value) / margin)
    return inside
