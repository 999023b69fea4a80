"""Odometry beside the trajectory: motions within windows, turns, and the delay between their clocks."""

from __future__ import annotations

from math import nan

import numpy as np

from evermap.geometry import se2, se3
from evermap.slam.gaps import find_gaps, is_outside
from evermap.types import FloatArray, IntArray, Odometry, ParameterEstimate, SlamResult, SpatialOdometry

WINDOWS = 40
"""Parts of a drive by which odometry and trajectory are compared: long over the noise, short against drift."""
SHORTEST_S = 2.0
LEAST_MOTION_M = 0.05
"""Motion within a window, below which the robot stands: its relative error says nothing."""
LATE_S, EARLY_S = 0.14, 0.05
"""Delay up to which the odometry is taken to be what is late, by its filters and bridges; a longer one is as well the
sensor's, whose readings are processed. And by how much odometry may seem early, as two clocks differ: no driver stamps
what has not happened yet, so that by more it is the sensor that is late."""
SURELY = 2.0
"""Standard deviations by which a delay must be one, and an early odometry be earlier than that."""


def compare_odometry(result: SlamResult, odometry: Odometry | SpatialOdometry | None) -> tuple[float, float, float]:
    """Return by how much odometry and trajectory differ within windows, as a share of the motion, in angle, in length.

    All are medians over windows in which either moved, and in which the odometry has no gap.
    """
    path, other = result.trajectory, result.dead_reckoning
    if len(path) < 3 or len(other) != len(path) or not np.array_equal(path.stamp_s, other.stamp_s):
        return nan, nan, nan
    lag_s = max(SHORTEST_S, float(path.stamp_s[-1] - path.stamp_s[0]) / WINDOWS)
    last = np.searchsorted(path.stamp_s, path.stamp_s + lag_s)
    first = np.flatnonzero(last < len(path))
    first = (
        first[np.linspace(0, len(first) - 1, min(len(first), 20 * WINDOWS)).astype(np.int64)] if len(first) else first
    )
    if odometry is not None:
        first = first[is_outside(find_gaps(odometry), path.stamp_s[first], path.stamp_s[last[first]])]
    if len(first) < 3:
        return nan, nan, nan
    one, two = (find_motions(each.pose_world_robot, first, last[first]) for each in (path, other))
    went = np.stack([np.linalg.norm(each, axis=1) for each in (one, two)])
    moves = went.max(axis=0) > LEAST_MOTION_M
    turned = find_turns_between(path.pose_world_robot, other.pose_world_robot, first, last[first])
    turn = float(np.median(np.abs(turned)))
    if moves.sum() < 3:
        return nan, turn, nan
    apart = np.linalg.norm(one - two, axis=1)[moves] / went.max(axis=0)[moves]
    longer = went[0][moves].sum() / max(float(went[1][moves].sum()), 1e-9)
    return float(np.median(apart)), turn, float(longer)


def find_motions(pose: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    """Return (W, D) translations from rows of poses to others, in the frame of their start."""
    group, dim = (se2, 2) if pose.shape[1] == 3 else (se3, 3)
    return np.asarray(group.between(pose[first], pose[last])[:, :dim])


def find_turns_between(path: FloatArray, other: FloatArray, first: IntArray, last: IntArray) -> FloatArray:
    """Return (W,) angles between turns by the one and by the other."""
    if path.shape[1] == 3:
        one, two = (each[last, 2] - each[first, 2] for each in (path, other))
        return np.asarray(se2.wrap(one - two))
    return se3.angle_between(*(se3.between(each[first], each[last]) for each in (path, other)))


def find_odometry_delay(result: SlamResult) -> ParameterEstimate | None:
    """Return the delay of the odometry where it was estimated, as in the plane, and was not put right."""
    if any((cause.code, cause.subject) == ("clock", "sensor") for cause in result.causes):
        return None
    return next((each for each in result.parameters if each.name == "odometry_delay_s" and not each.fixed), None)


def find_shift_by_clock_m(result: SlamResult) -> float:
    """Return how far the robot goes, by its usual speed, within a long delay between odometry and detections.

    Poses are those of the detections' clock: if the odometry's is right, they are off by as much.
    """
    path, delay = result.trajectory, find_odometry_delay(result)
    if delay is None or len(path) < 3:
        return nan
    is_late = delay.value > max(LATE_S, SURELY * delay.sigma)
    if not (is_late or delay.value + SURELY * delay.sigma < -EARLY_S):
        return nan
    dim = 2 if path.pose_world_robot.shape[1] == 3 else 3
    went = np.linalg.norm(np.diff(path.pose_world_robot[:, :dim], axis=0), axis=1)
    return abs(delay.value) * float(went.sum()) / max(float(path.stamp_s[-1] - path.stamp_s[0]), 1e-9)
