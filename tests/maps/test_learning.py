"""Lifetimes learned from the history of a map, against the laws that the history was drawn from."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats as law
from simulated_stays import TrueStay, as_seen, histories, two_looks_a_day

from evermap.config import LifetimeConfig
from evermap.existence.sites import CliqueChains
from evermap.maps.learning import ClassEvidence, ClassLives, History, stay_ages, with_priors
from evermap.maps.lives import Lives
from evermap.maps.living import LivingMap, Stays
from evermap.runs.company import Company
from evermap.survival.families import GeneralPurpose
from evermap.types import UNKNOWN
from evermap_studies.sim.config import DAY_S, DEFAULT_CLASSES, Duration, ObjectClass

LOOKS_S = two_looks_a_day(28)
END_S = 28 * DAY_S
SEEDS = range(30)


def seen_in_four_weeks(seed: int, warmup_days: float = 60.0) -> Stays:
    """Of the demo's classes, which lived on for some time before the first look."""
    return as_seen(histories(DEFAULT_CLASSES, END_S, np.random.default_rng(seed), warmup_days * DAY_S), LOOKS_S)


@pytest.mark.slow
@pytest.mark.parametrize("warmup_days", [0.0, 60.0])
def test_bands_cover_the_lifetimes_of_the_simulated_building(warmup_days: float) -> None:
    """Between the ages by which 10 % and 90 % are gone: there is nothing to be seen of rarer things in four weeks."""
    covered = []
    for seed in SEEDS:
        stays = seen_in_four_weeks(seed, warmup_days)
        lives = ClassLives.of(stays, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives
        learned = ClassLives.of(stays, lives)
        for kind, item in enumerate(DEFAULT_CLASSES):
            if item.stay is None:
                continue
            truth = law.gamma(item.stay.shape, scale=item.stay.mean_days / item.stay.shape)
            ages_days = truth.ppf([0.1, 0.3, 0.5, 0.7, 0.9])
            _, lower, upper = learned.band(kind, ages_days * DAY_S)
            survival = truth.sf(ages_days)
            covered.append((lower <= survival) & (survival <= upper))
    assert np.mean(covered) >= 0.9
    assert np.mean(covered, axis=1).reshape(len(SEEDS), -1).mean(axis=0).min() >= 0.75  # every class by itself


def test_a_class_that_never_leaves_is_believed_to_stay() -> None:
    stays = seen_in_four_weeks(0)
    life = ClassLives.of(stays, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives.of(0, np.zeros(2))
    assert life.n_stays == DEFAULT_CLASSES[0].count
    assert life.n_ended == 0
    assert np.exp(life.stay.log_conditional_survival(28 * DAY_S, 29 * DAY_S)) > 0.99


def test_returns_hops_and_known_sites_are_learned() -> None:
    classes = (
        ObjectClass("swing", "hinge", count=5, stay=Duration(1.5)),
        ObjectClass(
            "comes-back", count=8, stay=Duration(2.0), absence=Duration(2.0),
            p_vanish=1.0, p_return=1.0, p_same_place=1.0,
        ),
        ObjectClass("wanders", count=8, stay=Duration(2.0), p_vanish=0.0),
        ObjectClass("is-taken", count=25, stay=Duration(2.0), p_vanish=1.0, p_return=0.0),
    )  # fmt: skip
    stays = as_seen(histories(classes, END_S, np.random.default_rng(1), 0.0), LOOKS_S)
    lives = ClassLives.of(stays, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives
    swing, comes_back, wanders, is_taken = (lives.of(kind, np.zeros(2)) for kind in range(4))
    assert swing.p_hop > 0.9
    assert swing.p_known > 0.9
    assert comes_back.p_hop < 0.1
    assert comes_back.p_known > 0.9
    # of those that were missed at a look, after two weeks
    assert np.exp(comes_back.absence.log_conditional_survival(DAY_S, 14 * DAY_S)) < 0.1
    assert wanders.p_hop > 0.9
    assert wanders.p_known < 0.1
    assert np.exp(is_taken.absence.log_conditional_survival(DAY_S, 14 * DAY_S)) > 0.9


def test_hops_to_known_sites_are_forecast_as_often_as_they_were_seen() -> None:
    """Of 40 things that hopped from a first site to a second one half hop back, half to a third one."""
    count, day_s = 40, DAY_S * (1.0 + np.arange(3.0))
    third = np.where(np.arange(count) % 2, 0, 2)
    site = 3 * np.arange(count)[:, None] + np.stack([0 * third, 0 * third + 1, third], axis=1)
    elsewhere, gone = np.array([-np.inf, *day_s[:2]]), np.array([*day_s[1:], np.inf])
    columns = [np.tile(column, count) for column in (elsewhere, day_s, day_s, gone, np.array([1.0, 1.0, 0.0]))]
    none = np.zeros(3 * count, dtype=np.int64)
    stays = Stays(np.repeat(np.arange(count), 3), site.ravel(), none, np.zeros((3 * count, 2)), *columns)
    life = ClassLives.of(stays, Lives(looks_s=day_s[:2]), day_s[2]).lives.of(0, np.zeros(2))
    chains = CliqueChains.of(np.zeros(2, dtype=np.int64), 1)
    share = np.full(2, 0.5 * life.p_known)  # as `believe.dynamics_of` has it
    route, _ = chains.routes(np.ones(1), share, np.zeros(1, dtype=np.bool_))
    assert route[chains.row_of_site[0], 2] == pytest.approx(0.5, abs=0.02)
    assert route[chains.row_of_site[0], 0] == pytest.approx(0.5, abs=0.02)


def test_what_is_missed_and_not_told_to_be_gone_has_gone_in_part() -> None:
    """Of 36 that stood there, two are missed a day later: without these, nothing would ever seem to leave."""

    looks_s = np.array([60.0, DAY_S + 60.0])

    def there_a_day_later(p_gone: float, told: bool = False) -> float:
        n, missed = 36, np.arange(36) < 2
        last_s = np.where(missed, 30.0, DAY_S + 30.0)
        gone_s = np.where(missed & told, DAY_S + 30.0, np.inf)
        stays = Stays(
            np.arange(n), np.arange(n), np.zeros(n, np.int64), np.zeros((n, 2)), np.full(n, -np.inf), np.zeros(n),
            last_s, gone_s, np.where(missed, p_gone, 0.0),
        )  # fmt: skip
        history = History(stays, looks_s, LifetimeConfig())
        ages = stay_ages(history, history.sightings(np.zeros(n), np.zeros(n)))
        assert ages.weight.sum() == pytest.approx(n)  # each counts for one
        learned = ClassLives.of(stays, Lives(looks_s=looks_s[:1]), looks_s[1])
        return float(np.exp(learned.lives.of(0).stay.log_conditional_survival(30.0, DAY_S)))

    left_out, half, surely = there_a_day_later(0.0), there_a_day_later(0.5), there_a_day_later(1.0)
    assert left_out > half + 0.005 > surely + 0.01
    assert surely == pytest.approx(there_a_day_later(1.0, told=True), abs=1e-3)
    assert surely == pytest.approx(34 / 36, abs=0.04)


def test_without_stays_nothing_is_believed_but_looks_are_counted() -> None:
    lives = ClassLives.of(Stays.empty(), Lives(), 100.0).lives
    assert len(lives.life) == 0
    assert lives.looks_s.tolist() == [100.0]


def test_a_new_class_gets_what_the_others_have_in_common() -> None:
    """Of everything that leaves within days, the next thing does so, too; with less certainty than its fellows."""
    classes = tuple(ObjectClass(f"kind-{n}", count=12, stay=Duration(2.0), p_vanish=0.0) for n in range(6))
    stays = as_seen(histories(classes, END_S, np.random.default_rng(3), 0.0), LOOKS_S)
    lives = ClassLives.of(stays, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives
    unknown = lives.of(17, np.zeros(2)).stay
    assert unknown is lives.of(UNKNOWN, np.zeros(2)).stay
    assert 0.5 * DAY_S < unknown.quantile(0.5) < 4.0 * DAY_S
    _, lower, upper = ClassLives.of(stays, lives).band(17, [2.0 * DAY_S])
    _, lower_known, upper_known = ClassLives.of(stays, lives).band(3, [2.0 * DAY_S])
    assert upper - lower > 2.0 * (upper_known - lower_known)


@pytest.mark.slow
def test_a_site_forecasts_better_with_what_other_sites_have_seen() -> None:
    """Ten sites of three days; what is there now, and its class moves by itself: is it there seven looks later?"""
    names, now_s, then_s = tuple(item.name for item in DEFAULT_CLASSES), LOOKS_S[5], LOOKS_S[12]
    true = [histories(DEFAULT_CLASSES, END_S, np.random.default_rng(seed), 60.0 * DAY_S) for seed in range(10)]
    maps = [
        LivingMap(stays=as_seen(of, LOOKS_S[:6]), lives=Lives(looks_s=LOOKS_S[:6]), class_names=names) for of in true
    ]
    company = Company.of([ClassEvidence.of(living) for living in maps])
    loss: dict[str, list[float]] = {"alone": [], "learned": [], "told": []}
    for site, (living, of) in enumerate(zip(maps, true, strict=True)):
        there = {(stay.thing, stay.site) for stay in of if stay.start_s <= now_s and then_s < stay.end_s}
        learned, stays = company.lifetimes(site), living.stays
        told = with_priors(living, learned, company.class_names, worth=20)
        alone, entered = (ClassLives.of(stays, lives).lives for lives in (living.lives, told.lives))
        for row in np.flatnonzero(np.isinf(stays.gone_s)):
            kind, age_s = int(stays.class_id[row]), now_s - stays.first_s[row]
            if DEFAULT_CLASSES[kind].mount == "hinge":
                continue  # may be back
            was = (int(stays.clique_id[row]), int(stays.site_id[row]) % 1000) in there
            priors = alone.of(kind).stay, learned[names[kind]].stay, entered.of(kind).stay
            for way, prior in zip(loss, priors, strict=True):
                p = float(np.exp(prior.log_conditional_survival(age_s, age_s + then_s - now_s)))
                loss[way].append(-np.log(p if was else 1.0 - p))
    mean = {way: float(np.mean(values)) for way, values in loss.items()}
    assert mean["learned"] < 0.85 * mean["alone"]
    assert mean["told"] < 0.85 * mean["alone"]


def test_order_of_stays_does_not_matter() -> None:
    stays = seen_in_four_weeks(2)
    shuffled = stays[np.random.default_rng(0).permutation(len(stays))]
    one, other = (ClassLives.of(s, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives for s in (stays, shuffled))
    np.testing.assert_allclose([life.p_hop for life in one.life], [life.p_hop for life in other.life], rtol=1e-12)
    for a, b in zip(one.life, other.life, strict=True):
        np.testing.assert_allclose(a.stay.log_survival(DAY_S), b.stay.log_survival(DAY_S), rtol=1e-6)


@pytest.mark.slow
def test_forecasts_of_the_next_session_beat_the_general_purpose_prior_and_are_calibrated() -> None:
    """What is there now: will it be there at the next look? Learned day by day, of what was seen until then."""
    general = GeneralPurpose(1.0 / (3650.0 * DAY_S), 1.0 / 3600.0)
    said, said_in_general, was = [], [], []
    for seed in range(4):
        true = histories(DEFAULT_CLASSES, END_S, np.random.default_rng(seed), 0.0)
        for until in range(20, len(LOOKS_S) - 1, 4):
            stays = as_seen(true, LOOKS_S[:until])
            now_s, next_s = LOOKS_S[until - 1], LOOKS_S[until]
            lives = ClassLives.of(stays, Lives(looks_s=LOOKS_S[: until - 1]), now_s).lives
            there = {(stay.thing, stay.site) for stay in true if stay.start_s <= next_s < stay.end_s}
            for row in np.flatnonzero(np.isinf(stays.gone_s)):
                age_s = now_s - stays.first_s[row]
                stay = lives.of(int(stays.class_id[row]), stays.position_m[row]).stay
                kind = DEFAULT_CLASSES[stays.class_id[row]]
                if kind.mount == "hinge":
                    continue  # may be back: a forecast of returns, which lifetimes alone do not make
                said.append(np.exp(stay.log_conditional_survival(age_s, age_s + next_s - now_s)))
                said_in_general.append(np.exp(general.log_conditional_survival(age_s, age_s + next_s - now_s)))
                site = int(stays.site_id[row]) % 1000
                was.append((int(stays.clique_id[row]), site) in there)
    p, q, y = np.array(said), np.array(said_in_general), np.array(was)
    scores = [-np.mean(np.log(np.where(y, s, 1.0 - s))) for s in (p, q)]
    assert scores[0] < scores[1]
    edges = np.quantile(p, [0.0, 0.25, 0.5, 0.75, 1.0])
    for low, high in itertools.pairwise(edges):
        rows = (p >= low) & (p <= high)
        error = np.sqrt(np.mean(p[rows] * (1.0 - p[rows])) / rows.sum())
        assert abs(np.mean(y[rows]) - np.mean(p[rows])) < 3.0 * error + 0.01


def test_places_differ_only_where_they_do() -> None:
    """Half of the things stand where they are moved six times as often; the class knows only the average."""
    rng = np.random.default_rng(5)
    slow, fast = (ObjectClass("thing", count=15, stay=Duration(days), p_vanish=0.0) for days in (6.0, 1.0))
    true = histories((slow, fast), END_S, rng, 0.0)
    corner = np.array([[5.0, 5.0], [25.0, 5.0]])
    by_place = np.repeat(corner, 15, axis=0)
    stays = as_seen([TrueStay(s.thing, 0, s.site, s.start_s, s.end_s) for s in true], LOOKS_S, by_place)
    lives = ClassLives.of(stays, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives
    here, there, elsewhere = (lives.of(0, np.array(place)).stay for place in (*corner, (95.0, 5.0)))
    next_day = [float(np.exp(life.log_conditional_survival(DAY_S, 2.0 * DAY_S))) for life in (here, elsewhere, there)]
    truth = np.exp([-1.0 / 6.0, -1.0])
    error, error_of_class = np.abs(np.array(next_day)[[0, 2]] - truth), np.abs(next_day[1] - truth)
    assert (error < 0.5 * error_of_class).all()
    assert next_day[2] < next_day[1] < next_day[0]

    # the same things, placed by lot: chunks are what their class is
    by_lot = corner[rng.integers(0, 2, 30)]
    alike = as_seen(histories((slow, slow), END_S, rng, 0.0), LOOKS_S, by_lot)
    lives = ClassLives.of(replace(alike, class_id=0 * alike.class_id), Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives
    medians = [float(lives.of(0, place).stay.quantile(0.5)) for place in (*corner, np.array([95.0, 5.0]))]
    assert max(medians) / min(medians) < 1.25


def test_learning_does_not_depend_on_how_long_ago_a_class_was_first_seen() -> None:
    """A class with more stays than are learned from: the newest count, whatever became of them."""
    classes = (ObjectClass("swing", "hinge", count=8, stay=Duration(2.0)),)
    looks_s = two_looks_a_day(180)
    stays = as_seen(histories(classes, 180 * DAY_S, np.random.default_rng(6), 0.0), looks_s)
    assert len(stays) > 1.5 * LifetimeConfig().newest
    lives = ClassLives.of(stays, Lives(looks_s=looks_s[:-1]), looks_s[-1]).lives
    assert lives.of(0, np.zeros(2)).n_stays == LifetimeConfig().newest
    mean, lower, upper = ClassLives.of(stays, lives).band(0, [2.0 * DAY_S])
    assert lower < np.exp(-1.0) < upper
    assert upper - lower < 0.3  # 0.11 if all 300 stays were known from beginning to end, whatever their law
    assert np.exp(lives.of(0, np.zeros(2)).stay.log_survival(2.0 * DAY_S)) == pytest.approx(mean[0], rel=1e-2)


def with_doubts(stays: Stays, kind: int, n: int, p_gone: float) -> Stays:
    """Some stays of a class that go on are said to have ended a look later, with this probability."""
    rows = np.flatnonzero((stays.class_id == kind) & np.isinf(stays.gone_s))[:n]
    assert len(rows) == n
    gone_s, doubt, last_s = stays.gone_s.copy(), stays.p_gone.copy(), stays.last_s.copy()
    last_s[rows], gone_s[rows], doubt[rows] = LOOKS_S[-2], LOOKS_S[-1], p_gone
    return replace(stays, last_s=last_s, gone_s=gone_s, p_gone=doubt)


def survival(stays: Stays, kind: int) -> np.ndarray:
    """Of a class, after a day, a week and a month."""
    lives = ClassLives.of(stays, Lives(looks_s=LOOKS_S[:-1]), LOOKS_S[-1]).lives
    return np.exp(lives.of(kind, np.array([500.0, 500.0])).stay.log_survival(np.array([1.0, 7.0, 28.0]) * DAY_S))


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_an_end_that_is_not_believed_is_none(kind: int) -> None:
    """The same as a stay that goes on, but was not seen any more."""
    stays = seen_in_four_weeks(1)
    doubted = with_doubts(stays, kind, 3, 0.0)
    going_on = replace(doubted, gone_s=np.where(doubted.p_gone == stays.p_gone, doubted.gone_s, np.inf))
    going_on = replace(going_on, gone_s=np.where(np.isinf(stays.gone_s), np.inf, doubted.gone_s))
    np.testing.assert_allclose(survival(doubted, kind), survival(going_on, kind), rtol=1e-6)


def test_a_handful_of_doubtful_ends_does_not_move_lifetimes() -> None:
    """Of what never leaves: five false alarms that hardly anybody believes in, against five that are certain."""
    stays = seen_in_four_weeks(0)
    before, doubtful, certain = (
        survival(one, 0) for one in (stays, with_doubts(stays, 0, 5, 0.03), with_doubts(stays, 0, 5, 1.0))
    )
    assert (before - doubtful <= 0.02).all()
    assert (before - doubtful < 0.2 * (before - certain)).all()
    assert certain[-1] < before[-1] - 0.05


@pytest.mark.parametrize(("kind", "age"), [pytest.param(0, 2, marks=pytest.mark.slow), (1, 0)])
def test_lifetimes_are_the_shorter_the_more_ends_are_believed(kind: int, age: int) -> None:
    """At ages up to which the ends were, and at which the class has not nearly all left, nor all stayed."""
    stays = seen_in_four_weeks(3)
    found = [survival(with_doubts(stays, kind, 4, p), kind)[age] for p in (0.0, 0.2, 0.5, 0.8, 1.0)]
    assert (np.diff(found) < 0.0).all()
