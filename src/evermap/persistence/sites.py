"""The belief of a living map: every clique stands at one of its known sites, or is away.

One chain a clique (MATH.md section 5, "Uniting the papers"). Who stands at a site stays over a gap with the conditional
survival of its lifetime; who leaves stands at another known site at once with `p_hop`, else is away, and who is away
returns as its absence ends. With one site and no return this is Rosen's persistence filter, with several landmarks on
the clique Bateman's joint clique filter, with a constant hazard and `p_hop = 1` Nielsen's chain of modes.

Misses are weighed by what is known of the lines of sight (`sensing.sightlines`) and by what the same session says of
them, so that false negatives are explained instead of suppressed: a site that is hidden from where the robot looks, or
that somebody stands before, is not one that was left.
"""

from __future__ import annotations

import numpy as np

from evermap.persistence import checks
from evermap.persistence.site_chains import Chains, distinct, odds, transitions
from evermap.persistence.site_records import SiteBeliefs, SiteDynamics, SiteLooks, SiteTrace, check_sites
from evermap.sensing.sightlines import Lines
from evermap.types import BoolArray, FloatArray, IntArray

__all__ = ["SiteBeliefs", "SiteDynamics", "SiteLooks", "SiteTrace", "follow_sites"]

STEPS = 32
"""Of a gap between sessions, in each of which a clique leaves or returns at most once."""


