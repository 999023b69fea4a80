"""Hours of the week in lifetimes: worlds whose factor is known, and the filter against the sum over all arrivals."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from evermap.existence.hours import (
    HOUR_S,
    HOURS,
    DatedStays,
    HourFit,
    HourLikelihood,
    learn_hours,
    learn_hours_and_hazards,
)
from evermap.existence.rhythm import BIN_S, BINS, DAY_S, MONDAY_S, WEEK_S, Rhythm
from evermap.existence.sites import SiteDynamics, SiteLooks, SiteSensor, follow_sites
from evermap.maps.lives import general_purpose
from evermap.sensing.sightlines import Lines
from evermap.survival import Exponential, LifetimePrior, Weibull
from evermap.survival.hazard_posterior import HazardPosterior
from evermap.survival.pooled_hazards import learn_hazards
from evermap.survival.stay_likelihood import StayAges
from evermap.types import FloatArray

START_S = MONDAY_S + 2800 * WEEK_S
WEEKS = 4
HOUR_OF_WEEK = np.arange(HOURS)
HOUR_OF_DAY, DAY_OF_WEEK = HOUR_OF_WEEK % 24, HOUR_OF_WEEK // 24
FACTORS = {
    "night": np.where((HOUR_OF_DAY >= 20) | (HOUR_OF_DAY < 6), 2.4, 0.0),
    "work": np.where((HOUR_OF_DAY >= 8) & (HOUR_OF_DAY < 18) & (DAY_OF_WEEK < 5), 168.0 / 50.0, 0.0),
    "mild": 1.0 + 0.6 * np.sin(2.0 * np.pi * HOUR_OF_DAY / 24.0),
    "none": np.ones(HOURS),
}
MEAN_S = 3.0 * DAY_S


def true_clock(kind: str, stamp_s: FloatArray) -> FloatArray:
    """Integrate a factor from the start of the world on, by numpy alone."""
    passed = np.append(0.0, np.cumsum(np.tile(FACTORS[kind], 8 * WEEKS)) * HOUR_S)
    return np.interp(stamp_s - START_S, HOUR_S * np.arange(len(passed)), passed)


def make_stays(kind: str, seed: int, n: int = 250, looks: str = "any hour") -> DatedStays:
    """Draw stays of an exponential lifetime on the clock of a factor, as looks show them."""
    rng = np.random.default_rng(seed)
    end_s = WEEKS * WEEK_S
    look_s = (
        START_S
        + {
            "any hour": np.sort(rng.uniform(0.0, end_s, 42 * WEEKS)),
            "noon": np.arange(7 * WEEKS) * DAY_S + 12.0 * HOUR_S,
        }[looks]
    )
    began = START_S + rng.uniform(0.0, end_s - 3.0 * DAY_S, n)
    grid = START_S + np.arange(7 * 24 * 60 * WEEKS) * 60.0
    counted = true_clock(kind, grid)
    left = true_clock(kind, began) + rng.exponential(MEAN_S, n)
    end = np.append(grid, np.inf)[np.searchsorted(counted, left)]
    first, after = np.searchsorted(look_s, began), np.searchsorted(look_s, end)
    seen = (first > 0) & (first < after)
    first, after = first[seen], after[seen]
    between = look_s[first - 1, None] + (0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)) * (
        look_s[first] - look_s[first - 1]
    ).reshape(-1, 1)
    ones = np.ones(len(first))
    return DatedStays(
        between, look_s[first], look_s[after - 1], np.append(look_s, np.inf)[after], ones, ones, 0 * first
    )


def join_classes(parts: list[DatedStays]) -> DatedStays:
    """Return the stays of several classes."""
    numbered = [replace(part, group=np.full(len(part.group), k)) for k, part in enumerate(parts)]
    return DatedStays(
        *(np.concatenate([getattr(one, column.name) for one in numbered]) for column in fields(DatedStays))
    )


def count_ages(stays: DatedStays, fit: HourFit | None = None) -> StayAges:
    """Return ages on the clock of a fit."""
    n = len(stays.group)
    begin, first, last, gone = (
        stamp_s if fit is None else fit.count_s(stays.group, stamp_s)
        for stamp_s in (stays.begin_s, stays.first_s, stays.last_s, stays.gone_s)
    )
    ages = (stamp_s[:, None] - begin for stamp_s in (first, last, gone))
    return StayAges(*ages, stays.weight, stays.group, np.ones((n, 2)), np.zeros(n), np.zeros(n))


def learn_lifetimes(stays: DatedStays, fit: HourFit | None = None) -> list[LifetimePrior]:
    """Return the lifetimes of the classes."""
    n = int(stays.group.max()) + 1
    return [one.prior() for one in learn_hazards(count_ages(stays, fit), [None] * n, general_purpose())[:n]]


def by_hour(fit: HourFit) -> FloatArray:
    """Return the (168,) factors that were learned."""
    assert fit.rhythm is not None
    return fit.rhythm.factor.reshape(HOURS, -1).mean(axis=1)


def lost_nats(kind: str, predicted: FloatArray, stamp_s: FloatArray, gap_s: float) -> float:
    """Return the mean loss of forecasts of the next look beyond that of who knows the law."""
    passed = true_clock(kind, stamp_s + gap_s) - true_clock(kind, stamp_s)
    true, told = (np.clip(p, 1e-9, 1.0 - 1e-9) for p in (np.exp(-passed / MEAN_S), predicted))
    return float(np.mean(true * np.log(true / told) + (1.0 - true) * np.log((1.0 - true) / (1.0 - told))))


def forecast_nats(kind: str, stays: DatedStays, fit: HourFit | None, seed: int) -> float:
    """Return the loss of forecasts six hours ahead, of things of any age."""
    rng = np.random.default_rng(seed)
    stamp_s, age_s, gap_s = (
        START_S + WEEK_S + rng.uniform(0.0, WEEK_S, 400),
        rng.uniform(0.2, 5.0, 400) * DAY_S,
        6 * HOUR_S,
    )
    prior, kind_of = learn_lifetimes(stays, fit)[0], np.zeros(400, dtype=np.int64)
    begin, now, then = (
        at if fit is None else fit.count_s(kind_of, at) for at in (stamp_s - age_s, stamp_s, stamp_s + gap_s)
    )
    return lost_nats(kind, np.exp(prior.log_conditional_survival(now - begin, then - begin)), stamp_s, gap_s)


@pytest.mark.parametrize("kind", ["night", "work"])
def test_hours_at_which_things_leave_are_found(kind: str) -> None:
    """From 200 ends, looked at six times a day, to within what so many can tell; and forecasts are nearly the law's."""
    for seed in (0, 1):
        stays = make_stays(kind, seed)
        fit = learn_hours(stays, learn_lifetimes(stays), np.array([False]))
        assert fit.rhythm is not None
        assert fit.log_evidence > 50.0
        assert fit.rhythm.factor.mean() == pytest.approx(1.0)
        found, true = by_hour(fit), FACTORS[kind]
        busy = true > 0.0
        assert found[busy].mean() > 0.8 * true[busy].mean()
        assert np.corrcoef(found, true)[0, 1] > 0.85
        n_days = 7 if kind == "night" else 5
        of_day = found.reshape(7, 24)[:n_days].mean(axis=0)
        hours = true.reshape(7, 24)[0] > 0.0
        inside = hours & np.roll(hours, 2) & np.roll(hours, -2)  # two hours from an edge
        outside = ~(hours | np.roll(hours, 2) | np.roll(hours, -2))
        expected = 200 / hours.sum()  # ends an hour of the day: a standard deviation is 1 / sqrt of it
        assert np.all(np.abs(of_day[inside] / true[busy].mean() - 1.0) < 3.0 / np.sqrt(expected))
        assert np.all(of_day[outside] < 0.15)
        without, with_hours = (forecast_nats(kind, stays, one, 9 + seed) for one in (None, fit))
        assert with_hours < 0.006
        assert without > 0.04


