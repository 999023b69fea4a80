"""Sparse linear least squares: the structure once, then numbers as often as they change."""

from __future__ import annotations

import threading
from collections.abc import Generator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from evermap.errors import DataError, NumericalError
from evermap.estimate.sparse.elimination import (
    Elimination,
    Spread,
    back_substitute,
    columns_of_inverse,
    eliminate,
    eliminate_large,
    forward_substitute,
    multiply_transposed,
    numbers_of,
    spread,
    spread_room,
    ways_to_border,
)
from evermap.estimate.sparse.tree import Factors, Tree, tree_of
from evermap.types import FloatArray, IntArray

_Result = TypeVar("_Result")
Slices: TypeAlias = Generator[float, None, _Result]
"""Work that may be left after every slice of at most about a millisecond: parts of a millisecond, then its result."""

SLICE = 1e6
"""Multiplications of a slice."""
LARGE = 1e7
"""Multiplications of a front, or of the information of one of its factors, from which on BLAS is faster."""


class _AtOnce(threading.local):
    """How many `exhaust` a thread is within."""

    depth = 0


_AT_ONCE = _AtOnce()


def exhaust(slices: Slices[_Result]) -> _Result:
    """Return the result of work that is done at once, in as few slices as it can be."""
    _AT_ONCE.depth += 1
    try:
        while True:
            next(slices)
    except StopIteration as done:
        result: _Result = done.value
        return result
    finally:
        _AT_ONCE.depth -= 1


