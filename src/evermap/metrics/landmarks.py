"""Landmark errors against surveyed positions, matched by id."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import DataError
from evermap.geometry import se2
from evermap.metrics.alignment import align_points, rotate_covariance
from evermap.metrics.consistency import nees
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

MIN_SIGHTINGS = 10


@dataclass(frozen=True, slots=True)
class LandmarkErrors:
    """Errors of L landmarks that are both mapped and surveyed.

    Attributes:
        landmark_id, n_hits: (L,) identities and how often each was seen.
        estimate_m, truth_m: (L, 2) positions in the frame of the truth.
        error_m: (L,) distances.
        nees: (L,) 2 degrees of freedom; see `PoseErrors` for what an alignment does to it. nan where exact.
        scored: (L,) seen often enough to count.
        pose_truth_estimate: (3,) the alignment used.
        unmapped: surveyed landmarks that the map does not have.
    """

    landmark_id: IntArray
    n_hits: IntArray
    estimate_m: FloatArray
    truth_m: FloatArray
    error_m: FloatArray
    nees: FloatArray
    scored: BoolArray
    pose_truth_estimate: FloatArray
    unmapped: int

    @property
    def rmse_m(self) -> float | None:
        """Root mean square error [m] over the scored landmarks; None if there is none."""
        return float(np.sqrt(np.mean(self.error_m[self.scored] ** 2))) if np.any(self.scored) else None

    @property
    def max_m(self) -> float | None:
        """Largest error [m] of the scored landmarks; None if there is none."""
        return float(np.max(self.error_m[self.scored])) if np.any(self.scored) else None


def evaluate_landmarks(
    estimate: Landmarks,
    truth: Landmarks,
    pose_truth_estimate: FloatArray | None,
    *,
    min_sightings: int = MIN_SIGHTINGS,
) -> LandmarkErrors | None:
    """Errors after the given alignment (usually the trajectory's), or after the landmarks' own where it is None.

    Args:
        estimate: the map.
        truth: surveyed landmarks.
        pose_truth_estimate: (3,) motion from the map's frame to the truth's; None aligns the scored landmarks
            themselves, which is kinder: it needs no pose truth and hides a rotation between poses and map.
        min_sightings: landmarks seen less often are listed but not scored.

    Returns:
        None if no landmark is in both, or too few for an alignment of their own.
    """
    ids, mine, theirs = np.intersect1d(estimate.landmark_id, truth.landmark_id, return_indices=True)
    if len(ids) == 0:
        return None
    n_hits = estimate.n_hits[mine]
    scored = n_hits >= min_sightings
    source, target = estimate.position_m[mine], truth.position_m[theirs]
    if pose_truth_estimate is None:
        try:
            pose_truth_estimate = align_points(source[scored], target[scored])
        except DataError:
            return None
    aligned = se2.transform(pose_truth_estimate, source)
    covariance = rotate_covariance(estimate.covariance_m2[mine], float(pose_truth_estimate[2]))
    return LandmarkErrors(
        landmark_id=ids.astype(np.int64),
        n_hits=n_hits,
        estimate_m=aligned,
        truth_m=target,
        error_m=np.linalg.norm(aligned - target, axis=1),
        nees=nees(aligned - target, covariance + truth.covariance_m2[theirs]),
        scored=scored,
        pose_truth_estimate=np.asarray(pose_truth_estimate, dtype=np.float64),
        unmapped=int(len(truth) - len(ids)),
    )
