"""Recordings that are cut short, have holes, or say too little: estimated and admitted, or refused in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from judged import AS_READ, arrays_of, judge, judged, recording_of, surveyed
from recordings import building, with_detections, with_ids, without_odometry_between

from evermap.config import load_config
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.pipeline import run_slam
from evermap.types import UNKNOWN
from evermap_studies.sim import WarehouseConfig, simulate_warehouse


def test_an_interrupt_leaves_the_finished_part():
    recording = recording_of(0)
    seen = []

    def stop_after_100(done_s, all_s):
        seen.append((done_s, all_s))
        if len(seen) == 100:
            raise KeyboardInterrupt

    run = judge(recording, judged(0).wrong, load_config(None, [AS_READ, "slam.online=true"]), progress=stop_after_100)
    result = run.result
    assert result.interrupted
    assert any("interrupted" in warning for warning in result.warnings)
    assert np.all(np.diff([done for done, _ in seen]) > 0)
    used = np.unique(recording.detections.frame)
    last = recording.frames.stamp_s[used[99]]
    assert result.trajectory.stamp_s[-1] == pytest.approx(last, abs=1e-6)
    assert result.landmarks.last_seen_s.max() <= last
    assert run.pose_nees.max() < 35.0
    assert not judged(0).result.interrupted


def test_an_interrupt_before_anything_is_known_goes_through():
    def stop(done_s, all_s):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_slam(recording_of(0), progress=stop)


def test_without_known_identities_nothing_can_be_estimated():
    with pytest.raises(DataError, match="known identity"):
        run_slam(with_ids(recording_of(0), lambda ids: np.full_like(ids, UNKNOWN)))


def test_without_odometry_nothing_can_be_estimated():
    with pytest.raises(DataError, match="odometry"):
        run_slam(without_odometry_between(recording_of(0), -1.0, 1e9))


def test_two_frames_are_enough():
    recording = recording_of(0)
    frames = np.unique(recording.detections.frame)[20:22]
    result = run_slam(with_detections(recording, np.isin(recording.detections.frame, frames)))
    assert len(result.step_s) == 2
    for name, value in arrays_of(result):
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            assert np.isfinite(value).all(), name


def test_one_frame_is_not():
    recording = recording_of(0)
    with pytest.raises(DataError, match="1 frames"):
        run_slam(with_detections(recording, recording.detections.frame == recording.detections.frame[0]))


def test_a_landmark_seen_once_is_in_the_map_with_its_uncertainty():
    recording = recording_of(1, faults=0.0)
    identity = np.bincount(recording.detections.landmark_id).argmax()
    mine = np.flatnonzero(recording.detections.landmark_id == identity)
    keep = np.setdiff1d(np.arange(len(recording.detections)), mine[np.arange(len(mine)) != len(mine) // 2])
    run = judge(with_detections(recording, keep), np.zeros(0))
    row = int(np.flatnonzero(run.result.landmarks.landmark_id == identity)[0])
    assert run.result.landmarks.n_hits[row] == 1
    assert run.result.landmarks.first_seen_s[row] == run.result.landmarks.last_seen_s[row]
    assert run.landmark_nees[row] < 25.0
    sigma = np.sqrt(np.linalg.eigvalsh(run.result.landmarks.covariance_m2[row]))
    assert np.all((sigma > 0.01) & (sigma < 1.0))


def test_a_blind_and_deaf_stretch_of_20_s_is_survived_and_admitted():
    """No odometry and no detections for 20 s: nobody knows where the robot is, and the covariance says so."""
    recording = recording_of(3, faults=0.0)
    passed = recording.frames.stamp_s - recording.odometry.stamp_s[0]
    blind = (passed > 14.9) & (passed < 35.1)
    silent = without_odometry_between(with_detections(recording, ~blind[recording.detections.frame]), 15.0, 35.0)
    run = judge(silent, np.zeros(0), prior_map=surveyed(recording, 3))
    trajectory = run.result.trajectory
    assert np.isfinite(trajectory.pose_world_robot).all()
    size = np.sqrt(np.einsum("nii->ni", trajectory.covariance)[:, :2].sum(axis=1))
    at = trajectory.stamp_s - recording.odometry.stamp_s[0]
    middle, known = size[(at > 18) & (at < 32)], size[(at < 14) | (at > 36)]
    assert middle.min() > 5 * np.median(known)
    # grows away from both ends
    assert np.all(np.diff(size[(at > 17) & (at < 23)]) > 0)
    assert np.all(np.diff(size[(at > 27) & (at < 33)]) < 0)
    # and before and after it is the map that tells
    error = np.linalg.norm(run.pose_error[:, :2], axis=1)
    assert error[(at < 14) | (at > 36)].max() < 0.3
    assert np.all(error[(at > 16) & (at < 34)] < 4 * size[(at > 16) & (at < 34)])


def test_silent_odometry_alone_is_survived_and_admitted():
    recording = recording_of(0, faults=0.0)
    run = judge(without_odometry_between(recording, 10.0, 30.0), np.zeros(0))
    assert run.pose_nees.max() < 25.0


def test_a_robot_whose_odometry_fails_while_it_turns_is_not_lost_for_words():
    """With 30 s of silence the last poses hang on the first by little more than nothing; covariances stay ones."""
    recording = building(0, patrol_s=90.0, rate_hz=2.0).sessions[0]
    config = load_config(None, ["slam.online=true"])
    result = run_slam(without_odometry_between(recording, 30.0, 60.0), config)
    for covariance in (result.trajectory.covariance, result.online.covariance, result.landmarks.covariance_m2):
        assert np.linalg.eigvalsh(covariance)[:, 0].min() > 0.0
    passed = result.online.stamp_s - recording.odometry.stamp_s[0]
    size = np.sqrt(np.einsum("nii->ni", result.online.covariance)[:, :2].sum(axis=1))
    assert size[passed > 60.0].min() > size[passed < 30.0].max()


@pytest.mark.parametrize("pause_s", [1e3, 1e8])
def test_a_clock_that_was_set_forward_is_a_pause_and_costs_no_more_than_one(pause_s: float):
    """By minutes, or by years: the rest of the session is estimated, with as many poses, in as many places."""
    recording = building(0, patrol_s=60.0, rate_hz=2.0).sessions[0]
    middle = recording.odometry.stamp_s[0] + 30.0
    later = [np.where(t > middle, t + pause_s, t) for t in (recording.odometry.stamp_s, recording.frames.stamp_s)]
    paused = replace(
        recording,
        odometry=replace(recording.odometry, stamp_s=later[0]),
        frames=replace(recording.frames, stamp_s=later[1]),
    )
    result = run_slam(paused)
    for name, value in arrays_of(result):
        if isinstance(value, np.ndarray) and value.dtype == np.float64 and "nis" not in name:
            assert np.isfinite(value).all(), name
    assert len(result.trajectory) < 10 * 60.0 + 700
    assert result.trajectory.stamp_s[-1] == pytest.approx(
        run_slam(recording).trajectory.stamp_s[-1] + pause_s, abs=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_landmark_whose_first_sighting_was_misread_is_where_all_others_say(seed):
    """One identity in a hundred is wrong: many a landmark is named minutes before it comes into view."""
    warehouse = WarehouseConfig(
        n_landmarks=240,
        p_wrong_identity=0.01,
        range_bias_m=0.03,
        bearing_bias_rad=0.01,
        forward_scale=1.01,
        turn_scale=1.005,
    )
    recording = simulate_warehouse(warehouse, seed=seed)
    found = run_slam(replace(recording, truth=None)).landmarks
    truth = recording.true_landmarks.position_m[found.landmark_id]
    off_m = np.linalg.norm(se2.transform(rigid(found.position_m, truth), found.position_m) - truth, axis=1)
    assert off_m.max() < 0.5


@pytest.mark.slow
def test_ranges_in_millimetres_are_told_and_go_through():
    recording = judged(1).recording
    seen = recording.detections
    result = run_slam(replace(recording, detections=replace(seen, range_m=1000.0 * seen.range_m)))
    assert any("millimetres" in warning for warning in result.warnings)
