"""A frame seen in a map that is believed but not estimated: Schmidt's update of pose and calibration.

The places of the map are wrong, by what their covariance says, and wrong in the same way in every frame. A filter that
takes that for fresh noise of each detection believes after a hundred frames in its pose to a tenth of the map's error.
So the places stand in the covariance beside the state (`kernels.AT_PLACES`), with the correlations that detections
make, but no detection moves them (Schmidt 1966, 'consider' states): pose and calibration get the gain that is best for
them, the places none.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evermap.slam.frame_factor import linearise_frame, spread_of_frame, turn_pose
from evermap.slam.kernels import AT_PLACES, detection_residual, inlier_weight, kernel, wrapped
from evermap.types import FloatArray, IntArray

ITERATIONS = 8
SMALL_STEP = 0.01
"""Iterations of an update at most, and the step (m, rad or 1) that ends them: less bends no measurement equation."""
SETTLED_WEIGHT = 0.02
"""Change of a weight below which the iterations end."""
UNSURE = 4.0
"""Times by which a detection's innovation is wider (in area) than its own noise where the pose is so uncertain that
whether the detection is an outlier is better asked of the others of the frame."""
LEAST_WEIGHT = 1e-6


@kernel
def choose_places(
    pose: FloatArray,
    states: FloatArray,
    covariance: FloatArray,
    position: FloatArray,
    block: FloatArray,
    log_p: FloatArray,
    slot: Any,
    first: IntArray,
    last: IntArray,
    reading: FloatArray,
    sigma: FloatArray,
    mount: FloatArray,
    free: Any,
    chosen: IntArray,
) -> None:
    """Choose the known place at which each landmark was seen: the most probable one (max-mixture, MATH.md section 5).

    Args:
        pose: (3,) of the filter, before the frame.
        states: (9,).
        covariance: (12 + 2 K, 12 + 2 K), as for `update_considering`.
        position: (P, 2) of all places.
        block: (P, 2, 2) covariance of each.
        log_p: (P,) of the probability that the landmark stands there.
        slot: (P,) where a place stands in the covariance, -1 where it does not.
        first: (M,) row of each detection's first candidate.
        last: (M,) row behind the last one.
        reading: (M, 2) of the detections.
        sigma: (M, 2) their noise.
        mount: (3,) pose of the sensor on the robot.
        free: (9,) which calibration states are estimated.
        chosen: (M,) out, rows.
    """
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    h, joint, part, s = np.zeros((2, 10)), np.zeros((10, 10)), np.zeros((2, 10)), np.zeros((2, 2))
    for m in range(len(reading)):
        chosen[m] = first[m]
        if last[m] - first[m] == 1:
            continue
        best = -np.inf
        for row in range(first[m], last[m]):
            detection_residual(pose, position[row], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
            for a in range(2):
                for b in range(3):
                    h[a, b] = jx[a, b]
                for b in range(5):
                    h[a, 3 + b] = jc[a, b] if free[b] else 0.0
                h[a, 8], h[a, 9] = jl[a, 0], jl[a, 1]
            for a in range(8):
                for b in range(8):
                    joint[a, b] = covariance[a, b]
                for b in range(2):
                    cross = covariance[a, AT_PLACES + 2 * slot[row] + b] if slot[row] >= 0 else 0.0
                    joint[a, 8 + b] = joint[8 + b, a] = cross
            joint[8:, 8:] = block[row]
            part[:] = 0.0
            for a in range(2):
                for k in range(10):
                    for b in range(10):
                        part[a, b] += h[a, k] * joint[k, b]
                for c in range(2):
                    s[a, c] = sigma[m, a] ** 2 if a == c else 0.0
                    for b in range(10):
                        s[a, c] += part[a, b] * h[c, b]
            det = s[0, 0] * s[1, 1] - s[0, 1] * s[1, 0]
            nis = _squared(s[0, 0], s[0, 1], s[1, 1], e[0], e[1])
            score = log_p[row] - 0.5 * nis - 0.5 * math.log(det)
            if score > best:
                best = score
                chosen[m] = row


@kernel
def update_considering(
    pose: FloatArray,
    states: FloatArray,
    covariance: FloatArray,
    place: FloatArray,
    slot: IntArray,
    reading: FloatArray,
    sigma: FloatArray,
    log_odds: FloatArray,
    mount: FloatArray,
    free: Any,
    nis: FloatArray,
    weight: FloatArray,
) -> None:
    """Update by all detections of a frame at once, relinearised and re-weighted until nothing moves.

    A detection's weight is its probability to be no outlier, given its innovation (`kernels.inlier_weight`). While the
    pose is uncertain many innovations are credible, so there a second one is asked: that which is left when the other
    detections of the frame have been used, each with its weight.

    Args:
        pose: (3,) in and out.
        states: (9,) in and out.
        covariance: (12 + 2 K, 12 + 2 K) in and out, of pose, states and the places that are considered.
        place: (K, 2) these places.
        slot: (M,) which of them each detection is of.
        reading: (M, 2) range and bearing.
        sigma: (M, 2) their noise.
        log_odds: (M,) for 'no outlier' where a detection is exactly where it is expected.
        mount: (3,) pose of the sensor on the robot.
        free: (9,) which calibration states are estimated.
        nis: (M,) out, squared Mahalanobis distance of the innovation, before the frame was used.
        weight: (M,) out.
    """
    size, count = len(covariance), len(reading)
    start, start_states, step = pose.copy(), states.copy(), np.zeros(AT_PLACES)
    residual, left, pull = np.zeros(2 * count), np.zeros(2 * count), np.zeros(2 * count)
    jacobian, column = np.zeros((2 * count, 10)), np.zeros((count, 10), dtype=np.int64)
    gain, spread = np.zeros((2 * count, size)), np.zeros((2 * count, 2 * count))
    credible, unsure = np.ones(count), False
    root: Any = spread
    for iteration in range(ITERATIONS):
        linearise_frame(pose, states, place, slot, reading, mount, free, step[2], residual, jacobian, column)
        spread_of_frame(covariance, jacobian, column, gain, spread)
        if iteration == 0:
            unsure = _innovations(covariance, jacobian, column, spread, residual, sigma, nis)
            for m in range(count):
                weight[m] = credible[m] = max(inlier_weight(nis[m], log_odds[m], False), LEAST_WEIGHT)
        for m in range(count):
            for k in range(2):
                spread[2 * m + k, 2 * m + k] += sigma[m, k] ** 2 / weight[m]
        # innovation at the step so far, told at the start
        for row in range(2 * count):
            left[row] = residual[row]
            for a in range(8):
                left[row] -= jacobian[row, a] * step[a]
        root = np.linalg.cholesky(spread)
        _solve(root, left, pull)
        moved = 0.0
        for k in range(AT_PLACES):
            total = 0.0
            for row in range(2 * count):
                total -= gain[row, k] * pull[row]
            moved = max(moved, abs(total - step[k]))
            step[k] = total
        c, s = math.cos(start[2]), math.sin(start[2])
        pose[0] = start[0] + c * step[0] - s * step[1]
        pose[1] = start[1] + s * step[0] + c * step[1]
        pose[2] = wrapped(start[2] + step[2])
        states[:] = start_states + step[3:]
        if unsure:
            changed = _weigh_by_the_others(spread, pull, sigma, log_odds, iteration == 0, credible, weight)
        else:
            changed = 0.0
        if moved < SMALL_STEP and changed < SETTLED_WEIGHT:
            break
    _learn(covariance, gain, root)
    turn_pose(covariance, step[2])


@kernel
def _innovations(
    covariance: FloatArray,
    jacobian: FloatArray,
    column: IntArray,
    spread: FloatArray,
    residual: FloatArray,
    sigma: FloatArray,
    nis: FloatArray,
) -> bool:
    """Squared distance of every detection by itself; True where the pose is so uncertain that this tells little."""
    unsure = False
    for m in range(len(nis)):
        r, q = sigma[m, 0] ** 2, sigma[m, 1] ** 2
        a, b, d = spread[2 * m, 2 * m] + r, spread[2 * m, 2 * m + 1], spread[2 * m + 1, 2 * m + 1] + q
        nis[m] = _squared(a, b, d, residual[2 * m], residual[2 * m + 1])
        # what it would be if only the reading and the place were uncertain
        x, y = column[m, 8], column[m, 9]
        xx, xy, yy = covariance[x, x], covariance[x, y], covariance[y, y]
        i, j = jacobian[2 * m, 8], jacobian[2 * m, 9]
        k, n = jacobian[2 * m + 1, 8], jacobian[2 * m + 1, 9]
        own_a = i * i * xx + 2.0 * i * j * xy + j * j * yy + r
        own_b = i * k * xx + (i * n + j * k) * xy + j * n * yy
        own_d = k * k * xx + 2.0 * k * n * xy + n * n * yy + q
        unsure |= a * d - b * b > UNSURE * (own_a * own_d - own_b * own_b)
    return unsure


@kernel
def _weigh_by_the_others(
    spread: FloatArray,
    pull: FloatArray,
    sigma: FloatArray,
    log_odds: FloatArray,
    heavy: bool,
    credible: FloatArray,
    weight: FloatArray,
) -> float:
    """New weights, at most `credible`, by each detection's innovation given all others; returns the largest change.

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
        now = min(max(inlier_weight(max(squared, 0.0), log_odds[m], heavy), LEAST_WEIGHT), credible[m])
        changed = max(changed, abs(now - weight[m]))
        weight[m] = now
    return changed


