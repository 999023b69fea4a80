"""What the study says, session by session, as plain values with stable keys: section `demo` of `summary.json`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.demo.study import SERIES, Study, Visit
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

MOVED_M = 0.05
"""Farther from its old place than this, a landmark has moved."""

ALIGNMENT = "each session's path by an SE(2) alignment of its own, for evaluation only; landmarks by the same"


@dataclass(frozen=True, slots=True)
class Drift:
    """How the world of one session differs from the one that was mapped.

    Attributes:
        stayed, moved, vanished, appeared: ids of landmarks; `vanished` were there at first and are not any more.
        displacement_m: how far each of `moved` is from its first place.
    """

    stayed: IntArray
    moved: IntArray
    displacement_m: FloatArray
    vanished: IntArray
    appeared: IntArray


def drift(then: Landmarks, now: Landmarks) -> Drift:
    """Compare two true states of a building."""
    ids, old, new = np.intersect1d(then.landmark_id, now.landmark_id, return_indices=True)
    gap_m = np.linalg.norm(now.position_m[new] - then.position_m[old], axis=1)
    return Drift(
        stayed=ids[gap_m <= MOVED_M],
        moved=ids[gap_m > MOVED_M],
        displacement_m=gap_m[gap_m > MOVED_M],
        vanished=np.setdiff1d(then.landmark_id, ids),
        appeared=np.setdiff1d(now.landmark_id, ids),
    )


def drifts(study: Study) -> tuple[Drift, ...]:
    """One a session, against the truth of the first session, in the changing building."""
    truths = [session.true_landmarks for session in study.changed.sessions]
    assert truths[0] is not None
    return tuple(drift(truths[0], truth) for truth in truths if truth is not None)


def demo_dict(study: Study, seed: int) -> dict[str, Any]:
    """All numbers. Shares are of the detections that had a prediction; None where there is nothing to divide by."""
    sessions = [
        {
            "session": k + 1,
            "day": study.changed.truths[k].day + 1,
            "start_s": study.changed.truths[k].start_s,
            "changes": _changes(study, k, now),
            **{name: _errors(study.visits[name][k]) for name in SERIES},
        }
        for k, now in enumerate(drifts(study))
    ]
    return {
        "scenario": study.scenario.as_dict(),
        "seed": seed,
        "alignment": ALIGNMENT,
        "moved_threshold_m": MOVED_M,
        "sessions": sessions,
        "true_events": len(study.changed.events),
    }


def _errors(visit: Visit) -> dict[str, float | None]:
    """How far off one session was."""
    poses, landmarks = visit.evaluation.poses, visit.evaluation.landmarks
    numbers: dict[str, float | None] = dict.fromkeys(
        ("pose_rmse_m", "pose_p10_m", "pose_p90_m", "heading_rmse_deg", "landmark_rmse_m", "landmark_median_m")
    )
    if poses is not None:
        low, high = np.percentile(poses.position_error_m, [10, 90])
        numbers |= {
            "pose_rmse_m": poses.rmse_m,
            "pose_p10_m": float(low),
            "pose_p90_m": float(high),
            "heading_rmse_deg": poses.heading_rmse_deg,
        }
    if landmarks is not None and np.any(landmarks.scored):
        numbers["landmark_rmse_m"] = landmarks.rmse_m
        numbers["landmark_median_m"] = float(np.median(landmarks.error_m[landmarks.scored]))
    numbers["outlier_share"] = visit.evaluation.nis.outlier_share
    return numbers


def _changes(study: Study, k: int, now: Drift) -> dict[str, float | int | None]:
    """What has changed since the map was made, and what the estimator made of it in session `k`.

    A moved landmark is 'believed' if most of its detections were, else 'rejected'; not every one was seen.
    """
    innovations = study.visits["changed"][k].result.innovations
    rejected = innovations.p_inlier < 0.5
    of_moved = np.isin(innovations.landmark_id, now.moved)
    of_stayed = np.isin(innovations.landmark_id, now.stayed)
    seen = np.isin(now.moved, innovations.landmark_id)
    far = now.displacement_m[seen]
    doubt = np.array([np.mean(rejected[innovations.landmark_id == name]) for name in now.moved[seen]])
    return {
        "landmarks_mapped_then": len(now.stayed) + len(now.moved) + len(now.vanished),
        "moved": len(now.moved),
        "vanished": len(now.vanished),
        "appeared": len(now.appeared),
        "moved_believed": int(np.count_nonzero(doubt < 0.5)),
        "moved_rejected": int(np.count_nonzero(doubt >= 0.5)),
        "believed_displacement_m": _median(far[doubt < 0.5]),
        "rejected_displacement_m": _median(far[doubt >= 0.5]),
        "moved_detection_share": _share(of_moved),
        "moved_rejected_share": _share(rejected[of_moved]),
        "stayed_rejected_share": _share(rejected[of_stayed]),
    }


def _share(which: BoolArray) -> float | None:
    return float(np.mean(which)) if len(which) else None


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if len(values) else None
