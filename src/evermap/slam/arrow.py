"""Batch smoothing: Gauss-Newton whose normal equations are a chain of poses with a border.

Poses are tied to their neighbours by odometry, and all of them to the few landmarks and calibration states. Eliminating
the chain first costs `O(N G^2)` for N poses and G shared numbers, and the way back gives every covariance that noise
estimation, gating and error ellipses need, without forming an inverse of the whole.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from evermap.errors import DataError, NumericalError
from evermap.slam.kernels import (
    detection_residual,
    inlier_weight,
    inverse_of,
    invert_3x3,
    kernel,
    multiply,
    outlier_loss,
    wrapped,
)
from evermap.slam.preintegration import Intervals, linearise_interval
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.types import BoolArray, FloatArray

MEMORY_LIMIT_GB = 4.0
COST_SLACK = 0.5
"""Nats by which the cost may rise in a step: weights change with calibration states and residuals, which is no harm."""
HELD = 1e-9
"""Information that keeps a landmark whose every sighting is an outlier from going anywhere."""


class Normal(NamedTuple):
    """Normal equations of the chain (`diagonal`, `off`) with its border and corner.

    Attributes:
        diagonal, off: (N, 3, 3) information of pose i, and of pose i + 1 with pose i.
        border: (N, 3, G) of poses with landmarks and states; corner: (G, G) of those.
        right_pose: (N, 3), right_shared: (G,) right sides.
        cost: negative log posterior up to a constant.
        weights: (M,) inlier probability of every detection.
    """

    diagonal: FloatArray
    off: FloatArray
    border: FloatArray
    corner: FloatArray
    right_pose: FloatArray
    right_shared: FloatArray
    cost: float
    weights: FloatArray


class Solution(NamedTuple):
    """Steps of poses (N, 3) and shared numbers (G,), and the covariances of `Marginals` (empty if not wanted)."""

    pose: FloatArray
    shared: FloatArray
    cov_pose: FloatArray
    cov_next: FloatArray
    cov_cross: FloatArray
    cov_shared: FloatArray


@kernel
def _dot(a: Any, column: int, b: Any, other: int) -> Any:
    """One entry of `a' b` for matrices of three rows."""
    return a[0, column] * b[0, other] + a[1, column] * b[1, other] + a[2, column] * b[2, other]


@kernel
def assemble(
    pose: FloatArray,
    landmark: FloatArray,
    states: FloatArray,
    driven: Intervals,
    pose_row: Any,
    landmark_row: Any,
    reading: FloatArray,
    sigma: FloatArray,
    variance: FloatArray,
    mount: FloatArray,
    prior_mean: FloatArray,
    prior_sigma: FloatArray,
    free: Any,
    start: FloatArray,
    start_information: float,
    landmark_mean: FloatArray,
    landmark_information: FloatArray,
    log_odds: float,
    heavy: bool,
) -> Normal:
    """Linearise everything at the given values; the arguments are the fields of `Estimate`, `Problem` and `Noise`."""
    n, count = len(pose), len(landmark)
    shared = 2 * count + 9
    at_states, at_motion = 2 * count, 2 * count + 5
    diagonal = np.zeros((n, 3, 3))
    off = np.zeros((n, 3, 3))
    border = np.zeros((n, 3, shared))
    corner = np.zeros((shared, shared))
    right_pose = np.zeros((n, 3))
    right_shared = np.zeros(shared)
    weights = np.zeros(len(pose_row))
    cost = 0.0

    information, e, pull = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    j, weighted = np.zeros((3, 10)), np.zeros((3, 10))
    for i in range(n - 1):
        linearise_interval(driven, i, pose, variance, free, e, j, information)
        for a in range(3):
            pull[a] = information[a, 0] * e[0] + information[a, 1] * e[1] + information[a, 2] * e[2]
            cost += 0.5 * e[a] * pull[a]
        for a in range(3):
            for b in range(10):
                weighted[a, b] = information[a, 0] * j[0, b] + information[a, 1] * j[1, b] + information[a, 2] * j[2, b]
        for a in range(3):
            for b in range(3):
                diagonal[i, a, b] += _dot(j, a, weighted, b)
                diagonal[i + 1, a, b] += _dot(j, 3 + a, weighted, 3 + b)
                off[i, a, b] = _dot(j, 3 + a, weighted, b)
            for b in range(4):
                border[i, a, at_motion + b] += _dot(j, a, weighted, 6 + b)
                border[i + 1, a, at_motion + b] += _dot(j, 3 + a, weighted, 6 + b)
            right_pose[i, a] -= j[0, a] * pull[0] + j[1, a] * pull[1] + j[2, a] * pull[2]
            right_pose[i + 1, a] -= j[0, 3 + a] * pull[0] + j[1, 3 + a] * pull[1] + j[2, 3 + a] * pull[2]
        for a in range(4):
            for b in range(4):
                corner[at_motion + a, at_motion + b] += _dot(j, 6 + a, weighted, 6 + b)
            right_shared[at_motion + a] -= j[0, 6 + a] * pull[0] + j[1, 6 + a] * pull[1] + j[2, 6 + a] * pull[2]

    z, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    for m in range(len(pose_row)):
        i, j = pose_row[m], 2 * landmark_row[m]
        detection_residual(
            pose[i], landmark[landmark_row[m]], states, mount, reading[m, 0], reading[m, 1], z, jx, jl, jc
        )
        squared = (z[0] / sigma[m, 0]) ** 2 + (z[1] / sigma[m, 1]) ** 2
        weight = inlier_weight(squared, log_odds, heavy)
        weights[m] = weight
        cost += outlier_loss(squared, log_odds, heavy)
        for row in range(2):
            precision = weight / sigma[m, row] ** 2
            for k in range(5):
                if not free[k]:
                    jc[row, k] = 0.0
            for a in range(3):
                scaled = precision * jx[row, a]
                right_pose[i, a] -= scaled * z[row]
                for b in range(3):
                    diagonal[i, a, b] += scaled * jx[row, b]
                for b in range(2):
                    border[i, a, j + b] += scaled * jl[row, b]
                for b in range(5):
                    border[i, a, at_states + b] += scaled * jc[row, b]
            for a in range(2):
                scaled = precision * jl[row, a]
                right_shared[j + a] -= scaled * z[row]
                for b in range(2):
                    corner[j + a, j + b] += scaled * jl[row, b]
                for b in range(5):
                    corner[j + a, at_states + b] += scaled * jc[row, b]
                    corner[at_states + b, j + a] += scaled * jc[row, b]
            for a in range(5):
                scaled = precision * jc[row, a]
                right_shared[at_states + a] -= scaled * z[row]
                for b in range(5):
                    corner[at_states + a, at_states + b] += scaled * jc[row, b]

    for k in range(9):
        precision = 1.0 / prior_sigma[k] ** 2
        off_mean = states[k] - prior_mean[k]
        corner[at_states + k, at_states + k] += precision
        right_shared[at_states + k] -= precision * off_mean
        cost += 0.5 * precision * off_mean * off_mean
    moved = (landmark - landmark_mean).reshape(2 * count)
    prior_pull = landmark_information @ moved
    corner[:at_states, :at_states] += landmark_information
    right_shared[:at_states] -= prior_pull
    cost += 0.5 * np.dot(moved, prior_pull)
    for k in range(at_states):
        corner[k, k] += HELD
    # the first pose is held at `start`, in its own frame
    c, s = np.cos(pose[0, 2]), np.sin(pose[0, 2])
    dx, dy, dt = pose[0, 0] - start[0], pose[0, 1] - start[1], wrapped(pose[0, 2] - start[2])
    for k in range(3):
        diagonal[0, k, k] += start_information
    right_pose[0, 0] -= start_information * (c * dx + s * dy)
    right_pose[0, 1] -= start_information * (-s * dx + c * dy)
    right_pose[0, 2] -= start_information * dt
    cost += 0.5 * start_information * (dx * dx + dy * dy + dt * dt)
    return Normal(diagonal, off, border, corner, right_pose, right_shared, cost, weights)


@kernel
def solve(normal: Normal, damping: float, covariances: bool) -> Solution:
    """Return the Newton step (Levenberg-Marquardt with `damping`) and, if wanted, covariances.

    Eliminates pose after pose (block Cholesky of the chain), solves the border's Schur complement, and returns along
    the chain.
    """
    off = normal.off
    n, shared = len(normal.diagonal), len(normal.corner)
    inverse, factor, block = np.empty((n, 3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    border, gain = np.empty((n, 3, shared)), np.empty((n, 3, shared))
    right = np.empty((n, 3))
    corner = normal.corner.copy()
    for k in range(shared):
        corner[k, k] *= 1.0 + damping
    for i in range(n):
        block[:] = normal.diagonal[i]
        for a in range(3):
            block[a, a] *= 1.0 + damping
            right[i, a] = normal.right_pose[i, a]
            for k in range(shared):
                border[i, a, k] = normal.border[i, a, k]
        if i > 0:
            multiply(off[i - 1], inverse[i - 1], factor)
            for a in range(3):
                f0, f1, f2 = factor[a, 0], factor[a, 1], factor[a, 2]
                for b in range(3):
                    block[a, b] -= f0 * off[i - 1, b, 0] + f1 * off[i - 1, b, 1] + f2 * off[i - 1, b, 2]
                right[i, a] -= f0 * right[i - 1, 0] + f1 * right[i - 1, 1] + f2 * right[i - 1, 2]
                for k in range(shared):
                    border[i, a, k] -= f0 * border[i - 1, 0, k] + f1 * border[i - 1, 1, k] + f2 * border[i - 1, 2, k]
        invert_3x3(block, inverse[i])
        multiply(inverse[i], border[i], gain[i])
    flat_border, flat_gain = border.reshape(3 * n, shared), gain.reshape(3 * n, shared)
    schur: FloatArray = corner - flat_border.T @ flat_gain
    rest = normal.right_shared - flat_gain.T @ right.reshape(3 * n)
    step_shared: Any = np.linalg.solve(schur, rest)
    step_pose = -(flat_gain @ step_shared).reshape(n, 3)
    for i in range(n - 1, -1, -1):
        r0, r1, r2 = right[i, 0], right[i, 1], right[i, 2]
        if i < n - 1:
            x, y, turn = step_pose[i + 1, 0], step_pose[i + 1, 1], step_pose[i + 1, 2]
            r0 -= off[i, 0, 0] * x + off[i, 1, 0] * y + off[i, 2, 0] * turn
            r1 -= off[i, 0, 1] * x + off[i, 1, 1] * y + off[i, 2, 1] * turn
            r2 -= off[i, 0, 2] * x + off[i, 1, 2] * y + off[i, 2, 2] * turn
        for a in range(3):
            step_pose[i, a] += inverse[i, a, 0] * r0 + inverse[i, a, 1] * r1 + inverse[i, a, 2] * r2
    if not covariances:
        empty2, empty3 = np.zeros((0, 0)), np.zeros((0, 3, 3))
        return Solution(step_pose, step_shared, empty3, empty3, empty3, empty2)
    cov_shared = inverse_of(schur)
    cov_pose = np.empty((n, 3, 3))
    cov_next = np.zeros((n, 3, 3))
    cross = -(flat_gain @ cov_shared).reshape(n, 3, shared)
    back = factor
    for i in range(n - 1, -1, -1):
        cov_pose[i] = inverse[i]
        if i < n - 1:
            multiply(inverse[i], off[i].T, back)
            for a in range(3):
                b0, b1, b2 = back[a, 0], back[a, 1], back[a, 2]
                for k in range(shared):
                    cross[i, a, k] -= b0 * cross[i + 1, 0, k] + b1 * cross[i + 1, 1, k] + b2 * cross[i + 1, 2, k]
            for a in range(3):
                for b in range(3):
                    total = 0.0
                    for m in range(3):
                        total += back[a, m] * cov_pose[i + 1, m, b]
                    for k in range(shared):
                        total += gain[i, a, k] * cross[i + 1, b, k]
                    cov_next[i, a, b] = -total
            for a in range(3):
                for b in range(3):
                    for m in range(3):
                        cov_pose[i, a, b] -= cov_next[i, a, m] * back[b, m]
        for a in range(3):
            for b in range(3):
                for k in range(shared):
                    cov_pose[i, a, b] -= cross[i, a, k] * gain[i, b, k]
    return Solution(step_pose, step_shared, cov_pose, cov_next, cross, cov_shared)


@kernel
def eliminate_chain(normal: Normal) -> tuple[FloatArray, FloatArray]:
    """Return information (3 + G, 3 + G) and right side (3 + G,) of the last pose and the shared numbers."""
    n, shared = len(normal.diagonal), len(normal.corner)
    off = normal.off
    border, gain = normal.border.copy(), np.empty((n - 1, 3, shared))
    block, inverse, factor = normal.diagonal[0].copy(), np.zeros((3, 3)), np.zeros((3, 3))
    right = normal.right_pose.copy()
    for i in range(n - 1):
        invert_3x3(block, inverse)
        multiply(inverse, border[i], gain[i])
        multiply(off[i], inverse, factor)
        for a in range(3):
            f0, f1, f2 = factor[a, 0], factor[a, 1], factor[a, 2]
            for b in range(3):
                block[a, b] = normal.diagonal[i + 1, a, b] - (f0 * off[i, b, 0] + f1 * off[i, b, 1] + f2 * off[i, b, 2])
            right[i + 1, a] -= f0 * right[i, 0] + f1 * right[i, 1] + f2 * right[i, 2]
            for k in range(shared):
                border[i + 1, a, k] -= f0 * border[i, 0, k] + f1 * border[i, 1, k] + f2 * border[i, 2, k]
    flat_gain = gain.reshape(3 * (n - 1), shared)
    corner = normal.corner - border[: n - 1].reshape(3 * (n - 1), shared).T @ flat_gain
    right_shared = normal.right_shared - flat_gain.T @ right[: n - 1].reshape(3 * (n - 1))
    information = np.zeros((3 + shared, 3 + shared))
    information[:3, :3] = block
    information[:3, 3:] = border[n - 1]
    information[3:, :3] = border[n - 1].T
    information[3:, 3:] = corner
    return information, np.concatenate((right[n - 1], right_shared))


class Smoother:
    """Optimum and covariances of one `Problem` at given noise.

    Raises:
        DataError: more poses times landmarks than fit into memory.
        NumericalError: no finite optimum.
    """

    def __init__(self, problem: Problem, noise: Noise, *, heavy: bool = False, robust: bool = True) -> None:
        self.problem = problem
        self.noise = noise
        self._heavy = heavy
        self._log_odds = noise.outlier_log_odds if robust else np.inf
        self._robust = robust
        self._known = np.zeros(len(problem.landmark_mean), dtype=bool)
        self._information = np.zeros((0, 0))
        self._last: tuple[Estimate, Normal] | None = None
        size_gb = 5e-8 * len(problem.stamp_s) * (len(problem.landmark_mean) * 2 + 9)
        if size_gb > MEMORY_LIMIT_GB:
            raise DataError(
                f"{len(problem.stamp_s)} poses with {len(problem.landmark_mean)} landmarks need {size_gb:.0f} GB",
                hint="split the recording into sessions",
            )

    def optimum(self, start: Estimate, *, iterations: int = 30, tolerance: float = 1e-6) -> Estimate:
        """Run damped Gauss-Newton from `start` until no step moves anything by more than `tolerance` (m or rad)."""
        estimate = start
        normal = self.normal(estimate)
        damping = 0.0
        for _ in range(iterations):
            step = solve(normal, damping, False)
            trial = _moved(estimate, step.pose, step.shared)
            following = self.normal(trial)
            if np.isfinite(following.cost) and following.cost <= normal.cost + COST_SLACK:
                estimate, normal = trial, following
                damping = 0.0 if damping < 1e-6 else damping / 10.0
                if max(np.abs(step.pose).max(), np.abs(step.shared).max()) < tolerance:
                    break
            else:
                damping = max(1e-6, 10.0 * damping)
                if damping > 1e6:
                    break
        if not np.isfinite(normal.cost):
            raise NumericalError("the smoother found no finite optimum", hint="check units and time stamps")
        self._last = (estimate, normal)  # the last trial need not be the best
        return estimate

    def cost(self, estimate: Estimate) -> float:
        """Return the negative log posterior up to a constant."""
        return float(self.normal(estimate).cost)

    def inlier_probability(self, estimate: Estimate) -> FloatArray:
        """Return (M,) probability of every detection to be no outlier, given the estimate."""
        return self.normal(estimate).weights

    def marginals(self, estimate: Estimate) -> Marginals:
        """Return covariances of the Gaussian approximation at `estimate`; rows of unknown landmarks are zero."""
        known = np.append(np.repeat(estimate.known, 2), np.ones(9, dtype=bool))
        solved = solve(self.normal(estimate), 0.0, True)
        shared = np.zeros((len(known), len(known)))
        shared[np.ix_(known, known)] = _semidefinite(solved.cov_shared)
        cross = np.zeros((len(estimate.pose), 3, len(known)))
        cross[:, :, known] = solved.cov_cross
        return Marginals(solved.cov_pose, solved.cov_next, cross, shared)

    def summary(self, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
        """Return information on the last pose, the known landmarks and the states, linearised at `estimate`.

        Returns:
            `R` upper triangular (n, n) and `d` (n,), n = 3 + 2 known landmarks + 9: the cost of a step `x` is
            `|R x - d|^2 / 2` up to a constant.
        """
        information, right = eliminate_chain(self.normal(estimate))
        root: FloatArray = cholesky(information, lower=False)
        return root, solve_triangular(root, right, trans="T")

    def newest(self, estimate: Estimate) -> FloatArray:
        """Return (3 + 2 K + 9,) squared: joint covariance of the last pose, the known landmarks and the states."""
        information, _ = eliminate_chain(self.normal(estimate))
        try:
            root = np.linalg.inv(np.linalg.cholesky(0.5 * (information + information.T)))
        except np.linalg.LinAlgError:
            raise NumericalError("the session hangs together too loosely for a covariance") from None
        # a square has no negative eigenvalue, however loosely the last pose hangs on the others
        return root.T @ root

    def _prior_information(self, known: BoolArray) -> FloatArray:
        """The prior of the known landmarks, worked out anew only when others are known."""
        if not np.array_equal(known, self._known):
            self._known, self._information = known, self.problem.prior_information(known)
        return self._information

    def normal(self, estimate: Estimate) -> Normal:
        """Return the problem linearised at `estimate`; landmarks without position are left out."""
        if self._last is not None and self._last[0] is estimate:
            return self._last[1]
        problem, noise = self.problem, self.noise
        known = estimate.known
        rank = np.cumsum(known) - 1
        parts: Normal = assemble(
            estimate.pose,
            estimate.landmark[known],
            estimate.states,
            problem.drive.between(problem.stamp_s, estimate.states),
            problem.pose_row,
            rank[problem.landmark_row],
            problem.reading,
            noise.of_detections(problem.sigma_given),
            noise.odometry**2,
            problem.mount,
            problem.prior.mean,
            problem.prior.sigma,
            problem.prior.free,
            problem.start_pose,
            problem.start_information,
            problem.landmark_mean[known],
            self._prior_information(known),
            self._log_odds,
            self._heavy and self._robust,
        )
        self._last = (estimate, parts)
        return parts


def _semidefinite(covariance: FloatArray) -> FloatArray:
    """A covariance (n, n) that rounding may have robbed of its smallest eigenvalues, where others are huge."""
    symmetric: FloatArray = 0.5 * (covariance + covariance.T)
    try:
        np.linalg.cholesky(symmetric)
    except np.linalg.LinAlgError:
        size, direction = np.linalg.eigh(symmetric)
        symmetric = (direction * np.maximum(size, 1e-12 * size[-1])) @ direction.T
    return symmetric


def _moved(estimate: Estimate, step_pose: FloatArray, step_shared: FloatArray) -> Estimate:
    """The estimate after a step: poses on the right, the rest added."""
    c, s = np.cos(estimate.pose[:, 2]), np.sin(estimate.pose[:, 2])
    pose = estimate.pose.copy()
    pose[:, 0] += c * step_pose[:, 0] - s * step_pose[:, 1]
    pose[:, 1] += s * step_pose[:, 0] + c * step_pose[:, 1]
    pose[:, 2] += step_pose[:, 2]
    landmark = estimate.landmark.copy()
    landmark[estimate.known] += step_shared[:-9].reshape(-1, 2)
    return Estimate(pose, landmark, estimate.states + step_shared[-9:])
