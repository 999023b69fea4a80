"""Beliefs of the map's cliques: predicted to a session by their lifetimes, and updated by its hits and misses.

And by arrivals and departures that were observed: a tracker that sees a car drive off knows more than a thousand misses
of it would say, since what is missed may be hidden. So the belief that it stands ends there and then, and of looks only
one remains: the first at which it was gone.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from evermap.config import LivingConfig
from evermap.existence.sites import Evidence, SiteBeliefs, SiteDynamics, SiteLooks, SiteSensor, follow_sites
from evermap.maps.lives import Life
from evermap.maps.living import EXISTS, LivingMap, Places, Sites, class_of, clique_rows, rows_among, site_middles
from evermap.maps.sessions.extend import Extended, first_and_last
from evermap.maps.sessions.looks import Arrivals, PlaceLooks, Watch
from evermap.sensing.sightlines import KNOWN, Lines, nominal_lines
from evermap.survival.hazards import never_leaves
from evermap.types import UNKNOWN, FloatArray, IntArray, Sensor, rows_of

WITNESSED_NATS = 50.0
"""Log likelihood ratio of having been seen to leave: more than any lifetime outweighs."""
LEAST_P, MOST_P = 1e-6, 1.0 - 1e-6
"""Bounds of a probability whose logarithm is taken."""


@dataclass(frozen=True, slots=True)
class Believed:
    """What a session makes of the beliefs of a map that has its places and sites.

    Attributes:
        until_s: instant of the beliefs.
        places: with hits and misses.
        sites: with beliefs and sightings.
        log_evidence: (C,) what the session's looks say for 'it stands at one of its sites' against 'it is away', as a
            log likelihood ratio, by clique, in the order of `living.clique_rows`.
        evidence: of every clique and frame.
    """

    until_s: float
    places: Places
    sites: Sites
    log_evidence: FloatArray
    evidence: Evidence


def dynamics_of(living: LivingMap, config: LivingConfig) -> SiteDynamics:
    """Return the dynamics of the cliques of a map, from the lifetimes of their class and place."""
    sites = living.sites
    cliques, row = clique_rows(sites)
    class_id = class_of(living, cliques)
    middle = site_middles(living)
    lives = _lives(living, config, class_id[row], middle)
    seen = np.full(len(cliques), -np.inf)
    np.maximum.at(seen, row, sites.seen_s)
    order = np.lexsort((sites.seen_s, row))
    newest = order[np.flatnonzero(np.diff(row[order], append=-1))]  # the last of each clique
    of_clique = [lives[s] for s in newest]
    count = np.bincount(row, minlength=len(cliques))
    p_known = np.array([life.p_known for life in of_clique])
    # a clique returns to the site it left as often as to all other known ones together
    share = np.where(np.arange(len(row)) == newest[row], 1.0, 1.0 / np.maximum(count[row] - 1, 1))
    total = np.bincount(row, share, minlength=len(cliques))
    share *= p_known[row] / np.where(total > 0.0, total, 1.0)[row]
    if not config.returns:
        share[:] = 0.0
    return SiteDynamics(
        stay=tuple(life.stay for life in lives),
        since_s=sites.since_s,
        absence=tuple(life.absence for life in of_clique),
        away_since_s=seen,
        p_hop=np.array([life.p_hop for life in of_clique]) * float(config.returns),
        return_share=share,
        rhythm=living.lives.rhythm if config.learn_lifetimes else None,
        hourly=living.lives.follows(class_id),
    )


def aged(living: LivingMap, config: LivingConfig, until_s: float) -> Sites:
    """Return the sites of a map with beliefs predicted to a later instant, without looks."""
    if not config.existence or len(living.sites) == 0:
        return living.sites
    start_s = living.believed_s()[np.unique(living.sites.clique_id, return_index=True)[1]]  # of a clique all are told
    until_s = max(until_s, living.stamp_s)
    none = np.zeros(0, dtype=np.int64)
    nothing = SiteLooks(np.zeros(0), none, none, none, np.zeros(0, dtype=np.bool_))
    lines = nominal_lines(np.zeros(0), living.sightlines.rules)
    after = _followed(living, living.sites.p_here, nothing, lines, config, start_s, until_s, 0.01)
    return _with_beliefs(living.sites, living.sites.p_here, after)


def _with_beliefs(sites: Sites, p_start: FloatArray, after: SiteBeliefs) -> Sites:
    """Return sites (S,) with beliefs after a gap, and the part of each that is the last seen stay."""
    never_left = np.divide(sites.p_kept, p_start, out=np.zeros(len(sites)), where=p_start > 0.0)
    return replace(sites, p_here=after.p_here, p_kept=after.p_stayed * np.minimum(never_left, 1.0))


def believed(
    entry: Extended, seen: PlaceLooks, sensor: Sensor, span_s: tuple[float, float], config: LivingConfig
) -> Believed:
    """Return the beliefs and the counts after a session, which goes from one instant to another."""
    (start_s, end_s), living, rows, sites = span_s, entry.living, seen.rows, entry.living.sites
    until_s, hit, missed = max(end_s, living.stamp_s), rows.hit, seen.counts & ~rows.hit
    places = replace(
        living.places,
        n_hits=living.places.n_hits + np.bincount(seen.place[hit], minlength=len(living.places)),
        n_misses=living.places.n_misses + np.bincount(seen.place[missed], minlength=len(living.places)),
    )
    first, last = first_and_last(rows.site[hit], rows.stamp_s[hit], len(sites))
    cliques, row = clique_rows(sites)
    log_evidence, evidence = np.zeros(len(cliques)), Evidence.empty()
    if config.existence:
        # a look at an empty place gives a detection of its landmark by chance: a wrong identity
        p_false = min(max(sensor.p_false / max(len(living.members), 10), 1e-5), 0.1)
        # what another robot's session saw until its end is in the beliefs: looks before that count as at that instant
        from_s, counted = max(start_s, living.stamp_s), rows_of(rows, seen.counts)
        counted = replace(counted, stamp_s=np.maximum(counted.stamp_s, from_s))
        after = _followed(living, entry.p_start, counted, seen.lines, config, from_s, until_s, p_false)
        sites = _with_beliefs(sites, entry.p_start, after)
        both = [np.bincount(row, p_site, minlength=len(cliques)) for p_site in (after.p_here, after.p_before)]
        p = np.clip(np.array(both, dtype=np.float64), 1e-12, 1.0 - 1e-12)
        log_evidence = np.subtract(*np.log(p / (1.0 - p)))
        evidence = replace(after.trace, clique_id=cliques[after.trace.clique_id])
    else:
        sites = replace(sites, p_here=_as_seen(living, rows.site[hit], last))
    stood = (entry.p_start >= EXISTS) & ~entry.is_new
    arrived = np.isfinite(first) & ~stood & (sites.p_here >= EXISTS)
    since_s = np.where(arrived & ~entry.is_new, first, sites.since_s)
    sites = replace(sites, since_s=since_s, seen_s=np.maximum(sites.seen_s, last))
    return Believed(until_s, places, sites, log_evidence, evidence)


def _as_seen(living: LivingMap, hit_site: IntArray, last_s: FloatArray) -> FloatArray:
    """Return beliefs without decay: a clique is where it was seen last."""
    p_here = living.sites.p_here.copy()
    _, clique = clique_rows(living.sites)
    seen = np.unique(hit_site)
    for row in np.unique(clique[seen]):
        mine = np.flatnonzero(clique == row)
        p_here[mine] = 0.0
        p_here[mine[np.argmax(last_s[mine])]] = 1.0
    return p_here


def _followed(
    living: LivingMap,
    p_start: FloatArray,
    rows: SiteLooks,
    lines: Lines,
    config: LivingConfig,
    start_s: FloatArray | float,
    until_s: float,
    p_false: float,
) -> SiteBeliefs:
    cliques, row = clique_rows(living.sites)
    return follow_sites(
        p_start,
        row,
        dynamics_of(living, config),
        rows,
        SiteSensor(lines, p_false, use_misses=config.misses),
        start_s=start_s,
        until_s=until_s,
        held=np.isin(cliques, living.members.clique_id[living.members.pinned]),
    )


def _lives(living: LivingMap, config: LivingConfig, class_id: IntArray, position_m: FloatArray) -> list[Life]:
    """(S,) lives at sites (S, 2) of classes (S,): what holds for one is the same object for all that it holds for."""
    chunk = np.floor(position_m[:, :2] / living.lives.chunk_m).astype(np.int64)
    _, first, which = np.unique(np.column_stack([class_id, chunk]), axis=0, return_index=True, return_inverse=True)
    found = []
    for kind, middle in zip(class_id[first].tolist(), position_m[first], strict=True):
        life = living.lives.of(kind, middle) if config.learn_lifetimes else living.lives.said(kind)
        found.append(life if config.returns else replace(life, absence=never_leaves()))
    return [found[k] for k in which.ravel().tolist()]


@dataclass(frozen=True, slots=True)
class Witnessed:
    """Landmarks that a session saw arriving or leaving: (W,) rows.

    Attributes:
        landmark_id: which.
        since_s, until_s: when it arrived, and when it left; nan if that was not seen.
        probability: of that.
        when_s: half width of the intervals of both times.
        instead: (W,) landmark that took its place while nobody looked, `UNKNOWN` where it was seen to leave.
    """

    landmark_id: IntArray
    since_s: FloatArray
    until_s: FloatArray
    probability: FloatArray
    when_s: float = 0.0
    instead: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @classmethod
    def nothing(cls) -> Witnessed:
        """Return none."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros(0))

    def sites(self, entry: Extended) -> IntArray:
        """Return (W,) rows of their sites in the map with the session, -1 for none."""
        place, living = self._places(entry), entry.living
        site = np.searchsorted(living.sites.site_id, np.append(living.places.site_id, -1)[place])
        return np.where(place >= 0, site, -1)

    def _places(self, entry: Extended) -> IntArray:
        """(W,) rows of the places at which they were seen in the session, or stood before it; -1 for none."""
        living, place = entry.living, entry.places_of(self.landmark_id)
        member = rows_among(living.members.landmark_id, self.landmark_id)
        stood = living.place_row(self.landmark_id, np.append(living.site_of(entry.p_start), UNKNOWN)[member])
        return np.where(place >= 0, place, stood)

    def unlooked(self, watch: Watch, entry: Extended) -> Watch:
        """Return the watched places without those of these landmarks before they arrived and after they left."""
        place = self._places(entry)
        mine, count = place >= 0, len(entry.living.places)
        since, until = np.full(count, -np.inf), np.full(count, np.inf)
        since[place[mine]] = np.nan_to_num(self.since_s[mine] + self.when_s, nan=-np.inf)
        until[place[mine]] = np.nan_to_num(self.until_s[mine] - self.when_s, nan=np.inf)
        listed = watch.listed
        row, stamp_s = listed.landmark, watch.stamp_s[listed.pose]
        there = listed.hit | ((stamp_s > since[row]) & (stamp_s < until[row]))
        return watch._replace(listed=listed.rows(there))


