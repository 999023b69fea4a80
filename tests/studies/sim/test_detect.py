"""Detections against the measurement model that the configuration states, computed here anew."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation, Slerp

from evermap.types import UNKNOWN
from evermap_studies.sim import BuildingConfig, SimulatedSensor, simulate_building
from evermap_studies.sim.detect import sticky_uniform

CLEAN = SimulatedSensor(stickiness=0.0, p_wrong_identity=0.0, p_false=0.0, p_detect_near=0.95, p_detect_far=0.6)
CONFIG = BuildingConfig(days=2, patrol_s=165.0, sensor=CLEAN)


def crosses(a, b, c, d) -> bool:
    """Whether the segments a-b and c-d cross: each has the other's ends on different sides."""

    def side(p, q, r) -> float:
        return (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])

    return side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0


def sensor_poses(recording):
    """(F,) complex positions and headings of the sensor at the frames, interpolated by scipy."""
    truth, mount = recording.truth, recording.sensor.mount_robot_sensor
    pose, at = truth.pose_world_robot, recording.frames.stamp_s
    turns = Slerp(truth.stamp_s, Rotation.from_euler("z", pose[:, 2:]))(at).as_euler("xyz")[:, 2]
    place = np.interp(at, truth.stamp_s, pose[:, 0]) + 1j * np.interp(at, truth.stamp_s, pose[:, 1])
    return place + np.exp(1j * turns) * complex(*mount[:2]), turns + mount[2]


def true_measurements(recording, landmark_id):
    """True range and bearing (F, n) of the landmarks from the sensor at all frames."""
    place, heading = sensor_poses(recording)
    rows = np.searchsorted(recording.true_landmarks.landmark_id, landmark_id)
    position = recording.true_landmarks.position_m[rows] @ np.array([1.0, 1.0j])
    away = (position[None] - place[:, None]) * np.exp(-1j * heading[:, None])
    return np.abs(away), np.angle(away)


def residuals(recording, sensor):
    """Normalised range and bearing residuals of all detections, from the law as it is written in the docs."""
    d = recording.detections
    ranges, bearings = true_measurements(recording, recording.true_landmarks.landmark_id)
    column = np.searchsorted(recording.true_landmarks.landmark_id, d.landmark_id)
    r, b = ranges[d.frame, column], bearings[d.frame, column]
    law = sensor.range_bias_m + r * (1 + sensor.range_slope + sensor.range_bearing * b + sensor.range_bearing2 * b**2)
    turn = np.angle(np.exp(1j * (d.bearing_rad - b - sensor.bearing_bias_rad)))
    return (d.range_m - law) / sensor.sigma_range_m, turn / sensor.sigma_bearing_rad


@pytest.mark.parametrize(
    "sensor",
    [
        CLEAN,
        replace(CLEAN, range_bias_m=0.1, range_slope=-0.05, range_bearing=0.02, range_bearing2=-0.3,
                bearing_bias_rad=-0.05, sigma_range_m=0.1, sigma_bearing_rad=0.03,
                mount_robot_sensor=(0.2, -0.1, 1.0)),
    ],
)  # fmt: skip
def test_residuals_are_white_with_the_configured_sigma(sensor):
    simulation = simulate_building(replace(CONFIG, sensor=sensor), 11)
    for recording in simulation.sessions:
        parts = residuals(recording, sensor)
        count = len(parts[0])
        assert count > 500
        for part in parts:
            assert 0.001 < stats.chi2(count).cdf(np.sum(part**2)) < 0.999
            assert stats.kstest(part, "norm").pvalue > 0.001
            assert abs(np.corrcoef(part[1:], part[:-1])[0, 1]) < 4 / math.sqrt(count)
        assert abs(np.corrcoef(*parts)[0, 1]) < 4 / math.sqrt(count)


