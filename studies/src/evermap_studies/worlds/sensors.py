"""Sensors in space whose detection is known: how they see in a simulated world, and what filters may assume.

Causes multiply: `P_D = P_0 P(range) P(incidence) P(in the field)` (MATH.md section 3). Each is a function of a
`ViewGeometry`, that is of how landmarks stand to the sensor; together they are a `SpatialModel`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from evermap.errors import ConfigError, InputError
from evermap.sensing.profile import Field, Projection
from evermap.types import BoolArray, FloatArray

LIDAR = Field(16.0, math.pi, math.radians(30.0), Projection.SPHERICAL)
CAMERA = Field(16.0, math.radians(45.0), math.radians(45.0), Projection.PINHOLE)


def angles(field: Field, point_sensor_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return azimuth and elevation [rad] of points (..., 3) in the sensor's frame; each of shape (...)."""
    x, y, z = np.moveaxis(point_sensor_m, -1, 0)
    ahead = np.hypot(x, y) if field.projection is Projection.SPHERICAL else x
    return np.arctan2(y, x), np.arctan2(z, ahead)


def contains(field: Field, point_sensor_m: FloatArray) -> BoolArray:
    """Return whether points (..., 3) in the sensor's frame lie in the field; shape (...)."""
    azimuth, elevation = angles(field, point_sensor_m)
    near = np.linalg.norm(point_sensor_m, axis=-1) <= field.range_max_m
    inside = (np.abs(azimuth) <= field.half_azimuth_rad) & (np.abs(elevation) <= field.half_elevation_rad)
    return np.asarray(near & inside)


def outline(field: Field, range_m: float) -> FloatArray:
    """Return (7, 65, 3) lines in the sensor's frame that a picture shows the field by, cut off at `range_m`.

    The first two are the lower and the upper edge; each of the others comes from the sensor, goes up between the
    two, and returns to it.
    """
    share = np.linspace(-1.0, 1.0, 65)
    edges = [_rays(field, share, np.full(65, level)) for level in (-1.0, 1.0)]
    slices = []
    for at in np.linspace(-1.0, 1.0, 5):
        ray = _rays(field, np.full(65, at), share)
        ray[[0, -1]] = 0.0
        slices.append(ray)
    return range_m * np.stack([*edges, *slices])


def _rays(field: Field, azimuth_share: FloatArray, elevation_share: FloatArray) -> FloatArray:
    """(N, 3) unit vectors at shares of the half angles."""
    azimuth, elevation = azimuth_share * field.half_azimuth_rad, elevation_share * field.half_elevation_rad
    if field.projection is Projection.PINHOLE:
        ray = np.stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation)], axis=-1)
    else:
        ray = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1)
    return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))


@dataclass(frozen=True, slots=True)
class ViewGeometry:
    """K landmarks seen from one pose.

    Attributes:
        point_sensor_m: (K, 3) landmarks in the sensor's frame.
        range_m: (K,) distances.
        facing: (K,) cosine of the angle of incidence, between a landmark's outward direction and that to the sensor.
        direction: (K, 3) unit vectors from the landmarks to the sensor, in the world's frame.
    """

    point_sensor_m: FloatArray
    range_m: FloatArray
    facing: FloatArray
    direction: FloatArray


def sight(landmark_m: FloatArray, outward: FloatArray, position_m: FloatArray, rotation: FloatArray) -> ViewGeometry:
    """Look at landmarks (K, 3) with outward unit vectors (K, 3) from (3,) with rotation (3, 3) to the world."""
    offset = position_m - landmark_m
    range_m = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(range_m, 1e-9)[:, None]
    return ViewGeometry(-offset @ rotation, range_m, np.sum(direction * outward, axis=1), direction)


def sights(pose: FloatArray, position_m: FloatArray, outward: FloatArray | None = None) -> list[ViewGeometry]:
    """Look at landmarks (L, 3) from each of F poses; arguments as in `SpatialModel.p_detect`.

    Raises:
        InputError: poses or landmarks of another shape.
    """
    if np.ndim(pose) != 3 or np.shape(pose)[1:] != (4, 4):
        raise InputError(f"shape {np.shape(pose)} instead of (F, 4, 4)", field="pose")
    if np.ndim(position_m) != 2 or np.shape(position_m)[1] != 3:
        raise InputError(f"shape {np.shape(position_m)} instead of (L, 3)", field="position_m")
    faces = np.zeros(np.shape(position_m)) if outward is None else outward
    seen = [sight(position_m, faces, one[:3, 3], one[:3, :3]) for one in pose]
    return seen if outward is not None else [replace(one, facing=np.ones(len(one.range_m))) for one in seen]


class Cause(Protocol):
    """One of the reasons for which a landmark is detected or not."""

    def probability(self, sight: ViewGeometry) -> FloatArray:
        """Return (K,) probabilities that it does not prevent a detection."""
        ...


