"""Robots that drive together: against a dense solver of the same cost, and on drives drawn from their model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from dense import DensePosterior
from drives import NOISE, driven, nees, seen_from
from problems import QUIET, World, default_prior, make_world, slow_detection
from recordings import with_ids

from evermap.align.acceptance import SIGMA_M, Acceptance, accept_alignment
from evermap.align.candidates import Matches
from evermap.config import Config, LocalizeConfig, SlamConfig
from evermap.errors import ConfigError, DataError
from evermap.geometry import se2
from evermap.metrics.trajectory import interpolate
from evermap.pipeline import run_slam, run_together
from evermap.slam import together
from evermap.slam.encounters import Encounters, PlanarTogether
from evermap.slam.problem import Estimate
from evermap.slam.smoother import Smoother
from evermap.types import UNKNOWN, Detections, Frames, Odometry, Recording, RobotSightings, SlamResult, Trajectory

SMALL = 1e-4
"""Parts of a standard deviation."""


class Three:
    """Three small worlds laid into one: what stands where is another's, too; some robots see some others."""

    def __init__(self, seed: int, *, wrong: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        motion = np.array([[0.0, 0.0, 0.0], [2.0, -1.0, 1.1], [-3.0, 4.0, -2.5]])
        worlds = [make_world(seed + r, n_poses=6 + r, n_landmarks=4, p_seen=0.9) for r in range(3)]
        # two of the first robot's landmarks are the second one's, and another is the third one's
        self.places, self.landmark = [np.arange(4), np.array([4, 5, 0, 1]), np.array([6, 2, 7, 8])], np.zeros((9, 2))
        for by, world, places in reversed(list(zip(motion, worlds, self.places, strict=True))):
            self.landmark[places] = se2.transform(by, world.truth.landmark)
        self.worlds = [
            self._laid(rng, world, by, self.landmark[places])
            for world, by, places in zip(worlds, motion, self.places, strict=True)
        ]
        first = np.cumsum([0, 6, 7, 8])
        pairs = np.array([[0, 1], [1, 0], [2, 0], [0, 2], [1, 2], [0, 1]])
        row = np.array([[first[a] + rng.integers(6), first[b] + rng.integers(6)] for a, b in pairs])
        pose = np.concatenate([world.truth.pose for world in self.worlds])
        reading = np.array(
            [
                slow_detection(pose[a], pose[b, :2], self.worlds[r].truth.states, self.worlds[r].problem.mount)
                for (a, b), r in zip(row, pairs[:, 0], strict=True)
            ]
        )
        reading += QUIET.detection * rng.normal(size=reading.shape)
        reading[rng.random(len(reading)) < wrong, 0] += 2.0
        self.met = Encounters(row[:, 0], row[:, 1], pairs[:, 0], reading)
        self.sigma = np.array([[0.05, 0.02], [0.06, 0.03], [0.07, 0.02]])

    def _laid(self, rng: np.random.Generator, world: World, by: np.ndarray, landmark: np.ndarray) -> World:
        """The same drive elsewhere, among other landmarks; only the first robot's first pose is held."""
        problem, truth = world.problem, world.truth
        pose, held = se2.compose(by, truth.pose), 1e-2 if by.any() else problem.start_information
        reading = slow_detection(pose[problem.pose_row], landmark[problem.landmark_row], truth.states, problem.mount)
        reading += QUIET.detection * rng.normal(size=reading.shape)
        problem = replace(problem, start_pose=by, start_information=held, reading=reading)
        return World(problem, world.noise, Estimate(pose, landmark, truth.states))

    def joint(self) -> PlanarTogether:
        smoothers = [Smoother(world.problem, world.noise) for world in self.worlds]
        return PlanarTogether(smoothers, self.places, np.zeros(3), self.met, self.sigma)

    def start(self) -> Estimate:
        pose = np.concatenate([world.truth.pose for world in self.worlds])
        return Estimate(pose, self.landmark, np.concatenate([default_prior().mean] * 3))


class DenseTogether:
    """The residuals of all robots and their encounters as one function of a step away from `around`."""

    def __init__(self, three: Three, around: Estimate) -> None:
        self.three, self.around = three, around
        self.parts = [
            DensePosterior(world.problem, world.noise, own)
            for world, own in zip(three.worlds, three.joint().estimates(around), strict=True)
        ]

    def at(self, step: np.ndarray) -> Estimate:
        n, p = len(self.around.pose), len(self.around.landmark)
        pose = se2.compose(self.around.pose, se2.exp(step[: 3 * n].reshape(-1, 3)))
        landmark = self.around.landmark + step[3 * n : 3 * n + 2 * p].reshape(-1, 2)
        return Estimate(pose, landmark, self.around.states + step[3 * n + 2 * p :])

    def encounters(self, estimate: Estimate) -> np.ndarray:
        """(S, 2) over sigma."""
        seen, states = self.three.met, estimate.states.reshape(-1, 11)
        e = np.array(
            [
                z
                - slow_detection(estimate.pose[a], estimate.pose[b, :2], states[r], self.three.worlds[r].problem.mount)
                for a, b, r, z in zip(*seen, strict=True)
            ]
        )
        e[:, 1] = se2.wrap(e[:, 1])
        return e / self.three.sigma[seen.robot]

    def residuals(self, step: np.ndarray, weights: list[np.ndarray] | None = None) -> np.ndarray:
        """Half the sum of squares is the cost; with `weights`, those of inliers are frozen."""
        moved, out = self.at(step), []
        kinds = []
        for part, own in zip(self.parts, self.three.joint().estimates(moved), strict=True):
            kinds.append((part.detection_residuals(own), part.log_odds))
            out += [part.odometry_residuals(own).ravel(), part.prior_residuals(own)]
        kinds.append((self.encounters(moved), QUIET.outlier_log_odds))
        for k, (e, log_odds) in enumerate(kinds):
            squared = (e**2).sum(axis=1)
            loss = squared / 2 - np.logaddexp(0.0, squared / 2 - log_odds) + np.logaddexp(0.0, -log_odds)
            factor = np.sqrt(2 * loss / np.maximum(squared, 1e-300)) if weights is None else np.sqrt(weights[k])
            out.append((e * factor[:, None]).ravel())
        return np.concatenate(out)

    def linearised(self) -> tuple[np.ndarray, np.ndarray]:
        """Inverse of `J' W J` at `around`, and the Gauss-Newton step that is left there; J by central differences."""
        weights = [
            part.weights(own) for part, own in zip(self.parts, self.three.joint().estimates(self.around), strict=True)
        ]
        squared = (self.encounters(self.around) ** 2).sum(axis=1)
        weights.append(np.exp(-np.logaddexp(0.0, squared / 2 - QUIET.outlier_log_odds)))
        size, h = 3 * len(self.around.pose) + 2 * len(self.around.landmark) + len(self.around.states), 1e-6
        columns = [(self.residuals(h * d, weights) - self.residuals(-h * d, weights)) / (2 * h) for d in np.eye(size)]
        jacobian = np.stack(columns, axis=1)
        covariance = np.linalg.inv(jacobian.T @ jacobian)
        return covariance, -covariance @ jacobian.T @ self.residuals(np.zeros(size), weights)


@pytest.mark.parametrize(("seed", "wrong"), [(6, 0.0), (15, 0.4)])
def test_optimum_and_covariances_are_those_of_a_dense_solver(seed: int, wrong: float) -> None:
    three = Three(seed, wrong=wrong)
    joint = three.joint()
    near = joint.of([one.under(QUIET, heavy=True) for one in joint.robots], three.sigma).optimum(three.start())
    estimate = joint.optimum(near, iterations=100, tolerance=1e-9)
    marginals = joint.marginals(estimate)
    dense = DenseTogether(three, estimate)
    nowhere = np.zeros(3 * len(estimate.pose) + 2 * 9 + 33)
    assert joint.cost(estimate) == pytest.approx(0.5 * np.sum(dense.residuals(nowhere) ** 2), rel=1e-6)
    covariance, left = dense.linearised()
    assert np.abs(left / np.sqrt(np.diag(covariance))).max() < SMALL
    n = len(estimate.pose)
    for r, own in enumerate(joint.parts(estimate, marginals)):
        rows = np.arange(joint.first[r], joint.first[r + 1])
        places = 3 * n + 2 * three.places[r]
        states = 3 * n + 18 + 11 * r + np.arange(11)
        for k, row in enumerate(rows):
            block = covariance[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]
            np.testing.assert_allclose(own.pose[k], block, atol=1e-3 * np.abs(block).max())
        after = covariance[3 * rows[0] : 3 * rows[0] + 3, 3 * rows[1] : 3 * rows[1] + 3]
        np.testing.assert_allclose(own.consecutive[0], after, atol=1e-3 * np.abs(after).max() + 1e-12)
        for k, at in enumerate(places):
            block = covariance[at : at + 2, at : at + 2]
            np.testing.assert_allclose(own.landmark[k], block, atol=1e-3 * np.abs(block).max())
        block = covariance[np.ix_(states, states)]
        np.testing.assert_allclose(own.states, block, atol=1e-3 * np.abs(block).max())
        mine = np.concatenate(
            [(3 * rows[:, None] + np.arange(3)).ravel(), (places[:, None] + np.arange(2)).ravel(), states]
        )
        cross = covariance[np.ix_(mine, states)]
        np.testing.assert_allclose(own.with_states, cross, atol=1e-3 * np.abs(cross).max())
        some = np.concatenate([3 * rows[1] + np.arange(3), places[2] + np.arange(2), states])
        asked = own.joint(np.array([2]), poses=np.array([1]), states=True)
        np.testing.assert_allclose(asked, covariance[np.ix_(some, some)], atol=1e-3 * np.abs(block).max())


def drives_together(
    seed: int, *, wrong: float = 0.0, n_robots: int = 3, moves_m: tuple[float, float] = (0.0, 0.0)
) -> list[Recording]:
    """Robots among few landmarks, which they see from near; they see each other from farther away.

    All but the first have a third of the frames, so that others see them between two. A share of the encounters is
    `wrong`: another robot's name. Halfway, the first landmark may move.
    """
    rng = np.random.default_rng(seed)
    landmark = rng.uniform(-4.0, 4.0, (6, 2))
    worlds = []
    for _ in range(n_robots):
        start = np.append(rng.uniform(-4.0, 4.0, 2), rng.uniform(-np.pi, np.pi))
        worlds.append(driven(rng, landmark, n_frames=600, start=start))
    recordings, after = [], landmark + np.outer(np.arange(6) == 0, moves_m)
    for r, world in enumerate(worlds):
        met, others = [], np.delete(np.arange(n_robots), r)
        for other in others:
            at = se2.transform(se2.inverse(world.pose), worlds[other].pose[:, None, :2])[:, 0]
            reading = slow_detection(world.pose, worlds[other].pose[:, :2], world.states, np.zeros(3))
            near = np.flatnonzero(
                (np.hypot(*at.T) < 6.0) & (np.hypot(*at.T) > 0.3) & (at[:, 0] > 0.0) & (rng.random(600) < 0.1)
            )
            met.append(np.column_stack([world.stamp_s[near], np.full(len(near), other + 1), reading[near]]))
        met = np.concatenate(met)
        met = met[np.argsort(met[:, 0], kind="stable")]
        met[:, 2:] += NOISE.detection * rng.normal(size=(len(met), 2))
        lied = rng.random(len(met)) < wrong
        met[lied, 1] = 1 + rng.choice(others, np.count_nonzero(lied))
        rows = np.arange(0, 600, 3 if r else 1)
        frames = [world.sightings[row] for row in rows]
        if any(moves_m):
            frames = [
                seen_from(rng, world.pose[row], after, world.states) if row >= 300 else frame
                for row, frame in zip(rows, frames, strict=True)
            ]
        near = [frame.reading[:, 0] < 2.5 for frame in frames]
        count = [int(some.sum()) for some in near]
        nothing = np.full(sum(count), np.nan)
        reading = np.concatenate([frame.reading[some] for frame, some in zip(frames, near, strict=True)])
        detections = Detections(
            frame=np.repeat(np.arange(len(rows)), count),
            landmark_id=np.concatenate([frame.landmark_id[some] for frame, some in zip(frames, near, strict=True)]),
            range_m=reading[:, 0],
            bearing_rad=se2.wrap(reading[:, 1]),
            class_id=np.full(sum(count), UNKNOWN),
            sigma_range_m=nothing,
            sigma_bearing_rad=nothing,
            source_line=np.zeros(sum(count), dtype=np.int64),
        )
        velocity = world.drive.velocity
        recordings.append(
            Recording(
                name=f"robot {r + 1}",
                odometry=Odometry(world.drive.stamp_s, *velocity[:, :3].T),
                frames=Frames(world.stamp_s[rows], complete=False),
                detections=detections,
                truth=Trajectory(world.stamp_s, world.pose, np.zeros((600, 3, 3)), "truth"),
                robot_sightings=RobotSightings(met[:, 0], met[:, 1].astype(int), met[:, 2], se2.wrap(met[:, 3])),
            )
        )
    return recordings


def scored(recordings: list[Recording], results: list[SlamResult], first: int | None) -> np.ndarray:
    """(R, 3) position [m] and heading [rad] error, RMSE, and mean NEES of the position.

    In the frame of the pose that is held: that of the `first` robot, or each in its own.
    """
    rows = []
    for r, (recording, result) in enumerate(zip(recordings, results, strict=True)):
        held, truth = results[r if first is None else first].trajectory, recordings[r if first is None else first].truth
        at = np.argmin(np.trace(held.covariance, axis1=1, axis2=2))
        true = interpolate(truth, held.stamp_s[at : at + 1])[0][0]
        frame = se2.compose(true, se2.inverse(held.pose_world_robot[at]))
        path = result.trajectory
        away = np.abs(path.stamp_s - held.stamp_s[at]) > 5.0  # there it is held to 0.1 mm
        true = interpolate(recording.truth, path.stamp_s[away])[0]
        error = se2.log(se2.between(se2.compose(frame, path.pose_world_robot[away]), true))
        position = np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))
        told = nees(error[:, :2], path.covariance[away][:, :2, :2]).mean()
        rows.append([position, np.sqrt(np.mean(error[:, 2] ** 2)), told])
    return np.array(rows)


