"""Smooth rates from counts: known surfaces, finite differences, and a direct search for the smoothness."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from evermap.existence.rhythm import (
    BINS,
    HALF_AN_EVENT,
    Basis,
    _newton,
    age_basis,
    constant,
    fit,
    steady_level,
    week_basis,
)
from evermap.types import FloatArray

LOG_AGE = np.linspace(np.log(10.0), np.log(5000.0), 60)


def true_log_age(log_age: FloatArray) -> FloatArray:
    """A rate with a bump at a typical age."""
    return np.asarray(-5.0 + 2.0 * np.exp(-((log_age - np.log(300.0)) ** 2)) - 0.2 * log_age)


def true_log_week() -> FloatArray:
    """Two busy hours a day, less of them at the weekend."""
    hour = np.arange(BINS) / 6.0
    busy = np.exp(-(((hour % 24.0) - 9.0) ** 2) / 4.0) + np.exp(-(((hour % 24.0) - 17.0) ** 2) / 6.0)
    return np.asarray(np.where(hour < 120.0, 2.0, 0.7) * busy)


def test_a_known_surface_is_recovered() -> None:
    """The error is what so many events can tell: its square, in standard deviations, is 1 on the mean or less."""
    rng = np.random.default_rng(1)
    surface = true_log_age(LOG_AGE)[:, None] + true_log_week()[None, :]
    exposure = rng.uniform(0.5, 1.5, surface.shape) * 60.0
    events = rng.poisson(exposure * np.exp(surface)).astype(float)
    rates = fit(events, exposure, age_basis(LOG_AGE, 20), week_basis())
    error = rates.log_age[:, None] + rates.log_week[None, :] - surface
    expected = exposure * np.exp(surface)
    # sum over cells of (expected events) x (squared error of log rate) is about the number of parameters
    assert (expected * error**2).sum() < 2.0 * rates.freedom
    assert rates.freedom < 120.0
    assert np.sqrt((expected * error**2).sum() / expected.sum()) < 0.05
    # a level costs nothing: as many events are expected as were counted, and half of one
    refitted = (exposure * np.exp(rates.log_age[:, None] + rates.log_week)).sum()
    assert refitted == pytest.approx(events.sum() + HALF_AN_EVENT, rel=1e-4)
    assert rates.log_week @ events.sum(0) == pytest.approx(0.0, abs=1e-2 * events.sum())


def test_a_constant_rate_is_events_by_exposure() -> None:
    rates = fit(np.array([[30.0]]), np.array([[1000.0]]), constant(1), None)
    assert np.exp(rates.log_age[0]) == pytest.approx(30.5 / 1000.0, rel=1e-4)
    assert rates.freedom == pytest.approx(1.0, abs=1e-4)


def test_nothing_seen_has_no_rate() -> None:
    rates = fit(np.zeros((3, 1)), np.zeros((3, 1)), constant(3), None)
    assert (np.exp(rates.log_age) < 1e-20).all()
    assert rates.freedom == 0.0


@pytest.mark.parametrize("with_week", [False, True])
def test_newton_ends_where_gradient_and_curvature_say(with_week: bool) -> None:
    """Finite differences of the penalised likelihood, written out."""
    rng = np.random.default_rng(3)
    age = age_basis(LOG_AGE[::6], 4)
    week = Basis(rng.normal(0.0, 1.0, (12, 3)), (), np.zeros((3, 3))).columns if with_week else np.zeros((12, 0))
    n = age.columns.shape[1] + week.shape[1]
    root = rng.normal(0.0, 1.0, (n, n))
    penalty = root @ root.T + np.eye(n)
    exposure = rng.uniform(1.0, 30.0, (10, 12))
    events = rng.poisson(0.3 * exposure).astype(float)

    def loss(beta: FloatArray) -> float:
        log_rate = (age.columns @ beta[: age.columns.shape[1]])[:, None] + (week @ beta[age.columns.shape[1] :])[
            None, :
        ]
        return float((exposure * np.exp(log_rate) - events * log_rate).sum() + 0.5 * beta @ penalty @ beta)

    best, covariance = _newton(np.zeros(n), events, exposure, age.columns, week, penalty)
    h = 1e-3
    steps = h * np.eye(n)
    gradient = [(loss(best + e) - loss(best - e)) / (2.0 * h) for e in steps]
    np.testing.assert_allclose(gradient, 0.0, atol=2e-3)
    curvature = [
        [
            (loss(best + a + b) - loss(best + a - b) - loss(best - a + b) + loss(best - a - b)) / (4.0 * h * h)
            for b in steps
        ]
        for a in steps
    ]
    np.testing.assert_allclose(np.linalg.inv(covariance), curvature, rtol=1e-4, atol=1e-2)
    found = optimize.minimize(loss, np.zeros(n), method="BFGS", options={"gtol": 1e-6})
    np.testing.assert_allclose(best, found.x, atol=1e-4)


def marginal(log_weights: FloatArray, events: FloatArray, exposure: FloatArray, basis: Basis) -> float:
    """Laplace's approximation of the marginal likelihood, up to a constant, without the code under test."""
    n = basis.columns.shape[1]
    prior = 1e-5 * np.eye(n) + sum(np.exp(w) * m for w, m in zip(log_weights, basis.penalties, strict=True))

    def loss(beta: FloatArray) -> float:
        log_rate = basis.columns @ beta
        return float((exposure * np.exp(log_rate) - events * log_rate).sum() + 0.5 * beta @ prior @ beta)

    def slope(beta: FloatArray) -> FloatArray:
        return np.asarray(basis.columns.T @ (exposure * np.exp(basis.columns @ beta) - events) + prior @ beta)

    start = np.full(n, np.log(events.sum() / exposure.sum()))
    best = optimize.minimize(loss, start, jac=slope, method="BFGS", options={"gtol": 1e-7, "maxiter": 2000}).x
    information = (basis.columns.T * (exposure * np.exp(basis.columns @ best))) @ basis.columns + prior
    return float(-loss(best) + 0.5 * np.linalg.slogdet(prior)[1] - 0.5 * np.linalg.slogdet(information)[1])


