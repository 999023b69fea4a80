"""The four weeks: what happened in the building, and what each method said, week by week."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se2
from evermap.types import IntArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    INK,
    MUTED,
    SHADE,
    NamedFigure,
    class_looks,
    house_style,
    new_figure,
    settle,
)
from evermap_studies.demo.claims import CERTAIN
from evermap_studies.demo.claims_figure import TELLING
from evermap_studies.demo.looks import METHOD_LOOKS
from evermap_studies.demo.numbers import Line, week_of
from evermap_studies.demo.study import Study
from evermap_studies.sim import CLUTTER
from evermap_studies.sim.building import SceneObject
from evermap_studies.worlds.scores import NEAR_M

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DOUBTED = "#f0b48a"
"""Colour of what was told falsely, but not with certainty."""


def draw_weeks(study: Study, lines: dict[str, Line]) -> NamedFigure:
    """Two weeks a row: the plan, and beneath it what was told."""
    import matplotlib as mpl

    week = week_of(study)
    weeks = np.unique(week)
    rows = -(-len(weeks) // 2)
    most = max(
        int(np.bincount(week[lines[name].claims.session], minlength=len(weeks)).max(initial=1)) for name in TELLING
    )
    style: Any = {"font.size": 10.0, "axes.titlesize": 11.5}
    with house_style(), mpl.rc_context(style):
        figure = new_figure(10.0, 4.2 * rows + 0.5)
        cells = figure.subplots(2 * rows, 2, height_ratios=(2.7, 1.1) * rows, squeeze=False)
        for axes in cells.ravel():
            axes.set_axis_off()
        for which in weeks.tolist():
            plan, told = (cells[2 * (which // 2) + part, which % 2] for part in (0, 1))
            sessions = np.flatnonzero(week == which)
            _draw_plan(plan, study, lines["evermap"], sessions)
            _draw_told(told, lines, sessions, most)
            plan.set_title(_title(study, which, sessions), loc="left")
        legend = [entry for axes in cells[:, 0] for entry in zip(*axes.get_legend_handles_labels(), strict=True)]
        labels: dict[str, Any] = {}
        for handle, label in legend:
            labels.setdefault(label, handle)
        figure.legend(
            labels.values(), labels.keys(), loc="outside lower center", ncols=5, handlelength=1.2, columnspacing=1.2
        )
        settle(figure)
    return NamedFigure("demo_weeks", figure, "Four weeks in one building, and what was said of them", _caption())


def _caption() -> str:
    return (
        "Plans: where the robot drove in that week (grey lines), what stands there at its end, and what truly changed"
        " since the week before; a door with its bar was shut for some patrols, a hatched wing was closed. Circled:"
        " landmarks of which evermap told a change in that week that had not happened. Crates, which come and go by the"
        " hour, are small, and their changes are not drawn. Bars: the changes that each method told in that week, by"
        " landmark, all of its patrols together: true ones, false ones, and false ones that were told with a"
        f" probability above {CERTAIN:g}."
    )


def _title(study: Study, which: int, sessions: IntArray) -> str:
    truths = [study.building.truths[k] for k in sessions.tolist()]
    changed = int(study.truth.changed[sessions].sum())
    closed = [truth.wing_shut for truth in truths]
    before = bool(sessions[0]) and study.building.truths[int(sessions[0]) - 1].wing_shut
    wing = ", wing closed" if all(closed) else ", the wing opens" if any(closed) or before else ""
    return f"Week {which + 1}{wing}: {changed} true changes"


def _draw_plan(axes: Axes, study: Study, line: Line, sessions: IntArray) -> None:
    """The building in a week."""
    from matplotlib.patches import Rectangle

    building = study.building
    plan, last = building.plan, int(sessions[-1])
    if building.truths[int(sessions[0])].wing_shut:
        size = plan.length_m - plan.wing_x_m, plan.depth_m
        axes.add_patch(Rectangle((plan.wing_x_m, 0.0), *size, fc=SHADE, ec=MUTED, hatch="//", lw=0.0, zorder=0))
    for k in sessions.tolist():
        path = building.sessions[k].truth
        assert path is not None
        axes.plot(*path.pose_world_robot[::25, :2].T, color=MUTED, lw=0.7, alpha=0.3, zorder=1)
    for wall in plan.walls_m:
        axes.plot(*wall.T, color=INK, lw=1.6, solid_capstyle="round", zorder=2)
    shut = sorted({row for k in sessions.tolist() for row in building.truths[k].shut_rooms})
    for row, wall in enumerate(plan.shut(shut, wing=False).walls_m[len(plan.walls_m) :]):
        label = "door, shut at times" if not row else None
        axes.plot(*wall.T, color=ESTIMATE, lw=3.2, solid_capstyle="butt", zorder=2, label=label)
    _draw_objects(axes, study, max(int(sessions[0]) - 1, 0), last)
    _draw_false(axes, study, line, sessions)
    axes.set_xlim(-0.4, plan.length_m + 0.4)
    axes.set_ylim(-0.4, plan.depth_m + 0.4)
    axes.set_aspect("equal")


def _draw_objects(axes: Axes, study: Study, before: int, after: int) -> None:
    """What stands there after a week, and what happened to everything but clutter since the session `before`."""
    drawn: set[str] = set()
    looks = class_looks(study.building.class_names)

    def named(label: str) -> str | None:
        new = label not in drawn
        drawn.add(label)
        return label if new else None

    for item in study.building.objects:
        then, now = (_middle(study, item, k) for k in (before, after))
        look = looks[study.building.class_names[item.class_id]]
        is_clutter = item.kind.name == CLUTTER.name
        if now is not None:
            size = 3.0 if is_clutter else 4.5
            axes.plot(*now, look.marker, color=look.colour, ms=size, mew=0.0, zorder=4, label=named(item.kind.name))
        if is_clutter or after == before:
            continue
        if then is None and now is not None:
            axes.plot(*now, "+", color=INK, ms=10, mew=1.6, zorder=5, label=named("came"))
        elif then is not None and now is None:
            axes.plot(*then, "x", color=INK, ms=7, mew=1.6, zorder=5, label=named("left"))
        elif then is not None and now is not None and np.hypot(*np.subtract(now, then)) > NEAR_M:
            arrow: Any = {"arrowstyle": "-|>", "color": INK, "lw": 1.0, "shrinkA": 0.0, "shrinkB": 2.0}
            axes.annotate("", now, then, arrowprops=arrow, zorder=5)
            axes.plot([], [], color=INK, lw=1.0, marker=">", ms=4, label=named("moved"))


def _middle(study: Study, item: SceneObject, session: int) -> tuple[float, float] | None:
    """Centre of an object's landmarks in a session; None where it is away."""
    at_m = study.truth.position_m[session, list(item.landmark_ids)]
    return None if np.isnan(at_m).any() else (float(at_m[:, 0].mean()), float(at_m[:, 1].mean()))


