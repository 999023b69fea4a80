"""The smoother's cost written down a second time, for dense solvers: slow, and without its kernels."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy.linalg
import scipy.optimize
from problems import closed_increments, integrated, slow_detection

from evermap.geometry import se2
from evermap.slam.problem import Estimate, Noise, Problem


class DensePosterior:
    """Residuals of a problem as one vector function of all unknowns, a step away from `around`.

    The odometry's covariance is frozen at the states of `around`: the smoother re-weights, it does not minimise over
    the weights (a likelihood without its normalisation would reward noise).
    """

    def __init__(self, problem: Problem, noise: Noise, around: Estimate, *, robust: bool = True) -> None:
        self.problem, self.noise, self.around = problem, noise, around
        self.log_odds = noise.outlier_log_odds if robust else np.inf
        self.known = np.flatnonzero(around.known)
        self.free = np.flatnonzero(problem.prior.free)
        self.n_poses = len(problem.stamp_s)
        covariance = [
            integrated(problem.drive, a, b, around.states).covariance(noise.odometry**2)
            for a, b in pairwise(problem.stamp_s)
        ]
        self.white = np.linalg.inv(np.linalg.cholesky(np.array(covariance)))
        self.sigma = np.where(np.isfinite(problem.sigma_given), problem.sigma_given, noise.detection)
        self._increments: dict[bytes, np.ndarray] = {}

    @property
    def size(self) -> int:
        return 3 * self.n_poses + 2 * len(self.known) + len(self.free)

    def at(self, step: np.ndarray) -> Estimate:
        """`around`, moved: poses on the right, landmarks and free states added."""
        split = 3 * self.n_poses, 3 * self.n_poses + 2 * len(self.known)
        pose = se2.compose(self.around.pose, se2.exp(step[: split[0]].reshape(-1, 3)))
        landmark, states = self.around.landmark.copy(), self.around.states.copy()
        landmark[self.known] += step[split[0] : split[1]].reshape(-1, 2)
        states[self.free] += step[split[1] :]
        return Estimate(pose, landmark, states)

    def detection_residuals(self, estimate: Estimate) -> np.ndarray:
        """(M, 2) over sigma."""
        problem = self.problem
        pose, landmark = estimate.pose[problem.pose_row], estimate.landmark[problem.landmark_row]
        e = problem.reading - slow_detection(pose, landmark, estimate.states, problem.mount)
        e[:, 1] = se2.wrap(e[:, 1])
        return e / self.sigma

    def odometry_residuals(self, estimate: Estimate) -> np.ndarray:
        """(N - 1, 3), whitened."""
        increments = self._increments.setdefault(estimate.states.tobytes(), np.empty((0, 3)))
        if len(increments) == 0:
            increments = closed_increments(self.problem.drive, self.problem.stamp_s, estimate.states)
            self._increments[estimate.states.tobytes()] = increments
        e = se2.between(increments, se2.between(estimate.pose[:-1], estimate.pose[1:]))
        return np.einsum("nij,nj->ni", self.white, e)

    def prior_residuals(self, estimate: Estimate) -> np.ndarray:
        problem, prior = self.problem, self.problem.prior
        out = [((estimate.states - prior.mean) / prior.sigma)[self.free]]
        # the joint prior of the known landmarks by way of the covariance of all; a singular value of zero is no prior
        information = problem.landmark_information.toarray()
        mapped = np.flatnonzero(information.any(axis=0))
        covariance = np.linalg.inv(information[np.ix_(mapped, mapped)])
        seen = np.isin(mapped // 2, self.known)
        information = np.linalg.inv(covariance[np.ix_(seen, seen)])
        moved = (estimate.landmark - problem.landmark_mean).ravel()[mapped[seen]]
        out.append(np.linalg.cholesky(information).T @ moved)
        out.append(np.sqrt(problem.start_information) * se2.between(problem.start_pose, estimate.pose[0]))
        return np.concatenate(out)

    def weights(self, estimate: Estimate) -> np.ndarray:
        """(M,) posterior probability of no outlier."""
        squared = (self.detection_residuals(estimate) ** 2).sum(axis=1)
        return np.exp(-np.logaddexp(0.0, squared / 2 - self.log_odds))

    def residuals(self, step: np.ndarray) -> np.ndarray:
        """Half the sum of squares is the cost, outlier mixture included."""
        estimate = self.at(step)
        e = self.detection_residuals(estimate)
        squared = (e**2).sum(axis=1)
        loss = squared / 2 - np.logaddexp(0.0, squared / 2 - self.log_odds) + np.logaddexp(0.0, -self.log_odds)
        factor = np.sqrt(2 * loss / np.maximum(squared, 1e-300))
        parts = (e * factor[:, None], self.odometry_residuals(estimate), self.prior_residuals(estimate))
        return np.concatenate([part.ravel() for part in parts])

    def cost(self) -> float:
        return 0.5 * float((self.residuals(np.zeros(self.size)) ** 2).sum())

    def optimum(self) -> Estimate:
        """By scipy, from `around`."""
        solved = scipy.optimize.least_squares(
            self.residuals, np.zeros(self.size), jac="3-point", x_scale="jac", xtol=1e-12, ftol=1e-14, gtol=1e-12
        )
        return self.at(solved.x)

    def jacobian(self) -> tuple[np.ndarray, np.ndarray]:
        """`J` by central differences and the residuals at `around`, with the inlier weights of there."""
        root_weight = np.sqrt(self.weights(self.around))[:, None]

        def residuals(step: np.ndarray) -> np.ndarray:
            moved = self.at(step)
            detections = root_weight * self.detection_residuals(moved)
            parts = (detections, self.odometry_residuals(moved), self.prior_residuals(moved))
            return np.concatenate([part.ravel() for part in parts])

        h = 1e-6
        jacobian = np.stack([(residuals(h * d) - residuals(-h * d)) / (2 * h) for d in np.eye(self.size)], axis=1)
        return jacobian, residuals(np.zeros(self.size))

    def linearised(self) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of `J' W J` at `around`, and the Gauss-Newton step that is left there; J by central differences.

        Both in (3 N + 2 L + 11): poses, all landmarks, all states. Entries of unknown landmarks are zero, fixed states
        keep the variance of their prior.
        """
        jacobian, residual = self.jacobian()
        # columns scaled to one: the first pose may be held 1e8 times harder than the rest
        scale = 1.0 / np.linalg.norm(jacobian, axis=0)
        triangle = np.linalg.qr(jacobian * scale, mode="r")
        root = scipy.linalg.solve_triangular(triangle, np.eye(self.size)) * scale[:, None]
        covariance = root @ root.T
        n_landmarks, n_states = len(self.around.landmark), len(self.problem.prior.mean)
        at_landmarks, at_states = 3 * self.n_poses, 3 * self.n_poses + 2 * n_landmarks
        of_landmarks = at_landmarks + (2 * self.known[:, None] + [0, 1]).ravel()
        rows = np.concatenate([np.arange(at_landmarks), of_landmarks, at_states + self.free])
        whole, step = np.zeros((at_states + n_states,) * 2), np.zeros(at_states + n_states)
        fixed = ~self.problem.prior.free
        whole[at_states + np.flatnonzero(fixed), at_states + np.flatnonzero(fixed)] = (
            self.problem.prior.sigma[fixed] ** 2
        )
        whole[np.ix_(rows, rows)] = covariance
        step[rows] = -covariance @ (jacobian.T @ residual)
        return whole, step
