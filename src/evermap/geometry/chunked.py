"""Covariance of many points of which those near each other are correlated: blocks of chunks and of their neighbours.

A joint covariance of P points has 4 P^2 numbers. What is worth knowing of a map is how well a place is known beside
those around it; how it is correlated with what is far away follows from the places between. So points are cut into
*chunks* of a few, and kept are the covariances of chunks and of pairs of neighbouring chunks: a number of values a
point. Between chunks that are no neighbours the joint is the one of largest entropy that agrees with what is kept, on
a graph of cliques of chunks (covariance selection, Dempster 1972; chunks as in Bateman 2020, 4.5): given the chunks
between them, two chunks are independent. So the covariance of a few places costs what is near them.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from evermap.geometry import se2
from evermap.types import BoolArray, FloatArray, IntArray

MOST_POINTS = 12
"""Of a chunk; one that has more is halved."""
NEIGHBOURS = 6
"""Chunks, the nearest, with which the covariance of a chunk is kept, beside those that have it among theirs."""
CHUNKS_A_PART = 4
"""Whose blocks are read, and kept by a store, together."""
MOST_GIVEN = 6
"""Chunks, all neighbours of each other, given which a chunk is independent of those before."""
TOLERATED = 1e-6
"""Share of a chunk's variance by which blocks may contradict each other."""
MOST_FOLLOWED = 256
"""Regressions of a chunk on others that are kept: some 10 MB."""
FLOOR_M2 = 1e-10
"""Variance by which matrices that are inverted are kept definite: a hundredth of a millimetre."""

Joint = Callable[[IntArray, IntArray], FloatArray]
"""(2 A, 2 B) covariance of points of some rows with those of others; in space 3 for 2, as everywhere here."""


class Part:
    """Blocks of the pairs whose first chunk is one of `CHUNKS_A_PART`; read when they are asked for."""

    __slots__ = ("_values", "name")

    def __init__(self, values: FloatArray | Callable[[], FloatArray], name: bytes = b"") -> None:
        self._values = values
        self.name = name
        """That a store keeps it under; empty where none does."""

    @property
    def values(self) -> FloatArray:
        """(V,) the blocks (2 n_a, 2 n_b) of the pairs, one after the other, row by row."""
        if callable(self._values):
            self._values = self._values()
        return self._values

    @property
    def is_read(self) -> bool:
        """Whether the blocks are in memory."""
        return not callable(self._values)


