"""The hazard regression against brute force, simulated truths, and what its bands promise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats

from evermap.errors import ConfigError, DataError
from evermap.existence import single
from evermap.survival import Exponential, LifetimePrior, LogNormal, PiecewiseConstantHazard, Weibull
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.gaussian_process import DAY_S, Covariates, gp_fit
from evermap.survival.hazard_regression import Exposures, HazardDraws, Term, learn, overlaps
from evermap.survival.parametric_fit import log_likelihood
from evermap.types import FloatArray

INF = float("inf")


def visited(lifetime: FloatArray, visit_s: float, seed: int) -> CensoredLifetimes:
    """Looked at twenty times, a random while apart."""
    rng = np.random.default_rng(seed)
    n = len(lifetime)
    visits = np.cumsum(rng.exponential(visit_s, (n, 20)), axis=1)
    visits = np.hstack([np.zeros((n, 1)), visits, np.full((n, 1), INF)])
    last, rows = (visits < lifetime[:, None]).sum(axis=1) - 1, np.arange(n)
    return CensoredLifetimes.of(visits[rows, last], visits[rows, last + 1])


MIXED = CensoredLifetimes.of(
    [1.0, 0.5, 3.0, 0.0, 2.0, 0.2], [1.0, 2.0, INF, 0.7, 4.0, 9.0], [0.2, 0.8, 1.0, 0.0, 0.0, 0.0], [1, 2, 1, 1, 3, 1]
)


def test_likelihood_is_that_of_the_prior_with_the_same_rates() -> None:
    edges, baseline = np.array([0.0, 0.6, 1.5, 3.0]), np.array([0.5, 0.3, 0.7, 0.2])
    f = np.array([0.3, -0.2, 0.5, -1.0])
    samples = Exposures.of(MIXED, edges, baseline, np.zeros(6, dtype=np.int64))
    prior = PiecewiseConstantHazard(tuple(edges), tuple(baseline * np.exp(f)))
    np.testing.assert_allclose(samples.log_likelihood(np.tile(f, (6, 1))), log_likelihood(prior, MIXED), rtol=1e-12)


def test_laplace_is_the_maximum_and_curvature_that_scipy_finds() -> None:
    rng = np.random.default_rng(0)
    group = np.array([0, 1, 0, 1, 1, 0])
    edges, baseline = np.array([0.0, 0.6, 1.5, 3.0]), np.full(4, 0.4)
    samples = Exposures.of(MIXED, edges, baseline, group)
    curves, levels = rng.normal(size=(2, 4, 3)), rng.normal(size=(6, 2))
    root = rng.normal(size=(3, 3))
    precision = root @ root.T + np.eye(3)
    found = learn(samples, [Term(curves=curves, precision=precision, scale=0.8), Term(levels=levels, scale=0.5)])

    def cost(u: FloatArray) -> float:
        f = (curves @ u[:3])[group] + (levels @ u[3:])[:, None]
        prior = 0.5 * u[:3] @ precision @ u[:3] / 0.64 + 0.5 * u[3:] @ u[3:] / 0.25
        return float(prior - MIXED.weight @ samples.log_likelihood(f))

    best: Any = scipy.optimize.minimize(cost, np.zeros(5), tol=1e-12)
    np.testing.assert_allclose(found.mean, best.x, atol=1e-4)
    steps = 1e-3 * np.eye(5)
    hessian = np.array(
        [
            [
                cost(found.mean + a + b)
                - cost(found.mean + a - b)
                - cost(found.mean - a + b)
                + cost(found.mean - a - b)
                for b in steps
            ]
            for a in steps
        ]
    ) / (4e-6)
    np.testing.assert_allclose(np.linalg.inv(found.covariance), hessian, rtol=1e-4, atol=1e-4)


def test_evidence_is_near_the_integral_over_a_single_level() -> None:
    stays = Exponential(0.5).sample(1, 40)
    samples = Exposures.of(CensoredLifetimes.of(stays, stays), np.zeros(1), np.ones(1), np.zeros(40, dtype=np.int64))
    found = learn(samples, [Term(curves=np.ones((1, 1, 1)), scale=1.5)])

    def joint(u: float) -> float:
        loglik = float(samples.log_likelihood(np.full((40, 1), u)).sum())
        return math.exp(loglik - found.log_evidence) * scipy.stats.norm.pdf(u, scale=1.5)

    total, _ = scipy.integrate.quad(joint, -3.0, 2.0)
    assert total == pytest.approx(1.0, abs=0.01)


def test_scales_are_learned() -> None:
    """Fifty levels drawn with a scale of 0.8, forty exact stays each."""
    rng = np.random.default_rng(3)
    column = np.repeat(np.arange(50), 40)
    stays = rng.exponential(np.exp(-0.8 * rng.standard_normal(50)[column]))
    samples = Exposures.of(CensoredLifetimes.of(stays, stays), np.zeros(1), np.ones(1), np.zeros(2000, dtype=np.int64))
    found = learn(samples, [Term(levels=np.eye(50)[column])])
    assert found.scales[0] == pytest.approx(0.8, rel=0.25)  # a standard deviation of 50 is known to a tenth


def test_draws_answer_as_their_mean_and_as_a_prior() -> None:
    rng = np.random.default_rng(4)
    edges = np.array([0.0, 1.0, 4.0])
    draws = HazardDraws(edges, np.exp(rng.normal(-1.0, 0.5, (200, 3))))
    t = np.array([0.0, 0.5, 1.0, 3.0, 4.0, 7.0])
    each = np.array([np.exp(PiecewiseConstantHazard(tuple(edges), tuple(r)).log_survival(t)) for r in draws.rates])
    mean, lower, upper = draws.survival(t, confidence=0.8)
    np.testing.assert_allclose(mean, each.mean(axis=0))
    np.testing.assert_allclose([lower, upper], np.quantile(each, [0.1, 0.9], axis=0))
    times = [PiecewiseConstantHazard(tuple(edges), tuple(r)).quantile(0.6) for r in draws.rates]
    np.testing.assert_allclose(draws.quantile(0.6, 0.8), np.quantile(times, [0.5, 0.1, 0.9]))
    np.testing.assert_allclose(np.exp(draws.prior().log_survival(edges)), draws.survival(edges)[0])
    for late in (8.0, 64.0, 512.0):  # not a constant hazard: the draws that leave late are those that are left
        assert draws.prior().log_survival(late) == pytest.approx(math.log(draws.survival(late)[0]))
    with pytest.raises(ConfigError, match=r"confidence"):
        draws.survival(t, 0.0)


def test_overlaps_add_up() -> None:
    rng = np.random.default_rng(5)
    first, length = rng.uniform(0.0, 5.0, 50), rng.uniform(0.0, 9.0, 50)
    spent = overlaps(first, first + length, np.array([0.0, 1.0, 2.5, 6.0]))
    np.testing.assert_allclose(spent.sum(axis=1), length)
    inside = (np.minimum(first + length, 2.5) - np.maximum(first, 1.0)).clip(0.0)
    np.testing.assert_allclose(spent[:, 1], inside)


TRUTHS: dict[int, LifetimePrior] = {2: Weibull(4e4, 0.8), 5: LogNormal(10.0, 0.8), 9: Weibull(2e5, 2.0)}


def of_classes(n: int, seed: int) -> tuple[CensoredLifetimes, Any]:
    rng = np.random.default_rng(seed)
    class_id = rng.choice(list(TRUTHS), n)
    lifetime = np.array([TRUTHS[int(k)].sample(rng) for k in class_id])
    return visited(lifetime, 1e4, seed), class_id


def test_curves_of_classes_come_near_the_truth() -> None:
    data, class_id = of_classes(6000, 0)
    hazard = gp_fit(data, Covariates(class_id=class_id))
    for k, truth in TRUTHS.items():
        t = truth.quantile([0.1, 0.3, 0.5, 0.7, 0.9])
        mean, lower, upper = hazard.at(class_id=k).survival(t)
        np.testing.assert_allclose(mean, [0.9, 0.7, 0.5, 0.3, 0.1], atol=0.04)
        assert (upper - lower).max() < 0.1


@pytest.mark.slow
def test_bands_of_classes_cover_the_truth() -> None:
    """Of 95 % bands 93 to 96 % do; the log-normal, whose hazard falls faster than any power of time, costs most."""
    covered = []
    for seed in range(40):
        data, class_id = of_classes(400, 100 + seed)
        hazard = gp_fit(data, Covariates(class_id=class_id))
        for k, truth in TRUTHS.items():
            gone = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
            _, lower, upper = hazard.at(class_id=k).survival(truth.quantile(gone))
            covered.append((lower <= 1.0 - gone) & (1.0 - gone <= upper))
    assert 0.91 <= np.mean(covered) <= 0.99


def test_every_covariate_is_followed() -> None:
    """Factors of the hazard at two values of each, against the truth that made the samples."""
    rng = np.random.default_rng(6)
    n = 3000
    size, hour = rng.uniform(0.5, 4.0, n), rng.uniform(0.0, 24.0, n)
    place, speed = rng.uniform(0.0, 50.0, (n, 2)), rng.uniform(0.0, 2.0, n)
    effect = -0.6 * size + np.cos(2.0 * np.pi * hour / 24.0) + 0.8 * np.sin(place[:, 0] / 8.0)
    data = visited(np.asarray(rng.exponential(3e4 * np.exp(-effect))), 1e4, 7)
    known = Covariates(place_m=place, size_m=size, speed_mps=speed, time_of_day_s=hour * 3600.0)
    hazard = gp_fit(data, known)
    usual: dict[str, Any] = {
        "place_m": (25.0, 25.0), "size_m": 2.0, "speed_mps": 1.0, "time_of_day_s": 6.0 * 3600.0
    }  # fmt: skip

    def change(name: str, first: Any, second: Any) -> float:
        """Log factor of the cumulative hazard from one value to another."""
        rates = [hazard.at(**(usual | {name: value})).prior().cumulative_hazard(2e4) for value in (first, second)]
        return math.log(rates[1] / rates[0])

    assert change("size_m", 1.0, 3.0) == pytest.approx(-1.2, abs=0.25)
    assert change("time_of_day_s", 0.0, 12 * 3600.0) == pytest.approx(-2.0, abs=0.35)
    assert change("place_m", (12.0, 25.0), (37.0, 25.0)) == pytest.approx(
        0.8 * (math.sin(37.0 / 8.0) - math.sin(1.5)), abs=0.35
    )
    assert change("speed_mps", 0.5, 1.5) == pytest.approx(0.0, abs=0.2)
    assert change("time_of_day_s", 0.0, DAY_S) == pytest.approx(0.0, abs=1e-6)
    without = {name: Covariates(**(known.columns() | {name: None})) for name in ("speed_mps", "time_of_day_s")}
    assert hazard.log_evidence < gp_fit(data, without["speed_mps"]).log_evidence + 3.0  # it says nothing
    assert hazard.log_evidence > gp_fit(data, without["time_of_day_s"]).log_evidence + 100.0


def test_time_may_be_counted_in_any_unit() -> None:
    data, class_id = of_classes(300, 8)
    in_days = CensoredLifetimes.of(data.left_s / DAY_S, data.right_s / DAY_S)
    t = np.array([1e4, 1e5])
    plain = gp_fit(data, Covariates(class_id=class_id)).at(class_id=5).survival(t)
    scaled = gp_fit(in_days, Covariates(class_id=class_id)).at(class_id=5).survival(t / DAY_S)
    np.testing.assert_allclose(plain, scaled, atol=1e-3)


def test_without_covariates_and_a_filter_takes_it() -> None:
    truth = Weibull(3e4, 1.2)
    hazard = gp_fit(visited(truth.sample(9, 1500), 1e4, 9)).at()
    prior = hazard.prior()
    np.testing.assert_allclose(np.exp(prior.log_survival(truth.quantile([0.2, 0.5, 0.8]))), [0.8, 0.5, 0.2], atol=0.05)
    belief = single.init(1, prior).predict(2e4)
    assert belief[0] == pytest.approx(math.exp(prior.log_survival(2e4)))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ([5.0], [5.0]),
        ([5.0], [9.0]),
        ([3.0] * 50, [3.0] * 50),
        ([3e-9, 5e-9], [3e-9, 6e-9]),
        ([1e3, 5e12], [1e4, 6e12]),
    ],
)
def test_few_and_equal_samples_have_an_answer_near_them(left: list[float], right: list[float]) -> None:
    hazard = gp_fit(CensoredLifetimes.of(left, right)).at()
    median, lower, upper = hazard.quantile(0.5)
    assert 0.3 * min(left) < median < 3.0 * max(right)
    assert 0.0 < lower < median < upper
    assert math.isfinite(hazard.prior().mean())


def test_what_does_not_fit_is_refused() -> None:
    data = CensoredLifetimes.of([1.0, 2.0, 1.0], [2.0, 3.0, 4.0])
    with pytest.raises(DataError, match=r"class_id.*2 rows for 3"):
        gp_fit(data, Covariates(class_id=np.array([0, 1])))
    with pytest.raises(DataError, match=r"size_m.*2 rows, others 3"):
        Covariates(class_id=np.zeros(3, dtype=np.int64), size_m=np.zeros(2))
    with pytest.raises(DataError, match=r"speed_mps.*row 1"):
        Covariates(speed_mps=np.array([0.0, INF]))
    hazard = gp_fit(data, Covariates(class_id=np.array([3, 3, 8])))
    with pytest.raises(DataError, match=r"class 4 was never seen.*3, 8"):
        hazard.at(class_id=4)
    with pytest.raises(DataError, match=r"class_id.*is needed"):
        hazard.at()
    with pytest.raises(DataError, match=r"size_m.*not learned from"):
        hazard.at(class_id=3, size_m=1.0)
