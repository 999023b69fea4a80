"""Laws of every model of presence: one stay, phases, run lengths, rhythms, the chain of a clique over its sites."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evermap.existence.lifetimes import Lifetimes
from evermap.existence.models import model_of
from evermap.existence.one_stay import OneStay, PersistenceFilter
from evermap.existence.phase_belief import PhaseBelief
from evermap.existence.phase_type import PhaseType
from evermap.existence.protocol import Instants, Looks, PresenceModel, Track
from evermap.existence.rhythm import BINS, WEEK_S, Rhythm
from evermap.existence.run_length import RunLength, RunLengthBelief
from evermap.existence.sites import SiteDynamics, SiteLooks
from evermap.sensing.sightlines import Lines
from evermap.survival import Exponential, Gamma, LogNormal, Mixture, Weibull, never_leaves
from evermap.types import FloatArray

from .rows import follow_sites

P_FALSE = 0.2
"""The same at all looks: the sites' sensor has one."""
SURE = 1e12
"""Pseudo counts of a line of sight whose detection probability is known."""


@dataclass(frozen=True)
class AtOneSite:
    """The chain of a clique with one site behind the calls of the other models; it stands there when first heard of."""

    lifetimes: Lifetimes

    def track(self, looks: Looks, instants: Instants | None = None) -> Track:
        asked = instants or Instants.of_looks(looks)
        p, evidence = np.empty(len(asked.stamp_s)), np.zeros(looks.n_features)
        for f in range(looks.n_features):
            own, times = looks.of(f), asked.stamp_s[asked.first[f] : asked.first[f + 1]]
            begin = min([*own.stamp_s[:1], *times[:1]], default=0.0)
            for k, time in enumerate(times):
                p[asked.first[f] + k] = self._until(own, begin, float(time))[0]
            evidence[f] = self._until(own, begin, float(max([begin, *own.stamp_s[-1:]])))[1]
        return Track(p, evidence, np.zeros(looks.n_features))

    def _until(self, looks: Looks, begin_s: float, until_s: float) -> tuple[float, float]:
        n = int(np.searchsorted(looks.stamp_s, until_s, side="right"))
        at, zeros = np.array([begin_s]), np.zeros(n, np.int64)
        rows = SiteLooks(looks.stamp_s[:n], zeros, zeros, np.arange(n), looks.detected[:n] == 1.0)
        lines = Lines(np.ones(n), SURE * (1.0 - looks.p_miss[:n]), SURE * looks.p_miss[:n], 0.0)
        share = np.array([1.0 - self.lifetimes.absence.p_never_leaves])
        dynamics = SiteDynamics((self.lifetimes.stay,), at, (self.lifetimes.absence,), at, np.zeros(1), share)
        found = follow_sites(
            np.ones(1), np.zeros(1, np.int64), dynamics, rows, lines,
            start_s=begin_s, until_s=until_s, p_false=P_FALSE, p_occluded=0.0, occluded_s=0.0,
        )  # fmt: skip
        away = np.log(np.where(looks.detected[:n] == 1.0, P_FALSE, 1.0 - P_FALSE)).sum()
        return float(found.p_here[0]), float(found.log_evidence[0] + away)


RHYTHM = Rhythm(np.round(np.sin(np.arange(BINS) / 23.0), 5))
STAY, ABSENCE = LogNormal(np.log(40.0), 0.5), Gamma(2.0, 30.0)
MIXED = Mixture.of([Exponential(0.1), Exponential(1e-3)], [0.3, 0.7])
STORED: dict[str, PresenceModel] = {
    "one stay": OneStay(Weibull(60.0, 1.7)),
    "two phases": PhaseType.two_state(0.01, 0.03),
    "five phases": PhaseType.from_mixtures(MIXED, Mixture.of([MIXED, Exponential(0.5)], [0.5, 0.5])),
    "phases, rhythm": PhaseType(
        np.array([False, True]), np.array([[0.0, 1e-2], [2e-2, 0.0]]), None, (RHYTHM,), np.array([[-1, 0], [-1, -1]])
    ),
    "run lengths": RunLength(STAY, ABSENCE, 1.0),
    "run lengths, rhythm": RunLength(STAY, ABSENCE, 1.0, RHYTHM, RHYTHM, False, 16),
}
MODELS: dict[str, Any] = STORED | {"one site": AtOneSite(Lifetimes(STAY, Exponential(0.02)))}
every_model = pytest.mark.parametrize("name", MODELS)
few = settings(max_examples=15, deadline=None)


