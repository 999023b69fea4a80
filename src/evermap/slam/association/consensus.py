"""Which pairs of landmarks are one, all at the same time: consensus in the joint Gaussian of their differences.

A landmark that is met again after a long way may be any of a dozen by its own gate, but all that are met again share
one error of the robot. A set of pairs is therefore grown from a seed: conditioned on the pairs so far being one, the
pair with most evidence comes next, until none has any. That is done from every seed. A pair is certain if the best set
without it, whatever else it has, explains far less. (Joint compatibility, Neira and Tardos 2001, with evidence in place
of counts, and greedy in place of branch and bound: polynomial however wide the gates are.)
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.slam.kernels import kernel
from evermap.types import BoolArray, FloatArray, IntArray

MOST_SEEDS = 80
"""Pairs that sets are grown from, those with most evidence by themselves."""
LARGEST_SET = 32
IMPLIED_M2 = 1e-7
"""Variance of a difference that a set of pairs fixes."""
FREE = 2
"""Pairs that fix how one map lies over another."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """P pairs that may be one.

    Attributes:
        difference: (P, 2) of the two places.
        covariance: (2 P, 2 P) of all differences together.
        log_density: (P,) of the difference and all else that speaks against it, were they two.
        conflict: (P, P) pairs that cannot both be one.
    """

    difference: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    conflict: BoolArray


@dataclass(frozen=True, slots=True)
class Consensus:
    """The set of pairs with most evidence.

    Attributes:
        pairs: (n,) rows of the candidates.
        evidence: that they are one, over all being two [nats].
        margin: (n,) by how much the best set without each falls short [nats].
    """

    pairs: IntArray
    evidence: float
    margin: FloatArray


def consensus(candidates: Candidates, *, gate: float, loose: float) -> Consensus:
    """Return the best set of pairs that are one, and how sure each is.

    Args:
        candidates: the pairs.
        gate: squared distance of a pair, given those before it, that none in a set exceeds.
        loose: the same of the first `FREE` pairs, which fix how the maps lie.
    """
    count = len(candidates.difference)
    every = (
        np.ascontiguousarray(candidates.difference),
        np.ascontiguousarray(candidates.covariance),
        candidates.log_density,
        np.ascontiguousarray(candidates.conflict),
    )
    if not count:
        return Consensus(np.zeros(0, dtype=np.int64), 0.0, np.zeros(0))
    alone = np.array([_grown(np.array([k]), -1, 1, gate, loose, *every)[1] for k in range(count)])
    seeds = np.argsort(-alone, kind="stable")[:MOST_SEEDS]
    sets, evidence = _all_grown(seeds, gate, loose, *every)
    if evidence.max() <= 0.0:
        return Consensus(np.zeros(0, dtype=np.int64), 0.0, np.zeros(0))
    top = int(np.argmax(evidence))
    best = sets[top][sets[top] >= 0]
    margin = np.full(len(best), evidence[top])  # over all being two
    for m, pair in enumerate(best.tolist()):
        without = evidence[~(sets == pair).any(axis=1)]
        _, rest = _grown(np.delete(best, m), pair, LARGEST_SET, gate, loose, *every)
        margin[m] = evidence[top] - max(0.0, rest, without.max(initial=0.0))
    return Consensus(best, float(evidence[top]), margin)


@functools.cache
def warm_up() -> None:
    """Compile the kernels, or load them where that was done before: by one pair that is one."""
    one = Candidates(np.zeros((1, 2)), np.eye(2), np.array([-9.0]), np.zeros((1, 1), dtype=np.bool_))
    consensus(one, gate=9.0, loose=9.0)


@kernel
def _all_grown(
    seeds: IntArray,
    gate: float,
    loose: float,
    difference: FloatArray,
    covariance: FloatArray,
    log_density: FloatArray,
    conflict: Any,
) -> tuple[IntArray, FloatArray]:
    """Sets (K, LARGEST_SET) grown from seeds (K,), -1 where they end, and the evidence (K,) of each."""
    sets, evidence = np.full((len(seeds), LARGEST_SET), -1), np.zeros(len(seeds))
    for k in range(len(seeds)):
        found, evidence[k] = _grown(
            seeds[k : k + 1], -1, LARGEST_SET, gate, loose, difference, covariance, log_density, conflict
        )
        sets[k, : len(found)] = found
    return sets, evidence


@kernel
def _grown(
    start: IntArray,
    forbidden: int,
    most: int,
    gate: float,
    loose: float,
    difference: FloatArray,
    covariance: FloatArray,
    log_density: FloatArray,
    conflict: Any,
) -> tuple[IntArray, float]:
    """Grow a set from pairs `start`, without the `forbidden` one, to at most `most`; returns it and its evidence."""
    count = len(difference)
    room = max(min(most, LARGEST_SET), len(start))
    chosen, evidence = np.empty(room, dtype=np.int64), 0.0
    open_ = np.ones(count, dtype=np.bool_)
    if forbidden >= 0:
        open_[forbidden] = False
    rest, own = difference.copy(), np.empty((count, 3))
    for k in range(count):
        own[k, 0], own[k, 1] = covariance[2 * k, 2 * k], covariance[2 * k, 2 * k + 1]
        own[k, 2] = covariance[2 * k + 1, 2 * k + 1]
    white = np.zeros((count, 2, 2 * room))
    n = 0
    while n < room:
        best, most_gained = -1, 0.0
        if n < len(start):
            best = start[n]
            most_gained = _gain(own[best], rest[best])[0] - log_density[best]
        else:
            for k in range(count):
                # what follows from the set, as the third pair of three landmarks, is no evidence
                if open_[k] and own[k, 0] > IMPLIED_M2 and own[k, 2] > IMPLIED_M2:
                    gain, squared = _gain(own[k], rest[k])
                    if squared <= (loose if n < FREE else gate) and gain - log_density[k] > most_gained:
                        best, most_gained = k, gain - log_density[k]
        if best < 0:
            break
        evidence += most_gained
        chosen[n] = best
        # the lower root of its covariance, given those before
        a = np.sqrt(max(own[best, 0], 1e-12))
        b = own[best, 1] / a
        c = np.sqrt(max(own[best, 2] - b * b, 1e-12))
        z0 = rest[best, 0] / a
        z1 = (rest[best, 1] - b * z0) / c
        open_[best] = False
        for k in range(count):
            if conflict[best, k]:
                open_[k] = False
        n += 1
        if n == room:
            break
        for k in range(count):
            if not open_[k] and n >= len(start):
                continue
            for row in range(2):
                x, y = covariance[2 * k + row, 2 * best], covariance[2 * k + row, 2 * best + 1]
                for m in range(2 * (n - 1)):
                    x -= white[k, row, m] * white[best, 0, m]
                    y -= white[k, row, m] * white[best, 1, m]
                x /= a
                y = (y - b * x) / c
                white[k, row, 2 * n - 2], white[k, row, 2 * n - 1] = x, y
                rest[k, row] -= x * z0 + y * z1
            x0, y0 = white[k, 0, 2 * n - 2], white[k, 0, 2 * n - 1]
            x1, y1 = white[k, 1, 2 * n - 2], white[k, 1, 2 * n - 1]
            own[k, 0] -= x0 * x0 + y0 * y0
            own[k, 1] -= x0 * x1 + y0 * y1
            own[k, 2] -= x1 * x1 + y1 * y1
    return chosen[:n], evidence


@kernel
def _gain(own: FloatArray, rest: FloatArray) -> tuple[float, float]:
    """Log density of a difference at zero, and its squared distance."""
    a, b, d = max(own[0], 1e-12), own[1], max(own[2], 1e-12)
    det = max(a * d - b * b, 1e-20)
    squared = (d * rest[0] ** 2 - 2.0 * b * rest[0] * rest[1] + a * rest[1] ** 2) / det
    return -0.5 * (squared + np.log(det)) - np.log(2.0 * np.pi), squared
