"""The filter of a stream, beside iSAM2: a step from an optimum leads to the next optimum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from problems import QUIET, World, default_prior, make_world, mounted
from test_smoother import elsewhere, tied

from evermap.config import SlamConfig
from evermap.geometry import se2
from evermap.slam import streaming
from evermap.slam.batch import sight_at
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import beliefs, prepare
from evermap.slam.planar_filter import FrameReadings, PlanarFilter, PlanarMotion, SessionFilter
from evermap.slam.problem import Estimate
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import StreamingSlam
from evermap_studies.peers.isam import IncrementalSmoother
from evermap_studies.sim import WarehouseConfig, simulate_warehouse

KNOWN_SENSORS = CalibrationPrior.from_settings(calibrated=False)


class OneStep(SessionFilter):
    """The filter with the methods of its peer."""

    def add(self, row: int, motion: PlanarMotion, landmark: np.ndarray) -> None:
        self.drive(motion)
        super().add(row, landmark)

    def last_pose(self) -> np.ndarray:
        return self.pose

    def last_covariance(self) -> np.ndarray:
        return self.covariance[:3, :3]

    def landmark(self, row: int) -> np.ndarray:
        return self.position[row]

    def around(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        slots = self.bring(places)
        return self.covariance, self.position[self._row], slots


SOLVERS: dict[str, Callable[..., Any]] = {"filter": OneStep, "gtsam": IncrementalSmoother}


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
MOUNTED = mounted(default_prior(), 0.003)
"""So good, and so well mounted, that one linearisation is enough."""

WORLDS = {
    "free": lambda: make_world(1, noise=PRECISE, prior=MOUNTED),
    "map": lambda: elsewhere(make_world(3, noise=PRECISE, prior=MOUNTED, n_mapped=3, sigma_map_m=0.01)),
    "new landmark": lambda: without_landmark_until_the_end(make_world(4, noise=PRECISE, prior=MOUNTED), 1),
    "new landmark of the map": lambda: without_landmark_until_the_end(
        elsewhere(make_world(5, noise=PRECISE, prior=MOUNTED, n_mapped=3, sigma_map_m=0.01)), 1
    ),
    "new landmark of a group": lambda: without_landmark_until_the_end(
        elsewhere(tied(make_world(6, noise=PRECISE, prior=MOUNTED, n_mapped=5))), 2
    ),
}


def optimum_of(world: World, n_poses: int) -> Estimate:
    """By the batch smoother, of the first poses."""
    problem = world.problem.until(n_poses)
    seen = np.isin(np.arange(len(world.truth.landmark)), problem.landmark_row)
    start = world.near_truth(np.random.default_rng(0), by=0.01)
    start = Estimate(start.pose[:n_poses], np.where(seen[:, None], start.landmark, np.nan), start.states)
    return Smoother(problem, world.noise, robust=False).optimum(start, tolerance=1e-9)


def covariance_around(solver: Any, places: np.ndarray) -> np.ndarray:
    """Of newest pose, calibration states and these places, in order."""
    joint, place, column = solver.around(places)
    for j, at in zip(places, column, strict=True):
        assert place[at] == pytest.approx(solver.landmark(int(j)))
    rows = np.append(np.arange(14), (14 + 2 * column[:, None] + [0, 1]).ravel())
    return joint[np.ix_(rows, rows)]


@pytest.mark.parametrize("name", WORLDS)
def test_a_step_from_an_optimum_leads_to_the_next(solver_of, name):
    world = WORLDS[name]()
    problem = world.problem
    n = len(problem.stamp_s)
    before = optimum_of(world, n - 1)
    solver = solver_of(problem, world.noise, robust=False)
    solver.restart(before, world.noise, problem)
    motion = PlanarMotion.between(problem, world.noise, n - 1, before.states)
    predicted = se2.compose(before.pose[-1], motion.increment)
    last = problem.pose_row == n - 1
    landmark = before.landmark.copy()
    pointed_at = sight_at(predicted, problem.reading[last], before.states, problem.mount)
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
        [np.arange(len(marginals.shared) - 11, len(marginals.shared)), *([2 * j, 2 * j + 1] for j in known)]
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
    world = make_world(7, noise=PRECISE, prior=MOUNTED)
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
    motion = PlanarMotion.between(problem, world.noise, n - 1, before.states)
    predicted = se2.compose(before.pose[-1], motion.increment)
    place = sight_at(predicted, problem.reading[last][0], before.states, problem.mount)
    solver.add(n - 1, motion, np.vstack([before.landmark, place]))
    estimate = solver.estimate()
    assert estimate.known.tolist() == [True] * (count + 1)
    assert estimate.landmark[count] == pytest.approx(place, abs=0.2)
    assert np.linalg.norm(estimate.landmark[0] - before.landmark[0]) < 0.05


def test_a_wrong_identity_moves_next_to_nothing(solver_of):
    world = make_world(8)
    problem, n = world.problem, len(world.problem.stamp_s)
    before = optimum_of(world, n - 1)
    motion = PlanarMotion.between(problem, world.noise, n - 1, before.states)
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
        monkeypatch.setattr(streaming, "SessionFilter", partial(SessionFilter, most=room))
        slam = StreamingSlam(prepared.problem, noise, prior)
        most[room] = 0
        for _ in prepared.problem.stamp_s:
            slam.step()
            most[room] = max(most[room], len(slam._filter.active))
        online[room], spread[room] = slam.online_pose, slam.online_covariance
    assert most[24] <= 24
    assert most[96] > 50
    sigma = np.sqrt(np.einsum("nii->ni", spread[96]))
    apart = np.abs(se2.local(online[96], online[24])) / sigma
    assert np.quantile(apart, 0.99) < 0.5
    assert np.sqrt(np.einsum("nii->ni", spread[24])) / sigma == pytest.approx(1.0, abs=0.2)


def test_work_that_waits_changes_only_the_poses_that_were_told_before_it():
    """A frame may leave its share of a relinearisation to the time until the next one: slice after slice, or none."""
    recording = simulate_warehouse(WarehouseConfig(60, forward_scale=1.02, turn_scale=0.98, bearing_bias_rad=0.01))
    prior, noise = beliefs(recording.sensor, SlamConfig())
    at_once, waiting = (StreamingSlam(prepare(recording).problem, noise, prior) for _ in range(2))
    told_earlier = 0
    for row in range(len(at_once.online_pose)):
        at_once.step()
        waiting.step(later=True)
        told_earlier += not np.array_equal(waiting.online_pose[row], at_once.online_pose[row])
        for _ in range(row % 4):
            waiting.work(1e-3)
        if row % 2:
            waiting.work()
            np.testing.assert_array_equal(waiting.states, at_once.states)
    assert 0 < told_earlier < 0.1 * row
    mine, theirs = waiting.finish(), at_once.finish()
    np.testing.assert_array_equal(mine.estimate.pose, theirs.estimate.pose)
    np.testing.assert_array_equal(mine.estimate.landmark, theirs.estimate.landmark)


def test_the_filter_is_the_smoother_where_all_is_nearly_linear():
    """From the first frame on, places met by their detections alone."""
    made = make_world(0, n_poses=6, n_landmarks=3, noisy=0.02, prior=KNOWN_SENSORS, p_seen=1.0)
    problem = made.problem
    local = PlanarFilter(problem.mount, problem.prior)
    start = local.covariance.copy()
    start[:3, :3] = np.eye(3) / problem.start_information
    local.hold(problem.start_pose, problem.prior.mean, start, np.arange(0), np.zeros((0, 2)))
    for row in range(len(problem.stamp_s)):
        if row > 0:
            local.drive(PlanarMotion.between(problem, made.noise, row, local.states))
        for m in np.flatnonzero(problem.pose_row == row):
            j, sigma = problem.landmark_row[m : m + 1], made.noise.of_detections(problem.sigma_given[m : m + 1])
            local.know_of(3)
            if np.isnan(local.position[j[0], 0]):
                local.meet(int(j[0]), sight_at(local.pose, problem.reading[m], local.states, problem.mount))
            local.update(j, FrameReadings(problem.reading[m : m + 1], sigma))
    smoother = Smoother(problem, made.noise, robust=False)
    estimate = smoother.optimum(Estimate(made.truth.pose, made.truth.landmark, problem.prior.mean))
    batch = PlanarFilter(problem.mount, problem.prior)
    batch.begin(estimate, smoother.marginals(estimate), len(problem.stamp_s) - 1, np.arange(3))
    np.testing.assert_allclose(local.position, batch.position, atol=2e-4)
    np.testing.assert_allclose(local.pose, batch.pose, atol=2e-4)
    slots = local.bring(np.arange(3))
    own, other = np.append(np.arange(3), local.columns(slots)), np.append(np.arange(3), local.columns(np.arange(3)))
    np.testing.assert_allclose(
        local.covariance[np.ix_(own, own)], batch.covariance[np.ix_(other, other)], rtol=0.05, atol=2e-5
    )


def test_places_that_are_only_considered_stay_and_the_rest_gets_the_best_gain():
    """Schmidt's update written down densely, where weights are 1 and the frame is nearly linear."""
    rng = np.random.default_rng(3)
    mount, n = np.array([0.2, -0.1, 0.3]), 4
    prior = CalibrationPrior.from_settings(calibrated=True)
    place = rng.uniform(2.0, 5.0, (n, 2))
    spread = rng.normal(size=(14 + 2 * n, 14 + 2 * n))
    spread = 1e-6 * (spread @ spread.T + np.eye(14 + 2 * n))
    sigma = np.full((n, 2), 2e-3)
    states, pose = prior.mean, np.array([0.3, 0.1, 0.5])
    held = {}
    for considered in (True, False):
        local = PlanarFilter(mount, prior, considered=considered)
        local.hold(pose, states, spread, np.arange(n), place.copy())
        true_pose = se2.compose(pose, np.array([1e-3, -1e-3, 5e-4]))
        away = se2.transform(se2.inverse(se2.compose(true_pose, mount)), place)
        reading = np.column_stack([np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])])
        nis, _, frame = local.compare(np.arange(n), FrameReadings(reading, sigma))
        residual, by = sigma * frame.residual, sigma[..., None] * frame.jacobian
        h = np.zeros((2 * n, 14 + 2 * n))
        for m in range(n):
            h[2 * m : 2 * m + 2, :10], h[2 * m : 2 * m + 2, 14 + 2 * m : 16 + 2 * m] = by[m, :, :10], by[m, :, 10:]
        s = h @ spread @ h.T + np.diag(sigma.ravel() ** 2)
        for m in range(n):
            mine = slice(2 * m, 2 * m + 2)
            assert nis[m] == pytest.approx(residual[m] @ np.linalg.solve(s[mine, mine], residual[m]))
        gain = np.linalg.solve(s, h @ spread).T
        if considered:
            gain[14:] = 0.0
        expected = spread - gain @ h @ spread - (gain @ h @ spread).T + gain @ s @ gain.T
        moved = -gain @ residual.ravel()
        local.update(np.arange(n), FrameReadings(reading, sigma))
        size = np.sqrt(np.diag(expected))
        scale = np.outer(size, size)
        assert np.abs((local.covariance[: len(scale), : len(scale)] - expected) / scale).max() < 5e-3
        np.testing.assert_allclose(se2.log(se2.between(pose, local.pose)), moved[:3], atol=2e-5)
        np.testing.assert_allclose(local.position - place, moved[14:].reshape(-1, 2), atol=2e-5)
        held[considered] = local.position
    np.testing.assert_array_equal(held[True], place)
    assert np.abs(held[False] - place).max() > 1e-5
