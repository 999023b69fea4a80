"""Loops of the nonparametric maximum likelihood of censored lifetimes, compiled.

Nodes `0 .. m` lie between the `m` cells (the maximal intersections); node k is the time after cells `0 .. k - 1`.
A sample is an edge between two nodes, and its probability is the mass between them. Masses below a node are `below`,
those above it `above`; both are sums of positive numbers, so that neither tail cancels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.compiled import drop_stale_code, kept
from evermap.types import BoolArray, FloatArray, IntArray

drop_stale_code(__file__)

kernel = kept(nogil=True, error_model="numpy", fastmath={"contract"})

SMALLEST = 1e-300
"""Instead of a mass of 0, where it is divided by or its logarithm is taken."""


class Terms(NamedTuple):
    """What the likelihood is made of; weights of samples, merged where their edges are the same by construction.

    Attributes:
        within: (m,) weight of samples in this cell alone.
        before: (m + 1,) weight of samples below this node, that is in all cells before it.
        after: (m + 1,) weight of samples above it.
        entered: (m + 1,) weight of samples that are known only because they lie above it.
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

    Bits of such floats are in the order of the floats. It takes a third of the time of a sort by comparisons.
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


@kernel
def sweep(
    opened: bool,
    points: FloatArray,
    ends: FloatArray,
    entries: FloatArray,
    starts: FloatArray,
    cell_start: FloatArray,
    cell_end: FloatArray,
    point_cell: IntArray,
    end_node: IntArray,
    entry_node: IntArray,
    start_node: IntArray,
) -> int:
    """Find the maximal intersections in one pass over sorted times, and where every sample lies among them.

    A cell is an opening with no other before the next closing. At one time: points open, then points, ends and entries
    close, then starts open. An entry closes, since mass leaves the truncation sets by moving left (Frydman 1994).

    Args:
        opened: whether some sample starts at 0.
        points: sorted times of exact samples.
        ends: sorted finite ends of the others.
        entries: sorted entries above 0.
        starts: sorted starts above 0.
        cell_start: filled, with room for a cell a point and a start, and one more.
        cell_end: filled; a point is where they are equal, and an infinite end closes what is still open.
        point_cell: filled, the cell of every point.
        end_node: filled, for every end.
        entry_node: filled, for every entry.
        start_node: filled, for every start.

    Returns:
        How many cells there are.
    """
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
def contract(
    terms: Terms,
    node: IntArray,
    within: FloatArray,
    before: FloatArray,
    after: FloatArray,
    entered: FloatArray,
    first: IntArray,
    last: IntArray,
    weight: FloatArray,
) -> int:
    """Merge nodes: `node[k]` is the new name of k, never decreasing. Adds to the weights, fills the edges.

    Returns:
        How many edges there are still; others have become simpler kinds, or nothing where their ends are one.
    """
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
    """Merge equal edges in place, through a table (m + 1, m + 1) of zeros; returns how many are left."""
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
    """From masses (m,) the mass below and above every node (m + 1,), and that of every edge (E,)."""
    m = mass.size
    below[0], above[m] = 0.0, 0.0
    for j in range(m):
        below[j + 1] = below[j] + mass[j]
    for j in range(m - 1, -1, -1):
        above[j] = above[j + 1] + mass[j]
    for i in range(span.size):
        a, b = terms.first[i], terms.last[i]
        # in the upper half the masses above are the smaller numbers, and their difference the more exact
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
    """One step of expectation maximisation, in place: Kaplan-Meier of the expected deaths, with delayed entry.

    Without truncation this is Turnbull's self-consistency; with it, conditioning on the entry saves inventing those
    that were never seen, which is what makes Turnbull's own version crawl.
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
    # whoever is left over by rounding
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
    """Masses (m,) of the iterative convex minorant's proposal: isotonic regression of a diagonal Newton step.

    Args:
        slope: (m,) by the masses.
        diag: (m + 1,) negative second derivative by the masses below each node.
        below: (m + 1,) present masses below.
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