@pytest.mark.slow
def test_robots_that_see_each_other_are_surer_and_right() -> None:
    """Also where every fifth names another robot; errors are as large as they say."""
    alone, shared, met = [], [], []
    for seed in (1, 4, 10):
        recordings = drives_together(seed, wrong=0.2 if seed == 10 else 0.0)
        blind = {number: replace(one, robot_sightings=None) for number, one in enumerate(recordings, start=1)}
        alone.append(scored(recordings, [run_slam(recording) for recording in recordings], None))
        shared.append(scored(recordings, list(run_together(blind).values()), 0))
        met.append(scored(recordings, list(run_together(dict(enumerate(recordings, start=1))).values()), 0))
    alone, shared, met = (np.concatenate(part) for part in (alone, shared, met))
    assert np.all(met[:, :2].mean(axis=0) < 0.85 * shared[:, :2].mean(axis=0))
    assert np.all(met[:, :2].mean(axis=0) < 0.7 * alone[:, :2].mean(axis=0))
    assert 0.5 < met[:, 2].mean() < 4.0


def test_results_are_in_one_frame() -> None:
    """Landmarks of all lie where those of the first do, what was known online lies beside what was smoothed."""
    results = run_together(dict(enumerate(drives_together(2), start=1)), Config(slam=SlamConfig(online=True)))
    first = results[1].landmarks
    assert list(results) == [1, 2, 3]
    for result in results.values():
        _, mine, theirs = np.intersect1d(result.landmarks.landmark_id, first.landmark_id, return_indices=True)
        assert len(mine) > 3
        np.testing.assert_allclose(result.landmarks.position_m[mine], first.position_m[theirs], atol=1e-9)
        smooth = interpolate(result.trajectory, result.online.stamp_s)[0]
        late = len(smooth) // 2
        gap = np.linalg.norm(result.online.pose_world_robot[late:, :2] - smooth[late:, :2], axis=1)
        assert np.median(gap) < 1.0


