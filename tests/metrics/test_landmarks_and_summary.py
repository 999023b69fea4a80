"""Landmark errors and the summary's stable keys."""

import dataclasses
import json

import numpy as np
import pytest

from evermap.geometry import se2
from evermap.metrics.landmarks import evaluate_landmarks
from evermap.metrics.summary import compare_with_truth, in_view, metrics_dict
from evermap.types import Innovations, Landmarks, rows_of

STABLE_KEYS = {
    "pose_rmse_m",
    "heading_rmse_deg",
    "landmark_rmse_m",
    "online_pose_rmse_m",
    "dead_reckoning_rmse_m",
    "dead_reckoning_heading_rmse_deg",
    "nis_mean",
    "nis_in_band_share",
    "pose_nees_mean",
    "landmark_nees_mean",
    "alignment",
}


def with_hits(landmarks, n_hits):
    return dataclasses.replace(landmarks, n_hits=np.asarray(n_hits))


def test_landmarks_are_matched_by_id_and_the_rare_ones_not_scored():
    truth = Landmarks.at([1, 2, 3, 9], [[0, 0], [1, 0], [0, 2], [5, 5]])
    pose_truth_map = np.array([3.0, -1.0, 0.7])
    in_map = se2.transform(se2.inverse(pose_truth_map), [[0.3, 0.0], [1.0, 0.4], [7.0, 7.0]])
    estimate = with_hits(Landmarks.at([1, 2, 3], in_map, sigma_m=0.1), [10, 50, 9])
    errors = evaluate_landmarks(estimate, truth, pose_truth_map)
    np.testing.assert_array_equal(errors.landmark_id, [1, 2, 3])
    np.testing.assert_allclose(errors.error_m[:2], [0.3, 0.4])
    assert errors.rmse_m == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert errors.max_m == pytest.approx(0.4)
    assert errors.unmapped == 1
    np.testing.assert_allclose(errors.nees[:2], [9.0, 16.0])


def test_nees_turns_the_covariance_with_the_map():
    truth = Landmarks.at([1, 2], [[0.0, 0.0], [4.0, 0.0]])
    turn = np.array([0.0, 0.0, np.pi / 2])
    estimate = Landmarks.at([1, 2], se2.transform(se2.inverse(turn), [[0.0, 0.2], [4.0, 0.2]]), sigma_m=[0.1, 0.1])
    covariance = np.zeros((2, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = 0.04, 0.0001  # long along the map's x, which is the truth's y
    estimate = with_hits(dataclasses.replace(estimate, covariance_m2=covariance), [99, 99])
    np.testing.assert_allclose(evaluate_landmarks(estimate, truth, turn).nees, 1.0)


def test_own_alignment_removes_a_turn_of_the_map_and_never_helps_less():
    rng = np.random.default_rng(4)
    truth = Landmarks.at(np.arange(12), rng.uniform(-5, 5, (12, 2)))
    noisy = se2.transform([1.0, 2.0, 0.3], truth.position_m + rng.normal(0, 0.05, (12, 2)))
    estimate = with_hits(Landmarks.at(np.arange(12), noisy), np.full(12, 20))
    own = evaluate_landmarks(estimate, truth, None)
    given = evaluate_landmarks(estimate, truth, se2.inverse([1.0, 2.0, 0.3]))
    assert own.rmse_m <= given.rmse_m
    assert own.rmse_m == pytest.approx(0.05 * np.sqrt(2), rel=0.35)
    assert evaluate_landmarks(estimate, Landmarks.at([77], [[0, 0]]), None) is None
    assert evaluate_landmarks(with_hits(estimate, np.zeros(12, int)), truth, None) is None


def test_summary_has_every_key_and_is_json(run):
    summary = metrics_dict(compare_with_truth(*run))
    assert summary.keys() >= STABLE_KEYS
    assert all(summary[key] is not None for key in STABLE_KEYS)
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["pose_rmse_m"] < 0.1 < summary["dead_reckoning_rmse_m"]


def test_summary_without_truth_keeps_the_keys_and_says_null(run):
    recording, result = run
    full = metrics_dict(compare_with_truth(recording, result))
    blind = metrics_dict(compare_with_truth(dataclasses.replace(recording, truth=None, true_landmarks=None), result))
    assert blind.keys() == full.keys()
    assert blind["alignment"].keys() == full["alignment"].keys()
    for key in STABLE_KEYS - {"alignment", "nis_mean", "nis_in_band_share"}:
        assert blind[key] is None, key
    assert blind["nis_mean"] == full["nis_mean"]

    landmarks_only = metrics_dict(compare_with_truth(dataclasses.replace(recording, truth=None), result))
    assert landmarks_only["landmark_rmse_m"] is None
    assert landmarks_only["landmark_rmse_own_alignment_m"] == full["landmark_rmse_own_alignment_m"]


def test_summary_of_a_run_without_innovations(run):
    recording, result = run
    empty = np.zeros(0)
    none = Innovations(empty, empty.astype(int), empty.astype(int), empty, empty)
    summary = metrics_dict(compare_with_truth(recording, dataclasses.replace(result, innovations=none)))
    assert summary["nis_mean"] is None
    assert summary["nis_in_band_share"] is None
    json.dumps(summary, allow_nan=False)


def test_errors_in_view_are_those_near_a_sighting(run):
    recording, result = run
    blind = np.isin(recording.detections.frame, np.arange(200, 900))  # nothing seen for 700 frames
    detections = rows_of(recording.detections, ~blind)
    recording = dataclasses.replace(recording, detections=detections)
    evaluation = compare_with_truth(recording, result)
    poses = evaluation.poses
    sightings = [recording.frames.stamp_s[row] for row in detections.frame]
    near = [min(abs(stamp - seen) for seen in sightings) <= 1.0 for stamp in poses.stamp_s]
    assert 0 < sum(near) < len(near)
    np.testing.assert_array_equal(in_view(recording, poses.stamp_s), near)
    metrics = metrics_dict(evaluation)
    heading = [error for error, seen in zip(poses.heading_error_rad, near, strict=True) if seen]
    assert metrics["heading_rmse_in_view_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(np.square(heading)))))
    assert metrics["in_view_share"] == pytest.approx(sum(near) / len(near))
