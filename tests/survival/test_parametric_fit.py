"""Maximum likelihood fits against lifelines, scipy and closed forms."""

from __future__ import annotations

import math
from typing import Any

import lifelines
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.errors import ConfigError, DataError, NumericalError
from evermap.existence import single
from evermap.survival import Exponential, Gamma, LifetimePrior, LogNormal, Mixture, Weibull, never_leaves
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.parametric_fit import KINDS, Kind, fit, fit_best, log_likelihood

INF = float("inf")
N = 400


def intervals(prior: LifetimePrior, seed: int, visit_s: float) -> CensoredLifetimes:
    """Seen at visits a random while apart, until the twelfth."""
    rng = np.random.default_rng(seed)
    lifetime = prior.sample(rng, N)
    visits = np.cumsum(rng.exponential(visit_s, (N, 12)), axis=1)
    visits = np.hstack([np.zeros((N, 1)), visits, np.full((N, 1), INF)])
    last_seen = (visits < lifetime[:, None]).sum(axis=1) - 1
    rows = np.arange(N)
    return CensoredLifetimes.of(visits[rows, last_seen], visits[rows, last_seen + 1])


def right_censored(prior: LifetimePrior, seed: int, entry_s: float, until_s: float) -> CensoredLifetimes:
    rng = np.random.default_rng(seed)
    lifetime, entry = prior.sample(rng, 3 * N), rng.uniform(0.0, entry_s, 3 * N)
    heard_of = lifetime > entry
    lifetime, entry = lifetime[heard_of], entry[heard_of]
    censored = entry + rng.exponential(until_s, len(entry))
    left = np.minimum(lifetime, censored)
    weight = rng.integers(1, 4, len(entry))
    return CensoredLifetimes.of(left, np.where(lifetime <= censored, left, INF), entry, weight)


FITTERS: dict[str, Any] = {
    "exponential": lifelines.ExponentialFitter,
    "weibull": lifelines.WeibullFitter,
    "lognormal": lifelines.LogNormalFitter,
}


def as_theirs(kind: str, prior: Any) -> dict[str, float]:
    match kind:
        case "exponential":
            return {"lambda_": 1.0 / prior.rate}
        case "weibull":
            return {"lambda_": prior.scale_s, "rho_": prior.shape}
        case _:
            return {"mu_": prior.mu, "sigma_": prior.sigma}


@pytest.mark.parametrize("kind", FITTERS)
def test_intervals_as_lifelines(kind: str) -> None:
    data = intervals(Weibull(4.0, 1.3), 0, 1.0)
    mine = fit(kind, data)
    theirs = FITTERS[kind]().fit_interval_censoring(data.left_s, data.right_s)
    assert mine.loglik >= theirs.log_likelihood_ - 1e-7
    assert mine.loglik == pytest.approx(theirs.log_likelihood_, rel=1e-6)
    for name, value in as_theirs(kind, mine.prior).items():
        assert value == pytest.approx(getattr(theirs, name), rel=1e-3)
    assert mine.aic == pytest.approx(theirs.AIC_, rel=1e-6)


@pytest.mark.parametrize("kind", FITTERS)
def test_right_censored_with_entries_and_weights_as_lifelines(kind: str) -> None:
    data = right_censored(Weibull(4.0, 1.3), 1, 2.0, 6.0)
    mine = fit(kind, data)
    theirs = FITTERS[kind]().fit_right_censoring(data.left_s, data.exact, entry=data.entry_s, weights=data.weight)
    assert mine.loglik == pytest.approx(theirs.log_likelihood_, rel=1e-6)
    # theirs are of the parameters, ours of their logarithms
    errors = dict(zip(mine.names, mine.standard_errors, strict=True))
    theirs_errors = theirs.summary["se(coef)"]
    match kind:
        case "exponential":
            assert errors["log_rate"] == pytest.approx(theirs_errors["lambda_"] / theirs.lambda_, rel=1e-3)
        case "weibull":
            assert errors["log_scale_s"] == pytest.approx(theirs_errors["lambda_"] / theirs.lambda_, rel=1e-3)
            assert errors["log_shape"] == pytest.approx(theirs_errors["rho_"] / theirs.rho_, rel=1e-3)
        case _:
            assert errors["mu"] == pytest.approx(theirs_errors["mu_"], rel=1e-3)


