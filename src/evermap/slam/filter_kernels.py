"""The steps of the local filter, compiled, of any dimension: predict, weigh the detections of a frame, and update.

A state is the newest pose, the calibration states and the places in slots: covariance (own + D K, own + D K) in this
order, rows of slots that are free zero. Detections come linearised and whitened (`local_filter.SightedFrame`):
residuals (M, R) and derivatives (M, R, W), zero behind the residuals that a detection has, by the numbers `column`
(M, W).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evermap.compiled import kept
from evermap.estimate.robust import weigh
from evermap.slam.kernels import kernel, sandwich
from evermap.types import FloatArray, IntArray

UNSURE = 4.0
"""Times by which the innovation of a detection with two residuals is wider (in area) than its own noise where the pose
is so uncertain that whether the detection is an outlier is better asked of the others of the frame."""
LEAST_WEIGHT = 1e-6
LARGE = 32
"""Rows from which a matrix is factorised by LAPACK."""
vectorised = kept(effort=3, error_model="numpy", fastmath={"contract"})


@kernel
def drive_on(covariance: FloatArray, own: int, carry: FloatArray, by_states: FloatArray, noise: FloatArray) -> None:
    """Advance the joint covariance to the next pose, in place.

    Args:
        covariance: in and out.
        own: numbers of pose and calibration.
        carry: (D, D) derivative of the next pose by the pose, each in its own frame.
        by_states: (D, C) of it by the last C calibration states.
        noise: (D, D) of the motion.
    """
    dim, count = by_states.shape
    first = own - count
    rows = carry @ covariance[:dim] + by_states @ covariance[first:own]
    corner = np.ascontiguousarray(rows[:, :dim]) @ carry.T + np.ascontiguousarray(rows[:, first:own]) @ by_states.T
    for a in range(dim):
        for k in range(dim, len(covariance)):
            covariance[a, k] = covariance[k, a] = rows[a, k]
        for b in range(a + 1):
            half = 0.5 * (corner[a, b] + noise[a, b] + corner[b, a] + noise[b, a])
            covariance[a, b] = covariance[b, a] = half


@kernel
def part_of(covariance: FloatArray, own: int, dim: int, slot: IntArray) -> tuple[IntArray, FloatArray]:
    """Return the numbers of pose, calibration and places in slots (M,), of `dim` numbers each, and their covariance."""
    where = np.arange(own + dim * len(slot))
    for m in range(len(slot)):
        for k in range(dim):
            where[own + dim * m + k] = own + dim * slot[m] + k
    part = np.empty((len(where), len(where)))
    for i in range(len(where)):
        for k in range(len(where)):
            part[i, k] = covariance[where[i], where[k]]
    return where, part


@kernel
def compare_each(
    covariance: FloatArray, own: int, residual: FloatArray, jacobian: FloatArray, column: IntArray, slot: IntArray,
    spread: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Compare detections (M,) with one place each, each pair separately: `S = H P H' + 1`.

    `slot` (M,) says where a place stands in the covariance; where it is -1, `spread` (M, D, D) is that of the place.

    Returns:
        (M,) squared Mahalanobis distances, and (M,) `log |S|`.
    """
    count, rows, width = jacobian.shape
    dim = spread.shape[1]
    of_place = width - dim
    nis, log_det = np.empty(count), np.empty(count)
    part, across, s = np.zeros((width, width)), np.zeros((rows, width)), np.zeros((rows, rows))
    at, off = np.zeros(width, dtype=np.int64), np.zeros(rows)
    for m in range(count):
        for a in range(width):
            at[a] = column[m, a] if a < of_place else own + dim * slot[m] + a - of_place
        for a in range(width):
            for b in range(width):
                if slot[m] >= 0 or max(a, b) < of_place:
                    part[a, b] = covariance[at[a], at[b]]
                else:
                    part[a, b] = spread[m, a - of_place, b - of_place] if min(a, b) >= of_place else 0.0
        sandwich(jacobian[m], part, across, s)
        for a in range(rows):
            s[a, a] += 1.0
            off[a] = residual[m, a]
        nis[m], log_det[m] = squared_distance(s, off)
    return nis, log_det


@kernel
def squared_distance(spread: FloatArray, off: FloatArray) -> tuple[float, float]:
    """Return `off' spread^-1 off` and `log |spread|`; both arguments are used up."""
    squared = log_det = 0.0
    for i in range(len(off)):
        for k in range(i + 1):
            total = spread[i, k]
            for a in range(k):
                total -= spread[i, a] * spread[k, a]
            spread[i, k] = math.sqrt(total) if k == i else total / spread[k, k]
        for a in range(i):
            off[i] -= spread[i, a] * off[a]
        off[i] /= spread[i, i]
        squared += off[i] ** 2
        log_det += 2.0 * math.log(spread[i, i])
    return squared, log_det


