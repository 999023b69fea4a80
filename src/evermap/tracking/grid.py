"""A spatial hash of a frame's detections: which of them lie in a box."""

from __future__ import annotations

import math

import numpy as np

from evermap.tracking.kernels import inlined, kernel
from evermap.types import FloatArray, IntArray

FAR = 2.0**40
"""Cells are counted to here from the origin, so that they are whole numbers however small a cell is."""


@inlined
def cell_of(value: float, cell_m: float) -> int:
    """Cell along one axis."""
    return math.floor(min(max(value / cell_m, -FAR), FAR))


@inlined
def bucket_of(x: int, y: int, z: int, mask: int) -> int:
    """Where a cell is kept: large primes, and the high bits, which the products mix best (Teschner 2003)."""
    mixed = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)
    return (mixed ^ (mixed >> 17)) & mask


@kernel
def fill(position: FloatArray, cell_m: float) -> tuple[IntArray, IntArray, IntArray]:
    """Sort positions (M, 3) into buckets: `member[start[b]:start[b + 1]]`, and the (M, 3) cells."""
    m = position.shape[0]
    size = 16
    while size < 2 * m:
        size *= 2
    cell = np.empty((m, 3), dtype=np.int64)
    bucket = np.empty(m, dtype=np.int64)
    start = np.zeros(size + 1, dtype=np.int64)
    for j in range(m):
        for a in range(3):
            cell[j, a] = cell_of(position[j, a], cell_m)
        bucket[j] = bucket_of(cell[j, 0], cell[j, 1], cell[j, 2], size - 1)
        start[bucket[j] + 1] += 1
    for b in range(size):
        start[b + 1] += start[b]
    member = np.empty(m, dtype=np.int64)
    free = start[:-1].copy()
    for j in range(m):
        member[free[bucket[j]]] = j
        free[bucket[j]] += 1
    return start, member, cell
