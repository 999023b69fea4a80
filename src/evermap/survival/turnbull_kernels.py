"""Compiled loops of the nonparametric maximum likelihood of censored lifetimes.

Nodes `0 .. m` lie between the `m` cells (the maximal intersections); node k is the time after cells `0 .. k - 1`.
A sample is an edge between two nodes, and its probability is the mass between them. Masses below a node are `below`,
those above it `above`; both are sums of positive numbers, so that neither tail cancels.

In terms of the masses below the nodes the Hessian `H` of the log likelihood is a weighted Laplacian: an edge of weight
w between nodes a and b adds `w (x_a - x_b)^2` to the quadratic form. Both end nodes are fixed, so an edge to one of
them is on the diagonal alone.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.compiled import kept
from evermap.types import BoolArray, FloatArray, IntArray

kernel = kept(nogil=True, error_model="numpy", fastmath={"contract"})

SMALLEST = 1e-300
"""Replaces a mass of 0 in divisions and logarithms."""


class Terms(NamedTuple):
    """Weights of the terms of the likelihood; samples with the same edge are merged.

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


@kernel
def sort_together(keys: Any, rows: IntArray) -> None:
    """Sort rows by their keys (n,), bits of floats that are not negative, both in place: a radix sort, 11 bits a pass.

    The bits of such floats are in the order of the floats. It takes a third of the time of a sort by comparisons.
    """
    counts = np.zeros((6, 2048), np.int64)
    for i in range(keys.size):
        for digit in range(6):
            counts[digit, (keys[i] >> (11 * digit)) & 2047] += 1
    from_keys, from_rows, to_keys, to_rows = keys, rows, np.empty_like(keys), np.empty_like(rows)
    for digit in range(6):
        place = 0
        for value in range(2048):
            counts[digit, value], place = place, place + counts[digit, value]
        for i in range(keys.size):
            value = (from_keys[i] >> (11 * digit)) & 2047
            at = counts[digit, value]
            counts[digit, value] = at + 1
            to_keys[at], to_rows[at] = from_keys[i], from_rows[i]
        from_keys, from_rows, to_keys, to_rows = to_keys, to_rows, from_keys, from_rows


class Stamps(NamedTuple):
    """Sorted times of samples, in seconds.

    Attributes:
        points: of exact samples.
        ends: finite ends of the others.
        entries: entries above 0.
        starts: starts above 0.
    """

    points: FloatArray
    ends: FloatArray
    entries: FloatArray
    starts: FloatArray


class Cells(NamedTuple):
    """Maximal intersections, and where every stamp lies among them.

    Attributes:
        start, end: of the cells, with room for one a point and a start, and one more; a point where they are equal.
        point_cell: the cell of every point.
        end_node, entry_node, start_node: the node of every end, entry and start.
    """

    start: FloatArray
    end: FloatArray
    point_cell: IntArray
    end_node: IntArray
    entry_node: IntArray
    start_node: IntArray


@kernel
def sweep(opened: bool, stamps: Stamps, found: Cells) -> int:
    """Find the maximal intersections in one pass over sorted times, and where every sample lies among them.

    A cell is an opening with no other before the next closing. At one time: points open, then points, ends and entries
    close, then starts open. An entry closes, since mass leaves the truncation sets by moving left (Frydman 1994). An
    infinite end closes what is still open.

    Args:
        opened: whether some sample starts at 0.
        stamps: of the samples.
        found: filled.

    Returns:
        The number of cells.
    """
    points, ends, entries, starts = stamps
    cell_start, cell_end, point_cell, end_node, entry_node, start_node = found
    cells = 0
    start = 0.0
    i, j, k, q = 0, 0, 0, 0
    while True:
        at = np.inf
        if i < points.size:
            at = points[i]
        if j < ends.size:
            at = min(at, ends[j])
        if k < entries.size:
            at = min(at, entries[k])
        if q < starts.size:
            at = min(at, starts[q])
        if at == np.inf:
            break
        if i < points.size and points[i] == at:
            opened, start = True, at
        if opened and (
            (i < points.size and points[i] == at)
            or (j < ends.size and ends[j] == at)
            or (k < entries.size and entries[k] == at)
        ):
            cell_start[cells], cell_end[cells] = start, at
            cells += 1
            opened = False
        while i < points.size and points[i] == at:
            point_cell[i] = cells - 1
            i += 1
        while j < ends.size and ends[j] == at:
            end_node[j] = cells
            j += 1
        while k < entries.size and entries[k] == at:
            entry_node[k] = cells
            k += 1
        while q < starts.size and starts[q] == at:
            opened, start = True, at
            start_node[q] = cells
            q += 1
    if opened:
        cell_start[cells], cell_end[cells] = start, np.inf
        cells += 1
    return cells


@kernel
def contract(terms: Terms, node: IntArray, merged: Terms) -> int:
    """Merge nodes: `node[k]` is the new number of k, never decreasing; add weights to `merged` and fill its edges.

    Returns:
        The number of edges left; others have become simpler kinds, or nothing where their ends are one node.
    """
    within, before, after, entered, first, last, weight = merged
    m = within.size
    for k in range(node.size):
        before[node[k]] += terms.before[k]
        after[node[k]] += terms.after[k]
        entered[node[k]] += terms.entered[k]
    for j in range(terms.within.size):
        if node[j] < node[j + 1]:
            within[node[j]] += terms.within[j]
    count = 0
    for i in range(terms.first.size):
        a, b, w = node[terms.first[i]], node[terms.last[i]], terms.weight[i]
        if b == m:
            after[a] += w
        elif a == 0:
            before[b] += w
        elif b == a + 1:
            within[a] += w
        elif b > a:
            first[count], last[count], weight[count] = a, b, w
            count += 1
    return count


