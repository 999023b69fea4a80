"""Other cliques in the same map: what is where does not change, only what goes together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.maps.bodies import relabel
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.types import FloatArray


def a_map() -> LivingMap:
    """Clique 0 of landmarks 1, 2, 3 with two sites, clique 1 of landmark 7 with one."""
    off = np.zeros(4, dtype=np.bool_)
    rng = np.random.default_rng(0)
    root = rng.standard_normal((14, 14))
    return LivingMap(
        stamp_s=10.0,
        members=Members(np.array([1, 2, 3, 7]), np.array([0, 0, 0, 1]), np.array([0, 0, 0, 1]), off, off),
        sites=Sites(
            np.array([0, 1, 2]), np.array([0, 0, 1]), np.array([0.2, 0.7, 0.9]), np.array([0.1, 0.6, 0.9]),
            np.array([0.0, 5.0, 1.0]), np.array([4.0, 9.0, 9.5]),
        ),
        places=Places(
            np.array([0, 0, 0, 1, 1, 1, 2]), np.array([1, 2, 3, 1, 2, 3, 7]), rng.uniform(0, 9, (7, 2)),
            np.arange(7), np.arange(7) + 10,
        ),
        stays=Stays(
            np.array([0, 1]), np.array([1, 2]), np.array([0, 1]), np.zeros((2, 2)), np.array([-np.inf, -np.inf]),
            np.array([5.0, 1.0]), np.array([9.0, 9.5]), np.array([np.inf, np.inf]), np.zeros(2),
        ),
        covariance_m2=root @ root.T,
        n_cliques_ever=2,
        n_sites_ever=3,
    )  # fmt: skip


def where(living: LivingMap) -> set[tuple[int, float, float]]:
    return {
        (int(name), float(x), float(y))
        for name, (x, y) in zip(living.places.landmark_id, living.places.position_m, strict=True)
    }


def joint(living: LivingMap, names: tuple[int, ...]) -> FloatArray:
    """Covariance of the places of some landmarks, in the order of their positions."""
    rows = np.flatnonzero(np.isin(living.places.landmark_id, names))
    rows = rows[np.lexsort(living.places.position_m[rows].T)]
    at = (2 * rows[:, None] + np.arange(2)).ravel()
    return living.covariance_m2[np.ix_(at, at)]


def test_a_body_taken_apart_keeps_its_sites_in_both_parts() -> None:
    before = a_map()
    after, rank = relabel(before, np.array([0, 0, 2, 1]))
    assert where(after) == where(before)
    np.testing.assert_array_equal(after.places.position_m[rank], before.places.position_m)
    np.testing.assert_allclose(joint(after, (1, 2, 3, 7)), joint(before, (1, 2, 3, 7)))
    assert after.n_cliques_ever == 3
    for clique, names in ((0, {1, 2}), (2, {3})):
        mine = after.sites.clique_id == clique
        np.testing.assert_allclose(np.sort(after.sites.p_here[mine]), [0.2, 0.7])
        np.testing.assert_allclose(np.sort(after.sites.p_kept[mine]), [0.1, 0.6])
        for site in after.sites.site_id[mine]:
            assert set(after.places.landmark_id[after.places.site_id == site].tolist()) == names
    assert set(before.sites.site_id.tolist()) <= set(after.sites.site_id.tolist())
    assert after.n_sites_ever == 5
    assert np.all(np.diff(after.sites.site_id) > 0)


def test_stays_are_of_the_part_that_keeps_the_site() -> None:
    """Landmark 3 turned out to have moved alone: what it did at site 1 is not the history of the others."""
    whole = a_map()
    alone = whole.places.site_id != 1
    alone |= whole.places.landmark_id == 3
    corner = (2 * np.flatnonzero(alone)[:, None] + np.arange(2)).ravel()
    before = replace(whole, places=whole.places[alone], covariance_m2=whole.covariance_m2[np.ix_(corner, corner)])
    after, _ = relabel(before, np.array([0, 0, 2, 1]))
    owner = dict(zip(after.sites.site_id.tolist(), after.sites.clique_id.tolist(), strict=True))
    assert owner[1] == 2
    assert after.stays.site_id.tolist() == [1, 2]
    assert after.stays.clique_id.tolist() == [2, 1]


def test_bodies_put_together_stand_where_both_stood() -> None:
    before = a_map()
    after, _ = relabel(before, np.zeros(4, dtype=np.int64))
    assert where(after) == where(before)
    assert set(after.sites.clique_id.tolist()) == {0}
    together = after.places.site_id[after.places.landmark_id == 7][0]
    assert set(after.places.landmark_id[after.places.site_id == together].tolist()) == {1, 2, 3, 7}
    row = int(np.searchsorted(after.sites.site_id, together))
    assert after.sites.p_here[row] == 0.7  # both stand there no more surely than each
    assert after.sites.p_kept[row] == 0.6
    assert (after.sites.p_kept <= after.sites.p_here).all()
    assert after.sites.p_here.sum() <= 1.0
    assert after.stays.clique_id.tolist() == [0]  # the stay of the one that is no more goes on in the other


def test_the_same_cliques_are_the_same_map() -> None:
    before = a_map()
    after, rank = relabel(before, before.members.clique_id)
    np.testing.assert_array_equal(rank, np.arange(7))
    for name in ("members", "sites", "places", "stays"):
        for column in ("site_id", "clique_id", "landmark_id", "p_here"):
            if hasattr(getattr(before, name), column):
                np.testing.assert_array_equal(
                    getattr(getattr(after, name), column), getattr(getattr(before, name), column)
                )
    assert replace(after, covariance_m2=before.covariance_m2).n_sites_ever == before.n_sites_ever
