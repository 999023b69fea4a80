"""What was associated wrongly is found and undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import World, make_world

from evermap.config import Config
from evermap.estimate.sparse.system import exhaust
from evermap.geometry import se2
from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.features import Traits
from evermap.slam.association.in_plane import BEFORE
from evermap.slam.association.wrong_associations import Visits, find_displaced, laid, weigh_visits
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.intake import prepare
from evermap.slam.noise import START
from evermap.slam.problem import Estimate, Marginals
from evermap.slam.smoother import Smoother
from evermap.types import UNKNOWN
from evermap_studies.sim.park import ParkConfig, simulate_park

KNOWN_SENSORS = CalibrationPrior.from_settings(calibrated=False)
TWICE = 5
"""A landmark that is seen in two visits."""
SETTINGS = Config(slam={"association": {"forget_s": 5.0}}).slam
KICK_RAD = 0.6
PARK = ParkConfig(
    drive_m=1800.0, n_trees=120, n_cars=0, p_ghost=0.0, speed_scale=1.0, steering_bias_rad=0.0, steering_walk_rad=0.0
)


def solved(made: World, assignment: Assignment) -> tuple[Assignment, Marginals, Smoother]:
    smoother = Smoother(assignment.problem(), made.noise, heavy=False)
    slices = smoother.solve_in_slices(assignment.estimate, iterations=20, tolerance=1e-9, settled=0.0)
    estimate, marginals = exhaust(slices)
    return replace(assignment, estimate=estimate), marginals, smoother


def two_visits(seed: int, off_m: float = 0.0) -> tuple[World, Assignment, np.ndarray]:
    """A world, who is who, and the rows of the second visit, whose readings are off."""
    made = make_world(seed, n_poses=60, n_landmarks=8, prior=KNOWN_SENSORS)
    problem = made.problem
    late = (problem.landmark_row == TWICE) & (problem.pose_row > 36)
    reading = problem.reading.copy()
    reading[late, 0] += off_m
    row = problem.landmark_row.copy()
    row[(row == TWICE) & (problem.pose_row > 24) & (problem.pose_row <= 36)] = NOBODY
    sigma = np.tile(made.noise.detection, (len(row), 1))
    measured = replace(problem, reading=reading, sigma_given=sigma)
    kind = np.full((len(row), 2), UNKNOWN)
    return made, Assignment(measured, row, made.truth, kind, Traits.none(len(row)), SETTINGS), np.flatnonzero(late)


def weighed(made: World, assignment: Assignment) -> Visits:
    found, marginals, smoother = solved(made, assignment)
    every = weigh_visits(found, marginals, smoother.detections(found.estimate), density=0.1)
    mine = np.flatnonzero(every.landmark == TWICE)
    return Visits([every.rows[k] for k in mine], *(each[mine] for each in every[1:]))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 4))])
def test_a_visit_is_weighed_as_if_its_landmark_had_been_cut_and_solved_again(seed: int) -> None:
    made, assignment, late = two_visits(seed)
    visits = weighed(made, assignment)
    np.testing.assert_array_equal(visits.landmark, TWICE)
    k = next(k for k, rows in enumerate(visits.rows) if set(rows) == set(late.tolist()))
    cut, marginals, _ = solved(made, assignment.split([late]))
    gap = cut.estimate.landmark[TWICE] - cut.estimate.landmark[8]
    joint = marginals.joint(np.array([TWICE, 8])).reshape(2, 2, 2, 2)
    own = joint[0, :, 0] + joint[1, :, 1] - joint[0, :, 1] - joint[1, :, 0]
    own += 2.0 * assignment.shared_variance[TWICE] * np.eye(2)
    squared = gap @ np.linalg.solve(own, gap)
    assert visits.squared[k] == pytest.approx(squared, rel=0.1, abs=0.02)
    evidence = -0.5 * (squared + np.linalg.slogdet(2.0 * np.pi * own)[1]) - np.log(0.1)
    assert visits.evidence[k] == pytest.approx(evidence, abs=0.1)


def test_where_nothing_is_a_landmark_there_are_no_visits() -> None:
    made, assignment, _ = two_visits(0)
    nothing = assignment.without(np.ones(8, dtype=bool))
    _, marginals, smoother = solved(made, assignment)
    visits = weigh_visits(nothing, marginals, smoother.detections(assignment.estimate), density=0.1)
    assert len(visits.rows) == len(visits.evidence) == 0


def test_a_visit_to_another_landmark_contradicts_the_rest() -> None:
    for off_m in (0.0, 0.8):
        made, assignment, _ = two_visits(2, off_m)
        evidence = weighed(made, assignment).evidence
        assert np.all(evidence > 2.0) if off_m == 0.0 else np.all(evidence < -10.0)


def kicked(seed: int) -> tuple[World, Assignment, np.ndarray]:
    """A park after a turn that the car does not know of: all met since then is there twice, each half by itself right.

    Returns the world, the assignment and (L,) which tree each landmark is.
    """
    made = simulate_park(PARK, seed=seed)
    at, angular = len(made.odometry.stamp_s) // 2, made.odometry.angular_radps.copy()
    angular[at : at + 5] += KICK_RAD / (5.0 * float(np.diff(made.odometry.stamp_s[:2])[0]))
    made = replace(made, odometry=replace(made.odometry, angular_radps=angular))
    assert made.truth is not None
    prepared = prepare(made)
    problem = replace(prepared.problem, prior=KNOWN_SENSORS)
    frame = np.searchsorted(made.truth.stamp_s - made.truth.stamp_s[0], problem.stamp_s)
    true = se2.compose(se2.inverse(made.truth.pose_world_robot[frame[0]]), made.truth.pose_world_robot)
    pose, late = true[frame].copy(), frame >= at + 5
    turned = se2.compose(true[at + 2], se2.compose(np.array([0.0, 0.0, KICK_RAD]), se2.inverse(true[at + 2])))
    pose[late] = se2.compose(turned, pose[late])
    tree, after = made.detections.landmark_id[prepared.used], late[problem.pose_row]
    name = tree + 1000 * after
    order = np.argsort([np.flatnonzero(name == each)[0] for each in np.unique(name)])
    names = np.unique(name)[order]  # landmarks in the order they were met
    row = np.argsort(order)[np.unique(name, return_inverse=True)[1]]
    sigma = np.tile(START.detection, (len(row), 1))
    guess = Assignment(
        replace(problem, sigma_given=sigma),
        row,
        Estimate(pose, np.zeros((len(names), 2)), KNOWN_SENSORS.mean),
        np.full((len(tree), 2), UNKNOWN),
        Traits.none(len(tree)),
    )
    points = guess.points()
    place = np.array([np.median(points[row == k], axis=0) for k in range(len(names))])
    world = World(problem, START, Estimate(true[frame], place, KNOWN_SENSORS.mean))
    return world, replace(guess, estimate=replace(guess.estimate, landmark=place)), names % 1000


def error_m(made: World, assignment: Assignment) -> float:
    return float(np.median(np.hypot(*(made.truth.pose - assignment.estimate.pose)[:, :2].T)))


@pytest.mark.parametrize("seed", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_a_stretch_that_lies_beside_itself_is_found_and_laid_where_it_belongs(seed: int) -> None:
    made, assignment, tree = kicked(seed)
    bent, marginals, _ = solved(made, assignment)
    found = find_displaced(bent, marginals, bent.sightings >= 3, density=0.01, probability=0.97)
    assert len(found) > 5
    for stretch in found:
        np.testing.assert_array_equal(tree[stretch.younger], tree[stretch.older])
    again = min((solved(made, laid(bent, found[0], before))[0] for before in BEFORE), key=lambda a: error_m(made, a))
    twins = [(int(k), int(np.argmax(tree == tree[k]))) for k in range(len(tree)) if np.argmax(tree == tree[k]) != k]
    known, _, _ = solved(made, replace(bent, estimate=replace(bent.estimate, pose=made.truth.pose)).merged(twins))
    assert error_m(made, again) < 0.25 * error_m(made, bent)
    assert error_m(made, again) < 1.2 * error_m(made, known) + 0.05
