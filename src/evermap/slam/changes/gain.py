"""The gain of a hypothesis about changes over 'nothing moved' (MATH.md section 5).

With `e` = estimated minus mapped positions, `A` the inverse covariance of `e` if nothing moved and `b = A e`, groups
with displacements `d ~ N(0, s^2 I)` that enter through columns `B` gain

    1/2 b'B (I/s^2 + B'AB)^-1 B'b  -  1/2 log |I + s^2 B'AB|  +  sum of log prior over groups.

A group may also turn about its centroid, by an angle of any size: its members move by `d + (R(angle) - I) (p - c)`,
which is linear in few columns (in the plane four: x, y, cosine - 1, sine), so the fit of the angle needs none but their
products, and the gain is the one above with the columns of the tangent (Laplace). In space the columns are x, y, z and
the nine numbers of R - I; where landmarks have orientations, the rotation vector too, by which these turn.

Most displacements are as far as is stated (`move_sigma_m`), some are `far` times that. Under one normal distribution
what was carried across the room would cost a hundred nats, and anything else is more probable than that: that it turned
about a landmark which nobody saw again, or that its sightings are errors.

Which copies of a landmark moved depends on when: item `onset * L + landmark` stands for 'this landmark, from this
window on'. `quadratic` and `linear` hold `T'AT` and `T'b` for the columns `T` of every item.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import gammaln

from evermap.config import ChangesConfig
from evermap.slam.kernels import kernel
from evermap.types import FloatArray, IntArray

_TURN_STEPS, _MORE_STEPS = 6, 2
"""Gauss-Newton steps towards the angles, and from there under another prior; without a turning group one is exact."""


PLANE, POINTS, PLACES = 2, 3, 6
"""Numbers of a landmark: in the plane x, y; of points in space x, y, z; of places with orientations the rotation vector
from a given orientation as well, in the axes of the map."""


def turning_columns(numbers: int) -> FloatArray:
    """Return (T, D, D) by which matrix each column of turning displaces a point: in the plane that of cosine - 1 and
    that of the sine, in space those of the numbers of R - I, and 0 for the rotation vector, which moves no point.

    Args:
        numbers: of a landmark: `PLANE`, `POINTS`, `PLACES`.
    """
    if numbers == PLANE:
        return np.array([[[1.0, 0.0], [0.0, 1.0]], [[0.0, -1.0], [1.0, 0.0]]])
    return np.concatenate([np.eye(9).reshape(9, 3, 3), np.zeros((numbers - 3, 3, 3))])


def motion_spread(prior: ChangesConfig, numbers: int) -> FloatArray:
    """Return the prior standard deviations of a motion's displacement, 2 or 3 [m], and of its turn, 1 or 3 [rad]."""
    if numbers == PLANE:
        return prior.spread
    return np.repeat([prior.move_sigma_m, prior.turn_sigma_rad], 3)


def spread_of(motion: FloatArray, prior: ChangesConfig) -> FloatArray:
    """Return the prior standard deviations (Y,) of a motion (Y,), which are wider where its displacement is far."""
    point_dim = PLANE if len(motion) == PLANE + 1 else POINTS
    spread = motion_spread(prior, PLANE if point_dim == PLANE else PLACES)
    if not is_far(motion[:point_dim] / spread[:point_dim], far_prior(prior)):
        return spread
    return np.append(prior.far * spread[:point_dim], spread[point_dim:])


def far_prior(prior: ChangesConfig) -> FloatArray:
    """Return how much farther some things go, how many do, and the usual distance of two on a body that turned [m].

    Any two that moved apart fit some turn but for one number, their distance. Three and more leave no doubt.
    """
    return np.array([prior.far, prior.p_far, prior.body_m])


class Tables(NamedTuple):
    """Precomputed tables for gains.

    Attributes:
        quadratic: (C K, C K) `T'AT`, with D + T columns a item.
        linear: (C K,) `T'b`.
        position: (L, D) mapped positions.
        turning: (T, D, D) columns of turning; see `turning_columns`.
        spread: (Y,) prior standard deviations of a motion; see `motion_spread`.
        log_prior: (L + 1, 2) log prior of a group by its size, for groups that only move and that turn, relative to
            'nothing moved'.
        log_onset: (W,) log prior of the window from which on a group has moved.
        far: (3,) see `far_prior`.
    """

    quadratic: FloatArray
    linear: FloatArray
    position: FloatArray
    turning: FloatArray
    spread: FloatArray
    log_prior: FloatArray
    log_onset: FloatArray
    far: FloatArray = far_prior(ChangesConfig())


