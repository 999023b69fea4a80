"""Stays and absences learned from uncertain looks, against the lifetimes that the looks were simulated with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.errors import ConfigError, DataError
from evermap.existence.learn_sojourns import Data, LearnedSojourns, climb, learn, with_lifetimes
from evermap.existence.protocol import Instants, Looks
from evermap.existence.rhythm import BINS, Rhythm, day_shares
from evermap.existence.run_length import RunLength
from evermap.existence.sojourns import FAMILIES
from evermap.survival import Exponential, Gamma, LifetimePrior, LogNormal, Mixture, Weibull
from evermap.types import BoolArray, FloatArray

STEP_S, SPAN_S, ERROR = 2.0, 6000.0, 0.1


def truth(stay: LifetimePrior, absence: LifetimePrior, seed: int, features: int = 6) -> tuple[FloatArray, BoolArray]:
    """Instants (T,) and presence (features, T), each feature in the middle of its life."""
    rng = np.random.default_rng(seed)
    cycle = stay.mean() + absence.mean()
    time = np.arange(0.0, SPAN_S, STEP_S)
    there = np.empty((features, len(time)), dtype=np.bool_)
    for row in there:
        n = int(4.0 * (SPAN_S / cycle + 20.0)) + 20
        changes = np.cumsum(np.column_stack([stay.sample(rng, n), absence.sample(rng, n)]).ravel())
        row[:] = np.searchsorted(changes, time + 20.0 * cycle * rng.uniform(0.5, 1.0), side="right") % 2 == 0
    return time, there


def looks_at(time: FloatArray, there: BoolArray, error: float = ERROR, seed: int = 0) -> Looks:
    """One look at every instant, wrong as often as said."""
    wrong = np.random.default_rng(1000 + seed).random(there.shape) < error
    feature = np.repeat(np.arange(len(there)), len(time))
    return Looks.from_rows(feature, 1e6 + np.tile(time, len(there)), (there ^ wrong).ravel(), error, error)


def standard_errors(
    learned: LearnedSojourns, prior: LifetimePrior, expected: LifetimePrior, name: str, which: int
) -> FloatArray:
    """By how many standard errors of fully observed durations the parameters are off."""
    n = learned.expected.counts[which].n_events
    if name == "exponential":
        assert isinstance(prior, Exponential)
        assert isinstance(expected, Exponential)
        return np.array([np.log(prior.rate / expected.rate) * np.sqrt(n)])
    if name == "lognormal":
        assert isinstance(prior, LogNormal)
        assert isinstance(expected, LogNormal)
        return np.array(
            [
                (prior.mu - expected.mu) / expected.sigma * np.sqrt(n),
                np.log(prior.sigma / expected.sigma) * np.sqrt(2.0 * n),
            ]
        )
    if name == "weibull":
        assert isinstance(prior, Weibull)
        assert isinstance(expected, Weibull)
        # Fisher information of log scale and log shape: 1.053 / shape and 0.780 a root n
        return np.array(
            [
                np.log(prior.scale_s / expected.scale_s) * expected.shape / 1.053 * np.sqrt(n),
                np.log(prior.shape / expected.shape) / 0.780 * np.sqrt(n),
            ]
        )
    mean = np.log(prior.mean() / expected.mean()) * np.sqrt(n * expected.shape)  # type: ignore[attr-defined]
    from scipy.special import polygamma

    shape = float(expected.shape)  # type: ignore[attr-defined]
    information = shape * (shape * float(polygamma(1, shape)) - 1.0)  # of log shape, mean unknown
    return np.array([mean, np.log(prior.shape / shape) * np.sqrt(n * information)])  # type: ignore[attr-defined]


PAIRS: dict[str, tuple[LifetimePrior, LifetimePrior]] = {
    "exponential": (Exponential(1.0 / 60.0), Exponential(1.0 / 90.0)),
    "lognormal": (LogNormal(np.log(60.0), 0.5), LogNormal(np.log(90.0), 0.3)),
    "weibull": (Weibull(60.0, 3.0), Weibull(90.0, 2.0)),
    "gamma": (Gamma(10.0, 6.0), Gamma(30.0, 3.0)),
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "weibull")) for name in PAIRS])
def test_a_family_that_is_known_is_learned_from_noisy_looks(name: str) -> None:
    """4.5 standard errors of durations seen exactly leave some room for what noise hides."""
    stay, absence = PAIRS[name]
    looks = looks_at(*truth(stay, absence, 0))
    learned = learn(looks, families=[name])
    off = [
        *standard_errors(learned, learned.model.stay, stay, name, 1),
        *standard_errors(learned, learned.model.absence, absence, name, 0),
    ]
    assert (np.abs(off) < 4.5).all()
    # what was learned explains the looks better than the truth, as the maximum does
    best = RunLength(stay, absence, learned.model.step_s).track(looks).log_evidence.sum()
    assert learned.log_evidence > best - 0.5
    # twice the gain of a maximum is chi-squared of as many degrees of freedom as parameters
    assert learned.log_evidence < best + 12.0


@pytest.mark.slow
def test_two_peaks_are_learned_from_noisy_looks() -> None:
    stay = Mixture.of([LogNormal(np.log(30.0), 0.08), LogNormal(np.log(120.0), 0.08)], [0.5, 0.5])
    looks = looks_at(*truth(stay, Exponential(1.0 / 60.0), 3))
    learned = learn(looks, families=("exponential", "peaks"))
    assert learned.candidates[0].name == "peaks stays, exponential absences"
    t = np.array([20.0, 45.0, 80.0, 100.0, 150.0])
    n = learned.expected.counts[1].n_events
    np.testing.assert_allclose(
        np.exp(learned.model.stay.log_survival(t)), np.exp(stay.log_survival(t)), atol=4.0 * np.sqrt(0.25 / n)
    )


def test_durations_that_forget_their_age_are_found_to() -> None:
    looks = looks_at(*truth(*PAIRS["exponential"], 5))
    learned = learn(looks, families=("exponential", "weibull", "lognormal"))
    assert learned.candidates[0].name == "exponential stays, exponential absences"


def test_durations_that_do_not_are_found_not_to() -> None:
    looks = looks_at(*truth(*PAIRS["weibull"], 6))
    learned = learn(looks, families=("exponential", "weibull"))
    assert learned.candidates[0].name == "weibull stays, weibull absences"
    assert [c.score for c in learned.candidates] == sorted((c.score for c in learned.candidates), reverse=True)
    assert learned.candidates[-1].name == "exponential stays, exponential absences"
    assert learned.candidates[-1].freedom == 2.0


def test_the_evidence_never_falls_from_round_to_round() -> None:
    """Exponential lifetimes have their maximum in closed form, so every round climbs.

    What climbs is the evidence with the half event that the rates are given beforehand; born at the first look, so that
    what is believed there does not change with them.
    """
    data = Data.of(looks_at(*truth(*PAIRS["exponential"], 7, features=2)), STEP_S, np.inf, rhythm=False)
    model = RunLength(Exponential(1.0 / 10.0), Exponential(1.0 / 2000.0), STEP_S, newborn=True)
    climbed = []
    for _ in range(25):
        expected = data.expect(model)
        rates = [prior.rate for prior in (model.absence, model.stay) if isinstance(prior, Exponential)]
        climbed.append(expected.log_evidence + 0.5 * np.log(rates).sum())
        absence, stay = (FAMILIES["exponential"](counts, None) for counts in expected.counts)
        model = with_lifetimes(model, (absence, stay))
    assert (np.diff(climbed) > -1e-6).all()
    assert climbed[-1] - climbed[0] > 50.0
    assert climbed[-1] - climbed[-2] < 1e-3


def test_what_is_expected_of_all_is_the_sum_of_what_is_of_each() -> None:
    time, there = truth(Weibull(60.0, 2.0), Exponential(1.0 / 40.0), 3)
    there = there[:, : len(time) // 4]
    looks = looks_at(time[: len(time) // 4], there)
    model = RunLength(Weibull(50.0, 1.5), Exponential(1.0 / 50.0), STEP_S)
    whole = Data.of(looks, STEP_S, 500.0, rhythm=False).expect(model)
    each = []
    for feature in range(looks.n_features):
        alone = Data.of(looks.of(feature), STEP_S, 500.0, rhythm=False).expect(model)
        np.testing.assert_array_equal(whole.presence[feature], alone.presence[0])
        each.append(alone)
    assert whole.log_evidence == pytest.approx(sum(one.log_evidence for one in each), rel=1e-12)
    for state in (0, 1):
        for name in ("events", "exposure_s", "open_ended"):
            parts = sum(getattr(one.counts[state], name) for one in each)
            np.testing.assert_allclose(getattr(whole.counts[state], name), parts, rtol=1e-9, atol=1e-12)


def test_lifetimes_that_forget_their_age_need_few_hypotheses() -> None:
    """And what is learned with few has its ages counted with all."""
    time, there = truth(Exponential(1.0 / 60.0), Exponential(1.0 / 40.0), 3)
    looks = looks_at(time[: len(time) // 4], there[:, : len(time) // 4])
    data = Data.of(looks, STEP_S, np.inf, rhythm=False)
    few, many = (
        data.expect(RunLength(Exponential(0.02), Exponential(0.03), STEP_S, hypotheses=number)) for number in (8, 64)
    )
    assert few.log_evidence == pytest.approx(many.log_evidence, rel=1e-10)
    for one, other in zip(few.counts, many.counts, strict=True):
        assert one.events.sum() == pytest.approx(other.events.sum(), rel=1e-9)
        assert one.exposure_s.sum() == pytest.approx(other.exposure_s.sum(), rel=1e-9)
    learned = learn(looks, families=["exponential"])
    assert learned.model.hypotheses == 64
    again = data.expect(learned.model)
    np.testing.assert_allclose(learned.expected.counts[1].events, again.counts[1].events, rtol=1e-9)


def test_seen_without_error_rates_are_changes_by_time() -> None:
    time, there = truth(*PAIRS["exponential"], 8)
    learned = learn(looks_at(time, there, 1e-9), families=("exponential",))
    changes = there[:, 1:] != there[:, :-1]
    for prior, state in ((learned.model.stay, True), (learned.model.absence, False)):
        assert isinstance(prior, Exponential)
        ended = (changes & (there[:, :-1] == state)).sum()
        # a change is in the middle of a step, and the half of it that follows tells nothing of the new state
        spent = ((there[:, :-1] == state) * STEP_S * np.where(changes, 0.5, 1.0)).sum()
        assert prior.rate == pytest.approx((ended + 0.5) / spent, rel=1e-3)


def test_learning_twice_gives_the_same_numbers() -> None:
    looks = looks_at(*truth(*PAIRS["lognormal"], 9, features=1))
    one, two = (learn(looks, families=("exponential", "lognormal", "smooth")) for _ in range(2))
    assert one.model.to_dict() == two.model.to_dict()
    assert one.log_evidence == two.log_evidence


def test_the_second_half_can_be_learned_later() -> None:
    """A step of EM on the second half, with what is remembered of the first, comes near to all at once."""
    time, there = truth(*PAIRS["lognormal"], 10)
    half = len(time) // 2
    looks = looks_at(time, there)
    early = (looks.stamp_s - 1e6) < time[half]

    def part(rows: BoolArray) -> Looks:
        feature = np.repeat(np.arange(6), len(time))[rows]
        return Looks.from_rows(feature, looks.stamp_s[rows], looks.detected[rows], ERROR, ERROR)

    whole = learn(looks, families=("lognormal",))
    first = learn(part(early), families=("lognormal",))
    both = first.updated(part(~early))
    assert both.last_s == whole.last_s
    for which in (0, 1):
        assert both.expected.counts[which].n_events == pytest.approx(whole.expected.counts[which].n_events, rel=0.05)
    for found, expected in ((both.model.stay, whole.model.stay), (both.model.absence, whole.model.absence)):
        assert isinstance(found, LogNormal)
        assert isinstance(expected, LogNormal)
        assert found.mu == pytest.approx(expected.mu, abs=0.05)
        assert found.sigma == pytest.approx(expected.sigma, rel=0.1)


def test_what_is_long_ago_counts_less() -> None:
    """Stays of 20 s until a change of habits, then of 120 s: with a half life the later ones are learned."""
    early = truth(Exponential(1.0 / 20.0), Exponential(1.0 / 60.0), 11, features=4)
    late = truth(Exponential(1.0 / 120.0), Exponential(1.0 / 60.0), 12, features=4)
    time = np.concatenate([early[0], early[0][-1] + STEP_S + late[0]])
    looks = looks_at(time, np.hstack([early[1], late[1]]))
    ever = learn(looks, families=("exponential",)).model.stay
    lately = learn(looks, families=("exponential",), half_life_s=1000.0).model.stay
    assert isinstance(ever, Exponential)
    assert isinstance(lately, Exponential)
    assert 1.0 / ever.rate < 80.0
    # 4 features x 1000 s / ln 2 of memory, in cycles of 180 s: some 32 stays count
    assert 1.0 / lately.rate == pytest.approx(120.0, rel=3.0 / np.sqrt(32.0))
    assert lately.rate < ever.rate


def test_evidence_of_learning_is_that_of_the_filter() -> None:
    looks = looks_at(*truth(*PAIRS["weibull"], 13, features=3))
    learned = learn(looks, families=("weibull",))
    assert learned.log_evidence == pytest.approx(learned.model.track(looks).log_evidence.sum(), rel=1e-9)


@pytest.mark.slow
def test_a_rhythm_has_steps_within_its_ten_minutes() -> None:
    """Looks every half an hour: learning takes the same steps as the filter."""
    rng = np.random.default_rng(14)
    n = 500
    stamps = 1.8e9 + 1800.0 * np.arange(n)
    there = (np.cumsum(rng.random(n) < 0.1) % 2).astype(bool)
    looks = Looks.from_rows(np.zeros(n, int), stamps, there ^ (rng.random(n) < 0.1), 0.1, 0.1)
    learned = learn(looks, rhythm=True, families=("exponential",))
    # one week and a half: the levels of its weeks may differ, and are those of the last in the filter
    data = Data.of(looks, learned.model.step_s, np.inf, rhythm=True)
    ordinary = replace(learned.model, unusual=None)
    found = data.expect(ordinary).log_evidence
    assert found == pytest.approx(ordinary.track(looks).log_evidence.sum(), rel=1e-9)


def test_progress_is_told_to_the_end() -> None:
    told: list[float] = []
    learn(looks_at(*truth(*PAIRS["exponential"], 15, features=1)), families=("exponential",), progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_what_cannot_be_learned_from_is_refused() -> None:
    one_look_each = Looks.from_rows([0, 1], [1.0, 2.0], [1, 0], 0.1, 0.1)
    with pytest.raises(DataError, match="no feature has looks at two instants"):
        learn(one_look_each)
    at_one_time = Looks.from_rows([0, 0], [1.0, 1.0], [1, 0], 0.1, 0.1)
    with pytest.raises(DataError, match="no feature has looks at two instants"):
        learn(at_one_time)
    looks = Looks.from_rows([0, 0], [1.0, 2.0], [1, 0], 0.1, 0.1)
    with pytest.raises(ConfigError, match=r"families.*unknown family 'cauchy'.*exponential"):
        learn(looks, families=("cauchy",))
    with pytest.raises(ConfigError, match="unknown family 'weibull'"):
        learn(looks, families=("weibull",), rhythm=True)


MINUTE_S, DAY_S = 60.0, 86400.0


def building(weeks: int, seed: int, still: tuple[int, ...] = ()) -> tuple[FloatArray, FloatArray]:
    """A door at every ten minutes: it changes every half an hour from nine to five on weekdays, but on still days."""
    rng = np.random.default_rng(seed)
    time = 4.0 * DAY_S + np.arange(0.0, weeks * 7 * DAY_S, 10.0 * MINUTE_S)
    day, hour = ((time - 4.0 * DAY_S) // DAY_S).astype(int), time % DAY_S / 3600.0
    works = (day % 7 < 5) & (hour >= 9.0) & (hour < 17.0) & ~np.isin(day, still)
    return time, np.cumsum(works & (rng.random(len(time)) < 0.3)) % 2 * works


def looked(time: FloatArray, there: FloatArray) -> Looks:
    return Looks.from_rows(np.zeros(len(time), int), time, there, 1e-3, 1e-3)


def door() -> RunLength:
    """The model of the building's door."""
    busy = np.full((7, 144), -12.0)
    busy[:5, 54:102] = 0.0
    change = Exponential(-np.log(0.7) / (10.0 * MINUTE_S))
    return RunLength(change, change, 10.0 * MINUTE_S, Rhythm(np.zeros(BINS)), Rhythm(busy.ravel()))


