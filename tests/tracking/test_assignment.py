"""The assignment against scipy's on the padded dense matrix, and the candidates against all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from evermap.tracking.association import NOBODY, Likelihood, Targets, assign, candidates
from evermap.tracking.frame import Frame

FORBIDDEN = 1e6
POINTS = (np.empty((0, 0)),) * 3
"""No boxes and no scores."""
USUAL = (1e-3, 30.66, 16.0, np.log(0.02), 0.25, 0.05)
"""What follows in a `Likelihood`."""


def sparse(cost: np.ndarray, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    start = np.concatenate([[0], np.cumsum(allowed.sum(axis=1))]).astype(np.int64)
    return start, np.nonzero(allowed)[1].astype(np.int64), cost[allowed]


def least_total(cost: np.ndarray, allowed: np.ndarray) -> float:
    n, m = cost.shape
    padded = np.full((n, m + n), FORBIDDEN)
    padded[:, :m][allowed] = cost[allowed]
    padded[np.arange(n), m + np.arange(n)] = 0.0
    return float(padded[linear_sum_assignment(padded)].sum())


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 12),
    m=st.integers(0, 12),
    density=st.floats(0.05, 1.0),
    whole=st.booleans(),
)
def test_the_total_is_scipys(seed: int, n: int, m: int, density: float, whole: bool) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.integers(-5, 3, (n, m)).astype(float) if whole else rng.normal(-1.0, 3.0, (n, m))  # with ties, without
    allowed = rng.random((n, m)) < density
    start, column, values = sparse(cost, allowed)
    pair = assign(start, column, values, m)
    given_to = np.flatnonzero(pair != NOBODY)
    assert len(np.unique(column[pair[given_to]])) == len(given_to)
    assert np.all((pair[given_to] >= start[given_to]) & (pair[given_to] < start[given_to + 1]))
    assert values[pair[given_to]].sum() == pytest.approx(least_total(cost, allowed), abs=1e-9)


def test_one_large_component_too() -> None:
    rng = np.random.default_rng(1)
    cost, allowed = rng.normal(-1.0, 3.0, (200, 180)), np.ones((200, 180), dtype=bool)
    start, column, values = sparse(cost, allowed)
    pair = assign(start, column, values, 180)
    assert values[pair[pair != NOBODY]].sum() == pytest.approx(least_total(cost, allowed), abs=1e-8)


@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 15),
    m=st.integers(1, 15),
    size_m=st.sampled_from([2.0, 20.0, 1e4]),
    shared=st.booleans(),
    reach_m=st.sampled_from([0.0, 5.0]),
)
def test_candidates_are_all_pairs_worth_it_with_their_costs(
    seed: int, n: int, m: int, size_m: float, shared: bool, reach_m: float
) -> None:
    """Every pair's likelihoods by scipy: a Gaussian, the class by total probability, the appearance by its cosine."""
    rng = np.random.default_rng(seed)
    mean, position = rng.uniform(-size_m, size_m, (n, 9)), rng.uniform(-size_m, size_m, (m, 3))
    roots = rng.normal(size=(n, 9, 9)) * rng.uniform(0.1, 2.0, (n, 1, 1))
    covariance = roots @ roots.transpose(0, 2, 1) + 0.01 * np.eye(9)
    root = rng.normal(size=(1 if shared else m, 3, 3))
    noise = root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3)
    class_p, confusion = rng.dirichlet(np.ones(3), n), rng.dirichlet(np.ones(3), 3)
    seen_class = rng.integers(-1, 3, m)
    look, seen_look = rng.normal(size=(n, 4)), rng.normal(size=(m, 4))
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    seen_look /= np.linalg.norm(seen_look, axis=1, keepdims=True)
    seen_look[0] = 0.0
    odds, p_detect = rng.uniform(0.0, 2.0, n), rng.uniform(0.05, 0.99, n)
    likelihood = Likelihood(
        confusion, np.array([0.2, 0.3, 0.5]), np.log(1e-3), 21.1, 4.0, 0.5, reach_m, np.log(1e-4), *USUAL
    )
    targets = Targets(mean, covariance, class_p, look, np.zeros((n, 0)), odds, p_detect)
    pairs = candidates(targets, n, Frame(0.0, position, noise, seen_class, seen_look, *POINTS), likelihood)
    expected = {}
    for i in range(n):
        for j in range(m):
            s = covariance[i, :3, :3] + noise[0 if shared else j]
            d = position[j] - mean[i, :3]
            density = (
                multivariate_normal(mean[i, :3], s).logpdf(position[j])
                if d @ np.linalg.solve(s, d) <= 21.1
                else -np.inf
            )
            density = max(density, np.log(1e-4)) if np.linalg.norm(d) <= reach_m else density
            ratio = density - np.log(1e-3)
            if seen_class[j] >= 0:
                column = confusion[:, seen_class[j]]
                ratio += logsumexp(np.log(class_p[i] * column)) - logsumexp(np.log([0.2, 0.3, 0.5] * column))
            if j > 0:
                ratio += 4.0 * (look[i] @ seen_look[j] - 0.5) / 0.5
            hit = p_detect[i] / (1.0 + odds[i])
            cost = np.log(1.0 - hit) - np.log(hit) - ratio
            if cost < 0.0:
                expected[i, j] = (cost, ratio)
    rows = np.repeat(np.arange(n), np.diff(pairs.start))
    got = {
        (int(i), int(j)): (float(c), float(r))
        for i, j, c, r in zip(rows, pairs.column, pairs.cost, pairs.log_ratio, strict=True)
    }
    assert len(got) == len(pairs.cost)
    assert got.keys() == expected.keys()
    for key, values in expected.items():
        assert got[key] == pytest.approx(values, abs=1e-6)


def test_a_young_tracklet_does_not_steal_the_detection_of_an_old_one() -> None:
    """Its gate is wide, so its Mahalanobis distance is the shorter one; but its density there is lower."""
    mean = np.zeros((2, 9))
    mean[1, 0] = 1.0
    covariance = np.array([np.eye(9) * 0.01, np.eye(9) * 4.0])
    z, noise = np.array([[0.6, 0.0, 0.0]]), np.eye(3)[None] * 0.09
    likelihood = Likelihood(np.ones((1, 1)), np.ones(1), np.log(1e-4), 21.1, 1.0, 0.5, 0.0, -np.inf, *USUAL)
    none = np.zeros((2, 0))
    targets = Targets(mean, covariance, np.ones((2, 1)), none, none, np.full(2, 1e-6), np.full(2, 0.9))
    pairs = candidates(targets, 2, Frame(0.0, z, noise, np.full(1, -1), np.zeros((1, 0)), *POINTS), likelihood)
    assert 0.6**2 / 0.1 > 0.4**2 / 4.09
    assert assign(pairs.start, pairs.column, pairs.cost, 1).tolist() == [0, NOBODY]
