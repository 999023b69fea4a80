"""A session solved alone, in the frame of its first pose: what it knows before the map is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.slam.streaming import Outcome
from evermap.types import BoolArray, FloatArray, IntArray

SIGHTINGS = 1.5
"""Inliers that a landmark needs to be believed: one sighting may carry a wrong identity."""


@dataclass(frozen=True, slots=True)
class OwnLandmarks:
    """Landmarks of a session.

    Attributes:
        row: (K,) rows of the problem's landmarks: those that were seen often enough to be believed.
        position_m: (K, 2) in the frame of the first pose.
        covariance_m2: (2 K, 2 K).
    """

    row: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray


def believable(landmark_row: IntArray, inlier: FloatArray, known: BoolArray) -> IntArray:
    """(K,) rows of landmarks that have a position, and enough sightings that fit it."""
    sightings = np.bincount(landmark_row[: len(inlier)], inlier, minlength=len(known))
    return np.flatnonzero(known & (sightings >= SIGHTINGS))


def own_landmarks(outcome: Outcome, *, of_unknown_size: bool = True) -> OwnLandmarks:
    """What a session says of its landmarks.

    Args:
        outcome: of the session.
        of_unknown_size: with what is not known of the scale, as one needs to compare it with a map. The metre of a map
            is that of its first session: where later ones could change it, the shrinking that noise does to every
            graph would shrink it a little each time.
    """
    estimate = outcome.graph_estimate
    row = believable(outcome.problem.landmark_row, outcome.inlier, estimate.known)
    at = (2 * row[:, None] + np.arange(2)).ravel()
    position = estimate.landmark[row] * outcome.scale
    covariance = outcome.graph_marginals.shared[np.ix_(at, at)] * outcome.scale**2
    if of_unknown_size:
        longer = position.ravel() * outcome.log_scale_sigma  # a longer world moves all landmarks away from the origin
        covariance = covariance + np.outer(longer, longer)
    return OwnLandmarks(row, position, covariance)
