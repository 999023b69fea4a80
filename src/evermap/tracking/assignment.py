"""Optimal assignment on a sparse graph in which everybody may stay alone, at no cost.

Shortest augmenting paths with dual prices (Jonker and Volgenant 1987), one row after the other. A path never leaves the
connected component that it starts in, and most components of gated tracklets are one pair, settled by the first pass;
so the work is that of the components by themselves without anybody having to look for them.
"""

from __future__ import annotations

import numpy as np

from evermap.tracking.kernels import kernel
from evermap.types import FloatArray, IntArray

NOBODY = -1


@kernel
def assign(start: IntArray, column: IntArray, cost: FloatArray, n_columns: int) -> IntArray:
    """The matching of least total cost; only pairs that cost less than 0 can be in it.

    Args:
        start: (N + 1,) first pair of every row.
        column: (E,) column of every pair, none twice in a row.
        cost: (E,) finite.
        n_columns: how many columns there are.

    Returns:
        (N,) pair of every row, or `NOBODY`.
    """
    n = start.shape[0] - 1
    pair_of_row = np.full(n, NOBODY, dtype=np.int64)
    row_of_column = np.full(n_columns, NOBODY, dtype=np.int64)
    price = np.zeros(n_columns)
    late = np.empty(n, dtype=np.int64)
    n_late = 0
    for i in range(n):  # whoever wants a column that is free has it
        best, least = NOBODY, 0.0
        for e in range(start[i], start[i + 1]):
            if cost[e] < least:
                best, least = e, cost[e]
        if best == NOBODY:
            continue
        if row_of_column[column[best]] == NOBODY:
            row_of_column[column[best]] = i
            pair_of_row[i] = best
        else:
            late[n_late] = i
            n_late += 1
    if n_late == 0:
        return pair_of_row

    distance = np.full(n_columns, np.inf)
    via = np.empty(n_columns, dtype=np.int64)  # the pair that reaches a column
    via_row = np.empty(n_columns, dtype=np.int64)
    done = np.zeros(n_columns, dtype=np.bool_)
    reached = np.empty(n_columns, dtype=np.int64)
    for f in range(n_late):
        n_reached = 0
        row, so_far = late[f], 0.0
        alone_row, alone = row, 0.0  # the row for which staying alone ends the path, and that path's length
        target = NOBODY
        while True:
            for e in range(start[row], start[row + 1]):
                k = column[e]
                if done[k]:
                    continue
                length = so_far + cost[e] - price[k]
                if length < distance[k]:
                    if distance[k] == np.inf:
                        reached[n_reached] = k
                        n_reached += 1
                    distance[k], via[k], via_row[k] = length, e, row
            nearest, least = NOBODY, np.inf
            for r in range(n_reached):
                k = reached[r]
                if not done[k] and distance[k] < least:
                    nearest, least = k, distance[k]
            if alone <= least:
                least = alone
                break
            if row_of_column[nearest] == NOBODY:
                target = nearest
                break
            done[nearest] = True
            row = row_of_column[nearest]
            own = pair_of_row[row]
            so_far = least - (cost[own] - price[nearest])
            if so_far < alone:
                alone_row, alone = row, so_far
        for r in range(n_reached):
            k = reached[r]
            if done[k]:
                price[k] += distance[k] - least
        if target == NOBODY and alone_row != late[f]:
            target = column[pair_of_row[alone_row]]
            pair_of_row[alone_row] = NOBODY
        while target != NOBODY:  # back along the path: everybody moves on by one
            row = via_row[target]
            freed = NOBODY if pair_of_row[row] == NOBODY else column[pair_of_row[row]]
            pair_of_row[row] = via[target]
            row_of_column[target] = row
            target = NOBODY if row == late[f] else freed
        for r in range(n_reached):
            distance[reached[r]] = np.inf
            done[reached[r]] = False
    return pair_of_row
