"""The changes that a method tells, landmark by landmark: which of them are false, and what it fails to tell.

A change told of a landmark is false

- if nothing had happened to it since the method last told where it stands, or else since it was first detected (since
  the first session, if it is told as appeared);
- if it is told as vanished and stands where the method's map had it;
- if it is told as come or moved and stands nowhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se2
from evermap.types import BoolArray, ChangeKind, FloatArray, IntArray
from evermap_studies.demo.truth import Truth
from evermap_studies.worlds.scores import NEAR_M

if TYPE_CHECKING:
    from evermap_studies.demo.study import Visit

CERTAIN = 0.99
REASONS: dict[str, tuple[ChangeKind, ...]] = {
    "came": (ChangeKind.APPEARED, ChangeKind.RETURNED),
    "vanished": (ChangeKind.VANISHED,),
    "moved": (ChangeKind.MOVED, ChangeKind.ROTATED, ChangeKind.SWAPPED),
}
"""How changes are told, in the order of the tables."""


@dataclass(frozen=True, slots=True)
class Claims:
    """The N changes that a method told, one row for each landmark of each.

    Attributes:
        session, landmark_id: (N,) when, and of what.
        reason: (N,) row of `REASONS`.
        probability: (N,) with which it was told.
        is_true: (N,) whether it had happened.
        never_changed: (N,) whether nothing had ever happened to the landmark since the first session.
    """

    session: IntArray
    landmark_id: IntArray
    reason: IntArray
    probability: FloatArray
    is_true: BoolArray
    never_changed: BoolArray

    def __len__(self) -> int:
        return len(self.session)


def claims_of(visits: Sequence[Visit], truth: Truth, pose_truth_map: FloatArray) -> Claims:
    """What a method told over all sessions, compared with the truth."""
    n_changes = np.cumsum(truth.changed, axis=0)
    n_landmarks = truth.changed.shape[1]
    first = np.where(truth.detected.any(axis=0), truth.detected.argmax(axis=0), 0)
    told_in: dict[int, int] = {}
    rows: list[tuple[int, int, int, float, bool, bool]] = []
    for k, visit in enumerate(visits):
        stood = _mapped(visits[k - 1], pose_truth_map) if k else {}
        for change in visit.changes:
            reason = next(row for row, kinds in enumerate(REASONS.values()) if change.kind in kinds)
            for name in change.landmark_ids:
                if not 0 <= name < n_landmarks:
                    continue  # a name that nothing carries
                since = told_in.get(name, 0 if change.kind is ChangeKind.APPEARED else int(first[name]))
                happened = bool(n_changes[k, name] > n_changes[min(since, k), name])
                if change.kind is not ChangeKind.VANISHED:
                    happened = happened and bool(truth.there[k, name])
                elif name in stood:
                    off_m = float(np.linalg.norm(truth.position_m[k, name] - stood[name]))  # nan where it is away
                    happened = happened and not off_m <= NEAR_M
                rows.append((k, name, reason, change.probability, happened, bool(n_changes[k, name] == 0)))
        standing = [change.landmark_ids for change in visit.changes if change.kind is not ChangeKind.VANISHED]
        told_in |= {name: k for names in standing for name in names}
    columns = list(zip(*rows, strict=True)) or [()] * 6
    kinds = (np.int64, np.int64, np.int64, np.float64, np.bool_, np.bool_)
    return Claims(*(np.array(column, dtype=kind) for column, kind in zip(columns, kinds, strict=True)))


def _mapped(visit: Visit, pose_truth_map: FloatArray) -> dict[int, FloatArray]:
    """Where a map has its landmarks, in the frame of the truth."""
    landmarks = visit.snapshot.landmarks
    return dict(zip(landmarks.landmark_id.tolist(), se2.transform(pose_truth_map, landmarks.position_m), strict=True))


def n_recalled(claims: Claims, truth: Truth, sessions: BoolArray) -> tuple[int, int]:
    """Changes that could be known in some of the sessions (S,), and how many of them were told in time.

    In time is from the first session after the old state was last seen, until the next change can be known.
    """
    wanted = truth.knowable[sessions[truth.knowable[:, 2]]]
    right = {(name, k) for name, k, true in zip(claims.landmark_id.tolist(), claims.session.tolist(),
                                                claims.is_true.tolist(), strict=True) if true}  # fmt: skip
    told = sum(any((name, k) in right for k in range(first, until)) for name, first, _, until in wanted.tolist())
    return len(wanted), told


def claim_numbers(claims: Claims, truth: Truth, sessions: BoolArray) -> dict[str, Any]:
    """Scores of what was told in some of the sessions (S,); None where there is nothing to divide by."""
    rows = sessions[claims.session]
    false = rows & ~claims.is_true
    certain = claims.probability > CERTAIN
    error = (claims.probability - claims.is_true)[rows]
    knowable, recalled = n_recalled(claims, truth, sessions)
    n_told, n_false = int(rows.sum()), int(false.sum())
    return {
        "told": n_told,
        "false": n_false,
        "false_certain": int((false & certain).sum()),
        "never_changed": int((rows & claims.never_changed).sum()),
        "never_changed_certain": int((rows & claims.never_changed & certain).sum()),
        "false_by_reason": {name: int((false & (claims.reason == row)).sum()) for row, name in enumerate(REASONS)},
        "false_share": n_false / n_told if n_told else None,
        "told_brier": float(np.mean(error**2)) if n_told else None,
        "knowable": knowable,
        "recalled": recalled,
        "told_recall": recalled / knowable if knowable else None,
    }
