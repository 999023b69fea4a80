"""Lines of sight that nobody looked along before: how probably they lead through open space.

A street that was mapped driving one way is driven the other way: no line to what is missed was ever seen to be clear,
and nothing behind it shows that it is. But the session knows of space, not of lines only: wherever it saw something,
nothing stood between. These rays cover part of a new line. On the rest of it, `u` metres through which the session did
not see, there may be a wall or a shut door. With `r` of them a metre, and a share `q` of places that are hidden all the
same, the line is clear with probability

    P(clear) = (1 - q) exp(-r u)

In a street both are others than in a house. A session learns them from all that is known and was looked at along new
lines, and starts from what earlier ones learned. A line along which something was seen has no wall in its metres; what
was missed from all is gone, or there is a wall, or it is hidden; what was missed, but seen along other lines, is not
gone. Each is asked by the rays to the others only. With none to ask, no line of any length is open.

Rays are those of the session, not of earlier ones: what was open then may be shut now.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.config import LooksConfig
from evermap.types import BoolArray, FloatArray, IntArray

RATES = np.geomspace(1e-6, 300.0, 80)
"""Walls a metre over which is integrated."""
_LOGITS = np.linspace(-40.0, 5.0, 61)
LOG_HIDDEN, LOG_SHOWN = -np.logaddexp(0.0, -_LOGITS), -np.logaddexp(0.0, _LOGITS)
"""Logarithms of shares of places that are hidden all the same, over which is integrated, and of the others."""
WIDE_M, NARROW_M, STEP_M = 0.35, 0.05, 0.1
"""Half widths of a ray where it begins, as one is taken of each cell, and where it ends; steps along a line."""
MOST_LINES = 40
"""Lines to a clique that are asked, evenly of all."""
_STARTS = 12
"""Directions of a sector in which sectors may begin."""


class Rays(NamedTuple):
    """Lines along which something was seen: (R, 2) from, (R, 2) to [m], (R,) the clique that was seen."""

    from_m: FloatArray
    to_m: FloatArray
    clique: IntArray


class NewLooks(NamedTuple):
    """Looks along new lines: (N,) rows.

    Attributes:
        clique, line: (N,) clique that is looked for, and number of the line.
        hit: (N,) whether it was detected.
        p_detect: (N,) how probable that was with nothing in the way.
        eye_m, place_m: (N, 2) ends of the line.
    """

    clique: IntArray
    line: IntArray
    hit: BoolArray
    p_detect: FloatArray
    eye_m: FloatArray
    place_m: FloatArray


class OpenSpace(NamedTuple):
    """What a session says of new lines to C cliques.

    Attributes:
        counts: (N,) looks along lines that are known to be clear by it, to cliques that were missed.
        p_clear: (C,) probability that a clique that was missed is not hidden; 0 where nothing was asked.
        unseen_m: (C,) `u` of the line with the least of it; nan where nothing was asked.
        learned: (4,) of the gamma distribution of `r` the shape and rate [m], of the beta distribution of `q` both
            parameters: after the session.
    """

    counts: BoolArray
    p_clear: FloatArray
    unseen_m: FloatArray
    learned: FloatArray


def weigh_new_lines(
    rays: Rays,
    looks: NewLooks,
    p_gone: FloatArray,
    teaches: BoolArray,
    before: FloatArray,
    least_clear: float,
    settings: LooksConfig,
) -> OpenSpace:
    """Return how probably new lines are open.

    Args:
        rays: of the session.
        looks: along lines of which nothing was known before.
        p_gone: (C,) probability that each clique is gone, but for these looks.
        teaches: (C,) cliques of which is known otherwise whether they stand.
        before: (4,) as `OpenSpace.learned`, by earlier sessions.
        least_clear: probability from which a line is known to be clear.
        settings: what counts as having looked.
    """
    from evermap.sensing.kernels import unseen_length

    n, (shape, rate_m, hidden, shown) = len(p_gone), before.tolist()
    nothing = OpenSpace(np.zeros(len(looks.clique), dtype=np.bool_), np.zeros(n), np.full(n, np.nan), before)
    _, first, key, often = np.unique(looks.line, return_index=True, return_inverse=True, return_counts=True)
    if not len(first) or not len(rays.clique):
        return nothing
    key, of = key.ravel(), looks.clique[first]
    asked = np.flatnonzero(_evenly(of, n, MOST_LINES))
    u = np.full(len(first), np.inf)
    eye, place, ray_eye, ray_end = (
        np.ascontiguousarray(one, dtype=np.float64)
        for one in (looks.eye_m[first[asked]], looks.place_m[first[asked]], rays.from_m, rays.to_m)
    )
    limits = WIDE_M, NARROW_M, STEP_M
    u[asked] = unseen_length(eye, place, of[asked], ray_eye, ray_end, rays.clique, limits)
    u = np.maximum(u, settings.beside_m)  # things are put against walls: of those next to a place rays say little
    unseen_m = _least(u, of, often, n, settings.witnesses)
    who = np.flatnonzero(np.isfinite(unseen_m))
    alike = u[key] <= 2.0 * unseen_m[looks.clique] + STEP_M
    away = looks.eye_m - looks.place_m
    sides, of_shown, of_all = (
        count_sides(looks.clique[some], away[some], n, settings)[who, None, None]
        for some in (alike, looks.hit, np.ones(len(key), dtype=np.bool_))
    )
    seen = np.bincount(looks.clique[looks.hit], minlength=n)[who] > 0
    clear = np.exp(LOG_SHOWN)[:, None] * np.exp(-unseen_m[who, None, None] * RATES)  # (A, Q, R)
    is_hidden, gone = (1.0 - clear) ** sides, p_gone[who, None, None]
    by_line = _fit_lines(looks, key, of[asked], asked, u[asked], n)[who]
    of_seen = of_all * by_line[:, None] + of_shown * LOG_SHOWN[:, None]
    fit = np.where(seen[:, None, None], of_seen, np.log(gone + (1.0 - gone) * is_hidden))
    prior = (shape * np.log(RATES) - rate_m * RATES) + (hidden * LOG_HIDDEN + shown * LOG_SHOWN)[:, None]
    total = prior + fit[teaches[who]].sum(axis=0)
    p_clear, p_line = np.zeros(n), np.zeros(len(first))
    for k in np.flatnonzero(~seen):  # its own miss is the evidence on it, and counts once
        weight = _normalise(total - fit[k] * teaches[who[k]])
        p_clear[who[k]] = 1.0 - float((weight * is_hidden[k]).sum())
        mine = asked[of[asked] == who[k]]
        p_line[mine] = np.exp(-u[mine, None] * RATES) @ weight.sum(axis=0)
    counts = (p_line >= least_clear)[key] & (p_clear >= least_clear)[looks.clique]
    return OpenSpace(counts, p_clear, unseen_m, _moments(_normalise(total), settings) if teaches[who].any() else before)


def warm_up() -> None:
    """Compile what new lines need, or load it."""
    from evermap.sensing.kernels import unseen_length

    eye, place, body = np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1, dtype=np.int64)
    unseen_length(eye, place, body, eye, place, body, (WIDE_M, NARROW_M, STEP_M))


def _evenly(of: IntArray, n: int, most: int) -> BoolArray:
    """Return which lines (K,) to cliques are taken, `most` of each, evenly."""
    order = np.argsort(of, kind="stable")
    count = np.bincount(of, minlength=n)
    rank = np.empty(len(of), dtype=np.int64)
    rank[order] = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    share = np.minimum(1.0, most / np.maximum(count, 1))[of]
    return np.asarray(np.floor((rank + 1) * share + 1e-9) > np.floor(rank * share + 1e-9))


def _least(u: FloatArray, of: IntArray, often: IntArray, n: int, looks: int) -> FloatArray:
    """Return (C,) the length within which enough looks at a clique have not more; nan for few."""
    found = np.full(n, np.nan)
    order = np.lexsort((u, of))
    order = order[np.isfinite(u[order])]
    total = np.cumsum(often[order])
    begin = np.flatnonzero(np.diff(of[order], prepend=-1))
    before = np.repeat((total - often[order])[begin], np.diff(np.append(begin, len(order))))
    enough = order[total - before >= looks][::-1]
    found[of[enough]] = u[enough]  # the last that is written is the least
    return found


def _fit_lines(looks: NewLooks, key: IntArray, of: IntArray, asked: IntArray, u: FloatArray, n: int) -> FloatArray:
    """Return (C, R) mean log likelihood of what was seen along each line, and missed, if the clique stands there."""
    count = int(key.max(initial=-1)) + 1
    seen = np.bincount(key, looks.hit, count)[asked] > 0
    p_looks = -np.expm1(np.bincount(key, np.log1p(-np.minimum(looks.p_detect, 0.98)), count)[asked])
    wall = -u[:, None] * RATES
    each = np.where(seen[:, None], wall, np.log1p(-p_looks[:, None] * np.exp(wall)))
    total = np.zeros((n, len(RATES)))
    np.add.at(total, of, each)
    return total / np.maximum(np.bincount(of, minlength=n), 1)[:, None]


def _normalise(log_weight: FloatArray) -> FloatArray:
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def _moments(weight: FloatArray, settings: LooksConfig) -> FloatArray:
    """Return (4,) parameters with the means and variances of weights (Q, R), worth no more than the settings say."""
    of_share, of_rate, share = weight.sum(axis=1), weight.sum(axis=0), np.exp(LOG_HIDDEN)
    rate, mean = float(of_rate @ RATES), float(of_share @ share)
    rate_m = rate / max(float(of_rate @ (RATES - rate) ** 2), 1e-12)
    worth = mean * (1.0 - mean) / max(float(of_share @ (share - mean) ** 2), 1e-12) - 1.0
    rate_m, worth = min(rate_m, settings.most_unseen_m), min(max(worth, 1.0), settings.most_new)
    return np.array([rate * rate_m, rate_m, mean * worth, (1.0 - mean) * worth])


def count_sides(clique: IntArray, away: FloatArray, n: int, settings: LooksConfig) -> FloatArray:
    """(C,) number of sides from which each of `n` cliques was looked at, at least one, by the cliques (N,) of the looks
    that count and missed, and (N, 2) from the places to the sensor.

    A side is a sector with enough looks. Their number is the mean over the directions in which sectors may begin,
    counted from the mean direction of the looks: it grows steadily with the angle that looks span, and a map that is
    turned has the same.
    """
    every = settings.sides * _STARTS
    angle = np.arctan2(away[:, 1], away[:, 0])
    east, north = (np.bincount(clique, some, minlength=n) for some in (np.cos(angle), np.sin(angle)))
    turned = np.mod((angle - np.arctan2(north, east)[clique]) * (every / (2.0 * np.pi)) + 0.5, every)
    part = np.floor(turned).astype(np.int64) % every
    looks = np.bincount(clique * every + part, minlength=n * every).reshape(n, every)
    sums = np.cumsum(np.hstack([looks, looks[:, : _STARTS - 1]]), axis=1)
    within = sums[:, _STARTS - 1 :] - np.hstack([np.zeros((n, 1), dtype=np.int64), sums[:, : every - 1]])
    enough = within >= settings.witnesses
    return np.asarray(np.clip(enough.sum(axis=1) / _STARTS, 1.0, settings.most_sides))