def test_a_weak_rhythm_is_worth_finding() -> None:
    stays = make_stays("mild", 1)
    fit = learn_hours(stays, learn_lifetimes(stays), np.array([False]))
    assert fit.rhythm is not None
    assert 3.0 < fit.log_evidence < 40.0
    assert forecast_nats("mild", stays, fit, 3) < 0.4 * forecast_nats("mild", stays, None, 3)


@pytest.mark.parametrize("looks", ["any hour", "noon"])
def test_no_rhythm_is_found_where_there_is_none(looks: str) -> None:
    for seed in range(4):
        stays = make_stays("none", seed, looks=looks)
        fit = learn_hours(stays, learn_lifetimes(stays), np.array([False]))
        assert fit.rhythm is None
        assert not fit.follows.any()
        assert fit.log_evidence < 2.0
        assert fit.count_s(stays.group, stays.first_s) is stays.first_s


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
@pytest.mark.parametrize(("kind", "is_searched"), [("none", False), ("mild", True), ("night", True)])
def test_a_rhythm_is_searched_for_where_it_may_have_evidence(
    kind: str, seed: int, is_searched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The evidence of a likelihood that is a quadratic, without a search, and that which the search finds."""
    stays = make_stays(kind, seed)
    likelihood = HourLikelihood.of(stays, [Exponential(MEAN_S)], None)
    nearly = likelihood.fit()[1]
    monkeypatch.setattr(HourLikelihood, "_weigh_nearly", lambda *_: np.inf)
    found = likelihood.fit()[1]
    assert (nearly == found) == is_searched
    if not is_searched:
        assert nearly == pytest.approx(found, abs=2.0)
        assert found < 0.5


def test_looks_at_one_hour_show_none() -> None:
    """What leaves at night, looked at at noon: the day of an end is known, its hour is not."""
    for seed in range(3):
        stays = make_stays("night", seed, looks="noon")
        fit = learn_hours(stays, learn_lifetimes(stays), np.array([False]))
        assert fit.rhythm is None
        assert fit.n_dated < 1.0
        assert fit.log_evidence < 0.0
    assert (
        learn_hours(make_stays("night", 0), learn_lifetimes(make_stays("night", 0)), np.array([False])).n_dated > 100.0
    )


def test_looks_at_one_hour_show_weekends() -> None:
    stays = make_stays("work", 0, looks="noon")
    fit = learn_hours(stays, learn_lifetimes(stays), np.array([False]))
    day = by_hour(fit).reshape(7, 24).mean(axis=1)
    assert fit.n_dated < 1.0
    assert np.all(day[:5] > 1.0)  # of a Friday's ends half are seen on Saturday
    assert np.all(day[5:] < 0.2)


def test_classes_that_leave_at_other_hours_do_not_follow() -> None:
    """Of four, two leave at night; one is at work, one leaves at any hour."""
    kinds, counts = ("work", "night", "none", "night"), (60, 150, 100, 40)
    stays = join_classes([make_stays(kind, 5 + k, n) for k, (kind, n) in enumerate(zip(kinds, counts, strict=True))])
    lifetimes = learn_lifetimes(stays)
    fit = learn_hours(stays, lifetimes, np.zeros(4, dtype=np.bool_))
    assert fit.follows.tolist() == [False, True, False, True]
    assert np.corrcoef(by_hour(fit), FACTORS["night"])[0, 1] > 0.85
    opposed = join_classes([make_stays("night", 5, 200), make_stays("work", 6, 120)])
    assert learn_hours(opposed, learn_lifetimes(opposed), np.zeros(2, dtype=np.bool_)).follows.tolist() == [True, False]


def test_a_class_with_a_stated_lifetime_follows_on_its_own_evidence_alone() -> None:
    """Three stays that end now and then say nothing: a stated hazard is one by age on the wall."""
    stays = join_classes([make_stays("night", 5, 200), make_stays("night", 6, 4)])
    lifetimes = learn_lifetimes(stays)
    few = replace(stays, p_gone=np.where(stays.group == 1, 0.0, stays.p_gone))
    assert learn_hours(few, lifetimes, np.array([False, True])).follows.tolist() == [True, False]
    assert learn_hours(few, lifetimes, np.array([False, False])).follows.tolist() == [True, True]
    many = join_classes([make_stays("night", 5, 200), make_stays("night", 6, 80)])
    assert learn_hours(many, learn_lifetimes(many), np.array([False, True])).follows.tolist() == [True, True]


def test_likelihood_is_that_of_stays_on_the_clock() -> None:
    """Of an exponential lifetime, for any factor: `S` at the last sighting less `S` at the look that missed it."""
    stays = make_stays("work", 3, 60)
    likelihood = HourLikelihood.of(stays, [Exponential(1.0 / MEAN_S)], None)
    log_factor = np.random.default_rng(0).normal(0.0, 0.7, HOURS)
    rhythm = Rhythm(np.repeat(log_factor, round(HOUR_S / BIN_S)))
    first, last, gone = (rhythm.count_s(at) for at in (stays.first_s, stays.last_s, stays.gone_s))
    left, right = np.exp(-(last - first) / MEAN_S), np.exp(-(gone - first) / MEAN_S)
    np.testing.assert_allclose(likelihood.values(log_factor), np.log(left - right), rtol=1e-9)


def test_curvature_is_that_of_the_likelihood() -> None:
    """Against differences of the values, and of the gradient."""
    likelihood = HourLikelihood.of(make_stays("work", 3, 60), [Exponential(1.0 / MEAN_S)], None)
    at, rng = np.random.default_rng(0).normal(0.0, 0.7, HOURS), np.random.default_rng(1)
    slope, information = likelihood.curvature(at)
    for _ in range(5):
        to = 1e-4 * rng.normal(size=HOURS)
        above, below = (float(likelihood.values(at + sign * to).sum()) for sign in (1.0, -1.0))
        assert 0.5 * (above - below) == pytest.approx(slope @ to, rel=1e-5)
        change = likelihood.curvature(at + to)[0] - likelihood.curvature(at - to)[0]
        np.testing.assert_allclose(-0.5 * change, information @ to, atol=1e-8)


def test_hours_and_hazards_are_learned_in_turn() -> None:
    """Hazards are those on the clock that is kept, which is the one of most evidence; and by age where none is."""
    asked: list[tuple[HourFit, list[HazardPosterior]]] = []

    def learn_from(stays: DatedStays) -> tuple[HourFit | None, object, object]:
        def learn(fit: HourFit) -> list[HazardPosterior]:
            asked.append((fit, learn_hazards(count_ages(stays, fit), [None], general_purpose())))
            return asked[-1][1]

        asked.clear()
        by_age = learn_hazards(count_ages(stays), [None], general_purpose())
        return *learn_hours_and_hazards(stays, by_age, np.array([False]), learn), by_age

    fit, hazards, _ = learn_from(make_stays("night", 4))
    assert len(asked) == 2
    assert fit is not None
    assert [found is hazards for asked_fit, found in asked if asked_fit.rhythm is fit.rhythm] == [True]
    assert fit.log_evidence == pytest.approx(asked[0][0].log_evidence, rel=0.2)
    fit, hazards, by_age = learn_from(make_stays("none", 4))
    assert not asked
    assert hazards is by_age
    assert fit is not None
    assert fit.rhythm is None


def test_the_round_of_most_evidence_is_kept() -> None:
    """All leave after two days of nights: hours that are learned again from such ages take the place of these."""
    stays = make_stays("night", 4, 300)
    grid = START_S + np.arange(7 * 24 * 60 * WEEKS) * 60.0
    spread = np.random.default_rng(54).normal(2.0 * DAY_S, 0.05 * DAY_S, len(stays.group))
    left = true_clock("night", stays.begin_s.mean(axis=1)) + spread
    end = np.append(grid, np.inf)[np.searchsorted(true_clock("night", grid), left)]
    look_s = np.unique(np.concatenate([stays.first_s, stays.last_s, stays.gone_s[np.isfinite(stays.gone_s)]]))
    after = np.searchsorted(look_s, end)
    stays = replace(stays, last_s=look_s[after - 1], gone_s=np.append(look_s, np.inf)[after])
    stays = DatedStays(*(getattr(stays, one.name)[stays.last_s > stays.first_s] for one in fields(DatedStays)))

    def learn(fit: HourFit | None = None) -> list[HazardPosterior]:
        return learn_hazards(count_ages(stays, fit), [None], general_purpose())

    fit, hazards = learn_hours_and_hazards(stays, learn(), np.array([False]), learn)
    assert fit is not None
    assert fit.rhythm is not None
    early, late = hazards[0].prior().quantile(np.array([0.1, 0.5]))
    assert early > 1.5 * DAY_S
    assert late == pytest.approx(2.0 * DAY_S, rel=0.05)


def test_ages_that_are_known_to_the_hour_on_the_wall_are_kept() -> None:
    """Cars of a shift come at half past eight and leave eight hours later: hours of ends are told by ages."""
    rng, look_s = np.random.default_rng(2), START_S + np.arange(0.25, 24.0 * 7 * WEEKS, 0.5) * HOUR_S
    began = START_S + (rng.choice([d for d in range(7 * WEEKS - 1) if d % 7 < 5], 300) * 24.0 + 8.5) * HOUR_S
    began += 0.3 * HOUR_S * rng.normal(size=300)
    end = began + 8.0 * HOUR_S * np.exp(0.05 * rng.normal(size=300))
    first, after = np.searchsorted(look_s, began), np.searchsorted(look_s, end)
    ones = np.ones(300)
    stays = DatedStays(
        began[:, None], look_s[first], look_s[after - 1], look_s[after], ones, ones, np.zeros(300, dtype=np.int64)
    )

    def learn(fit: HourFit | None = None) -> list[HazardPosterior]:
        return learn_hazards(count_ages(stays, fit), [None], general_purpose())

    by_age = learn()
    fit, hazards = learn_hours_and_hazards(stays, by_age, np.array([False]), learn)
    assert fit is not None
    assert fit.rhythm is None
    assert hazards is by_age


def test_long_stays_are_counted_over_all_hours() -> None:
    """Half a year in view, and an end within two months: exposure is that of all its hours, and no hour is shown."""
    months = np.array([START_S + 26.0 * WEEK_S])
    begin, one = np.full((1, 2), START_S), np.ones(1)
    stays = DatedStays(begin, begin[:, 0], months, months + 9.0 * WEEK_S, one, one, np.zeros(1, dtype=np.int64))
    likelihood = HourLikelihood.of(stays, [Exponential(1.0 / MEAN_S)], None)
    assert likelihood.seen.sum() == pytest.approx(26.0 * WEEK_S / MEAN_S)
    np.testing.assert_allclose(likelihood.seen, 26.0 * WEEK_S / MEAN_S / HOURS, rtol=1e-9)
    assert likelihood.n_dated == 0.0
    assert likelihood.weight[0] == 0.0


def test_clock_of_a_rhythm_is_the_integral_of_its_factor() -> None:
    rhythm = Rhythm(np.random.default_rng(1).normal(size=BINS))
    fine = START_S + np.arange(0.0, 9.0 * DAY_S, 1.0)
    bins = ((fine - MONDAY_S) % WEEK_S // BIN_S).astype(int)
    summed = np.append(0.0, np.cumsum(rhythm.factor[bins]))
    at = np.array([0, 12345, 86400, 700000])
    np.testing.assert_allclose(rhythm.count_s(fine[at]) - rhythm.count_s(START_S), summed[at], rtol=1e-9)
    assert rhythm.count_s(np.array([np.inf, -np.inf])).tolist() == [np.inf, -np.inf]
    flat = Rhythm(np.zeros(BINS))
    assert flat.count_s(START_S + 1e6) - flat.count_s(START_S) == pytest.approx(1e6)


def follow(
    dynamics: SiteDynamics, gap_s: float, looks: SiteLooks | None = None, p_here: float = 1.0
) -> tuple[float, float]:
    """Return the belief after a gap from the start of the world on, and the part that never left."""
    none = np.zeros(0, dtype=np.int64)
    rows = looks or SiteLooks(np.zeros(0), none, none, none, np.zeros(0, dtype=np.bool_))
    lines = Lines(np.ones(1), np.array([9e14]), np.array([1e14]), 0.03)
    after = follow_sites(
        np.array([p_here]), np.zeros(1, dtype=np.int64), dynamics, rows, SiteSensor(lines, 0.01, 0.0),
        start_s=START_S, until_s=START_S + gap_s,
    )  # fmt: skip
    return float(after.p_here[0]), float(after.p_stayed[0])


NIGHT = Rhythm(np.repeat(np.log(np.maximum(FACTORS["night"], 1e-6)), round(HOUR_S / BIN_S)))


def renew_at(stay: LifetimePrior, absence: LifetimePrior, age_s: float, hourly: bool) -> SiteDynamics:
    """Return one clique with one site, to which it always returns."""
    rhythm = NIGHT if hourly else None
    return SiteDynamics(
        (stay,), np.array([START_S - age_s]), (absence,), np.array([START_S - age_s]), np.zeros(1), np.ones(1),
        rhythm, np.array([hourly]),
    )  # fmt: skip


def test_filter_counts_ages_of_stays_on_the_clock() -> None:
    """By day nothing leaves; over a night what the law says; between looks of one session, too."""
    stay, age_s = Weibull(2.0 * DAY_S, 1.7), 30.0 * HOUR_S
    never = Exponential(1e-15)
    begin, start = true_clock_of_night(START_S - age_s), true_clock_of_night(START_S)
    for hours in (5.0, 19.0, 30.0, 200.0):
        now = true_clock_of_night(START_S + hours * HOUR_S)
        expected = np.exp(stay.log_conditional_survival(start - begin, now - begin))
        assert follow(renew_at(stay, never, age_s, True), hours * HOUR_S)[1] == pytest.approx(expected, rel=1e-6)
    one = np.zeros(1, dtype=np.int64)
    age = start - begin
    for hour in (8.0, 26.0):
        seen = SiteLooks(np.array([START_S + hour * HOUR_S]), one, one, one, np.array([False]))
        now = true_clock_of_night(START_S + hour * HOUR_S)
        kept = np.exp(stay.log_conditional_survival(age, now - begin))
        posterior = kept * 0.1 / (kept * 0.1 + (1.0 - kept) * 0.99)
        then = true_clock_of_night(START_S + 44.0 * HOUR_S)
        expected = posterior * np.exp(stay.log_conditional_survival(now - begin, then - begin))
        found = follow(renew_at(stay, never, age_s, True), 44.0 * HOUR_S, seen)[1]
        assert found == pytest.approx(expected, rel=0.02)


def true_clock_of_night(stamp_s: float) -> float:
    """Integrate what `NIGHT` has, by numpy alone."""
    factor = np.maximum(FACTORS["night"], 1e-6)
    weeks, phase = divmod(stamp_s - START_S, WEEK_S)
    passed = np.append(0.0, np.cumsum(factor) * HOUR_S)
    return float(weeks * passed[-1] + np.interp(phase, HOUR_S * np.arange(HOURS + 1), passed))


def test_returns_within_a_gap_leave_by_the_clock() -> None:
    """Against 40,000 drawn histories: stays end at night, absences at any hour."""
    rng = np.random.default_rng(7)
    stay, absence, gap_s = Exponential(1.0 / (0.4 * DAY_S)), Exponential(1.0 / (6.0 * HOUR_S)), 2.6 * DAY_S
    until = START_S + gap_s
    grid = START_S + np.arange(0.0, 20.0 * DAY_S, 30.0)
    counted = np.array([true_clock_of_night(at) for at in grid])
    there = 0
    for _ in range(40_000):
        at, here = START_S, True
        while True:
            if here:
                at = float(grid[np.searchsorted(counted, np.interp(at, grid, counted) + rng.exponential(0.4 * DAY_S))])
            else:
                at += rng.exponential(6.0 * HOUR_S)
            if at >= until:
                break
            here = not here
        there += here
    assert follow(renew_at(stay, absence, 0.0, True), gap_s)[0] == pytest.approx(there / 40_000, abs=0.02)
    assert abs(follow(renew_at(stay, absence, 0.0, False), gap_s)[0] - there / 40_000) > 0.05


def test_a_clock_without_followers_is_that_on_the_wall() -> None:
    plain = renew_at(Weibull(2.0 * DAY_S, 1.7), Exponential(1e-5), 3e4, False)
    for other in (replace(plain, rhythm=NIGHT), replace(plain, rhythm=NIGHT, hourly=None)):
        assert follow(other, 3.0 * DAY_S) == follow(plain, 3.0 * DAY_S)
