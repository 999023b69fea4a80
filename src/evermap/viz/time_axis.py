"""Axes of time in the units that people use: seconds to days since a start, or the date and hour of a clock."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import Clock, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_UNITS = ((300.0, "s", 1.0), (3 * 3600.0, "min", 60.0), (3 * 86400.0, "h", 3600.0), (float("inf"), "days", 86400.0))
"""Maximum span, name and seconds of a unit."""

DURATIONS = (
    ("1 µs", 1e-6),
    ("1 ms", 1e-3),
    ("1 s", 1.0),
    ("10 s", 10.0),
    ("1 min", 60.0),
    ("10 min", 600.0),
    ("1 h", 3600.0),
    ("6 h", 6 * 3600.0),
    ("1 day", 86400.0),
    ("1 week", 7 * 86400.0),
    ("1 month", 30 * 86400.0),
    ("1 year", 365.25 * 86400.0),
    ("10 years", 3652.5 * 86400.0),
    ("100 years", 36525.0 * 86400.0),
)
"""Candidate ticks of a logarithmic axis of durations."""


_FIRST_UNIX_S = 6e8
"""Stamps beyond this (1989) are dates."""


def guess_clock(stamp_s: FloatArray) -> Clock:
    """Return whether stamps count since 1970, or since some start."""
    return Clock.UNIX if float(stamp_s.min()) > _FIRST_UNIX_S else Clock.RECORDING


@dataclass(frozen=True, slots=True)
class TimeUnit:
    """A unit to draw times in."""

    name: str
    seconds: float


def unit_for(span_s: float) -> TimeUnit:
    """Return seconds up to 5 minutes, then minutes up to 3 hours, hours up to 3 days, days."""
    return next(TimeUnit(name, seconds) for limit, name, seconds in _UNITS if span_s <= limit)


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """How stamps become coordinates of a horizontal axis: since a start, or as dates of a clock.

    Attributes:
        start_s: stamp that is 0; unused with a clock of dates.
        unit: of the axis; None where it shows dates.
        zone: what the dates are, for the label.
    """

    start_s: float
    unit: TimeUnit | None
    zone: str = ""

    @classmethod
    def over(cls, first_s: float, last_s: float, clock: Clock) -> TimeAxis:
        """Return the axis for stamps from `first_s` to `last_s`; `Clock.RECORDING` counts from 0 or a far-off start."""
        if clock is Clock.RECORDING:
            start_s = 0.0 if 0.0 <= first_s <= last_s - first_s else first_s
            return cls(start_s, unit_for(last_s - start_s))
        return cls(first_s, None, "UTC" if clock is Clock.UNIX else "local clock")

    def coordinates(self, stamp_s: Any) -> Any:
        """Return stamps as matplotlib wants them: floats in the axis' unit, or datetime64."""
        stamps: FloatArray = np.asarray(stamp_s, dtype=np.float64)
        if self.unit is not None:
            return (stamps - self.start_s) / self.unit.seconds
        return np.round(stamps * 1e6).astype(np.int64).astype("datetime64[us]")

    def label(self, axes: Axes) -> None:
        """Set ticks and the axis label with its unit."""
        if self.unit is not None:
            axes.set_xlabel(f"time{' since the start' if self.start_s else ''} [{self.unit.name}]")
            return
        from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

        locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
        axes.set_xlabel(f"time [{self.zone}]")


def label_ages(axes: Axes, age_s: FloatArray, unit: TimeUnit, *, logarithmic: bool) -> None:
    """Make an axis over ages (N,), increasing, in `unit`; a logarithmic one has ticks such as `1 min`."""
    from matplotlib.ticker import NullFormatter, NullLocator

    low_s, high_s = float(age_s[0]), float(age_s[-1])
    if not logarithmic:
        axes.set(xlim=(0.0, high_s / unit.seconds), xlabel=f"time since first seen [{unit.name}]")
        return
    axes.set_xscale("log")
    axes.set_xlim(low_s / unit.seconds, high_s / unit.seconds)
    ticks = [(name, value / unit.seconds) for name, value in DURATIONS if low_s <= value <= high_s]
    if len(ticks) < 2:  # no two of them in sight: plain numbers
        axes.set_xlabel(f"time since first seen [{unit.name}]")
        return
    chosen = ticks[:: 1 + (len(ticks) - 1) // 6]
    axes.set_xticks([value for _, value in chosen], [name for name, _ in chosen])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("time since first seen")
