"""Identities found by geometry, against those that made the measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identity_scores import identity_scores
from problems import World, make_world
from recordings import building

from evermap.slam.association.assignment import NOBODY, Assignment
from evermap.slam.association.associator import Associator, fit_sighting_noise
from evermap.slam.association.identify import identified
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.noise import START
from evermap.slam.problem import Estimate
from evermap.types import UNKNOWN, Landmarks

KNOWN_SENSORS = CalibrationPrior.from_settings(calibrated=False, fix={})


def world(seed: int, **settings: float) -> World:
    return make_world(seed, n_poses=60, n_landmarks=8, prior=KNOWN_SENSORS, **settings)


def associated(world: World) -> Assignment:
    hidden = replace(world.problem, landmark_row=np.full_like(world.problem.landmark_row, -99))
    associator = Associator(hidden, world.noise)
    for _ in hidden.stamp_s:
        associator.step()
    return associator.finish()


@pytest.mark.parametrize("seed", range(5))
def test_a_small_world_is_sorted_out(seed: int) -> None:
    made = world(seed)
    row = associated(made).landmark_row
    scores = identity_scores(row, made.problem.landmark_row)
    assert (scores.n_landmarks, scores.n_identities) == (8, 8)
    assert scores.purity == 1.0
    assert np.mean(row == NOBODY) < 0.02


def test_a_detection_of_nothing_is_nobodys() -> None:
    made = world(3)
    reading = made.problem.reading.copy()
    reading[50, 0] += 2.5
    row = associated(replace(made, problem=replace(made.problem, reading=reading))).landmark_row
    assert row[50] == NOBODY
    assert identity_scores(np.delete(row, 50), np.delete(made.problem.landmark_row, 50)).purity == 1.0


def test_merging_and_forgetting_keep_the_detections_together() -> None:
    made = world(1)
    rows = made.problem.landmark_row
    split = rows.copy()
    split[(rows == 2) & (made.problem.pose_row > 30)] = 8
    landmark = np.vstack([made.truth.landmark, made.truth.landmark[2]])
    broken = Assignment(made.problem, split, Estimate(made.truth.pose, landmark, made.truth.states))
    np.testing.assert_array_equal(broken.merged([(8, 2)]).landmark_row, rows)
    less = broken.without(np.arange(9) == 0)
    assert less.n_landmarks == 8
    np.testing.assert_array_equal(less.landmark_row == NOBODY, rows == 0)
    np.testing.assert_array_equal(less.estimate.landmark[less.landmark_row[rows == 5]][0], landmark[5])


def test_noise_that_grows_with_range_is_found() -> None:
    made = make_world(2, n_poses=400, n_landmarks=8, noisy=0.0, prior=KNOWN_SENSORS, p_seen=1.0)
    rng = np.random.default_rng(0)
    reach = made.problem.reading[:, 0]
    reading = made.problem.reading + rng.normal(size=(len(reach), 2)) * np.column_stack(
        [np.hypot(0.01, 2e-4 * reach**2), np.full(len(reach), 0.005)]
    )
    truth = replace(made.truth, states=made.problem.prior.mean)
    noisy = replace(made.problem, reading=reading)
    found = fit_sighting_noise(noisy, truth, np.array([0.02, 0.01])).of_detections(noisy)
    np.testing.assert_allclose(found[:, 0], np.hypot(0.01, 2e-4 * reach**2), rtol=0.1)
    np.testing.assert_allclose(found[:, 1], 0.005, rtol=0.05)


@pytest.mark.slow
def test_a_building_without_ids_and_in_its_map() -> None:
    recording = building(2).sessions[0]
    found = identified(recording, CalibrationPrior.from_settings(calibrated=True, fix={}), START)
    scores = identity_scores(found.detections.landmark_id, recording.detections.landmark_id)
    assert scores.purity > 0.98
    assert scores.completeness > 0.9
    assert recording.true_landmarks is not None
    survey = Landmarks.at(recording.true_landmarks.landmark_id, recording.true_landmarks.position_m, sigma_m=0.02)
    inside = identified(
        recording, CalibrationPrior.from_settings(calibrated=True, fix={}), START, prior_map=survey
    ).detections.landmark_id
    met = np.isin(inside, survey.landmark_id)
    assert met.mean() > 0.5
    assert np.mean(inside[met] == recording.detections.landmark_id[met]) > 0.98
    assert np.all(inside[~met & (inside != UNKNOWN)] > 0)
