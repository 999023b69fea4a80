"""Levels by restricted likelihood: unbiased where maximum likelihood is not, and held where nothing is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from evermap.estimate.noise import Turns, alternate, restricted_level


def test_a_level_counts_what_the_fit_absorbed():
    random, n, unknowns = np.random.default_rng(0), 40, 20
    found = []
    for _ in range(400):
        design = random.normal(size=(n, unknowns))
        y = 0.3 * random.normal(size=n)
        hat = design @ np.linalg.solve(design.T @ design, design.T)
        residual = y - hat @ y
        found.append(restricted_level(residual @ residual, n - np.trace(hat), 1.0, 0.0))
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.3, rel=0.03)  # by maximum likelihood .21


def test_it_is_the_maximum_of_the_marginal_likelihood():
    random = np.random.default_rng(1)
    design, y = random.normal(size=(30, 6)), random.normal(size=30)
    hat = design @ np.linalg.solve(design.T @ design, design.T)
    residual = y - hat @ y
    grid = np.linspace(0.5, 2.0, 4001)
    log_likelihood = -24 * np.log(grid) - 0.5 * (residual @ residual) / grid**2
    level = restricted_level(residual @ residual, 30 - np.trace(hat), 1.0, 0.0)
    assert level == pytest.approx(grid[np.argmax(log_likelihood)], abs=1e-3)


def test_without_residuals_a_level_stays_where_it_starts():
    assert restricted_level(0.0, 0.0, 0.07, 2.0) == pytest.approx(0.07)
    assert restricted_level(0.0, -0.1, 0.07, 2.0) == pytest.approx(0.07)  # rounding of leverages


def test_values_and_levels_in_turns_end_where_the_marginal_likelihood_is_largest():
    """Two sensors measure one number: 30 readings of .5, 40 of 2."""
    random = np.random.default_rng(2)
    readings = [1.0 + 0.5 * random.normal(size=30), 1.0 + 2.0 * random.normal(size=40)]

    def optimise(before, levels, heavy):
        turns.append((before, heavy))
        weight = levels**-2.0
        return sum(w * one.sum() for w, one in zip(weight, readings, strict=True)) / (weight @ [30, 40])

    def learn(mean, levels):
        variance = 1.0 / (levels**-2.0 @ [30, 40])
        left = [len(one) - len(one) * variance / level**2 for one, level in zip(readings, levels, strict=True)]
        squares = [((one - mean) ** 2).sum() for one in readings]
        found = restricted_level(squares, left, 1.0, 0.0)
        return found, np.abs(np.log(found / levels)).max()

    turns = []
    _, levels = alternate(np.ones(2), optimise, learn, lambda _, found, heavy: found, Turns(50, 2, 1e-9))
    assert [heavy for _, heavy in turns[:3]] == [True, True, False]
    assert turns[0][0] is None
    assert len(turns) < 50

    def minus_log_likelihood(levels):
        weight = levels**-2.0
        mean = sum(w * one.sum() for w, one in zip(weight, readings, strict=True)) / (weight @ [30, 40])
        squares = sum(w * ((one - mean) ** 2).sum() for w, one in zip(weight, readings, strict=True))
        return np.log(levels) @ [30, 40] + 0.5 * squares + 0.5 * np.log(weight @ [30, 40])

    best = minimize(minus_log_likelihood, np.ones(2), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).x
    assert levels == pytest.approx(best, rel=1e-5)


def test_turns_follow_what_was_learned_until_it_settles_or_there_are_no_more():
    """What learns halves a level; of two that start settled the heavy turns are made all the same."""
    halved = alternate(
        8.0, lambda _, level, __: level, lambda at, _: (at / 2, 1.0), lambda _, fit, __: fit, Turns(3, 0, 0.1)
    )
    assert halved == (2.0, 1.0)
    settled = alternate(
        8.0, lambda _, level, __: level, lambda at, _: (at / 2, 0.0), lambda _, fit, __: fit, Turns(9, 2, 0.1)
    )
    assert settled == (2.0, 1.0)
