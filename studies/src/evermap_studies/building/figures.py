"""Figures of `evermap reproduce building`: the map with what moved, from above and from the side, and calibration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se3
from evermap.maps.living import LivingMap
from evermap.viz.style import ALERT, ESTIMATE, MUTED, house_style, new_figure, settle
from evermap_studies.building.table import UNCHANGED, of_method, reliability
from evermap_studies.building.world import KINDS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evermap_studies.building.study import Story

MARKERS = ("s", "D", "^", "o", "P")
COLOURS = ("#4a4a4a", "#b07aa1", "#59a14f", "#f28e2b", "#4e79a7")
RECENT = 7
"""Sessions of which moves are drawn."""


def draw_map(story: Story, living: LivingMap, run: Mapping[str, Any]) -> Figure:
    """The map after the last session from above and from the side, fading with belief, and the last week's moves."""
    last = len(story.patrols) - 1
    records, pose = living.landmarks(), story.alignment(living, last)
    own = np.flatnonzero(records.landmark_id < len(story.world.of))
    name, at = records.landmark_id[own], se3.transform(pose, records.position_m[own])
    p, kind = records.p_exists[own], story.world.class_id[name]
    truth = story.patrols[last].recording.truth
    ends, height, _ = story.world.blocking(last)
    moved = [row for row in run["told"] if row["kind"] in ("moved", "rotated") and row["session"] > last - RECENT]
    with house_style():
        figure = new_figure(7.6, 6.4)
        above, side = figure.subplots(2, 1, sharex=True, height_ratios=(14.4, 4.0))
        for (a, b), top in zip(ends, height, strict=True):
            above.plot(*zip(a, b, strict=True), color=MUTED, lw=1.1 if top > 2.5 else 0.7, zorder=1)
        if truth is not None:
            above.plot(
                *truth.pose_world_robot[:, :2].T, color=ESTIMATE, lw=0.9, alpha=0.7, label="last patrol", zorder=2
            )
        for row, what in enumerate(KINDS):
            some = kind == row
            style = {"marker": MARKERS[row], "s": 20, "color": COLOURS[row], "lw": 0.0, "zorder": 3}
            for axes, column in ((above, 1), (side, 2)):
                axes.scatter(*at[some][:, [0, column]].T, alpha=np.clip(p[some], 0.12, 1.0), **style)
            above.scatter([], [], label=what.name, **style)
        for row in moved:
            before, after = (story.position_m[row[key], row["landmark"]] for key in ("since", "session"))
            for axes, column in ((above, 1), (side, 2)):
                arrow = {"arrowstyle": "-|>", "color": ALERT, "lw": 1.0, "shrinkA": 0.0, "shrinkB": 0.0}
                if np.isfinite(before).all() and np.isfinite(after).all():
                    axes.annotate("", after[[0, column]], before[[0, column]], arrowprops=arrow, zorder=4)
        above.plot([], [], color=ALERT, label=f"reported as moved, last {RECENT} days")
        above.set(aspect="equal", ylabel="y [m]")
        side.set(aspect="equal", xlabel="x [m]", ylabel="z [m]", ylim=(-0.1, 2.2))
        above.legend(loc="upper center", bbox_to_anchor=(0.5, 1.12), ncols=8, markerscale=1.0)
        settle(figure)
    return figure


def draw_existence(content: Mapping[str, Any]) -> Figure:
    """Share of landmarks that stand where the map has them, by the probability that it gives, now and a day ahead."""
    methods = list(dict.fromkeys(run["method"] for run in content["runs"] if run["method"] != UNCHANGED))
    first = {run["seed"] for run in of_method(content, methods[-1])}
    with house_style():
        figure = new_figure(7.2, 3.6)
        panels = figure.subplots(1, 2, sharey=True)
        for axes, key, title in zip(
            panels, ("statements", "forecasts"), ("after a session", "a day ahead"), strict=True
        ):
            axes.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=0.9, ls="--")
            for row, method in enumerate(methods):
                pairs = [pair for run in of_method(content, method) if run["seed"] in first for pair in run[key]]
                p, share, count = (np.array(column) for column in zip(*reliability(pairs), strict=True))
                colour = ESTIMATE if row == 0 else COLOURS[row]
                axes.plot(p, share, color=colour, lw=1.6 if row == 0 else 0.9)
                axes.scatter(p, share, s=10.0 + 60.0 * np.sqrt(count / count.max()), color=colour, label=method)
            axes.set(title=title, xlabel="P(it stands there) by the map [1]", xlim=(-0.03, 1.03), ylim=(-0.03, 1.05))
        panels[0].set_ylabel("share that does [1]")
        panels[1].legend(loc="lower right", markerscale=0.6)
        settle(figure)
    return figure
