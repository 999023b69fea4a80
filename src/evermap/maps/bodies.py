"""The bodies of a living map after a session: split and joined by what their landmarks did (`grouping.regrouped`).

A part that is split off takes with it its places at all sites of its clique, under sites of its own, and a copy of the
clique's history: what was one body by mistake has been two all along. Bodies that are joined share the site at which
they stand and the one from which they came; what either did before is not known of the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.maps.grouping import Fate, regrouped
from evermap.maps.living import LivingMap, Sites
from evermap.types import UNKNOWN, FloatArray, IntArray

LIKELY = 0.5
"""Belief from which on a clique is said to stand at a site."""
STICKY = 4.0
"""Misses of one session come in runs: so many of them say as much as one independent miss."""
P_WRONG = 1e-3
"""Of a detection that fits a landmark, that it is of another one, all through a session."""


@dataclass(frozen=True, slots=True)
class _Fates:
    """What a session found of all landmarks of a map, in the order of its members.

    Attributes:
        fate: (L,) as of `Fate`.
        p_wrong: (L,) probability that it is not so.
        site_before, site: (L,) where its clique stood, and stands; `UNKNOWN` for nowhere.
        place_before, place: (L,) rows of its places there; -1 for none.
    """

    fate: IntArray
    p_wrong: FloatArray
    site_before: IntArray
    site: IntArray
    place_before: IntArray
    place: IntArray


def with_bodies(before: LivingMap, after: LivingMap, *, reach_m: float) -> LivingMap:
    """The map after a session, its landmarks grouped anew where the session says so.

    Args:
        before: the map as the session found it.
        after: as the session leaves it, beliefs, counts and stays up to date.
        reach_m: largest extent of a body.
    """
    fates = _fates(before, after)
    if not np.isin(fates.fate, (Fate.MOVED, Fate.GONE)).any():
        return after
    position, covariance = after.places.position_m, after.covariance_m2
    both = np.stack([fates.place_before, fates.place], axis=1)
    corner = 2 * both[:, :, None] + np.arange(2)
    blocks = covariance[corner[:, :, None, :, None], corner[:, None, :, None, :]]  # (L, 2, 2, x and y, x and y)
    spread = blocks[:, 0, 0] + blocks[:, 1, 1] - blocks[:, 0, 1] - blocks[:, 1, 0]
    clique = regrouped(
        after.members.clique_id,
        after.members.class_id,
        fates.fate,
        position[fates.place_before],
        position[fates.place],
        spread,
        reach_m=reach_m,
        next_id=after.n_cliques_ever,
        p_wrong=fates.p_wrong,
    )
    if np.array_equal(clique, after.members.clique_id):
        return after
    return _joined(_split(after, clique), after, fates)


def _fates(before: LivingMap, after: LivingMap) -> _Fates:
    names = after.members.landmark_id
    site = after.site_of()
    row = np.searchsorted(before.members.landmark_id, names)
    known = np.isin(names, before.members.landmark_id)
    site_before = np.full(len(names), UNKNOWN, dtype=np.int64)
    site_before[known] = before.site_of()[row[known]]
    place, place_before = after.place_row(names, site), after.place_row(names, site_before)
    counted = before.place_row(names, site)
    hits, misses = (
        np.where(place >= 0, now[place], 0) - np.where(counted >= 0, then[counted], 0)
        if len(then)
        else np.where(place >= 0, now[place], 0)
        for now, then in ((after.places.n_hits, before.places.n_hits), (after.places.n_misses, before.places.n_misses))
    )
    seen = (place >= 0) & (place_before >= 0) & (hits > 0)
    likely = np.isin(site, after.sites.site_id[after.sites.p_here >= LIKELY])
    p_missed = _p_missed(after, place, hits, misses)
    fate = np.select(
        [
            seen & (site == site_before),
            seen & likely,
            (place >= 0) & (site == site_before) & (hits == 0) & (p_missed < 0.1),
        ],
        [Fate.STAYED, Fate.MOVED, Fate.GONE],
        Fate.UNSEEN,
    )
    return _Fates(fate, np.where(fate == Fate.GONE, p_missed, P_WRONG), site_before, site, place_before, place)


def _p_missed(after: LivingMap, place: IntArray, hits: IntArray, misses: IntArray) -> FloatArray:
    """(L,) probability that a landmark which is there was not detected once, by how often its fellows were."""
    _, body = np.unique(after.members.clique_id, return_inverse=True)
    looks = hits + misses
    before_hits = np.where(place >= 0, after.places.n_hits[place], 0) - hits
    before_looks = before_hits + np.where(place >= 0, after.places.n_misses[place], 0) - misses
    rate = before_hits / np.maximum(before_looks, 1)
    usual, now, all_looks = (np.bincount(body.ravel(), weights=w)[body.ravel()] for w in (rate * looks, hits, looks))
    # of fellows alone: its own misses must not excuse themselves
    usual, now, all_looks = usual - rate * looks, now - hits, all_looks - looks
    as_usual = np.where((usual > 0.0) & (all_looks > 0), np.minimum(now / np.maximum(usual, 1e-12), 1.0), 0.0)
    return np.asarray(np.exp(-rate * looks * as_usual / STICKY))


def _split(after: LivingMap, clique: IntArray) -> LivingMap:
    """Every part with its new clique; sites at which several parts stood once for each. Rows keep their order."""
    member = np.searchsorted(after.members.landmark_id, after.places.landmark_id)
    of_place, site_of_place = clique[member], after.places.site_id.copy()
    sites, stays, next_site = after.sites, after.stays, after.n_sites_ever
    heir = {int(c): _heir(int(c), clique[after.members.clique_id == c]) for c in np.unique(after.members.clique_id)}
    stay_clique = np.array([heir.get(int(c), int(c)) for c in stays.clique_id], dtype=np.int64)
    site_clique = np.array([heir.get(int(c), int(c)) for c in sites.clique_id], dtype=np.int64)
    copies: list[tuple[int, int, int]] = []  # row of the site, its copy, whose
    for row, site in enumerate(after.sites.site_id.tolist()):
        parts = np.unique(of_place[site_of_place == site])
        if len(parts) and site_clique[row] not in parts:
            site_clique[row] = parts[0]
        for part in parts[parts != site_clique[row]].tolist():
            copies.append((row, next_site, part))
            site_of_place[(site_of_place == site) & (of_place == part)] = next_site
            next_site += 1
    sites, stays = replace(sites, clique_id=site_clique), replace(stays, clique_id=stay_clique)
    for row, site, part in copies:
        old = sites.site_id[row]
        sites = sites.joined(replace(sites[np.array([row])], site_id=np.array([site]), clique_id=np.array([part])))
        mine = stays[(stays.site_id == old) & (stays.clique_id == site_clique[row])]
        same = np.ones_like(mine.site_id)
        stays = stays.joined(replace(mine, site_id=site * same, clique_id=part * same))
    return replace(
        after,
        members=replace(after.members, clique_id=clique),
        sites=sites,
        places=replace(after.places, site_id=site_of_place),
        stays=stays,
        n_cliques_ever=max(after.n_cliques_ever, int(clique.max()) + 1),
        n_sites_ever=next_site,
    )


def _heir(name: int, parts: IntArray) -> int:
    """The clique that goes on with the history of one: itself, or where most of it went."""
    return name if name in parts else int(np.bincount(parts).argmax())


def _joined(split: LivingMap, after: LivingMap, fates: _Fates) -> LivingMap:
    """Sites at which parts of a new body stand, and stood before, made one; rows in the order that a map keeps."""
    sites, site_of_place, stays = split.sites, split.places.site_id.copy(), split.stays
    for name in np.unique(split.members.clique_id):
        mine = split.members.clique_id == name
        sources, size = np.unique(after.members.clique_id[mine], return_counts=True)
        moved = mine & (fates.fate == Fate.MOVED)
        if len(sources) < 2 or not moved.any():
            continue
        eldest = int(sources[np.argmax(size)])
        of_eldest = split.members.landmark_id[mine & (after.members.clique_id == eldest)]
        kept = np.unique(split.places.site_id[np.isin(split.places.landmark_id, of_eldest)])
        stays = stays[(stays.clique_id != name) | np.isin(stays.site_id, kept)]
        weight = np.where(sites.clique_id == name, 1.0 / len(sources), 1.0)
        sites = replace(sites, p_here=sites.p_here * weight)
        for place in (fates.place[moved], fates.place_before[moved]):
            together = np.unique(site_of_place[place])
            one = next((site for site in together.tolist() if site in kept), int(together[0]))
            sites = _made_one(sites, together, one)
            site_of_place[np.isin(site_of_place, together)] = one
            stays = replace(stays, site_id=np.where(np.isin(stays.site_id, together), one, stays.site_id))
    places = replace(split.places, site_id=site_of_place)
    order = np.lexsort((places.landmark_id, places.site_id))
    corner = (2 * order[:, None] + np.arange(2)).ravel()
    return replace(
        split,
        sites=sites[np.argsort(sites.site_id)],
        places=places[order],
        stays=stays[np.argsort(stays.first_s, kind="stable")],
        covariance_m2=split.covariance_m2[np.ix_(corner, corner)],
    )


def _made_one(sites: Sites, together: IntArray, one: int) -> Sites:
    """Some sites as one of them."""
    mine = np.isin(sites.site_id, together)
    is_one = sites.site_id == one
    columns = ((sites.p_here, np.sum), (sites.since_s, np.max), (sites.seen_s, np.max))
    p_here, since_s, seen_s = (np.where(is_one, of(column[mine]), column) for column, of in columns)
    return replace(sites, p_here=p_here, since_s=since_s, seen_s=seen_s)[~mine | is_one]
