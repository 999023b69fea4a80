"""Durations, rates and times of day as people type them: `30min`, `2/d`, `18:30`."""

from __future__ import annotations

import math
import re

from evermap.errors import ConfigError

UNITS_S = {
    "us": 1e-6,
    "ms": 1e-3,
    "s": 1.0,
    "min": 60.0,
    "h": 3600.0,
    "d": 86400.0,
    "w": 7 * 86400.0,
    "y": 365.25 * 86400.0,
}
"""Units of durations, in seconds."""

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_DURATION = re.compile(rf"({_NUMBER})\s*([a-zA-Zµ]*)")
_RATE = re.compile(rf"({_NUMBER})\s*/\s*([a-zA-Zµ]+)")
_HOUR = re.compile(r"(\d{1,2})(?::([0-5]\d))?")
_SOME_UNITS = ", ".join(UNITS_S)


def parse_number(text: str) -> float:
    """Read a plain finite number, or raise a ConfigError."""
    if not re.fullmatch(_NUMBER, text.strip()) or not math.isfinite(float(text)):
        raise ConfigError(f"'{text}' is not a number")
    return float(text)


def parse_positive(text: str) -> float:
    """Read a plain positive number, or raise a ConfigError."""
    number = parse_number(text)
    if not number > 0.0:
        raise ConfigError(f"must be positive, not '{text}'")
    return number


def parse_duration_s(text: str) -> float:
    """Read `90s`, `10min`, `2h`, `3d`, `4w`, `1y` (of 365.25 days) or `20ms` in seconds, or raise a ConfigError."""
    found = _DURATION.fullmatch(text.strip())
    if found is None:
        raise ConfigError(f"'{text}' is not a duration", hint="a number and a unit, as 90s, 10min, 2h, 3d, 4w or 1y")
    number, unit = found.groups()
    if not unit:
        raise ConfigError(f"'{text}' has no unit", hint=f"{number}s, {number}min, {number}h or {number}d")
    seconds = float(number) * _unit_s(unit)
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise ConfigError(f"a duration must be positive and finite, not '{text}'")
    return seconds


def parse_rate_hz(text: str) -> float:
    """Read a hazard, `0.5/d`, `2/h`, `1e-3/s`, in 1/s, which may be 0, or raise a ConfigError."""
    found = _RATE.fullmatch(text.strip())
    if found is None:
        raise ConfigError(f"'{text}' is not a rate", hint="a number per unit of time, as 0.5/d, 2/h or 1e-3/s")
    rate = float(found[1]) / _unit_s(found[2])
    if not (math.isfinite(rate) and rate >= 0.0):
        raise ConfigError(f"a rate must be finite and not negative, not '{text}'")
    return rate


def parse_hour(text: str) -> float:
    """Read a time of day, `18` or `18:30`, in hours, or raise a ConfigError."""
    found = _HOUR.fullmatch(text.strip())
    hour = -1.0 if found is None else int(found[1]) + int(found[2] or 0) / 60.0
    if not 0.0 <= hour < 24.0:
        raise ConfigError(f"'{text}' is not a time of day", hint="hours and minutes from 0:00 to 23:59, as 18:30")
    return hour


def duration_text(seconds: float) -> str:
    """Write a duration with three digits in a suitable unit: `2 d`, `90 s`, `1.5 h`; `never` for infinity."""
    if math.isinf(seconds):
        return "never"
    fitting = [(name, size) for name, size in UNITS_S.items() if name != "w" and abs(seconds) >= size]
    name, size = fitting[-1] if fitting else next(iter(UNITS_S.items()))
    return f"{seconds / size:.3g} {name}"


def _unit_s(unit: str) -> float:
    if unit not in UNITS_S:
        word = unit.lower()
        guess = next((name for name in ("min", *UNITS_S) if word.startswith(name) or name.startswith(word)), None)
        problem = f"unknown unit of time '{unit}'"
        raise ConfigError(problem, hint=f"{guess}, of {_SOME_UNITS}" if guess else f"one of {_SOME_UNITS}")
    return UNITS_S[unit]
