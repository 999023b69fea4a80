"""The robot's patrol: a lap through every room, driven by a differential drive with bounded accelerations.

The drive is integrated exactly (constant twist between control steps), so the true trajectory, the true velocities
and noise-free odometry agree to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
from evermap.types import Clock, FloatArray, Odometry
from evermap_studies.sim.building import ROOM_INSET_M, FloorPlan
from evermap_studies.sim.config import DriveConfig, OdometryConfig

LANE_M: float = 0.4
"""The robot keeps to the right of the corridor's middle by this much."""
ROUTE_STEP_M: float = 0.05
CORNER_M: float = 1.0
"""Corners of the route are rounded from this distance on."""
REST_S: float = 1.0
"""The robot stands still for this long before it leaves."""


@dataclass(frozen=True, slots=True)
class PatrolDrive:
    """What the robot truly did; row `i` of the twist holds from `stamp_s[i]` to `stamp_s[i + 1]`.

    Attributes:
        stamp_s: (N,) equally spaced.
        pose_world_robot: (N, 3).
        twist: (N, 3) forward, sideways and angular velocity.
    """

    stamp_s: FloatArray
    pose_world_robot: FloatArray
    twist: FloatArray

    def pose_at(self, stamp_s: FloatArray) -> FloatArray:
        """Return exact poses (K, 3) at stamps (K,) within the drive."""
        row = np.clip(np.searchsorted(self.stamp_s, stamp_s, side="right") - 1, 0, len(self.stamp_s) - 1)
        passed_s = stamp_s - self.stamp_s[row]
        return se2.compose(self.pose_world_robot[row], se2.exp(self.twist[row] * passed_s[:, None]))


def patrol_route(
    plan: FloorPlan,
    *,
    reverse: bool = False,
    jitter_m: FloatArray | None = None,
    skip: Collection[int] = (),
    wing_shut: bool = False,
    start: float = 0.0,
) -> FloatArray:
    """Plan a closed lap from the dock (west end of the corridor) through all rooms, (N, 2) about 5 cm apart.

    Args:
        plan: the building.
        reverse: visit the northern rooms on the way out instead of the southern ones.
        jitter_m: (rooms, 4) shifts of the loops' four sides (west, east, near, far), None for the nominal lap.
        skip: rooms (rows of the plan) that are passed by.
        wing_shut: turn round before the partition of the eastern wing; its rooms have to be in `skip`.
        start: where the lap begins, as a share of its length from the dock.
    """
    middle = sum(plan.corridor_y_m) / 2
    jitter = np.zeros((len(plan.rooms), 4)) if jitter_m is None else jitter_m
    dock_x, end_x = 1.2, (plan.wing_x_m if wing_shut else plan.length_m) - 1.2
    rows = {
        north: [row for row, room in enumerate(plan.rooms) if room.north == north and row not in skip]
        for north in (False, True)
    }
    out_y, back_y = middle - LANE_M, middle + LANE_M
    corners: list[tuple[float, float]] = [(dock_x + 0.8, out_y)]
    for row in rows[reverse]:
        corners += _room_loop(plan, row, out_y, jitter[row], eastward=True)
    corners += [(end_x, out_y), (end_x, back_y)]
    for row in reversed(rows[not reverse]):
        corners += _room_loop(plan, row, back_y, jitter[row], eastward=False)
    corners += [(dock_x, back_y), (dock_x, out_y)]
    route = _resample(_round_corners(np.array(corners)))
    return np.roll(route, -int(start * len(route)), axis=0)


