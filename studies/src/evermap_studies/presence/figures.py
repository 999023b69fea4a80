"""Pictures of the comparison: do the probabilities mean what they say, a week foretold, and a return noticed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.metrics.belief import reliability
from evermap.types import Clock
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GRID,
    INK,
    MUTED,
    ODOMETRY,
    house_style,
    new_figure,
    settle,
)
from evermap.viz.time_axis import TimeAxis
from evermap_studies.frame import save_all
from evermap_studies.presence.models import DOOR_DEFAULT, PERIODIC, ROOM_DEFAULT, RUN_LENGTH_RHYTHM, TWO_STATE
from evermap_studies.presence.tasks import TASKS, RoomFeature

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from evermap_studies.presence.study import Found

_COLOURS = {DOOR_DEFAULT.name: ESTIMATE, PERIODIC.name: ODOMETRY, TWO_STATE.name: ALERT}
_LABELS = {
    RUN_LENGTH_RHYTHM.name: "run-length with rhythm",
    PERIODIC.name: "periodic mean",
    TWO_STATE.name: "two states",
}
_FEWEST = 200
"""Beliefs that a bin must hold for its share to be drawn."""
_BEFORE_S, _AFTER_S = 20.0, 60.0
"""What is shown around a return."""


def draw_all(room: Sequence[RoomFeature], found: Found, path: Callable[[str], Path]) -> None:
    """Write all figures as PNG and SVG.

    Args:
        room: the landmarks.
        found: beliefs of the contenders.
        path: where to write the file of a name.
    """
    figures = {"reliability": _draw_reliability(found), "week": _draw_week(found)}
    returned = _a_return(room)
    if returned is not None:
        figures["return"] = _draw_return(room, found, *returned)
    save_all(figures, path)


def _draw_reliability(found: Found) -> Figure:
    """Belief against how often it was true, a panel a task."""
    with house_style():
        figure = new_figure(7.2, 3.1)
        panels = figure.subplots(1, len(TASKS), sharex=True, sharey=True)
        for axes, task in zip(panels, TASKS, strict=True):
            axes.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=0.9, ls="--")
            for name, colour in _COLOURS.items():
                weeks = found.door[task.name, name]
                truth = [np.tile(t.present, t.drawings) for t in found.trials[task.name]]
                bins = reliability(np.concatenate([p.ravel() for p in weeks]), np.concatenate(truth))
                shown = bins.count >= _FEWEST * len(weeks[0])
                axes.plot(
                    bins.belief[shown], bins.present[shown], color=colour, marker="o", ms=3.5, label=_LABELS[name]
                )
            axes.set_title(f"({task.name}) {task.title}")
            axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), xlabel="P(open) [1]", aspect="equal")
        panels[0].set_ylabel("truly open [1]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        settle(figure)
    return figure


def _draw_week(found: Found) -> Figure:
    """The default model in the first test week: without a look, and with one every half an hour."""
    with house_style():
        figure = new_figure(7.2, 3.6)
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, task in zip(panels, TASKS[:2], strict=True):
            week = found.trials[task.name][0]
            stamp_s = week.instants.stamp_s[: len(week.present)]
            axis = TimeAxis.over(float(stamp_s[0]), float(stamp_s[-1]), Clock.LOCAL_WALL)
            time = axis.coordinates(stamp_s)
            axes.fill_between(time, week.present, step="post", color=GRID, lw=0, label="truly open")
            axes.plot(time, found.door[task.name, DOOR_DEFAULT.name][0][0], color=ESTIMATE, lw=0.9, label="P(open)")
            one = week.looks.of(0)
            for kind, at, colour, label in ((1.0, 1.07, INK, "detected"), (0.0, -0.07, MUTED, "missed")):
                rows = one.detected == kind
                if rows.any():
                    axes.plot(
                        axis.coordinates(one.stamp_s[rows]),
                        np.full(rows.sum(), at),
                        "|",
                        ms=4,
                        color=colour,
                        label=label,
                    )
            axes.set_title(f"({task.name}) {task.title}")
            axes.set(ylim=(-0.13, 1.13), ylabel="P(open) [1]", xlim=(time[0], time[-1]))
        axis.label(panels[-1])
        figure.legend(*panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=4)
        settle(figure)
    return figure


def _a_return(room: Sequence[RoomFeature]) -> tuple[int, float] | None:
    """The first landmark that comes back in the test recording, and when; None if none does."""
    for index, landmark in enumerate(room):
        back = np.flatnonzero(np.diff(landmark.present) > 0.0)
        if back.size:
            return index, float(landmark.stamp_s[back[0] + 1])
    return None


def _draw_return(room: Sequence[RoomFeature], found: Found, index: int, return_s: float) -> Figure:
    """Beliefs in a landmark around its return."""
    landmark = room[index]
    shown = (landmark.stamp_s >= return_s - _BEFORE_S) & (landmark.stamp_s <= return_s + _AFTER_S)
    time_s = landmark.stamp_s[shown] - return_s
    with house_style():
        figure = new_figure(7.2, 2.9)
        axes = figure.subplots()
        axes.fill_between(time_s, landmark.present[shown], step="post", color=GRID, lw=0, label="truly there")
        for name, colour, label in ((ROOM_DEFAULT.name, ESTIMATE, "run-length"), (TWO_STATE.name, ALERT, "two states")):
            axes.step(time_s, found.room[name][index][shown], where="post", color=colour, label=label)
        _draw_looks(axes, landmark, return_s)
        axes.set(
            xlabel="time since the return [s]",
            ylabel="P(exists) [1]",
            ylim=(-0.13, 1.13),
            xlim=(-_BEFORE_S, _AFTER_S),
            title=f"landmark {landmark.name} comes back",
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        settle(figure)
    return figure


def _draw_looks(axes: Axes, landmark: RoomFeature, return_s: float) -> None:
    time_s: Any = landmark.test.stamp_s - return_s
    for kind, at, colour, label in ((1.0, 1.07, INK, "detected"), (0.0, -0.07, MUTED, "missed")):
        rows = (landmark.test.detected == kind) & (time_s >= -_BEFORE_S) & (time_s <= _AFTER_S)
        axes.plot(time_s[rows], np.full(rows.sum(), at), "|", ms=5, color=colour, label=label)
