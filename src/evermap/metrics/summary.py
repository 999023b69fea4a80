"""All numbers of a run in one dictionary with stable keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.metrics.consistency import NisSummary, share_in_band, summarise_nis
from evermap.metrics.landmarks import MIN_SIGHTINGS, LandmarkErrors, by_recorded_identity, evaluate_landmarks
from evermap.metrics.trajectory import PoseErrors, evaluate_trajectory
from evermap.show import Shown
from evermap.types import AnyRecording, BoolArray, FloatArray, SlamResult, is_in_space, json_number

RATE_HZ = 2.0
IN_VIEW_S = 1.0
"""A stamp counts as 'in view' this close to a frame with a landmark."""
ONLINE_MAX_GAP_S = 1.0


@dataclass(frozen=True, slots=True)
class Evaluation(Shown):
    """Comparison of a run with the truth; None where the truth is not known.

    Attributes:
        poses: smoothed trajectory, after its own alignment.
        online: causal poses, after their own alignment, where the sensor looked within `ONLINE_MAX_GAP_S`.
        dead_reckoning: odometry alone, after its own alignment (which flatters it).
        landmarks: after the alignment of `poses`.
        landmarks_anchored: after the alignment that makes the first pose exact (for NEES).
        landmarks_own: after the landmarks' own alignment.
        nis: innovation consistency.
        in_view: (K,) which of the scored stamps of `poses` are within `IN_VIEW_S` of a sighting.
        rate_hz: how densely truth was sampled.
    """

    poses: PoseErrors | None
    online: PoseErrors | None
    dead_reckoning: PoseErrors | None
    landmarks: LandmarkErrors | None
    landmarks_anchored: LandmarkErrors | None
    landmarks_own: LandmarkErrors | None
    nis: NisSummary
    in_view: BoolArray | None = None
    rate_hz: float = RATE_HZ


def compare_with_truth(recording: AnyRecording, result: SlamResult, *, rate_hz: float = RATE_HZ) -> Evaluation:
    """Compare a run with all that the recording knows of the truth, poses at `rate_hz`."""
    poses = online = dead_reckoning = landmarks = anchored = own = None
    if recording.truth is not None:
        # in space there may be no odometry, and then no pose where nothing was seen
        within: dict[str, Any] = {"rate_hz": rate_hz, "max_gap_s": float("inf")}
        if is_in_space(recording):
            within |= {"max_gap_s": ONLINE_MAX_GAP_S, "looked_s": recording.frames.stamp_s}
        poses = evaluate_trajectory(result.trajectory, recording.truth, **within)
        online = evaluate_trajectory(result.online, recording.truth, **within | {"max_gap_s": ONLINE_MAX_GAP_S})
        dead_reckoning = evaluate_trajectory(result.dead_reckoning, recording.truth, rate_hz=rate_hz)
    if recording.true_landmarks is not None:
        mapped = by_recorded_identity(result.landmarks, result.innovations, recording)
        same = recording.symmetries if is_in_space(recording) else None
        own = evaluate_landmarks(mapped, recording.true_landmarks, None, symmetries=same)
        if poses is not None:
            landmarks = evaluate_landmarks(mapped, recording.true_landmarks, poses.pose_truth_estimate, symmetries=same)
            if poses.pose_truth_anchor is not None:
                anchor = poses.pose_truth_anchor
                anchored = evaluate_landmarks(mapped, recording.true_landmarks, anchor, symmetries=same)
    nis = summarise_nis(result.innovations)
    view = in_view(recording, poses.stamp_s) if poses is not None else None
    return Evaluation(poses, online, dead_reckoning, landmarks, anchored, own, nis, view, rate_hz)


def in_view(recording: AnyRecording, stamp_s: FloatArray) -> BoolArray:
    """Return (K,) whether a landmark was seen within `IN_VIEW_S` before or after each stamp.

    Elsewhere the pose rests on odometry alone, whose errors no map can correct.
    """
    seen = recording.frames.stamp_s[np.unique(recording.detections.frame)]
    if len(seen) == 0:
        return np.zeros(len(stamp_s), dtype=np.bool_)
    after = np.searchsorted(seen, stamp_s)
    later = np.abs(seen[np.minimum(after, len(seen) - 1)] - stamp_s)
    earlier = np.abs(seen[np.maximum(after - 1, 0)] - stamp_s)
    near: BoolArray = np.minimum(earlier, later) <= IN_VIEW_S
    return near


def metrics_dict(evaluation: Evaluation) -> dict[str, Any]:
    """Return the stable keys of `metrics` in `summary.json`: plain floats, None without truth, no key missing."""
    poses, online, odometry = evaluation.poses, evaluation.online, evaluation.dead_reckoning
    landmarks, own, nis = evaluation.landmarks, evaluation.landmarks_own, evaluation.nis
    anchored, view, scored = evaluation.landmarks_anchored, evaluation.in_view, poses or landmarks or own
    return {
        "pose_rmse_m": json_number(poses and poses.rmse_m),
        "pose_mean_m": json_number(poses and poses.mean_m),
        "pose_median_m": json_number(poses and poses.median_m),
        "pose_max_m": json_number(poses and poses.max_m),
        "heading_rmse_deg": json_number(poses and poses.heading_rmse_deg),
        "orientation_rmse_deg": json_number(poses and poses.orientation_rmse_deg),
        **_view(poses, view),
        "drift_m_per_m": json_number(poses and poses.drift_m_per_m),
        "online_pose_rmse_m": json_number(online and online.rmse_m),
        "online_heading_rmse_deg": json_number(online and online.heading_rmse_deg),
        "online_orientation_rmse_deg": json_number(online and online.orientation_rmse_deg),
        "dead_reckoning_rmse_m": json_number(odometry and odometry.rmse_m),
        "dead_reckoning_heading_rmse_deg": json_number(odometry and odometry.heading_rmse_deg),
        "dead_reckoning_orientation_rmse_deg": json_number(odometry and odometry.orientation_rmse_deg),
        "landmark_rmse_m": json_number(landmarks and landmarks.rmse_m),
        "landmark_median_m": json_number(landmarks and landmarks.median_m),
        "landmark_max_m": json_number(landmarks and landmarks.max_m),
        "landmark_rmse_own_alignment_m": json_number(own and own.rmse_m),
        "landmark_median_own_alignment_m": json_number(own and own.median_m),
        "landmark_orientation_rmse_deg": json_number(landmarks and landmarks.orientation_rmse_deg),
        "landmark_orientation_rmse_own_alignment_deg": json_number(own and own.orientation_rmse_deg),
        "landmarks_scored": int(own.scored.sum()) if own else None,
        "landmark_min_sightings": MIN_SIGHTINGS,
        "nis_mean": json_number(nis.mean),
        "nis_mean_all": json_number(nis.mean_all),
        "nis_median": json_number(nis.median),
        "nis_mean_band": [json_number(edge) for edge in nis.mean_band] if nis.mean_band else None,
        "nis_in_band_share": json_number(nis.in_band_share),
        "nis_in_two_sided_band_share": json_number(nis.in_two_sided_band_share),
        "nis_lag1_autocorrelation": json_number(nis.lag1),
        "nis_count": nis.count,
        "outlier_share": json_number(nis.outlier_share),
        "pose_nees_mean": _mean(poses.nees if poses else None),
        "pose_nees_in_band_share": share_in_band(poses.nees, poses.dof) if poses else None,
        "whole_pose_nees_mean": _mean(poses.whole_nees if poses else None),
        "pose_nees_anchored_mean": _mean(poses.anchored_nees if poses else None),
        "landmark_nees_mean": _mean(landmarks.nees[landmarks.scored] if landmarks else None),
        "landmark_nees_in_band_share": landmarks and landmarks.nees_in_band_share,
        "landmark_nees_anchored_mean": _mean(anchored.nees[anchored.scored] if anchored else None),
        "nees_dof": scored and scored.dof,
        "alignment": _alignment(evaluation),
    }


def _alignment(evaluation: Evaluation) -> dict[str, Any]:
    """Return how estimates were aligned with the truth, and how much truth was scored."""
    poses, online, odometry = evaluation.poses, evaluation.online, evaluation.dead_reckoning
    return {
        "purpose": "evaluation only; nothing of it flows back into the estimate",
        "rate_hz": evaluation.rate_hz,
        "method": poses and poses.alignment,
        "pose_truth_estimate": poses and _pose(poses.pose_truth_estimate),
        "pose_truth_dead_reckoning": odometry and _pose(odometry.pose_truth_estimate),
        "pose_truth_online": online and _pose(online.pose_truth_estimate),
        "scored_stamps": len(poses.stamp_s) if poses else 0,
        "scored_from_s": poses and json_number(poses.stamp_s[0]),
        "scored_to_s": poses and json_number(poses.stamp_s[-1]),
        "skipped_stamps": poses.skipped if poses else 0,
        "online_scored_stamps": len(online.stamp_s) if online else 0,
        "online_skipped_stamps": online.skipped if online else 0,
    }


def _pose(pose: FloatArray) -> dict[str, float | None]:
    names = ("x_m", "y_m", "theta_rad") if len(pose) == 3 else ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    return dict(zip(names, map(json_number, pose), strict=True))


def _mean(values: FloatArray | None) -> float | None:
    if values is None or not np.any(np.isfinite(values)):
        return None
    return float(np.mean(values[np.isfinite(values)]))


def _view(poses: PoseErrors | None, view: BoolArray | None) -> dict[str, float | None]:
    """Return the errors while landmarks were in view, and the share of that time."""
    names = ("pose_rmse_in_view_m", "heading_rmse_in_view_deg", "orientation_rmse_in_view_deg", "in_view_share")
    if poses is None or view is None or not view.any():
        return dict.fromkeys(names)
    errors = (poses.position_error_m, poses.heading_error_rad, poses.orientation_error_rad)
    distance, *angles = (np.sqrt(np.mean(error[view] ** 2)) for error in errors)
    rmse = map(json_number, (distance, *np.degrees(angles)))
    return dict(zip(names, (*rmse, float(np.mean(view))), strict=True))
