"""A session solved alone, in the frame of its first pose: what it knows before the map is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.slam.streaming import Outcome
from evermap.types import FloatArray, IntArray

SIGHTINGS = 1.5
"""Inliers that a landmark needs to be believed: one sighting may carry a wrong identity."""
SIGHTINGS_IN_PLACE = 0.5
"""The same, of one that stands where the map has it: a wrong identity is hardly ever the right one there."""


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


def own_landmarks(outcome: Outcome, in_place: IntArray | None = None, *, of_unknown_size: bool = True) -> OwnLandmarks:
    """What a session says of its landmarks.

    Args:
        outcome: of the session.
        in_place: rows of landmarks that were laid at places of the map.
        of_unknown_size: with what is not known of the scale, as one needs to compare it with a map. The metre of a map
            is that of its first session: where later ones could change it, the shrinking that noise does to every
            graph would shrink it a little each time.
    """
    estimate = outcome.graph_estimate
    landmark = outcome.problem.landmark_row[: len(outcome.inlier)]
    least = np.full(len(estimate.known), SIGHTINGS)
    least[[] if in_place is None else in_place] = SIGHTINGS_IN_PLACE
    row = np.flatnonzero(estimate.known & (np.bincount(landmark, outcome.inlier, minlength=len(least)) >= least))
    at = (2 * row[:, None] + np.arange(2)).ravel()
    position = estimate.landmark[row] * outcome.scale
    covariance = outcome.graph_marginals.shared[np.ix_(at, at)] * outcome.scale**2
    if of_unknown_size:
        longer = position.ravel() * outcome.log_scale_sigma  # a longer world moves all landmarks away from the origin
        covariance = covariance + np.outer(longer, longer)
    return OwnLandmarks(row, position, covariance)
