"""Boxes that stand upright in space: the overlap of two of them, exactly.

A box is a row of seven numbers: centre `x, y, z`, `length, width, height`, and the heading of its length in the plane.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.tracking.kalman import inlined, kernel
from evermap.types import FloatArray

MOST_CORNERS = 16
"""A rectangle cut by four lines has at most eight corners; rounding may leave a few more."""


@inlined
def corners(box: FloatArray, out: FloatArray) -> None:
    """Fill `out` (4, 2) with the corners from above, anticlockwise."""
    c, s = math.cos(box[6]), math.sin(box[6])
    for k in range(4):
        along = 0.5 * box[3] if k in (0, 3) else -0.5 * box[3]
        across = 0.5 * box[4] if k in (0, 1) else -0.5 * box[4]
        out[k, 0] = box[0] + c * along - s * across
        out[k, 1] = box[1] + s * along + c * across


@inlined
def area_of(polygon: FloatArray, n: int) -> float:
    """Return the area of a polygon of `n` corners, anticlockwise."""
    twice = 0.0
    for k in range(n):
        m = k + 1 if k + 1 < n else 0
        x, y = polygon[k, 0] - polygon[0, 0], polygon[k, 1] - polygon[0, 1]
        twice += x * (polygon[m, 1] - polygon[0, 1]) - y * (polygon[m, 0] - polygon[0, 0])
    return 0.5 * twice


@kernel
def shared_area(a: FloatArray, b: FloatArray) -> float:
    """Return the area [m^2] that two boxes share from above: one rectangle cut by the sides of the other."""
    if math.hypot(a[0] - b[0], a[1] - b[1]) >= 0.5 * (math.hypot(a[3], a[4]) + math.hypot(b[3], b[4])):
        return 0.0
    polygon, cut, sides = np.empty((MOST_CORNERS, 2)), np.empty((MOST_CORNERS, 2)), np.empty((4, 2))
    corners(a, polygon)
    corners(b, sides)
    n = 4
    for k in range(4):
        x, y = sides[k, 0], sides[k, 1]
        dx, dy = sides[(k + 1) % 4, 0] - x, sides[(k + 1) % 4, 1] - y
        n_cut = 0
        for i in range(n):
            j = i + 1 if i + 1 < n else 0
            here = dx * (polygon[i, 1] - y) - dy * (polygon[i, 0] - x)
            there = dx * (polygon[j, 1] - y) - dy * (polygon[j, 0] - x)
            if here >= 0.0 and n_cut < MOST_CORNERS:
                cut[n_cut] = polygon[i]
                n_cut += 1
            if (here >= 0.0) != (there >= 0.0) and n_cut < MOST_CORNERS:
                share = here / (here - there)
                cut[n_cut, 0] = polygon[i, 0] + share * (polygon[j, 0] - polygon[i, 0])
                cut[n_cut, 1] = polygon[i, 1] + share * (polygon[j, 1] - polygon[i, 1])
                n_cut += 1
        n = n_cut
        if n < 3:
            return 0.0
        polygon[:n] = cut[:n]
    return max(area_of(polygon, n), 0.0)


@kernel
def overlap(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return (N, M) intersection over union of boxes (N, 7) and (M, 7), in space."""
    found = np.zeros((a.shape[0], b.shape[0]))
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            tall = min(a[i, 2] + 0.5 * a[i, 5], b[j, 2] + 0.5 * b[j, 5])
            tall -= max(a[i, 2] - 0.5 * a[i, 5], b[j, 2] - 0.5 * b[j, 5])
            if tall <= 0.0:
                continue
            common = tall * shared_area(a[i], b[j])
            both = a[i, 3] * a[i, 4] * a[i, 5] + b[j, 3] * b[j, 4] * b[j, 5] - common
            found[i, j] = common / both if both > 0.0 else 0.0
    return found
