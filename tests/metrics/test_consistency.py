"""NEES and NIS against simulated Gaussian draws and scipy's chi-square."""

import numpy as np
import pytest
from scipy import stats

from evermap.estimate.innovations import lag1_autocorrelation
from evermap.metrics.consistency import (
    chi2_interval,
    chi2_quantile,
    nees,
    running_mean,
    share_in_band,
    summarise_nis,
)
from evermap.types import Innovations


def innovations(nis, p_inlier=None, landmark_id=None):
    count = len(nis)
    return Innovations(
        np.arange(count, dtype=float),
        np.arange(count),
        np.zeros(count, int) if landmark_id is None else landmark_id,
        np.asarray(nis, float),
        np.ones(count) if p_inlier is None else p_inlier,
    )


@pytest.mark.parametrize("size", [1, 2, 3])
def test_nees_of_gaussian_draws_is_chi_square(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size)) * 1e-3
    covariance = root @ root.T
    draws = rng.multivariate_normal(np.zeros(size), covariance, 5000)
    values = nees(draws, np.broadcast_to(covariance, (5000, size, size)))
    assert stats.kstest(values, stats.chi2(size).cdf).pvalue > 0.01


def test_exact_poses_have_no_nees():
    covariance = np.array([np.eye(2), np.zeros((2, 2)), [[1.0, 1.0], [1.0, 1.0]]])
    np.testing.assert_array_equal(np.isnan(nees(np.ones((3, 2)), covariance)), [False, True, True])
    assert np.isfinite(nees(np.ones((1, 2)), np.eye(2)[None] * 1e-12))


def test_quantiles_are_those_of_scipy_bit_by_bit():
    for dof in (1, 2, 3, 17, 12_345):
        for p in (1e-6, 0.025, 0.5, 0.95, 0.999):
            assert chi2_quantile(p, dof) == stats.chi2.ppf(p, dof)


def test_mean_interval_covers_simulated_means():
    rng = np.random.default_rng(2)
    low, high = chi2_interval(2, 50)
    means = rng.chisquare(2, (4000, 50)).mean(axis=1)
    assert np.mean((means >= low) & (means <= high)) == pytest.approx(0.95, abs=0.012)


def test_summary_of_consistent_innovations():
    rng = np.random.default_rng(5)
    nis = rng.chisquare(2, 4000)
    summary = summarise_nis(innovations(nis, landmark_id=rng.integers(0, 9, 4000)))
    assert summary.mean == pytest.approx(2.0, abs=0.12)
    assert summary.mean_band == chi2_interval(2, 4000)
    assert summary.mean == summary.mean_all
    assert summary.in_band_share == pytest.approx(0.95, abs=0.012)
    assert summary.in_two_sided_band_share == pytest.approx(0.95, abs=0.012)
    assert summary.median == pytest.approx(stats.chi2(2).median(), abs=0.08)
    assert summary.outlier_share == 0
    assert abs(summary.lag1) < 0.05


def test_outliers_are_counted_apart():
    nis = np.array([1.0, 3.0, 400.0, np.nan])
    summary = summarise_nis(innovations(nis, p_inlier=np.array([0.9, 1.0, 0.01, 1.0])))
    assert summary.count == 2
    assert summary.mean == pytest.approx(2.0)
    assert summary.mean_all == pytest.approx(404 / 3)
    assert summary.outlier_share == pytest.approx(1 / 3)
    only = summarise_nis(innovations([400.0], p_inlier=np.array([0.0])))
    assert only.mean is None
    assert only.outlier_share == 1.0
    assert summarise_nis(innovations([])).mean is None


def test_correlated_errors_show_in_the_lag_one_autocorrelation():
    rng = np.random.default_rng(8)
    walk = np.zeros((3000, 2))
    for i in range(1, len(walk)):
        walk[i] = 0.9 * walk[i - 1] + np.sqrt(1 - 0.81) * rng.normal(size=2)
    nis = np.sum(walk**2, axis=1)
    assert lag1_autocorrelation(nis, np.zeros(3000)) > 0.6
    shuffled = np.arange(3000) % 1500  # only pairs 1500 steps apart share a group
    assert abs(lag1_autocorrelation(nis, shuffled.astype(float))) < 0.1
    assert lag1_autocorrelation(nis[:5], np.zeros(5)) is None


def test_running_mean_equals_the_plain_loop():
    values = np.random.default_rng(0).normal(size=40)
    expected = [np.nan] * 6 + [values[i - 6 : i + 1].mean() for i in range(6, 40)]
    np.testing.assert_allclose(running_mean(values, 7), expected, atol=1e-12)
    assert np.isnan(running_mean(values[:3], 7)).all()


def test_share_in_band_ignores_missing_values():
    assert share_in_band(np.array([1.0, np.nan, 100.0])) == 0.5
    assert share_in_band(np.array([np.nan])) is None
