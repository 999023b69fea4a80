"""Lifetimes of classes learned together, against likelihoods and posteriors that are integrated otherwise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats as law
from scipy.integrate import quad
from scipy.linalg import expm

from evermap.survival import Weibull
from evermap.survival.class_lifetimes import (
    LOG_MEAN,
    LOG_SHAPE,
    LOGIT_RETURN,
    SHAPE_SPREAD,
    SITE_SPREADS,
    ClassPosterior,
    Sightings,
    SitesPosterior,
    absence_log_likelihood,
    finer,
    stay_log_likelihood,
)

DAY_S = 86_400.0


def seen(
    elsewhere: list[float], first: list[float], last: list[float], gone: list[float], gap: float = 1.0,
    back: float = 0.0, rate: float = 0.0,
) -> Sightings:  # fmt: skip
    """In days, at looks that are equally far apart."""
    stamps = (np.array(column) * DAY_S for column in (elsewhere, first, last, gone))
    ones = np.ones(len(first))
    return Sightings(*stamps, np.tile(gap * DAY_S, (len(first), 2)), back * ones, rate / DAY_S * ones)


STAYS = ([-0.5, 2.0, 0.0], [0.0, 2.7, 0.2], [3.0, 2.7, 9.0], [4.0, 3.0, np.inf])


@pytest.mark.parametrize(("node", "nats"), [((20, 4), 0.01), ((24, 6), 0.01), ((30, 1), 0.04)])
def test_stay_is_as_probable_as_the_integral_over_its_arrival_says(node: tuple[int, int], nats: float) -> None:
    """Two instants are enough for a few thousandths, but where the hazard is infinite at first: a shape of 0.5."""
    mean, shape = math.exp(LOG_MEAN[node[0]]), math.exp(LOG_SHAPE[node[1]])
    prior = Weibull(mean / math.gamma(1.0 + 1.0 / shape), shape)

    def survival(age: float) -> float:
        return float(np.exp(prior.log_survival(age))) if age < np.inf else 0.0

    found = stay_log_likelihood(seen(*STAYS))[:, node[0], node[1]]
    for row, (elsewhere, first, last, gone) in enumerate(np.array(STAYS).T * DAY_S):
        until = first - elsewhere  # ages at the first sighting
        alive = quad(survival, 0.0, until)[0]
        sighted = quad(survival, last - first, last - first + until)[0]
        if gone < np.inf:
            sighted -= quad(survival, gone - first, gone - first + until)[0]
        assert found[row] == pytest.approx(math.log(sighted / alive), abs=nats)


@pytest.mark.parametrize("node", [(20, 4), (24, 6), (30, 1)])
def test_stay_that_one_comes_upon_is_what_is_left_of_it(node: tuple[int, int]) -> None:
    mean, shape = math.exp(LOG_MEAN[node[0]]), math.exp(LOG_SHAPE[node[1]])
    prior = law.weibull_min(shape, scale=mean / math.gamma(1.0 + 1.0 / shape))
    found = stay_log_likelihood(seen([-np.inf] * 2, [0.0] * 2, [3.0] * 2, [4.0, np.inf]))[:, node[0], node[1]]
    past = [quad(prior.sf, 0.0, day * DAY_S, epsrel=1e-10)[0] / mean for day in (3.0, 4.0)]
    np.testing.assert_allclose(found, np.log([past[1] - past[0], 1.0 - past[0]]), rtol=1e-5)


def test_a_late_end_of_a_short_stay_is_improbable_without_overflow() -> None:
    values = stay_log_likelihood(seen([-np.inf], [0.0], [3650.0], [np.inf]))[0]
    assert np.isfinite(values).all()
    memoryless = int(np.argmin(np.abs(LOG_SHAPE)))
    np.testing.assert_allclose(values[:, memoryless], -3650.0 * DAY_S / np.exp(LOG_MEAN), rtol=1e-9)


def test_unseen_returns_are_those_of_a_chain_of_two_states() -> None:
    memoryless, node = int(np.argmin(np.abs(LOG_SHAPE))), 18
    leave = DAY_S / math.exp(LOG_MEAN[node])
    back, rate = 0.8, 0.1
    come = back * leave + rate
    step = expm(np.array([[-leave, leave], [come, -come]]) * 0.5)  # half a day
    stays = seen([0.0], [1e-9], [3.0], [3.5], gap=0.5, back=back, rate=rate)
    found = stay_log_likelihood(stays)[0, node, memoryless]
    assert found == pytest.approx(6.0 * math.log(step[0, 0]) + math.log(step[0, 1]), rel=1e-4)


def test_absence_is_as_probable_as_the_integral_over_its_beginning_says() -> None:
    mean, share = math.exp(LOG_MEAN[20]), 1.0 / (1.0 + math.exp(-LOGIT_RETURN[6]))
    there, first, last, back = (np.array(days) * DAY_S for days in ([0.0, 0.0], [0.5, 0.5], [2.0, 9.0], [2.5, np.inf]))
    found = absence_log_likelihood(there, first, last, back)[:, 20, 6]

    def away(age: float) -> float:
        return 1.0 - share + share * math.exp(-age / mean)

    for row in (0, 1):
        # as far before the first look as it may have gone
        known = quad(away, 0.0, first[row])[0]
        said = quad(away, last[row] - first[row], last[row])[0]
        if back[row] < np.inf:
            said -= quad(away, back[row] - first[row], back[row])[0]
        assert found[row] == pytest.approx(math.log(said / known), abs=1e-3)


def test_without_data_any_duration_is_possible() -> None:
    none = np.zeros((0, len(LOG_MEAN), len(LOG_SHAPE)))
    curve = ClassPosterior.of(none).curve(-1)
    # an hour to ten years, as the general-purpose prior
    assert 1.0 * DAY_S < curve.quantile(0.5) < 100.0 * DAY_S
    assert 0.2 < np.exp(curve.log_survival(30.0 * DAY_S)) < 0.8


def test_posterior_of_many_stays_is_that_of_the_exact_likelihood() -> None:
    """Exact exponential lifetimes, hence a gamma posterior of the rate; the level of all classes hardly matters."""
    rng = np.random.default_rng(0)
    ends = rng.exponential(3.0, 200)
    first = np.zeros(200)
    stays = seen(list(first - 1e-6), list(first), list(ends - 1e-4), list(ends), gap=1e3)
    values = stay_log_likelihood(stays).sum(axis=0, keepdims=True)
    memoryless = np.abs(LOG_SHAPE) < 1e-9
    values = np.where(memoryless, values, values - 1e4 * np.square(LOG_SHAPE))  # as if its shape were known
    mean, lower, upper = ClassPosterior.of(values).band(0, [3.0 * DAY_S])
    rate = law.gamma(200.0, scale=1.0 / ends.sum())
    assert mean[0] == pytest.approx(float(np.mean(np.exp(-3.0 * rate.rvs(100_000, random_state=1)))), abs=0.005)
    np.testing.assert_allclose([lower[0], upper[0]], np.exp(-3.0 * rate.ppf([0.975, 0.025])), atol=0.01)


def test_one_stay_makes_no_wild_curve() -> None:
    """It leans to what nine fellows do that all stay for about two days."""
    rng = np.random.default_rng(2)
    rows = []
    for kind in range(10):
        n = 40 if kind < 9 else 1
        first = rng.uniform(0.0, 10.0, n)
        last = first + (rng.exponential(2.0, n) if kind < 9 else 40.0)
        stays = seen(list(first - 0.01), list(first), list(last), list(last + 0.01))
        rows.append(stay_log_likelihood(stays).sum(axis=0))
    posterior = ClassPosterior.of(np.array(rows))
    alone = ClassPosterior.of(np.array(rows[-1:]))
    medians = [float(one.curve(row).quantile(0.5)) / DAY_S for one, row in ((posterior, 9), (alone, 0), (posterior, 0))]
    assert medians[2] < medians[0] < medians[1]


def test_who_never_comes_back_is_gone() -> None:
    n = 40
    zero = np.zeros(n)
    values = absence_log_likelihood(zero, zero + DAY_S, zero + 30.0 * DAY_S, zero + np.inf).sum(axis=0, keepdims=True)
    curve = ClassPosterior.of(values, improper=True).curve(0)
    assert curve.p_never_leaves > 0.5
    assert np.exp(curve.log_conditional_survival(DAY_S, 30.0 * DAY_S)) > 0.95


# --- many sites ---

MIDDLES, WIDTHS = np.log(np.array([3.0, 8.0, 20.0, 50.0]) * DAY_S), np.array([0.6, 0.4, 0.8, 0.5])
"""Of likelihoods of four sites, normal in the log of the mean."""


def of_sites(middles: np.ndarray, widths: np.ndarray, n_second: int = len(LOG_SHAPE)) -> np.ndarray:
    """Log likelihoods (S, 1, M, A) that say nothing of the second parameter."""
    normal = -0.5 * np.square((LOG_MEAN - middles[:, None]) / widths[:, None])
    return np.repeat(normal[:, None, :, None], n_second, axis=3)


@pytest.mark.parametrize("site", [0, 3, None])
def test_sites_of_normal_likelihoods_have_the_posterior_of_a_normal_hierarchy(site: int | None) -> None:
    """In closed form given the spreads and the level, over which the reference sums by itself; no grid of means."""
    levels, between_classes = np.linspace(math.log(3600.0), math.log(3650.0 * DAY_S), 12), (0.5, 1.0, 2.0, 4.0)
    step = (LOG_MEAN[1] - LOG_MEAN[0]) / 4.0
    ends = LOG_MEAN[0] - 0.5 * step, LOG_MEAN[-1] + 0.5 * step
    log_weights, means, variances = [], [], []
    for between in SITE_SPREADS[False][0]:
        for level in levels:
            for spread in between_classes:
                # the last of the unknowns is the site's own; the class' mean is integrated out
                covariance = spread**2 + between**2 * np.eye(5)
                seen_covariance = covariance[:4, :4] + np.diag(WIDTHS**2)
                cross = covariance[4, :4] if site is None else covariance[site, :4]
                gain = np.linalg.solve(seen_covariance, cross)
                log_evidence = law.multivariate_normal(np.full(4, level), seen_covariance).logpdf(MIDDLES)
                inside = np.diff(law.norm(level, spread).cdf(ends))[0]  # means lie on the grid
                log_weights.append(log_evidence - math.log(inside))
                means.append(level + gain @ (MIDDLES - level))
                variances.append(covariance[4, 4] - gain @ cross)
    weights = np.exp(np.array(log_weights) - max(log_weights))
    nodes = finer(LOG_MEAN)
    mixed = law.norm(np.array(means)[:, None], np.sqrt(variances)[:, None])
    expected = (weights / weights.sum()) @ (mixed.cdf(nodes + 0.5 * step) - mixed.cdf(nodes - 0.5 * step))

    found = SitesPosterior.of(of_sites(MIDDLES, WIDTHS))
    posterior = found.site(None if site is None else of_sites(MIDDLES, WIDTHS)[site]).weight[0]
    np.testing.assert_allclose(posterior.sum(axis=1), expected, atol=2e-4)
    assert 0.5 * np.abs(posterior.sum(axis=1) - expected).sum() < 2e-3  # total variation


def some_sites(count: int, seed: int = 0) -> np.ndarray:
    """Log likelihoods (S, 2, M, A) of watched stays of two classes."""
    rng = np.random.default_rng(seed)
    each = []
    for _ in range(count):
        lasted = rng.exponential(1.0, (2, 3)) * np.array([[2.0], [20.0]]) * rng.lognormal(0.0, 0.7)
        begun = np.zeros(6)
        stays = seen(begun - 0.5, begun, np.floor(lasted.ravel()), np.floor(lasted.ravel()) + 1.0)
        each.append(stay_log_likelihood(stays).reshape(2, 3, len(LOG_MEAN), len(LOG_SHAPE)).sum(axis=1))
    return np.stack(each)


def test_sites_that_do_not_differ_are_one_and_those_that_differ_in_everything_are_alone() -> None:
    sites = some_sites(5)
    pool, alike = ClassPosterior.of(sites.sum(axis=0)), SitesPosterior.of(sites, spreads=((0.0,), (0.0,)))
    np.testing.assert_allclose(alike.site(sites[2]).weight, pool.weight, atol=1e-14)
    np.testing.assert_allclose(alike.site().weight, pool.weight, atol=1e-14)
    apart = SitesPosterior.of(sites, spreads=((np.inf,), (np.inf,)))
    for one in sites:
        by_itself = SitesPosterior.of(one[None], spreads=((np.inf,), (np.inf,))).site(one).weight
        np.testing.assert_allclose(apart.site(one).weight[:-1], by_itself[:-1], atol=1e-14)
    flat = np.ptp(apart.site().weight, axis=(1, 2))
    np.testing.assert_allclose(flat, 0.0, atol=1e-15)  # nothing of a site that was not seen


def test_one_site_with_a_known_spread_of_shapes_has_the_posterior_of_its_map() -> None:
    one = some_sites(1)
    found = SitesPosterior.of(one, spreads=((0.0,), (0.0,))).site(one[0])
    np.testing.assert_allclose(found.weight, ClassPosterior.of(one[0]).weight, atol=1e-14)
    np.testing.assert_allclose(found.curve(0).rates, ClassPosterior.of(one[0]).curve(0).rates, rtol=1e-9)


def test_a_site_without_data_changes_nothing_and_is_a_new_one() -> None:
    sites, empty = some_sites(4), np.zeros((1, 2, len(LOG_MEAN), len(LOG_SHAPE)))
    without, found = SitesPosterior.of(sites), SitesPosterior.of(np.concatenate([sites, empty]))
    np.testing.assert_allclose(found.site(sites[1]).weight, without.site(sites[1]).weight, atol=1e-12)
    np.testing.assert_allclose(found.site(empty[0]).weight, without.site().weight, atol=1e-12)
    np.testing.assert_allclose(found.p_pair, without.p_pair, atol=1e-12)


def test_the_order_of_sites_does_not_matter() -> None:
    sites = some_sites(6)
    one, other = SitesPosterior.of(sites), SitesPosterior.of(sites[::-1])
    np.testing.assert_allclose(one.site(sites[0]).weight, other.site(sites[0]).weight, atol=1e-12)


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_how_far_sites_differ_is_learned(spread: float) -> None:
    rng = np.random.default_rng(3)
    middles = math.log(10.0 * DAY_S) + spread * rng.normal(size=40) + 0.3 * rng.normal(size=40)
    found = SitesPosterior.of(of_sites(middles, np.full(40, 0.3)))
    assert found.p_pair @ found.spreads[:, 0] == pytest.approx(spread, abs=0.25)
    absences = SitesPosterior.of(of_sites(middles, np.full(40, 0.3), len(LOGIT_RETURN)), improper=True)
    assert absences.p_pair @ absences.spreads[:, 0] == pytest.approx(spread, abs=0.25)


def test_shapes_of_sites_lie_about_those_of_the_company() -> None:
    """Normal likelihoods of log shapes, and a normal prior: the posterior of one site is normal, in closed form."""
    middles, width, between = np.array([0.1, 0.4, 0.6]), 0.2, 0.5
    shapes = -0.5 * np.square((LOG_SHAPE - middles[:, None]) / width)
    sites = np.repeat(shapes[:, None, None, :], len(LOG_MEAN), axis=2)
    found = SitesPosterior.of(sites, spreads=((0.0,), (between,))).site(sites[0]).weight[0].sum(axis=0)
    covariance = SHAPE_SPREAD**2 + between**2 * np.eye(3)
    gain = np.linalg.solve(covariance + width**2 * np.eye(3), covariance[0])
    nodes = finer(LOG_SHAPE)
    assert found @ nodes == pytest.approx(gain @ middles, abs=0.02)
    assert found @ nodes**2 - (found @ nodes) ** 2 == pytest.approx(covariance[0, 0] - gain @ covariance[0], rel=0.1)
