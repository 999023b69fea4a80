"""Seats of cliques as rows of columns, where one that leaves a seat goes, and with what probability it leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from evermap.existence.lifetimes import log_death_odds
from evermap.existence.recursion import LOG_LARGEST
from evermap.survival.base import LifetimePrior
from evermap.types import BoolArray, FloatArray, IntArray


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


class Seats(NamedTuple):
    """Rows of the seats of all cliques.

    Attributes:
        priors: the different lifetimes.
        prior: (R,) which of these each seat has.
        since_s: (R,) when the old ones came there.
        came_s: (R,) when the new ones did, on average.
        route: (R, W) where one that leaves a seat goes.
        moves: (R,) sum of that.
    """

    priors: tuple[LifetimePrior, ...]
    prior: IntArray
    since_s: FloatArray
    came_s: FloatArray
    route: FloatArray
    moves: FloatArray


class Transitions(NamedTuple):
    """Transitions between frames; undefined at the first frame of a clique.

    Attributes:
        log_route: (R, W) log probability that one that leaves a seat goes to another of its clique.
        log_rest: (F, 2, W) log probabilities to be at the same seat since the frame before, of the old and the new.
        log_leave: (F, 2, W) to have left it for another one, that is `log_route`.
    """

    log_route: FloatArray
    log_rest: FloatArray
    log_leave: FloatArray


def transitions(chains: CliqueChains, seats: Seats, frame_clique: IntArray, frame_stamp: FloatArray) -> Transitions:
    """Return what happens between frames.

    Args:
        chains: R rows of seats.
        seats: their lifetimes and routes.
        frame_clique: (F,) clique of each frame, those of a clique next to each other.
        frame_stamp: (F,) when, in order of time within a clique.
    """
    priors, prior, since_s, came_s, route, moves = seats
    width = chains.width
    row = chains.first[frame_clique][:, None] + np.arange(width)
    frame, seat = np.nonzero(row < chains.first[1:][frame_clique][:, None])
    row = row[frame, seat]
    stop = frame_stamp[frame]
    last = np.maximum(frame - 1, 0)
    start = np.where(frame_clique[last] == frame_clique[frame], frame_stamp[last], stop)
    with np.errstate(divide="ignore"):
        log_moves, log_stays = np.log(moves[row]), np.log1p(-moves[row])
    shape = len(frame_clique), 2, width
    log_rest, log_leave = np.full(shape, -np.inf), np.full(shape, -np.inf)
    for age, began in enumerate((since_s, came_s)):
        young, aged = np.maximum(start - began[row], 0.0), np.maximum(stop - began[row], 0.0)
        log_odds = log_death_odds(priors, prior[row], young, aged)
        leave, rest = -np.logaddexp(0.0, -log_odds), -np.logaddexp(0.0, log_odds)
        log_rest[frame, age, seat] = np.logaddexp(rest, leave + log_stays)
        log_leave[frame, age, seat] = np.where(log_moves > -np.inf, leave, -np.inf)
    with np.errstate(divide="ignore"):
        return Transitions(np.log(route), log_rest, log_leave)
