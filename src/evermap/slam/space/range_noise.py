"""How the noise of positions grows with their range, learned where a sensor states nothing of it.

A lidar has one noise of ranges and one of directions, a stereo pair's ranges are worse by the square of their length, a
detector that knows sizes errs by a share of the range. So variances are sums of powers of the range r,

    along the line of sight  a^2 + (b r)^2 + (c r^2)^2,   across it  d^2 + (e r)^2,

learned for each sensor as variance components by restricted maximum likelihood (Patterson and Thompson 1971). What the
fit absorbed is taken as it was under the noise before (expectation-maximisation, as of the levels); imaginary residuals
of a usual sensor of that level keep a shape that nothing shows as it usually is. Which
ranges these are: `estimate.noise.raise_ranges`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.estimate.noise import GAIN_NATS, fit_variances, gain_by_variances, raise_ranges
from evermap.geometry import se3
from evermap.slam.space.estimate import SpatialOptimum, converge, leverages
from evermap.slam.space.linearise import ACROSS, ALONG, CORNERS
from evermap.types import FloatArray

POWERS = (0, 2), (0, 2, 4)
"""Of the range, in variances across the line of sight and along it."""
NUMBERS = 2.0, 1.0
"""That a position measures across the line of sight and along it."""
ROUNDS, SETTLED = 4, 0.05
"""Times that noise and values are sought in turns, at most, and relative change of the noise, a root mean square, that
ends it."""
FARTHEST = 2.0
"""Ratio of expected and measured range up to which the former counts; where it is more the place is elsewhere."""


def with_range_noise(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum with noise by range of positions of which none is stated; the same where usual noise will do.

    Levels are over that noise from then on.
    """
    for _ in range(ROUNDS):
        problem, noise = optimum.smoother.problem, optimum.noise
        if not problem.estimate_noise or not np.isfinite(problem.usual_m).any():
            break
        before = problem.sigma_position_m * noise.levels[[ACROSS, ALONG]]
        found = learn_range_noise(optimum)
        change = np.log(found / before)[np.isfinite(problem.usual_m[:, 0])]
        if np.mean(change**2, axis=0).max() < SETTLED**2:
            break
        if np.isfinite(problem.usual_m[problem.kind != CORNERS]).all():
            noise = replace(noise, across=1.0, along=1.0)
        # else what is stated keeps its levels, and noise that is learned is over these
        problem = problem.with_sigma_position(found / noise.levels[[ACROSS, ALONG]])
        optimum = converge(problem, optimum.estimate, noise, heavy_rounds=0)
    return optimum


def learn_range_noise(optimum: SpatialOptimum) -> FloatArray:
    """Return (M, 2) standard deviations of positions across and along the line of sight, by the residuals there."""
    smoother, now = optimum.smoother, optimum.now
    problem, levels = smoother.problem, optimum.noise.levels[[ACROSS, ALONG]]
    before = problem.sigma_position_m * levels
    explained = leverages(smoother, smoother.spread(now, nearly=True))[1]
    squares = now.weight[:, None] * now.residual**2 + explained
    expected = np.column_stack([squares[:, :2].sum(axis=1), squares[:, 2]]) * before**2
    measured_m = np.linalg.norm(problem.measured[:, :3], axis=1)
    least = np.array(problem.settings.least_noise)[[ACROSS, ALONG]]
    numbers, range_m, found = now.weight[:, None] * NUMBERS, _expect_ranges(optimum), before.copy()
    for sensor in range(len(problem.mount)):
        own = np.flatnonzero((problem.sensor == sensor) & np.isfinite(problem.usual_m[:, 0]))
        if not numbers[own].any():
            continue
        fitted, gain = np.empty((len(own), 2)), 0.0
        for k, powers in enumerate(POWERS):
            count, usual = numbers[own, k], problem.usual_m[own, k] ** 2
            usual = usual * (expected[own, k] / usual).sum() / count.sum()
            imagined = problem.settings.pseudo_count * count / count.sum()
            variance = fit_variances(
                raise_ranges(powers, range_m[own], measured_m[own]),
                expected[own, k] + imagined * usual,
                count + imagined,
            )
            # of exact positions, as a simulator makes them, nothing would be left
            variance = np.maximum(variance, (least[k] * problem.usual_m[own, k]) ** 2)
            fitted[:, k] = np.sqrt(variance)
            gain += gain_by_variances(expected[own, k], count, before[own, k] ** 2, variance, problem.share[own])
        if gain > GAIN_NATS:
            found[own] = fitted
    return found


def _expect_ranges(optimum: SpatialOptimum) -> FloatArray:
    """Return ranges (M,) at which the solution has detections."""
    problem, estimate = optimum.smoother.problem, optimum.estimate
    eye = se3.compose(estimate.seen_from(problem)[0], estimate.mount(problem)[problem.sensor])[:, :3]
    measured_m = np.linalg.norm(problem.measured[:, :3], axis=1)
    expected_m = np.linalg.norm(estimate.place[problem.place, :3] - eye, axis=1)
    return np.asarray(np.clip(expected_m, measured_m / FARTHEST, measured_m * FARTHEST))
