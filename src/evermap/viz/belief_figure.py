"""One feature's belief over time, as in Rosen 2016 Fig. 1: what was seen, what was missed, what is believed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import InputError, printable
from evermap.types import Clock, FloatArray
from evermap.viz.style import ALERT, ESTIMATE, LANDMARK, MUTED, SHADE, house_style, new_figure, settle
from evermap.viz.time_axis import TimeAxis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_HIT_ROW, _MISS_ROW = (1.04, 1.12), (-0.12, -0.04)
"""Heights of the rows of ticks, above and below the probabilities."""
_RASTER_FROM = 3000
"""More ticks than this are embedded as pixels, to keep vector files small."""


def plot_belief(
    time_s: Any,
    p_exists: Any,
    *,
    looks: tuple[Any, Any] = ((), ()),
    truth_s: Any = None,
    forecast_from_s: float | None = None,
    threshold: float | None = None,
    title: str | None = None,
    clock: Clock = Clock.RECORDING,
) -> Figure:
    """Draw one feature: belief curve, detections above, misses below, truth shaded, forecast dashed.

    Args:
        time_s: (N,) times of the curve, never decreasing; a time twice draws the jump of an observation.
        p_exists: (N,) probability that the feature exists then.
        looks: (M,) times of the looks at it, and (M,) 1 for a detection, 0 for a miss.
        truth_s: (K, 2) begin and end of the stretches in which it truly was there (`stretches` makes them from
            samples); None where the truth is not known.
        forecast_from_s: from here on the curve is a forecast.
        threshold: a line at the probability of a decision, for example of removal.
        title: above the axes.
        clock: `RECORDING` for an axis of seconds, minutes, hours or days; else dates.

    Raises:
        InputError: columns of different lengths, no times, or times that decrease.
    """
    with house_style():
        figure = new_figure(7.2, 2.7)
        axes = figure.add_subplot()
        draw_belief(
            axes,
            time_s,
            p_exists,
            looks=looks,
            truth_s=truth_s,
            forecast_from_s=forecast_from_s,
            threshold=threshold,
            clock=clock,
        )
        if title:
            axes.set_title(printable(title))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=6, columnspacing=1.4)
        settle(figure)
    return figure


def draw_belief(
    axes: Axes,
    time_s: Any,
    p_exists: Any,
    *,
    looks: tuple[Any, Any] = ((), ()),
    truth_s: Any = None,
    forecast_from_s: float | None = None,
    threshold: float | None = None,
    clock: Clock = Clock.RECORDING,
) -> None:
    """Draw as `plot_belief` into given axes and without legend. Call within `house_style`."""
    time, belief = _columns(("time_s", time_s), ("p_exists", p_exists))
    look_s, hits = _columns(("look_s", looks[0]), ("detected", looks[1]))
    if len(time) == 0 or np.any(np.diff(time) < 0.0):
        raise InputError("a curve needs at least one time, and times that never decrease", field="time_s")
    first, last = float(time[0]), float(time[-1])
    axis = TimeAxis.over(first, last, clock)
    x = axis.coordinates

    known = len(time) if forecast_from_s is None else int(np.searchsorted(time, forecast_from_s, side="right"))
    axes.plot(x(time[:known]), belief[:known], color=ESTIMATE, lw=1.4, zorder=4, label="P(exists)")
    if known < len(time):
        rest = slice(max(known - 1, 0), None)
        axes.plot(x(time[rest]), belief[rest], color=ESTIMATE, lw=1.4, ls=(0, (3, 2)), zorder=4)
    if forecast_from_s is not None and forecast_from_s < last:
        axes.axvspan(x(max(forecast_from_s, first)), x(last), color=SHADE, lw=0, zorder=0, label="forecast")
    if truth_s is not None:
        shown = np.clip(np.asarray(truth_s, dtype=np.float64).reshape(-1, 2), first, last)
        for k, (begin, end) in enumerate(shown[shown[:, 0] < shown[:, 1]]):
            label = "truly there" if k == 0 else None
            axes.fill_between(x([begin, end]), 0.0, 1.0, color=LANDMARK, alpha=0.16, lw=0, zorder=1, label=label)
    if threshold is not None:
        axes.axhline(threshold, color=MUTED, lw=0.9, ls=":", zorder=2, label=f"threshold {threshold:g}")
    _ticks(axes, x(look_s[hits > 0.5]), _HIT_ROW, LANDMARK, "detection")
    _ticks(axes, x(look_s[hits <= 0.5]), _MISS_ROW, ALERT, "miss")

    axes.set(ylim=(-0.16, 1.16), ylabel="P(exists) [1]", yticks=np.linspace(0.0, 1.0, 5))
    if last > first:
        axes.set_xlim(x(first), x(last))
    axis.label(axes)


def stretches(stamp_s: Any, present: Any) -> FloatArray:
    """Return (K, 2) begin and end of the runs of samples with something there; each holds until the next.

    Args:
        stamp_s: (N,) strictly increasing.
        present: (N,) 1 or 0.
    """
    stamps, there = _columns(("stamp_s", stamp_s), ("present", present))
    if len(stamps) == 0:
        return np.zeros((0, 2))
    edges = np.diff((there > 0.5).astype(np.int8), prepend=0)
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return np.column_stack([stamps[begins], np.append(stamps[ends], stamps[-1])[: len(begins)]])


def _ticks(axes: Axes, at: Any, row: tuple[float, float], colour: str, label: str) -> None:
    """A row of short upright lines, thinner the more there are; a legend entry that stays visible."""
    if len(at) == 0:
        return
    crowd = float(np.clip(300.0 / len(at), 0.25, 1.0))
    axes.vlines(at, *row, color=colour, lw=0.5 + 0.7 * crowd, zorder=3, rasterized=len(at) > _RASTER_FROM)
    axes.plot([], [], "|", color=colour, ms=7, mew=1.4, label=label)


def _columns(first: tuple[str, Any], second: tuple[str, Any]) -> tuple[FloatArray, FloatArray]:
    (name, left), (other, right) = first, second
    a, b = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise InputError(f"shape {b.shape} where {name} has {a.shape}", field=other, hint="one row a time")
    return a, b
