"""A least-squares problem as a value: variables, and blocks of factors that tie them.

Variables are poses, then whatever else there is (places, bodies), then the border: calibration states, which many
factors share. A block holds all factors of one kind, as arrays: which variables each of them ties, and how to fill in
their whitened Jacobians at given values. Nothing else of the estimator depends on what is measured, so several problems
together are a concatenation of their blocks (`concatenate_blocks`), and a new measurement is a new block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from evermap.estimate.sparse.elimination import curvature, multiply_rows
from evermap.estimate.sparse.system import Factorised, Slices, System, exhaust
from evermap.estimate.sparse.tree import MS, Factors, tree_of
from evermap.types import FloatArray, IntArray

State = TypeVar("State")
"""Values of all variables."""
Own = TypeVar("Own")
"""Values of the variables of one problem among several."""
State_contra = TypeVar("State_contra", contravariant=True)


class Room(NamedTuple):
    """Where a block of F factors is filled in.

    Attributes:
        values: of each factor its rows, one after the other: whitened Jacobian by the variables that it ties, and right
            side, minus the whitened residual.
        weights: (F,) ones; of robust factors their weights, whose roots are in `values`.
    """

    values: FloatArray
    weights: FloatArray


class FactorBlock(Protocol[State_contra]):
    """Factors of one kind.

    Attributes:
        ties: (F, k) variables that each factor ties, in the order of the columns of its Jacobian.
        rows: (F,) rows of each factor.
        pose: (F,) the pose together with which each is eliminated; -1 for a factor that belongs to none.
    """

    @property
    def ties(self) -> IntArray: ...
    @property
    def rows(self) -> IntArray: ...
    @property
    def pose(self) -> IntArray: ...

    def linearise(self, state: State_contra, out: Room) -> Slices[float]:
        """Fill in the factors at `state`, in slices, and return their negative log likelihood, up to a constant.

        Args:
            state: values of all variables.
            out: where to.
        """
        ...


@dataclass(frozen=True, slots=True)
class Layout:
    """Variables of a graph, and where elimination may cut it.

    Attributes:
        dim: (V,) numbers of each variable: poses, then the others, the border among them.
        border: (B,) variables that stay to the end.
        leaf_of_pose: (N,) poses are eliminated in groups of consecutive ones: the group of each.
        coordinate: (N, c) coordinates of the poses along which the graph may be cut: an order in time, positions.
    """

    dim: IntArray
    border: IntArray
    leaf_of_pose: IntArray
    coordinate: FloatArray

    @classmethod
    def of(cls, position: FloatArray, dim: int, places: ArrayLike, border: ArrayLike, a_leaf: int) -> Layout:
        """Return that of one problem: poses, places, then the border.

        Args:
            position: (N, c) rough positions of the poses.
            dim: numbers of a pose.
            places: (P,) numbers of each place.
            border: (B,) numbers of each variable of the border.
            a_leaf: consecutive poses that are eliminated together.
        """
        n, of_places, of_border = len(position), np.asarray(places), np.asarray(border)
        leaf = grouped(n, a_leaf)
        every = np.concatenate([np.full(n, dim), of_places, of_border]).astype(np.int64)
        first = n + len(of_places)
        return cls(every, first + np.arange(len(of_border)), leaf, np.column_stack([leaf, position]))


class AlikeFactors(NamedTuple):
    """Factors of one block with as many rows, and variables of as many numbers, as each other.

    Attributes:
        factor: (K,) which of the block they are.
        first: (K,) where their values begin among those of all factors.
        rows: r of each.
        number: (K, w) the number of each column among those of all variables.
    """

    factor: IntArray
    first: IntArray
    rows: int
    number: IntArray

    @property
    def at(self) -> IntArray:
        """(K, r, w + 1) where their rows are among the values of all factors, the right sides last."""
        width = self.number.shape[1] + 1
        return np.asarray(self.first[:, None, None] + np.arange(self.rows * width).reshape(self.rows, width))

    @property
    def right(self) -> IntArray:
        """(K, r) where the right sides are."""
        width = self.number.shape[1] + 1
        return np.asarray(self.first[:, None] + width * np.arange(1, self.rows + 1) - 1)

    def multiply(self, values: FloatArray, numbers: FloatArray) -> FloatArray:
        """Return (K, r, S) Jacobians, among the values of all factors, times numbers of all variables (numbers, S)."""
        return multiply_rows(values, self.first, self.rows, self.number, np.ascontiguousarray(numbers))


@dataclass(frozen=True, slots=True)
class GraphStructure:
    """The order of elimination of a graph, which does not depend on values, noise or weights.

    Attributes:
        layout: its variables.
        system: factors, block after block, and the elimination tree.
        coordinate: of its leaves.
        first: (K + 1,) first factor of each block.
    """

    layout: Layout
    system: System
    coordinate: FloatArray
    first: tuple[int, ...]

    def values_of(self, block: int) -> slice:
        """Return where the values of a block are among those of all."""
        begin = self.system.tree.value_first[[self.first[block], self.first[block + 1]]]
        return slice(int(begin[0]), int(begin[1]))

    def alike(self, block: int) -> list[AlikeFactors]:
        """Return the factors of a block by their shapes."""
        tree, factors, (first, last) = self.system.tree, self.system.factors, self.first[block : block + 2]
        if first == last:
            return []
        ties = factors.variable[factors.first[first] : factors.first[last]].reshape(last - first, -1)
        dim, found = self.layout.dim[ties], list[AlikeFactors]()
        kind = np.zeros(last - first, dtype=np.int64)
        for count in (factors.rows[first:last], *dim.T):
            _, kind = np.unique(kind * (1 + int(count.max())) + count, return_inverse=True)
        for one in range(int(kind.max()) + 1):
            mine = np.flatnonzero(kind == one)
            sizes, rows = dim[mine[0]].tolist(), int(factors.rows[first + mine[0]])
            columns = [tree.begin[ties[mine, k]][:, None] + np.arange(size) for k, size in enumerate(sizes)]
            number = np.concatenate(columns, axis=1)
            found.append(AlikeFactors(mine, tree.value_first[first + mine], rows, number))
        return found

    def hold_places(self, information: float) -> FloatArray:
        """Return (numbers,) so much information on all that is neither a pose nor of the border, which comes last."""
        begin, layout = self.system.tree.begin, self.layout
        held = np.zeros(begin[-1])
        held[begin[len(layout.leaf_of_pose)] : begin[len(layout.dim) - len(layout.border)]] = information
        return held


@dataclass(frozen=True, slots=True)
class Border(Generic[State]):
    """Prior of the border's numbers, independent of each other.

    Attributes:
        information: (B,) inverse variances.
        offset: the numbers (B,) less their means, for given values.
    """

    information: FloatArray
    offset: Callable[[State], FloatArray]


@dataclass(frozen=True, slots=True)
class Graph(Generic[State]):
    """Least squares over blocks of factors.

    Attributes:
        blocks: the factors.
        structure: the order of their elimination.
        border: prior of what stays to the end.
        held: (numbers,) information that is added on the diagonal: keeps what no factor determines where it is.
        retract: values after a step (numbers,), and the size of what it moved.
    """

    blocks: tuple[FactorBlock[State], ...]
    structure: GraphStructure
    border: Border[State]
    held: FloatArray
    retract: Callable[[State, FloatArray], tuple[State, float]]

    def linearised(self, state: State) -> Slices[Linear]:
        """Return the graph linearised at `state`, in slices."""
        structure, cost = self.structure, 0.0
        values, weights = np.zeros(structure.system.tree.value_first[-1]), []
        for k, block in enumerate(self.blocks):
            weights.append(np.ones(structure.first[k + 1] - structure.first[k]))
            cost += yield from block.linearise(state, Room(values[structure.values_of(k)], weights[-1]))
        offset = self.border.offset(state)
        cost += 0.5 * float(offset @ (self.border.information * offset))
        return Linear(values, tuple(weights), cost, -self.border.information * offset)

    def relinearise_blocks(self, now: Linear, state: State, blocks: Mapping[int, FactorBlock[State]]) -> Linear:
        """Return the graph with other blocks in place of some of its own, linearised at the values where it is already.

        Args:
            now: the graph itself, linearised; its cost stays, and is not that of the others.
            state: values of all variables.
            blocks: the others, by the numbers of those that they replace, and which tie the same.
        """
        values, weights = now.values.copy(), list(now.weights)
        for k, block in blocks.items():
            at = self.structure.values_of(k)
            values[at], weights[k] = 0.0, np.ones(len(weights[k]))
            exhaust(block.linearise(state, Room(values[at], weights[k])))
        return replace(now, values=values, weights=tuple(weights))

    def factorised(self, now: Linear, damping: float = 0.0) -> Slices[Factorised]:
        """Eliminate everything but the border, in slices.

        Args:
            now: the graph, linearised.
            damping: share of the curvature of every number that is added to it (Marquardt 1963).
        """
        system, extra, information = self.structure.system, self.held, self.border.information
        if damping > 0.0:
            own = extra + curvature(system.tree, system.factors, now.values)
            own[len(own) - len(information) :] += information
            extra = extra + damping * own
        return system.factorised(
            now.values, extra=extra, border_information=np.diag(information), border_right=now.border_right
        )


@dataclass(frozen=True, slots=True)
class Linear:
    """A graph at some values.

    Attributes:
        values: whitened Jacobians and right sides of all factors.
        weights: of each block, those of its factors (F,).
        cost: negative log posterior, up to a constant.
        border_right: (B,) pull of the prior of the border.
    """

    values: FloatArray
    weights: tuple[FloatArray, ...]
    cost: float
    border_right: FloatArray


@dataclass(frozen=True, slots=True)
class SharedBlock(Generic[State, Own]):
    """A block of one problem among several that are solved together.

    Attributes:
        block: the factors, as the problem has them.
        variable: (V,) which of all variables its own are.
        first_pose: which of all poses its first one is.
        select: its values among those of all.
    """

    block: FactorBlock[Own]
    variable: IntArray
    first_pose: int
    select: Callable[[State], Own]

    @property
    def ties(self) -> IntArray:
        """Return (F, k) variables, numbered through all problems."""
        return self.variable[self.block.ties]

    @property
    def rows(self) -> IntArray:
        """Return (F,) rows of each factor."""
        return self.block.rows

    @property
    def pose(self) -> IntArray:
        """Return (F,) poses, numbered through all problems."""
        return np.where(self.block.pose >= 0, self.first_pose + self.block.pose, -1)

    def linearise(self, state: State, out: Room) -> Slices[float]:
        """Fill in the factors at the problem's own values."""
        return self.block.linearise(self.select(state), out)


