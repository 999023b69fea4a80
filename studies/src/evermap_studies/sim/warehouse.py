"""A warehouse of any size: aisles side by side, landmarks along them, and a robot that drives all aisles once.

It is what cost is measured on: landmarks in view, their density and the sightings of each stay the same while the
world grows, so drive and sightings grow in proportion to the landmarks. Nothing moves. Everything is drawn as arrays;
100,000 frames take about a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.slam.association.merging import in_reach
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    Trajectory,
)

OFF_AISLE_M = (1.5, 2.5)
"""Least and most distance of a landmark from the middle of its aisle; sides alternate."""
ALONG_M = 0.5
"""Largest deviation of a landmark from even spacing along its aisle."""


@dataclass(frozen=True, slots=True)
class WarehouseConfig:
    """Everything about a warehouse and the robot in it.

    Attributes:
        n_landmarks: in the whole warehouse.
        landmarks_per_aisle: None for a square warehouse. Aisles are filled one after the other, and the first ones are
            the same however many follow.
        aisles_driven: the first so many; None for all.
        aisle_m, spacing_m: between two aisles, and between two landmarks along an aisle.
        range_m, half_view_rad: limits of the sensor, at the robot's centre.
        rate_hz: of frames and odometry.
        speed_mps: constant, also through the turns at the ends of aisles.
        p_detect: of a landmark in view, independently in each frame.
        p_wrong_identity: that a detection carries the identity of any landmark of the warehouse.
        sigma_range_m, sigma_bearing_rad: standard deviations of readings.
        odometry_sigma: standard deviations of odometry in the order of `NoiseConfig`: forward by distance [m/sqrt(m)]
            and by turn [m/sqrt(rad)], sideways by distance [m/sqrt(m)], turn by time [rad/sqrt(s)] and by turn
            [rad/sqrt(rad)].
        range_bias_m, bearing_bias_rad, forward_scale, turn_scale: calibration errors; scales are true over reported.
    """

    n_landmarks: int = 400
    landmarks_per_aisle: int | None = None
    aisles_driven: int | None = None
    aisle_m: float = 6.0
    spacing_m: float = 3.0
    range_m: float = 7.0
    half_view_rad: float = 1.2
    rate_hz: float = 10.0
    speed_mps: float = 1.2
    p_detect: float = 0.9
    p_wrong_identity: float = 0.0
    sigma_range_m: float = 0.03
    sigma_bearing_rad: float = 0.01
    odometry_sigma: tuple[float, float, float, float, float] = field(default=(0.02, 0.01, 0.01, 0.004, 0.02))
    range_bias_m: float = 0.0
    bearing_bias_rad: float = 0.0
    forward_scale: float = 1.0
    turn_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.n_landmarks < 1:
            raise ConfigError(f"must be positive, not {self.n_landmarks}", field="n_landmarks")
        for name in ("aisle_m", "spacing_m", "range_m", "half_view_rad", "rate_hz", "speed_mps"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"must be positive and finite, not {getattr(self, name)!r}", field=name)
        for name in ("landmarks_per_aisle", "aisles_driven"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise ConfigError(f"must be positive, not {getattr(self, name)}", field=name)

    @property
    def per_aisle(self) -> int:
        """Return the landmarks along one aisle."""
        if self.landmarks_per_aisle is not None:
            return self.landmarks_per_aisle
        aisles = max(1, round(math.sqrt(self.n_landmarks * self.spacing_m / self.aisle_m)))
        return math.ceil(self.n_landmarks / aisles)

    @property
    def aisles(self) -> int:
        """Return the number of aisles, the last perhaps with fewer landmarks."""
        return math.ceil(self.n_landmarks / self.per_aisle)

    @property
    def aisle_length_m(self) -> float:
        """Return the length of an aisle."""
        return self.per_aisle * self.spacing_m

    @property
    def drive_m(self) -> float:
        """Return the length of the drive: the aisles, joined by half circles."""
        driven = min(self.aisles, self.aisles_driven or self.aisles)
        return driven * self.aisle_length_m + (driven - 1) * math.pi * self.aisle_m / 2


def simulate_warehouse(warehouse: WarehouseConfig | int = 400, *, seed: int = 0) -> Recording:
    """Record one drive through a warehouse, with its truth; the same seed gives the same recording.

    The world's frame has its origin at the first pose, its x axis along the first aisle; ids of landmarks count from 0
    along the aisles.

    Args:
        warehouse: what to drive through; a number means the default one with so many landmarks.
        seed: of positions, noise and misses.
    """
    config = WarehouseConfig(n_landmarks=warehouse) if isinstance(warehouse, int) else warehouse
    rng = np.random.default_rng([seed, 1])
    landmark = warehouse_landmarks(config, seed=seed)
    stamp_s = np.arange(math.floor(config.drive_m / config.speed_mps * config.rate_hz) + 1) / config.rate_hz
    pose = pose_along(config, config.speed_mps * stamp_s)
    sensor = Sensor(
        range_max_m=config.range_m,
        bearing_min_rad=-config.half_view_rad,
        bearing_max_rad=config.half_view_rad,
        sigma_range_m=config.sigma_range_m,
        sigma_bearing_rad=config.sigma_bearing_rad,
        p_detect=config.p_detect,
    )
    return Recording(
        name=f"warehouse of {config.n_landmarks} landmarks, seed {seed}",
        odometry=_odometry(config, stamp_s, pose, rng),
        frames=Frames(stamp_s),
        detections=_detections(config, pose, landmark, rng),
        sensor=sensor,
        truth=Trajectory(stamp_s, pose, np.zeros((len(pose), 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(len(landmark)), landmark),
        source="evermap_studies.sim.warehouse",
    )


def warehouse_landmarks(config: WarehouseConfig, *, seed: int = 0) -> FloatArray:
    """Return the (L, 2) true positions, aisle by aisle."""
    rng = np.random.default_rng([seed, 0])
    along, off = rng.random((config.n_landmarks, 2)).T
    aisle, place = np.divmod(np.arange(config.n_landmarks), config.per_aisle)
    side = np.where((aisle + place) % 2 == 0, 1.0, -1.0)
    x = (place + 0.5) * config.spacing_m + ALONG_M * (2.0 * along - 1.0)
    y = aisle * config.aisle_m + side * (OFF_AISLE_M[0] + (OFF_AISLE_M[1] - OFF_AISLE_M[0]) * off)
    return np.column_stack([x, y])


def pose_along(config: WarehouseConfig, driven_m: FloatArray) -> FloatArray:
    """Return the (N, 3) true poses after (N,) driven metres: up one aisle, a half circle, down the next."""
    length, radius = config.aisle_length_m, config.aisle_m / 2
    aisle, rest = np.divmod(driven_m, length + math.pi * radius)
    straight, angle = np.minimum(rest, length), np.maximum(rest - length, 0.0) / radius
    forth = aisle % 2 == 0
    x = np.where(forth, straight + radius * np.sin(angle), length - straight - radius * np.sin(angle))
    y = aisle * config.aisle_m + radius * (1.0 - np.cos(angle))
    return np.column_stack([x, y, se2.wrap(np.where(forth, angle, math.pi - angle))])


def _odometry(config: WarehouseConfig, stamp_s: FloatArray, pose: FloatArray, rng: np.random.Generator) -> Odometry:
    """Constant velocities from stamp to stamp, noisy by distance, angle and time."""
    period_s = 1.0 / config.rate_hz
    velocity = se2.log(se2.between(pose[:-1], pose[1:])) / period_s
    velocity = np.vstack([velocity, velocity[-1:]])
    speed, turn = np.hypot(velocity[:, 0], velocity[:, 1]), np.abs(velocity[:, 2])
    forward_m, forward_rad, sideways_m, turn_s, turn_rad = np.square(config.odometry_sigma)
    variance = np.column_stack([forward_m * speed + forward_rad * turn, sideways_m * speed, turn_s + turn_rad * turn])
    noisy = velocity + np.sqrt(variance / period_s) * rng.normal(size=velocity.shape)
    forward, lateral, angular = (noisy / [config.forward_scale, config.forward_scale, config.turn_scale]).T
    return Odometry(stamp_s, forward.copy(), lateral.copy(), angular.copy())


def _detections(
    config: WarehouseConfig, pose: FloatArray, landmark: FloatArray, rng: np.random.Generator
) -> Detections:
    """Readings of what is in view and detected, by frame, then by landmark."""
    frame, seen = in_reach(landmark, pose[:, :2], config.range_m)
    offset = se2.transform(se2.inverse(pose)[frame], landmark[seen])
    range_m, bearing_rad = np.hypot(*offset.T), np.arctan2(offset[:, 1], offset[:, 0])
    hit = (np.abs(bearing_rad) < config.half_view_rad) & (rng.random(len(frame)) < config.p_detect)
    frame, seen, range_m, bearing_rad = frame[hit], seen[hit], range_m[hit], bearing_rad[hit]
    range_m = np.maximum(range_m + config.range_bias_m + config.sigma_range_m * rng.normal(size=len(frame)), 1e-3)
    bearing_rad = bearing_rad + config.bearing_bias_rad + config.sigma_bearing_rad * rng.normal(size=len(frame))
    wrong = rng.random(len(frame)) < config.p_wrong_identity
    seen = np.where(wrong, rng.integers(0, len(landmark), len(frame)), seen)
    return Detections(
        frame=frame,
        landmark_id=seen,
        range_m=range_m,
        bearing_rad=se2.wrap(bearing_rad),
        class_id=np.full(len(frame), UNKNOWN),
        sigma_range_m=np.full(len(frame), np.nan),
        sigma_bearing_rad=np.full(len(frame), np.nan),
        source_line=np.zeros(len(frame), dtype=np.int64),
    )
