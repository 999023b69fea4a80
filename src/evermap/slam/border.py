"""One Gaussian of the newest pose and the border, step by step.

The border, that is the calibration states and the places of landmarks, is small, and given the newest pose the older
ones say nothing more about the next detection. So a step predicts the newest pose by its odometry, marginalises the
one before, and updates with the detections of the frame: an iterated extended Kalman filter (Bell and Cathey 1993)
whose measurement noise is re-weighted like the smoother's. A step costs `O(G^2)` for G numbers in the border, whatever
the number of poses; the batch smoother relinearises the old ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.slam.arrow import Smoother
from evermap.slam.frame_factor import linearise_frame, spread_of_frame, turn_pose
from evermap.slam.kernels import (
    AT_PLACES,
    adjoint,
    composed,
    inlier_weight,
    inverted,
    kernel,
    wrapped,
)
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.solver import Motion
from evermap.types import FloatArray, IntArray

UNKNOWN_VARIANCE = 1e4
"""Of a place before its first sighting, m^2: where nothing is known, but not so wide that digits are lost."""
ITERATIONS = 10
SMALL_STEP = 1e-4
"""Iterations of an update at most, and the step (m, rad or 1) that ends them."""


class BorderFilter:
    """The incremental solver that needs no graph; see `solver.IncrementalSolver` for its methods.

    Args:
        problem: the measurements.
        noise: standard deviations.
        robust: down-weight outliers (Cauchy, decided when the detection comes).
    """

    def __init__(self, problem: Problem, noise: Noise, *, robust: bool = True) -> None:
        self.problem = problem
        self._robust = robust
        self._noise = noise
        self._first_detection = np.searchsorted(problem.pose_row, np.arange(len(problem.stamp_s) + 1))
        self._pose = problem.start_pose.copy()
        self._states = problem.prior.mean.copy()
        self._place = np.zeros((0, 2))
        self._slot: dict[int, int] = {}
        self._covariance = np.zeros((AT_PLACES, AT_PLACES))
        self._covariance[:3, :3] = np.eye(3) / problem.start_information
        self._covariance[3:, 3:] = np.diag(problem.prior.sigma**2)
        self._old_pose = np.zeros((0, 3))
        self._new_pose: list[FloatArray] = []

    def restart(self, estimate: Estimate, noise: Noise, problem: Problem) -> None:
        """Restart at an optimum of all poses so far."""
        self.problem, self._noise = problem, noise
        smoother = Smoother(problem.until(len(estimate.pose)), noise, heavy=True, robust=self._robust)
        covariance = smoother.newest(estimate)
        places = np.flatnonzero(estimate.known)
        self._slot = {int(row): slot for slot, row in enumerate(places)}
        n_border = 2 * len(places)
        order = np.concatenate([np.arange(3), 3 + n_border + np.arange(9), 3 + np.arange(n_border)])
        self._covariance = covariance[np.ix_(order, order)]
        self._pose, self._states = estimate.pose[-1].copy(), estimate.states.copy()
        self._place = estimate.landmark[places]
        self._old_pose, self._new_pose = estimate.pose[:-1], [self._pose.copy()]

    def add(self, row: int, motion: Motion | None, landmark: FloatArray) -> None:
        """Add pose `row` with its odometry and its detections."""
        problem = self.problem
        detections = np.arange(self._first_detection[row], self._first_detection[row + 1])
        rows = problem.landmark_row[detections]
        for j in dict.fromkeys(rows.tolist()):
            if j not in self._slot:
                self._meet(j, landmark)
        if motion is not None:
            drive_on(self._pose, self._covariance, motion.increment, motion.by_states, motion.covariance)
        _update(
            self._pose,
            self._states,
            self._place,
            self._covariance,
            np.array([self._slot[j] for j in rows.tolist()], dtype=np.int64),
            problem.reading[detections],
            self._noise.of_detections(problem.sigma_given[detections]),
            problem.mount,
            problem.prior.free,
            self._robust,
        )
        self._new_pose.append(self._pose.copy())

    def last_pose(self) -> FloatArray:
        """Return (3,) the newest pose."""
        return self._pose.copy()

    def last_covariance(self) -> FloatArray:
        """Return (3, 3) its covariance, in its own frame."""
        return self._covariance[:3, :3].copy()

    def states(self) -> FloatArray:
        """Return (9,) calibration states."""
        return self._states.copy()

    def landmark(self, row: int) -> FloatArray:
        """Return (2,) one place; nan where it is not known yet."""
        slot = self._slot.get(row)
        return np.full(2, np.nan) if slot is None else self._place[slot].copy()

    def estimate(self) -> Estimate:
        """Return values of everything so far; poses since the last restart as they were when they were added."""
        landmark = np.full((len(self.problem.landmark_mean), 2), np.nan)
        landmark[list(self._slot)] = self._place
        return Estimate(np.vstack([self._old_pose, *self._new_pose]), landmark, self._states.copy())

    def joint_covariance(self, places: IntArray) -> FloatArray:
        """Return (12 + 2 k, 12 + 2 k) of the newest pose, the calibration states and k known places."""
        slots = np.array([self._slot[j] for j in places.tolist()], dtype=np.int64)
        columns = AT_PLACES + (2 * slots[:, None] + [0, 1]).ravel()
        rows = np.concatenate([np.arange(AT_PLACES), columns])
        joint: FloatArray = self._covariance[np.ix_(rows, rows)]
        return joint

    def _meet(self, row: int, landmark: FloatArray) -> None:
        """A place that was not known: at its prior given those that are, or anywhere."""
        problem = self.problem
        known = np.zeros(len(problem.landmark_mean), dtype=bool)
        known[list(self._slot)] = True
        prior = problem.conditional_prior(row, known)
        size = len(self._covariance)
        gain = np.zeros((2, size))
        for k, j in enumerate(prior.given.tolist()):
            at = AT_PLACES + 2 * self._slot[j]
            gain[:, at : at + 2] = prior.gain[:, 2 * k : 2 * k + 2]
        grown = np.empty((size + 2, size + 2))
        grown[:size, :size] = self._covariance
        grown[size:, :size] = gain @ self._covariance
        grown[:size, size:] = grown[size:, :size].T
        given = bool(prior.information.any())
        spread = np.linalg.inv(prior.information) if given else UNKNOWN_VARIANCE * np.eye(2)
        grown[size:, size:] = gain @ self._covariance @ gain.T + spread
        self._covariance = grown
        known_places = np.full_like(problem.landmark_mean, np.nan)
        known_places[list(self._slot)] = self._place
        place = prior.place(known_places, problem.landmark_mean) if given else landmark[row]
        self._slot[row] = len(self._place)
        self._place = np.vstack([self._place, place])


@kernel
def drive_on(
    pose: FloatArray, covariance: FloatArray, increment: FloatArray, by_states: FloatArray, noise: FloatArray
) -> None:
    """Advance the newest pose and the joint covariance to the next pose, in place."""
    pose[:] = composed(pose, increment)
    pose[2] = wrapped(pose[2])
    size = len(covariance)
    carry = adjoint(inverted(increment))
    for k in range(3, size):
        x, y, turn = covariance[0, k], covariance[1, k], covariance[2, k]
        covariance[0, k] = carry[0, 0] * x + carry[0, 1] * y + carry[0, 2] * turn
        covariance[1, k] = carry[1, 0] * x + carry[1, 1] * y + carry[1, 2] * turn
    block = covariance[:3, :3].copy()
    cross = covariance[:3, 8:12].copy() @ by_states.T
    covariance[:3, :3] = carry @ block @ carry.T + cross + cross.T + noise
    covariance[:3, :3] += by_states @ covariance[8:12, 8:12].copy() @ by_states.T
    for a in range(3):
        for k in range(3, size):
            for b in range(4):
                covariance[a, k] += by_states[a, b] * covariance[8 + b, k]
            covariance[k, a] = covariance[a, k]


@kernel
def _update(
    pose: FloatArray,
    states: FloatArray,
    place: FloatArray,
    covariance: FloatArray,
    slot: Any,
    reading: FloatArray,
    sigma: FloatArray,
    mount: FloatArray,
    free: Any,
    robust: bool,
) -> None:
    """All detections of a frame at once, relinearised and re-weighted until nothing moves; all in place."""
    size, count = len(covariance), len(reading)
    if count == 0:
        return
    start, start_states, start_place = pose.copy(), states.copy(), place.copy()
    step, weight = np.zeros(size), np.ones(count)
    residual = np.zeros(2 * count)
    jacobian, column = np.zeros((2 * count, 10)), np.zeros((count, 10), dtype=np.int64)
    spread, gain = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, size))
    for iteration in range(ITERATIONS):
        linearise_frame(pose, states, place, slot, reading, mount, free, step[2], residual, jacobian, column)
        spread_of_frame(covariance, jacobian, column, gain, spread)
        for m in range(count if iteration > 0 and robust else 0):
            squared = (residual[2 * m] / sigma[m, 0]) ** 2 + (residual[2 * m + 1] / sigma[m, 1]) ** 2
            weight[m] = inlier_weight(squared, 0.0, True)
        if iteration == 0 and robust:
            # before anything is known of this frame: as surprising as its innovation is
            for m in range(count):
                a = spread[2 * m, 2 * m] + sigma[m, 0] ** 2
                b = spread[2 * m, 2 * m + 1]
                d = spread[2 * m + 1, 2 * m + 1] + sigma[m, 1] ** 2
                x, y = residual[2 * m], residual[2 * m + 1]
                weight[m] = inlier_weight((d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b), 0.0, True)
        for m in range(count):
            for k in range(2):
                spread[2 * m + k, 2 * m + k] += sigma[m, k] ** 2 / weight[m]
        # innovation at the step so far, told at the start
        for row in range(2 * count):
            for a in range(10):
                residual[row] -= jacobian[row, a] * step[column[row // 2, a]]
        pull: Any = np.linalg.solve(spread, residual)
        moved = 0.0
        for k in range(size):
            total = 0.0
            for row in range(2 * count):
                total -= gain[row, k] * pull[row]
            moved = max(moved, abs(total - step[k]))
            step[k] = total
        c, s = np.cos(start[2]), np.sin(start[2])
        pose[0] = start[0] + c * step[0] - s * step[1]
        pose[1] = start[1] + s * step[0] + c * step[1]
        pose[2] = wrapped(start[2] + step[2])
        states[:] = start_states + step[3:AT_PLACES]
        place[:] = start_place + step[AT_PLACES:].reshape(-1, 2)
        if moved < SMALL_STEP:
            break
    root: Any = np.linalg.cholesky(spread)
    white: Any = np.linalg.solve(root, gain)
    for i in range(size):
        for k in range(i, size):
            total = 0.0
            for row in range(2 * count):
                total += white[row, i] * white[row, k]
            covariance[i, k] -= total
            if k > i:
                covariance[k, i] = covariance[i, k]
    turn_pose(covariance, step[2])