def concatenate_blocks(
    problems: Sequence[Sequence[FactorBlock[Own]]],
    variable: Sequence[IntArray],
    first_pose: Sequence[int],
    select: Sequence[Callable[[State], Own]],
    *,
    measured: int,
    between: Sequence[FactorBlock[State]] = (),
) -> tuple[FactorBlock[State], ...]:
    """Return the blocks of several problems as those of one.

    Args:
        problems: the blocks of each.
        variable: of each, which of all variables its own are.
        first_pose: of each, which of all poses its first one is.
        select: of each, its values among those of all.
        measured: kinds of block that come first, each of all problems; the others come last, problem by problem.
        between: blocks that tie the problems to each other.
    """
    shared: list[list[FactorBlock[State]]] = [
        [SharedBlock(block, variable[r], first_pose[r], select[r]) for block in blocks]
        for r, blocks in enumerate(problems)
    ]
    first = [blocks[kind] for kind in range(measured) for blocks in shared]
    return (*first, *between, *(block for blocks in shared for block in blocks[measured:]))


def concatenate_groups(n_poses: Sequence[int], a_leaf: int) -> IntArray:
    """Return (N,) the groups of the poses of several problems, one after the other, none with poses of two."""
    groups, count = [], 0
    for own in n_poses:
        groups.append(count + grouped(own, a_leaf))
        count = int(groups[-1][-1]) + 1
    return np.concatenate(groups)


