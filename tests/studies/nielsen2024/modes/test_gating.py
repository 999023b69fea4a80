"""Gates are as wide as promised, and births happen where nothing gates."""

from __future__ import annotations

import numpy as np
import pytest
from dense import DensePosterior
from moving import make_moving_world
from problems import make_world
from scipy import stats

from evermap.slam.smoother import Smoother
from evermap_studies.nielsen2024.modes.gating import distances, distances_to_modes, gate_threshold, with_births
from evermap_studies.nielsen2024.modes.places import FREE, Modes


@pytest.mark.parametrize("alpha", [0.5, 0.8, 0.95, 0.999])
def test_the_gate_is_the_chi_square_quantile(alpha: float):
    assert gate_threshold(alpha) == pytest.approx(stats.chi2.ppf(alpha, 2), rel=1e-12)


def test_a_gate_that_nothing_fails():
    assert gate_threshold(1.0) == np.inf


def test_true_detections_fall_outside_as_often_as_the_gate_promises():
    squared = []
    for seed in range(60):
        world = make_world(seed, n_poses=25, n_landmarks=6, n_mapped=3)
        problem = world.problem
        blind = problem.until(len(problem.stamp_s), last_is_blind=True)
        estimate = Smoother(blind, world.noise, robust=False).optimum(world.near_truth(np.random.default_rng(seed)))
        marginals = Smoother(blind, world.noise, robust=False).marginals(estimate)
        last = np.flatnonzero(problem.pose_row == len(problem.stamp_s) - 1)
        squared.append(distances(problem, estimate, marginals, world.noise, last, problem.landmark_row[last]))
    # detections of one world share their pose: the worlds are what is independent
    share = np.array([np.mean(of_world > gate_threshold(0.95)) for of_world in squared])
    assert abs(share.mean() - 0.05) < 4 * share.std() / np.sqrt(len(share))
    assert stats.kstest([of_world[0] for of_world in squared], stats.chi2(2).cdf).pvalue > 0.01


def test_one_mode_is_born_where_a_landmark_went():
    moving = make_moving_world(5)
    world, problem = moving.world, moving.problem
    truth = world.truth  # as if poses were known, so that only what moved fails its gate
    marginals = Smoother(problem, world.noise).marginals(Smoother(problem, world.noise, heavy=True).optimum(truth))
    modes = Modes.one_each(6)
    grown, estimate, more, lost = with_births(problem, truth, marginals, world.noise, modes, gate_threshold(0.99999))
    late = (problem.landmark_row == moving.moved) & (problem.pose_row >= moving.since)
    np.testing.assert_array_equal(lost, late)
    np.testing.assert_array_equal(more.landmark, [0, 1, 2, 3, 4, 5, moving.moved])
    np.testing.assert_allclose(estimate.landmark[6], moving.at, atol=0.5)
    assert len(grown.landmark_mean) == 7
    assert not grown.mapped[6]
    np.testing.assert_array_equal(grown.landmark_row, problem.landmark_row)


def test_a_gate_without_bounds_bears_nothing():
    moving = make_moving_world(5)
    estimate = moving.static_optimum()
    marginals = Smoother(moving.problem, moving.world.noise).marginals(estimate)
    modes = Modes.one_each(6)
    *same, lost = with_births(moving.problem, estimate, marginals, moving.world.noise, modes, np.inf)
    assert [a is b for a, b in zip(same, (moving.problem, estimate, modes), strict=True)] == [True] * 3
    assert not lost.any()


def test_distances_are_those_of_the_dense_covariance():
    """`H P H'` by finite differences through the whole posterior."""
    world = make_world(2, n_poses=8, n_landmarks=4)
    smoother = Smoother(world.problem, world.noise)
    near = Smoother(world.problem, world.noise, heavy=True).optimum(world.near_truth(np.random.default_rng(0)))
    estimate = smoother.optimum(near)
    dense = DensePosterior(world.problem, world.noise, estimate)
    covariance, _ = dense.linearised()
    h = 1e-6
    around = np.eye(dense.size)
    by_all = np.stack(
        [dense.detection_residuals(dense.at(h * d)) - dense.detection_residuals(dense.at(-h * d)) for d in around], -1
    ) / (2 * h)
    free = np.concatenate([np.arange(3 * 8 + 2 * 4), 3 * 8 + 2 * 4 + dense.free])
    covariance = covariance[np.ix_(free, free)]
    everything = np.arange(len(world.problem.reading))
    marginals = smoother.marginals(estimate)
    found = distances(world.problem, estimate, marginals, world.noise, everything, world.problem.landmark_row)
    e = dense.detection_residuals(estimate)
    for m in everything:
        s = by_all[m] @ covariance @ by_all[m].T + np.eye(2)
        assert found[m] == pytest.approx(e[m] @ np.linalg.solve(s, e[m]), rel=1e-4, abs=1e-9)


def test_gates_of_several_modes_are_those_of_each_alone():
    moving = make_moving_world(5)
    estimate = moving.told_optimum()
    marginals = Smoother(moving.told, moving.world.noise).marginals(estimate)
    modes = Modes(np.array([0, 1, 2, 3, 4, 5, moving.moved]), 6)
    gates = distances_to_modes(moving.told, estimate, marginals, moving.world.noise, modes) < gate_threshold(0.95)
    own = np.arange(len(moving.told.reading))
    for column, places in enumerate(modes.table(estimate).T):
        place = places[modes.landmark[moving.told.landmark_row]]
        there = own[place != FREE]
        squared = distances(moving.told, estimate, marginals, moving.world.noise, there, place[there])
        np.testing.assert_array_equal(gates[there, column], squared < gate_threshold(0.95))
        assert not gates[place == FREE, column].any()
    mine = moving.told.landmark_row == moving.moved
    assert gates[mine, 0].mean() > 0.9
    assert gates[mine, 1].mean() < 0.1
