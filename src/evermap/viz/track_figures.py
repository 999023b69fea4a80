"""Figures of tracking: objects over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import Clock, FloatArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    MUTED,
    class_looks,
    drawing,
    legend_name,
    legend_of,
)
from evermap.viz.time_axis import TimeAxis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_SPELLS = 80
"""Maximum rows of the right half: the longest spells."""


def plot_objects(
    class_names: Sequence[str],
    paths: Sequence[tuple[int, FloatArray]],
    rests: Any,
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
        rests: the spells, `tracking.record.StaticSpells`.
        start_s: first frame.
        end_s: last frame.
        sensor_m: (F, 2) where the sensor was, in order; None where unknown.
        clock: `RECORDING` for an axis of seconds, minutes, hours or days; else dates.
    """
    looks = [class_looks(class_names)[name] for name in class_names]
    left = np.isfinite(rests.gone_s)
    with drawing(9.0, 4.8) as figure:
        above, bars = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
        if sensor_m is not None:
            above.plot(*sensor_m.T, color=MUTED, lw=0.8, ls=":", zorder=1, label="path of the sensor")
        for k, (name, look) in enumerate(zip(class_names, looks, strict=True)):
            for _, path in (one for one in paths if one[0] == k):
                above.plot(*path.T, color=look.colour, lw=0.9, alpha=0.7, zorder=2)
            mark: Any = {"ls": "none", "marker": look.marker, "ms": 6.0, "mec": look.colour}
            here = rests.class_id == k
            above.plot(*rests.position_m[here & left, :2].T, mfc="none", alpha=0.6, zorder=3, **mark)
            above.plot(*rests.position_m[here & ~left, :2].T, mfc=look.colour, zorder=4, **mark)
            above.plot([], [], color=look.colour, mfc=look.colour, **(mark | {"ls": "-"}),
                       label=legend_name(name) or "objects")  # fmt: skip
        if left.any():
            above.plot(
                *rests.position_m[left, :2].T, "x", color=ALERT, ms=6.0, mew=1.1, zorder=3.5, label="has left again"
            )
        above.set(xlabel="x [m]", ylabel="y [m]")
        above.set_aspect("equal", adjustable="datalim")
        above.set_title("paths, and places of rest")
        _draw_bars(bars, rests, [look.colour for look in looks], TimeAxis.over(start_s, end_s, clock), end_s)
        figure.legend(*legend_of(above, bars), loc="outside lower center", ncols=5)
    return figure


def _draw_bars(axes: Axes, rests: Any, colours: Sequence[str], axis: TimeAxis, end_s: float) -> None:
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
        axes.plot([], [], color=MUTED, lw=0.8, label="arrived or left in between")
    if unbounded:
        axes.plot([], [], color=MUTED, marker=">", ls="", ms=3.5, label="beginning or end unknown")
    which = (
        f"the {len(order)} longest of {len(rests.first_s):,} spells" if len(order) < len(rests.first_s) else "spells"
    )
    axes.set(yticks=[], ylim=(len(order), -1.0))
    axes.axvline(at(end_s), color=INK, lw=0.6, ls=":", label="last frame")
    axis.label(axes)
    axes.set_title(f"{which} at rest")


STATIC, DYNAMIC = ESTIMATE, GROUP
"""Blue, and wine instead of the thesis' purple, which colour-blind readers confuse with blue."""
