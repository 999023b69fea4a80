"""Changes against brute force, and as a person would call them."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import PersistConfig
from evermap.existence.one_stay import OneStay
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Looks
from evermap.runs.persist.changes import Changes, find_changes
from evermap.survival import Exponential


def walk(p: list[float], confidence: float) -> list[tuple[int, int, bool]]:
    """The rule in words: since which look the old state was sure, at which look the new one is, and what it is."""
    found, state, since = [], 0, -1
    for k, belief in enumerate(p):
        new = 1 if belief >= confidence else -1 if belief <= 1.0 - confidence else 0
        if new and state and new != state:
            found.append((since, k, new == 1))
        if new and new != state:
            state, since = new, k
    return found


def posterior(looks: Looks, entered: int, decided: int, returned: bool) -> np.ndarray:
    """Weight of the change in each gap of a window, one product of likelihoods at a time."""
    weights = []
    for k in range(entered, decided):
        product = looks.stamp_s[k + 1] - looks.stamp_s[k]
        for j in range(entered + 1, decided + 1):
            there = (j <= k) != returned
            p_hit = 1.0 - looks.p_miss[j] if there else looks.p_false[j]
            product *= p_hit if looks.detected[j] == 1.0 else 1.0 - p_hit
        weights.append(product)
    return np.asarray(weights / np.sum(weights))


def noisy(seed: int, n_features: int = 5, n: int = 600) -> Looks:
    rng = np.random.default_rng(seed)
    feature, time = rng.integers(0, n_features, n), rng.random(n) * 1000.0
    there = np.sin(time / 60.0 + feature) > -0.3
    detected = np.where(there, rng.random(n) > 0.15, rng.random(n) < 0.1)
    return Looks.from_rows(feature, time, detected, rng.uniform(0.1, 0.2, n), rng.uniform(0.05, 0.15, n))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 4))])
def test_decisions_and_intervals_equal_brute_force(seed: int) -> None:
    looks = noisy(seed)
    p = PhaseType.two_state(1 / 200, 1 / 100).track(looks).p_present
    found = find_changes(looks, p, 0.9)
    expected = []
    for feature in range(looks.n_features):
        mine = looks.of(feature)
        beliefs = p[looks.first[feature] : looks.first[feature + 1]].tolist()
        for entered, decided, returned in walk(beliefs, 0.9):
            cumulative = np.cumsum(posterior(mine, entered, decided, returned))
            first, last = (
                np.argmax(cumulative >= PersistConfig().tail),
                np.argmax(cumulative >= 1.0 - PersistConfig().tail),
            )
            edges = mine.stamp_s[entered : decided + 1]
            median = np.interp(0.5, np.concatenate([[0.0], cumulative]), edges)
            confidence = beliefs[decided] if returned else 1.0 - beliefs[decided]
            row = (feature, returned, median, edges[first], edges[last + 1], mine.stamp_s[decided], confidence)
            expected.append(row)
    expected.sort(key=lambda row: row[5])
    assert len(expected) > 20
    assert len(found) == len(expected)
    for k, name in enumerate(Changes.__slots__):
        np.testing.assert_allclose(getattr(found, name), [row[k] for row in expected], rtol=1e-9, err_msg=name)
    assert (found.earliest_s <= found.stamp_s).all()
    assert (found.stamp_s <= found.latest_s).all()
    np.testing.assert_array_equal(found.per_feature(5), np.bincount([row[0] for row in expected], minlength=5))


def test_a_perfect_detector_leaves_one_gap() -> None:
    looks = Looks.from_rows([0] * 6, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0], [1, 1, 0, 0, 1, 1], 0.0, 0.0)
    found = find_changes(looks, PhaseType.two_state(0.01, 0.01).track(looks).p_present, 0.95)
    np.testing.assert_array_equal(found.returned, [False, True])
    np.testing.assert_array_equal(found.earliest_s, [10.0, 30.0])
    np.testing.assert_array_equal(found.latest_s, [20.0, 40.0])
    np.testing.assert_allclose(found.stamp_s, [15.0, 35.0])


def test_one_miss_is_no_change_and_the_interval_holds_the_truth() -> None:
    time = np.arange(0.0, 100.0, 5.0)
    detected = (time < 50.0).astype(float)
    detected[4] = 0.0  # a miss at 20 s, long before it leaves
    looks = Looks.from_rows(np.zeros(20, dtype=int), time, detected, 0.1, 0.1)
    found = find_changes(looks, OneStay(Exponential(0.01)).track(looks).p_present, 0.9)
    assert len(found) == 1
    assert not found.returned[0]
    assert 30.0 <= found.earliest_s[0] <= 45.0
    assert 45.0 < found.stamp_s[0] < 50.0
    assert found.latest_s[0] >= 50.0
    assert found.decided_s[0] > 50.0


def test_no_looks_no_changes() -> None:
    looks = Looks.from_rows(np.zeros(0, dtype=int), [], [], 0.1, 0.1, n_features=3)
    assert len(find_changes(looks, np.zeros(0), 0.9)) == 0
