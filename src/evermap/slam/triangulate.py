"""Where a landmark must be, by its sightings alone."""

from __future__ import annotations

import numpy as np

from evermap.geometry import se2
from evermap.slam.problem import Estimate, Problem
from evermap.types import FloatArray, IntArray

MIN_SIGHTINGS = 3
"""Sightings from which a landmark's place may be voted on."""


def sighted_at(pose: FloatArray, reading: FloatArray, states: FloatArray, mount: FloatArray) -> FloatArray:
    """Positions (..., 2) that readings (..., 2) of range and bearing from poses (..., 3) point to.

    The range law is inverted at the corrected bearing.
    """
    bearing = reading[..., 1] - states[4]
    gain = 1.0 + states[1] + states[2] * bearing + states[3] * bearing**2
    range_m = (reading[..., 0] - states[0]) / gain
    in_sensor = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1)
    return se2.transform(se2.compose(pose, mount), in_sensor)


def outvoted(problem: Problem, estimate: Estimate, weights: FloatArray) -> Estimate:
    """The estimate with landmarks moved to the median of their sightings where most sightings disagree with them.

    A landmark whose first sighting carried the wrong identity starts in the wrong place, from where all right
    sightings look like outliers.

    Args:
        problem: the measurements so far.
        estimate: where they put everything.
        weights: (M,) inlier weights of the detections.
    """
    sightings = np.bincount(problem.landmark_row, minlength=len(estimate.landmark))
    agreeing = np.bincount(problem.landmark_row, weights=weights > 0.5, minlength=len(estimate.landmark))
    # a vote would only set a landmark of a prior map against that map
    disputed = (sightings >= MIN_SIGHTINGS) & (agreeing < 0.5 * sightings) & ~problem.mapped
    lost: IntArray = np.flatnonzero(disputed).astype(np.int64)
    if len(lost) == 0:
        return estimate
    landmark = estimate.landmark.copy()
    for j in lost:
        mine = np.flatnonzero(problem.landmark_row == j)
        at = sighted_at(estimate.pose[problem.pose_row[mine]], problem.reading[mine], estimate.states, problem.mount)
        landmark[j] = np.median(at, axis=0)
    return Estimate(estimate.pose, landmark, estimate.states)
