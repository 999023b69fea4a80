"""The picture of the demonstration: what changed in the building, and what that does to a map that does not know."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.demo.numbers import drifts
from evermap.demo.study import Study, Visit
from evermap.types import FloatArray, IntArray, Landmarks
from evermap.viz.style import ALERT, ESTIMATE, INK, MUTED, PAPER, NamedFigure, house_style, new_figure, settle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours once more; shapes tell the classes apart where colours don't
_CLASS_LOOK = (
    (INK, "s"),
    ("#e69f00", "D"),
    ("#009e73", "^"),
    ("#0072b2", "o"),
    ("#cc79a7", "v"),
    ("#56b4e9", "P"),
)
_RC: Any = {
    "font.size": 12.5,
    "axes.labelsize": 12.5,
    "axes.titlesize": 14.0,
    "xtick.labelsize": 12.0,
    "ytick.labelsize": 12.0,
    "legend.fontsize": 11.5,
}


def draw_demo(study: Study) -> NamedFigure:
    """The hero figure, 1600 x 768 pixels at 160 dpi."""
    import matplotlib as mpl

    with house_style(), mpl.rc_context(_RC):
        figure = new_figure(10.0, 4.8)
        plan, errors = figure.subplots(1, 2, width_ratios=(1.75, 1.0))
        _draw_building(plan, study)
        _draw_errors(errors, study)
        settle(figure)
    return NamedFigure("demo", figure, "What a map that never changes costs in a building that does", _caption(study))


def _caption(study: Study) -> str:
    now, day = drifts(study)[-1], study.changed.truths[-1].day + 1
    return (
        f"Left: the building on day {day} with the robot's patrol of that day. Of the"
        f" {len(now.stayed) + len(now.moved) + len(now.vanished)} landmarks that were there on day 1,"
        f" {len(now.moved)} stand elsewhere (hollow: where they were; one arrow an object) and {len(now.vanished)} are"
        " gone (crosses). Right: position error of each day's patrol, RMSE after an alignment of its own; shaded is"
        " the middle 80 % of the errors along the patrol. Robot, patrols and noise are the same in both buildings."
    )


def _draw_building(axes: Axes, study: Study) -> None:
    """Walls, last patrol, landmarks as they are now, and where those of the first day were."""
    first, last = study.changed.sessions[0], study.changed.sessions[-1]
    then, now = first.true_landmarks, last.true_landmarks
    assert then is not None
    assert now is not None
    assert last.truth is not None
    change = drifts(study)[-1]
    for wall in study.changed.plan.walls_m:
        axes.plot(*wall.T, color=INK, lw=2.2, solid_capstyle="round", zorder=2)
    axes.plot(*last.truth.pose_world_robot[::25, :2].T, color="#b9c1ca", lw=1.6, zorder=1)

    for item in study.changed.objects:
        ids = np.intersect1d(item.landmark_ids, change.moved)
        if len(ids) == 0:
            continue
        colour, shape = _CLASS_LOOK[item.class_id % len(_CLASS_LOOK)]
        old, new = _at(then, ids), _at(now, ids)
        axes.plot(*old.T, shape, ms=4.6, mfc=PAPER, mec=colour, mew=1.0, zorder=5)
        arrow = {"arrowstyle": "-|>,head_width=0.22,head_length=0.42", "color": ALERT, "lw": 1.5}
        curve = {"connectionstyle": "arc3,rad=0.12", "shrinkA": 1.0, "shrinkB": 1.0}
        axes.annotate("", new.mean(axis=0), old.mean(axis=0), arrowprops=arrow | curve, zorder=6)
    gone = _at(then, change.vanished)
    axes.plot(*gone.T, "x", ms=7, color=ALERT, mew=2.0, zorder=6)
    for row, name in enumerate(study.changed.class_names):
        colour, shape = _CLASS_LOOK[row % len(_CLASS_LOOK)]
        points = now.position_m[now.class_id == row]
        axes.plot(*points.T, shape, color=colour, ms=5.6, mec=PAPER, mew=0.5, zorder=7, label=name, ls="none")
    axes.plot([], [], color=ALERT, marker=">", ms=5, lw=1.2, label="moved (hollow: from)")
    axes.plot([], [], "x", color=ALERT, ms=7, mew=2.0, label="vanished")
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(f"The building on day {study.changed.truths[-1].day + 1}, mapped on day 1")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=4, handlelength=1.2, columnspacing=1.2, handletextpad=0.5
    )


def _at(landmarks: Landmarks, ids: IntArray) -> FloatArray:
    """(k, 2) positions of some of them."""
    return landmarks.position_m[np.searchsorted(landmarks.landmark_id, ids)]


def _draw_errors(axes: Axes, study: Study) -> None:
    """Error of every session: changing building, unchanging one, and no memory at all."""
    from matplotlib.ticker import MaxNLocator

    days = np.array([truth.day + 1 for truth in study.changed.truths])
    looks = {
        "changed": (ALERT, "-", "o", "things change"),
        "unchanged": (ESTIMATE, "-", "s", "nothing changes"),
        "from_scratch": (MUTED, ":", None, "no map kept"),
    }
    for name, (colour, dash, marker, label) in looks.items():
        rmse_cm, low_cm, high_cm = (100.0 * numbers for numbers in _spread(study.visits[name]))
        if name != "from_scratch":
            axes.fill_between(days, low_cm, high_cm, color=colour, alpha=0.16, lw=0)
        axes.plot(days, rmse_cm, ls=dash, marker=marker, color=colour, lw=2.2, ms=6.5, label=label)
    axes.set_ylim(bottom=0.0)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    axes.set_xlim(days[0] - 0.25, days[-1] + 0.25)
    changed = [len(now.moved) + len(now.vanished) for now in drifts(study)]
    axes.set_xticks(days, [f"{day}\n{count}" for day, count in zip(days, changed, strict=True)])
    axes.set_xlabel("day · landmarks moved or gone")
    axes.set_ylabel("position error [cm]")
    axes.set_title("Living with the map of day 1")
    axes.legend(loc="upper left", borderaxespad=0.2)


def _spread(visits: tuple[Visit, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """RMSE, 10 % and 90 % quantile of the position errors, each (S,), nan where there is no truth."""
    rows = []
    for visit in visits:
        poses = visit.evaluation.poses
        errors = np.array([np.nan]) if poses is None else poses.position_error_m
        rows.append((np.sqrt(np.mean(errors**2)), *np.percentile(errors, [10, 90])))
    rmse, low, high = np.array(rows).T
    return rmse, low, high
