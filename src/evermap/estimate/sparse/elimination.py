"""Numbers along the elimination tree: Cholesky factor, solution, and the covariances that fronts hold.

Every front is a small dense matrix (multifrontal method, Duff and Reid 1983; Liu 1992), so the loops are over rows in
memory. Covariances of everything that a factor ties are found on the way back, without an inverse of the whole
(Erisman and Tinney 1975); those of other pairs from the rows of `L^-1` along their ways to the root.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from evermap.compiled import kept
from evermap.estimate.sparse.tree import Factors, Tree
from evermap.types import FloatArray, IntArray

TINY = 1e-12
"""Share of its own information below which a pivot is rounding."""
BLOCK = 4
"""Rows that are eliminated at once: as many as fit into registers beside what they change."""

LARGE_FACTOR = 64
"""Rows of a factor from which on `eliminate_large` computes its information by BLAS, and `spread` nothing."""

kernel = kept(effort=3, error_model="numpy", fastmath={"contract"})


class Spread(NamedTuple):
    """Covariances at the optimum.

    Attributes:
        own: covariance of each variable by itself, one after the other, in rows.
        own_first: (V + 1,) where they begin.
        with_border: (numbers, B) covariance of every number with those of the border that are in its front.
        of_factors: `A S A'` of each factor with Jacobian A, (rows, rows) each, one after the other; none of factors
            with `LARGE_FACTOR` rows, as of a map.
        of_factors_first: (F + 1,) where they begin.
        pairs: (P, a, b) covariances of the first two variables of each of the first P factors.
        held: room for the covariances of the fronts from the root to one of them.
    """

    own: FloatArray
    own_first: IntArray
    with_border: FloatArray
    of_factors: FloatArray
    of_factors_first: IntArray
    pairs: FloatArray
    held: FloatArray

    def of(self, variable: IntArray, dim: int) -> FloatArray:
        """Return (K, dim, dim) covariances of variables (K,) that have so many numbers each."""
        at = self.own_first[variable][:, None] + np.arange(dim * dim)
        return np.asarray(self.own[at].reshape(-1, dim, dim))

    def explained(self, factor: IntArray, rows: int) -> FloatArray:
        """Return (K, rows, rows) `A S A'` of factors (K,) with so many rows each."""
        at = self.of_factors_first[factor][:, None] + np.arange(rows * rows)
        return np.asarray(self.of_factors[at].reshape(-1, rows, rows))


class Elimination(NamedTuple):
    """Numeric state of an elimination, possibly incomplete.

    Attributes:
        stored: rows (own, size) of the Cholesky factor `L'`, front after front.
        right: (numbers,) right side, `L^-1 b`.
        waiting: updates of fronts whose parents come later.
        where, whose: where each of these begins, and the front that it is of.
        n_waiting: (1,) how many.
        front: room for the largest front and its right side.
    """

    stored: FloatArray
    right: FloatArray
    waiting: FloatArray
    where: IntArray
    whose: IntArray
    n_waiting: IntArray
    front: FloatArray

    @classmethod
    def of(cls, tree: Tree) -> Elimination:
        """Return room for the numbers of a tree, before the first front."""
        largest, count = int(tree.size.max()), len(tree.parent)
        return cls(
            np.empty(tree.stored[-1]),
            np.zeros(tree.begin[-1]),
            np.empty(tree.most_waiting),
            np.zeros(count + 1, dtype=np.int64),
            np.empty(count, dtype=np.int64),
            np.zeros(1, dtype=np.int64),
            np.zeros((largest, largest + 1)),
        )

    def border(self, tree: Tree) -> FloatArray:
        """Return (B, B + 1) information of the border and its right side, upper triangle, when all is done."""
        left = int(tree.size[0] - tree.own[0])
        return self.waiting[: left * (left + 1)].reshape(left, left + 1)


@kernel
def _of_factor(tree: Tree, factors: Factors, f: int, index: Any) -> int:
    """Write the positions of a factor's numbers in its front; return their count."""
    width = 0
    for k in range(factors.first[f], factors.first[f + 1]):
        for a in range(tree.dim[factors.variable[k]]):
            index[width] = tree.factor_at[k] + a
            width += 1
    return width


