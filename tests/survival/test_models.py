"""What each model says about itself: scipy's distributions, the words of the named constructors, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from evermap import survival
from evermap.errors import ConfigError
from evermap.survival import LifetimePrior
from evermap_studies.rosen2016.callable_hazard import CallableHazard

HOUR_S, DAY_S = 3600.0, 86400.0


@pytest.mark.parametrize(
    ("prior", "theirs"),
    [
        (survival.Exponential(0.2), stats.expon(scale=5.0)),
        (survival.Uniform(20.0), stats.uniform(0.0, 20.0)),
        (survival.Weibull(4.0, 0.6), stats.weibull_min(0.6, scale=4.0)),
        (survival.Weibull(4.0, 2.6), stats.weibull_min(2.6, scale=4.0)),
        (survival.LogNormal(1.5, 0.8), stats.lognorm(0.8, scale=math.exp(1.5))),
        (survival.Gamma(2.0, 0.4), stats.gamma(0.4, scale=2.0)),
        (survival.Gamma(2.0, 7.5), stats.gamma(7.5, scale=2.0)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_agrees_with_scipy(prior: LifetimePrior, theirs: object) -> None:
    t = np.array([0.01, 0.5, 2.0, 5.0, 11.0, 19.0])
    np.testing.assert_allclose(prior.log_survival(t), theirs.logsf(t), rtol=1e-9)
    np.testing.assert_allclose(prior.log_density(t), theirs.logpdf(t), rtol=1e-9)
    np.testing.assert_allclose(prior.hazard(t), np.exp(theirs.logpdf(t) - theirs.logsf(t)), rtol=1e-9)
    p = np.array([1e-12, 0.01, 0.3, 0.5, 0.9, 0.999])
    np.testing.assert_allclose(prior.quantile(p), theirs.ppf(p), rtol=1e-9)
    assert prior.mean() == pytest.approx(theirs.mean(), rel=1e-12)


def test_general_purpose_is_the_exponential_averaged_over_its_rate() -> None:
    prior = survival.GeneralPurpose(1e-3, 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    rates = 1e-3 * np.exp(0.5 * (nodes + 1.0) * math.log(1e3))
    t = np.array([0.1, 1.0, 30.0, 400.0, 5000.0])
    expected = np.exp(-rates * t[:, None]) @ (0.5 * weights)
    np.testing.assert_allclose(np.exp(prior.log_survival(t)), expected, rtol=1e-12)
    expected = (rates * np.exp(-rates * t[:, None])) @ (0.5 * weights)
    np.testing.assert_allclose(np.exp(prior.log_density(t)), expected, rtol=1e-12)


def test_words() -> None:
    assert math.exp(survival.Exponential.from_half_life(90.0).log_survival(90.0)) == pytest.approx(0.5, rel=1e-14)
    assert survival.Exponential.from_mean(90.0).mean() == pytest.approx(90.0, rel=1e-14)
    assert math.exp(survival.LogNormal.from_half_life(90.0, 2.0).log_survival(90.0)) == pytest.approx(0.5, rel=1e-14)
    assert survival.GeneralPurpose.from_mean_stays(1.0, DAY_S) == survival.GeneralPurpose(1.0 / DAY_S, 1.0)
    walls = survival.never_leaves()
    assert walls.log_survival(1e12) == 0.0
    assert walls.p_never_leaves == 1.0
    assert math.isinf(walls.sample(0))


def test_gone_overnight_leaves_at_night_only() -> None:
    prior = survival.gone_daily(0.3, first_seen_hour=12.0, hours=(20.0, 6.0))
    hours = np.array([8.0, 18.0, 32.0, 42.0, 66.0])  # 20:00, 06:00, 20:00, 06:00, 06:00
    np.testing.assert_allclose(np.exp(prior.log_survival(hours * HOUR_S)), [1.0, 0.7, 0.7, 0.49, 0.343], rtol=1e-12)
    assert prior.hazard(1.0 * HOUR_S) == 0.0
    assert prior.hazard(13.0 * HOUR_S) > 0.0


def test_gone_by_day_leaves_by_day_only() -> None:
    prior = survival.gone_daily(0.5, first_seen_hour=13.0, hours=(8.0, 18.0))
    hours = np.array([5.0, 19.0, 29.0, 43.0])  # 18:00, 08:00, 18:00, 08:00
    half_a_day = math.sqrt(0.5)
    expected = [half_a_day, half_a_day, 0.5 * half_a_day, 0.5 * half_a_day]
    np.testing.assert_allclose(np.exp(prior.log_survival(hours * HOUR_S)), expected, rtol=1e-12)


def test_points_of_mass() -> None:
    prior = survival.StepLifetime.at_points((5.0, 60.0, math.inf), (0.5, 0.3, 0.2))
    np.testing.assert_allclose(np.exp(prior.log_survival([4.9, 5.0, 59.0, 60.0, 1e9])), [1.0, 0.5, 0.5, 0.2, 0.2])
    np.testing.assert_array_equal(prior.quantile([0.5, 0.6, 0.8, 0.81]), [5.0, 60.0, 60.0, math.inf])
    np.testing.assert_array_equal(prior.hazard([5.0, 6.0, 60.0]), [math.inf, 0.0, math.inf])
    assert set(prior.sample(3, 500)) == {5.0, 60.0, math.inf}
    ends = survival.StepLifetime.at_points((5.0,), (1.0,))
    assert ends.log_survival(5.0) == ends.log_conditional_survival(6.0, 7.0) == -math.inf
    assert ends.log_conditional_death(6.0, 7.0) == 0.0
    assert ends.mean() == 5.0


def test_nobody_outlives_a_limit() -> None:
    prior = survival.Uniform(100.0)
    assert prior.log_conditional_survival(40.0, 100.0) == -math.inf
    assert prior.log_conditional_death(40.0, 101.0) == 0.0
    assert prior.log_density(100.5) == -math.inf
    assert prior.quantile(1.0) == 100.0
    assert survival.Mixture((prior, prior), (0.5, 0.5)).log_conditional_death(200.0, 201.0) == 0.0


def test_a_callable_hazard_finds_jumps_and_equals_the_pieces() -> None:
    written = survival.PiecewiseConstantHazard((0.0, 3.0, 500.0), (1.5, 1e-7, 2e-3))
    computed = CallableHazard(lambda t: np.where(t < 3.0, 1.5, np.where(t < 500.0, 1e-7, 2e-3)), horizon_s=1e4)
    a = np.array([0.0, 1.0, 2.999, 3.1, 40.0, 499.0, 2e4])
    b = np.array([1.0, 3.5, 3.001, 3.2, 700.0, 501.0, 3e4])
    for ask in ("log_conditional_survival", "log_conditional_death"):
        np.testing.assert_allclose(getattr(computed, ask)(a, b), getattr(written, ask)(a, b), rtol=1e-10)
    assert computed.mean() == pytest.approx(written.mean(), rel=1e-9)


def test_a_hazard_of_finite_integral_says_who_stays() -> None:
    prior = CallableHazard(lambda t: 2.0 * np.exp(-t), horizon_s=100.0, rate_after=0.0)
    assert prior.p_never_leaves == pytest.approx(math.exp(-2.0), rel=1e-12)
    assert survival.PiecewiseConstantHazard((0.0, 10.0), (0.1, 0.0)).p_never_leaves == pytest.approx(math.exp(-1.0))
    assert survival.PeriodicHazard(1.0, (0.0,), (0.0,)).p_never_leaves == 1.0


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: survival.Exponential(0.0), "rate"),
        (lambda: survival.Exponential.from_half_life(-1.0), "half_life"),
        (lambda: survival.Exponential.from_mean(math.nan), "mean_stay"),
        (lambda: survival.GeneralPurpose(1.0, 1.0), "high"),
        (lambda: survival.Uniform(math.inf), "limit_s"),
        (lambda: survival.Weibull(1.0, -2.0), "shape"),
        (lambda: survival.LogNormal(math.nan, 1.0), "mu"),
        (lambda: survival.Gamma(0.0, 1.0), "scale_s"),
        (lambda: survival.Mixture((), ()), "weights"),
        (lambda: survival.Mixture((survival.Uniform(1.0),), (0.9,)), "weights"),
        (lambda: survival.Mixture.of((survival.Uniform(1.0),), (math.nan,)), "shares"),
        (lambda: survival.StepLifetime((2.0,), (1.0,), (1.0,)), "ends_s"),
        (lambda: survival.StepLifetime((math.nan,), (1.0,), (1.0,)), "ends_s"),
        (lambda: survival.StepLifetime.at_points((0.0,), (1.0,)), "ends_s"),
        (lambda: survival.StepLifetime.at_points((1.0,), (0.5,)), "masses"),
        (lambda: survival.PiecewiseConstantHazard((0.0, 1.0), (0.1, -0.1)), "rates"),
        (lambda: survival.PiecewiseConstantHazard((1.0,), (0.1,)), "edges_s"),
        (lambda: survival.PiecewiseConstantHazard((0.0, 2.0, 2.0), (0.1, 0.1, 0.1)), "edges_s"),
        (lambda: survival.PeriodicHazard(24.0, (0.0, 25.0), (0.1, 0.1)), "edges_s"),
        (lambda: survival.PeriodicHazard(24.0, (0.0, 5.0), (0.1, math.nan)), "rates"),
        (lambda: survival.PeriodicHazard(24.0, (0.0,), (0.1,), start_s=24.0), "start_s"),
        (lambda: CallableHazard(lambda t: 0.1 - t, 10.0), "hazard"),
        (lambda: CallableHazard(lambda t: 1.0 / t, 10.0), "hazard"),
        (lambda: CallableHazard(lambda t: np.ones(3), 10.0), "hazard"),
        (lambda: CallableHazard(lambda t: 0.1, 10.0, rate_after=-1.0), "rate_after"),
        (lambda: survival.gone_daily(1.0, first_seen_hour=3.0, hours=(20.0, 6.0)), "probability"),
        (lambda: survival.gone_daily(0.5, first_seen_hour=24.0, hours=(20.0, 6.0)), "first_seen_hour"),
    ],
)
def test_refuses_what_is_no_lifetime(make: object, field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        make()
    assert caught.value.field == field
