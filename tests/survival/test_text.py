"""Priors written as text: what they stand for, and one line for every mistake."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import ConfigError
from evermap.survival import (
    Exponential,
    Gamma,
    GeneralPurpose,
    LifetimePrior,
    LogNormal,
    Mixture,
    PeriodicHazard,
    PiecewiseConstantHazard,
    ScaledHazard,
    StepLifetime,
    Uniform,
    Weibull,
    gone_daily,
    never_leaves,
    parse_prior,
)
from evermap.survival.durations import UNITS_S, duration_text, parse_duration_s, parse_hour, parse_rate_hz
from evermap.survival.text import FORMS, prior_text

DAY_S = 86400.0


@pytest.mark.parametrize(
    ("text", "prior"),
    [
        ("exponential:half-life=2d", Exponential(math.log(2) / (2 * DAY_S))),
        ("exponential:mean=90s", Exponential(1 / 90)),
        ("exponential:rate=0.5/h", Exponential(0.5 / 3600)),
        ("unknown:1h..30d", GeneralPurpose(1 / (30 * DAY_S), 1 / 3600)),
        ("general-purpose:low=0.001/s,high=1/s", GeneralPurpose(0.001, 1.0)),
        ("uniform:limit=4w", Uniform(28 * DAY_S)),
        ("weibull:scale=10min,shape=0.7", Weibull(600.0, 0.7)),
        ("lognormal:median=2d,spread=1.5", LogNormal(math.log(2 * DAY_S), 1.5)),
        ("gamma:shape=2,scale=1y", Gamma(365.25 * DAY_S, 2.0)),
        ("never-leaves", never_leaves()),
        ("gone-overnight:p=0.3,seen=10:30", gone_daily(0.3, first_seen_hour=10.5, hours=(20, 6))),
        ("gone-overnight:p=0.3,seen=1,night=22..5:15", gone_daily(0.3, first_seen_hour=1, hours=(22, 5.25))),
        ("gone-by-day:p=.2,seen=9,day=7:30..19", gone_daily(0.2, first_seen_hour=9, hours=(7.5, 19))),
        ("hazard:0s=1/d,3d=0.01/d", PiecewiseConstantHazard((0, 3 * DAY_S), (1 / DAY_S, 0.01 / DAY_S))),
        (
            "factors:0s=2,1d=0.5 of 0.25*exponential:mean=1e+2s + 0.75 * never-leaves",
            ScaledHazard(Mixture((Exponential(0.01), never_leaves()), (0.25, 0.75)), (0.0, DAY_S), (2.0, 0.5)),
        ),
        (
            "mass:0s..1h=0.3,2d=0.5,never=0.2",
            StepLifetime((0.0, 2 * DAY_S, math.inf), (3600.0, 2 * DAY_S, math.inf), (0.3, 0.5, 0.2)),
        ),
        ("periodic:period=1s,0s=2/s,0.5s=0/s", PeriodicHazard(1, (0, 0.5), (2, 0))),
        ("periodic:period=1w,start=2d,0s=1/w", PeriodicHazard(7 * DAY_S, (0,), (1 / (7 * DAY_S),), start_s=2 * DAY_S)),
        (
            "0.25*exponential:mean=1e+2s + 0.75 * never-leaves",
            Mixture((Exponential(0.01), never_leaves()), (0.25, 0.75)),
        ),
    ],
)
def test_text_stands_for_its_prior(text: str, prior: LifetimePrior) -> None:
    assert parse_prior(text) == prior


@pytest.mark.parametrize("name", FORMS)
def test_every_form_shows_an_example_of_itself(name: str) -> None:
    assert FORMS[name].example.startswith(name)
    assert isinstance(parse_prior(FORMS[name].example), LifetimePrior)


@pytest.mark.parametrize("name", [name for name in FORMS if name not in {"periodic", "gone-overnight", "gone-by-day"}])
def test_what_is_written_is_read_as_the_same_prior(name: str) -> None:
    prior = parse_prior(FORMS[name].example)
    written = parse_prior(prior_text(Mixture((prior, Exponential(1e-17 / 3)), (0.1, 0.9))))
    assert isinstance(written, Mixture)
    age_s = np.geomspace(1e-3, 1e9, 50)
    np.testing.assert_allclose(written.components[0].log_survival(age_s), prior.log_survival(age_s), rtol=1e-12)
    assert written.components[1] == Exponential(1e-17 / 3)


def test_what_has_no_words_says_so() -> None:
    with pytest.raises(ConfigError, match="PeriodicHazard cannot be written"):
        prior_text(parse_prior(FORMS["periodic"].example))


@given(
    weights=st.lists(st.integers(1, 99), min_size=2, max_size=4),
    means=st.lists(st.integers(1, 10**6), min_size=4, max_size=4),
)
def test_mixtures_mix_what_their_parts_say(weights: list[int], means: list[int]) -> None:
    total = sum(weights)
    text = "+".join(f"{w / total!r}*exponential:mean={m}s" for w, m in zip(weights, means, strict=False))
    expected = sum(w / total * math.exp(-500.0 / m) for w, m in zip(weights, means, strict=False))
    assert math.exp(parse_prior(text).log_survival(500.0)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", ["empty"]),
        ("exponental:half-life=2d", ["unknown lifetime 'exponental'", "try: exponential"]),
        ("foo", ["one of exponential, unknown"]),
        ("exponential:halflife=2d", ["no 'halflife'", "try: half-life"]),
        ("exponential:half-life=2d,mean=3d", ["one of half-life, mean and rate"]),
        ("exponential", ["one of half-life, mean and rate"]),
        ("exponential:half-life=2", ["half-life: '2' has no unit", "2d"]),
        ("exponential:half-life=2 days", ["unknown unit of time 'days'", "try: d"]),
        ("exponential:half-life=2m", ["unknown unit of time 'm'", "try: min"]),
        ("exponential:half-life=-2d", ["positive"]),
        ("exponential:half-life=1e999d", ["finite"]),
        ("exponential:rate=0/d", ["rate: must be finite and positive"]),
        ("exponential:rate=0.5", ["not a rate", "0.5/d"]),
        ("weibull:scale=2d", ["needs shape", "weibull:scale=2d,shape=0.7"]),
        ("weibull:scale=2d,shape=-1", ["shape: must be positive"]),
        ("weibull:scale=2d,shape=two", ["shape: 'two' is not a number"]),
        ("uniform:3d", ["'3d' is not of the form key=value", "uniform:limit=3d"]),
        ("uniform:limit=3d,limit=4d", ["limit: given twice"]),
        ("unknown:1h", ["'1h' is not a range"]),
        ("unknown:1d..1h", ["shorter mean stay comes first"]),
        ("never-leaves:ever=1d", ["never-leaves has no 'ever'"]),
        ("gone-overnight:p=0.3,seen=25:00", ["seen: '25:00' is not a time of day", "18:30"]),
        ("gone-overnight:p=1,seen=9", ["probability: must lie above 0 and below 1"]),
        ("hazard:0s=-1/d", ["0s: a rate must be finite and not negative"]),
        ("lognormal:median=2d,spread=0", ["spread: must be positive"]),
        ("hazard:1d=2/d", ["the first rate must start at 0", "hazard:0s="]),
        ("hazard:0s=2/d,2d=1/d,1d=0/d", ["increase strictly"]),
        ("hazard:", ["needs rates"]),
        ("periodic:0s=1/d", ["needs period"]),
        ("0.3*never-leaves+0.6*uniform:limit=3d", ["weights sum to 0.9"]),
        ("0.3*never-leaves+uniform:limit=3d", ["no weight in 'uniform:limit=3d'", "0.5*uniform:limit=3d"]),
        ("-0.5*never-leaves+1.5*uniform:limit=3d", ["weights must be finite and positive"]),
        ("never-leaves+", ["a part of the sum is empty"]),
    ],
)
def test_mistake_is_one_line_with_what_and_what_to_try(text: str, named: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_prior(text)
    line = caught.value.one_line()
    assert "\n" not in line
    for part in (f"prior '{text}': ", *named):
        assert part in line


@given(
    st.text(max_size=40) | st.sampled_from(list(FORMS)).flatmap(lambda name: st.text(":=,.*+0123dhs").map(name.__add__))
)
def test_any_text_is_a_prior_or_a_plain_mistake(text: str) -> None:
    try:
        prior = parse_prior(text)
    except ConfigError as error:
        line = error.one_line()
    else:
        line = repr(prior)
        assert 0.0 <= np.exp(prior.log_survival(1.0)) <= 1.0
    assert "\n" not in line


@given(number=st.floats(1e-3, 1e6), unit=st.sampled_from(list(UNITS_S)))
def test_durations_and_rates_have_their_unit(number: float, unit: str) -> None:
    assert parse_duration_s(f"{number!r}{unit}") == pytest.approx(number * UNITS_S[unit], rel=1e-15)
    assert parse_rate_hz(f"{number!r}/{unit}") == pytest.approx(number / UNITS_S[unit], rel=1e-15)


@given(st.floats(1e-6, 1e12))
def test_printed_durations_read_back_to_three_digits(seconds: float) -> None:
    assert parse_duration_s(duration_text(seconds)) == pytest.approx(seconds, rel=6e-3)


def test_hours() -> None:
    assert [parse_hour(text) for text in ("0", "7:30", " 23:59 ")] == pytest.approx([0.0, 7.5, 24.0 - 1 / 60])
    for wrong in ("24", "7:60", "-1", "", "7.5"):
        with pytest.raises(ConfigError, match="not a time of day"):
            parse_hour(wrong)
