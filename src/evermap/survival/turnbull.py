"""The likelihood of censored lifetimes on its cells: a rough step over all cells, and a Newton step over few.

Nodes `0 .. m` lie between the `m` cells (the maximal intersections); node k is the time after cells `0 .. k - 1`.
A sample is an edge between two nodes, and its probability is the mass between them. Masses below a node are `below`,
those above it `above`; both are sums of positive numbers, so that neither tail cancels.

In terms of the masses below the nodes the Hessian `H` of the log likelihood is a weighted Laplacian: an edge of weight
w between nodes a and b adds `w (x_a - x_b)^2` to the quadratic form. Both end nodes are fixed, so an edge to one of
them is on the diagonal alone.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from evermap.survival.censored import CensoredLifetimes
from evermap.types import BoolArray, FloatArray, IntArray

SMALLEST = 1e-300
"""Replaces a mass of 0 in divisions and logarithms."""
DIRECT = 2e9
"""Largest number of multiplications of a direct solution; beyond, conjugate gradients solve."""
LEAP = 20.0
"""Largest decrease of a cumulative hazard in one step."""
WORTH = 0.3
"""A step with an old Hessian is followed by another if it leaves at most this share of the violation."""
ROUNDS = 30
"""Largest number of solutions for one step, each with fewer cells."""
MOST_GRADIENTS = 2000
"""Largest number of conjugate gradients of one solution."""


class Terms(NamedTuple):
    """Weights of the terms of the likelihood; samples with the same edge may be merged.

    Attributes:
        within: (m,) weight of samples in this cell alone.
        before: (m + 1,) weight of samples below this node, that is in all cells before it.
        after: (m + 1,) weight of samples above it.
        entered: (m + 1,) weight of samples that are known only because they lie above it (left truncation).
        first, last: (E,) nodes of the other samples, `0 < first`, `first + 1 < last < m`.
        weight: (E,) their weights.
    """

    within: FloatArray
    before: FloatArray
    after: FloatArray
    entered: FloatArray
    first: IntArray
    last: IntArray
    weight: FloatArray

    def diagonal(self) -> FloatArray:
        """Return the diagonal (m + 1,) of the Laplacian."""
        nodes = self.before.size
        sums = self.before + self.after + _tally(self.first, self.weight, nodes) + _tally(self.last, self.weight, nodes)
        sums[:-1] += self.within
        sums[1:] += self.within
        return sums

    def times(self, x: FloatArray) -> FloatArray:
        """Return the product (m + 1,) of the Laplacian and movements of the nodes, 0 at both ends."""
        near, far = self.within * np.diff(x), self.weight * (x[self.last] - x[self.first])
        force = (self.before + self.after) * x - _tally(self.first, far, x.size) + _tally(self.last, far, x.size)
        force[:-1] -= near
        force[1:] += near
        return force


def from_samples(data: CensoredLifetimes) -> tuple[FloatArray, FloatArray, Terms]:
    """Find the maximal intersections of the samples, and the likelihood on them.

    A cell is a start with no other before the next end. At one time: exact ends start, then all ends and entries end,
    then intervals start. An entry is an end, since mass leaves the truncation sets by moving left (Frydman 1994); so is
    infinity.

    Returns:
        start (m,) and end (m,) of the cells in seconds, in order, a point where they are equal; and the terms.
    """
    # Never seen gone since it entered: of probability 1 whatever the distribution.
    silent = (data.weight == 0.0) | (np.isinf(data.right_s) & (data.left_s <= data.entry_s))
    counted = np.flatnonzero(~silent if not silent.all() else data.weight > 0.0)
    rows = counted[np.argsort(data.left_s[counted])]  # in order of time, in which memory is read fastest
    left, right, entry, weight = (column[rows] for column in (data.left_s, data.right_s, data.entry_s, data.weight))
    exact = left == right
    left = np.where(exact, left, np.maximum(left, entry))
    points, starts = np.unique(right[exact]), np.unique(left[~exact])
    closes = np.unique(np.concatenate([points, right[~exact], entry[entry > 0.0], [np.inf]]))
    start = np.append(-np.inf, starts)[np.searchsorted(starts, closes)]
    start[np.searchsorted(closes, points)] = points
    cells = start >= np.append(0.0, closes[:-1])
    start, end = start[cells], closes[cells]

    m, none = start.size, np.zeros(start.size + 1)
    last = _nodes(end, right)
    within = _tally(last[exact] - 1, weight[exact], m)
    entered = _tally(_nodes(end, entry), weight, m + 1)
    first = np.searchsorted(end, left[~exact], side="right")
    raw = Terms(within, none, none, entered, first, last[~exact], weight[~exact])
    return start, end, contract(raw, np.arange(m + 1))


def _nodes(end: FloatArray, times: FloatArray) -> IntArray:
    """Return how many cells end until each time; looked up in order, which takes a quarter of the time."""
    order = np.argsort(times)
    node = np.empty(times.size, np.int64)
    node[order] = np.searchsorted(end, times[order], side="right")
    return node


def contract(terms: Terms, node: IntArray) -> Terms:
    """Merge nodes: `node` (m + 1,) are their new numbers, from 0 and never decreasing.

    Edges become simpler kinds, or nothing where their ends are one node.
    """
    m = int(node[-1])
    first, last, weight = node[terms.first], node[terms.last], terms.weight
    if (m + 1) ** 2 < weight.size:  # many edges between few nodes: equal ones become one
        total = _tally(first * (m + 1) + last, weight, (m + 1) ** 2)
        key = np.flatnonzero(total)
        (first, last), weight = np.divmod(key, m + 1), total[key]
    is_after, is_before = last == m, first == 0
    is_within = ~is_after & ~is_before & (last == first + 1)
    is_before &= ~is_after
    edge = ~is_after & ~is_before & (last > first + 1)
    before, after, entered = (_tally(node, one, m + 1) for one in (terms.before, terms.after, terms.entered))
    within = terms.within[node[:-1] < node[1:]] + _tally(first[is_within], weight[is_within], m)
    before += _tally(last[is_before], weight[is_before], m + 1)
    after += _tally(first[is_after], weight[is_after], m + 1)
    return Terms(within, before, after, entered, first[edge], last[edge], weight[edge])


def names(kept: BoolArray) -> IntArray:
    """Return the numbers (m + 1,) of the nodes when only these cells (m,) are kept, for `contract`."""
    return np.append(0, np.cumsum(kept))


def best_between(slope: FloatArray, least: float, inside: BoolArray) -> BoolArray:
    """Return a support (m,) with the cell of the largest slope above `least` in every gap of it as well."""
    rows = np.flatnonzero(~inside & (slope > least))
    rows = rows[np.argsort(-slope[rows], kind="stable")]
    _, best = np.unique(np.cumsum(inside)[rows], return_index=True)
    support = inside.copy()
    support[rows[best]] = True
    return support


class Point:
    """Masses (m,) on the cells, and the likelihood there.

    Attributes:
        below, above: (m + 1,) mass on either side of every node.
        span: (E,) mass of every edge.
    """

    def __init__(self, terms: Terms, mass: FloatArray) -> None:
        self.terms, self.mass = terms, mass
        self.below, self.above = np.append(0.0, np.cumsum(mass)), np.append(np.cumsum(mass[::-1])[::-1], 0.0)
        below, above = ((side[terms.first], side[terms.last]) for side in (self.below, self.above))
        # in the upper half the masses above are smaller, and their difference is more exact
        self.span = np.where(below[0] > 0.5, above[0] - above[1], below[1] - below[0])

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
        terms, nodes = self.terms, self.below.size
        falls = terms.before / np.maximum(self.below, SMALLEST)
        rate = (terms.after - terms.entered) / np.maximum(self.above, SMALLEST) - falls
        rate[0] += falls.sum()
        with np.errstate(divide="ignore", invalid="ignore"):  # a sample without mass
            pull = terms.weight / self.span
            rate += _tally(terms.first, pull, nodes) - _tally(terms.last, pull, nodes)
            return np.asarray(np.cumsum(rate[:-1]) + terms.within / np.maximum(self.mass, SMALLEST))

    @functools.cached_property
    def kkt_violation(self) -> float:
        """Return the violation of the optimality conditions: slopes 0 where there is mass, not positive elsewhere."""
        worst = max(float(self.slope.max()), -float(self.slope.min(where=self.mass > 0.0, initial=0.0)))
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
        # Nodes with linear terms alone still need a scale to move by.
        return curvature._replace(after=np.where(curvature.diagonal() > 0.0, 0.0, 1.0 + terms.after + terms.entered))


def _tally(place: IntArray, weight: FloatArray, size: int) -> FloatArray:
    return np.asarray(np.bincount(place, weight, size), np.float64)  # of no rows it returns whole numbers


def _sum_of_logs(weight: FloatArray, probability: FloatArray) -> float:
    return float(np.sum(weight * np.log(np.where(weight != 0.0, probability, 1.0))))


def _bent(weight: FloatArray, probability: FloatArray) -> FloatArray:
    return np.asarray(weight / np.maximum(np.square(probability), SMALLEST))


def rough_step(point: Point) -> Point:
    """Take a step of expectation maximisation, then of the iterative convex minorant (Wellner and Zhan 1997).

    Both are linear in all sizes. The first is good where exact samples couple neighbours, the second everywhere else,
    and it empties cells.
    """
    from scipy.optimize import isotonic_regression

    point = _expectation_step(point)
    if point.mass.size == 1:
        return point
    diagonal = point.curvature(truncated=False).diagonal()[1:-1]
    wanted = point.below[1:-1] - np.diff(point.slope) / diagonal  # a Newton step by the masses below the nodes
    below = np.clip(isotonic_regression(wanted, weights=diagonal).x, 0.0, 1.0)
    return _climb(point, np.diff(below, prepend=0.0, append=1.0) - point.mass)


def _expectation_step(point: Point) -> Point:
    """Take a step of expectation maximisation: Kaplan-Meier of the expected deaths, with delayed entry.

    Without truncation this is Turnbull's self-consistency; with it, conditioning on the entry avoids imputing the
    samples that were never seen, which makes Turnbull's own version slow.
    """
    entered = point.terms.entered[:-1]
    pull = np.cumsum(np.where(entered > 0.0, entered / np.maximum(point.above[:-1], SMALLEST), 0.0))
    deaths = np.maximum(point.mass * (point.slope + pull), 0.0)
    at_risk = np.cumsum(entered) - np.cumsum(deaths) + deaths
    share = np.minimum(np.divide(deaths, at_risk, out=np.zeros(deaths.size), where=at_risk > 0.0), 1.0)
    mass = np.append(1.0, np.cumprod(1.0 - share)[:-1]) * share
    return Point(point.terms, mass / mass.sum())  # what is left over by rounding is shared out


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
    return new if factor is None or not new.mass.all() else _take_more_steps(new, factor)


def _take_more_steps(point: Point, factor: FloatArray) -> Point:
    """Take further steps with the factorised Hessian of a point close by, which cost a fifth, while they pay off."""
    from scipy.linalg import lapack

    while point.kkt_violation > SMALLEST:
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
    place = -np.log(np.maximum(point.above, SMALLEST)) if hazards else point.below
    tolerance = min(max(point.kkt_violation, 1e-8), 1e-3)
    kept = np.ones(point.mass.size, dtype=bool)
    few, pull, shift, node = matrix, force, np.zeros(force.size), np.arange(force.size)
    for _ in range(ROUNDS):
        move, factor = _solve_steps(few, pull, tolerance)
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
        few = contract(matrix, node)
        pull = _tally(node, force - matrix.times(shift), int(node[-1]) + 1)
        pull[0] = pull[-1] = 0.0
    return None, None


def _solve_steps(matrix: Terms, force: FloatArray, tolerance: float) -> tuple[FloatArray | None, FloatArray | None]:
    """Solve for the movement of the nodes (m + 1,), both ends fixed; None if the matrix is not positive definite.

    Returns also the matrix as LAPACK's `pbtrf` factorises it, if that was used.
    """
    inner = matrix.within.size - 1
    move = np.zeros(inner + 2)
    if inner == 0:
        return move, None
    first, apart = matrix.first - 1, matrix.last - matrix.first
    band = int(apart.max(initial=min(1, inner - 1)))
    if float(inner) * band * band > DIRECT:
        return _by_gradients(matrix, force, tolerance), None
    from scipy.linalg import lapack

    lower = _tally(first * (band + 1) + apart, -matrix.weight, inner * (band + 1)).reshape(inner, band + 1).T
    lower[0] = matrix.diagonal()[1:-1]
    lower[1:2, :-1] -= matrix.within[1:-1]
    with _blas().limit(limits=1, user_api="blas"):  # matrices this small are faster on one thread
        factor, move[1:-1], failed = lapack.dpbsv(lower, force[1:-1], lower=1, overwrite_ab=1)
    return (None, None) if failed else (move, factor)


def _by_gradients(matrix: Terms, force: FloatArray, tolerance: float) -> FloatArray | None:
    """Solve for the movement of the nodes by conjugate gradients, preconditioned by a tridiagonal matrix.

    Args:
        matrix: the Laplacian.
        force: (m + 1,) right hand side, 0 at both ends.
        tolerance: of the residual in the norm of the preconditioner's inverse, relative to that of `force`.

    Returns:
        None if the matrix or the preconditioner is not positive definite.
    """
    from scipy.linalg import lapack

    pivots, ratios, failed = lapack.dpttrf(_tridiagonal(matrix), -matrix.within[1:-1])
    if failed:
        return None
    x, way, z = np.zeros((3, force.size))
    residual, before, least = force, np.inf, -np.inf
    for _ in range(MOST_GRADIENTS):
        z[1:-1], _ = lapack.dpttrs(pivots, ratios, residual[1:-1])
        now = float(residual @ z)
        least = tolerance * tolerance * now if before == np.inf else least
        if now <= least:
            break
        way = z + now / before * way
        bent = matrix.times(way)
        curvature = float(way @ bent)
        if not curvature > 0.0:
            return None
        x += now / curvature * way
        residual = residual - now / curvature * bent
        before = now
    return x


def _tridiagonal(matrix: Terms) -> FloatArray:
    """Return the diagonal (m - 1,) of a tridiagonal preconditioner, its other entries those of the matrix.

    Edges between distant nodes are dropped where neighbours hold a node, and count for the diagonal where it would be
    loose without them.
    """
    chain = np.append(matrix.within, 0.0) + np.append(0.0, matrix.within)
    empty = matrix.within == 0.0
    loose = np.append(empty, False) | np.append(False, empty)
    return np.where(loose, matrix.diagonal(), matrix.before + matrix.after + chain)[1:-1]


@functools.cache
def _blas() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