def test_hits_come_with_the_stated_probability_and_only_in_view():
    """Brute force over every frame and landmark: a hit needs range, field of view and no wall in between."""
    simulation = simulate_building(replace(CONFIG, days=1), 2)
    recording, walls = simulation.sessions[0], simulation.plan.walls_m.tolist()
    ids = recording.true_landmarks.landmark_id
    ranges, bearings = true_measurements(recording, ids)
    place, _ = sensor_poses(recording)
    hit = np.zeros(ranges.shape, dtype=bool)
    hit[recording.detections.frame, np.searchsorted(ids, recording.detections.landmark_id)] = True
    probability = np.zeros(ranges.shape)
    for frame, column in zip(*np.nonzero(ranges < 7.0), strict=True):
        r, b = ranges[frame, column], bearings[frame, column]
        inside = CLEAN.range_min_m <= r <= CLEAN.range_max_m and abs(b) <= CLEAN.field_of_view_rad / 2
        if inside:
            a, c = (place[frame].real, place[frame].imag), recording.true_landmarks.position_m[column]
            if not any(crosses(a, c, *wall) for wall in walls):
                probability[frame, column] = 0.95 - 0.35 * (r / CLEAN.range_max_m) ** 2
    assert not hit[probability == 0.0].any()
    p = probability[probability > 0.0]
    for low, high in ((0.0, 2.0), (2.0, 4.0), (4.0, 6.5)):
        band = (ranges >= low) & (ranges < high) & (probability > 0.0)
        p = probability[band]
        assert abs(hit[band].sum() - p.sum()) < 4 * math.sqrt(np.sum(p * (1 - p)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_every_landmark_is_seen_on_a_full_lap(seed):
    simulation = simulate_building(replace(BuildingConfig(), patrol_s=170.0), seed)
    for recording in simulation.sessions:
        hits = np.bincount(recording.detections.landmark_id, minlength=simulation.n_landmarks)
        assert hits[recording.true_landmarks.landmark_id].min() >= 5


def test_frames_are_complete_and_regular():
    recording = simulate_building(CONFIG, 0).sessions[0]
    assert recording.frames.complete
    np.testing.assert_allclose(np.diff(recording.frames.stamp_s), 0.2, atol=1e-6)
    assert len(recording.frames) == pytest.approx(165.0 * 5.0, abs=1)
    assert recording.odometry.stamp_s[0] <= recording.frames.stamp_s[0]
    assert recording.frames.stamp_s[-1] <= recording.odometry.stamp_s[-1]
    blind = replace(CONFIG, days=1, sensor=replace(CLEAN, p_detect_near=0.0, p_detect_far=0.0))
    recording = simulate_building(blind, 0).sessions[0]
    assert len(recording.detections) == 0
    assert len(recording.frames) == pytest.approx(165.0 * 5.0, abs=1)


def test_faults_have_the_configured_rates():
    sensor = replace(CLEAN, p_wrong_identity=0.05, p_no_identity=0.1, p_false=0.2)
    simulation = simulate_building(replace(CONFIG, sensor=sensor), 4)
    for recording, truth in zip(simulation.sessions, simulation.truths, strict=True):
        d, true_id = recording.detections, truth.detection_landmark_id
        assert len(true_id) == len(d)
        assert np.all(np.diff(d.frame) >= 0)
        real = true_id != UNKNOWN
        named = real & (d.landmark_id != UNKNOWN)
        assert stats.binomtest(int((~real).sum()), len(recording.frames), 0.2).pvalue > 1e-3
        assert stats.binomtest(int((real & ~named).sum()), int(real.sum()), 0.1).pvalue > 1e-3
        assert stats.binomtest(int((d.landmark_id != true_id)[named].sum()), int(named.sum()), 0.05).pvalue > 1e-3
        class_of = np.array([item.class_id for item in simulation.objects for _ in item.landmark_ids])
        known = d.landmark_id != UNKNOWN
        np.testing.assert_array_equal(d.class_id[known], class_of[d.landmark_id[known]])
        assert np.all(d.class_id[~known] == UNKNOWN)
        assert set(true_id[real]) <= set(recording.true_landmarks.landmark_id)


@pytest.mark.parametrize("stickiness", [0.0, 0.6])
def test_sticky_draws_stay_uniform_and_correlate_as_stated(stickiness):
    u = sticky_uniform(np.random.default_rng(5), 2000, 50, stickiness)
    assert stats.kstest(u[:, 0], "uniform").pvalue > 0.01
    assert stats.kstest(u[:, -1], "uniform").pvalue > 0.01
    same = (u[:, 1:] == u[:, :-1]).mean()
    assert same == pytest.approx(stickiness, abs=0.01)
    for lag in (1, 2, 3):
        assert np.corrcoef(u[:, 10], u[:, 10 + lag])[0, 1] == pytest.approx(stickiness**lag, abs=0.08)
