"""Definition of looks, hits and misses, and nominal detection models.

A *look* is a landmark, or one of its candidate places, in a frame in which it should be detected:
`P(detect | there)` is at least `worth_a_look` of what the sensor does at best. A detection is a look too, wherever the
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

from evermap.config import LooksConfig
from evermap.geometry import se2
from evermap.types import BoolArray, FloatArray, IntArray, Sensor

USUAL = LooksConfig()
AT_ONCE = 64
"""Consecutive poses that are compared with the landmarks near any of them."""


class DetectionModel(Protocol):
    """Protocol of detection models: the probability to detect a present landmark.

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
        settings: how soft its edges are, and what is worth a look.
    """

    sensor: Sensor
    settings: LooksConfig = USUAL

    def p_detect(self, pose: FloatArray, position_m: FloatArray) -> FloatArray:
        """Return (F, L) probabilities of landmarks (L, 2) from robot poses (F, 3) in the same frame."""
        none = np.zeros(0, dtype=np.int64)
        listed = self._list_seen(pose, position_m, (none, none), -1.0, math.inf)
        return listed.p_detect.reshape(len(pose), len(position_m))

    def looks(self, pose: FloatArray, position_m: FloatArray, seen: tuple[IntArray, IntArray]) -> LooksAt:
        """List the looks at landmarks, hits and misses.

        Args:
            pose: (F, 3) of the robot.
            position_m: (L, 2) landmarks in the same frame, taken to be there.
            seen: (H,) rows of poses and (H,) rows of landmarks: the detections.
        """
        least = self.settings.worth_a_look * self.sensor.p_detect
        return self._list_seen(pose, position_m, seen, least, float(self.reach_m))

    def _list_seen(
        self, pose: FloatArray, position_m: FloatArray, seen: tuple[IntArray, IntArray], least: float, reach_m: float
    ) -> LooksAt:
        """Return what was seen, and what is in reach and detected with some probability at least."""
        from evermap.sensing.kernels import looks

        eye = se2.compose(pose, np.asarray(self.sensor.mount_robot_sensor)).reshape(-1, 3)
        by_pose = np.argsort(seen[0], kind="stable")
        first = np.searchsorted(seen[0][by_pose], np.arange(len(eye) + 1))
        position = np.asarray(position_m, dtype=np.float64)
        return LooksAt(*looks(eye, position, self.limits, (least, reach_m, AT_ONCE), first, seen[1][by_pose]))

    @property
    def reach_m(self) -> float:
        """Return how far away nothing is detected any more."""
        return self.sensor.range_max_m + 3.0 * self.settings.range_margin_m

    @property
    def limits(self) -> tuple[float, ...]:
        """As `kernels.in_view` takes them; a sensor that sees all around has no limits of the bearing."""
        of, all_around = self.sensor, self.sensor.bearing_max_rad - self.sensor.bearing_min_rad >= 2 * math.pi - 1e-6
        bearing = (-math.inf, math.inf) if all_around else (float(of.bearing_min_rad), float(of.bearing_max_rad))
        ranges = float(of.range_min_m), float(of.range_max_m)
        return (float(of.p_detect), *ranges, *bearing, self.settings.range_margin_m, self.settings.bearing_margin_rad)

    def worth_a_look(self, p_detect: FloatArray) -> BoolArray:
        """Return which probabilities of any shape are large enough for a look."""
        return np.asarray(p_detect >= self.settings.worth_a_look * self.sensor.p_detect)


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
