"""What stamps count, and stamps as text."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from enum import StrEnum


class Clock(StrEnum):
    """Clock of stamps. Stamps of different clocks are never compared."""

    UNIX = "unix"
    """Seconds since 1970-01-01 UTC."""
    RECORDING = "recording"
    """Seconds since an arbitrary start, monotonic within one recording."""
    LOCAL_WALL = "local_wall"
    """Seconds since 1970-01-01 as the clocks on the wall show them (for daily rhythms)."""


_DAY_S = 86_400


def stamp_text(stamp_s: float, clock: Clock) -> str:
    """Return '2026-11-21 14:20:05', or 'day 3 04:05:06' since the start of a recording's own clock; '-' for no
    stamp.
    """
    if not math.isfinite(stamp_s):
        return "-"
    if clock is not Clock.RECORDING:
        try:
            return datetime.fromtimestamp(round(stamp_s), UTC).strftime("%Y-%m-%d %H:%M:%S")
        except (OverflowError, ValueError, OSError):  # no date of the calendar
            return f"{stamp_s:g} s"
    days, seconds = divmod(round(stamp_s), _DAY_S)
    time = f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    return f"day {days} {time}" if days else time


def between_text(from_s: float, to_s: float, clock: Clock) -> str:
    """Return 'between A and B'; 'before B' without an earlier look."""
    late = stamp_text(to_s, clock)
    early = stamp_text(from_s, clock)
    if early == "-":
        return f"before {late}"
    if early == late:
        return f"at {late}"
    same_day = early.rpartition(" ")[0] == late.rpartition(" ")[0] and " " in late
    return f"between {early} and {late.rpartition(' ')[2] if same_day else late}"
