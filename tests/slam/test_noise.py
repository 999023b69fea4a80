"""Noise levels: unbiased over many recordings, and at the top of the marginal likelihood of one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from dense import DensePosterior
from problems import QUIET, World, default_prior, integrated, make_world

from evermap.slam.noise import START, NoiseFit, refine_noise
from evermap.slam.problem import Estimate, Noise
from evermap.slam.smoother import Smoother

# sensors that look backwards have a range law that jumps there; not what is tested here
PRIOR = default_prior(range_skew_per_rad=0.0)


def fitted(world: World, start: Noise = START, rounds: int = 60) -> tuple[NoiseFit, Estimate]:
    """Optimum and noise in turns until neither changes; the pseudo residuals vouch for the truth."""
    noise, estimate = start, world.truth
    for _ in range(rounds):
        smoother = Smoother(world.problem, noise, robust=False)
        estimate = smoother.optimum(estimate, tolerance=1e-8)
        weights = smoother.inlier_probability(estimate)
        fit = refine_noise(world.problem, estimate, smoother.marginals(estimate), weights, noise, world.noise)
        change = np.abs(levels(fit.noise) / levels(noise) - 1.0).max()
        noise = fit.noise
        if change < 1e-5:
            break
    return fit, estimate


def levels(noise: Noise) -> np.ndarray:
    return np.concatenate([noise.detection, noise.odometry])


def with_level(noise: Noise, k: int, factor: float) -> Noise:
    values = levels(noise)
    values[k] *= factor
    return replace(noise, detection=values[:2], odometry=values[2:])


def log_marginal_likelihood(world: World, noise: Noise, start: Estimate) -> float:
    """Laplace approximation with everything but the noise integrated out, and the pseudo residuals; all dense."""
    estimate = Smoother(world.problem, noise, robust=False).optimum(start, tolerance=1e-9)
    posterior = DensePosterior(world.problem, noise, estimate, robust=False)
    covariance, _ = posterior.linearised()
    moved = np.diag(covariance) > 0.0
    spread = np.linalg.slogdet(covariance[np.ix_(moved, moved)])[1]
    stamps, drive = world.problem.stamp_s, world.problem.drive
    normaliser = len(world.problem.reading) * np.log(noise.detection).sum()
    for a, b in pairwise(stamps):
        odometry = integrated(drive, a, b, estimate.states).covariance(noise.odometry**2)
        normaliser += 0.5 * np.linalg.slogdet(odometry)[1]
    believed = levels(world.noise) / levels(noise)
    pseudo = -START.pseudo_count * (np.log(levels(noise)) + 0.5 * believed**2).sum()
    return -posterior.cost() - normaliser + 0.5 * spread + pseudo


def test_stationary_point_tops_the_marginal_likelihood():
    """Slope over curvature of the log likelihood by the log level is the distance to the top."""
    states = default_prior().mean + 0.2 * default_prior().sigma * PRIOR.free
    world = make_world(21, n_poses=25, n_landmarks=5, prior=PRIOR, states=states)
    fit, estimate = fitted(world)
    middle = log_marginal_likelihood(world, fit.noise, estimate)
    for k in range(7):
        h = 0.1
        low, high = (log_marginal_likelihood(world, with_level(fit.noise, k, np.exp(d)), estimate) for d in (-h, h))
        assert middle > max(low, high), f"level {k} is not at a maximum"
        to_top = -(high - low) / (2 * h) / ((high - 2 * middle + low) / h**2)
        assert abs(to_top) < 0.02, f"level {k} is {to_top:.1%} off the top"


def test_given_sigmas_are_left_alone():
    world = make_world(22, n_poses=60, prior=PRIOR)
    sigma = np.full_like(world.problem.reading, np.nan)
    sigma[:, 1] = 0.5
    world = World(replace(world.problem, sigma_given=sigma), world.noise, world.truth)
    smoother = Smoother(world.problem, QUIET, robust=False)
    estimate = smoother.optimum(world.truth)
    weights = smoother.inlier_probability(estimate)
    fit = refine_noise(world.problem, estimate, smoother.marginals(estimate), weights, QUIET, START)
    assert fit.noise.detection[1] == pytest.approx(START.detection[1])  # nobody speaks of it but the start
    assert fit.detection_relative[1] == pytest.approx(1 / np.sqrt(2 * START.pseudo_count))
    assert fit.detection_relative[0] < 0.5 * fit.detection_relative[1]


def test_outliers_do_not_count():
    world = make_world(23, n_poses=150, n_landmarks=6, prior=PRIOR)
    reading = world.problem.reading.copy()
    wrong = np.random.default_rng(1).random(len(reading)) < 0.05
    reading[wrong, 0] += 2.0
    spoilt = World(replace(world.problem, reading=reading), world.noise, world.truth)
    noise = QUIET
    for _ in range(8):
        smoother = Smoother(spoilt.problem, noise)
        estimate = smoother.optimum(world.truth)
        weights = smoother.inlier_probability(estimate)
        fit = refine_noise(spoilt.problem, estimate, smoother.marginals(estimate), weights, noise, QUIET)
        noise = fit.noise
    assert fit.detection_relative[0] > 1 / np.sqrt(2 * (len(reading) - wrong.sum() + START.pseudo_count))
    assert noise.detection == pytest.approx(QUIET.detection, rel=0.1)


@pytest.mark.slow
def test_levels_are_unbiased_and_as_sure_as_they_say():
    fits = [fitted(make_world(seed, n_poses=250, n_landmarks=6, step_s=0.7, p_seen=0.6, prior=PRIOR))[0]
            for seed in range(24)]  # fmt: skip
    found = np.array([levels(fit.noise) for fit in fits]) / levels(QUIET)
    scatter = found.std(axis=0, ddof=1)
    bias = (found.mean(axis=0) - 1.0) / (scatter / np.sqrt(len(fits)))
    assert np.abs(bias).max() < 3.0
    stated = np.array([np.concatenate([fit.detection_relative, fit.odometry_relative]) for fit in fits]).mean(axis=0)
    # the scatter of 24 draws is itself known to 15 %
    assert np.all(stated > 0.6 * scatter)
    assert np.all(stated < 1.6 * scatter)
