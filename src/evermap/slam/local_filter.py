"""One Gaussian of the newest pose, the calibration states and the places around, step by step.

Given the newest pose the older ones say nothing more about the next detection. So a step predicts the newest pose by
its odometry, marginalises the one before, and updates with the detections of the frame: an iterated extended Kalman
filter (Bell and Cathey 1993) whose measurement noise is re-weighted like the smoother's.

Only the places that were used last, at most `MOST_ACTIVE`, stand in the covariance, so that a step costs the same
whatever the size of the world (compare the compressed filter of Guivant and Nebot 2001, whose far places wait, too). A
place that leaves is kept with what ties it to its nearest neighbours; where it comes back it is where these take it.
Those that were met before the last relinearisation are tied as the batch smoother says, exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.compiled import kept
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
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.solver import Motion
from evermap.types import FloatArray, IntArray

UNKNOWN_VARIANCE = 1e4
"""Of a place before its first sighting, m^2: where nothing is known, but not so wide that digits are lost."""
LEAST_VARIANCE = 1e-12
"""Of neighbours, m^2: two that are known exactly, or as one, say no more than one of them."""
ITERATIONS = 10
SMALL_STEP = 1e-4
"""Iterations of an update at most, and the step (m, rad or 1) that ends them."""
MOST_ACTIVE = 64
"""Places in the covariance: those of several views around the robot."""
LEAVING = 16
"""Places that leave at once when there are more."""
NEIGHBOURS = 8
"""Places, the nearest, to which a place is tied while it is not in the covariance."""


@dataclass(frozen=True, slots=True)
class Ties:
    """Where a place was when it was in no covariance any more, together with its neighbours.

    Attributes:
        rows: (k,) neighbours.
        place: (2,) of the place itself; neighbours: (k, 2) of these.
        joint: (2 + 2 k, 2 + 2 k) covariance of it and them.
    """

    rows: IntArray
    place: FloatArray
    neighbours: FloatArray
    joint: FloatArray


class LocalFilter:
    """The incremental solver for worlds of any size; see `solver.IncrementalSolver` for its methods.

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
        self._covariance = np.zeros((AT_PLACES, AT_PLACES))
        self._covariance[:3, :3] = np.eye(3) / problem.start_information
        self._covariance[3:, 3:] = np.diag(problem.prior.sigma**2)
        self._position = np.full((len(problem.landmark_mean), 2), np.nan)
        self._slot = np.full(len(problem.landmark_mean), -1)
        self._active: IntArray = np.zeros(0, dtype=np.int64)
        self._used_at: IntArray = np.zeros(0, dtype=np.int64)
        self._left: dict[int, Ties] = {}
        self._batch: Marginals | None = None
        self._batch_position = np.zeros((0, 2))
        self._old_pose = np.zeros((0, 3))
        self._new_pose: list[FloatArray] = []

    def restart(self, estimate: Estimate, noise: Noise, problem: Problem, marginals: Marginals | None = None) -> None:
        """Restart at an optimum of all poses so far."""
        self.problem, self._noise = problem, noise
        n = len(estimate.pose)
        if marginals is None:
            marginals = Smoother(problem.until(n), noise, heavy=True, robust=self._robust).marginals(estimate)
        self._batch, self._batch_position = marginals, estimate.landmark.copy()
        self._position = estimate.landmark.copy()
        recent = problem.landmark_row[: self._first_detection[n]][::-1]
        seen, first = np.unique(recent[: 50 * MOST_ACTIVE], return_index=True)
        active = seen[np.argsort(first, kind="stable")][: MOST_ACTIVE - LEAVING]
        if np.count_nonzero(estimate.known) <= MOST_ACTIVE - LEAVING:
            active = np.flatnonzero(estimate.known)
        active = active[estimate.known[active]]
        joint = self._batch.joint(active, poses=np.array([n - 1]), states=True)
        end = 3 + 2 * len(active)
        order = np.concatenate([np.arange(3), end + np.arange(9), np.arange(3, end)])
        self._covariance = np.ascontiguousarray(joint[np.ix_(order, order)])
        self._slot = np.full(len(estimate.landmark), -1)
        self._slot[active] = np.arange(len(active))
        self._active, self._used_at, self._left = active, np.full(len(active), n - 1), {}
        self._pose, self._states = estimate.pose[-1].copy(), estimate.states.copy()
        self._old_pose, self._new_pose = estimate.pose[:-1], [self._pose.copy()]

    def add(self, row: int, motion: Motion | None, landmark: FloatArray) -> None:
        """Add pose `row` with its odometry and its detections."""
        problem = self.problem
        detections = np.arange(self._first_detection[row], self._first_detection[row + 1])
        rows = problem.landmark_row[detections]
        self._activate(rows, landmark)
        if motion is not None:
            drive_on(self._pose, self._covariance, motion.increment, motion.by_states, motion.covariance)
        _update(
            self._pose, self._states, self._position, self._covariance, self._active, rows, self._slot[rows],
            problem.reading[detections], self._noise.of_detections(problem.sigma_given[detections]), problem.mount,
            problem.prior.free, self._robust,
        )  # fmt: skip
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
        return self._position[row].copy() if row < len(self._position) else np.full(2, np.nan)

    def estimate(self) -> Estimate:
        """Return values of everything so far; poses since the last restart as they were when they were added."""
        landmark = np.full((len(self.problem.landmark_mean), 2), np.nan)
        landmark[: len(self._position)] = self._position
        return Estimate(np.vstack([self._old_pose, *self._new_pose]), landmark, self._states.copy())

    def around(self, places: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the covariance with these places in it, all its places, and which of them these are."""
        self._activate(places, self._position)
        return self._covariance, self._position[self._active], self._slot[places]

    def _activate(self, rows: IntArray, landmark: FloatArray) -> None:
        """Have places in the covariance; those without a position yet are at their prior, or where `landmark` says."""
        new = len(self.problem.landmark_mean) - len(self._position)
        if new > 0:
            self._position = np.pad(self._position, ((0, new), (0, 0)), constant_values=np.nan)
            self._slot = np.pad(self._slot, (0, new), constant_values=-1)
        now, slots = len(self._old_pose) + len(self._new_pose), self._slot[rows]
        here = slots >= 0
        if np.count_nonzero(here) == len(here):
            self._used_at[slots] = now
            return
        self._used_at[slots[here]] = now
        waiting = list(dict.fromkeys(rows[~here].tolist()))
        if len(self._active) + len(waiting) > MOST_ACTIVE:
            self._leave(len(self._active) + len(waiting) - MOST_ACTIVE + LEAVING, now)
        for j in waiting:
            self._enter(j, landmark, now)

    def _leave(self, count: int, now: int) -> None:
        """Take the places out that were not used for longest."""
        order = np.argsort(self._used_at, kind="stable")[:count]
        leaving = order[self._used_at[order] < now]
        stays = np.ones(len(self._active), dtype=bool)
        stays[leaving] = False
        kept = np.flatnonzero(stays)
        position = self._position[self._active]
        for slot in leaving.tolist():
            away = ((position[kept] - position[slot]) ** 2).sum(axis=1)
            near = kept[np.argsort(away, kind="stable")[:NEIGHBOURS]]
            at = _columns(np.append(slot, near))
            self._left[int(self._active[slot])] = Ties(
                self._active[near], position[slot], position[near], self._covariance[np.ix_(at, at)]
            )
        self._slot[self._active[leaving]] = -1
        self._active, self._used_at = self._active[kept], self._used_at[kept]
        self._slot[self._active] = np.arange(len(kept))
        rows = np.concatenate([np.arange(AT_PLACES), _columns(kept)])
        self._covariance = np.ascontiguousarray(self._covariance[np.ix_(rows, rows)])

    def _enter(self, row: int, landmark: FloatArray, now: int) -> None:
        """Put a place back, or a new one: given those that are in the covariance, at its ties or its prior."""
        size, problem = len(self._covariance), self.problem
        if np.isfinite(self._position[row, 0]):
            ties = self._ties(row)
            there = np.flatnonzero(self._slot[ties.rows] >= 0)
            at = 2 + (2 * there[:, None] + [0, 1]).ravel()
            given = ties.rows[there]
            known = ties.joint[np.ix_(at, at)] + LEAST_VARIANCE * np.eye(len(at))
            gain = np.asarray(np.linalg.solve(known, ties.joint[at, :2]).T, dtype=np.float64)
            spread: FloatArray = ties.joint[:2, :2] - gain @ ties.joint[at, :2]
            place: FloatArray = ties.place + gain @ (self._position[given] - ties.neighbours[there]).ravel()
        else:
            active = np.zeros(len(problem.landmark_mean), dtype=bool)
            active[self._active] = True
            prior = problem.conditional_prior(row, active)
            given, gain = prior.given, prior.gain
            if prior.information.any():
                spread = np.asarray(np.linalg.inv(prior.information))
                place = prior.place(self._position, problem.landmark_mean)
            else:
                spread, place = UNKNOWN_VARIANCE * np.eye(2), landmark[row]
        across: FloatArray = gain @ self._covariance[_columns(self._slot[given])]
        grown = np.empty((size + 2, size + 2))
        grown[:size, :size] = self._covariance
        grown[size:, :size] = across
        grown[:size, size:] = across.T
        grown[size:, size:] = across[:, _columns(self._slot[given])] @ gain.T + 0.5 * (spread + spread.T)
        self._covariance = grown
        self._slot[row] = len(self._active)
        self._active, self._used_at = np.append(self._active, row), np.append(self._used_at, now)
        self._position[row] = place

    def _ties(self, row: int) -> Ties:
        """What ties a place that is known, but in no covariance: as it was when it left, or as the smoother says."""
        if row in self._left:
            return self._left.pop(row)
        assert self._batch is not None
        of_batch = self._active[self._active < len(self._batch_position)]
        of_batch = of_batch[np.isfinite(self._batch_position[of_batch, 0])]
        away = ((self._batch_position[of_batch] - self._batch_position[row]) ** 2).sum(axis=1)
        near = of_batch[np.argsort(away, kind="stable")[:NEIGHBOURS]]
        every = np.append(row, near)
        return Ties(near, self._batch_position[row], self._batch_position[near], self._batch.joint(every))


def _columns(slots: IntArray) -> IntArray:
    """Columns of x and y of places in the covariance."""
    return np.asarray(AT_PLACES + (2 * slots[:, None] + [0, 1]).ravel(), dtype=np.int64)


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
    pose: FloatArray, states: FloatArray, position: FloatArray, covariance: FloatArray, active: Any, seen: Any,
    slot: Any, reading: FloatArray, sigma: FloatArray, mount: FloatArray, free: Any, robust: bool,
) -> None:  # fmt: skip
    """All detections of a frame at once, relinearised and re-weighted until nothing moves; all in place.

    Only pose, calibration and the places that are `seen` take part in that; the other `active` places follow at last.
    """
    count, size = len(reading), AT_PLACES + 2 * len(reading)
    if count == 0:
        return
    place, where, own = position[seen], np.arange(size), np.arange(count)
    where[AT_PLACES::2], where[AT_PLACES + 1 :: 2] = AT_PLACES + 2 * slot, AT_PLACES + 2 * slot + 1
    part = np.ascontiguousarray(covariance[where][:, where])
    start, start_states, start_place = pose.copy(), states.copy(), place.copy()
    before, step, weight, innovation, pull = (
        np.zeros(size),
        np.zeros(size),
        np.ones(count),
        np.zeros(2 * count),
        np.zeros(2 * count),
    )
    jacobian, column = np.zeros((2 * count, 10)), np.zeros((count, 10), dtype=np.int64)
    root, gain = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, size))
    for iteration in range(ITERATIONS):
        linearise_frame(pose, states, place, own, reading, mount, free, step[2], innovation, jacobian, column)
        spread_of_frame(part, jacobian, column, gain, root)
        for m in range(count if robust else 0):
            x, y = innovation[2 * m], innovation[2 * m + 1]
            # before anything is known of this frame: as surprising as its innovation is
            unknown = 1.0 if iteration == 0 else 0.0
            a = unknown * root[2 * m, 2 * m] + sigma[m, 0] ** 2
            b = unknown * root[2 * m, 2 * m + 1]
            d = unknown * root[2 * m + 1, 2 * m + 1] + sigma[m, 1] ** 2
            weight[m] = inlier_weight((d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b), 0.0, True)
        for row in range(2 * count):
            root[row, row] += sigma[row // 2, row % 2] ** 2 / weight[row // 2]
            # innovation at the step so far, told at the start
            for a in range(10):
                innovation[row] -= jacobian[row, a] * step[column[row // 2, a]]
        _solve(root, innovation, pull)
        before[:], step[:] = step, 0.0
        for row in range(2 * count):
            for k in range(size):
                step[k] -= pull[row] * gain[row, k]
        c, s = math.cos(start[2]), math.sin(start[2])
        pose[0] = start[0] + c * step[0] - s * step[1]
        pose[1] = start[1] + s * step[0] + c * step[1]
        pose[2] = wrapped(start[2] + step[2])
        moved = 0.0
        for k in range(size):
            moved = max(moved, abs(step[k] - before[k]))
            if k >= AT_PLACES:
                place[(k - AT_PLACES) // 2, k % 2] = start_place[(k - AT_PLACES) // 2, k % 2] + step[k]
            elif k >= 3:
                states[k - 3] = start_states[k - 3] + step[k]
        if moved < SMALL_STEP:
            break
    column[:, 8], column[:, 9] = where[AT_PLACES::2], where[AT_PLACES + 1 :: 2]
    white = np.zeros((2 * count, len(covariance) + 1))
    white[:, -1] = innovation
    _condition(covariance, jacobian, column, root, white)
    for k in range(len(active)):
        for row in range(2 * count):
            for a in range(2):
                position[active[k], a] -= white[row, AT_PLACES + 2 * k + a] * white[row, -1]
    turn_pose(covariance, step[2])


@kernel
def _solve(matrix: FloatArray, right: FloatArray, x: FloatArray) -> None:
    """Solve by Cholesky's factor, which takes the place of the lower triangle of the matrix."""
    for i in range(len(matrix)):
        for k in range(i + 1):
            total = matrix[i, k]
            for a in range(k):
                total -= matrix[i, a] * matrix[k, a]
            matrix[i, k] = math.sqrt(total) if k == i else total / matrix[k, k]
        x[i] = right[i]
        for a in range(i):
            x[i] -= matrix[i, a] * x[a]
        x[i] /= matrix[i, i]
    for i in range(len(matrix) - 1, -1, -1):
        x[i] /= matrix[i, i]
        for a in range(i):
            x[a] -= matrix[i, a] * x[i]


@kept(effort=3, error_model="numpy", fastmath={"contract"})
def _condition(covariance: FloatArray, jacobian: FloatArray, column: Any, root: FloatArray, white: FloatArray) -> None:
    """Condition on detections, with the lower root of `H P H' + R`.

    `white`, zeros and the innovations in its last column, becomes `root^-1 (H P, innovations)`.
    """
    for row in range(len(white)):
        for a in range(10):
            by, at = jacobian[row, a], column[row // 2, a]
            for k in range(len(covariance) if by != 0.0 else 0):
                white[row, k] += by * covariance[at, k]
        for other in range(row):
            for k in range(white.shape[1]):
                white[row, k] -= root[row, other] * white[other, k]
        for k in range(white.shape[1]):
            white[row, k] /= root[row, row]
    for i in range(len(covariance)):
        mine = covariance[i]
        for row in range(0, len(white), 2):
            one, two = white[row], white[row + 1]
            a, b = one[i], two[i]
            for k in range(len(covariance)):
                mine[k] -= a * one[k] + b * two[k]