@kernel
def _pass_on(tree: Tree, node: int, index: Any) -> int:
    """Write the positions of a front's passed-on numbers in its parent's; return their count."""
    left = 0
    for k in range(tree.first[node] + tree.n_own[node], tree.first[node + 1]):
        for a in range(tree.dim[tree.variable[k]]):
            index[left] = tree.up[k] + a
            left += 1
    return left


@kernel
def eliminate(
    tree: Tree, factors: Factors, values: FloatArray, extra: FloatArray, state: Elimination, high: int, low: int
) -> None:
    """Eliminate the fronts from `high - 1` down to `low`, all later ones being eliminated in `state`.

    `values` are Jacobian and right side of each factor, whitened: the cost is `|A x - b|^2 / 2`; `extra` (numbers,)
    information is added on the diagonal.
    """
    diagonal = np.zeros(len(state.front))
    for node in range(high - 1, low - 1, -1):
        _gather(tree, factors, values, extra, state, node, np.inf)
        for i in range(tree.own[node]):
            diagonal[i] = state.front[i, i]
        _eliminate_rows(state.front, diagonal, tree.own[node], tree.size[node])
        _store(tree, state, node)


def eliminate_large(
    tree: Tree, factors: Factors, values: FloatArray, extra: FloatArray, state: Elimination, node: int
) -> None:
    """Eliminate a front as `eliminate` does, by BLAS: from some hundred numbers on that is several times as fast.

    Raises:
        LinAlgError: it is not positive definite beyond rounding; the state is as before, but for its front.
    """
    own, size, n_waiting = int(tree.own[node]), int(tree.size[node]), int(state.n_waiting[0])
    _gather(tree, factors, values, extra, state, node, float(LARGE_FACTOR))  # an integer would compile it once more
    front = state.front[:size, : size + 1]
    mine = tree.factor[tree.factor_first[node] : tree.factor_first[node + 1]]
    for f in mine[factors.rows[mine] >= LARGE_FACTOR].tolist():
        of_factor = slice(factors.first[f], factors.first[f + 1])
        index = np.append(numbers_of(tree.factor_at[of_factor], tree.dim[factors.variable[of_factor]]), size)
        jacobian = values[tree.value_first[f] : tree.value_first[f + 1]].reshape(factors.rows[f], -1)
        front[np.ix_(index[:-1], index)] += jacobian[:, :-1].T @ jacobian
    try:
        root = cholesky(front[:own, :own], check_finite=False)
    except LinAlgError:
        state.n_waiting[0] = n_waiting
        raise
    rest = solve_triangular(root, front[:own, own:], trans="T", check_finite=False)
    front[:own] = np.hstack([root, rest])
    front[own:, own:] -= rest[:, :-1].T @ rest
    _store(tree, state, node)


def numbers_of(first: IntArray, dim: IntArray) -> IntArray:
    """Return the positions of all numbers of variables (V,) that begin at `first` and have `dim` each."""
    return np.asarray(np.repeat(first - np.cumsum(dim) + dim, dim) + np.arange(dim.sum()))


@kernel
def _gather(
    tree: Tree, factors: Factors, values: FloatArray, extra: FloatArray, state: Elimination, node: int, below: float
) -> None:
    """Write into `state.front` the information of a front's factors, of those with fewer rows than `below`, and what
    its children pass on.
    """
    waiting, where, whose, front = state.waiting, state.where, state.whose, state.front
    index, size, n_waiting = np.empty(len(front) + 1, np.int64), tree.size[node], state.n_waiting[0]
    for i in range(size):
        for j in range(i, size):
            front[i, j] = 0.0
        front[i, size] = 0.0
    for k in range(tree.first[node], tree.first[node] + tree.n_own[node]):
        v = tree.variable[k]
        for a in range(tree.dim[v]):
            front[tree.at[k] + a, tree.at[k] + a] = extra[tree.begin[v] + a]
    for j in range(tree.factor_first[node], tree.factor_first[node + 1]):
        f = tree.factor[j]
        if factors.rows[f] >= below:
            continue
        width = _of_factor(tree, factors, f, index)
        _add_rows(values, tree.value_first[f], factors.rows[f], width, index, front, size)
    while n_waiting > 0 and tree.parent[whose[n_waiting - 1]] == node:
        n_waiting -= 1
        child = whose[n_waiting]
        left = _pass_on(tree, child, index)
        _add_passed_on(waiting, where[n_waiting], left, index, front, size)
    state.n_waiting[0] = n_waiting


