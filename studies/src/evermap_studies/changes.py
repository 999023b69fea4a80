"""Scores of the changes that were found: which landmarks, how far, when."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from evermap.geometry.se2 import wrap
from evermap.show import Shown
from evermap.types import ChangeKind, FloatArray, IntArray, MapChange, SlamResult


@dataclass(frozen=True, slots=True)
class ChangeErrors(Shown):
    """Errors of the changes of a run; G groups are matched, each true one with at most one found.

    Attributes:
        exact: the same groups of landmarks were found, no more and no fewer; two that exchanged identities differ
            from two that moved.
        precision: share of the landmarks found changed that did change; None where none was found.
        recall: share of the changed landmarks that were found; None where nothing changed.
        true_row, found_row: (G,) which true change was matched with which found one: the pairs with the most landmarks
            in common; groups without a common landmark are not matched.
        displacement_error_m: (G,) distance between true and found displacement of the centroid; it includes the
            difference of the centroids where a group that turned was found with other members.
        rotation_error_rad: (G,) absolute difference of the turns, wrapped.
        time_error_s: (G,) between `time_of_change` of both.
    """

    exact: bool
    precision: float | None
    recall: float | None
    true_row: IntArray
    found_row: IntArray
    displacement_error_m: FloatArray
    rotation_error_rad: FloatArray
    time_error_s: FloatArray


def compare_changes(found: Sequence[MapChange], true: Sequence[MapChange]) -> ChangeErrors:
    """Compare the found changes with the true ones; probabilities are ignored."""
    claimed, changed = _landmarks(found), _landmarks(true)
    right = len(claimed & changed)
    true_row, found_row = _matched(found, true)
    pairs = [(found[f], true[t]) for t, f in zip(true_row, found_row, strict=True)]
    return ChangeErrors(
        exact=_groups(found) == _groups(true),
        precision=right / len(claimed) if claimed else None,
        recall=right / len(changed) if changed else None,
        true_row=true_row,
        found_row=found_row,
        displacement_error_m=np.array([math.dist(f.displacement_m, t.displacement_m) for f, t in pairs]),
        rotation_error_rad=np.array([abs(float(wrap(f.rotation_rad - t.rotation_rad))) for f, t in pairs]),
        time_error_s=np.array([abs(time_of_change(f) - time_of_change(t)) for f, t in pairs]),
    )


@dataclass(frozen=True, slots=True)
class ChangeCounts:
    """Changes counted by landmark and kind, of one session or sums of many.

    Attributes:
        n_found, n_true: landmarks that are reported as changed, and that did change.
        n_right: landmarks in both, with the same kind of change.
    """

    n_found: int = 0
    n_true: int = 0
    n_right: int = 0

    def __add__(self, other: ChangeCounts) -> ChangeCounts:
        return ChangeCounts(self.n_found + other.n_found, self.n_true + other.n_true, self.n_right + other.n_right)

    @property
    def precision(self) -> float | None:
        """Return the share of the found that are right; None where nothing was found."""
        return self.n_right / self.n_found if self.n_found else None

    @property
    def recall(self) -> float | None:
        """Return the share of the true that were found; None where nothing changed."""
        return self.n_right / self.n_true if self.n_true else None


def count_changes(
    found: Sequence[MapChange], true: Sequence[MapChange], kind: ChangeKind | None = None
) -> ChangeCounts:
    """Count changes by landmark and kind; groups do not matter, and a rotation counts as a move.

    Args:
        found: reported changes.
        true: those that happened.
        kind: only changes of this kind; None for all, with the kind as part of what must be right.
    """
    claimed, changed = (
        {(identity, what) for identity, what in _by_landmark(changes) if kind in (None, what)}
        for changes in (found, true)
    )
    return ChangeCounts(len(claimed), len(changed), len(claimed & changed))


def _by_landmark(changes: Sequence[MapChange]) -> Iterator[tuple[int, ChangeKind]]:
    for change in changes:
        kind = ChangeKind.MOVED if change.kind is ChangeKind.ROTATED else change.kind
        yield from ((identity, kind) for identity in change.landmark_ids)


def rank_of_truth(result: SlamResult, true: Sequence[MapChange]) -> int | None:
    """Return 0 if the run's changes are exactly the true groups, k if its k-th alternative is, None if none is."""
    explanations = [result.changes, *(alternative.changes for alternative in result.alternatives)]
    wanted = _groups(true)
    return next((rank for rank, changes in enumerate(explanations) if _groups(changes) == wanted), None)


def time_of_change(change: MapChange) -> float:
    """Return the middle of its interval [s]; the first stamp of the session for a change before it."""
    if math.isnan(change.stamp_from_s):
        return change.stamp_to_s
    return 0.5 * (change.stamp_from_s + change.stamp_to_s)


def _landmarks(changes: Sequence[MapChange]) -> set[int]:
    return {identity for change in changes for identity in change.landmark_ids}


def _groups(changes: Sequence[MapChange]) -> list[tuple[list[int], bool]]:
    """Return members and whether they exchanged identities, sorted; a group that moved twice counts twice."""
    return sorted((sorted(change.landmark_ids), change.kind is ChangeKind.SWAPPED) for change in changes)


def _matched(found: Sequence[MapChange], true: Sequence[MapChange]) -> tuple[IntArray, IntArray]:
    """Pair rows (true, found) with the most landmarks in common over all; ties go to the nearer displacement."""
    from scipy.optimize import linear_sum_assignment

    common = np.array([[len({*t.landmark_ids} & {*f.landmark_ids}) for f in found] for t in true], dtype=np.float64)
    common = common.reshape(len(true), len(found))
    apart = np.array([[math.dist(t.displacement_m, f.displacement_m) for f in found] for t in true])
    # the ties of all pairs together weigh less than one landmark
    tie = (apart / (1.0 + apart)).reshape(common.shape) / (1.0 + max(common.shape))
    true_row, found_row = linear_sum_assignment(common - tie, maximize=True)
    paired = common[true_row, found_row] > 0
    return true_row[paired].astype(np.int64), found_row[paired].astype(np.int64)
