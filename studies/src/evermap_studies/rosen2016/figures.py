"""Figures 3 and 4 of Rosen 2016, with the reference numbers as points, and how far all numbers are from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    INK,
    MUTED,
    ODOMETRY,
    house_style,
    new_figure,
    settle,
)
from evermap_studies.frame import save_all
from evermap_studies.rosen2016.examples import draw_belief_example, draw_prior_example
from evermap_studies.rosen2016.table import LIMIT, NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from evermap_studies.rosen2016.study import Settings, Value

_CONTOUR = 0.025
"""Distance of the lines of equal error."""
_COLOURS = {"uniform": ESTIMATE, "general_purpose": ODOMETRY, "empirical": ALERT}


def draw_all(settings: Settings, values: Sequence[Value], path: Callable[[str], Path]) -> None:
    """Write all figures as PNG and SVG.

    Args:
        settings: of the experiment.
        values: of figures 3 and 4; those that were compared have a `reference`.
        path: where to write the file of a name.
    """
    figures = {
        "fig1-belief": draw_belief_example(settings),
        "fig2-priors": draw_prior_example(),
        "fig3-error": _draw_errors(values),
        "fig4-removal": _draw_removal(values),
    }
    if any(value.get("z") is not None for value in values):
        figures["agreement"] = _draw_agreement(values)
    save_all(figures, path)


def _draw_errors(values: Sequence[Value]) -> Figure:
    """Maps of the error over P_M and P_F on one scale of colours, and its course over the revisit rate."""
    maps = {name: _as_map(values, name) for name in _COLOURS}
    bounds = np.arange(0.0, max(float(errors.max()) for _, errors in maps.values()) + _CONTOUR, _CONTOUR)
    with house_style():
        figure = new_figure(7.2, 5.6)
        parts: Any = figure.subfigures(2, 1, height_ratios=(1.1, 1.0))
        above, below = parts
        above.suptitle(
            "axes are as labelled; the published plots have P_M and P_F exchanged", x=0.01, ha="left", size=8
        )
        panels = above.subplots(1, 3, sharex=True, sharey=True)
        for letter, axes, (name, (levels, errors)) in zip("abc", panels, maps.items(), strict=True):
            filled = axes.contourf(levels, levels, errors.T, levels=bounds, cmap="cividis")
            lines = axes.contour(levels, levels, errors.T, levels=bounds, colors="white", linewidths=0.6)
            axes.clabel(lines, lines.levels[::2], fmt="%.2f", fontsize=8)
            axes.set_title(f"({letter}) {NAMES[name].removeprefix('filter, ')}")
            axes.set(xlabel="P_M, missed detections [1]", aspect="equal")
            axes.grid(visible=False)
        panels[0].set_ylabel("P_F, false alarms [1]")
        bar = above.colorbar(filled, ax=panels, shrink=0.75, pad=0.01, ticks=bounds[::4])
        bar.set_label("mean L1 error [1]")

        axes = below.subplots()
        _draw_over(axes, [value for value in values if value["figure"] == "3d"], "revisit_rate_hz", list(_COLOURS))
        axes.set_xscale("log")
        axes.set_title("(d) over the revisit rate, P_M = P_F = 0.1")
        axes.set(xlabel="λ_R [1/s]", ylabel="mean L1 error [1]", ylim=(0.0, None))
        axes.legend(loc="upper right")
        settle(figure)
    return figure


def _as_map(values: Sequence[Value], estimator: str) -> tuple[Any, Any]:
    """The values of P_M (and of P_F), and the errors, P_M by P_F."""
    rows = [value for value in values if value["figure"] == "3abc" and value["estimator"] == estimator]
    levels = sorted({value["p_miss"] for value in rows})
    errors = np.full((len(levels), len(levels)), np.nan)
    for value in rows:
        errors[levels.index(value["p_miss"]), levels.index(value["p_false"])] = value["value"]
    return levels, errors


def _draw_removal(values: Sequence[Value]) -> Figure:
    with house_style():
        figure = new_figure(7.2, 3.4)
        panels = figure.subplots(1, 2, sharex=True)
        for letter, metric, axes in zip("ab", ("precision", "recall"), panels, strict=True):
            rows = [value for value in values if value["figure"] == "4" and value["metric"] == metric]
            _draw_over(axes, rows, "threshold", ["uniform", "general_purpose"])
            empirical = next(value for value in rows if value["estimator"] == "empirical")
            axes.axhline(empirical["value"], color=ALERT, label=NAMES["empirical"])
            _draw_reference(axes, [empirical], lambda _: 0.52, ALERT)
            axes.set_title(f"({letter}) {metric} of removal")
            axes.set(xlabel="removal threshold P_V [1]", ylabel=f"mean {metric} [1]")
        handles, labels = panels[0].get_legend_handles_labels()
        unique = dict(zip(labels, handles, strict=True))
        figure.legend(unique.values(), unique.keys(), loc="outside lower center", ncols=2)
        settle(figure)
    return figure


def _draw_over(axes: Axes, values: Sequence[Value], setting: str, estimators: Sequence[str]) -> None:
    """A line an estimator over a setting, and the reference as points."""
    for name in estimators:
        rows = sorted((value for value in values if value["estimator"] == name), key=lambda value: value[setting])
        x = [value[setting] for value in rows]
        axes.plot(x, [value["value"] for value in rows], color=_COLOURS[name], label=NAMES[name])
        _draw_reference(axes, rows, lambda value: value[setting], _COLOURS[name])
    if any(value.get("reference") is not None for value in values):
        axes.errorbar([], [], yerr=[], fmt="o", ms=3, color=INK, lw=0.9, label="reference ± 3 standard errors")


def _draw_reference(axes: Axes, rows: Sequence[Value], place: Callable[[Value], float], colour: str) -> None:
    known = [value for value in rows if value.get("reference_se") is not None]
    if known:
        axes.errorbar(
            [place(value) for value in known],
            [value["reference"] for value in known],
            yerr=[LIMIT * value["reference_se"] for value in known],
            fmt="o",
            ms=3,
            color=colour,
            lw=0.9,
        )


def _draw_agreement(values: Sequence[Value]) -> Figure:
    """Histogram of z against the normal distribution."""
    z = np.array([value["z"] for value in values if value.get("z") is not None])
    edges = np.arange(-4.5, 4.75, 0.25)
    with house_style():
        figure = new_figure(7.2, 2.7)
        axes = figure.add_subplot()
        label = f"{len(z)} values"
        axes.hist(np.clip(z, edges[0], edges[-1]), edges.tolist(), color=ESTIMATE, alpha=0.55, label=label)
        middle = np.linspace(edges[0], edges[-1], 200)
        normal = len(z) * 0.25 * np.exp(-0.5 * middle**2) / np.sqrt(2.0 * np.pi)
        axes.plot(middle, normal, color=INK, label="normal distribution")
        for limit in (-LIMIT, LIMIT):
            axes.axvline(limit, color=MUTED, lw=0.9, ls="--")
        axes.set(xlabel="(ours - reference) / standard error of the difference [1]", ylabel="values [1]")
        axes.set_xlim(edges[0], edges[-1])
        axes.legend(loc="upper right")
        settle(figure)
    return figure
