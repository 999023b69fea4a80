"""Forecasts of the run-length filter, against closed forms and against many simulated futures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate

from evermap.errors import InputError, NumericalError
from evermap.existence.lifetimes import tabulate
from evermap.existence.protocol import Looks
from evermap.existence.rhythm import BIN_S, BINS, WEEK_S, Rhythm, bin_of_week
from evermap.existence.run_length import RunLength, RunLengthBelief, residual_life
from evermap.survival import (
    Exponential,
    Gamma,
    LifetimePrior,
    LogNormal,
    Mixture,
    PiecewiseConstantHazard,
    Weibull,
    never_leaves,
)
from evermap.types import FloatArray

STAY, ABSENCE = LogNormal(np.log(40.0), 0.5), Weibull(70.0, 1.8)
SAMPLES = 200_000


def believed(model: RunLength, seed: int = 1, n: int = 40) -> RunLengthBelief:
    """Belief about one feature after some looks."""
    rng = np.random.default_rng(seed)
    looks = Looks.from_rows(
        np.zeros(n, int), 1000.0 + np.cumsum(rng.uniform(0.5, 9.0, n)), rng.random(n) < 0.5, 0.3, 0.25
    )
    return RunLengthBelief.after(model, looks)


def hypotheses(state: RunLengthBelief, which: int) -> tuple[FloatArray, FloatArray]:
    """Ages and probabilities of one feature's hypotheses about one state."""
    n = state.count[0, which]
    return state.stamp_s[0] - state.start_s[0, which, :n], state.weight[0, 0, which, :n]


