"""Calibration states: what is fixed stays, and scale is divided as the closed-form posterior says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import default_prior, make_world

from evermap.errors import ConfigError
from evermap.slam.calibration import FORWARD, NAMES, SLOPE, SPECS, CalibrationPrior
from evermap.slam.smoother import Smoother


def test_default_prior_is_the_table():
    prior = default_prior()
    assert [spec.name for spec in SPECS] == list(NAMES)
    assert prior.mean.tolist() == [spec.mean for spec in SPECS]
    assert prior.sigma.tolist() == [spec.sigma for spec in SPECS]
    assert prior.free.all()
    assert not CalibrationPrior.from_settings(calibrated=False, fix={}).free.any()


def test_unknown_state_is_an_error_that_names_the_known_ones():
    with pytest.raises(ConfigError, match=r"odometry_dealy_s.*odometry_delay_s"):
        default_prior(odometry_dealy_s=0.1)


def posterior_of_product(
    prior: CalibrationPrior, product: float, sigma_product: float
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of (log slope, log forward scale) when their sum is measured: a Kalman update."""
    spread = np.diag([prior.sigma[SLOPE] ** 2, prior.sigma[FORWARD] ** 2])
    h = np.ones((1, 2))
    wide = np.log(product / prior.mean[FORWARD])
    # 'measured' is what the likelihood says, without the prior that the graph's own estimate holds already
    total = spread.sum()
    variance = 1.0 / (1.0 / sigma_product**2 - 1.0 / total)
    measured = wide * variance / sigma_product**2
    gain = spread @ h.T / (total + variance)
    return (gain * measured).ravel(), spread - gain @ h @ spread


@pytest.mark.parametrize("product", [0.93, 1.0, 1.06])
@pytest.mark.parametrize("sigma", [1e-4, 0.004, 0.03])
def test_scale_is_divided_by_the_closed_form_posterior(product, sigma):
    prior = default_prior()
    states, covariance = prior.mean.copy(), np.diag(np.full(9, 1e-4))
    states[FORWARD], covariance[FORWARD, FORWARD] = product, sigma**2
    mean, spread = posterior_of_product(prior, product, sigma)
    divided, after, factor, log_sigma = prior.split_scale(states, covariance)
    assert np.log1p(divided[SLOPE]) == pytest.approx(mean[0], abs=1e-12)
    assert np.log(divided[FORWARD]) == pytest.approx(mean[1], abs=1e-12)
    assert factor == pytest.approx(np.exp(-mean[0]))
    assert log_sigma == pytest.approx(np.sqrt(spread[0, 0]), rel=1e-9)
    assert after[SLOPE, SLOPE] == pytest.approx(spread[0, 0], rel=1e-9)
    assert after[FORWARD, FORWARD] == pytest.approx(spread[1, 1], rel=1e-9)


def test_division_explains_every_reading_as_well():
    """Graph and divided solution predict the same ranges and the same motion, in their own metres."""
    prior = default_prior()
    states = np.array([0.03, 0.0, 0.05, -0.4, 0.02, 0.1, 0.94, 1.05, 0.03])
    divided, _, factor, _ = prior.split_scale(states, np.eye(9) * 1e-6)
    r, b, v, w = 3.7, 0.4, 0.8, -0.6

    def reading(s, r):
        return s[0] + r * (1 + s[1] + s[2] * b + s[3] * b * b)

    def speed(s):
        return s[6] * v - s[8] * abs(w)

    assert reading(divided, factor * r) == pytest.approx(reading(states, r), abs=1e-12)
    assert speed(divided) == pytest.approx(factor * speed(states), abs=1e-12)


def test_where_the_slope_is_fixed_nothing_is_divided():
    prior = default_prior(range_slope=0.01)
    assert prior.without_scale() is prior
    states, covariance = prior.mean + 0.01, np.eye(9) * 1e-4
    divided, after, factor, log_sigma = prior.split_scale(states, covariance)
    assert divided.tolist() == states.tolist()
    assert np.array_equal(after, covariance)
    assert (factor, log_sigma) == (1.0, 0.0)


def test_the_graph_never_sees_the_slope_but_its_uncertainty():
    prior = default_prior()
    graph = prior.without_scale()
    assert not graph.free[SLOPE]
    assert graph.free.sum() == 8
    assert graph.sigma[FORWARD] == pytest.approx(np.hypot(0.05, 0.02))
    assert prior.free.all()  # not changed in place


@pytest.mark.parametrize("name", [n for n in NAMES if n != "range_slope"])
def test_fixed_states_are_left_alone_by_the_division(name):
    prior = default_prior(**{name: 1.01 if name.endswith("scale") else 0.017})
    k = NAMES.index(name)
    graph = prior.without_scale()
    states = graph.mean.copy()
    if graph.free[FORWARD]:
        states[FORWARD] = 0.96
    divided, *_ = prior.split_scale(states, np.diag(np.where(graph.free, 1e-6, prior.sigma**2)))
    assert divided[k] == prior.mean[k]


def test_with_the_odometers_scale_given_the_recording_tells_the_slope():
    """Forward scale fixed and true: the range slope is observable, the map in metres."""
    states = default_prior().mean.copy()
    states[SLOPE] = 0.03
    prior = default_prior(odometry_forward_scale=1.0, range_skew_per_rad=0.0, range_curvature_per_rad2=0.0)
    world = make_world(31, noisy=0.0, states=states, prior=prior, n_poses=200)
    problem = replace(world.problem, prior=prior.without_scale())
    smoother = Smoother(problem, world.noise, robust=False)
    found = smoother.optimum(world.near_truth(np.random.default_rng(0)))
    divided, covariance, factor, _ = prior.split_scale(found.states, smoother.marginals(found).states)
    assert abs(divided[SLOPE] - 0.03) < 3 * np.sqrt(covariance[SLOPE, SLOPE])
    assert divided[SLOPE] == pytest.approx(0.03, abs=0.01)
    assert factor * found.landmark == pytest.approx(world.truth.landmark, rel=0.01, abs=0.05)


@pytest.mark.parametrize(("slope", "forward"), [(0.0, 1.0), (0.02, 0.95), (-0.015, 1.04)])
def test_metres_are_right_when_the_priors_are_told_the_truth(slope, forward):
    """Exact measurements of a sensor with a wrong scale by an odometer with another."""
    truth = np.array([0.05, slope, 0.0, -0.2, 0.01, 0.2, forward, 1.05, 0.02])
    prior = replace(default_prior(), mean=truth)
    world = make_world(32, noisy=0.0, states=truth, prior=prior)
    problem = replace(world.problem, prior=prior.without_scale())
    smoother = Smoother(problem, world.noise, robust=False)
    found = smoother.optimum(world.near_truth(np.random.default_rng(0)), tolerance=1e-9)
    divided, _, factor, _ = prior.split_scale(found.states, smoother.marginals(found).states)
    assert divided == pytest.approx(truth, abs=1e-6)
    assert factor * found.landmark == pytest.approx(world.truth.landmark, abs=1e-5)
    assert factor * found.pose[:, :2] == pytest.approx(world.truth.pose[:, :2], abs=1e-5)
