"""A car in a park: trees without names, seen by a laser, on roads that it drives again after long ways.

Made like the recordings that are hard without identities: few detections a frame, trees in irregular groups, odometry
from wheels and steering whose zero wanders, and detections of what is no tree: parked cars, whose nearest corner
follows the view, and single ghosts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Odometry,
    Recording,
    Sensor,
    Trajectory,
)

BLOCK_M = 55.0
"""Between two crossings."""
CROSSINGS = (5, 4)
WHEELBASE_M = 2.8
MOST_CURVED = 0.17
"""Largest curvature that the car can drive [1/m]."""


@dataclass(frozen=True, slots=True)
class ParkConfig:
    """Everything about a park, the car and its laser.

    Attributes:
        n_trees, n_cars: how many trees, and parked cars.
        drive_m, speed_mps, rate_hz: length and speed of the drive; rate of frames and odometry.
        range_m, half_view_rad: limits of the laser.
        p_detect, reach_m: of a tree at no distance, and the distance over which that falls to a third.
        stickiness: probability that a tree's fate is that of the frame before.
        p_car: of a detection of a car in reach, in a frame.
        p_ghost: of a detection of nothing in a frame.
        sigma_range_m, sigma_bearing_rad: standard deviations of readings.
        speed_scale: reported over true speed.
        steering_bias_rad, steering_walk_rad: constant error of the steering angle, and what it gains on the root of a
            second; it forgets within a minute.
        speed_noise, steering_noise_rad: white, in each row; that of the speed as a share of it.
    """

    n_trees: int = 150
    n_cars: int = 14
    drive_m: float = 3500.0
    speed_mps: float = 2.5
    rate_hz: float = 5.0
    range_m: float = 80.0
    half_view_rad: float = math.pi / 2.0
    p_detect: float = 0.5
    reach_m: float = 13.0
    stickiness: float = 0.6
    p_car: float = 0.12
    p_ghost: float = 0.06
    sigma_range_m: float = 0.12
    sigma_bearing_rad: float = 0.012
    speed_scale: float = 1.03
    steering_bias_rad: float = 0.002
    steering_walk_rad: float = 0.0005
    speed_noise: float = 0.03
    steering_noise_rad: float = 0.01


def simulate_park(config: ParkConfig | None = None, *, seed: int = 0) -> Recording:
    """Record one drive through a park, with its truth; `UNKNOWN` identities are detections of no tree.

    Args:
        config: what to drive through; None for the default.
        seed: of the park, the way and all errors.
    """
    config = config or ParkConfig()
    rng = np.random.default_rng([seed, 77])
    pose, speed, steering = _drive(config, rng)
    stamp_s = np.arange(len(pose)) / config.rate_hz
    tree = _trees(config, pose, rng)
    detections = _detections(config, pose, tree, rng)
    world = se2.inverse(pose[0])
    pose, tree = np.asarray(se2.compose(world, pose)), np.asarray(se2.transform(world, tree))
    return Recording(
        name=f"park of {config.n_trees} trees, seed {seed}",
        odometry=_odometry(config, stamp_s, speed, steering, rng),
        frames=Frames(stamp_s),
        detections=detections,
        sensor=Sensor(
            range_max_m=config.range_m, bearing_min_rad=-config.half_view_rad, bearing_max_rad=config.half_view_rad
        ),
        truth=Trajectory(stamp_s, pose, np.zeros((len(pose), 3, 3)), frame="truth"),
        true_landmarks=Landmarks.at(np.arange(len(tree)), tree),
        source="evermap_studies.sim.park",
    )


def _drive(config: ParkConfig, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray]:
    """True poses (N, 3), speeds (N,) and steering angles (N,): pure pursuit from crossing to crossing."""
    columns, rows = CROSSINGS
    crossing = np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), axis=-1) * BLOCK_M
    crossing = crossing + rng.uniform(-12.0, 12.0, crossing.shape)
    period_s = 1.0 / config.rate_hz
    at, before = (0, 0), (-1, 0)
    x, y = float(crossing[0, 0, 0]), float(crossing[0, 0, 1])
    heading, driven, steering = 0.3, 0.0, 0.0
    poses: list[tuple[float, float, float]] = []
    speeds: list[float] = []
    angles: list[float] = []
    while driven < config.drive_m:
        ways = [(at[0] + i, at[1] + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        ways = [way for way in ways if 0 <= way[0] < columns and 0 <= way[1] < rows and way != before]
        before, at = at, ways[int(rng.integers(len(ways)))]
        goal = crossing[at] + rng.normal(0.0, 1.0, 2)
        for _ in range(int(4.0 * BLOCK_M / (config.speed_mps * period_s))):
            away, error = math.hypot(goal[0] - x, goal[1] - y), math.atan2(goal[1] - y, goal[0] - x) - heading
            if away < 7.0 or driven >= config.drive_m:
                break
            error = (error + math.pi) % (2.0 * math.pi) - math.pi
            curvature = min(max(2.0 * math.sin(error) / min(away, 9.0), -MOST_CURVED), MOST_CURVED)
            if abs(error) > 0.5 * math.pi:
                curvature = math.copysign(MOST_CURVED, error)
            steering += min(max(math.atan(WHEELBASE_M * curvature) - steering, -0.5 * period_s), 0.5 * period_s)
            speed = config.speed_mps * (1.0 - 0.5 * abs(curvature) / MOST_CURVED)
            poses.append((x, y, heading))
            speeds.append(speed)
            angles.append(steering)
            step, turn = speed * period_s, speed * period_s * math.tan(steering) / WHEELBASE_M
            x, y = x + step * math.cos(heading + 0.5 * turn), y + step * math.sin(heading + 0.5 * turn)
            heading, driven = heading + turn, driven + step
    pose = np.array(poses)
    pose[:, 2] = se2.wrap(pose[:, 2])
    return pose, np.array(speeds), np.array(angles)


def _trees(config: ParkConfig, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Groups of trees beside the roads, none nearer than 3 m to the car's way or 1.5 m to another."""
    found: list[FloatArray] = []
    while len(found) < config.n_trees:
        middle = pose[int(rng.integers(len(pose))), :2] + rng.normal(0.0, 15.0, 2)
        for _ in range(int(rng.integers(1, 7))):
            tree = middle + rng.normal(0.0, 5.0, 2)
            near = min((float(np.hypot(*(tree - other))) for other in found), default=np.inf)
            if near > 1.5 and np.hypot(*(pose[:, :2] - tree).T).min() > 3.0 and len(found) < config.n_trees:
                found.append(tree)
    return np.array(found)


