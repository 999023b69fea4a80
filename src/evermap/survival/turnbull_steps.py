"""Two ways up the likelihood of censored lifetimes: a rough step over all cells, an exact one over few."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from evermap.survival import laplacian
from evermap.survival import turnbull_kernels as kernels
from evermap.survival.turnbull_kernels import Terms
from evermap.survival.turnbull_terms import Point, contract, names
from evermap.types import FloatArray

DIRECT = 2e9
"""Most multiplications of a direct solution; what takes more is solved by conjugate gradients."""
LEAP = 20.0
"""Most by which a cumulative hazard may fall in one step."""
WORTH = 0.3
"""What a step with an old Hessian must leave of the violation, at most, to be followed by another."""
ROUNDS = 30
"""Most solutions for one step, each with fewer cells."""


def rough_step(point: Point) -> Point:
    """Expectation maximisation, then the iterative convex minorant (Wellner and Zhan 1997); linear in all sizes.

    The first is good where exact samples tie neighbours together, the second everywhere else, and it empties cells.
    """
    mass = point.mass.copy()
    kernels.expectation_step(point.terms, point.above, point.slope, mass)
    point = Point(point.terms, mass)
    diagonal, proposal = np.empty(mass.size + 1), np.empty(mass.size)
    laplacian.diagonal(point.curvature(truncated=False), diagonal)
    kernels.isotonic_step(point.slope, diagonal, point.below, proposal)
    return _climb(point, proposal - mass)


def newton_step(point: Point) -> Point:
    """Newton's method, cells that would get a negative mass being emptied.

    By the masses below the nodes, where a step can empty the last cells too; if that fails, which truncation may cause,
    by the cumulative hazards.
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
    """Steps with the factorised Hessian of a point close by, which cost a fifth, while each is worth it."""
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
    """Along a step, halved until the likelihood is no worse but for rounding; or the point itself."""
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
    """Change (m,) of the masses to the maximum of the quadratic model, by dropping cells until none is negative.

    Without a cell its two nodes move together, from a jump `shift` that closes the gap between them.

    Args:
        point: where the model was made.
        matrix: its negative second derivatives.
        force: (m + 1,) its first derivatives, 0 at both ends.
        hazards: they are by the cumulative hazards, not by the masses below the nodes.

    Returns:
        The change, None if there is no maximum; and the factorised matrix, if there is one and no cell was dropped.
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
        laplacian.product(matrix, shift, resistance)
        pull = np.bincount(node, force - resistance).astype(np.float64)
        pull[0] = pull[-1] = 0.0
    return None, None


def _solved(matrix: Terms, force: FloatArray, tolerance: float) -> tuple[FloatArray | None, FloatArray | None]:
    """Movement of the nodes (m + 1,), both ends fixed, under a force; None if the matrix is not positive definite.

    With it the matrix as LAPACK's `pbtrf` factorises it, if that is how it was solved.
    """
    inner = matrix.within.size - 1
    move = np.zeros(inner + 2)
    if inner == 0:
        return move, None
    band = min(laplacian.bandwidth(matrix), inner - 1)
    if float(inner) * band * band > DIRECT:
        steps = laplacian.conjugate_gradients(matrix, _anchors(matrix), force, tolerance, 2000, move)
        return None if steps < 0 else move, None
    from scipy.linalg import lapack

    lower = np.zeros((band + 1, inner), order="F")
    laplacian.banded(matrix, lower)
    with _blas().limit(limits=1, user_api="blas"):  # for matrices this small, threads only get in each other's way
        factor, move[1:-1], failed = lapack.dpbsv(lower, force[1:-1], lower=1, overwrite_ab=1)
    return (None, None) if failed else (move, factor)


def _anchors(matrix: Terms) -> FloatArray:
    """Edges (m + 1,) of the nodes to the fixed ends, in a tridiagonal matrix that is close to this one.

    Other edges are left out where neighbours hold a node, and taken for anchors where it would be loose without them.
    """
    anchors = matrix.before + matrix.after
    others = np.empty(anchors.size)
    laplacian.diagonal(matrix, others)
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
