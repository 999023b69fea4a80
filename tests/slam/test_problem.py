"""Joint priors: what is left of one when only some landmarks are known, against the covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import World, make_world

from evermap.slam.problem import Problem

COVARIANCE = np.cov(np.random.default_rng(0).normal(size=(10, 60)))


@pytest.fixture
def problem() -> Problem:
    return replace(make_world(1).problem, landmark_information=np.linalg.inv(COVARIANCE))


def places(*rows: int) -> list[int]:
    return [k for row in rows for k in (2 * row, 2 * row + 1)]


@pytest.mark.parametrize("rows", [[0], [1, 3], [0, 2, 4], [0, 1, 2, 3, 4]])
def test_prior_of_some_is_a_block_of_the_covariance(problem, rows):
    found = problem.prior_information(np.isin(np.arange(5), rows)).toarray()
    assert np.linalg.inv(found) == pytest.approx(COVARIANCE[np.ix_(places(*rows), places(*rows))], rel=1e-9)


@pytest.mark.parametrize(("row", "given"), [(2, [0, 4]), (0, [3]), (4, [0, 1, 2, 3])])
def test_conditional_prior_is_that_of_the_textbook(problem, row, given):
    own, others = places(row), places(*given)
    cross = COVARIANCE[np.ix_(own, others)]
    gain = np.linalg.solve(COVARIANCE[np.ix_(others, others)], cross.T).T
    prior = problem.conditional_prior(row, np.isin(np.arange(5), given))
    assert prior.given.tolist() == given
    assert prior.gain == pytest.approx(gain, rel=1e-9)
    assert np.linalg.inv(prior.information) == pytest.approx(COVARIANCE[np.ix_(own, own)] - gain @ cross.T, rel=1e-9)
    landmark = np.arange(10.0).reshape(5, 2)
    expected = problem.landmark_mean[row] + gain @ (landmark[given] - problem.landmark_mean[given]).ravel()
    assert prior.place(landmark, problem.landmark_mean) == pytest.approx(expected)


def test_untied_landmarks_depend_on_none():
    world: World = make_world(2, n_mapped=2)
    problem = world.problem
    assert problem.mapped.tolist() == [True, True, False, False, False]
    for row in range(5):
        prior = problem.conditional_prior(row, np.arange(5) != row)
        assert len(prior.given) == 0
        own = problem.landmark_information[2 * row : 2 * row + 2][:, places(row)]
        assert np.array_equal(prior.information, own.toarray())


def test_two_places_tied_to_each_other_but_to_nothing_else():
    """How far apart they are is known, where they are is not: a rank that no covariance has."""
    difference = np.zeros((2, 10))
    difference[:, places(1)], difference[:, places(3)] = -np.eye(2), np.eye(2)
    information = difference.T @ difference / 0.2**2
    problem = replace(make_world(3).problem, landmark_information=information)
    assert not problem.prior_information(np.isin(np.arange(5), [0, 1, 2])).toarray().any()
    assert not problem.conditional_prior(1, np.isin(np.arange(5), [0])).information.any()
    prior = problem.conditional_prior(3, np.isin(np.arange(5), [0, 1]))
    assert prior.given.tolist() == [1]
    assert prior.information == pytest.approx(np.eye(2) / 0.2**2)
    assert prior.gain == pytest.approx(np.eye(2))