def _room_loop(
    plan: FloorPlan, row: int, lane_y: float, jitter: FloatArray, *, eastward: bool
) -> list[tuple[float, float]]:
    """Corners from the corridor through the doorway, around the room and out again."""
    room = plan.rooms[row]
    x = room.doorway_x_m
    west, east = room.low_m[0] + ROOM_INSET_M + jitter[0], room.high_m[0] - ROOM_INSET_M + jitter[1]
    if room.north:
        near, far = room.low_m[1] + 1.4 + jitter[2], room.high_m[1] - 2.1 + jitter[3]
    else:
        near, far = room.high_m[1] - 1.4 + jitter[2], room.low_m[1] + 2.1 + jitter[3]
    first, last = (west, east) if eastward else (east, west)
    return [(x, lane_y), (x, near), (first, near), (first, far), (last, far), (last, near), (x, near), (x, lane_y)]


def _round_corners(corners: FloatArray) -> FloatArray:
    """A closed polygon (C, 2) with every corner replaced by a quadratic Bezier arc."""
    before, after = np.roll(corners, 1, axis=0) - corners, np.roll(corners, -1, axis=0) - corners
    leg_before, leg_after = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    reach = np.minimum(CORNER_M, 0.5 * np.minimum(leg_before, leg_after))[:, None]
    start, end = corners + reach * before / leg_before[:, None], corners + reach * after / leg_after[:, None]
    u = np.linspace(0.0, 1.0, 16)[None, :, None]
    arc = (1 - u) ** 2 * start[:, None] + 2 * u * (1 - u) * corners[:, None] + u**2 * end[:, None]
    return np.asarray(arc.reshape(-1, 2))


def _resample(points: FloatArray) -> FloatArray:
    """A closed line (N, 2) resampled to equal steps of about `ROUTE_STEP_M`; the last point is not the first."""
    closed = np.vstack([points, points[:1]])
    arc_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    at = np.linspace(0.0, arc_m[-1], max(8, round(arc_m[-1] / ROUTE_STEP_M)), endpoint=False)
    return np.stack([np.interp(at, arc_m, closed[:, 0]), np.interp(at, arc_m, closed[:, 1])], axis=1)


def _speed_limits(route: FloatArray, config: DriveConfig) -> FloatArray:
    """(N,) speed at every point of the route from which the curves ahead can still be braked for."""
    span = 4  # points: curvature over 40 cm, about what the robot follows
    before, after = route - np.roll(route, span, axis=0), np.roll(route, -span, axis=0) - route
    turn = np.arctan2(
        before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], before[:, 0] * after[:, 0] + before[:, 1] * after[:, 1]
    )
    curvature = np.maximum(np.abs(turn) / (span * ROUTE_STEP_M), 1e-9)
    # besides the bound in curves: the turn rate of a curve must be reached within 20 cm of it
    grip = min(config.lateral_acceleration_mps2, 0.2 * config.turn_acceleration_radps2)
    limit = np.minimum(config.speed_mps, np.sqrt(grip / curvature))
    square = (np.minimum(limit, 0.8 * config.turn_radps / curvature) ** 2).tolist()
    gain = 2 * 0.7 * config.acceleration_mps2 * ROUTE_STEP_M
    for i in range(2 * len(square) - 2, -1, -1):  # twice around, because the route is closed
        here, ahead = i % len(square), (i + 1) % len(square)
        square[here] = min(square[here], square[ahead] + gain)
    return np.asarray(np.sqrt(square), dtype=np.float64)