@kernel
def hypothesis_gain(label: IntArray, onset: IntArray, turns: Any, tables: Tables) -> tuple[float, FloatArray]:
    """Return the gain [nats] and the most probable motion (G, Y) of every group: its displacement [m], in the plane
    an angle, in space a rotation vector [rad].

    `label` (L,) is the group of every landmark, 0 = static, groups are 1..G; `onset` (G + 1,) the window from which on
    each has moved, and `turns` (G + 1,) whether it also turns, whose row 0 is not used.
    """
    groups, spread, point_dim = len(onset) - 1, tables.spread, tables.position.shape[1]
    width, first, matrix, right, gain = _products(label, onset, turns, tables)
    motion = np.zeros((groups, len(spread)))
    total = first[groups + 1]
    if total == 0:
        return gain, motion
    # unknowns y: a displacement and, where a group turns, a rotation; columns z(y): the displacement, and `turning`
    start = np.zeros(groups + 2, dtype=np.int64)
    any_turns = False
    for g in range(1, groups + 1):
        start[g + 1] = start[g] + (0 if width[g] == 0 else (len(spread) if width[g] > point_dim else point_dim))
        any_turns = any_turns or width[g] > point_dim
    size = start[groups + 1]
    scale = np.zeros(size)
    for g in range(1, groups + 1):
        for a in range(start[g + 1] - start[g]):
            scale[start[g] + a] = spread[a]
    value = np.zeros(size)  # in units of its prior
    column, tangent, weighted = np.zeros(total), np.zeros((total, size)), np.zeros(total)
    inner, step = np.zeros((size, size)), np.zeros(size)
    far, is_settled, steps = np.zeros(groups + 1, dtype=np.bool_), False, _TURN_STEPS if any_turns else 1
    while not is_settled:
        for _ in range(steps):
            _columns_of(value, scale, width, first, start, point_dim, column, tangent)
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
        is_settled, steps = True, min(steps, _MORE_STEPS)
        for g in range(1, groups + 1):
            if width[g] == 0 or far[g] or not is_far(value[start[g] : start[g] + point_dim], tables.far):
                continue
            far[g], is_settled = True, False
            gain += np.log(tables.far[1])
            for a in range(start[g], start[g] + point_dim):
                scale[a] *= tables.far[0]
                value[a] /= tables.far[0]
    _columns_of(value, scale, width, first, start, point_dim, column, tangent)
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
def is_far(displacement: FloatArray, far: FloatArray) -> bool:
    """Return whether a displacement (D,), in its prior's standard deviations, is more probable as one that is far.

    Most are not, so that for these the prior is the one that is stated.
    """
    squared = 0.0
    for a in range(len(displacement)):
        squared += displacement[a] * displacement[a]
    return bool(0.5 * squared * (1.0 - far[0] ** -2) > len(displacement) * np.log(far[0]) - np.log(far[1]))


@kernel
def gain_of(label: IntArray, onset: IntArray, turns: Any, tables: Tables) -> float:
    """Return the gain of `hypothesis_gain` alone: of one group that only moves in the plane in closed form.

    Most hypotheses that a search weighs are such, and nearly all of the time of the general one is its tables.
    """
    group, size = 0, 0
    for i in range(len(label)):
        if label[i] > 0:
            if group > 0 and label[i] != group:
                return float(hypothesis_gain(label, onset, turns, tables)[0])
            group = label[i]
            size += 1
    if group == 0:
        return 0.0
    if turns[group] or tables.position.shape[1] != PLANE:
        return float(hypothesis_gain(label, onset, turns, tables)[0])
    count, columns = len(label), PLANE + len(tables.turning)
    xx, yx, xy, yy, x, y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        if label[i] != group:
            continue
        at = columns * (onset[group] * count + i)
        x += tables.linear[at]
        y += tables.linear[at + 1]
        for j in range(count):
            if label[j] == group:
                to = columns * (onset[group] * count + j)
                xx += tables.quadratic[at, to]
                xy += tables.quadratic[at, to + 1]
                yx += tables.quadratic[at + 1, to]
                yy += tables.quadratic[at + 1, to + 1]
    # in units of the prior of the displacement
    across, along = tables.spread[0], tables.spread[1]
    first = np.sqrt(1.0 + across * xx * across)
    between = along * yx * across / first
    second = np.sqrt(max(1.0 + along * yy * along - between * between, 1e-300))
    v = across * x / first
    w = (along * y - between * v) / second
    if is_far(np.array([(v - between * w / second) / first, w / second]), tables.far):
        return float(hypothesis_gain(label, onset, turns, tables)[0])
    prior = tables.log_prior[size, 0] + tables.log_onset[onset[group]]
    return float(prior + 0.5 * (v * v + w * w) - np.log(first) - np.log(second))


