"""What a session found goes into the map: names, bodies, and one joint covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.config import LivingConfig
from evermap.maps.living import LivingMap
from evermap.maps.sessions.extend import Extended, Found, extended, fellows_of
from evermap.maps.sessions.gaussian import with_session
from evermap.types import FloatArray

from .scenes import assert_consistent, begun, found, next_map

ALONE = LivingConfig(cliques=False)


def some_covariance(random: np.random.Generator, points: int) -> FloatArray:
    factor = random.normal(size=(2 * points, 2 * points + 1)) * 0.02
    return np.asarray(factor @ factor.T)


def test_a_fellow_is_on_the_body_that_most_of_its_object_are_of() -> None:
    """Landmark 1 is of a body of its own, 2 and 3 of another; 5 is of an object that the map knows nothing of."""
    living = begun(found([1, 2, 3], [[0, 0], [1, 0], [2, 0]])).living
    members = replace(living.members, landmark_id=np.array([1, 2, 3]), clique_id=np.array([0, 1, 1]))
    objects = np.array([[1, 8], [2, 8], [3, 8], [4, 8], [5, 9]])
    fellow = fellows_of(np.array([4, 5, 6]), objects, replace(living, members=members))
    np.testing.assert_array_equal(fellow, [2, -1, -1])


def believing(entry: Extended) -> LivingMap:
    return replace(entry.living, sites=replace(entry.living.sites, p_here=entry.p_start))


def random_session(random: np.random.Generator, living: LivingMap) -> Found:
    """Some landmarks of the map, each at one of its places or somewhere new, and some that nobody saw before."""
    known = living.members.landmark_id
    again = np.sort(random.permutation(known)[: random.integers(0, len(known) + 1)])
    pool = np.setdiff1d(np.arange(40), known)
    names = np.sort(np.concatenate([again, random.choice(pool, random.integers(1, 4), replace=False)]))
    place, at = [], []
    for name in names:
        rows = np.flatnonzero(living.places.landmark_id == name)
        stays = len(rows) > 0 and random.random() < 0.7
        place.append(int(random.choice(rows)) if stays else -1)
        at.append(living.places.position_m[place[-1]] if stays else random.uniform(0, 15, 2))
    return found(
        names.tolist(),
        np.array(at) + random.normal(size=(len(at), 2)) * 0.01,
        place=place,
        class_id=(names % 2).tolist(),
        covariance_m2=some_covariance(random, len(at)),
    )


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_a_map_is_consistent_whatever_is_found_and_names_are_never_used_again(seed: int, cliques: bool) -> None:
    random = np.random.default_rng(seed)
    config = LivingConfig(cliques=cliques)
    living = LivingMap()
    ever: set[int] = set()
    for _ in range(4):
        session = random_session(random, living)
        entry = extended(living, living.sites, session, config, 0.01)
        after = entry.living
        assert_consistent(believing(entry))
        fresh = set(after.sites.site_id.tolist()) - set(living.sites.site_id.tolist())
        assert not fresh & ever
        assert fresh == set() or min(fresh) >= living.n_sites_ever
        ever |= fresh
        # every landmark of the session is where it was found
        np.testing.assert_array_equal(after.places.landmark_id[entry.place], session.landmark_id)
        np.testing.assert_allclose(after.places.position_m[entry.place], session.position_m)
        assert len(entry.is_new) == len(entry.p_start) == len(after.sites)
        # what had a place keeps it: none is lost, whoever's it is called now
        assert len(after.places) == len(living.places) + int((session.place < 0).sum())
        keep = np.sort(random.permutation(len(after.sites))[:1])
        forgotten = after.sites.site_id[keep] if random.random() < 0.3 else np.zeros(0, dtype=np.int64)
        living = believing(entry)
        if len(forgotten):
            of = after.places.landmark_id[np.isin(after.places.site_id, forgotten)]
            living = living.without(of)


@given(st.integers(0, 2**32 - 1))
def test_covariances_stay_with_their_places(seed: int) -> None:
    """The geometry by itself, place after place by name, is the sorted map's."""
    random = np.random.default_rng(seed)
    living = begun(random_session(random, LivingMap()), ALONE).living
    for _ in range(2):
        session = random_session(random, living)
        entry = next_map(living, session, ALONE)
        seen, new = np.flatnonzero(session.place >= 0), np.flatnonzero(session.place < 0)
        order = np.concatenate([seen, new])
        corner = (2 * order[:, None] + np.arange(2)).ravel()
        position, covariance = with_session(
            living.places.position_m, living.covariance_m2, session.place[seen], session.position_m[order],
            session.covariance_m2[np.ix_(corner, corner)], 0.0,
        )  # fmt: skip
        names = [(int(s), int(n)) for s, n in zip(living.places.site_id, living.places.landmark_id, strict=True)]
        names += [(-1, int(n)) for n in session.landmark_id[new]]
        after = entry.living
        for a, one in enumerate(zip(after.places.site_id.tolist(), after.places.landmark_id.tolist(), strict=True)):
            i = names.index(one if one in names else (-1, one[1]))
            np.testing.assert_allclose(after.places.position_m[a], position[i])
            for b, two in enumerate(zip(after.places.site_id.tolist(), after.places.landmark_id.tolist(), strict=True)):
                j = names.index(two if two in names else (-1, two[1]))
                np.testing.assert_allclose(
                    after.covariance_m2[2 * a : 2 * a + 2, 2 * b : 2 * b + 2],
                    covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2],
                    atol=1e-12,
                )
        living = after