@kernel
def _add_rows(values: FloatArray, begin: int, rows: int, width: int, index: Any, front: FloatArray, size: int) -> None:
    """Add the information of a factor's rows to a front, in whose rows and columns `index` (width,) they belong.

    Positions are unsigned here and below: of a signed one machine code asks each time whether it counts from the end.
    """
    at, count, one = np.uint64(begin), np.uint64(width), np.uint64(1)
    for _ in range(rows):
        for a in range(count):
            value, i = values[at + a], np.uint64(index[a])
            if value == 0.0:
                continue
            for c in range(a, count):
                j = np.uint64(index[c])
                front[min(i, j), max(i, j)] += value * values[at + c]
            front[i, size] += value * values[at + count]
        at += count + one


@kernel
def _add_passed_on(waiting: FloatArray, begin: int, left: int, index: Any, front: FloatArray, size: int) -> None:
    """Add what a child passes on to a front, in whose rows and columns `index` (left,) it belongs."""
    at, count, one = np.uint64(begin), np.uint64(left), np.uint64(1)
    for i in range(count):
        to = np.uint64(index[i])
        for j in range(i, count):
            front[to, np.uint64(index[j])] += waiting[at + j]
        front[to, size] += waiting[at + count]
        at += count + one


@kernel
def _store(tree: Tree, state: Elimination, node: int) -> None:
    """Keep the rows of an eliminated front, and what waits for its parent."""
    stored, right, waiting, where, front = state.stored, state.right, state.waiting, state.where, state.front
    size, own, n_waiting = tree.size[node], tree.own[node], state.n_waiting[0]
    for k in range(tree.first[node], tree.first[node] + tree.n_own[node]):
        v = tree.variable[k]
        for a in range(tree.dim[v]):
            right[tree.begin[v] + a] = front[tree.at[k] + a, size]
    at, first, count, one = np.uint64(tree.stored[node]), np.uint64(own), np.uint64(size), np.uint64(1)
    for i in range(first):
        for j in range(i, count):
            stored[at + j] = front[i, j]
        at += count
    at, left = np.uint64(where[n_waiting]), count - first
    for i in range(left):
        for j in range(i, left + one):
            waiting[at + j] = front[first + i, first + j]
        at += left + one
    state.whose[n_waiting] = node
    where[n_waiting + 1] = np.int64(at)
    state.n_waiting[0] = n_waiting + 1


@kernel
def _eliminate_rows(front: FloatArray, diagonal: FloatArray, own: int, size: int) -> None:
    """Make the first `own` rows of the upper triangle those of a Cholesky factor, and the rest its complement."""
    end, stop, one = np.uint64(own), np.uint64(size + 1), np.uint64(1)
    for begin in range(0, own, BLOCK):
        first = np.uint64(begin)
        last = min(first + np.uint64(BLOCK), end)
        for k in range(first, last):
            for p in range(first, k):
                m = front[p, k]
                if m != 0.0:
                    for j in range(k, stop):
                        front[k, j] -= m * front[p, j]
            scale = 1.0 / math.sqrt(max(front[k, k], TINY * diagonal[k] + 1e-300))
            for j in range(k, stop):
                front[k, j] *= scale
            front[k, k] = 1.0 / scale
        if last == first + np.uint64(BLOCK):
            second = first + one
            third = second + one
            fourth = third + one
            for i in range(last, stop - one):
                m0, m1, m2, m3 = front[first, i], front[second, i], front[third, i], front[fourth, i]
                if m0 != 0.0 or m1 != 0.0 or m2 != 0.0 or m3 != 0.0:
                    for j in range(i, stop):
                        front[i, j] -= (
                            m0 * front[first, j] + m1 * front[second, j] + m2 * front[third, j] + m3 * front[fourth, j]
                        )
        else:
            for k in range(first, last):
                for i in range(last, stop - one):
                    m = front[k, i]
                    if m != 0.0:
                        for j in range(i, stop):
                            front[i, j] -= m * front[k, j]