@dataclass(frozen=True, eq=False)
class ChunkedCovariance:
    """Joint covariance of P points in the plane, x and y interleaved; of points in space (x, y, z), and 3 for 2.

    Attributes:
        chunk: (P,) chunk of every point, 0 to C - 1; within a chunk points are in the order of their rows.
        parent: (C,) an earlier chunk that is always a neighbour, so that all chunks hang together; -1 for the first.
        centre_m: (C, 2) middles of the chunks, when something was last learned of them; nan of empty ones.
        pair: (Q, 2) neighbouring chunks `a <= b`, every chunk with itself among them, sorted.
        each_m2: (P, 2, 2) covariance of every point by itself.
        parts: the blocks of the pairs.
    """

    chunk: IntArray
    parent: IntArray
    centre_m: FloatArray
    pair: IntArray
    each_m2: FloatArray
    parts: tuple[Part, ...]

    def __len__(self) -> int:
        return len(self.chunk)

    @property
    def dim(self) -> int:
        """Coordinates of a point: 2, or 3 in space."""
        return int(self.each_m2.shape[-1])

    @classmethod
    def empty(cls, dim: int = 2) -> Self:
        """Return the covariance of no points."""
        none = np.zeros(0, dtype=np.int64)
        return cls(none, none, np.zeros((0, dim)), np.zeros((0, 2), dtype=np.int64), np.zeros((0, dim, dim)), ())

    @classmethod
    def of_points(cls, position_m: FloatArray, joint: Joint) -> Self:
        """Cut points (P, 2) into chunks, and keep what `joint` says of neighbouring ones."""
        dim = position_m.shape[1]
        chunk = _halve_chunks(position_m)
        centre = _centres(chunk, position_m, int(chunk.max(initial=-1)) + 1)
        parent = np.full(len(centre), -1, dtype=np.int64)
        for c in range(1, len(centre)):
            parent[c] = np.argmin(((centre[:c] - centre[c]) ** 2).sum(axis=1))
        pair = _pairs(centre, parent)
        index = _Index.of(chunk, pair, dim)
        each, parts = np.zeros((len(chunk), dim, dim)), []
        for g in range(len(index.group) - 1):
            found = []
            for a, b in pair[index.group[g] : index.group[g + 1]].tolist():
                block = joint(index.points(a), index.points(b))
                found.append(block.ravel())
                if a == b:
                    each[index.points(a)] = _of_each(block, dim)
            parts.append(Part(np.concatenate(found)))
        return cls(chunk, parent, centre, pair, each, tuple(parts))

    @classmethod
    def of_dense(cls, position_m: FloatArray, covariance_m2: FloatArray) -> Self:
        """Cut points (P, 2) with a joint covariance (2 P, 2 P) into chunks."""
        dim = position_m.shape[1]
        return cls.of_points(position_m, lambda a, b: covariance_m2[np.ix_(se2.xy_rows(a, dim), se2.xy_rows(b, dim))])

    @classmethod
    def of_independent(cls, position_m: FloatArray, each_m2: FloatArray) -> Self:
        """Cut points (P, 2) with a covariance (P, 2, 2) each into chunks."""

        def joint(a: IntArray, b: IntArray) -> FloatArray:
            dim = position_m.shape[1]
            found = np.zeros((len(a), dim, len(b), dim))
            i, j = np.nonzero(a[:, None] == b)
            found[i, :, j] = each_m2[a[i]]
            return found.reshape(dim * len(a), dim * len(b))

        return cls.of_points(position_m, joint)

    def flaw(self, count: int, dim: int = 2) -> str:
        """Return a description of an inconsistency, also with the number of points; '' if it is consistent."""
        n = len(self.parent)
        own = self.pair[self.pair[:, 0] == self.pair[:, 1], 0]
        good = (
            len(self.chunk) == count
            and self.each_m2.shape == (count, dim, dim)
            and self.centre_m.shape == (n, dim)
            and (self.chunk.min(initial=0) >= 0 and self.chunk.max(initial=-1) < n)
            and (self.parent < np.arange(n)).all()
            and (self.pair.min(initial=0) >= 0 and self.pair.max(initial=-1) < n)
            and (np.diff(self.pair @ [n, 1]) > 0).all()
            and np.array_equal(own, np.arange(n))
            and len(self.parts) == len(self._index.group) - 1
            and all(len(part.values) == size for part, size in zip(self.parts, self.sizes, strict=True) if part.is_read)
        )
        return "" if good else f"a covariance in chunks that is not of {count} places"

    @property
    def sizes(self) -> IntArray:
        """Return the number of values of each part."""
        return np.diff(self._index.first[self._index.group])

    @functools.cached_property
    def _index(self) -> _Index:
        return _Index.of(self.chunk, self.pair, self.dim)

    def of(self, rows: IntArray) -> FloatArray:
        """Return (2 K, 2 K) joint covariance of points (K,), in their order."""
        rows = np.asarray(rows, dtype=np.int64)
        wanted = np.unique(self.chunk[rows])
        if not len(wanted):
            return np.zeros((0, 0))
        points, joint = self._complete_points(self._connect_chunks(wanted))
        place = np.empty(len(self), dtype=np.int64)
        place[points] = np.arange(len(points))
        at = se2.xy_rows(place[rows], self.dim)
        return np.asarray(joint[np.ix_(at, at)])

    def taken(self, rows: IntArray) -> Self:
        """Return the covariance of points (K,), each at most once, in this order; chunks keep their numbers."""
        chunk = self.chunk[rows]
        index, now = self._index, _Index.of(chunk, self.pair, self.dim)
        within = np.empty(len(self), dtype=np.int64)
        within[index.order] = np.arange(len(self)) - index.start[self.chunk[index.order]]
        size = np.diff(index.start)
        kept = [within[rows[now.points(c)]] for c in range(len(size))]
        same = np.array([np.array_equal(mine, np.arange(n)) for mine, n in zip(kept, size.tolist(), strict=True)])
        fresh = {}
        for q in np.flatnonzero(~same[self.pair].all(axis=1)).tolist():
            i, j = (se2.xy_rows(kept[c], self.dim) for c in self.pair[q].tolist())
            fresh[q] = self._block(q)[np.ix_(i, j)].ravel()
        parts = self._parts(now, fresh, np.arange(len(self.pair)))
        return replace(self, chunk=chunk, each_m2=self.each_m2[rows], parts=parts)

    def _parts(self, now: _Index, fresh: dict[int, FloatArray], was: IntArray) -> tuple[Part, ...]:
        """Parts of new pairs (Q',), indexed by `now`: the same where nothing is `fresh`, else put together.

        Blocks that are not fresh are those of the old rows `was` (Q',).
        """
        index, parts = self._index, []
        for g, (begin, end) in enumerate(itertools.pairwise(now.group.tolist())):
            same = g < len(self.parts) and np.array_equal(was[begin:end], np.arange(*index.group[g : g + 2]))
            if same and not any(q in fresh for q in range(begin, end)):
                parts.append(self.parts[g])
                continue
            blocks = [fresh[q] if q in fresh else self._block(int(was[q])).ravel() for q in range(begin, end)]
            parts.append(Part(np.concatenate(blocks)))
        return tuple(parts)

    def updated(self, new: Update) -> Self:
        """Return the covariance after some points were updated, added or removed.

        The points that stay as they are keep their own covariances. With those that were learned they stay correlated
        as they were: `T C`, where `T` is the symmetric map from the old Gaussian of the learned points beside them to
        the new one (optimal transport), so that all stays positive semidefinite; what came depends on them by what was
        learned alone.
        """
        kept = np.flatnonzero(new.was >= 0)
        chunk, parent = _join_points(new, self)
        n_chunks = len(parent)
        of_old = np.full(len(chunk), -1, dtype=np.int64)
        of_old[kept] = new.was[kept]
        told = np.zeros(len(chunk), dtype=np.bool_)
        told[new.rows] = True
        gone = np.setdiff1d(np.arange(len(self)), new.was[kept])
        moved = kept[self.chunk[of_old[kept]] != chunk[kept]]
        touched = np.zeros(n_chunks, dtype=np.bool_)
        touched[chunk[told]] = touched[self.chunk[gone]] = touched[chunk[moved]] = True
        touched[self.chunk[of_old[moved]]] = True
        known = np.flatnonzero(~touched[: len(self.parent)])
        centre = _centres(chunk, new.position_m, n_chunks)
        centre[known] = self.centre_m[known]
        pair = _pairs(centre, parent)
        # pairs of chunks without updates are unchanged, the others are computed anew
        code, old_code = pair @ [n_chunks, 1], self.pair @ [n_chunks, 1]
        code = np.union1d(code[touched[pair].any(axis=1)], old_code[~touched[self.pair].any(axis=1)])
        pair = np.column_stack([code // n_chunks, code % n_chunks])
        index = _Index.of(chunk, pair, self.dim)
        is_fresh = touched[pair].any(axis=1)
        fresh = self._add_fresh(index, np.flatnonzero(is_fresh), told, of_old, new)
        was = np.where(is_fresh, -1, np.searchsorted(old_code, code))
        each = np.empty((len(chunk), self.dim, self.dim))
        each[kept] = self.each_m2[new.was[kept]]
        for q, block in fresh.items():
            a, b = pair[q].tolist()
            if a == b:
                each[index.points(a)] = _of_each(block.reshape(self.dim * len(index.points(a)), -1), self.dim)
        return type(self)(chunk, parent, centre, pair, each, self._parts(index, fresh, was))

    def _add_fresh(
        self, index: _Index, fresh: IntArray, told: BoolArray, of_old: IntArray, new: Update
    ) -> dict[int, FloatArray]:
        """Blocks of the pairs `fresh` of the new covariance."""
        pair, dim = index.pair, self.dim
        points = np.flatnonzero(np.isin(index.chunk, pair[fresh].ravel()))
        rest = points[~told[points]]
        row = np.full(len(index.chunk), -1, dtype=np.int64)
        row[new.rows] = np.arange(len(new.rows))  # of `new.covariance_m2`
        learned = new.rows[np.isin(index.chunk[new.rows], index.chunk[points])]
        old = learned[of_old[learned] >= 0]  # those that were known before
        place_of_rest = np.full(len(index.chunk), -1, dtype=np.int64)
        place_of_rest[rest] = np.arange(len(rest))
        across = np.zeros((dim * len(new.rows), dim * len(rest)))
        own = np.zeros((dim * len(rest), dim * len(rest)))
        if len(rest):
            beside = old[np.isin(index.chunk[old], pair[np.isin(pair, index.chunk[rest]).any(axis=1)])]
            joint = self.of(of_old[np.concatenate([beside, rest])])
            n = dim * len(beside)
            own = joint[n:, n:]
            if n:
                s = se2.xy_rows(row[beside], dim)
                after = new.covariance_m2[np.ix_(s, s)] + FLOOR_M2 * np.eye(n)
                carried = _transport(joint[:n, :n] + FLOOR_M2 * np.eye(n), after) @ joint[:n, n:]
                across = new.covariance_m2[:, s] @ cho_solve(cho_factor(after), carried)
                across[s] = carried
        found = {}
        for q in fresh.tolist():
            a, b = (index.points(int(c)) for c in pair[q])
            block = np.empty((len(a), dim, len(b), dim))
            ta, tb = np.flatnonzero(told[a]), np.flatnonzero(told[b])
            ra, rb = np.flatnonzero(~told[a]), np.flatnonzero(~told[b])
            for i, j, source, rows, columns in (
                (ta, tb, new.covariance_m2, row[a[ta]], row[b[tb]]),
                (ta, rb, across, row[a[ta]], place_of_rest[b[rb]]),
                (ra, tb, across.T, place_of_rest[a[ra]], row[b[tb]]),
                (ra, rb, own, place_of_rest[a[ra]], place_of_rest[b[rb]]),
            ):
                part = source[np.ix_(se2.xy_rows(rows, dim), se2.xy_rows(columns, dim))]
                part = part.reshape(len(i), dim, len(j), dim)
                block[i[:, None], :, j[None], :] = part.transpose(0, 2, 1, 3)
            found[q] = block.ravel()
        return found

    def _block(self, q: int) -> FloatArray:
        """The block of a pair."""
        index = self._index
        g = int(self.pair[q, 0]) // CHUNKS_A_PART
        begin = index.first[index.group[g]]
        values = self.parts[g].values[index.first[q] - begin : index.first[q + 1] - begin]
        rows, columns = (self.dim * int(index.start[c + 1] - index.start[c]) for c in self.pair[q].tolist())
        return values.reshape(rows, columns)

    def _between(self, a: int, b: int) -> FloatArray:
        """The block of two neighbouring chunks in either order."""
        block = self._block(self._index.pair_of(min(a, b), max(a, b)))
        return block if a <= b else block.T

    def _connect_chunks(self, chunks: IntArray) -> IntArray:
        """Chunks, and those between them without which they would not hang together."""
        graph = self._index.graph
        while True:
            near, inside, front = self._near(chunks), set[int](), chunks[:1].tolist()
            while front:
                inside.add(here := front.pop())
                front += near[here] & near.keys() - inside
            others = np.array([c for c in near if c not in inside], dtype=np.int64)
            if not len(others):
                return chunks
            order, before = breadth_first_order(graph, int(chunks[0]), directed=False)
            rank = np.full(graph.shape[0], graph.shape[0], dtype=np.int64)
            rank[order] = np.arange(len(order))
            at = int(others[np.argmin(rank[others])])
            way = []
            while at >= 0 and at not in inside:
                way.append(at)
                at = int(before[at])
            if at < 0:  # nothing lies between them
                return chunks
            chunks = np.union1d(chunks, way)

    def _complete_points(self, chunks: IntArray) -> tuple[IntArray, FloatArray]:
        """Points of chunks, and their joint covariance."""
        index, near = self._index, self._near(chunks)
        order = self._elimination(near)
        size = np.diff(index.start)
        first = np.concatenate([[0], np.cumsum(self.dim * size[list(order)])]).astype(np.int64)
        at = {c: slice(int(first[k]), int(first[k + 1])) for k, c in enumerate(order)}
        joint = np.zeros((int(first[-1]), int(first[-1])))
        for c, given in order.items():
            mine, n = at[c], at[c].start
            own = self._between(c, c)
            joint[mine, mine] = own
            if not n:
                continue
            fitting, gain, rest = self._follows(c, given)
            if not fitting:
                continue
            rows = np.concatenate([np.arange(at[g].start, at[g].stop) for g in fitting])
            # stored and derived blocks of the given chunks differ a little: the chunk's own block is the stored one
            back = _transport(rest + gain @ joint[np.ix_(rows, rows)] @ gain.T, own)
            joint[mine, :n] = back @ (gain @ joint[rows, :n])
            joint[:n, mine] = joint[mine, :n].T
        points = np.concatenate([index.points(c) for c in order]) if order else np.zeros(0, dtype=np.int64)
        return points, joint

    def _follows(self, c: int, given: list[int]) -> tuple[list[int], FloatArray, FloatArray]:
        """Return the regression (m, n) of a chunk (m, m) on a clique of others (n, n), and its conditional covariance.

        Blocks that were told at different times may contradict each other: then the farthest others are left out.
        """
        found = self._followed.get(key := (c, *given))
        if found is None:
            if len(self._followed) >= MOST_FOLLOWED:
                self._followed.clear()
            found = self._followed[key] = self._regress(c, given)
        return found

    @functools.cached_property
    def _followed(self) -> dict[tuple[int, ...], tuple[list[int], FloatArray, FloatArray]]:
        """What `_follows` has found: a robot asks for the same chunks for some time."""
        return {}

    def _regress(self, c: int, given: list[int]) -> tuple[list[int], FloatArray, FloatArray]:
        own = self._between(c, c)
        while given:
            among = np.block([[self._between(g, h) for h in given] for g in given])
            cross = np.hstack([self._between(c, g) for g in given])
            try:
                root = cho_factor(among + FLOOR_M2 * np.eye(len(among)))
            except np.linalg.LinAlgError:
                given = given[:-1]
                continue
            gain = cho_solve(root, cross.T).T
            value, vector = np.linalg.eigh(own - gain @ cross.T)
            if value[0] > -TOLERATED * np.trace(own):
                return given, gain, (vector * np.maximum(value, 0.0)) @ vector.T
            given = given[:-1]
        return [], np.zeros((len(own), 0)), own

    def _near(self, chunks: IntArray) -> dict[int, set[int]]:
        """Return the neighbours of every chunk."""
        graph = self._index.graph
        return {c: set(graph.indices[graph.indptr[c] : graph.indptr[c + 1]].tolist()) for c in chunks.tolist()}

    def _elimination(self, near: dict[int, set[int]]) -> dict[int, list[int]]:
        """Return chunks in elimination order, each with the clique of earlier neighbours on which it depends."""
        order: dict[int, list[int]] = {}
        waiting = dict.fromkeys(near, 0)
        while waiting:  # maximum cardinality search: next the chunk with most visited neighbours
            c = max(waiting, key=lambda k: (waiting[k], -k))
            del waiting[c]
            known = np.array(sorted(near[c] & order.keys()), dtype=np.int64)
            away = ((self.centre_m[known] - self.centre_m[c]) ** 2).sum(axis=1)
            known_first = known[np.argsort(away, kind="stable")].tolist()
            best: list[int] = []
            for seed in known_first:
                clique = [seed]
                for other in known_first:
                    if other != seed and len(clique) < MOST_GIVEN and near[other].issuperset(clique):
                        clique.append(other)
                if len(clique) > len(best):
                    best = clique
            order[c] = best
            for other in near[c] & waiting.keys():
                waiting[other] += 1
        return order


def of_places(covariance_m2: JointCovariance, rows: IntArray, dim: int = 2) -> FloatArray:
    """Return (2 K, 2 K) joint covariance of some points, in their order; of independent ones (P, 2, 2), (K, 2, 2).

    Of points in space with `dim=3`, which only a dense one has to be told.
    """
    if isinstance(covariance_m2, ChunkedCovariance):
        return covariance_m2.of(rows)
    if covariance_m2.ndim == 3:
        return np.asarray(covariance_m2[rows])
    at = se2.xy_rows(rows, dim)
    return np.asarray(covariance_m2[np.ix_(at, at)])


def taken(covariance_m2: JointCovariance, rows: IntArray, dim: int = 2) -> JointCovariance:
    """Return the covariance of some points, in their order and in the form that it has."""
    if isinstance(covariance_m2, ChunkedCovariance):
        return covariance_m2.taken(rows)
    return of_places(covariance_m2, rows, dim)


def blocks(covariance_m2: JointCovariance, dim: int = 2) -> FloatArray:
    """Return (P, 2, 2) covariance of every point by itself."""
    if isinstance(covariance_m2, ChunkedCovariance):
        return covariance_m2.each_m2
    if covariance_m2.ndim == 3:
        return covariance_m2
    return _of_each(covariance_m2, dim)


class Update(NamedTuple):
    """Update of some of N points.

    Attributes:
        position_m: (N, 2) of all points after it.
        was: (N,) row of each before it, -1 where it is new.
        rows: (K,) points that were learned, all new ones among them.
        covariance_m2: (2 K, 2 K) joint covariance of these.
    """

    position_m: FloatArray
    was: IntArray
    rows: IntArray
    covariance_m2: FloatArray


JointCovariance = FloatArray | ChunkedCovariance
"""Joint covariance of P points: dense (2 P, 2 P), x and y interleaved; of independent ones (P, 2, 2); or in chunks."""


@dataclass(frozen=True)
class _Index:
    """Index of points and blocks.

    Attributes:
        chunk: (P,) of every point.
        order: (P,) points by chunk; `start` (C + 1,) where chunks begin in it.
        first: (Q + 1,) where the blocks of pairs begin.
        group: (G + 1,) pairs at which parts begin.
        pair: (Q, 2) the pairs; graph: (C, C) which are neighbours.
    """

    chunk: IntArray
    order: IntArray
    start: IntArray
    first: IntArray
    group: IntArray
    pair: IntArray

    @classmethod
    def of(cls, chunk: IntArray, pair: IntArray, dim: int) -> Self:
        n_chunks = int(pair.max(initial=-1)) + 1
        order = np.argsort(chunk, kind="stable")
        start = np.searchsorted(chunk[order], np.arange(n_chunks + 1))
        size = np.diff(start)
        first = np.concatenate([[0], np.cumsum(dim**2 * size[pair[:, 0]] * size[pair[:, 1]])]).astype(np.int64)
        begins = np.arange(0, n_chunks + CHUNKS_A_PART, CHUNKS_A_PART) if n_chunks else np.zeros(1, dtype=np.int64)
        group = np.searchsorted(pair[:, 0], np.minimum(begins, n_chunks))
        return cls(chunk, order, start.astype(np.int64), first, group.astype(np.int64), pair)

    def points(self, c: int) -> IntArray:
        """Return rows of the points of a chunk."""
        return self.order[self.start[c] : self.start[c + 1]]

    def pair_of(self, a: int, b: int) -> int:
        """Return the row of a pair."""
        return int(np.searchsorted(self._code, a * (len(self.start) - 1) + b))

    @functools.cached_property
    def _code(self) -> IntArray:
        return np.asarray(self.pair @ [len(self.start) - 1, 1])

    @functools.cached_property
    def graph(self) -> csr_array:
        n = len(self.start) - 1
        a, b = self.pair[self.pair[:, 0] != self.pair[:, 1]].T
        ones = np.ones(2 * len(a), dtype=np.int8)
        return csr_array((ones, (np.append(a, b), np.append(b, a))), shape=(n, n))


def _of_each(block: FloatArray, dim: int) -> FloatArray:
    """(n, 2, 2) of every point by itself, of (2 n, 2 n)."""
    n = len(block) // dim
    rows = np.arange(n)
    return np.asarray(block.reshape(n, dim, n, dim)[rows, :, rows, :])


def _transport(before: FloatArray, after: FloatArray) -> FloatArray:
    """The symmetric map of one Gaussian onto another: `A^-1/2 (A^1/2 B A^1/2)^1/2 A^-1/2`."""
    value, vector = np.linalg.eigh(before)
    root = np.sqrt(np.maximum(value, FLOOR_M2))
    half = (vector * root) @ vector.T
    middle, turned = np.linalg.eigh(half @ after @ half)
    inner = (turned * np.sqrt(np.maximum(middle, 0.0))) @ turned.T
    inverse = (vector / root) @ vector.T
    return np.asarray(inverse @ inner @ inverse)


def _halve_chunks(position_m: FloatArray) -> IntArray:
    """(P,) chunks of at most `MOST_POINTS`, numbered so that near ones have near numbers."""
    chunk = np.zeros(len(position_m), dtype=np.int64)
    count, waiting = 0, [np.arange(len(position_m))]
    while waiting:
        rows = waiting.pop()
        if len(rows) <= MOST_POINTS:
            chunk[rows] = count
            count += 1 if len(rows) else 0
            continue
        waiting += reversed(_halves(position_m, rows))
    return chunk


def _halves(position_m: FloatArray, rows: IntArray) -> list[IntArray]:
    """Points in two halves, across where they reach farthest."""
    along = int(np.argmax(np.ptp(position_m[rows], axis=0)))
    order = np.argsort(position_m[rows, along], kind="stable")
    middle = len(rows) // 2
    return [np.sort(rows[order[:middle]]), np.sort(rows[order[middle:]])]


def _centres(chunk: IntArray, position_m: FloatArray, n_chunks: int) -> FloatArray:
    """(C, 2) middles of chunks; nan of empty ones."""
    count = np.bincount(chunk, minlength=n_chunks)
    with np.errstate(invalid="ignore"):
        sums = [np.bincount(chunk, axis, minlength=n_chunks) / count for axis in position_m.T]
    return np.column_stack(sums)


def _pairs(centre: FloatArray, parent: IntArray) -> IntArray:
    """(Q, 2) neighbouring chunks."""
    from scipy.spatial import cKDTree  # takes a tenth of a second, which only large maps need

    n = len(centre)
    real = np.flatnonzero(np.isfinite(centre[:, 0]))
    own = np.arange(n)
    a, b = [own, own[parent >= 0]], [own, parent[parent >= 0]]
    if len(real) > 1:
        count = min(NEIGHBOURS + 1, len(real))
        _, near = cKDTree(centre[real]).query(centre[real], count)
        a.append(np.repeat(real, count))
        b.append(real[near.ravel()])
    one, other = np.concatenate(a), np.concatenate(b)
    code = np.unique(np.minimum(one, other) * max(n, 1) + np.maximum(one, other))
    return np.column_stack([code // max(n, 1), code % max(n, 1)])


def _join_points(new: Update, before: ChunkedCovariance) -> tuple[IntArray, IntArray]:
    """(N,) chunks of the points after an update, and (C,) parents: new points join the nearest chunk, and those that
    have too many then are halved.
    """
    from scipy.spatial import cKDTree

    known = new.was >= 0
    chunk = np.full(len(new.was), -1, dtype=np.int64)
    chunk[known] = before.chunk[new.was[known]]
    fresh = np.flatnonzero(~known)
    if len(fresh):
        real = np.flatnonzero(np.isfinite(before.centre_m[:, 0]))
        chunk[fresh] = real[cKDTree(before.centre_m[real]).query(new.position_m[fresh])[1]]
    parents = before.parent.tolist()
    waiting = np.unique(chunk[fresh]).tolist()
    while waiting:
        c = waiting.pop()
        rows = np.flatnonzero(chunk == c)
        if len(rows) > MOST_POINTS:
            chunk[_halves(new.position_m, rows)[1]] = len(parents)
            waiting += [c, len(parents)]
            parents.append(c)
    return chunk, np.array(parents, dtype=np.int64)