def test_landmarks_of_one_class_within_reach_are_one_body() -> None:
    session = found([3, 5, 8, 9], [[0, 0], [1, 0], [0.5, 0.5], [9, 9]], class_id=[0, 0, 1, 0])
    members = begun(session).living.members
    assert members.clique_id[0] == members.clique_id[1]
    assert len(set(members.clique_id.tolist())) == 3
    assert len(set(begun(session, ALONE).living.members.clique_id.tolist())) == 4


@pytest.mark.parametrize(("x_m", "joins"), [(1.4, True), (1.8, False)])
def test_a_landmark_that_was_missed_at_first_joins_the_body_it_stands_at(x_m: float, joins: bool) -> None:
    """Within reach (1.6 m) of all of it; it has its place at the site at which the body stands."""
    living = begun(found([1, 2], [[0, 0], [0.5, 0]])).living
    entry = next_map(living, found([1, 2, 7], [[0, 0], [0.5, 0], [x_m, 0]], place=[0, 1, -1]))
    after = entry.living
    assert (after.members.clique_id[2] == after.members.clique_id[0]) == joins
    assert len(after.sites) == (1 if joins else 2)
    assert entry.is_new.tolist() == ([False] if joins else [False, True])


def test_another_class_does_not_join() -> None:
    living = begun(found([1, 2], [[0, 0], [0.5, 0]])).living
    after = next_map(
        living, found([1, 2, 7], [[0, 0], [0.5, 0], [0.2, 0.2]], place=[0, 1, -1], class_id=[0, 0, 1])
    ).living
    assert after.members.clique_id[2] != after.members.clique_id[0]


def test_a_body_that_moved_has_a_new_site_and_its_old_one() -> None:
    living = begun(found([1, 2, 9], [[0, 0], [0.5, 0], [9, 9]])).living
    entry = next_map(living, found([1, 2, 9], [[4, 4], [4.5, 4], [9, 9]], place=[-1, -1, 2], probability=0.97))
    after = entry.living
    assert after.members.clique_id.tolist() == living.members.clique_id.tolist()
    body = after.members.clique_id[0]
    assert (after.sites.clique_id == body).sum() == 2
    # belief in it goes there, and what is left is shared as before
    assert entry.p_start[entry.is_new].tolist() == [0.97]
    old = np.flatnonzero((after.sites.clique_id == body) & ~entry.is_new)
    assert entry.p_start[old[0]] == pytest.approx(0.03 * living.sites.p_here[living.sites.clique_id == body][0])


