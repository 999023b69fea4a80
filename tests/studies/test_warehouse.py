"""The warehouse is what it says, and the objective of its factors is what gtsam says."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.types import Recording
from evermap.valid import check_type
from evermap_studies.peers import plain_gtsam
from evermap_studies.peers.factors import (
    Factors,
    PlainNoise,
    dead_reckoned_start,
    factors_of,
    integrated,
    near_start,
    objective,
    truth_of,
)
from evermap_studies.sim import WarehouseConfig, simulate_warehouse
from evermap_studies.sim.warehouse import pose_along, warehouse_landmarks

SMALL = WarehouseConfig(n_landmarks=30)
NOISE = PlainNoise(np.array([SMALL.sigma_range_m, SMALL.sigma_bearing_rad]), np.array(SMALL.odometry_sigma))


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate_warehouse(SMALL)


@pytest.fixture(scope="module")
def factors(recording: Recording) -> Factors:
    return factors_of(recording, NOISE)


@pytest.mark.parametrize("n_landmarks", [1, 7, 100, 400])
def test_aisles_hold_the_landmarks_and_are_all_driven_once(n_landmarks: int) -> None:
    config = WarehouseConfig(n_landmarks=n_landmarks)
    assert (config.aisles - 1) * config.per_aisle < n_landmarks <= config.aisles * config.per_aisle
    landmark = warehouse_landmarks(config)
    aisle = np.repeat(np.arange(config.aisles), config.per_aisle)[:n_landmarks]
    off = np.abs(landmark[:, 1] - aisle * config.aisle_m)
    assert ((off >= 1.5) & (off <= 2.5)).all()
    pose = pose_along(config, np.linspace(0.0, config.drive_m, 20 * n_landmarks))
    in_aisle = (pose[:, 0] > 0.0) & (pose[:, 0] < config.aisle_length_m)
    assert set(np.round(pose[in_aisle, 1] / config.aisle_m, 6)) >= set(range(config.aisles))
    np.testing.assert_allclose(pose[-1, 0] % config.aisle_length_m, 0.0, atol=1e-9)


def test_the_drive_is_smooth_and_as_fast_as_configured() -> None:
    config = WarehouseConfig(n_landmarks=60)
    driven_m = np.arange(0.0, config.drive_m, 0.01)
    step = se2.log(se2.between(*(pose_along(config, driven_m)[rows] for rows in (slice(-1), slice(1, None)))))
    np.testing.assert_allclose(step[:, 0], 0.01, rtol=1e-3)
    np.testing.assert_allclose(step[:, 1], 0.0, atol=3e-5)
    assert np.abs(step[:, 2]).max() == pytest.approx(0.01 / 3.0, rel=1e-6)  # half circles of 3 m


def test_a_recording_of_the_warehouse_is_valid_repeatable_and_seeded(recording: Recording) -> None:
    check_type(recording)
    again, other = simulate_warehouse(SMALL), simulate_warehouse(SMALL, seed=1)
    np.testing.assert_array_equal(again.detections.range_m, recording.detections.range_m)
    assert len(other.detections) != len(recording.detections)
    np.testing.assert_allclose(np.diff(recording.frames.stamp_s), 0.1, rtol=1e-9)
    assert recording.truth is not None
    np.testing.assert_array_equal(recording.truth.pose_world_robot[0], 0.0)


def test_readings_are_those_of_what_is_in_view(recording: Recording) -> None:
    """Against every pair of frame and landmark: no pair is missed, readings are as noisy as configured."""
    assert recording.truth is not None
    assert recording.true_landmarks is not None
    pose, landmark = recording.truth.pose_world_robot, recording.true_landmarks.position_m
    local = se2.transform(se2.inverse(pose)[:, None], landmark[None])
    range_m, bearing_rad = np.hypot(local[..., 0], local[..., 1]), np.arctan2(local[..., 1], local[..., 0])
    in_view = (range_m <= SMALL.range_m) & (np.abs(bearing_rad) < SMALL.half_view_rad)
    detections = recording.detections
    pair = (detections.frame, detections.landmark_id)
    assert in_view[pair].all()
    assert (np.diff(detections.frame) >= 0).all()
    assert len(detections) / in_view.sum() == pytest.approx(SMALL.p_detect, abs=0.03)
    assert np.std(detections.range_m - range_m[pair]) == pytest.approx(SMALL.sigma_range_m, rel=0.1)
    assert np.std(detections.bearing_rad - bearing_rad[pair]) == pytest.approx(SMALL.sigma_bearing_rad, rel=0.1)


def test_density_and_sightings_stay_the_same_while_the_warehouse_grows() -> None:
    """As many sightings of a landmark, and as much drive for it, give or take what the edges and turns change."""
    small, large = (simulate_warehouse(n) for n in (400, 1600))
    assert len(large.detections) / len(small.detections) == pytest.approx(4.0, rel=0.1)
    assert len(large.frames) / len(small.frames) == pytest.approx(4.0, rel=0.1)


def test_more_aisles_leave_the_first_ones_as_they_are() -> None:
    """A session in a part of a warehouse is the same, however large the rest is."""
    small = WarehouseConfig(n_landmarks=60, landmarks_per_aisle=10, aisles_driven=3)
    large = replace(small, n_landmarks=600)
    np.testing.assert_array_equal(warehouse_landmarks(large)[:60], warehouse_landmarks(small))
    one, other = simulate_warehouse(small), simulate_warehouse(large)
    np.testing.assert_array_equal(one.odometry.forward_mps, other.odometry.forward_mps)
    np.testing.assert_array_equal(one.detections.range_m, other.detections.range_m)


def test_configured_errors_are_in_the_recording() -> None:
    clean = simulate_warehouse(SMALL)
    config = replace(SMALL, bearing_bias_rad=0.02, range_bias_m=0.1, forward_scale=1.05, turn_scale=0.9)
    off = simulate_warehouse(config)
    np.testing.assert_allclose(off.detections.bearing_rad - clean.detections.bearing_rad, 0.02, atol=1e-9)
    np.testing.assert_allclose(off.detections.range_m - clean.detections.range_m, 0.1, atol=1e-9)
    np.testing.assert_allclose(off.odometry.forward_mps * 1.05, clean.odometry.forward_mps)
    np.testing.assert_allclose(off.odometry.angular_radps * 0.9, clean.odometry.angular_radps)
    wrong = simulate_warehouse(replace(SMALL, p_wrong_identity=0.5)).detections.landmark_id
    assert 0.4 < np.mean(wrong != clean.detections.landmark_id) < 0.6


@pytest.mark.parametrize("field", ["n_landmarks", "range_m", "landmarks_per_aisle"])
def test_a_warehouse_without_size_is_an_error(field: str) -> None:
    with pytest.raises(ConfigError, match=field):
        replace(SMALL, **{field: 0})


@pytest.mark.parametrize("logarithm", [True, False])
def test_the_objective_is_what_gtsam_computes(recording: Recording, factors: Factors, logarithm: bool) -> None:
    graph = plain_gtsam.graph_of(factors, logarithm=logarithm)
    for estimate in (
        truth_of(factors, recording),
        near_start(factors, recording, 0.2),
        dead_reckoned_start(factors),
    ):
        theirs = graph.error(plain_gtsam.values_of(estimate))
        assert objective(factors, estimate, logarithm=logarithm) == pytest.approx(theirs, rel=1e-9)


def test_coordinates_as_residuals_have_the_derivatives_that_they_should(factors: Factors) -> None:
    """Against differences, at poses that fit odometry badly."""
    one = replace(
        factors,
        stamp_s=factors.stamp_s[:2],
        pose_row=factors.pose_row[:0],
        landmark_row=factors.landmark_row[:0],
        reading=factors.reading[:0],
        sigma=factors.sigma[:0],
    )
    factor = plain_gtsam.graph_of(one, logarithm=False).at(1)
    poses = [gtsam.Pose2(1.0, 2.0, 0.3), gtsam.Pose2(1.5, 1.7, 0.9)]

    def residual(*moved: np.ndarray) -> np.ndarray:
        values = gtsam.Values()
        for key, pose, step in zip(factor.keys(), poses, moved, strict=True):
            values.insert(key, pose.compose(gtsam.Pose2.Expmap(step)))
        return np.asarray(factor.unwhitenedError(values))

    values = gtsam.Values()
    for key, pose in zip(factor.keys(), poses, strict=True):
        values.insert(key, pose)
    linear = factor.linearize(values)
    whiten = np.linalg.inv(np.linalg.cholesky(factors.covariance[0]))
    still, step = np.zeros(3), 1e-6
    for which in (0, 1):
        expected = np.empty((3, 3))
        for k, axis in enumerate(step * np.eye(3)):
            ahead, back = ([axis * sign if which == n else still for n in (0, 1)] for sign in (1.0, -1.0))
            expected[:, k] = (residual(*ahead) - residual(*back)) / (2.0 * step)
        found = linear.getA()[:, 3 * which : 3 * which + 3]
        # whitened by any square root of the information
        np.testing.assert_allclose(found.T @ found, (whiten @ expected).T @ (whiten @ expected), rtol=1e-5, atol=1e-1)


def test_integrated_odometry_is_what_gtsam_composes(recording: Recording, factors: Factors) -> None:
    """Row by row, and the covariance against samples of the noise of every row."""
    odometry = recording.odometry
    rows = slice(int(factors.frame[3]), int(factors.frame[4]))
    pose = gtsam.Pose2()
    for k in range(rows.start, rows.stop):
        twist = np.array([odometry.forward_mps[k], odometry.lateral_mps[k], odometry.angular_radps[k]])
        pose = pose.compose(gtsam.Pose2.Expmap(0.1 * twist))
    np.testing.assert_allclose(factors.increment[3], [pose.x(), pose.y(), pose.theta()], atol=1e-9)


def test_the_covariance_of_odometry_is_that_of_samples(recording: Recording) -> None:
    """Over two seconds of a turn, where the noise is carried around a corner."""
    turning = float(recording.odometry.stamp_s[np.argmax(recording.odometry.angular_radps > 0.2) + 5])
    between = np.array([turning, turning + 2.0])
    sigma = np.array([0.025, 0.015, 0.01, 0.025, 0.015])  # small: covariances are of first order
    mean, covariance = integrated(recording, between, sigma)
    rng, odometry = np.random.default_rng(0), recording.odometry
    inside = (odometry.stamp_s >= turning - 1e-9) & (odometry.stamp_s < turning + 2.0 - 1e-9)
    velocity = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])[inside]
    speed, turn = np.hypot(*velocity[:, :2].T), np.abs(velocity[:, 2])
    one = np.ones_like(speed)
    variance = np.column_stack(
        [
            sigma[0] ** 2 * speed + sigma[1] ** 2 * turn,
            sigma[2] ** 2 * speed,
            sigma[3] ** 2 * one + sigma[4] ** 2 * turn,
        ]
    )
    pose = np.zeros((40_000, 3))
    for row, spread in zip(velocity, np.sqrt(variance / 0.1), strict=True):
        pose = se2.compose(pose, se2.exp(0.1 * (row + spread * rng.normal(size=pose.shape))))
    sampled = np.cov(se2.log(se2.between(mean[0], pose)).T)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    np.testing.assert_allclose(covariance[0] / scale, sampled / scale, atol=0.03)


def test_levenberg_marquardt_finds_the_same_optimum_from_both_starts(recording: Recording, factors: Factors) -> None:
    near, far = (
        plain_gtsam.levenberg_marquardt(factors, start, tolerance=1e-9)
        for start in (near_start(factors, recording), dead_reckoned_start(factors))
    )
    np.testing.assert_allclose(near.estimate.landmark, far.estimate.landmark, atol=1e-4)
    truth = truth_of(factors, recording)
    best = objective(factors, near.estimate)
    assert best < objective(factors, truth)
    for seed in (0, 1):
        assert best < objective(factors, near_start(factors, recording, 1e-3, seed))
    off = near.estimate.landmark - truth.landmark
    nees = np.einsum("li,lij,lj->l", off, np.linalg.inv(near.landmark_covariance), off)
    assert 0.2 < nees.mean() < 8.0
    streamed = plain_gtsam.isam2(factors)
    np.testing.assert_allclose(streamed.estimate.landmark, near.estimate.landmark, atol=0.1)
    assert streamed.step_s.shape == factors.stamp_s.shape
