"""The elimination tree: where each variable is eliminated, and its remaining neighbours.

Factors come in *leaves*, for example those of a few consecutive poses. The leaves are bisected again and again, each
time along the axis (time, or a coordinate) and at the cut across which the least is shared: nested dissection (George
1973) of the factors. A variable is eliminated at the lowest node that has all its factors below it. So a corridor that
is driven once is cut in time, a hall that is driven crosswise in space, and no fill-in is ever computed symbolically:
the variables of a node (its *front*; Duff and Reid 1983) are what its children share with the rest of the world.

Some variables, the *border*, are kept above the root: calibration states, or what a marginal is asked of.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, NamedTuple

import numpy as np

from evermap.compiled import kept
from evermap.types import FloatArray, IntArray

MS = 2e-5
"""Milliseconds for each variable of a leaf or a front that is looked at."""
AT_ONCE = 50_000
"""Of these, in a slice."""
LEAST_SHARE = 0.3
"""Of the leaves, on the smaller side of a cut: lopsided cuts make deep trees."""

kernel = kept(effort=1, error_model="numpy")


class Factors(NamedTuple):
    """Variables of each factor.

    Attributes:
        first: (F + 1,) where the variables of each factor begin in `variable`.
        variable: variables, factor after factor.
        rows: (F,) rows of each factor's Jacobian.
        leaf: (F,) the leaf that each belongs to; every leaf has at least one factor.
    """

    first: IntArray
    variable: IntArray
    rows: IntArray
    leaf: IntArray


class Tree(NamedTuple):
    """Fronts, parents before their children.

    Attributes:
        parent: (T,) row of each front's parent, -1 of the root.
        first: (T + 1,) where the variables of each front begin in `variable`.
        variable: variables of the fronts, in the order of elimination: own ones, then those that are passed on.
        at: where each of these begins in its front, in numbers.
        up: where each of these begins in the parent's front (at the root, in the border); -1 for own ones.
        n_own: (T,) how many variables are eliminated in each front.
        own, size: (T,) numbers that are eliminated in each front, and all of its numbers.
        stored: (T + 1,) where the rows of each front's factor begin in `Factorised.rows`.
        factor_first, factor: (T + 1,) and (F,) factors of each front.
        factor_at: where each variable of each factor begins in its front, parallel to `Factors.variable`.
        value_first: (F + 1,) where the Jacobian of each factor, with the right side as last column, begins.
        dim: (V,) numbers of each variable.
        begin: (V + 1,) where each variable begins in a vector of all.
        border: (B,) variables above the root.
        in_border: (V,) where each variable begins in the border, -1 of others.
        most_waiting: numbers that updates waiting for their parents take, at most.
        way: (T,) numbers of all fronts from the root to each, itself left out, as squares.
        most_held: the same, itself included, at most.
    """

    parent: IntArray
    first: IntArray
    variable: IntArray
    at: IntArray
    up: IntArray
    n_own: IntArray
    own: IntArray
    size: IntArray
    stored: IntArray
    factor_first: IntArray
    factor: IntArray
    factor_at: IntArray
    value_first: IntArray
    dim: IntArray
    begin: IntArray
    border: IntArray
    in_border: IntArray
    most_waiting: int
    way: IntArray
    most_held: int


def tree_of(dim: IntArray, factors: Factors, coordinate: FloatArray, border: IntArray) -> Generator[float, None, Tree]:
    """Return the elimination tree of a least-squares problem, in slices of some milliseconds.

    Variables (V,) have `dim` numbers each and are tied by factors, those of the border (B,) are not eliminated. Leaves
    may be cut along the axes of their coordinates (leaves, axes), of which the first is preferred.
    """
    dim = np.ascontiguousarray(dim, dtype=np.int64)
    border = np.ascontiguousarray(border, dtype=np.int64)
    leaf_first, leaf_variable = _leaves(factors.first, factors.variable, factors.leaf, len(coordinate), len(dim))
    yield MS * len(factors.rows)
    owner = np.full(len(dim), FREE)
    owner[border] = ABOVE
    coordinate, n = np.ascontiguousarray(coordinate, dtype=np.float64), len(coordinate)
    parent, node_of_leaf, leaf_of_node = np.full(2 * n - 1, -1), np.empty(n, np.int64), np.full(2 * n - 1, -1)
    span, todo, at = np.full((3, len(dim)), -1), np.zeros((2 * n, 3), np.int64), np.array([1, 0])
    todo[0, 1:], order = (n, -1), np.arange(n)
    while at[0] > 0:
        yield MS * _dissect(
            leaf_first, leaf_variable, coordinate, dim, owner, parent, node_of_leaf, leaf_of_node, order, span, todo, at
        )
    node = node_of_leaf[factors.leaf]
    count = np.bincount(node, minlength=len(parent))
    factor = np.argsort(node, kind="stable")
    fronts = _fronts(parent, leaf_of_node, leaf_first, leaf_variable, owner, dim, border)
    first, variable, at, up, n_own, own, size, most_waiting, way = fronts
    yield MS * len(variable)
    factor_first = np.append(0, np.cumsum(count))
    factor_at = _positions(first, variable, at, factor_first, factor, factors.first, factors.variable, len(dim))
    yield MS * len(factors.rows)
    yield MS * len(factors.rows)
    in_border = np.full(len(dim), -1)
    in_border[border] = np.cumsum(dim[border]) - dim[border]
    width = np.diff(np.append(0, np.cumsum(dim[factors.variable]))[factors.first])
    value_first = np.append(0, np.cumsum(factors.rows * (width + 1)))
    yield MS * len(factors.rows)
    return Tree(
        parent,
        first,
        variable,
        at,
        up,
        n_own,
        own,
        size,
        np.append(0, np.cumsum(own * size)),
        factor_first,
        factor,
        factor_at,
        value_first,
        dim,
        np.append(0, np.cumsum(dim)),
        border,
        in_border,
        most_waiting,
        way,
        int((way + size**2).max()),
    )


FREE, ABOVE = -2, -1
"""Owners of variables that no front eliminates yet, or none ever will."""


@kernel
def _leaves(
    variable_first: Any, variable: Any, leaf: Any, n_leaves: int, n_variables: int
) -> tuple[IntArray, IntArray]:
    """The different variables of each leaf: where they begin (leaves + 1,), and which."""
    begin = np.zeros(n_leaves + 1, np.int64)
    for f in range(len(leaf)):
        begin[leaf[f] + 1] += 1
    for k in range(n_leaves):
        begin[k + 1] += begin[k]
    factor, filled = np.empty(len(leaf), np.int64), begin[:-1].copy()
    for f in range(len(leaf)):
        factor[filled[leaf[f]]] = f
        filled[leaf[f]] += 1
    first, out, count = np.zeros(n_leaves + 1, np.int64), np.empty(len(variable), np.int64), 0
    stamp = np.full(n_variables, -1)
    for k in range(n_leaves):
        for j in range(begin[k], begin[k + 1]):
            for i in range(variable_first[factor[j]], variable_first[factor[j] + 1]):
                if stamp[variable[i]] != k:
                    stamp[variable[i]] = k
                    out[count] = variable[i]
                    count += 1
        first[k + 1] = count
    return first, out[:count].copy()


@kernel
def _order(key: FloatArray) -> IntArray:
    """Rows in the order of their keys, equal ones as they come; the sorts of numba take a second to compile."""
    n, width = len(key), 1
    order, merged = np.arange(n), np.empty(n, np.int64)
    while width < n:
        for low in range(0, n, 2 * width):
            middle, high = min(low + width, n), min(low + 2 * width, n)
            a, b = low, middle
            for k in range(low, high):
                if a < middle and (b >= high or key[order[a]] <= key[order[b]]):
                    merged[k] = order[a]
                    a += 1
                else:
                    merged[k] = order[b]
                    b += 1
        order, merged = merged, order
        width *= 2
    return order


@kernel
def _dissect(
    leaf_first: Any, leaf_variable: Any, coordinate: FloatArray, dim: Any, owner: Any, parent: Any, node_of_leaf: Any,
    leaf_of_node: Any, order: Any, span: Any, todo: Any, progress: Any,
) -> int:  # fmt: skip
    """Bisect some leaves; return how many of their variables were looked at.

    Fills in the node that eliminates each variable (`owner`), the parents of the nodes (2 leaves - 1,), each node
    before its children, the nodes of the leaves, and the leaves of the nodes, -1 for others. `order`, `span` and `todo`
    are scratch that is kept; `progress` is how much there is to do, and how many nodes are done.
    """
    axes, work, (waiting, node), (start, stop, stamp) = coordinate.shape[1], 0, progress, span
    while waiting > 0 and work < AT_ONCE:
        waiting -= 1
        low, high = todo[waiting, 0], todo[waiting, 1]
        parent[node] = todo[waiting, 2]
        m = high - low
        if m == 1:
            leaf = order[low]
            node_of_leaf[leaf], leaf_of_node[node] = node, leaf
            for k in range(leaf_first[leaf], leaf_first[leaf + 1]):
                if owner[leaf_variable[k]] == FREE:
                    owner[leaf_variable[k]] = node
            node += 1
            continue
        best, best_cut, best_order = np.inf, 1, order[low:high].copy()
        for axis in range(axes):
            leaves = order[low:high]
            key = np.empty(m)
            for r in range(m):
                key[r] = coordinate[leaves[r], axis]
            by_key = _order(key)
            for r in range(m):
                by_key[r] = leaves[by_key[r]]
            leaves = by_key
            change = np.zeros(m + 1, np.int64)
            mark = node * axes + axis
            for r in range(m):
                for k in range(leaf_first[leaves[r]], leaf_first[leaves[r] + 1]):
                    v = leaf_variable[k]
                    if owner[v] == FREE:
                        if stamp[v] != mark:
                            stamp[v], start[v] = mark, r
                        stop[v] = r
            for r in range(m):
                for k in range(leaf_first[leaves[r]], leaf_first[leaves[r] + 1]):
                    v = leaf_variable[k]
                    if owner[v] == FREE and start[v] == r and stop[v] > r:
                        change[r + 1] += dim[v]
                        change[stop[v] + 1] -= dim[v]
            least = max(1, int(LEAST_SHARE * m))
            shared = 0
            for cut in range(1, m - least + 1):
                shared += change[cut]
                # of equal cuts the one nearer to the middle, of equal axes the first
                cost = shared + 1e-3 * abs(2 * cut - m) / m
                if cut >= least and cost < best - 1e-9:
                    best, best_cut, best_order = cost, cut, leaves
        for r in range(m):
            order[low + r] = best_order[r]
            work += leaf_first[best_order[r] + 1] - leaf_first[best_order[r]]
        mark = (node + 1) * axes * -1 - 2
        for r in range(m):
            leaf = order[low + r]
            for k in range(leaf_first[leaf], leaf_first[leaf + 1]):
                v = leaf_variable[k]
                if r < best_cut:
                    stamp[v] = mark
                elif owner[v] == FREE and stamp[v] == mark:
                    owner[v] = node
        middle = low + best_cut
        todo[waiting, 0], todo[waiting, 1], todo[waiting, 2] = middle, high, node
        todo[waiting + 1, 0], todo[waiting + 1, 1], todo[waiting + 1, 2] = low, middle, node
        waiting += 2
        node += 1
    progress[0], progress[1] = waiting, node
    return work


@kernel
def _fronts(
    parent: Any, leaf_of_node: Any, leaf_first: Any, leaf_variable: Any, owner: Any, dim: Any, border: Any
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, IntArray, int, IntArray]:
    """The variables of every front, from the leaves up; see `Tree`."""
    count, n_variables = len(parent), len(dim)
    child = np.full((count, 2), -1)
    for node in range(count - 1, 0, -1):
        child[parent[node], 1 if child[parent[node], 0] >= 0 else 0] = node
    begin, end = np.zeros(count, np.int64), np.zeros(count, np.int64)
    found = np.empty(max(8 * len(leaf_variable), 16), np.int64)
    n_own, own, size = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64)
    rank = np.zeros(n_variables, np.int64)
    for v in range(n_variables):
        rank[v] = (count - owner[v]) * n_variables + v
    for k in range(len(border)):
        rank[border[k]] = (count + 2) * n_variables + k
    stamp, used = np.full(n_variables, -1), 0
    for node in range(count - 1, -1, -1):
        total = len(border)
        for c in child[node]:
            if c >= 0:
                total += end[c] - begin[c]
        leaf = leaf_of_node[node]
        if leaf >= 0:
            total += leaf_first[leaf + 1] - leaf_first[leaf]
        mine, m = np.empty(total, np.int64), 0
        for c in child[node]:
            if c >= 0:
                for k in range(begin[c] + n_own[c], end[c]):
                    if stamp[found[k]] != node:
                        stamp[found[k]] = node
                        mine[m] = found[k]
                        m += 1
        if leaf >= 0:
            for k in range(leaf_first[leaf], leaf_first[leaf + 1]):
                if stamp[leaf_variable[k]] != node:
                    stamp[leaf_variable[k]] = node
                    mine[m] = leaf_variable[k]
                    m += 1
        if node == 0:
            for v in border:
                if stamp[v] != node:
                    stamp[v] = node
                    mine[m] = v
                    m += 1
        key = np.empty(m)
        for k in range(m):
            key[k] = rank[mine[k]]
        by_rank = _order(key)
        if used + m > len(found):
            grown = np.empty(2 * (used + m), np.int64)
            for k in range(used):
                grown[k] = found[k]
            found = grown
        begin[node], end[node] = used, used + m
        for k in range(m):
            v = mine[by_rank[k]]
            found[used + k] = v
            size[node] += dim[v]
            if owner[v] == node:
                n_own[node] += 1
                own[node] += dim[v]
        used += m
    # in the order of the nodes, with positions
    first = np.zeros(count + 1, np.int64)
    for node in range(count):
        first[node + 1] = first[node] + end[node] - begin[node]
    variable, at, up = np.empty(used, np.int64), np.empty(used, np.int64), np.full(used, -1)
    place = np.zeros(n_variables, np.int64)
    position = 0
    for v in border:
        place[v] = position
        position += dim[v]
    for node in range(count):
        position = 0
        for k in range(end[node] - begin[node]):
            v = found[begin[node] + k]
            variable[first[node] + k], at[first[node] + k] = v, position
            position += dim[v]
    for node in range(count):
        if node > 0:
            for k in range(first[parent[node]], first[parent[node] + 1]):
                place[variable[k]] = at[k]
        for k in range(first[node] + n_own[node], first[node + 1]):
            up[k] = place[variable[k]]
    most, now = 0, 0
    for node in range(count - 1, -1, -1):
        for c in child[node]:
            if c >= 0:
                now -= (size[c] - own[c]) * (size[c] - own[c] + 1)
        now += (size[node] - own[node]) * (size[node] - own[node] + 1)
        most = max(most, now)
    way = np.zeros(count, np.int64)
    for node in range(1, count):
        way[node] = way[parent[node]] + size[parent[node]] ** 2
    return first, variable, at, up, n_own, own, size, most + 1, way


@kernel
def _positions(
    first: Any, variable: Any, at: Any, factor_first: Any, factor: Any, variable_first: Any, of_factor: Any,
    n_variables: int,
) -> IntArray:  # fmt: skip
    """Return the position of the variables of each factor in its front."""
    position, place = np.empty(len(of_factor), np.int64), np.zeros(n_variables, np.int64)
    for node in range(len(first) - 1):
        if factor_first[node] == factor_first[node + 1]:
            continue
        for k in range(first[node], first[node + 1]):
            place[variable[k]] = at[k]
        for j in range(factor_first[node], factor_first[node + 1]):
            for k in range(variable_first[factor[j]], variable_first[factor[j] + 1]):
                position[k] = place[of_factor[k]]
    return position
