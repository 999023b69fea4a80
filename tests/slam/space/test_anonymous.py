"""Landmarks in space without identity, against those that made the measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identity_scores import identity_scores

from evermap import run_slam
from evermap.config import Config
from evermap.errors import ConfigError, DataError
from evermap.slam.association.in_space import identified_in_space
from evermap.types import UNKNOWN, SpatialRecording

from .corridors import tagged_corridor
from .halls import hall
from .rooms import Room

SLAM = Config().slam
NAMELESS = Config(slam={"unknown_ids": True})


def scored(recording: SpatialRecording, *, purity: float, completeness: float) -> SpatialRecording:
    """The recording with ids by geometry, as right as stated, and with as many landmarks as there are."""
    found = identified_in_space(recording, SLAM)
    real = recording.detections.landmark_id != UNKNOWN
    scores = identity_scores(found.detections.landmark_id[real], recording.detections.landmark_id[real])
    assert scores.purity >= purity
    assert scores.completeness >= completeness
    assert scores.n_landmarks == scores.n_identities
    return found


@pytest.mark.parametrize("drift", [0.01, 0.1])
def test_points_of_a_hall_are_told_apart_and_met_again(drift):
    recording = hall(1, n_points=40, n_frames=400, drift=drift)
    found = scored(recording, purity=0.995, completeness=0.99)
    false = recording.detections.landmark_id == UNKNOWN
    assert np.mean(found.detections.landmark_id[false] == UNKNOWN) > 0.8


@pytest.mark.slow
def test_the_loop_is_closed_behind_a_drift_of_metres():
    """Odometry alone has the landmarks of the second round two spacings off."""
    recording = hall(2, n_points=60, n_frames=450, step_s=0.6, drift=0.1)
    scored(recording, purity=0.99, completeness=0.97)


def test_tags_are_told_apart_and_the_estimate_is_as_good():
    world = tagged_corridor(0, n_tags=16, drift=0.05)
    scored(world.recording, purity=1.0, completeness=1.0)
    off = []
    for config in (NAMELESS, Config()):
        at = run_slam(world.recording, config).trajectory.pose_world_robot[:, :3]
        off.append(float(np.linalg.norm(np.ptp(at, axis=0) - np.ptp(world.true_pose[:, :3], axis=0))))
    assert off[0] < 1.15 * off[1] + 1e-3


def test_objects_that_look_the_same_however_they_are_turned():
    scored(Room.of(1).walk(1, drift=0.05), purity=1.0, completeness=1.0)


def test_what_jumps_is_followed():
    """Odometry that is a quarter of a metre off at once, as a visual one: the tags in view are the same."""
    recording = tagged_corridor(3, n_tags=24).recording
    assert recording.odometry is not None
    pose = recording.odometry.pose_world_robot.copy()
    pose[100:, :3] += (0.2, -0.1, 0.15)
    jumped = replace(recording, odometry=replace(recording.odometry, pose_world_robot=pose))
    scored(jumped, purity=1.0, completeness=1.0)


def test_landmarks_of_two_classes_at_one_place_stay_two():
    recording = tagged_corridor(1, n_tags=8).recording
    seen = recording.detections
    kind = np.arange(len(seen)) % 2
    doubled = replace(seen, class_id=kind, landmark_id=2 * seen.landmark_id + kind)
    scored(replace(recording, detections=doubled, class_names=("tag", "board")), purity=1.0, completeness=1.0)


def test_identities_of_the_recording_are_not_looked_at():
    recording = hall(3, n_points=20, n_frames=150)
    hidden = replace(recording.detections, landmark_id=np.full(len(recording.detections), UNKNOWN))
    one, other = (identified_in_space(each, SLAM) for each in (recording, replace(recording, detections=hidden)))
    np.testing.assert_array_equal(one.detections.landmark_id, other.detections.landmark_id)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_points_of_which_some_have_names(share):
    recording = hall(1, n_points=40, n_frames=400, drift=0.1)
    true = recording.detections.landmark_id
    named = np.isin(true, np.random.default_rng(0).permutation(40)[: int(40 * share)])
    given = np.where(named, 100 + true, UNKNOWN)
    some = replace(recording, detections=replace(recording.detections, landmark_id=given))
    found = identified_in_space(some, SLAM, keep_ids=True).detections.landmark_id
    np.testing.assert_array_equal(found[named], given[named])
    assert not np.isin(found[~named], given[named]).any()
    real = true != UNKNOWN
    scores = identity_scores(found[real], true[real])
    assert scores.purity > 0.995
    assert scores.completeness > 0.98
    assert scores.n_landmarks == scores.n_identities


def test_tags_that_are_not_always_read():
    recording = tagged_corridor(0, n_tags=16, drift=0.05).recording
    true = recording.detections.landmark_id
    read = np.where(np.random.default_rng(0).random(len(true)) < 0.5, true, UNKNOWN)
    some = replace(recording, detections=replace(recording.detections, landmark_id=read))
    found = identified_in_space(some, SLAM, keep_ids=True).detections.landmark_id
    assert np.mean(found == true) > 0.99


def test_what_it_cannot_do_is_refused():
    recording = tagged_corridor(0, n_frames=40, odometry=False).recording
    with pytest.raises(DataError, match="need odometry"):
        identified_in_space(recording, SLAM)
    with pytest.raises(ConfigError, match="a fixed map"):
        run_slam(tagged_corridor(0, n_frames=40).recording, NAMELESS, prior_map=recording.true_landmarks)
