"""Trajectory and map against the simulator's truth: as good as they say."""

from __future__ import annotations

import numpy as np
import pytest
from judged import AS_READ, SEEDS, consistent, judged, true_pose_at
from scipy import stats

from evermap.geometry import se2


def test_trajectory_and_map_are_as_good_as_they_say():
    runs = [judged(seed) for seed in SEEDS]
    consistent(runs)
    for run in runs:
        assert run.pose_nees.max() < 35.0
        assert run.landmark_nees[run.seen_well].max() < 25.0
        assert run.result.trajectory.frame == run.result.landmarks.frame == "first_pose"


def test_trajectory_and_map_in_a_prior_map_are_as_good_as_they_say():
    runs = [judged(seed, with_map=True) for seed in SEEDS]
    consistent(runs)
    for run in runs:
        assert run.result.trajectory.frame == run.result.landmarks.frame == run.result.online.frame == "prior_map"
        # no alignment: these are coordinates of the map
        assert np.sqrt((run.pose_error[:, :2] ** 2).sum(axis=1).mean()) < 0.05
        assert np.sqrt((run.pose_error[:, 2] ** 2).mean()) < 0.02


@pytest.mark.slow
def test_many_runs_are_as_good_as_they_say():
    consistent([judged(seed) for seed in range(16)])
    # the simulated robot drives straight, which a map does not tell: its heading is known where that is stated
    straight = "sensor.sigma_askew_rad=0.001"
    consistent([judged(seed, straight, with_map=True) for seed in range(16)])


def test_wrong_identities_are_found():
    runs = [judged(seed, AS_READ, faults=0.05) for seed in SEEDS]
    wrong = np.concatenate([run.wrong[run.result.innovations.detection] for run in runs])
    p_inlier = np.concatenate([run.result.innovations.p_inlier for run in runs])
    # a landmark that nobody ever saw rightly cannot be told from one that is there
    assert wrong.sum() > 15
    assert np.mean(p_inlier[wrong] < 0.5) > 0.8
    assert np.mean(p_inlier[~wrong] > 0.5) > 0.98


@pytest.mark.parametrize("seeds", [(0,), pytest.param((0, 2), marks=pytest.mark.slow)])
def test_wrong_identities_hurt_only_those_who_believe_everything(seeds):
    robust = np.array([judged(seed, AS_READ).landmark_rmse() for seed in seeds])
    credulous = np.array([judged(seed, AS_READ, "slam.robust=false").landmark_rmse() for seed in seeds])
    without = np.array([judged(seed, faults=0.0).landmark_rmse() for seed in seeds])
    assert credulous.sum() > 2 * robust.sum()
    assert robust.sum() < 1.5 * without.sum()


def test_innovations_are_nearly_chi_square():
    """After the first stock-taking of noise; too much noise is allowed for a while, too little is not."""
    runs = [judged(seed, faults=0.0) for seed in SEEDS]
    nis = np.concatenate([run.result.innovations.nis[run.result.innovations.stamp_s > stamp] for run in runs
                          for stamp in [run.result.trajectory.stamp_s[0] + 15.0]])  # fmt: skip
    assert 1.3 < nis.mean() < 2.2
    assert np.mean(nis > stats.chi2(2).ppf(0.99)) < 0.02


def test_online_poses_are_causal_and_end_where_the_smoother_ends():
    run = judged(1, "slam.online=true")
    online = run.result.online
    assert len(online) == len(run.result.step_s)
    assert np.isfinite(online.pose_world_robot).all()
    last = run.result.trajectory.pose_world_robot[-1]
    assert np.linalg.norm(online.pose_world_robot[-1, :2] - last[:2]) < 0.3
    assert np.linalg.eigvalsh(online.covariance[1:]).min() > 0.0


def test_dead_reckoning_starts_with_the_trajectory_and_is_worse():
    runs = [judged(seed, with_map=True) for seed in SEEDS]
    for run in runs:
        start = run.result.dead_reckoning.pose_world_robot[0] - run.result.trajectory.pose_world_robot[0]
        assert se2.wrap(start[2]) == pytest.approx(0.0, abs=1e-9)
        assert start[:2] == pytest.approx(0.0, abs=1e-9)
        true = true_pose_at(run.recording, run.result.trajectory.stamp_s)
        away = np.linalg.norm(run.result.dead_reckoning.pose_world_robot[:, :2] - true[:, :2], axis=1)
        assert away[-1] > 5 * np.linalg.norm(run.pose_error[:, :2], axis=1)[-1]


def test_trajectory_has_every_frame_and_no_long_step():
    run = judged(2)
    stamps = run.result.trajectory.stamp_s
    assert np.diff(stamps).max() < 0.1 + 1e-6
    assert np.isin(run.recording.frames.stamp_s, stamps).all()
    assert np.linalg.eigvalsh(run.result.trajectory.covariance).min() > 0.0


def test_misses_are_expected_and_not_detected():
    run = judged(0, AS_READ)
    misses, detections = run.result.misses, run.recording.detections
    hits = set(zip(detections.frame.tolist(), detections.landmark_id.tolist(), strict=True))
    assert len(misses) > 50
    assert not hits & set(zip(misses.frame.tolist(), misses.landmark_id.tolist(), strict=True))
    counted = [int((misses.landmark_id == identity).sum()) for identity in run.result.landmarks.landmark_id]
    assert run.result.landmarks.n_misses.tolist() == counted
    known = [int((detections.landmark_id == identity).sum()) for identity in run.result.landmarks.landmark_id]
    assert run.result.landmarks.n_hits.tolist() == known
