"""A living map from above: what is believed to be there, what is gone, and where things stood before."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.errors import InputError, printable
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    LANDMARK,
    MUTED,
    ODOMETRY,
    ONLINE,
    PAPER,
    house_style,
    legend_name,
    new_figure,
    settle,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLOURS = (LANDMARK, ESTIMATE, ODOMETRY, GROUP, ONLINE)
_MARKERS = ("o", "s", "^", "D")
_MAX_LABELS = 60


def plot_living_map(
    landmark_id: IntArray,
    place: IntArray,
    p_exists: FloatArray,
    class_id: IntArray,
    class_names: tuple[str, ...],
    pinned: BoolArray,
    deleted: BoolArray,
    position_m: FloatArray,
    place_landmark: IntArray,
    *,
    title: str,
) -> Figure:
    """Landmarks at their most probable places, the fainter the less they exist; their other places as small dots.

    Args:
        landmark_id: (L,) sorted.
        place: (L,) row of the place of each, -1 for none.
        p_exists: (L,) probability.
        class_id: (L,) class, or `UNKNOWN`.
        class_names: names of the classes, for the legend.
        pinned: (L,) marked by a ring.
        deleted: (L,) left out.
        position_m: (P, 2) of all places.
        place_landmark: (P,) whose place each is.
        title: above the axes.

    Raises:
        InputError: there is nothing to draw.
    """
    shown = np.flatnonzero((place >= 0) & ~deleted)
    if not len(shown):
        raise InputError("nothing to draw: the map has no landmark")
    at = position_m[place[shown]]
    low, high = position_m.min(axis=0), position_m.max(axis=0)
    size = np.maximum(high - low, 1.0)
    with house_style():
        figure = new_figure(7.2, float(np.clip(6.4 * size[1] / size[0], 2.4, 7.5)) + 1.0)
        axes = figure.add_subplot()
        earlier = ~np.isin(np.arange(len(position_m)), place[shown]) & np.isin(place_landmark, landmark_id[shown])
        for row in np.flatnonzero(earlier):
            now = at[np.searchsorted(landmark_id[shown], place_landmark[row])]
            axes.plot(*np.stack([position_m[row], now]).T, color=MUTED, lw=0.5, alpha=0.5, zorder=1)
        if earlier.any():
            axes.plot(*position_m[earlier].T, ".", color=MUTED, ms=4, zorder=2, label="other known place")
        there = p_exists[shown] >= 0.5
        for k, name in enumerate(np.unique(class_id[shown])):
            label = legend_name(class_names[name]) if 0 <= name < len(class_names) else "class not known"
            colour = INK if name == UNKNOWN else _COLOURS[k % len(_COLOURS)]
            mine = (class_id[shown] == name) & there
            if mine.any():
                alpha = np.clip(p_exists[shown][mine], 0.25, 1.0)
                x, y = at[mine].T
                shape = _MARKERS[k // len(_COLOURS) % len(_MARKERS)]
                axes.scatter(x, y, s=34, color=colour, marker=shape, alpha=alpha, lw=0, zorder=4, label=label)
        if not there.all():
            axes.plot(*at[~there].T, "x", color=ALERT, ms=5, mew=1.1, zorder=3, label="believed gone")
        if pinned[shown].any():
            axes.plot(*at[pinned[shown]].T, "o", mfc="none", mec=INK, ms=10, mew=1.0, zorder=5, label="pinned")
        if len(shown) <= _MAX_LABELS:
            for point, name in zip(at, landmark_id[shown], strict=True):
                axes.annotate(
                    str(name), point, xytext=(5, 4), textcoords="offset points", fontsize=7.5, color=INK, zorder=6,
                    bbox={"facecolor": PAPER, "alpha": 0.6, "edgecolor": "none", "pad": 0.5},
                )  # fmt: skip
        margin = 0.06 * float(size.max())
        axes.set(
            xlim=(low[0] - margin, high[0] + margin),
            ylim=(low[1] - margin, high[1] + margin),
            aspect="equal",
            xlabel="x [m]",
            ylabel="y [m]",
            title=printable(title),
        )
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        settle(figure)
    return figure
