"""A map that was there before: wherever the robot starts in it, whatever it lacks, and one of another place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from judged import AS_READ, assert_same, judge, judged, recording_of, surveyed
from recordings import some_rows

from evermap.config import load_config
from evermap.geometry import se2
from evermap.io import read_planar, read_prior_map
from evermap.io.template import write_template
from evermap.pipeline import run_slam
from evermap.types import FloatArray, Landmarks


def moved_map(landmarks: Landmarks, pose: FloatArray) -> Landmarks:
    turn = se2.rotation(pose[2])
    return replace(
        landmarks,
        position_m=se2.transform(pose, landmarks.position_m),
        covariance_m2=turn @ landmarks.covariance_m2 @ turn.T,
    )


@pytest.mark.parametrize("pose", [(100.0, -300.0, 3.0), (-7.0, 2.0, -1.6)])
def test_the_start_may_be_anywhere_in_the_map(pose):
    """Moving the map moves the result with it, and nothing else."""
    here = judged(1, with_map=True)
    recording = here.recording
    there = run_slam(recording, prior_map=moved_map(surveyed(recording, 1), np.array(pose)))
    moved = se2.compose(pose, here.result.trajectory.pose_world_robot)
    gap = se2.between(moved, there.trajectory.pose_world_robot)
    assert np.abs(gap).max() < 2e-3
    turn = se2.rotation(pose[2])
    assert there.landmarks.covariance_m2 == pytest.approx(
        turn @ here.result.landmarks.covariance_m2 @ turn.T, rel=0.05, abs=1e-9
    )


def test_a_map_may_know_more_and_less_than_the_recording():
    recording = recording_of(1)
    true = recording.true_landmarks
    half = some_rows(true, slice(None, None, 2))
    strangers = Landmarks.at(
        np.append(half.landmark_id, [7000, 8000]), np.vstack([half.position_m, [[1e4, 0.0], [0.0, -1e4]]])
    )
    config = load_config(None, [AS_READ])
    run = judge(recording, judged(1).wrong, config, prior_map=half)
    with_strangers = run_slam(recording, config, prior_map=strangers)
    assert run.result.trajectory.frame == "prior_map"
    assert np.sqrt((run.pose_error[:, :2] ** 2).sum(axis=1).mean()) < 0.08
    assert np.isin(recording.detections.landmark_id, run.result.landmarks.landmark_id).all()
    assert_same(with_strangers, run.result)


def test_a_map_of_another_place_is_not_entered():
    recording = recording_of(2, 20.0)
    result = run_slam(recording, prior_map=Landmarks.at([7000, 8000, 9000], [[0.0, 0.0], [5.0, 0.0], [0.0, 5.0]]))
    assert result.trajectory.frame == "first_pose"
    assert any("prior map" in warning for warning in result.warnings)


@pytest.mark.slow
def test_a_small_map_is_enough_without_identities(tmp_path):
    """Six landmarks, one of them moved: the others have their identities."""
    folder = write_template(tmp_path / "template")
    recording, survey = read_planar(folder), read_prior_map(folder / "survey.csv")
    result = run_slam(recording, load_config(None, ["slam.unknown_ids=true"]), prior_map=survey)
    assert not any("cannot localise" in warning for warning in result.warnings)
    named = run_slam(recording, prior_map=survey)
    both, mine, theirs = np.intersect1d(result.landmarks.landmark_id, named.landmarks.landmark_id, return_indices=True)
    assert len(both) >= 5
    off = result.landmarks.position_m[mine] - named.landmarks.position_m[theirs]
    assert np.linalg.norm(off, axis=1).max() < 0.05
