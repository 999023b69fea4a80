"""Noise levels from the recording itself: restricted maximum likelihood of variance components.

At the optimum a residual is smaller than the noise that made it, by what the fit absorbed. The stationary point of the
marginal likelihood (Laplace approximation, poses, landmarks and calibration integrated out) sets for every component
`k` with unit covariance `P_k` and information `W`

    sigma_k^2 <- sigma_k^2  sum e' W P_k W e  /  sum tr(W P_k) - tr(W P_k W V),

with `V = J Sigma J'` the part of the residual's covariance that the estimate's own uncertainty explains (Patterson and
Thompson 1971; the multiplicative form keeps variances positive). Truth is never used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.config import NoiseConfig
from evermap.slam.kernels import (
    detection_residual,
    kernel,
    sandwich,
)
from evermap.slam.preintegration import Intervals, linearise_interval
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.types import FloatArray


def start_noise(settings: NoiseConfig, outlier_log_odds: float = 7.0) -> Noise:
    """Return the levels that a run starts from; wide: too little noise would lock the first mistake in.

    Args:
        settings: the levels.
        outlier_log_odds: see `Noise`.
    """
    return Noise(
        detection=np.array([settings.sigma_range_m, settings.sigma_bearing_rad]),
        odometry=np.array(
            [
                settings.forward_by_distance,
                settings.forward_by_turn,
                settings.sideways_by_distance,
                settings.turn_by_time,
                settings.turn_by_turn,
            ]
        ),
        outlier_log_odds=outlier_log_odds,
        pseudo_count=settings.pseudo_count,
    )


START = start_noise(NoiseConfig())


@dataclass(frozen=True, slots=True)
class NoiseFit:
    """New noise levels and how well they are known.

    Attributes:
        noise: the levels.
        detection_relative: (2,) standard deviations of the levels, relative to them.
        odometry_relative: (5,) the same; kinds that act on one axis are hard to tell apart, and that is in it.
    """

    noise: Noise
    detection_relative: FloatArray
    odometry_relative: FloatArray


def refine_noise(
    problem: Problem, estimate: Estimate, marginals: Marginals, weights: FloatArray, noise: Noise, start: Noise = START
) -> NoiseFit:
    """Take one step towards the restricted-likelihood noise levels.

    Args:
        problem: the measurements.
        estimate: the optimum under `noise`.
        marginals: covariances at `estimate`, made with `noise`.
        weights: (M,) inlier probabilities.
        noise: levels so far.
        start: levels that `start.pseudo_count` imaginary residuals vouch for.
    """
    free, pseudo = problem.prior.free, start.pseudo_count
    squares, counts = _detection_sums(
        estimate.pose,
        estimate.landmark,
        estimate.states,
        problem.pose_row,
        problem.landmark_row,
        problem.reading,
        noise.of_detections(problem.sigma_given),
        np.isfinite(problem.sigma_given),
        problem.mount,
        free,
        weights,
        marginals.pose,
        marginals.pose_shared,
        marginals.shared,
    )
    detection = np.sqrt((squares + pseudo * start.detection**2) / (counts + pseudo))
    pulls, chances, fisher = _odometry_sums(
        estimate.pose,
        problem.drive.between(problem.stamp_s, estimate.states),
        noise.odometry**2,
        free,
        marginals.pose,
        marginals.consecutive,
        marginals.pose_shared,
        marginals.shared,
    )
    # tr(W P_k) is a count only after multiplying by the variance
    count = np.maximum(noise.odometry**2 * chances, 0.0)
    squares_odometry = noise.odometry**4 * pulls
    odometry = np.sqrt((squares_odometry + pseudo * start.odometry**2) / (count + pseudo))
    return NoiseFit(
        Noise(detection, odometry, noise.outlier_log_odds),
        1.0 / np.sqrt(2.0 * (counts + pseudo)),
        np.sqrt(_inflation(fisher) / (2.0 * (count + pseudo))),
    )


def _inflation(fisher: FloatArray) -> FloatArray:
    """Factor by which each variance is known less well because others act on the same residuals (>= 1)."""
    scale = np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    correlation = fisher / np.outer(scale, scale) + 1e-3 * np.eye(len(fisher))
    inflation: FloatArray = np.maximum(np.diag(np.linalg.inv(correlation)), 1.0)
    return inflation


@kernel
def joint_covariance(
    pose: int, place: int, cov_pose: FloatArray, cov_cross: FloatArray, cov_shared: FloatArray, out: FloatArray
) -> None:
    """Compute the covariance (10, 10) of one pose, one place and the five sensor states, from `Marginals`."""
    at_states = len(cov_shared) - 9
    out[:3, :3] = cov_pose[pose]
    for a in range(7):
        row = 2 * place + a if a < 2 else at_states + a - 2
        for b in range(3):
            out[3 + a, b] = out[b, 3 + a] = cov_cross[pose, b, row]
        for b in range(7):
            out[3 + a, 3 + b] = cov_shared[row, 2 * place + b if b < 2 else at_states + b - 2]


@kernel
def _detection_sums(
    pose: FloatArray,
    landmark: FloatArray,
    states: FloatArray,
    pose_row: Any,
    landmark_row: Any,
    reading: FloatArray,
    sigma: FloatArray,
    given: Any,
    mount: FloatArray,
    free: Any,
    weights: FloatArray,
    cov_pose: FloatArray,
    cov_cross: FloatArray,
    cov_shared: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Weighted squares of residuals and their effective number, range and bearing apart."""
    squares, counts = np.zeros(2), np.zeros(2)
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    j = np.zeros((2, 10))
    cov, part, explained = np.zeros((10, 10)), np.zeros((2, 10)), np.zeros((2, 2))
    for m in range(len(pose_row)):
        i = pose_row[m]
        detection_residual(
            pose[i], landmark[landmark_row[m]], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc
        )
        for k in range(5):
            if not free[k]:
                jc[:, k] = 0.0
        j[:, :3], j[:, 3:5], j[:, 5:] = jx, jl, jc
        joint_covariance(i, landmark_row[m], cov_pose, cov_cross, cov_shared, cov)
        sandwich(j, cov, part, explained)
        w = weights[m]
        for k in range(2):
            if not given[m, k]:
                squares[k] += w * e[k] * e[k]
                counts[k] += w * max(1.0 - w * explained[k, k] / sigma[m, k] ** 2, 0.0)
    return squares, counts


