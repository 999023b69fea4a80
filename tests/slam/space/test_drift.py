"""What a recording says of its noise before it is solved: drift of the odometry, and errors of detectors that last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.space.drift import drift_of
from evermap.slam.space.estimate import first_places
from evermap.slam.space.intake import SpatialIntake, prepare_space
from evermap.types import SpatialRecording, rows_of
from evermap_studies.causes.catalogue import catalogue
from evermap_studies.causes.drives import as_recording
from evermap_studies.causes.judge import make_case

from .rooms import Room


def lasting(recording: SpatialRecording, sigma_m: float, time_s: float) -> SpatialRecording:
    """The same with errors of each landmark that last so long (Ornstein and Uhlenbeck)."""
    random, seen = np.random.default_rng(1), recording.detections
    stamp_s = recording.frames.stamp_s
    error = np.zeros((len(stamp_s), int(seen.landmark_id.max()) + 1, 3))
    error[0] = random.normal(0.0, sigma_m, error[0].shape)
    for k, step_s in enumerate(np.diff(stamp_s)):
        rest = np.exp(-step_s / time_s)
        error[k + 1] = rest * error[k] + np.sqrt(1.0 - rest**2) * random.normal(0.0, sigma_m, error[0].shape)
    at = seen.position_sensor_m + error[seen.frame, seen.landmark_id]
    return replace(recording, detections=replace(seen, position_sensor_m=at))


def alike(intake: SpatialIntake, time_s: float) -> np.ndarray:
    """Return (M,) how many detections of the same landmark err like each, itself among them."""
    place, stamp_s = intake.problem.place, intake.problem.stamp_s[intake.problem.pose_row]
    return (np.exp(-np.abs(stamp_s[:, None] - stamp_s) / time_s) * (place[:, None] == place)).sum(axis=1)


def improvement(recording: SpatialRecording) -> float:
    """Error of the robot over that of the odometry alone."""
    found = compare_with_truth(recording, run_slam(recording), rate_hz=10.0)
    assert found.poses is not None
    assert found.dead_reckoning is not None
    return float(found.poses.rmse_m / found.dead_reckoning.rmse_m)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_drift_is_what_landmarks_share(seed: int) -> None:
    """It is not taken for errors of the detector, whose white noise lets the robot be located."""
    recording = Room.of(seed).walk(seed, drift=0.02)
    intake = prepare_space(recording, Config().slam.space)
    found = drift_of(intake.problem, intake.driven_pose)
    assert (found.share == 1.0).all()
    assert found.translation == pytest.approx(0.014, rel=0.4)  # half of the variance is the rotation's
    assert improvement(recording) < 0.25


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_errors_that_last_are_found_and_do_not_pull_a_good_odometry_away(seed: int) -> None:
    recording = lasting(Room.of(seed).walk(seed, drift=0.002), 0.06, 5.0)
    intake = prepare_space(recording, Config().slam.space)
    found = drift_of(intake.problem, intake.driven_pose)
    assert np.median(found.share * alike(intake, 5.0)) == pytest.approx(1.0, rel=0.25)
    assert found.translation is not None
    assert found.translation < 0.006
    assert improvement(recording) < 1.1


def test_an_odometry_whose_drift_does_not_show_is_not_held_for_exact() -> None:
    """At two frames a second hardly a tag is seen often enough: the drift that shows is the least there is."""
    world = next(one for one in catalogue() if one.name == "poses in a map: nothing wrong")
    given = make_case(replace(world, make=replace(world.make, frame_hz=2.0)), 1).given
    recording = as_recording(given)
    assert isinstance(recording, SpatialRecording)
    intake = prepare_space(recording, Config().slam.space)
    found = drift_of(intake.problem, intake.driven_pose)
    assert found.translation == Config().slam.space.steady_m
    assert (found.share == 1.0).all()
    result = run_slam(recording, prior_map=given.places)
    compared = compare_with_truth(recording, result, rate_hz=10.0)
    assert compared.poses is not None
    assert compared.dead_reckoning is not None
    assert compared.poses.rmse_m < 0.2 * compared.dead_reckoning.rmse_m  # .47 of it where it is held for exact
    assert np.median(compared.poses.nees) < 2.0 * compared.poses.dof


def test_an_odometry_that_is_exact_but_for_what_is_seen_stays_so() -> None:
    """Among the same few sightings: what is the more probable of the two."""
    recording = Room.of(0).walk(0, drift=0.0005, n_frames=160)
    intake = prepare_space(recording, Config().slam.space)
    assert drift_of(intake.problem, intake.driven_pose).translation == Config().slam.space.steady_m
    levels = {one.name: one.value for one in run_slam(recording).parameters}
    assert levels["sigma_odometry_m"] < 0.001


def test_a_lone_detection_is_no_newer_than_the_time_that_errors_last() -> None:
    recording = lasting(Room.of(0).walk(0, drift=0.002), 0.06, 20.0)
    seen = recording.detections
    mine = np.flatnonzero(seen.landmark_id == seen.landmark_id[0])
    stamp_s = recording.frames.stamp_s[seen.frame]
    lone = mine[len(mine) // 2]
    kept = (seen.landmark_id != seen.landmark_id[0]) | (np.abs(stamp_s - stamp_s[lone]) > 2.0)
    kept[lone] = True
    intake = prepare_space(replace(recording, detections=rows_of(seen, kept)), Config().slam.space)
    found = drift_of(intake.problem, intake.driven_pose)
    row = np.flatnonzero(intake.used == np.count_nonzero(kept[:lone]))[0]
    assert found.share[row] < 0.3


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_two_landmarks_of_a_map_are_enough_beside_an_odometry_that_hardly_drifts(seed: int) -> None:
    """By their positions alone everything may turn about the line between them."""
    room = Room.of(seed, ("mug",), 2)
    recording = lasting(room.walk(seed, drift=1e-4, n_frames=1000), 0.06, 20.0)
    found = compare_with_truth(recording, run_slam(recording, prior_map=room.map().as_prior(0.02)), rate_hz=10.0)
    assert found.poses is not None
    assert found.poses.rmse_m < 0.001  # after alignment


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_ranges_that_are_far_worse_than_directions_do_not_move_things(seed: int) -> None:
    """Sizes in an image tell ranges: here by 10 % each, and all 8 % too long. Things are where the directions meet."""
    recording = Room.of(seed).walk(seed, drift=0.002)
    seen = recording.detections
    wrong = 1.08 + 0.1 * np.random.default_rng(seed).normal(size=(len(seen), 1))
    recording = replace(recording, detections=replace(seen, position_sensor_m=wrong * seen.position_sensor_m))
    result = run_slam(recording)
    levels = {parameter.name: parameter.value for parameter in result.parameters}
    assert levels["direction_noise_factor"] == pytest.approx(1.0, abs=0.2)
    assert 8.0 < levels["range_noise_factor"] < 16.0  # of 2 cm, at 2 m
    found = compare_with_truth(recording, result, rate_hz=10.0)
    assert found.landmarks is not None
    assert found.landmarks.rmse_m < 0.06


def test_places_begin_where_most_of_their_detections_are() -> None:
    """Not where the first ones are, which may be wrong."""
    room = Room.of(3)
    recording = room.walk(3, drift=1e-4)
    seen = recording.detections
    early = seen.frame < np.median(seen.frame[seen.landmark_id == 0])
    at = seen.position_sensor_m.copy()
    at[early & (seen.landmark_id == 0)] += [0.0, 0.0, 2.0]
    wrong = np.flatnonzero(early & (seen.landmark_id == 0))[::2]
    at[wrong] = seen.position_sensor_m[wrong]
    moved = replace(recording, detections=replace(seen, position_sensor_m=at))
    intake = prepare_space(moved, Config().slam.space)
    first = first_places(intake.problem, intake.driven_pose).place
    away = np.linalg.norm(first[:, :3] - first[1, :3], axis=1)
    expected = np.linalg.norm(room.place - room.place[1], axis=1)
    assert away == pytest.approx(expected, abs=0.15)
