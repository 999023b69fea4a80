"""A posterior of hazards as weighted draws: survival with its bounds, the ages that were seen, and the prior of it."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.survival import Exponential
from evermap.survival.hazard_posterior import HazardPosterior, integrate_expected
from evermap.types import FloatArray

EDGES_S = np.array([0.0, 10.0, 100.0])
RATES = np.geomspace(1e-3, 1e-1, 200)


def posterior(rates: FloatArray, weight: FloatArray, risk: tuple[float, ...] = (0.0, 3.0, 0.0)) -> HazardPosterior:
    """Draws of one hazard at all ages."""
    each = np.tile(rates[:, None], (1, 3))
    return HazardPosterior(EDGES_S, each, weight, None, np.zeros(3), np.array(risk))


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95])
def test_bounds_are_weighted_quantiles_of_the_draws(confidence: float) -> None:
    """Of draws alike, and of some that count more: the draws at which the sum of weights passes the tail."""
    for weight in (np.full(200, 1.0 / 200), np.linspace(1.0, 3.0, 200) / 400):
        found = posterior(RATES, weight)
        for t in (5.0, 40.0, 300.0):
            alive = np.exp(-RATES * t)
            mean, lower, upper = found.survival(t, confidence)
            assert mean == pytest.approx(weight @ alive)
            for bound, share in ((lower, 0.5 * (1.0 - confidence)), (upper, 0.5 * (1.0 + confidence))):
                up_to = weight[alive <= bound * (1.0 + 1e-12)].sum()
                assert share - 1e-12 <= up_to <= share + weight.max() + 1e-12
    table = found.survival([[5.0, 40.0], [0.0, 300.0]])
    assert all(column.shape == (2, 2) for column in table)
    np.testing.assert_array_equal([column[1, 0] for column in table], 1.0)
    with pytest.raises(ConfigError):
        found.survival(1.0, 1.0)


@pytest.mark.parametrize(
    ("risk", "seen_s"),
    [((0.0, 3.0, 0.0), (10.0, 100.0)), ((2.0, 0.0, 1.0), (0.0, np.inf)), ((0.0, 0.0, 0.0), (np.inf, 0.0))],
)
def test_ages_that_were_seen_are_those_at_which_stays_were_at_risk(
    risk: tuple[float, ...], seen_s: tuple[float, float]
) -> None:
    assert posterior(RATES, np.full(200, 1.0 / 200), risk).seen_s == seen_s


def test_the_prior_has_the_expected_survival_at_every_edge() -> None:
    weight = np.linspace(1.0, 3.0, 200) / 400
    integrated = integrate_expected(np.tile(RATES[:, None], (1, 3)), weight, EDGES_S)
    expected = -np.log([weight @ np.exp(-RATES * t) for t in (10.0, 100.0, 200.0)])
    np.testing.assert_allclose(np.cumsum(integrated), expected)
    prior = posterior(RATES, weight).prior()
    np.testing.assert_allclose(prior.log_survival(np.array([10.0, 100.0, 200.0])), -expected)


def test_what_was_stated_keeps_its_form() -> None:
    """With the hazard that is stated in all draws it is the prior itself; with twice that its hazard is scaled."""
    stated, one = Exponential.from_mean(50.0), np.ones(1)
    for factor in (1.0, 2.0):
        found = HazardPosterior(EDGES_S, np.full((1, 3), factor / 50.0), one, stated, np.zeros(3), np.zeros(3)).prior()
        np.testing.assert_allclose(
            found.log_survival(np.array([5.0, 70.0, 150.0])), -factor * np.array([0.1, 1.4, 3.0])
        )
        assert (found is stated) == (factor == 1.0)
    twice = np.array([[1.0, 2.0, 1.0]]) / 50.0  # between 10 and 100 s only
    found = HazardPosterior(EDGES_S, twice, one, stated, np.zeros(3), np.zeros(3)).prior()
    np.testing.assert_allclose(found.log_survival(np.array([5.0, 70.0, 150.0])), [-0.1, -2.6, -4.8])
