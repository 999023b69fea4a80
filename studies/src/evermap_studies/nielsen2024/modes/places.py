"""The multi-hypothesis map: whose mode each place is (Nielsen 2024 section 3.1).

A mode's position stands in the estimate and its covariance in the marginals, as those of every place. What is kept
here is only what the estimator does not know: which landmark a place belongs to.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.slam.problem import Estimate, Problem, between_rows
from evermap.types import FloatArray, IntArray

FREE = -1
"""Owner of a row of places that belongs to nobody (any more), and column of a landmark with fewer modes."""


@dataclass(frozen=True, slots=True)
class Modes:
    """Whose mode each place is.

    Attributes:
        landmark: (P,) row of the landmark, or `FREE`. Row `l < L` is the first mode of landmark `l`: what a prior map
            says, or where it was first seen. It stays reserved when it has no position.
        n_landmarks: L.
    """

    landmark: IntArray
    n_landmarks: int

    @classmethod
    def one_each(cls, n_landmarks: int) -> Modes:
        """The static world."""
        return cls(np.arange(n_landmarks), n_landmarks)

    def table(self, estimate: Estimate) -> IntArray:
        """(L, K) places with a position of every landmark, in order; `FREE` where it has fewer than K."""
        owned = np.flatnonzero((self.landmark != FREE) & estimate.known)
        order = owned[np.argsort(self.landmark[owned], kind="stable")]
        owner = self.landmark[order]
        column = np.arange(len(order)) - np.searchsorted(owner, owner)
        table = np.full((self.n_landmarks, max(1, int(column.max(initial=0)) + 1)), FREE, dtype=np.int64)
        table[owner, column] = order
        return table

    def rows_for(self, count: int) -> IntArray:
        """(count,) rows for new modes: free ones first, then new ones at the end."""
        free = np.flatnonzero(self.landmark == FREE)[:count]
        return np.append(free, len(self.landmark) + np.arange(count - len(free)))

    def with_owner(self, place: IntArray, landmark: IntArray | int) -> Modes:
        """These places belong to these landmarks (or are `FREE`); rows are appended as needed."""
        missing = max(0, int(np.max(place, initial=-1)) + 1 - len(self.landmark))
        owner = np.append(self.landmark, np.full(missing, FREE))
        owner[place] = landmark
        return replace(self, landmark=owner)

    def without(self, places: IntArray) -> Modes:
        """Rows behind the landmarks' own belong to nobody; the landmarks' own stay theirs, without position."""
        return self.with_owner(places[places >= self.n_landmarks], FREE)


def grown(problem: Problem, estimate: Estimate, count: int) -> tuple[Problem, Estimate]:
    """Room for `count` places; those that are new have neither prior nor position."""
    missing = count - len(problem.landmark_mean)
    if missing <= 0:
        return problem, estimate
    landmark = np.pad(estimate.landmark, ((0, missing), (0, 0)), constant_values=np.nan)
    return problem.with_places(count), replace(estimate, landmark=landmark)


def compacted(problem: Problem, estimate: Estimate, modes: Modes) -> tuple[Problem, Estimate, Modes, IntArray]:
    """Without the rows that belong to nobody, the others in the order in which they were first seen.

    Returns:
        Problem, estimate and modes, and (P,) the new row of every old one, `FREE` where it is gone.
    """
    extra = modes.n_landmarks + np.flatnonzero(modes.landmark[modes.n_landmarks :] != FREE)
    seen, first = np.unique(problem.landmark_row, return_index=True)
    when = np.full(len(modes.landmark), len(problem.landmark_row))
    when[seen] = first
    rows = np.append(np.arange(modes.n_landmarks), extra[np.argsort(when[extra], kind="stable")])
    to = np.full(len(modes.landmark), FREE)
    to[rows] = np.arange(len(rows))
    axes = np.asarray((2 * rows[:, None] + [0, 1]).ravel(), dtype=np.int64)
    problem = replace(
        problem,
        landmark_row=to[problem.landmark_row],
        landmark_mean=problem.landmark_mean[rows],
        landmark_information=between_rows(problem.landmark_information, axes),
    )
    estimate = replace(estimate, landmark=estimate.landmark[rows])
    return problem, estimate, replace(modes, landmark=modes.landmark[rows]), to


def at_places(estimate: Estimate, place: IntArray, position_m: FloatArray | float) -> Estimate:
    """The estimate with some places elsewhere, or nowhere (nan)."""
    landmark = estimate.landmark.copy()
    landmark[place] = position_m
    return replace(estimate, landmark=landmark)


def moved_to(problem: Problem, places: IntArray, others: IntArray) -> Problem:
    """The problem with all detections of some places (k,) at others (k,)."""
    to = np.arange(len(problem.landmark_mean))
    to[places] = others
    return replace(problem, landmark_row=to[problem.landmark_row])
