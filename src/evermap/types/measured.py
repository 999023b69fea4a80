"""What a robot drives and sees, and what it did not see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.show import Shown, extent, span
from evermap.types.arrays import UNKNOWN, ArrayTable, FloatArray, IntArray
from evermap.types.clock import Clock

MASK_ID = "mask_id"
"""Column of features that is not of a landmark itself: the mask of an image that a detection lies in."""


@dataclass(frozen=True, slots=True)
class Odometry(ArrayTable):
    """Body velocities; row `i` holds from `stamp_s[i]` until `stamp_s[i + 1]` (zero-order hold).

    Attributes:
        stamp_s: (N,) strictly increasing.
        forward_mps: (N,) velocity along the robot's x axis.
        lateral_mps: (N,) velocity along its y axis (zeros for a differential drive).
        angular_radps: (N,) turn rate, counter-clockwise positive.
        is_measured: whether they are the motions that were measured, as of increments and poses, which nothing stamps
            before they were; velocities may be commanded, which the robot follows late.
    """

    stamp_s: FloatArray
    forward_mps: FloatArray
    lateral_mps: FloatArray
    angular_radps: FloatArray
    clock: Clock = Clock.RECORDING
    is_measured: bool = False

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), **span(self.stamp_s), "clock": self.clock.value}


@dataclass(frozen=True, slots=True)
class Frames(ArrayTable):
    """Frames of the sensor, with or without detections.

    Attributes:
        stamp_s: (F,) strictly increasing.
        complete: False where the recording does not log empty frames (then absence of a frame is no evidence).
    """

    stamp_s: FloatArray
    complete: bool = True
    clock: Clock = Clock.RECORDING

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), **span(self.stamp_s), "complete": self.complete, "clock": self.clock.value}


@dataclass(frozen=True, slots=True)
class Detections(ArrayTable):
    """Hits: one row a detection, sorted by frame.

    Attributes:
        frame: (M,) row of `Frames`.
        landmark_id: (M,) identity given by the front end, or `UNKNOWN`.
        range_m: (M,) distance from the sensor, as reported (uncalibrated).
        bearing_rad: (M,) counter-clockwise from the sensor's x axis, as reported; nan where only the range is known.
        class_id: (M,) row of `Recording.class_names`, or `UNKNOWN`.
        sigma_range_m, sigma_bearing_rad: (M,) standard deviations given for this very detection, nan where none is.
        source_line: (M,) line in the input file, for messages; 0 where there is none.
        features: (M, D) what was measured of the landmark itself, as its radius or colour, nan where it was not; and
            the mask that it lies in (`MASK_ID`), negative or nan in none; None where nothing ever was.
        feature_names: (D,) what the columns of `features` are called.
    """

    frame: IntArray
    landmark_id: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    class_id: IntArray
    sigma_range_m: FloatArray
    sigma_bearing_rad: FloatArray
    source_line: IntArray
    features: FloatArray | None = None
    feature_names: tuple[str, ...] = ()

    def _facts(self) -> dict[str, Any]:
        known = self.landmark_id[self.landmark_id != UNKNOWN]
        return {"rows": len(self), "landmarks": len(np.unique(known)), "range_m": extent(self.range_m)}


@dataclass(frozen=True, slots=True)
class Misses(ArrayTable):
    """Misses: landmarks that were expected in a frame and not detected; one row a (frame, landmark).

    Attributes:
        frame: (K,) row of `Frames`.
        landmark_id: (K,) the landmark that was expected.
        p_detect: (K,) probability with which it would have been detected, were it there.
    """

    frame: IntArray
    landmark_id: IntArray
    p_detect: FloatArray

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), "landmarks": len(np.unique(self.landmark_id))}

    @classmethod
    def empty(cls) -> Misses:
        """Return no misses."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, np.zeros(0))


@dataclass(frozen=True, slots=True)
class RobotSightings(ArrayTable):
    """Sightings of other robots, used where these are solved together. One row a sighting."""

    stamp_s: FloatArray
    robot_id: IntArray
    range_m: FloatArray
    bearing_rad: FloatArray
    clock: Clock = Clock.RECORDING

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), "robots": len(np.unique(self.robot_id)), **span(self.stamp_s)}