@kernel
def _odometry_sums(
    pose: FloatArray,
    driven: Intervals,
    variance: FloatArray,
    free: Any,
    cov_pose: FloatArray,
    cov_next: FloatArray,
    cov_cross: FloatArray,
    cov_shared: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of every kind of odometry noise, with `L = W - W V W`: sums of `e' W P_k W e` and of `tr(L P_k)`.

    And the Fisher information of the variances, `sum tr(P_k L P_l L) / 2`.
    """
    kinds = len(variance)
    shared = len(cov_shared)
    pulls, chances, fisher = np.zeros(kinds), np.zeros(kinds), np.zeros((kinds, kinds))
    weighted = np.zeros((kinds, 3, 3))
    information, left = np.zeros((3, 3)), np.zeros((3, 3))
    e, pull, j = np.zeros(3), np.zeros(3), np.zeros((3, 10))
    cov, part, explained = np.zeros((10, 10)), np.zeros((3, 10)), np.zeros((3, 3))
    cov[6:, 6:] = cov_shared[shared - 4 :, shared - 4 :]
    for i in range(len(pose) - 1):
        noise = driven.noise[i]
        linearise_interval(driven, i, pose, variance, free, e, j, information)
        for a in range(3):
            for b in range(3):
                cov[a, b], cov[3 + a, 3 + b] = cov_pose[i, a, b], cov_pose[i + 1, a, b]
                cov[a, 3 + b] = cov[3 + b, a] = cov_next[i, a, b]
            for b in range(4):
                cov[a, 6 + b] = cov[6 + b, a] = cov_cross[i, a, shared - 4 + b]
                cov[3 + a, 6 + b] = cov[6 + b, 3 + a] = cov_cross[i + 1, a, shared - 4 + b]
            pull[a] = information[a, 0] * e[0] + information[a, 1] * e[1] + information[a, 2] * e[2]
        sandwich(j, cov, part, explained)
        # W - W V W: what the residual still is allowed to be
        sandwich(information, explained, part, left)
        for a in range(3):
            for b in range(3):
                left[a, b] = information[a, b] - left[a, b]
        for k in range(kinds):
            for a in range(3):
                for b in range(3):
                    pulls[k] += pull[a] * noise[k, a, b] * pull[b]
                    weighted[k, a, b] = (
                        noise[k, a, 0] * left[0, b] + noise[k, a, 1] * left[1, b] + noise[k, a, 2] * left[2, b]
                    )
                chances[k] += weighted[k, a, a]
            for m in range(k + 1):
                for a in range(3):
                    for b in range(3):
                        fisher[k, m] += 0.5 * weighted[k, a, b] * weighted[m, b, a]
    for k in range(kinds):
        for m in range(k):
            fisher[m, k] = fisher[k, m]
    return pulls, chances, fisher