@kernel
def _products(
    label: IntArray, onset: IntArray, turns: Any, tables: Tables
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, float]:
    """Columns of every group (0, D or D + T), the first of each, their `C'AC` and `C'b` about centroids; log prior."""
    quadratic, linear, position, turning, _, log_prior, log_onset, far = tables
    count, groups, point_dim = len(label), len(onset) - 1, position.shape[1]
    columns = point_dim + len(turning)
    width, size = np.zeros(groups + 1, dtype=np.int64), np.zeros(groups + 1, dtype=np.int64)
    first = np.zeros(groups + 2, dtype=np.int64)
    centre = np.zeros((groups + 1, point_dim))
    members = np.zeros((groups + 1, count), dtype=np.int64)
    for i in range(count):
        g = label[i]
        members[g, size[g]] = i
        size[g] += 1
        for a in range(point_dim):
            centre[g, a] += position[i, a]
    prior = 0.0
    for g in range(1, groups + 1):
        if size[g] > 0:
            for a in range(point_dim):
                centre[g, a] /= size[g]
            width[g] = columns if turns[g] else point_dim
            prior += log_prior[size[g], 1 if turns[g] else 0] + log_onset[onset[g]]
            if turns[g] and size[g] == 2:
                squared = 0.0
                for a in range(point_dim):
                    squared += (position[members[g, 0], a] - position[members[g, 1], a]) ** 2
                prior -= np.sqrt(squared) / far[2]
        first[g + 1] = first[g] + width[g]
    total = first[groups + 1]
    matrix, right = np.zeros((total, total)), np.zeros(total)
    for g in range(1, groups + 1):
        for m in range(size[g]):
            at = columns * (onset[g] * count + members[g, m])
            for a in range(width[g]):
                right[first[g] + a] += linear[at + a]
            for h in range(g, groups + 1):
                for n in range(size[h]):
                    to = columns * (onset[h] * count + members[h, n])
                    for a in range(width[g]):
                        for c in range(width[h]):
                            matrix[first[g] + a, first[h] + c] += quadratic[at + a, to + c]
    for g in range(1, groups + 1):
        for h in range(g + 1, groups + 1):
            for a in range(width[g]):
                for c in range(width[h]):
                    matrix[first[h] + c, first[g] + a] = matrix[first[g] + a, first[h] + c]
    # from turning about the origin to turning about the centroid
    by = np.zeros(point_dim)
    for g in range(1, groups + 1):
        f = first[g]
        for t in range(width[g] - point_dim):
            _displace(turning[t], centre[g], by)
            right[f + point_dim + t] -= _sum_weighted(by, right, f)
            for k in range(total):
                matrix[f + point_dim + t, k] -= _sum_weighted(by, matrix[:, k], f)
        for t in range(width[g] - point_dim):
            _displace(turning[t], centre[g], by)
            for k in range(total):
                matrix[k, f + point_dim + t] -= _sum_weighted(by, matrix[k], f)
    return width, first, matrix, right, prior


@kernel
def _displace(turning: FloatArray, point: FloatArray, by: FloatArray) -> None:
    """Write by how much a column of turning displaces a point."""
    for a in range(len(point)):
        by[a] = 0.0
        for c in range(len(point)):
            by[a] += turning[a, c] * point[c]


@kernel
def _sum_weighted(by: FloatArray, values: FloatArray, first: int) -> float:
    """Sum of values from the first on, as many as there are weights; some of these are 0."""
    total = 0.0
    for a in range(len(by)):
        if by[a] != 0.0:
            total += by[a] * values[first + a]
    return total


