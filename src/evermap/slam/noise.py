"""Noise levels from the recording itself: restricted maximum likelihood of variance components.

At the optimum a residual is smaller than the noise that made it, by what the fit absorbed. The stationary point of the
marginal likelihood (Laplace approximation, poses, landmarks and calibration integrated out) sets for every component
`k` with unit covariance `P_k` and information `W`

    sigma_k^2 <- sigma_k^2  sum e' W P_k W e  /  sum tr(W P_k) - tr(W P_k W V),

with `V = J Sigma J'` the part of the residual's covariance that the estimate's own uncertainty explains (Patterson and
Thompson 1971; the multiplicative form keeps variances positive). Truth is never used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.config import NoiseConfig
from evermap.estimate.noise import GAIN_NATS, fit_variances, gain_by_variances, raise_ranges, restricted_level
from evermap.slam.kernels import kernel, multiply
from evermap.slam.linearise import detection_residuals, root_of
from evermap.slam.preintegration import Intervals, linearise_interval
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.types import FloatArray


def start_noise(settings: NoiseConfig, outlier_log_odds: float = 7.0) -> Noise:
    """Return the levels that a run starts from; wide: too little noise would lock the first mistake in."""
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
    """New noise levels with their uncertainties.

    Attributes:
        noise: the levels.
        detection_relative: (2,) standard deviations of the levels, relative to them.
        odometry_relative: (5,) the same; kinds that act on one axis are hard to tell apart, and that is in it.
        change: root mean square of what the step changes the noise of a reading or a motion by, relative to it: kinds
            that change against each other change little.
    """

    noise: Noise
    detection_relative: FloatArray
    odometry_relative: FloatArray
    change: float = 0.0


def refine_noise(
    problem: Problem,
    estimate: Estimate,
    marginals: Marginals,
    weights: FloatArray,
    noise: Noise,
    start: Noise = START,
    *,
    scoring: bool = False,
) -> NoiseFit:
    """Take one step from `noise` towards the restricted-likelihood noise levels.

    With `scoring`, by the Fisher information of all kinds of odometry noise together: kinds that act on the same
    residuals are told apart in fewer steps, from levels that are not far off.

    `estimate` is the optimum under `noise`, with its covariances and the inlier probabilities (M,); `start` are levels
    that `start.pseudo_count` imaginary residuals vouch for.
    """
    pseudo, (squares, counts) = start.pseudo_count, _sum_detections(problem, estimate, marginals, weights)
    detection = restricted_level(squares, counts, start.detection, pseudo)
    driven = problem.drive.between(problem.stamp_s, estimate.states)
    pulls, chances, fisher = _odometry_sums(
        estimate.pose, driven, noise.odometry**2, problem.prior.free, marginals.explained_odometry
    )
    # tr(W P_k) is a count only after multiplying by the variance
    variance = noise.odometry**2
    count = np.maximum(variance * chances, 0.0)
    odometry = restricted_level(variance**2 * pulls, count, start.odometry, pseudo)
    step, information = np.log(odometry / noise.odometry), variance[:, None] * fisher * variance
    if scoring:
        imagined = pseudo * start.odometry**2 / variance
        gradient = 0.5 * (variance * (pulls - chances) + imagined - pseudo)
        whole = np.sqrt(0.5 * count / np.maximum(information.sum(axis=1), 1e-300))
        information = whole[:, None] * information * whole
        step = 0.5 * np.linalg.solve(information + np.diag(0.5 * imagined), gradient)
        step = np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        odometry = noise.odometry * np.exp(step)
    of_motions = float(step @ information @ step) / max(float(information.sum()), 1e-300)
    of_readings = float(np.max(np.log(detection / noise.detection) ** 2 * (counts > pseudo)))
    # a variance is known less well where others act on the same residuals
    scale = np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    correlation = fisher / np.outer(scale, scale) + 1e-3 * np.eye(len(fisher))
    inflation = np.maximum(np.diag(np.linalg.inv(correlation)), 1.0)
    return NoiseFit(
        Noise(detection, odometry, noise.outlier_log_odds),
        1.0 / np.sqrt(2.0 * (counts + pseudo)),
        np.sqrt(inflation / (2.0 * (count + pseudo))),
        float(np.sqrt(max(of_motions, of_readings))),
    )


def _sum_detections(
    problem: Problem, estimate: Estimate, marginals: Marginals, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (2,) sums of squares of ranges and bearings that state no noise, and (2,) their degrees of freedom."""
    residual = detection_residuals(problem, estimate)
    residual = residual if problem.noise_shape is None else residual / problem.noise_shape
    learned = np.where(np.isfinite(problem.sigma_given), 0.0, weights[:, None])
    left = 1.0 - np.diagonal(marginals.explained_detections, axis1=1, axis2=2)
    return (learned * residual**2).sum(axis=0), (learned * np.maximum(left, 0.0)).sum(axis=0)


