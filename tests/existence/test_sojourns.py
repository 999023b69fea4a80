"""Lifetimes from counts, against maximum likelihood by scipy and lifelines on the durations themselves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from evermap.existence.learn_sojourns import rank_fits
from evermap.existence.lifetimes import edges
from evermap.existence.rhythm import BINS, HALF_AN_EVENT
from evermap.existence.sojourns import (
    BACKGROUND_SPREAD,
    FAMILIES,
    SHARE_STRENGTH,
    WITH_RHYTHM,
    Sojourns,
    _gamma_hazard,
    _lognormal_hazard,
    _mixture,
    _weibull_hazard,
    mean_hazards,
)
from evermap.survival import Exponential, Gamma, LifetimePrior, LogNormal, Mixture, Weibull
from evermap.types import FloatArray

N = 20_000
TRUE: dict[str, LifetimePrior] = {
    "exponential": Exponential(1.0 / 80.0),
    "weibull": Weibull(100.0, 2.5),
    "gamma": Gamma(20.0, 4.0),
    "lognormal": LogNormal(np.log(90.0), 0.4),
    "peaks": Mixture.of([LogNormal(np.log(30.0), 0.06), LogNormal(np.log(200.0), 0.06)], [0.6, 0.4]),
}


def counted(durations: FloatArray, longest: float = np.inf) -> Sojourns:
    """The table of fully observed durations, those longer than `longest` cut off there."""
    _, edge = edges(1.0)
    edge = np.append(edge, 2.0 * edge[-1])
    seen = np.minimum(durations, longest)
    row = np.searchsorted(edge, seen, side="right") - 1
    ended = durations <= longest
    whole = np.array([np.clip(seen - a, 0.0, b - a).sum() for a, b in pairwise(edge)])
    n = len(whole)
    events = np.bincount(row[ended], minlength=n).astype(float)
    return Sojourns(edge, events[:, None], whole[:, None], np.bincount(row[~ended], minlength=n).astype(float))


@pytest.fixture(scope="module")
def durations() -> dict[str, FloatArray]:
    return {name: np.asarray(prior.sample(7, N)) for name, prior in TRUE.items()}


def test_mean_hazards_of_bins_give_back_survival() -> None:
    _, edge = edges(1.0)
    edge = edge[edge < 300.0]
    prior = TRUE["gamma"]
    integrated = np.cumsum(mean_hazards(prior.cumulative_hazard(edge), edge) * np.diff(edge))
    np.testing.assert_allclose(-integrated, prior.log_survival(edge[1:]), rtol=1e-9, atol=1e-15)


def test_an_exponential_is_events_by_exposure(durations: dict[str, FloatArray]) -> None:
    for longest in (np.inf, 60.0):
        counts = counted(durations["exponential"], longest)
        found = FAMILIES["exponential"](counts, None).prior
        assert isinstance(found, Exponential)
        ended = (durations["exponential"] <= longest).sum()
        spent = np.minimum(durations["exponential"], longest).sum()
        assert found.rate == pytest.approx((ended + HALF_AN_EVENT) / spent, rel=1e-9)


@pytest.mark.parametrize("longest", [np.inf, 110.0])
def test_two_parameters_are_those_of_maximum_likelihood(durations: dict[str, FloatArray], longest: float) -> None:
    """Up to the width of a bin (a hundredth of an age); lifelines where some are cut off."""
    import lifelines  # type: ignore[import-untyped]

    for name in ("weibull", "lognormal"):
        seen, ended = np.minimum(durations[name], longest), durations[name] <= longest
        found = FAMILIES[name](counted(durations[name], longest), None).prior
        if isinstance(found, Weibull):
            fitted = lifelines.WeibullFitter().fit(seen, ended)
            expected, parameters = (fitted.lambda_, fitted.rho_), (found.scale_s, found.shape)
        else:
            assert isinstance(found, LogNormal)
            fitted = lifelines.LogNormalFitter().fit(seen, ended)
            expected, parameters = (np.exp(fitted.mu_), fitted.sigma_), (np.exp(found.mu), found.sigma)
        np.testing.assert_allclose(parameters, expected, rtol=0.01)


def test_gamma_is_that_of_maximum_likelihood(durations: dict[str, FloatArray]) -> None:
    found = FAMILIES["gamma"](counted(durations["gamma"]), None).prior
    assert isinstance(found, Gamma)
    shape, _, scale = stats.gamma.fit(durations["gamma"], floc=0.0)
    assert found.shape == pytest.approx(shape, rel=0.01)
    assert found.scale_s == pytest.approx(scale, rel=0.01)


def test_peaks_are_found_where_they_are(durations: dict[str, FloatArray]) -> None:
    for longest in (np.inf, 190.0):
        found = FAMILIES["peaks"](counted(durations["peaks"], longest), None).prior
        t = np.array([20.0, 27.0, 30.0, 33.0, 100.0, 180.0])
        np.testing.assert_allclose(found.log_survival(t), TRUE["peaks"].log_survival(t), atol=0.03)


@pytest.mark.parametrize("name", ["weibull", "gamma", "lognormal"])
def test_the_quick_cumulative_hazard_is_that_of_the_family(name: str) -> None:
    quick = {"weibull": _weibull_hazard, "gamma": _gamma_hazard, "lognormal": _lognormal_hazard}[name]
    t = np.concatenate([[0.0], np.geomspace(1.0, 3e3, 40)])
    for a, b in ((np.log(90.0), -0.5), (np.log(90.0), 0.7), (np.log(20.0), 0.0)):
        family: dict[str, LifetimePrior] = {
            "weibull": Weibull(np.exp(a), np.exp(b)),
            "gamma": Gamma(np.exp(a - b), np.exp(b)),
            "lognormal": LogNormal(a, np.exp(b)),
        }
        expected = family[name].cumulative_hazard(t)
        near = expected < 30.0  # beyond, the gamma's is infinite
        np.testing.assert_allclose(quick(a, b, t)[near], expected[near], rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("longest", [np.inf, 190.0])
@pytest.mark.parametrize("n", [0, 2])
def test_a_mixture_is_where_a_round_of_em_leaves_it(durations: dict[str, FloatArray], n: int, longest: float) -> None:
    """A round by scipy's truncated normals: who ended belongs where its density is, who went on where its survival."""
    counts = counted(durations["peaks"], longest)
    prior = _mixture(counts, n).prior
    parts = prior.components if isinstance(prior, Mixture) else (prior,)
    share = np.array(prior.weights if isinstance(prior, Mixture) else [1.0])
    mean, spread = (np.array([getattr(part, name) for part in parts]) for name in ("mu", "sigma"))
    x, ended, going = np.log(counts.age_s)[:, None], counts.events, counts.open_ended[:, None]
    width = np.log(np.diff(counts.edge_s) / counts.age_s + 1.0)[:, None]
    law = stats.norm(mean, spread)
    density, beyond = share * law.pdf(x), share * law.sf(x)
    mine = ended * density / np.maximum(density.sum(axis=1, keepdims=True), 1e-300)
    open_mine = going * beyond / np.maximum(beyond.sum(axis=1, keepdims=True), 1e-300)
    some = going[:, 0] > 0.0
    later = stats.truncnorm((x[some] - mean) / spread, np.inf, mean, spread)
    weight = (mine + open_mine).sum(axis=0)
    new_mean = ((mine * x).sum(axis=0) + (open_mine[some] * later.mean()).sum(axis=0)) / weight
    squares = (mine * ((x - new_mean) ** 2 + width**2 / 12.0)).sum(axis=0)
    squares += (open_mine[some] * (later.var() + (later.mean() - new_mean) ** 2)).sum(axis=0)
    typical = np.append(BACKGROUND_SPREAD**2, np.full(n, squares[1:].sum() / weight[1:].sum() if n else 0.0))
    np.testing.assert_allclose(mean, new_mean, atol=1e-3)  # a component with hardly a stay is slow
    np.testing.assert_allclose(spread, np.sqrt((squares + typical) / (weight + 1.0)), rtol=1e-3)
    np.testing.assert_allclose(share, (weight + SHARE_STRENGTH) / (weight + SHARE_STRENGTH).sum(), atol=1e-3)


