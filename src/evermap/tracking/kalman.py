"""How kernels of this package are compiled, small linear algebra, and filters of positions and of boxes.

Filters of positions have constant acceleration or constant velocity in space. One path for every measurement
covariance: the axes are independent filters only where all noise is diagonal, which that of a camera or a lidar, long
in its line of sight, never is; and the whole nine states cost half a microsecond.

A box in the state is nine numbers: length, width, height [m], heading [rad], their four variances, and the log odds
that the heading is right rather than opposite, which detectors confuse. Every number has a filter of its own: sizes are
constant but for what a changing view does to them, headings turn at random, the faster the shorter the box.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.compiled import kept
from evermap.tracking.tracklets import FORWARD, N_DETECTED, VARIANCE, YAW, Rules
from evermap.types import FloatArray

kernel = kept(effort=1, error_model="numpy")
inlined = kept(effort=1, error_model="numpy", forceinline=True)

Vector = tuple[float, float, float]
Symmetric = tuple[float, float, float, float, float, float]
"""Entries xx, xy, xz, yy, yz and zz of a symmetric (3, 3)."""


@inlined
def sum_of(a: FloatArray, b: FloatArray) -> Symmetric:
    """Return the sum of two symmetric (3, 3), or of their first three rows and columns."""
    return (
        a[0, 0] + b[0, 0], a[0, 1] + b[0, 1], a[0, 2] + b[0, 2],
        a[1, 1] + b[1, 1], a[1, 2] + b[1, 2], a[2, 2] + b[2, 2],
    )  # fmt: skip


@inlined
def distance_and_log_det(offset: Vector, matrix: Symmetric) -> tuple[float, float]:
    """Return the squared Mahalanobis length of a vector under a symmetric (3, 3), and the log of its determinant.

    By the factors `L D L'`; infinite where the matrix is not positive definite.
    """
    x, y, z = offset
    xx, xy, xz, yy, yz, zz = matrix
    a, b = xy / xx, xz / xx
    d1 = yy - a * xy
    rest = yz - b * xy
    c = rest / d1
    d2 = zz - b * xz - c * rest
    if not (xx > 0.0 and d1 > 0.0 and d2 > 0.0):
        return math.inf, math.inf
    u = y - a * x
    v = z - b * x - c * u
    return x * x / xx + u * u / d1 + v * v / d2, math.log(xx * d1 * d2)


@inlined
def invert(m: FloatArray, out: FloatArray) -> None:
    """Fill `out` with the inverse of a symmetric positive definite (3, 3)."""
    xx, xy, xz, yy, yz, zz = m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]
    cxx, cxy, cxz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * cxx + xy * cxy + xz * cxz)
    out[0, 0], out[1, 1], out[2, 2] = cxx * scale, (xx * zz - xz * xz) * scale, (xx * yy - xy * xy) * scale
    out[0, 1] = out[1, 0] = cxy * scale
    out[0, 2] = out[2, 0] = cxz * scale
    out[1, 2] = out[2, 1] = (xy * xz - xx * yz) * scale


@kernel
def predict(mean: FloatArray, covariance: FloatArray, n: int, gap_s: float, density: float) -> None:
    """Move the first `n` filters on by `gap_s`, in place: white jerk (D = 9) or white acceleration (D = 6).

    Args:
        mean: (N, D) position, velocity and acceleration, three axes each.
        covariance: (N, D, D).
        n: rows in use.
        gap_s: time since the last prediction.
        density: power spectral density of the noise, each axis.
    """
    t = gap_s
    d = mean.shape[1]
    if d == 9:
        by_second = 0.5 * t * t
        t2, t3 = t * t, t * t * t
        q00, q01, q02 = density * t2 * t3 / 20.0, density * t2 * t2 / 8.0, density * t3 / 6.0
        q11, q12, q22 = density * t3 / 3.0, density * t2 / 2.0, density * t
        for i in range(n):
            m, p = mean[i], covariance[i]
            for a in range(3):
                m[a] += t * m[3 + a] + by_second * m[6 + a]
                m[3 + a] += t * m[6 + a]
            for a in range(3):  # rows, then columns: F P, then (F P) F'
                for c in range(9):
                    p[a, c] += t * p[3 + a, c] + by_second * p[6 + a, c]
                    p[3 + a, c] += t * p[6 + a, c]
            for r in range(9):
                for a in range(3):
                    p[r, a] += t * p[r, 3 + a] + by_second * p[r, 6 + a]
                    p[r, 3 + a] += t * p[r, 6 + a]
            for a in range(3):
                p[a, a] += q00
                p[3 + a, 3 + a] += q11
                p[6 + a, 6 + a] += q22
                p[a, 3 + a] += q01
                p[3 + a, a] += q01
                p[a, 6 + a] += q02
                p[6 + a, a] += q02
                p[3 + a, 6 + a] += q12
                p[6 + a, 3 + a] += q12
    else:
        q00, q01, q11 = density * t * t * t / 3.0, density * t * t / 2.0, density * t
        for i in range(n):
            m, p = mean[i], covariance[i]
            for a in range(3):
                m[a] += t * m[3 + a]
                for c in range(6):
                    p[a, c] += t * p[3 + a, c]
            for r in range(6):
                for a in range(3):
                    p[r, a] += t * p[r, 3 + a]
            for a in range(3):
                p[a, a] += q00
                p[3 + a, 3 + a] += q11
                p[a, 3 + a] += q01
                p[3 + a, a] += q01


@kernel
def update(mean: FloatArray, covariance: FloatArray, position: FloatArray, noise: FloatArray) -> None:
    """Update a filter with one measured position, in place; with D = 3 it is the filter of a place at rest.

    Args:
        mean: (D,) of one filter; its first three states are the position.
        covariance: (D, D).
        position: (3,) measured.
        noise: (3, 3) its covariance.
    """
    d = mean.shape[0]
    s, inverse, gain, innovation = np.empty((3, 3)), np.empty((3, 3)), np.empty((9, 3)), np.empty(3)
    for a in range(3):
        innovation[a] = position[a] - mean[a]
        for b in range(3):
            s[a, b] = covariance[a, b] + noise[a, b]
    invert(s, inverse)
    for r in range(d):
        for b in range(3):
            gain[r, b] = (
                covariance[r, 0] * inverse[0, b] + covariance[r, 1] * inverse[1, b] + covariance[r, 2] * inverse[2, b]
            )
    for r in range(d):
        mean[r] += gain[r, 0] * innovation[0] + gain[r, 1] * innovation[1] + gain[r, 2] * innovation[2]
    for r in range(d - 1, -1, -1):  # from the last row, so that the first three are still the old ones
        for c in range(r, -1, -1):
            lowered = covariance[r, c] - gain[r, 0] * covariance[c, 0] - gain[r, 1] * covariance[c, 1]
            covariance[r, c] = lowered - gain[r, 2] * covariance[c, 2]
    for r in range(d):
        for c in range(r):
            covariance[c, r] = covariance[r, c]


@inlined
def wrapped(angle: float, period: float) -> float:
    """Return an angle within half a period of zero."""
    return angle - period * math.floor(angle / period + 0.5)


@inlined
def shape_log_ratio(
    box: FloatArray, detected: FloatArray, noise: FloatArray, other_size: float, p_misshapen: float
) -> float:
    """Return the log-likelihood ratio of a detected size and heading for this box, over those of any other object."""
    total = 0.0
    for k in range(3):
        v = box[VARIANCE + k] + noise[k]
        d, other = detected[k] - box[k], (other_size * box[k]) ** 2 + v
        total += 0.5 * (math.log(other / v) - d * d / v + d * d / other)
    v = box[VARIANCE + YAW] + noise[YAW]
    e = wrapped(detected[YAW] - box[YAW], math.pi)
    total += -0.5 * (e * e / v + math.log(2.0 * math.pi * v)) + math.log(math.pi)
    return math.log((1.0 - p_misshapen) * math.exp(min(total, 50.0)) + p_misshapen)


@inlined
def begin_shape(box: FloatArray, detected: FloatArray, noise: FloatArray, forward_nats: float) -> None:
    """Set a box to a detection."""
    for k in range(N_DETECTED):
        box[k], box[VARIANCE + k] = detected[k], noise[k]
    box[FORWARD] = forward_nats


@kernel
def predict_shapes(box: FloatArray, n: int, gap_s: float, turning: float, resizing: float) -> None:
    """Move sizes and headings of the first `n` boxes (N, 9) on, in place."""
    for i in range(n):
        for k in range(3):
            box[i, VARIANCE + k] += (resizing * box[i, k]) ** 2 * gap_s
        turn = turning / max(box[i, 0], 0.1)
        box[i, VARIANCE + YAW] = min(box[i, VARIANCE + YAW] + turn * turn * gap_s, math.pi**2 / 3.0)


@inlined
def update_shape(
    box: FloatArray, detected: FloatArray, noise: FloatArray, mean: FloatArray, covariance: FloatArray, rules: Rules
) -> None:
    """Update a box by a detection, and distinguish front and back by its direction of motion."""
    for k in range(3):
        gain = box[VARIANCE + k] / (box[VARIANCE + k] + noise[k])
        box[k] += gain * (detected[k] - box[k])
        box[VARIANCE + k] *= 1.0 - gain
    off = wrapped(detected[YAW] - box[YAW], 2.0 * math.pi)
    around = abs(off) > 0.5 * math.pi
    gain = box[VARIANCE + YAW] / (box[VARIANCE + YAW] + noise[YAW])
    box[YAW] += gain * wrapped(off, math.pi)
    box[VARIANCE + YAW] *= 1.0 - gain
    step, most = rules.forward_nats, rules.most_forward_nats
    box[FORWARD] = min(box[FORWARD] + (-step if around else step), most)
    c, s = math.cos(box[YAW]), math.sin(box[YAW])
    along = c * mean[3] + s * mean[4]
    v = c * c * covariance[3, 3] + 2.0 * c * s * covariance[3, 4] + s * s * covariance[4, 4]
    if along * along > rules.sure_of_way * v and abs(along) > box[0] / 4.0:
        box[FORWARD] = most if along > 0.0 else -most
    if box[FORWARD] < 0.0:
        box[YAW] += math.pi
        box[FORWARD] = -box[FORWARD]
    box[YAW] = wrapped(box[YAW], 2.0 * math.pi)


def noise_of_shapes(box: FloatArray, face_m: FloatArray) -> FloatArray:
    """Return (M, 4) variances of detected sizes and headings.

    A size is the difference of two faces, a heading the angle between two ends.

    Args:
        box: (M, 4).
        face_m: (M, 3) standard deviations of where faces are, along, across, and up.
    """
    size = 2.0 * face_m**2
    return np.column_stack([size, size[:, 0] / np.maximum(box[:, 0], 1e-3) ** 2])


def noise_of_centres(box: FloatArray, face_m: FloatArray) -> FloatArray:
    """Return (M, 3, 3) covariances of detected centres, the mean of two faces each."""
    c, s = np.cos(box[:, YAW]), np.sin(box[:, YAW])
    v = 0.5 * face_m**2
    found = np.zeros((len(box), 3, 3))
    found[:, 0, 0] = c * c * v[:, 0] + s * s * v[:, 1]
    found[:, 1, 1] = s * s * v[:, 0] + c * c * v[:, 1]
    found[:, 0, 1] = found[:, 1, 0] = c * s * (v[:, 0] - v[:, 1])
    found[:, 2, 2] = v[:, 2]
    return found
