"""What a look says about modes, against scipy's distributions and hand-made geometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from evermap.errors import InputError
from evermap.types import Sensor
from evermap_studies.nielsen2024.selectors.likelihood import (
    Readings,
    hit_probabilities,
    log_psi,
    miss_weight_from,
    predict,
)

CAMERA = Sensor(
    range_min_m=0.3,
    range_max_m=5.0,
    bearing_min_rad=-0.6,
    bearing_max_rad=0.5,
    p_detect=0.7,
    mount_robot_sensor=(0.2, -0.1, 0.3),
)


def scene(seed=0, rows=40):
    """Poses, landmarks of two modes (the second landmark has one), readings near the first mode, every third a miss."""
    rng = np.random.default_rng(seed)
    pose = np.column_stack([rng.uniform(-3, 3, (rows, 2)), rng.uniform(-9, 9, rows)])
    mode = rng.uniform(-4, 4, (3, 2, 2))
    mode[1, 1] = np.nan
    landmark = np.sort(rng.integers(0, 3, rows))
    reading = np.array([expected(p, mode[i, 0], CAMERA) for p, i in zip(pose, landmark, strict=True)])
    reading += rng.normal(0, [0.3, 0.1], (rows, 2))
    reading[::3] = np.nan
    sigma = np.column_stack([rng.uniform(0.05, 0.3, rows), rng.uniform(0.02, 0.1, rows)])
    return pose, landmark, mode, reading, sigma


def expected(pose, point, sensor, states=(0.0,) * 9):
    """Range and bearing as reported, in plain trigonometry."""
    mount = sensor.mount_robot_sensor
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + c * mount[0] - s * mount[1], pose[1] + s * mount[0] + c * mount[1]
    b = math.remainder(math.atan2(point[1] - y, point[0] - x) - pose[2] - mount[2], 2 * math.pi)
    r = math.dist(point, (x, y))
    return np.array([states[0] + r * (1 + states[1] + states[2] * b + states[3] * b * b), b + states[4]])


def perturbed(pose, xi):
    """`pose * exp(xi)` for a small step, to first order."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([pose[0] + c * xi[0] - s * xi[1], pose[1] + s * xi[0] + c * xi[1], pose[2] + xi[2]])


def innovation_covariance(pose, point, sensor, states, sigma, pose_covariance, mode_covariance, step=1e-6):
    """`H P H' + R` with derivatives by finite differences."""
    columns = [
        expected(perturbed(pose, step * e), point, sensor, states)
        - expected(perturbed(pose, -step * e), point, sensor, states)
        for e in np.eye(3)
    ]
    columns += [
        expected(pose, point + step * e, sensor, states) - expected(pose, point - step * e, sensor, states)
        for e in np.eye(2)
    ]
    jacobian = np.array([[c[0], math.remainder(c[1], 2 * math.pi)] for c in columns]).T / (2 * step)
    return (
        jacobian[:, :3] @ pose_covariance @ jacobian[:, :3].T
        + jacobian[:, 3:] @ mode_covariance @ jacobian[:, 3:].T
        + np.diag(sigma**2)
    )


def random_covariance(rng, count, size, scale):
    root = rng.normal(0, scale, (*count, size, size))
    return root @ np.swapaxes(root, -1, -2) + 1e-4 * np.eye(size)


@pytest.mark.parametrize(("weight", "density"), [(1.0, 0.0), (0.3, 0.02)])
@pytest.mark.parametrize("uncertain", [False, True])
def test_likelihood_is_that_of_the_definition(weight, density, uncertain):
    pose, landmark, mode, reading, sigma = scene()
    rng = np.random.default_rng(1)
    states = np.array([0.05, 0.02, -0.01, -0.1, 0.03, 0, 0, 0, 0])
    pose_covariance = random_covariance(rng, (len(pose),), 3, 0.1 * uncertain)
    mode_covariance = random_covariance(rng, (3, 2), 2, 0.2 * uncertain)
    readings = Readings(pose, landmark, mode, reading, sigma, states, pose_covariance, mode_covariance)
    found = log_psi(readings, CAMERA, miss_weight=weight, outlier_density=density, gone=True)
    assert found.shape == (len(pose), 3)
    floors = 0
    for row, (p, i) in enumerate(zip(pose, landmark, strict=True)):
        missed = np.isnan(reading[row, 0])
        with np.errstate(divide="ignore"):
            assert found[row, 2] == (0.0 if missed else np.log(density))
        for k in range(2):
            if np.isnan(mode[i, k, 0]):
                assert found[row, k] == -np.inf
                continue
            h = expected(p, mode[i, k], CAMERA, states)
            s = innovation_covariance(
                p, mode[i, k], CAMERA, states, sigma[row], pose_covariance[row], mode_covariance[i, k]
            )
            r, b = stats.norm(h[0], math.sqrt(s[0, 0])), stats.norm(h[1], math.sqrt(s[1, 1]))
            p_detect = 0.7 * (r.sf(0.3) * r.cdf(5.0)) * (b.sf(-0.6) * b.cdf(0.5))
            if missed:
                value = weight * math.log1p(-p_detect)
            else:
                difference = reading[row] - h
                difference[1] = math.remainder(difference[1], 2 * math.pi)
                gaussian = stats.multivariate_normal([0, 0], s).pdf(difference)
                if p_detect * gaussian < 1e-250 and density == 0.0:
                    assert found[row, k] < math.log(1e-250)
                    assert np.isfinite(found[row, k])
                    floors += 1
                    continue
                value = math.log(p_detect * gaussian + density)
            assert found[row, k] == pytest.approx(value, rel=2e-5, abs=1e-6)
    assert density > 0.0 or uncertain or floors > 3