def test_gamma_as_scipy() -> None:
    times = Gamma(3.0, 2.5).sample(3, N)
    left, right = np.where(times < 8.0, times, 8.0), np.where(times < 8.0, times, INF)
    mine: Any = fit("gamma", CensoredLifetimes.of(left, right))
    theirs = scipy.stats.CensoredData.right_censored(left, times >= 8.0)
    shape, _, scale = scipy.stats.gamma.fit(theirs, floc=0.0)
    assert mine.prior.shape == pytest.approx(shape, rel=1e-3)
    assert mine.prior.scale_s == pytest.approx(scale, rel=1e-3)


def test_exponential_has_closed_forms() -> None:
    data = right_censored(Exponential(0.3), 4, 1.0, 5.0)
    mine = fit("exponential", data)
    events = float(data.weight[data.exact].sum())
    rate = events / float(data.weight @ (data.left_s - data.entry_s))
    assert mine.prior.hazard(1.0) == pytest.approx(rate, rel=1e-7)
    assert mine.standard_errors[0] == pytest.approx(events**-0.5, rel=1e-4)
    lower, upper = mine.band([0.0, 2.0])
    factor = math.exp(1.959964 * events**-0.5)
    np.testing.assert_allclose(lower, [1.0, math.exp(-2.0 * rate * factor)], rtol=1e-5)
    np.testing.assert_allclose(upper, [1.0, math.exp(-2.0 * rate / factor)], rtol=1e-5)
    assert mine.bic - mine.aic == pytest.approx(math.log(data.weight.sum()) - 2.0)


def test_likelihood_is_that_of_scipy() -> None:
    reference = scipy.stats.weibull_min(1.7, scale=2.0)
    data = CensoredLifetimes.of([1.0, 0.5, 3.0, 0.0, 2.0], [1.0, 2.0, INF, 0.7, 4.0], [0.2, 0.8, 1.0, 0.0, 0.0])
    expected = [
        reference.logpdf(1.0) - reference.logsf(0.2),
        math.log((reference.sf(0.8) - reference.sf(2.0)) / reference.sf(0.8)),  # the entry says more than `left`
        reference.logsf(3.0) - reference.logsf(1.0),
        reference.logcdf(0.7),
        math.log(reference.sf(2.0) - reference.sf(4.0)),
    ]
    np.testing.assert_allclose(log_likelihood(Weibull(2.0, 1.7), data), expected, rtol=1e-12)


MIXED = Mixture((Exponential(0.02), Exponential(2.0)), (0.6, 0.4))
LEAVING = Mixture((Exponential(0.5), never_leaves()), (0.7, 0.3))


@pytest.mark.parametrize(("kind", "truth"), [("two-exponentials", MIXED), ("some-never-leave", LEAVING)])
def test_mixtures_find_a_maximum_that_a_global_search_does_not_beat(kind: str, truth: LifetimePrior) -> None:
    data = intervals(truth, 5, 3.0)
    mine = fit(kind, data)
    family = KINDS[kind]
    bounds = [(-8.0, 3.0)] * (len(family.names) - 1) + [(-4.0, 4.0)]
    best: Any = scipy.optimize.differential_evolution(
        lambda p: -float(log_likelihood(family.build(p), data).sum()), bounds, rng=0, popsize=8, maxiter=60
    )
    assert mine.loglik >= -best.fun - 1e-6
    assert mine.loglik >= log_likelihood(truth, data).sum()


