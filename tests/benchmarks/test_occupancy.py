"""The engine's evidence of looks in seasons is the likelihood of dynamic occupancy (MacKenzie et al. 2003)."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.occupancy import estimate_occupancy
from scipy.optimize import minimize
from scipy.special import expit

from evermap.existence.protocol import Looks

SEASON_S, SITES, SEASONS, VISITS = 1000.0, 120, 6, 3
PSI, GAMMA, EPSILON, P = 0.4, 0.15, 0.25, 0.6


def seen() -> np.ndarray:
    """(SITES, SEASONS, VISITS) detections."""
    rng = np.random.default_rng(3)
    taken = rng.random(SITES) < PSI
    rows = []
    for _ in range(SEASONS):
        rows.append(taken[:, None] & (rng.random((SITES, VISITS)) < P))
        taken = np.where(taken, rng.random(SITES) >= EPSILON, rng.random(SITES) < GAMMA)
    return np.stack(rows, axis=1)


def log_likelihood(logits: np.ndarray, y: np.ndarray) -> float:
    """Forward algorithm of two states over seasons, written down as in the paper."""
    psi, gamma, epsilon, p = expit(logits)
    change = np.array([[1.0 - gamma, gamma], [epsilon, 1.0 - epsilon]])
    state = np.tile([1.0 - psi, psi], (len(y), 1))
    for k in range(y.shape[1]):
        of_taken = np.prod(np.where(y[:, k], p, 1.0 - p), axis=1)
        state = state * np.stack([~y[:, k].any(axis=1), of_taken], axis=1)
        if k + 1 < y.shape[1]:
            state = state @ change
    return float(np.log(state.sum(axis=1)).sum())


def test_estimates_are_those_of_the_likelihood_written_down() -> None:
    y = seen()
    site, season, visit = np.indices(y.shape)
    looks = Looks.from_rows(site.ravel(), SEASON_S * season.ravel() + visit.ravel(), y.ravel(), 0.1, 0.1)
    found = estimate_occupancy(looks, SEASON_S)
    best = minimize(lambda x: -log_likelihood(x, y), np.zeros(4), method="BFGS")
    assert found.log_likelihood == pytest.approx(-best.fun, abs=1e-4)
    values = np.array([found.psi, found.gamma, found.epsilon, found.p])
    np.testing.assert_allclose(values, expit(best.x), atol=3e-4)
    sigma = np.sqrt(np.diag(best.hess_inv)) * expit(best.x) * (1.0 - expit(best.x))
    np.testing.assert_allclose(found.sigma, sigma, rtol=0.3)
    assert np.all(np.abs(values - [PSI, GAMMA, EPSILON, P]) < 3.0 * np.array(found.sigma))
