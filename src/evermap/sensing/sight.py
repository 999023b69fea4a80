"""How landmarks stand to a sensor in space, and what of it decides whether they are detected.

A detection model is a function of a `Sight`; models multiply: `P_D = P_0 P(range) P(incidence) P(in the field)`
(MATH.md section 3). They say what is assumed before anything was seen; `learned` finds out what is so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from evermap.errors import ConfigError
from evermap.sensing.field import Field, Projection
from evermap.types import FloatArray


@dataclass(frozen=True, slots=True)
class Sight:
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


def sight(landmark_m: FloatArray, outward: FloatArray, position_m: FloatArray, rotation: FloatArray) -> Sight:
    """Landmarks (K, 3) with outward unit vectors (K, 3) from a sensor at (3,) with rotation (3, 3) to the world."""
    offset = position_m - landmark_m
    range_m = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(range_m, 1e-9)[:, None]
    return Sight(-offset @ rotation, range_m, np.sum(direction * outward, axis=1), direction)


class DetectionModel(Protocol):
    """`P(detected | there)` by one cause."""

    def probability(self, sight: Sight) -> FloatArray:
        """(K,) probabilities."""
        ...


@dataclass(frozen=True, slots=True)
class Fading:
    """Detection that fades with range: `exp(-r / length_m)` (Bateman 2020 section 5.1.1, its misprint corrected)."""

    length_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.length_m <= math.inf:
            raise ConfigError(f"must be positive, not {self.length_m!r}", field="length_m", hint="0.7 of the range")

    def probability(self, sight: Sight) -> FloatArray:
        """(K,) probabilities."""
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

    def probability(self, sight: Sight) -> FloatArray:
        """(K,) probabilities."""
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

    def probability(self, sight: Sight) -> FloatArray:
        """(K,) probabilities."""
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
class Product:
    """Several causes, each of which can prevent a detection.

    Attributes:
        models: the causes.
        p_0: probability of detection where none of them does.
    """

    models: tuple[DetectionModel, ...]
    p_0: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.p_0 <= 1.0:
            raise ConfigError(f"{self.p_0!r} is no probability", field="p_0", hint="a number between 0 and 1")

    def probability(self, sight: Sight) -> FloatArray:
        """(K,) probabilities."""
        product = np.full(len(sight.range_m), self.p_0)
        for model in self.models:
            product *= model.probability(sight)
        return product


def _edge_distance(along: FloatArray, across: FloatArray, half_rad: float) -> FloatArray:
    """How far inside the edge at `half_rad` points lie; behind the apex it is the apex that is nearest."""
    distance = along * math.sin(half_rad) - across * math.cos(half_rad)
    behind = along * math.cos(half_rad) + across * math.sin(half_rad) < 0.0
    return np.where(behind, np.copysign(np.hypot(along, across), distance), distance)