@kernel
def _dot_from(stored: FloatArray, at: Any, x: FloatArray, first: Any, end: Any) -> float:
    """Return the product of `stored` from `at` on with `x`, of the numbers from `first` to before `end`.

    Four sums do not wait for each other.
    """
    a, b, c, d, j = 0.0, 0.0, 0.0, 0.0, first
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    while j + three < end:
        a += stored[at + j] * x[j]
        b += stored[at + j + one] * x[j + one]
        c += stored[at + j + two] * x[j + two]
        d += stored[at + j + three] * x[j + three]
        j += four
    while j < end:
        a += stored[at + j] * x[j]
        j += one
    return (a + b) + (c + d)


@kernel
def multiply_transposed(tree: Tree, factors: Factors, values: FloatArray, right: FloatArray) -> FloatArray:
    """Return (numbers,) the transposed Jacobians of all factors, among their values, times a right side (rows,)."""
    out, at, row = np.zeros(tree.begin[-1]), 0, 0
    for f in range(len(factors.rows)):
        for _ in range(factors.rows[f]):
            for k in range(factors.first[f], factors.first[f + 1]):
                begin = tree.begin[factors.variable[k]]
                for a in range(tree.dim[factors.variable[k]]):
                    out[begin + a] += values[at] * right[row]
                    at += 1
            at += 1
            row += 1
    return out


@kernel
def multiply_rows(values: FloatArray, first: Any, rows: int, number: Any, numbers: FloatArray) -> FloatArray:
    """Return (K, rows, S) Jacobians times numbers of all variables (numbers, S).

    The values of each of K factors begin at `first`, a right side behind each row; `number` (K, w) is which of all
    numbers each column is.
    """
    count, width = number.shape
    out = np.zeros((count, rows, numbers.shape[1]))
    for k in range(count):
        at = first[k]
        for r in range(rows):
            for a in range(width):
                value = values[at + a]
                if value != 0.0:
                    for s in range(numbers.shape[1]):
                        out[k, r, s] += value * numbers[number[k, a], s]
            at += width + 1
    return out


@kernel
def forward_substitute(tree: Tree, stored: FloatArray, right: FloatArray) -> None:
    """Make a right side (numbers,) `L^-1` times it, in place; that of the border is what the others leave of it.

    `stored` are the rows of the Cholesky factor.
    """
    largest = 0
    for node in range(len(tree.parent)):
        largest = max(largest, tree.size[node])
    mine = np.empty(largest)
    for node in range(len(tree.parent) - 1, -1, -1):
        size, own = tree.size[node], tree.own[node]
        for k in range(tree.first[node], tree.first[node + 1]):
            begin = tree.begin[tree.variable[k]]
            for a in range(tree.dim[tree.variable[k]]):
                mine[tree.at[k] + a] = right[begin + a]
        for i in range(own):
            at, row, end = np.uint64(tree.stored[node] + i * size), np.uint64(i), np.uint64(size)
            value = mine[row] / stored[at + row]
            mine[row] = value
            if value != 0.0:
                for j in range(row + np.uint64(1), end):
                    mine[j] -= value * stored[at + j]
        for k in range(tree.first[node], tree.first[node + 1]):
            begin = tree.begin[tree.variable[k]]
            for a in range(tree.dim[tree.variable[k]]):
                right[begin + a] = mine[tree.at[k] + a]


