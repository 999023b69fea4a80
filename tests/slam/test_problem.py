"""Joint priors: what is left of one when only some landmarks are known, against the covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import World, make_world

from evermap.config import OdometryConfig
from evermap.slam.problem import Drive, Problem

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


SILENT = OdometryConfig(silence_s=1.0, silent_variance=0.25, longest_silence_s=60.0)


def driven(
    jump_row: int | None = None, by: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Rows every 50 ms at 1 m/s, which speeds up by 15 m/s^2 at first; one row is another velocity."""
    velocity = np.tile([1.0, 0.0, 0.1], (40, 1))
    velocity[:4, 0] = [0.25, 0.5, 0.75, 1.0]
    if jump_row is not None:
        velocity[jump_row] += by
    return 0.05 * np.arange(40), velocity


@pytest.mark.parametrize("by", [(18.0, 0.0, 0.0), (0.0, -6.0, 0.0), (0.0, 0.0, 9.0)])
def test_a_step_that_no_robot_drives_may_be_none(by):
    """Over 50 ms the standard deviation is the step: of 18 m/s, .9 m."""
    drive = Drive.from_rows(*driven(20, by), SILENT)
    expected = np.zeros(41)
    step = 0.05 * (np.array([1.0, 0.0, 0.1]) + by)
    expected[20], expected[40] = (step**2).sum() / 0.05, 0.25
    assert drive.unknown == pytest.approx(expected)
    assert drive.velocity[20, :3] == pytest.approx([1.0 + by[0], by[1], 0.1 + by[2]])  # dead reckoning follows it


@pytest.mark.parametrize("by", [(1.9, 0.0, 0.0), (0.0, 0.0, -1.9), (0.0, 0.0, 0.0)])
def test_what_a_robot_drives_is_known(by):
    assert not Drive.from_rows(*driven(20, by), SILENT).unknown[:40].any()


def test_a_jump_before_a_silence_lasts_a_step_and_tells_no_speed():
    stamp_s, velocity = driven(20, (30.0, 0.0, 0.0))
    drive = Drive.from_rows(np.append(stamp_s[:21], stamp_s[21:] + 5.0), velocity, SILENT)
    assert drive.stamp_s[20:23] == pytest.approx([1.0, 1.05, 6.05])
    assert drive.unknown[20] == pytest.approx((31.0**2 + 0.1**2) * 0.05)
    assert drive.unknown[21] == pytest.approx(0.25 + (1.0 + 0.1**2) * 5.05)  # by the speed before
    assert not drive.velocity[21].any()
