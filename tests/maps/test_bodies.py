"""Bodies of a living map, split and joined after a session."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap import se2
from evermap.maps.bodies import with_bodies
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.types import FloatArray, IntArray

REACH_M = 1.6
CORNERS = np.array([[0.0, 0.0], [0.6, 0.0], [0.6, 0.4], [1.2, 0.3]])
VARIANCE_M2 = 4e-4


def a_map(
    clique: list[int], site_of: dict[int, dict[int, FloatArray]], p_here: dict[int, float], hits: int = 20
) -> LivingMap:
    """Landmarks 10, 11 ...; for every site the places of some of them, by the number of the landmark."""
    count = len(clique)
    rows = [(site, 10 + k, *place) for site, places in site_of.items() for k, place in places.items()]
    site_id, landmark_id = (np.array([row[c] for row in rows], dtype=np.int64) for c in (0, 1))
    owner = {site: clique[next(iter(places))] for site, places in site_of.items()}
    names = np.array(list(site_of), dtype=np.int64)
    cliques = np.array([owner[site] for site in site_of], dtype=np.int64)
    ones = np.ones(len(names))
    stays = Stays(
        cliques,
        names,
        0 * names,
        np.zeros((len(names), 2)),
        -np.inf * ones,
        1.0 * names,
        2.0 * ones + names,
        np.inf * ones,
    )
    off, counts = np.zeros(count, np.bool_), np.full(len(rows), hits)
    return LivingMap(
        stamp_s=100.0,
        members=Members(10 + np.arange(count), np.zeros(count, np.int64), np.array(clique), off, off),
        sites=Sites(names, cliques, np.array([p_here[site] for site in site_of]), 1.0 * names, 2.0 + names),
        places=Places(site_id, landmark_id, np.array([row[2:] for row in rows]), counts, counts),
        covariance_m2=VARIANCE_M2 * np.eye(2 * len(rows)) + 1e-6,
        stays=stays,
        class_names=("thing",),
        n_cliques_ever=10,
        n_sites_ever=20,
    )  # fmt: skip


def seen_again(living: LivingMap, site_of: dict[int, list[int]], hits: int = 15, misses: int = 15) -> LivingMap:
    """More hits and misses of the landmarks at some sites."""
    mine = np.array(
        [
            int(name) - 10 in site_of.get(int(site), [])
            for site, name in zip(living.places.site_id, living.places.landmark_id, strict=True)
        ]
    )
    places = living.places
    return replace(
        living, places=replace(places, n_hits=places.n_hits + hits * mine, n_misses=places.n_misses + misses * mine)
    )


def check(living: LivingMap) -> None:
    """What every living map keeps to."""
    assert (np.diff(living.sites.site_id) > 0).all()
    pairs = np.stack([living.places.site_id, living.places.landmark_id], axis=1)
    assert (np.lexsort(pairs.T[::-1]) == np.arange(len(pairs))).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert set(living.places.site_id) == set(living.sites.site_id)
    clique_of = dict(zip(living.members.landmark_id.tolist(), living.members.clique_id.tolist(), strict=True))
    at = np.searchsorted(living.sites.site_id, living.places.site_id)
    assert living.sites.clique_id[at].tolist() == [clique_of[name] for name in living.places.landmark_id.tolist()]
    assert (living.members.clique_id < living.n_cliques_ever).all()
    assert (living.sites.site_id < living.n_sites_ever).all()
    assert (np.diff(living.stays.first_s) >= 0).all()
    for clique in np.unique(living.sites.clique_id):
        assert living.sites.p_here[living.sites.clique_id == clique].sum() <= 1.0 + 1e-12
    assert np.allclose(living.covariance_m2, living.covariance_m2.T)


def bodies(living: LivingMap) -> set[frozenset[int]]:
    label: IntArray = living.members.clique_id
    return {frozenset((living.members.landmark_id[label == name] - 10).tolist()) for name in np.unique(label)}


def test_nothing_changes_where_all_stay() -> None:
    before = a_map([0, 0, 0, 0], {0: dict(enumerate(CORNERS))}, {0: 0.9})
    after = seen_again(before, {0: [0, 1, 2, 3]})
    assert with_bodies(before, after, reach_m=REACH_M) is after


def test_a_first_session_leaves_its_bodies_as_they_are() -> None:
    after = a_map([0, 0, 0, 0], {0: dict(enumerate(CORNERS))}, {0: 0.9})
    assert with_bodies(LivingMap(), after, reach_m=REACH_M) is after


def test_a_part_that_is_missed_while_the_rest_is_seen_becomes_a_body() -> None:
    before = a_map([3, 3, 3, 3], {0: dict(enumerate(CORNERS)), 1: dict(enumerate(CORNERS + 2.0))}, {0: 0.1, 1: 0.8})
    after = seen_again(seen_again(before, {1: [0, 1]}), {1: [2, 3]}, hits=0, misses=40)
    found = with_bodies(before, after, reach_m=REACH_M)
    check(found)
    assert bodies(found) == {frozenset({0, 1}), frozenset({2, 3})}
    assert len(found.sites) == 4  # both sites for both bodies
    np.testing.assert_allclose(found.p_exists(), after.p_exists())
    assert len(found.stays) == 4
    assert found.members.clique_id.tolist() == [3, 3, 10, 10]
    kept = found.landmarks()
    np.testing.assert_allclose(kept.position_m, after.landmarks().position_m)
    np.testing.assert_allclose(kept.covariance_m2, after.landmarks().covariance_m2)


def test_a_few_misses_part_nobody() -> None:
    before = a_map([3, 3, 3, 3], {0: dict(enumerate(CORNERS))}, {0: 0.9})
    after = seen_again(seen_again(before, {0: [0, 1]}), {0: [2, 3]}, hits=0, misses=4)
    assert with_bodies(before, after, reach_m=REACH_M) is after


def test_misses_of_all_alike_part_nobody() -> None:
    """Hidden from where the robot looked: its fellows were missed as often."""
    before = a_map([3, 3, 3, 3], {0: dict(enumerate(CORNERS))}, {0: 0.9})
    after = seen_again(seen_again(before, {0: [0, 1, 2]}, hits=1, misses=60), {0: [3]}, hits=0, misses=60)
    assert with_bodies(before, after, reach_m=REACH_M) is after


def test_two_bodies_that_moved_as_one_are_one() -> None:
    moved = se2.move_together(CORNERS, np.array([2.0, -1.0]), 0.6)
    own, other = {0: CORNERS[0], 1: CORNERS[1]}, {2: CORNERS[2], 3: CORNERS[3]}
    elsewhere = {2: CORNERS[2] + 5.0, 3: CORNERS[3] + 5.0}
    before = a_map([2, 2, 5, 5], {0: own, 1: other, 2: elsewhere}, {0: 0.9, 1: 0.7, 2: 0.2})
    sites = {0: own, 1: other, 2: elsewhere, 3: {0: moved[0], 1: moved[1]}, 4: {2: moved[2], 3: moved[3]}}
    after = a_map([2, 2, 5, 5], sites, {0: 0.02, 1: 0.05, 2: 0.05, 3: 0.9, 4: 0.8})
    found = with_bodies(before, after, reach_m=REACH_M)
    check(found)
    assert bodies(found) == {frozenset({0, 1, 2, 3})}
    assert found.sites.site_id.tolist() == [0, 2, 3]
    np.testing.assert_allclose(found.sites.p_here, [0.035, 0.025, 0.85])
    assert found.places.landmark_id[found.places.site_id == 3].tolist() == [10, 11, 12, 13]
    np.testing.assert_allclose(found.landmarks().position_m, moved)
    assert found.stays.site_id.tolist() == [0, 3]  # the history of the elder
    assert (found.stays.clique_id == found.members.clique_id[0]).all()


def test_two_bodies_that_moved_each_its_own_way_stay_two() -> None:
    own, other = {0: CORNERS[0], 1: CORNERS[1]}, {2: CORNERS[2], 3: CORNERS[3]}
    before = a_map([2, 2, 5, 5], {0: own, 1: other}, {0: 0.9, 1: 0.7})
    near = se2.move_together(CORNERS[2:], np.array([0.2, 0.5]), 1.0)
    new = {3: {0: CORNERS[0] + 0.4, 1: CORNERS[1] + 0.4}, 4: {2: near[0], 3: near[1]}}
    after = a_map([2, 2, 5, 5], {0: own, 1: other, **new}, {0: 0.02, 1: 0.05, 3: 0.9, 4: 0.8})
    assert with_bodies(before, after, reach_m=REACH_M) is after


def test_a_body_whose_parts_moved_apart_is_two_with_histories_of_their_own() -> None:
    first = {0: dict(enumerate(CORNERS))}
    before = a_map([2, 2, 2, 2], first, {0: 0.9})
    apart = {1: {0: CORNERS[0] + 1.0, 1: CORNERS[1] + 1.0, 2: CORNERS[2] - 1.0, 3: CORNERS[3] - 1.0}}
    after = a_map([2, 2, 2, 2], {**first, **apart}, {0: 0.05, 1: 0.9})
    found = with_bodies(before, after, reach_m=REACH_M)
    check(found)
    assert bodies(found) == {frozenset({0, 1}), frozenset({2, 3})}
    assert len(found.sites) == 4
    assert np.bincount(found.stays.clique_id)[found.members.clique_id[[0, 2]]].tolist() == [2, 2]
    np.testing.assert_allclose(found.landmarks().position_m, after.landmarks().position_m)
