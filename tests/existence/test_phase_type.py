"""Chains of phases against scipy, brute force over phase paths, and the persistence filter."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from evermap.errors import ConfigError, InputError, NumericalError
from evermap.existence.lifetimes import exponential_mixture_of
from evermap.existence.one_stay import PersistenceFilter
from evermap.existence.phase_belief import PhaseBelief
from evermap.existence.phase_kernels import leap, transition
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, Looks
from evermap.existence.rhythm import BIN_S, BINS, WEEK_S, Rhythm
from evermap.survival import Exponential, GeneralPurpose, Mixture, Weibull

MONDAY_S = 4.0 * 86400.0
NO_LOOKS = Looks.from_rows(np.zeros(0, dtype=int), [], [], 0.1, 0.1, n_features=1)


def random_chain(seed: int, n: int = 3, *, rhythm: bool = False, pace_hz: float = 0.02) -> PhaseType:
    rng = np.random.default_rng(seed)
    rates = pace_hz * 10 ** rng.uniform(-2, 0, (n, n))
    np.fill_diagonal(rates, 0.0)
    present = np.arange(n) % 2 == 1
    if not rhythm:
        return PhaseType(present, rates)
    which = rng.integers(-1, 2, (n, n))
    return PhaseType(present, rates, None, tuple(Rhythm(rng.normal(0.0, 1.0, BINS)) for _ in range(2)), which)


def random_looks(seed: int, n: int = 40, span_s: float = 400.0, n_features: int = 3) -> Looks:
    rng = np.random.default_rng(seed)
    return Looks.from_rows(
        rng.integers(0, n_features, n), rng.uniform(0.0, span_s, n) + 1e6, rng.random(n) < 0.5,
        rng.uniform(0.05, 0.6, n), rng.uniform(0.05, 0.6, n), n_features=n_features,
    )  # fmt: skip


def generator(rates: Any) -> Any:
    return rates - np.diag(rates.sum(1))


def gap_matrix(model: PhaseType, from_s: float, to_s: float) -> Any:
    """Transition between two instants, bin by bin with scipy's exponentials."""
    rates = model.rates_by_bin
    if len(rates) == 1:
        return expm(generator(rates[0]) * (to_s - from_s))
    total = np.eye(model.n_phases)
    while from_s < to_s:
        number = int(np.floor((from_s - MONDAY_S) / BIN_S))
        stop = min(to_s, MONDAY_S + (number + 1) * BIN_S)
        total = total @ expm(generator(rates[number % BINS]) * (stop - from_s))
        from_s = stop
    return total


@pytest.mark.parametrize("n", [2, 3, 5])
def test_transitions_are_matrix_exponentials(n: int) -> None:
    rng = np.random.default_rng(n)
    for span_s in (1e-9, 1e-3, 0.7, 15.0, 17.0, 300.0):
        rates = rng.random((n, n)) * 10 ** rng.uniform(-4, 0, (n, n))
        np.fill_diagonal(rates, 0.0)
        exact = expm(generator(rates) * span_s)
        found, belief = np.empty((n, n)), rng.dirichlet(np.ones(n))
        transition(rates, rates.sum(1), span_s, found)
        np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-13)
        after = belief.copy()
        leap(after, rates, rates.sum(1), span_s, np.empty((3, n)))
        np.testing.assert_allclose(after, belief @ exact, rtol=1e-12, atol=1e-13)


def test_small_probabilities_keep_their_digits() -> None:
    """Three slow changes in a row: to leading order the product of the rates, by time cubed over 6."""
    rates = np.zeros((4, 4))
    rates[[0, 1, 2], [1, 2, 3]] = 1e-20
    found = np.empty((4, 4))
    transition(rates, rates.sum(1), 2.0, found)
    assert found[0, 3] == pytest.approx(1e-60 * 8.0 / 6.0, rel=1e-12, abs=0.0)