def _odometry(
    config: ParkConfig, stamp_s: FloatArray, speed: FloatArray, steering: FloatArray, rng: np.random.Generator
) -> Odometry:
    """What wheels and steering angle tell."""
    count, period_s = len(stamp_s), 1.0 / config.rate_hz
    white, keep = rng.normal(size=(count, 3)), math.exp(-period_s / 60.0)
    wander = np.zeros(count)
    for k in range(1, count):
        wander[k] = keep * wander[k - 1] + config.steering_walk_rad * math.sqrt(period_s) * white[k, 2]
    told = speed * (config.speed_scale + config.speed_noise * white[:, 0])
    angle = steering + config.steering_bias_rad + wander + config.steering_noise_rad * white[:, 1]
    return Odometry(stamp_s, told, np.zeros(count), speed * np.tan(angle) / WHEELBASE_M)


def _detections(config: ParkConfig, pose: FloatArray, tree: FloatArray, rng: np.random.Generator) -> Detections:
    """Trees, by frame, then what is none."""
    frame, seen, reading = _seen(config, pose, tree)
    hit = np.zeros(len(frame), dtype=bool)
    fate, last = np.ones(len(tree)), np.full(len(tree), -2)
    chance = config.p_detect * np.exp(-reading[:, 0] / config.reach_m)
    for k, (row, which) in enumerate(zip(frame.tolist(), seen.tolist(), strict=True)):
        if last[which] != row - 1 or rng.random() > config.stickiness:
            fate[which] = rng.random()
        last[which], hit[k] = row, fate[which] < chance[k]
    cars = pose[rng.integers(0, len(pose), config.n_cars), :2] + rng.normal(0.0, 4.0, (config.n_cars, 2))
    by_car, _, at_car = _seen(config, pose, cars, reach_m=25.0)
    corner = rng.random(len(by_car)) < config.p_car
    at_car = at_car[corner] + rng.normal(size=(int(corner.sum()), 2)) * [0.8, 0.04]
    by_ghost = np.flatnonzero(rng.random(len(pose)) < config.p_ghost)
    at_ghost = np.column_stack(
        [
            rng.uniform(2.0, 0.5 * config.range_m, len(by_ghost)),
            rng.uniform(-config.half_view_rad, config.half_view_rad, len(by_ghost)),
        ]
    )
    frames = np.concatenate([frame[hit], by_car[corner], by_ghost])
    identity = np.concatenate([seen[hit], np.full(len(frames) - int(hit.sum()), UNKNOWN)])
    readings = np.concatenate([reading[hit], at_car, at_ghost])
    readings += rng.normal(size=readings.shape) * [config.sigma_range_m, config.sigma_bearing_rad]
    order, count = np.argsort(frames, kind="stable"), len(frames)
    return Detections(
        frame=frames[order],
        landmark_id=identity[order],
        range_m=np.maximum(readings[order, 0], 0.5),
        bearing_rad=np.asarray(se2.wrap(readings[order, 1])),
        class_id=np.full(count, UNKNOWN),
        sigma_range_m=np.full(count, np.nan),
        sigma_bearing_rad=np.full(count, np.nan),
        source_line=np.zeros(count, dtype=np.int64),
    )


def _seen(
    config: ParkConfig, pose: FloatArray, place: FloatArray, reach_m: float | None = None
) -> tuple[IntArray, IntArray, FloatArray]:
    """Frames, rows of places and true readings of all that is in view."""
    offset = se2.transform(se2.inverse(pose)[:, None], place[None])
    away, bearing = np.hypot(offset[..., 0], offset[..., 1]), np.arctan2(offset[..., 1], offset[..., 0])
    view = (away < (reach_m or config.range_m)) & (np.abs(bearing) < config.half_view_rad)
    frame, which = np.nonzero(view)
    return frame, which, np.column_stack([away[view], bearing[view]])
