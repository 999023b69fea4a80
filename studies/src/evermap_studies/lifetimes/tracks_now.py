"""What a tracker believes at one instant, as in the thesis' Fig. 5.3."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import BoolArray, FloatArray
from evermap.viz.style import DYNAMIC, INK, MUTED, SHADE, STATIC

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
