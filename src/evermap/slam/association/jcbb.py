"""Joint compatibility: which pairings of detections with landmarks can be true together.

Neira and Tardos: Data Association in Stochastic Mapping Using the Joint Compatibility Test, IEEE T-RA 17(6), 2001.
Pairings that pass their own gates may contradict each other, since all share the robot's error. A set of pairings is
jointly compatible if its stacked innovation passes the gate under the stacked covariance. Branch and bound over the
interpretation tree finds the set with most pairings, and among these the one with the smallest distance. The distance
is updated pairing by pairing with a growing Cholesky factor (their incremental form, square-root).

The largest set is not always right: wide gates contain chance pairings. `pairing_probability` therefore weighs all
compatible sets by Bayes' rule against the alternative, landmarks that are new.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from evermap.slam.kernels import kernel
from evermap.types import FloatArray, IntArray

NEGLIGIBLE = 12.0
"""Log weight below the best set [nats] from which a set is ignored: all such sets together weigh about 1e-4."""
MAX_NODES = 50_000
"""Maximum number of visited nodes, behind which the search is cut; a tenth of a second."""
NARROWER = 0.5
"""Share of `NEGLIGIBLE` with which a search that was cut is done again: what is left out is then what weighs least, not
what comes last in the tree."""
NARROWEST = 1.0
"""Log weight [nats] from which a search that was cut is taken as it is."""


@dataclass(frozen=True, slots=True)
class Pairings:
    """K pairings that pass their own gates; sorted by `source`.

    Attributes:
        source: (K,) detection, or landmark of a local map, counted from 0.
        target: (K,) candidate landmark.
        innovation: (K, D) measured minus predicted, in the plane or in space.
        covariance: (D K, D K) of all innovations together.
        log_density_new: (K,) of the innovation if the landmark is new.
        n_sources: number of sources, with pairings or not.
        log_det_least: (K,) lower bound of that of the covariance of an innovation given all others, to cut sets of no
            weight; None if unknown.
    """

    source: IntArray
    target: IntArray
    innovation: FloatArray
    covariance: FloatArray
    log_density_new: FloatArray
    n_sources: int
    log_det_least: FloatArray | None = None


@functools.cache
def gates(n: int, confidence: float, dim: int = 2) -> FloatArray:
    """Return (n + 1,) chi-square quantiles with `dim` k degrees of freedom for k = 0..n pairings."""
    bounds: FloatArray = np.append(0.0, 2.0 * gammaincinv(0.5 * dim * np.arange(1, n + 1), confidence))
    bounds.setflags(write=False)
    return bounds


def most_pairings(pairings: Pairings, *, confidence: float = 0.99) -> IntArray:
    """Return the jointly compatible set with most pairings and, among those, the smallest distance.

    Returns:
        (n_sources,) the row of `Pairings` of every source, -1 for none.
    """
    order, ordered = _sort_pairings(pairings)
    found = _search(*_arguments(ordered, confidence), False, NEGLIGIBLE)[0]
    chosen, rows = np.full(pairings.n_sources, -1), order[found[found >= 0]]
    chosen[pairings.source[rows]] = rows
    return chosen


def pairing_probability(pairings: Pairings, *, confidence: float = 0.99) -> tuple[FloatArray, float]:
    """Return (K,) posterior probabilities of the pairings over all jointly compatible sets.

    Returns:
        These, and the evidence of all sets together over only new sources [nats].
    """
    order, ordered = _sort_pairings(pairings)
    arguments, ignored = _arguments(ordered, confidence), NEGLIGIBLE
    _, found, evidence, is_cut = _search(*arguments, True, ignored)
    while is_cut and ignored > NARROWEST:
        ignored *= NARROWER
        _, found, evidence, is_cut = _search(*arguments, True, ignored)
    probability = np.zeros(len(order))
    probability[order] = found
    return probability, evidence


def _sort_pairings(pairings: Pairings) -> tuple[IntArray, Pairings]:
    """Return (K,) rows in the order of the search, and the pairings in that order.

    Sources with few pairings come first, and of a source what is most probable by itself: the robot's error is known
    well where alternatives begin, and the first set that is complete is about the best, by which others are cut.
    """
    count, dim = pairings.innovation.shape
    at: IntArray = dim * np.arange(count)[:, None] + np.arange(dim)
    alone = pairings.covariance[at[:, :, None], at[:, None, :]]
    squared = np.einsum("ki,ki->k", pairings.innovation, np.linalg.solve(alone, pairings.innovation[..., None])[..., 0])
    score = -0.5 * (squared + np.linalg.slogdet(alone)[1]) - pairings.log_density_new
    best, level = np.full(pairings.n_sources, -np.inf), np.empty(pairings.n_sources, dtype=np.int64)
    np.maximum.at(best, pairings.source, score)
    several = np.bincount(pairings.source, minlength=pairings.n_sources)
    level[np.lexsort((-best, several))] = np.arange(pairings.n_sources)
    order: IntArray = np.lexsort((-score, level[pairings.source]))
    least, rows = pairings.log_det_least, at[order].ravel()
    ordered = Pairings(
        level[pairings.source[order]], pairings.target[order], pairings.innovation[order],
        pairings.covariance[np.ix_(rows, rows)], pairings.log_density_new[order], pairings.n_sources,
        None if least is None else least[order],
    )  # fmt: skip
    return order, ordered


def _arguments(
    pairings: Pairings, confidence: float
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    first: IntArray = np.searchsorted(pairings.source, np.arange(pairings.n_sources + 1))
    dim, rest = pairings.innovation.shape[1], np.full(pairings.n_sources + 1, np.inf)
    if pairings.log_det_least is not None:
        most, own = np.zeros(pairings.n_sources + 1), -0.5 * (pairings.log_det_least + dim * np.log(2.0 * np.pi))
        np.maximum.at(most, pairings.source, own - pairings.log_density_new)
        rest = most[::-1].cumsum()[::-1].copy()
    return (
        first,
        pairings.target,
        np.ascontiguousarray(pairings.innovation),
        np.ascontiguousarray(pairings.covariance),
        pairings.log_density_new,
        gates(pairings.n_sources, confidence, pairings.innovation.shape[1]),
        rest,
    )


@kernel
def _extend(
    chosen: Any, n: int, k: int, innovation: FloatArray, covariance: FloatArray, factor: FloatArray, white: FloatArray
) -> tuple[float, float]:
    """Append pairing `k` to the `n` chosen: rows of the Cholesky factor and of the whitened innovation.

    Returns:
        The increments of the squared distance and of the log determinant.
    """
    gain, log_det, dim = 0.0, 0.0, innovation.shape[1]
    for a in range(dim):
        row = dim * n + a
        rest = innovation[k, a]
        for col in range(row + 1):
            other, b = (chosen[col // dim], col % dim) if col < dim * n else (k, col - dim * n)
            value = covariance[dim * k + a, dim * other + b]
            for m in range(col):
                value -= factor[row, m] * factor[col, m]
            if col < row:
                factor[row, col] = value / factor[col, col]
                rest -= factor[row, col] * white[col]
            else:
                factor[row, row] = np.sqrt(max(value, 1e-300))
        white[row] = rest / factor[row, row]
        gain += white[row] ** 2
        log_det += 2.0 * np.log(factor[row, row])
    return gain, log_det


@kernel
def _search(
    first: Any,
    target: Any,
    innovation: FloatArray,
    covariance: FloatArray,
    log_density_new: FloatArray,
    gate: FloatArray,
    rest: FloatArray,
    weigh_all: bool,
    ignored: float,
) -> tuple[IntArray, FloatArray, float, bool]:
    """Search depth first; a level of the tree is a source, its branches are the pairings of the source, and none.

    With `weigh_all` every compatible set adds its weight to its pairings, except sets that weigh `ignored` [nats] less
    than the best: `rest` (n_sources + 1,) bounds the contribution of the sources from each level on. Without it,
    branches that cannot exceed the best set so far are cut.

    Returns:
        The best set by source, the weights, their sum [nats], and whether the search was cut by `MAX_NODES`.
    """
    n_sources, n_pairings, dim = len(first) - 1, len(target), innovation.shape[1]
    remaining = np.zeros(n_sources + 1, dtype=np.int64)  # sources from here on with any pairing
    for level in range(n_sources - 1, -1, -1):
        remaining[level] = remaining[level + 1] + (1 if first[level + 1] > first[level] else 0)
    cursor = np.zeros(n_sources + 1, dtype=np.int64)
    picked = np.full(n_sources, -1, dtype=np.int64)  # by level
    chosen = np.zeros(n_sources, dtype=np.int64)  # in order of choice
    count = np.zeros(n_sources + 1, dtype=np.int64)
    distance, score = np.zeros(n_sources + 1), np.zeros(n_sources + 1)
    factor, white = np.zeros((dim * n_sources, dim * n_sources)), np.zeros(dim * n_sources)
    best, best_count, best_distance = np.full(n_sources, -1, dtype=np.int64), 0, 0.0
    weight, total, top = np.zeros(n_pairings), 0.0, 0.0
    level, nodes = 0, 0
    cursor[0] = first[0] if n_sources else 0
    while level >= 0:
        if level == n_sources:
            better = count[level] > best_count or (count[level] == best_count and distance[level] < best_distance)
            if better:
                best[:], best_count, best_distance = picked, count[level], distance[level]
            if weigh_all:
                if score[level] > top:
                    shrink = np.exp(top - score[level])
                    weight *= shrink
                    total *= shrink
                    top = score[level]
                share = np.exp(score[level] - top)
                total += share
                for k in chosen[: count[level]]:
                    weight[k] += share
            level -= 1
            continue
        k = cursor[level]
        cursor[level] += 1
        if k > first[level + 1] or nodes >= MAX_NODES:
            picked[level] = -1
            level -= 1
            continue
        n = count[level]
        if k == first[level + 1]:  # the source is unpaired
            picked[level] = -1
            count[level + 1], distance[level + 1], score[level + 1] = n, distance[level], score[level]
        else:
            taken = False
            for other in chosen[:n]:
                taken |= target[other] == target[k]
            if taken:
                continue
            nodes += 1
            gain, log_det = _extend(chosen, n, k, innovation, covariance, factor, white)
            if distance[level] + gain > gate[n + 1]:
                continue
            picked[level] = chosen[n] = k
            count[level + 1] = n + 1
            distance[level + 1] = distance[level] + gain
            score[level + 1] = (
                score[level] - 0.5 * (gain + log_det) - 0.5 * dim * np.log(2.0 * np.pi) - log_density_new[k]
            )
        if weigh_all and score[level + 1] + rest[level + 1] < top - ignored:
            continue
        if not weigh_all:
            reach = count[level + 1] + remaining[level + 1]
            if reach < best_count or (reach == best_count and best_count > 0 and distance[level + 1] >= best_distance):
                continue
        level += 1
        if level < n_sources:
            cursor[level] = first[level]
    evidence = 0.0
    if total > 0.0:
        weight /= total
        evidence = top + np.log(total)
    return best, weight, evidence, nodes >= MAX_NODES
