"""A Gaussian over the newest pose, the calibration states and all landmarks: what a frame is compared with.

An extended Kalman filter in covariance form (Smith, Self and Cheeseman 1990). It runs from one batch solution to the
next only, so that its linearisation is never old; between them it costs `O(L^2)` a frame for L landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.geometry import se2
from evermap.slam.association.jcbb import Pairings, gates
from evermap.slam.kernels import AT_PLACES, detection_residual, kernel
from evermap.slam.local_filter import drive_on
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.solver import Motion
from evermap.slam.streaming import sighted_at
from evermap.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class PoseBelief:
    """Mean and covariance.

    Attributes:
        pose: (3,) perturbed on the right.
        states: (9,) calibration states.
        landmark: (L, 2).
        covariance: (12 + 2 L, 12 + 2 L) in this order.
    """

    pose: FloatArray
    states: FloatArray
    landmark: FloatArray
    covariance: FloatArray

    @classmethod
    def first(cls, problem: Problem) -> PoseBelief:
        """Return the belief before the first frame: the start pose, the priors of the states, no landmark."""
        spread = np.append(np.full(3, 1.0 / problem.start_information), (problem.prior.sigma * problem.prior.free) ** 2)
        return cls(problem.start_pose.copy(), problem.prior.mean.copy(), np.zeros((0, 2)), np.diag(spread))

    @classmethod
    def at(cls, estimate: Estimate, marginals: Marginals, row: int, across: FloatArray | None = None) -> PoseBelief:
        """Return the smoothed belief about pose `row`; every landmark has to be known.

        Args:
            estimate: the optimum.
            marginals: its covariances.
            row: of the pose.
            across: (3, G) covariance of the pose with landmarks and states, where it is known already.
        """
        n = 2 * len(estimate.landmark)
        order = np.append(n + np.arange(9), np.arange(n))
        covariance = np.zeros((12 + n, 12 + n))
        covariance[:3, :3] = marginals.pose[row]
        if across is None:
            across = marginals.joint(np.arange(len(estimate.landmark)), poses=np.array([row]), states=True)[:3, 3:]
        covariance[:3, 3:] = across[:, order]
        covariance[3:, :3] = covariance[:3, 3:].T
        covariance[3:, 3:] = marginals.shared[np.ix_(order, order)]
        return cls(estimate.pose[row], estimate.states, estimate.landmark, covariance)

    def may_be_one(self, a: int, b: int, confidence: float) -> bool:
        """Return whether the difference of two landmarks is insignificant."""
        rows, others = AT_PLACES + 2 * a + np.arange(2), AT_PLACES + 2 * b + np.arange(2)
        p = self.covariance
        cross = p[np.ix_(rows, others)]
        spread = p[np.ix_(rows, rows)] + p[np.ix_(others, others)] - cross - cross.T + 1e-12 * np.eye(2)
        gap = self.landmark[a] - self.landmark[b]
        return bool(gap @ np.linalg.solve(spread, gap) < gates(1, confidence)[1])


def predicted(belief: PoseBelief, problem: Problem, noise: Noise, row: int) -> PoseBelief:
    """Return the belief about pose `row` by odometry from the pose before; the first one as it is."""
    if row == 0:
        return belief
    motion = Motion.between(problem, noise, row, belief.states)
    pose, covariance = belief.pose.copy(), belief.covariance.copy()
    drive_on(pose, covariance, motion.increment, motion.by_states, motion.covariance)
    return PoseBelief(pose, belief.states, belief.landmark, covariance)


def pairings_of_frame(
    belief: PoseBelief, problem: Problem, sigma: FloatArray, detections: IntArray, *, confidence: float, density: float
) -> tuple[Pairings, FloatArray]:
    """Return detections of a frame with the landmarks whose gates they pass.

    Args:
        belief: about the pose that made the detections.
        problem: readings, mount and free states.
        sigma: (M, 2) standard deviations of all detections.
        detections: (n,) rows of those of the frame.
        confidence: of the gates.
        density: landmarks a square metre that one expects where none was met before.

    Returns:
        The pairings, and the (2 K, 12 + 2 L) derivatives of their residuals.
    """
    source, target, innovation, block = _in_gate(
        belief.pose, belief.states, belief.landmark, belief.covariance, problem.reading[detections],
        sigma[detections], problem.mount, problem.prior.free, gates(1, confidence)[1],
    )  # fmt: skip
    count = len(source)
    rows = np.zeros((count, 2, len(belief.covariance)))
    rows[:, :, :8] = block[:, :, :8]
    for k in range(count):
        at = AT_PLACES + 2 * target[k]
        rows[k, :, at : at + 2] = block[k, :, 8:]
    h = rows.reshape(2 * count, len(belief.covariance))
    joint = h @ belief.covariance @ h.T + np.diag((sigma[detections[source]] ** 2).ravel())
    # a square metre has r dr db
    new = np.log(density * np.maximum(problem.reading[detections[source], 0], 0.1))
    return Pairings(source, target, innovation, joint, new, len(detections)), h


@kernel
def _in_gate(
    pose: FloatArray,
    states: FloatArray,
    landmark: FloatArray,
    covariance: FloatArray,
    reading: FloatArray,
    sigma: FloatArray,
    mount: FloatArray,
    free: Any,
    gate: float,
) -> tuple[Any, Any, FloatArray, FloatArray]:
    """Detection, landmark, residual (2,) and its derivatives (2, 10) of every pair that passes its own gate."""
    n, count = len(reading), len(landmark)
    source, target = np.zeros(n * count, dtype=np.int64), np.zeros(n * count, dtype=np.int64)
    innovation, block = np.zeros((n * count, 2)), np.zeros((n * count, 2, 10))
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    columns, part = np.arange(10), np.zeros((10, 10))
    found = 0
    for s in range(n):
        for j in range(count):
            detection_residual(pose, landmark[j], states, mount, reading[s, 0], reading[s, 1], e, jx, jl, jc)
            by = block[found]
            by[:, :3], by[:, 8:] = jx, jl
            for k in range(5):
                for a in range(2):
                    by[a, 3 + k] = jc[a, k] if free[k] else 0.0
            columns[8], columns[9] = AT_PLACES + 2 * j, AT_PLACES + 2 * j + 1
            for a in range(10):
                for b in range(10):
                    part[a, b] = covariance[columns[a], columns[b]]
            spread = by @ part @ by.T
            spread[0, 0] += sigma[s, 0] ** 2
            spread[1, 1] += sigma[s, 1] ** 2
            det = spread[0, 0] * spread[1, 1] - spread[0, 1] ** 2
            squared = (e[0] ** 2 * spread[1, 1] - 2.0 * e[0] * e[1] * spread[0, 1] + e[1] ** 2 * spread[0, 0]) / det
            if squared <= gate:
                source[found], target[found] = s, j
                innovation[found] = e
                found += 1
    return source[:found], target[:found], innovation[:found], block[:found]


def updated(belief: PoseBelief, pairings: Pairings, derivative: FloatArray, taken: IntArray) -> PoseBelief:
    """Return the belief after the pairings `taken` (rows of `pairings`)."""
    rows = np.column_stack([2 * taken, 2 * taken + 1]).ravel()
    h = derivative[rows]
    cross = belief.covariance @ h.T
    gain = np.linalg.solve(pairings.covariance[np.ix_(rows, rows)], cross.T).T
    step = -gain @ pairings.innovation[taken].ravel()
    covariance = belief.covariance - gain @ cross.T
    return PoseBelief(
        se2.compose(belief.pose, np.array([step[0], step[1], step[2]])),
        belief.states + step[3:12],
        belief.landmark + step[12:].reshape(-1, 2),
        0.5 * (covariance + covariance.T),
    )


def with_landmark(belief: PoseBelief, problem: Problem, sigma: FloatArray, detection: int) -> PoseBelief:
    """Return the belief with one more landmark, where the detection points."""
    reading = problem.reading[detection]
    place = sighted_at(belief.pose, reading, belief.states, problem.mount)
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    detection_residual(belief.pose, place, belief.states, problem.mount, reading[0], reading[1], e, jx, jl, jc)
    n = len(belief.covariance)
    by = np.zeros((2, n))
    by[:, :3], by[:, 3:8] = jx, jc * problem.prior.free[:5]
    inverse = np.linalg.inv(jl)
    by = -inverse @ by
    joint = np.zeros((n + 2, n + 2))
    joint[:n, :n] = belief.covariance
    joint[n:, :n] = by @ belief.covariance
    joint[:n, n:] = joint[n:, :n].T
    joint[n:, n:] = by @ belief.covariance @ by.T + inverse @ np.diag(sigma[detection] ** 2) @ inverse.T
    return PoseBelief(belief.pose, belief.states, np.vstack([belief.landmark, place]), joint)
