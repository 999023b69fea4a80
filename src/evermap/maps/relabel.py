"""The same map with other cliques: bodies taken apart, or put together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se2
from evermap.maps.living import LivingMap, Sites
from evermap.types import BoolArray, FloatArray, IntArray


def relabelled(living: LivingMap, clique_id: IntArray) -> tuple[LivingMap, IntArray]:
    """The map after its landmarks were given to other cliques.

    A site of a clique that is taken apart becomes one for each part; its stays are those of the part that keeps the
    site. Where cliques are put together, the sites at which they most probably stood become one; their other sites hold
    places of some landmarks only. Stays that went on of a clique that is no more are left out: they go on in the one
    that it is part of now.

    Args:
        living: the map.
        clique_id: (L,) clique of each landmark; new ones have ids from `living.n_cliques_ever` on.

    Returns:
        The map, and (P,) where each row of its places has gone.
    """
    members, sites, places, stays = living.members, living.sites, living.places, living.stays
    of_place = np.searchsorted(sites.site_id, places.site_id)
    label = clique_id[np.searchsorted(members.landmark_id, places.landmark_id)]
    pairs, part = np.unique(np.column_stack([of_place, label]), axis=0, return_inverse=True)
    site, owner = pairs.T
    keeps = _keepers(site, owner, sites.clique_id[site])
    new_id = sites.site_id[site].copy()
    new_id[~keeps] = living.n_sites_ever + np.arange(np.count_nonzero(~keeps))
    into = _united(owner, sites.clique_id[site], sites.p_here[site])

    p_here, p_kept = np.full((2, len(site)), np.inf)
    np.minimum.at(p_here, into, sites.p_here[site])
    np.minimum.at(p_kept, into, sites.p_kept[site])
    stands = np.flatnonzero(into == np.arange(len(into)))
    stands = stands[np.argsort(new_id[stands], kind="stable")]
    since = np.full(len(site), -np.inf)
    np.maximum.at(since, into, sites.since_s[site])
    seen = np.full(len(site), -np.inf)
    np.maximum.at(seen, into, sites.seen_s[site])
    p_here = _of_sum_one(owner[stands], p_here[stands])
    p_kept = np.minimum(p_kept[stands], p_here)
    parted = Sites(new_id[stands], owner[stands], p_here, p_kept, since[stands], seen[stands])
    moved = replace(places, site_id=new_id[into[part.ravel()]])
    order = np.lexsort((moved.landmark_id, moved.site_id))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    corner = se2.xy_rows(order)
    no_more = np.setdiff1d(sites.clique_id, owner)
    lost, owners = set(no_more.tolist()), dict(zip(parted.site_id.tolist(), parted.clique_id.tolist(), strict=True))
    whose = zip(stays.clique_id.tolist(), stays.site_id.tolist(), strict=True)
    kept = [clique if clique in lost else owners.get(at, clique) for clique, at in whose]
    stays = replace(stays, clique_id=np.array(kept, dtype=np.int64))
    return replace(
        living,
        members=replace(members, clique_id=clique_id),
        sites=parted,
        places=moved[order],
        covariance_m2=living.covariance_m2[np.ix_(corner, corner)],
        stays=stays[~(np.isin(stays.clique_id, no_more) & (stays.gone_s == np.inf))],
        n_cliques_ever=max(living.n_cliques_ever, int(clique_id.max(initial=-1)) + 1),
        n_sites_ever=living.n_sites_ever + int(np.count_nonzero(~keeps)),
    ), rank


def _keepers(site: IntArray, owner: IntArray, before: IntArray) -> BoolArray:
    """Which part of every site keeps its id: that of the clique it was of, else the first."""
    order = np.lexsort((owner, owner != before, site))
    keeps = np.zeros(len(site), dtype=np.bool_)
    keeps[order[np.append(True, np.diff(site[order]) != 0)[: len(order)]]] = True
    return keeps


def _united(owner: IntArray, before: IntArray, p_here: FloatArray) -> IntArray:
    """For every part the one that it goes into: itself, but for the likeliest parts of cliques put together."""
    into = np.arange(len(owner))
    for clique in np.unique(owner):
        mine = np.flatnonzero(owner == clique)
        likeliest = [mine[before[mine] == name] for name in np.unique(before[mine])]
        if len(likeliest) > 1:
            into[[rows[np.argmax(p_here[rows])] for rows in likeliest]] = likeliest[0][np.argmax(p_here[likeliest[0]])]
    return into


def _of_sum_one(owner: IntArray, p_here: FloatArray) -> FloatArray:
    """Probabilities of sites, scaled where those of one clique are more than 1 in sum."""
    _, row = np.unique(owner, return_inverse=True)
    total = np.bincount(row.ravel(), p_here)
    return np.asarray(p_here / np.maximum(total, 1.0)[row.ravel()])
