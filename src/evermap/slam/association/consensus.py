"""Pairs of landmarks that are the same, decided jointly: consensus in the joint Gaussian of their differences.

A landmark that returns after a long way may match a dozen others by its own gate, but all returning landmarks share
one error of the robot. A set of pairs is therefore grown from a seed: given the pairs so far, the pair with most
evidence is added, until none has any. That is repeated from every seed. A pair is certain if the best set without it
has far less evidence. (Joint compatibility, Neira and Tardos 2001, with evidence instead of counts, and greedy instead
of branch and bound: polynomial for any width of the gates.)
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from evermap.slam.kernels import kernel
from evermap.types import BoolArray, FloatArray, IntArray

MOST_SEEDS = 80
"""Number of seeds, the pairs with most evidence by themselves: bounds the work."""
LARGEST_SET = 32
"""Largest number of pairs in a set: bounds the work."""
IMPLIED_M2 = 1e-7
"""Variance up to which a difference follows from the other pairs: a tolerance."""
LEAST_M2 = 1e-12
"""Lower bound of variances, against rounding."""
FREE = 2
"""Number of pairs that determine a motion in the plane."""


class Candidates(NamedTuple):
    """P candidate pairs.

    Attributes:
        difference: (P, D) of the two positions, in the plane or in space.
        covariance: (D P, D P) of all differences together.
        log_density: (P,) of the difference if they are two landmarks, with all other evidence against the pair.
        conflict: (P, P) pairs that exclude each other.
        ends: (P, 2) the two landmarks of each, counted from 0: a pair that follows from others is no evidence. None if
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
        evidence: of the set over no pairs [nats].
        margin: (n,) the same over the best set without each pair [nats].
    """

    pairs: IntArray
    evidence: float
    margin: FloatArray


def consensus(candidates: Candidates, *, gate: float, loose: float) -> Consensus:
    """Return the set of pairs with most evidence, and the margin of each.

    Args:
        candidates: the pairs.
        gate: largest squared distance of a pair, given those before it.
        loose: the same for the first `FREE` pairs, which determine the motion.
    """
    count = len(candidates.difference)
    if not count:
        return Consensus(np.zeros(0, dtype=np.int64), 0.0, np.zeros(0))
    ends = np.arange(2 * count).reshape(count, 2) if candidates.ends is None else candidates.ends
    every = Candidates(*map(np.ascontiguousarray, candidates._replace(ends=ends)))
    alone = np.array([_grown(np.array([k]), -1, 1, gate, loose, every)[1] for k in range(count)])
    seeds = np.argsort(-alone, kind="stable")[:MOST_SEEDS]
    sets, evidence, label = _all_grown(seeds, gate, loose, every)
    if evidence.max() <= 0.0:
        return Consensus(np.zeros(0, dtype=np.int64), 0.0, np.zeros(0))
    top = int(np.argmax(evidence))
    best = sets[top][sets[top] >= 0]
    margin = np.full(len(best), evidence[top])  # over no pairs
    for m, pair in enumerate(best.tolist()):
        without = evidence[label[:, ends[pair, 0]] != label[:, ends[pair, 1]]]
        _, rest, _ = _grown(np.delete(best, m), pair, LARGEST_SET, gate, loose, every)
        margin[m] = evidence[top] - max(0.0, rest, without.max(initial=0.0))
    return Consensus(best, float(evidence[top]), margin)


@functools.cache
def warm_up() -> None:
    """Compile the kernels, or load them from the cache, by one pair."""
    one = Candidates(np.zeros((1, 2)), np.eye(2), np.array([-9.0]), np.zeros((1, 1), dtype=np.bool_))
    consensus(one, gate=9.0, loose=9.0)


@kernel
def _all_grown(seeds: IntArray, gate: float, loose: float, pairs: Any) -> tuple[IntArray, FloatArray, IntArray]:
    """Sets (K, LARGEST_SET) grown from seeds (K,), padded by -1, the evidence (K,) of each, and labels (K, L) of
    landmarks: those with one label are the same.
    """
    sets, evidence = np.full((len(seeds), LARGEST_SET), -1), np.zeros(len(seeds))
    label = np.empty((len(seeds), pairs.ends.max() + 1), dtype=np.int64)
    for k in range(len(seeds)):
        none: Any = np.int64(-1)  # no literals, for which numba would compile it again
        most: Any = np.int64(LARGEST_SET)
        found, evidence[k], label[k] = _grown(seeds[k : k + 1], none, most, gate, loose, pairs)
        sets[k, : len(found)] = found
    return sets, evidence, label


@kernel
def _grown(
    start: IntArray, forbidden: int, most: int, gate: float, loose: float, pairs: Any
) -> tuple[IntArray, float, IntArray]:
    """Grow a set from pairs `start` to at most `most`, without the `forbidden` one; return it, its evidence, and the
    labels of landmarks.
    """
    difference, covariance, log_density, ends = pairs.difference, pairs.covariance, pairs.log_density, pairs.ends
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
                # a pair that follows from the set, as the third of three landmarks, is no evidence
                if open_[k] and _least_variance(own[k]) > IMPLIED_M2:
                    gain, squared = _gain(own[k], rest[k], root, z)
                    if squared <= (loose if n < FREE else gate) and gain - log_density[k] > most_gained:
                        best, most_gained = k, gain - log_density[k]
        if best < 0:
            break
        evidence += most_gained
        chosen[n] = best
        _gain(own[best], rest[best], root, z)  # leaves the lower root of its covariance, given the pairs before
        open_[best] = False
        one, other = label[ends[best, 0]], label[ends[best, 1]]
        label[label == other] = one
        for k in range(count):
            one, other = label[ends[k, 0]], label[ends[k, 1]]
            if pairs.conflict[best, k] or one == other:
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
    """Log density of a difference at zero, and its squared distance; writes the lower root of the covariance to `root`
    and the whitened difference to `z`.
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
