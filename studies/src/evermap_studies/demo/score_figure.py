"""Every score of every method over the sessions: accuracy, calibration, map size, cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.types import FloatArray
from evermap.viz.style import MUTED, NamedFigure, house_style, new_figure, settle
from evermap_studies.demo.hero import days_of
from evermap_studies.demo.looks import METHOD_LOOKS
from evermap_studies.demo.numbers import EXISTENCE_BOUND, Line, lengths_of, ratios
from evermap_studies.demo.study import Study

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
            (panels[0, 0], "precision_sure", "Precision of claims with p ≥ .9"),
            (panels[0, 1], "recall", "Recall of what was looked at"),
            (panels[1, 0], "existence_brier", "Existence: Brier score"),
            (panels[1, 1], "forecast_brier", "Next session: Brier score"),
        ):
            for name, scores in series.items():
                _line(axes, name, day, np.array([np.nan if s[key] is None else s[key] for s in scores]))
            axes.set_title(title)
        _as_is(panels[1, 1], day, lines)
        panels[0, 0].axhline(EXISTENCE_BOUND, color=MUTED, lw=0.8, ls=(0, (2, 2)), zorder=1)
        for axes in panels[0]:
            axes.set_ylim(top=1.01)
        for name, visits in study.visits.items():
            _line(panels[2, 0], name, day, np.array([float(len(visit.snapshot.place_id)) for visit in visits]))
            _line(panels[2, 1], name, day, np.array([60e3 * visit.cpu_s for visit in visits]) / lengths_of(study))
        panels[2, 0].set_title("Size of the map: places")
        panels[2, 1].set_title("Time for a minute of recording [ms]")
        for axes in panels[1:].ravel():
            axes.set_ylim(bottom=0.0)
        for axes in panels[2]:
            axes.set_xlabel("day")
            axes.set_xlim(day[0], day[-1])
        handles, labels = panels[1, 1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
        settle(figure)
    return NamedFigure("demo_scores", figure, "Accuracy, calibration, map size, cost", _caption())


def _caption() -> str:
    return (
        "A claim is right within 0.25 m; dashed is what was expected of precision. Recall is over the landmarks that"
        " stand where they were really looked at. The Brier score of existence is that of the statements 'it stands"
        " where it was last detected', about all landmarks that were ever detected; the forecast's is that of the same"
        " statements about the next session, lower is better. Dotted: the forecast that all stays as it truly is. Time"
        " is that of one processor; compiling is not in it."
    )


def _line(axes: Axes, name: str, day: FloatArray, values: FloatArray) -> None:
    look = METHOD_LOOKS[name]
    axes.plot(day, values, color=look.colour, ls=look.dash, lw=0.7 * look.width, zorder=look.order, label=look.label)


def _as_is(axes: Axes, day: FloatArray, lines: dict[str, Line]) -> None:
    """The forecast that nothing changes, from the truth."""
    counts = next(iter(lines.values())).counts
    value = [np.nan if one.as_is.brier is None else one.as_is.brier for one in counts]
    axes.plot(day, value, color=MUTED, ls=(0, (1, 1)), lw=0.9, zorder=2, label="all stays as it is")
