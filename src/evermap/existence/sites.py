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

from functools import partial

import numpy as np

from evermap.existence import checks
from evermap.existence.site_chains import Chains, distinct, odds, transitions
from evermap.existence.site_frames import Frames, Said, said_by
from evermap.existence.site_records import SiteBeliefs, SiteDynamics, SiteLooks, SiteTrace, check_sites
from evermap.sensing.sightlines import Lines
from evermap.types import BoolArray, FloatArray, IntArray

__all__ = ["SiteBeliefs", "SiteDynamics", "SiteLooks", "SiteTrace", "follow_sites"]

STEPS = 32
"""Of a gap between sessions, in each of which a clique leaves or returns at most once."""
SELDOM = 0.01
"""A gap in which nobody leaves or returns with more than these odds is one step."""


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
    p_occluded: float = 0.02,
    occluded_s: float = 5.0,
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
        p_occluded: that somebody stands before the whole clique.
        occluded_s: mean time that he stays, so that a blind spell is one event and not as many as it has frames; 0 for
            another one in every frame.
        held: (C,) cliques that are never believed away (an operator's word); none where None.
        use_misses: False has only hits speak.

    Raises:
        InputError: shapes, rows that do not exist, numbers out of range, or time running back.
    """
    from evermap.existence import site_kernels as kernels

    n_cliques, n_sites = len(dynamics.p_hop), len(p_here)
    start = checks.as_rows(start_s, n_cliques, "start_s")
    pinned = np.zeros(n_cliques, dtype=np.bool_) if held is None else np.asarray(held, dtype=np.bool_)
    check_sites(p_here, clique_of_site, dynamics, looks, lines, start, until_s, p_false, p_occluded, occluded_s)
    chains = Chains.of(clique_of_site, n_cliques)
    frames = Frames.of(looks, n_cliques, until_s)

    # From the last session to the first look, in steps; then from look to look.
    priors, number = distinct((*dynamics.stay, *dynamics.absence))
    prior = chains.by_row(number[:n_sites], number[n_sites:])
    since = chains.by_row(dynamics.since_s, dynamics.away_since_s)
    route, moves = chains.routes(dynamics.p_hop, dynamics.return_share, pinned)
    gap_s = (frames.stamp_s[frames.first[:-1]] - start)[chains.clique]
    age = np.maximum(start[chains.clique] - since, 0.0)
    brief = odds(priors, prior, np.stack([age, np.zeros(len(age))], 1), np.stack([age + gap_s, gap_s], 1)) < SELDOM
    steps = 1 if brief.all() else STEPS
    step_s = gap_s / steps
    old, new, came = chains.start(p_here, pinned), np.zeros(len(since)), np.zeros(len(since))
    edges = age[:, None] + np.arange(steps + 1) * step_s[:, None]
    since_middle = np.maximum(np.arange(steps + 1) - 0.5, 0.0) * step_s[:, None]
    death_old, death_new = (odds(priors, prior, age_s[:, :-1], age_s[:, 1:]) for age_s in (edges, since_middle))
    kernels.renew(chains.first, route, moves, death_old, death_new, old, new, came)
    came = start[chains.clique] + came * step_s
    log_rest, log_leave = transitions(chains, priors, prior, since, came, moves, frames.clique, frames.stamp_s)
    with np.errstate(divide="ignore"):
        log_route, log_here = np.log(route), np.log(np.column_stack([old, new]))
    chain = chains.first, frames.first, log_route, log_rest, log_leave

    def filtered(said: Said) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Log probabilities after each frame, what it said for the sites, and the evidence of all."""
        found = np.empty(log_rest.shape), np.empty(len(frames)), np.empty(n_cliques)
        kernels.forward(*chain, log_here, said.log_ratio, *found)
        return found

    say = partial(
        said_by, frames, looks, chains, lines,
        p_false=float(p_false), p_occluded=float(p_occluded), occluded_s=float(occluded_s),
    )  # fmt: skip
    hits, said = say(use_misses=False), say(use_misses=use_misses)
    log_after, log_odds, log_evidence = filtered(said)
    smoothed = np.empty(log_rest.shape)
    kernels.backward(*chain, hits.log_ratio, filtered(hits)[0], smoothed)

    seat = chains.row_of_site - chains.first[clique_of_site]
    stayed, returned = np.exp(log_after[frames.first[1:][clique_of_site] - 1, :, seat]).T
    share = np.divide(stayed, stayed + returned, out=np.ones(n_sites), where=stayed + returned > 0.0)
    weight = np.empty(len(looks))
    weight[frames.order] = np.exp(smoothed[frames.of_look, :, seat[looks.site[frames.order]]]).sum(axis=1)
    return SiteBeliefs(
        p_here=stayed + returned,
        p_stayed=stayed,
        p_before=(old + new)[chains.row_of_site],
        since_s=share * dynamics.since_s + (1.0 - share) * came[chains.row_of_site],
        weight=weight,
        log_evidence=log_evidence,
        trace=_trace(frames, said, log_after, log_odds),
    )


def _trace(frames: Frames, said: Said, log_after: FloatArray, log_odds: FloatArray) -> SiteTrace:
    """The frames in which something was looked at."""
    rows = np.flatnonzero(frames.is_look)
    at_sites = np.exp(log_after[rows]).sum(axis=1)[:, 1:]
    best = 1 + at_sites.argmax(axis=1) if len(rows) else rows
    return SiteTrace(
        clique=frames.clique[rows],
        stamp_s=frames.stamp_s[rows],
        n_hits=said.n_hits[rows, best],
        n_misses=said.n_misses[rows, best],
        expected=said.expected[rows, best],
        log_odds=log_odds[rows],
        p_exists=at_sites.sum(axis=1),
    )
