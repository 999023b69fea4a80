"""The likelihood of censored lifetimes on its cells: a rough step over all cells, and a Newton step over few."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from evermap.survival import turnbull_kernels as kernels
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.turnbull_kernels import Cells, Stamps, Terms
from evermap.types import BoolArray, FloatArray, IntArray

DIRECT = 2e9
"""Largest number of multiplications of a direct solution; beyond, conjugate gradients solve."""
LEAP = 20.0
"""Largest decrease of a cumulative hazard in one step."""
WORTH = 0.3
"""A step with an old Hessian is followed by another if it leaves at most this share of the violation."""
ROUNDS = 30
"""Largest number of solutions for one step, each with fewer cells."""


def from_samples(data: CensoredLifetimes) -> tuple[FloatArray, FloatArray, Terms]:
    """Find the maximal intersections of the samples, and the likelihood on them.

    Returns:
        start (m,) and end (m,) of the cells in seconds, in order, a point where they are equal; and the terms.
    """
    columns = (data.left_s, data.right_s, data.entry_s, data.weight)
    # Never seen gone since it entered: of probability 1 whatever the distribution.
    silent = (data.weight == 0.0) | (np.isinf(data.right_s) & (data.left_s <= data.entry_s))
    counted = ~silent if not silent.all() else data.weight > 0.0
    left, right, entry, weight = columns if counted.all() else (column[counted] for column in columns)
    exact = left == right
    if entry.any():
        left = np.where(exact, left, np.maximum(left, entry))
    point_row, point_s = _sorted(right, exact)
    end_row, end_s = _sorted(right, ~exact & (right < np.inf))
    entry_row, entry_s = _sorted(entry, entry > 0.0)
    start_row, start_s = _sorted(left, ~exact & (left > 0.0))
    zero_row = np.flatnonzero(left == 0.0)

    cells = point_s.size + start_s.size + 1
    nodes = (np.empty(rows.size, np.int64) for rows in (point_row, end_row, entry_row, start_row))
    found = Cells(np.empty(cells), np.empty(cells), *nodes)
    m = kernels.sweep(zero_row.size > 0, Stamps(point_s, end_s, entry_s, start_s), found)

    entered = _tally(found.entry_node, weight[entry_row], m + 1)
    entered[0] += np.sum(weight[entry == 0.0])
    last = np.full(left.size, m)
    last[end_row] = found.end_node
    rows = np.concatenate((zero_row, start_row))  # in order of time, in which memory is read fastest
    first = np.concatenate((np.zeros(zero_row.size, np.int64), found.start_node))
    within, none = _tally(found.point_cell, weight[point_row], m), np.zeros(m + 1)
    raw = Terms(within, none, none, entered, first, last[rows], weight[rows])
    return found.start[:m], found.end[:m], contract(raw, np.arange(m + 1))


def contract(terms: Terms, node: IntArray) -> Terms:
    """Merge nodes: `node` (m + 1,) are their new numbers, from 0 and never decreasing."""
    m, edges = int(node[-1]), terms.first.size
    before, after, entered = np.zeros((3, m + 1))
    first, last = np.empty((2, edges), np.int64)
    merged = Terms(np.zeros(m), before, after, entered, first, last, np.empty(edges))
    left = kernels.contract(terms, node, merged)
    first, last, weight = merged.first[:left], merged.last[:left], merged.weight[:left]
    if (m + 1) ** 2 < left:
        left = kernels.merge_equal(first, last, weight, np.zeros((m + 1, m + 1)))
    return merged._replace(first=first[:left], last=last[:left], weight=weight[:left])


def names(kept: BoolArray) -> IntArray:
    """Return the numbers (m + 1,) of the nodes when only these cells (m,) are kept, for `contract`."""
    node = np.zeros(kept.size + 1, np.int64)
    np.cumsum(kept, out=node[1:])
    return node


class Point:
    """Masses (m,) on the cells, and the likelihood there.

    Attributes:
        below, above: (m + 1,) mass on either side of every node.
        span: (E,) mass of every edge.
    """

    def __init__(self, terms: Terms, mass: FloatArray) -> None:
        self.terms, self.mass = terms, mass
        self.below, self.above = np.empty(mass.size + 1), np.empty(mass.size + 1)
        self.span = np.empty(terms.first.size)
        kernels.spread(terms, mass, self.below, self.above, self.span)

    @functools.cached_property
    def loglik(self) -> float:
        """Return the log likelihood, `-inf` where a sample has no mass."""
        terms = self.terms
        with np.errstate(divide="ignore", invalid="ignore"):
            total = _sum_of_logs(terms.within, self.mass) + _sum_of_logs(terms.before, self.below)
            total += _sum_of_logs(terms.after - terms.entered, self.above) + _sum_of_logs(terms.weight, self.span)
        return -np.inf if np.isnan(total) else total

    @functools.cached_property
    def slope(self) -> FloatArray:
        """Return the derivatives (m,) of the log likelihood by the masses, which weighted by these sum to 0."""
        slope = np.empty(self.mass.size)
        kernels.slopes(self.terms, self.mass, self.below, self.above, self.span, slope)
        return slope

    @property
    def kkt_violation(self) -> float:
        """Return the violation of the optimality conditions: slopes 0 where there is mass, not positive elsewhere."""
        worst = max(float(self.slope.max()), float(np.abs(np.where(self.mass > 0.0, self.slope, 0.0)).max()))
        return worst / float(self.terms.entered.sum())

    def curvature(self, *, truncated: bool = True) -> Terms:
        """Return the Hessian by the masses below the nodes, as the weights of its Laplacian.

        Args:
            truncated: include the part of truncation, which may be negative.
        """
        terms = self.terms
        return terms._replace(
            within=_bent(terms.within, self.mass),
            before=_bent(terms.before, self.below),
            after=_bent(terms.after - terms.entered if truncated else terms.after, self.above),
            entered=np.zeros(terms.entered.size),
            weight=_bent(terms.weight, self.span),
        )

    def hazard_curvature(self) -> Terms:
        """Return the Hessian by the cumulative hazards `-log above`, by which the likelihood is always concave.

        `log(exp(-x) - exp(-y))` is concave, and terms of what lies above a node are linear.
        """
        terms, s = self.terms, self.above
        curvature = terms._replace(
            within=_bent(terms.within * s[:-1] * s[1:], self.mass),
            before=_bent(terms.before * s, self.below),
            after=np.zeros(s.size),
            entered=np.zeros(s.size),
            weight=_bent(terms.weight * s[terms.first] * s[terms.last], self.span),
        )
        diagonal = np.empty(s.size)
        kernels.diagonal(curvature, diagonal)
        # Nodes with linear terms alone still need a scale to move by.
        return curvature._replace(after=np.where(diagonal > 0.0, 0.0, 1.0 + terms.after + terms.entered))


def _sorted(values: FloatArray, chosen: BoolArray) -> tuple[IntArray, FloatArray]:
    rows = np.flatnonzero(chosen)
    times = values[rows]
    kernels.sort_together(times.view(np.int64), rows)
    return rows, times


def _tally(place: IntArray, weight: FloatArray, size: int) -> FloatArray:
    return np.bincount(place, weight, size).astype(np.float64)  # of no rows it returns whole numbers


def _sum_of_logs(weight: FloatArray, probability: FloatArray) -> float:
    return float(np.sum(weight * np.log(np.where(weight != 0.0, probability, 1.0))))


def _bent(weight: FloatArray, probability: FloatArray) -> FloatArray:
    return np.asarray(weight / np.maximum(np.square(probability), kernels.SMALLEST))


def rough_step(point: Point) -> Point:
    """Take a step of expectation maximisation, then of the iterative convex minorant (Wellner and Zhan 1997).

    Both are linear in all sizes. The first is good where exact samples couple neighbours, the second everywhere else,
    and it empties cells.
    """
    mass = point.mass.copy()
    kernels.expectation_step(point.terms, point.above, point.slope, mass)
    point = Point(point.terms, mass)
    diagonal, proposal = np.empty(mass.size + 1), np.empty(mass.size)
    kernels.diagonal(point.curvature(truncated=False), diagonal)
    kernels.isotonic_step(point.slope, diagonal, point.below, proposal)
    return _climb(point, proposal - mass)


def newton_step(point: Point) -> Point:
    """Take a Newton step; cells that would get a negative mass are emptied.

    It is by the masses below the nodes, where a step can empty the last cells too; if that fails, which truncation may
    cause, by the cumulative hazards.
    """
    by_mass = np.zeros(point.below.size)
    by_mass[1:-1] = -np.diff(point.slope)
    step, factor = _proposal(point, point.curvature(), by_mass, hazards=False)
    new = _along(point, step)
    if new is point:
        step, _ = _proposal(point, point.hazard_curvature(), by_mass * point.above, hazards=True)
        new = _along(point, step)
        return rough_step(point) if new is point else new
    return new if factor is None or not new.mass.all() else _refined(new, factor)


def _refined(point: Point, factor: FloatArray) -> Point:
    """Take further steps with the factorised Hessian of a point close by, which cost a fifth, while they pay off."""
    from scipy.linalg import lapack

    while point.kkt_violation > kernels.SMALLEST:
        move = np.zeros(point.below.size)
        move[1:-1], _ = lapack.dpbtrs(factor, -np.diff(point.slope), lower=1)
        new = _climb(point, np.diff(move))
        if new.kkt_violation > WORTH * point.kkt_violation:
            return point
        point = new
    return point


def _along(point: Point, step: FloatArray | None) -> Point:
    return point if step is None or np.sum(point.slope * step) < 0.0 else _climb(point, step)


def _climb(point: Point, step: FloatArray) -> Point:
    """Go along a step, halved until the likelihood is no worse up to rounding; or return the point itself."""
    least = point.loglik - 1e-13 * abs(point.loglik)
    share = 1.0
    while share > 1e-6:
        mass = np.maximum(point.mass + share * step, 0.0)
        new = Point(point.terms, mass / mass.sum())
        if new.loglik >= least:
            return new
        share *= 0.5
    return point


def _proposal(
    point: Point, matrix: Terms, force: FloatArray, *, hazards: bool
) -> tuple[FloatArray | None, FloatArray | None]:
    """Change the masses to the maximum of the quadratic model, dropping cells until none is negative.

    Without a cell its two nodes move together, after a jump `shift` that closes the gap between them.

    Args:
        point: where the model was made.
        matrix: its negative second derivatives.
        force: (m + 1,) its first derivatives, 0 at both ends.
        hazards: they are by the cumulative hazards, not by the masses below the nodes.

    Returns:
        (m,) the change, None if there is no maximum; and the factorised matrix, if there is one and no cell was
        dropped.
    """
    place = -np.log(np.maximum(point.above, kernels.SMALLEST)) if hazards else point.below
    tolerance = min(max(point.kkt_violation, 1e-8), 1e-3)
    kept = np.ones(point.mass.size, dtype=bool)
    few, pull, shift, node = matrix, force, np.zeros(force.size), np.arange(force.size)
    for _ in range(ROUNDS):
        move, factor = _solved(few, pull, tolerance)
        if move is None:
            return None, None
        change = shift + move[node]
        step = -np.diff(point.above * np.expm1(-np.maximum(change, -LEAP))) if hazards else np.diff(change)
        step[~kept] = -point.mass[~kept]
        after = point.mass + step
        if not (kept & (after < 0.0)).any():
            return np.asarray(step), factor if kept.all() else None
        kept &= after > 0.0
        node = names(kept)
        together = place[np.concatenate(([True], kept))]
        together[-1] = place[-1]
        shift = together[node] - place
        few, resistance = contract(matrix, node), np.empty(force.size)
        kernels.product(matrix, shift, resistance)
        pull = np.bincount(node, force - resistance).astype(np.float64)
        pull[0] = pull[-1] = 0.0
    return None, None


def _solved(matrix: Terms, force: FloatArray, tolerance: float) -> tuple[FloatArray | None, FloatArray | None]:
    """Solve for the movement of the nodes (m + 1,), both ends fixed; None if the matrix is not positive definite.

    Returns also the matrix as LAPACK's `pbtrf` factorises it, if that was used.
    """
    inner = matrix.within.size - 1
    move = np.zeros(inner + 2)
    if inner == 0:
        return move, None
    band = min(kernels.bandwidth(matrix), inner - 1)
    if float(inner) * band * band > DIRECT:
        steps = kernels.conjugate_gradients(matrix, _anchors(matrix), force, tolerance, 2000, move)
        return None if steps < 0 else move, None
    from scipy.linalg import lapack

    lower = np.zeros((band + 1, inner), order="F")
    kernels.banded(matrix, lower)
    with _blas().limit(limits=1, user_api="blas"):  # matrices this small are faster on one thread
        factor, move[1:-1], failed = lapack.dpbsv(lower, force[1:-1], lower=1, overwrite_ab=1)
    return (None, None) if failed else (move, factor)


def _anchors(matrix: Terms) -> FloatArray:
    """Return edges (m + 1,) of the nodes to the fixed ends, for a tridiagonal preconditioner of this matrix.

    Other edges are dropped where neighbours hold a node, and counted as anchors where it would be loose without them.
    """
    anchors = matrix.before + matrix.after
    others = np.empty(anchors.size)
    kernels.diagonal(matrix, others)
    loose = np.zeros(anchors.size, dtype=bool)
    loose[1:] |= matrix.within == 0.0
    loose[:-1] |= matrix.within == 0.0
    others -= anchors
    others[1:] -= matrix.within
    others[:-1] -= matrix.within
    return np.asarray(np.where(loose, anchors + others, anchors))


@functools.cache
def _blas() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
