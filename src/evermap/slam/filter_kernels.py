"""The steps of the local filter, compiled: predict, compare a frame with places, update by all of it at once.

A state is the newest pose, the calibration states and the places in slots: covariance (14 + 2 K, 14 + 2 K) in this
order, rows of slots that are free zero. Everything is in place.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evermap.compiled import kept
from evermap.estimate.robust import HEAVY_TAIL, weigh
from evermap.slam.kernels import (
    AT_PLACES,
    N_MOTION,
    N_NOISE,
    N_SENSOR,
    N_STATES,
    adjoint,
    composed,
    detection_residual,
    integrate_odometry,
    inverted,
    kernel,
    odometry_covariance,
    sandwich,
    wrapped,
)
from evermap.types import FloatArray, IntArray

DRIVEN, BY_PLACE, WIDTH = 3 + N_SENSOR, 3 + N_SENSOR, 3 + N_SENSOR + 2
"""Where the states of the odometry begin in the covariance; and in what a detection depends on, its place, and all."""
ITERATIONS = 10
SMALL_STEP = 1e-4
"""Iterations of an update at most, and the step (m, rad or 1) that ends them."""
CONSIDERED_STEP = 1e-2
"""The same where places are only considered, and none can be led astray: less bends no measurement equation."""
SMALL_TURN = 1e-6
"""Angle (rad) below which an arc is its second-order series."""
SETTLED_WEIGHT = 0.02
"""Change of a weight below which the iterations end."""
UNSURE = 4.0
"""Times by which a detection's innovation is wider (in area) than its own noise where the pose is so uncertain that
whether the detection is an outlier is better asked of the others of the frame."""
LEAST_WEIGHT = 1e-6
LARGE = 32
"""Rows from which a matrix is factorised by LAPACK."""
BELIEVED, HEAVY, BY_OTHERS, GATED = 0, 1, 2, 3
"""How detections are weighed: not at all; by the Cauchy's tails, as in the smoother's first rounds; as inliers or
outliers, where the pose is uncertain by what the others of the frame say; not at all, but as linear as the joint gates
that they passed: iterated, a wrong pairing leads farther astray (MRCLAM 6, robot 4: 0.7 m for 0.12 m)."""


@kernel
def linearise_frame(
    pose: FloatArray, states: FloatArray, place: FloatArray, start: FloatArray, start_place: FloatArray, slot: IntArray,
    reading: FloatArray, mount: FloatArray, free: Any, residual: FloatArray, jacobian: FloatArray, column: IntArray,
) -> None:  # fmt: skip
    """Compute residuals (2 M,), derivatives (2 M, 12) and which numbers of the state (M, 12) these are by.

    Derivatives are by the errors at the start of the update, which `_turn_on` carries to where pose and places are now.
    """
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    c, s = math.cos(start[2] - pose[2]), math.sin(start[2] - pose[2])
    for m in range(len(reading)):
        x = place[slot[m], 0] - start_place[slot[m], 0] - pose[0] + start[0]
        y = place[slot[m], 1] - start_place[slot[m], 1] - pose[1] + start[1]
        detection_residual(pose, place[slot[m]], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        for k in range(2):
            row = 2 * m + k
            residual[row] = e[k]
            jacobian[row, 0] = c * jx[k, 0] + s * jx[k, 1]
            jacobian[row, 1] = -s * jx[k, 0] + c * jx[k, 1]
            jacobian[row, 2] = jx[k, 2] + x * jl[k, 1] - y * jl[k, 0]
            for a in range(N_SENSOR):
                jacobian[row, 3 + a] = jc[k, a] if free[a] else 0.0
            jacobian[row, BY_PLACE], jacobian[row, BY_PLACE + 1] = jl[k, 0], jl[k, 1]
        for a in range(BY_PLACE):
            column[m, a] = a
        column[m, BY_PLACE], column[m, BY_PLACE + 1] = AT_PLACES + 2 * slot[m], AT_PLACES + 2 * slot[m] + 1


@kernel
def spread_of_frame(
    covariance: FloatArray, jacobian: FloatArray, column: IntArray, gain: FloatArray, spread: FloatArray
) -> None:
    """Compute `H P` (2 M, size) and `H P H'` (2 M, 2 M)."""
    gain[:] = 0.0
    for row in range(len(jacobian)):
        for a in range(WIDTH):
            by, at = jacobian[row, a], column[row // 2, a]
            if by != 0.0:
                for k in range(len(covariance)):
                    gain[row, k] += by * covariance[at, k]
    np.dot(np.ascontiguousarray(gain[:, :BY_PLACE]), np.ascontiguousarray(jacobian[:, :BY_PLACE].T), spread)
    for row in range(len(jacobian)):
        for other in range(row + 1):
            x, y = column[other // 2, BY_PLACE], column[other // 2, BY_PLACE + 1]
            total = spread[row, other] + gain[row, x] * jacobian[other, BY_PLACE]
            total += gain[row, y] * jacobian[other, BY_PLACE + 1]
            spread[row, other] = spread[other, row] = total


@kernel
def along_turn(x: float, y: float, turn: float) -> tuple[float, float]:
    """Return the chord (2,) of an arc that begins in the direction of, and is as long as, (x, y), and turns by `turn`.

    `V(turn) (x, y)` of the exponential of SE(2).
    """
    if abs(turn) < SMALL_TURN:
        return x - 0.5 * turn * y, y + 0.5 * turn * x
    s, c = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
    return s * x - c * y, c * x + s * y


@kernel
def driven(
    stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, start_s: float, stop_s: float, states: FloatArray,
    free: Any, sigma: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return increment, derivatives by free states, and covariance of the motion between two instants: `Motion`."""
    increment, by_states = np.zeros(3), np.zeros((3, N_MOTION))
    kinds, covariance = np.zeros((N_NOISE, 3, 3)), np.zeros((3, 3))
    integrate_odometry(stamp, velocity, unknown, start_s, stop_s, states, increment, by_states, kinds, covariance)
    odometry_covariance(kinds, covariance, sigma**2, covariance)
    for k in range(N_MOTION):
        if not free[N_SENSOR + k]:
            by_states[:, k] = 0.0
    return increment, by_states, covariance