def test_a_smooth_hazard_follows_any(durations: dict[str, FloatArray]) -> None:
    for name in ("exponential", "weibull", "gamma", "lognormal"):
        prior = TRUE[name]
        fitted = FAMILIES["smooth"](counted(durations[name]), None)
        t = np.asarray(prior.quantile(np.linspace(0.05, 0.95, 10)))
        share = np.exp(fitted.prior.log_survival(t))
        # five standard errors of an empirical share
        np.testing.assert_allclose(share, np.linspace(0.95, 0.05, 10), atol=5.0 * np.sqrt(0.25 / N))
        assert 1.0 < fitted.freedom < 25.0


@pytest.mark.parametrize("name", TRUE)
def test_enough_durations_tell_their_family(durations: dict[str, FloatArray], name: str) -> None:
    assert rank_fits(counted(durations[name]), tuple(FAMILIES), None, rhythm=False)[0].family == name


@pytest.mark.parametrize("name", FAMILIES)
def test_few_durations_give_a_lifetime_all_the_same(name: str) -> None:
    for few in ([], [40.0], [40.0, 41.0], [40.0, 40.0, 40.0]):
        prior = FAMILIES[name](counted(np.array([*few, 500.0]), 100.0), None).prior
        survival = np.exp(prior.log_survival(np.array([0.0, 10.0, 100.0, 1e4])))
        assert survival[0] == 1.0
        assert (np.diff(survival) <= 0.0).all()


def test_a_rhythm_is_found_beside_the_hazard_of_age() -> None:
    """Counts of an exponential lifetime that ends by day only: the factor of every ten minutes."""
    _, edge = edges(300.0)
    edge = np.append(edge[::16], 2.0 * edge[-1])
    day = np.where((np.arange(BINS) % 144 >= 48) & (np.arange(BINS) % 144 < 108), 1.6, 0.4)
    rng = np.random.default_rng(1)
    exposure = np.exp(-edge[:-1] / 20000.0)[:, None] * np.diff(edge)[:, None] * np.ones(BINS)
    exposure[edge[:-1] > 200_000.0] = 0.0
    exposure *= 50_000.0 / (3e-5 * exposure.sum())
    events = rng.poisson(exposure * 3e-5 * day).astype(float)
    counts = Sojourns(edge, events, exposure, np.zeros(len(edge) - 1))
    for name in WITH_RHYTHM:
        fitted = WITH_RHYTHM[name](counts, None)
        assert fitted.rhythm is not None
        inside = np.abs(np.arange(BINS) % 144 - 78) < 20
        night = np.abs(np.arange(BINS) % 144 - 78) > 45
        ratio = fitted.rhythm.factor[inside].mean() / fitted.rhythm.factor[night].mean()
        assert ratio == pytest.approx(4.0, rel=0.1)
        hazard = mean_hazards(fitted.prior.cumulative_hazard(edge), edge)
        total = (exposure * hazard[:, None] * fitted.rhythm.factor).sum()
        assert total == pytest.approx(events.sum(), rel=0.01)
