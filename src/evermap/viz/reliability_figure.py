"""Whether probabilities mean what they say: belief against how often it was true, and how many beliefs there were."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.metrics.belief import BeliefScores, Reliability
from evermap.viz.style import ESTIMATE, ESTIMATE_BAND, MUTED, house_style, new_figure, settle

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_reliability(bins: Reliability, scores: BeliefScores, *, title: str | None = None) -> Figure:
    """Figure of the share of truth in each bin of belief, above the count of each bin on a logarithmic scale.

    Args:
        bins: `reliability(...)`.
        scores: of the same beliefs, written beside it.
        title: above the axes.
    """
    with house_style():
        figure = new_figure(4.6, 4.6)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 1.0))
        filled = bins.count > 0
        above.plot([0.0, 1.0], [0.0, 1.0], color=MUTED, lw=0.9, ls="--", zorder=2, label="calibrated")
        size = 20.0 + 100.0 * np.sqrt(bins.count[filled] / bins.count.max())
        above.plot(bins.belief[filled], bins.present[filled], color=ESTIMATE, lw=1.2, zorder=3)
        above.scatter(
            bins.belief[filled], bins.present[filled], s=size, color=ESTIMATE, zorder=4, label="bin of beliefs"
        )
        above.set(xlim=(-0.03, 1.03), ylim=(-0.06, 1.06), ylabel="truly there [1]")
        numbers = {
            "Brier": scores.brier,
            "log loss": scores.log_loss,
            "calibration error": scores.calibration_error,
        }
        above.text(
            0.97,
            0.05,
            "\n".join(f"{name} {value:.4f}" for name, value in numbers.items()),
            transform=above.transAxes,
            ha="right",
            va="bottom",
            size=8,
        )
        above.legend(loc="upper left", markerscale=0.6)
        if title:
            above.set_title(title)
        width = np.diff(bins.edge)
        below.bar(bins.edge[:-1], bins.count, width=width, align="edge", color=ESTIMATE_BAND, ec=ESTIMATE, lw=0.7)
        below.set(xlabel="P(exists) [1]", ylabel="beliefs", yscale="log", ylim=(0.5, 2.5 * bins.count.max()))
        settle(figure)
    return figure