def test_nothing_ties_robots() -> None:
    """Landmarks with other names, and no sightings; sightings alone tie them."""
    recordings = [replace(one, robot_sightings=None) for one in drives_together(2, n_robots=2)]
    strange = with_ids(recordings[1], lambda ids: ids + 100)
    with pytest.raises(DataError, match="nothing connects robot 2 to robot 1"):
        run_together({1: recordings[0], 2: strange})
    met = drives_together(2, n_robots=2)
    results = run_together({1: met[0], 2: with_ids(met[1], lambda ids: ids + 100)})
    assert scored(met, list(results.values()), 0)[:, 0].max() < 0.3


def test_robots_are_laid_together_by_their_own_covariances(monkeypatch) -> None:
    """The differences of common landmarks are as large as these say, beyond what an alignment allows in any case."""
    asked = []

    def accepting(matches: Matches, rules: LocalizeConfig, **given: np.ndarray) -> Acceptance:
        asked.append((matches, given, accept_alignment(matches, rules, **given)))
        return asked[-1][-1]

    monkeypatch.setattr(together, "accept_alignment", accepting)
    run_together({k: replace(one, robot_sightings=None) for k, one in enumerate(drives_together(2, n_robots=2), 1)})
    matches, given, found = asked[0]
    count, (source, target) = len(matches), matches.points
    assert count > 5
    assert found.agree.all()
    turn, at = np.kron(np.eye(count), se2.rotation(found.motion[2])), se2.transform(found.motion, source)
    spread = given["covariance_m2"] - SIGMA_M**2 * np.eye(2 * count) + turn @ given["source_m2"] @ turn.T
    white = np.linalg.inv(np.linalg.cholesky(spread))
    freedom, error = white @ se2.rigid_directions(at - at.mean(axis=0)), white @ (at - target).ravel()
    off = error - freedom @ np.linalg.lstsq(freedom, error)[0]
    assert 0.3 < float(off @ off) / (2 * count - 3) < 3.0