@kernel
def drive_on(
    pose: FloatArray, covariance: FloatArray, increment: FloatArray, by_states: FloatArray, noise: FloatArray
) -> None:
    """Advance the newest pose and the joint covariance to the next pose, in place."""
    moved, size = composed(pose, increment), len(covariance)
    pose[0], pose[1], pose[2] = moved[0], moved[1], wrapped(moved[2])
    carry = adjoint(inverted(increment))
    for k in range(3, size):
        x, y, turn = covariance[0, k], covariance[1, k], covariance[2, k]
        covariance[0, k] = carry[0, 0] * x + carry[0, 1] * y + carry[0, 2] * turn
        covariance[1, k] = carry[1, 0] * x + carry[1, 1] * y + carry[1, 2] * turn
    block = covariance[:3, :3].copy()
    cross = covariance[:3, DRIVEN:AT_PLACES].copy() @ by_states.T
    own, more = carry @ block @ carry.T, by_states @ covariance[DRIVEN:AT_PLACES, DRIVEN:AT_PLACES].copy() @ by_states.T
    for a in range(3):
        for k in range(3):
            covariance[a, k] = own[a, k] + cross[a, k] + cross[k, a] + noise[a, k] + more[a, k]
        for k in range(3, size):
            for b in range(N_MOTION):
                covariance[a, k] += by_states[a, b] * covariance[DRIVEN + b, k]
            covariance[k, a] = covariance[a, k]