def drive(
    route: FloatArray, config: DriveConfig, start_s: float, duration_s: float, rng: np.random.Generator
) -> PatrolDrive:
    """Follow the closed route from its first point for the given time, by pure pursuit.

    Args:
        route: (N, 2) from `patrol_route`.
        config: speeds, bounds and slip.
        start_s: first stamp.
        duration_s: last stamp minus first.
        rng: for the start pose (3 cm, 0.02 rad) and the slip.
    """
    dt = 1.0 / config.truth_hz
    steps = math.ceil(duration_s * config.truth_hz) + 1
    limits = _speed_limits(route, config).tolist()
    xs, ys = route[:, 0].tolist(), route[:, 1].tolist()
    heading = math.atan2(ys[1] - ys[0], xs[1] - xs[0])
    start = np.array([xs[0], ys[0], heading]) + rng.normal(0.0, [0.03, 0.03, 0.02])
    slip = (rng.normal(0.0, 1.0, steps) * config.slip_m / math.sqrt(dt)).tolist()

    rest = math.ceil(REST_S * config.truth_hz)
    behind = round(config.lookahead_m / ROUTE_STEP_M)
    forward_step, turn_step = config.acceleration_mps2 * dt, config.turn_acceleration_radps2 * dt
    x, y, theta = (float(value) for value in start)
    v = w = 0.0
    target = 0
    pose = np.empty((steps, 3))
    twist = np.zeros((steps, 3))
    for step in range(steps):
        pose[step] = x, y, theta
        if step < rest:
            continue
        look2 = max(config.lookahead_m, 0.35 * v) ** 2  # pure pursuit sways if it looks ahead less than that
        dx, dy = xs[target] - x, ys[target] - y
        while dx * dx + dy * dy < look2:
            target = (target + 1) % len(xs)
            dx, dy = xs[target] - x, ys[target] - y
        c, s = math.cos(theta), math.sin(theta)
        curvature = 2.0 * (c * dy - s * dx) / (dx * dx + dy * dy)
        wanted = min(limits[target], limits[target - behind], config.turn_radps / (abs(curvature) + 1e-9))
        v += min(max(wanted - v, -forward_step), forward_step)
        turn = min(max(v * curvature, -config.turn_radps), config.turn_radps)
        w += min(max(turn - w, -turn_step), turn_step)
        # the same exponential as se2.exp, on plain floats
        angle, side = w * dt, slip[step] * dt
        sinc = math.sin(angle) / angle if abs(angle) > 1e-12 else 1.0
        cosc = (1.0 - math.cos(angle)) / angle if abs(angle) > 1e-5 else angle / 2
        ahead, left = sinc * v * dt - cosc * side, cosc * v * dt + sinc * side
        x, y, theta = x + c * ahead - s * left, y + s * ahead + c * left, theta + angle
        twist[step] = v, slip[step], w
    pose[:, 2] = se2.wrap(pose[:, 2])
    return PatrolDrive(stamp_s=start_s + np.arange(steps, dtype=np.float64) * dt, pose_world_robot=pose, twist=twist)


def report_odometry(path: PatrolDrive, config: OdometryConfig, rng: np.random.Generator) -> Odometry:
    """Simulate what the encoders report of a drive: delayed, scaled and noisy forward and angular velocity."""
    start_s, end_s = path.stamp_s[0], path.stamp_s[-1]
    period_s = 1.0 / config.rate_hz
    # the last row's period ends within the drive
    passed_s = np.arange(math.floor((end_s - start_s) * config.rate_hz + 1e-3)) * period_s
    noise = rng.standard_normal((2, len(passed_s))) / math.sqrt(period_s)
    # integrals of the true velocities, of which the mean over any period is a difference; zero before the start
    true_s = path.stamp_s - start_s
    steps_s = np.diff(true_s, append=2 * true_s[-1] - true_s[-2])
    integral = np.vstack([np.zeros(3), np.cumsum(path.twist * steps_s[:, None], axis=0)])
    edges = np.append(true_s, true_s[-1] + steps_s[-1])

    def mean(column: int) -> FloatArray:
        upto = np.interp(passed_s + period_s - config.delay_s, edges, integral[:, column])
        since = np.interp(passed_s - config.delay_s, edges, integral[:, column])
        return np.asarray((upto - since) / period_s, dtype=np.float64)

    return Odometry(
        stamp_s=start_s + passed_s,
        forward_mps=mean(0) * config.forward_scale + config.forward_noise_m * noise[0],
        lateral_mps=np.zeros(len(passed_s)),
        angular_radps=mean(2) * config.angular_scale + config.angular_noise_rad * noise[1],
        clock=Clock.UNIX,
    )
