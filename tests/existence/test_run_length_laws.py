"""Laws of the run-length filter, and what it must come to where simpler filters are exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.existence.one_stay import PersistenceFilter
from evermap.existence.protocol import Instants, Looks
from evermap.existence.rhythm import BINS, WEEK_S, Rhythm
from evermap.existence.run_length import RunLength, RunLengthBelief
from evermap.survival import (
    Exponential,
    Gamma,
    GeneralPurpose,
    LifetimePrior,
    LogNormal,
    PiecewiseConstantHazard,
    Weibull,
    never_leaves,
)
from evermap.types import FloatArray

STAY, ABSENCE = LogNormal(np.log(40.0), 0.5), Gamma(2.0, 30.0)
PLAIN = RunLength(STAY, ABSENCE, 1.0)
RHYTHMS = [Rhythm(np.random.default_rng(k).normal(0.0, 0.7, BINS)) for k in (1, 2)]
WITH_RHYTHM = RunLength(STAY, ABSENCE, 1.0, RHYTHMS[0], RHYTHMS[1])
MODELS = {"no rhythm": PLAIN, "rhythm": WITH_RHYTHM}


def looks_of(seed: int, n_features: int = 5, n: int = 200, begin_s: float = 1000.0) -> Looks:
    """Looks at random features in turn, at times that floats hold exactly."""
    rng = np.random.default_rng(seed)
    time = begin_s + np.cumsum(rng.integers(0, 48, n)) / 16.0
    return Looks.from_rows(
        rng.integers(0, n_features, n), time, rng.random(n) < 0.5, rng.uniform(0.05, 0.5, n), rng.uniform(0.05, 0.5, n),
        n_features=n_features,
    )  # fmt: skip


def scored_with(looks: Looks, **columns: Any) -> Looks:
    """The looks with other columns."""
    whole = {name: getattr(looks, name) for name in ("first", "stamp_s", "detected", "p_miss", "p_false")}
    return Looks(**{**whole, **columns})


# --- a feature that never returns -------------------------------------------------------------------------------------


def persistence_of(prior: LifetimePrior, looks: Looks) -> tuple[FloatArray, float]:
    """Rosen's filter at the looks at one feature that is born at the first of them."""
    one = PersistenceFilter(prior)
    rows = zip(looks.stamp_s - looks.stamp_s[0], looks.detected == 1.0, looks.p_miss, looks.p_false, strict=True)
    return np.array([one.update(*row) for row in rows]), one.log_evidence


@pytest.mark.parametrize(
    "prior",
    [
        Exponential(0.03),
        PiecewiseConstantHazard((0.0, 2.0, 10.0, 40.0, 56.0), (0.0, 0.2, 0.001, 1.5, 0.01)),
        PiecewiseConstantHazard((0.0, 16.0), (0.05, 0.0)),
    ],
    ids=["exponential", "piecewise", "some never leave"],
)
def test_without_return_it_is_the_persistence_filter(prior: LifetimePrior) -> None:
    model = RunLength(prior, never_leaves(), 1.0, newborn=True, hypotheses=16)
    for seed in range(10):
        looks = looks_of(seed, n_features=1, n=60)
        expected, evidence = persistence_of(prior, looks)
        last = np.append(np.diff(looks.stamp_s) > 0.0, True)
        track = model.track(looks)
        np.testing.assert_allclose(track.p_present[last], expected[last], rtol=1e-10, atol=1e-13)
        assert track.log_evidence[0] == pytest.approx(evidence, abs=1e-10)


@pytest.mark.parametrize(
    ("prior", "tolerance"), [(Weibull(60.0, 1.7), 1e-3), (LogNormal(4.0, 0.6), 1e-3), (Gamma(0.4, 100.0), 2e-3)]
)
def test_without_return_other_lifetimes_differ_by_the_width_of_a_bin(prior: LifetimePrior, tolerance: float) -> None:
    """Within a bin, 1/64 to 1/128 of an age wide, the hazard is its mean.

    That moves beliefs by less than 0.001, or 0.002 where the spread of lifetimes is only a tenth of their mean.
    """
    model = RunLength(prior, never_leaves(), 1.0, newborn=True)
    for seed in range(10):
        looks = looks_of(seed, n_features=1, n=60)
        expected, evidence = persistence_of(prior, looks)
        last = np.append(np.diff(looks.stamp_s) > 0.0, True)
        track = model.track(looks)
        np.testing.assert_allclose(track.p_present[last], expected[last], atol=tolerance)
        assert track.log_evidence[0] == pytest.approx(evidence, abs=5e-3)


