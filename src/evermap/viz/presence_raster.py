"""Many features at one glance: a row each, time across, belief as colour, changes as marks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import InputError, printable
from evermap.types import Clock
from evermap.viz.style import ALERT, ESTIMATE, GRID, INK, PAPER, SHADE, house_style, new_figure, settle
from evermap.viz.time_axis import TimeAxis

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
    """Figure of F features over T stretches of time.

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
    with house_style():
        figure = new_figure(7.2, height + 1.05)
        axes = figure.add_subplot()
        axis = TimeAxis.over(float(edge[0]), float(edge[-1]), clock)
        _paint(figure, axes, axis.coordinates(edge), belief)
        _mark(axes, axis, changes, row_in)
        if forecast_from_s is not None and edge[0] < forecast_from_s < edge[-1]:
            axes.axvline(
                axis.coordinates(forecast_from_s), color=INK, lw=0.9, ls=(0, (3, 2)), label="forecast from here"
            )
        _label_rows(axes, names)
        axis.label(axes)
        if title:
            axes.set_title(title)
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(
                handles, labels, loc="outside lower center", ncols=4, markerscale=5.5 / _mark_size(row_in, changes)
            )
        settle(figure)
    return figure


def _paint(figure: Figure, axes: Axes, edges: Any, belief: Any) -> None:
    """Blue is there, orange is not, pale is undecided, hatched is no belief."""
    from matplotlib.colors import LinearSegmentedColormap

    colours = LinearSegmentedColormap.from_list("presence", [ALERT, PAPER, ESTIMATE]).with_extremes(
        bad=(0.0, 0.0, 0.0, 0.0)
    )
    rows = np.arange(len(belief) + 1) - 0.5
    shown = np.ma.masked_invalid(belief)
    mesh = axes.pcolormesh(edges, rows, shown, cmap=colours, vmin=0.0, vmax=1.0, rasterized=True, zorder=1)
    axes.grid(visible=False)
    axes.set_facecolor(SHADE)
    axes.patch.set(hatch="/////", edgecolor=GRID, linewidth=0.0)
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
