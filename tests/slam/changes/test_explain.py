"""What a hypothesis becomes: priors whose covariances are known, places, and detections on their ways."""

from __future__ import annotations

import numpy as np
import pytest
from problems import make_world

from evermap.config import ChangesConfig
from evermap.geometry import se2
from evermap.slam.changes.explain import GivenMap, MovedGroup, explained
from evermap.slam.problem import Estimate

PRIOR = ChangesConfig()
SPREAD = np.array([0.7, 0.7, 0.5])
COUNT = 6


@pytest.fixture
def given() -> GivenMap:
    rng = np.random.default_rng(0)
    root = 0.05 * (np.eye(2) + 0.3 * rng.normal(size=(COUNT, 2, 2)))
    return GivenMap(rng.uniform(-4.0, 4.0, (COUNT, 2)), root @ root.transpose(0, 2, 1), np.arange(COUNT) != 5)


def told(given: GivenMap, *groups: MovedGroup):
    world = make_world(1, n_poses=20, n_landmarks=COUNT)
    estimate = Estimate(world.truth.pose, given.mean + 0.01, world.truth.states)
    return (world.problem, *explained(world.problem, estimate, given, groups, PRIOR))


def rows(places: np.ndarray) -> np.ndarray:
    return (2 * np.asarray(places)[:, None] + np.arange(2)).ravel()


def blockdiag(blocks: np.ndarray) -> np.ndarray:
    out = np.zeros((2 * len(blocks), 2 * len(blocks)))
    for k, block in enumerate(blocks):
        out[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    return out


def columns_of(position: np.ndarray, angle: float | None) -> np.ndarray:
    """(2 k, 2 or 3) how the members move with x, y and the angle: numerical derivatives."""
    arm = position - position.mean(axis=0)
    shifts = [np.tile(step, len(arm)) for step in np.eye(2)]
    if angle is not None:
        h = 1e-6
        turned = [(arm @ se2.rotation(angle + s * h).T).ravel() for s in (1, -1)]
        shifts.append((turned[0] - turned[1]) / (2 * h))
    return np.column_stack(shifts)


@pytest.mark.parametrize("turns", [False, True])
def test_before_the_session(given: GivenMap, turns: bool) -> None:
    members, angle = np.array([0, 2, 3]), 0.6
    group = MovedGroup(members, turns, np.array([0.4, -0.2, angle if turns else 0.0]), 0)
    before, problem, start, landmark = told(given, group)
    np.testing.assert_array_equal(landmark, np.arange(COUNT))
    np.testing.assert_array_equal(problem.landmark_row, before.landmark_row)
    columns = columns_of(given.mean[members], angle if turns else None)
    motion = (columns * SPREAD[: columns.shape[1]] ** 2) @ columns.T
    own = problem.landmark_information.toarray()[np.ix_(rows(members), rows(members))]
    np.testing.assert_allclose(np.linalg.inv(own), blockdiag(given.covariance[members]) + motion, rtol=1e-6, atol=1e-9)
    for j in (1, 4):
        block = problem.landmark_information.toarray()[np.ix_(rows([j]), rows([j]))]
        np.testing.assert_allclose(np.linalg.inv(block), given.covariance[j], rtol=1e-9)
    assert not problem.mapped[5]
    assert not problem.landmark_information.toarray()[rows(members)][:, rows([1, 4, 5])].any()
    # the prior is linearised at the angle found: where the members would be without displacement, as far as it is known
    arm = given.mean[members] - given.mean[members].mean(axis=0)
    turned = arm @ se2.rotation(group.motion[2]).T
    np.testing.assert_allclose(
        start.landmark[members], given.mean[members].mean(axis=0) + [0.4, -0.2] + turned, atol=1e-12
    )
    if not turns:
        np.testing.assert_array_equal(problem.landmark_mean[members], given.mean[members])
    else:  # at the angle itself the prior's mean goes back along the tangent by the angle
        expected = given.mean[members].mean(axis=0) + turned - angle * columns[:, 2].reshape(-1, 2)
        np.testing.assert_allclose(problem.landmark_mean[members], expected, atol=1e-6)


def test_within_the_session(given: GivenMap) -> None:
    """Old and new places share the map's error; the new one has the motion's besides."""
    members = np.array([1, 4])
    group = MovedGroup(members, False, np.array([0.4, -0.2, 0.0]), 1, since_s=8.0, between_s=(7.0, 8.0))
    before, problem, start, landmark = told(given, group)
    np.testing.assert_array_equal(landmark, [0, 1, 2, 3, 4, 5, 1, 4])
    all_rows = rows(np.array([1, 4, 6, 7]))
    covariance = np.linalg.inv(problem.landmark_information.toarray()[np.ix_(all_rows, all_rows)])
    old = blockdiag(given.covariance[members])
    columns = columns_of(given.mean[members], None)
    motion = (columns * SPREAD[:2] ** 2) @ columns.T + PRIOR.rigid_m**2 * np.eye(4)
    np.testing.assert_allclose(covariance, np.block([[old, old], [old, old + motion]]), rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(start.landmark[6:], start.landmark[members] + [0.4, -0.2])
    stamp_s = before.stamp_s[before.pose_row]
    expected = before.landmark_row.copy()
    expected[(before.landmark_row == 1) & (stamp_s >= 8.0)] = 6
    expected[(before.landmark_row == 4) & (stamp_s >= 8.0)] = 7
    np.testing.assert_array_equal(problem.landmark_row, expected)
    assert np.any(expected > 5)
    assert np.any(before.landmark_row[expected <= 5] == 1)


def test_new_places_that_no_map_holds_are_tied_to_the_old_alone(given: GivenMap) -> None:
    group = MovedGroup(np.array([5]), False, np.array([0.4, -0.2, 0.0]), 1, since_s=8.0, between_s=(7.0, 8.0))
    _, problem, _, landmark = told(given, group)
    np.testing.assert_array_equal(landmark, [0, 1, 2, 3, 4, 5, 5])
    both = np.ix_(rows([5, 6]), rows([5, 6]))
    together = np.tile(np.eye(2), (2, 1))
    np.testing.assert_allclose(problem.landmark_information.toarray()[both] @ together, 0.0, atol=1e-9)
    difference = np.linalg.inv(problem.landmark_information.toarray()[np.ix_(rows([6]), rows([6]))])
    np.testing.assert_allclose(difference, (SPREAD[0] ** 2 + PRIOR.rigid_m**2) * np.eye(2))


def test_two_groups_at_two_times(given: GivenMap) -> None:
    first = MovedGroup(np.array([0, 2]), False, np.array([0.4, 0.0, 0.0]), 2, since_s=9.0, between_s=(8.0, 9.0))
    second = MovedGroup(np.array([1, 3]), False, np.array([0.0, 0.3, 0.0]), 1, since_s=5.0, between_s=(4.0, 5.0))
    before, problem, _, landmark = told(given, first, second)
    np.testing.assert_array_equal(landmark, [0, 1, 2, 3, 4, 5, 0, 2, 1, 3])
    stamp_s = before.stamp_s[before.pose_row]
    np.testing.assert_array_equal(landmark[problem.landmark_row], before.landmark_row)
    moved = problem.landmark_row >= COUNT
    since = np.array([9.0, 5.0, 9.0, 5.0, np.inf, np.inf])[before.landmark_row]
    np.testing.assert_array_equal(moved, stamp_s >= since)
    information = problem.landmark_information.toarray()
    assert np.all(np.linalg.eigvalsh(information) > -1e-6)
    assert not information[np.ix_(rows([6, 7]), rows([8, 9]))].any()