def test_a_member_that_went_away_from_its_body_is_a_body_of_its_own_with_its_old_place() -> None:
    living = begun(found([1, 2, 3, 9], [[0, 0], [0.5, 0], [0, 0.5], [9, 9]])).living
    entry = next_map(
        living, found([1, 2, 3, 9], [[0, 0], [0.5, 0], [5, 5], [9, 9]], place=[0, 1, -1, 3], first_s=10.0, last_s=11.0)
    )
    after = entry.living
    body = dict(zip(after.members.landmark_id.tolist(), after.members.clique_id.tolist(), strict=True))
    assert body[1] == body[2] != body[3]
    assert body[3] >= living.n_cliques_ever
    # nobody expects it at the old body's site any more, but it may come back to where it was
    rows = np.flatnonzero(after.places.landmark_id == 3)
    assert len(rows) == 2
    assert sorted(after.places.position_m[rows].tolist()) == [[0.0, 0.5], [5.0, 5.0]]
    there = after.place_row(np.array([3]), after.site_of()[after.members.landmark_id == 3])
    back = extended(
        believing(entry),
        believing(entry).sites,
        found([3], [[0.0, 0.5]], place=[int(next(r for r in rows if r != there[0]))]),
        LivingConfig(),
        0.0,
    )
    assert len(back.living.places) == len(after.places), "no new place: it is back"
    assert_consistent(back.living)


def test_bodies_are_taken_apart_in_the_old_map_too() -> None:
    """What changed is told of the bodies as they are known now: two moved, and the third stayed where it was."""
    living = begun(found([1, 2, 3, 9], [[0, 0], [0.5, 0], [0, 0.5], [9, 9]])).living
    entry = next_map(living, found([1, 2, 3, 9], [[5, 5], [5.5, 5], [0, 0.5], [9, 9]], place=[-1, -1, 2, 3]))
    assert_consistent(entry.before)
    assert entry.before.members.clique_id.tolist() == entry.living.members.clique_id.tolist()
    assert len(set(entry.before.members.clique_id.tolist())) == 3
    sites = dict(zip(entry.before.sites.site_id.tolist(), entry.before.sites.clique_id.tolist(), strict=True))
    after = dict(zip(entry.living.sites.site_id.tolist(), entry.living.sites.clique_id.tolist(), strict=True))
    assert sites.items() <= after.items()
    np.testing.assert_allclose(entry.before.sites.p_here, 0.9)
    np.testing.assert_array_equal(
        np.sort(entry.before.places.position_m, axis=0), np.sort(living.places.position_m, axis=0)
    )


def test_one_that_was_missed_while_its_body_moved_and_is_found_where_it_was_is_a_body_of_its_own() -> None:
    living = begun(found([1, 2, 9], [[0, 0], [0.5, 0], [9, 9]])).living
    living = believing(next_map(living, found([2, 9], [[6, 0], [9, 9]], place=[-1, 2])))
    one, nine = (int(np.flatnonzero(living.places.landmark_id == name)[0]) for name in (1, 9))
    entry = next_map(living, found([1, 2, 9], [[0, 0], [3, 3], [9, 9]], place=[one, -1, nine]))
    assert_consistent(believing(entry))
    body = entry.living.members.clique_id
    assert body[0] != body[1]
    assert len(entry.living.places) == len(living.places) + 1


def test_members_that_are_found_at_two_sites_are_no_body() -> None:
    living = begun(found([1, 2, 9], [[0, 0], [0.5, 0], [9, 9]])).living
    living = believing(next_map(living, found([1, 2, 9], [[5, 5], [5.5, 5], [9, 9]], place=[-1, -1, 2])))
    rows = living.place_row(np.array([1, 2]), np.array([0, living.n_sites_ever - 1]))
    assert (rows >= 0).all()
    nine = int(np.flatnonzero(living.places.landmark_id == 9)[0])
    entry = next_map(living, found([1, 2, 9], [[0, 0], [5.5, 5], [9, 9]], place=[*rows, nine]))
    assert_consistent(believing(entry))
    body = entry.living.members.clique_id
    assert body[0] != body[1]
    assert len(entry.living.places) == len(living.places), "each has been there before"
