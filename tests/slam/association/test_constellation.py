"""Maps laid over each other by their shape."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.geometry import se2
from evermap.slam.association.constellation import LocalMap, list_agreed_pairs, overlays

MOTION = np.array([4.0, -7.0, 2.2])


def some_map(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(0.0, 12.0, (count, 2))


def seen_from_elsewhere(place: np.ndarray, rng: np.random.Generator, sigma: float = 0.03) -> LocalMap:
    """The places in a frame of their own, measured."""
    seen = se2.transform(se2.inverse(MOTION), place) + sigma * rng.normal(size=place.shape)
    return LocalMap(seen, sigma**2 * np.eye(2 * len(place)))


def exact(place: np.ndarray) -> LocalMap:
    return LocalMap(place, 1e-6 * np.eye(2 * len(place)))


@pytest.mark.parametrize("seed", range(10))
def test_a_part_of_a_map_is_found_in_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = some_map(rng, 15)
    part = rng.permutation(15)[:6]
    source = seen_from_elsewhere(place[part], rng)
    pairs = list_agreed_pairs(source, exact(place), np.ones((6, 15), dtype=bool), density=0.1, probability=0.97)
    assert pairs
    assert all(part[s] == t for s, t in pairs)
    best = overlays(source, exact(place), np.ones((6, 15), dtype=bool), density=0.1)[0]
    assert len(best.pairs) == 6


def test_a_landmark_that_moved_is_no_part_of_it() -> None:
    rng = np.random.default_rng(1)
    place = some_map(rng, 8)
    now = place.copy()
    now[3] += [0.4, 0.0]
    pairs = list_agreed_pairs(
        seen_from_elsewhere(now, rng), exact(place), np.ones((8, 8), bool), density=0.1, probability=0.97
    )
    assert len(pairs) >= 5
    assert all(s == t != 3 for s, t in pairs)


def test_a_map_that_looks_the_same_from_two_sides_says_nothing() -> None:
    rng = np.random.default_rng(2)
    place = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [0.0, 5.0]])
    source = seen_from_elsewhere(place, rng)
    assert not list_agreed_pairs(source, exact(place), np.ones((4, 4), bool), density=0.1, probability=0.97)


def test_another_room_is_not_this_one() -> None:
    rng = np.random.default_rng(3)
    source = seen_from_elsewhere(some_map(rng, 6), rng)
    pairs = list_agreed_pairs(source, exact(some_map(rng, 6)), np.ones((6, 6), bool), density=0.1, probability=0.97)
    assert not pairs