def gain_without_start(
    problem: Problem, estimate: Estimate, marginals: Marginals, weights: FloatArray, noise: Noise, start: Noise
) -> float:
    """Return by how much the log evidence is larger at levels that no imagined residuals have pulled [nats].

    What is imagined has noise in metres, and pulls less the nearer a level is to it: so of two solutions that differ in
    their metre alone, that in which lengths are longer would fit better. By a step of Fisher's scoring from where the
    pull and the slope of the likelihood are in balance; a slope of more than twice the pull is of levels that are not.

    Arguments are those of `refine_noise`.
    """
    squares, counts = _sum_detections(problem, estimate, marginals, weights)
    driven, variance = problem.drive.between(problem.stamp_s, estimate.states), noise.odometry**2
    pulls, chances, fisher = _odometry_sums(
        estimate.pose, driven, variance, problem.prior.free, marginals.explained_odometry
    )
    most = start.pseudo_count * np.abs(start.levels**2 / noise.levels**2 - 1.0)
    slope = 0.5 * np.concatenate([squares / noise.detection**2 - counts, variance * (pulls - chances)])
    slope = np.clip(slope, -most, most)
    information = np.diag(0.5 * np.concatenate([counts, np.zeros(len(variance))]))
    information[len(counts) :, len(counts) :] = variance[:, None] * fisher * variance
    information += 0.5 * start.pseudo_count * np.eye(len(slope))  # as many, at the levels there are
    return float(0.5 * slope @ np.linalg.solve(information, slope))


def learn_noise_by_range(
    problem: Problem, estimate: Estimate, marginals: Marginals, weights: FloatArray, noise: Noise, share: float
) -> tuple[Problem, Noise]:
    """Return the problem with the noise by range of detections that state none, and levels that go with it.

    A stereo pair's ranges are worse by the square of their length, those of a detector that knows sizes by a share of
    it; of what is measured as a position, bearings are the better the farther it is. So variances of ranges are sums of
    r^0, r^2 and r^4 (`estimate.noise.raise_ranges`), and those of bearings of r^-2 and r^0, as in space. Levels are
    those with which all detections would be worth as much. The same problem where noise as it was is as probable.

    It is for positions of sensors in space (`Problem.noise_by_range`). Of the cameras of MRCLAM, whose errors last and
    whose range law is a state, it made single robots better and several together too sure of landmarks (NEES 1.3 to
    4.7).

    Arguments are those of `refine_noise`, and the `share` of the information of the detections that is new.
    """
    if not len(problem.reading):
        return problem, noise
    residual, before = detection_residuals(problem, estimate), problem.find_sigma(noise)
    explained = np.clip(np.diagonal(marginals.explained_detections, axis1=1, axis2=2), 0.0, 1.0)
    expected = weights[:, None] * residual**2 + explained * before**2
    read_m = np.maximum(problem.reading[:, 0], NEAREST * float(np.median(problem.reading[:, 0])))
    range_m = np.clip(read_m - residual[:, 0], read_m / FARTHEST, read_m * FARTHEST)
    shape = np.ones_like(before) if problem.noise_shape is None else problem.noise_shape.copy()
    level, is_new = noise.detection.copy(), False
    for k, powers in enumerate(POWERS):
        own = np.flatnonzero(~np.isfinite(problem.sigma_given[:, k]))
        count, squares, was = weights[own], expected[own, k], before[own, k] ** 2
        if count.sum() < FEWEST:
            continue
        imagined = noise.pseudo_count * count / count.sum()
        variance = fit_variances(
            raise_ranges(powers, range_m[own], read_m[own]), squares + imagined * was, count + imagined
        )
        if gain_by_variances(squares, count, was, variance, share) > GAIN_NATS:
            level[k] = np.mean(1.0 / variance) ** -0.5
            shape[own, k], is_new = np.sqrt(variance) / level[k], True
    if not is_new:
        return problem, noise
    return replace(problem, noise_shape=shape), replace(noise, detection=level)


