"""Lifetimes as tables of hazards, against the lifetimes themselves."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.existence.lifetimes import DOUBLINGS_BELOW, PER_DOUBLING, bins_of, edges, tabulate
from evermap.survival import (
    Exponential,
    Gamma,
    GeneralPurpose,
    LifetimePrior,
    LogNormal,
    PiecewiseConstantHazard,
    Uniform,
    Weibull,
    never_leaves,
)

PRIORS: dict[str, LifetimePrior] = {
    "exponential": Exponential(0.02),
    "lognormal": LogNormal(4.0, 0.7),
    "weibull": Weibull(100.0, 2.3),
    "gamma": Gamma(0.4, 300.0),
    "general purpose": GeneralPurpose(1e-4, 1.0),
}


def between(prior: LifetimePrior, step_s: float, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hazard of a table integrated from `a` to `b`."""
    table = tabulate(prior, step_s)

    def up_to(age: np.ndarray) -> np.ndarray:
        i = bins_of(age, table.offset, len(table.edge_s))
        return np.asarray(table.cumulative[i] + table.hazard_hz[i] * (age - table.edge_s[i]))

    return np.asarray(up_to(b) - up_to(a))


@pytest.mark.parametrize("step_s", [1e-3, 0.7, 1.0, 600.0, 86400.0])
def test_edges_are_64_equal_parts_of_every_doubling_from_a_small_part_of_a_step(step_s: float) -> None:
    offset, edge = edges(step_s)
    assert edge[0] == 0.0
    assert step_s / 2 ** (DOUBLINGS_BELOW + 1) < edge[1] <= step_s / 2**DOUBLINGS_BELOW
    doublings = edge[1:].reshape(-1, PER_DOUBLING)
    np.testing.assert_array_equal(doublings / doublings[:, :1], np.tile(1.0 + np.arange(64) / 64.0, (28, 1)))
    np.testing.assert_array_equal(doublings[1:, 0] / doublings[:-1, 0], 2.0)
    # every edge begins its own bin, and the number just below it ends the one before
    np.testing.assert_array_equal(bins_of(edge, offset, len(edge)), np.arange(len(edge)))
    np.testing.assert_array_equal(bins_of(np.nextafter(edge[1:], 0.0), offset, len(edge)), np.arange(len(edge) - 1))


@pytest.mark.parametrize("name", PRIORS)
def test_survival_is_exact_at_the_edges(name: str) -> None:
    table = tabulate(PRIORS[name], 3.0)
    certain = -PRIORS[name].log_survival(table.edge_s)
    fine = certain < 600.0
    np.testing.assert_allclose(table.cumulative[fine], certain[fine], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(table.survival(), np.exp(-certain), rtol=1e-7, atol=1e-200)


@pytest.mark.parametrize("name", PRIORS)
def test_between_edges_it_is_off_by_a_quarter_of_the_change_of_hazard_at_most(name: str) -> None:
    """A chord of a curve of slopes between `h1` and `h2` over a width `w` is off by `|h2 - h1| w / 4` at most."""
    prior = PRIORS[name]
    rng = np.random.default_rng(1)
    age = np.exp(rng.uniform(0.0, np.log(2000.0), 2000))
    later = age + rng.uniform(1.0, 30.0, 2000)
    offset, edge = edges(3.0)
    bound = np.zeros(2000)
    for end in (age, later):
        i = bins_of(end, offset, len(edge))
        bound += np.abs(np.diff(prior.hazard(edge[[i, i + 1]]), axis=0)[0]) * (edge[i + 1] - edge[i]) / 4.0
    error = np.abs(between(prior, 3.0, age, later) + prior.log_conditional_survival(age, later))
    assert (error <= 1.0001 * bound + 1e-11).all()


def test_a_constant_hazard_is_exact_everywhere() -> None:
    rng = np.random.default_rng(2)
    age = np.exp(rng.uniform(-5.0, 13.0, 1000))  # from below the first edge on
    np.testing.assert_allclose(between(Exponential(0.02), 3.0, age, 2.0 * age), 0.02 * age, rtol=1e-12)


def test_steps_on_the_edges_are_exact_everywhere() -> None:
    prior = PiecewiseConstantHazard((0.0, 3.0, 10.0, 96.0), (0.0, 0.1, 0.01, 0.03))
    rng = np.random.default_rng(3)
    age = rng.uniform(0.0, 200.0, 1000)
    later = age + rng.uniform(0.0, 50.0, 1000)
    np.testing.assert_allclose(
        between(prior, 1.0, age, later), -prior.log_conditional_survival(age, later), rtol=1e-10, atol=1e-13
    )


def test_the_last_hazard_holds_for_ever() -> None:
    table = tabulate(Exponential(1e-9), 1.0)
    assert table.hazard_hz[-1] == pytest.approx(1e-9, rel=1e-12)
    assert tabulate(never_leaves(), 1.0).hazard_hz.max() == 0.0


def test_a_deadline_is_a_hazard_that_nobody_survives() -> None:
    table = tabulate(Uniform(64.0), 1.0)
    assert np.isfinite(table.hazard_hz).all()
    np.testing.assert_allclose(table.survival(), np.maximum(1.0 - table.edge_s / 64.0, 0.0), atol=1e-12)
    assert (np.exp(-between(Uniform(64.0), 1.0, np.array([10.0, 63.0]), np.array([64.0, 65.0]))) == 0.0).all()