def test_exact_poses_and_modes_are_the_limit_of_certain_ones():
    exact = Readings(*scene(2))
    certain = replace(
        exact, pose_covariance=np.zeros((len(exact.landmark), 3, 3)), mode_covariance_m2=np.zeros((3, 2, 2, 2))
    )
    exact, certain = (log_psi(readings, CAMERA, outlier_density=1e-3) for readings in (exact, certain))
    np.testing.assert_array_equal(exact, certain)


def test_mahalanobis_distance_is_that_of_the_density():
    found = predict(Readings(*scene(3)), CAMERA)
    scale = np.log(2 * math.pi * found.range_sigma_m * found.bearing_sigma_rad)  # exact: errors are independent
    np.testing.assert_allclose(found.log_density, -0.5 * found.squared_distance - scale, rtol=1e-9)
    assert np.isnan(found.squared_distance[::3]).all()


def test_a_wrong_identity_cannot_force_a_switch_where_outliers_are_possible():
    """One reading that fits the other mode exactly, against the price of two switches."""
    pose = np.zeros((1, 3))
    mode = np.array([[[2.0, 0.5], [3.0, -0.5]]])
    reading = expected(pose[0], mode[0, 1], CAMERA)[None]
    sigma = np.array([[0.05, 0.02]])
    price = 2 * math.log(1e-4)
    readings = Readings(pose, np.array([0]), mode, reading, sigma)
    by_paper = log_psi(readings, CAMERA)[0]
    with_floor = log_psi(readings, CAMERA, outlier_density=0.1)[0]
    assert by_paper[1] - by_paper[0] > -price > with_floor[1] - with_floor[0] > 0.0


def test_a_sensor_that_never_misses_leaves_a_miss_possible():
    never = Sensor(p_detect=1.0)
    miss = Readings(
        np.zeros((1, 3)), np.array([0]), np.array([[[2.0, 0.0]]]), np.full((1, 2), np.nan), np.full((1, 2), 0.1)
    )
    found = log_psi(miss, never)
    assert found[0, 0] == pytest.approx(math.log(1e-6))


def test_hit_probabilities_are_counted_by_hand():
    detected = np.array([1, 1, 0, 0, 1, 0, 1, 1, 1, 0], dtype=float)
    first = np.array([0, 5, 5, 9, 10])
    # 11001, 0111 and 0: after a hit 1, 0, 1, 1, after a miss 0, 1, 1
    after_hit, after_miss = hit_probabilities(detected, first)
    assert after_hit == pytest.approx((3 + 1) / (4 + 2))
    assert after_miss == pytest.approx((2 + 1) / (3 + 2))


def test_weight_of_a_miss_is_that_of_the_chain_that_made_the_misses():
    rng = np.random.default_rng(0)
    p_hit = {1: 0.7, 0: 0.2}
    rows, sequences = [], 200
    for _ in range(sequences):
        state = int(rng.random() < 0.4)
        for _ in range(100):
            rows.append(state)
            state = int(rng.random() < p_hit[state])
    detected = np.array(rows, dtype=float)
    weight = miss_weight_from(detected, np.arange(sequences + 1) * 100, 0.4)
    assert weight == pytest.approx(math.log(0.8) / math.log(0.6), rel=0.03)
    single = rng.random(20000) < 0.4
    assert miss_weight_from(single.astype(float), np.array([0, 20000]), 0.4) == pytest.approx(1.0, rel=0.05)


def test_weight_needs_detections_and_a_probability():
    assert 0.0 < miss_weight_from(np.array([]), np.array([0]), 0.6) <= 1.0
    with pytest.raises(InputError, match="row 1"):
        miss_weight_from(np.array([1.0, 0.5]), np.array([0, 2]), 0.6)
    with pytest.raises(InputError, match="p_detect"):
        miss_weight_from(np.array([1.0, 0.0]), np.array([0, 2]), 1.0)