@pytest.mark.parametrize("rhythm", [False, True])
def test_filter_is_a_sum_over_all_paths(rhythm: bool) -> None:
    model = random_chain(4, rhythm=rhythm)
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0.0, 4000.0, 5)) + 3e5
    looks = Looks.from_rows(np.zeros(5, dtype=int), time, rng.random(5) < 0.5, 0.2, 0.3)
    instants = np.array([time[0] - 900.0, time[2], time[3] + 1.0, time[4] + 5000.0])
    track = model.track(looks, Instants.same_for_all(1, instants))
    start = model.stationary(float(instants[0]))

    def weight_of(paths_until: float, at: float) -> tuple[float, float]:
        """Weight of all paths, and of those that are there at `at`, by enumeration of phases at every event."""
        times = [*time[time <= paths_until], at]
        total = there = 0.0
        gaps = [gap_matrix(model, a, b) for a, b in itertools.pairwise([instants[0], *times])]
        for path in itertools.product(range(model.n_phases), repeat=len(times) + 1):
            weight = start[path[0]]
            for k, matrix in enumerate(gaps):
                weight *= matrix[path[k], path[k + 1]]
                if k < len(times) - 1:
                    hit = looks.detected[k] == 1.0
                    weight *= (0.8 if hit else 0.2) if model.present[path[k + 1]] else (0.3 if hit else 0.7)
            total += weight
            there += weight if model.present[path[-1]] else 0.0
        return total, there

    for found, at in zip(track.p_present, instants, strict=True):
        total, there = weight_of(at, at)
        assert found == pytest.approx(there / total, rel=1e-11)
    assert track.log_evidence[0] == pytest.approx(np.log(weight_of(np.inf, time[-1])[0]), rel=1e-11)


@pytest.mark.parametrize("rhythm", [False, True])
def test_asking_more_changes_no_answer(rhythm: bool) -> None:
    model, looks = random_chain(1, rhythm=rhythm), random_looks(2, span_s=9000.0)
    few, many = 1e6 + np.array([-100.0, 300.0, 20000.0]), 1e6 + np.linspace(-100.0, 20000.0, 202)
    coarse = model.track(looks, Instants.same_for_all(3, few))
    fine = model.track(looks, Instants.same_for_all(3, many))
    np.testing.assert_allclose(
        fine.p_present.reshape(3, -1)[:, [0, 4, 201]], coarse.p_present.reshape(3, -1), rtol=1e-9
    )
    np.testing.assert_allclose(fine.log_evidence, coarse.log_evidence, rtol=1e-11)


def test_weeks_may_be_shifted_and_time_scaled() -> None:
    looks = random_looks(3)
    weekly = random_chain(2, rhythm=True)
    later = Looks(looks.first, looks.stamp_s + 3 * WEEK_S, looks.detected, looks.p_miss, looks.p_false)
    np.testing.assert_allclose(weekly.track(later).p_present, weekly.track(looks).p_present, rtol=1e-8)
    chain = random_chain(2)
    slow = Looks(looks.first, looks.stamp_s * 1024.0, looks.detected, looks.p_miss, looks.p_false)
    slowed = PhaseType(chain.present, chain.rates_hz / 1024.0)
    np.testing.assert_allclose(slowed.track(slow).p_present, chain.track(looks).p_present, rtol=1e-12)


def test_a_detector_that_says_nothing_changes_nothing() -> None:
    model, looks = random_chain(6), random_looks(7)
    blind = Looks(looks.first, looks.stamp_s, looks.detected, looks.p_miss, 1.0 - looks.p_miss)
    long_run = model.stationary()[model.present].sum()
    np.testing.assert_allclose(model.track(blind).p_present, long_run, rtol=1e-12)


def test_without_return_it_is_the_persistence_filter() -> None:
    rng = np.random.default_rng(8)
    time = np.sort(rng.uniform(0.0, 300.0, 60))
    hit, miss, false = rng.random(60) < 0.4, rng.uniform(0.05, 0.5, 60), rng.uniform(0.05, 0.5, 60)
    old = PersistenceFilter(Exponential(0.01))
    expected = [old.update(*row) for row in zip(time, hit.tolist(), miss, false, strict=True)]
    track = PhaseType.two_state(0.01, 0.0, p_present=1.0).track(since_birth(0.0, time, hit, miss, false))
    np.testing.assert_allclose(track.p_present[1:], expected, rtol=1e-11)
    assert track.log_evidence[0] == pytest.approx(old.log_evidence + np.log(0.5), rel=1e-12)


