"""Observed arrivals and departures: direct evidence, in addition to looks at places.

A tracker that sees a car drive off knows more than a thousand misses of it would say, since what is missed may be
hidden. So the belief that it stands ends there and then, and of looks only one remains: the first at which it was gone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.existence.sites import Evidence
from evermap.maps.living import LivingMap, clique_rows
from evermap.maps.sessions.believe import Believed
from evermap.maps.sessions.extend import Extended
from evermap.maps.sessions.looks import Arrivals, PlaceLooks, Watch
from evermap.sensing.sightlines import KNOWN
from evermap.types import FloatArray, IntArray, rows_of

WITNESSED_NATS = 50.0
"""Log likelihood ratio of having been seen to leave: more than any lifetime outweighs."""
LEAST_P, MOST_P = 1e-6, 1.0 - 1e-6
"""Bounds of a probability whose logarithm is taken."""


@dataclass(frozen=True, slots=True)
class Witnessed:
    """Landmarks that a session saw arriving or leaving: (W,) rows.

    Attributes:
        landmark_id: which.
        since_s, until_s: when it arrived, and when it left; nan if that was not seen.
        probability: of that.
        when_s: half width of the intervals of both times.
    """

    landmark_id: IntArray
    since_s: FloatArray
    until_s: FloatArray
    probability: FloatArray
    when_s: float = 0.0

    @classmethod
    def nothing(cls) -> Witnessed:
        """Return none."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), np.zeros(0))

    def sites(self, entry: Extended) -> IntArray:
        """Return (W,) rows of their sites in the map with the session, -1 for none."""
        place, living = entry.places_of(self.landmark_id), entry.living
        site = np.searchsorted(living.sites.site_id, np.append(living.places.site_id, -1)[place])
        return np.where(place >= 0, site, -1)

    def unlooked(self, watch: Watch, entry: Extended) -> Watch:
        """Return the watched places without those of these landmarks before they arrived and after they left."""
        place = entry.places_of(self.landmark_id)
        mine, count = place >= 0, 1 + int(entry.place.max(initial=0))
        since, until = np.full(count, -np.inf), np.full(count, np.inf)
        since[place[mine]] = np.nan_to_num(self.since_s[mine] + self.when_s, nan=-np.inf)
        until[place[mine]] = np.nan_to_num(self.until_s[mine] - self.when_s, nan=np.inf)
        listed = watch.listed
        row = np.minimum(listed.landmark, len(since) - 1)
        ours = listed.landmark < len(since)
        stamp_s = watch.stamp_s[listed.pose]
        there = ~ours | listed.hit | ((stamp_s > since[row]) & (stamp_s < until[row]))
        return watch._replace(listed=listed.rows(there))


def departed(now: Believed, seen: PlaceLooks, what: Witnessed, entry: Extended) -> tuple[Believed, PlaceLooks]:
    """Return the map with observed departures, their evidence by clique and by frame, and looks that have them."""
    site, living = what.sites(entry), now.living
    left = np.flatnonzero(np.isfinite(what.until_s) & (site >= 0))
    if not len(left):
        return now, seen
    sites, (cliques, clique_of) = living.sites, clique_rows(living.sites)
    at, p_left = site[left], np.clip(what.probability[left], LEAST_P, MOST_P)
    clique = clique_of[at]
    p_here, p_kept, log_evidence = sites.p_here.copy(), sites.p_kept.copy(), now.log_evidence.copy()
    p_here[at] *= 1.0 - p_left
    p_kept[at] *= 1.0 - p_left
    log_evidence[clique] = -WITNESSED_NATS
    living = replace(living, sites=replace(sites, p_here=p_here, p_kept=p_kept))
    total = np.bincount(clique_of, p_here, minlength=len(cliques))
    stamp_s, none, one = what.until_s[left] + what.when_s, np.zeros(len(left), np.int64), np.ones(len(left), np.int64)
    of_left = Evidence(
        cliques[clique], stamp_s, none, one, np.ones(len(left)), np.log1p(-p_left), np.clip(total[clique], 0.0, 1.0)
    )
    evidence = now.evidence.joined(of_left)
    evidence = evidence[np.lexsort((evidence.stamp_s, evidence.clique_id))]
    return Believed(living, log_evidence, evidence), _with_looks(living, seen, at, clique, stamp_s)


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


def arrived(came: Arrivals, living: LivingMap, what: Witnessed, entry: Extended) -> Arrivals:
    """Return arrivals by earlier looks, with the observed ones, and departures among these."""
    site = what.sites(entry)
    seen = {
        int(site[k]): (float(what.since_s[k] - what.when_s), float(what.probability[k]))
        for k in np.flatnonzero(np.isfinite(what.since_s) & (site >= 0))
    }
    new = ~np.isin(living.sites.site_id[site], entry.before.sites.site_id) | np.isfinite(what.since_s)
    left = np.flatnonzero(np.isfinite(what.until_s) & (site >= 0) & new)
    return replace(came, came=seen, left_s={int(site[k]): float(what.until_s[k] + what.when_s) for k in left})