def left_over(prior: LifetimePrior, age: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Times that remain to those who reached an age, by inverting survival."""
    gone = -np.expm1(prior.log_survival(age))
    return np.maximum(prior.quantile(gone + (1.0 - gone) * rng.random(len(age))) - age, 0.0)


def simulated(model: RunLength, state: RunLengthBelief, ahead_s: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(T, SAMPLES) presence in many futures that begin as believed."""
    parts = [(s, *hypotheses(state, s)) for s in (0, 1)]
    weights = np.concatenate([weight for _, _, weight in parts])
    ages = np.concatenate([age for _, age, _ in parts])
    kinds = np.concatenate([np.full(len(age), s) for s, age, _ in parts])
    chosen = rng.choice(len(weights), SAMPLES, p=weights / weights.sum())
    there = kinds[chosen] == 1
    changed = np.where(there, left_over(model.stay, ages[chosen], rng), left_over(model.absence, ages[chosen], rng))
    found = np.empty((len(ahead_s), SAMPLES), dtype=bool)
    for k, time in enumerate(ahead_s):
        while (late := changed <= time).any():
            there[late] = ~there[late]
            next_one = np.where(there, model.stay.sample(rng, SAMPLES), model.absence.sample(rng, SAMPLES))
            changed[late] += next_one[late]
        found[k] = there
    return found


def test_a_forecast_is_the_mean_of_many_futures() -> None:
    model = RunLength(STAY, ABSENCE, 1.0 / 32.0, hypotheses=512)
    state = believed(model)
    ahead = np.array([0.5, 5.0, 20.0, 60.0, 150.0])
    futures = simulated(model, state, ahead, np.random.default_rng(2))
    for k, time in enumerate(ahead):
        expected, error = futures[k].mean(), futures[k].std() / np.sqrt(SAMPLES)
        assert state.predict(state.stamp_s + time)[0] == pytest.approx(expected, abs=4.0 * error)


@pytest.mark.parametrize(
    ("stay", "absence"),
    [(STAY, ABSENCE), (Exponential(0.02), Gamma(10.0, 3.0)), (Weibull(30.0, 0.8), LogNormal(3.0, 1.0))],
)
def test_far_ahead_it_is_the_share_of_stays(stay: LifetimePrior, absence: LifetimePrior) -> None:
    model = RunLength(stay, absence, 1.0 / 8.0, hypotheses=256)
    share = stay.mean() / (stay.mean() + absence.mean())
    found = believed(model).predict(1.0e4)[0]
    assert found == pytest.approx(share, abs=2e-3)
    assert RunLengthBelief.first(model, [0.0]).predict(0.0)[0] == pytest.approx(share, abs=2e-3)


@pytest.mark.parametrize("prior", [LogNormal(4.0, 0.6), Weibull(50.0, 2.0), Gamma(20.0, 2.5), Exponential(0.01)])
def test_residual_life_is_the_integral_of_conditional_survival(prior: LifetimePrior) -> None:
    table = tabulate(prior, 1.0)
    ages = np.array([0.0, 0.01, 3.3, 20.0, 64.0, 170.0])
    for age, found in zip(ages, residual_life(table, ages), strict=True):
        expected, _ = integrate.quad(
            lambda t, a=age: float(np.exp(prior.log_conditional_survival(a, a + t))), 0.0, 4000.0, limit=2000
        )
        assert found == pytest.approx(expected, rel=1e-3)
    assert residual_life(table, np.array(0.0)) == pytest.approx(prior.mean(), rel=1e-4)


def test_residual_life_of_steps_of_hazard_is_exact() -> None:
    prior = PiecewiseConstantHazard((0.0, 4.0, 48.0), (0.1, 0.0, 0.02))
    table = tabulate(prior, 1.0)
    assert residual_life(table, np.array(0.0)) == pytest.approx(prior.mean(), rel=1e-12)
    # past 4 s nothing happens before 48 s, and then 50 s are left
    np.testing.assert_allclose(
        residual_life(table, np.array([4.0, 10.0, 48.0, 1e5])), [94.0, 88.0, 50.0, 50.0], rtol=1e-9
    )


def test_what_may_never_end_lasts_for_ever_on_the_mean() -> None:
    half = Mixture.of([Exponential(0.1), never_leaves()], [0.5, 0.5])
    model = RunLength(half, Exponential(0.05), 1.0, newborn=True)
    state = RunLengthBelief.first(model, [0.0]).update(7.0, 1, 0.1, 0.1)
    np.testing.assert_array_equal(state.time_to_leave(), [np.inf])
    assert state.time_to_return()[0] == pytest.approx(20.0, rel=1e-9)
    deadline = RunLength(PiecewiseConstantHazard((0.0, 8.0, 16.0), (0.0, 500.0, 0.0)), Exponential(0.05), 1.0)
    # nobody reaches the time without hazard
    assert residual_life(deadline.tables[1], np.array(0.0)) == pytest.approx(8.0 + 1.0 / 500.0, rel=1e-9)


def test_the_time_to_the_next_change_is_the_mean_of_many() -> None:
    model = RunLength(STAY, ABSENCE, 0.5, hypotheses=128)
    state = believed(model, seed=3)
    rng = np.random.default_rng(4)
    for which, prior, found in ((1, STAY, state.time_to_leave()), (0, ABSENCE, state.time_to_return())):
        ages, weights = hypotheses(state, which)
        left = left_over(prior, rng.choice(ages, SAMPLES, p=weights / weights.sum()), rng)
        assert found[0] == pytest.approx(left.mean(), abs=4.0 * left.std() / np.sqrt(SAMPLES))
        ahead = np.array([0.0, 3.0, 30.0, 90.0])
        lasting = state.p_lasts(state.stamp_s[0] + ahead, present=bool(which))[0]
        assert lasting[0] == pytest.approx(1.0, abs=1e-12)
        for time, share in zip(ahead[1:], lasting[1:], strict=True):
            assert share == pytest.approx((left > time).mean(), abs=4.0 * np.sqrt(share * (1.0 - share) / SAMPLES))


def test_the_curve_is_conditional_survival() -> None:
    model = RunLength(LogNormal(4.0, 0.6), never_leaves(), 1.0, newborn=True)
    state = RunLengthBelief.first(model, [100.0]).update(124.0, 1, 0.1, 0.1)
    ahead = np.array([0.0, 5.0, 50.0, 500.0])
    expected = np.exp(model.stay.log_conditional_survival(24.0, 24.0 + ahead))
    np.testing.assert_allclose(state.p_lasts(124.0 + ahead)[0], expected, rtol=1e-3)
    np.testing.assert_array_equal(state.p_lasts(124.0 + ahead, present=False)[0], 1.0)
    np.testing.assert_array_equal(state.time_to_return(), [np.inf])


HOURS = Rhythm(np.log(np.where((np.arange(BINS) % 144 >= 48) & (np.arange(BINS) % 144 < 108), 3.0, 0.05)))
"""Things happen from 8 to 18 o'clock."""


def test_a_rhythm_without_contrast_is_none() -> None:
    flat = Rhythm(np.zeros(BINS))
    with_rhythm = RunLength(LogNormal(9.0, 0.5), Exponential(1e-5), 300.0, flat, flat)
    without = RunLength(LogNormal(9.0, 0.5), Exponential(1e-5), 300.0)
    stamps = 1.8e9 + np.arange(20) * 900.0
    looks = Looks.from_rows(np.zeros(20, int), stamps, np.arange(20) > 7, 0.1, 0.1)
    one, other = RunLengthBelief.after(with_rhythm, looks), RunLengthBelief.after(without, looks)
    for function in (RunLengthBelief.time_to_leave, RunLengthBelief.time_to_return):
        # where it starts there is a difference: what is believed at first
        np.testing.assert_allclose(function(one), function(other), rtol=2e-3)


def test_with_a_rhythm_time_passes_as_fast_as_the_hours_tell() -> None:
    """An exponential stay under a rhythm: the integral of `exp(-rate * integral of the factor)`, hour by hour."""
    rate, monday_s = 1.0 / (6 * 3600.0), 4 * 86400.0 + 3000 * WEEK_S
    model = RunLength(Exponential(rate), Exponential(rate / 20.0), 300.0, HOURS, HOURS, newborn=True)
    for begin_s in (monday_s, monday_s + 20 * 3600.0 + 123.0):
        state = RunLengthBelief.first(model, [begin_s]).update(begin_s + 50.0, 1, 0.1, 0.1)
        grid = begin_s + 50.0 + 60.0 * np.arange(40 * 7 * 1440)
        for one, found, factor in (
            (rate, state.time_to_leave()[0], HOURS.factor[bin_of_week(grid + 30.0)]),
            (rate / 20.0, state.time_to_return()[0], HOURS.factor[bin_of_week(grid + 30.0)]),
        ):
            x = one * factor * 60.0
            before = np.exp(-np.concatenate([[0.0], np.cumsum(x)[:-1]]))
            assert found == pytest.approx((before * 60.0 * -np.expm1(-x) / x).sum(), rel=2e-3)
        asked = begin_s + np.array([3600.0, 40000.0, 90000.0])
        k = np.round((asked - begin_s - 50.0) / 60.0).astype(int)
        expected = np.exp(-np.concatenate([[0.0], np.cumsum(rate * HOURS.factor[bin_of_week(grid + 30.0)] * 60.0)]))[k]
        np.testing.assert_allclose(state.p_lasts(asked)[0], expected, rtol=5e-3)


def test_certainly_away_has_no_time_to_leave() -> None:
    model = RunLength(Exponential(0.1), Exponential(0.1), 1.0)
    state = RunLengthBelief.first(model, [0.0, 0.0]).update(1.0, 0, 0.0, 0.5, rows=[1])  # a detector that never misses
    assert np.isnan(state.time_to_leave()[1])
    assert np.isnan(state.p_lasts([2.0])[1, 0])
    assert state.time_to_leave()[0] == pytest.approx(10.0)
    np.testing.assert_allclose(state.time_to_return(), 10.0)


def test_features_without_a_look_are_believed_as_at_first() -> None:
    model = RunLength(STAY, ABSENCE, 1.0)
    looks = Looks.from_rows([0, 0], [10.0, 20.0], [1, 1], 0.1, 0.1, n_features=2)
    state = RunLengthBelief.after(model, looks)
    np.testing.assert_array_equal(state.stamp_s, [20.0, 20.0])
    assert state.probability[1] == RunLengthBelief.first(model, [20.0]).probability[0]
    assert state.log_evidence[1] == 0.0


def test_bad_questions_are_refused() -> None:
    state = RunLengthBelief.first(RunLength(STAY, ABSENCE, 1.0), [0.0, 5.0])
    with pytest.raises(InputError, match="not in order of time"):
        state.p_lasts([9.0, 8.0])
    with pytest.raises(InputError, match=r"instant 0: time 4\.0 s lies before"):
        state.p_lasts([4.0, 8.0], present=False)
    with pytest.raises(InputError, match="instant 1: time nan is not finite"):
        state.p_lasts([9.0, np.nan])
    with pytest.raises(InputError, match="there is no look"):
        RunLengthBelief.after(state.model, Looks.from_rows(np.zeros(0, int), [], [], 0.1, 0.1, n_features=1))
    gone = RunLength(PiecewiseConstantHazard((0.0, 8.0), (900.0, 900.0)), never_leaves(), 1.0, newborn=True)
    with pytest.raises(NumericalError, match=r"feature 1 at 30\.0 s: this observation is impossible"):
        RunLengthBelief.after(gone, Looks.from_rows([0, 1, 1], [0.0, 0.0, 30.0], [1, 1, 1], 0.1, 0.0))


def test_bins_of_a_rhythm_are_whole_steps() -> None:
    """A forecast under a rhythm is never made with steps longer than its ten minutes."""
    model = RunLength(Exponential(1e-5), Exponential(1e-5), 7200.0, HOURS, HOURS)
    assert model.law.step_s == BIN_S