def test_days_on_which_nothing_changed_are_told_and_do_not_count_for_the_others() -> None:
    time, there = building(6, 1, still=(9, 10, 24))
    data = Data.of(looked(time, there), 10.0 * MINUTE_S, np.inf, rhythm=True)
    of_kind, moving, shares = data.days(door(), np.zeros(4))
    # weekends look the same, still or not: three of thirty days, with half a day of each kind before any
    assert shares.still == pytest.approx((3.0 + 0.5) / (30.0 + 2.0), rel=0.05)
    assert of_kind[1] == pytest.approx(3.0 + 12.0 * shares.still, rel=0.05)
    # never seen: people on one of twelve weekend days
    assert shares.other == pytest.approx(0.5 / (12.0 + 2.0), rel=0.25)
    weight = moving.importance[0][np.isin(moving.lattices[0].stamp_s[:-1] % DAY_S, 12.0 * 3600.0)]
    still, weekend = np.isin(np.arange(42), (9, 10, 24)), np.arange(42) % 7 >= 5
    assert weight[still].max() < 0.01
    assert weight[~still & ~weekend].min() > 0.99
    np.testing.assert_allclose(weight[weekend], 1.0 - shares.still, atol=0.02)
    _, _, plain = Data.of(looked(*building(6, 1)), 10.0 * MINUTE_S, np.inf, rhythm=True).days(door(), np.zeros(4))
    assert plain.still == pytest.approx(0.5 / (30.0 + 2.0), rel=0.05)


