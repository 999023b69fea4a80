"""The search over pairings, against all subsets written down one by one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from evermap.slam.association.jcbb import Pairings, most_pairings, pairing_probability
from evermap.types import FloatArray


def random_pairings(
    seed: int, n_sources: int = 3, n_targets: int = 4, share: float = 0.6, spread: float = 1.5
) -> Pairings:
    """Pairings whose innovations share a common error, some of them too large."""
    rng = np.random.default_rng(seed)
    source, target = np.nonzero(rng.random((n_sources, n_targets)) < share)
    count = len(source)
    by_pose = rng.normal(size=(2 * count, 3))
    own = rng.normal(size=(2 * count, 2 * count))
    covariance = by_pose @ by_pose.T + 0.1 * own @ own.T + 0.3 * np.eye(2 * count)
    innovation = spread * rng.multivariate_normal(np.zeros(2 * count), covariance).reshape(-1, 2)
    return Pairings(source, target, innovation, covariance, rng.normal(-3.0, 1.0, count), n_sources)


def compatible_sets(pairings: Pairings, confidence: float) -> list[tuple[tuple[int, ...], float, float]]:
    """Every set of pairings that passes, built up source by source, with distance and log weight.

    Sources come in the order of the search: those with fewest pairings first, and of these the most probable one.
    """
    options = [[-1, *np.flatnonzero(pairings.source == s).tolist()] for s in range(pairings.n_sources)]
    options.sort(key=lambda rows: (len(rows), -max((log_weight(pairings, (k,)) for k in rows[1:]), default=-np.inf)))
    found = []
    for choice in itertools.product(*options):
        rows = tuple(k for k in choice if k >= 0)
        if len(set(pairings.target[list(rows)])) < len(rows):
            continue
        distances = [distance_of(pairings, rows[:n]) for n in range(1, len(rows) + 1)]
        if all(d <= chi2.ppf(confidence, 2 * n) for n, d in enumerate(distances, start=1)):
            found.append((rows, distances[-1] if rows else 0.0, log_weight(pairings, rows)))
    return found


def distance_of(pairings: Pairings, rows: tuple[int, ...]) -> float:
    columns = [2 * k + a for k in rows for a in range(2)]
    e = pairings.innovation[list(rows)].ravel()
    return float(e @ np.linalg.inv(pairings.covariance[np.ix_(columns, columns)]) @ e)


def log_weight(pairings: Pairings, rows: tuple[int, ...]) -> float:
    if not rows:
        return 0.0
    columns = [2 * k + a for k in rows for a in range(2)]
    density = multivariate_normal(cov=pairings.covariance[np.ix_(columns, columns)])
    return float(density.logpdf(pairings.innovation[list(rows)].ravel()) - pairings.log_density_new[list(rows)].sum())


@pytest.mark.parametrize("seed", range(40))
def test_branch_and_bound_equals_all_subsets(seed: int) -> None:
    pairings = random_pairings(seed)
    found = most_pairings(pairings, confidence=0.95)
    rows, distance, _ = min(compatible_sets(pairings, 0.95), key=lambda item: (-len(item[0]), item[1]))
    chosen = tuple(found[found >= 0])
    assert set(chosen) == set(rows)
    assert distance_of(pairings, chosen) == pytest.approx(distance, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", range(40))
def test_probabilities_are_those_of_bayes_rule(seed: int) -> None:
    pairings = random_pairings(seed)
    probability, evidence = pairing_probability(pairings, confidence=0.99)
    sets = compatible_sets(pairings, 0.99)
    weight = np.exp([w for *_, w in sets])
    expected = [
        sum(w for (rows, *_), w in zip(sets, weight, strict=True) if k in rows) for k in range(len(probability))
    ]
    np.testing.assert_allclose(probability, np.array(expected) / weight.sum(), rtol=1e-9, atol=1e-15)
    assert evidence == pytest.approx(np.log(weight.sum()), abs=1e-9)


def frame_of_clusters(n_doubtful: int, n_certain: int = 26) -> tuple[Pairings, FloatArray]:
    """A frame of a lidar whose detections share no error, so that each is by itself; and the probabilities."""
    rng = np.random.default_rng(n_doubtful)
    first = rng.normal(0.0, 0.6, (n_certain + n_doubtful, 3))
    other = rng.normal(0.0, 0.9, (n_doubtful, 2, 3))
    source = np.concatenate([np.repeat(np.arange(n_doubtful), 2), np.arange(n_certain + n_doubtful)])
    innovation = np.concatenate([other.reshape(-1, 3), first])
    order = np.argsort(source, kind="stable")
    source, innovation = source[order], innovation[order]
    new = np.full(len(source), -8.0)
    weight = np.exp(-0.5 * (innovation**2).sum(axis=1) - 1.5 * np.log(2.0 * np.pi) - new)
    total = 1.0 + np.bincount(source, weight)
    k = len(source)
    pairings = Pairings(source, np.arange(k), innovation, np.eye(3 * k), new, len(first), np.zeros(k))
    return pairings, weight / total[source]


@pytest.mark.parametrize(("n_doubtful", "most"), [(1, 2e-3), (2, 2e-3), (4, 0.05), (6, 0.05)])
def test_all_detections_of_a_full_frame_have_their_alternatives(n_doubtful: int, most: float) -> None:
    # a search that is cut would hold what comes first in the tree for certain: .78 too much in a lidar's frame
    pairings, expected = frame_of_clusters(n_doubtful)
    probability, _ = pairing_probability(pairings, confidence=1.0 - 1e-12)
    np.testing.assert_allclose(probability, expected, atol=most)


def test_a_pairing_that_contradicts_the_others_is_left_out() -> None:
    # two detections say that the robot is 1 m further to the left; the third alone would say to the right
    shift = np.array([[0.0, 1.0], [0.0, 1.0], [0.0, -1.0]])
    covariance = np.tile(np.eye(2), (3, 3)) + 0.01 * np.eye(6)
    pairings = Pairings(np.arange(3), np.arange(3), shift, covariance, np.full(3, -2.0), 3)
    assert most_pairings(pairings).tolist() == [0, 1, -1]


def test_one_landmark_is_seen_once_in_a_frame() -> None:
    pairings = Pairings(np.array([0, 1]), np.array([7, 7]), np.zeros((2, 2)), np.eye(4), np.zeros(2), 2)
    assert (most_pairings(pairings) >= 0).sum() == 1


def test_nothing_to_pair() -> None:
    pairings = Pairings(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros((0, 0)), np.zeros(0), 2)
    assert most_pairings(pairings).tolist() == [-1, -1]
    assert len(pairing_probability(pairings)[0]) == 0