@vectorised
def add_across(covariance: FloatArray, jacobian: FloatArray, column: Any, out: FloatArray) -> None:
    """Add `H P`, (M R, size), to the first columns of `out`."""
    rows, width = jacobian.shape[1:]
    for m in range(len(jacobian)):
        for row in range(rows):
            mine = out[rows * m + row]
            for a in range(width):
                by, at = jacobian[m, row, a], column[m, a]
                for k in range(len(covariance) if by != 0.0 else 0):
                    mine[k] += by * covariance[at, k]


@vectorised
def spread_of_frame(
    covariance: FloatArray, jacobian: FloatArray, column: Any, gain: FloatArray, spread: FloatArray
) -> None:
    """Compute `H P` (M R, size) and `H P H'` (M R, M R)."""
    rows, width = jacobian.shape[1:]
    gain[:] = 0.0
    add_across(covariance, jacobian, column, gain)
    for row in range(len(spread)):
        mine = gain[row]
        for other in range(row + 1):
            by, at, total = jacobian[other // rows, other % rows], column[other // rows], 0.0
            for a in range(width):
                total += mine[at[a]] * by[a]
            spread[row, other] = spread[other, row] = total


@kernel
def weigh_by_surprise(
    spread: FloatArray, residual: FloatArray, tail: FloatArray, known: bool, weight: FloatArray
) -> None:
    """Weigh by the Cauchy's tails: before anything is `known` of this frame, as surprising as an innovation is."""
    count, rows = residual.shape
    alone, off = np.empty((rows, rows)), np.empty(rows)
    for m in range(count):
        for a in range(rows):
            for b in range(rows):
                alone[a, b] = 0.0 if known else spread[rows * m + a, rows * m + b]
            alone[a, a] += 1.0
            off[a] = residual[m, a]
        weight[m] = weigh(squared_distance(alone, off)[0], 0.0, tail[m], 0.0)[0]


@kernel
def weigh_alone(
    part: FloatArray, spread: FloatArray, residual: FloatArray, jacobian: FloatArray, column: IntArray, dim: int,
    n_rows: IntArray, log_odds: FloatArray, nis: FloatArray, weight: FloatArray,
) -> bool:  # fmt: skip
    """Compute the squared distance of every detection alone, and weights by it as inliers or outliers; return whether
    the pose is too uncertain for this.
    """
    count, rows, width = jacobian.shape
    of_place, unsure = width - dim, False
    alone, certain, off = np.empty((rows, rows)), np.empty((rows, rows)), np.empty(rows)
    place, across, by_place = np.empty((dim, dim)), np.empty((rows, dim)), np.empty((rows, dim))
    for m in range(count):
        for a in range(rows):
            for b in range(rows):
                alone[a, b] = spread[rows * m + a, rows * m + b]
            for b in range(dim):
                by_place[a, b] = jacobian[m, a, of_place + b]
        for a in range(dim):
            for b in range(dim):
                place[a, b] = part[column[m, of_place + a], column[m, of_place + b]]
        # its value if only the reading and the place were uncertain
        sandwich(by_place, place, across, certain)
        for a in range(rows):
            alone[a, a] += 1.0
            certain[a, a] += 1.0
            off[a] = residual[m, a]
        nis[m], log_det = squared_distance(alone, off)
        _, of_certain = squared_distance(certain, off)
        unsure |= log_det - of_certain > 0.5 * n_rows[m] * math.log(UNSURE)
        weight[m] = max(weigh(nis[m], log_odds[m], 0.0, 0.0)[0], LEAST_WEIGHT)
    return unsure


@kernel
def weigh_by_the_others(
    spread: FloatArray, pull: FloatArray, log_odds: FloatArray, tail: FloatArray, heavy: bool, credible: FloatArray,
    weight: FloatArray,
) -> float:  # fmt: skip
    """Compute weights, at most `credible`, from each detection's innovation given all others; return the largest
    change.

    With `V` the inverse of the innovations' covariance and `p = V r`, what is left of detection m when the others have
    been used is `V_mm^-1 p_m`, with covariance `V_mm^-1` (leave one out).
    """
    inverse: Any = np.linalg.inv(spread)
    changed, rows = 0.0, len(pull) // len(weight)
    for m in range(len(weight)):
        first = rows * m
        alone: Any = np.linalg.inv(np.ascontiguousarray(inverse[first : first + rows, first : first + rows]))
        off = alone @ pull[first : first + rows]
        for a in range(rows):
            alone[a, a] -= 1.0 / weight[m] - 1.0  # noise by which it was held to be an outlier
        squared = max(float((off * np.linalg.solve(alone, off)).sum()), 0.0)
        now = weigh(squared, log_odds[m], tail[m] if heavy else 0.0, 0.0)[0]
        now = min(max(now, LEAST_WEIGHT), credible[m])
        changed = max(changed, abs(now - weight[m]))
        weight[m] = now
    return changed


@kernel
def solve_frame(
    spread: FloatArray, gain: FloatArray, residual: FloatArray, jacobian: FloatArray, column: IntArray,
    weight: FloatArray, root: FloatArray, innovation: FloatArray, pull: FloatArray, step: FloatArray, moving: int,
) -> float:  # fmt: skip
    """Compute the step of the first `moving` numbers, in place of the step before, and return its largest change.

    Filled in are the factor `root` of `S`, which is `spread` with the noise on its diagonal, the innovations at the
    step before, expressed at the start, and `pull`, `S^-1` times these.
    """
    count, rows, width = jacobian.shape
    for each in range(count * rows):
        m, row = each // rows, each % rows
        spread[each, each] += 1.0 / weight[m]
        innovation[each] = residual[m, row]
        for a in range(width):
            innovation[each] -= jacobian[m, row, a] * step[column[m, a]]
    root[:] = spread
    solve_by_root(root, innovation, pull)
    moved = 0.0
    for k in range(moving):
        before, step[k] = step[k], 0.0
        for each in range(count * rows):
            step[k] -= pull[each] * gain[each, k]
        moved = max(moved, abs(step[k] - before))
    return moved


@kernel
def solve_by_root(matrix: FloatArray, right: FloatArray, x: FloatArray) -> None:
    """Solve by Cholesky's factor, which takes the place of the lower triangle of the matrix."""
    large = len(matrix) > LARGE
    if large:
        factor: Any = np.linalg.cholesky(matrix)
        for i in range(len(matrix)):
            for k in range(i + 1):
                matrix[i, k] = factor[i, k]
    for i in range(len(matrix)):
        for k in range(0 if large else i + 1):
            total = matrix[i, k]
            for a in range(k):
                total -= matrix[i, a] * matrix[k, a]
            matrix[i, k] = math.sqrt(total) if k == i else total / matrix[k, k]
        x[i] = right[i]
        for a in range(i):
            x[i] -= matrix[i, a] * x[a]
        x[i] /= matrix[i, i]
    for i in range(len(matrix) - 1, -1, -1):
        x[i] /= matrix[i, i]
        for a in range(i):
            x[a] -= matrix[i, a] * x[i]


@vectorised
def condition(covariance: FloatArray, root: FloatArray, white: FloatArray) -> None:
    """Condition on detections, with the lower root of `S = H P H' + R`; `white`, `H P` and innovations, becomes
    `root^-1 (H P, innovations)`.
    """
    for row in range(len(white)):
        mine = white[row]
        for other in range(row % 2):
            for k in range(len(mine)):
                mine[k] -= root[row, other] * white[other, k]
        for other in range(row % 2, row, 2):
            a, b, one, two = root[row, other], root[row, other + 1], white[other], white[other + 1]
            for k in range(len(mine)):
                mine[k] -= a * one[k] + b * two[k]
        for k in range(len(mine)):
            mine[k] /= root[row, row]
    even = len(white) - len(white) % 2
    for i in range(len(covariance)):
        mine = covariance[i]
        for row in range(0, even, 2):
            one, two = white[row], white[row + 1]
            a, b = one[i], two[i]
            for k in range(i + 1):
                mine[k] -= a * one[k] + b * two[k]
        for row in range(even, len(white)):
            one, a = white[row], white[row, i]
            for k in range(i + 1):
                mine[k] -= a * one[k]
        for k in range(i):
            covariance[k, i] = mine[k]


@vectorised
def consider(covariance: FloatArray, own: int, root: FloatArray, across: FloatArray) -> None:
    """Update pose and states as Schmidt with `across`, the `H P` of all; the places keep what is unknown of them."""
    n, size = len(root), len(covariance)
    gain = across[:, :own].copy()  # becomes S^-1 H P, of pose and states alone
    for i in range(n):
        for k in range(i):
            for b in range(own):
                gain[i, b] -= root[i, k] * gain[k, b]
        for b in range(own):
            gain[i, b] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for b in range(own):
            gain[i, b] /= root[i, i]
        for k in range(i):
            for b in range(own):
                gain[k, b] -= root[i, k] * gain[i, b]
    less = np.ascontiguousarray(gain.T) @ across
    for a in range(own):
        for k in range(a, size):
            covariance[a, k] -= less[a, k]
            covariance[k, a] = covariance[a, k]
