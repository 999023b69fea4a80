"""The field of a sensor in space: how far, how wide and how high it looks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from evermap.errors import ConfigError
from evermap.types import BoolArray, FloatArray


class Projection(StrEnum):
    """How a sensor measures its vertical angle."""

    SPHERICAL = "spherical"
    """From the horizontal plane, as a spinning lidar: the field is an annulus."""
    PINHOLE = "pinhole"
    """In the plane of x and z, as a camera: the field is a pyramid."""


@dataclass(frozen=True, slots=True)
class Field:
    """What a sensor that looks along its x axis, with z up, can see (Bateman 2020 section 5.1.1).

    Attributes:
        range_max_m: nothing farther is detected.
        half_azimuth_rad: to the left and to the right; pi is all around.
        half_elevation_rad: up and down.
        projection: what the vertical angle is measured from.
    """

    range_max_m: float
    half_azimuth_rad: float
    half_elevation_rad: float
    projection: Projection

    def __post_init__(self) -> None:
        if not 0.0 < self.range_max_m < math.inf:
            raise ConfigError(f"must be positive and finite, not {self.range_max_m!r}", field="range_max_m")
        widest = math.pi if self.projection is Projection.SPHERICAL else math.pi / 2
        for name, most in (("half_azimuth_rad", widest), ("half_elevation_rad", math.pi / 2)):
            value = getattr(self, name)
            if not 0.0 < value <= most:
                raise ConfigError(f"must be above 0 and at most {most:.4f}, not {value!r}", field=name)

    def angles(self, point_sensor_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Azimuth and elevation [rad] of points (..., 3) in the sensor's frame; each of shape (...)."""
        x, y, z = np.moveaxis(point_sensor_m, -1, 0)
        ahead = np.hypot(x, y) if self.projection is Projection.SPHERICAL else x
        return np.arctan2(y, x), np.arctan2(z, ahead)

    def contains(self, point_sensor_m: FloatArray) -> BoolArray:
        """Whether points (..., 3) in the sensor's frame lie in the field; shape (...)."""
        azimuth, elevation = self.angles(point_sensor_m)
        near = np.linalg.norm(point_sensor_m, axis=-1) <= self.range_max_m
        inside = (np.abs(azimuth) <= self.half_azimuth_rad) & (np.abs(elevation) <= self.half_elevation_rad)
        return np.asarray(near & inside)

    def outline(self, range_m: float) -> FloatArray:
        """(7, 65, 3) lines in the sensor's frame that a picture shows the field by, cut off at `range_m`.

        The first two are the lower and the upper edge; each of the others comes from the sensor, goes up between the
        two, and returns to it.
        """
        share = np.linspace(-1.0, 1.0, 65)
        edges = [self._rays(share, np.full(65, level)) for level in (-1.0, 1.0)]
        slices = []
        for at in np.linspace(-1.0, 1.0, 5):
            ray = self._rays(np.full(65, at), share)
            ray[[0, -1]] = 0.0
            slices.append(ray)
        return range_m * np.stack([*edges, *slices])

    def _rays(self, azimuth_share: FloatArray, elevation_share: FloatArray) -> FloatArray:
        """(N, 3) unit vectors at shares of the half angles."""
        azimuth, elevation = azimuth_share * self.half_azimuth_rad, elevation_share * self.half_elevation_rad
        if self.projection is Projection.PINHOLE:
            ray = np.stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation)], axis=-1)
        else:
            ray = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


LIDAR = Field(16.0, math.pi, math.radians(30.0), Projection.SPHERICAL)
CAMERA = Field(16.0, math.radians(45.0), math.radians(45.0), Projection.PINHOLE)
