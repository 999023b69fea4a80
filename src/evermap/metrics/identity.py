"""Landmarks of a run that numbered them itself, compared with the identities that the recording knows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from evermap.types import UNKNOWN, FloatArray, Innovations, IntArray, Landmarks, Recording


@dataclass(frozen=True, slots=True)
class IdentityScores:
    """How well landmarks of a run stand for landmarks of the recording.

    Attributes:
        purity: share of detections whose landmark consists mostly of detections of the same identity.
        completeness: share of detections that are in the landmark which holds most of their identity.
        n_landmarks, n_identities: how many there are.
    """

    purity: float
    completeness: float
    n_landmarks: int
    n_identities: int


def identity_scores(landmark_id: IntArray, true_id: IntArray) -> IdentityScores:
    """Purity and completeness of detections (M,), `UNKNOWN` where one was given to no landmark."""
    table, landmarks, identities = _table(landmark_id, true_id)
    if len(identities) == 0:
        return IdentityScores(0.0, 0.0, 0, 0)
    given = max(float(table.sum()), 1.0)
    return IdentityScores(
        float(table.max(axis=1, initial=0).sum() / given),
        float(table.max(axis=0, initial=0).sum() / len(true_id)),
        len(landmarks),
        len(identities),
    )


def by_recorded_identity(landmarks: Landmarks, innovations: Innovations, recording: Recording) -> Landmarks:
    """The map with the ids that the recording gives to most detections of each landmark, for scoring.

    Nothing changes where the run used the recording's ids. Where two landmarks claim one id, the one with more
    detections of it has it; landmarks that get none are left out.
    """
    kept_rows = innovations.detection < len(recording.detections)  # a run may be compared with a part of its recording
    recorded = recording.detections.landmark_id[innovations.detection[kept_rows]]
    given = innovations.landmark_id[kept_rows]
    if np.array_equal(recorded, given):
        return landmarks
    table, mine, theirs = _table(given, recorded)
    claims: dict[int, int] = {}
    for k in np.argsort(-table.max(axis=1, initial=0), kind="stable"):
        claims.setdefault(int(theirs[table[k].argmax()]), int(mine[k]))
    names = {landmark: identity for identity, landmark in claims.items()}
    rows = np.flatnonzero(np.isin(landmarks.landmark_id, list(names)))
    ids = np.array([names[int(k)] for k in landmarks.landmark_id[rows]], dtype=np.int64)
    order = np.argsort(ids)
    columns = (
        "position_m", "covariance_m2", "class_id", "p_exists", "n_hits", "n_misses", "first_seen_s", "last_seen_s"
    )  # fmt: skip
    kept = {name: getattr(landmarks, name)[rows][order] for name in columns}
    return replace(landmarks, landmark_id=ids[order], **kept)


def _table(landmark_id: IntArray, true_id: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
    """(L, I) detections by landmark and identity, and both lists of ids."""
    given = (landmark_id != UNKNOWN) & (true_id != UNKNOWN)
    landmarks, row = np.unique(landmark_id[given], return_inverse=True)
    identities, column = np.unique(true_id[given], return_inverse=True)
    table = np.zeros((len(landmarks), len(identities)))
    np.add.at(table, (row, column), 1.0)
    return table, landmarks, identities