@kernel
def _columns_of(
    value: FloatArray, scale: FloatArray, width: IntArray, first: IntArray, start: IntArray, point_dim: int,
    column: FloatArray, tangent: FloatArray,
) -> None:  # fmt: skip
    """Columns (C,) at the unknowns (Y,), and their derivatives (C, Y)."""
    tangent[:] = 0.0
    for g in range(1, len(width)):
        if width[g] == 0:
            continue
        f, s = first[g], start[g]
        for a in range(point_dim):
            column[f + a] = value[s + a] * scale[s + a]
            tangent[f + a, s + a] = scale[s + a]
        if width[g] == point_dim:
            continue
        f, s = f + point_dim, s + point_dim
        if point_dim == 2:
            angle = value[s] * scale[s]
            column[f], column[f + 1] = np.cos(angle) - 1.0, np.sin(angle)
            tangent[f, s], tangent[f + 1, s] = -np.sin(angle) * scale[s], np.cos(angle) * scale[s]
        else:
            turn, by = _rotation(value[s : s + 3] * scale[s : s + 3])
            for a in range(9):
                column[f + a] = turn[a // 3, a % 3] - (1.0 if a % 4 == 0 else 0.0)
                for c in range(3):
                    tangent[f + a, s + c] = by[c, a // 3, a % 3] * scale[s + c]
            for a in range(width[g] - point_dim - 9):
                column[f + 9 + a] = value[s + a] * scale[s + a]
                tangent[f + 9 + a, s + a] = scale[s + a]


@kernel
def _rotation(vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrix (3, 3) of a rotation vector, and its derivatives (3, 3, 3) by each number of that.

    `R = 1 + a W + b W^2`, `dR / dv_k = (J e_k) x R` with the left Jacobian `J = 1 + b W + c W^2`, `W` the cross product
    with the vector.
    """
    q = vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]
    if q < 1e-4:  # series, to 1e-16
        a, b, c = 1.0 - q / 6.0 + q * q / 120.0, 0.5 - q / 24.0 + q * q / 720.0, 1.0 / 6.0 - q / 120.0 + q * q / 5040.0
    else:
        t = np.sqrt(q)
        a, b, c = np.sin(t) / t, 2.0 * np.sin(0.5 * t) ** 2 / q, (t - np.sin(t)) / (q * t)
    turn, left, by = np.eye(3), np.eye(3), np.zeros((3, 3, 3))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for matrix, odd, even in ((turn, a, b), (left, b, c)):
            matrix[j, k] -= odd * vector[i]
            matrix[k, j] += odd * vector[i]
            for m in range(3):
                matrix[i, m] += even * (vector[i] * vector[m] - (q if i == m else 0.0))
    for k in range(3):
        for m in range(3):
            for i in range(3):
                j, n = (i + 1) % 3, (i + 2) % 3
                by[k, i, m] = left[j, k] * turn[n, m] - left[n, k] * turn[j, m]
    return turn, by


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


def log_prior(prior: ChangesConfig, n_landmarks: int, largest: int, *, numbers: int = PLANE) -> FloatArray:
    """Return (largest + 1, 2) log priors of a group by size, moved only and also turned: `eps 2^-n / C(N, n)`.

    A point alone has nothing to turn; a place with an orientation has.
    """
    size = np.arange(largest + 1)
    choices = gammaln(n_landmarks + 1) - gammaln(size + 1) - gammaln(n_landmarks - size + 1)
    group = np.log(prior.p_moved) - np.log1p(-prior.p_moved) - size * np.log(2.0) - choices
    with np.errstate(divide="ignore"):
        table: FloatArray = group[:, None] + np.log([1.0 - prior.p_rotated, prior.p_rotated])
    if numbers != PLACES:
        table[:2, 1] = -np.inf
    table[0] = 0.0
    return table


def log_onset(n_windows: int) -> FloatArray:
    """Return (W,) log prior of the window from which on a group has moved: before the session as likely as within."""
    if n_windows == 1:
        return np.zeros(1)
    return np.asarray(np.log(np.append(0.5, np.full(n_windows - 1, 0.5 / (n_windows - 1)))))
