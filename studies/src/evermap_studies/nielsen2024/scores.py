"""Scores of one run in a map that is wrong: poses and landmarks in the map's frame, and the changes that were found.

Nothing is aligned: the map gives the frame, and an estimate that slides away with the moved landmarks is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from evermap.metrics.landmarks import evaluate_landmarks
from evermap.metrics.summary import RATE_HZ, in_view
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.types import FloatArray, Landmarks, MapChange, Recording, SlamResult, Trajectory
from evermap_studies.changes import compare_changes, rank_of_truth, time_of_change

Row = dict[str, Any]


def run_scores(
    recording: Recording, result: SlamResult, reference: Trajectory, truth: Trajectory | None, landmarks: Landmarks
) -> Row:
    """Errors of poses and landmarks in the map's frame; None where the robot was not found in the map.

    Args:
        recording: what was processed.
        result: what came out.
        reference: trajectory to compare with.
        truth: the recording's own, which may cover a part only.
        landmarks: where they truly are at the end.
    """
    placed = result.trajectory.frame == "prior_map"
    errors = evaluate_trajectory(result.trajectory, reference, rate_hz=RATE_HZ, align=False) if placed else None
    true = evaluate_trajectory(result.trajectory, truth, rate_hz=RATE_HZ, align=False) if placed and truth else None
    mapped = evaluate_landmarks(result.landmarks, landmarks, np.zeros(3)) if placed else None
    seen = None if errors is None else errors.position_error_m[in_view(recording, errors.stamp_s)]
    return {
        "placed": placed,
        "pose_rmse_m": None if errors is None else errors.rmse_m,
        "pose_seen_rmse_m": None if seen is None else _rms(seen),
        "pose_max_m": None if errors is None else errors.max_m,
        "heading_rmse_deg": None if errors is None else errors.heading_rmse_deg,
        "pose_true_rmse_m": None if true is None else true.rmse_m,
        "landmark_rmse_m": None if mapped is None else mapped.rmse_m,
        "landmark_max_m": None if mapped is None else mapped.max_m,
    }


def change_scores(true: Sequence[MapChange], result: SlamResult, recording: Recording, during: bool) -> Row:
    """How the changes that were found agree with those that were made; plain JSON values.

    Args:
        true: what was made.
        result: of the run.
        recording: before the edit.
        during: whether the change happened during the recording.
    """
    found, others = result.changes, result.alternatives
    errors = compare_changes(found, true)
    groups = {change.landmark_ids for change in true}
    right = [change.landmark_ids in groups for change in found]
    return {
        "exact": errors.exact,
        "truth_rank": rank_of_truth(replace(result, changes=found, alternatives=others), true),
        "precision": errors.precision,
        "recall": errors.recall,
        "displacement_error_m": float(errors.displacement_error_m.max()) if len(errors.true_row) else None,
        "changes": [
            {
                "landmarks": list(change.landmark_ids),
                "kind": change.kind.value,
                "displacement_m": list(change.displacement_m),
                "rotation_rad": change.rotation_rad,
                "probability": change.probability,
                "right": is_right,
            }
            for change, is_right in zip(found, right, strict=True)
        ],
        "alternatives": [other.probability for other in others],
        **_time_scores([change for change, ok in zip(found, right, strict=True) if ok and during], true, recording),
    }


def _time_scores(right: Sequence[MapChange], true: Sequence[MapChange], recording: Recording) -> Row:
    """How far the true time lies outside of the interval that was reported, and its middle outside of the window [s].

    The window reaches from the last sighting of the group before the change to the first after it: within it all
    times explain the recording equally well.
    """
    if not right:
        return {"time_off_interval_s": None, "time_off_window_s": None}
    at_s, found_s = time_of_change(true[0]), time_of_change(right[0])
    detections = recording.detections
    stamps = recording.frames.stamp_s[detections.frame]
    seen_s = stamps[np.isin(detections.landmark_id, right[0].landmark_ids)]
    opens = float(seen_s[seen_s < at_s].max(initial=stamps[0]))
    closes = float(seen_s[seen_s >= at_s].min(initial=stamps[-1]))
    return {
        "time_off_interval_s": max(right[0].stamp_from_s - at_s, at_s - right[0].stamp_to_s, 0.0)
        if math.isfinite(right[0].stamp_from_s)
        else abs(found_s - at_s),
        "time_off_window_s": max(opens - found_s, found_s - closes, 0.0),
    }


def _rms(values: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
