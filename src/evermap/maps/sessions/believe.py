"""Beliefs of the map's cliques: predicted to a session by their lifetimes, and updated by its hits and misses."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.config import LivingConfig
from evermap.existence.sites import Evidence, SiteBeliefs, SiteDynamics, SiteLooks, SiteSensor, follow_sites
from evermap.maps.lives import Life
from evermap.maps.living import EXISTS, LivingMap, Sites, class_of, clique_rows, site_middles
from evermap.maps.sessions.extend import Extended, first_and_last
from evermap.maps.sessions.looks import PlaceLooks
from evermap.sensing.sightlines import Lines, nominal_lines
from evermap.survival.step import never_leaves
from evermap.types import FloatArray, IntArray, Sensor, rows_of


@dataclass(frozen=True, slots=True)
class Believed:
    """The map with the session's beliefs.

    Attributes:
        living: all but stays and what is learned.
        log_evidence: (C,) what the session's looks say for 'it stands at one of its sites' against 'it is away', as a
            log likelihood ratio, by clique, in the order of `living.clique_rows`.
        evidence: of every clique and frame.
    """

    living: LivingMap
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
    """Return the map with the beliefs and the counts of a session, which goes from one instant to another."""
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
        log_evidence = _log_odds(row, after.p_here, len(cliques)) - _log_odds(row, after.p_before, len(cliques))
        evidence = replace(after.trace, clique_id=cliques[after.trace.clique_id])
    else:
        sites = replace(sites, p_here=_as_seen(living, rows.site[hit], last))
    stood = (entry.p_start >= EXISTS) & ~entry.is_new
    arrived = np.isfinite(first) & ~stood & (sites.p_here >= EXISTS)
    since_s = np.where(arrived & ~entry.is_new, first, sites.since_s)
    sites = replace(sites, since_s=since_s, seen_s=np.maximum(sites.seen_s, last))
    living = replace(living, stamp_s=until_s, session_start_s=start_s, places=places, sites=sites)
    return Believed(living, log_evidence, evidence)


def _log_odds(clique: IntArray, p_here: FloatArray, n: int) -> FloatArray:
    """(n,) log odds that a clique stands at one of its sites, by the row of the clique of each (S,)."""
    p = np.clip(np.bincount(clique, p_here, minlength=n), 1e-12, 1.0 - 1e-12)
    return np.asarray(np.log(p / (1.0 - p)))


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
