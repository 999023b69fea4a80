"""Modes that are none: pruned where they explain hardly anything, merged where they are the same place."""

from __future__ import annotations

from collections import Counter
from itertools import combinations

import numpy as np

from evermap.slam.modes.places import FREE, Modes, at_places, moved_to
from evermap.slam.problem import Estimate, Marginals, Problem
from evermap.types import IntArray


def without_empty(problem: Problem, estimate: Estimate, modes: Modes) -> tuple[Estimate, Modes]:
    """Without the modes that no detection holds; what the prior map holds stays, seen or not."""
    count = np.bincount(problem.landmark_row, minlength=len(modes.landmark))
    empty = np.flatnonzero((modes.landmark != FREE) & estimate.known & ~problem.mapped & (count == 0))
    if len(empty) == 0:
        return estimate, modes
    return at_places(estimate, empty, np.nan), _freed(modes, empty)


def pruned(problem: Problem, estimate: Estimate, modes: Modes) -> tuple[Problem, Estimate, Modes]:
    """Without the modes that a single detection held and later ones did not: it goes to the most frequent mode.

    A mode whose only detection is its landmark's last may be the beginning of something and stays.
    """
    count = np.bincount(problem.landmark_row, minlength=len(modes.landmark))
    newest = np.full(modes.n_landmarks, FREE)
    newest[modes.landmark[problem.landmark_row]] = problem.landmark_row  # sorted by pose: the last one stands
    single = np.flatnonzero((modes.landmark != FREE) & ~problem.mapped & (count == 1))
    goes = single[newest[modes.landmark[single]] != single]
    if len(goes) == 0:
        return problem, estimate, modes
    places = np.argsort(count, kind="stable")
    frequent = np.zeros(modes.n_landmarks, dtype=np.int64)
    owned = places[modes.landmark[places] != FREE]
    frequent[modes.landmark[owned]] = owned
    problem = moved_to(problem, goes, frequent[modes.landmark[goes]])
    return problem, at_places(estimate, goes, np.nan), _freed(modes, goes)


def merged(
    problem: Problem, estimate: Estimate, marginals: Marginals, modes: Modes, significance: float
) -> tuple[Problem, Estimate, Modes]:
    """With modes of a landmark united whose difference is not significant under their joint covariance.

    Two modes need a switch at least, and as many as there are between them, which the chain grants with its switching
    probability each: a difference that chance explains more often than that is none. With two degrees of freedom
    `P(chi2 > d^2) = exp(-d^2 / 2)`, so this is where the gain in likelihood outweighs the switches. Pairs unite at
    once, the nearest first; a mode that a prior map holds, else the older row, gives the place.
    """
    from_, into = _same(problem, estimate, marginals, modes, -2.0 * np.log(significance))
    if len(from_) == 0:
        return problem, estimate, modes
    return moved_to(problem, from_, into), at_places(estimate, from_, np.nan), _freed(modes, from_)


def _freed(modes: Modes, places: IntArray) -> Modes:
    """Rows behind the landmarks' own belong to nobody; the landmarks' own just have no position."""
    return modes.with_owner(places[places >= modes.n_landmarks], FREE)


def _same(
    problem: Problem, estimate: Estimate, marginals: Marginals, modes: Modes, limit: float
) -> tuple[IntArray, IntArray]:
    """Places to give up and those to unite them with: squared Mahalanobis distance below `limit` for every switch."""
    switches = _switches(problem, modes)
    pairs: list[tuple[float, int, int]] = []
    for row in modes.table(estimate):
        for a, b in combinations(row[row != FREE].tolist(), 2):
            distance = _squared_distance(estimate, marginals, a, b) / max(1, switches[min(a, b), max(a, b)])
            if distance < limit:
                keep, leave = (b, a) if problem.mapped[b] and not problem.mapped[a] else (a, b)
                pairs.append((distance, leave, keep))
    touched: set[int] = set()
    from_, into = [], []
    for _, leave, keep in sorted(pairs):
        if leave not in touched and keep not in touched:
            touched |= {leave, keep}
            from_.append(leave)
            into.append(keep)
    return np.array(from_, dtype=np.int64), np.array(into, dtype=np.int64)


def _switches(problem: Problem, modes: Modes) -> Counter[tuple[int, int]]:
    """How often consecutive detections of a landmark are at two different places, by both, the lower row first."""
    owner = modes.landmark[problem.landmark_row]
    order = np.argsort(owner, kind="stable")
    before, after = problem.landmark_row[order[:-1]], problem.landmark_row[order[1:]]
    changed = (owner[order[:-1]] == owner[order[1:]]) & (before != after)
    low, high = np.minimum(before, after)[changed], np.maximum(before, after)[changed]
    return Counter(zip(low.tolist(), high.tolist(), strict=True))


def _squared_distance(estimate: Estimate, marginals: Marginals, a: int, b: int) -> float:
    """Of two places from each other, with what the estimate knows of both together."""
    rows, columns = slice(2 * a, 2 * a + 2), slice(2 * b, 2 * b + 2)
    shared = marginals.shared
    cross = shared[rows, columns]
    covariance = shared[rows, rows] + shared[columns, columns] - cross - cross.T
    apart = estimate.landmark[a] - estimate.landmark[b]
    return float(apart @ np.linalg.solve(covariance, apart))
