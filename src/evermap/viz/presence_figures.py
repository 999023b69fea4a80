"""Figures of features that come and go: beliefs at one glance, of one feature, what a model predicts, and calibration.

That of one feature is as Rosen 2016 Fig. 1: what was seen, what was missed, what is believed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import InputError, printable
from evermap.existence.protocol import Instants, Looks, PresenceModel
from evermap.existence.rhythm import MONDAY_S
from evermap.metrics.belief import BeliefScores, Reliability
from evermap.types import Clock, FloatArray
from evermap.viz.style import ALERT, ESTIMATE, ESTIMATE_BAND, GRID, INK, LANDMARK, MUTED, PAPER, SHADE, drawing
from evermap.viz.time_axis import DURATIONS, TimeAxis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ROW_IN, _LEAST_IN, _MOST_IN = 0.19, 1.1, 8.0
"""Height of a row, and of the lowest and highest raster."""
_MOST_LABELS = 40


def plot_raster(
    names: Sequence[str],
    edge_s: Any,
    p_exists: Any,
    *,
    changes: Sequence[tuple[int, float, bool]] = (),
    forecast_from_s: float | None = None,
    title: str | None = None,
    clock: Clock = Clock.RECORDING,
) -> Figure:
    """Draw a figure of F features over T stretches of time.

    Args:
        names: F labels, from top to bottom.
        edge_s: (T + 1,) borders of the stretches, increasing.
        p_exists: (F, T) belief in each; nan where there is none.
        changes: row, time, and whether the feature returned (else it vanished).
        forecast_from_s: a line where the forecast begins.
        title: above the axes.
        clock: `RECORDING` for an axis of seconds, minutes, hours or days; else dates.

    Raises:
        InputError: shapes that do not fit.
    """
    belief, edge = np.asarray(p_exists, dtype=np.float64), np.asarray(edge_s, dtype=np.float64)
    if belief.shape != (len(names), len(edge) - 1) or len(names) == 0:
        raise InputError(f"shape {belief.shape} instead of ({len(names)}, {len(edge) - 1})", field="p_exists")
    height = float(np.clip(_ROW_IN * len(names), _LEAST_IN, _MOST_IN))
    row_in = height / len(names)
    with drawing(7.2, height + 1.05) as figure:
        axes = figure.add_subplot()
        axis = TimeAxis.over(float(edge[0]), float(edge[-1]), clock)
        _paint(figure, axes, axis.coordinates(edge), belief)
        _mark(axes, axis, changes, row_in)
        if forecast_from_s is not None and edge[0] < forecast_from_s < edge[-1]:
            begin = axis.coordinates(forecast_from_s)
            axes.axvline(begin, color=INK, lw=0.9, ls=(0, (3, 2)), label="forecast from here")
        _label_rows(axes, names)
        axis.label(axes)
        if title:
            axes.set_title(title)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            scale = 5.5 / _mark_size(row_in, changes)
            figure.legend(handles, labels, loc="outside lower center", ncols=4, markerscale=scale)
    return figure


def _paint(figure: Figure, axes: Axes, edges: Any, belief: Any) -> None:
    """Blue is there, orange is not, pale is undecided, hatched is no belief."""
    from matplotlib.colors import LinearSegmentedColormap

    opaque = LinearSegmentedColormap.from_list("presence", [ALERT, PAPER, ESTIMATE])
    colours = opaque.with_extremes(bad=(0.0, 0.0, 0.0, 0.0))
    rows = np.arange(len(belief) + 1) - 0.5
    shown = np.ma.masked_invalid(belief)
    mesh = axes.pcolormesh(edges, rows, shown, cmap=colours, vmin=0.0, vmax=1.0, rasterized=True, zorder=1)
    axes.grid(visible=False)
    axes.set_facecolor(SHADE)
    unknown: Any = {"hatch": "/////", "edgecolor": GRID, "linewidth": 0.0}
    axes.patch.set(**unknown)
    if np.isnan(belief).any():
        axes.fill_between([], [], facecolor=SHADE, label="not yet seen", **unknown)
    bar = figure.colorbar(mesh, ax=axes, pad=0.015, fraction=0.03, aspect=12, ticks=[0.0, 0.5, 1.0])
    bar.set_label("P(exists) [1]")
    bar.outline.set_visible(False)


def _mark(axes: Axes, axis: TimeAxis, changes: Sequence[tuple[int, float, bool]], row_in: float) -> None:
    size = _mark_size(row_in, changes)
    for returned, marker, label in ((False, "v", "vanished"), (True, "^", "returned")):
        mine = [(time_s, row) for row, time_s, back in changes if back == returned]
        if mine:
            at, rows = zip(*mine, strict=True)
            style: Any = {"mfc": INK, "mec": PAPER, "mew": 0.6, "ms": size, "ls": "none", "zorder": 3}
            axes.plot(axis.coordinates(np.array(at)), rows, marker, label=label, **style)


def _mark_size(row_in: float, changes: Sequence[tuple[int, float, bool]]) -> float:
    """Points, for rows of this height; smaller where many changes share a row."""
    crowd = max(Counter(row for row, _, _ in changes).values(), default=1)
    return float(np.clip(min(30.0 * row_in, 150.0 / crowd), 2.0, 5.5))


def _label_rows(axes: Axes, names: Sequence[str]) -> None:
    step = 1 + (len(names) - 1) // _MOST_LABELS
    shown = range(0, len(names), step)
    axes.set_yticks(list(shown), [printable(names[k] if len(names[k]) <= 18 else f"{names[k][:17]}…") for k in shown])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_ylabel("feature")
    axes.tick_params(axis="y", length=0)


MOST_ROWS = 8
_NOON_S = 12.0 * 3600.0
_WEEK_STEP_S = 600.0
_DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_HALF_LIVES = 100.0
"""Length of the forecast, in half-lives of the information of the look."""


def plot_presence_models(models: Mapping[str, PresenceModel]) -> Figure:
    """Draw a figure of forecasts, one row a model: presence after it was certainly seen there, or gone, and over the
    week.

    Looks are taken on a Monday at noon. The first eight models are drawn, by name; '' for one without.
    """
    drawn = dict(list(models.items())[:MOST_ROWS])
    rhythm = any(map(has_rhythm, drawn.values()))
    with drawing(8.0 if rhythm else 5.0, 0.6 + 1.9 * len(drawn)) as figure:
        grid = figure.subplots(len(drawn), 2 if rhythm else 1, squeeze=False, width_ratios=(1, 1.3) if rhythm else (1,))
        for row, (name, model) in enumerate(drawn.items()):
            last = row == len(drawn) - 1
            _after_a_look(grid[row, 0], model, name, last=last, legend=row == 0)
            if rhythm:
                _week(grid[row, 1], *week_of_presence(model), last=last)
    return figure


def week_of_presence(model: PresenceModel) -> tuple[FloatArray, FloatArray]:
    """Return times of a week, since Monday 00:00 [s], and presence then, long after the last look."""
    time_s = np.arange(0.0, 7.0 * 86400.0 + 1.0, _WEEK_STEP_S)
    nothing = np.zeros(0)
    unseen = Looks(np.zeros(2, dtype=np.int64), nothing, nothing, nothing, nothing)
    return time_s, model.track(unseen, Instants.same_for_all(1, MONDAY_S + time_s)).p_present


def has_rhythm(model: PresenceModel) -> bool:
    """Return whether the model knows the time of the week."""
    return any(getattr(model, name, None) for name in ("rhythms", "stay_rhythm", "absence_rhythm"))


def _after_a_look(axes: Axes, model: PresenceModel, name: str, *, last: bool, legend: bool) -> None:
    """Presence ahead of a look that is certain, on a logarithmic axis until it makes no difference."""
    start = MONDAY_S + _NOON_S
    ahead = np.geomspace(1e-2, 60.0 * 86400.0, 240)
    curves = []
    for seen in (1, 0):
        look = Looks.from_rows([0], [start], [seen], 0.0, 0.0)
        curves.append(model.track(look, Instants.same_for_all(1, start + ahead)).p_present)
    told = np.abs(curves[0] - curves[1])
    half = ahead[int(np.argmin(told > 0.5))] if (told <= 0.5).any() else ahead[-1]
    end = min(ahead[min(np.flatnonzero(told > 0.01)[-1] + 8, len(ahead) - 1)], _HALF_LIVES * half)
    moved = np.flatnonzero((1.0 - curves[0] > 0.005) | (curves[1] > 0.005))
    begin = ahead[max(moved[0] - 8, 0)] if moved.size else ahead[0]
    axes.plot(ahead, curves[0], color=ESTIMATE, label="seen there")
    axes.plot(ahead, curves[1], color=ALERT, label="seen to be gone")
    ticks = [(text, value) for text, value in DURATIONS if begin <= value <= end][:: 1 if end < 3e4 * begin else 2]
    axes.set(xscale="log", xlim=(begin, max(end, 2.0 * begin)), ylim=(-0.03, 1.03), ylabel="P(there) [1]")
    axes.set_xticks([value for _, value in ticks], [text for text, _ in ticks])
    axes.minorticks_off()
    if name:
        axes.set_title(printable(name))
    if legend:
        axes.legend(loc="center left")
    if last:
        axes.set_xlabel("time since the look")


def _week(axes: Axes, time_s: Any, presence: Any, *, last: bool) -> None:
    """Presence through the week, nights shaded."""
    day = time_s / 86400.0
    for k in range(8):
        axes.axvspan(k - 0.25, min(k + 0.25, 7.0), color=SHADE, lw=0, zorder=0)
    axes.fill_between(day, 0.0, presence, color=ESTIMATE, alpha=0.25, lw=0)
    axes.plot(day, presence, color=ESTIMATE, lw=1.0)
    axes.set(xlim=(0.0, 7.0), ylim=(-0.03, 1.03))
    axes.set_xticks(np.arange(7) + 0.5, _DAYS)
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    if last:
        axes.set_xlabel("local time of the week, 18:00 to 6:00 shaded", color=MUTED)


def plot_reliability(bins: Reliability, scores: BeliefScores, *, title: str | None = None) -> Figure:
    """Draw a figure of the share of truth in each bin of belief, above the count of each bin on a logarithmic scale.

    Args:
        bins: `reliability(...)`.
        scores: of the same beliefs, written beside it.
        title: above the axes.
    """
    with drawing(4.6, 4.6) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
        filled = bins.count > 0
        above.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=0.9, ls="--", zorder=2, label="calibrated")
        belief, present = bins.belief[filled], bins.present[filled]
        size = 20.0 + 100.0 * np.sqrt(bins.count[filled] / bins.count.max())
        above.plot(belief, present, color=ESTIMATE, lw=1.2, zorder=3)
        above.scatter(belief, present, s=size, color=ESTIMATE, zorder=4, label="bin of beliefs")
        above.set(xlim=(-0.03, 1.03), ylim=(-0.06, 1.06), ylabel="truly there [1]")
        numbers = {"Brier": scores.brier, "log loss": scores.log_loss, "calibration error": scores.calibration_error}
        told = "\n".join(f"{name} {value:.4f}" for name, value in numbers.items())
        above.text(0.97, 0.05, told, transform=above.transAxes, ha="right", va="bottom", size=8)
        above.legend(loc="upper left", markerscale=0.6)
        if title:
            above.set_title(title)
        width = np.diff(bins.edge)
        below.bar(bins.edge[:-1], bins.count, width=width, align="edge", color=ESTIMATE_BAND, ec=ESTIMATE, lw=0.7)
        below.set(xlabel="P(exists) [1]", ylabel="beliefs", yscale="log", ylim=(0.5, 2.5 * bins.count.max()))
    return figure


_HIT_ROW, _MISS_ROW = (1.04, 1.12), (-0.12, -0.04)
"""Heights of the rows of ticks, above and below the probabilities."""
_RASTER_FROM = 3000
"""Number of ticks above which they are embedded as pixels, to keep vector files small."""


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
    time, belief = _columns(("time_s", time_s), ("p_exists", p_exists))
    look_s, hits = _columns(("look_s", looks[0]), ("detected", looks[1]))
    if len(time) == 0 or np.any(np.diff(time) < 0.0):
        raise InputError("a curve needs at least one time, and times that never decrease", field="time_s")
    first, last = float(time[0]), float(time[-1])
    axis = TimeAxis.over(first, last, clock)
    x = axis.coordinates
    with drawing(7.2, 2.7) as figure:
        axes = figure.add_subplot()
        _draw_curve(axes, axis, time, belief, np.inf if forecast_from_s is None else forecast_from_s)
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
        if title:
            axes.set_title(printable(title))
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=6, columnspacing=1.4)
    return figure


def _draw_curve(axes: Axes, axis: TimeAxis, time: FloatArray, belief: FloatArray, forecast_from_s: float) -> None:
    """The belief, dashed where it is a forecast."""
    x, last = axis.coordinates, float(time[-1])
    known = int(np.searchsorted(time, forecast_from_s, side="right"))
    axes.plot(x(time[:known]), belief[:known], color=ESTIMATE, lw=1.4, zorder=4, label="P(exists)")
    if known < len(time):
        rest = slice(max(known - 1, 0), None)
        axes.plot(x(time[rest]), belief[rest], color=ESTIMATE, lw=1.4, ls=(0, (3, 2)), zorder=4)
    if forecast_from_s < last:
        begin = max(forecast_from_s, float(time[0]))
        axes.axvspan(x(begin), x(last), color=SHADE, lw=0, zorder=0, label="forecast")


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