@dataclass(frozen=True, slots=True)
class Fading:
    """Detection that fades with range: `exp(-r / length_m)` (Bateman 2020 section 5.1.1, its misprint corrected)."""

    length_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.length_m <= math.inf:
            raise ConfigError(f"must be positive, not {self.length_m!r}", field="length_m", hint="0.7 of the range")

    def probability(self, sight: ViewGeometry) -> FloatArray:
        """Return (K,) probabilities that it does not prevent a detection."""
        return np.exp(-sight.range_m / self.length_m)


@dataclass(frozen=True, slots=True)
class ViewingAngle:
    """Detection up to an angle of incidence, with an edge that is as soft as outward directions are uncertain.

    Attributes:
        largest_rad: angle at which half of the landmarks are still detected.
        edge: scale of the logistic edge, in units of the cosine.
    """

    largest_rad: float
    edge: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 < self.largest_rad <= math.pi:
            raise ConfigError(f"must be above 0 and at most pi, not {self.largest_rad!r}", field="largest_rad")
        if not 0.0 < self.edge < math.inf:
            raise ConfigError(f"must be positive and finite, not {self.edge!r}", field="edge")

    def probability(self, sight: ViewGeometry) -> FloatArray:
        """Return (K,) probabilities that it does not prevent a detection."""
        return 1.0 / (1.0 + np.exp(-(sight.facing - math.cos(self.largest_rad)) / self.edge))


@dataclass(frozen=True, slots=True)
class InField:
    """Being in the field of a sensor whose pose is known to some precision.

    Every limit of the field is a surface; the distance of a landmark from it, over its standard deviation, goes through
    the normal distribution function. This is exact to first order at one edge. Edges are taken as independent, which in
    the corners of a camera's image is too low by `asin(rho) / 2 pi` at most, `rho` the cosine between the two planes;
    and of two opposite edges only the nearer one counts: a field is wide compared with its softness.

    Attributes:
        field: limits.
        sigma_position_m: standard deviation of the sensor's position, and of the landmark's, per axis.
        sigma_attitude_rad: of the sensor's orientation, per axis.
    """

    field: Field
    sigma_position_m: float = 0.05
    sigma_attitude_rad: float = math.radians(1.0)

    def __post_init__(self) -> None:
        for name in ("sigma_position_m", "sigma_attitude_rad"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ConfigError(f"must be finite and not negative, not {value!r}", field=name)
        if self.sigma_position_m == 0.0:
            raise ConfigError("must be positive: no edge is infinitely sharp", field="sigma_position_m", hint="0.001")

    def probability(self, sight: ViewGeometry) -> FloatArray:
        """Return (K,) probabilities that it does not prevent a detection."""
        from scipy.special import ndtr

        x, y, z = sight.point_sensor_m.T
        level = np.hypot(x, y)
        ahead = level if self.field.projection is Projection.SPHERICAL else x
        inside = ndtr((self.field.range_max_m - sight.range_m) / self.sigma_position_m)
        spread = np.hypot(self.sigma_position_m, sight.range_m * self.sigma_attitude_rad)
        inside *= ndtr(_edge_distance(ahead, np.abs(z), self.field.half_elevation_rad) / spread)
        if self.field.half_azimuth_rad < math.pi:
            inside *= ndtr(_edge_distance(x, np.abs(y), self.field.half_azimuth_rad) / spread)
        return np.asarray(inside)


@dataclass(frozen=True, slots=True)
class SpatialModel:
    """Several causes, each of which can prevent a detection; a `visibility.DetectionModel` in space.

    Attributes:
        causes: independent of each other.
        p_0: probability of detection where none of them does.
    """

    causes: tuple[Cause, ...]
    p_0: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.p_0 <= 1.0:
            raise ConfigError(f"must be a probability, not {self.p_0!r}", field="p_0", hint="a number between 0 and 1")

    def probability(self, sight: ViewGeometry) -> FloatArray:
        """Return (K,) probabilities of detection."""
        product = np.full(len(sight.range_m), self.p_0)
        for cause in self.causes:
            product *= cause.probability(sight)
        return product

    def p_detect(self, pose: FloatArray, position_m: FloatArray, outward: FloatArray | None = None) -> FloatArray:
        """Return (F, L) probabilities to detect landmarks that are there.

        Args:
            pose: (F, 4, 4) from the sensor's frame to the world's.
            position_m: (L, 3) landmarks in the world.
            outward: (L, 3) unit vectors that they face along; they face every sensor where None.
        """
        rows = sights(pose, position_m, outward)
        return np.array([self.probability(row) for row in rows]).reshape(len(rows), len(position_m))


def _edge_distance(along: FloatArray, across: FloatArray, half_rad: float) -> FloatArray:
    """How far inside the edge at `half_rad` points lie; behind the apex it is the apex that is nearest."""
    distance = along * math.sin(half_rad) - across * math.cos(half_rad)
    behind = along * math.cos(half_rad) + across * math.sin(half_rad) < 0.0
    return np.where(behind, np.copysign(np.hypot(along, across), distance), distance)