@kernel
def _squared(a: float, b: float, d: float, x: float, y: float) -> float:
    """Squared Mahalanobis distance of (x, y) with covariance [[a, b], [b, d]]."""
    return (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)


@kernel
def _solve(root: FloatArray, right: FloatArray, out: FloatArray) -> None:
    """`(L L')^-1 right`."""
    n = len(right)
    for i in range(n):
        total = right[i]
        for k in range(i):
            total -= root[i, k] * out[k]
        out[i] = total / root[i, i]
    for i in range(n - 1, -1, -1):
        out[i] /= root[i, i]
        for k in range(i):
            out[k] -= root[i, k] * out[i]


@kernel
def _learn(covariance: FloatArray, gain: FloatArray, root: FloatArray) -> None:
    """Schmidt's update, in place: the state's rows and columns lose what the frame told; the places' keep theirs."""
    n = len(root)
    white = np.zeros((n, AT_PLACES))  # L^-1 H P, of the state alone
    for i in range(n):
        for b in range(AT_PLACES):
            white[i, b] = gain[i, b]
        for k in range(i):
            by = root[i, k]
            for b in range(AT_PLACES):
                white[i, b] -= by * white[k, b]
        for b in range(AT_PLACES):
            white[i, b] /= root[i, i]
    for i in range(n - 1, -1, -1):  # (L L')^-1 H P
        for b in range(AT_PLACES):
            white[i, b] /= root[i, i]
        for k in range(i):
            by = root[i, k]
            for b in range(AT_PLACES):
                white[k, b] -= by * white[i, b]
    told = np.ascontiguousarray(white.T) @ gain
    for a in range(AT_PLACES):
        for k in range(a, len(covariance)):
            covariance[a, k] -= told[a, k]
            covariance[k, a] = covariance[a, k]
