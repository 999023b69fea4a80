"""Figures of tracking: objects over time, and what a tracker believes at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    ONLINE,
    SHADE,
    house_style,
    legend_name,
    new_figure,
    settle,
)
from evermap.viz.time_axis import unit_for

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (ESTIMATE, ALERT, LANDMARK, GROUP, ODOMETRY, ONLINE)
MOST_SPELLS = 80
"""Rows of the right half; of more spells, the longest."""


@dataclass(frozen=True, slots=True)
class Rests:
    """K spells at rest.

    Attributes:
        class_id: (K,) class.
        position_m: (K, 2) where.
        elsewhere_s, first_s, last_s, gone_s: (K,) last look without it, first and last with it, first without it;
            not finite where there is none.
    """

    class_id: IntArray
    position_m: FloatArray
    elsewhere_s: FloatArray
    first_s: FloatArray
    last_s: FloatArray
    gone_s: FloatArray


def plot_objects(
    class_names: Sequence[str],
    paths: Sequence[tuple[int, FloatArray]],
    rests: Rests,
    *,
    start_s: float,
    end_s: float,
    sensor_m: FloatArray | None = None,
) -> Figure:
    """Paths and places of rest from above; beside it, a bar for each spell at rest.

    A bar is from the first sighting to the last. The thin line before it begins at the last look at which the object
    was not there, that behind it ends at the first; an arrow instead of an end: nobody knows.

    Args:
        class_names: C classes, '' for one without a name.
        paths: class and (K, 2) positions of each stretch in which an object moved.
        rests: the spells.
        start_s: first frame.
        end_s: last frame.
        sensor_m: (F, 2) where the sensor was, in order; None where unknown.
    """
    with house_style():
        figure = new_figure(9.0, 4.6)
        above, bars = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
        if sensor_m is not None:
            above.plot(*sensor_m.T, color=MUTED, lw=0.8, ls=":", zorder=1, label="sensor")
        for k, name in enumerate(class_names):
            colour = _COLOURS[k % len(_COLOURS)]
            for _, path in (one for one in paths if one[0] == k):
                above.plot(*path.T, color=colour, lw=0.9, alpha=0.7, zorder=2)
            mine = rests.class_id == k
            above.plot(*rests.position_m[mine].T, ls="none", marker="s", ms=4.0, mfc="none", mec=colour, zorder=3)
            above.plot([], [], color=colour, lw=2.0, label=legend_name(name) or "objects")
        above.set(xlabel="x [m]", ylabel="y [m]")
        above.set_aspect("equal", adjustable="datalim")
        above.set_title("paths, and places of rest")
        _draw_bars(bars, rests, start_s, end_s)
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=6)
        settle(figure)
    return figure


def _draw_bars(axes: Axes, rests: Rests, start_s: float, end_s: float) -> None:
    unit = unit_for(end_s - start_s)
    longest = np.argsort(rests.first_s - rests.last_s, kind="stable")[:MOST_SPELLS]
    order = longest[np.argsort(rests.first_s[longest], kind="stable")]

    def at(stamp_s: float) -> float:
        return (stamp_s - start_s) / unit.seconds

    for row, k in enumerate(order.tolist()):
        colour = _COLOURS[int(rests.class_id[k]) % len(_COLOURS)]
        for outer_s, inner_s, mark in (
            (rests.elsewhere_s[k], rests.first_s[k], "<"),
            (rests.gone_s[k], rests.last_s[k], ">"),
        ):
            if np.isfinite(outer_s):
                axes.plot([at(outer_s), at(inner_s)], [row, row], color=colour, lw=0.8)
            else:
                axes.plot(at(inner_s), row, color=colour, marker=mark, ms=3.5)
        axes.plot([at(rests.first_s[k]), at(rests.last_s[k])], [row, row], color=colour, lw=3.0, solid_capstyle="butt")
    which = (
        f"the {len(order)} longest of {len(rests.first_s):,} spells" if len(order) < len(rests.first_s) else "spells"
    )
    axes.set(xlabel=f"time since the first frame [{unit.name}]", yticks=[], ylim=(len(order), -1.0))
    axes.axvline(at(end_s), color=INK, lw=0.6, ls=":")
    axes.set_title(f"{which} at rest")


STATIC, DYNAMIC = ESTIMATE, GROUP
"""The thesis' blue and purple."""
ARROW_S = 2.0
"""Arrows show the way of so many seconds."""


def draw_tracks(
    axes: Axes,
    *,
    position_m: FloatArray,
    velocity_mps: FloatArray,
    static: BoolArray,
    resting_m: FloatArray,
    sensor_m: FloatArray,
    reach_m: float,
    path_m: FloatArray | None = None,
    detected_m: FloatArray | None = None,
) -> None:
    """Active tracklets by colour, the working set hollow, and the sensor with its radius. Call in `house_style`.

    Args:
        axes: empty.
        position_m: (N, 3) of active tracklets.
        velocity_mps: (N, 3) of the same; arrows for those that move.
        static: (N,) whether each is static.
        resting_m: (K, 3) places of the objects in the working set.
        sensor_m: (3,).
        reach_m: radius in which the sensor sees.
        path_m: (F, 3) of the sensor so far.
        detected_m: (M, 3) detections of the frame.
    """
    from matplotlib.patches import Circle

    x, y = sensor_m[:2]
    axes.add_patch(
        Circle((x, y), reach_m, facecolor=SHADE, edgecolor=MUTED, lw=0.8, zorder=0.5, label="seen by the sensor")
    )
    if path_m is not None:
        axes.plot(path_m[:, 0], path_m[:, 1], color=MUTED, lw=0.8, ls=":", zorder=1, label="its path")
    marks: Any = {"ls": "none", "marker": "o", "ms": 5.0}
    axes.plot(
        *resting_m[:, :2].T, mfc="none", mec=STATIC, mew=1.0, zorder=2, label="static, in the working set", **marks
    )
    axes.plot(*position_m[static, :2].T, color=STATIC, zorder=3, label="static", **marks)
    axes.plot(*position_m[~static, :2].T, color=DYNAMIC, zorder=3, label="dynamic", **marks)
    ends = position_m[~static] + ARROW_S * velocity_mps[~static]
    ways = np.stack([position_m[~static, :2], ends[:, :2]], axis=1)
    for begin, end in ways:
        axes.plot(*np.array([begin, end]).T, color=DYNAMIC, lw=1.0, zorder=2.5)
    if detected_m is not None:
        axes.plot(*detected_m[:, :2].T, ls="none", marker="x", ms=3.0, mew=0.6, color=INK, zorder=4, label="detection")
    axes.plot(x, y, ls="none", marker="^", ms=7.0, color=INK, zorder=5, label="sensor")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
