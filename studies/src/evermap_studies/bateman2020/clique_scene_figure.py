"""Objects with landmarks all over them and a sensor that passes by, in space (Bateman 2020, Fig. 5.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray
from evermap.viz.style import ALERT, ESTIMATE, ESTIMATE_BAND, GRID, GROUP, INK, LANDMARK, MUTED, ODOMETRY, ONLINE, PAPER

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.axes3d import Axes3D

CLIQUE_COLOURS = (ESTIMATE, ODOMETRY, LANDMARK, ONLINE, GROUP)
"""In turn; the sixth clique looks like the first."""
DISC_M = 0.22
"""Radius that a landmark is drawn with."""
FRAMES = 16
"""Sensor frames drawn along the path."""
AXIS_M = 1.0
"""Length of a frame's forward axis; the others are half as long."""


def draw_clique_scene(
    figure: Figure,
    path_m: FloatArray,
    rotation: FloatArray,
    landmark_m: FloatArray,
    normal: FloatArray,
    clique: IntArray,
    *,
    step: int,
    detected: BoolArray,
    field_outline_m: FloatArray,
) -> None:
    """Trajectory with sensor frames, cliques by colour, and what the sensor sees in one step. Call in `house_style`.

    A landmark is a disc that faces along its normal: filled where it faces the sensor of that step, else hollow.

    Args:
        figure: empty; gets one pair of axes in space.
        path_m: (F, 3) of the sensor, for one period.
        rotation: (F, 3, 3) from the sensor's frame to the world's.
        landmark_m: (K, 3).
        normal: (K, 3) unit vectors.
        clique: (K,) which clique each landmark belongs to.
        step: row of `path_m` at which the sensor is shown.
        detected: (K,) landmarks detected in that step; a line goes to each.
        field_outline_m: (N, P, 3) lines in the sensor's frame, see `worlds.sensors.outline`.
    """
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    axes: Axes3D = figure.add_subplot(projection="3d", computed_zorder=False)
    sensor = path_m[step]
    _draw_field(axes, field_outline_m @ rotation[step].T + sensor)
    axes.plot(*path_m.T, color=INK, lw=1.2, zorder=3, label="trajectory")
    _draw_frames(axes, path_m, rotation)
    _draw_landmarks(axes, landmark_m, normal, clique, sensor)
    rays = np.stack([np.broadcast_to(sensor, landmark_m[detected].shape), landmark_m[detected]], axis=1)
    if len(rays):
        axes.add_collection3d(Line3DCollection(rays, colors=ALERT, linewidths=0.7, zorder=5))
    ring: Any = {"mfc": "none", "mec": ALERT, "mew": 1.3, "ms": 8.0, "ls": "none", "zorder": 6}
    axes.plot(*landmark_m[detected].T, "o", label="detected in this step", **ring)
    axes.plot(*sensor[:, None], "o", color=INK, ms=5.0, ls="none", zorder=7, label="sensor, its field cut off")
    _settle_axes(axes, np.concatenate([path_m, landmark_m]))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, columnspacing=1.4)


def _draw_field(axes: Axes3D, outline_m: FloatArray) -> None:
    """Lines, and the surface between the lower and the upper edge."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    low, high = outline_m[:2]
    strip = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    surface = Poly3DCollection(strip, facecolors=ESTIMATE_BAND, edgecolors="none", alpha=0.35, zorder=1)
    axes.add_collection3d(surface)
    axes.add_collection3d(Line3DCollection(outline_m, colors=MUTED, linewidths=0.6, alpha=0.8, zorder=2))


def _draw_frames(axes: Axes3D, path_m: FloatArray, rotation: FloatArray) -> None:
    """The forward axis in ink, the two others muted."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    rows = np.linspace(0, len(path_m), FRAMES, endpoint=False).astype(np.int64)
    for k, (colour, length_m) in enumerate([(INK, AXIS_M), (MUTED, AXIS_M / 2), (MUTED, AXIS_M / 2)]):
        ends = path_m[rows] + length_m * rotation[rows, :, k]
        lines = Line3DCollection(np.stack([path_m[rows], ends], axis=1), colors=colour, linewidths=1.4, zorder=3)
        axes.add_collection3d(lines)


def _draw_landmarks(
    axes: Axes3D, landmark_m: FloatArray, normal: FloatArray, clique: IntArray, sensor_m: FloatArray
) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    outlines = discs(landmark_m, normal)
    facing = ((sensor_m - landmark_m) * normal).sum(axis=1) > 0.0
    for c in np.unique(clique):
        colour = CLIQUE_COLOURS[c % len(CLIQUE_COLOURS)]
        for towards in (False, True):
            mine = (clique == c) & (facing == towards)
            if mine.any():
                face = colour if towards else PAPER
                marks = Poly3DCollection(outlines[mine], facecolors=face, edgecolors=colour, linewidths=0.8, zorder=4)
                axes.add_collection3d(marks)
        axes.plot([], [], [], "o", color=colour, ls="none", label=f"clique {c}")


def discs(centre_m: FloatArray, normal: FloatArray) -> FloatArray:
    """(K, 16, 3) outlines of discs about the centres, across the normals."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    angle = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)[:, None]
    round_m = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
    return np.asarray(centre_m[:, None] + DISC_M * round_m)


def _settle_axes(axes: Axes3D, shown_m: FloatArray) -> None:
    """One scale for the three axes, quiet panes."""
    from matplotlib.ticker import MaxNLocator

    low, high = shown_m.min(axis=0), shown_m.max(axis=0)
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_zlabel("z [m]", labelpad=-1.0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.05)
    axes.view_init(elev=38.0, azim=-60.0)
    for axis, bins in ((axes.xaxis, 6), (axes.yaxis, 6), (axes.zaxis, 2)):
        axis.set_major_locator(MaxNLocator(bins, integer=True))
        axis.set_pane_color((0.0, 0.0, 0.0, 0.0))
        axis.line.set_color(GRID)