@st.composite
def looks(draw: st.DrawFn, features: int = 3, longest: int = 14) -> Looks:
    """Looks at a few features, each seen at first, at times that floats hold exactly."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = draw(st.integers(features, longest))
    time = 1e6 + np.cumsum(rng.integers(0, 160, n)) / 16.0
    which = np.concatenate([np.arange(features), rng.integers(0, features, n - features)])
    hit = np.where(np.arange(n) < features, True, rng.random(n) < 0.5)
    return Looks.from_rows(which, time, hit, rng.uniform(0.05, 0.6, n), P_FALSE, n_features=features)


def asked_of(seen: Looks, stamps: Any) -> Instants:
    """Instants from the last of all looks on."""
    return Instants.same_for_all(seen.n_features, seen.stamp_s.max() + np.asarray(stamps))


def chosen(seen: Looks, features: Any) -> Looks:
    """The looks at some features, in this order."""
    parts = [seen.of(f) for f in features]
    first = np.concatenate([[0], np.cumsum([len(part.stamp_s) for part in parts])])
    columns = ("stamp_s", "detected", "p_miss", "p_false")
    return Looks(first, *(np.concatenate([getattr(part, c) for part in parts]) for c in columns))


@every_model
@few
@given(seen=looks())
def test_beliefs_are_probabilities(name: str, seen: Looks) -> None:
    track = MODELS[name].track(seen, asked_of(seen, [0.0, 0.5, 30.0, 1e4]))
    for p in (track.p_present, MODELS[name].track(seen).p_present):
        assert ((p >= 0.0) & (p <= 1.0)).all()
    assert (track.log_evidence <= 1e-12).all()
    assert (track.merged_mass >= 0.0).all()


@every_model
@few
@given(seen=looks(), order=st.permutations(range(3)))
def test_permuting_features_permutes_the_answer(name: str, seen: Looks, order: list[int]) -> None:
    """And a feature alone is answered as among others."""
    whole = MODELS[name].track(seen, asked_of(seen, [0.0, 7.0, 90.0]))
    mixed = MODELS[name].track(chosen(seen, order), asked_of(seen, [0.0, 7.0, 90.0]))
    np.testing.assert_allclose(mixed.p_present.reshape(3, -1), whole.p_present.reshape(3, -1)[order], rtol=1e-12)
    np.testing.assert_allclose(mixed.log_evidence, whole.log_evidence[order], rtol=1e-12, atol=1e-14)
    alone = MODELS[name].track(seen.of(order[0]), Instants.same_for_all(1, seen.stamp_s.max() + np.array([0, 7, 90])))
    np.testing.assert_allclose(alone.p_present, whole.p_present.reshape(3, -1)[order[0]], rtol=1e-12)


@every_model
@few
@given(seen=looks(), between=st.lists(st.floats(0.0, 100.0), max_size=5))
def test_asking_in_between_changes_no_answer(name: str, seen: Looks, between: list[float]) -> None:
    few_s = np.array([0.0, 13.0, 100.0])
    many_s = np.sort(np.concatenate([few_s, between]))
    coarse = MODELS[name].track(seen, asked_of(seen, few_s)).p_present.reshape(3, -1)
    fine = MODELS[name].track(seen, asked_of(seen, many_s)).p_present.reshape(3, -1)
    np.testing.assert_allclose(fine[:, np.searchsorted(many_s, few_s)], coarse, rtol=1e-9, atol=1e-13)


@every_model
@few
@given(seen=looks(features=1, longest=9))
def test_the_evidence_is_the_product_of_the_predictions(name: str, seen: Looks) -> None:
    """Two parts of a sequence are the whole: each look is judged by the belief of those before it."""
    model, total = MODELS[name], 0.0
    columns = (seen.stamp_s, seen.detected, seen.p_miss, seen.p_false)
    _, there, gone = seen.columns()
    for k in range(len(seen.stamp_s)):
        past = Looks(np.array([0, k]), *(column[:k] for column in columns))
        if k == 0 and name == "one stay":
            continue  # the detection of the birth is not an observation
        p = model.track(past, Instants.same_for_all(1, seen.stamp_s[k : k + 1])).p_present[0]
        total += np.log(p * there[k] + (1.0 - p) * gone[k])
    assert model.track(seen).log_evidence[0] == pytest.approx(total, rel=1e-8, abs=1e-9)


@every_model
@few
@given(seen=looks(features=1), coins=st.lists(st.floats(0.0, 60.0), min_size=1, max_size=5))
def test_a_coin_carries_no_information(name: str, seen: Looks, coins: list[float]) -> None:
    """`P_M = 1 - P_F`: the answer is the forecast, and only the coin's own probability is added to the evidence."""
    if name.startswith("run lengths"):
        coins = [float(round(coin)) for coin in coins]  # on its steps: between them a look is a step of its own
    model = MODELS[name]
    if name == "one site":  # of those that return, it knows the mean time of arrival only
        model = AtOneSite(Lifetimes(STAY, never_leaves()))
    when = seen.stamp_s.max() + np.sort(coins)
    columns = zip(
        (seen.stamp_s, seen.detected, seen.p_miss, seen.p_false), (when, 0, 1 - P_FALSE, P_FALSE), strict=True
    )
    more = Looks.from_rows(
        np.zeros(len(seen.stamp_s) + len(when), int),
        *(np.concatenate([old, np.broadcast_to(new, len(when))]) for old, new in columns),
    )
    ahead = Instants.same_for_all(1, when[-1] + np.array([0.0, 40.0]))
    plain, tossed = model.track(seen, ahead), model.track(more, ahead)
    np.testing.assert_allclose(tossed.p_present, plain.p_present, rtol=1e-9, atol=1e-12)
    expected = plain.log_evidence[0] + len(when) * np.log(1.0 - P_FALSE)
    assert tossed.log_evidence[0] == pytest.approx(expected, rel=1e-9)