POWERS = (0, 2, 4), (-2, 0)
"""Of the range, in variances of ranges and of bearings."""
FEWEST = 30.0
"""Inliers from which their noise by range is sought."""
FARTHEST, NEAREST = 2.0, 0.1
"""Ratio of expected and measured range up to which the former counts; and share of the median range that counts at
least."""


class Extrapolation:
    """Extrapolated noise levels of a sequence of `refine_noise` steps: Anderson mixing (1965) of their logarithms.

    Kinds of noise that act on the same residuals take dozens of steps to separate, each a few per cent in the same
    direction. The steps so far tell where that leads.
    """

    def __init__(self) -> None:
        self._last: tuple[FloatArray, FloatArray] | None = None
        self._by_level: list[FloatArray] = []
        self._by_step: list[FloatArray] = []

    def elsewhere(self) -> None:
        """Go on at another problem, so near that steps change with the levels as they did."""
        self._last = None

    def ahead(self, before: Noise, after: Noise) -> Noise:
        """Return levels to go on from, given those before and after a step."""
        level = np.log(before.levels)
        step = np.log(after.levels) - level
        if self._last is not None:
            self._by_level = [*self._by_level, level - self._last[0]][1 - MIXED :]
            self._by_step = [*self._by_step, step - self._last[1]][1 - MIXED :]
        self._last = level, step
        if self._by_step:
            by_level, by_step = np.transpose(self._by_level), np.transpose(self._by_step)
            share = np.linalg.lstsq(by_step, step, rcond=LEAST_MIXED)[0]
            step = np.clip(step - (by_level + by_step) @ share, -LARGEST_STEP, LARGEST_STEP)
        mixed = np.exp(level + step)
        return replace(after, detection=mixed[:2], odometry=mixed[2:])


MIXED = 5
"""Steps that are extrapolated from."""
LEAST_MIXED = 1e-2
"""Relative size of differences between steps that are not rounding, or the values that settle beside them."""
LARGEST_STEP = 0.5
"""Of the logarithm of a level."""


@kernel
def _odometry_sums(
    pose: FloatArray, driven: Intervals, variance: FloatArray, free: Any, explained: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return for every kind of odometry noise, with `L = W - W V W`: sums of `e' W P_k W e` and of `tr(L P_k)`.

    And the Fisher information of the variances, `sum tr(P_k L P_l L) / 2`.
    """
    kinds = len(variance)
    pulls, chances, fisher = np.zeros(kinds), np.zeros(kinds), np.zeros((kinds, kinds))
    weighted = np.zeros((kinds, 3, 3))
    information, root, left = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    part, kept = np.zeros((3, 3)), np.zeros((3, 3))
    e, pull, j = np.zeros(3), np.zeros(3), np.zeros((3, 10))
    for i in range(len(pose) - 1):
        noise = driven.noise[i]
        linearise_interval(driven, i, pose, variance, free, e, j, information)
        root_of(information, root)
        for a in range(3):
            pull[a] = information[a, 0] * e[0] + information[a, 1] * e[1] + information[a, 2] * e[2]
            for b in range(3):
                kept[a, b] = (1.0 if a == b else 0.0) - explained[i, a, b]
        # W - W V W = R' (1 - A S A') R with W = R' R: what the residual still is allowed to be
        multiply(kept, root, part)
        multiply(root.T, part, left)
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
