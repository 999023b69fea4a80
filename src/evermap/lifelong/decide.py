"""What changed in a session: stays that ended or began, and the changes that are told of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.lifelong.arrive import Arrivals
from evermap.lifelong.believe import Looks, class_of, clique_rows, site_middles
from evermap.lifelong.geometry import of_places
from evermap.maps.learning import LongestLives
from evermap.maps.living import EXISTS, LivingMap, Stays
from evermap.slam.align import rigid
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray, Landmarks, MapChange

SAME_PLACE_M = 0.3
"""Cliques that stand this close to where another stood have taken its place."""
SAME_SPOT_M = 0.1
"""Cliques that stand this close to where they stood have not moved."""
LEAST_EVIDENCE = 1.5
"""What looks must say against a clique, as a log likelihood ratio, before it is told to have left."""
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


def decided(
    before: LivingMap,
    after: LivingMap,
    looks: Looks,
    log_evidence: FloatArray,
    arrivals: Arrivals,
    start_s: float,
    longest: LongestLives | None = None,
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """The map with its stays up to date, and what changed since it was told last, by clique.

    A stay goes on until looks end it: age alone lowers a belief, and is never told as a change. A clique that was away
    and is seen again has returned only if it had really left.

    Args:
        before: the map as the session found it.
        after: with the session's beliefs, and sites with their sightings.
        looks: of the session, at places of `after`.
        log_evidence: (C,) what they say for 'it stands somewhere' against 'it is away', by clique.
        arrivals: what earlier looks said of the places of new sites.
        start_s: beginning of the session.
        longest: lifetimes that are credible: a clique is told to have vanished where the looks outweigh even these.
            None where nothing is known of lifetimes.
    """
    hits, misses = _counted(looks, len(after.sites))
    middle, sites = site_middles(after), after.sites
    cliques, row_of = clique_rows(sites)
    told, arrival = _told(before, after), {int(site): k for k, site in enumerate(arrivals.site)}
    last, gone, p_gone = after.stays.last_s.copy(), after.stays.gone_s.copy(), after.stays.p_gone.copy()
    p_kept, hidden, shown = sites.p_kept.copy(), np.zeros(3), np.zeros(3)
    least = np.full(len(cliques), LEAST_EVIDENCE)
    if longest is not None:
        newest_s = np.full(len(cliques), -np.inf)
        np.maximum.at(newest_s, row_of, sites.seen_s)
        p_stays = longest.survival(class_of(after, cliques), np.maximum(after.stamp_s - newest_s, 0.0))
        least = np.maximum(least, np.log(p_stays / np.maximum(1.0 - p_stays, 1e-300)))
    begun: list[tuple[int, int, float, float, float]] = []
    found: list[MapChange] = []
    for c, clique in enumerate(cliques.tolist()):
        mine = np.flatnonzero(row_of == c)
        site = int(mine[np.argmax(sites.p_here[mine])])
        stands, here = sites.p_here[site] >= EXISTS, int(hits[site]) > 0
        p_away = min(max(1.0 - float(sites.p_here[mine].sum()), 0.0), 1.0)
        sight = int(looks.sight[c])
        old, stay = told.get(clique, (-1, -1))
        if log_evidence[c] <= -LEAST_EVIDENCE and not hits[mine].any():
            hidden[sight % 2] += 1.0 - p_away
        newest = stay if stay >= 0 else _newest_stay(after, clique)
        if old >= 0:
            if stands and site == old:
                if stay >= 0:
                    last[stay] = max(last[stay], sites.seen_s[site])
                    if here:  # if it was missed before, it was hidden then
                        hidden[sight % 2] += min(p_kept[site] / sites.p_here[site], 1.0) * p_gone[stay]
                        p_gone[stay] = 0.0
                        shown[sight % 2] += 1.0
                    elif log_evidence[c] <= -LEAST_EVIDENCE:
                        p_gone[stay] = p_away
                else:  # a body that was taken apart: its part goes on
                    begun.append((clique, site, -np.inf, float(sites.since_s[site]), float(sites.seen_s[site])))
                if here:
                    p_kept[site] = sites.p_here[site]
                continue
            looked_away = not stands and misses[old] > 0 and log_evidence[c] <= -least[c] and p_away >= EXISTS
            if not (stands and here) and not looked_away:
                if stay >= 0 and log_evidence[c] <= -LEAST_EVIDENCE:
                    p_gone[stay] = p_away
                continue
            left_s = float(sites.seen_s[old])
            if stay >= 0:
                left_s = last[stay] = max(last[stay], left_s)
                gone[stay], p_gone[stay] = _first_miss(looks, old, left_s, start_s), 1.0
            if looked_away:
                if stay >= 0:
                    p_gone[stay] = p_away
                to_s = _first_miss(looks, old, left_s, start_s)
                found.append(_change(after, ChangeKind.VANISHED, old, -1, left_s, to_s, p_away, 0, int(misses[old])))
                continue
            since = max(float(sites.since_s[site]), np.nextafter(left_s, np.inf))
            begun.append((clique, site, left_s, since, max(float(sites.seen_s[site]), since)))
            p_kept[site] = sites.p_here[site]
            if np.hypot(*_motion(after, old, site)[0]) < SAME_SPOT_M:
                continue
            p_moved = float(sites.p_here[site])
            n_hits, n_misses = int(hits[site]), int(misses[old])
            found.append(_change(after, ChangeKind.MOVED, old, site, left_s, since, p_moved, n_hits, n_misses))
            continue
        if not (stands and here):
            if newest >= 0 and np.isfinite(gone[newest]):
                at = _row(after, int(after.stays.site_id[newest]))
                p_gone[newest] = min(max(1.0 - p_kept[at], 0.0), 1.0) if at >= 0 else p_gone[newest]
            continue
        seen_s = float(sites.seen_s[site])
        share = min(p_kept[site] / sites.p_here[site], 1.0)
        p_kept[site] = sites.p_here[site]
        same = newest >= 0 and after.stays.site_id[newest] == sites.site_id[site]
        hidden[sight % 2] += share * p_gone[newest] if same else 0.0
        if same and share >= 1.0 - EXISTS:  # it had never left
            last[newest], gone[newest], p_gone[newest] = seen_s, np.inf, 0.0
            continue
        elsewhere_s, probability = -np.inf, 1.0 - share if same else 1.0
        kind, left = ChangeKind.RETURNED, _last_site(before, after, clique)
        if newest >= 0:
            # where it was last it was found missing; elsewhere it may have come when it left
            elsewhere_s = float(gone[newest] if same else last[newest])
            p_gone[newest] = max(p_gone[newest], probability)
        elif site in arrival:
            k = arrival[site]
            kind, elsewhere_s, probability = ChangeKind.APPEARED, arrivals.looked_s[k], arrivals.p_appeared[k]
            if probability < EXISTS:
                elsewhere_s = -np.inf
        else:
            probability = 0.0
        since = max(float(sites.since_s[site]), np.nextafter(elsewhere_s, np.inf))
        begun.append((clique, site, elsewhere_s, since, max(seen_s, since)))
        if probability >= EXISTS and len(before.places):
            p = probability * float(sites.p_here[site])
            n_misses = int(misses[left]) if left >= 0 else 0
            found.append(_change(after, kind, left, site, elsewhere_s, since, p, int(hits[site]), n_misses))
    stays = replace(after.stays, last_s=last, gone_s=gone, p_gone=p_gone)
    if begun:
        clique_id, rows, elsewhere, first, until = (np.array(column) for column in zip(*begun, strict=True))
        fresh = Stays(
            clique_id,
            sites.site_id[rows],
            class_of(after, clique_id),
            middle[rows],
            elsewhere,
            first,
            until,
            np.full(len(rows), np.inf),
            np.zeros(len(rows)),
        )
        stays = stays.joined(fresh)
        stays = stays[np.argsort(stays.first_s, kind="stable")]
    hidden[2], shown[2] = looks.unwitnessed
    sightlines = after.sightlines.after_session(hidden, shown)
    after = replace(after, stays=stays, sites=replace(sites, p_kept=p_kept), sightlines=sightlines)
    return after, _swaps(found, before, after)


def _told(before: LivingMap, after: LivingMap) -> dict[int, tuple[int, int]]:
    """For every clique that is said to stand somewhere the row of its site, and of its stay (-1 for none)."""
    told: dict[int, tuple[int, int]] = {}
    stays = after.stays
    for row in np.flatnonzero(stays.gone_s == np.inf).tolist():
        site = _row(after, int(stays.site_id[row]))
        if site >= 0:
            told[int(stays.clique_id[row])] = (site, row)
    known = set(stays.clique_id.tolist())
    then = standing(before)
    for clique, at in zip(then.clique_id.tolist(), then.site.tolist(), strict=True):
        if clique not in known and at >= 0:  # part of a body that stood there
            site = _row(after, int(before.sites.site_id[at]))
            if site >= 0:
                told[clique] = (site, -1)
    return told


def _newest_stay(living: LivingMap, clique: int) -> int:
    """Row of the last stay of a clique, -1 for none."""
    mine = np.flatnonzero(living.stays.clique_id == clique)
    return int(mine[-1]) if len(mine) else -1


def _change(
    living: LivingMap,
    kind: ChangeKind,
    left: int,
    site: int,
    from_s: float,
    to_s: float,
    probability: float,
    n_hits: int,
    n_misses: int,
) -> MapChange:
    """A change of the clique that left one site (row, -1 for none), and stands at another."""
    step, turn = _motion(living, left, site) if site >= 0 and left >= 0 else (np.full(2, np.nan), 0.0)
    return MapChange(
        landmark_ids=_members_at(living, site if site >= 0 else left),
        kind=kind,
        stamp_from_s=from_s if np.isfinite(from_s) else float("nan"),
        stamp_to_s=to_s,
        displacement_m=(float(step[0]), float(step[1])),
        rotation_rad=turn,
        probability=float(min(max(probability, 0.0), 1.0)),
        n_hits=n_hits,
        n_misses=n_misses,
    )


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


def _first_miss(looks: Looks, site: int, last_s: float, start_s: float) -> float:
    """The first look of a session at which a clique was missed at its site after its last sighting there."""
    rows = (looks.rows.site == site) & ~looks.rows.hit & looks.counts & (looks.rows.stamp_s > last_s)
    return float(looks.rows.stamp_s[rows].min()) if rows.any() else max(start_s, float(np.nextafter(last_s, np.inf)))


def _counted(looks: Looks, count: int) -> tuple[IntArray, IntArray]:
    hit: BoolArray = looks.rows.hit
    hits = np.bincount(looks.rows.site[hit], minlength=count)
    return hits, np.bincount(looks.rows.site[~hit & looks.counts], minlength=count)


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