def test_without_return_it_has_the_reference_posteriors(rosen_traces: list[dict[str, Any]]) -> None:
    for sequence in rosen_traces:
        reference = sequence["priors"]["exponential"]
        looks = since_birth(sequence["init_time"], sequence["times"], sequence["y"], sequence["P_M"], sequence["P_F"])
        model = PhaseType.two_state(reference["params"]["rate"], 0.0, p_present=1.0)
        np.testing.assert_allclose(model.track(looks).p_present[1:], reference["posterior"], atol=1e-9)
        future = model.track(looks, Instants.same_for_all(1, np.sort(reference["future_times"])))
        np.testing.assert_allclose(
            future.p_present, np.array(reference["future"])[np.argsort(reference["future_times"])], atol=1e-9
        )


def since_birth(birth_s: float, time: Any, hit: Any, miss: Any, false: Any) -> Looks:
    """Looks at one feature; one that says nothing stands for its birth."""
    columns = (np.append(first, rest) for first, rest in ((birth_s, time), (1, hit), (0.5, miss), (0.5, false)))
    return Looks.from_rows(np.zeros(len(time) + 1, dtype=int), *columns)


def test_forecast_of_two_states_has_a_closed_form() -> None:
    leave, back = 1e-3, 4e-3
    model = PhaseType.two_state(leave, back, p_present=0.9)
    ahead = np.logspace(-3, 7, 60)
    track = model.track(NO_LOOKS, Instants.same_for_all(1, np.append(0.0, ahead)))
    mean = back / (leave + back)
    expected = mean + (0.9 - mean) * np.exp(-(leave + back) * ahead)
    np.testing.assert_allclose(track.p_present[1:], expected, rtol=1e-13)


def test_long_run_with_a_rhythm_repeats_every_week() -> None:
    model = random_chain(9, rhythm=True)
    at = MONDAY_S + 123456.0
    belief = model.stationary(at)
    np.testing.assert_allclose(belief @ gap_matrix(model, at, at + WEEK_S), belief, rtol=1e-9)
    far = model.track(NO_LOOKS, Instants.same_for_all(1, [at - 50 * WEEK_S, at])).p_present[1]
    assert far == pytest.approx(belief[model.present].sum(), rel=1e-9)


def test_mixtures_keep_their_survival() -> None:
    stay = Mixture.of([Exponential(0.1), Exponential(0.001)], [0.3, 0.7])
    model = PhaseType.from_mixtures(stay, Exponential(1e-3))
    # phases: one absence, then the two stays; with the return cut, presence is the survival function
    rates = model.rates_hz.copy()
    rates[0] = 0.0
    once = PhaseType(model.present, rates, np.array([0.0, 0.3, 0.7]))
    t = np.array([0.0, 1.0, 30.0, 2000.0])
    found = once.track(NO_LOOKS, Instants.same_for_all(1, t)).p_present
    np.testing.assert_allclose(found, np.exp(stay.log_survival(t)), rtol=1e-12)
    assert model.stationary()[model.present].sum() == pytest.approx(stay.mean() / (stay.mean() + 1000.0), rel=1e-12)


def test_an_unknown_rate_is_a_mixture_of_a_few() -> None:
    prior = GeneralPurpose(1e-4, 1e-1)
    t = np.logspace(-1, 4.5, 50)
    rates, weights = exponential_mixture_of(prior, 16)
    found = Mixture.of([Exponential(rate) for rate in rates], weights).log_survival(t)
    np.testing.assert_allclose(np.exp(found), np.exp(prior.log_survival(t)), atol=1e-6)
    with pytest.raises(ConfigError, match="not a mixture of exponentials"):
        exponential_mixture_of(Weibull(10.0, 2.0))


def believed(model: PhaseType, *phases: Any, stamp_s: float = 0.0) -> PhaseBelief:
    n = len(phases)
    return PhaseBelief(model, np.array(phases, dtype=float), np.full(n, stamp_s), np.zeros(n))


