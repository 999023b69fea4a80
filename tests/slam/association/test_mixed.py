"""Landmarks of which some have a name: what is given to which, against those that made the measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identity_scores import identity_scores
from problems import make_world
from recordings import building

from evermap import run_slam
from evermap.config import Config, SlamConfig
from evermap.maps.sessions.nameless import number_in
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.association import with_identities
from evermap.slam.association.assignment import NOBODY, Assignment, alike, names_of
from evermap.slam.association.features import Traits
from evermap.slam.association.identify import numbered
from evermap.slam.association.merging import _without_contradictions
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.problem import Estimate
from evermap.types import UNKNOWN, IntArray, Landmarks, Recording
from evermap_studies.sim.park import ParkConfig, simulate_park

PRIOR = CalibrationPrior.from_settings(calibrated=True)
MIXED = Config(slam={"unknown_ids": "empty"})


def with_some_named(recording: Recording, share: float, seed: int = 0) -> Recording:
    """The recording with the ids of a share of its landmarks, and none for the others."""
    given = recording.detections
    ids = np.unique(given.landmark_id[given.landmark_id != UNKNOWN])
    kept = ids[np.random.default_rng(seed).permutation(len(ids)) < share * len(ids)]
    named = np.where(np.isin(given.landmark_id, kept), given.landmark_id, UNKNOWN)
    return replace(recording, detections=replace(given, landmark_id=named))


def check_names(found: IntArray, given: IntArray, true: IntArray) -> None:
    """Names are kept, no new number is a name, and nobody else gets one."""
    named = given != UNKNOWN
    np.testing.assert_array_equal(found[named], given[named])
    with_a_name = ~named & np.isin(found, given[named])
    assert np.mean(found[with_a_name] == true[with_a_name]) > 0.95 if with_a_name.any() else True


def test_unlike_names_are_never_one() -> None:
    label = np.array([[UNKNOWN, 3], [UNKNOWN, 4], [UNKNOWN, UNKNOWN], [2, UNKNOWN], [1, 3]])
    assert alike(label[:, None], label[None]).tolist() == [
        [True, False, True, True, True],
        [False, True, True, True, False],
        [True] * 5,
        [True, True, True, True, False],
        [True, False, True, False, True],
    ]
    assert _without_contradictions([(2, 0), (2, 1), (3, 2), (4, 3)], label) == [(2, 0), (3, 2)]


def test_a_name_is_that_of_the_landmark_that_most_say_it_of() -> None:
    name = np.array([7, 7, 7, 7, UNKNOWN, 8, 7, 8, 9])
    row = np.array([0, 0, 1, 1, 1, 1, 1, 2, NOBODY])
    assert names_of(name, row, 4).tolist() == [UNKNOWN, 7, 8, UNKNOWN]
    assert numbered(np.array([UNKNOWN, 7, UNKNOWN, 2]), np.array([1, 2, 7])).tolist() == [3, 7, 4, 2]


def test_visits_are_landmarks_of_their_own_but_for_names() -> None:
    made = make_world(0, n_poses=9, n_landmarks=2, prior=CalibrationPrior.from_settings(calibrated=False))
    seen = replace(
        made.problem,
        stamp_s=np.array([0.0, 1.0, 2.0, 30.0, 31.0, 60.0, 61.0, 90.0, 91.0]),
        pose_row=np.arange(9),
    )
    row, name = np.array([1, 1, NOBODY, 1, 1, 0, 0, 0, 1]), np.full(9, UNKNOWN)
    name[[3, 5]] = 4
    estimate = Estimate(made.truth.pose[:9], np.zeros((2, 2)), made.truth.states)
    visits = Assignment(seen, row, estimate, np.column_stack([np.full(9, UNKNOWN), name]), Traits.none(9)).in_visits()
    assert visits.tolist() == [0, 0, NOBODY, 1, 1, 1, 1, 2, 3]


@pytest.mark.parametrize("share", [0.2, pytest.param(0.5, marks=pytest.mark.slow)])
def test_half_of_a_building_has_names(share: float) -> None:
    recording = building(2).sessions[0]
    true, some = recording.detections.landmark_id, with_some_named(recording, share)
    found = with_identities(some, SlamConfig(unknown_ids="empty")).detections.landmark_id
    scores = identity_scores(found, true)
    assert scores.purity > 0.98
    assert scores.completeness > 0.95
    check_names(found, some.detections.landmark_id, true)


@pytest.mark.slow
def test_tags_that_are_not_always_read() -> None:
    """Of half of the detections of each landmark the id is missing: they are of the same landmarks."""
    recording = building(2).sessions[0]
    true, rng = recording.detections.landmark_id, np.random.default_rng(1)
    read = np.where(rng.random(len(true)) < 0.5, true, UNKNOWN)
    some = replace(recording, detections=replace(recording.detections, landmark_id=read))
    found = with_identities(some, SlamConfig(unknown_ids="empty")).detections.landmark_id
    met = (read == UNKNOWN) & (found != UNKNOWN)
    assert np.mean(found[met] == true[met]) > 0.98
    assert met.sum() > 0.95 * np.sum((read == UNKNOWN) & (true != UNKNOWN))


@pytest.mark.slow
def test_a_name_helps_a_robot_that_is_lost() -> None:
    """Odometry so bad that trees alone do not show where the loop closes; one tree in ten has a name."""
    config = ParkConfig(
        n_trees=60,
        n_cars=0,
        drive_m=1200.0,
        speed_scale=1.08,
        steering_bias_rad=0.006,
        steering_walk_rad=0.0015,
        speed_noise=0.08,
        steering_noise_rad=0.03,
    )
    off = np.zeros((2, 3))
    for seed in range(2):
        recording = simulate_park(config, seed=seed)
        assert recording.truth is not None
        for k, share in enumerate((0.0, 0.1, 1.0)):
            some = with_some_named(recording, share, seed=seed)
            estimated = run_slam(some, MIXED).trajectory
            off[seed, k] = evaluate_trajectory(estimated, recording.truth, rate_hz=2.0).rmse_m
    assert off[:, 0].min() > 5.0
    _, some_named, all_named = np.linalg.norm(off, axis=0)
    assert some_named < 1.3 * all_named


@pytest.mark.slow
def test_without_any_name_it_is_as_if_ids_were_ignored() -> None:
    recording = with_some_named(building(2).sessions[0], 0.0)
    one, other = (with_identities(recording, SlamConfig(unknown_ids=each)) for each in (True, "empty"))
    np.testing.assert_array_equal(one.detections.landmark_id, other.detections.landmark_id)


def test_names_say_where_in_a_map_it_is() -> None:
    recording = building(2).sessions[0]
    assert recording.true_landmarks is not None
    survey = Landmarks.at(recording.true_landmarks.landmark_id, recording.true_landmarks.position_m, sigma_m=0.02)
    true, some = recording.detections.landmark_id, with_some_named(recording, 0.2)
    found = number_in(some, survey, Config(slam={"unknown_ids": "empty"})).detections.landmark_id
    met = np.isin(found, survey.landmark_id)
    assert np.mean(found[met] == true[met]) > 0.98
    assert met.mean() > 0.8