def grouped(n_poses: int, a_leaf: int) -> IntArray:
    """Return (N,) the group of each pose: so many consecutive ones, the last with the interval that leads to it."""
    return np.minimum(np.arange(n_poses), max(n_poses - 2, 0)) // a_leaf


def build_structure(layout: Layout, blocks: Sequence[FactorBlock[State]]) -> Slices[GraphStructure]:
    """Find the order of elimination, in slices: nested dissection of the leaves, those of factors without a pose too.

    Args:
        layout: variables.
        blocks: factors; those of a block whose covariances of consecutive poses are wanted come first.
    """
    ties = [block.ties for block in blocks]
    counts = [len(part) for part in ties]
    pose = np.concatenate([block.pose for block in blocks])
    n_leaves = int(layout.leaf_of_pose[-1]) + 1
    leaf = np.where(pose >= 0, layout.leaf_of_pose[pose], n_leaves + np.cumsum(pose < 0) - 1)
    width = np.repeat([part.shape[1] for part in ties], counts)
    factors = Factors(
        np.append(0, np.cumsum(width)).astype(np.int64),
        np.concatenate([part.ravel() for part in ties]).astype(np.int64),
        np.concatenate([block.rows for block in blocks]).astype(np.int64),
        leaf.astype(np.int64),
    )
    yield MS * len(leaf)
    coordinate = _coordinates(layout, factors, pose)
    yield MS * len(leaf)
    tree = yield from tree_of(layout.dim, factors, coordinate, layout.border)
    system = System(layout.dim, factors, coordinate, layout.border, tree)
    return GraphStructure(layout, system, coordinate, tuple(np.append(0, np.cumsum(counts)).tolist()))


