"""The belief of a living map: every clique occupies one of its known sites, or is away.

One chain a clique (MATH.md section 5, "Uniting the papers"). A clique at a site stays over a gap with the conditional
survival of its lifetime; one that leaves stands at another known site at once with `p_hop`, else is away, and one that
is away returns as its absence ends. With one site and no return this is Rosen's persistence filter, with several
landmarks on the clique Bateman's joint clique filter, with a constant hazard and `p_hop = 1` Nielsen's chain of modes.

Misses are weighed by what is known of the lines of sight (`sensing.sightlines`) and by what the same session says of
them, so that false negatives are explained instead of suppressed: a site that is hidden from where the robot looks, or
occluded, is not one that was left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from evermap.errors import InputError
from evermap.existence import protocol as checks
from evermap.existence.lifetimes import log_death_odds
from evermap.existence.recursion import LOG_LARGEST
from evermap.existence.rhythm import Rhythm
from evermap.sensing.sightlines import Lines
from evermap.show import Shown
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray, Tabular

if TYPE_CHECKING:
    from evermap.existence.site_kernels import FrameEvidence, SiteChain


@dataclass(frozen=True, slots=True)
class CliqueChains:
    """Layout of the seats, see `site_kernels`.

    Attributes:
        first: (C + 1,) rows of each clique's seats, 'away' first.
        clique: (R,) clique of each row.
        row_of_site: (S,).
    """

    first: IntArray
    clique: IntArray
    row_of_site: IntArray

    @classmethod
    def of(cls, clique_of_site: IntArray, n_cliques: int) -> CliqueChains:
        count = 1 + np.bincount(clique_of_site, minlength=n_cliques)
        first = np.append(0, np.cumsum(count))
        order = np.argsort(clique_of_site, kind="stable")
        row_of_site = np.empty(len(clique_of_site), dtype=np.int64)
        row_of_site[order] = np.arange(len(order)) + clique_of_site[order] + 1  # one 'away' for each clique up to it
        return cls(first, np.repeat(np.arange(n_cliques), count), row_of_site)

    @property
    def width(self) -> int:
        """W: most seats of a clique."""
        return int(np.max(np.diff(self.first), initial=1))

    def by_row(self, of_site: Any, of_clique: Any) -> Any:
        """Return (R,) a column by seat."""
        column = np.empty(len(self.clique), dtype=np.asarray(of_site).dtype)
        column[self.first[:-1]] = of_clique
        column[self.row_of_site] = of_site
        return column

    def start(self, p_here: FloatArray, held: BoolArray) -> FloatArray:
        """Return (R,) probabilities of all seats; those of a clique that is held are all at its sites."""
        n = len(held)
        site_clique = self.clique[self.row_of_site]
        total = np.bincount(site_clique, p_here, minlength=n)
        count = np.bincount(site_clique, minlength=n)
        firm = held & (count > 0)
        lost = (firm & (total == 0.0))[site_clique]
        scale = np.where(firm & (total > 0.0) | (total > 1.0), total, 1.0)[site_clique]
        here = np.where(lost, 1.0 / np.maximum(count, 1)[site_clique], p_here / scale)
        return np.asarray(self.by_row(here, np.where(firm, 0.0, np.maximum(1.0 - total, 0.0))))

    def routes(self, p_hop: FloatArray, return_share: FloatArray, held: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return (R, W) where one that leaves a seat goes, by seat of its clique, and (R,) the sum: the rest stays."""
        share = self.by_row(return_share, 0.0)
        width = self.width
        seat = np.arange(len(self.clique)) - self.first[self.clique]
        to = self.first[self.clique][:, None] + np.arange(width)
        known = to < self.first[1:][self.clique][:, None]
        shares = np.where(known, share[np.where(known, to, 0)], 0.0)
        away, itself = seat == 0, seat[:, None] == np.arange(width)
        others = np.where(itself, 0.0, shares)
        elsewhere = np.where(away, 1.0, 1.0 - share)[:, None]
        hop = np.where(away, 1.0, p_hop[self.clique])[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            route = np.where(elsewhere > 0.0, np.minimum(hop * others / elsewhere, 1.0), 0.0)
        moves = np.minimum(route.sum(axis=1), 1.0)
        free = ~away & ~held[self.clique]
        route[free, 0] = np.maximum(1.0 - moves[free], 0.0)
        return route, np.where(free, 1.0, moves)


def distinct(priors: tuple[LifetimePrior, ...]) -> tuple[tuple[LifetimePrior, ...], IntArray]:
    """Return the different ones among priors, and which of these each is."""
    number: dict[object, int] = {}
    row = np.array([number.setdefault(_name(prior), len(number)) for prior in priors], dtype=np.int64)
    first = np.unique(row, return_index=True)[1]
    return tuple(priors[k] for k in first), row


def _name(prior: LifetimePrior) -> object:
    """Return a key that equal priors share; for one that cannot be compared, its identity."""
    try:
        hash(prior)
    except TypeError:
        return id(prior)
    return prior


def odds(priors: tuple[LifetimePrior, ...], prior: IntArray, start_s: FloatArray, stop_s: FloatArray) -> FloatArray:
    """Return (R, M) odds of leaving within gaps [start, stop) of age."""
    log_odds = log_death_odds(priors, np.repeat(prior, start_s.shape[1]), start_s.ravel(), stop_s.ravel())
    certain = np.isinf(log_odds)
    bounded = np.clip(log_odds, -LOG_LARGEST, LOG_LARGEST)
    return np.exp(np.where(certain, log_odds, bounded)).reshape(start_s.shape)


@dataclass(frozen=True, slots=True)
class SiteLooks(Shown):
    """Places that were looked at: (N,) rows in any order, one for each place and frame.

    Attributes:
        stamp_s: of the frame; rows of one clique and stamp are one frame.
        clique: row of the clique, 0 to C - 1.
        site: row of the site the place belongs to, 0 to S - 1.
        key: row of its line of sight, 0 to K - 1.
        hit: whether it was detected.
    """

    stamp_s: FloatArray
    clique: IntArray
    site: IntArray
    key: IntArray
    hit: BoolArray

    def __len__(self) -> int:
        return len(self.stamp_s)


@dataclass(frozen=True, slots=True)
class SiteDynamics(Shown):
    """Dynamics of S sites of C cliques: stays, absences and returns.

    Attributes:
        stay: S lifetimes of a stay at each site.
        since_s: (S,) when the newest stay there began.
        absence: C lifetimes of the time away of each clique.
        away_since_s: (C,) when it went away, if it is away.
        p_hop: (C,) probability that a clique that leaves a site stands at another one at once.
        return_share: (S,) probability that what turns up does so at this site, at most 1 in sum of a clique; the rest
            turns up at places that are not known, which is 'away'. One that hops from a site has the shares of the
            others and of unknown places, scaled to sum 1. 0 for a clique that never returns.
        rhythm: by whose clock the ages of stays are counted of `hourly` cliques; those of absences, and of all where it
            is None, are on the wall.
        hourly: (C,) cliques; none where None.
    """

    stay: tuple[LifetimePrior, ...]
    since_s: FloatArray
    absence: tuple[LifetimePrior, ...]
    away_since_s: FloatArray
    p_hop: FloatArray
    return_share: FloatArray
    rhythm: Rhythm | None = None
    hourly: BoolArray | None = None


class SiteSensor(NamedTuple):
    """Detection model of places.

    Attributes:
        lines: K lines of sight as known before the session.
        p_false: probability of a detection at a place where nothing of the clique is.
        p_occluded: that the whole clique is occluded.
        occluded_s: mean duration of that, so that a blind spell is one event and not as many as it has frames; 0 for an
            occlusion of its own in every frame.
        use_misses: False has only hits count.
    """

    lines: Lines
    p_false: float
    p_occluded: float = 0.02
    occluded_s: float = 5.0
    use_misses: bool = True


@dataclass(frozen=True, slots=True)
class Evidence(Tabular):
    """Evidence of looks at the places of cliques: (E,) rows, by clique, then by time.

    Attributes:
        clique_id: whose; of `SiteBeliefs` the clique's row.
        stamp_s: of the frame.
        n_hits, n_misses: landmarks of it that were detected at its most probable site, and expected but not detected.
        expected: mean number of hits, had it stood there.
        log_odds: log likelihood ratio of the frame for 'it is at one of its sites' against 'it is away' [nats].
        p_exists: probability that it stands at one of its sites, after the frame.
    """

    clique_id: IntArray
    stamp_s: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    expected: FloatArray
    log_odds: FloatArray
    p_exists: FloatArray

    @classmethod
    def empty(cls) -> Self:
        """Return none."""
        number, none = np.zeros(0), np.zeros(0, dtype=np.int64)
        return cls(none, number, none, none, number, number, number)


@dataclass(frozen=True, slots=True)
class SiteBeliefs(Shown):
    """Beliefs of C cliques with S sites after a session of N looks.

    Attributes:
        p_here: (S,) probability that each site is occupied, at the end.
        p_stayed: (S,) part of it: that it has been there since before the start.
        p_before: (S,) before the clique's first look; at the end where there was none.
        since_s: (S,) mean begin of the stay there, given that it stands there at the end.
        weight: (N,) probability that the clique stood at the looks' sites then, given all hits of the session. Misses
            are left out: whether they are due to the line of sight or to the clique is what is learned from them.
        log_evidence: (C,) log probability of all looks at a clique, less that of the same looks if it were away.
        trace: what every frame said.
    """

    p_here: FloatArray
    p_stayed: FloatArray
    p_before: FloatArray
    since_s: FloatArray
    weight: FloatArray
    log_evidence: FloatArray
    trace: Evidence


def _check_sites(
    p_here: FloatArray,
    clique_of_site: IntArray,
    dynamics: SiteDynamics,
    looks: SiteLooks,
    lines: Lines,
    start_s: FloatArray,
    until_s: float,
) -> None:
    """Raise `InputError` for what cannot be."""
    n_cliques, n_sites, n_looks = len(dynamics.p_hop), len(p_here), len(looks)
    lengths: dict[str, tuple[Any, int]] = {
        "p_here": (p_here, n_sites), "clique_of_site": (clique_of_site, n_sites), "stay": (dynamics.stay, n_sites),
        "since_s": (dynamics.since_s, n_sites), "return_share": (dynamics.return_share, n_sites),
        "absence": (dynamics.absence, n_cliques), "away_since_s": (dynamics.away_since_s, n_cliques),
        "p_hop": (dynamics.p_hop, n_cliques), "clique": (looks.clique, n_looks), "site": (looks.site, n_looks),
        "key": (looks.key, n_looks), "hit": (looks.hit, n_looks), "misses": (lines.misses, len(lines.hits)),
        "p_free": (lines.p_free, len(lines.hits)),
    }  # fmt: skip
    if dynamics.hourly is not None:
        lengths["hourly"] = dynamics.hourly, n_cliques
    for field, (column, n) in lengths.items():
        shape = (len(column),) if isinstance(column, tuple) else np.shape(column)
        if shape != (n,):
            raise InputError(f"shape {shape} instead of ({n},)", field=field)
    checks.check_rows(clique_of_site, n_cliques, twice=True, field="clique_of_site")
    checks.check_rows(looks.clique, n_cliques, twice=True, field="clique")
    checks.check_rows(looks.site, n_sites, twice=True, field="site")
    checks.check_rows(looks.key, len(lines.hits), twice=True, field="key")
    for field, values in (("p_here", p_here), ("p_hop", dynamics.p_hop), ("return_share", dynamics.return_share)):
        checks.check_probability(np.asarray(values, dtype=np.float64), field)
    for field, summed in (("p_here", p_here), ("return_share", dynamics.return_share)):
        total = np.bincount(clique_of_site, summed, minlength=n_cliques)
        if (total > 1.0 + 1e-9).any():
            row = int(np.argmax(total))
            raise InputError(f"clique {row}: {total[row]} is more than 1 in sum", field=field)
    for field, stamps in (("since_s", dynamics.since_s), ("away_since_s", dynamics.away_since_s), ("start_s", start_s)):
        if not np.isfinite(stamps).all():
            raise InputError(
                f"row {int(np.argmin(np.isfinite(stamps)))}: not a finite time", field=field, hint="finite times"
            )
    wrong = np.flatnonzero(clique_of_site[looks.site] != looks.clique)
    if wrong.size:
        raise InputError(f"row {wrong[0]}: site {looks.site[wrong[0]]} is of another clique", field="site")
    checks.check_times(looks.stamp_s, start_s[looks.clique], noun="look")
    last = max(np.max(looks.stamp_s, initial=-np.inf), np.max(start_s, initial=-np.inf))
    if not last <= until_s < np.inf:
        raise InputError(f"{until_s} s lies before the last look", field="until_s")


def _check_sensor(sensor: SiteSensor) -> None:
    """Raise `InputError` for what cannot be."""
    lines, p_false, p_occluded, occluded_s, _ = sensor
    checks.check_probability(np.asarray(lines.p_free, dtype=np.float64), "p_free")
    if not 0.0 < p_false < 1.0:
        raise InputError(f"{p_false} is not a probability between 0 and 1, both excluded", field="p_false")
    if not 0.0 <= lines.p_blocked < 1.0:
        raise InputError(f"{lines.p_blocked} is not a probability below 1", field="p_blocked")
    if not 0.0 <= p_occluded < 1.0:
        raise InputError(f"{p_occluded} is not a probability below 1", field="p_occluded")
    if not 0.0 <= occluded_s < np.inf:
        raise InputError(f"{occluded_s} s is not a duration", field="occluded_s")
    for field, counts in (("hits", lines.hits), ("misses", lines.misses)):
        good = np.isfinite(counts) & (np.asarray(counts) > 0.0)
        if not good.all():
            row = int(np.argmin(good))
            raise InputError(f"row {row}: {counts[row]} is not a pseudo count", field=field, hint="a number above 0")


@dataclass(frozen=True, slots=True)
class CliqueFrames:
    """F frames, by clique and time; the last of every clique is the end of the session, at which nothing is looked at.

    Attributes:
        clique, stamp_s: (F,).
        is_look: (F,) False for the ends.
        first: (C + 1,) frames of clique c are `first[c]` to `first[c + 1]`.
        order: (N,) rows of the looks, by frame and site.
        of_look: (N,) frame of each look, in that order.
    """

    clique: IntArray
    stamp_s: FloatArray
    is_look: BoolArray
    first: IntArray
    order: IntArray
    of_look: IntArray

    @classmethod
    def of(cls, looks: SiteLooks, n_cliques: int, until_s: float) -> CliqueFrames:
        """Return the frames of a session that ends at `until_s`."""
        order = np.lexsort((looks.site, looks.stamp_s, looks.clique))
        clique, stamp = looks.clique[order], looks.stamp_s[order]
        opens = np.append(True, (np.diff(clique) != 0) | (np.diff(stamp) != 0))[: len(order)]
        clique = np.append(clique[opens], np.arange(n_cliques))
        stamp = np.append(stamp[opens], np.full(n_cliques, until_s))
        by_clique = np.argsort(clique, kind="stable")  # those of a clique are in order already, its end last
        is_look = (by_clique < np.count_nonzero(opens)).astype(np.bool_)
        first = np.searchsorted(clique[by_clique], np.arange(n_cliques + 1)).astype(np.int64)
        of_look = np.flatnonzero(is_look)[np.cumsum(opens) - 1]
        return cls(clique[by_clique], stamp[by_clique], is_look, first, order, of_look)

    def __len__(self) -> int:
        return len(self.clique)


def _said_by(frames: CliqueFrames, looks: SiteLooks, chains: CliqueChains, sensor: SiteSensor) -> FrameEvidence:
    """Return the evidence of every frame."""
    from evermap.existence.site_kernels import FrameEvidence, FrameRows, frame_evidence

    lines, p_false, p_occluded, occluded_s, use_misses = sensor
    site, key = looks.site[frames.order], looks.key[frames.order]
    n_lines = max(len(lines.hits), 1)
    pair, slot = np.unique(site * n_lines + key, return_inverse=True)  # lines of sight to each site learn by themselves
    p_free, hits, misses = (np.asarray(column, dtype=np.float64)[pair % n_lines] for column in lines[:3])
    shape = len(frames), chains.width
    n_hits, n_misses = np.zeros((2, *shape), dtype=np.int64)
    said = FrameEvidence(np.zeros(shape), n_hits, n_misses, np.zeros(shape))
    rows = FrameRows(
        np.searchsorted(frames.of_look, np.arange(len(frames) + 1)),
        frames.clique,
        frames.stamp_s,
        slot.ravel(),
        chains.row_of_site[site] - chains.first[looks.clique[frames.order]],
        np.asarray(looks.hit, dtype=np.bool_)[frames.order],
    )
    numbers = float(p_false), float(p_occluded), float(occluded_s), bool(use_misses)
    frame_evidence(rows, Lines(p_free, hits, misses, float(lines.p_blocked)), numbers, said)
    return said


STEPS = 32
"""Of a gap between sessions, in each of which a clique leaves or returns at most once."""
SELDOM = 0.01
"""A gap in which nothing leaves or returns with more than these odds is one step."""


def follow_sites(
    p_here: FloatArray,
    clique_of_site: IntArray,
    dynamics: SiteDynamics,
    looks: SiteLooks,
    sensor: SiteSensor,
    *,
    start_s: FloatArray | float,
    until_s: float,
    held: BoolArray | None = None,
) -> SiteBeliefs:
    """Update beliefs by all looks of a session.

    Args:
        p_here: (S,) probability at `start_s` that each site is occupied; the rest to 1 is away.
        clique_of_site: (S,) row of the clique of each site; a clique may have none.
        dynamics: how sites are left and returned to.
        looks: what was looked at.
        sensor: how well places are seen.
        start_s: when `p_here` held, for all or (C,) of each clique; none of its looks is earlier.
        until_s: end of the session; no look is later.
        held: (C,) cliques that are never believed away (an operator's word); none where None.

    Raises:
        InputError: shapes, rows that do not exist, numbers out of range, or time running back.
    """
    from evermap.existence import site_kernels as kernels

    n_cliques, n_sites = len(dynamics.p_hop), len(p_here)
    start = checks.as_rows(start_s, n_cliques, "start_s")
    pinned = np.zeros(n_cliques, dtype=np.bool_) if held is None else np.asarray(held, dtype=np.bool_)
    _check_sites(p_here, clique_of_site, dynamics, looks, sensor.lines, start, until_s)
    _check_sensor(sensor)
    chains = CliqueChains.of(clique_of_site, n_cliques)
    frames = CliqueFrames.of(looks, n_cliques, until_s)
    old = chains.start(p_here, pinned)
    chain, new, came_s = _predict_looks(chains, frames, dynamics, old, start, pinned)
    with np.errstate(divide="ignore"):
        log_here = np.log(np.column_stack([old, new]))
    shape = chain.log_rest.shape

    def filtered(said: FrameEvidence) -> tuple[FloatArray, FloatArray, FloatArray]:
        found = np.empty(shape), np.empty(len(frames)), np.empty(n_cliques)
        kernels.forward(chain, log_here, said.log_ratio, *found)
        return found  # log probabilities after each frame, its evidence for the sites, and the total evidence

    hits, said = (_said_by(frames, looks, chains, one) for one in (sensor._replace(use_misses=False), sensor))
    log_after, log_odds, log_evidence = filtered(said)
    smoothed = np.empty(shape)
    kernels.backward(chain, hits.log_ratio, filtered(hits)[0], smoothed)

    seat = chains.row_of_site - chains.first[clique_of_site]
    stayed, returned = np.exp(log_after[frames.first[1:][clique_of_site] - 1, :, seat]).T
    share = np.divide(stayed, stayed + returned, out=np.ones(n_sites), where=stayed + returned > 0.0)
    weight = np.empty(len(looks))
    weight[frames.order] = np.exp(smoothed[frames.of_look, :, seat[looks.site[frames.order]]]).sum(axis=1)
    since_s = share * dynamics.since_s + (1.0 - share) * came_s[chains.row_of_site]
    before = (old + new)[chains.row_of_site]
    trace = _trace(frames, said, log_after, log_odds)
    return SiteBeliefs(stayed + returned, stayed, before, since_s, weight, log_evidence, trace)


def _predict_looks(
    chains: CliqueChains,
    frames: CliqueFrames,
    dynamics: SiteDynamics,
    old: FloatArray,
    start: FloatArray,
    pinned: BoolArray,
) -> tuple[SiteChain, FloatArray, FloatArray]:
    """Predict from the last session to the first look, in steps; then from look to look.

    Args:
        chains: R rows of seats.
        frames: of the session.
        dynamics: how sites are left and returned to.
        old: (R,) probability of each seat at `start`; updated in place to that of being there since before.
        start: (C,) when that held.
        pinned: (C,) cliques that are never away.

    Returns:
        What happens from frame to frame, and (R,) probability to have come within the gap, and when, on average.
    """
    from evermap.existence.site_kernels import SiteChain, renew

    n_sites = len(dynamics.since_s)
    priors, number = distinct((*dynamics.stay, *dynamics.absence))
    prior = chains.by_row(number[:n_sites], number[n_sites:])
    since = chains.by_row(dynamics.since_s, dynamics.away_since_s)
    route, moves = chains.routes(dynamics.p_hop, dynamics.return_share, pinned)
    gap_s = (frames.stamp_s[frames.first[:-1]] - start)[chains.clique]
    start_s, clock = start[chains.clique], _SeatClock.of(dynamics, chains)
    age = clock.age_s(since, start_s)
    passed = gap_s if clock.rhythm is None else clock.age_s(start_s, start_s + gap_s)
    brief = odds(priors, prior, np.stack([age, np.zeros(len(age))], 1), np.stack([age + passed, passed], 1)) < SELDOM
    steps = 1 if brief.all() else STEPS
    step_s = gap_s / steps
    new, came = np.zeros(len(since)), np.zeros(len(since))
    edges = age[:, None] + np.arange(steps + 1) * step_s[:, None]
    since_middle = np.maximum(np.arange(steps + 1) - 0.5, 0.0) * step_s[:, None]
    death_new = odds(priors, prior, since_middle[:, :-1], since_middle[:, 1:])[:, None]
    if clock.rhythm is not None:
        index: FloatArray = np.arange(steps + 1, dtype=np.float64)
        edges[clock.rows] = age[clock.rows, None] + clock.steps_s(start_s, step_s, np.zeros(1), index)[:, 0]
        of_arrival = np.repeat(death_new, steps, axis=1)  # how long a step is depends on when
        young = clock.steps_s(start_s, step_s, index[:-1] + 0.5, np.maximum(index - 0.5, 0.0))
        ages = young[..., :-1].reshape(len(young), -1), young[..., 1:].reshape(len(young), -1)
        of_arrival[clock.rows] = odds(priors, prior[clock.rows], *ages).reshape(len(young), steps, steps)
        death_new = of_arrival
    death_old = odds(priors, prior, edges[:, :-1], edges[:, 1:])
    renew(chains.first, route, moves, death_old, death_new, old, new, came)
    came_s = start_s + came * step_s
    rest_and_leave = _between_frames(chains, frames, (priors, prior), (since, came_s), moves, clock)
    with np.errstate(divide="ignore"):
        return SiteChain(chains.first, frames.first, np.log(route), *rest_and_leave), new, came_s


@dataclass(frozen=True, slots=True)
class _SeatClock:
    """By which clock the ages of seats are counted.

    Attributes:
        rhythm: of those that have another than the one on the wall; None for none.
        hourly: (R,) whether a seat has it.
        rows: (H,) seats that have.
    """

    rhythm: Rhythm | None
    hourly: BoolArray
    rows: IntArray

    @classmethod
    def of(cls, dynamics: SiteDynamics, chains: CliqueChains) -> _SeatClock:
        n_sites, n_cliques = len(dynamics.since_s), len(dynamics.p_hop)
        if dynamics.rhythm is None or dynamics.hourly is None or not dynamics.hourly.any():
            return cls(None, np.zeros(n_sites + n_cliques, dtype=np.bool_), np.zeros(0, dtype=np.int64))
        at_site = dynamics.hourly[chains.clique[chains.row_of_site]]
        hourly = np.asarray(chains.by_row(at_site, np.zeros(n_cliques, dtype=np.bool_)))
        return cls(dynamics.rhythm, hourly, np.flatnonzero(hourly))

    def age_s(self, since_s: FloatArray, until_s: FloatArray, row: IntArray | None = None) -> FloatArray:
        """Return ages (N,), at least 0, of seats (N,), all in order where None."""
        age = until_s - since_s
        if self.rhythm is not None:
            hourly = self.hourly if row is None else self.hourly[row]
            age = np.where(hourly, self.rhythm.count_s(until_s) - self.rhythm.count_s(since_s), age)
        return np.asarray(np.maximum(age, 0.0))

    def steps_s(self, start_s: FloatArray, step_s: FloatArray, begin: FloatArray, steps: FloatArray) -> FloatArray:
        """Return what passes (H, B, M) on the clock of its seats in steps (M,) after the first `begin` (B,) ones."""
        assert self.rhythm is not None
        start, step = start_s[self.rows, None, None], step_s[self.rows, None, None]
        until = self.rhythm.count_s(start + step * (begin[:, None] + steps))
        return np.asarray(until - self.rhythm.count_s(start + step * begin[:, None]))


def _between_frames(
    chains: CliqueChains,
    frames: CliqueFrames,
    lifetimes: tuple[tuple[LifetimePrior, ...], IntArray],
    began_s: tuple[FloatArray, FloatArray],
    moves: FloatArray,
    clock: _SeatClock,
) -> tuple[FloatArray, FloatArray]:
    """`log_rest` and `log_leave` of `SiteChain`.

    Args:
        chains: R rows of seats.
        frames: of the session.
        lifetimes: the different ones, and (R,) which of these each seat has.
        began_s: (R,) when the old ones came there, and (R,) when the new ones did.
        moves: (R,) probability that one that leaves a seat goes to another.
        clock: by which their ages are counted.
    """
    priors, prior = lifetimes
    row = chains.first[frames.clique][:, None] + np.arange(chains.width)
    frame, seat = np.nonzero(row < chains.first[1:][frames.clique][:, None])
    row = row[frame, seat]
    stop = frames.stamp_s[frame]
    last = np.maximum(frame - 1, 0)
    start = np.where(frames.clique[last] == frames.clique[frame], frames.stamp_s[last], stop)
    with np.errstate(divide="ignore"):
        log_moves, log_stays = np.log(moves[row]), np.log1p(-moves[row])
    log_rest, log_leave = np.full((2, len(frames), 2, chains.width), -np.inf)
    for age, began in enumerate(began_s):
        young, aged = (clock.age_s(began[row], stamp_s, row) for stamp_s in (start, stop))
        log_odds = log_death_odds(priors, prior[row], young, aged)
        leave, rest = -np.logaddexp(0.0, -log_odds), -np.logaddexp(0.0, log_odds)
        log_rest[frame, age, seat] = np.logaddexp(rest, leave + log_stays)
        log_leave[frame, age, seat] = np.where(log_moves > -np.inf, leave, -np.inf)
    return log_rest, log_leave


def _trace(frames: CliqueFrames, said: FrameEvidence, log_after: FloatArray, log_odds: FloatArray) -> Evidence:
    """The frames in which something was looked at."""
    rows = np.flatnonzero(frames.is_look)
    at_sites = np.exp(log_after[rows]).sum(axis=1)[:, 1:]
    best = 1 + at_sites.argmax(axis=1) if len(rows) else rows
    return Evidence(
        clique_id=frames.clique[rows],
        stamp_s=frames.stamp_s[rows],
        n_hits=said.n_hits[rows, best],
        n_misses=said.n_misses[rows, best],
        expected=said.expected[rows, best],
        log_odds=log_odds[rows],
        p_exists=at_sites.sum(axis=1),
    )
