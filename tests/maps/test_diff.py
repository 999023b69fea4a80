"""Differences of maps that were changed on purpose, against what was done to them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from random_maps import random_map

from evermap.maps.diff import diff, edits
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.types import ChangeKind

NOW_S = 100.0
LATER_S = 200.0
NEVER = -np.inf


def a_map(
    sites: list[tuple[int, int, float]],
    places: list[tuple[int, int, float, float]],
    *,
    cliques: dict[int, int],
    stays: list[tuple[int, int, float, float, float, float]] = (),
    hits: dict[tuple[int, int], tuple[int, int]] | None = None,
    stamp_s: float = NOW_S,
    deleted: tuple[int, ...] = (),
    pinned: tuple[int, ...] = (),
    sigma_m: float = 0.02,
) -> LivingMap:
    """A map by hand: sites (id, clique, p), places (site, landmark, x, y), stays (clique, site, four stamps)."""
    ids = np.array(sorted(cliques), dtype=np.int64)
    site, clique, p = (np.array(column) for column in zip(*sites, strict=True))
    at, name, x, y = (np.array(column) for column in zip(*places, strict=True))
    counts = np.array([(hits or {}).get((s, n), (0, 0)) for s, n in zip(at, name, strict=True)])
    rows = np.array(stays, dtype=np.float64).reshape(-1, 6)
    rows = rows[np.argsort(rows[:, 3], kind="stable")]
    return LivingMap(
        stamp_s=stamp_s,
        members=Members(
            ids,
            np.full(len(ids), -1),
            np.array([cliques[int(i)] for i in ids]),
            np.isin(ids, pinned),
            np.isin(ids, deleted),
        ),
        sites=Sites(site, clique, *np.tile(p.astype(float), (2, 1)), np.zeros(len(site)), np.full(len(site), stamp_s)),
        places=Places(at, name, np.column_stack([x, y]).astype(float), counts[:, 0], counts[:, 1]),
        stays=Stays(
            rows[:, 0].astype(np.int64),
            rows[:, 1].astype(np.int64),
            np.full(len(rows), -1),
            np.zeros((len(rows), 2)),
            *rows[:, 2:].T.copy(),
            np.isfinite(rows[:, 5]).astype(np.float64),
        ),
        covariance_m2=sigma_m**2 * np.eye(2 * len(places)),
        n_cliques_ever=100,
        n_sites_ever=100,
    )


def only(a: LivingMap, b: LivingMap):
    (change,) = diff(a, b)
    return change


def one(p: float, **more: object) -> LivingMap:
    """Landmark 5 at (1, 2) with belief p."""
    return a_map([(0, 3, p)], [(0, 5, 1.0, 2.0)], cliques={5: 3}, **more)


EMPTY = LivingMap()


@pytest.mark.parametrize("seed", range(5))
def test_a_map_differs_by_nothing_from_itself(seed: int) -> None:
    living = random_map(seed)
    assert diff(living, living) == ()
    assert edits(living, living) == ()


def told(living: LivingMap) -> dict[int, bool]:
    """Landmarks that are said to stand somewhere, and whether their place was seen empty before."""
    stays = living.stays
    result = {}
    for name, clique in zip(living.members.landmark_id.tolist(), living.members.clique_id.tolist(), strict=True):
        mine = [k for k in range(len(stays)) if stays.clique_id[k] == clique and stays.gone_s[k] == np.inf]
        deleted = living.members.deleted[living.members.landmark_id == name][0]
        if mine and not deleted:
            result[name] = bool(np.isfinite(stays.elsewhere_s[mine]).all())
    return result


def test_of_a_new_map_has_appeared_whose_place_was_seen_empty() -> None:
    living = random_map(7, cliques=12)
    found = diff(EMPTY, living)
    expected = [name for name, seen_empty in told(living).items() if seen_empty]
    assert 0 < len(expected) < len(told(living))
    assert {c.kind for c in found} == {ChangeKind.APPEARED}
    assert sorted(n for c in found for n in c.landmark_ids) == sorted(expected)
    for change in found:
        assert np.isnan(change.displacement_m).all()


def test_appeared_between_the_looks_of_its_stay() -> None:
    new = one(0.9, stays=[(3, 0, 120.0, 150.0, 190.0, np.inf)], hits={(0, 5): (7, 1)}, stamp_s=LATER_S)
    change = only(EMPTY, new)
    assert (change.stamp_from_s, change.stamp_to_s) == (120.0, 150.0)
    assert (change.n_hits, change.n_misses) == (7, 0)
    nobody_looked = one(0.9, stays=[(3, 0, NEVER, 150.0, 190.0, np.inf)], stamp_s=LATER_S)
    assert diff(EMPTY, nobody_looked) == ()  # the map grew


def test_vanished_between_its_last_sighting_and_the_first_miss() -> None:
    old = one(0.8, stays=[(3, 0, NEVER, 1.0, 90.0, np.inf)], hits={(0, 5): (9, 2)})
    new = one(0.1, stays=[(3, 0, NEVER, 1.0, 110.0, 130.0)], hits={(0, 5): (10, 8)}, stamp_s=LATER_S)
    change = only(old, new)
    assert change.kind is ChangeKind.VANISHED
    assert change.landmark_ids == (5,)
    assert change.probability == pytest.approx(0.8 * 0.9)
    assert (change.stamp_from_s, change.stamp_to_s) == (110.0, 130.0)
    assert (change.n_hits, change.n_misses) == (0, 6)
    assert np.isnan(change.displacement_m).all()


def test_existence_is_decided_at_one_half() -> None:
    assert diff(one(0.5), one(0.6)) == ()
    assert diff(one(0.49), one(0.1)) == ()
    assert only(one(0.5), one(0.499)).kind is ChangeKind.VANISHED
    assert only(one(0.4), one(0.5)).kind is ChangeKind.RETURNED


def test_moved_with_displacement_time_and_evidence() -> None:
    places = [(0, 5, 1.0, 2.0), (1, 5, 1.5, 1.0)]
    old = a_map([(0, 3, 0.9)], places[:1], cliques={5: 3}, hits={(0, 5): (20, 1)})
    new = a_map(
        [(0, 3, 0.05), (1, 3, 0.9)],
        places,
        cliques={5: 3},
        stays=[(3, 0, NEVER, 1.0, 110.0, 125.0), (3, 1, 115.0, 140.0, 180.0, np.inf)],
        hits={(0, 5): (20, 5), (1, 5): (12, 0)},
        stamp_s=LATER_S,
    )
    change = only(old, new)
    assert change.kind is ChangeKind.MOVED
    np.testing.assert_allclose(change.displacement_m, (0.5, -1.0))
    assert change.rotation_rad == 0.0
    assert change.probability == pytest.approx(0.9 * 0.9)
    assert (change.stamp_from_s, change.stamp_to_s) == (115.0, 125.0)
    assert (change.n_hits, change.n_misses) == (12, 4)
    back = only(new, old)
    np.testing.assert_allclose(back.displacement_m, (-0.5, 1.0))


def test_moved_twice_between_leaving_the_first_place_and_coming_to_the_last() -> None:
    places = [(0, 5, 1.0, 2.0), (1, 5, 4.0, 4.0), (2, 5, 1.5, 1.0)]
    old = a_map([(0, 3, 0.9)], places[:1], cliques={5: 3})
    stays = [(3, 0, NEVER, 1.0, 110.0, 120.0), (3, 1, 110.0, 125.0, 140.0, 160.0), (3, 2, 140.0, 165.0, 190.0, np.inf)]
    new = a_map([(0, 3, 0.0), (1, 3, 0.0), (2, 3, 0.9)], places, cliques={5: 3}, stays=stays, stamp_s=LATER_S)
    change = only(old, new)
    assert (change.kind, change.stamp_from_s, change.stamp_to_s) == (ChangeKind.MOVED, 110.0, 165.0)
    gone = replace(new, sites=replace(new.sites, p_here=np.zeros(3)))
    gone.stays.gone_s[2] = 195.0
    change = only(old, gone)
    assert (change.kind, change.stamp_from_s, change.stamp_to_s) == (ChangeKind.VANISHED, 190.0, 195.0)


def test_moved_by_leaving_and_coming_back_elsewhere() -> None:
    places = [(0, 5, 1.0, 2.0), (1, 5, 4.0, 4.0)]
    old = a_map([(0, 3, 0.9)], places[:1], cliques={5: 3})
    stays = [(3, 0, NEVER, 1.0, 110.0, 130.0), (3, 1, 130.0, 160.0, 190.0, np.inf)]
    new = a_map([(0, 3, 0.0), (1, 3, 0.9)], places, cliques={5: 3}, stays=stays, stamp_s=LATER_S)
    change = only(old, new)
    assert (change.kind, change.stamp_from_s, change.stamp_to_s) == (ChangeKind.MOVED, 110.0, 160.0)


def test_another_site_within_the_noise_is_no_move() -> None:
    """Sites are named anew where bodies are put together otherwise; the things did not move for that."""
    old = a_map([(0, 3, 0.9)], [(0, 5, 1.0, 2.0)], cliques={5: 3}, sigma_m=0.1)
    new = a_map([(8, 4, 0.9)], [(8, 5, 1.1, 2.1)], cliques={5: 4}, sigma_m=0.1)
    assert diff(old, new) == ()
    sharp = replace(new, covariance_m2=1e-8 * np.eye(2))
    assert only(replace(old, covariance_m2=1e-8 * np.eye(2)), sharp).kind is ChangeKind.MOVED


def body(angle_rad: float, step_m: tuple[float, float], site: int) -> list[tuple[int, int, float, float]]:
    """Places of landmarks 1 to 4 on a body that was turned about its middle, (2, 1), and moved."""
    corners = np.array([[1.0, 0.0], [3.0, 0.5], [3.0, 2.0], [1.0, 1.5]])
    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    moved = (corners - corners.mean(axis=0)) @ turn.T + corners.mean(axis=0) + step_m
    return [(site, k + 1, float(x), float(y)) for k, (x, y) in enumerate(moved)]


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.5])
def test_a_body_moves_as_one(angle: float) -> None:
    cliques = dict.fromkeys(range(1, 5), 7)
    old = a_map([(0, 7, 1.0)], body(0.0, (0, 0), 0), cliques=cliques)
    new = a_map([(0, 7, 0.0), (1, 7, 1.0)], body(0.0, (0, 0), 0) + body(angle, (2, -1), 1), cliques=cliques)
    change = only(old, new)
    assert change.landmark_ids == (1, 2, 3, 4)
    assert change.kind is (ChangeKind.ROTATED if angle else ChangeKind.MOVED)
    np.testing.assert_allclose(change.displacement_m, (2.0, -1.0), atol=1e-12)
    assert change.rotation_rad == pytest.approx(angle)


def test_a_turn_that_may_be_noise_is_none() -> None:
    cliques = dict.fromkeys(range(1, 5), 7)
    old = a_map([(0, 7, 1.0)], body(0.0, (0, 0), 0), cliques=cliques, sigma_m=0.05)
    new = a_map([(1, 7, 1.0)], body(0.03, (2, 0), 1), cliques=cliques, sigma_m=0.05)
    assert (only(old, new).kind, only(old, new).rotation_rad) == (ChangeKind.MOVED, 0.0)


def test_two_that_stand_in_each_others_place_were_swapped() -> None:
    spots = {1: (0.0, 0.0), 2: (3.0, 1.0), 3: (5.0, 5.0)}
    old = a_map([(k, k, 0.9) for k in spots], [(k, k, *spots[k]) for k in spots], cliques={k: k for k in spots})
    new = a_map(
        [(11, 1, 0.9), (12, 2, 0.8), (13, 3, 0.9)],
        [(11, 1, 3.01, 0.99), (12, 2, 0.01, 0.0), (13, 3, 5.0, 6.0)],
        cliques={k: k for k in spots},
    )
    swap, move = sorted(diff(old, new), key=lambda c: len(c.landmark_ids), reverse=True)
    assert (swap.kind, swap.landmark_ids) == (ChangeKind.SWAPPED, (1, 2))
    np.testing.assert_allclose(swap.displacement_m, (3.01, 0.99))
    assert swap.probability == pytest.approx(0.9**3 * 0.8)
    assert (move.kind, move.landmark_ids) == (ChangeKind.MOVED, (3,))


def test_three_that_changed_places_in_a_ring_were_not_swapped() -> None:
    spots = {1: (0.0, 0.0), 2: (3.0, 1.0), 3: (5.0, 5.0)}
    old = a_map([(k, k, 0.9) for k in spots], [(k, k, *spots[k]) for k in spots], cliques={k: k for k in spots})
    new = a_map(
        [(10 + k, k, 0.9) for k in spots],
        [(10 + k, k, *spots[k % 3 + 1]) for k in spots],
        cliques={k: k for k in spots},
    )
    assert [c.kind for c in diff(old, new)] == [ChangeKind.MOVED] * 3


def test_returned_to_where_it_was_or_elsewhere() -> None:
    gone = one(0.1, stays=[(3, 0, NEVER, 1.0, 50.0, 60.0)])
    same = one(0.9, stays=[(3, 0, NEVER, 1.0, 50.0, 60.0), (3, 0, 150.0, 160.0, 190.0, np.inf)], stamp_s=LATER_S)
    change = only(gone, same)
    assert change.kind is ChangeKind.RETURNED
    assert change.displacement_m == (0.0, 0.0)
    assert change.probability == pytest.approx(0.9 * 0.9)
    assert (change.stamp_from_s, change.stamp_to_s) == (150.0, 160.0)
    other = a_map(
        [(0, 3, 0.0), (1, 3, 0.9)],
        [(0, 5, 1.0, 2.0), (1, 5, 4.0, 2.0)],
        cliques={5: 3},
        stays=[(3, 0, NEVER, 1.0, 50.0, 60.0), (3, 1, NEVER, 160.0, 190.0, np.inf)],
        stamp_s=LATER_S,
    )
    elsewhere = only(gone, other)
    np.testing.assert_allclose(elsewhere.displacement_m, (3.0, 0.0))
    assert (elsewhere.stamp_from_s, elsewhere.stamp_to_s) == (60.0, 160.0)


def test_what_an_operator_deleted_did_not_vanish() -> None:
    assert diff(one(0.9), one(0.1, deleted=(5,))) == ()
    assert diff(one(0.9, deleted=(5,)), one(0.1)) == ()
    assert edits(one(0.9), one(0.9, deleted=(5,), pinned=(5,))) == ((5, "deleted"), (5, "pinned"))
    assert edits(one(0.9, deleted=(5,)), one(0.9)) == ((5, "undeleted"),)


def test_a_landmark_that_the_map_forgot_has_vanished() -> None:
    other = a_map([(4, 9, 0.9)], [(4, 6, 0.0, 0.0)], cliques={6: 9}, stamp_s=LATER_S)
    kinds = {c.kind: c for c in diff(one(0.9), other)}
    assert set(kinds) == {ChangeKind.APPEARED, ChangeKind.VANISHED}
    assert kinds[ChangeKind.VANISHED].landmark_ids == (5,)
    assert (kinds[ChangeKind.VANISHED].stamp_from_s, kinds[ChangeKind.VANISHED].stamp_to_s) == (NOW_S, LATER_S)


@pytest.mark.parametrize("seed", range(20))
def test_backwards_vanished_is_appeared_or_returned(seed: int) -> None:
    """Of two arbitrary maps, the same things change forwards and backwards, each landmark at most once."""
    a, b = random_map(seed, cliques=8), random_map(seed + 100, cliques=8)
    there, back = diff(a, b), diff(b, a)

    def names(changes, *kinds):
        return sorted(n for c in changes if c.kind in kinds for n in c.landmark_ids)

    every = [n for c in there for n in c.landmark_ids]
    assert len(every) == len(set(every))
    for one, other, living in ((there, back, a), (back, there, b)):  # but for what came to be known
        came = names(other, ChangeKind.APPEARED, ChangeKind.RETURNED)
        left = set(names(one, ChangeKind.VANISHED))
        assert set(came) <= left
        assert not any(told(living)[name] for name in left - set(came))
    for change in (*there, *back):
        assert 0.0 <= change.probability <= 1.0
        assert math.isnan(change.stamp_from_s) or change.stamp_from_s <= change.stamp_to_s