def departed(now: Believed, seen: PlaceLooks, what: Witnessed, entry: Extended) -> tuple[Believed, PlaceLooks]:
    """Return beliefs with observed departures, their evidence by clique and by frame, and looks that have them."""
    site = what.sites(entry)
    left = np.flatnonzero(np.isfinite(what.until_s) & (site >= 0))
    if not len(left):
        return now, seen
    sites, (cliques, clique_of) = now.sites, clique_rows(now.sites)
    at, p_left = site[left], np.clip(what.probability[left], LEAST_P, MOST_P)
    clique = clique_of[at]
    p_here, p_kept, log_evidence = sites.p_here.copy(), sites.p_kept.copy(), now.log_evidence.copy()
    p_here[at] *= 1.0 - p_left
    p_kept[at] *= 1.0 - p_left
    log_evidence[clique] = -WITNESSED_NATS
    total = np.bincount(clique_of, p_here, minlength=len(cliques))
    stamp_s, none, one = what.until_s[left] + what.when_s, np.zeros(len(left), np.int64), np.ones(len(left), np.int64)
    of_left = Evidence(
        cliques[clique], stamp_s, none, one, np.ones(len(left)), np.log1p(-p_left), np.clip(total[clique], 0.0, 1.0)
    )
    evidence = now.evidence.joined(of_left)
    evidence = evidence[np.lexsort((evidence.stamp_s, evidence.clique_id))]
    sites = replace(sites, p_here=p_here, p_kept=p_kept)
    now = replace(now, sites=sites, log_evidence=log_evidence, evidence=evidence)
    return now, _with_looks(entry.living, seen, at, clique, stamp_s)


