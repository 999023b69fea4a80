"""Priors by the words that people use for them."""

from __future__ import annotations

import math

from evermap.errors import ConfigError
from evermap.survival.exponential import Exponential
from evermap.survival.general_purpose import GeneralPurpose
from evermap.survival.periodic import PeriodicHazard
from evermap.survival.step import StepLifetime

_HOUR_S = 3600.0
_DAY_S = 86400.0


def half_life(seconds: float) -> Exponential:
    """Of what is there now, half is gone after `seconds`."""
    return Exponential.from_half_life(seconds)


def mean_stay(seconds: float) -> Exponential:
    """Things stay for `seconds` on average, and nothing else is known."""
    return Exponential.from_mean(seconds)


def somewhere_between(shortest_s: float, longest_s: float) -> GeneralPurpose:
    """The mean stay is unknown, but lies between the two (every order of magnitude equally likely)."""
    return GeneralPurpose.from_mean_stays(shortest_s, longest_s)


def never_leaves() -> StepLifetime:
    """Walls."""
    return StepLifetime.at_points((math.inf,), (1.0,))


def gone_overnight(
    probability: float, *, first_seen_hour: float, night_hours: tuple[float, float] = (20.0, 6.0)
) -> PeriodicHazard:
    """Safe by day, and gone with `probability` after each night: parked cars, bins, a market.

    Args:
        probability: of leaving during one whole night, above 0 and below 1.
        first_seen_hour: local time of day at t = 0, in hours, in [0, 24).
        night_hours: begin and end of the night in hours of local time, in [0, 24); it may pass midnight.
    """
    return _daily(probability, first_seen_hour, night_hours, "night_hours")


def gone_by_day(
    probability: float, *, first_seen_hour: float, day_hours: tuple[float, float] = (8.0, 18.0)
) -> PeriodicHazard:
    """Safe while the place is closed, and gone with `probability` after each day (the office of Rosen 2016)."""
    return _daily(probability, first_seen_hour, day_hours, "day_hours")


def _daily(probability: float, first_seen_hour: float, hours: tuple[float, float], name: str) -> PeriodicHazard:
    """Hazard of a daily stretch of hours, of which a fraction `probability` does not see the end."""
    if not 0.0 < probability < 1.0:
        raise ConfigError(f"must lie above 0 and below 1, not {probability!r}", field="probability")
    begin, end = hours
    for hour, field in ((begin, name), (end, name), (first_seen_hour, "first_seen_hour")):
        if not 0.0 <= hour < 24.0:
            raise ConfigError(f"an hour of the day must lie in [0, 24), not {hour!r}", field=field)
    if begin == end:
        raise ConfigError(f"begin and end must differ, not both {begin!r}", field=name)
    length_s = ((end - begin) % 24.0) * _HOUR_S
    rate = -math.log1p(-probability) / length_s
    # The period starts with the stretch, so that midnight needs no special case.
    start_s = ((first_seen_hour - begin) % 24.0) * _HOUR_S
    return PeriodicHazard(_DAY_S, (0.0, length_s), (rate, 0.0), start_s=start_s)
