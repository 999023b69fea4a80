"""What a map learns of the hours of the week, and where it counts: forecasts, explanations, its file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_maps import assert_same

from evermap.config import LivingConfig
from evermap.existence.lifetimes import Lifetimes
from evermap.existence.rhythm import BINS, DAY_S, MONDAY_S, WEEK_S
from evermap.maps.learning import ClassLives, with_priors
from evermap.maps.lives import Lives
from evermap.maps.living import LivingMap, Members, Places, Sites, Stays
from evermap.maps.sessions.believe import aged
from evermap.maps.store.content import flaw, pack, unpack
from evermap.runs.map_dicts import hours_dict
from evermap.survival import Exponential, Weibull, never_leaves
from evermap.types import UNKNOWN, Clock, FloatArray

START_S = MONDAY_S + 2800 * WEEK_S
WEEKS, HOUR_S = 4, 3600.0
MEAN_S = 3.0 * DAY_S


def leave_at_night(stamp_s: FloatArray) -> FloatArray:
    """Integrate a factor of 2.4 from 20 to 6 o'clock, and of 0 else."""
    days, phase = np.divmod(stamp_s - START_S, DAY_S)
    return days * DAY_S + 2.4 * (np.minimum(phase, 6.0 * HOUR_S) + np.maximum(phase - 20.0 * HOUR_S, 0.0))


def make_history(
    counts: dict[int, int], *, at_night: bool = True, noon: bool = False, any_hour: int = 1, mean_s: float = MEAN_S
) -> tuple[Stays, FloatArray]:
    """Draw stays of some classes as looks show them; those of one class end at any hour."""
    rng = np.random.default_rng(3)
    end_s = WEEKS * WEEK_S
    look_s = START_S + (
        np.arange(7 * WEEKS) * DAY_S + 12.0 * HOUR_S if noon else np.sort(rng.uniform(0.0, end_s, 42 * WEEKS))
    )
    grid = START_S + np.arange(0.0, 2.0 * end_s, 60.0)
    rows = []
    for kind, n in counts.items():
        counted = leave_at_night(grid) if at_night and kind != any_hour else grid - START_S
        began = START_S + rng.uniform(0.0, end_s - 3.0 * DAY_S, n)
        end = np.append(grid, np.inf)[
            np.searchsorted(counted, np.interp(began, grid, counted) + rng.exponential(mean_s, n))
        ]
        first, after = np.searchsorted(look_s, began), np.searchsorted(look_s, end)
        seen = (first > 0) & (first < after)
        first, after = first[seen], after[seen]
        gone = np.append(look_s, np.inf)[after]
        rows += [(kind, *row) for row in zip(look_s[first - 1], look_s[first], look_s[after - 1], gone, strict=True)]
    table = np.array(rows)
    names = np.arange(len(table))
    p_gone = np.isfinite(table[:, 4]).astype(np.float64)
    return Stays(names, names, table[:, 0].astype(int), np.zeros((len(table), 2)), *table[:, 1:].T, p_gone), look_s


def learn(stays: Stays, look_s: FloatArray, clock: Clock, before: Lives | None = None) -> Lives:
    before = replace(before or Lives(), looks_s=look_s[:-1])
    return ClassLives.of(stays, before, float(look_s[-1]), clock=clock).lives


def make_map(lives: Lives, stays: Stays, stamp_s: float, clock: Clock = Clock.LOCAL_WALL) -> LivingMap:
    """Return a map with one landmark of class 0 and one of class 1, which came a day before and are there."""
    ids, off = np.arange(2), np.zeros(2, dtype=np.bool_)
    since, none = np.full(2, stamp_s - DAY_S), np.zeros(2, dtype=np.int64)
    return LivingMap(
        members=Members(ids, ids, ids, off, off),
        sites=Sites(ids, ids, np.ones(2), np.ones(2), since, np.full(2, stamp_s)),
        places=Places(ids, ids, np.zeros((2, 2)), none, none),
        stays=stays,
        covariance_m2=0.01 * np.eye(4),
        lives=lives,
        class_names=("cart", "pallet"),
        stamp_s=stamp_s,
        session_start_s=stamp_s,
        clock=clock,
        n_cliques_ever=1000,
        n_sites_ever=1000,
    )


