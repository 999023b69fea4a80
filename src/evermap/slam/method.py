"""The interface between the estimator and the methods that explain moved landmarks.

A *place* is one row of the problem's landmarks. The first L places are the landmarks themselves, in the order in which
the session was prepared; a landmark that moved has further places, behind them. Which place a detection belongs to
stands in `Problem.landmark_row`, and nothing else tells the estimator of moves: it stays plain least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from evermap.estimate.sparse.system import Slices
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.types import FloatArray, IntArray, MapChange

Compare = Callable[[IntArray, IntArray], tuple[FloatArray, FloatArray]]
"""`compare(detections, places)`, both (k,): squared Mahalanobis distance of every detection if it were of that place,
with `S = H P H' + R` of pose and place together, and `log |S|`; nan where the place has no position yet."""


@dataclass(frozen=True, slots=True)
class Rival:
    """Another explanation that the measurements cannot rule out.

    Attributes:
        changes: what moved then, as in `Explanation`.
        probability: its weight among all explanations.
        position: (L, 2) where the landmarks would be; nan where never seen.
        covariance: (L, 2, 2) of each.
    """

    changes: tuple[MapChange, ...]
    probability: float
    position: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Explanation:
    """Result of a method for all measurements so far.

    Attributes:
        problem: the same measurements, with other places and priors, or the very object that was given.
        estimate: the values of that problem, its places included.
        current: (L,) the place where each landmark is now.
        changes: what moved: landmarks by their rows, stamps on the problem's clock, displacements in its metres.
        rivals: other explanations nearly as probable, the most probable first.
        warnings: what the user should know.
    """

    problem: Problem
    estimate: Estimate
    current: IntArray
    changes: tuple[MapChange, ...] = ()
    rivals: tuple[Rival, ...] = ()
    warnings: tuple[str, ...] = ()

    def earlier(self, by_s: float) -> Explanation:
        """Return the same with all that happened so much earlier."""

        def moved(changes: tuple[MapChange, ...]) -> tuple[MapChange, ...]:
            return tuple(
                replace(one, stamp_from_s=one.stamp_from_s - by_s, stamp_to_s=one.stamp_to_s - by_s) for one in changes
            )

        rivals = tuple(replace(rival, changes=moved(rival.changes)) for rival in self.rivals)
        return replace(self, changes=moved(self.changes), rivals=rivals)


class Method(Protocol):
    """Decides for every frame to which places its detections belong, and thinks again at relinearisations."""

    def assign(self, problem: Problem, row: int, detections: IntArray, compare: Compare) -> IntArray:
        """Return places (k,) of the detections (k,) of pose `row`, before they are used.

        The problem has the places decided so far; `landmark_row[detections]` still says whose detections they are.
        `compare` says how far each is from a place.

        Returns:
            (k,) rows of places. One without position starts where the detection points; rows from the number of places
            on are new ones, in their order.
        """
        ...

    def unprejudice(self, problem: Problem, estimate: Estimate) -> tuple[Problem, Estimate]:
        """Return the problem, and values to start from, on which noise levels are learned before the last revisions.

        Unchanged for a method without assumptions that distort the solution.
        """
        return problem, estimate

    def revises(self, problem: Problem) -> bool:
        """Return whether `revise` may change this problem before the end; else it is solved beside the stream."""
        del problem
        return True

    def beside(self) -> Method | None:
        """Return a copy that revises in slices while this one assigns; None if the stream has to wait for `revise`."""
        return None

    def revise_in_slices(
        self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool
    ) -> Slices[Explanation]:
        """Return what `revise` does, in slices."""
        yield 0.0
        return self.revise(problem, estimate, noise, heavy=heavy, final=final)

    def revise(self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool) -> Explanation:
        """Return the best explanation of everything so far, from the optimum with the places decided so far.

        If `heavy`, outliers have the Cauchy's tails, as while the estimate may still be far off; if `final`, the
        session ends.
        """
        ...


class Static(Method):
    """`nohyp`: a static world, every detection belongs to the one place of its landmark."""

    def __init__(self, n_landmarks: int) -> None:
        self._current = np.arange(n_landmarks)

    def assign(self, problem: Problem, row: int, detections: IntArray, compare: Compare) -> IntArray:
        """Return the place of each detection's landmark."""
        del row, compare
        return problem.landmark_row[detections]

    def revises(self, problem: Problem) -> bool:
        """Return False."""
        del problem
        return False

    def revise(self, problem: Problem, estimate: Estimate, noise: Noise, *, heavy: bool, final: bool) -> Explanation:
        """Return the problem unchanged."""
        del noise, heavy, final
        return Explanation(problem, estimate, self._current)