@pytest.mark.parametrize(("name", "tolerance"), [("exponential", 1e-9), ("log_uniform", 2e-3)])
def test_without_return_it_gives_the_reference_numbers(
    rosen_traces: list[dict[str, Any]], name: str, tolerance: float
) -> None:
    """Exact for exponential lifetimes; for an unknown rate up to the width of the table's bins."""
    for sequence in rosen_traces:
        reference = sequence["priors"][name]
        parameters = reference["params"]
        prior = (
            Exponential(parameters["rate"])
            if name == "exponential"
            else GeneralPurpose(parameters["lambda_l"], parameters["lambda_u"])
        )
        looks = Looks.from_rows(
            np.zeros(len(sequence["times"]), int), sequence["times"], sequence["y"], sequence["P_M"], sequence["P_F"]
        )
        step_s = max(float(np.median(np.diff(looks.stamp_s))), 1e-3)
        model = RunLength(prior, never_leaves(), step_s, newborn=True, hypotheses=16)
        asked = np.array([sequence["init_time"], *looks.stamp_s, *reference["future_times"]])
        track = model.track(looks, Instants.same_for_all(1, asked))
        n = len(looks.stamp_s)
        last = np.append(np.diff(looks.stamp_s) > 0.0, True)
        found, future = track.p_present[1 : n + 1], track.p_present[n + 1 :]
        np.testing.assert_allclose(found[last], np.array(reference["posterior"])[last], atol=tolerance)
        np.testing.assert_allclose(future, reference["future"], atol=tolerance)


# --- lifetimes that forget their age ----------------------------------------------------------------------------------


def two_states(leave_hz: float, return_hz: float, looks: Looks) -> tuple[FloatArray, float]:
    """The Markov chain of two states in closed form, from its long run on."""
    total, evidence, now = leave_hz + return_hz, 0.0, looks.stamp_s[0]
    p, found = return_hz / total, []
    for time, hit, miss, false in zip(looks.stamp_s, looks.detected, looks.p_miss, looks.p_false, strict=True):
        p = return_hz / total + (p - return_hz / total) * np.exp(-total * (time - now))
        there, away = (1.0 - miss, false) if hit else (miss, 1.0 - false)
        likelihood = p * there + (1.0 - p) * away
        p, now, evidence = p * there / likelihood, time, evidence + np.log(likelihood)
        found.append(p)
    return np.array(found), evidence


def test_exponential_lifetimes_approach_the_two_state_chain_as_the_step_shrinks() -> None:
    """The error halves with the step: it is of first order, for at most one change a step is one too few."""
    looks = looks_of(3, n_features=1, n=60)
    expected, evidence = two_states(0.05, 0.02, looks)
    last = np.append(np.diff(looks.stamp_s) > 0.0, True)
    errors, gains = [], []
    for step_s in (0.5, 0.25, 0.125, 0.0625, 0.03125):
        track = RunLength(Exponential(0.05), Exponential(0.02), step_s).track(looks)
        errors.append(np.abs(track.p_present - expected)[last].max())
        gains.append(abs(track.log_evidence[0] - evidence))
    for error in (errors, gains):
        np.testing.assert_allclose(np.array(error[1:]) / np.array(error[:-1]), 0.5, atol=0.05)
    assert errors[-1] < 5e-4