def test_a_landmark_that_moves_is_each_robots_own() -> None:
    """Its displacement is told in the frame of all."""
    recordings = drives_together(11, moves_m=(1.5, -1.0))
    results = run_together(dict(enumerate(recordings, start=1)))
    assert scored(recordings, list(results.values()), 0)[:, 0].max() < 0.4
    start = recordings[0].truth.pose_world_robot[0]
    expected = se2.rotation(-start[2]) @ [1.5, -1.0]
    seen = [change for result in results.values() for change in result.changes if change.landmark_ids == (0,)]
    assert seen
    for change in seen:
        np.testing.assert_allclose(change.displacement_m, expected, atol=0.3)


def test_identities_are_needed() -> None:
    recordings = dict(enumerate(drives_together(2, n_robots=2), start=1))
    with pytest.raises(ConfigError, match="known by their ids"):
        run_together(recordings, Config(slam={"unknown_ids": True}))


def test_sightings_of_strangers_are_told() -> None:
    recordings = drives_together(2, n_robots=2)
    seen = recordings[0].robot_sightings
    recordings[0] = replace(recordings[0], robot_sightings=replace(seen, robot_id=np.full(len(seen), 7)))
    results = run_together(dict(enumerate(recordings, start=1)))
    assert any(f"{len(seen)} sightings of robots not used" in warning for warning in results[1].warnings)
