"""Landmark errors against surveyed positions, and identities of a run against those of the recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from evermap.errors import DataError
from evermap.geometry import se3
from evermap.geometry.group import group_of
from evermap.geometry.symmetry import Symmetries
from evermap.metrics.consistency import nees, share_in_band
from evermap.metrics.trajectory import align_points, rotate_covariance
from evermap.show import ShownTable
from evermap.types import UNKNOWN, AnyRecording, BoolArray, FloatArray, Innovations, IntArray, Landmarks, rows_of

MIN_SIGHTINGS = 10


@dataclass(frozen=True, slots=True)
class LandmarkErrors(ShownTable):
    """Errors of L landmarks that are both mapped and surveyed.

    Attributes:
        landmark_id, n_hits: (L,) identities and how often each was seen.
        estimate_m, truth_m: (L, D) positions in the frame of the truth.
        error_m: (L,) distances.
        orientation_error_rad: (L,) angles between the orientations; nan where either is a point.
        nees: (L,) of positions, D degrees of freedom; nan where exact. An alignment lowers it, see `PoseErrors`.
        scored: (L,) seen often enough to count.
        pose_truth_estimate: (3,) or (7,) the alignment used.
        unmapped: surveyed landmarks that the map does not have.
    """

    landmark_id: IntArray
    n_hits: IntArray
    estimate_m: FloatArray
    truth_m: FloatArray
    error_m: FloatArray
    orientation_error_rad: FloatArray
    nees: FloatArray
    scored: BoolArray
    pose_truth_estimate: FloatArray
    unmapped: int
    _besides: ClassVar = frozenset({"pose_truth_estimate"})

    def _facts(self) -> dict[str, Any]:
        count = {"landmarks": len(self.landmark_id), "scored": int(self.scored.sum()), "unmapped": self.unmapped}
        return {**count, "rmse_m": self.rmse_m, "max_m": self.max_m}

    @property
    def nees_in_band_share(self) -> float | None:
        """Return the share of the scored landmarks whose NEES is below its 95 % quantile; None if there is none."""
        return share_in_band(self.nees[self.scored], self.dof)

    @property
    def dof(self) -> int:
        """Return the degrees of freedom of `nees`: 2 in the plane, 3 in space."""
        return int(self.truth_m.shape[1])

    @property
    def rmse_m(self) -> float | None:
        """Return the root mean square error [m] of the scored landmarks; None if there is none."""
        return float(np.sqrt(np.mean(self.error_m[self.scored] ** 2))) if np.any(self.scored) else None

    @property
    def median_m(self) -> float | None:
        """Return the median error [m] of the scored landmarks; None if there is none."""
        return float(np.median(self.error_m[self.scored])) if np.any(self.scored) else None

    @property
    def orientation_rmse_deg(self) -> float | None:
        """Return the root mean square angle [degrees] of the scored landmarks with an orientation; None without any."""
        angle = self.orientation_error_rad[self.scored]
        known = angle[np.isfinite(angle)]
        return float(np.degrees(np.sqrt(np.mean(known**2)))) if len(known) else None

    @property
    def max_m(self) -> float | None:
        """Return the largest error [m] of the scored landmarks; None if there is none."""
        return float(np.max(self.error_m[self.scored])) if np.any(self.scored) else None


def evaluate_landmarks(
    estimate: Landmarks,
    truth: Landmarks,
    pose_truth_estimate: FloatArray | None,
    *,
    min_sightings: int = MIN_SIGHTINGS,
    symmetries: Mapping[str, tuple[str, ...]] | None = None,
) -> LandmarkErrors | None:
    """Compute errors after the given alignment (usually the trajectory's), or after the landmarks' own.

    Args:
        estimate: the map.
        truth: surveyed landmarks.
        pose_truth_estimate: (3,) or (7,) motion from the map's frame to the truth's; None aligns the scored landmarks
            themselves, which needs no truth of poses and hides a rotation between poses and map.
        min_sightings: landmarks seen less often are listed but not scored.
        symmetries: turns after which objects look the same, by the names of their classes, as of a `SpatialRecording`.

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
    group = group_of(pose_truth_estimate)
    aligned = group.transform(pose_truth_estimate, source)
    covariance = rotate_covariance(estimate.covariance_m2[mine], group.rotation_of(pose_truth_estimate))
    angle = _angles(pose_truth_estimate, rows_of(estimate, mine), rows_of(truth, theirs), symmetries or {})
    return LandmarkErrors(
        landmark_id=ids.astype(np.int64),
        n_hits=n_hits,
        estimate_m=aligned,
        truth_m=target,
        error_m=np.linalg.norm(aligned - target, axis=1),
        orientation_error_rad=angle,
        nees=nees(aligned - target, covariance + truth.covariance_m2[theirs]),
        scored=scored,
        pose_truth_estimate=np.asarray(pose_truth_estimate, dtype=np.float64),
        unmapped=int(len(truth) - len(ids)),
    )


def _angles(
    pose_truth_estimate: FloatArray, estimate: Landmarks, truth: Landmarks, symmetries: Mapping[str, tuple[str, ...]]
) -> FloatArray:
    """Angles (L,) between the orientations of the same landmarks after the alignment, the least where turns look the
    same; nan where either has none.
    """
    out = np.full(len(estimate), np.nan)
    if estimate.rotation is None or truth.rotation is None:
        return out
    turned, reference = (np.pad(r, ((0, 0), (3, 0))) for r in (estimate.rotation, truth.rotation))
    known = np.flatnonzero(np.isfinite(turned).all(axis=1) & np.isfinite(reference).all(axis=1))
    kinds = [dict(enumerate(one.class_names)) for one in (estimate, truth)]
    classes = zip(estimate.class_id.tolist(), truth.class_id.tolist(), strict=True)
    alike = Symmetries.of_classes(symmetries, [kinds[0].get(a) or kinds[1].get(b, "") for a, b in classes])
    turned = alike[known].nearest(se3.compose(pose_truth_estimate, turned[known]), reference[known])
    out[known] = np.linalg.norm(se3.local(reference[known], turned)[:, 3:], axis=1)
    return out


def by_recorded_identity(landmarks: Landmarks, innovations: Innovations, recording: AnyRecording) -> Landmarks:
    """Rename the landmarks of a map by the id that the recording gives to most of their detections, for scoring.

    Nothing changes where the run used the recording's ids. Where two landmarks claim one id, the one with more
    detections gets it; landmarks that get none are left out.
    """
    kept_rows = innovations.detection < len(recording.detections)  # a run may be compared with a part of its recording
    recorded = recording.detections.landmark_id[innovations.detection[kept_rows]]
    given = innovations.landmark_id[kept_rows]
    if np.array_equal(recorded, given):
        return landmarks
    known = (given != UNKNOWN) & (recorded != UNKNOWN)
    mine, row = np.unique(given[known], return_inverse=True)
    theirs, column = np.unique(recorded[known], return_inverse=True)
    table = np.zeros((len(mine), len(theirs)))  # detections by landmark and identity
    np.add.at(table, (row, column), 1.0)
    claims: dict[int, int] = {}
    for k in np.argsort(-table.max(axis=1, initial=0), kind="stable"):
        claims.setdefault(int(theirs[table[k].argmax()]), int(mine[k]))
    names = {landmark: identity for identity, landmark in claims.items()}
    rows = np.flatnonzero(np.isin(landmarks.landmark_id, list(names)))
    ids = np.array([names[int(k)] for k in landmarks.landmark_id[rows]], dtype=np.int64)
    order = np.argsort(ids)
    return replace(rows_of(landmarks, rows[order]), landmark_id=ids[order])
