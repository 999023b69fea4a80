"""The functions of `se3` for rows of poses, compiled. A single row of an argument goes with all of the others."""

from __future__ import annotations

import math

from evermap.compiled import kept
from evermap.geometry.jacobian import SERIES, SERIES_BELOW
from evermap.types import FloatArray

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

kernel = kept(effort=1, error_model="numpy")


@kernel
def normalise(pose: FloatArray) -> None:
    """Normalise quaternions of (N, 7), in place."""
    for i in range(len(pose)):
        _put(pose, i, (pose[i, 0], pose[i, 1], pose[i, 2]), _quaternion(pose, i))


@kernel
def compose(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Compute `se3.compose` of (N, 7)."""
    by_a, by_b = min(len(a) - 1, 1), min(len(b) - 1, 1)
    for i in range(len(out)):
        j, k = by_a * i, by_b * i
        turn = _quaternion(a, j)
        x, y, z = _turn_vector(turn, b[k, 0], b[k, 1], b[k, 2])
        _put(out, i, (a[j, 0] + x, a[j, 1] + y, a[j, 2] + z), _times(turn, _quaternion(b, k)))


@kernel
def between(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Compute `se3.between` of (N, 7)."""
    by_a, by_b = min(len(a) - 1, 1), min(len(b) - 1, 1)
    for i in range(len(out)):
        j, k = by_a * i, by_b * i
        back = -a[j, 3], -a[j, 4], -a[j, 5], a[j, 6]
        at = _turn_vector(back, b[k, 0] - a[j, 0], b[k, 1] - a[j, 1], b[k, 2] - a[j, 2])
        _put(out, i, at, _times(back, _quaternion(b, k)))


@kernel
def inverse(a: FloatArray, out: FloatArray) -> None:
    """Compute `se3.inverse` of (N, 7)."""
    for i in range(len(out)):
        back = -a[i, 3], -a[i, 4], -a[i, 5], a[i, 6]
        x, y, z = _turn_vector(back, a[i, 0], a[i, 1], a[i, 2])
        _put(out, i, (-x, -y, -z), back)


@kernel
def transform(pose: FloatArray, point: FloatArray, out: FloatArray) -> None:
    """Compute `se3.transform` of poses (N, 7) and points (N, 3)."""
    by_pose, by_point = min(len(pose) - 1, 1), min(len(point) - 1, 1)
    for i in range(len(out)):
        j, k = by_pose * i, by_point * i
        x, y, z = _turn_vector(_quaternion(pose, j), point[k, 0], point[k, 1], point[k, 2])
        out[i, 0], out[i, 1], out[i, 2] = pose[j, 0] + x, pose[j, 1] + y, pose[j, 2] + z


@kernel
def rotation_of(pose: FloatArray, out: FloatArray) -> None:
    """Compute `se3.rotation_of` (N, 3, 3) of (N, 7)."""
    for i in range(len(out)):
        turn = _quaternion(pose, i)
        out[i, 0, 0], out[i, 1, 0], out[i, 2, 0] = _turn_vector(turn, 1.0, 0.0, 0.0)
        out[i, 0, 1], out[i, 1, 1], out[i, 2, 1] = _turn_vector(turn, 0.0, 1.0, 0.0)
        out[i, 0, 2], out[i, 1, 2], out[i, 2, 2] = _turn_vector(turn, 0.0, 0.0, 1.0)


@kernel
def exp(twist: FloatArray, out: FloatArray) -> None:
    """Compute `se3.exp` of (N, 6)."""
    for i in range(len(out)):
        x, y, z, a, b, c = twist[i, 0], twist[i, 1], twist[i, 2], twist[i, 3], twist[i, 4], twist[i, 5]
        q = a * a + b * b + c * c
        once, twice, _ = coefficients(q)
        half = math.sqrt(q) / 2.0
        scale = 0.5 * math.sin(half) / half if half > 0.0 else 0.5
        u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
        at = (
            x + once * u + twice * (b * w - c * v),
            y + once * v + twice * (c * u - a * w),
            z + once * w + twice * (a * v - b * u),
        )
        _put(out, i, at, (scale * a, scale * b, scale * c, math.cos(half)))


@kernel
def log(pose: FloatArray, out: FloatArray) -> None:
    """Compute `se3.log` of (N, 7), which are normalised in place."""
    normalise(pose)
    for i in range(len(out)):
        x, y, z = pose[i, 0], pose[i, 1], pose[i, 2]
        a, b, c, scalar = _quaternion(pose, i)
        length = math.sqrt(a * a + b * b + c * c)
        # the arc tangent of a tiny length is that length, whose square may underflow
        scale = 2.0 if length < 1e-8 else 2.0 * math.atan2(length, scalar) / length
        a, b, c = scale * a, scale * b, scale * c
        once, _, slope = coefficients(a * a + b * b + c * c)
        d = -slope / once
        u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
        out[i, 0] = x - 0.5 * u + d * (b * w - c * v)
        out[i, 1] = y - 0.5 * v + d * (c * u - a * w)
        out[i, 2] = z - 0.5 * w + d * (a * v - b * u)
        out[i, 3], out[i, 4], out[i, 5] = a, b, c


@kernel
def coefficients(q: float) -> Triple:
    """Return `b`, `c` of `jacobian.inverse_coefficient`, and the derivative of `b`."""
    if not q < SERIES_BELOW:
        t = math.sqrt(q)
        half = math.sin(t / 2.0)
        b, c = 2.0 * half * half / q, (t - math.sin(t)) / (q * t)
        return b, c, (1.0 - 2.0 * b - q * c) / (2.0 * q)
    b, c, slope = SERIES[0, 0], SERIES[1, 0], SERIES[2, 0]
    for k in range(1, SERIES.shape[1]):
        b, c, slope = b * q + SERIES[0, k], c * q + SERIES[1, k], slope * q + SERIES[2, k]
    return b, c, slope


@kernel
def _put(out: FloatArray, row: int, at: Triple, a: Quaternion) -> None:
    """Write a pose as `se3.normalise_poses`."""
    first = a[3]
    for k in (2, 1, 0):  # whichever of qw, qz, qy, qx is the first that is not zero says the sign
        if first == 0.0:
            first = a[k]
    length = math.copysign(math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3]), first)
    out[row, 0], out[row, 1], out[row, 2] = at
    out[row, 3], out[row, 4], out[row, 5], out[row, 6] = a[0] / length, a[1] / length, a[2] / length, a[3] / length


@kernel
def _quaternion(pose: FloatArray, row: int) -> Quaternion:
    return pose[row, 3], pose[row, 4], pose[row, 5], pose[row, 6]


@kernel
def _times(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[3] * b[0] + b[3] * a[0] + (a[1] * b[2] - a[2] * b[1]),
        a[3] * b[1] + b[3] * a[1] + (a[2] * b[0] - a[0] * b[2]),
        a[3] * b[2] + b[3] * a[2] + (a[0] * b[1] - a[1] * b[0]),
        a[3] * b[3] - (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]),
    )


@kernel
def _turn_vector(a: Quaternion, x: float, y: float, z: float) -> Triple:
    """Rotate a vector."""
    u, v, w = 2.0 * (a[1] * z - a[2] * y), 2.0 * (a[2] * x - a[0] * z), 2.0 * (a[0] * y - a[1] * x)
    return (
        x + a[3] * u + (a[1] * w - a[2] * v),
        y + a[3] * v + (a[2] * u - a[0] * w),
        z + a[3] * w + (a[0] * v - a[1] * u),
    )
