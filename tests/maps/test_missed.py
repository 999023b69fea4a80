"""Members of a body that are missed alone, and places that are never seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import betaln

from evermap.maps.bodies import without_missed
from evermap.maps.living import LivingMap, Members, Places, Sites
from evermap.maps.sessions.looks import _p_never_in_sight

LANDMARKS = 10 + np.arange(4)
OFF = np.zeros(4, np.bool_)


def body(hits: int = 60, misses: int = 40) -> LivingMap:
    """Four landmarks of one clique at the second of two sites, with counts."""
    site = np.repeat([0, 1], 4)
    counts = np.full(8, hits), np.full(8, misses)
    return LivingMap(
        stamp_s=100.0,
        members=Members(LANDMARKS, np.zeros(4, np.int64), np.full(4, 3), OFF, OFF),
        sites=Sites(
            np.arange(2), np.full(2, 3), np.array([0.1, 0.8]), np.array([0.0, 0.7]), np.zeros(2), np.full(2, 50.0)
        ),
        places=Places(site, np.tile(LANDMARKS, 2), np.random.default_rng(0).normal(size=(8, 2)), *counts),
        covariance_m2=1e-3 * np.eye(16),
        n_cliques_ever=10,
        n_sites_ever=20,
    )


def looked(living: LivingMap, hits: list[int], misses: list[int]) -> LivingMap:
    """After a session that counted these at the second site."""
    places = living.places
    counted = replace(
        places,
        n_hits=places.n_hits + np.concatenate([np.zeros(4, np.int64), hits]),
        n_misses=places.n_misses + np.concatenate([np.zeros(4, np.int64), misses]),
    )
    return replace(living, places=counted)


def test_members_that_are_missed_while_others_are_seen_are_a_body_of_their_own() -> None:
    after = looked(body(), [25, 30, 0, 0], [20, 20, 50, 45])
    found = without_missed(body(), after)
    assert found.members.clique_id.tolist() == [3, 3, 10, 10]
    assert len(found.sites) == 4  # both sites for both
    np.testing.assert_allclose(found.p_exists(), after.p_exists())
    np.testing.assert_allclose(found.landmarks().position_m, after.landmarks().position_m)
    np.testing.assert_allclose(found.landmarks().covariance_m2, after.landmarks().covariance_m2)


def test_a_few_misses_part_nobody() -> None:
    after = looked(body(), [25, 30, 0, 0], [20, 20, 9, 7])
    assert without_missed(body(), after) is after


def test_what_was_hidden_from_all_parts_nobody() -> None:
    after = looked(body(), [2, 0, 1, 0], [60, 60, 60, 60])
    assert without_missed(body(), after) is after


def test_what_was_hardly_ever_seen_owes_nothing() -> None:
    before = body()
    rare = replace(before.places, n_hits=before.places.n_hits.copy(), n_misses=before.places.n_misses.copy())
    rare.n_hits[7], rare.n_misses[7] = 3, 200
    before = replace(before, places=rare)
    after = looked(before, [25, 30, 28, 0], [20, 20, 20, 60])
    assert without_missed(before, after) is after


def test_a_first_session_leaves_bodies_as_they_are() -> None:
    assert without_missed(LivingMap(), body()).members.clique_id.tolist() == [3, 3, 3, 3]


def test_an_empty_map_stays_empty() -> None:
    assert len(without_missed(LivingMap(), LivingMap()).members) == 0


def test_how_likely_a_place_is_in_sight_from_nowhere_is_learned_from_what_was_seen():
    """Against the beta distribution that shares were drawn from, places that were never seen left out."""
    rng = np.random.default_rng(2)
    positions = rng.integers(5, 30, 600)
    for a, b in ((2.0, 1.0), (12.0, 2.0)):
        seen = rng.binomial(positions, rng.beta(a, b, len(positions)))
        found = _p_never_in_sight(seen[seen > 0], positions[seen > 0], np.array([3, 8, 20]))
        true = np.exp(betaln(a, b + np.array([3, 8, 20])) - betaln(a, b))
        assert np.abs(np.log(found / true) / np.log(true)).max() < 0.12
    few = _p_never_in_sight(seen[:5], positions[:5], np.array([20]))
    assert few > found[2]  # five places say little
