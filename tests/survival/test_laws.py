"""Laws that every lifetime obeys, whatever its formula."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from evermap import survival
from evermap.errors import ConfigError
from evermap.survival import LifetimePrior
from evermap_studies.rosen2016.callable_hazard import CallableHazard

CONTINUOUS: dict[str, LifetimePrior] = {
    "exponential": survival.Exponential(2e-3),
    "general purpose": survival.GeneralPurpose(1e-3, 1.0),
    "general purpose, narrow": survival.GeneralPurpose(1e-2, 1.2e-2),
    "uniform": survival.Uniform(500.0),
    "weibull": survival.Weibull(300.0, 0.7),
    "log-normal": survival.LogNormal(5.0, 1.2),
    "gamma": survival.Gamma(100.0, 2.5),
    "mixture": survival.Mixture((survival.Exponential(0.1), survival.Uniform(800.0)), (0.4, 0.6)),
    "piecewise": survival.PiecewiseConstantHazard((0.0, 10.0, 50.0), (0.05, 0.0, 0.002)),
    "periodic": survival.PeriodicHazard(24.0, (0.0, 8.0, 18.0), (0.0, 0.01, 0.002), start_s=11.0),
    "callable": CallableHazard(lambda t: 0.01 / (1.0 + t / 50.0) + 1e-3, horizon_s=1e4),
    "intervals": survival.StepLifetime((0.0, 20.0), (10.0, 400.0), (0.3, 0.7)),
    "scaled": survival.ScaledHazard(survival.Weibull(300.0, 0.7), (0.0, 30.0, 200.0), (0.5, 3.0, 1.2)),
}
SOME_STAY: dict[str, LifetimePrior] = {
    "scaled, some stay": survival.ScaledHazard(
        survival.Mixture((survival.never_leaves(), survival.Exponential(0.01)), (0.3, 0.7)), (0.0, 50.0), (2.0, 0.3)
    ),
    "piecewise, some stay": survival.PiecewiseConstantHazard((0.0, 100.0), (0.01, 0.0)),
    "callable, some stay": CallableHazard(lambda t: np.exp(-t / 100.0) / 100.0, 1e5, rate_after=0.0),
    "mixture, some stay": survival.Mixture((survival.never_leaves(), survival.Exponential(0.01)), (0.3, 0.7)),
    "points": survival.StepLifetime.at_points((5.0, 60.0, math.inf), (0.5, 0.3, 0.2)),
    "turnbull": survival.StepLifetime((10.0, 30.0, 100.0), (20.0, 30.0, math.inf), (0.5, 0.25, 0.25)),
}
ALL = CONTINUOUS | SOME_STAY


@pytest.fixture(params=ALL, ids=str)
def prior(request: pytest.FixtureRequest) -> LifetimePrior:
    return ALL[request.param]


@pytest.fixture
def triples() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    times = np.sort(np.exp(rng.uniform(np.log(1e-3), np.log(450.0), (3, 400))), axis=0)
    return times[0], times[1], times[2]


def test_is_a_lifetime_prior(prior: LifetimePrior) -> None:
    assert isinstance(prior, LifetimePrior)


def test_survival_starts_at_one_and_never_increases(prior: LifetimePrior) -> None:
    t = np.concatenate(([0.0], np.geomspace(1e-9, 1e12, 500)))
    log_s = prior.log_survival(t)
    assert log_s[0] == 0.0
    assert np.all(np.diff(log_s[np.isfinite(log_s)]) <= 0.0)
    assert np.all(np.diff(np.exp(log_s)) <= 0.0)
    np.testing.assert_array_equal(prior.cumulative_hazard(t), -log_s)


def test_conditional_survival_chains(prior: LifetimePrior, triples: tuple[np.ndarray, ...]) -> None:
    a, b, c = triples
    whole = prior.log_conditional_survival(a, c)
    parts = prior.log_conditional_survival(a, b) + prior.log_conditional_survival(b, c)
    np.testing.assert_allclose(parts, whole, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(
        prior.log_survival(a) + prior.log_conditional_survival(a, b), prior.log_survival(b), rtol=1e-11
    )


def test_to_live_or_to_die_is_certain(prior: LifetimePrior, triples: tuple[np.ndarray, ...]) -> None:
    a, _, c = triples
    total = np.exp(prior.log_conditional_survival(a, c)) + np.exp(prior.log_conditional_death(a, c))
    np.testing.assert_allclose(total, 1.0, rtol=0.0, atol=1e-14)


def test_equal_times_are_survived(prior: LifetimePrior) -> None:
    t = np.array([0.0, 1e-9, 5.0, 60.0, 1e3, 1e12])
    np.testing.assert_array_equal(prior.log_conditional_survival(t, t), 0.0)
    np.testing.assert_array_equal(prior.log_conditional_death(t, t), -np.inf)


def test_arrays_broadcast_and_scalars_stay_scalars(prior: LifetimePrior) -> None:
    a, b = np.array([[1.0], [2.0]]), np.array([3.0, 4.0, 5.0])
    table = prior.log_conditional_death(a, b)
    assert table.shape == (2, 3)
    assert table[1, 2] == pytest.approx(float(prior.log_conditional_death(2.0, 5.0)), rel=1e-13)
    assert np.ndim(prior.log_survival(3.0)) == np.ndim(prior.quantile(0.1)) == np.ndim(prior.sample(1)) == 0
    assert prior.log_survival(np.empty((0, 3))).shape == prior.hazard(np.empty((0, 3))).shape == (0, 3)
    assert prior.sample(1, (2, 5)).shape == (2, 5)
    assert prior.sample(1, 0).shape == (0,)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, [1.0, -1e-9]])
def test_bad_times_are_refused(prior: LifetimePrior, bad: object) -> None:
    for ask in (prior.log_survival, prior.hazard, prior.cumulative_hazard, prior.log_density):
        with pytest.raises(ConfigError):
            ask(bad)
    with pytest.raises(ConfigError):
        prior.log_conditional_survival(bad, 10.0)


def test_time_going_back_names_the_row(prior: LifetimePrior) -> None:
    with pytest.raises(ConfigError, match="row 1"):
        prior.log_conditional_death([1.0, 3.0], 2.0)


def test_quantiles_invert_the_distribution(prior: LifetimePrior) -> None:
    p = np.array([1e-6, 0.01, 0.2, 0.5, 0.7, 0.95])
    t = prior.quantile(p)
    reached = np.isfinite(t)
    np.testing.assert_array_equal(reached, p <= 1.0 - prior.p_never_leaves)
    died = -np.expm1(prior.log_survival(t[reached]))
    assert np.all(died >= p[reached] * (1.0 - 1e-9))
    before = -np.expm1(prior.log_survival(t[reached] * (1.0 - 1e-9)))
    assert np.all(before <= p[reached] * (1.0 + 1e-9))
    assert prior.quantile(0.0) == 0.0
    with pytest.raises(ConfigError):
        prior.quantile(1.5)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_density_is_the_slope_of_survival(name: str) -> None:
    prior = CONTINUOUS[name]
    t = np.array([0.37, 3.3, 15.1, 44.4, 123.4, 377.0])
    step = 1e-5 * t
    slope = (np.exp(prior.log_survival(t - step)) - np.exp(prior.log_survival(t + step))) / (2 * step)
    np.testing.assert_allclose(np.exp(prior.log_density(t)), slope, rtol=1e-6, atol=1e-11)
    np.testing.assert_allclose(prior.hazard(t), slope / np.exp(prior.log_survival(t)), rtol=1e-6, atol=1e-11)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_mean_is_the_integral_of_survival(name: str) -> None:
    prior = CONTINUOUS[name]
    # In log t, on pieces short enough for the kinks of some of them.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    edges = np.linspace(-20.0, 13.0, 20_001)
    u = edges[:-1, None] + np.diff(edges)[:, None] * 0.5 * (nodes + 1.0)
    integral = np.exp(-20.0) + float(
        np.sum((np.exp(u + prior.log_survival(np.exp(u))) @ weights) * 0.5 * np.diff(edges))
    )
    assert prior.mean() == pytest.approx(integral, rel=1e-6)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_samples_follow_the_distribution(name: str) -> None:
    prior = CONTINUOUS[name]
    draws = prior.sample(5, 4000)
    np.testing.assert_array_equal(draws, prior.sample(np.random.default_rng(5), 4000))
    assert stats.kstest(draws, lambda t: -np.expm1(prior.log_survival(t))).pvalue > 1e-3


@pytest.mark.parametrize("name", SOME_STAY)
def test_some_never_leave(name: str) -> None:
    prior = SOME_STAY[name]
    stay = prior.p_never_leaves
    assert 0.0 < stay < 1.0
    assert math.exp(prior.log_survival(1e12)) == pytest.approx(stay, rel=1e-9)
    assert math.isinf(prior.mean())
    draws = prior.sample(11, 20_000)
    assert np.isinf(draws).mean() == pytest.approx(stay, abs=0.012)
    for t in (3.0, 15.0, 59.0, 61.0):
        assert (draws > t).mean() == pytest.approx(math.exp(prior.log_survival(t)), abs=0.015)


@pytest.mark.parametrize(
    ("slow", "fast"),
    [
        (survival.GeneralPurpose(1e-3, 1.0), survival.GeneralPurpose(1e3, 1e6)),
        (survival.Weibull(1e4, 1.7), survival.Weibull(1e-2, 1.7)),
        (survival.Gamma(1e4, 0.6), survival.Gamma(1e-2, 0.6)),
        (survival.LogNormal(math.log(1e4), 2.0), survival.LogNormal(math.log(1e-2), 2.0)),
    ],
    ids=lambda prior: type(prior).__name__,
)
def test_only_the_ratio_of_times_to_the_scale_matters(slow: LifetimePrior, fast: LifetimePrior) -> None:
    a = np.geomspace(1e-2, 1e6, 60)
    for b in (a * 1.0000001, a * 3.0):
        np.testing.assert_allclose(
            slow.log_conditional_survival(a, b),
            fast.log_conditional_survival(a * 1e-6, b * 1e-6),
            rtol=1e-8,
            atol=1e-300,
        )


@pytest.mark.parametrize("name", CONTINUOUS)
def test_a_mixture_of_one_is_that_one(name: str, triples: tuple[np.ndarray, ...]) -> None:
    prior = CONTINUOUS[name]
    mixed = survival.Mixture((prior,), (1.0,))
    a, b, _ = triples
    for ask in ("log_conditional_survival", "log_conditional_death"):
        np.testing.assert_allclose(getattr(mixed, ask)(a, b), getattr(prior, ask)(a, b), rtol=1e-12)
    for ask in ("log_survival", "hazard", "log_density"):
        np.testing.assert_allclose(getattr(mixed, ask)(a), getattr(prior, ask)(a), rtol=1e-12)
