"""Chains of cliques over 'away' and their sites, compiled: evidence of frames, gaps between sessions, looks within one.

A clique of K sites has K + 1 *seats*: 0 is 'away', the others are its sites. At a seat it is *old*, there since before
the session, or *new*, come in the meantime; the two differ in age. Rows of columns by seat: one for each site of every
clique and one for its 'away', cliques after one another, `seat[c]` to `seat[c + 1]` those of clique c, 'away' first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.existence.elementary import inlined, kernel
from evermap.sensing.sightlines import Lines
from evermap.types import BoolArray, FloatArray, IntArray


@inlined
def _log_add(a: Any, b: Any) -> Any:
    """`log(e^a + e^b)`, also of infinities."""
    high, low = max(a, b), min(a, b)
    return high if low == -np.inf else high + np.log1p(np.exp(low - high))


class FrameRows(NamedTuple):
    """N looks in F frames.

    Attributes:
        first: (F + 1,) rows of frame f are `first[f]` to `first[f + 1]`, those of a seat next to each other.
        clique: (F,) frames of a clique are next to each other, in order of time.
        stamp_s: (F,) of the frames.
        slot: (N,) rows of `Lines`: one for each pair of seat and line of sight.
        seat: (N,) number of the seat within its clique.
        hit: (N,) detected.
    """

    first: IntArray
    clique: IntArray
    stamp_s: FloatArray
    slot: IntArray
    seat: IntArray
    hit: BoolArray


class FrameEvidence(NamedTuple):
    """Evidence of F frames on W seats.

    Attributes:
        log_ratio: (F, W) log likelihood of each seat, less that of being away.
        n_hits, n_misses: (F, W) detections and misses of its places.
        expected: (F, W) mean number of detections, had the clique been there.
    """

    log_ratio: FloatArray
    n_hits: IntArray
    n_misses: IntArray
    expected: FloatArray


class SiteChain(NamedTuple):
    """Chains of C cliques.

    Attributes:
        seat: (C + 1,) rows of the seats of each clique.
        first_frame: (C + 1,) frames of each clique; at least one.
        log_route: (R, W) log probability that one that leaves a seat goes to another of its clique.
        log_rest: (F, 2, W) log probabilities to be at the same seat since the frame before, of the old and the new;
            undefined at the first frame of a clique.
        log_leave: (F, 2, W) to have left it for another one, that is `log_route`.
    """

    seat: IntArray
    first_frame: IntArray
    log_route: FloatArray
    log_rest: FloatArray
    log_leave: FloatArray


@kernel
def frame_evidence(
    rows: FrameRows, lines: Lines, sensor: tuple[float, float, float, bool], said: FrameEvidence
) -> None:
    """Compute the evidence of frames for each seat against 'away', while learning the lines of sight.

    All is given that the clique has been at a site all the time. (Of one that comes while it is watched, the looks
    before count too: a little too cautious then.) Whether the lines of sight to it are free changes as seldom as what
    is known of each by itself allows, for one wall hides a clique from many cells. Detections along a free line are
    exchangeable (Beta-Bernoulli): their probabilities multiply, each given those before. And somebody may stand before
    the whole clique (MATH.md section 3), for a while: a chain in continuous time over the frames. What is seen of it
    then is false, and teaches nothing.

    Args:
        rows: the looks.
        lines: of each slot; hits and misses are updated in place.
        sensor: all but the lines of `sites.SiteSensor`.
        said: filled in.
    """
    first, clique, stamp_s, slot, seat, hit = rows
    p_free, hits, misses, p_blocked = lines
    p_false, p_occluded, occluded_s, use_misses = sensor
    log_ratio, n_hits, n_misses, expected = said
    width = log_ratio.shape[1]
    free, likely = np.empty(width), np.empty(width)  # of each seat: after the last frame, and by its lines alone
    veil, looked_s = np.empty(width), np.empty(width)  # that it was occluded then, if its line is free
    for f in range(first.size - 1):
        log_ratio[f], n_hits[f], n_misses[f], expected[f] = 0.0, 0, 0, 0.0
        if f == 0 or clique[f] != clique[f - 1]:
            likely[:] = -1.0
        low = first[f]
        while low < first[f + 1]:
            k = seat[low]
            high, p_line = low, 0.0
            while high < first[f + 1] and seat[high] == k:
                p_line += p_free[slot[high]]
                high += 1
            p_line /= high - low
            if likely[k] < 0.0:
                free[k], veil[k] = p_line, p_occluded
            elif p_line >= likely[k]:
                opened = (p_line - likely[k]) / (1.0 - likely[k]) if likely[k] < 1.0 else 0.0
                free[k] += (1.0 - free[k]) * opened
            else:
                free[k] *= p_line / likely[k]
            if likely[k] >= 0.0:
                lasting = np.exp(-(stamp_s[f] - looked_s[k]) / (occluded_s * (1.0 - p_occluded))) if occluded_s else 0.0
                veil[k] = p_occluded + (veil[k] - p_occluded) * lasting
            likely[k], looked_s[k] = p_line, stamp_s[f]

            seen, hidden = 0.0, 0.0
            for row in range(low, high):
                a, b = hits[slot[row]], misses[slot[row]]
                p = max(a / (a + b), p_false)  # P(detect) of a present landmark is at least that of a false detection
                q = max(p_blocked, p_false)
                expected[f, k] += free[k] * p + (1.0 - free[k]) * q
                if hit[row]:
                    n_hits[f, k] += 1
                    hits[slot[row]] += 1.0
                    seen += np.log(p / p_false)
                    hidden += np.log(q / p_false)
                else:
                    n_misses[f, k] += 1
                    if use_misses:
                        misses[slot[row]] += 1.0
                        seen += np.log(min(b / (a + b), 1.0 - p_false) / (1.0 - p_false))
                        hidden += np.log((1.0 - q) / (1.0 - p_false))
            seen += np.log(free[k] * (1.0 - veil[k]))
            veiled = np.log(free[k] * veil[k])
            hidden += np.log(1.0 - free[k])
            total = _log_add(_log_add(seen, veiled), hidden)
            log_ratio[f, k] = total
            open_line = _log_add(seen, veiled)
            free[k] = min(np.exp(open_line - total), 1.0)
            veil[k] = min(np.exp(veiled - open_line), 1.0) if open_line > -np.inf else p_occluded
            nothing = 1.0 - min(np.exp(seen - total), 1.0)
            for row in range(low, high):  # looks that were none
                if hit[row]:
                    hits[slot[row]] -= nothing
                elif use_misses:
                    misses[slot[row]] -= nothing
            low = high


@kernel
def renew(
    seat: IntArray,
    route: FloatArray,
    moves: FloatArray,
    death_old: FloatArray,
    death_new: FloatArray,
    old: FloatArray,
    new: FloatArray,
    began: FloatArray,
) -> None:
    """Carry beliefs over a long gap in which a clique may leave and return many times: the renewal equation in M steps.

    A clique that arrives within a step does so in its middle; one that leaves in the same step arrives in the next.

    Args:
        seat: (C + 1,) rows of the seats of each clique.
        route: (R, W) where one that leaves a seat goes; what is missing to 1 stays.
        moves: (R,) sum of that.
        death_old: (R, M) odds of leaving, in each step, of those that have been there since before.
        death_new: (R, M, M) odds of leaving of those that came in each step: in the rest of that, and in each one after
            it; (R, 1, M) where it does not matter when they came.
        old: (R,) probabilities, updated in place.
        new: (R,) filled in: of those that came in the meantime.
        began: (R,) filled in: when that was on average, in steps; the middle of the gap where none came.
    """
    steps, when = death_old.shape[1], death_new.shape[1] > 1
    come = np.zeros((old.size, steps))
    again = np.zeros(old.size)
    for c in range(seat.size - 1):
        low, high = seat[c], seat[c + 1]
        for m in range(steps):
            for s in range(low, high):
                leaving = again[s] + old[s] * _share(death_old[s, m])
                old[s] *= _rest(death_old[s, m], moves[s])
                for j in range(m):
                    leaving += come[s, j] * _share(death_new[s, j * when, m - j])
                    come[s, j] *= _rest(death_new[s, j * when, m - j], moves[s])
                for t in range(high - low):
                    come[low + t, m] += leaving * route[s, t]
            for s in range(low, high):
                again[s] = come[s, m] * _share(death_new[s, m * when, 0])
                come[s, m] *= _rest(death_new[s, m * when, 0], moves[s])
        for s in range(low, high):
            for t in range(high - low):
                come[low + t, steps - 1] += again[s] * route[s, t]
        for s in range(low, high):
            new[s], began[s] = 0.0, 0.0
            for m in range(steps):
                new[s] += come[s, m]
                began[s] += come[s, m] * (m + 0.5)
            began[s] = began[s] / new[s] if new[s] > 0.0 else 0.5 * steps


@inlined
def _share(odds: Any) -> Any:
    """Probability of something of these odds."""
    return odds / (1.0 + odds) if odds < 1.0 else 1.0 / (1.0 + 1.0 / odds)


@inlined
def _rest(odds: Any, moves: Any) -> Any:
    """Probability to be where one was: of not leaving, or of leaving for nowhere."""
    return 1.0 / (1.0 + odds) + _share(odds) * max(1.0 - moves, 0.0)


@kernel
def forward(
    chain: SiteChain,
    log_here: FloatArray,
    log_ratio: FloatArray,
    filtered: FloatArray,
    log_odds: FloatArray,
    log_evidence: FloatArray,
) -> None:
    """Follow beliefs after each frame of every clique, the first of which lies where they are known.

    Args:
        chain: of the cliques.
        log_here: (R, 2) log probabilities at the first frame, before it: old and new.
        log_ratio: (F, W) what each frame says for the seats, against 'away'.
        filtered: (F, 2, W) filled in: log probabilities after each frame.
        log_odds: (F,) filled in: what each frame says for 'at one of its sites' against 'away'.
        log_evidence: (C,) filled in: log probability of all frames over that if it were away.
    """
    seat, first_frame, log_route, log_rest, log_leave = chain
    flow = np.empty(log_ratio.shape[1])
    for c in range(seat.size - 1):
        low, n = seat[c], seat[c + 1] - seat[c]
        log_evidence[c] = 0.0
        for f in range(first_frame[c], first_frame[c + 1]):
            now = filtered[f]
            now[:] = -np.inf
            if f == first_frame[c]:
                for s in range(n):
                    now[0, s], now[1, s] = log_here[low + s, 0], log_here[low + s, 1]
            else:
                last = filtered[f - 1]
                for s in range(n):
                    flow[s] = _log_add(last[0, s] + log_leave[f, 0, s], last[1, s] + log_leave[f, 1, s])
                for t in range(n):
                    now[0, t] = last[0, t] + log_rest[f, 0, t]
                    now[1, t] = last[1, t] + log_rest[f, 1, t]
                    for s in range(n):
                        now[1, t] = _log_add(now[1, t], flow[s] + log_route[low + s, t])
            sites, seen, total = -np.inf, -np.inf, -np.inf
            for s in range(n):
                for age in range(2):
                    if s > 0:
                        sites = _log_add(sites, now[age, s])
                    now[age, s] += log_ratio[f, s]
                    if s > 0:
                        seen = _log_add(seen, now[age, s])
                    total = _log_add(total, now[age, s])
            log_odds[f] = seen - sites if sites > -np.inf else 0.0
            log_evidence[c] += total
            for age in range(2):
                for s in range(n):
                    now[age, s] -= total


@kernel
def backward(chain: SiteChain, log_ratio: FloatArray, filtered: FloatArray, smoothed: FloatArray) -> None:
    """Fill in `smoothed` (F, 2, W), log probabilities at each frame given all of them, from those of `forward`."""
    seat, first_frame, log_route, log_rest, log_leave = chain
    width = log_ratio.shape[1]
    flow = np.empty(width)
    ahead = np.empty((2, width))
    for c in range(seat.size - 1):
        low, n = seat[c], seat[c + 1] - seat[c]
        ahead[:] = 0.0
        for f in range(first_frame[c + 1] - 1, first_frame[c] - 1, -1):
            smoothed[f] = -np.inf
            total = -np.inf
            for s in range(n):
                for age in range(2):
                    smoothed[f, age, s] = filtered[f, age, s] + ahead[age, s]
                    total = _log_add(total, smoothed[f, age, s])
            for age in range(2):
                for s in range(n):
                    smoothed[f, age, s] -= total
            if f > first_frame[c]:
                for s in range(n):
                    gone = -np.inf
                    for t in range(n):
                        gone = _log_add(gone, log_route[low + s, t] + log_ratio[f, t] + ahead[1, t])
                    flow[s] = gone
                for s in range(n):
                    for age in range(2):
                        stays = log_rest[f, age, s] + log_ratio[f, s] + ahead[age, s]
                        ahead[age, s] = _log_add(stays, log_leave[f, age, s] + flow[s])