def test_a_weekend_on_which_people_work_is_not_out_of_the_question() -> None:
    """No weekend like it was seen; with looks it is believed like a weekday."""
    data = Data.of(looked(*building(6, 1)), 10.0 * MINUTE_S, np.inf, rhythm=True)
    model = replace(door(), unusual=data.days(door(), np.zeros(4))[2])
    noon = 4.0 * DAY_S + 61 * DAY_S + 13.0 * 3600.0  # of a Saturday
    time = noon - 2 * 3600.0 + 20.0 * MINUTE_S * np.arange(6)
    looks = Looks.from_rows(np.zeros(6, int), time, [0, 1, 1, 0, 1, 1], 0.1, 0.1)
    asked = Instants(np.array([0, 1]), np.array([noon]))
    beliefs = [one.track(looks, asked).p_present[0] for one in (model, replace(model, unusual=None))]
    assert beliefs[0] > 0.3 > 0.1 > beliefs[1]
    unlooked = model.track(looks.taken(np.zeros(0, int), np.array([0, 0])), asked).p_present[0]
    assert 1e-3 < unlooked < 0.04


def test_shares_of_days_are_those_of_a_sample_of_known_kinds() -> None:
    """Days that are certain count one each, with half a day of each kind; days that tell nothing do not count."""
    certain, nothing = np.eye(4)[[0] * 20 + [1] * 3 + [3]], np.ones((50, 4))
    days = np.concatenate([certain, nothing])
    total, kind, shares = day_shares(days, np.ones(len(days)), np.zeros(4))
    np.testing.assert_allclose(shares, (np.array([3.0, 0.0, 1.0]) + 0.5) / (24.0 + 2.0), rtol=1e-3)
    assert total.sum() == pytest.approx(74.0)
    np.testing.assert_allclose(kind[:24], certain)
    _, _, later = day_shares(certain[:4], np.ones(4), np.array([16.0, 3.0, 0.0, 1.0]))
    np.testing.assert_allclose(later, (np.array([3.0, 0.0, 1.0]) + 0.5) / (24.0 + 2.0), rtol=1e-5)