def _with_looks(
    living: LivingMap, seen: PlaceLooks, site: IntArray, clique: IntArray, stamp_s: FloatArray
) -> PlaceLooks:
    """Looks with one more at each of some sites, which finds nothing and cannot be mistaken."""
    rows, lines, n = seen.rows, seen.lines, len(site)
    place = np.searchsorted(living.places.site_id, living.sites.site_id[site])
    last = np.array([np.append(np.flatnonzero(seen.place == one), -1)[-2:][0] for one in place.tolist()])
    cell = np.append(seen.cell, 0)[last]
    nothing, lines_of = np.zeros(n, dtype=np.bool_), len(lines.hits)
    rows = replace(
        rows,
        stamp_s=np.append(rows.stamp_s, stamp_s),
        clique=np.append(rows.clique, clique),
        site=np.append(rows.site, site),
        key=np.append(rows.key, np.full(n, lines_of)),
        hit=np.append(rows.hit, nothing),
    )
    sure = lines._replace(
        p_free=np.append(lines.p_free, 1.0), hits=np.append(lines.hits, KNOWN), misses=np.append(lines.misses, 1.0)
    )
    order = np.lexsort((rows.stamp_s, rows.clique))
    return replace(
        seen,
        rows=rows_of(rows, order),
        place=np.append(seen.place, place)[order],
        cell=np.append(seen.cell, cell)[order],
        lines=sure,
        counts=np.append(seen.counts, ~nothing)[order],
        settled=np.append(seen.settled, nothing)[order],
    )


