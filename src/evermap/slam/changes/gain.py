"""The gain of a hypothesis about changes over 'nothing moved' (MATH.md section 5).

With `e` = estimated minus mapped positions, `A` the inverse covariance of `e` if nothing moved and `b = A e`, groups
with displacements `d ~ N(0, s^2 I)` that enter through columns `B` gain

    1/2 b'B (I/s^2 + B'AB)^-1 B'b  -  1/2 log |I + s^2 B'AB|  +  sum of log prior over groups.

A group may also turn about its centroid, by an angle of any size: its members move by `d + (R(angle) - I) (p - c)`,
which is linear in four columns (x, y, cosine - 1, sine), so the fit of the angle needs none but their products, and the
gain is the one above with the columns of the tangent (Laplace).

Which copies of a landmark moved depends on when: item `onset * L + landmark` stands for 'this landmark, from this
window on'. `quadratic` and `linear` hold `T'AT` and `T'b` for the four columns `T` of every item.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaln

from evermap.config import ChangesConfig
from evermap.slam.kernels import kernel
from evermap.types import FloatArray, IntArray

_TURN_STEPS = 6
"""Gauss-Newton steps towards the angles; without a turning group one is exact."""


class Tables(NamedTuple):
    """Precomputed tables for gains.

    Attributes:
        quadratic: (4 K, 4 K) `T'AT`.
        linear: (4 K,) `T'b`.
        position: (L, 2) mapped positions.
        spread: (3,) prior standard deviations of x, y and angle.
        log_prior: (L + 1, 2) log prior of a group by its size, for groups that only move and that turn, relative to
            'nothing moved'.
        log_onset: (W,) log prior of the window from which on a group has moved.
    """

    quadratic: FloatArray
    linear: FloatArray
    position: FloatArray
    spread: FloatArray
    log_prior: FloatArray
    log_onset: FloatArray


@kernel
def hypothesis_gain(label: IntArray, onset: IntArray, turns: Any, tables: Tables) -> tuple[float, FloatArray]:
    """Return the gain [nats] and the most probable motion (G, 3) of every group: x [m], y [m], angle [rad].

    `label` (L,) is the group of every landmark, 0 = static, groups are 1..G; `onset` (G + 1,) the window from which on
    each has moved, and `turns` (G + 1,) whether it also turns, whose row 0 is not used.
    """
    groups, spread = len(onset) - 1, tables.spread
    width, first, matrix, right, gain = _products(label, onset, turns, tables)
    motion = np.zeros((groups, 3))
    total = first[groups + 1]
    if total == 0:
        return gain, motion
    # unknowns y: x, y and, where a group turns, its angle; columns z(y): x, y, cosine - 1, sine
    start = np.zeros(groups + 2, dtype=np.int64)
    any_turns = False
    for g in range(1, groups + 1):
        start[g + 1] = start[g] + (0 if width[g] == 0 else (3 if width[g] == 4 else 2))
        any_turns = any_turns or width[g] == 4
    size = start[groups + 1]
    scale = np.zeros(size)
    for g in range(1, groups + 1):
        for a in range(start[g + 1] - start[g]):
            scale[start[g] + a] = spread[a]
    value = np.zeros(size)  # in units of its prior
    column, tangent, weighted = np.zeros(total), np.zeros((total, size)), np.zeros(total)
    inner, step = np.zeros((size, size)), np.zeros(size)
    for _ in range(_TURN_STEPS if any_turns else 1):
        _columns_of(value, scale, width, first, start, column, tangent)
        for a in range(size):
            for k in range(total):
                weighted[k] = 0.0
                for m in range(total):
                    weighted[k] += matrix[k, m] * tangent[m, a]
            step[a] = -value[a]
            for k in range(total):
                step[a] += tangent[k, a] * right[k] - weighted[k] * column[k]
            for c in range(size):
                inner[c, a] = 1.0 if c == a else 0.0
                for k in range(total):
                    inner[c, a] += tangent[k, c] * weighted[k]
        _factor(inner)
        _solve(inner, step)
        for a in range(size):
            value[a] += step[a]
    _columns_of(value, scale, width, first, start, column, tangent)
    for k in range(total):
        pull = right[k]
        for m in range(total):
            pull -= 0.5 * matrix[k, m] * column[m]
        gain += column[k] * pull
    for a in range(size):
        gain -= 0.5 * value[a] * value[a] + np.log(inner[a, a])
    for g in range(1, groups + 1):
        for a in range(start[g + 1] - start[g]):
            motion[g - 1, a] = value[start[g] + a] * scale[start[g] + a]
    return gain, motion


@kernel
def _products(
    label: IntArray, onset: IntArray, turns: Any, tables: Tables
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, float]:
    """Columns of every group (0, 2 or 4), the first of each, their `C'AC` and `C'b` about the centroids; log prior."""
    quadratic, linear, position, _, log_prior, log_onset = tables
    count, groups = len(label), len(onset) - 1
    width, size = np.zeros(groups + 1, dtype=np.int64), np.zeros(groups + 1, dtype=np.int64)
    first = np.zeros(groups + 2, dtype=np.int64)
    centre = np.zeros((groups + 1, 2))
    members = np.zeros((groups + 1, count), dtype=np.int64)
    for i in range(count):
        g = label[i]
        members[g, size[g]] = i
        size[g] += 1
        centre[g, 0] += position[i, 0]
        centre[g, 1] += position[i, 1]
    prior = 0.0
    for g in range(1, groups + 1):
        if size[g] > 0:
            centre[g, 0] /= size[g]
            centre[g, 1] /= size[g]
            width[g] = 4 if turns[g] else 2
            prior += log_prior[size[g], 1 if turns[g] else 0] + log_onset[onset[g]]
        first[g + 1] = first[g] + width[g]
    total = first[groups + 1]
    matrix, right = np.zeros((total, total)), np.zeros(total)
    for g in range(1, groups + 1):
        for m in range(size[g]):
            at = 4 * (onset[g] * count + members[g, m])
            for a in range(width[g]):
                right[first[g] + a] += linear[at + a]
            for h in range(g, groups + 1):
                for n in range(size[h]):
                    to = 4 * (onset[h] * count + members[h, n])
                    for a in range(width[g]):
                        for c in range(width[h]):
                            matrix[first[g] + a, first[h] + c] += quadratic[at + a, to + c]
    for g in range(1, groups + 1):
        for h in range(g + 1, groups + 1):
            for a in range(width[g]):
                for c in range(width[h]):
                    matrix[first[h] + c, first[g] + a] = matrix[first[g] + a, first[h] + c]
    # from turning about the origin to turning about the centroid
    for g in range(1, groups + 1):
        if width[g] == 4:
            f, x, y = first[g], centre[g, 0], centre[g, 1]
            right[f + 2] -= x * right[f] + y * right[f + 1]
            right[f + 3] -= x * right[f + 1] - y * right[f]
            for k in range(total):
                matrix[f + 2, k] -= x * matrix[f, k] + y * matrix[f + 1, k]
                matrix[f + 3, k] -= x * matrix[f + 1, k] - y * matrix[f, k]
            for k in range(total):
                matrix[k, f + 2] -= x * matrix[k, f] + y * matrix[k, f + 1]
                matrix[k, f + 3] -= x * matrix[k, f + 1] - y * matrix[k, f]
    return width, first, matrix, right, prior


@kernel
def _columns_of(
    value: FloatArray, scale: FloatArray, width: IntArray, first: IntArray, start: IntArray, column: FloatArray,
    tangent: FloatArray,
) -> None:  # fmt: skip
    """Columns (C,) at the unknowns (Y,), and their derivatives (C, Y)."""
    tangent[:] = 0.0
    for g in range(1, len(width)):
        if width[g] == 0:
            continue
        f, s = first[g], start[g]
        for a in range(2):
            column[f + a] = value[s + a] * scale[s + a]
            tangent[f + a, s + a] = scale[s + a]
        if width[g] == 4:
            angle = value[s + 2] * scale[s + 2]
            column[f + 2], column[f + 3] = np.cos(angle) - 1.0, np.sin(angle)
            tangent[f + 2, s + 2], tangent[f + 3, s + 2] = -np.sin(angle) * scale[s + 2], np.cos(angle) * scale[s + 2]


@kernel
def _factor(matrix: FloatArray) -> None:
    """Lower Cholesky factor in place."""
    for a in range(len(matrix)):
        for c in range(a):
            matrix[a, a] -= matrix[a, c] * matrix[a, c]
        matrix[a, a] = np.sqrt(max(matrix[a, a], 1e-300))
        for r in range(a + 1, len(matrix)):
            for c in range(a):
                matrix[r, a] -= matrix[r, c] * matrix[a, c]
            matrix[r, a] /= matrix[a, a]


@kernel
def _solve(factor: FloatArray, right: FloatArray) -> None:
    """Solve with a lower Cholesky factor, in place."""
    for a in range(len(right)):
        for c in range(a):
            right[a] -= factor[a, c] * right[c]
        right[a] /= factor[a, a]
    for a in range(len(right) - 1, -1, -1):
        for r in range(a + 1, len(right)):
            right[a] -= factor[r, a] * right[r]
        right[a] /= factor[a, a]


def log_prior(prior: ChangesConfig, n_landmarks: int, largest: int) -> FloatArray:
    """Return (largest + 1, 2) log priors of a group by size, moved only and also turned: `eps 2^-n / C(N, n)`."""
    size = np.arange(largest + 1)
    choices = gammaln(n_landmarks + 1) - gammaln(size + 1) - gammaln(n_landmarks - size + 1)
    group = np.log(prior.p_moved) - np.log1p(-prior.p_moved) - size * np.log(2.0) - choices
    with np.errstate(divide="ignore"):
        table: FloatArray = group[:, None] + np.log([1.0 - prior.p_rotated, prior.p_rotated])
    table[:2, 1] = -np.inf  # one landmark alone has nothing to turn
    table[0] = 0.0
    return table


def log_onset(n_windows: int) -> FloatArray:
    """Return (W,) log prior of the window from which on a group has moved: before the session as likely as within."""
    if n_windows == 1:
        return np.zeros(1)
    return np.asarray(np.log(np.append(0.5, np.full(n_windows - 1, 0.5 / (n_windows - 1)))))
