"""The picture of the demonstration: what evermap's map believes in the end, and what every method got wrong."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se2
from evermap.types import ChangeKind, FloatArray, IntArray, MapChange
from evermap.viz.style import ALERT, GRID, INK, MUTED, PAPER, NamedFigure, class_looks, house_style, new_figure, settle
from evermap_studies.demo.claims import Claims
from evermap_studies.demo.looks import METHOD_LOOKS
from evermap_studies.demo.methods import method_named
from evermap_studies.demo.numbers import Line, ratios
from evermap_studies.demo.study import Study
from evermap_studies.worlds.scores import NEAR_M, stands_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_RC: Any = {
    "font.size": 12.5,
    "axes.labelsize": 12.5,
    "axes.titlesize": 14.0,
    "xtick.labelsize": 12.0,
    "ytick.labelsize": 12.0,
    "legend.fontsize": 11.0,
}
FAINTEST = 0.12


def draw_hero(study: Study, lines: dict[str, Line]) -> NamedFigure:
    """Draw the hero figure, 1600 x 800 pixels at 160 dpi."""
    import matplotlib as mpl

    with house_style(), mpl.rc_context(_RC):
        figure = new_figure(10.0, 5.0)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1.0))
        plan, errors, false = (figure.add_subplot(cell) for cell in (grid[:, 0], grid[0, 1], grid[1, 1]))
        _draw_map(plan, study, lines["evermap"].pose_truth_map)
        day = days_of(study)
        for name, line in lines.items():
            _line(errors, name, day, [_centimetres(ratios(counts)["pose_rmse_m"]) for counts in line.counts])
            if not method_named(name).is_told:
                _line(false, name, day, np.cumsum(false_by_session(line.claims, len(day))).tolist())
        _dress(errors, false, day)
        settle(figure)
    return NamedFigure("demo", figure, "A map that stays true for four weeks", _caption(study, lines))


def _caption(study: Study, lines: dict[str, Line]) -> str:
    day = study.building.truths[-1].day + 1
    truth = study.truth
    as_first = int(np.all(truth.position_m[-1] == truth.position_m[0], axis=1).sum())
    claimed = study.living.landmarks(p_least=0.5)
    wrong = len(claimed) - int(stands_at(claimed, truth.landmarks(-1), lines["evermap"].pose_truth_map).sum())
    rest = "all of them right" if wrong == 0 else f"{wrong} of which have gone or moved since (circled)"
    seen = int(truth.known[-1].sum())
    return (
        f"Left: evermap's map after the last session of day {day}: every landmark at its most probable place, the less"
        f" probable the fainter; hollow where the map knows that it used to stand; in red what evermap says has changed"
        f" on this day. The map claims {len(claimed)} landmarks, {rest}; {seen} stand where they were looked at. Of the"
        f" {int(truth.there[0].sum())} landmarks of day 1 {as_first} still stand where they were. Right, session by"
        " session on the same recordings: position error in the map's frame (RMSE); and how many changes each method"
        " has told that are false, added up."
    )


def _draw_map(axes: Axes, study: Study, pose_truth_map: FloatArray) -> None:
    """Walls, what the map believes, what it remembers, and what has changed on the last day."""
    for wall in study.building.plan.walls_m:
        axes.plot(*wall.T, color=INK, lw=2.2, solid_capstyle="round", zorder=2)
    path = study.building.sessions[-1].truth
    assert path is not None
    axes.plot(*path.pose_world_robot[::25, :2].T, color=GRID, lw=1.4, zorder=1)

    living = study.living
    best = living.landmarks()
    classes = dict(zip(living.members.landmark_id.tolist(), living.members.class_id.tolist(), strict=True))
    here = se2.transform(pose_truth_map, best.position_m)
    remembered = _remembered(study)
    places = se2.transform(pose_truth_map, living.places.position_m)
    looks = class_looks(study.building.class_names)
    for row, name in enumerate(study.building.class_names):
        colour, shape = looks[name].colour, looks[name].marker
        old = [k for k in remembered if classes[int(living.places.landmark_id[k])] == row]
        axes.plot(*places[old].T, shape, ms=4.2, mfc="none", mec=colour, mew=0.8, alpha=0.4, ls="none", zorder=3)
        axes.plot([], [], shape, color=colour, ms=6, ls="none", label=name)
        mine = best.class_id == row
        if not mine.any():
            continue
        opacity = np.maximum(best.p_exists[mine], FAINTEST)
        x, y = here[mine].T
        axes.scatter(x, y, marker=shape, s=40, color=colour, alpha=opacity, edgecolors=PAPER, linewidths=0.5, zorder=7)
    drawn = {_draw_change(axes, change, study, pose_truth_map) for change in _of_last_day(study)}
    _draw_wrong(axes, study, pose_truth_map)
    axes.plot([], [], "o", mfc="none", mec=MUTED, ms=5, ls="none", label="stood there")
    if "moved" in drawn:
        axes.plot([], [], color=ALERT, marker=">", ms=5, lw=1.4, label="moved today")
    if "vanished" in drawn:
        axes.plot([], [], "x", color=ALERT, ms=6.5, mew=1.9, ls="none", label="vanished today")
    if "came" in drawn:
        axes.plot([], [], "+", color=ALERT, ms=8, mew=1.9, ls="none", label="came today")
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(f"What the map believes on day {study.building.truths[-1].day + 1}")
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0.01), ncols=4, handlelength=1.2, columnspacing=1.1, handletextpad=0.4
    )


def _remembered(study: Study) -> list[int]:
    """Rows of places at which the map does not believe a landmark to stand now, but knows that it did."""
    living = study.living
    best = set(living.site_of().tolist())
    return [k for k, site in enumerate(living.places.site_id.tolist()) if site not in best]


def _of_last_day(study: Study) -> list[MapChange]:
    """What evermap says has changed in the sessions of the last day."""
    return [c for visit in study.visits["evermap"][-study.scenario.sessions_per_day :] for c in visit.changes]


def _draw_change(axes: Axes, change: MapChange, study: Study, pose_truth_map: FloatArray) -> str:
    """An arrow for what moved, a cross for what is gone, a plus for what came; returns which."""
    living = study.living
    row = living.place_row(living.members.landmark_id, living.site_of())
    of = np.isin(living.members.landmark_id, change.landmark_ids) & (row >= 0)
    if not of.any():
        return ""  # forgotten since
    here = se2.transform(pose_truth_map, living.places.position_m[row[of]])
    if change.kind == ChangeKind.VANISHED:
        axes.plot(*here.T, "x", ms=6.5, color=ALERT, mew=1.9, zorder=8)
        return "vanished"
    if not math.hypot(*change.displacement_m) >= NEAR_M:  # it was not there before, or is back where it was
        axes.plot(*here.T, "+", ms=9, color=ALERT, mew=1.6, zorder=6)
        return "came"
    end = here.mean(axis=0)
    start = end - se2.rotation(float(pose_truth_map[2])) @ np.array(change.displacement_m)
    arrow = {"arrowstyle": "-|>,head_width=0.22,head_length=0.42", "color": ALERT, "lw": 1.5}
    curve = {"connectionstyle": "arc3,rad=0.12", "shrinkA": 1.0, "shrinkB": 1.0}
    axes.annotate("", end, start, arrowprops=arrow | curve, zorder=6)
    return "moved"


def _draw_wrong(axes: Axes, study: Study, pose_truth_map: FloatArray) -> None:
    """A ring around every claim that is not so."""
    claimed = study.living.landmarks(p_least=0.5)
    wrong = ~stands_at(claimed, study.truth.landmarks(-1), pose_truth_map)
    at = se2.transform(pose_truth_map, claimed.position_m[wrong])
    axes.plot(*at.T, "o", ms=12, mfc="none", mec=ALERT, mew=1.2, ls="none", zorder=9)


def _line(axes: Axes, name: str, day: FloatArray, values: list[float]) -> None:
    look = METHOD_LOOKS[name]
    axes.plot(day, values, color=look.colour, ls=look.dash, lw=look.width, label=look.label, zorder=look.order)


def false_by_session(claims: Claims, sessions: int) -> IntArray:
    """(S,) changes that were told falsely in every session."""
    return np.bincount(claims.session[~claims.is_true], minlength=sessions)


def _dress(errors: Axes, false: Axes, day: FloatArray) -> None:
    """Titles, scales and one legend of the panels at the right."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    errors.set_yscale("log")
    errors.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    errors.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    errors.yaxis.set_minor_formatter(FuncFormatter(lambda _value, _: ""))
    errors.set_title("Position error [cm]")
    errors.set_xticklabels([])
    false.set_title("False changes, cumulative")
    false.set_ylim(bottom=0.0)
    false.set_xlabel("day")
    for axes in (errors, false):
        axes.set_xlim(day[0], day[-1] + 0.25)
    handles, labels = errors.get_legend_handles_labels()
    false.legend(
        handles, labels, loc="upper center", bbox_to_anchor=(0.45, -0.32), ncols=3, handlelength=1.6, columnspacing=1.0
    )


def days_of(study: Study) -> FloatArray:
    """(S,) when each session was, in days from 1."""
    first_s = study.building.config.first_day_unix_s
    return np.array([1.0 + (truth.start_s - first_s) / 86_400.0 for truth in study.building.truths])


def _centimetres(metres: float | None) -> float:
    return float("nan") if metres is None else 100.0 * metres
