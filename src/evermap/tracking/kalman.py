"""Constant-acceleration and constant-velocity Kalman filters in space, over all tracklets at once.

One path for every measurement covariance: the axes are independent filters only where all noise is diagonal, which that
of a camera or a lidar, long in its line of sight, never is; and the whole nine states cost half a microsecond.
"""

from __future__ import annotations

import numpy as np

from evermap.tracking.kernels import invert, kernel
from evermap.types import FloatArray


@kernel
def predict(mean: FloatArray, covariance: FloatArray, n: int, gap_s: float, density: float) -> None:
    """Move the first `n` filters on by `gap_s`, in place: white jerk (D = 9) or white acceleration (D = 6).

    Args:
        mean: (N, D) position, velocity and acceleration, three axes each.
        covariance: (N, D, D).
        n: rows in use.
        gap_s: time since the last prediction.
        density: power spectral density of the noise, each axis.
    """
    t = gap_s
    d = mean.shape[1]
    if d == 9:
        by_second = 0.5 * t * t
        t2, t3 = t * t, t * t * t
        q00, q01, q02 = density * t2 * t3 / 20.0, density * t2 * t2 / 8.0, density * t3 / 6.0
        q11, q12, q22 = density * t3 / 3.0, density * t2 / 2.0, density * t
        for i in range(n):
            m, p = mean[i], covariance[i]
            for a in range(3):
                m[a] += t * m[3 + a] + by_second * m[6 + a]
                m[3 + a] += t * m[6 + a]
            for a in range(3):  # rows, then columns: F P, then (F P) F'
                for c in range(9):
                    p[a, c] += t * p[3 + a, c] + by_second * p[6 + a, c]
                    p[3 + a, c] += t * p[6 + a, c]
            for r in range(9):
                for a in range(3):
                    p[r, a] += t * p[r, 3 + a] + by_second * p[r, 6 + a]
                    p[r, 3 + a] += t * p[r, 6 + a]
            for a in range(3):
                p[a, a] += q00
                p[3 + a, 3 + a] += q11
                p[6 + a, 6 + a] += q22
                p[a, 3 + a] += q01
                p[3 + a, a] += q01
                p[a, 6 + a] += q02
                p[6 + a, a] += q02
                p[3 + a, 6 + a] += q12
                p[6 + a, 3 + a] += q12
    else:
        q00, q01, q11 = density * t * t * t / 3.0, density * t * t / 2.0, density * t
        for i in range(n):
            m, p = mean[i], covariance[i]
            for a in range(3):
                m[a] += t * m[3 + a]
                for c in range(6):
                    p[a, c] += t * p[3 + a, c]
            for r in range(6):
                for a in range(3):
                    p[r, a] += t * p[r, 3 + a]
            for a in range(3):
                p[a, a] += q00
                p[3 + a, 3 + a] += q11
                p[a, 3 + a] += q01
                p[3 + a, a] += q01


@kernel
def update(mean: FloatArray, covariance: FloatArray, position: FloatArray, noise: FloatArray) -> None:
    """Take in one measured position, in place; with D = 3 the filter is that of a place that does not move.

    Args:
        mean: (D,) of one filter; its first three states are the position.
        covariance: (D, D).
        position: (3,) measured.
        noise: (3, 3) its covariance.
    """
    d = mean.shape[0]
    s, inverse, gain, innovation = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 3)), np.empty(3)
    for a in range(3):
        innovation[a] = position[a] - mean[a]
        for b in range(3):
            s[a, b] = covariance[a, b] + noise[a, b]
    invert(s, inverse)
    for r in range(d):
        for b in range(3):
            gain[r, b] = (
                covariance[r, 0] * inverse[0, b] + covariance[r, 1] * inverse[1, b] + covariance[r, 2] * inverse[2, b]
            )
    for r in range(d):
        mean[r] += gain[r, 0] * innovation[0] + gain[r, 1] * innovation[1] + gain[r, 2] * innovation[2]
    for r in range(d - 1, -1, -1):  # from the last row, so that the first three are still the old ones
        for c in range(r, -1, -1):
            lowered = (
                covariance[r, c]
                - gain[r, 0] * covariance[c, 0]
                - gain[r, 1] * covariance[c, 1]
                - gain[r, 2] * covariance[c, 2]
            )
            covariance[r, c] = lowered
    for r in range(d):
        for c in range(r):
            covariance[c, r] = covariance[r, c]
