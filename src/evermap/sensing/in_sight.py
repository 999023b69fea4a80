"""Each landmark is detected at a rate of its own: how probable it is that all looks miss one that is there.

A position from which a place is looked at `k` times, each with probability `p` to detect a usual landmark, shows it
with probability `q d`, where `d = 1 - prod (1 - p)` is what the looks are worth and `q` the landmark's own share of
such positions: small for what is small, glossy or turned away. Shares are beta distributed over landmarks, with
parameters that are learned from those of the session. These were selected: one that was never detected is not known to
be there. So the likelihood of what was seen of a known one is divided by the probability that it was seen at all (a
beta-binomial, truncated at zero, where all looks are worth the same). Of the others each is gone, or hidden from
everywhere, or was missed by chance; what one of them says is evidence on all but itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import betainc, logsumexp, softmax

from evermap.types import BoolArray, FloatArray, IntArray

SHARES = np.geomspace(1.0 / 3.0, 64.0, 25)
"""Parameters of the beta distribution that are weighed, all alike (both are a number of positions). How many landmarks
are hardly ever detected is what no session says, since these are not among those that it detected: the least one was
chosen by houses and STAR-loc."""
EDGES = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 41))
"""Of the bins of own shares over which is integrated, narrow at both ends."""
LEVELS = 100
"""Bins of what looks from a position are worth."""
LEAST = 1e-300
"""Likelihood, so that its logarithm is finite."""
NOTHING = np.zeros(2)
"""Positions that are believed beforehand."""


class Positions(NamedTuple):
    """From where places were looked at: (N,) rows, one for each place, position and kind of look.

    Attributes:
        place: row of the place.
        worth: probability that looks from there detect a usual landmark, if it is in sight.
        hit: whether one did.
        counts: whether these looks are evidence; all of them say whether a place was ever seen.
    """

    place: IntArray
    worth: FloatArray
    hit: BoolArray
    counts: BoolArray

    @classmethod
    def of(
        cls, place: IntArray, cell: IntArray, p_detect: FloatArray, hit: BoolArray, counts: BoolArray, sticky: float
    ) -> Positions:
        """Return looks (N,) by place and position: cells (N, 2). So many consecutive looks as `sticky` says are one."""
        rows, row = np.unique(np.column_stack([place, cell, counts]), axis=0, return_inverse=True)
        row = row.ravel()
        log_missed = np.bincount(row, np.log1p(-np.minimum(p_detect, 0.99)) / sticky, minlength=len(rows))
        seen = np.bincount(row, hit, minlength=len(rows)) > 0
        return cls(rows[:, 0].astype(np.int64), -np.expm1(log_missed), seen, rows[:, 3] > 0)

    def sum_by_place(self, some: BoolArray, log_p: FloatArray, count: int) -> FloatArray:
        """Return (P, Q) sums of a table (LEVELS, Q) over the rows of some looks."""
        number = np.bincount(self.place[some] * LEVELS + self.level[some], minlength=count * LEVELS)
        return np.asarray(number.reshape(count, LEVELS) @ log_p)

    @property
    def level(self) -> IntArray:
        """(N,) bin of what the looks are worth."""
        return np.minimum((self.worth * LEVELS).astype(np.int64), LEVELS - 1)


def weigh_never_seen(
    seen: Positions,
    unseen: BoolArray,
    hidden: FloatArray,
    p_gone: float,
    at_first: FloatArray = NOTHING,
) -> FloatArray:
    """Return (P,) how probable it is that all looks that count miss what stands at a place; 1 without any.

    Args:
        seen: from where places were looked at.
        unseen: (P,) places that were never detected, by these looks or others.
        hidden: (H,) shares of the places that are in sight from nowhere, which are weighed.
        p_gone: probability that there is nothing, of a place that was never detected.
        at_first: (2,) positions from which a landmark is in sight, and from which it is not, believed beforehand.
    """
    count, (place, _, hit, counts) = len(unseen), seen
    looked, found, ever = (np.bincount(place[some], minlength=count) > 0 for some in (counts, counts & hit, hit))
    known, asked = ~unseen & looked & ever, unseen & looked
    number = np.bincount(seen.level, minlength=LEVELS)
    worth = (np.bincount(seen.level, seen.worth, minlength=LEVELS) + 1e-9) / np.maximum(number, 1)  # mean of each bin
    share = 0.5 * (EDGES[1:] + EDGES[:-1])
    shown = np.minimum(worth, 1.0)[:, None] * share
    log_missed = np.log1p(-shown)
    a, b = (grid.ravel()[:, None] for grid in np.meshgrid(SHARES, SHARES))
    p_share = np.asarray(np.diff(betainc(a, b, EDGES), axis=1), dtype=np.float64)
    log_mean = np.log(np.hstack([a, b]) / (a + b))
    log_fit = log_mean @ at_first
    missed = seen.sum_by_place(counts & ~hit, log_missed, count)
    if known.any():
        by_any = np.asarray(np.log(-np.expm1(seen.sum_by_place(np.ones_like(hit), log_missed, count)[known])))
        by_others = np.log(np.maximum(-np.expm1(seen.sum_by_place(~counts, log_missed, count)), LEAST))
        fit = missed + seen.sum_by_place(counts & hit, np.log(shown), count)
        # what was seen by looks that do not count only is known by these
        fit = np.where(found[:, None], fit, fit + by_others)[known]
        log_fit = log_fit + (_log_mean(p_share, fit) - _log_mean(p_share, by_any)).sum(axis=1)
    by_chance = p_share @ np.exp(missed[asked]).T
    log_hidden = np.count_nonzero(known) * np.log1p(-hidden) - 0.5 * np.log(hidden)
    log_sum, mean = np.empty((2, len(hidden), by_chance.shape[1]))
    for k, p_hidden in enumerate(hidden):
        p_missed = p_hidden + (1.0 - p_hidden) * by_chance
        each = np.log(p_gone + (1.0 - p_gone) * p_missed)
        weight = log_hidden[k] + log_fit[:, None] + each.sum(axis=1, keepdims=True) - each
        log_sum[k] = logsumexp(weight, axis=0)
        mean[k] = (np.exp(weight - log_sum[k]) * p_missed).sum(axis=0)
    p = np.ones(count)
    p[asked] = (softmax(log_sum, axis=0) * mean).sum(axis=0)
    return p


def _log_mean(weight: FloatArray, log_p: FloatArray) -> FloatArray:
    """Return (G, K) logarithms of means of likelihoods (K, Q) by weights (G, Q)."""
    highest = log_p.max(axis=1, keepdims=True)
    return np.asarray(np.log(np.maximum(weight @ np.exp(log_p - highest).T, LEAST)) + highest.T)
