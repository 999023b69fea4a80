"""The map with what a session found: new cliques, new sites of old ones, new places, all with one joint covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.config import LivingConfig
from evermap.geometry.chunked import JointCovariance, blocks, of_places, taken
from evermap.maps.bodies import Displacements, Fate, group, regroup, relabel
from evermap.maps.living import LivingMap, Members, Places, Sites, rows_among
from evermap.maps.sessions.gaussian import with_session
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Found:
    """Landmarks of a session, in the map's frame, in the order of their ids.

    Attributes:
        landmark_id, class_id: (K,).
        place: (K,) row of the old map's places, -1 where it stands at none of its own.
        probability: (K,) of that.
        position_m: (K, 2) posterior, in space (K, 3).
        covariance_m2: joint covariance of it.
        object_id: (K,) object that it is on, as an object detector says; -1 for none.
        first_s: (K,) first sighting.
        last_s: (K,) last sighting.
        rotation, rotation_covariance: in space (K, 4) and (K, 3, 3), as of `living.Places`; None in the plane.
        fellow: (K,) a landmark of the map on the same object, as `fellows_of` has it; -1 for none.
    """

    landmark_id: IntArray
    class_id: IntArray
    place: IntArray
    probability: FloatArray
    position_m: FloatArray
    covariance_m2: JointCovariance
    object_id: IntArray
    first_s: FloatArray
    last_s: FloatArray
    rotation: FloatArray | None = None
    rotation_covariance: FloatArray | None = None
    fellow: IntArray | None = None


def fellows_of(landmark_id: IntArray, objects: IntArray, living: LivingMap) -> IntArray:
    """Return (K,) a landmark of the map on the same object as each of some (K,), seen now or not; -1 for none.

    Of the body that most landmarks of the object are of, as `Recording.objects` (N, 2) states them.
    """
    members, found = living.members, np.full(len(landmark_id), -1, dtype=np.int64)
    _, row, at = np.intersect1d(members.landmark_id, objects[:, 0], return_indices=True)
    body, clique = objects[at, 1], members.clique_id[row]
    _, mine, stated = np.intersect1d(landmark_id, objects[:, 0], return_indices=True)
    for k, one in zip(mine.tolist(), objects[stated, 1].tolist(), strict=True):
        theirs = np.flatnonzero(body == one)
        if len(theirs):
            name, count = np.unique(clique[theirs], return_counts=True)
            of_most = theirs[clique[theirs] == name[np.argmax(count)]]
            found[k] = members.landmark_id[row[of_most[0]]]
    return found


def first_and_last(row: IntArray, stamp_s: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return (`count`,) the first and the last of the stamps of each row; inf and -inf where there is none."""
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, row, stamp_s)
    np.maximum.at(last, row, stamp_s)
    return first, last


@dataclass(frozen=True, slots=True)
class Extended:
    """The map with the session's sites, before its beliefs are updated.

    Attributes:
        before: the map as it was, but for bodies that this session took apart or put together.
        living: with the session's places and sites.
        landmark_id: (K,) landmarks of the session.
        place: (K,) row of the map's places at which each of them stands.
        p_start: (S,) beliefs in its sites at the beginning of the session.
        is_new: (S,) sites that the session found.
    """

    before: LivingMap
    living: LivingMap
    landmark_id: IntArray
    place: IntArray
    p_start: FloatArray
    is_new: BoolArray

    def places_of(self, landmark_id: IntArray) -> IntArray:
        """Return (N,) rows of the map's places at which landmarks stand, -1 for those that the session has not."""
        place = np.full(len(landmark_id), -1, dtype=np.int64)
        _, here, there = np.intersect1d(landmark_id, self.landmark_id, return_indices=True)
        place[here] = self.place[there]
        return place

    def has_places_of(self, other: Extended) -> bool:
        """Return whether the places of both maps are the same, and their bodies most probably at the same sites."""
        mine, theirs = self.living, other.living
        return all(
            np.array_equal(one, another)
            for one, another in (
                (mine.members.clique_id, theirs.members.clique_id),
                (mine.site_of(), theirs.site_of()),
                (mine.places.site_id, theirs.places.site_id),
                (mine.places.position_m, theirs.places.position_m),
                (self.place, other.place),
            )
        )