def _draw_false(axes: Axes, study: Study, line: Line, sessions: IntArray) -> None:
    """A ring around the landmarks of evermap's false changes, where its map has them after the session."""
    claims, label = line.claims, "told falsely by evermap"
    rows = np.flatnonzero(~claims.is_true & np.isin(claims.session, sessions))
    at_m = []
    for row in rows.tolist():
        landmarks = study.visits["evermap"][int(claims.session[row])].snapshot.landmarks
        of = np.flatnonzero(landmarks.landmark_id == claims.landmark_id[row])
        at_m += [se2.transform(line.pose_truth_map, landmarks.position_m[of[0]])] if len(of) else []
    x, y = np.array(at_m).reshape(-1, 2).T
    axes.plot(x, y, "o", ms=9, mfc="none", mec=ALERT, mew=1.0, ls="none", zorder=6, label=label)


def _draw_told(axes: Axes, lines: dict[str, Line], sessions: IntArray, most: int) -> None:
    """What every method told in a week, as bars."""
    axes.set_axis_on()
    for row, name in enumerate(TELLING):
        claims = lines[name].claims
        mine = np.isin(claims.session, sessions)
        certain = claims.probability > CERTAIN
        parts = (
            (claims.is_true, METHOD_LOOKS["evermap"].colour, "told, true"),
            (~claims.is_true & ~certain, _DOUBTED, "told, false"),
            (~claims.is_true & certain, ALERT, "told, false, p > .99"),
        )
        left = 0
        for which, colour, label in parts:
            count = int((mine & which).sum())
            axes.barh(row, count, left=left, color=colour, height=0.7, label=label if not row else None)
            left += count
        n_false = int((mine & ~claims.is_true).sum())
        axes.annotate(f" {n_false} of {left} false", (left, row), va="center", fontsize=8.5)
    axes.set_yticks(np.arange(len(TELLING)), [METHOD_LOOKS[name].label for name in TELLING])
    axes.tick_params(axis="y", length=0)
    axes.set_xticks([])
    axes.set_ylim(len(TELLING) + 0.3, -0.5)
    axes.set_xlim(0.0, 1.3 * most)
    axes.spines[["top", "right", "bottom"]].set_visible(False)
