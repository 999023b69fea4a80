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
LEAST_M2 = 1e-12
"""No variance is less, by rounding."""
FREE = 2
"""Pairs that fix how one map lies over another."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """P pairs that may be one.

    Attributes:
        difference: (P, D) of the two places, in the plane or in space.
        covariance: (D P, D P) of all differences together.
        log_density: (P,) of the difference and all else that speaks against it, were they two.
        conflict: (P, P) pairs that cannot both be one.
        ends: (P, 2) the two landmarks of each, counted from 0: what follows from other pairs is no evidence. None where
            no pair can follow from others.
    """

    difference: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    conflict: BoolArray
    ends: IntArray | None = None


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
    ends = np.arange(2 * count).reshape(count, 2) if candidates.ends is None else candidates.ends
    every = (
        np.ascontiguousarray(candidates.difference),
        np.ascontiguousarray(candidates.covariance),
        candidates.log_density,
        np.ascontiguousarray(candidates.conflict),
        np.ascontiguousarray(ends),
    )
    if not count:
        return Consensus(np.zeros(0, dtype=np.int64), 0.0, np.zeros(0))
    alone = np.array([_grown(np.array([k]), -1, 1, gate, loose, *every)[1] for k in range(count)])
    seeds = np.argsort(-alone, kind="stable")[:MOST_SEEDS]
    sets, evidence, label = _all_grown(seeds, gate, loose, *every)
    if evidence.max() <= 0.0:
        return Consensus(np.zeros(0, dtype=np.int64), 0.0, np.zeros(0))
    top = int(np.argmax(evidence))
    best = sets[top][sets[top] >= 0]
    margin = np.full(len(best), evidence[top])  # over all being two
    for m, pair in enumerate(best.tolist()):
        without = evidence[label[:, ends[pair, 0]] != label[:, ends[pair, 1]]]
        _, rest, _ = _grown(np.delete(best, m), pair, LARGEST_SET, gate, loose, *every)
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
    ends: IntArray,
) -> tuple[IntArray, FloatArray, IntArray]:
    """Sets (K, LARGEST_SET) grown from seeds (K,), -1 where they end, the evidence (K,) of each, and (K, L) which
    landmarks are one in it: those of one label.
    """
    sets, evidence = np.full((len(seeds), LARGEST_SET), -1), np.zeros(len(seeds))
    label = np.empty((len(seeds), ends.max() + 1), dtype=np.int64)
    for k in range(len(seeds)):
        found, evidence[k], label[k] = _grown(
            seeds[k : k + 1], -1, LARGEST_SET, gate, loose, difference, covariance, log_density, conflict, ends
        )
        sets[k, : len(found)] = found
    return sets, evidence, label


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
    ends: IntArray,
) -> tuple[IntArray, float, IntArray]:
    """Grow a set from pairs `start` to at most `most`, in which the `forbidden` one is none; returns it, its evidence,
    and labels of landmarks.
    """
    count = len(difference)
    room = max(min(most, LARGEST_SET), len(start))
    chosen, evidence = np.empty(room, dtype=np.int64), 0.0
    open_ = np.ones(count, dtype=np.bool_)
    label = np.arange(ends.max() + 1)
    if forbidden >= 0:
        open_[forbidden] = False
    dim = difference.shape[1]
    rest, own, root, z = difference.copy(), np.empty((count, dim, dim)), np.empty((dim, dim)), np.empty(dim)
    for k in range(count):
        own[k] = covariance[dim * k : dim * k + dim, dim * k : dim * k + dim]
    white = np.zeros((count, dim, dim * room))
    n = 0
    while n < room:
        best, most_gained = -1, 0.0
        if n < len(start):
            best = start[n]
            most_gained = _gain(own[best], rest[best], root, z)[0] - log_density[best]
        else:
            for k in range(count):
                # what follows from the set, as the third pair of three landmarks, is no evidence
                if open_[k] and _least_variance(own[k]) > IMPLIED_M2:
                    gain, squared = _gain(own[k], rest[k], root, z)
                    if squared <= (loose if n < FREE else gate) and gain - log_density[k] > most_gained:
                        best, most_gained = k, gain - log_density[k]
        if best < 0:
            break
        evidence += most_gained
        chosen[n] = best
        _gain(own[best], rest[best], root, z)  # leaves the lower root of its covariance, given those before
        open_[best] = False
        one, other = label[ends[best, 0]], label[ends[best, 1]]
        label[label == other] = one
        for k in range(count):
            one, other = label[ends[k, 0]], label[ends[k, 1]]
            if conflict[best, k] or one == other:
                open_[k] = False
            elif forbidden >= 0:
                a, b = label[ends[forbidden, 0]], label[ends[forbidden, 1]]
                if (a == one and b == other) or (a == other and b == one):
                    open_[k] = False
        n += 1
        if n == room:
            break
        known = dim * (n - 1)
        for k in range(count):
            if not open_[k] and n >= len(start):
                continue
            for row in range(dim):
                explained = 0.0
                for a in range(dim):
                    value = covariance[dim * k + row, dim * best + a]
                    for m in range(known):
                        value -= white[k, row, m] * white[best, a, m]
                    for b in range(a):
                        value -= root[a, b] * white[k, row, known + b]
                    white[k, row, known + a] = value / root[a, a]
                    explained += white[k, row, known + a] * z[a]
                rest[k, row] -= explained
            for row in range(dim):
                for column in range(dim):
                    explained = 0.0
                    for a in range(dim):
                        explained += white[k, row, known + a] * white[k, column, known + a]
                    own[k, row, column] -= explained
    return chosen[:n], evidence, label


@kernel
def _least_variance(own: FloatArray) -> float:
    """Smallest number on a diagonal."""
    least = np.inf
    for a in range(len(own)):
        least = min(least, float(own[a, a]))
    return least


@kernel
def _gain(own: FloatArray, rest: FloatArray, root: FloatArray, z: FloatArray) -> tuple[float, float]:
    """Log density of a difference at zero, and its squared distance; `root` becomes the lower root of the covariance,
    `z` the whitened difference.
    """
    squared, log_det = 0.0, 0.0
    for a in range(len(rest)):
        left = rest[a]
        for b in range(a + 1):
            value = own[a, b]
            for c in range(b):
                value -= root[a, c] * root[b, c]
            if b < a:
                root[a, b] = value / root[b, b]
                left -= root[a, b] * z[b]
            else:
                root[a, a] = np.sqrt(max(value, LEAST_M2))
        z[a] = left / root[a, a]
        squared += z[a] * z[a]
        log_det += 2.0 * np.log(root[a, a])
    return -0.5 * (squared + log_det + len(rest) * np.log(2.0 * np.pi)), squared