def test_mean_times_without_a_rhythm() -> None:
    model = PhaseType.two_state(1 / 300.0, 1 / 50.0)
    np.testing.assert_allclose(believed(model, [0.0, 1.0], [0.9, 0.1], [1.0, 0.0]).time_to_leave(), [300, 300, np.nan])
    np.testing.assert_allclose(believed(model, [0.0, 1.0], [0.9, 0.1], [1.0, 0.0]).time_to_return(), [np.nan, 50, 50])
    three = PhaseType.from_mixtures(Exponential(0.1), Mixture.of([Exponential(0.1), Exponential(0.01)], [0.5, 0.5]))
    np.testing.assert_allclose(believed(three, [0.1, 0.3, 0.6]).time_to_return(), [0.25 * 10.0 + 0.75 * 100.0])
    gone = PhaseType.two_state(0.1, 0.0, p_present=1.0)
    np.testing.assert_allclose(believed(gone, [0.5, 0.5]).time_to_return(), [np.inf])
    np.testing.assert_allclose(believed(gone, [0.5, 0.5]).time_to_leave(), [10.0])


def test_mean_times_with_a_rhythm_are_integrals_of_survival() -> None:
    model = random_chain(10, n=4, rhythm=True, pace_hz=2e-5)
    at, weights = MONDAY_S + 987654.0, [0.6, 0.1, 0.3, 0.0]
    stays = model.rates_hz.copy()
    stays[model.present] = 0.0  # presence holds what arrives: what is not there has not yet returned
    held = PhaseType(model.present, stays, np.array([2 / 3, 0, 1 / 3, 0]), model.rhythms, model.rhythm_of)
    t = at + np.arange(0.0, 6 * WEEK_S, 60.0)
    absent = 1.0 - held.track(NO_LOOKS, Instants.same_for_all(1, t)).p_present
    found = believed(model, weights, stamp_s=at).time_to_return()
    np.testing.assert_allclose(found, [np.trapezoid(absent, t)], rtol=1e-4)


@pytest.mark.parametrize("rhythm", [False, True])
def test_step_by_step_is_the_whole(rhythm: bool) -> None:
    model, looks = random_chain(11, rhythm=rhythm), random_looks(12, n=30, n_features=2)
    track = model.track(looks, Instants.same_for_all(2, [1e6 + 450.0]))
    firsts = looks.stamp_s[looks.first[:-1]]
    state = PhaseBelief.first(model, firsts)
    for f in range(2):
        one = looks.of(f)
        for k in range(len(one.stamp_s)):
            state = state.update(one.stamp_s[k], one.detected[k], one.p_miss[k], one.p_false[k], rows=np.array([f]))
    np.testing.assert_allclose(state.predict(1e6 + 450.0), track.p_present, rtol=1e-11)
    at_once = PhaseBelief.after(model, looks)
    np.testing.assert_allclose(at_once.phases, state.phases, rtol=1e-11)
    np.testing.assert_array_equal(at_once.stamp_s, state.stamp_s)
    np.testing.assert_allclose(state.log_evidence, track.log_evidence, rtol=1e-11)
    with pytest.raises(InputError, match=r"row 0: time 3\.0 s lies before"):
        state.predict(3.0)


def test_a_given_start_holds_until_the_first_look() -> None:
    model = PhaseType.two_state(0.1, 0.2, p_present=0.25)
    looks = Looks.from_rows([0], [100.0], [1], 0.1, 0.1)
    track = model.track(looks, Instants.same_for_all(1, [0.0, 99.0, 100.0]))
    odds = 0.25 * 0.9 / (0.75 * 0.1)
    np.testing.assert_allclose(track.p_present, [0.25, 0.25, odds / (1.0 + odds)], rtol=1e-13)


def test_refusals() -> None:
    with pytest.raises(ConfigError, match="never returns"):
        PhaseType.two_state(0.1, 0.0)
    with pytest.raises(ConfigError, match="some phases"):
        PhaseType(np.array([True, True]), np.zeros((2, 2)))
    with pytest.raises(ConfigError, match="rates"):
        PhaseType.two_state(-0.1, 0.1)
    with pytest.raises(ConfigError, match="depends on the first one"):
        PhaseType(np.array([True, False]), np.zeros((2, 2))).stationary()
    gone = PhaseType(np.array([False, True]), np.zeros((2, 2)), np.array([1.0, 0.0]))
    looks = Looks.from_rows([0, 1, 1], [0.0, 0.0, 5.0], [0, 0, 1], 0.1, 0.0)
    with pytest.raises(NumericalError, match=r"feature 1 at 5\.0 s: this observation is impossible"):
        gone.track(looks)
