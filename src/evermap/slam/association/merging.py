"""Duplicate landmarks: pairs whose difference vanishes, found near each other and weighed jointly.

Candidates are neighbours (a k-d tree); their covariances come from the sparse factorisation, for the compared landmarks
only. `consensus` weighs the candidates of a group of landmarks jointly.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from evermap.config import AssociationConfig
from evermap.slam.association.assignment import alike, same_name
from evermap.slam.association.consensus import FREE, Candidates, Consensus, consensus
from evermap.slam.association.jcbb import gates
from evermap.slam.batch import USUAL
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray

_Part = TypeVar("_Part")
_Result = TypeVar("_Result")

MERGE_ROUNDS = 8
"""Maximum number of rounds of merging per solution: each makes the map stiffer."""
GROUP = 24
"""Number of consecutive landmarks that are weighed jointly with the rest of the map: bounds the work."""
MOST_TOGETHER = 200
"""Number of landmarks in one joint covariance, for consecutive groups: bounds the memory."""
MOST_PAIRS = 400
"""Number of pairs of a group, those with most evidence by themselves: bounds the work."""
MOST_NEAR = 80
"""Number of nearest landmarks that one is compared with: bounds the work."""


@dataclass(frozen=True, slots=True)
class Differences:
    """K pairs of landmarks, in D numbers.

    Attributes:
        gap: (K, D) difference of the two.
        covariance: (K, D, D) of each, with the shared errors of sightings.
        log_density: (K,) of the gap if they are two landmarks.
        joint: returns the covariance (D P, D P) of some rows (P,) together.
    """

    gap: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    joint: Callable[[IntArray], FloatArray]

    def part(self, begin: int, end: int) -> Differences:
        """Return the pairs from one row to another."""
        each = self.gap[begin:end], self.covariance[begin:end], self.log_density[begin:end]
        return Differences(*each, lambda rows: self.joint(begin + rows))


@dataclass(frozen=True, slots=True)
class Solution:
    """L landmarks at an optimum, in the plane or in space, to be compared with each other.

    Attributes:
        place: (L, 2 or 3).
        covariance: (L, 2, 2) or (L, 3, 3) of each by itself.
        differences: returns those of pairs, by rows (K,) of the younger and (K,) of the older ones.
        sightings, last_seen_s: (L,) number of detections, stamp of the last.
        together, in_turn: (L, L) numbers of frames, see `count_together`.
        kind: (L, P) class and name of each, `UNKNOWN` for none: different ones exclude each other.
        settings: of the association.
    """

    place: FloatArray
    covariance: FloatArray
    differences: Callable[[IntArray, IntArray], Differences]
    sightings: IntArray
    last_seen_s: FloatArray
    together: sparse.csr_array
    in_turn: sparse.csr_array
    kind: IntArray
    settings: AssociationConfig = USUAL.association


def propose_merges(
    solution: Solution,
    *,
    probability: float,
    among: BoolArray,
    last: bool,
    refused: set[tuple[int, int]],
    known: BoolArray | None = None,
) -> list[tuple[int, int]]:
    """Return pairs (younger, older) of landmarks that are the same with at least `probability`, given all such pairs.

    Args:
        solution: the landmarks.
        probability: least posterior probability.
        among: (L,) landmarks to find duplicates of.
        last: True if no frames will follow.
        refused: pairs to leave out.
        known: (L,) candidate duplicates; None for all.
    """
    seen = (solution.sightings >= solution.settings.fewest_to_pair) | (solution.kind[:, -1] != UNKNOWN)
    sources, targets = np.flatnonzero(seen & among), np.flatnonzero(seen if known is None else seen & known)
    if len(sources) < 1 or len(targets) < 2:
        return []
    pairs = np.vstack([_near(solution, sources, targets), _list_named(solution.kind, sources, targets)])
    count = len(solution.place)
    not_tried = np.array([u * count + o for u, o in refused], dtype=np.int64)
    younger, older = np.divmod(np.setdiff1d(pairs[:, 0] * count + pairs[:, 1], not_tried), count)
    kept = alike(solution.kind[younger], solution.kind[older])
    younger, older = younger[kept], older[kept]
    order = sources[np.argsort(solution.last_seen_s[sources], kind="stable")[::-1]]
    group = np.full(count, -1)
    group[order] = np.arange(len(order)) // GROUP
    one, other = group[younger], group[older]
    other = np.where(one <= other, other, -1)  # not again with a source before the younger one
    groups = [np.flatnonzero((one == k) | (other == k)) for k in range(-(-len(order) // GROUP))]
    groups = [mine for mine in groups if len(mine)]
    merges = list[tuple[int, int]]()
    for some in _batches(groups, younger, older):
        rows, first = np.concatenate(some), np.cumsum([0, *map(len, some)])
        found = solution.differences(younger[rows], older[rows])
        for mine, begin in zip(some, first.tolist(), strict=False):
            part = found.part(begin, begin + len(mine))
            merges += _list_agreeing(solution, younger[mine], older[mine], part, probability, last=last)
    return _without_contradictions(sorted(set(merges)), solution.kind)


def find_accepted_rise(
    pairs: list[tuple[int, int]], sightings: IntArray, numbers: int | IntArray, settings: AssociationConfig
) -> float:
    """Return the rise of the cost that merging pairs may cause [nats].

    Args:
        pairs: (younger, older), P of them.
        sightings: (L,) number of detections of each landmark.
        numbers: of the difference of a pair, or (P,) of each; the settings are for two.
        settings: of the association.
    """
    lesser = np.array([min(sightings[u], sightings[o]) for u, o in pairs])
    rise = np.minimum(settings.rise_nats + settings.rise_per_sighting * lesser, settings.most_rise_nats)
    return float((0.5 * numbers * rise).sum())


def merge_while_any(
    solved: _Result,
    propose: Callable[[_Result, set[tuple[int, int]]], list[tuple[int, int]]],
    merge: Callable[[_Result, list[tuple[int, int]]], _Result | None],
) -> _Result:
    """Merge pairs of landmarks that are the same while there are any: propose, solve on trial, accept.

    Args:
        solved: the solution to begin with.
        propose: returns pairs (younger, older) of a solution, without those that were refused in it.
        merge: returns a solution with pairs merged; None if it is not accepted, of which nothing is kept.

    Returns:
        The last solution that was accepted.
    """
    refused: set[tuple[int, int]] = set()
    for _ in range(MERGE_ROUNDS):
        pairs = propose(solved, refused)
        if not pairs:
            break
        merged = try_by_halves(pairs, functools.partial(merge, solved), refused.add)
        if merged is not None:
            refused.clear()
            solved = merged
    return solved


def try_by_halves(
    parts: list[_Part], attempt: Callable[[list[_Part]], _Result | None], refuse: Callable[[_Part], object]
) -> _Result | None:
    """Try all parts, or half of them, and so on, until the attempt gives a result; a single part may be refused."""
    while parts:
        if (found := attempt(parts)) is not None:
            return found
        if len(parts) == 1:
            refuse(parts[0])
        parts = parts[: len(parts) // 2]
    return None


def _batches(groups: list[IntArray], younger: IntArray, older: IntArray) -> Iterator[list[IntArray]]:
    """Consecutive groups of rows of pairs, together up to `MOST_TOGETHER` landmarks."""
    some, held = list[IntArray](), np.zeros(0, dtype=np.int64)
    for mine in groups:
        more = np.union1d(held, np.append(younger[mine], older[mine]))
        if some and len(more) > MOST_TOGETHER:
            yield some
            some, more = [], np.unique(np.append(younger[mine], older[mine]))
        some, held = [*some, mine], more
    if some:
        yield some


def _without_contradictions(merges: list[tuple[int, int]], kind: IntArray) -> list[tuple[int, int]]:
    """Pairs without those that join two names or classes through a third landmark without one."""
    part, label, kept = np.arange(len(kind)), kind.copy(), list[tuple[int, int]]()
    for one, other in merges:
        a, b = part[one], part[other]
        if alike(label[a], label[b]):
            label[b] = np.maximum(label[a], label[b])
            part[part == a] = b
            kept.append((one, other))
    return kept


def _list_named(kind: IntArray, sources: IntArray, targets: IntArray) -> IntArray:
    """Different pairs (younger, older) of a source and a target with the same name, at any distance."""
    row, column = np.nonzero(same_name(kind[sources][:, None], kind[targets][None]) & (sources[:, None] != targets))
    pairs = np.column_stack([sources[row], targets[column]])
    return np.column_stack([pairs.max(axis=1, initial=-1), pairs.min(axis=1, initial=len(kind))])


def _near(solution: Solution, sources: IntArray, targets: IntArray) -> IntArray:
    """Different pairs (younger, older) of a source and a target within the loose gate of their own covariances."""
    place, covariance = solution.place, solution.covariance
    spread = np.sqrt(2.0 * np.linalg.eigvalsh(covariance)[:, -1])
    gate = math.sqrt(solution.settings.loose_gate)
    tree = KDTree(place[targets])
    count = min(MOST_NEAR + 1, len(targets))
    away, column = (np.reshape(each, (len(sources), count)) for each in tree.query(place[sources], k=count))
    other = targets[np.minimum(column, len(targets) - 1)]
    reach = gate * np.hypot(spread[sources][:, None], spread[other]) + 0.1
    row, at = np.nonzero((away < reach) & (other != sources[:, None]))
    one, two = sources[row], other[row, at]
    return np.column_stack([np.maximum(one, two), np.minimum(one, two)])


def _list_agreeing(
    solution: Solution, younger: IntArray, older: IntArray, found: Differences, probability: float, *, last: bool
) -> list[tuple[int, int]]:
    """Pairs (younger, older) of a group that are the same with certainty."""
    settings = solution.settings
    gap, own = found.gap, found.covariance
    squared = np.einsum("ki,ki->k", gap, np.linalg.solve(own, gap[..., None])[..., 0])
    together, in_turn = (entries(each, younger, older) for each in (solution.together, solution.in_turn))
    one_seen = np.minimum(settings.in_turn_nats * in_turn, settings.most_in_turn_nats)
    against = found.log_density + settings.double_nats * together - one_seen
    alone = -0.5 * (squared + np.log(np.linalg.det(own))) - against
    inside = np.flatnonzero((squared < settings.loose_gate) & (together < 3))
    inside = inside[np.argsort(-alone[inside], kind="stable")[:MOST_PAIRS]]
    if not len(inside):
        return []
    younger, older = younger[inside], older[inside]
    conflict = _conflicts(younger, older, solution.together, solution.kind)
    ends = np.unique(np.column_stack([younger, older]), return_inverse=True)[1].reshape(-1, 2)
    candidates = Candidates(gap[inside], found.joint(inside), against[inside], conflict, ends)
    gate = gates(1, settings.gate_confidence, gap.shape[1])[1]
    best: Consensus = consensus(candidates, gate=gate, loose=settings.loose_gate)
    least = math.log(probability / (1.0 - probability)) if last or len(best.pairs) > FREE else settings.few_nats
    sure = best.pairs[best.margin >= least]
    return [(int(younger[k]), int(older[k])) for k in sure]


def _conflicts(younger: IntArray, older: IntArray, together: sparse.csr_array, kind: IntArray) -> BoolArray:
    """(P, P) pairs that exclude each other: they join two landmarks seen in one frame, or with different labels."""
    conflict = np.zeros((len(younger), len(younger)), dtype=bool)
    np.fill_diagonal(conflict, True)
    for mine, other in ((younger, older), (older, younger)):
        for theirs, another in ((younger, older), (older, younger)):
            shared = mine[:, None] == theirs[None]
            one, two = np.nonzero(shared)
            apart = entries(together, other[one], another[two]) > 0.0
            apart |= ~alike(kind[other[one]], kind[another[two]])
            conflict[one[apart], two[apart]] = True
    return conflict


def entries(matrix: sparse.csr_array, row: IntArray, column: IntArray) -> FloatArray:
    """Return (K,) entries of a sparse matrix."""
    matrix.sum_duplicates()
    key = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr)) * matrix.shape[1] + matrix.indices
    wanted = row * matrix.shape[1] + column
    at = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
    return np.where(key[at] == wanted, matrix.data[at], 0.0) if len(key) else np.zeros(len(wanted))


def in_reach(place: FloatArray, at: FloatArray, reach_m: float) -> tuple[IntArray, IntArray]:
    """Return rows of points and rows of places within this distance of each other, sorted."""
    near: Any = KDTree(place).query_ball_point(at, reach_m, return_sorted=True)
    count = np.fromiter(map(len, near), dtype=np.int64, count=len(near))
    column = np.fromiter(chain.from_iterable(near), dtype=np.int64, count=int(count.sum()))
    return np.repeat(np.arange(len(near)), count), column
