"""What several filters believe of the same clique over time (Bateman 2020, Fig. 5.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray
from evermap.viz.presence_figures import stretches
from evermap.viz.style import ALERT, ESTIMATE, INK, LANDMARK, MUTED, SHADE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def draw_clique_beliefs(
    figure: Figure,
    step: IntArray,
    beliefs: Mapping[str, FloatArray],
    *,
    survival_step: float,
    in_view: BoolArray,
    detected: BoolArray,
    rho_high: float,
    rho_low: float,
) -> None:
    """A row for each filter, below them a row of what was seen. Call in `house_style`.

    A landmark leaves the map when the belief falls below `rho_low`, and is back when it has reached `rho_high`; a
    removal is marked by whether it was too early. Steps in which the clique was out of view are shaded.

    Args:
        figure: empty; gets one pair of axes a filter and one for the detections.
        step: (F,) increasing.
        beliefs: posterior of persistence (F,) by the filter's name; nan before the birth.
        survival_step: last instant at which the clique was there.
        in_view: (F,) whether a detection was possible.
        detected: (F,) whether any of its landmarks was detected.
        rho_high: measurements are accepted from this belief on.
        rho_low: landmarks are removed below this belief.
    """
    heights = [1.0] * len(beliefs) + [0.35]
    rows = figure.subplots(len(beliefs) + 1, 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    for axes, (name, belief) in zip(rows, beliefs.items(), strict=False):
        _draw_belief(axes, step, belief, survival_step, rho_high, rho_low)
        axes.set_title(name)
    _draw_looks(rows[-1], step, in_view, detected)
    for axes in rows:
        for k, (begin, end) in enumerate(stretches(step, ~in_view)):
            axes.axvspan(begin, end, color=SHADE, lw=0, zorder=0, label=None if k else "out of view")
        axes.axvline(survival_step, color=INK, lw=1.2, ls=(0, (4, 2)), zorder=3, label="truly gone")
        axes.grid(visible=False)
    rows[-1].set(xlabel="step", xlim=(step[0], step[-1]))
    known = {label: handle for axes in rows for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(known.values(), known.keys(), loc="outside lower center", ncols=3, columnspacing=1.4)


def removals(belief: FloatArray, *, rho_high: float, rho_low: float) -> IntArray:
    """(M,) rows at which a belief (F,) falls below `rho_low`, each time after it had (again) reached `rho_high`."""
    found, kept = [], True
    for row, value in enumerate(belief):
        if kept and value < rho_low:
            found.append(row)
        kept = value >= rho_high or (kept and not value < rho_low)
    return np.array(found, dtype=np.int64)


def _draw_belief(
    axes: Axes, step: IntArray, belief: FloatArray, survival_step: float, rho_high: float, rho_low: float
) -> None:
    axes.plot(step, belief, color=ESTIMATE, lw=1.0, drawstyle="steps-post", zorder=4, label="P(there)")
    for level, name in ((rho_high, "thresholds"), (rho_low, None)):
        axes.axhline(level, color=MUTED, lw=0.8, ls=(0, (3, 2)), zorder=2, label=name)
    at = removals(belief, rho_high=rho_high, rho_low=rho_low)
    early = step[at] <= survival_step
    for mine, colour, label in ((at[early], ALERT, "removed too early"), (at[~early], LANDMARK, "removed rightly")):
        axes.plot(step[mine], belief[mine], "v", color=colour, ms=5.0, zorder=5, label=label)
    axes.set(ylim=(-0.08, 1.08), yticks=(0.0, 0.5, 1.0), ylabel="P(there) [1]")


def _draw_looks(axes: Axes, step: IntArray, in_view: BoolArray, detected: BoolArray) -> None:
    """Detected or not, for each step in view."""
    for seen, colour in ((True, LANDMARK), (False, ALERT)):
        mine = step[in_view & (detected == seen)]
        axes.plot(mine, np.full(len(mine), float(seen)), "|", color=colour, ms=6.0, mew=0.6, zorder=4)
    axes.set(ylim=(-0.6, 1.6), yticks=(0.0, 1.0))
    axes.set_yticklabels(["missed", "detected"])
