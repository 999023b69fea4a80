"""The batch smoother against dense solvers of the same cost, which share none of its code."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from dense import DensePosterior
from problems import World, default_prior, make_world

from evermap.errors import DataError
from evermap.estimate.sparse import system
from evermap.geometry import se2
from evermap.slam.problem import Estimate
from evermap.slam.smoother import POSES_A_LEAF, Smoother

SMALL = 1e-4
"""Parts of a standard deviation."""


def with_unknown_landmark(world: World) -> World:
    """A sixth landmark that nobody saw, in a row between the others."""
    problem = world.problem
    row = np.where(problem.landmark_row >= 2, problem.landmark_row + 1, problem.landmark_row)
    problem = replace(
        problem,
        landmark_row=row,
        landmark_mean=np.insert(problem.landmark_mean, 2, 0.0, axis=0),
        landmark_information=np.insert(
            np.insert(problem.landmark_information.toarray(), [4, 4], 0.0, axis=0), [4, 4], 0.0, axis=1
        ),
    )
    truth = replace(world.truth, landmark=np.insert(world.truth.landmark, 2, np.nan, axis=0))
    return World(problem, world.noise, truth)


def with_duplicates(world: World) -> World:
    """Every fifth detection comes twice in its frame, a little different."""
    problem = world.problem
    again = np.arange(0, len(problem.pose_row), 5)
    rows = np.insert(np.arange(len(problem.pose_row)), again, again)
    reading = problem.reading[rows] + 0.01 * np.sin(np.arange(2 * len(rows))).reshape(-1, 2)
    problem = replace(
        problem,
        pose_row=problem.pose_row[rows],
        landmark_row=problem.landmark_row[rows],
        reading=reading,
        sigma_given=problem.sigma_given[rows],
    )
    return World(problem, world.noise, world.truth)


def with_own_sigmas(world: World) -> World:
    """Some detections say how good their range, their bearing or both are."""
    sigma = np.full((len(world.problem.reading), 2), np.nan)
    sigma[::3, 0], sigma[::2, 1] = 0.2, 0.05
    return World(replace(world.problem, sigma_given=sigma), world.noise, world.truth)


def elsewhere(world: World) -> World:
    """In a map, the first pose anywhere and hardly held."""
    pose_map_world = np.array([30.0, -12.0, 2.9])
    problem, truth = world.problem, world.truth
    turn = se2.rotation(pose_map_world[2])
    moved = Estimate(
        se2.compose(pose_map_world, truth.pose), se2.transform(pose_map_world, truth.landmark), truth.states
    )
    every = np.kron(np.eye(len(problem.landmark_mean)), turn)
    problem = replace(
        problem,
        start_pose=moved.pose[0],
        start_information=1e-2,
        landmark_mean=np.where(problem.mapped[:, None], se2.transform(pose_map_world, problem.landmark_mean), 0.0),
        landmark_information=every @ problem.landmark_information.toarray() @ every.T,
    )
    return World(problem, world.noise, moved)


def tied(world: World) -> World:
    """Landmarks 0, 2 and 3 of the map share a displacement, and so does 4, which nobody saw."""
    problem = world.problem
    members = np.array([0, 2, 3, 4])
    shared = np.zeros((5, 2, 2))
    shared[members] = np.eye(2)
    shared = shared.reshape(10, 2)
    covariance = 0.05**2 * np.eye(10) + 0.6**2 * shared @ shared.T
    seen = problem.landmark_row != 4
    problem = replace(
        problem,
        pose_row=problem.pose_row[seen],
        landmark_row=problem.landmark_row[seen],
        reading=problem.reading[seen],
        sigma_given=problem.sigma_given[seen],
        landmark_mean=world.truth.landmark + np.where(np.isin(np.arange(5), members)[:, None], [0.4, -0.3], 0.0),
        landmark_information=np.linalg.inv(covariance),
    )
    landmark = world.truth.landmark.copy()
    landmark[4] = np.nan
    return World(problem, world.noise, replace(world.truth, landmark=landmark))


def blind(world: World) -> World:
    """For two leaves of the elimination nothing is seen, so that their fronts hold no state of the sensor."""
    seen = (world.problem.pose_row < POSES_A_LEAF) | (world.problem.pose_row >= 3 * POSES_A_LEAF)
    return replace(world, problem=world.problem.seeing(seen))


CASES = {
    "free": lambda: make_world(1),
    # nothing straight behind the robot, where the range law jumps
    "outliers": lambda: make_world(12, p_outlier=0.1),
    "map": lambda: elsewhere(make_world(3, n_mapped=3)),
    "fixed states": lambda: make_world(
        4, prior=default_prior(odometry_delay_s=0.1, range_bias_m=0.02, range_slope=0.0)
    ),
    "plain": lambda: make_world(5, prior=replace(default_prior(), free=np.zeros(11, dtype=bool))),
    "never seen": lambda: with_unknown_landmark(make_world(6)),
    "duplicates": lambda: with_duplicates(make_world(7)),
    "tied": lambda: elsewhere(tied(make_world(9, n_mapped=5))),
    "blind": lambda: blind(make_world(1, n_poses=40)),
    "own sigmas": lambda: with_own_sigmas(make_world(8, p_outlier=0.05)),
}


@pytest.fixture(scope="module", params=CASES)
def solved(request):
    """A world, its smoother and the optimum."""
    world = CASES[request.param]()
    start = world.near_truth(np.random.default_rng(0))
    smoother = Smoother(world.problem, world.noise)
    near = Smoother(world.problem, world.noise, heavy=True).optimum(start)
    return world, smoother, smoother.optimum(near, tolerance=1e-9)


@pytest.fixture(scope="module")
def dense(solved):
    world, _, optimum = solved
    posterior = DensePosterior(world.problem, world.noise, optimum)
    return posterior, *posterior.linearised()


def flat_step(a: Estimate, b: Estimate) -> np.ndarray:
    """From a to b, poses in their own frame; zero for unknown landmarks."""
    parts = se2.log(se2.between(a.pose, b.pose)), np.nan_to_num(b.landmark - a.landmark), b.states - a.states
    return np.concatenate([part.ravel() for part in parts])


def test_cost_and_weights_are_those_written_down_in_the_test(solved, dense):
    _, smoother, optimum = solved
    posterior, *_ = dense
    assert smoother.cost(optimum) == pytest.approx(posterior.cost(), rel=1e-9)
    assert smoother.inlier_probability(optimum) == pytest.approx(posterior.weights(optimum), abs=1e-9)


def test_nothing_is_left_to_step_at_the_optimum(solved, dense):
    _, _, optimum = solved
    _, covariance, step = dense
    sigma = np.sqrt(np.diag(covariance))
    assert np.abs(step / np.where(sigma > 0, sigma, 1.0)).max() < SMALL
    assert np.abs(step[: 3 * len(optimum.pose)]).max() < 1e-3


@pytest.mark.parametrize("name", ["free", "outliers", "map"])
def test_optimum_is_that_of_scipys_least_squares(name):
    world = CASES[name]()
    start = world.near_truth(np.random.default_rng(0))
    smoother = Smoother(world.problem, world.noise)
    found = smoother.optimum(Smoother(world.problem, world.noise, heavy=True).optimum(start))
    posterior = DensePosterior(world.problem, world.noise, found)
    step = flat_step(found, posterior.optimum())
    sigma = np.sqrt(np.diag(posterior.linearised()[0]))
    assert np.abs(step / np.where(sigma > 0, sigma, 1.0)).max() < SMALL
    assert np.abs(step[: 3 * len(found.pose)]).max() < 1e-3


def test_all_marginals_are_blocks_of_the_dense_inverse(solved, dense):
    _, smoother, optimum = solved
    _, covariance, _ = dense
    marginals = smoother.marginals(optimum)
    n, g = len(optimum.pose), 2 * len(optimum.landmark) + 11
    sigma = np.sqrt(np.diag(covariance))
    sigma[sigma == 0.0] = 1.0
    pose_rows, shared = np.arange(3 * n).reshape(n, 3), np.arange(3 * n, 3 * n + g)

    def compare(found, rows, columns):
        """As parts of the standard deviations."""
        assert found.shape == (len(rows), len(columns))
        gap = found - covariance[np.ix_(rows, columns)]
        assert np.abs(gap / np.outer(sigma[rows], sigma[columns])).max() < SMALL

    compare(marginals.shared, shared, shared)
    for i in range(n):
        compare(marginals.pose[i], pose_rows[i], pose_rows[i])
        compare(marginals.pose_shared[i], pose_rows[i], shared)
        if i < n - 1:
            compare(marginals.consecutive[i], pose_rows[i], pose_rows[i + 1])
    assert not marginals.consecutive[-1].any()
    # the views into them
    at = 3 * n + 2 * np.arange(len(optimum.landmark))
    for j, k in enumerate(at):
        compare(marginals.landmark[j], [k, k + 1], [k, k + 1])
    compare(marginals.states, shared[-11:], shared[-11:])
    known = np.append(np.repeat(optimum.known, 2), np.ones(11, dtype=bool))
    compare(marginals.with_states, np.append(np.arange(3 * n), shared[known]), shared[-11:])


def test_some_fronts_hold_no_sensor_where_nothing_is_seen():
    whole, some = (CASES[name]() for name in ("free", "blind"))
    held = [
        Smoother(world.problem, world.noise).graph(world.truth).structure.system.has_border_throughout
        for world in (whole, some)
    ]
    assert held == [True, False]


def test_fixed_states_stay():
    world = CASES["fixed states"]()
    prior = world.problem.prior
    found = Smoother(world.problem, world.noise).optimum(world.near_truth(np.random.default_rng(0)))
    assert found.states[~prior.free] == pytest.approx(prior.mean[~prior.free], abs=0.0)
    assert np.all(found.states[prior.free] != prior.mean[prior.free])


def test_exact_measurements_give_the_exact_truth():
    """Priors told the truth, no noise: the optimum is where everything came from."""
    states = np.array([0.05, 0.02, 0.1, -0.4, 0.03, 0.04, -0.03, 0.25, 0.95, 1.08, 0.03])
    prior = replace(default_prior(), mean=states)
    world = make_world(11, noisy=0.0, states=states, prior=prior)
    found = Smoother(world.problem, world.noise).optimum(world.near_truth(np.random.default_rng(3), by=0.05))
    assert found.pose == pytest.approx(world.truth.pose, abs=1e-7)
    assert found.landmark == pytest.approx(world.truth.landmark, abs=1e-7)
    assert found.states == pytest.approx(states, abs=1e-7)
    assert Smoother(world.problem, world.noise).cost(found) == pytest.approx(0.0, abs=1e-9)


def test_the_optimum_does_not_depend_on_where_it_starts():
    world = make_world(12)
    smoother = Smoother(world.problem, world.noise, robust=False)
    rng = np.random.default_rng(5)
    first, second = (smoother.optimum(world.near_truth(rng, by=0.15), tolerance=1e-9) for _ in range(2))
    assert np.abs(flat_step(first, second)).max() < 1e-6


def test_without_robustness_one_outlier_drags_the_map():
    world = make_world(13, p_outlier=0.08)
    start = world.near_truth(np.random.default_rng(0))
    error = {}
    for robust in (True, False):
        near = Smoother(world.problem, world.noise, heavy=True, robust=robust).optimum(start)
        found = Smoother(world.problem, world.noise, robust=robust).optimum(near)
        error[robust] = np.sqrt(((found.landmark - world.truth.landmark) ** 2).sum(axis=1).mean())
    assert error[False] > 2 * error[True]


def test_weights_find_the_outliers():
    world = make_world(14, n_poses=40, p_outlier=0.1)
    residual = DensePosterior(world.problem, world.noise, world.truth).detection_residuals(world.truth)
    wrong = (residual**2).sum(axis=1) > 100.0
    start = world.near_truth(np.random.default_rng(0))
    near = Smoother(world.problem, world.noise, heavy=True).optimum(start)
    smoother = Smoother(world.problem, world.noise)
    p = smoother.inlier_probability(smoother.optimum(near))
    assert wrong.sum() > 5
    assert np.all(p[wrong] < 0.5)
    assert np.mean(p[~wrong] > 0.5) > 0.99


def test_what_is_remembered_belongs_to_the_estimate_that_is_asked_about():
    """Also when the last trial was rejected, and for two estimates in turns."""
    world = make_world(4, n_poses=15)
    rng = np.random.default_rng(0)
    far = Estimate(
        world.truth.pose + 5.0 * rng.normal(size=world.truth.pose.shape),
        world.truth.landmark + 5.0 * rng.normal(size=world.truth.landmark.shape),
        world.truth.states,
    )
    smoother = Smoother(world.problem, world.noise, robust=False)
    found = [smoother.optimum(far, iterations=count) for count in range(1, 6)]
    rejected = [np.array_equal(a.pose, b.pose) for a, b in pairwise(found)]
    assert any(rejected)
    again = [smoother.optimum(far, iterations=count) for count in (3, 4)]
    for estimate in (again[1], found[0], again[0], found[0], far):
        fresh = Smoother(world.problem, world.noise, robust=False)
        assert smoother.cost(estimate) == fresh.cost(estimate)
        assert np.array_equal(smoother.marginals(estimate).pose, fresh.marginals(estimate).pose)
        assert np.array_equal(smoother.inlier_probability(estimate), fresh.inlier_probability(estimate))


def test_problems_that_fit_into_no_memory_are_refused(monkeypatch):
    world = make_world(15)
    monkeypatch.setattr(system, "MEMORY_LIMIT_GB", 1e-6)
    with pytest.raises(DataError, match="poses and landmarks tied by"):
        Smoother(world.problem, world.noise).cost(world.truth)
