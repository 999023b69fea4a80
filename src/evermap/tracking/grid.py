"""Objects by place, hashed: detections of a frame in boxes, and objects of the working set in chunks of the ground.

A chunk's objects are a linked list of rows.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from evermap.tracking.kalman import inlined, kernel
from evermap.types import FloatArray, IntArray

FAR = 2.0**40
"""Cells are counted to here from the origin, so that they are whole numbers however small a cell is."""


@inlined
def cell_of(value: float, cell_m: float) -> int:
    """Return the cell along one axis."""
    return math.floor(min(max(value / cell_m, -FAR), FAR))


@inlined
def bucket_of(x: int, y: int, z: int, mask: int) -> int:
    """Return where a cell is kept: large primes, and the high bits, which the products mix best (Teschner 2003)."""
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


Rows = NDArray[np.int32]
END = -1
"""No further row of a bucket."""


@kernel
def link(rows: IntArray, position: FloatArray, chunk_m: float, head: Rows, following: Rows) -> None:
    """Enter rows into the lists of their chunks.

    Args:
        rows: (K,) rows of `position`.
        position: (N, 3); the first two are on the ground.
        chunk_m: side of a chunk.
        head: (B,) first row of every bucket, or `END`; B is a power of two.
        following: (N,) the next row of the same bucket, or `END`.
    """
    for row in rows:
        b = bucket_of(cell_of(position[row, 0], chunk_m), cell_of(position[row, 1], chunk_m), 0, head.shape[0] - 1)
        following[row] = head[b]
        head[b] = row


@kernel
def unlink(rows: IntArray, position: FloatArray, chunk_m: float, head: Rows, following: Rows) -> None:
    """Take rows out of the lists of their chunks."""
    for row in rows:
        b = bucket_of(cell_of(position[row, 0], chunk_m), cell_of(position[row, 1], chunk_m), 0, head.shape[0] - 1)
        if head[b] == row:
            head[b] = following[row]
            continue
        before = head[b]
        while following[before] != row:
            before = following[before]
        following[before] = following[row]


@kernel
def rows_near(
    centre: FloatArray, reach_m: FloatArray, position: FloatArray, chunk_m: float, head: Rows, following: Rows
) -> IntArray:
    """Return rows within `reach_m` (K,) of any of the points `centre` (K, 3), each once, in order.

    Where the discs hold more chunks than there are buckets, all buckets are looked through.
    """
    found = np.empty(64, dtype=np.int64)
    n_found = 0
    n_buckets = head.shape[0]
    for k in range(centre.shape[0]):
        r = reach_m[k]
        low_x, high_x = cell_of(centre[k, 0] - r, chunk_m), cell_of(centre[k, 0] + r, chunk_m)
        low_y, high_y = cell_of(centre[k, 1] - r, chunk_m), cell_of(centre[k, 1] + r, chunk_m)
        everywhere = (high_x - low_x + 1.0) * (high_y - low_y + 1.0) > n_buckets
        if everywhere:
            low_x, high_x, low_y, high_y = 0, n_buckets - 1, 0, 0
        for x in range(low_x, high_x + 1):
            for y in range(low_y, high_y + 1):
                row = head[x] if everywhere else head[bucket_of(x, y, 0, n_buckets - 1)]
                while row != END:
                    dx, dy = position[row, 0] - centre[k, 0], position[row, 1] - centre[k, 1]
                    dz = position[row, 2] - centre[k, 2]
                    mine = everywhere or (
                        cell_of(position[row, 0], chunk_m) == x and cell_of(position[row, 1], chunk_m) == y
                    )
                    if mine and math.sqrt(dx * dx + dy * dy + dz * dz) <= r:
                        if n_found == found.shape[0]:
                            found = np.concatenate((found, np.empty(n_found, dtype=np.int64)))
                        found[n_found] = row
                        n_found += 1
                    row = following[row]
    found = np.sort(found[:n_found])
    n_kept = 0
    for k in range(n_found):
        if k == 0 or found[k] != found[k - 1]:
            found[n_kept] = found[k]
            n_kept += 1
    return found[:n_kept]
