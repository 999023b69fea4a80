"""Figures of a map that lives on: errors and what it holds over the sessions, and that neither size nor cost grows."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import FloatArray, IntArray
from evermap.viz.style import ALERT, ESTIMATE, GROUP, INK, MUTED, ODOMETRY, ONLINE, house_style, new_figure, settle
from evermap_studies.lifelong.runs import CONTENDERS, WHOLE
from evermap_studies.worlds.scores import Existence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = dict[str, Any]
Series = Callable[[Row], float | None]

ROUND = 5
"""Sessions until a robot's turn comes again."""
COLOURS = dict(zip((c.name for c in CONTENDERS), (ALERT, ODOMETRY, ONLINE, GROUP, ESTIMATE, INK), strict=True))


def draw_errors(rows: list[Row]) -> Figure:
    """Pose and landmark errors, precision and recall over the sessions, of all contenders; means over seeds."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    with house_style():
        figure = new_figure(7.2, 5.2)
        pose, landmark, precision, recall = figure.subplots(2, 2, sharex=True).ravel()
        for name in COLOURS:
            mine = [row for row in rows if row["contender"] == name]
            if mine:
                _line(pose, mine, lambda row: row["pose_rmse_m"], name)
                _line(landmark, mine, lambda row: row["landmark_rmse_m"], name)
                _line(precision, mine, lambda row: _existence(row).precision, name)
                _line(recall, mine, lambda row: _existence(row).recall, name)
        for axes, what in ((pose, "pose"), (landmark, "landmark")):
            axes.set(title=f"{what} RMSE [m]", yscale="log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        precision.set(title="precision of the map", ylim=(-0.03, 1.03), xlabel="session")
        recall.set(title="recall of the map", ylim=(-0.03, 1.03), xlabel="session")
        figure.legend(*pose.get_legend_handles_labels(), loc="outside lower center", ncols=6)
        settle(figure)
    return figure


def draw_flat(rows: list[Row]) -> Figure:
    """Error, size and cost of evermap's map over a long life."""
    mine = [row for row in rows if row["contender"] == WHOLE.name]
    with house_style():
        figure = new_figure(7.2, 5.2)
        error, size, step, time = figure.subplots(2, 2, sharex=True).ravel()
        for key, colour, label in (
            ("pose_rmse_m", ESTIMATE, "poses"),
            ("pose_own_rmse_m", MUTED, "poses, own alignment"),
            ("landmark_rmse_m", GROUP, "landmarks"),
        ):
            _dots(error, mine, key, colour, label)
        for key, colour, label in (("places", ESTIMATE, "places"), ("landmarks", MUTED, "landmarks")):
            _dots(size, mine, key, colour, label)
        for key, colour, label in (("step_p99_ms", ESTIMATE, "99th percentile"), ("step_p50_ms", MUTED, "median")):
            _dots(step, mine, key, colour, label)
        _dots(time, mine, "cpu_s", ESTIMATE, "processor")
        error.set(title="RMSE [m]")
        size.set(title="size of the map")
        step.set(title="step [ms]", xlabel="session")
        time.set(title="time of a session [s]", xlabel="session")
        for axes in (error, size, step, time):
            axes.set_ylim(0.0, 1.4 * axes.get_ylim()[1])  # room for the legend
        for axes in (error, size, step):
            axes.legend(loc="upper left", ncols=2)
        settle(figure)
    return figure


def _line(axes: Axes, rows: list[Row], value: Series, name: str) -> None:
    session, mean = _mean(rows, value)
    thick, above = (2.0, 3) if name == WHOLE.name else (1.0, 2)
    dashed = "--" if name == CONTENDERS[-1].name else "-"
    dot = "o" if len(session) < 10 else ""
    axes.plot(session + 1, mean, color=COLOURS[name], label=name, ls=dashed, marker=dot, ms=3.0, lw=thick, zorder=above)


def _dots(axes: Axes, rows: list[Row], key: str, colour: str, label: str) -> None:
    """A dot a session, and the mean of a round of all robots."""
    session, mean = _mean(rows, lambda row: row[key])
    axes.plot(session + 1, mean, color=colour, ls="", marker="o", ms=2.5, alpha=0.5)
    if len(session) >= ROUND:
        smooth = np.convolve(mean, np.full(ROUND, 1.0 / ROUND), mode="valid")
        axes.plot(session[ROUND - 1 :] + 1 - ROUND // 2, smooth, color=colour, lw=1.5, label=label)


def _mean(rows: list[Row], value: Series) -> tuple[IntArray, FloatArray]:
    """Sessions, and the mean over seeds at each; nan where nothing is known."""
    sessions = np.unique([row["session"] for row in rows])
    means = []
    for session in sessions:
        known = [one for row in rows if row["session"] == session if (one := value(row)) is not None]
        means.append(float(np.mean(known)) if known else np.nan)
    return sessions, np.array(means)


def _existence(row: Row) -> Existence:
    return Existence(**row["existence"]) if row["existence"] is not None else Existence()
