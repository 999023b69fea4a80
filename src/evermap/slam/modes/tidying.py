"""Modes that are none: pruned where they explain hardly anything, merged where they are the same place."""

from __future__ import annotations

import numpy as np

from evermap.slam.modes.places import FREE, Modes, at_places, moved_to
from evermap.slam.problem import Estimate, Marginals, Problem
from evermap.types import IntArray


def pruned(problem: Problem, estimate: Estimate, modes: Modes) -> tuple[Problem, Estimate, Modes]:
    """Without the modes that no detection holds, and without those that a single one held and later ones did not.

    A mode whose only detection is its landmark's last may be the beginning of something and stays. So does what the
    prior map holds, seen or not. Detections of a mode that goes move to the landmark's most frequent one.
    """
    count = np.bincount(problem.landmark_row, minlength=len(modes.landmark))
    hopeless = (modes.landmark != FREE) & estimate.known & ~problem.mapped & (count < 2)
    owner = modes.landmark[problem.landmark_row]
    newest = np.full(modes.n_landmarks, FREE)
    newest[owner] = problem.landmark_row  # the last assignment stands: detections are sorted by pose
    single = np.flatnonzero(hopeless & (count == 1))
    hopeless[single] = newest[modes.landmark[single]] != single
    goes = np.flatnonzero(hopeless)
    if len(goes) == 0:
        return problem, estimate, modes
    frequent = np.zeros(modes.n_landmarks, dtype=np.int64)
    stays = np.flatnonzero((modes.landmark != FREE) & ~hopeless)
    stays = stays[np.argsort(count[stays], kind="stable")]
    frequent[modes.landmark[stays]] = stays
    problem = moved_to(problem, goes, frequent[modes.landmark[goes]])
    return problem, at_places(estimate, goes, np.nan), _freed(modes, goes)


def merged(
    problem: Problem, estimate: Estimate, marginals: Marginals, modes: Modes, significance: float
) -> tuple[Problem, Estimate, Modes]:
    """With modes of a landmark united whose difference is not significant under their joint covariance.

    A mode more needs a switch more, which the chain grants with its switching probability: a difference that chance
    explains more often than that is none. With two degrees of freedom `P(chi2 > d^2) = exp(-d^2 / 2)`, so this also is
    where the gain in likelihood outweighs one switch. Pairs unite at once, the nearest first; a mode that a prior map
    holds, else the older row, gives the place.
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
    """Places to give up and those to unite them with, by squared Mahalanobis distance below a limit."""
    table = modes.table(estimate)
    pairs: list[tuple[float, int, int]] = []
    for row in table[(table != FREE).sum(axis=1) > 1]:
        places = row[row != FREE]
        for k, a in enumerate(places):
            for b in places[k + 1 :]:
                distance = _squared_distance(estimate, marginals, int(a), int(b))
                if distance < limit:
                    keep, leave = (b, a) if problem.mapped[b] and not problem.mapped[a] else (a, b)
                    pairs.append((distance, int(leave), int(keep)))
    touched: set[int] = set()
    from_, into = [], []
    for _, leave, keep in sorted(pairs):
        if leave not in touched and keep not in touched:
            touched |= {leave, keep}
            from_.append(leave)
            into.append(keep)
    return np.array(from_, dtype=np.int64), np.array(into, dtype=np.int64)


def _squared_distance(estimate: Estimate, marginals: Marginals, a: int, b: int) -> float:
    """Of two places from each other, with what the estimate knows of both together."""
    rows, columns = slice(2 * a, 2 * a + 2), slice(2 * b, 2 * b + 2)
    shared = marginals.shared
    cross = shared[rows, columns]
    covariance = shared[rows, rows] + shared[columns, columns] - cross - cross.T
    apart = estimate.landmark[a] - estimate.landmark[b]
    return float(apart @ np.linalg.solve(covariance, apart))
