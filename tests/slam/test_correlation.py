"""Errors that last: found in residuals of known correlation, and counted as what they are worth."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import Config
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.correlation import Curve, Lasting, curve_columns, fit_curve, lasting_errors
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser

LANDMARKS, EACH, STEP_S = 30, 240, 0.25


def residuals(seed: int, share: float, time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals (M, 2) of landmarks that are all seen at every instant, their stamps and landmarks."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-STEP_S / time_s)
    slow = rng.normal(size=(EACH, LANDMARKS, 2))
    for k in range(1, EACH):
        slow[k] = keep * slow[k - 1] + np.sqrt(1.0 - keep**2) * slow[k]
    value = np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.normal(size=slow.shape)
    value += rng.normal(size=(1, LANDMARKS, 2))  # landmarks that are off: the same for all of their residuals
    stamp_s = np.repeat(np.arange(EACH) * STEP_S, LANDMARKS)
    return value.reshape(-1, 2), stamp_s, np.tile(np.arange(LANDMARKS), EACH)


@pytest.mark.parametrize(("share", "time_s"), [(0.5, 3.0), (0.2, 10.0), (0.8, 1.0)])
def test_share_and_worth_of_errors_that_last(share, time_s):
    residual, stamp_s, landmark = residuals(1, share, time_s)
    found = lasting_errors(residual, np.ones(len(landmark)), stamp_s, landmark)
    assert found.share.sum() == pytest.approx(share, abs=0.12)
    lag_s = np.abs(np.subtract.outer(stamp_s[landmark == 0], stamp_s[landmark == 0]))
    correlation = share * np.exp(-lag_s / time_s)
    np.fill_diagonal(correlation, 1.0)
    expected = EACH**2 / correlation.sum()  # the mean of a landmark's residuals is that of so many independent ones
    assert found.information(stamp_s, landmark)[landmark == 0].sum() == pytest.approx(expected, rel=0.35)


def test_white_errors_are_worth_all_of_them():
    residual, stamp_s, landmark = residuals(2, 0.0, 1.0)
    found = lasting_errors(residual, np.ones(len(landmark)), stamp_s, landmark)
    assert not found.any
    assert np.all(found.information(stamp_s, landmark) == 1.0)


def test_outliers_and_missing_components_are_left_out():
    residual, stamp_s, landmark = residuals(3, 0.0, 1.0)
    weight = np.where(np.random.default_rng(0).random(len(landmark)) < 0.05, 0.0, 1.0)
    residual[weight == 0.0] += 100.0
    residual[:, 1] = np.nan
    assert not lasting_errors(residual, weight, stamp_s, landmark).any


def test_correlation_adds_to_variances_by_brute_force():
    rng = np.random.default_rng(4)
    stamp_s, place = np.sort(rng.uniform(0.0, 20.0, 50)), rng.integers(0, 4, 50)
    influence = rng.normal(size=(50, 2, 3))
    lasting = Lasting(np.array([1.0, 10.0]), np.array([0.3, 0.4]))
    lag_s = np.abs(np.subtract.outer(stamp_s, stamp_s))
    correlation = (np.exp(-lag_s[..., None] / lasting.persist_s) @ lasting.share) * np.equal.outer(place, place)
    np.fill_diagonal(correlation, 0.0)
    expected = np.einsum("mds,mn,nds->s", influence, correlation, influence)
    assert lasting.variance_beside(influence, stamp_s, place) == pytest.approx(expected)
    assert lasting.information(stamp_s, place) == pytest.approx(1.0 / (1.0 + correlation.sum(axis=1)))


def test_covariances_are_honest_where_a_visit_errs_alike():
    """NEES of poses and landmarks is ten times its expectation if detections count as independent."""
    world = LaserWorld(lasting_m=0.02, lasting_rad=np.radians(0.25))
    recording = simulate_laser(world, 0)
    config = Config.model_validate({"slam": {"sensor_model": "plain", "method": "nohyp"}})
    found = compare_with_truth(recording, run_slam(recording, config))
    assert found.poses is not None
    assert found.landmarks_anchored is not None
    assert 0.2 < np.mean(found.poses.anchored_nees) / 2.0 < 2.5
    assert 0.2 < np.mean(found.landmarks_anchored.nees) / 2.0 < 2.5


def test_a_curve_that_takes_many_exchanges_is_fitted() -> None:
    """Of a made drive; three steps of non-negative least squares a number, the default, end in a RuntimeError there."""
    lag_s = np.array([0.4, 0.8, 1.2, 1.6, 2.8, 4.4, 6.8, 10.4, 14.8, 41.6, 52.8, 94.4])
    square = np.array(
        [0.00142, 0.00255, 0.00577, 0.00575, 0.006, 0.01078, 0.02796, 0.03114, 0.05613, 0.29674, 0.39646, 0.43702]
    )
    worth = np.array([75.0, 75.0, 75.0, 75.0, 60.2, 38.3, 24.8, 16.2, 11.4, 4.1, 3.2, 1.8])
    curve, persist_s, growth = Curve(lag_s, square, worth), [1.0, 3.0, 10.0, 30.0, 100.0], 0.0018
    found, log_likelihood = fit_curve(curve, persist_s, growth)
    columns = np.column_stack(curve_columns(curve, persist_s))

    def log_likelihood_of(parts: np.ndarray) -> float:
        fitted = np.maximum(columns @ parts + growth * lag_s, 0.1 * square)
        return float(worth @ (-np.log(fitted) - square / fitted))

    assert (found >= 0.0).all()
    assert log_likelihood == pytest.approx(log_likelihood_of(found))
    for k in range(len(found)):  # no part that is a little larger or smaller is more probable
        for by in (-0.1, 0.1):
            other = found.copy()
            other[k] = max(other[k] + by * max(found[k], 0.001), 0.0)
            assert log_likelihood_of(other) < log_likelihood + 0.1
