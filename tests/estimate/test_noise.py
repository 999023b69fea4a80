"""Levels by restricted likelihood: unbiased where maximum likelihood is not, and held where nothing is known."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.estimate.noise import restricted_level


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
