"""Figures of `evermap reproduce partial-views`: reliability of what is told, and false changes by length of patrols."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.viz.style import ALERT, ESTIMATE, MUTED, house_style, new_figure, settle
from evermap_studies.partial_views.before import BEFORE
from evermap_studies.partial_views.table import PLAIN, by_patrol, patrol_name, reliability, summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_reliability(content: Mapping[str, Any]) -> Figure:
    """Share of the changes told that are true, by the probability that was told, before and now."""
    groups = by_patrol(content)
    with house_style():
        figure = new_figure(7.2, 3.6)
        panels = figure.subplots(1, 2, sharey=True)
        for axes, name, title in zip(
            panels, (PLAIN, patrol_name(0)), ("buildings, patrols of 20 to 165 s", "harder world"), strict=True
        ):
            axes.plot([0.5, 1.0], [0.5, 1.0], color=MUTED, lw=0.9, ls="--", label="calibrated")
            bins = BEFORE["reliability"].get(name)
            if bins:
                _curve(axes, bins, ALERT, "first edition")
            if name in groups:
                told = [row for world in groups[name] for row in world["told"]]
                _curve(axes, reliability(told), ESTIMATE, "evermap")
            axes.set(title=title, xlabel="probability told [1]", xlim=(0.48, 1.02), ylim=(-0.03, 1.05))
        panels[0].set_ylabel("share that is true [1]")
        panels[0].legend(loc="lower right", markerscale=0.6)
        settle(figure)
    return figure


def _curve(axes: Any, bins: Any, colour: str, label: str) -> None:
    p, share, count = (np.array(column, dtype=np.float64) for column in zip(*bins, strict=True))
    axes.plot(p, share, color=colour, lw=1.2)
    axes.scatter(p, share, s=12.0 + 90.0 * np.sqrt(count / count.max()), color=colour, label=label, zorder=3)


def draw_false_changes(content: Mapping[str, Any]) -> Figure:
    """Per cent of the changes told that are about things that never changed, and that are false, by patrol."""
    groups = {name: worlds for name, worlds in by_patrol(content).items() if name != PLAIN}
    with house_style():
        figure = new_figure(7.2, 3.2)
        panels = figure.subplots(1, 2, sharex=True)
        at = np.arange(len(groups))
        for axes, key, title in zip(
            panels, ("never", "false"), ("about what never changed [%]", "false in the interval told [%]"), strict=True
        ):
            before = [100.0 * BEFORE["by_patrol"].get(name, {}).get(key, np.nan) for name in groups]
            numbers = [summary(worlds) for worlds in groups.values()]
            now = [100.0 * s[key] / max(s["told"], 1) for s in numbers]
            axes.bar(at - 0.2, before, 0.38, color=ALERT, label="first edition")
            bars = axes.bar(at + 0.2, now, 0.38, color=ESTIMATE, label="evermap")
            axes.bar_label(bars, [f"{value:.1f}" for value in now], size=7, padding=1)
            axes.set(title=title, xticks=at, xticklabels=list(groups), xlabel="patrols")
        panels[0].legend(loc="upper right")
        settle(figure)
    return figure