@kernel
def back_substitute(
    tree: Tree, stored: FloatArray, right: FloatArray, border: FloatArray, x: FloatArray, low: int, high: int
) -> None:
    """Solve `L' x = right` for the variables of the fronts from `low` to `high - 1`, those before being done.

    `stored` are the rows of the Cholesky factor, `border` (B,) the solution of the border; `x` (numbers,) is filled in.
    """
    position, largest = 0, 0
    for v in tree.border:
        for a in range(tree.dim[v]):
            x[tree.begin[v] + a] = border[position]
            position += 1
    for node in range(low, high):
        largest = max(largest, tree.size[node])
    mine = np.empty(largest)
    for node in range(low, high):
        size, own = tree.size[node], tree.own[node]
        for k in range(tree.first[node], tree.first[node + 1]):
            v = tree.variable[k]
            for a in range(tree.dim[v]):
                at = tree.begin[v] + a
                mine[tree.at[k] + a] = right[at] if tree.at[k] < own else x[at]
        for i in range(own - 1, -1, -1):
            at, row, end = np.uint64(tree.stored[node] + i * size), np.uint64(i), np.uint64(size)
            mine[row] = (mine[row] - _dot_from(stored, at, mine, row + np.uint64(1), end)) / stored[at + row]
        for k in range(tree.first[node], tree.first[node] + tree.n_own[node]):
            v = tree.variable[k]
            for a in range(tree.dim[v]):
                x[tree.begin[v] + a] = mine[tree.at[k] + a]


def spread_room(tree: Tree, factors: Factors, border: FloatArray, n_pairs: int) -> Spread:
    """Return room for covariances, with those of the border (B, B) in it.

    Of the first `n_pairs` factors, all of the same two sizes, the covariance of the first two variables is wanted.
    """
    own_first = np.append(0, np.cumsum(tree.dim**2))
    of_first = np.append(0, np.cumsum(np.where(factors.rows < LARGE_FACTOR, factors.rows**2, 0)))
    shape = tree.dim[factors.variable[factors.first[0] : factors.first[0] + 2]] if n_pairs else np.zeros(2, np.int64)
    room = Spread(
        np.zeros(own_first[-1]),
        own_first,
        np.zeros((tree.begin[-1], len(border))),
        np.zeros(of_first[-1]),
        of_first,
        np.zeros((n_pairs, int(shape[0]), int(shape[1]))),
        np.empty(tree.most_held),
    )
    for v in tree.border:
        at = tree.in_border[v] + np.arange(tree.dim[v])
        room.with_border[tree.begin[v] : tree.begin[v + 1]] = border[at]
        room.own[own_first[v] : own_first[v + 1]] = border[np.ix_(at, at)].ravel()
    return room


@kernel
def spread(
    tree: Tree, factors: Factors, values: FloatArray, stored: FloatArray, border: FloatArray, out: Spread, low: int,
    high: int,
) -> None:  # fmt: skip
    """Find the covariances that the fronts from `low` to `high - 1` hold, those before being done.

    `values` are as for `eliminate`, `stored` the rows of the Cholesky factor, `border` (B, B) the covariance of the
    border; `out`, of `spread_room`, is filled in.
    """
    own_first, of_first, way, held = out.own_first, out.of_factors_first, tree.way, out.held
    n_pairs, a_dim, b_dim = out.pairs.shape
    largest = 0
    for node in range(low, high):
        largest = max(largest, tree.size[node])
    index = np.empty(largest + 1, np.int64)
    part, tied = np.empty(largest), np.empty((largest, largest))
    for node in range(low, high):
        size, own = tree.size[node], tree.own[node]
        cov = held[way[node] : way[node] + size * size].reshape(size, size)
        left = _pass_on(tree, node, index)
        if node > 0:
            up = tree.parent[node]
            above = held[way[up] : way[up] + tree.size[up] ** 2].reshape(tree.size[up], tree.size[up])
            _take(above, index, left, cov, own)
        else:
            _take(border, index, left, cov, own)
        _spread_rows(cov, part, stored[tree.stored[node] : tree.stored[node + 1]].reshape(own, size), own, size)
        for k in range(tree.first[node], tree.first[node] + tree.n_own[node]):
            v, at = tree.variable[k], tree.at[k]
            dim = tree.dim[v]
            for a in range(dim):
                for b in range(dim):
                    out.own[own_first[v] + a * dim + b] = cov[at + a, at + b]
            for j in range(tree.first[node] + tree.n_own[node], tree.first[node + 1]):
                # the border is last in every front, in its own order
                if tree.in_border[tree.variable[j]] >= 0:
                    to = tree.in_border[tree.variable[j]]
                    for a in range(dim):
                        for b in range(tree.dim[tree.variable[j]]):
                            out.with_border[tree.begin[v] + a, to + b] = cov[at + a, tree.at[j] + b]
        for j in range(tree.factor_first[node], tree.factor_first[node + 1]):
            f = tree.factor[j]
            if factors.rows[f] >= LARGE_FACTOR:
                continue
            width = _of_factor(tree, factors, f, index)
            _take(cov, index, width, tied, 0)
            _spread_factor(values, tree.value_first[f], factors.rows[f], width, tied, part, out.of_factors, of_first[f])
            if f < n_pairs:
                for a in range(a_dim):
                    for b in range(b_dim):
                        out.pairs[f, a, b] = cov[index[a], index[a_dim + b]]


