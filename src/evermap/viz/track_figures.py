"""Figures of tracking: objects over time, and what a tracker believes at one instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import BoolArray, Clock, FloatArray, IntArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    MUTED,
    SHADE,
    class_looks,
    house_style,
    legend_name,
    legend_of,
    new_figure,
    settle,
)
from evermap.viz.time_axis import TimeAxis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    clock: Clock = Clock.RECORDING,
) -> Figure:
    """Draw paths and places of rest from above; beside it, a bar for each spell at rest.

    A bar is from the first sighting to the last. The thin line before it begins at the last look at which the object
    was not there, that behind it ends at the first; an arrow instead of an end: nobody knows. Objects that left their
    place of rest are crossed out.

    Args:
        class_names: C classes, '' for one without a name.
        paths: class and (K, 2) positions of each stretch in which an object moved.
        rests: the spells.
        start_s: first frame.
        end_s: last frame.
        sensor_m: (F, 2) where the sensor was, in order; None where unknown.
        clock: `RECORDING` for an axis of seconds, minutes, hours or days; else dates.
    """
    looks = [class_looks(class_names)[name] for name in class_names]
    left = np.isfinite(rests.gone_s)
    with house_style():
        figure = new_figure(9.0, 4.8)
        above, bars = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
        if sensor_m is not None:
            above.plot(*sensor_m.T, color=MUTED, lw=0.8, ls=":", zorder=1, label="path of the sensor")
        for k, (name, look) in enumerate(zip(class_names, looks, strict=True)):
            for _, path in (one for one in paths if one[0] == k):
                above.plot(*path.T, color=look.colour, lw=0.9, alpha=0.7, zorder=2)
            mark: Any = {"ls": "none", "marker": look.marker, "ms": 6.0, "mec": look.colour}
            here = rests.class_id == k
            above.plot(*rests.position_m[here & left].T, mfc="none", alpha=0.6, zorder=3, **mark)
            above.plot(*rests.position_m[here & ~left].T, mfc=look.colour, zorder=4, **mark)
            above.plot([], [], color=look.colour, mfc=look.colour, **(mark | {"ls": "-"}),
                       label=legend_name(name) or "objects")  # fmt: skip
        if left.any():
            above.plot(*rests.position_m[left].T, "x", color=ALERT, ms=6.0, mew=1.1, zorder=3.5, label="has left again")
        above.set(xlabel="x [m]", ylabel="y [m]")
        above.set_aspect("equal", adjustable="datalim")
        above.set_title("paths, and places of rest")
        _draw_bars(bars, rests, [look.colour for look in looks], TimeAxis.over(start_s, end_s, clock), end_s)
        figure.legend(*legend_of(above, bars), loc="outside lower center", ncols=5)
        settle(figure)
    return figure


def _draw_bars(axes: Axes, rests: Rests, colours: Sequence[str], axis: TimeAxis, end_s: float) -> None:
    longest = np.argsort(rests.first_s - rests.last_s, kind="stable")[:MOST_SPELLS]
    order = longest[np.argsort(rests.first_s[longest], kind="stable")]
    at = axis.coordinates
    unbounded = bounded = False
    for row, k in enumerate(order.tolist()):
        colour = colours[int(rests.class_id[k])]
        first_s, last_s = rests.first_s[k], rests.last_s[k]
        for outer_s, inner_s, mark in ((rests.elsewhere_s[k], first_s, "<"), (rests.gone_s[k], last_s, ">")):
            if np.isfinite(outer_s):
                axes.plot(at([outer_s, inner_s]), [row, row], color=colour, lw=0.8)
                bounded = True
            else:
                axes.plot(at([inner_s]), [row], color=colour, marker=mark, ms=3.5)
                unbounded = True
        axes.plot(at([first_s, last_s]), [row, row], color=colour, lw=3.0, solid_capstyle="butt")
    axes.plot([], [], color=MUTED, lw=3.0, label="seen at rest")
    if bounded:
        axes.plot([], [], color=MUTED, lw=0.8, label="came or left in between")
    if unbounded:
        axes.plot([], [], color=MUTED, marker=">", ls="", ms=3.5, label="beginning or end not known")
    which = (
        f"the {len(order)} longest of {len(rests.first_s):,} spells" if len(order) < len(rests.first_s) else "spells"
    )
    axes.set(yticks=[], ylim=(len(order), -1.0))
    axes.axvline(at(end_s), color=INK, lw=0.6, ls=":", label="last frame")
    axis.label(axes)
    axes.set_title(f"{which} at rest")


STATIC, DYNAMIC = ESTIMATE, GROUP
"""Blue, and wine for the thesis' purple, which colour-blind readers take for blue."""
ARROW_S = 2.0
"""Arrows show the way of so many seconds."""


@dataclass(frozen=True, slots=True)
class TracksNow:
    """What a tracker believes at one instant.

    Attributes:
        position_m: (N, 3) of active tracklets.
        velocity_mps: (N, 3) of the same.
        static: (N,) whether each is static.
        resting_m: (K, 3) places of the objects in the working set.
        sensor_m: (3,).
        reach_m: radius in which the sensor sees.
    """

    position_m: FloatArray
    velocity_mps: FloatArray
    static: BoolArray
    resting_m: FloatArray
    sensor_m: FloatArray
    reach_m: float


def draw_tracks(
    axes: Axes, now: TracksNow, *, path_m: FloatArray | None = None, detected_m: FloatArray | None = None
) -> None:
    """Draw active tracklets by colour, the working set hollow, and the sensor with its radius. Call in `house_style`.

    Args:
        axes: empty.
        now: what moves has a line along its way of the next `ARROW_S` seconds.
        path_m: (F, 3) of the sensor so far.
        detected_m: (M, 3) detections of the frame.
    """
    from matplotlib.patches import Circle

    x, y = now.sensor_m[:2]
    static, moving = now.position_m[now.static], now.position_m[~now.static]
    axes.add_patch(
        Circle((x, y), now.reach_m, facecolor=SHADE, edgecolor=MUTED, lw=0.8, zorder=0.5, label="seen by the sensor")
    )
    if path_m is not None:
        axes.plot(path_m[:, 0], path_m[:, 1], color=MUTED, lw=0.8, ls=":", zorder=1, label="its path")
    marks: Any = {"ls": "none", "marker": "o", "ms": 5.0}
    axes.plot(
        *now.resting_m[:, :2].T, mfc="none", mec=STATIC, mew=1.0, zorder=2, label="static, in the working set", **marks
    )
    axes.plot(*static[:, :2].T, color=STATIC, zorder=3, label="static", **marks)
    axes.plot(*moving[:, :2].T, color=DYNAMIC, zorder=3, label="dynamic", **marks)
    for begin, way in zip(moving[:, :2], ARROW_S * now.velocity_mps[~now.static, :2], strict=True):
        axes.plot(*np.array([begin, begin + way]).T, color=DYNAMIC, lw=1.0, zorder=2.5)
    if detected_m is not None:
        axes.plot(*detected_m[:, :2].T, ls="none", marker="x", ms=3.0, mew=0.6, color=INK, zorder=4, label="detection")
    axes.plot(x, y, ls="none", marker="^", ms=7.0, color=INK, zorder=5, label="sensor")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
