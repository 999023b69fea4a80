"""What the streaming estimator asks of an incremental solver between two relinearisations by the batch smoother."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from evermap.slam.kernels import (
    AT_PLACES,
    N_NOISE,
    adjoint,
    composed,
    detection_residual,
    integrate_odometry,
    inverted,
    kernel,
    multiply,
    odometry_covariance,
    sandwich,
)
from evermap.slam.problem import Drive, Estimate, Marginals, Noise, Problem
from evermap.types import BoolArray, FloatArray, IntArray


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
        """Return between two instants, with (9,) calibration states of which some are `free`."""
        odometry = drive.stamp_s, drive.velocity, drive.unknown
        return cls(*_driven(*odometry, start_s, stop_s, states, free, noise.odometry))


@kernel
def _driven(
    stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, start_s: float, stop_s: float, states: FloatArray,
    free: Any, sigma: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Increment, derivatives by states that are free, and covariance of the motion between two instants."""
    increment, by_states = np.zeros(3), np.zeros((3, 4))
    kinds, covariance = np.zeros((N_NOISE, 3, 3)), np.zeros((3, 3))
    integrate_odometry(stamp, velocity, unknown, start_s, stop_s, states, increment, by_states, kinds, covariance)
    odometry_covariance(kinds, covariance, sigma**2, covariance)
    for k in range(4):
        if not free[5 + k]:
            by_states[:, k] = 0.0
    return increment, by_states, covariance


class IncrementalSolver(Protocol):
    """Pose after pose; the newest pose, the places of landmarks and the calibration states are known jointly.

    Attributes:
        problem: the measurements; rows beyond those added are not looked at. May be exchanged between two steps for
            one with the same frames whose coming detections belong to other places, or that has more places at the
            end; what was added before stays as it was until `restart`.
    """

    problem: Problem

    def restart(self, estimate: Estimate, noise: Noise, problem: Problem, marginals: Marginals | None = None) -> None:
        """Restart at `estimate`, an optimum of the first poses, with other noise, other places or other priors.

        Args:
            estimate: values of the first poses, and of all places that they saw.
            noise: standard deviations from here on.
            problem: the measurements.
            marginals: covariances at `estimate`, where they are known already.
        """
        ...

    def add(self, row: int, motion: Motion | None, landmark: FloatArray) -> None:
        """Add pose `row` with its odometry and its detections.

        Args:
            row: the pose to add, one more than the last.
            motion: odometry since the pose before; None for the first.
            landmark: (L, 2) positions of places, used for those that are seen for the first time.
        """
        ...

    def last_pose(self) -> FloatArray:
        """Return (3,) the newest pose."""
        ...

    def last_covariance(self) -> FloatArray:
        """Return (3, 3) its covariance, in its own frame."""
        ...

    def states(self) -> FloatArray:
        """Return (9,) calibration states."""
        ...

    def landmark(self, row: int) -> FloatArray:
        """Return (2,) one place; nan where it is not known yet."""
        ...

    def estimate(self) -> Estimate:
        """Return values of everything so far; old poses may be from when they were added."""
        ...

    def around(self, places: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return a covariance in which known places (k,) stand, their positions, and where.

        Returns:
            (12 + 2 P, 12 + 2 P) of the newest pose, the calibration states, and P places, not to be changed; (P, 2)
            these places; (k,) which of them each is.
        """
        ...


def compare(
    solver: IncrementalSolver, noise: Noise, motion: Motion, detections: IntArray, places: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return innovations of detections of the coming pose, before they are used, if they were of these places.

    Args:
        solver: with all poses before.
        noise: levels of the detections.
        motion: odometry since the newest pose.
        detections: (k,) rows of the problem's detections.
        places: (k,) rows of known places.

    Returns:
        (k,) squared Mahalanobis distances with `S = H P H' + R`, of pose, place and states together, and (k,)
        `log |S|`.
    """
    problem = solver.problem
    nis, log_det = np.empty(len(detections)), np.empty(len(detections))
    joint, place, column = solver.around(places)
    _innovations(
        joint, solver.last_pose(), motion.increment, solver.states(), place, column, motion.by_states,
        motion.covariance, problem.reading[detections], noise.of_detections(problem.sigma_given[detections]),
        problem.mount, problem.prior.free, nis, log_det,
    )  # fmt: skip
    return nis, log_det


@kernel
def _innovations(
    joint: FloatArray, pose_before: FloatArray, increment: FloatArray, states: FloatArray, places: FloatArray,
    column: Any, by_states: FloatArray, odometry_covariance: FloatArray, reading: FloatArray, sigma: FloatArray,
    mount: FloatArray, free: Any, nis: FloatArray, log_det: FloatArray,
) -> None:  # fmt: skip
    """Distance and log determinant of every detection by itself; `joint` belongs to the pose before."""
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    h, h_part, part, rows = np.zeros((2, 14)), np.zeros((2, 14)), np.zeros((14, 14)), np.arange(14)
    s, by_noise, jx_part = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 3))
    pose, carry = composed(pose_before, increment), adjoint(inverted(increment))
    for m in range(len(reading)):
        at = places[column[m]]
        detection_residual(pose, at, states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        # the new pose in terms of the old one and the states
        multiply(jx, carry, h[:, :3])
        for k in range(5):
            h[0, 3 + k], h[1, 3 + k] = (jc[0, k], jc[1, k]) if free[k] else (0.0, 0.0)
        multiply(jx, by_states, h[:, 8:12])
        h[:, 12:] = jl
        rows[12], rows[13] = AT_PLACES + 2 * column[m], AT_PLACES + 2 * column[m] + 1
        for row in range(14):
            for other in range(14):
                part[row, other] = joint[rows[row], rows[other]]
        sandwich(h, part, h_part, s)
        sandwich(jx, odometry_covariance, jx_part, by_noise)
        a = s[0, 0] + by_noise[0, 0] + sigma[m, 0] ** 2
        b = s[0, 1] + by_noise[0, 1]
        d = s[1, 1] + by_noise[1, 1] + sigma[m, 1] ** 2
        det = a * d - b * b
        nis[m] = (d * e[0] * e[0] - 2.0 * b * e[0] * e[1] + a * e[1] * e[1]) / det
        log_det[m] = np.log(det)
