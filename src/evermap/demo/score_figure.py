"""Every score of every method over the sessions: how right the maps are, how sure, how large, how dear."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.demo.hero import days_of
from evermap.demo.looks import METHOD_LOOKS
from evermap.demo.numbers import EXISTENCE_BOUND, Line, ratios
from evermap.demo.study import Study
from evermap.types import FloatArray
from evermap.viz.style import MUTED, NamedFigure, house_style, new_figure, settle

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_scores(study: Study, lines: dict[str, Line]) -> NamedFigure:
    """Six small panels over the days."""
    with house_style():
        figure = new_figure(7.2, 5.6)
        panels = figure.subplots(3, 2, sharex=True)
        day = days_of(study)
        series = {name: [ratios(counts) for counts in line.counts] for name, line in lines.items()}
        for axes, key, title in (
            (panels[0, 0], "precision", "Precision: what it claims is so"),
            (panels[0, 1], "recall", "Recall: what there is, it claims"),
            (panels[1, 0], "existence_brier", "Existence: Brier score"),
            (panels[1, 1], "forecast_brier", "Next session: Brier score"),
        ):
            for name, scores in series.items():
                _line(axes, name, day, np.array([np.nan if s[key] is None else s[key] for s in scores]))
            axes.set_title(title)
        _as_is(panels[1, 1], day, lines)
        for axes in panels[0]:
            axes.axhline(EXISTENCE_BOUND, color=MUTED, lw=0.8, ls=(0, (2, 2)), zorder=1)
            axes.set_ylim(top=1.01)
        for name, visits in study.visits.items():
            _line(panels[2, 0], name, day, np.array([float(len(visit.snapshot.place_id)) for visit in visits]))
            _line(panels[2, 1], name, day, np.array([1e3 * visit.cpu_s for visit in visits]))
        panels[2, 0].set_title("Size of the map: places")
        panels[2, 1].set_title("Time of a session [ms]")
        for axes in panels[1:].ravel():
            axes.set_ylim(bottom=0.0)
        for axes in panels[2]:
            axes.set_xlabel("day")
            axes.set_xlim(day[0], day[-1])
        handles, labels = panels[1, 1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        settle(figure)
    return NamedFigure("demo_scores", figure, "Right, sure, small and fast", _caption())


def _caption() -> str:
    return (
        "Precision and recall count claims (p_exists of 0.5 or more) within 0.25 m; dashed is what was expected. The"
        " Brier score of existence is that of the statements 'it stands where it stood last', about all landmarks that"
        " were ever detected; the forecast's is that of the same statements about the next session, lower is better."
        " Dotted: the forecast that all stays as it truly is. Time is that of one processor."
    )


def _line(axes: Axes, name: str, day: FloatArray, values: FloatArray) -> None:
    look = METHOD_LOOKS[name]
    axes.plot(day, values, color=look.colour, ls=look.dash, lw=0.7 * look.width, zorder=look.order, label=look.label)


def _as_is(axes: Axes, day: FloatArray, lines: dict[str, Line]) -> None:
    """The forecast that nothing changes, from the truth."""
    counts = next(iter(lines.values())).counts
    value = [np.nan if one.as_is.brier is None else one.as_is.brier for one in counts]
    axes.plot(day, value, color=MUTED, ls=(0, (1, 1)), lw=0.9, zorder=2, label="all stays as it is")