# --- laws -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MODELS)
def test_look_by_look_is_the_whole_at_once(name: str) -> None:
    model, looks = MODELS[name], looks_of(1)
    track = model.track(looks)
    state = RunLengthBelief.first(model, looks.stamp_s[looks.first[:-1]])
    found = np.empty(len(looks.stamp_s))
    for row in np.argsort(looks.stamp_s, kind="stable"):  # features in turn, as a robot meets them
        feature = np.searchsorted(looks.first, row, side="right") - 1
        state.predict(looks.stamp_s[row] + 3.0, rows=[feature])
        args = (looks.stamp_s[row], looks.detected[row], looks.p_miss[row], looks.p_false[row])
        state = state.update(*args, rows=[feature])
        found[row] = state.probability[feature]
    last = np.append((np.diff(looks.stamp_s) > 0.0) | (np.diff(looks.stamp_s) < 0.0), True)
    np.testing.assert_allclose(found[last], track.p_present[last], rtol=1e-11)
    np.testing.assert_allclose(state.log_evidence, track.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(state.merged_mass, track.merged_mass, rtol=1e-9)
    whole = RunLengthBelief.after(model, looks)
    np.testing.assert_array_equal(whole.weight, state.weight)
    np.testing.assert_array_equal(whole.start_s, state.start_s)
    np.testing.assert_array_equal(whole.stamp_s, state.stamp_s)
    ahead = looks.stamp_s.max() + np.array([0.0, 0.3, 7.9, 300.0])
    forecasts = model.track(looks, Instants.same_for_all(5, ahead)).p_present.reshape(5, 4)
    np.testing.assert_allclose(np.stack([state.predict(t) for t in ahead], axis=1), forecasts, rtol=1e-9)


@pytest.mark.parametrize("name", MODELS)
def test_asking_in_between_changes_nothing(name: str) -> None:
    model, looks = MODELS[name], looks_of(2)
    begun = looks.stamp_s[looks.first[:-1]].max()  # earlier questions would begin the beliefs earlier
    few = begun + np.array([1.0, 71.3, 300.0])
    many = np.sort(np.concatenate([few, np.random.default_rng(1).uniform(begun, begun + 400.0, 400)]))
    coarse, fine = (model.track(looks, Instants.same_for_all(5, asked)) for asked in (few, many))
    chosen = fine.p_present.reshape(5, -1)[:, np.searchsorted(many, few)]
    np.testing.assert_array_equal(chosen, coarse.p_present.reshape(5, 3))
    np.testing.assert_array_equal(coarse.log_evidence, fine.log_evidence)


@pytest.mark.parametrize("name", MODELS)
def test_weeks_later_everything_is_the_same(name: str) -> None:
    model, looks = MODELS[name], looks_of(3)
    later = scored_with(looks, stamp_s=looks.stamp_s + 64 * WEEK_S)
    # stamps of 4e7 s leave 7e-9 s of an age
    np.testing.assert_allclose(model.track(later).p_present, model.track(looks).p_present, rtol=1e-8)
    if name == "no rhythm":
        odd = scored_with(looks, stamp_s=looks.stamp_s + 12345.0)
        np.testing.assert_allclose(model.track(odd).p_present, model.track(looks).p_present, rtol=1e-10)


@pytest.mark.parametrize("factor", [2.0**-10, 0.5, 2.0**17])
def test_another_unit_of_time_changes_nothing(factor: float) -> None:
    looks = looks_of(4)
    model = RunLength(Exponential(0.02 / factor), Weibull(30.0 * factor, 2.0), 1.0 * factor)
    scaled = model.track(scored_with(looks, stamp_s=looks.stamp_s * factor))
    usual = RunLength(Exponential(0.02), Weibull(30.0, 2.0), 1.0).track(looks)
    np.testing.assert_allclose(scaled.p_present, usual.p_present, rtol=1e-12)
    np.testing.assert_allclose(scaled.log_evidence, usual.log_evidence, rtol=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_a_coin_carries_no_information(name: str) -> None:
    """With P_M = 1 - P_F a detection is as likely of one state as of the other."""
    model, looks = MODELS[name], looks_of(5)
    rng = np.random.default_rng(5)
    coins = rng.uniform(0.0, 1.0, len(looks.stamp_s))
    blind = scored_with(looks, p_miss=coins, p_false=1.0 - coins)
    other = scored_with(blind, detected=1.0 - blind.detected)
    np.testing.assert_allclose(model.track(blind).p_present, model.track(other).p_present, rtol=1e-12)
    # one feature, one look: the same as none
    one = Looks.from_rows([0, 0], [1000.0, 1004.0], [1, 1], [0.1, 0.3], [0.2, 0.7])
    none = Looks.from_rows([0], [1000.0], [1], 0.1, 0.2)
    asked = Instants.same_for_all(1, [1004.0, 1006.0])
    np.testing.assert_allclose(model.track(one, asked).p_present, model.track(none, asked).p_present, rtol=1e-12)
    gain = model.track(one).log_evidence - model.track(none).log_evidence
    assert gain[0] == pytest.approx(np.log(0.7), rel=1e-12)


@pytest.mark.parametrize("name", MODELS)
def test_other_features_do_not_matter(name: str) -> None:
    model, looks = MODELS[name], looks_of(6)
    track = model.track(looks)
    order = np.array([3, 0, 4, 1, 2])
    pieces = [looks.of(int(f)) for f in order]
    turned = Looks(
        np.cumsum([0, *(len(piece.stamp_s) for piece in pieces)]),
        *(np.concatenate([getattr(p, c) for p in pieces]) for c in ("stamp_s", "detected", "p_miss", "p_false")),
    )
    again = model.track(turned)
    np.testing.assert_array_equal(again.log_evidence, track.log_evidence[order])
    rows = np.concatenate([np.arange(looks.first[f], looks.first[f + 1]) for f in order])
    np.testing.assert_array_equal(again.p_present, track.p_present[rows])


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([Exponential(0.1), LogNormal(2.0, 0.02), Weibull(5.0, 8.0), Gamma(0.2, 50.0), never_leaves()]),
    st.sampled_from([Exponential(10.0), LogNormal(1.0, 2.0), GeneralPurpose(1e-3, 1e3)]),
    st.floats(1e-12, 0.5),
)
def test_beliefs_are_probabilities(seed: int, stay: LifetimePrior, absence: LifetimePrior, error: float) -> None:
    rng = np.random.default_rng(seed)
    n = 60
    looks = Looks.from_rows(
        rng.integers(0, 3, n), np.cumsum(rng.exponential(3.0, n)), rng.random(n) < 0.5, error, error, n_features=3
    )
    model = RunLength(stay, absence, 1.0, newborn=stay == never_leaves(), hypotheses=8)
    track = model.track(looks, Instants.same_for_all(3, np.linspace(0.0, 300.0, 100)))
    assert ((track.p_present >= 0.0) & (track.p_present <= 1.0)).all()
    assert np.isfinite(track.log_evidence).all()
    assert (track.log_evidence <= 1e-9).all()
    state: RunLengthBelief = RunLengthBelief.after(model, looks)
    np.testing.assert_allclose(
        [[state.weight[f, 0, s, : state.count[f, s]].sum() for s in (0, 1)] for f in range(3)],
        np.stack([1.0 - state.probability, state.probability], axis=1),
        atol=1e-12,
    )


# --- a list of limited length -----------------------------------------------------------------------------------------


def long_record(seed: int, n: int = 4000) -> Looks:
    """A feature that comes and goes as `PLAIN` says, looked at every few seconds."""
    rng = np.random.default_rng(seed)
    changes = np.cumsum(np.ravel([[STAY.sample(rng), ABSENCE.sample(rng)] for _ in range(400)]))
    time = 1000.0 + np.cumsum(rng.uniform(0.5, 4.0, n))
    there = np.searchsorted(changes, time - 1000.0) % 2 == 0
    return Looks.from_rows(np.zeros(n, int), time, np.where(there, 0.8, 0.2) > rng.random(n), 0.2, 0.2)


def test_with_places_enough_nothing_is_merged() -> None:
    looks = looks_of(7, n_features=1, n=40)
    steps = int(np.ceil(np.diff(looks.stamp_s)).sum()) + 1
    enough = RunLength(STAY, ABSENCE, 1.0, newborn=True, hypotheses=2 * steps)
    more = RunLength(STAY, ABSENCE, 1.0, newborn=True, hypotheses=4 * steps)
    assert enough.track(looks).merged_mass[0] == 0.0
    np.testing.assert_allclose(enough.track(looks).p_present, more.track(looks).p_present, rtol=1e-12)


def test_merging_costs_little_and_less_with_more_hypotheses() -> None:
    """Against 1024 hypotheses, over 9000 steps in which nearly every one merges."""
    worst, mean = [], []
    for count in (16, 32, 64, 128):
        errors = []
        for seed in range(3):
            looks = long_record(seed)
            exact = RunLength(STAY, ABSENCE, 1.0, hypotheses=1024).track(looks)
            few = RunLength(STAY, ABSENCE, 1.0, hypotheses=count).track(looks)
            errors.append(np.abs(few.p_present - exact.p_present))
        worst.append(np.max(errors))
        mean.append(np.mean(errors))
    assert (np.diff(mean) < 0.0).all()
    assert mean[2] < 1e-3
    assert worst[2] < 0.02
