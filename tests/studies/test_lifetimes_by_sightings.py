"""Stays of which only sightings are known: bounds by hand, and that forgetting the unseen ones is the larger error."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from evermap.errors import ConfigError, DataError
from evermap.survival import Exponential, LifetimePrior
from evermap.survival.censored import CensoredLifetimes, lifetimes_of_sightings
from evermap.survival.parametric_fit import fit
from evermap_studies.lifetimes.sightings import fit_sightings, settled_samples, weighted_sightings


def test_bounds_by_hand() -> None:
    """Not there at 90, seen from 100 to 150, gone at 180; considered to have come at 92.5 or at 97.5."""
    samples, stay = lifetimes_of_sightings([90.0], [100.0], [150.0], [180.0], instants=2)
    assert samples.left_s.tolist() == [57.5, 52.5]
    assert samples.right_s.tolist() == [87.5, 82.5]
    assert samples.entry_s.tolist() == [7.5, 2.5]
    assert samples.weight.tolist() == [0.5, 0.5]
    assert stay.tolist() == [0, 0]


def test_open_ends_are_open_and_unknown_ages_left_out() -> None:
    samples, stay = lifetimes_of_sightings(
        [-math.inf, 90.0], [100.0, 100.0], [100.0, 150.0], [180.0, math.inf], instants=3
    )
    assert stay.tolist() == [1, 1, 1]
    assert np.isinf(samples.right_s).all()


def test_those_that_are_counted_only_if_they_stay_enter_later() -> None:
    samples, stay = lifetimes_of_sightings(
        [90.0, 90.0], [100.0, 100.0], [101.0, 104.0], [110.0, 110.0], instants=1, least_stay_s=2.0
    )
    assert stay.tolist() == [1]
    assert samples.entry_s.tolist() == [7.0]


def patrols(seed: int, scale_s: float, shape: float) -> np.ndarray:
    """(4, K) elsewhere, first, last and gone of Weibull stays at a place that is visited every 1 s on average."""
    rng = np.random.default_rng(seed)
    visit = np.cumsum(rng.exponential(1.0, 4000))
    arrival = rng.uniform(0.0, visit[-1], 4000)
    end = arrival + scale_s * rng.weibull(shape, 4000)
    begin, last = np.searchsorted(visit, arrival), np.searchsorted(visit, end, side="right") - 1
    seen = last >= begin
    around = np.concatenate([[-math.inf], visit, [math.inf]])
    return np.array([around[begin[seen]], visit[begin[seen]], visit[last[seen]], around[last[seen] + 2]])


def weibull(samples: CensoredLifetimes) -> LifetimePrior:
    return fit("weibull", samples).prior


@pytest.mark.parametrize(
    ("scale_s", "shape"),
    [*(pytest.param(*one, marks=pytest.mark.slow) for one in ((2.0, 1.0), (3.0, 2.0))), (1.0, 2.0)],
)
def test_true_lifetimes_come_out_though_many_are_never_seen(scale_s: float, shape: float) -> None:
    """Of those that stay for one gap between looks half are not; forgetting them makes lifetimes far too long."""
    stays = patrols(0, scale_s, shape)
    samples = settled_samples(weibull, lambda given: weighted_sightings(stays, given), rounds=8)
    found = fit("weibull", samples)
    off = (found.parameters - np.log([scale_s, shape])) / found.standard_errors
    assert (np.abs(off) < 3.0).all()

    elsewhere, first, last, gone = stays[:, np.isfinite(stays[0])]
    naive = fit("weibull", CensoredLifetimes.of(last - first, gone - elsewhere))
    assert (naive.parameters[0] - math.log(scale_s)) / naive.standard_errors[0] > 5.0


MORE = [pytest.param(*one, 20, marks=pytest.mark.slow) for one in ((1.0, 2.0), (2.0, 1.0), (3.0, 2.0))]


@pytest.mark.parametrize(("scale_s", "shape", "runs"), [(1.0, 2.0, 5), *MORE])
def test_likelihood_of_the_stays_finds_the_truth_too(scale_s: float, shape: float, runs: int) -> None:
    """Over many runs errors are as large as standard errors say."""
    off = []
    for seed in range(runs):
        found = fit_sightings("weibull", *lifetimes_of_sightings(*patrols(seed, scale_s, shape)))
        off.append((found.parameters - np.log([scale_s, shape])) / found.standard_errors)
    assert chi2.sf(np.square(off).sum(axis=0), runs).min() > 1e-3
    assert chi2.cdf(np.square(off).sum(axis=0), runs).min() > 1e-3


def test_without_memory_it_makes_no_difference_when_it_came() -> None:
    """What is left of an exponential stay at the first sighting is exponential again."""
    stays = patrols(5, 2.0, 1.0)
    first, last, gone = stays[1:, np.isfinite(stays[0])]
    found = fit_sightings("exponential", *lifetimes_of_sightings(*stays))
    left = fit("exponential", CensoredLifetimes.of(last - first, gone - first))
    np.testing.assert_allclose(found.parameters, left.parameters, atol=1e-6)
    np.testing.assert_allclose(found.covariance, left.covariance, rtol=1e-4)
    assert found.loglik == pytest.approx(left.loglik)


def test_weights_are_the_probabilities_of_the_sighting() -> None:
    """Of what left between 60 and 90 s after it came rather than between 50 and 80 s, for an exponential of 100 s."""
    stays = [90.0], [110.0], [155.0], [185.0]
    samples = weighted_sightings(stays, Exponential.from_mean(100.0), instants=2)
    assert samples.left_s.tolist() == [60.0, 50.0]
    chance = np.exp([-0.6, -0.5]) - np.exp([-0.9, -0.8])
    np.testing.assert_allclose(samples.weight, chance / chance.sum(), rtol=1e-12)


@pytest.mark.parametrize(
    ("columns", "error", "problem"),
    [
        (([1.0], [1.0], [2.0], [3.0]), DataError, "not in order, row 0"),
        (([0.0], [1.0], [2.0], [2.0]), DataError, "not in order, row 0"),
        (([0.0, 1.0], [1.0], [2.0], [3.0]), DataError, r"shape \(2,\)"),
        (([-math.inf], [1.0], [2.0], [3.0]), DataError, "before the first look"),
    ],
)
def test_what_cannot_be_is_refused(columns, error, problem) -> None:
    with pytest.raises(error, match=problem):
        lifetimes_of_sightings(*columns)


def test_no_instants_are_refused() -> None:
    with pytest.raises(ConfigError, match="positive"):
        lifetimes_of_sightings([0.0], [1.0], [2.0], [3.0], instants=0)
