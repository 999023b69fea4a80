"""What changed in a session: stays that ended or began, and the changes that are told of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.lifelong.believe import Looks, class_of, clique_rows, site_middles
from evermap.lifelong.geometry import of_places
from evermap.maps.living import LivingMap, Stays
from evermap.slam.align import rigid
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, Landmarks, MapChange

EXISTS = 0.5
"""A clique is said to stand at a site that is more probable than this, and to be away where that is more probable."""
SAME_PLACE_M = 0.3
"""Cliques that stand this close to where another stood have taken its place."""
NEAR_M = 3.0
"""Who looks at something sees what else stands this close to it."""
SURELY_AWAY = 0.02
FORGOTTEN_P = 0.05
"""Cliques that are more probably away than to 1 - `SURELY_AWAY`, and return with less than this, are forgotten."""
MOST_AWAY = 20
"""Cliques that are away are remembered up to this number, and as many again as stand somewhere."""
MOST_STAYS = 5000
"""Newest stays that lifetimes are learned from: a year of a large building."""


@dataclass(frozen=True, slots=True)
class Standing:
    """Where cliques stand: their ids, and the row of the site of each, -1 where it is away."""

    clique_id: IntArray
    site: IntArray

    def of(self, clique_id: int) -> int:
        """The row of a clique's site; -1 where it is away or unknown."""
        return int(np.append(self.site, -1)[_found(self.clique_id, clique_id)])


def standing(living: LivingMap) -> Standing:
    """The site of every clique that is more probable than all else."""
    cliques, row = clique_rows(living.sites)
    site = np.full(len(cliques), -1, dtype=np.int64)
    likely = np.flatnonzero(living.sites.p_here >= EXISTS)
    site[row[likely]] = likely
    return Standing(cliques, site)


def with_stays(before: LivingMap, after: LivingMap, looks: Looks, start_s: float) -> LivingMap:
    """The map with its stays up to date: sightings prolong them, misses and moves end them, new sites begin them.

    Args:
        before: the map as the session found it.
        after: with the session's beliefs, and sites with their sightings.
        looks: of the session, at places of `after`.
        start_s: beginning of the session.
    """
    now = standing(after)
    middle = site_middles(after)
    open_row = {
        int(name): k for k, (name, gone) in enumerate(zip(after.stays.clique_id, after.stays.gone_s, strict=True))
        if gone == np.inf
    }  # fmt: skip
    last, gone = after.stays.last_s.copy(), after.stays.gone_s.copy()
    begun: list[tuple[int, int, float, float, float]] = []
    for clique, site in zip(now.clique_id.tolist(), now.site.tolist(), strict=True):
        row = open_row.get(clique)
        staying = row is not None and site >= 0 and after.stays.site_id[row] == after.sites.site_id[site]
        if row is not None and staying:
            last[row] = max(last[row], after.sites.seen_s[site])
            continue
        elsewhere_s = _looked_before(before, middle[site]) if site >= 0 else -np.inf
        if row is not None:
            at = _row(after, int(after.stays.site_id[row]))
            if at >= 0:  # who left during the session may have been seen in it
                last[row] = max(last[row], after.sites.seen_s[at])
            gone[row] = _first_miss(looks, at, float(last[row]), start_s)
            elsewhere_s = float(last[row])
        if site >= 0:
            since = max(float(after.sites.since_s[site]), np.nextafter(elsewhere_s, np.inf))
            begun.append((clique, site, elsewhere_s, since, max(float(after.sites.seen_s[site]), since)))
    stays = replace(after.stays, last_s=last, gone_s=gone)
    if begun:
        clique_id, rows, elsewhere, first, until = (np.array(column) for column in zip(*begun, strict=True))
        kind = class_of(after, clique_id)
        stays = stays.joined(
            Stays(
                clique_id,
                after.sites.site_id[rows],
                kind,
                middle[rows],
                elsewhere,
                first,
                until,
                np.full(len(rows), np.inf),
            )
        )
        stays = stays[np.argsort(stays.first_s, kind="stable")]
    return replace(after, stays=stays)


def without_forgotten(living: LivingMap, most_sites: int) -> LivingMap:
    """The map without what it need not remember: its cost is that of what stands there, whatever its age.

    Left out are the least probable sites of cliques that have more than `most_sites`, and cliques that are away for
    good: those that return with little probability, or, where too many are away, that went first. Their stays are kept
    to learn from.
    """
    sites, members = living.sites, living.members
    order = np.lexsort((-sites.seen_s, -sites.p_here, sites.clique_id))
    rank = np.arange(len(order)) - np.searchsorted(sites.clique_id[order], sites.clique_id[order])
    kept = np.zeros(len(sites), dtype=np.bool_)
    kept[order[rank < most_sites]] = True
    gone = _gone_for_good(living)
    kept &= ~np.isin(sites.clique_id, gone)
    stays = living.stays
    if len(stays) > MOST_STAYS:
        stays = stays[np.sort(np.argsort(stays.last_s, kind="stable")[-MOST_STAYS:])]
    if kept.all():
        return replace(living, stays=stays)
    rows = np.flatnonzero(np.isin(living.places.site_id, sites.site_id[kept]))
    return replace(
        living,
        members=members[~np.isin(members.clique_id, gone)],
        sites=sites[kept],
        places=living.places[rows],
        covariance_m2=of_places(living.covariance_m2, rows),
        stays=stays,
    )


