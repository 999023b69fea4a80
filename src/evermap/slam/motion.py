"""Odometry between two instants: the motion, its noise, and how it depends on the calibration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.slam.kernels import N_MOTION, N_NOISE, N_SENSOR, integrate_odometry, kernel, odometry_covariance
from evermap.slam.problem import Drive, Noise, Problem
from evermap.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Motion:
    """Odometry between two poses.

    Attributes:
        increment: (3,) the second pose seen from the first.
        by_states: (3, 4) its derivative, at its end, by delay, scales and slip; zero where these are not free.
        covariance: (3, 3) its noise.
    """

    increment: FloatArray
    by_states: FloatArray
    covariance: FloatArray

    @classmethod
    def between(cls, problem: Problem, noise: Noise, row: int, states: FloatArray) -> Motion:
        """Return from pose `row - 1` to pose `row`."""
        return cls.over(
            problem.drive, problem.stamp_s[row - 1], problem.stamp_s[row], states, problem.prior.free, noise
        )

    @classmethod
    def over(
        cls, drive: Drive, start_s: float, stop_s: float, states: FloatArray, free: BoolArray, noise: Noise
    ) -> Motion:
        """Return between two instants, with (11,) calibration states of which some are `free`."""
        odometry = drive.stamp_s, drive.velocity, drive.unknown
        return cls(*_driven(*odometry, start_s, stop_s, states, free, noise.odometry))


@kernel
def _driven(
    stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, start_s: float, stop_s: float, states: FloatArray,
    free: Any, sigma: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Increment, derivatives by states that are free, and covariance of the motion between two instants."""
    increment, by_states = np.zeros(3), np.zeros((3, N_MOTION))
    kinds, covariance = np.zeros((N_NOISE, 3, 3)), np.zeros((3, 3))
    integrate_odometry(stamp, velocity, unknown, start_s, stop_s, states, increment, by_states, kinds, covariance)
    odometry_covariance(kinds, covariance, sigma**2, covariance)
    for k in range(N_MOTION):
        if not free[N_SENSOR + k]:
            by_states[:, k] = 0.0
    return increment, by_states, covariance