@pytest.mark.parametrize("clock", [Clock.UNIX, Clock.LOCAL_WALL])
def test_a_map_forecasts_by_the_hour(clock: Clock) -> None:
    """Carts leave at night, pallets at any hour: what is there at 8 in the morning, and at 8 the next."""
    stays, look_s = make_history({0: 250, 1: 150})
    lives = learn(stays, look_s, clock)
    assert lives.hourly_class_id.tolist() == [UNKNOWN, 0]
    assert lives.follows(np.array([0, 1, 7])).tolist() == [True, False, True]
    living = make_map(lives, stays, START_S + (4 * 7.0 + 8.0 / 24.0) * DAY_S, clock)
    evening, morning = (aged(living, LivingConfig(), living.stamp_s + hours * HOUR_S).p_here for hours in (10.0, 24.0))
    assert evening[0] > 0.97
    assert morning[0] == pytest.approx(np.exp(-DAY_S / MEAN_S), abs=0.06)
    assert evening[1] == pytest.approx(np.exp(-10.0 * HOUR_S / MEAN_S), abs=0.04)
    plain = aged(living, LivingConfig(learn_lifetimes=False), living.stamp_s + 10.0 * HOUR_S).p_here
    assert plain[0] == plain[1]
    line = lives.describe_hours(clock, 0)[0]
    assert ("UTC" in line) == (clock is Clock.UNIX)
    assert int(line.split(":00")[0][-2:]) in (20, 21, 22, 23, 0, 1, 2, 3, 4, 5)
    assert lives.describe_hours(clock, 1) == [
        "stays of its class do not follow the hours of the week that others follow"
    ]
    found = hours_dict(living)["hours"]
    assert found["classes"] == ["", "cart"]
    assert np.mean(found["factor"]) == pytest.approx(1.0, abs=1e-3)
    name, chunks = pack(living)
    again = unpack(name, lambda names: {one: chunks[one].stored() for one in names})
    assert_same(again, living)
    assert again.lives.log_factor.shape == (BINS,)


def test_without_hours_of_the_week_everything_is_as_before() -> None:
    """A recording's own clock has none; nor have two weeks of few ends; the map's file has no new columns."""
    stays, look_s = make_history({0: 250, 1: 150})
    lives = learn(stays, look_s, Clock.RECORDING)
    assert not len(lives.log_factor)
    assert not len(lives.hours_known)
    assert lives.describe_hours(Clock.RECORDING) == []
    living = make_map(lives, stays, float(look_s[-1]), Clock.RECORDING)
    assert hours_dict(living) == {}
    assert b"log_factor" not in pack(living)[1][pack(living)[0]].raw
    few = np.flatnonzero(np.arange(len(stays)) % 20 == 0)
    assert not len(learn(stays[few], look_s, Clock.UNIX).hours_known)
    week = np.flatnonzero(stays.gone_s < START_S + WEEK_S)
    early = look_s[look_s < START_S + WEEK_S]
    assert len(week) > 30
    assert not len(learn(stays[week], early, Clock.UNIX).hours_known)


def test_no_rhythm_leaves_all_lifetimes_as_they_are() -> None:
    stays, look_s = make_history({0: 250, 1: 150}, at_night=False)
    plain, asked = (learn(stays, look_s, clock) for clock in (Clock.RECORDING, Clock.UNIX))
    assert asked.life == plain.life
    assert not len(asked.log_factor)
    assert asked.hours_known[0] > 100.0
    assert asked.hours_known[1] < 1.0
    assert asked.describe_hours(Clock.UNIX)[0].startswith("stays end at all hours of the week alike")


def test_looks_at_noon_leave_the_hours_open() -> None:
    stays, look_s = make_history({0: 300}, noon=True)
    lives = learn(stays, look_s, Clock.UNIX)
    assert not len(lives.log_factor)
    assert lives.hours_known[0] < 1.0
    assert lives.describe_hours(Clock.UNIX)[0].startswith("at which hour of the day stays end is open")


