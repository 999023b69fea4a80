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
    Sightings,
    absence_log_likelihood,
    absence_posterior,
    stay_log_likelihood,
    stay_posterior,
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
    curve = stay_posterior(none).curve(-1)
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
    mean, lower, upper = stay_posterior(values).band(0, [3.0 * DAY_S])
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
    posterior = stay_posterior(np.array(rows))
    alone = stay_posterior(np.array(rows[-1:]))
    medians = [float(one.curve(row).quantile(0.5)) / DAY_S for one, row in ((posterior, 9), (alone, 0), (posterior, 0))]
    assert medians[2] < medians[0] < medians[1]


def test_who_never_comes_back_is_gone() -> None:
    n = 40
    zero = np.zeros(n)
    values = absence_log_likelihood(zero, zero + DAY_S, zero + 30.0 * DAY_S, zero + np.inf).sum(axis=0, keepdims=True)
    curve = absence_posterior(values).curve(0)
    assert curve.p_never_leaves > 0.5
    assert np.exp(curve.log_conditional_survival(DAY_S, 30.0 * DAY_S)) > 0.95