def _coordinates(layout: Layout, factors: Factors, pose: IntArray) -> FloatArray:
    """Return coordinates of the leaves: means over poses; of a factor without a pose, over its variables' leaves."""
    of_pose, n = layout.leaf_of_pose, len(layout.leaf_of_pose)
    n_leaves, alone = int(of_pose[-1]) + 1, np.flatnonzero(pose < 0)
    weight = np.bincount(of_pose, minlength=n_leaves)
    at = np.empty((n_leaves + len(alone), layout.coordinate.shape[1]))
    for axis in range(at.shape[1]):
        at[:n_leaves, axis] = np.bincount(of_pose, layout.coordinate[:, axis], minlength=n_leaves) / weight
    if not len(alone):
        return at
    of_factor = np.repeat(np.arange(len(pose)), np.diff(factors.first))
    met = (pose[of_factor] >= 0) & (factors.variable >= n)
    variable, middle = factors.variable[met], at[factors.leaf[of_factor[met]]]
    count = np.bincount(variable, minlength=len(layout.dim))
    rest = np.flatnonzero(pose[of_factor] < 0)
    mine, those = np.searchsorted(alone, of_factor[rest]), factors.variable[rest]
    total = np.bincount(mine, count[those], minlength=len(alone))
    for axis in range(at.shape[1]):
        sums = np.bincount(variable, middle[:, axis], minlength=len(layout.dim))
        found = np.bincount(mine, sums[those], minlength=len(alone)) / np.maximum(total, 1)
        at[n_leaves:, axis] = np.where(total > 0, found, at[:n_leaves, axis].mean())
    return at