def test_a_stated_lifetime_is_by_age_on_the_wall_where_none_of_its_class_ended() -> None:
    stays, look_s = make_history({0: 250})
    one = Stays(
        np.array([900]), np.array([900]), np.array([2]), np.zeros((1, 2)), look_s[-2:-1] - 60.0, look_s[-1:],
        look_s[-1:], np.array([np.inf]), np.zeros(1),
    )  # fmt: skip
    both = stays.joined(one)
    said = {
        "fork": Lifetimes(Weibull(DAY_S, 1.5), never_leaves()),
        "pole": Lifetimes(Exponential(1e-5), never_leaves()),
    }
    before = with_priors(LivingMap(class_names=("cart", "pallet", "fork", "pole")), said, [], worth=20).lives
    lives = learn(both, look_s, Clock.UNIX, before)
    assert lives.follows(np.array([0, 2, 3])).tolist() == [True, False, False]
    ages_s = np.array([0.02, 0.3, 1.0, 3.0]) * DAY_S
    for kind, name in ((2, "fork"), (3, "pole")):
        found = lives.of(kind).stay
        np.testing.assert_allclose(
            np.exp(found.log_survival(ages_s)), np.exp(said[name].stay.log_survival(ages_s)), atol=1e-9
        )
    for_all = with_priors(LivingMap(class_names=("cart",)), {"": said["fork"]}, [], worth=20).lives
    assert UNKNOWN not in learn(stays, look_s, Clock.UNIX, for_all).hourly_class_id


def test_ages_of_a_map_are_counted_by_its_clock() -> None:
    stays, look_s = make_history({0: 250, 1: 150})
    lives = learn(stays, look_s, Clock.UNIX)
    noon = np.full(2, START_S + 2.5 * DAY_S)
    kinds = np.array([0, 1])
    assert lives.ages_s(kinds, noon, noon + 4.0 * HOUR_S)[0] < 0.1 * 4.0 * HOUR_S
    assert lives.ages_s(kinds, noon, noon + 4.0 * HOUR_S)[1] == 4.0 * HOUR_S
    np.testing.assert_allclose(lives.ages_s(kinds, noon, noon + 2.0 * WEEK_S), 2.0 * WEEK_S, rtol=1e-9)
    longest = ClassLives.of(stays, replace(lives, looks_s=look_s), clock=Clock.UNIX)
    assert_same_lives(longest.lives, lives)


def assert_same_lives(one: Lives, other: Lives) -> None:
    np.testing.assert_array_equal(one.log_factor, other.log_factor)
    assert one.life == other.life


def test_damaged_hours_are_found() -> None:
    stays, look_s = make_history({0: 20})
    living = make_map(Lives(), stays, float(look_s[-1]))
    assert not flaw(living)
    for damaged in ({"log_factor": np.zeros(7)}, {"hours_known": np.zeros(3)}, {"log_factor": np.full(BINS, np.nan)}):
        assert "hours" in flaw(replace(living, lives=Lives(**damaged))) or "log_factor" in flaw(
            replace(living, lives=Lives(**damaged))
        )


def test_ends_of_a_chunk_are_expected_by_the_clock_of_its_class() -> None:
    """Carts that come by day are in one place, others in another: by day none leaves, which is no matter of places."""
    stays, look_s = make_history({0: 600, 1: 150}, mean_s=0.2 * DAY_S)
    hour = (0.5 * (stays.elsewhere_s + stays.first_s) - START_S) % DAY_S / HOUR_S
    by_day = (hour > 7.0) & (hour < 16.0)
    stays = replace(stays, position_m=np.where(by_day[:, None], [[50.0, 0.0]], [[0.0, 0.0]]))
    ratios = []
    for clock in (Clock.RECORDING, Clock.UNIX):
        lives = learn(stays, look_s, clock)
        here, whole = (lives.of(0, at).stay for at in (np.array([50.0, 0.0]), None))
        ratios.append(here.log_survival(DAY_S) / whole.log_survival(DAY_S))
    assert abs(ratios[0] - 1.0) > 0.08
    assert ratios[1] == pytest.approx(1.0, abs=0.015)


def test_landmarks_without_a_class_follow_by_their_own_stays() -> None:
    stays, look_s = make_history({0: 250, UNKNOWN: 150}, any_hour=UNKNOWN)
    lives = learn(stays, look_s, Clock.UNIX)
    assert lives.hourly_class_id.tolist() == [0]
    assert lives.follows(np.array([0, UNKNOWN, 7])).tolist() == [True, False, False]
