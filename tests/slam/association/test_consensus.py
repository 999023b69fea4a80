"""Pairs of landmarks that are one, weighed together: against all sets, tried one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from evermap.slam.association.consensus import Candidates, consensus

LOOSE = 60.0
GATE = 13.8


def candidates(seed: int, n_landmarks: int = 4, drift_m: float = 2.0) -> tuple[Candidates, np.ndarray]:
    """A robot that has drifted meets landmarks again; each may be any of three. Which pairs are true."""
    rng = np.random.default_rng(seed)
    old = rng.uniform(0.0, 6.0, (n_landmarks, 2))
    shift = drift_m * rng.normal(size=2)
    new = old + shift + 0.05 * rng.normal(size=old.shape)
    younger, older = (each.ravel() for each in np.meshgrid(range(n_landmarks), range(n_landmarks), indexing="ij"))
    near = np.linalg.norm(new[younger] - old[older], axis=1) < 3.5 * drift_m
    younger, older = younger[near], older[near]
    count = len(younger)
    covariance = np.kron(np.ones((count, count)), drift_m**2 * np.eye(2))
    same = (younger[:, None] == younger[None]).astype(float) + (older[:, None] == older[None])
    covariance += np.kron(same, 0.05**2 * np.eye(2))
    conflict = ((younger[:, None] == younger[None]) | (older[:, None] == older[None])) & ~np.eye(count, dtype=bool)
    return Candidates(new[younger] - old[older], covariance, np.full(count, np.log(0.1)), conflict), younger == older


def evidence(made: Candidates, rows: tuple[int, ...]) -> float:
    at = np.array([[2 * k, 2 * k + 1] for k in rows]).ravel()
    own = made.covariance[np.ix_(at, at)]
    return float(
        multivariate_normal.logpdf(made.difference[list(rows)].ravel(), np.zeros(len(at)), own, allow_singular=True)
        - made.log_density[list(rows)].sum()
    )


@pytest.mark.parametrize("seed", range(8))
def test_the_best_set_is_that_of_all_sets(seed: int) -> None:
    made, true = candidates(seed)
    found = consensus(made, gate=GATE, loose=LOOSE)
    every = {
        rows: evidence(made, rows)
        for size in range(1, 5)
        for rows in itertools.combinations(range(len(true)), size)
        if not made.conflict[np.ix_(rows, rows)].any()
    }
    best = max(every, key=lambda rows: every[rows])
    assert sorted(found.pairs.tolist()) == list(best)
    assert found.evidence == pytest.approx(every[best], abs=1e-6)
    for pair, margin in zip(found.pairs.tolist(), found.margin, strict=True):
        rest = max([0.0, *(value for rows, value in every.items() if pair not in rows)])
        assert margin >= every[best] - rest - 1e-6  # greedy: no better than the best of all


def test_true_pairs_are_found_behind_a_drift_of_several_spacings() -> None:
    made, true = candidates(3, n_landmarks=8)
    found = consensus(made, gate=GATE, loose=LOOSE)
    assert np.all(true[found.pairs])
    assert len(found.pairs) == 8
    assert np.all(found.margin > 3.0)


def test_landmarks_at_one_distance_from_each_other_are_in_doubt() -> None:
    """A row of landmarks 1 m apart fits as well when moved by one."""
    covariance = np.kron(np.ones((4, 4)), np.eye(2)) + 1e-3 * np.eye(8)
    difference = np.array([[0.5, 0.0], [0.5, 0.0], [-0.5, 0.0], [-0.5, 0.0]])
    conflict = np.zeros((4, 4), dtype=bool)
    conflict[:2, 2:] = conflict[2:, :2] = True
    found = consensus(Candidates(difference, covariance, np.full(4, np.log(0.01)), conflict), gate=GATE, loose=LOOSE)
    assert len(found.pairs) == 2
    assert np.all(found.margin < 1.0)


def test_nothing_to_compare() -> None:
    none = Candidates(np.zeros((0, 2)), np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0), dtype=bool))
    assert len(consensus(none, gate=GATE, loose=LOOSE).pairs) == 0


def test_what_follows_from_other_pairs_is_neither_evidence_nor_a_rival() -> None:
    """Three landmarks in space that are one: two pairs say it all, and each of them is certain."""
    place = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.01], [0.0, 0.03, 0.0]])
    ends = np.array([[1, 0], [2, 0], [2, 1]])
    by = np.kron(np.eye(3)[ends[:, 0]] - np.eye(3)[ends[:, 1]], np.eye(3))
    made = Candidates(
        place[ends[:, 0]] - place[ends[:, 1]], 4e-4 * by @ by.T, np.full(3, np.log(0.01)), np.zeros((3, 3), bool), ends
    )
    found = consensus(made, gate=16.3, loose=LOOSE)
    assert len(found.pairs) == 2
    np.testing.assert_array_less(8.0, found.margin)