@dataclass(frozen=True)
class Factorised:
    """A least-squares problem with all but its border eliminated.

    What needs the border raises `NumericalError` where that is not determined.

    Attributes:
        system: its structure.
        values: Jacobians and right sides.
        rows: rows of the Cholesky factor `L'`, front after front.
        own_right: (numbers,) its right side, `L^-1 b`.
        information: (B, B) of the border, all else marginalised.
        right: (B,) its right side.
    """

    system: System
    values: FloatArray
    rows: FloatArray
    own_right: FloatArray
    information: FloatArray
    right: FloatArray

    def solution(self) -> Slices[FloatArray]:
        """Return (numbers,) the optimum of all variables, in slices."""
        tree = self.system.tree
        border = cho_solve(self._border, self.right) if len(self.right) else self.right
        x = np.zeros(tree.begin[-1])
        for low, high, share in self.system.cuts(10.0 * tree.own * tree.size):
            back_substitute(tree, self.rows, self.own_right, border, x, low, high)
            yield share
        return x

    def with_right(self, right: FloatArray) -> Factorised:
        """Return the same with another right side of the factors' rows (R,), and none of the border from elsewhere.

        Nothing is factorised again: it costs no more than a solution.
        """
        tree = self.system.tree
        own = multiply_transposed(tree, self.system.factors, self.values, right)
        forward_substitute(tree, self.rows, own)
        at = numbers_of(tree.begin[tree.border], tree.dim[tree.border])
        border, own[at] = own[at], 0.0
        return Factorised(self.system, self.values, self.rows, own, self.information, border)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the information of all variables, the border among them."""
        tree = self.system.tree
        node = np.repeat(np.arange(len(tree.own)), tree.own)
        row = np.arange(len(node)) - np.repeat(np.cumsum(tree.own) - tree.own, tree.own)
        pivots = self.rows[tree.stored[node] + row * (tree.size[node] + 1)]
        found = 2.0 * float(np.log(pivots).sum())
        return found + 2.0 * float(np.log(np.diag(self._border[0])).sum()) if len(self.right) else found

    def border_covariance(self) -> FloatArray:
        """Return (B, B) covariance of the border."""
        if not len(self.right):
            return self.information
        root = solve_triangular(self._border[0], np.eye(len(self.right)), trans="T")
        return np.asarray(root.T @ root)

    def spread(self, n_pairs: int = 0) -> Slices[Spread]:
        """Return covariances of all variables, with the border, and of what each factor ties, in slices: `Spread`."""
        tree, factors, border = self.system.tree, self.system.factors, self.border_covariance()
        room = spread_room(tree, factors, border, n_pairs)
        for low, high, share in self.system.cuts(tree.own * tree.size**2 + tree.size**2):
            spread(tree, factors, self.values, self.rows, border, room, low, high)
            yield share
        return room

    def joint(self, variables: IntArray) -> FloatArray:
        """Return the joint covariance of variables (K,), in their order; the cost is that of their ways up."""
        ways, rest, _ = self._ways(variables)
        joint = ways @ ways.T
        if rest.size:
            rest = solve_triangular(self._border[0], rest.T, trans="T")
            joint += rest.T @ rest
        return np.asarray(joint)

    def each(self, variables: IntArray, matrices: FloatArray) -> FloatArray:
        """Return (V, R, R) the covariance of each of the matrices (V, R, numbers) times different variables."""
        count, rows = matrices.shape[:2]
        ways, rest, _ = self._ways(variables, matrices.reshape(count * rows, -1))
        ways = ways.reshape(count, rows, -1)
        found = ways @ ways.transpose(0, 2, 1)
        if rest.size:
            rest = solve_triangular(self._border[0], rest.T, trans="T").T.reshape(count, rows, -1)
            found += rest @ rest.transpose(0, 2, 1)
        return np.asarray(found)

    def product(self, variables: IntArray, matrix: FloatArray) -> FloatArray:
        """Return (n, K) the joint covariance of different variables, of n numbers, times a matrix (n, K).

        It is never formed: variables are taken some at a time.
        """
        first = np.concatenate([[0], np.cumsum(self.system.tree.dim[variables])])
        told, told_border, reached = self._ways(variables, matrix.T)
        border = cho_solve(self._border, told_border.T) if told_border.size else told_border.T
        found = np.empty(matrix.shape)
        for at in range(0, len(variables), BATCH):
            some = variables[at : at + BATCH]
            ways, rest, passed = self._ways(some)
            own = self.system.tree.own
            rows = [reached[node] + np.arange(own[node]) for node in np.flatnonzero(passed >= 0)]
            found[first[at] : first[at + len(some)]] = ways @ told[:, np.concatenate(rows)].T + rest @ border
        return found

    def columns(self, variables: IntArray) -> FloatArray:
        """Return (numbers, n) covariance of everything with some variables; the cost is that of n solutions."""
        ways, rest, reached = self._ways(variables)
        border = cho_solve(self._border, rest.T) if rest.size else rest.T
        return columns_of_inverse(self.system.tree, self.rows, ways, reached, border)

    def _ways(self, variables: IntArray, matrix: FloatArray | None = None) -> tuple[FloatArray, FloatArray, IntArray]:
        wanted = np.ascontiguousarray(variables, dtype=np.int64)
        if matrix is None:
            matrix = np.eye(int(self.system.tree.dim[wanted].sum()))
        return ways_to_border(
            self.system.tree, self.rows, self.system.node_of, wanted, np.ascontiguousarray(matrix, dtype=np.float64)
        )

    @cached_property
    def _border(self) -> tuple[FloatArray, bool]:
        try:
            root, lower = cho_factor(self.information)
        except (LinAlgError, ValueError):
            problem = "the measurements do not determine a solution"
            raise NumericalError(problem, hint="check units and stamps") from None
        return root, bool(lower)


MEMORY_LIMIT_GB = 8.0
BATCH = 64
"""Variables whose ways to the root are held at a time."""


class System:
    """Structure of a least-squares problem: the place of every elimination; see `tree_of`.

    Raises:
        DataError: a factor that does not fit into memory.
    """

    def __init__(
        self, dim: IntArray, factors: Factors, coordinate: FloatArray, border: IntArray, tree: Tree | None = None
    ) -> None:
        self.factors = factors
        self.tree: Tree = exhaust(tree_of(dim, factors, coordinate, border)) if tree is None else tree
        size_gb = 8e-9 * (self.tree.stored[-1] + self.tree.most_waiting)
        if size_gb > MEMORY_LIMIT_GB:
            problem = f"{len(dim)} poses and landmarks tied by {len(factors.rows)} measurements need {size_gb:.0f} GB"
            raise DataError(problem, hint="split the recording into sessions")
        node = np.repeat(np.arange(len(self.tree.parent)), self.tree.n_own)
        self.node_of = np.full(len(dim), -1)
        own = self.tree.up < 0
        self.node_of[self.tree.variable[own]] = node
        rows = np.zeros(len(self.tree.parent), dtype=np.int64)
        fronts = np.repeat(np.arange(len(rows)), np.diff(self.tree.factor_first))
        np.maximum.at(rows, fronts, factors.rows[self.tree.factor])
        self._large = np.maximum(self.tree.own, rows) * self.tree.size**2 >= LARGE

    @cached_property
    def right_at(self) -> IntArray:
        """(R,) where the right sides of all rows are among the values of the factors."""
        rows = self.factors.rows
        width = np.repeat(np.diff(self.tree.value_first) // np.maximum(rows, 1), rows)
        row = np.arange(len(width)) - np.repeat(np.cumsum(rows) - rows, rows)
        return np.asarray(np.repeat(self.tree.value_first[:-1], rows) + (row + 1) * width - 1)

    @cached_property
    def has_border_throughout(self) -> bool:
        """Whether all fronts hold the whole border: then so does what `Factorised.spread` finds with it."""
        tree = self.tree
        front = np.repeat(np.arange(len(tree.parent)), np.diff(tree.first))
        held = np.bincount(front[tree.in_border[tree.variable] >= 0], minlength=len(tree.parent))
        return bool(np.all(held == len(tree.border)))

    def cuts(self, work: ArrayLike) -> list[tuple[int, int, float]]:
        """Return ranges of fronts with about a slice of work (T,) each, and the share of a slice that each takes; one
        for all where nobody waits between slices.
        """
        total = np.append(0.0, np.cumsum(np.asarray(work, dtype=np.float64))) / SLICE
        if _AT_ONCE.depth:
            return [(0, len(total) - 1, float(total[-1]))]
        _, first = np.unique(np.floor(total[:-1]), return_index=True)
        bounds = [*first.tolist(), len(total) - 1]
        return [(low, high, float(total[high] - total[low])) for low, high in pairwise(bounds)]

    def _eliminate(self, values: FloatArray, extra: FloatArray, state: Elimination, high: int, low: int) -> None:
        """Eliminate fronts as `eliminate` does, large ones by BLAS as far as rounding lets it."""
        for node in (low + np.flatnonzero(self._large[low:high]))[::-1].tolist():
            eliminate(self.tree, self.factors, values, extra, state, high, node + 1)
            try:
                eliminate_large(self.tree, self.factors, values, extra, state, node)
                high = node
            except LinAlgError:
                high = node + 1
        eliminate(self.tree, self.factors, values, extra, state, high, low)

    def factorised(
        self,
        values: FloatArray,
        *,
        extra: FloatArray | None = None,
        border_information: FloatArray | None = None,
        border_right: FloatArray | None = None,
    ) -> Slices[Factorised]:
        """Eliminate everything but the border, in slices.

        Args:
            values: Jacobian and right side of each factor, whitened, in rows: the cost is `|A x - b|^2 / 2`.
            extra: (numbers,) information that is added on the diagonal.
            border_information: (B, B) information on the border from elsewhere.
            border_right: (B,) its right side.
        """
        tree = self.tree
        extra = np.zeros(tree.begin[-1]) if extra is None else extra
        state = Elimination.of(tree)
        for low, high, share in reversed(self.cuts(tree.own * tree.size**2 + 2 * tree.size**2)):
            self._eliminate(values, extra, state, high, low)
            yield share
        border = state.border(tree)
        information = np.triu(border[:, :-1])
        information += np.triu(information, 1).T
        right = border[:, -1].copy()
        at = numbers_of(tree.begin[tree.border], tree.dim[tree.border])
        information[np.diag_indices(len(right))] += extra[at]
        if border_information is not None:
            information = information + border_information
        if border_right is not None:
            right = right + border_right
        return Factorised(self, values, state.stored, state.right, information, right)
