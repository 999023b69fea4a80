"""What the recording taught about the sensor: prior and posterior of every calibration state."""

from __future__ import annotations

import math

import numpy as np

from evermap.types import ParameterEstimate, SlamResult
from evermap.viz.style import ESTIMATE, GRID, INK, MUTED, NamedFigure, new_figure


def quantity(value: float, sigma: float, unit: str) -> str:
    """`0.2104 ± 0.0038 s`: two digits of the uncertainty decide how many the value gets."""
    suffix = "" if unit == "1" else f" {unit.replace('^2', '²')}"
    if not math.isfinite(sigma) or sigma <= 0:
        return f"{value:.4g}{suffix}".replace("-", "\N{MINUS SIGN}", 1)
    decimals = int(np.clip(1 - math.floor(math.log10(sigma)), 0, 9))
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}{suffix}".replace("-", "\N{MINUS SIGN}", 1)


def has_prior(parameter: ParameterEstimate) -> bool:
    """Whether it was estimated against a finite prior."""
    return not parameter.fixed and math.isfinite(parameter.prior_mean) and 0 < parameter.prior_sigma < math.inf


def draw_calibration(result: SlamResult) -> NamedFigure | None:
    """Estimates in units of their prior's standard deviation, numbers beside them; None without any prior."""
    shown = [parameter for parameter in result.parameters if has_prior(parameter)]
    if not shown:
        return None
    figure = new_figure(7.2, 0.9 + 0.34 * len(shown))
    axes = figure.add_subplot()
    rows = np.arange(len(shown))[::-1]
    shift = np.array([(p.value - p.prior_mean) / p.prior_sigma for p in shown])
    spread = np.array([p.sigma / p.prior_sigma for p in shown])
    axes.barh(rows, 4.0, left=-2.0, height=0.62, color=GRID, alpha=0.6, lw=0, label="prior, 2σ", zorder=1)
    axes.axvline(0, color=MUTED, lw=0.8, zorder=2)
    axes.errorbar(
        shift, rows, xerr=2 * spread, fmt="o", color=ESTIMATE, ms=4.5, capsize=3, lw=1.6, label="estimate, 2σ", zorder=3
    )
    reach = max(2.6, 1.1 * float(np.max(np.abs(shift) + 2 * spread)))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(rows, [p.name for p in shown])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("distance from the prior mean [prior standard deviations]")
    for row, parameter in zip(rows, shown, strict=True):
        axes.text(
            1.02,
            row,
            quantity(parameter.value, parameter.sigma, parameter.unit),
            transform=axes.get_yaxis_transform(),
            va="center",
            size=8,
            color=INK,
        )
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    caption = (
        "Calibration states as the recording determined them, in units of what was assumed: a short bar well inside"
        " the grey one was learned from the data; a bar as long as the grey one could not be observed."
    )
    return NamedFigure("calibration", figure, "Calibration", caption)
