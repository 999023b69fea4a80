"""Who is who by particles: their evidence is that of the joint Gaussian, and wrong matches die out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identity_scores import identity_scores
from problems import World, make_world
from scipy.stats import multivariate_normal

from evermap.config import Config
from evermap.geometry import se2
from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.features import Traits
from evermap.slam.association.identify import search_assignment
from evermap.slam.association.in_plane import PlanarAssociator
from evermap.slam.association.particles import drawn
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.linearise import detection_residuals

KNOWN_SENSORS = CalibrationPrior.from_settings(calibrated=False)


def world(seed: int) -> World:
    return make_world(seed, n_poses=60, n_landmarks=8, prior=KNOWN_SENSORS)


def finished(seed: int) -> tuple[PlanarAssociator, Assignment]:
    made = world(seed)
    hidden = replace(made.problem, landmark_row=np.full_like(made.problem.landmark_row, -99))
    associator = PlanarAssociator(hidden, made.noise)
    for _ in hidden.stamp_s:
        associator.step()
    return associator, associator.finish()


def exchanged(found: Assignment, one: int, other: int) -> Assignment:
    """In the second half of the recording one landmark is taken for the other, and where they are is between both."""
    row, late = found.landmark_row, found.measured.pose_row > found.measured.pose_row.max() // 2
    swapped = np.where(late & (row == one), other, np.where(late & (row == other), one, row))
    place = found.estimate.landmark.copy()
    place[[one, other]] += 0.2 * (place[[other, one]] - place[[one, other]])
    return replace(found, landmark_row=swapped, estimate=replace(found.estimate, landmark=place))


def test_evidence_is_that_of_the_joint_gaussian() -> None:
    """Of unambiguous detections: readings of all frames about the expected ones, by one covariance."""
    made = make_world(3, n_poses=6, n_landmarks=4, prior=KNOWN_SENSORS)
    problem, noise = made.problem, made.noise
    settings = Config(slam={"association": {"particles": {"bent": 1e-3}}}).slam
    motion = problem.drive.between(problem.stamp_s, made.truth.states)
    pose = [problem.start_pose]
    for step in motion.increment:
        pose.append(se2.compose(pose[-1], step))
    problem = replace(problem, sigma_given=np.tile(noise.detection, (len(problem.pose_row), 1)))
    at = replace(made.truth, pose=np.array(pose))
    kind = np.full((len(problem.pose_row), 2), -1)
    given = Assignment(problem, problem.landmark_row, at, kind, Traits.none(len(kind)), settings)
    _, evidence = drawn(given, noise.odometry, seed=0, wider=1.0)

    def residuals(change: np.ndarray) -> np.ndarray:
        steps, moved, poses = change[: 3 * len(pose)].reshape(-1, 3), change[3 * len(pose) :].reshape(-1, 2), []
        for k, one in enumerate([problem.start_pose, *motion.increment]):
            poses.append(se2.compose(se2.compose(poses[-1], one) if k else one, steps[k]))
        there = replace(at, pose=np.array(poses), landmark=at.landmark + moved)
        return detection_residuals(problem, there).ravel()

    size = 3 * len(pose) + at.landmark.size
    zero = residuals(np.zeros(size))
    by = np.column_stack([(residuals(1e-6 * unit) - residuals(-1e-6 * unit)) / 2e-6 for unit in np.eye(size)])
    away = np.hypot(*(at.landmark[:, None] - at.landmark[None]).T)
    np.fill_diagonal(away, np.inf)
    spread = np.zeros((size, size))
    own = np.tensordot(motion.noise, noise.odometry**2, (1, 0)) + motion.floor
    for k, block in enumerate([np.eye(3) / problem.start_information, *own]):
        spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = block
    spread[3 * len(pose) :, 3 * len(pose) :] = np.diag(np.repeat((1e-3 * away.min(axis=0)) ** 2, 2))
    covariance = by @ spread @ by.T + np.diag(problem.sigma_given.ravel() ** 2)
    perfect = -np.log(2.0 * np.pi * problem.sigma_given.prod(axis=1)).sum()
    expected = multivariate_normal.logpdf(zero, cov=covariance) - perfect
    met = np.zeros(len(at.landmark))
    for row in problem.landmark_row:  # one that was seen n times is seen again with n / (n + 1)
        seen = settings.fewest_sightings + met[row]
        expected += np.log(seen / (seen + 1.0))
        met[row] += 1
    assert evidence == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))])
def test_who_was_exchanged_is_told_apart_again(seed: int) -> None:
    associator, found = finished(seed)
    wrong = exchanged(found, 0, 1)
    odometry = associator.noise.odometry
    true = world(seed).problem.landmark_row
    before = identity_scores(wrong.landmark_row, true).purity
    purity = [identity_scores(drawn(wrong, odometry, k)[0].landmark_row, true).purity for k in range(3)]
    assert before < 0.97 < max(purity)
    again = search_assignment(associator, wrong, lambda _: wrong)
    assert associator.against(again) < associator.against(found) + 1.0
    assert identity_scores(again.landmark_row, true).purity == 1.0
    assert np.mean(again.landmark_row == NOBODY) < 0.02


def test_the_same_seed_draws_the_same() -> None:
    associator, found = finished(0)
    (one, same), (two, evidence), (other, third) = (drawn(found, associator.noise.odometry, k) for k in (1, 1, 2))
    np.testing.assert_array_equal(one.estimate.pose, two.estimate.pose)
    np.testing.assert_array_equal(one.landmark_row, two.landmark_row)
    assert same == evidence != third
    assert len(other.estimate.pose) == len(one.estimate.pose)


def test_names_are_heeded() -> None:
    """What was read as one name is never drawn as another."""
    associator, found = finished(0)
    true = world(0).problem.landmark_row
    kind = np.column_stack([np.full(len(true), -1), np.where(np.arange(len(true)) % 3 == 0, true + 100, -1)])
    got, _ = drawn(replace(found, kind=kind), associator.noise.odometry, seed=0)
    for row in range(got.n_landmarks):
        assert len(set(kind[got.landmark_row == row, 1]) - {-1}) <= 1
