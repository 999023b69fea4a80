"""The incremental solvers by one protocol: a step from an optimum leads to the next optimum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from problems import QUIET, World, make_world
from test_smoother import elsewhere, tied

from evermap.config import SlamConfig
from evermap.geometry import se2
from evermap.slam import local_filter
from evermap.slam.intake import beliefs, prepare
from evermap.slam.local_filter import LocalFilter
from evermap.slam.problem import Estimate
from evermap.slam.smoother import Smoother
from evermap.slam.solver import IncrementalSolver, Motion
from evermap.slam.streaming import StreamingSlam, sighted_at
from evermap_studies.peers.isam import IncrementalSmoother
from evermap_studies.sim import WarehouseConfig, simulate_warehouse

SOLVERS: dict[str, Callable[..., IncrementalSolver]] = {"arrow": LocalFilter, "gtsam": IncrementalSmoother}


@pytest.fixture(params=SOLVERS)
def solver_of(request) -> Callable[..., Any]:
    return SOLVERS[request.param]


def without_landmark_until_the_end(world: World, row: int) -> World:
    """The landmark is seen by the last pose only."""
    problem = world.problem
    keep = (problem.landmark_row != row) | (problem.pose_row == len(problem.stamp_s) - 1)
    problem = replace(
        problem,
        pose_row=problem.pose_row[keep],
        landmark_row=problem.landmark_row[keep],
        reading=problem.reading[keep],
        sigma_given=problem.sigma_given[keep],
    )
    return World(problem, world.noise, world.truth)


PRECISE = replace(QUIET, detection=QUIET.detection / 30, odometry=QUIET.odometry / 30)
"""So good that one linearisation is enough."""

WORLDS = {
    "free": lambda: make_world(1, noise=PRECISE),
    "map": lambda: elsewhere(make_world(3, noise=PRECISE, n_mapped=3, sigma_map_m=0.01)),
    "new landmark": lambda: without_landmark_until_the_end(make_world(4, noise=PRECISE), 1),
    "new landmark of the map": lambda: without_landmark_until_the_end(
        elsewhere(make_world(5, noise=PRECISE, n_mapped=3, sigma_map_m=0.01)), 1
    ),
    "new landmark of a group": lambda: without_landmark_until_the_end(
        elsewhere(tied(make_world(6, noise=PRECISE, n_mapped=5))), 2
    ),
}


def optimum_of(world: World, n_poses: int) -> Estimate:
    """By the batch smoother, of the first poses."""
    problem = world.problem.until(n_poses)
    seen = np.isin(np.arange(len(world.truth.landmark)), problem.landmark_row)
    start = world.near_truth(np.random.default_rng(0), by=0.01)
    start = Estimate(start.pose[:n_poses], np.where(seen[:, None], start.landmark, np.nan), start.states)
    return Smoother(problem, world.noise, robust=False).optimum(start, tolerance=1e-9)


def covariance_around(solver: IncrementalSolver, places: np.ndarray) -> np.ndarray:
    """Of newest pose, calibration states and these places, in order."""
    joint, place, column = solver.around(places)
    for j, at in zip(places, column, strict=True):
        assert place[at] == pytest.approx(solver.landmark(int(j)))
    rows = np.append(np.arange(12), (12 + 2 * column[:, None] + [0, 1]).ravel())
    return joint[np.ix_(rows, rows)]


@pytest.mark.parametrize("name", WORLDS)
def test_a_step_from_an_optimum_leads_to_the_next(solver_of, name):
    world = WORLDS[name]()
    problem = world.problem
    n = len(problem.stamp_s)
    before = optimum_of(world, n - 1)
    solver = solver_of(problem, world.noise, robust=False)
    solver.restart(before, world.noise, problem)
    motion = Motion.between(problem, world.noise, n - 1, before.states)
    predicted = se2.compose(before.pose[-1], motion.increment)
    last = problem.pose_row == n - 1
    landmark = before.landmark.copy()
    pointed_at = sighted_at(predicted, problem.reading[last], before.states, problem.mount)
    new = np.isnan(landmark[problem.landmark_row[last], 0])
    landmark[problem.landmark_row[last][new]] = pointed_at[new]
    solver.add(n - 1, motion, landmark)

    start = Estimate(np.vstack([before.pose, predicted]), landmark, before.states)
    smoother = Smoother(problem, world.noise, robust=False)
    after = smoother.optimum(start, tolerance=1e-9)
    marginals = smoother.marginals(after)
    found = solver.estimate()
    assert np.array_equal(found.known, after.known)
    known = np.flatnonzero(after.known)
    sigma = np.sqrt(np.diag(marginals.pose[-1]))
    assert np.abs(se2.log(se2.between(after.pose[-1], solver.last_pose())) / sigma).max() < 0.1
    assert np.abs((found.states - after.states) / np.sqrt(np.diag(marginals.states))).max() < 0.1
    spread = np.sqrt(np.einsum("lii->li", marginals.landmark))
    assert np.abs((found.landmark - after.landmark)[known] / spread[known]).max() < 0.1
    rows = np.concatenate(
        [np.arange(len(marginals.shared) - 9, len(marginals.shared)), *([2 * j, 2 * j + 1] for j in known)]
    )
    expected = np.block(
        [
            [marginals.pose[-1], marginals.pose_shared[-1][:, rows]],
            [marginals.pose_shared[-1][:, rows].T, marginals.shared[np.ix_(rows, rows)]],
        ]
    )
    sigma = np.sqrt(np.diag(expected))
    joint = covariance_around(solver, known)
    assert np.abs((joint - expected) / np.outer(sigma, sigma)).max() < 0.1
    assert joint[:3, :3] == pytest.approx(solver.last_covariance())
    for j in known:
        assert solver.landmark(int(j)) == pytest.approx(found.landmark[j])


def test_detections_may_be_given_to_a_new_place_between_two_steps(solver_of):
    """Only those to come: what was added stays with the old place."""
    world = make_world(7, noise=PRECISE)
    problem, n = world.problem, len(world.problem.stamp_s)
    before = optimum_of(world, n - 1)
    solver = solver_of(problem, world.noise)
    solver.restart(before, world.noise, problem)
    count = len(problem.landmark_mean)
    last = (problem.pose_row == n - 1) & (problem.landmark_row == 0)
    assert last.sum() == 1
    joint = np.zeros((2 * count + 2, 2 * count + 2))
    joint[:-2, :-2] = problem.landmark_information.toarray()
    solver.problem = replace(
        problem,
        landmark_row=np.where(last, count, problem.landmark_row),
        landmark_mean=np.vstack([problem.landmark_mean, np.zeros(2)]),
        landmark_information=joint,
    )
    motion = Motion.between(problem, world.noise, n - 1, before.states)
    predicted = se2.compose(before.pose[-1], motion.increment)
    place = sighted_at(predicted, problem.reading[last][0], before.states, problem.mount)
    solver.add(n - 1, motion, np.vstack([before.landmark, place]))
    estimate = solver.estimate()
    assert estimate.known.tolist() == [True] * (count + 1)
    assert estimate.landmark[count] == pytest.approx(place, abs=0.2)
    assert np.linalg.norm(estimate.landmark[0] - before.landmark[0]) < 0.05


def test_a_wrong_identity_moves_next_to_nothing(solver_of):
    world = make_world(8)
    problem, n = world.problem, len(world.problem.stamp_s)
    before = optimum_of(world, n - 1)
    motion = Motion.between(problem, world.noise, n - 1, before.states)
    reading = problem.reading.copy()
    reading[np.flatnonzero(problem.pose_row == n - 1)[0]] += [3.0, 1.0]
    wrong = replace(problem, reading=reading)
    moved = {}
    for robust in (True, False):
        ends = []
        for given in (problem, wrong):
            solver = solver_of(given, world.noise, robust=robust)
            solver.restart(before, world.noise, given)
            solver.add(n - 1, motion, before.landmark)
            ends.append(solver.last_pose())
        moved[robust] = np.linalg.norm(se2.between(*ends))
    assert moved[True] < 0.05
    assert moved[False] > 5 * moved[True]


def test_far_places_wait_and_come_back_where_their_neighbours_are(monkeypatch):
    """Along aisles that are seen again from the next one, room for few places is as good as room for all."""
    recording = simulate_warehouse(WarehouseConfig(60, forward_scale=1.02, turn_scale=0.98, bearing_bias_rad=0.01))
    prior, noise = beliefs(recording.sensor, SlamConfig())
    prepared = prepare(recording)
    online, spread, most = {}, {}, {}
    for room in (96, 24):
        monkeypatch.setattr(local_filter, "MOST_ACTIVE", room)
        monkeypatch.setattr(local_filter, "LEAVING", 6)
        slam = StreamingSlam(prepared.problem, noise, prior)
        most[room] = 0
        for _ in prepared.problem.stamp_s:
            slam.step()
            most[room] = max(most[room], len(slam._solver._active))
        online[room], spread[room] = slam.online_pose, slam.online_covariance
    assert most[24] <= 24
    assert most[96] > 50
    sigma = np.sqrt(np.einsum("nii->ni", spread[96]))
    apart = np.abs(se2.local(online[96], online[24])) / sigma
    assert np.quantile(apart, 0.99) < 0.5
    assert np.sqrt(np.einsum("nii->ni", spread[24])) / sigma == pytest.approx(1.0, abs=0.2)
