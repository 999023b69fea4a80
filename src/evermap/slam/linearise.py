"""A problem as whitened linear factors: Jacobians and right sides, in the layout of `sparse`."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from evermap.slam.kernels import N_MOTION, N_SENSOR, detection_residual, inlier_weight, kernel, outlier_loss
from evermap.slam.preintegration import Intervals, linearise_interval
from evermap.slam.problem import Estimate, Problem
from evermap.types import BoolArray, FloatArray, IntArray

OF_INTERVAL, OF_DETECTION = 3 + 3 + N_MOTION + 1, 3 + 2 + N_SENSOR + 1
"""Numbers of a row: by two poses and the states of the odometry, by pose, place and the states of the sensor; and the
right side."""
ODOMETRY, DETECTION = 3 * OF_INTERVAL, 2 * OF_DETECTION
"""Numbers of one factor, of three rows and of two."""


class Readings(NamedTuple):
    """Detections as the kernel reads them: (M,) rows of pose and place, (M, 2) readings and sigmas; (3,) mount.

    `free` (11,) are the calibration states that are estimated; `log_odds` and `heavy` as for `kernels.inlier_weight`.
    """

    pose_row: IntArray
    place: IntArray
    reading: FloatArray
    sigma: FloatArray
    mount: FloatArray
    free: BoolArray
    log_odds: float
    heavy: bool


@kernel
def root_of(information: FloatArray, root: FloatArray) -> None:
    """Compute the upper triangular root of `information = root' root`, (3, 3); what is below stays as it is."""
    for a in range(3):
        for b in range(a, 3):
            total = information[a, b]
            for k in range(a):
                total -= root[k, a] * root[k, b]
            root[a, b] = math.sqrt(total) if a == b else total / root[a, a]


@kernel
def linearise(
    pose: FloatArray, place: FloatArray, states: FloatArray, driven: Intervals, variance: FloatArray, seen: Readings,
    values: FloatArray, weight: FloatArray, begin: int, end: int, first: int, last: int,
) -> float:  # fmt: skip
    """Linearise the odometry from poses `begin` to `end - 1`, and the detections from `first` to `last - 1`.

    At poses (N, 3), places (P, 2) and calibration states (11,), with the variance (5,) of each kind of noise of the
    odometry. Filled in are `values`, factors of odometry before those of detections, and inlier weights (M,). Returns
    the negative log likelihood, up to a constant.
    """
    cost, at = 0.0, ODOMETRY * begin
    information, e, root = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    j = np.zeros((3, OF_INTERVAL - 1))
    for i in range(begin, end):
        linearise_interval(driven, i, pose, variance, seen.free, e, j, information)
        root_of(information, root)
        for a in range(3):
            for b in range(OF_INTERVAL - 1):
                total = 0.0
                for k in range(a, 3):
                    total += root[a, k] * j[k, b]
                values[at + b] = total
            total = 0.0
            for k in range(a, 3):
                total += root[a, k] * e[k]
            values[at + OF_INTERVAL - 1] = -total
            cost += 0.5 * total * total
            at += OF_INTERVAL
    at = ODOMETRY * (len(pose) - 1) + DETECTION * first
    z, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(first, last):
        detection_residual(
            pose[seen.pose_row[m]], place[seen.place[m]], states, seen.mount, seen.reading[m, 0], seen.reading[m, 1],
            z, jx, jl, jc,
        )  # fmt: skip
        squared = (z[0] / seen.sigma[m, 0]) ** 2 + (z[1] / seen.sigma[m, 1]) ** 2
        weight[m] = inlier_weight(squared, seen.log_odds, seen.heavy)
        cost += outlier_loss(squared, seen.log_odds, seen.heavy)
        for row in range(2):
            scale = math.sqrt(weight[m]) / seen.sigma[m, row]
            for a in range(3):
                values[at + a] = scale * jx[row, a]
            for a in range(2):
                values[at + 3 + a] = scale * jl[row, a]
            for a in range(N_SENSOR):
                values[at + 5 + a] = scale * jc[row, a] if seen.free[a] else 0.0
            values[at + OF_DETECTION - 1] = -scale * z[row]
            at += OF_DETECTION
    return cost


def detection_residuals(problem: Problem, estimate: Estimate) -> FloatArray:
    """Return (M, 2) measured minus predicted range [m] and bearing [rad]."""
    out = np.empty((len(problem.pose_row), 2))
    _detection_residuals(
        estimate.pose, estimate.landmark, estimate.states, problem.pose_row, problem.landmark_row, problem.reading,
        problem.mount, out,
    )  # fmt: skip
    return out


@kernel
def _detection_residuals(
    pose: FloatArray, landmark: FloatArray, states: FloatArray, pose_row: Any, landmark_row: Any, reading: FloatArray,
    mount: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    jx, jl, jc = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(len(pose_row)):
        detection_residual(
            pose[pose_row[m]], landmark[landmark_row[m]], states, mount, reading[m, 0], reading[m, 1], out[m],
            jx, jl, jc,
        )  # fmt: skip
