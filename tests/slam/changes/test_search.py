"""The search against the enumeration of all hypotheses."""

from __future__ import annotations

import numpy as np
import pytest
from references import all_labellings, comparison_of, gains_of_all, slam_like_covariance, static_evidence

from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.slam.changes.search import find_changes

PRIOR = ChangesConfig(p_rotated=0.0)


def random_comparison(seed: int):
    """Seven or eight landmarks of which none, one group or two have moved; seen from an unknown start."""
    rng = np.random.default_rng(seed)
    count = 7 + seed % 2
    position = rng.uniform(-6.0, 6.0, (count, 2))
    covariance = slam_like_covariance(rng, position)
    label = rng.integers(0, 3, count) * (seed % 5 > 0)  # every fifth world is static
    steps = np.vstack([np.zeros(2), rng.normal(size=(2, 2)) * rng.choice([0.1, 0.3, 0.7])])
    e = steps[label].ravel() + rng.multivariate_normal(np.zeros(2 * count), covariance)
    return position, comparison_of(e, covariance)


@pytest.mark.parametrize("worlds", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_search_finds_the_best_of_all_hypotheses(worlds: int) -> None:
    """All sets of up to `most_groups` groups are enumerated: 3845 of seven landmarks, 18002 of eight."""
    enumerated = {count: all_labellings(count, PRIOR.most_groups) for count in (7, 8)}
    assert [len(enumerated[count]) for count in (7, 8)] == [3845, 18002]
    found = 0
    for seed in range(worlds):
        position, comparison = random_comparison(seed)
        hypotheses = exhaust(find_changes(static_evidence(position), comparison, position, 1, PRIOR))
        labels = enumerated[len(position)]
        gains = gains_of_all(labels, comparison, PRIOR)
        best = int(np.argmax(gains))
        # gains of hypotheses that are the same are the same
        row = {tuple(label): gain for label, gain in zip(labels, gains, strict=True)}
        expected = [row[tuple(label)] for label in hypotheses.label[:50]]
        np.testing.assert_allclose(hypotheses.gain[:50], expected, atol=1e-5)
        found += np.array_equal(hypotheses.label[0], labels[best])
    assert found >= 0.975 * worlds


@pytest.mark.parametrize("seeds", [range(5), pytest.param(range(5, 20), marks=pytest.mark.slow)])
def test_weights_of_what_was_kept_are_nearly_those_of_everything(seeds: range) -> None:
    """Normalised over what the climb met, the best hypothesis is about as probable as over all there are."""
    enumerated = {count: all_labellings(count, PRIOR.most_groups) for count in (7, 8)}
    worst = 0.0
    for seed in seeds:
        position, comparison = random_comparison(seed)
        hypotheses = exhaust(find_changes(static_evidence(position), comparison, position, 1, PRIOR))
        gains = gains_of_all(enumerated[len(position)], comparison, PRIOR)
        kept = 1.0 / np.exp(hypotheses.gain - hypotheses.gain[0]).sum()
        whole = 1.0 / np.exp(gains - gains.max()).sum()
        worst = max(worst, abs(kept - whole))
    print("worst", worst)
    assert worst < 0.02


def test_no_hypothesis_is_told_twice_and_the_best_comes_first() -> None:
    position, comparison = random_comparison(3)
    hypotheses = exhaust(find_changes(static_evidence(position), comparison, position, 1, ChangesConfig()))
    rows = np.column_stack([hypotheses.label, hypotheses.onset, hypotheses.turns])
    assert len(np.unique(rows, axis=0)) == len(rows)
    assert np.all(np.diff(hypotheses.gain) <= 0.0)
    for label in hypotheses.label:  # numbered by their first member
        firsts = [int(np.flatnonzero(label == g)[0]) for g in range(1, label.max() + 1)]
        assert firsts == sorted(firsts)


def test_large_maps_are_searched_among_their_likeliest() -> None:
    rng = np.random.default_rng(5)
    position = rng.uniform(-20.0, 20.0, (60, 2))
    covariance = 0.03**2 * np.eye(120)
    e = 0.03 * rng.normal(size=120)
    moved = np.array([3, 30, 31, 59])
    e.reshape(60, 2)[moved] += [0.3, -0.2]
    hypotheses = exhaust(find_changes(static_evidence(position), comparison_of(e, covariance), position, 1, PRIOR))
    np.testing.assert_array_equal(np.flatnonzero(hypotheses.label[0]), moved)
    np.testing.assert_allclose(hypotheses.motion[0, 0, :2], [0.3, -0.2], atol=0.05)
