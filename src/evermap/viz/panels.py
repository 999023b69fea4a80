"""Panels of a map: from above, and in space from the side as well, at one scale; how landmarks look in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se3
from evermap.geometry.upright import level_pose
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks, Up
from evermap.viz.style import MUTED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec
    from matplotlib.lines import Line2D

BLIND_S = 5.0
"""Minimum gap that is shown as a gap."""

UP_UNKNOWN = "up unknown: along the map's z"
"""Title in place of 'from above'."""

View = list[int]
"""The two coordinates of a panel: to the right, and upwards."""
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = np.array([[i, i | bit] for bit in (1, 2, 4) for i in range(8) if not i & bit])
_TINY = 0.004
"""Length of a box, as a share of the figure, up to which it is drawn as a mark."""
_NORMAL = 0.04
"""Length of the line along a tag's normal, as a share of the figure."""


def long_gaps(stamp_s: FloatArray) -> IntArray:
    """Return the rows after which nothing is known for longer than usual, and for longer than `BLIND_S`."""
    step_s = np.diff(stamp_s)
    usual_s = float(np.median(step_s)) if len(step_s) else 0.0
    return np.flatnonzero(step_s > max(BLIND_S, 5.0 * usual_s))


def with_breaks(stamp_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return stamps and values (N,) or (N, D) with a row of nan in every long gap, so that a line does not cross it."""
    at = long_gaps(stamp_s) + 1
    return np.insert(stamp_s, at, stamp_s[at] - 1e-3), np.insert(values, at, np.nan, axis=0)


def height_over_width(size: FloatArray) -> float:
    """Return the height of all panels, one below the other, over their width, for a picture of `size` (2,) or (3,)."""
    views = _views(size)
    return float(sum(size[up] for _, up in views) / max(size[right] for right, _ in views))


def lay_out(
    figure: Figure,
    low: FloatArray,
    high: FloatArray,
    within: SubplotSpec | None = None,
    up: Up | None = None,
) -> list[tuple[Axes, View]]:
    """Add the panels for what lies between the corners `low` and `high`: (2,), in space (3,).

    From the side one looks along the shorter of x and y, so that the longer one is seen. `within` is the place for all
    of them, where they are not the only ones of the figure. `up` is of the map before it was levelled (`level_pose`);
    None where that is not asked.
    """
    size = high - low
    level = up is not None and level_pose(up)[:6].any()
    axis_names = [f"{axis}, levelled [m]" if level else f"{axis} [m]" for axis in "xyz"]
    views = _views(size)
    width = max(size[right] for right, _ in views)
    heights: Any = {"nrows": len(views), "ncols": 1, "height_ratios": [size[up] for _, up in views]}
    grid = figure.add_gridspec(**heights) if within is None else within.subgridspec(**heights)
    rows = [figure.add_subplot(grid[k, 0]) for k in range(len(views))]
    for axes, (right, upward) in zip(rows, views, strict=True):
        spare = 0.5 * (width - size[right])
        axes.set(
            xlim=(low[right] - spare, high[right] + spare), ylim=(low[upward], high[upward]), aspect="equal",
            xlabel=axis_names[right], ylabel=axis_names[upward],
        )  # fmt: skip
    unknown = up is None or not up.is_known
    if len(views) > 1:
        titles = (UP_UNKNOWN, "across it") if unknown else ("from above", "from the side")
        for axes, title in zip(rows, titles, strict=True):
            axes.set_title(title)
    elif unknown and up is not None:
        rows[0].set_title(UP_UNKNOWN)
    return list(zip(rows, views, strict=True))


def corners_of(parts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the corners of all finite points (N, D), with a margin; about the origin where there is none."""
    finite = [part[np.all(np.isfinite(part), axis=1)] for part in parts if len(part)]
    everything = np.concatenate([part for part in finite if len(part)] or [np.zeros((1, parts[0].shape[1]))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    reach = float(np.max(high - low))
    margin = max(0.06 * reach, min(0.5, 0.25 * reach) or 0.5)  # half a metre, less about what stands on a table
    return low - margin, high + margin


def _views(size: FloatArray) -> Sequence[View]:
    return [[0, 1]] if len(size) == 2 else [[0, 1], [int(np.argmax(size[:2])), 2]]


def seen(landmarks: Landmarks, view: View) -> Landmarks:
    """Return a map as a panel shows it: two coordinates of places and covariances."""
    if not len(landmarks):
        return replace(landmarks, position_m=np.zeros((0, 2)), covariance_m2=np.zeros((0, 2, 2)))
    covariance = landmarks.covariance_m2[:, view][:, :, view]
    return replace(landmarks, position_m=landmarks.position_m[:, view], covariance_m2=covariance)


def draw_shapes(
    axes: Axes, landmarks: Landmarks, view: View, colours: Any, reach_m: float, path_m: FloatArray | None = None
) -> None:
    """Draw boxes by their edges, and where the other landmarks that have an orientation face: along their z.

    Args:
        axes: a panel.
        landmarks: in space; those without an orientation have no shape.
        view: of the panel.
        colours: (L,).
        reach_m: size of the picture.
        path_m: (N, 3) from where they were seen; then all face towards it, whichever way their z points.
    """
    from matplotlib.collections import LineCollection

    if landmarks.rotation is None:
        return
    oriented = np.isfinite(landmarks.rotation).all(axis=1)
    sized = boxes(landmarks)
    lines = [*box_edges(landmarks, sized)[..., view].reshape(-1, 2, 2)]
    looks = [colour for colour, box in zip(colours, sized, strict=True) if box for _ in _EDGES]
    for row in np.flatnonzero(oriented & ~sized):
        start, normal = landmarks.position_m[row], se3.rotation_of(landmark_poses(landmarks)[row])[:, 2]
        if path_m is not None and len(path_m):
            nearest = path_m[np.nanargmin(np.sum((path_m - start) ** 2, axis=1))]
            normal = normal * (-1.0 if (nearest - start) @ normal < 0.0 else 1.0)
        lines.append(np.stack([start, start + _NORMAL * reach_m * normal])[:, view])
        looks.append(colours[row])
    axes.add_collection(LineCollection(lines, colors=looks, linewidths=1.1, zorder=5.5))


def boxes(landmarks: Landmarks) -> BoolArray:
    """Return (L,) which landmarks have a size and an orientation."""
    if landmarks.rotation is None:
        return np.zeros(len(landmarks), dtype=np.bool_)
    return np.asarray(np.isfinite(np.column_stack([landmarks.rotation, box_sizes(landmarks)])).all(axis=1))


def mostly_boxes(landmarks: Landmarks) -> bool:
    """Judge whether most landmarks are boxes: a street, drawn by outlines, from above alone."""
    return 2 * int(np.count_nonzero(boxes(landmarks))) > len(landmarks)


def is_outlined(landmarks: Landmarks, reach_m: float) -> BoolArray:
    """Return (L,) which landmarks of a street are large enough in the picture to be told by their outlines."""
    return np.asarray(mostly_boxes(landmarks) & (box_sizes(landmarks)[:, 0] > _TINY * reach_m))


def box_sizes(landmarks: Landmarks) -> FloatArray:
    """Return the sizes (L, 3) of boxes, nan of all else."""
    return np.full((len(landmarks), 3), np.nan) if landmarks.size_m is None else landmarks.size_m


def box_edges(landmarks: Landmarks, rows: BoolArray) -> FloatArray:
    """Return the ends (K, 12, 2, 3) of the edges of the boxes in some rows."""
    corners = se3.transform(landmark_poses(landmarks)[rows][:, None], _CORNERS * box_sizes(landmarks)[rows][:, None])
    return corners[:, _EDGES]


def footprints(landmarks: Landmarks, rows: BoolArray) -> FloatArray:
    """Return the corners (K, 4, 2) of the boxes in some rows from above, in order."""
    around = _CORNERS[[0, 2, 6, 4]] * box_sizes(landmarks)[rows][:, None]
    return se3.transform(landmark_poses(landmarks)[rows][:, None], around)[..., :2]


def draw_footprints(axes: Axes, landmarks: Landmarks, colours: Any) -> Line2D:
    """Draw boxes from above, the fuller the more probable it is that they exist; returns the mark of the legend."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba
    from matplotlib.lines import Line2D

    rows = boxes(landmarks)
    corners = list(footprints(landmarks, rows))
    faces = [to_rgba(colour, 0.75 * p) for colour, p in zip(colours[rows], landmarks.p_exists[rows], strict=True)]
    axes.add_collection(PolyCollection(corners, facecolors=faces, edgecolors=colours[rows], linewidths=0.6, zorder=5.5))
    return Line2D([], [], ls="", marker="s", mfc="none", mec=MUTED, ms=6, label="box, filled by P(exists)")


def landmark_poses(landmarks: Landmarks) -> FloatArray:
    """Return poses (L, 7) of landmarks in space, nan where there is no orientation."""
    rotation = np.full((len(landmarks), 4), np.nan) if landmarks.rotation is None else landmarks.rotation
    return np.column_stack([landmarks.position_m, rotation])
