"""Scores of one MRCLAM run, and how much of its heading error is the odometry's.

The robots are blind for up to a minute at a time. Then only odometry speaks, and what it says wrongly no landmark can
mend. Two numbers tell that share apart: the error while landmarks were in view, and the error of a robot that is given
its true pose at every sighting and has this odometry in between.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.metrics.summary import RATE_HZ, Evaluation, in_view, metrics_dict
from evermap.metrics.trajectory import PoseErrors, evaluate_trajectory, interpolate, scored_stamps
from evermap.types import FloatArray, Recording, SlamResult, Trajectory

_MAX_TRUTH_GAP_S = 0.5
"""True poses are interpolated to the sightings only between truth stamps this close."""
_FROM_METRICS = (
    "pose_rmse_m",
    "heading_rmse_deg",
    "online_pose_rmse_m",
    "online_heading_rmse_deg",
    "landmark_rmse_m",
    "landmark_rmse_own_alignment_m",
    "landmarks_scored",
    "nis_mean",
    "nis_in_band_share",
    "outlier_share",
    "pose_nees_mean",
    "pose_nees_in_band_share",
    "pose_nees_anchored_mean",
)


def sighting_stamps(recording: Recording) -> FloatArray:
    """(K,) stamps of the frames in which a landmark was seen [s]."""
    return recording.frames.stamp_s[np.unique(recording.detections.frame)]


def run_scores(recording: Recording, result: SlamResult, evaluation: Evaluation, wall_s: float) -> dict[str, Any]:
    """What one run is worth and what it cost; None where there is no truth. Keys are stable.

    Args:
        recording: what was processed.
        result: what came out.
        evaluation: `compare_with_truth(recording, result)`.
        wall_s: wall time of the whole run, final smoothing included [s].
    """
    metrics = metrics_dict(evaluation)
    lasted_s = float(np.ptp(recording.frames.stamp_s))
    step_ms = 1e3 * result.step_s
    p50, p99 = np.percentile(step_ms, [50, 99])
    return {
        **{key: metrics[key] for key in _FROM_METRICS},
        **view_scores(recording, evaluation.poses),
        "duration_s": lasted_s,
        "real_time_factor_streaming": lasted_s / float(result.step_s.sum()),
        "real_time_factor_whole": lasted_s / wall_s,
        "step_p50_ms": float(p50),
        "step_p99_ms": float(p99),
        "step_max_ms": float(step_ms.max()),
    }


def odometry_scores(recording: Recording, evaluation: Evaluation) -> dict[str, Any]:
    """Odometry alone, as reported, after an alignment of its own."""
    errors = evaluation.dead_reckoning
    return {
        "pose_rmse_m": None if errors is None else errors.rmse_m,
        "heading_rmse_deg": None if errors is None else errors.heading_rmse_deg,
        **view_scores(recording, errors),
    }


def view_scores(recording: Recording, errors: PoseErrors | None) -> dict[str, Any]:
    """Heading RMSE at the stamps in view (`metrics.summary.in_view`), their share, and the longest blind time."""
    blind_s = float(np.max(np.diff(sighting_stamps(recording)), initial=0.0))
    if errors is None:
        return {"heading_in_view_deg": None, "in_view_share": None, "longest_blind_s": blind_s}
    near = in_view(recording, errors.stamp_s)
    return {
        "heading_in_view_deg": _rmse_deg(errors.heading_error_rad[near]),
        "in_view_share": float(near.mean()),
        "longest_blind_s": blind_s,
    }


def bound_scores(recording: Recording, result: SlamResult) -> dict[str, Any]:
    """What `odometry_between_true_poses` leaves, scored as the run itself."""
    errors = odometry_between_true_poses(recording, result)
    return {
        "bound_pose_rmse_m": None if errors is None else errors.rmse_m,
        "bound_heading_rmse_deg": None if errors is None else errors.heading_rmse_deg,
    }


def odometry_between_true_poses(recording: Recording, result: SlamResult) -> PoseErrors | None:
    """Errors of a robot that knows its true pose at every sighting and only its odometry in between.

    The odometry is integrated with the calibration and the noise that the run estimated, and closes on both ends, as
    the run's own does. What is left is beyond every map: it is what this odometry says wrongly where nothing else
    speaks. None where truth does not cover the sightings.
    """
    from evermap.slam.bridge import bridge_poses
    from evermap.slam.calibration import NAMES
    from evermap.slam.intake import prepare
    from evermap.slam.kernels import NOISE_NAMES
    from evermap.slam.problem import Noise

    truth = recording.truth
    if truth is None:
        return None
    prepared = prepare(recording)
    known_s = recording.frames.stamp_s[prepared.pose_frame]
    known_s = known_s[(known_s >= truth.stamp_s[0]) & (known_s <= truth.stamp_s[-1])]
    true_pose, _, gap_s = interpolate(truth, known_s)
    known_s, true_pose = known_s[gap_s <= _MAX_TRUTH_GAP_S], true_pose[gap_s <= _MAX_TRUTH_GAP_S]
    rows = scored_stamps(truth, result.trajectory.stamp_s[0], result.trajectory.stamp_s[-1], RATE_HZ)
    if len(known_s) < 2 or len(rows) < 2:
        return None
    stamps = truth.stamp_s[rows]
    value = {parameter.name: parameter.value for parameter in result.parameters}
    noise = Noise(
        detection=np.array([value["sigma_range_m"], value["sigma_bearing_rad"]]),
        odometry=np.array([value[name] for name in NOISE_NAMES]),
        outlier_log_odds=np.inf,
    )
    exact = np.zeros((len(known_s), 3, 3))
    states = np.array([value[name] for name in NAMES])
    pose, covariance = bridge_poses(
        stamps - prepared.start_s,
        known_s - prepared.start_s,
        true_pose,
        exact,
        exact,
        prepared.problem.drive,
        states,
        noise,
    )
    return evaluate_trajectory(Trajectory(stamps, pose, covariance, "truth", truth.clock), truth, rate_hz=RATE_HZ)


def _rmse_deg(error_rad: FloatArray) -> float | None:
    return float(np.degrees(np.sqrt(np.mean(error_rad**2)))) if len(error_rad) else None
