"""Censored lifetimes as their likelihood sees them: cells that may hold mass, and samples as edges between nodes."""

from __future__ import annotations

import functools

import numpy as np

from evermap.survival import laplacian
from evermap.survival import turnbull_kernels as kernels
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.turnbull_kernels import Terms
from evermap.types import BoolArray, FloatArray, IntArray


def from_samples(data: CensoredLifetimes) -> tuple[FloatArray, FloatArray, Terms]:
    """The maximal intersections of the samples, and the likelihood on them.

    Returns:
        start (m,) and end (m,) of the cells in seconds, in order, a point where they are equal; and the terms.
    """
    columns = (data.left_s, data.right_s, data.entry_s, data.weight)
    # Never seen gone since it was first heard of: of probability 1 whatever the distribution.
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
    start, end = np.empty(cells), np.empty(cells)
    nodes = [np.empty(rows.size, np.int64) for rows in (point_row, end_row, entry_row, start_row)]
    m = kernels.sweep(zero_row.size > 0, point_s, end_s, entry_s, start_s, start, end, *nodes)
    point_cell, end_node, entry_node, start_node = nodes

    entered = _tally(entry_node, weight[entry_row], m + 1)
    entered[0] += np.sum(weight[entry == 0.0])
    last = np.full(left.size, m)
    last[end_row] = end_node
    rows = np.concatenate((zero_row, start_row))  # in order of time, which is how memory is read fastest
    first = np.concatenate((np.zeros(zero_row.size, np.int64), start_node))
    within, none = _tally(point_cell, weight[point_row], m), np.zeros(m + 1)
    raw = Terms(within, none, none, entered, first, last[rows], weight[rows])
    return start[:m], end[:m], contract(raw, np.arange(m + 1))


def contract(terms: Terms, node: IntArray) -> Terms:
    """The same samples with nodes merged: `node` (m + 1,) names them anew, from 0 and never decreasing."""
    m, edges = int(node[-1]), terms.first.size
    within, before, after, entered = np.zeros(m), np.zeros(m + 1), np.zeros(m + 1), np.zeros(m + 1)
    first, last, weight = np.empty(edges, np.int64), np.empty(edges, np.int64), np.empty(edges)
    left = kernels.contract(terms, node, within, before, after, entered, first, last, weight)
    if (m + 1) ** 2 < left:
        left = kernels.merge_equal(first[:left], last[:left], weight[:left], np.zeros((m + 1, m + 1)))
    return Terms(within, before, after, entered, first[:left], last[:left], weight[:left])


def names(kept: BoolArray) -> IntArray:
    """Names (m + 1,) of the nodes when only these cells (m,) are kept, as `contract` wants them."""
    node = np.zeros(kept.size + 1, np.int64)
    np.cumsum(kept, out=node[1:])
    return node


class Point:
    """Masses (m,) on the cells of some terms, and what follows from them.

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
        """Log likelihood, `-inf` where a sample has no mass."""
        terms = self.terms
        with np.errstate(divide="ignore", invalid="ignore"):
            total = _sum_of_logs(terms.within, self.mass) + _sum_of_logs(terms.before, self.below)
            total += _sum_of_logs(terms.after - terms.entered, self.above) + _sum_of_logs(terms.weight, self.span)
        return -np.inf if np.isnan(total) else total

    @functools.cached_property
    def slope(self) -> FloatArray:
        """(m,) derivatives of the log likelihood by the masses, which weighted by these sum to 0."""
        slope = np.empty(self.mass.size)
        kernels.slopes(self.terms, self.mass, self.below, self.above, self.span, slope)
        return slope

    @property
    def kkt_violation(self) -> float:
        """How far the slopes are from 0 where there is mass and from not positive elsewhere, for each sample."""
        worst = max(float(self.slope.max()), float(np.abs(np.where(self.mass > 0.0, self.slope, 0.0)).max()))
        return worst / float(self.terms.entered.sum())

    def curvature(self, *, truncated: bool = True) -> Terms:
        """The edges with negative second derivatives by the masses below the nodes for weights: a Laplacian.

        Args:
            truncated: with the part of truncation, which may be negative.
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
        """The same by the cumulative hazards `-log above`, in which the likelihood is concave, truncated or not.

        `log(exp(-x) - exp(-y))` is concave, and what lies above a node, counted or divided by, is linear.
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
        laplacian.diagonal(curvature, diagonal)
        # Nodes of linear terms alone, which a cell between them is about to lose, still need a scale to move by.
        return curvature._replace(after=np.where(diagonal > 0.0, 0.0, 1.0 + terms.after + terms.entered))


def _sorted(values: FloatArray, chosen: BoolArray) -> tuple[IntArray, FloatArray]:
    rows = np.flatnonzero(chosen)
    times = values[rows]
    kernels.sort_together(times.view(np.int64), rows)
    return rows, times


def _tally(place: IntArray, weight: FloatArray, size: int) -> FloatArray:
    return np.bincount(place, weight, size).astype(np.float64)  # of nothing at all it counts whole numbers


def _sum_of_logs(weight: FloatArray, probability: FloatArray) -> float:
    return float(np.sum(weight * np.log(np.where(weight != 0.0, probability, 1.0))))


def _bent(weight: FloatArray, probability: FloatArray) -> FloatArray:
    return np.asarray(weight / np.maximum(np.square(probability), kernels.SMALLEST))
