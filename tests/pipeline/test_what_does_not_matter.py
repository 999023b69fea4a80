"""The same result for another run, other names, another clock and without truth, to the last byte where it can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from judged import assert_same, judged, recording_of
from recordings import with_ids

from evermap.pipeline import run_slam


def test_the_same_recording_gives_the_same_bytes():
    assert_same(run_slam(recording_of(0)), judged(0).result)


def test_names_do_not_matter():
    """Renaming the landmarks renames the map."""
    recording = recording_of(2)
    rename = np.random.default_rng(0).permutation(500) + 1000
    result = run_slam(with_ids(recording, lambda ids: rename[ids]))
    before = judged(2).result
    new_id = rename[before.landmarks.landmark_id]
    order = np.argsort(new_id)
    assert result.landmarks.landmark_id.tolist() == new_id[order].tolist()
    assert result.landmarks.position_m == pytest.approx(before.landmarks.position_m[order], abs=2e-3)
    assert result.landmarks.n_hits.tolist() == before.landmarks.n_hits[order].tolist()
    assert result.landmarks.n_misses.tolist() == before.landmarks.n_misses[order].tolist()
    assert result.trajectory.pose_world_robot == pytest.approx(before.trajectory.pose_world_robot, abs=2e-3)


def test_the_clocks_zero_does_not_matter():
    recording, shift = recording_of(1), -1.7e9
    odometry, frames = recording.odometry, recording.frames
    result = run_slam(
        replace(
            recording,
            odometry=replace(odometry, stamp_s=odometry.stamp_s + shift),
            frames=replace(frames, stamp_s=frames.stamp_s + shift),
        )
    )
    before = judged(1).result
    assert result.trajectory.stamp_s == pytest.approx(before.trajectory.stamp_s + shift, abs=1e-5)
    assert result.trajectory.pose_world_robot == pytest.approx(before.trajectory.pose_world_robot, abs=1e-3)
    assert result.landmarks.position_m == pytest.approx(before.landmarks.position_m, abs=1e-3)
    assert result.landmarks.first_seen_s == pytest.approx(before.landmarks.first_seen_s + shift, abs=1e-5)


def test_truth_is_not_looked_at():
    recording = recording_of(0)
    blind = replace(recording, truth=None, true_landmarks=None)
    assert_same(run_slam(blind), judged(0).result)
