"""What a model of comings and goings foretells: after a look, and through the week."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import printable
from evermap.existence.protocol import Instants, Looks, PresenceModel
from evermap.existence.rhythm import MONDAY_S
from evermap.types import FloatArray
from evermap.viz.style import ALERT, ESTIMATE, MUTED, SHADE, house_style, new_figure, settle
from evermap.viz.time_axis import DURATIONS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_ROWS = 8
_NOON_S = 12.0 * 3600.0
_WEEK_STEP_S = 600.0
_DAYS = ("Mon", "Tue", "Wed", "Thu", "Fri", "Sat", "Sun")
_HALF_LIVES = 100.0
"""How far the forecast is drawn, in times after which half of what the look told is lost."""


def plot_presence_models(models: Mapping[str, PresenceModel]) -> Figure:
    """Figure of forecasts, one row a model: presence after it was certainly seen there, or gone, and over the week.

    Looks are taken on a Monday at noon. The first eight models are drawn.

    Args:
        models: by name; '' for a model without one.
    """
    drawn = dict(list(models.items())[:MOST_ROWS])
    rhythm = any(map(has_rhythm, drawn.values()))
    with house_style():
        figure = new_figure(8.0 if rhythm else 5.0, 0.6 + 1.9 * len(drawn))
        grid = figure.subplots(len(drawn), 2 if rhythm else 1, squeeze=False, width_ratios=(1, 1.3) if rhythm else (1,))
        for row, (name, model) in enumerate(drawn.items()):
            last = row == len(drawn) - 1
            _after_a_look(grid[row, 0], model, name, last=last, legend=row == 0)
            if rhythm:
                _week(grid[row, 1], *week_of_presence(model), last=last)
        settle(figure)
    return figure


def week_of_presence(model: PresenceModel) -> tuple[FloatArray, FloatArray]:
    """Presence over a week that nobody looks at, long after the last look.

    Args:
        model: any model of presence.

    Returns:
        Times since Monday 00:00 in seconds, and the probabilities.
    """
    time_s = np.arange(0.0, 7.0 * 86400.0 + 1.0, _WEEK_STEP_S)
    nothing = np.zeros(0)
    unseen = Looks(np.zeros(2, dtype=np.int64), nothing, nothing, nothing, nothing)
    return time_s, model.track(unseen, Instants.same_for_all(1, MONDAY_S + time_s)).p_present


def has_rhythm(model: PresenceModel) -> bool:
    """Whether the model knows the time of the week."""
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
    for k in range(7):
        axes.axvspan(k - 0.25, k + 0.25, color=SHADE, lw=0, zorder=0)
    axes.axvspan(6.75, 7.0, color=SHADE, lw=0, zorder=0)
    axes.fill_between(day, 0.0, presence, color=ESTIMATE, alpha=0.25, lw=0)
    axes.plot(day, presence, color=ESTIMATE, lw=1.0)
    axes.set(xlim=(0.0, 7.0), ylim=(-0.03, 1.03))
    axes.set_xticks(np.arange(7) + 0.5, _DAYS)
    axes.tick_params(axis="x", length=0)
    axes.grid(visible=False, axis="x")
    if last:
        axes.set_xlabel("local time of the week, 18:00 to 6:00 shaded", color=MUTED)