@kernel
def _take(whole: FloatArray, index: Any, count: int, out: FloatArray, first: int) -> None:
    """Copy the rows and columns `index` (count,) of a matrix to those of another one from `first` on."""
    begin, end = np.uint64(first), np.uint64(count)
    for i in range(end):
        row = np.uint64(index[i])
        for j in range(end):
            out[begin + i, begin + j] = whole[row, np.uint64(index[j])]


@kernel
def _spread_factor(
    values: FloatArray, begin: int, rows: int, width: int, tied: FloatArray, part: FloatArray, out: FloatArray, to: int
) -> None:
    """Write `A S A'` (rows, rows) of a factor's Jacobian, whose values begin there, and the covariance `tied`."""
    at, count, step = np.uint64(begin), np.uint64(width), np.uint64(width + 1)
    for r in range(rows):
        for c in range(count):
            part[c] = 0.0
        for a in range(count):
            value = values[at + a]
            if value != 0.0:
                for c in range(count):
                    part[c] += value * tied[a, c]
        other = np.uint64(begin)
        for q in range(r + 1):
            total = 0.0
            for c in range(count):
                total += part[c] * values[other + c]
            out[to + r * rows + q] = total
            out[to + q * rows + r] = total
            other += step
        at += step


@kernel
def _spread_rows(cov: FloatArray, row: FloatArray, rows: FloatArray, own: int, size: int) -> None:
    """Fill in the covariance of a front's own numbers, from the last to the first, beside that of those passed on."""
    end, block, one = np.uint64(size), np.uint64(BLOCK), np.uint64(1)
    for back in range(own):
        i = np.uint64(own - 1 - back)
        first = i + one
        for j in range(first, end):
            row[j] = 0.0
        p = first
        while p + block <= end:
            m0, m1, m2, m3 = rows[i, p], rows[i, p + one], rows[i, p + one + one], rows[i, p + block - one]
            if m0 != 0.0 or m1 != 0.0 or m2 != 0.0 or m3 != 0.0:
                p1, p2, p3 = p + one, p + one + one, p + block - one
                for j in range(first, end):
                    row[j] -= m0 * cov[p, j] + m1 * cov[p1, j] + m2 * cov[p2, j] + m3 * cov[p3, j]
            p += block
        for q in range(p, end):
            for j in range(first, end):
                row[j] -= rows[i, q] * cov[q, j]
        scale = 1.0 / rows[i, i]
        total = scale
        for j in range(first, end):
            value = row[j] * scale
            cov[i, j] = value
            cov[j, i] = value
            total -= rows[i, j] * value
        cov[i, i] = total * scale