def arrived(came: Arrivals, what: Witnessed, entry: Extended) -> Arrivals:
    """Return arrivals by earlier looks, with the observed ones, and departures among these."""
    site = what.sites(entry)
    seen = {
        int(site[k]): (float(what.since_s[k] - what.when_s), float(what.probability[k]))
        for k in np.flatnonzero(np.isfinite(what.since_s) & (site >= 0))
    }
    new = ~np.isin(entry.living.sites.site_id[site], entry.before.sites.site_id) | np.isfinite(what.since_s)
    left = np.flatnonzero(np.isfinite(what.until_s) & (site >= 0) & new)
    return replace(came, came=seen, left_s={int(site[k]): float(what.until_s[k] + what.when_s) for k in left})


def follow_occupants(came: Arrivals, now: Believed, entry: Extended) -> Arrivals:
    """Return arrivals of which some are at the spot of a box that is away by now.

    Two bodies are never in one spot: what is new within half a width of the middle of a former box came after that was
    last seen, as surely as the box is away.
    """
    before, sites, middle = entry.before, now.sites, site_middles(entry.living)
    width_m = before.boxes.of(before.places.landmark_id)[:, :2].min(axis=1)
    boxes = np.flatnonzero(np.isfinite(width_m))
    if not len(boxes) or not len(came.site):
        return came
    old = np.searchsorted(sites.site_id, before.places.site_id[boxes])
    cliques, row = clique_rows(sites)
    p_away = 1.0 - np.bincount(row, sites.p_here, minlength=len(cliques))
    looked, p_appeared = came.looked_s.copy(), came.p_appeared.copy()
    for k, site in enumerate(came.site.tolist()):
        away_m = np.linalg.norm(before.places.position_m[boxes] - middle[site], axis=1)
        there = np.flatnonzero((away_m < 0.5 * width_m[boxes]) & (row[old] != row[site]))
        if not len(there):
            continue
        last = old[there[np.argmax(sites.seen_s[old[there]])]]
        if p_away[row[last]] > p_appeared[k]:
            looked[k], p_appeared[k] = float(sites.seen_s[last]), float(p_away[row[last]])
    return replace(came, looked_s=looked, p_appeared=p_appeared)