@every_model
@few
@given(seen=looks(), weeks=st.integers(1, 5))
def test_whole_weeks_later_everything_is_the_same(name: str, seen: Looks, weeks: int) -> None:
    later = Looks(seen.first, seen.stamp_s + weeks * WEEK_S, seen.detected, seen.p_miss, seen.p_false)
    now, then = (MODELS[name].track(one, asked_of(one, [0.0, 7.0, 90.0])) for one in (seen, later))
    np.testing.assert_allclose(then.p_present, now.p_present, rtol=1e-9)
    np.testing.assert_allclose(then.log_evidence, now.log_evidence, rtol=1e-9)


ONCE: dict[str, Callable[[float], Any]] = {
    "one stay": lambda rate: OneStay(Exponential(rate)),
    "phases": lambda rate: PhaseType.two_state(rate, 0.0, p_present=1.0),
    "run lengths": lambda rate: RunLength(Exponential(rate), never_leaves(), 1.0, newborn=True),
    "one site": lambda rate: AtOneSite(Lifetimes(Exponential(rate), never_leaves())),
}


@pytest.mark.parametrize("name", ONCE)
@few
@given(seen=looks(features=1), rate=st.floats(1e-4, 0.1))
def test_without_return_it_is_the_persistence_filter(name: str, seen: Looks, rate: float) -> None:
    """With no further look that is the conditional survival of the lifetime that the model gives."""
    model, reference = ONCE[name](rate), PersistenceFilter(Exponential(rate))
    birth_s, ahead = seen.stamp_s[0], np.array([0.0, 3.0, 50.0])
    later = np.flatnonzero(seen.stamp_s >= birth_s)[1:]
    for k in later:
        reference.update(seen.stamp_s[k] - birth_s, bool(seen.detected[k]), seen.p_miss[k], seen.p_false[k])
    last = seen.stamp_s[-1]
    expected = [reference.predict(last - birth_s + t) for t in ahead]
    found = model.track(seen, Instants.same_for_all(1, last + ahead)).p_present
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-13)
    lifetimes = model.lifetimes
    np.testing.assert_allclose(found / found[0], 1.0 - lifetimes.p_leave(last - birth_s, ahead), rtol=1e-9)
    np.testing.assert_array_equal(lifetimes.p_return(1.0, ahead), 0.0)


@every_model
def test_lifetimes_are_distributions(name: str) -> None:
    ages = np.logspace(-1, 6, 40)
    for prior in MODELS[name].lifetimes:
        survival = prior.log_survival(ages)
        assert (survival <= 0.0).all()
        assert (np.diff(survival) <= 0.0).all()
    gap: FloatArray = MODELS[name].lifetimes.p_leave(10.0, ages)
    assert ((gap >= 0.0) & (gap <= 1.0)).all()


@pytest.mark.parametrize("name", STORED)
def test_models_are_kept_as_plain_values_and_show_themselves_shortly(name: str) -> None:
    model = STORED[name]
    assert isinstance(model, PresenceModel)
    again = model_of(model.to_dict())
    assert again.to_dict() == model.to_dict()
    assert len(repr(model)) < 1000
    assert "\n" not in repr(model)


def test_beliefs_and_tables_show_themselves_shortly() -> None:
    rng = np.random.default_rng(0)
    many = Looks.from_rows(
        rng.integers(0, 50, 900), np.sort(rng.uniform(0, 900, 900)), rng.random(900) < 0.5, 0.1, P_FALSE, n_features=50
    )
    run_length, phases = STORED["run lengths"], STORED["two phases"]
    assert isinstance(run_length, RunLength)
    assert isinstance(phases, PhaseType)
    beliefs = (
        RunLengthBelief.after(run_length, many),
        PhaseBelief.after(phases, many),
        PersistenceFilter(Exponential(1.0)),
    )
    for one in (many, run_length.track(many), *beliefs):
        assert len(repr(one)) < 1000
