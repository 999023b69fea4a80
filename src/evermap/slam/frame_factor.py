"""One frame linearised, compiled: what the filters share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evermap.slam.kernels import (
    AT_PLACES,
    detection_residual,
    kernel,
)
from evermap.types import FloatArray, IntArray


@kernel
def linearise_frame(
    pose: FloatArray, states: FloatArray, place: FloatArray, slot: IntArray, reading: FloatArray, mount: FloatArray,
    free: Any, turned: float, residual: FloatArray, jacobian: FloatArray, column: IntArray,
) -> None:  # fmt: skip
    """Compute residuals (2 M,), derivatives (2 M, 10) and which numbers of the state (M, 10) these are by.

    The step of the pose is told in the frame of where it started, from which it has `turned` by now.
    """
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    c, s = math.cos(turned), math.sin(turned)
    for m in range(len(reading)):
        detection_residual(pose, place[slot[m]], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        for k in range(2):
            row = 2 * m + k
            residual[row] = e[k]
            jacobian[row, 0] = c * jx[k, 0] - s * jx[k, 1]
            jacobian[row, 1] = s * jx[k, 0] + c * jx[k, 1]
            jacobian[row, 2] = jx[k, 2]
            for a in range(5):
                jacobian[row, 3 + a] = jc[k, a] if free[a] else 0.0
            jacobian[row, 8], jacobian[row, 9] = jl[k, 0], jl[k, 1]
        for a in range(8):
            column[m, a] = a
        column[m, 8], column[m, 9] = AT_PLACES + 2 * slot[m], AT_PLACES + 2 * slot[m] + 1


@kernel
def spread_of_frame(
    covariance: FloatArray, jacobian: FloatArray, column: IntArray, gain: FloatArray, spread: FloatArray
) -> None:
    """Compute `H P` (2 M, size) and `H P H'` (2 M, 2 M)."""
    gain[:] = 0.0
    for row in range(len(jacobian)):
        for a in range(10):
            by, at = jacobian[row, a], column[row // 2, a]
            if by != 0.0:
                for k in range(len(covariance)):
                    gain[row, k] += by * covariance[at, k]
    spread[:] = np.ascontiguousarray(gain[:, :8]) @ np.ascontiguousarray(jacobian[:, :8].T)
    for row in range(len(jacobian)):
        for other in range(row + 1):
            x, y = column[other // 2, 8], column[other // 2, 9]
            total = spread[row, other] + gain[row, x] * jacobian[other, 8] + gain[row, y] * jacobian[other, 9]
            spread[row, other] = spread[other, row] = total


@kernel
def turn_pose(covariance: FloatArray, turned: float) -> None:
    """Rotate the covariance of the pose into its own frame, which has turned."""
    c, s = math.cos(turned), math.sin(turned)
    for k in range(len(covariance)):
        x, y = covariance[0, k], covariance[1, k]
        covariance[0, k], covariance[1, k] = c * x + s * y, -s * x + c * y
    for k in range(len(covariance)):
        x, y = covariance[k, 0], covariance[k, 1]
        covariance[k, 0], covariance[k, 1] = c * x + s * y, -s * x + c * y
