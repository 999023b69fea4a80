"""Beliefs of the map's cliques: predicted to a session by their lifetimes, and updated by its hits and misses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import LivingConfig
from evermap.existence.sites import Evidence, SiteBeliefs, SiteDynamics, SiteLooks, SiteSensor, follow_sites
from evermap.maps.lives import Life
from evermap.maps.living import LivingMap, Sites, class_of, clique_rows, site_middles
from evermap.maps.sessions.looks import PlaceLooks
from evermap.sensing.sightlines import Lines, nominal_lines
from evermap.survival.hazards import never_leaves
from evermap.types import BoolArray, FloatArray, IntArray, Sensor, rows_of


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


def predicted(living: LivingMap, config: LivingConfig, until_s: float) -> FloatArray:
    """Return the (S,) probability that each site is occupied at a later instant."""
    return aged(living, config, until_s).p_here


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
    return with_beliefs(living.sites, living.sites.p_here, after)


def with_beliefs(sites: Sites, p_start: FloatArray, after: SiteBeliefs) -> Sites:
    """Return sites (S,) with beliefs after a gap, and the part of each that is the last seen stay."""
    never_left = np.divide(sites.p_kept, p_start, out=np.zeros(len(sites)), where=p_start > 0.0)
    return replace(sites, p_here=after.p_here, p_kept=after.p_stayed * np.minimum(never_left, 1.0))


def believed(
    living: LivingMap,
    p_start: FloatArray,
    looks: PlaceLooks,
    sensor: Sensor,
    config: LivingConfig,
    start_s: float,
    until_s: float,
) -> SiteBeliefs:
    """Return beliefs after the looks of a session.

    Args:
        living: the map, with the sites that the session found.
        p_start: (S,) beliefs at `start_s`.
        looks: of the session.
        sensor: whose false detections are counted with.
        config: which parts of the engine are on.
        start_s: beginning of the session.
        until_s: its end.
    """
    p_false = p_false_of(sensor, living)
    rows = rows_of(looks.rows, looks.counts)
    # what another robot's session saw until its end is in the beliefs: looks before that count as at that instant
    start_s, until_s = max(start_s, living.stamp_s), max(until_s, living.stamp_s)
    rows = replace(rows, stamp_s=np.maximum(rows.stamp_s, start_s))
    return _followed(living, p_start, rows, looks.lines, config, start_s, until_s, p_false)


def evidence(living: LivingMap, beliefs: SiteBeliefs) -> Evidence:
    """Return the evidence on every clique, frame by frame."""
    cliques, _ = clique_rows(living.sites)
    return replace(beliefs.trace, clique_id=cliques[beliefs.trace.clique_id])


def said(living: LivingMap, beliefs: SiteBeliefs) -> FloatArray:
    """Return the (C,) log likelihood ratio of a session's looks, for 'it is present' against 'it is away'."""
    cliques, row = clique_rows(living.sites)
    before, after = (
        np.clip(np.bincount(row, p, minlength=len(cliques)), 1e-12, 1.0 - 1e-12)
        for p in (beliefs.p_before, beliefs.p_here)
    )
    return np.asarray(np.log(after / (1.0 - after)) - np.log(before / (1.0 - before)))


def p_false_of(sensor: Sensor, living: LivingMap) -> float:
    """Return the probability that a look at an empty place gives a detection of its landmark: a wrong identity, by
    chance.
    """
    return min(max(sensor.p_false / max(len(living.members), 10), 1e-5), 0.1)


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
        held=_pinned(living, cliques),
    )


def _pinned(living: LivingMap, cliques: IntArray) -> BoolArray:
    """(C,) cliques of which an operator said that they are never to be removed."""
    return np.isin(cliques, living.members.clique_id[living.members.pinned])


def _lives(living: LivingMap, config: LivingConfig, class_id: IntArray, position_m: FloatArray) -> list[Life]:
    """(S,) lives at sites (S, 2) of classes (S,): what holds for one is the same object for all that it holds for."""
    chunk = np.floor(position_m[:, :2] / living.lives.chunk_m).astype(np.int64)
    _, first, which = np.unique(np.column_stack([class_id, chunk]), axis=0, return_index=True, return_inverse=True)
    found = []
    for kind, middle in zip(class_id[first].tolist(), position_m[first], strict=True):
        life = living.lives.of(kind, middle) if config.learn_lifetimes else living.lives.said(kind)
        found.append(life if config.returns else replace(life, absence=never_leaves()))
    return [found[k] for k in which.ravel().tolist()]