@pytest.mark.parametrize(
    "truth",
    [
        *(pytest.param(truth, marks=pytest.mark.slow) for truth in (Weibull(3.0, 3.0), MIXED)),
        LogNormal(1.0, 2.0),
        LEAVING,
    ],
    ids=str,
)
def test_the_best_is_the_family_of_the_truth(truth: LifetimePrior) -> None:
    data = intervals(truth, 6, 0.7)
    best = fit_best(data)
    assert type(best.prior) is type(truth)
    assert best.aic == min(one.aic for one in [fit(best.kind, data), *(fit(k, data) for k in ("exponential",))])


@settings(max_examples=20)
@given(st.floats(-9.0, 9.0), st.sampled_from(["exponential", "weibull", "lognormal"]))
def test_time_may_be_counted_in_any_unit(exponent: float, kind: str) -> None:
    data, unit = intervals(Weibull(4.0, 1.3), 7, 1.0), 10.0**exponent
    plain = fit(kind, data)
    scaled = fit(kind, CensoredLifetimes.of(unit * data.left_s, unit * data.right_s))
    assert scaled.loglik == pytest.approx(plain.loglik, rel=1e-8)
    assert scaled.prior.quantile(0.5) == pytest.approx(unit * plain.prior.quantile(0.5), rel=1e-4)
    np.testing.assert_allclose(scaled.covariance, plain.covariance, rtol=1e-3, atol=1e-7)


def test_weights_are_copies_and_order_says_nothing() -> None:
    data = intervals(Weibull(4.0, 1.3), 8, 1.0)
    copies = np.random.default_rng(0).permutation(np.repeat(np.arange(N), 3))
    once = fit("weibull", CensoredLifetimes.of(data.left_s, data.right_s, weight=3.0))
    thrice = fit("weibull", CensoredLifetimes.of(data.left_s[copies], data.right_s[copies]))
    assert once.loglik == pytest.approx(thrice.loglik, rel=1e-12)
    np.testing.assert_allclose(once.parameters, thrice.parameters, atol=1e-6)
    assert once.n_samples == thrice.n_samples == 3 * N


def test_a_family_of_ones_own() -> None:
    data = intervals(Weibull(4.0, 2.0), 9, 1.0)
    rayleigh = Kind(("log_scale_s",), lambda p: Weibull(math.exp(p[0]), 2.0), lambda mean: [[math.log(mean)]])
    assert fit(rayleigh, data).loglik <= fit("weibull", data).loglik
    assert fit_best(data, [rayleigh, "exponential"]).kind == "log_scale_s"


def test_a_filter_takes_what_was_fitted() -> None:
    prior = fit("weibull", intervals(Weibull(4.0, 1.3), 10, 1.0)).prior
    belief = single.init(1, prior).predict(2.0)
    assert belief[0] == pytest.approx(math.exp(prior.log_survival(2.0)))


@pytest.mark.parametrize(
    ("left", "right", "kind", "error", "message"),
    [
        ([1.0, 2.0], [INF, INF], "weibull", DataError, "no lifetime has an end"),
        ([0.0, 0.0], [1.0, 2.0], "exponential", NumericalError, "no clear maximum"),  # the sooner the better
        ([2.0], [2.0], "weibull", NumericalError, "no clear maximum"),  # a spike
        ([1.0], [2.0], "weibul", ConfigError, "weibul.*exponential, weibull"),
    ],
)
def test_mistakes(left: Any, right: Any, kind: str, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        fit(kind, CensoredLifetimes.of(left, right))


def test_choices_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="no kind"):
        fit_best(CensoredLifetimes.of([1.0], [2.0]), [])
    with pytest.raises(NumericalError):
        fit_best(CensoredLifetimes.of([0.0], [2.0]))
    with pytest.raises(ConfigError, match="confidence"):
        fit("exponential", CensoredLifetimes.of([1.0], [2.0])).band(1.0, 1.0)