@kernel
def merge_equal(first: IntArray, last: IntArray, weight: FloatArray, table: FloatArray) -> int:
    """Merge equal edges in place, through a table (m + 1, m + 1) of zeros; return the number left."""
    for i in range(first.size):
        table[first[i], last[i]] += weight[i]
    count = 0
    for a in range(table.shape[0]):
        for b in range(a + 2, table.shape[1]):
            if table[a, b] > 0.0:
                first[count], last[count], weight[count] = a, b, table[a, b]
                count += 1
    return count


@kernel
def spread(terms: Terms, mass: FloatArray, below: FloatArray, above: FloatArray, span: FloatArray) -> None:
    """Fill the mass below and above every node (m + 1,), and that of every edge (E,), from masses (m,)."""
    m = mass.size
    below[0], above[m] = 0.0, 0.0
    for j in range(m):
        below[j + 1] = below[j] + mass[j]
    for j in range(m - 1, -1, -1):
        above[j] = above[j + 1] + mass[j]
    for i in range(span.size):
        a, b = terms.first[i], terms.last[i]
        # in the upper half the masses above are smaller, and their difference is more exact
        span[i] = above[a] - above[b] if below[a] > 0.5 else below[b] - below[a]


@kernel
def slopes(
    terms: Terms, mass: FloatArray, below: FloatArray, above: FloatArray, span: FloatArray, slope: FloatArray
) -> None:
    """Fill the derivatives of the log likelihood by each mass (m,); weighted by the masses they sum to 0."""
    m = mass.size
    rate = np.empty(m + 1)  # change of the slope at each node
    from_start = 0.0
    for k in range(m + 1):
        falls = terms.before[k] / max(below[k], SMALLEST)
        from_start += falls
        rate[k] = (terms.after[k] - terms.entered[k]) / max(above[k], SMALLEST) - falls
    rate[0] += from_start
    for i in range(span.size):
        u = terms.weight[i] / span[i]
        rate[terms.first[i]] += u
        rate[terms.last[i]] -= u
    running = 0.0
    for j in range(m):
        running += rate[j]
        slope[j] = running + terms.within[j] / max(mass[j], SMALLEST)


@kernel
def expectation_step(terms: Terms, above: FloatArray, slope: FloatArray, mass: FloatArray) -> None:
    """Take a step of expectation maximisation, in place: Kaplan-Meier of the expected deaths, with delayed entry.

    Without truncation this is Turnbull's self-consistency; with it, conditioning on the entry avoids imputing the
    samples that were never seen, which makes Turnbull's own version slow.
    """
    pull = 0.0
    at_risk = 0.0
    alive = 1.0
    for j in range(mass.size):
        if terms.entered[j] > 0.0:
            pull += terms.entered[j] / above[j]
            at_risk += terms.entered[j]
        deaths = max(mass[j] * (slope[j] + pull), 0.0)
        mass[j] = alive * min(deaths / at_risk, 1.0) if at_risk > 0.0 else 0.0
        at_risk -= deaths
        alive -= mass[j]
    # what is left over by rounding
    total = mass.sum()
    for j in range(mass.size):
        mass[j] /= total


@kernel
def best_between(slope: FloatArray, least: float, inside: BoolArray) -> None:
    """Add to the support (m,), in place, the cell of the largest slope above `least` in every gap of it."""
    best = -1
    for j in range(slope.size):
        if inside[j]:
            if best >= 0:
                inside[best] = True
            best = -1
        elif slope[j] > least and (best < 0 or slope[j] > slope[best]):
            best = j
    if best >= 0:
        inside[best] = True


@kernel
def isotonic_step(slope: FloatArray, diag: FloatArray, below: FloatArray, mass: FloatArray) -> None:
    """Fill the proposal of the iterative convex minorant: isotonic regression of a diagonal Newton step.

    Args:
        slope: (m,) by the masses.
        diag: (m + 1,) negative second derivative by the masses below each node.
        below: (m + 1,) current masses below.
        mass: (m,) filled.
    """
    m = mass.size
    level, heft, count = np.empty(m), np.empty(m), np.empty(m, np.int64)
    blocks = 0
    for k in range(1, m):
        value, w, size = below[k] + (slope[k - 1] - slope[k]) / diag[k], diag[k], 1
        while blocks > 0 and level[blocks - 1] >= value:
            blocks -= 1
            total = heft[blocks] + w
            value = (level[blocks] * heft[blocks] + value * w) / total
            w = total
            size += count[blocks]
        level[blocks], heft[blocks], count[blocks] = value, w, size
        blocks += 1
    mass[:] = 0.0
    k, last = 0, 0.0
    for b in range(blocks):
        value = min(max(level[b], last), 1.0)
        mass[k] = value - last
        last = value
        k += count[b]
    mass[k] = 1.0 - last


@kernel
def diagonal(terms: Terms, diag: FloatArray) -> None:
    """Fill the diagonal (m + 1,) of `H`."""
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
    """Fill `out = H x` over the nodes; `x` is 0 at both ends."""
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
    """Return the bandwidth of `H`."""
    band = 1
    for i in range(terms.first.size):
        band = max(band, terms.last[i] - terms.first[i])
    return band


@kernel
def banded(terms: Terms, band: FloatArray) -> None:
    """Add the lower triangle of `H` for the inner nodes, `band[j, i] = H[i + j, i]`, to zeros."""
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
        terms: the edges of `H`.
        anchors: (m + 1,) edges to the fixed ends in the preconditioner; those between neighbours are as in `H`.
        force: (m + 1,) right hand side.
        tolerance: of the residual in the norm of the preconditioner's inverse, relative to that of `force`.
        most: largest number of steps.
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