@dataclass(frozen=True, slots=True)
class Measurements(Shown):
    """Measurements of one kind beside odometry and detections, one row each.

    Attributes:
        kind: its name, one of `evermap.estimate.measurements`, such as 'gnss'.
        stamp_s: (K,) instants.
        columns: (K,) numbers by the names of that kind's columns; nan where a row does not measure one.
        landmark_id: (K,) what was measured; `UNKNOWN` where the kind is not of a landmark.
    """

    kind: str
    stamp_s: FloatArray
    columns: Mapping[str, FloatArray]
    landmark_id: IntArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    def _facts(self) -> dict[str, Any]:
        return {"kind": self.kind, "rows": len(self), **span(self.stamp_s)}


@dataclass(frozen=True, slots=True)
class SpatialOdometry(ArrayTable):
    """Poses of the robot in a frame that drifts, as visual-inertial odometry gives them.

    Attributes:
        stamp_s: (N,) strictly increasing.
        pose_world_robot: (N, 7) x, y, z [m], quaternion qx, qy, qz, qw.
        variance: (N, 6) of each pose as the source states it, along and about x, y, z of the robot, [m^2], [rad^2]; nan
            where it does not.
        z_up: whether the source states that the z axis of that frame is up, as ROS does (REP 103).
    """

    stamp_s: FloatArray
    pose_world_robot: FloatArray
    variance: FloatArray
    clock: Clock = Clock.RECORDING
    z_up: bool = False

    def _facts(self) -> dict[str, Any]:
        return {"rows": len(self), **span(self.stamp_s), "clock": self.clock.value}


@dataclass(frozen=True, slots=True)
class SpatialDetections(ArrayTable):
    """Hits in space: one row a detection, sorted by frame; values that a detector does not give are nan.

    Attributes:
        frame: (M,) row of `Frames`.
        sensor: (M,) row of `SpatialRecording.sensors`.
        landmark_id: (M,) identity given by the front end, or `UNKNOWN`.
        position_sensor_m: (M, 3) in the sensor's frame; of a camera x is right, y down, z ahead.
        rotation: (M, 4) quaternion of the landmark in the sensor's frame.
        covariance_sensor_m2: (M, 3, 3) of the position; a variance of more than `ANY_RANGE_M2` along it says that only
            the direction was seen.
        sigma_rad: (M,) standard deviation of the orientation about every axis.
        corner_px: (M, 4, 2) corners of a square tag in the image (u right, v down), in the order (-1, -1), (1, -1),
            (1, 1), (-1, 1) times half of the tag's size in the tag's own x and y.
        tag_size_m: (M,) edge of a square tag.
        size_m: (M, 3) length, width and height of a box, whose frame has x along its length and z up.
        class_id: (M,) row of `SpatialRecording.class_names`, or `UNKNOWN`.
        score: (M,) as the detector gives it.
        source_line: (M,) line in the input file, for messages; 0 where there is none.
        features, feature_names: as of `Detections`.
    """

    frame: IntArray
    sensor: IntArray
    landmark_id: IntArray
    position_sensor_m: FloatArray
    rotation: FloatArray
    covariance_sensor_m2: FloatArray
    sigma_rad: FloatArray
    corner_px: FloatArray
    tag_size_m: FloatArray
    size_m: FloatArray
    class_id: IntArray
    score: FloatArray
    source_line: IntArray
    features: FloatArray | None = None
    feature_names: tuple[str, ...] = ()

    def _facts(self) -> dict[str, Any]:
        known = self.landmark_id[self.landmark_id != UNKNOWN]
        return {"rows": len(self), "landmarks": len(np.unique(known))}


def traits_of(seen: Detections | SpatialDetections) -> tuple[FloatArray | None, tuple[str, ...]]:
    """Return what was measured of landmarks themselves (M, D), None if nothing was, and what its columns are called."""
    names = tuple(name for name in seen.feature_names if name != MASK_ID)
    if seen.features is None or not names:
        return None, ()
    return seen.features[:, [name != MASK_ID for name in seen.feature_names]], names


def masks_of(seen: Detections | SpatialDetections) -> FloatArray:
    """Return the mask of its image that each detection (M,) lies in, nan for none."""
    if seen.features is None or MASK_ID not in seen.feature_names:
        return np.full(len(seen), np.nan)
    number = seen.features[:, seen.feature_names.index(MASK_ID)]
    return np.where(number >= 0.0, number, np.nan)