def follow_sites(
    p_here: FloatArray,
    clique_of_site: IntArray,
    dynamics: SiteDynamics,
    looks: SiteLooks,
    lines: Lines,
    *,
    start_s: FloatArray | float,
    until_s: float,
    p_false: float,
    p_occluded: float = 0.05,
    held: BoolArray | None = None,
    use_misses: bool = True,
) -> SiteBeliefs:
    """Take all looks of a session in.

    Args:
        p_here: (S,) probability at `start_s` that its clique stands at each site; the rest to 1 is away.
        clique_of_site: (S,) row of the clique of each site; a clique may have none.
        dynamics: how sites are left and returned to.
        looks: what was looked at.
        lines: what is known of K lines of sight before the session.
        start_s: when `p_here` held, for all or (C,) of each clique; none of its looks is earlier.
        until_s: end of the session; no look is later.
        p_false: probability of a detection at a place where nothing of the clique is.
        p_occluded: that somebody stands before the whole clique, in a frame.
        held: (C,) cliques that are never believed away (an operator's word); none where None.
        use_misses: False has only hits speak.

    Raises:
        InputError: shapes, rows that do not exist, numbers out of range, or time running back.
    """
    from evermap.persistence import site_kernels as kernels

    n_cliques, n_sites = len(dynamics.p_hop), len(p_here)
    start = checks.as_rows(start_s, n_cliques, "start_s")
    pinned = np.zeros(n_cliques, dtype=np.bool_) if held is None else np.asarray(held, dtype=np.bool_)
    check_sites(p_here, clique_of_site, dynamics, looks, lines, start, until_s, p_false, p_occluded)
    chains = Chains.of(clique_of_site, n_cliques)
    old = chains.start(np.asarray(p_here, dtype=np.float64), pinned)
    route, moves = chains.routes(dynamics.p_hop, dynamics.return_share, pinned)

    # Frames of every clique, and one without looks at the end.
    order = np.lexsort((looks.site, looks.stamp_s, looks.clique))
    clique, stamp = looks.clique[order], looks.stamp_s[order]
    new_frame = np.append(True, (np.diff(clique) != 0) | (np.diff(stamp) != 0))[: len(order)]
    opening = np.flatnonzero(new_frame)
    frame_clique = np.append(clique[opening], np.arange(n_cliques))
    frame_stamp = np.append(stamp[opening], np.full(n_cliques, until_s))
    is_look = np.arange(len(frame_clique)) < len(opening)
    by_clique = np.argsort(frame_clique, kind="stable")  # within a clique they are in order already, the end last
    frame_clique, frame_stamp, is_look = frame_clique[by_clique], frame_stamp[by_clique], is_look[by_clique]
    first_frame = np.searchsorted(frame_clique, np.arange(n_cliques + 1))
    row_first = np.zeros(len(frame_clique) + 1, dtype=np.int64)
    row_first[1:][is_look] = np.diff(np.append(opening, len(order)))
    row_first = np.cumsum(row_first)

    # What they say.
    width = int(np.max(np.diff(chains.first), initial=1))
    shape = len(frame_clique), width
    seat = chains.row_of_site[looks.site[order]] - chains.first[clique]
    pair, slot = np.unique(looks.site[order] * max(len(lines.hits), 1) + looks.key[order], return_inverse=True)
    key = pair % max(len(lines.hits), 1)
    p_free, hits, misses = (np.asarray(column, dtype=np.float64)[key] for column in lines[:3])
    log_ratio, expected = np.zeros(shape), np.zeros(shape)
    n_hits, n_misses = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    kernels.frame_evidence(
        row_first,
        frame_clique,
        slot.ravel(),
        seat,
        np.asarray(looks.hit, dtype=np.bool_)[order],
        p_free,
        hits,
        misses,
        float(lines.p_blocked),
        float(p_false),
        float(p_occluded),
        use_misses,
        log_ratio,
        n_hits,
        n_misses,
        expected,
    )

    # From the last session to the first look, in steps; then from look to look.
    priors, number = distinct((*dynamics.stay, *dynamics.absence))
    prior = chains.by_row(number[:n_sites], number[n_sites:])
    since = chains.by_row(dynamics.since_s, dynamics.away_since_s)
    gap_s = (frame_stamp[first_frame[:-1]] - start)[chains.clique]
    step = np.arange(STEPS + 1) / STEPS * gap_s[:, None]
    age = np.maximum(start[chains.clique] - since, 0.0)
    new, came = np.zeros(len(old)), np.zeros(len(old))
    middle = step[:, :-1] + 0.5 * (gap_s / STEPS)[:, None]
    kernels.renew(
        chains.first,
        route,
        moves,
        odds(priors, prior, age[:, None] + step[:, :-1], age[:, None] + step[:, 1:]),
        odds(priors, prior, middle, middle + (gap_s / STEPS)[:, None]),
        old,
        new,
        came,
    )
    came = start[chains.clique] + came * gap_s / STEPS
    log_rest, log_leave = transitions(chains, priors, prior, since, came, moves, frame_clique, frame_stamp)

    filtered, smoothed = np.empty((shape[0], 2, width)), np.empty((shape[0], 2, width))
    log_odds, log_evidence = np.empty(shape[0]), np.empty(n_cliques)
    with np.errstate(divide="ignore"):
        log_route, log_here = np.log(route), np.log(np.column_stack([old, new]))
    kernels.smooth(
        chains.first,
        first_frame,
        log_route,
        log_rest,
        log_leave,
        log_here,
        log_ratio,
        filtered,
        smoothed,
        log_odds,
        log_evidence,
    )

    after = np.exp(filtered)
    site_frame, site_seat = first_frame[1:][clique_of_site] - 1, chains.row_of_site - chains.first[clique_of_site]
    stayed, returned = after[site_frame, 0, site_seat], after[site_frame, 1, site_seat]
    at_sites = after[is_look][:, :, 1:].sum(axis=1)
    best = (np.arange(len(at_sites)), 1 + at_sites.argmax(axis=1)) if width > 1 else (np.arange(0), np.arange(0))
    weight = np.empty(len(order))
    look_frame = np.flatnonzero(is_look)[np.cumsum(new_frame) - 1]
    weight[order] = np.exp(smoothed[look_frame, :, seat]).sum(axis=1)
    before = (old + new)[chains.row_of_site]
    share = np.divide(stayed, stayed + returned, out=np.ones(n_sites), where=stayed + returned > 0.0)
    return SiteBeliefs(
        p_here=stayed + returned,
        p_stayed=stayed,
        p_before=before,
        since_s=share * dynamics.since_s + (1.0 - share) * came[chains.row_of_site],
        weight=weight,
        log_evidence=log_evidence,
        trace=SiteTrace(
            clique=frame_clique[is_look],
            stamp_s=frame_stamp[is_look],
            n_hits=n_hits[is_look][best],
            n_misses=n_misses[is_look][best],
            expected=expected[is_look][best],
            log_odds=log_odds[is_look],
            p_exists=at_sites.sum(axis=1),
        ),
    )
