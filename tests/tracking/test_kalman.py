"""The filters against dense matrices, exponentials of matrices and quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from evermap.tracking import kalman


def van_loan(order: int, gap_s: float, density: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise of a chain of integrators driven by white noise, from one matrix exponential (1978)."""
    a = np.kron(np.eye(order, k=1), np.eye(3))
    d = 3 * order
    drive = np.zeros((d, d))
    drive[-3:, -3:] = density * np.eye(3)
    m = expm(np.block([[-a, drive], [np.zeros((d, d)), a.T]]) * gap_s)
    transition = m[d:, d:].T
    return transition, transition @ m[:d, d:]


def random_covariance(rng: np.random.Generator, d: int) -> np.ndarray:
    root = rng.normal(size=(d, d))
    return root @ root.T + 0.1 * np.eye(d)


@pytest.mark.parametrize("order", [2, 3])
@given(seed=st.integers(0, 2**32 - 1), gap_s=st.floats(0.0, 3.0), density=st.floats(1e-4, 10.0))
def test_a_prediction_is_that_of_dense_matrices(order: int, seed: int, gap_s: float, density: float) -> None:
    rng = np.random.default_rng(seed)
    d = 3 * order
    mean, covariance = rng.normal(size=(3, d)), np.array([random_covariance(rng, d) for _ in range(3)])
    transition, noise = van_loan(order, gap_s, density)
    expected_mean = mean @ transition.T
    expected = transition @ covariance @ transition.T + noise
    untouched = mean[2].copy(), covariance[2].copy()
    kalman.predict(mean, covariance, 2, gap_s, density)
    np.testing.assert_allclose(mean[:2], expected_mean[:2], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(covariance[:2], expected[:2], rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(mean[2], untouched[0])
    np.testing.assert_array_equal(covariance[2], untouched[1])


@pytest.mark.parametrize("d", [3, 6, 9])
@given(seed=st.integers(0, 2**32 - 1))
def test_an_update_is_the_joseph_form(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, covariance = rng.normal(size=d), random_covariance(rng, d)
    z, noise = rng.normal(size=3), random_covariance(rng, 3)
    h = np.eye(3, d)
    gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + noise)
    left = np.eye(d) - gain @ h
    expected_mean, expected = mean + gain @ (z - h @ mean), left @ covariance @ left.T + gain @ noise @ gain.T
    kalman.update(mean, covariance, z, noise)
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(covariance, expected, rtol=1e-7, atol=1e-8)
    np.testing.assert_array_equal(covariance, covariance.T)


def test_a_hundred_steps_stay_with_least_squares() -> None:
    """Without process noise the filter is a least-squares fit of a polynomial to all detections."""
    rng = np.random.default_rng(3)
    prior, noise = np.diag([4.0] * 3 + [1.0] * 3 + [0.25] * 3), np.diag([0.09, 0.04, 0.01])
    mean, covariance = np.zeros((1, 9)), prior[None].copy()
    stamps = np.cumsum(rng.uniform(0.01, 0.3, 100))
    z = rng.normal(size=(100, 3))
    before = 0.0
    for stamp, point in zip(stamps, z, strict=True):
        kalman.predict(mean, covariance, 1, stamp - before, 0.0)
        kalman.update(mean[0], covariance[0], point, noise)
        before = stamp
    final, information, right = stamps[-1], np.linalg.inv(prior), np.zeros(9)
    for stamp, point in zip(stamps, z, strict=True):  # in the states at time 0
        h = np.kron([1.0, stamp, 0.5 * stamp**2], np.eye(3))
        information = information + h.T @ np.linalg.inv(noise) @ h
        right = right + h.T @ np.linalg.inv(noise) @ point
    to_end = np.kron([[1.0, final, 0.5 * final**2], [0.0, 1.0, final], [0.0, 0.0, 1.0]], np.eye(3))
    np.testing.assert_allclose(mean[0], to_end @ np.linalg.solve(information, right), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(covariance[0], to_end @ np.linalg.inv(information) @ to_end.T, rtol=1e-5, atol=1e-8)