def _gone_for_good(living: LivingMap) -> IntArray:
    """Ids of cliques that are away and need not be remembered."""
    sites = living.sites
    cliques, row = clique_rows(sites)
    p_here, seen = np.zeros(len(cliques)), np.full(len(cliques), -np.inf)
    np.add.at(p_here, row, sites.p_here)
    np.maximum.at(seen, row, sites.seen_s)
    operated = living.members.pinned | living.members.deleted
    away = np.flatnonzero((p_here < SURELY_AWAY) & ~np.isin(cliques, living.members.clique_id[operated]))
    kinds, middle = class_of(living, cliques[away]), site_middles(living)
    newest = {int(row[s]): s for s in np.argsort(sites.seen_s, kind="stable")}
    p_return = np.zeros(len(away))
    for k, clique in enumerate(away):
        absence = living.lives.of(int(kinds[k]), middle[newest[int(clique)]]).absence
        still_away = float(np.exp(absence.log_survival(max(living.stamp_s - seen[clique], 0.0))))
        p_return[k] = 1.0 - absence.p_never_leaves / still_away if still_away > 0.0 else 0.0
    hopeless = away[p_return < FORGOTTEN_P]
    waiting = away[p_return >= FORGOTTEN_P]
    most = MOST_AWAY + len(cliques) - len(away)
    too_many = waiting[np.argsort(seen[waiting], kind="stable")][: max(len(waiting) - most, 0)]
    return np.asarray(cliques[np.concatenate([hopeless, too_many])])


def changes_between(before: LivingMap, after: LivingMap, looks: Looks) -> tuple[MapChange, ...]:
    """What is different after a session, by clique.

    Args:
        before: the map as the session found it.
        after: the map that it leaves, stays up to date.
        looks: of the session, at places of `after`.
    """
    then, now = standing(before), standing(after)
    hits, misses = _counted(looks, len(after.sites))
    found: list[MapChange] = []
    for clique, site in zip(now.clique_id.tolist(), now.site.tolist(), strict=True):
        earlier = then.of(clique)
        old = -1 if earlier < 0 else _row(after, int(before.sites.site_id[earlier]))
        if old == site:
            continue
        known = bool(np.any(before.sites.clique_id == clique))
        left = old if old >= 0 else _last_site(before, after, clique)
        kind = ChangeKind.VANISHED if site < 0 else ChangeKind.MOVED if old >= 0 else (
            ChangeKind.RETURNED if known else ChangeKind.APPEARED
        )  # fmt: skip
        p_here = after.sites.p_here
        mine = after.sites.clique_id == clique
        probability = 1.0 - float(p_here[mine].sum()) if site < 0 else float(p_here[site])
        step, turn = _motion(after, left, site) if site >= 0 and left >= 0 else (np.full(2, np.nan), 0.0)
        from_s, to_s = _when(after, clique, site)
        if kind is ChangeKind.APPEARED and np.isnan(from_s):
            continue  # nobody had ever looked there: the map grew, the world did not change
        found.append(
            MapChange(
                landmark_ids=_members_at(after, site if site >= 0 else left),
                kind=kind,
                stamp_from_s=from_s,
                stamp_to_s=to_s,
                displacement_m=(float(step[0]), float(step[1])),
                rotation_rad=turn,
                probability=min(max(probability, 0.0), 1.0),
                n_hits=int(hits[site]) if site >= 0 else 0,
                n_misses=int(misses[left]) if left >= 0 else 0,
            )
        )
    return _swaps(found, before, after)


def _swaps(found: list[MapChange], before: LivingMap, after: LivingMap) -> tuple[MapChange, ...]:
    """Two that moved to each other's place have been exchanged, or carry each other's identity."""
    then, now = before.landmarks(), after.landmarks()

    def at(records: Landmarks, names: tuple[int, ...]) -> FloatArray:
        rows = np.isin(records.landmark_id, names)
        return np.asarray(records.position_m[rows].mean(axis=0)) if rows.any() else np.full(2, np.nan)

    moved = [k for k, change in enumerate(found) if change.kind is ChangeKind.MOVED]
    was = {k: at(then, found[k].landmark_ids) for k in moved}
    is_at = {k: at(now, found[k].landmark_ids) for k in moved}
    swapped: dict[int, int] = {}
    for a in moved:
        for b in moved:
            if a < b and a not in swapped and b not in swapped:
                across = max(np.linalg.norm(is_at[a] - was[b]), np.linalg.norm(is_at[b] - was[a]))
                if across < SAME_PLACE_M:
                    swapped[a] = b
    partners = set(swapped.values())
    told = []
    for k, change in enumerate(found):
        if k in partners:
            continue
        if k in swapped:
            told.append(_exchanged(change, found[swapped[k]]))
        else:
            told.append(change)
    return tuple(told)


