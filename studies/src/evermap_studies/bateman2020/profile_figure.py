"""What a sensor turned out to be: detection by range and by incidence, before and after (sensing.profile)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evermap.types import FloatArray
from evermap.viz.style import ESTIMATE, INK, MUTED

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class RateCurve:
    """Detection by one cause.

    Attributes:
        at: (N,) where it was estimated.
        assumed: (N,) before anything was seen.
        learned: (N,) after it.
        hits: (N,) expected hits behind each; its standard deviation is `learned / sqrt(hits)`.
        true_at, true: (M,) the truth, where it is known.
        label: of the axis.
    """

    at: FloatArray
    assumed: FloatArray
    learned: FloatArray
    hits: FloatArray
    true_at: FloatArray
    true: FloatArray
    label: str


def draw_profile(figure: Figure, curves: list[RateCurve]) -> None:
    """A panel a curve, the band at two standard deviations. Call in `house_style`."""
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for axes, curve in zip(panels, curves, strict=True):
        sigma = curve.learned / np.sqrt(np.maximum(curve.hits, 1e-9))
        low, high = np.clip(curve.learned - 2 * sigma, 0, 1), np.clip(curve.learned + 2 * sigma, 0, 1)
        axes.fill_between(curve.at, low, high, color=ESTIMATE, alpha=0.25, lw=0, label="learned, 2σ")
        axes.plot(curve.at, np.clip(curve.learned, 0, 1), color=ESTIMATE, marker="o", ms=3, lw=1.2, label="learned")
        axes.plot(curve.at, curve.assumed, color=MUTED, ls="--", lw=1.2, label="assumed before")
        axes.plot(curve.true_at, curve.true, color=INK, lw=1.2, label="true")
        axes.set(xlabel=curve.label, ylim=(-0.03, 1.05))
    panels[0].set_ylabel("detected, if there [1]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
