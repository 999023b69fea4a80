"""A session solved alone, in the frame of its first pose: what it knows before the map is asked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.geometry import se2
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
        covariance_m2: (2 K, 2 K), as if its size were known.
    """

    row: IntArray
    position_m: FloatArray
    covariance_m2: FloatArray


def own_landmarks(outcome: Outcome, in_place: IntArray | None = None) -> OwnLandmarks:
    """What a session says of its landmarks, in its own metres: those of the map where it was solved with one.

    Args:
        outcome: of the session.
        in_place: rows of landmarks that were laid at places of the map.
    """
    estimate = outcome.graph_estimate
    landmark = outcome.problem.landmark_row[: len(outcome.inlier)]
    least = np.full(len(estimate.known), SIGHTINGS)
    least[[] if in_place is None else in_place] = SIGHTINGS_IN_PLACE
    row = np.flatnonzero(estimate.known & (np.bincount(landmark, outcome.inlier, minlength=len(least)) >= least))
    at = se2.xy_rows(row)
    position = estimate.landmark[row] * outcome.scale
    return OwnLandmarks(row, position, outcome.graph_marginals.shared[np.ix_(at, at)] * outcome.scale**2)


def of_unknown_size(own: OwnLandmarks, log_sigma: float) -> FloatArray:
    """(2 K, 2 K) covariance with a size that is known to `log_sigma`: a longer world moves all away from the origin."""
    longer = own.position_m.ravel() * log_sigma
    return np.asarray(own.covariance_m2 + np.outer(longer, longer))
