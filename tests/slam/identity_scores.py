"""Identities that were found, against those of the recording; for tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import UNKNOWN, IntArray


@dataclass(frozen=True, slots=True)
class IdentityScores:
    """How well the landmarks of a run that numbered them itself match those of the recording.

    Attributes:
        purity: share of assigned detections that have the commonest identity of their landmark.
        completeness: share of detections that are in the landmark which holds most of their identity.
        n_landmarks, n_identities: numbers of distinct ids.
    """

    purity: float
    completeness: float
    n_landmarks: int
    n_identities: int


def identity_scores(landmark_id: IntArray, true_id: IntArray) -> IdentityScores:
    """Score the landmark ids of detections (M,) against true ones; `UNKNOWN` where one was given to no landmark."""
    given = (landmark_id != UNKNOWN) & (true_id != UNKNOWN)
    landmarks, row = np.unique(landmark_id[given], return_inverse=True)
    identities, column = np.unique(true_id[given], return_inverse=True)
    table = np.zeros((len(landmarks), len(identities)))
    np.add.at(table, (row, column), 1.0)
    if len(identities) == 0:
        return IdentityScores(0.0, 0.0, 0, 0)
    count = max(float(table.sum()), 1.0)
    return IdentityScores(
        float(table.max(axis=1, initial=0).sum() / count),
        float(table.max(axis=0, initial=0).sum() / len(true_id)),
        len(landmarks),
        len(identities),
    )