def extended(living: LivingMap, aged: Sites, found: Found, config: LivingConfig, drift_m: float) -> Extended:
    """Return the map with what a session found, by its sites as believed when the session began, and by how much places
    may have been off when it was solved.
    """
    before, living, aged, found = _with_bodies(living, aged, found, config, drift_m)
    members, cliques_ever = _with_members(living, found, config)
    clique = members.clique_id[np.searchsorted(members.landmark_id, found.landmark_id)]
    stands, new = np.flatnonzero(found.place >= 0), np.flatnonzero(found.place < 0)
    seen = found.place[stands]
    site_of = dict(zip(clique[stands].tolist(), living.places.site_id[seen].tolist(), strict=True))
    fresh = np.unique(clique[new][[int(c) not in site_of for c in clique[new]]])  # cliques that get a new site
    new_ids = living.n_sites_ever + np.arange(len(fresh))
    site_of |= zip(fresh.tolist(), new_ids.tolist(), strict=True)
    site = np.array([site_of[c] for c in clique[new].tolist()], dtype=np.int64)

    order = np.concatenate([stands, new])
    position, covariance = found.position_m[order], taken(found.covariance_m2, order, living.dim)
    if len(living.places):
        position, covariance = with_session(
            living.places.position_m,
            of_places(living.covariance_m2, np.arange(len(living.places)), living.dim),
            seen,
            position,
            of_places(covariance, np.arange(len(order)), living.dim),
            drift_m,
        )
    nothing = np.zeros(len(new), dtype=np.int64)
    places = living.places.joined(Places(site, found.landmark_id[new], found.position_m[new], nothing, nothing))
    places = replace(places, position_m=position)
    if found.rotation is not None and found.rotation_covariance is not None:
        turn = _average_turns(places, found.place, found.rotation, found.rotation_covariance)
        places = replace(places, rotation=turn[0], rotation_covariance=turn[1])
    sites, p_start, is_new = _with_sites(living, aged, found, clique, (fresh, new_ids), config.decisions.new_clique_p)
    sorted_rows = np.lexsort((places.landmark_id, places.site_id))
    place = found.place.copy()
    place[new] = len(living.places) + np.arange(len(new))
    return Extended(
        before,
        replace(
            living,
            members=members,
            sites=sites,
            places=places[sorted_rows],
            covariance_m2=taken(covariance, sorted_rows, living.dim),
            n_cliques_ever=cliques_ever,
            n_sites_ever=living.n_sites_ever + len(fresh),
        ),
        found.landmark_id,
        np.argsort(sorted_rows)[place],
        p_start,
        is_new,
    )


