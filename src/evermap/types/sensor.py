"""Sensors: what they see, where they are on the robot, what a data sheet says of their errors."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from evermap.show import Shown


class SensorKind(StrEnum):
    """Kind of sensor, which sets the priors of its errors."""

    LASER = "laser"
    CAMERA = "camera"
    TAG = "tag"
    STEREO = "stereo"
    UWB = "uwb"


NOT_IN_SPACE = {
    "sigma_offset_m": "no offset of ranges is estimated there: subtract it from the ranges",
    "sigma_askew_rad": "the robot may move in any direction there: sigma_angle_rad is that of the sensor's mount",
    "bearing_min_rad": "the field of view is that of the detections",
    "bearing_max_rad": "the field of view is that of the detections",
    "sigma_range_m": "[noise] sigma_m in sensor.toml",
    "sigma_bearing_rad": "[noise] sigma_m or sigma_px in sensor.toml",
    "mount_robot_sensor": "[mount] in sensor.toml or camera.toml",
}
"""Keys of a sensor in the plane that mean nothing in space, and what to try instead."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """Limits and nominal noise of a range-bearing sensor.

    Attributes:
        range_min_m, range_max_m: limits of the range.
        bearing_min_rad, bearing_max_rad: limits of the field of view.
        sigma_range_m, sigma_bearing_rad: nominal noise, a starting value where noise is estimated; None = unknown.
        p_detect: probability of detecting a landmark in view; p_false: probability of a false detection a frame.
        mount_robot_sensor: pose (x, y, theta) of the sensor in the robot's frame.
        kind: what it is; None = unknown.
        sigma_scale: standard deviation of the scale of its ranges, as a share; sigma_offset_m: of what is added to all;
            sigma_angle_rad: of its angle in the mount; sigma_position_m: of its position there, along each axis. None:
            as usual for the kind.
        sigma_odometer_scale: standard deviation of the scale of the odometer; sigma_askew_rad: of the direction in
            which the robot drives, from its front. None: unknown.
        measures_positions: whether ranges and bearings are those of positions, of whatever sensor in space.
    """

    range_min_m: float = 0.0
    range_max_m: float = float("inf")
    bearing_min_rad: float = -float(np.pi)
    bearing_max_rad: float = float(np.pi)
    sigma_range_m: float | None = None
    sigma_bearing_rad: float | None = None
    p_detect: float = 0.9
    p_false: float = 0.01
    mount_robot_sensor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: SensorKind | None = None
    sigma_scale: float | None = None
    sigma_offset_m: float | None = None
    sigma_angle_rad: float | None = None
    sigma_position_m: float | None = None
    sigma_odometer_scale: float | None = None
    sigma_askew_rad: float | None = None
    measures_positions: bool = False

    @property
    def states_scale(self) -> bool:
        """Whether its kind or data sheet says how well ranges or odometer measure lengths: else ranges do as stated."""
        return self.kind is not None or self.sigma_scale is not None or self.sigma_odometer_scale is not None


ANY_BEARING_RAD = 100.0
"""Standard deviation of a bearing that was not measured: its value is a start for the estimator, and worth nothing."""
ANY_RANGE_M2 = 1e6
"""Variance beyond which the range of a detection is not known."""


@dataclass(frozen=True, slots=True)
class SpatialSensor(Shown):
    """A sensor in space: where it is on the robot, how it projects, how far it sees.

    Attributes:
        name: as detections call it.
        mount_robot_sensor: (x, y, z, qx, qy, qz, qw), the sensor's pose in the robot's frame.
        intrinsics: (fx, fy, cx, cy) of a camera [px]; None of other sensors.
        distortion: coefficients: none for a pinhole, (k1, k2, p1, p2) or with k3 of 'radtan' (Brown 1966), (k1 .. k4)
            of 'equidistant' (Kannala and Brandt 2006).
        distortion_model: 'pinhole', 'radtan' or 'equidistant'.
        resolution_px: (width, height) of the image; None where it is not known.
        range_min_m, range_max_m: limits of the range.
        sigma_m, sigma_rad, sigma_px: nominal noise of positions, orientations and corners, where noise is estimated a
            starting value; None = unknown.
        p_detect: probability of detecting a landmark in view; p_false: probability of a false detection a frame.
        kind: what it is; None = unknown.
        sigma_scale: standard deviation of the scale of its ranges, as a share; sigma_angle_rad: of its orientation in
            the mount, about each axis; sigma_position_m: of its position there, along each. None: as usual.
        sigma_odometer_scale: standard deviation of the scale of the odometry; the same for all sensors.
    """

    name: str = "sensor"
    mount_robot_sensor: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    intrinsics: tuple[float, float, float, float] | None = None
    distortion: tuple[float, ...] = ()
    distortion_model: str = "pinhole"
    resolution_px: tuple[int, int] | None = None
    range_min_m: float = 0.0
    range_max_m: float = float("inf")
    sigma_m: float | None = None
    sigma_rad: float | None = None
    sigma_px: float | None = None
    p_detect: float = 0.9
    p_false: float = 0.01
    kind: SensorKind | None = None
    sigma_scale: float | None = None
    sigma_angle_rad: float | None = None
    sigma_position_m: float | None = None
    sigma_odometer_scale: float | None = None

    def _facts(self) -> dict[str, Any]:
        return {"name": self.name, "camera": self.intrinsics is not None, "mount": self.mount_robot_sensor}