@kernel
def ways_to_border(
    tree: Tree, stored: FloatArray, node_of: Any, wanted: Any, matrix: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return `L^-1` times a matrix that is zero but for the numbers of some variables, only the rows that it reaches.

    `stored` are the rows of the Cholesky factor, `node_of` (V,) the fronts that eliminate the variables, -1 of the
    border; `matrix` (C, numbers) has the columns of different variables `wanted` (K,), one a row.

    Returns:
        (C, rows) of the eliminated numbers, (C, B) of the border before it is factorised itself, and (T,) the first
        row of each front, -1 where no variable's way passes.
    """
    reached = np.full(len(tree.parent), -1)
    for v in wanted:
        node = node_of[v]
        while node >= 0 and reached[node] < 0:
            reached[node] = 0
            node = tree.parent[node]
    total, room, begin = 0, 0, np.zeros(len(tree.parent), np.int64)
    for node in range(len(tree.parent)):
        if reached[node] == 0:
            reached[node], begin[node] = total, room
            total += tree.own[node]
            room += tree.size[node]
    n_border = 0
    for v in tree.border:
        n_border += tree.dim[v]
    out, rest, front = np.zeros((len(matrix), total)), np.zeros((len(matrix), n_border)), np.zeros(room)
    passed = np.full(len(tree.parent), -1)
    for c in range(len(matrix)):
        column = 0
        for v in wanted:
            node = node_of[v]
            for a in range(tree.dim[v]):
                value = matrix[c, column + a]
                if value == 0.0:
                    continue
                if node < 0:
                    rest[c, tree.in_border[v] + a] = value
                    continue
                passed[node] = c
                for k in range(tree.first[node], tree.first[node] + tree.n_own[node]):
                    if tree.variable[k] == v:
                        front[begin[node] + tree.at[k] + a] = value
            column += tree.dim[v]
        for node in range(len(tree.parent) - 1, -1, -1):
            if passed[node] != c:
                continue
            size, own, up = tree.size[node], tree.own[node], tree.parent[node]
            mine = front[begin[node] : begin[node] + size]
            for i in range(own):
                at = tree.stored[node] + i * size
                value = mine[i] / stored[at + i]
                out[c, reached[node] + i] = value
                if value != 0.0:
                    for j in range(i + 1, size):
                        mine[j] -= value * stored[at + j]
            above = rest[c]
            if up >= 0:
                above, passed[up] = front[begin[up] : begin[up] + tree.size[up]], c
            for k in range(tree.first[node] + tree.n_own[node], tree.first[node + 1]):
                for b in range(tree.dim[tree.variable[k]]):
                    above[tree.up[k] + b] += mine[tree.at[k] + b]
            mine[:] = 0.0
    return out, rest, reached


@kernel
def columns_of_inverse(
    tree: Tree, stored: FloatArray, ways: FloatArray, reached: Any, border: FloatArray
) -> FloatArray:
    """Return columns (numbers, C) of the inverse, from those (C, rows) of `L^-1` and the (B, C) of the border."""
    out = np.empty((tree.begin[-1], len(ways)))
    right, x = np.zeros(tree.begin[-1]), np.zeros(tree.begin[-1])
    for column in range(len(ways)):
        for node in range(len(tree.parent)):
            for k in range(tree.first[node], tree.first[node] + tree.n_own[node]):
                v = tree.variable[k]
                for a in range(tree.dim[v]):
                    row = reached[node] + tree.at[k] + a
                    right[tree.begin[v] + a] = ways[column, row] if reached[node] >= 0 else 0.0
        first: Any = np.int64(0)  # no literal, for which numba would compile it again
        back_substitute(tree, stored, right, border[:, column].copy(), x, first, len(tree.parent))
        out[:, column] = x
    return out


@kernel
def curvature(tree: Tree, factors: Factors, values: FloatArray) -> FloatArray:
    """Return the diagonal of `A' A`, for damping."""
    out, at = np.zeros(tree.begin[-1]), 0
    for f in range(len(factors.rows)):
        for _ in range(factors.rows[f]):
            for k in range(factors.first[f], factors.first[f + 1]):
                for a in range(tree.dim[factors.variable[k]]):
                    out[tree.begin[factors.variable[k]] + a] += values[at] ** 2
                    at += 1
            at += 1
    return out