@pytest.mark.parametrize("bump", [0.0, 1.0, 3.0])
def test_smoothness_is_that_of_the_highest_marginal_likelihood(bump: float) -> None:
    rng = np.random.default_rng(4)
    basis = age_basis(LOG_AGE, 12)
    exposure = np.full(60, 300.0)
    rate = np.exp(-4.0 + bump * np.sin(2.0 * LOG_AGE))
    events = rng.poisson(exposure * rate).astype(float)
    counted = events + HALF_AN_EVENT * exposure / exposure.sum()
    rates = fit(events[:, None], exposure[:, None], basis, None)
    found = marginal(np.log(rates.weights), counted, exposure, basis)
    search = optimize.minimize_scalar(
        lambda w: -marginal(np.array([w]), counted, exposure, basis),
        bounds=(np.log(1e-4), np.log(1e6)),
        method="bounded",
        options={"xatol": 0.01},
    )
    # a likelihood less by 0.02 than the best is as good as the best
    assert found > -search.fun - 0.02


def test_levels_that_do_not_drift_are_found_not_to() -> None:
    rng = np.random.default_rng(5)
    exposure = np.full((20, 1), 100.0)
    steady = fit(rng.poisson(exposure).astype(float), exposure, steady_level(20), None)
    assert np.ptp(steady.log_age) < 0.1
    assert steady.freedom < 4.0
    drift = np.linspace(0.0, 2.0, 20)[:, None]
    drifting = fit(rng.poisson(exposure * np.exp(drift)).astype(float), exposure, steady_level(20), None)
    np.testing.assert_allclose(drifting.log_age, drift[:, 0], atol=4.0 * np.sqrt(1.0 / 100.0))
    assert drifting.freedom > 5.0


def test_an_earlier_fit_is_only_a_place_to_begin() -> None:
    rng = np.random.default_rng(6)
    exposure = rng.uniform(10.0, 20.0, (60, 1))
    events = rng.poisson(0.3 * exposure).astype(float)
    basis = age_basis(LOG_AGE, 12)
    cold = fit(events, exposure, basis, None)
    other = fit(events[::-1].copy(), exposure, basis, None)
    warm = fit(events, exposure, basis, None, other)
    np.testing.assert_allclose(warm.log_age, cold.log_age, atol=0.02)


def test_the_week_is_a_circle() -> None:
    """Its columns go on over midnight of Sunday to Monday as over any other."""
    basis = week_basis()
    daily = basis.columns[:, : basis.penalties[0].shape[0]]
    np.testing.assert_allclose(np.roll(daily, 144, axis=0)[:, :20], daily[:, :20], atol=1e-12)
    for penalty in (*basis.penalties, basis.fixed):
        np.testing.assert_allclose(penalty, penalty.T, atol=1e-12)
        assert np.linalg.eigvalsh(penalty).min() > -1e-9
