"""Whether a mode pays for itself: against scipy's Gaussians, the tied problem solved, and worlds with bursts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving import MovingWorld, make_moving_world, model_of
from scipy import stats

from evermap.slam.smoother import Smoother
from evermap_studies.nielsen2024.modes import evidence
from evermap_studies.nielsen2024.modes.alternation import Explanation, explain_with_modes
from evermap_studies.nielsen2024.modes.evidence import (
    MOVE_SIGMA_M,
    _coinciding,
    _History,
    _log_ratio,
    _of_difference,
    united,
)
from evermap_studies.nielsen2024.modes.gating import MOST_MODES, _in_excursion, surprised, with_births
from evermap_studies.nielsen2024.modes.places import FREE, Modes


def random_places(seed: int, count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(2 * count, 2 * count))
    return rng.normal(size=(count, 2)), root @ root.T / count


@pytest.mark.parametrize("seed", range(5))
def test_the_second_place_is_worth_the_ratio_of_two_gaussians(seed: int):
    mean, covariance = random_places(seed)
    chance = _of_difference(covariance, 1, 3)
    apart = mean[1] - mean[3]
    moved = stats.multivariate_normal(np.zeros(2), chance + MOVE_SIGMA_M**2 * np.eye(2)).logpdf(apart)
    same = stats.multivariate_normal(np.zeros(2), chance).logpdf(apart)
    assert _log_ratio(mean, covariance, 1, 3) == pytest.approx(moved - same, rel=1e-9)


def test_a_place_that_is_hardly_known_is_no_second_one():
    """All its sightings are outliers: its variance is so large that rounding leaves no definite covariance."""
    covariance = 1e-4 * np.eye(4) + 1e9 * np.kron(np.array([[1.0, 0.0], [0.0, 0.0]]), np.ones((2, 2)))
    covariance[:2, :2] -= 1e-3 * np.eye(2)
    assert np.linalg.eigvalsh(covariance)[0] < 0.0
    assert _log_ratio(np.array([[0.02, 0.01], [0.0, 0.0]]), covariance, 0, 1) < 5.0


@pytest.mark.parametrize("seed", range(5))
def test_places_that_coincide_are_those_of_the_tied_least_squares_problem(seed: int):
    mean, covariance = random_places(seed)
    tie = np.kron(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0]]), np.eye(2))  # place 3 is place 1
    information = np.linalg.inv(covariance)
    tied_covariance = np.linalg.inv(tie.T @ information @ tie)
    tied = tied_covariance @ tie.T @ information @ mean.ravel()
    at, left = _coinciding(mean, covariance, 3, 1)
    np.testing.assert_allclose(at.ravel(), tie @ tied, atol=1e-8)
    np.testing.assert_allclose(left, tie @ tied_covariance @ tie.T, atol=1e-8)


def test_uniting_ends_at_the_optimum_of_the_united_problem(monkeypatch: pytest.MonkeyPatch):
    """From the joint Gaussian alone, without solving anything."""
    monkeypatch.setattr(evidence, "SHARED_ERROR_M", 0.0)
    moving = make_moving_world(5, by=(0.0, 0.0))
    smoother = Smoother(moving.told, moving.world.noise, robust=False)
    torn = smoother.optimum(moving.told_optimum(), iterations=60, tolerance=1e-9)
    modes = Modes(np.array([0, 1, 2, 3, 4, 5, moving.moved]), 6)
    marginals = smoother.marginals(torn)
    problem, estimate, fewer = united(
        moving.told, torn, marginals, np.ones(len(moving.told.reading)), modes, switch_cost=9.0, outlier_cost=7.0
    )
    assert fewer.landmark[6] == FREE
    np.testing.assert_array_equal(problem.landmark_row, moving.problem.landmark_row)
    whole = Smoother(moving.problem, moving.world.noise, robust=False).optimum(
        moving.static_optimum(), iterations=60, tolerance=1e-9
    )
    torn_apart = np.linalg.norm(torn.landmark[6] - torn.landmark[moving.moved])
    off = np.abs(estimate.landmark[:6] - whole.landmark).max()
    assert off < 0.02 * torn_apart


def test_a_burst_counts_as_two_outliers_however_long_it_is():
    stamp_s = np.concatenate([np.linspace(10.0, 12.0, 7), np.linspace(30.0, 70.0, 41)])
    history = _History(np.zeros(48, dtype=np.int64), stamp_s, np.ones(48))
    assert replace(history, place=np.repeat([0, 1], [7, 41])).outliers(0) == 2.0
    assert replace(history, place=np.repeat([0, 1], [7, 41])).outliers(1) == 14.0  # seven times five seconds
    doubted = replace(history, place=np.repeat([0, 1], [1, 47]), weight=np.full(48, 0.25))
    assert doubted.outliers(0) == 0.25


def seen_elsewhere(first: int, poses: int) -> MovingWorld:
    """One landmark is far away from a few poses in a row, and then back."""
    moving = make_moving_world(5, since=first)
    reading = moving.problem.reading.copy()
    back = moving.problem.pose_row >= first + poses
    reading[back] = make_moving_world(5, by=(0.0, 0.0)).problem.reading[back]
    return replace(moving, problem=replace(moving.problem, reading=reading))


def explain(moving: MovingWorld, **settings: object) -> Explanation:
    start = Smoother(moving.problem, moving.world.noise).optimum(moving.static_optimum())
    modes = Modes.one_each(6)
    model = model_of("viterbi", **settings)
    return explain_with_modes(moving.problem, start, moving.world.noise, modes, model, np.random.default_rng(0))


def test_what_was_seen_elsewhere_in_one_look_only_did_not_move():
    burst = seen_elsewhere(31, 6)
    stamps = burst.problem.stamp_s[31:37]
    assert np.ptp(stamps) < 5.0
    assert len(explain(burst).modes.landmark) == 6
    assert len(explain(burst, births="gate").modes.landmark) > 6  # the paper keeps what is selected


def test_what_stays_elsewhere_for_several_looks_moved():
    found = explain(seen_elsewhere(20, 25))
    assert found.modes.landmark.tolist() == [0, 1, 2, 3, 4, 5, 2]


@pytest.mark.parametrize("births", ["evidence", "gate"])
def test_no_landmark_has_more_modes_than_are_allowed(births: str):
    moving = make_moving_world(5, by=(0.0, 0.0))
    problem = moving.problem
    mine = np.flatnonzero(problem.landmark_row == moving.moved)
    reading = problem.reading.copy()
    reading[mine, 0] += 1.5 * (np.arange(len(mine)) // 5)  # somewhere else every five detections
    problem = replace(problem, reading=reading)
    estimate = moving.world.truth
    marginals = Smoother(moving.problem, moving.world.noise).marginals(estimate)
    model = model_of("viterbi", births=births)
    _, grown, modes, _ = with_births(
        problem, estimate, marginals, moving.world.noise, Modes.one_each(6), model.gate, surprise=model.surprise
    )
    assert (modes.table(grown) != FREE).sum(axis=1)[moving.moved] == MOST_MODES


def test_single_surprises_do_not_add_up_where_the_landmark_is_seen_in_between():
    gate = 6.0
    lonely = np.where(np.arange(200) % 8 == 0, 100.0, 1.0)
    assert not _in_excursion(lonely, gate, 18.0).any()
    series = np.where((np.arange(200) >= 100) & (np.arange(200) < 104), 100.0, 1.0)
    assert _in_excursion(series, gate, 18.0)[100:104].all()
    assert not _in_excursion(series, gate, 18.0)[:100].any()


def test_without_a_price_every_detection_outside_the_gate_counts():
    squared = np.array([1.0, 7.0, 5.9, 6.1, 0.0])
    np.testing.assert_array_equal(_in_excursion(squared, 6.0, 0.0) & (squared >= 6.0), squared >= 6.0)
    assert surprised(0.0, 1e9, 6.0) == 7.0  # no more than an outlier says