def _average_turns(
    places: Places, place: IntArray, rotation: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Orientations of places, and their covariances, with those of a session's landmarks (K,): at their `place`, of new
    ones at the end. An orientation that the session did not see stays.
    """
    new = np.flatnonzero(place < 0)
    at = np.concatenate([place[place >= 0], len(places) - len(new) + np.arange(len(new))])
    of = np.concatenate([np.flatnonzero(place >= 0), new])
    known = np.isfinite(rotation[of, 0])
    turned, spread = places.rotation.copy(), places.rotation_covariance.copy()
    turned[at[known]] = rotation[of[known]]
    spread[at[known]] = covariance[of[known]]
    return turned, spread


def _with_bodies(
    living: LivingMap, aged: Sites, found: Found, config: LivingConfig, drift_m: float
) -> tuple[LivingMap, LivingMap, Sites, Found]:
    """Return the map before and after, its sites as believed now, and the found landmarks, with regrouped bodies."""
    clique_id = _bodies(living, aged.p_here, found, config, drift_m)
    if np.array_equal(clique_id, living.members.clique_id):
        return living, living, aged, found
    before = relabel(living, clique_id)[0]
    living, moved_to = relabel(replace(living, sites=aged), clique_id)
    if not np.array_equal(before.sites.site_id, living.sites.site_id):  # united under another of their sites
        before = living
    found = replace(found, place=np.where(found.place >= 0, moved_to[found.place], -1))
    return before, living, living.sites, found


def _with_members(living: LivingMap, found: Found, config: LivingConfig) -> tuple[Members, int]:
    """Return the map's landmarks with the new ones, in cliques of their own or in those of their neighbours."""
    members = living.members
    is_new = ~np.isin(found.landmark_id, members.landmark_id)
    new = np.flatnonzero(is_new)
    if not len(new):
        return members, living.n_cliques_ever
    if config.cliques:
        clique = living.n_cliques_ever + _number_bodies(found.object_id[new], found, new, config.clique_reach_m)
        _join_known(clique, new, members, found, config.clique_reach_m)
    else:
        clique = living.n_cliques_ever + np.arange(len(new))
    off = np.zeros(len(new), dtype=np.bool_)
    both = members.joined(Members(found.landmark_id[new], found.class_id[new], clique, off, off))
    return both[np.argsort(both.landmark_id, kind="stable")], int(clique.max(initial=living.n_cliques_ever - 1)) + 1


def _number_bodies(object_id: IntArray, found: Found, new: IntArray, reach_m: float) -> IntArray:
    """Bodies of new landmarks, from 0: by the detector of objects where it says something, else by proximity."""
    number = np.zeros(len(new), dtype=np.int64)
    told = object_id >= 0
    number[told] = np.unique(object_id[told], return_inverse=True)[1].ravel()
    first = len(np.unique(object_id[told]))
    rest = new[~told]
    if len(rest):
        number[~told] = first + group(found.position_m[rest], found.class_id[rest], reach_m=reach_m)
    return number


def _join_known(clique: IntArray, new: IntArray, members: Members, found: Found, reach_m: float) -> None:
    """A body of which another landmark was missed at first: the same object, or within reach of all of its class."""
    old = np.flatnonzero(np.isin(found.landmark_id, members.landmark_id))
    old_clique = members.clique_id[np.searchsorted(members.landmark_id, found.landmark_id[old])]
    if not len(old) and (found.object_id[new] < 0).all():
        return
    for name in np.unique(clique):
        mine = np.flatnonzero(clique == name)
        body, kind = found.object_id[new[mine[0]]], found.class_id[new[mine[0]]]
        if body >= 0:
            same = old_clique[found.object_id[old] == body]
            if not len(same) and found.fellow is not None:  # of which nothing was seen this time
                at = found.fellow[new[mine[:1]]]
                same = members.clique_id[np.searchsorted(members.landmark_id, at[at >= 0])]
            clique[mine] = same[0] if len(same) else name
            continue
        near = {}
        for other in np.unique(old_clique[(found.class_id[old] == kind) & (kind >= 0)]):
            theirs = old[old_clique == other]
            gap = np.linalg.norm(found.position_m[new[mine]][:, None] - found.position_m[theirs][None], axis=2).max()
            if gap <= reach_m:
                near[float(gap)] = int(other)
        if near:
            clique[mine] = near[min(near)]


def _bodies(living: LivingMap, p_site: FloatArray, found: Found, config: LivingConfig, drift_m: float) -> IntArray:
    """Return (L,) cliques of the map's landmarks: split if members separated, joined if they moved as one; by beliefs
    (S,) in its sites.
    """
    if not config.cliques or not len(living.members):
        return living.members.clique_id
    members, places = living.members, living.places
    stood = living.place_row(members.landmark_id, living.site_of(p_site))
    _, member, row = np.intersect1d(members.landmark_id, found.landmark_id, return_indices=True)
    known = stood[member] >= 0
    member, row = member[known], row[known]
    fate = np.full(len(members), Fate.UNSEEN, dtype=np.int64)
    fate[member] = np.where(found.place[row] == stood[member], Fate.STAYED, Fate.MOVED)
    if not (fate == Fate.MOVED).any():
        return _tear_cliques(living, p_site, members.clique_id, found, config.clique_reach_m)
    before = places.position_m[np.maximum(stood, 0)]
    after, spread = before.copy(), np.zeros((len(members), living.dim, living.dim))
    after[member] = found.position_m[row]
    now, then = (blocks(covariance, living.dim) for covariance in (found.covariance_m2, living.covariance_m2))
    spread[member] = now[row] + then[stood[member]]
    spread += drift_m**2 * np.eye(living.dim)
    clique_id = regroup(
        members.clique_id,
        members.class_id,
        fate,
        Displacements(before, after, spread),
        reach_m=config.clique_reach_m,
        next_id=living.n_cliques_ever,
        settings=config.grouping,
    )
    return _tear_cliques(living, p_site, clique_id, found, config.clique_reach_m)


def _tear_cliques(living: LivingMap, p_site: FloatArray, clique_id: IntArray, found: Found, reach_m: float) -> IntArray:
    """Split off members of cliques that cannot be at the site of the others: a clique occupies one site.

    Those who stand at another known site, or at a new place though they have one at the site of the others, or out of
    reach of these, are cliques of their own. Those at the site that was believed in most keep the clique.
    """
    members, places, sites = living.members, living.places, living.sites
    label = clique_id.copy()
    next_id = max(living.n_cliques_ever, int(label.max(initial=-1)) + 1)
    _, member, row = np.intersect1d(members.landmark_id, found.landmark_id, return_indices=True)
    at = np.where(found.place[row] >= 0, np.append(places.site_id, -1)[found.place[row]], -1)
    for name in np.unique(label[member]):
        mine = np.flatnonzero(label[member] == name)
        known = mine[at[mine] >= 0]
        if len(mine) < 2 or not len(known):
            continue
        believed = p_site[np.searchsorted(sites.site_id, at[known])]
        main = at[known[np.argmax(believed)]]
        there = mine[at[mine] == main]
        has_one = living.place_row(members.landmark_id[member[mine]], np.full(len(mine), main)) >= 0
        gap = np.linalg.norm(found.position_m[row[mine]][:, None] - found.position_m[row[there]][None], axis=2)
        apart = mine[(at[mine] != main) & ((at[mine] >= 0) | has_one | (gap.max(axis=1) > reach_m))]
        nowhere = row[apart[at[apart] < 0]]
        bodies = [apart[at[apart] == site] for site in np.unique(at[apart]) if site >= 0]
        if len(nowhere):
            number = group(found.position_m[nowhere], found.class_id[nowhere], reach_m=reach_m)
            bodies += [apart[at[apart] < 0][number == k] for k in np.unique(number)]
        for body in bodies:
            label[member[body]] = next_id
            next_id += 1
    return label


def _with_sites(
    living: LivingMap,
    aged: Sites,
    found: Found,
    clique: IntArray,
    new: tuple[IntArray, IntArray],
    p_fresh: float,
) -> tuple[Sites, FloatArray, BoolArray]:
    """The map's sites and the new ones, with beliefs before the session's looks are counted."""
    p_start, (fresh, new_ids) = aged.p_here.copy(), new
    p_new, first, last = np.full(len(fresh), p_fresh), np.full(len(fresh), np.inf), np.full(len(fresh), -np.inf)
    at = rows_among(fresh, clique)
    mine = np.flatnonzero((at >= 0) & (found.place < 0))
    np.minimum.at(first, at[mine], found.first_s[mine])
    np.maximum.at(last, at[mine], found.last_s[mine])
    for k in np.flatnonzero(np.isin(fresh, living.sites.clique_id)):
        old = np.flatnonzero(living.sites.clique_id == fresh[k])
        p_new[k] = min(float(found.probability[mine[at[mine] == k]].min()), 0.999)
        p_start[old] *= 1.0 - p_new[k]
    old_sites = replace(living.sites, p_kept=aged.p_kept)
    sites = old_sites.joined(Sites(new_ids, fresh, p_new, p_new, first, last))
    return sites, np.append(p_start, p_new), np.arange(len(sites)) >= len(living.sites)