@pytest.mark.slow
def test_shares_of_days_are_learned_and_later_days_are_added() -> None:
    time, there = building(8, 1, still=(9, 10, 24, 51))
    late = time >= time[0] + 42 * DAY_S
    first = learn(looked(time[~late], there[~late]), rhythm=True, families=("exponential",))
    both = first.updated(looked(time[late], there[late]))
    assert first.model.unusual is not None
    assert both.model.unusual is not None
    assert first.model.unusual.still == pytest.approx((3.0 + 0.5) / (30.0 + 2.0), rel=0.15)
    assert both.of_kind.sum() == pytest.approx(56.0)
    assert both.of_kind[1] - first.of_kind[1] == pytest.approx(1.0 + 4 * first.model.unusual.still, abs=0.3)


@pytest.mark.slow
def test_learning_goes_on_from_a_model_of_most_of_the_looks() -> None:
    """As good as anew, with nothing else tried: no family that lost before, no typical duration from the start."""
    time, there = truth(Weibull(2.5, 60.0), LogNormal(3.5, 0.4), 7, features=3)
    looks = looks_at(time, there, seed=7)
    before = learn(looks.taken(looks.stamp_s < 1e6 + 0.8 * SPAN_S))
    on, anew = learn(looks, start=before.model), learn(looks)
    assert len(on.candidates) == 1
    assert on.log_evidence > anew.log_evidence - 1.0


def test_a_trial_ends_that_cannot_catch_up() -> None:
    time, there = truth(Weibull(2.5, 60.0), LogNormal(3.5, 0.4), 7, features=2)
    data = Data.of(looks_at(time, there, seed=7), STEP_S, np.inf, rhythm=False)
    start = RunLength(Exponential(1.0 / 60.0), Exponential(1.0 / 60.0), STEP_S)
    whole = climb(data, start, ("weibull",), 8)
    with_chance = climb(data, start, ("weibull",), 8, whole.score - 1.0)
    assert with_chance.score == whole.score
    hopeless = climb(data, start, ("weibull",), 8, whole.score + 1e4)
    assert hopeless.expected.log_evidence < whole.expected.log_evidence
