"""Each landmark is detected at a rate of its own: beside the distribution they are drawn from, and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import betaln
from scipy.stats import beta

from evermap.sensing import in_sight
from evermap.sensing.in_sight import LEVELS, Positions, weigh_never_seen
from evermap.types import BoolArray, FloatArray, IntArray

NEVER_HIDDEN = np.array([1e-9])
SURELY_GONE = 1.0 - 1e-9
"""So that what is asked says nothing of the others."""


def count_positions(seen: IntArray, of: IntArray, worth: float = 1.0) -> Positions:
    """Places (P,) that are looked at from so many positions and seen from some of them."""
    place = np.repeat(np.arange(len(of)), of)
    hit = np.concatenate([np.arange(n) < x for x, n in zip(seen, of, strict=True)])
    return Positions(place, np.full(len(place), worth), hit, np.ones(len(place), dtype=np.bool_))


@pytest.mark.parametrize(("a", "b"), [(2.0, 1.0), (12.0, 2.0), (0.8, 0.4)])
def test_rates_are_learned_from_what_was_detected_at_all(a: float, b: float) -> None:
    """Landmarks that were never detected are left out, so that those that are detected often are too many."""
    rng = np.random.default_rng(2)
    positions = rng.integers(5, 30, 2000)
    seen = rng.binomial(positions, rng.beta(a, b, len(positions)))
    asked = np.array([3, 8, 20])
    known = seen > 0
    every = count_positions(np.append(seen[known], np.zeros(3, np.int64)), np.append(positions[known], asked))
    unseen = np.arange(known.sum() + 3) >= known.sum()
    found = weigh_never_seen(every, unseen, NEVER_HIDDEN, SURELY_GONE)[unseen]
    true = np.exp(betaln(a, b + asked) - betaln(a, b))
    assert np.abs(np.log(found / true) / np.log(true)).max() < 0.12
    np.testing.assert_array_equal(weigh_never_seen(every, unseen, NEVER_HIDDEN, SURELY_GONE)[~unseen], 1.0)


def brute_force(
    seen: Positions, unseen: BoolArray, hidden: FloatArray, p_gone: float, at_first: FloatArray
) -> FloatArray:
    """The same, place by place, as means over quantiles of the shares."""
    p, names = np.ones(len(unseen)), range(len(unseen))
    log_weight, p_missed = [], list[dict[int, float]]()
    for a in in_sight.SHARES:
        for b in in_sight.SHARES:
            q = beta.ppf((np.arange(500) + 0.5) / 500, a, b)
            log_fit, by_chance = float(at_first @ np.log([a / (a + b), b / (a + b)])), {}
            for name in names:
                rows = np.flatnonzero(seen.place == name)
                counted = [k for k in rows if seen.counts[k]]
                others = [k for k in rows if not seen.counts[k]]
                if not counted:
                    continue
                if unseen[name]:
                    by_chance[name] = np.prod([1.0 - seen.worth[k] * q for k in counted], axis=0).mean()
                    continue
                likely = np.prod(
                    [seen.worth[k] * q if seen.hit[k] else 1.0 - seen.worth[k] * q for k in counted], axis=0
                )
                if not seen.hit[counted].any():
                    likely = likely * (1.0 - np.prod([1.0 - seen.worth[k] * q for k in others], axis=0))
                ever = 1.0 - np.prod([1.0 - seen.worth[k] * q for k in rows], axis=0)
                log_fit += np.log(likely.mean() / ever.mean())
            n_known = sum(not unseen[name] and seen.counts[seen.place == name].any() for name in names)
            for h in hidden:
                log_weight.append(log_fit + n_known * np.log(1.0 - h) - 0.5 * np.log(h))
                p_missed.append({name: h + (1.0 - h) * value for name, value in by_chance.items()})
    for name in p_missed[0]:
        rest = [
            sum(np.log(p_gone + (1.0 - p_gone) * value) for other, value in one.items() if other != name)
            for one in p_missed
        ]
        weight = np.exp(np.add(log_weight, rest) - np.max(np.add(log_weight, rest)))
        p[name] = weight @ [one[name] for one in p_missed] / weight.sum()
    return p


@pytest.mark.parametrize("at_first", [np.zeros(2), np.array([4.75, 0.25])])
def test_it_is_what_brute_force_says(at_first: FloatArray, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four known landmarks, of which the last one was seen only by looks that do not count, and two unseen ones."""
    monkeypatch.setattr(in_sight, "SHARES", np.geomspace(0.25, 16.0, 4))
    rows = [
        *[(0, 87, k < 2, k < 3) for k in range(4)],
        *[(1, 62, k > 0, True) for k in range(3)],
        *[(2, 99, k == 0, True) for k in range(6)],
        *[(3, 77, k == 5, k < 4) for k in range(6)],
        *[(4, 92, False, True) for k in range(4)],
        *[(5, 45, False, k < 5) for k in range(7)],
    ]
    place, level, hit, counts = (np.array(column) for column in zip(*rows, strict=True))
    seen = Positions(place, (level + 0.5) / LEVELS, hit, counts)
    unseen, hidden = np.arange(6) >= 4, np.array([0.01, 0.1, 0.4])
    found = weigh_never_seen(seen, unseen, hidden, 0.03, at_first)
    np.testing.assert_allclose(found, brute_force(seen, unseen, hidden, 0.03, at_first), rtol=0.02)


def test_where_all_that_is_asked_was_missed_it_is_hidden_not_gone() -> None:
    """As behind walls: twenty landmarks that are missed say of each other that misses are no departures."""
    known = 20
    for n_missed, low, high in ((1, 0.0, 0.06), (20, 0.3, 1.0)):
        positions = np.full(known + n_missed, 10)
        seen = count_positions(np.where(np.arange(len(positions)) < known, 9, 0), positions)
        unseen = np.arange(len(positions)) >= known
        p = weigh_never_seen(seen, unseen, np.geomspace(0.003, 0.99, 20), 0.03)[unseen]
        assert (low < p).all()
        assert (p < high).all()


def test_looks_from_one_position_are_one_and_consecutive_ones_count_as_fewer() -> None:
    place = np.array([3, 3, 3, 3, 5])
    cell = np.array([[0, 0], [0, 0], [0, 1], [0, 0], [0, 0]])
    p_detect, hit = np.array([0.5, 0.2, 0.3, 0.9, 0.999]), np.array([False, True, False, False, False])
    counts = np.array([True, True, True, False, True])
    seen = Positions.of(place, cell, p_detect, hit, counts, sticky=2.0)
    found = {(int(p), bool(c), round(float(w), 9)): bool(h) for p, w, h, c in zip(*seen, strict=True)}
    assert found == {
        (3, True, round(1.0 - (0.5 * 0.8) ** 0.5, 9)): True,
        (3, True, round(1.0 - 0.7**0.5, 9)): False,
        (3, False, round(1.0 - 0.1**0.5, 9)): False,
        (5, True, round(1.0 - 0.01**0.5, 9)): False,
    }


def test_without_looks_nothing_is_said() -> None:
    none = np.zeros(0, dtype=np.int64)
    seen = Positions(none, np.zeros(0), none.astype(np.bool_), none.astype(np.bool_))
    np.testing.assert_array_equal(weigh_never_seen(seen, np.ones(3, dtype=np.bool_), np.array([0.1]), 0.03), 1.0)
