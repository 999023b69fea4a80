"""Learned lifetimes of every class over the true ones."""

from __future__ import annotations

from collections.abc import Sequence

from evermap.viz.style import INK, NamedFigure, class_looks, house_style, new_figure, settle
from evermap_studies.demo.lifetimes import LearnedLife


def draw_lifetimes(lives: Sequence[LearnedLife]) -> NamedFigure:
    """One small panel a class."""
    with house_style():
        columns = 3
        rows = -(-len(lives) // columns)
        figure = new_figure(7.2, 1.9 * rows + 0.3)
        panels = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
        looks = class_looks(life.name for life in lives)
        for axes, life in zip(panels, lives, strict=False):
            colour = looks[life.name].colour
            axes.fill_between(life.age_days, life.low, life.high, color=colour, alpha=0.18, lw=0)
            axes.plot(life.age_days, life.mean, color=colour, lw=1.8, label="learned")
            axes.plot(life.age_days, life.truth, color=INK, lw=1.2, ls="--", label="truth")
            axes.set_title(f"{life.name}: {life.n_ended} of {life.n_stays} stays ended")
            axes.set_xlim(0.0, life.age_days[-1])
            axes.set_ylim(0.0, 1.03)
        for axes in panels[len(lives) :]:
            axes.set_axis_off()
        for axes in panels[::columns]:
            axes.set_ylabel("still there")
        for axes in panels[max(0, len(lives) - columns) : len(lives)]:
            axes.set_xlabel("days")
        panels[0].legend(loc="lower left")
        settle(figure)
    caption = (
        "Share of things that stay at least so long at one place: learned from nothing but this map's own history, with"
        " the 95 % interval, and what the simulation drew from (dashed)."
    )
    return NamedFigure("demo_lifetimes", figure, "How long things stay", caption)