def _exchanged(change: MapChange, other: MapChange) -> MapChange:
    """Two moves told as one exchange; the displacement is that of the first."""
    return replace(
        change,
        kind=ChangeKind.SWAPPED,
        landmark_ids=tuple(sorted((*change.landmark_ids, *other.landmark_ids))),
        probability=min(change.probability, other.probability),
        n_hits=change.n_hits + other.n_hits,
        n_misses=change.n_misses + other.n_misses,
    )


def _motion(living: LivingMap, old: int, new: int) -> tuple[FloatArray, float]:
    """Shift and rotation of a body from one site to another, by the landmarks that have places at both.

    Of none the shift is that of the middles; the rotation of fewer than two is 0.
    """
    a = np.flatnonzero(living.places.site_id == living.sites.site_id[old])
    b = np.flatnonzero(living.places.site_id == living.sites.site_id[new])
    _, i, j = np.intersect1d(living.places.landmark_id[a], living.places.landmark_id[b], return_indices=True)
    if len(i):
        a, b = a[i], b[j]
    was, now = living.places.position_m[a], living.places.position_m[b]
    shift = now.mean(axis=0) - was.mean(axis=0)
    if len(i) < 2:
        return shift, 0.0
    return shift, float(rigid(was, now)[2])


def _when(living: LivingMap, clique: int, site: int) -> tuple[float, float]:
    """Between which two looks it happened: from the stays that ended or began."""
    mine = np.flatnonzero(living.stays.clique_id == clique)
    newest = mine[-1] if len(mine) else -1
    if newest < 0:
        return float("nan"), living.stamp_s
    if site < 0:
        return float(living.stays.last_s[newest]), float(living.stays.gone_s[newest])
    since = float(living.stays.elsewhere_s[newest])
    return (since if np.isfinite(since) else float("nan")), float(living.stays.first_s[newest])


def _looked_before(before: LivingMap, middle: FloatArray) -> float:
    """The last look at a spot before this session: something near it was seen, or missed; -inf where there was none."""

    def near(at: FloatArray) -> BoolArray:
        return np.asarray(np.all(np.abs(at - middle) < NEAR_M, axis=1))

    seen = before.places.site_id[near(before.places.position_m)]
    seen_s = before.sites.seen_s[np.isin(before.sites.site_id, seen)]
    missed_s = before.stays.gone_s[near(before.stays.position_m) & np.isfinite(before.stays.gone_s)]
    return float(np.concatenate([seen_s, missed_s]).max(initial=-np.inf))


def _first_miss(looks: Looks, site: int, last_s: float, start_s: float) -> float:
    """The first look of a session at which a clique was missed at its site after its last sighting there."""
    rows = (looks.rows.site == site) & ~looks.rows.hit & (looks.rows.stamp_s > last_s)
    return float(looks.rows.stamp_s[rows].min()) if rows.any() else max(start_s, float(np.nextafter(last_s, np.inf)))


def _counted(looks: Looks, count: int) -> tuple[IntArray, IntArray]:
    hit: BoolArray = looks.rows.hit
    hits = np.bincount(looks.rows.site[hit], minlength=count)
    return hits, np.bincount(looks.rows.site[~hit], minlength=count)


def _row(living: LivingMap, site_id: int) -> int:
    return _found(living.sites.site_id, site_id)


def _found(ids: IntArray, wanted: int) -> int:
    """The row of an id among sorted ones, -1 where it is none of them."""
    at = int(np.searchsorted(ids, wanted))
    return at if at < len(ids) and ids[at] == wanted else -1


def _last_site(before: LivingMap, after: LivingMap, clique: int) -> int:
    """Where a clique that is away was seen last, in rows of the new map."""
    mine = np.flatnonzero(before.sites.clique_id == clique)
    if not len(mine):
        return -1
    return _row(after, int(before.sites.site_id[mine[np.argmax(before.sites.seen_s[mine])]]))


def _members_at(living: LivingMap, site: int) -> tuple[int, ...]:
    if site < 0:
        return ()
    rows = living.places.site_id == living.sites.site_id[site]
    return tuple(int(name) for name in np.sort(living.places.landmark_id[rows]))
