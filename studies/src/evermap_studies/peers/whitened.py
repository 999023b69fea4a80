"""Whitened residuals of one frame, compiled: what gtsam's factor graph evaluates."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.estimate.robust import HEAVY_TAIL, weigh
from evermap.slam.kernels import (
    N_SENSOR,
    detection_residual,
    integrate_odometry,
    kernel,
    odometry_residual,
    residual_by_states,
)
from evermap.types import FloatArray


@kernel
def whitened_odometry(
    before: FloatArray,
    pose: FloatArray,
    states: FloatArray,
    odometry_stamp: FloatArray,
    velocity: FloatArray,
    unknown: FloatArray,
    start: float,
    stop: float,
    variance: FloatArray,
    free: Any,
    residual: FloatArray,
    by_before: FloatArray,
    by_pose: FloatArray,
    by_states: FloatArray,
) -> None:
    """Whiten the odometry residual by the inverse Cholesky factor of its covariance; all outputs have three rows."""
    increment, motion, noise, covariance = np.zeros(3), np.zeros((3, 4)), np.zeros((5, 3, 3)), np.zeros((3, 3))
    integrate_odometry(odometry_stamp, velocity, unknown, start, stop, states, increment, motion, noise, covariance)
    for kind in range(len(variance)):
        covariance += variance[kind] * noise[kind]
    e, j1, j2 = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    odometry_residual(before, pose, increment, e, j1, j2)
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    residual[:] = white @ e
    by_before[:] = white @ j1
    by_pose[:] = white @ j2
    residual_by_states(motion, e, free)
    by_states[:, N_SENSOR:] = white @ motion


@kernel
def whitened_detections(
    pose: FloatArray,
    points: FloatArray,
    states: FloatArray,
    mount: FloatArray,
    reading: FloatArray,
    sigma: FloatArray,
    column: Any,
    free: Any,
    heavy: bool,
    residual: FloatArray,
    by_pose: FloatArray,
    by_points: FloatArray,
    by_states: FloatArray,
) -> None:
    """Whiten the detection residuals, with the root of their robust weight; two rows a detection."""
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(len(reading)):
        detection_residual(pose, points[column[m]], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        squared = (e[0] / sigma[m, 0]) ** 2 + (e[1] / sigma[m, 1]) ** 2
        root = np.sqrt(weigh(squared, 0.0, HEAVY_TAIL, 0.0)[0]) if heavy else 1.0
        for k in range(2):
            row = 2 * m + k
            scale = root / sigma[m, k]
            residual[row] = scale * e[k]
            for a in range(3):
                by_pose[row, a] = scale * jx[k, a]
            for a in range(2):
                by_points[column[m], row, a] = scale * jl[k, a]
            for a in range(N_SENSOR):
                if free[a]:
                    by_states[row, a] = scale * jc[k, a]
