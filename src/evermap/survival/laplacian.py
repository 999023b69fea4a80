"""The graph whose edges are censored lifetimes, as a matrix: compiled products, and solutions by conjugate gradients.

The Hessian of their likelihood is a weighted Laplacian: an edge between the nodes a and b of weight w adds
`w (x_a - x_b)^2` to the quadratic form. Both ends are fixed, so an edge to one of them is on the diagonal alone.
"""

from __future__ import annotations

import numpy as np

from evermap.survival.turnbull_kernels import Terms, kernel
from evermap.types import FloatArray


@kernel
def diagonal(terms: Terms, diag: FloatArray) -> None:
    """Diagonal (m + 1,) of the matrix that `product` multiplies with."""
    m = terms.within.size
    for k in range(m + 1):
        diag[k] = terms.before[k] + terms.after[k]
    for j in range(m):
        diag[j] += terms.within[j]
        diag[j + 1] += terms.within[j]
    for i in range(terms.first.size):
        diag[terms.first[i]] += terms.weight[i]
        diag[terms.last[i]] += terms.weight[i]


@kernel
def product(terms: Terms, x: FloatArray, out: FloatArray) -> None:
    """`out = H x` over the nodes, `H` the weighted Laplacian of the edges; `x` is 0 at both ends."""
    m = terms.within.size
    for k in range(m + 1):
        out[k] = (terms.before[k] + terms.after[k]) * x[k]
    for j in range(m):
        force = terms.within[j] * (x[j + 1] - x[j])
        out[j] -= force
        out[j + 1] += force
    for i in range(terms.first.size):
        a, b = terms.first[i], terms.last[i]
        force = terms.weight[i] * (x[b] - x[a])
        out[a] -= force
        out[b] += force


@kernel
def bandwidth(terms: Terms) -> int:
    """How far from the diagonal `H` reaches."""
    band = 1
    for i in range(terms.first.size):
        band = max(band, terms.last[i] - terms.first[i])
    return band


@kernel
def banded(terms: Terms, band: FloatArray) -> None:
    """The lower triangle of `H` for the inner nodes, `band[j, i] = H[i + j, i]`, added to zeros."""
    m = terms.within.size
    for k in range(1, m):
        band[0, k - 1] += terms.before[k] + terms.after[k] + terms.within[k - 1] + terms.within[k]
        if k + 1 < m:
            band[1, k - 1] -= terms.within[k]
    for i in range(terms.first.size):
        a, b, w = terms.first[i] - 1, terms.last[i] - 1, terms.weight[i]
        band[0, a] += w
        band[0, b] += w
        band[b - a, a] -= w


@kernel
def conjugate_gradients(
    terms: Terms, anchors: FloatArray, force: FloatArray, tolerance: float, most: int, x: FloatArray
) -> int:
    """Solve `H x = force` over the inner nodes, preconditioned by a tridiagonal matrix.

    Args:
        terms: `H`, as for `product`.
        anchors: (m + 1,) edges to the fixed ends in the preconditioner; those between neighbours are as in `H`.
        force: (m + 1,) right hand side.
        tolerance: of the residual in the norm of the preconditioner's inverse, relative to that of `force`.
        most: steps.
        x: (m + 1,) filled, 0 at both ends.

    Returns:
        Steps taken, or -1 if `H` or the preconditioner is not positive definite.
    """
    m, chain = terms.within.size, terms.within
    ratio, inverse = np.zeros(m + 1), np.zeros(m + 1)  # the preconditioner's factors, pivots inverted
    for k in range(1, m):
        ratio[k] = chain[k - 1] * inverse[k - 1]
        inverse[k] = 1.0 / (chain[k - 1] * (1.0 - ratio[k]) + chain[k] + anchors[k])
    residual, z, way, bent = force.copy(), np.zeros(m + 1), np.zeros(m + 1), np.empty(m + 1)
    x[:] = 0.0
    before, start, steps = 1.0, 0.0, 0
    while True:
        for k in range(1, m):
            z[k] = residual[k] + ratio[k] * z[k - 1]
        now = 0.0
        for k in range(m - 1, 0, -1):
            z[k] = z[k] * inverse[k] + ratio[k + 1] * z[k + 1]
            now += residual[k] * z[k]
        if now < 0.0:
            return -1
        if steps == 0:
            start = now
        if now <= tolerance * tolerance * start or steps == most:
            return steps
        share = now / before if steps > 0 else 0.0
        for k in range(1, m):
            way[k] = z[k] + share * way[k]
        product(terms, way, bent)
        curvature = 0.0
        for k in range(1, m):
            curvature += way[k] * bent[k]
        if not curvature > 0.0:
            return -1
        length = now / curvature
        for k in range(1, m):
            x[k] += length * way[k]
            residual[k] -= length * bent[k]
        before = now
        steps += 1
