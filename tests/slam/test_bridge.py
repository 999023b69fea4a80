"""Poses between poses against the posterior of a chain that has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import QUIET, World, default_prior, integrated, make_world, slow_increment

from evermap.geometry import se2
from evermap.slam.bridge import bridge_poses, dead_reckoned
from evermap.slam.problem import Estimate
from evermap.slam.smoother import Smoother

# where a closing error of centimetres and hundredths of a radian is as linear as the bridge takes it to be
CALM = replace(QUIET, detection=0.2 * QUIET.detection, odometry=0.2 * QUIET.odometry)
PLAIN = replace(default_prior(), free=np.zeros(11, dtype=bool))


def smoothed(world: World, start: Estimate):
    smoother = Smoother(world.problem, world.noise, robust=False)
    estimate = smoother.optimum(start, tolerance=1e-9)
    return estimate, smoother.marginals(estimate)


def with_poses_at(world: World, stamps: np.ndarray, pose: np.ndarray) -> tuple[World, Estimate, np.ndarray]:
    """The same problem with further, blind poses in its chain; a start, and the rows of the new poses."""
    problem = world.problem
    both = np.concatenate([problem.stamp_s, stamps])
    order = np.argsort(both, kind="stable")
    row_of = np.argsort(order)
    start = Estimate(np.vstack([world.truth.pose, pose])[order], world.truth.landmark, world.truth.states)
    problem = replace(problem, stamp_s=both[order], pose_row=row_of[problem.pose_row])
    return World(problem, world.noise, start), start, row_of[len(world.problem.stamp_s) :]


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_bridged_poses_are_the_dense_posterior(seed):
    world = make_world(seed, n_poses=12, prior=PLAIN, step_s=3.0, noise=CALM)
    estimate, marginals = smoothed(world, world.truth)
    rng = np.random.default_rng(seed)
    first, last = world.problem.stamp_s[[0, -1]]
    # one a gap: then each is the posterior given the two poses around it
    share = rng.uniform(0.05, 0.95, len(world.problem.stamp_s) - 1)
    wanted = world.problem.stamp_s[:-1] + share * np.diff(world.problem.stamp_s)
    wanted = np.append(wanted, last + 0.9)
    pose, covariance = bridge_poses(
        wanted, world.problem.stamp_s, estimate.pose, marginals.pose, marginals.consecutive,
        world.problem.drive, estimate.states, world.noise,
    )  # fmt: skip
    bigger, start, rows = with_poses_at(world, wanted, pose)
    full, full_marginals = smoothed(bigger, start)
    sigma = np.sqrt(np.einsum("nii->ni", full_marginals.pose[rows]))
    gap = se2.log(se2.between(full.pose[rows], pose))
    assert np.abs(gap / sigma).max() < 0.03
    off = (covariance - full_marginals.pose[rows]) / (sigma[:, :, None] * sigma[:, None, :])
    assert np.abs(off).max() < 0.03
    assert first < wanted.min()


def test_before_the_first_pose_it_is_dead_reckoning_backwards():
    world = make_world(4, prior=PLAIN)
    estimate, marginals = smoothed(world, world.truth)
    wanted, first = np.array([-0.3]), world.problem.stamp_s[0]
    pose, covariance = bridge_poses(
        wanted, world.problem.stamp_s, estimate.pose, marginals.pose, marginals.consecutive,
        world.problem.drive, estimate.states, world.noise,
    )  # fmt: skip
    step = integrated(world.problem.drive, wanted[0], first, estimate.states)
    assert se2.compose(pose[0], step.increment) == pytest.approx(estimate.pose[0], abs=1e-9)
    # the uncertainty of the first pose and of the step, both seen from the earlier pose
    back = se2.adjoint(step.increment)
    expected = back @ (marginals.pose[0] + step.covariance(world.noise.odometry**2)) @ back.T
    assert covariance[0] == pytest.approx(expected, rel=1e-6)


def test_at_the_poses_themselves_nothing_changes():
    world = make_world(5)
    estimate, marginals = smoothed(world, world.truth)
    pose, covariance = bridge_poses(
        world.problem.stamp_s, world.problem.stamp_s, estimate.pose, marginals.pose, marginals.consecutive,
        world.problem.drive, estimate.states, world.noise,
    )  # fmt: skip
    assert np.abs(se2.between(estimate.pose, pose)).max() < 2e-4
    assert covariance == pytest.approx(marginals.pose, rel=1e-2, abs=5e-8)


def test_uncertainty_swells_in_the_middle_of_a_blind_stretch_and_stays_positive():
    world = make_world(6, n_poses=4, step_s=20.0, prior=PLAIN)
    estimate, marginals = smoothed(world, world.truth)
    a, b = world.problem.stamp_s[1:3]
    wanted = np.linspace(a, b, 41)
    _, covariance = bridge_poses(
        wanted, world.problem.stamp_s, estimate.pose, marginals.pose, marginals.consecutive,
        world.problem.drive, estimate.states, world.noise,
    )  # fmt: skip
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    size = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    assert 8 < np.argmax(size) < 32
    assert size.max() > 2 * max(size[0], size[-1])


def test_dead_reckoning_composes_the_increments():
    world = make_world(7)
    states = world.truth.states
    stamps = np.sort(np.random.default_rng(0).uniform(-0.5, world.problem.stamp_s[-1], 30))
    pose, covariance = dead_reckoned(stamps, world.problem.drive, states, world.noise)
    assert not pose[0].any()
    assert not covariance[0].any()
    whole = np.array([slow_increment(world.problem.drive, stamps[0], stamp, states) for stamp in stamps])
    assert np.abs(se2.between(whole, pose)).max() < 1e-9
    # composed step by step or integrated in one go: cuts within a step and the per-window floor matter little
    for k in (1, 10, 29):
        once = integrated(world.problem.drive, stamps[0], stamps[k], states).covariance(world.noise.odometry**2)
        sigma = np.sqrt(np.diag(once))
        assert np.abs((covariance[k] - once) / np.outer(sigma, sigma)).max() < 0.02


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_at_the_instants_of_poses_these_are_the_poses(seed):
    """And others are what they are without those among them."""
    world = make_world(seed, n_poses=12, prior=PLAIN, step_s=3.0, noise=CALM)
    estimate, marginals = smoothed(world, world.truth)
    own = world.problem.stamp_s
    given = (
        own, estimate.pose, marginals.pose, marginals.consecutive, world.problem.drive, estimate.states, world.noise,
    )  # fmt: skip
    pose, covariance = bridge_poses(own, *given)
    np.testing.assert_array_equal(pose, estimate.pose)
    np.testing.assert_allclose(covariance, marginals.pose, rtol=1e-9, atol=1e-15)
    others = np.concatenate([[own[0] - 0.5], own[:-1] + 0.4 * np.diff(own), [own[-1] + 0.5]])
    every = np.sort(np.concatenate([own, others]))
    both, alone = bridge_poses(every, *given), bridge_poses(others, *given)
    for all_of_them, some in zip(both, alone, strict=True):
        np.testing.assert_array_equal(all_of_them[np.isin(every, others)], some)