@kernel
def told(
    pose: FloatArray, covariance: FloatArray, front: FloatArray, scale: float, in_map: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the pose (3,) of the robot's front in metres, and its covariance (3, 3), in its own frame.

    The pose of the state is the first in its covariance, `front` (3,) is seen from it, `scale` are metres in a unit of
    the state. The frame is that of the poses in a map, else that of the front at the first of them.
    """
    seen, back = composed(pose, front), inverted(front)
    if not in_map:
        seen = composed(back, seen)
    carry = adjoint(back)
    spread = carry @ covariance[:3, :3].copy() @ carry.T
    for k in range(2):
        seen[k] *= scale
        spread[k] *= scale
        spread[:, k] *= scale
    seen[2] = wrapped(seen[2])
    return seen, spread


@kernel
def innovations(
    pose: FloatArray, states: FloatArray, covariance: FloatArray, place: FloatArray, slot: Any, own: FloatArray,
    reading: FloatArray, sigma: FloatArray, mount: FloatArray, free: Any,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Compare K detections, range and bearing, with one place (2,) each, each pair separately: `S = H P H' + R`.

    `slot` (K,) says where a place stands in the covariance; where it is -1, `own` (K, 2, 2) is that of the place.

    Returns:
        (K,) squared Mahalanobis distance, (K,) `log |S|`, (K, 2) residual and (K, 2, 12) its derivatives by pose,
        sensor states and place.
    """
    count = len(reading)
    nis, log_det, residual, by = np.empty(count), np.empty(count), np.empty((count, 2)), np.zeros((count, 2, WIDTH))
    jx, jl, jc = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    part, h_part, s, at = np.zeros((WIDTH, WIDTH)), np.zeros((2, WIDTH)), np.zeros((2, 2)), np.arange(WIDTH)
    for m in range(count):
        e, h = residual[m], by[m]
        at[BY_PLACE], at[BY_PLACE + 1] = AT_PLACES + 2 * slot[m], AT_PLACES + 2 * slot[m] + 1
        detection_residual(pose, place[m], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        for a in range(2):
            for b in range(WIDTH):
                if b < 3:
                    h[a, b] = jx[a, b]
                elif b >= BY_PLACE:
                    h[a, b] = jl[a, b - BY_PLACE]
                else:
                    h[a, b] = jc[a, b - 3] if free[b - 3] else 0.0
        for a in range(WIDTH):
            for b in range(WIDTH):
                if slot[m] >= 0 or max(a, b) < BY_PLACE:
                    part[a, b] = covariance[at[a], at[b]]
                else:
                    part[a, b] = own[m, a - BY_PLACE, b - BY_PLACE] if min(a, b) >= BY_PLACE else 0.0
        sandwich(h, part, h_part, s)
        a, b, d = s[0, 0] + sigma[m, 0] ** 2, s[0, 1], s[1, 1] + sigma[m, 1] ** 2
        nis[m] = _squared(a, b, d, e[0], e[1])
        log_det[m] = math.log(a * d - b * b)
    return nis, log_det, residual, by


@kernel
def update(
    pose: FloatArray, states: FloatArray, covariance: FloatArray, position: FloatArray, row: Any, slot: Any,
    reading: FloatArray, sigma: FloatArray, log_odds: FloatArray, mount: FloatArray, free: Any, considered: bool,
    weighing: int,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Update by all detections of a frame at once, relinearised and re-weighted until nothing moves.

    The step is right-invariant (Barrau and Bonnabel 2015, "An EKF-SLAM algorithm with consistency properties"): it
    moves whatever stands in the world by `V(phi) dp`. The covariance, of errors in the world, is re-expressed at the
    new state, `dp + J (p+ - p-) phi`, so that a heading that no detection shows stays as uncertain as it was.

    Only pose, calibration and the places that are seen take part in that; the other places follow at last. Places that
    are only considered (Schmidt 1966) stand in the covariance with the correlations that detections make, but stay
    where they are: pose and calibration get the gain that is best for them, the places none.

    Args:
        pose: (3,) in and out.
        states: (11,) in and out.
        covariance: in and out.
        position: (L, 2) in and out, of all places.
        row: (K,) which of them is in each slot, negative in a free one.
        slot: (M,) of the place of each detection.
        reading: (M, 2) range and bearing.
        sigma: (M, 2) their noise.
        log_odds: (M,) for 'no outlier' where a detection is exactly where it is expected, for `BY_OTHERS`.
        mount: (3,) pose of the sensor on the robot.
        free: (11,) which calibration states are estimated.
        considered: whether places stay where they are.
        weighing: how detections are weighed.

    Returns:
        (M,) squared distance of each innovation by itself, before the frame was used, and (M,) weights.
    """
    count, small = len(slot), CONSIDERED_STEP if considered else SMALL_STEP
    size, own = AT_PLACES + 2 * count, np.arange(count)
    nis, weight, credible = np.zeros(count), np.ones(count), np.ones(count)
    if count == 0:
        return nis, weight
    place, where, part = np.empty((count, 2)), np.arange(size), np.empty((size, size))
    for k in range(2 * count):
        place[k // 2, k % 2] = position[row[slot[k // 2]], k % 2]
        where[AT_PLACES + k] = AT_PLACES + 2 * slot[k // 2] + k % 2
    for k in range(size):
        for other in range(size):
            part[k, other] = covariance[where[k], where[other]]
    start, start_states, start_place = pose.copy(), states.copy(), place.copy()
    moving, before, step = AT_PLACES if considered else size, np.zeros(size), np.zeros(size)
    innovation, pull = np.zeros(2 * count), np.zeros(2 * count)
    jacobian, column = np.zeros((2 * count, WIDTH)), np.zeros((count, WIDTH), dtype=np.int64)
    root, gain, spread = np.zeros((2 * count, 2 * count)), np.zeros((2 * count, size)), np.zeros((0, 0))
    unsure = False
    for iteration in range(1 if weighing == GATED else ITERATIONS):
        linearise_frame(
            pose, states, place, start, start_place, own, reading, mount, free, innovation, jacobian, column
        )
        spread_of_frame(part, jacobian, column, gain, root)
        if weighing == BY_OTHERS and iteration == 0:
            unsure = _surprises(part, jacobian, root, innovation, sigma, nis)
            for m in range(count):
                weight[m] = credible[m] = max(weigh(nis[m], log_odds[m], 0.0, 0.0)[0], LEAST_WEIGHT)
        for m in range(count if weighing == HEAVY else 0):
            # before anything is known of this frame: as surprising as its innovation is
            unknown = 1.0 if iteration == 0 else 0.0
            a, d = unknown * root[2 * m, 2 * m], unknown * root[2 * m + 1, 2 * m + 1]
            squared = _squared(
                a + sigma[m, 0] ** 2, unknown * root[2 * m, 2 * m + 1], d + sigma[m, 1] ** 2,
                innovation[2 * m], innovation[2 * m + 1],
            )  # fmt: skip
            weight[m] = weigh(squared, 0.0, HEAVY_TAIL, 0.0)[0]
        for each in range(2 * count):
            root[each, each] += sigma[each // 2, each % 2] ** 2 / weight[each // 2]
            # innovation at the step so far, expressed at the start
            for a in range(WIDTH):
                innovation[each] -= jacobian[each, a] * step[column[each // 2, a]]
        if unsure:
            spread = root.copy()
        _solve(root, innovation, pull)
        moved = 0.0
        for k in range(moving):
            before[k], step[k] = step[k], 0.0
            for each in range(2 * count):
                step[k] -= pull[each] * gain[each, k]
            moved = max(moved, abs(step[k] - before[k]))
        c, s = math.cos(start[2]), math.sin(start[2])
        x, y = along_turn(c * step[0] - s * step[1], s * step[0] + c * step[1], step[2])
        pose[0], pose[1], pose[2] = start[0] + x, start[1] + y, wrapped(start[2] + step[2])
        for k in range(N_STATES):
            states[k] = start_states[k] + step[3 + k]
        for k in range(0 if considered else count):
            x, y = along_turn(step[AT_PLACES + 2 * k], step[AT_PLACES + 2 * k + 1], step[2])
            place[k, 0], place[k, 1] = start_place[k, 0] + x, start_place[k, 1] + y
        changed = 0.0
        if unsure:
            changed = _weigh_by_the_others(spread, pull, sigma, log_odds, iteration == 0, credible, weight)
        if moved < small and changed < SETTLED_WEIGHT:
            break
    lever = np.zeros(AT_PLACES if considered else len(covariance))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] - start[0], pose[1] - start[1]
    lever[0], lever[1] = s * x - c * y, c * x + s * y
    white = np.zeros((2 * count, len(covariance) + 1))
    for k in range(2 * count):
        column[k // 2, BY_PLACE + k % 2], white[k, -1] = where[AT_PLACES + k], innovation[k]
    _across(covariance, jacobian, column, white)
    if considered:
        _consider(covariance, root, white)
    else:
        _condition(covariance, root, white)
        for k in range(len(row)):
            if row[k] >= 0:
                x = y = 0.0
                for each in range(2 * count):
                    x -= white[each, AT_PLACES + 2 * k] * white[each, -1]
                    y -= white[each, AT_PLACES + 2 * k + 1] * white[each, -1]
                x, y = along_turn(x, y, step[2])
                position[row[k], 0], position[row[k], 1] = position[row[k], 0] + x, position[row[k], 1] + y
                lever[AT_PLACES + 2 * k], lever[AT_PLACES + 2 * k + 1] = -y, x
    _turn_on(covariance, step[2], lever)
    return nis, weight


@kernel
def _surprises(
    part: FloatArray, jacobian: FloatArray, spread: FloatArray, residual: FloatArray, sigma: FloatArray, nis: FloatArray
) -> bool:
    """Return the squared distance of every detection alone; True if the pose is too uncertain for this."""
    unsure = False
    for m in range(len(nis)):
        r, q, x = sigma[m, 0] ** 2, sigma[m, 1] ** 2, AT_PLACES + 2 * m
        a, b, d = spread[2 * m, 2 * m] + r, spread[2 * m, 2 * m + 1], spread[2 * m + 1, 2 * m + 1] + q
        nis[m] = _squared(a, b, d, residual[2 * m], residual[2 * m + 1])
        # its value if only the reading and the place were uncertain
        xx, xy, yy = part[x, x], part[x, x + 1], part[x + 1, x + 1]
        i, j = jacobian[2 * m, BY_PLACE], jacobian[2 * m, BY_PLACE + 1]
        k, n = jacobian[2 * m + 1, BY_PLACE], jacobian[2 * m + 1, BY_PLACE + 1]
        own_a = i * i * xx + 2.0 * i * j * xy + j * j * yy + r
        own_b = i * k * xx + (i * n + j * k) * xy + j * n * yy
        own_d = k * k * xx + 2.0 * k * n * xy + n * n * yy + q
        unsure |= a * d - b * b > UNSURE * (own_a * own_d - own_b * own_b)
    return unsure


@kernel
def _weigh_by_the_others(
    spread: FloatArray, pull: FloatArray, sigma: FloatArray, log_odds: FloatArray, heavy: bool, credible: FloatArray,
    weight: FloatArray,
) -> float:  # fmt: skip
    """Compute weights, at most `credible`, from each detection's innovation given all others; return the largest
    change.

    With `V` the inverse of the innovations' covariance and `p = V r`, what is left of detection m when the others have
    been used is `V_mm^-1 p_m`, with covariance `V_mm^-1` (leave one out).
    """
    inverse: Any = np.linalg.inv(spread)
    changed = 0.0
    for m in range(len(weight)):
        a, b, d = inverse[2 * m, 2 * m], inverse[2 * m, 2 * m + 1], inverse[2 * m + 1, 2 * m + 1]
        det = a * d - b * b
        aa, bb, dd = d / det, -b / det, a / det
        x, y = aa * pull[2 * m] + bb * pull[2 * m + 1], bb * pull[2 * m] + dd * pull[2 * m + 1]
        more = 1.0 / weight[m] - 1.0  # noise by which it was held to be an outlier
        squared = _squared(aa - more * sigma[m, 0] ** 2, bb, dd - more * sigma[m, 1] ** 2, x, y)
        now, _ = weigh(max(squared, 0.0), log_odds[m], HEAVY_TAIL if heavy else 0.0, 0.0)
        now = min(max(now, LEAST_WEIGHT), credible[m])
        changed = max(changed, abs(now - weight[m]))
        weight[m] = now
    return changed


@kernel
def _squared(a: float, b: float, d: float, x: float, y: float) -> float:
    """Squared Mahalanobis distance of (x, y) with covariance [[a, b], [b, d]]."""
    return (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)


@kernel
def _solve(matrix: FloatArray, right: FloatArray, x: FloatArray) -> None:
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


vectorised = kept(effort=3, error_model="numpy", fastmath={"contract"})


@vectorised
def _across(covariance: FloatArray, jacobian: FloatArray, column: Any, out: FloatArray) -> None:
    """Add `H P`, (2 M, size), to the first columns of `out`."""
    for row in range(len(out)):
        for a in range(WIDTH):
            by, at = jacobian[row, a], column[row // 2, a]
            for k in range(len(covariance) if by != 0.0 else 0):
                out[row, k] += by * covariance[at, k]


@vectorised
def _condition(covariance: FloatArray, root: FloatArray, white: FloatArray) -> None:
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
    for i in range(len(covariance)):
        mine = covariance[i]
        for row in range(0, len(white), 2):
            one, two = white[row], white[row + 1]
            a, b = one[i], two[i]
            for k in range(i + 1):
                mine[k] -= a * one[k] + b * two[k]
        for k in range(i):
            covariance[k, i] = mine[k]


@vectorised
def _consider(covariance: FloatArray, root: FloatArray, across: FloatArray) -> None:
    """Update pose and states as Schmidt with `across`, the `H P` of all; the places keep what is unknown of them."""
    n, size = len(root), len(covariance)
    told = across[:, :AT_PLACES].copy()  # becomes S^-1 H P, of pose and states alone
    for i in range(n):
        for k in range(i):
            for b in range(AT_PLACES):
                told[i, b] -= root[i, k] * told[k, b]
        for b in range(AT_PLACES):
            told[i, b] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for b in range(AT_PLACES):
            told[i, b] /= root[i, i]
        for k in range(i):
            for b in range(AT_PLACES):
                told[k, b] -= root[i, k] * told[i, b]
    less = np.ascontiguousarray(told.T) @ across
    for a in range(AT_PLACES):
        for k in range(a, size):
            covariance[a, k] -= less[a, k]
            covariance[k, a] = covariance[a, k]


@vectorised
def _turn_on(covariance: FloatArray, turned: float, lever: FloatArray) -> None:
    """Re-express a covariance at the corrected state: of the pose in its own frame, which has turned, and of everything
    that has moved, by `lever` times the error of the heading.
    """
    c, s, heading = math.cos(turned), math.sin(turned), covariance[2].copy()
    for k in range(len(covariance)):
        x, y = covariance[0, k], covariance[1, k]
        covariance[0, k], covariance[1, k] = c * x + s * y, c * y - s * x
    for k in range(len(covariance)):
        x, y = covariance[k, 0], covariance[k, 1]
        covariance[k, 0], covariance[k, 1] = c * x + s * y, c * y - s * x
    x, y = heading[0], heading[1]
    heading[0], heading[1] = c * x + s * y, c * y - s * x
    for i in range(len(covariance)):
        mine = covariance[i]
        for k in range(len(covariance) if i < len(lever) else 0):
            mine[k] += lever[i] * heading[k]
        by = mine[2]
        for k in range(len(lever)):
            mine[k] += by * lever[k]
