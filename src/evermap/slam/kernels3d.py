"""The measurement equations in space with their derivatives, compiled: odometry, points, landmarks with a pose; steps.

Poses are those of `geometry.se3`, `(x, y, z, qx, qy, qz, qw)` with unit quaternions, perturbed on the right by twists,
whose translation comes first. Residuals are measured minus predicted for detections, in the sensor's axes, and
`log(increment^-1 * between(pose, next))` for odometry. `mount` is the sensor's pose in the robot's frame.
"""

from __future__ import annotations

import math

from evermap.compiled import kept
from evermap.types import FloatArray

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
"""(3, 3), row after row. Tuples live in registers: nothing is allocated."""

kernel = kept(effort=3, error_model="numpy")


@kernel
def odometry_residual(
    pose: FloatArray, following: FloatArray, increment: FloatArray, residual: FloatArray, j1: FloatArray, j2: FloatArray
) -> None:
    """Compute `log(increment^-1 * between(pose, following))` (6,), with (6, 6) derivatives by both poses."""
    r_pose, r_increment = matrix_of(pose), matrix_of(increment)
    moved = _times(_conjugate(_quaternion(pose)), _quaternion(following))
    x, y, z = turn_vector_back(r_pose, following[0] - pose[0], following[1] - pose[1], following[2] - pose[2])
    ex, ey, ez = turn_vector_back(r_increment, x - increment[0], y - increment[1], z - increment[2])
    a, b, c = _rotation_vector(_times(_conjugate(_quaternion(increment)), moved))
    q = a * a + b * b + c * c
    d, by_d = _inverse_coefficients(q)
    along = a * ex + b * ey + c * ez
    px = ex - 0.5 * (b * ez - c * ey) + d * (a * along - q * ex)
    py = ey - 0.5 * (c * ex - a * ez) + d * (b * along - q * ey)
    pz = ez - 0.5 * (a * ey - b * ex) + d * (c * along - q * ez)
    residual[0], residual[1], residual[2], residual[3], residual[4], residual[5] = px, py, pz, a, b, c
    # the inverse right Jacobian of the residual is that of its rotation, beside its derivative along the translation
    turning, shift, turn = _inverse_jacobian(a, b, c), (px, py, pz), (a, b, c)
    along = a * px + b * py + c * pz
    for i in range(3):
        for k in range(3):
            j2[i, k] = j2[3 + i, 3 + k] = turning[3 * i + k]
            j2[3 + i, k] = j1[3 + i, k] = 0.0
            j2[i, 3 + k] = d * (turn[i] * shift[k] + shift[i] * turn[k]) + 2.0 * by_d * along * turn[i] * turn[k]
        j2[i, 3 + i] -= 2.0 * along * (d + q * by_d)
        second, third = (i + 1) % 3, (i + 2) % 3
        j2[i, 3 + second] -= 0.5 * shift[third]
        j2[i, 3 + third] += 0.5 * shift[second]
    # by the first pose: the same, of minus the adjoint of the motion's inverse
    r_moved = _matrix(moved)
    for i in range(3):
        f, g, h = turn_vector(r_moved, j2[i, 0], j2[i, 1], j2[i, 2])
        u, v, w = turn_vector(r_moved, j2[i, 3], j2[i, 4], j2[i, 5])
        j1[i, 0], j1[i, 1], j1[i, 2] = -f, -g, -h
        j1[3 + i, 3], j1[3 + i, 4], j1[3 + i, 5] = -f, -g, -h
        j1[i, 3], j1[i, 4], j1[i, 5] = g * z - h * y - u, h * x - f * z - v, f * y - g * x - w


@kernel
def point_residual(
    pose: FloatArray, landmark: FloatArray, mount: FloatArray, measured: FloatArray, residual: FloatArray,
    j_pose: FloatArray, j_landmark: FloatArray, j_mount: FloatArray,
) -> None:  # fmt: skip
    """Compute (x, y, z) in the sensor's frame, derivatives by pose (3, 6), point (3, 3) and mount (3, 6)."""
    position_residual(pose, landmark, mount, measured, residual, j_pose, j_mount)
    sensor = _matrix(_times(_quaternion(pose), _quaternion(mount)))
    for i in range(3):
        for k in range(3):
            j_landmark[i, k] = -sensor[3 * k + i]


@kernel
def pose_residual(
    pose: FloatArray, landmark: FloatArray, mount: FloatArray, measured: FloatArray, residual: FloatArray,
    j_pose: FloatArray, j_landmark: FloatArray, j_mount: FloatArray,
) -> None:  # fmt: skip
    """Compute the residual (6,) of a landmark's pose (7,) as detected, with (6, 6) derivatives by all three poses.

    The first three rows are those of its position. The others are the rotation vector, in the sensor's axes, that turns
    the predicted orientation into the measured one.
    """
    position_residual(pose, landmark, mount, measured, residual, j_pose, j_mount)
    seen = _times(_conjugate(_times(_quaternion(pose), _quaternion(mount))), _quaternion(landmark))
    r_mount, r_seen = matrix_of(mount), _matrix(seen)
    a, b, c = _rotation_vector(_times(_quaternion(measured), _conjugate(seen)))
    residual[3], residual[4], residual[5] = a, b, c
    _by_turns(_inverse_jacobian(a, b, c), r_mount, r_seen, j_pose, j_landmark, j_mount)


@kernel
def axis_residual(
    pose: FloatArray, landmark: FloatArray, mount: FloatArray, measured: FloatArray, axis: int, residual: FloatArray,
    j_pose: FloatArray, j_landmark: FloatArray, j_mount: FloatArray,
) -> None:  # fmt: skip
    """Compute as `pose_residual`, of a landmark of which nobody can see how it is turned about one of its axes.

    The last three rows are the shortest rotation vector that turns the predicted axis (0, 1 or 2 of the landmark) into
    the measured one; a turn of the landmark about its axis changes nothing.
    """
    position_residual(pose, landmark, mount, measured, residual, j_pose, j_mount)
    seen = _times(_conjugate(_times(_quaternion(pose), _quaternion(mount))), _quaternion(landmark))
    r_mount, r_seen, r_measured = matrix_of(mount), _matrix(seen), matrix_of(measured)
    x, y, z = r_seen[axis], r_seen[3 + axis], r_seen[6 + axis]
    u, v, w = r_measured[axis], r_measured[3 + axis], r_measured[6 + axis]
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    sine, cosine = math.sqrt(a * a + b * b + c * c), x * u + y * v + z * w
    angle = math.atan2(sine, cosine)
    if angle < 0.02:
        q = angle * angle
        scale, slope = 1.0 + q / 6.0 + q * q * 7.0 / 360.0, 1.0 / 3.0 + q * 2.0 / 15.0
    elif sine > 1e-6:
        scale, slope = angle / sine, (sine - angle * cosine) / (sine * sine * sine)
    else:  # upside down: half a turn about anything
        scale, slope, a, b, c = 0.0, 0.0, 0.0, 0.0, 0.0
    residual[3], residual[4], residual[5] = scale * a, scale * b, scale * c
    if scale == 0.0:
        residual[3] = math.pi
    e, d = scale * cosine, slope
    first = e - scale * x * u + d * a * a, d * a * b - scale * x * v, d * a * c - scale * x * w
    second = d * b * a - scale * y * u, e - scale * y * v + d * b * b, d * b * c - scale * y * w
    third = d * c * a - scale * z * u, d * c * b - scale * z * v, e - scale * z * w + d * c * c
    _by_turns(first + second + third, r_mount, r_seen, j_pose, j_landmark, j_mount)


@kernel
def _by_turns(
    turning: Matrix, r_mount: Matrix, r_seen: Matrix, j_pose: FloatArray, j_landmark: FloatArray, j_mount: FloatArray
) -> None:
    """Fill in derivatives of an orientation's residual by three poses, from that by a turn of the sensor."""
    for i in range(3):
        u, v, w = turning[3 * i], turning[3 * i + 1], turning[3 * i + 2]
        for k in range(3):
            j_pose[3 + i, k] = j_mount[3 + i, k] = j_landmark[3 + i, k] = j_landmark[i, 3 + k] = 0.0
            j_landmark[i, k] = -r_seen[3 * i + k]
        j_mount[3 + i, 3], j_mount[3 + i, 4], j_mount[3 + i, 5] = u, v, w
        j_pose[3 + i, 3], j_pose[3 + i, 4], j_pose[3 + i, 5] = turn_vector(r_mount, u, v, w)
        f, g, h = turn_vector_back(r_seen, u, v, w)
        j_landmark[3 + i, 3], j_landmark[3 + i, 4], j_landmark[3 + i, 5] = -f, -g, -h


@kernel
def nearest_turn(
    pose: FloatArray, landmark: FloatArray, mount: FloatArray, measured: FloatArray, axis: int, turns: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Compute what looks like a measured pose: of its turns (G, 4), beside any about an axis (-1 without), the one
    that is nearest to the predicted orientation.
    """
    seen = _times(_conjugate(_times(_quaternion(pose), _quaternion(mount))), _quaternion(landmark))
    x, y, z, w = _times(_conjugate(_quaternion(measured)), seen)
    best, row = -1.0, 0
    for k in range(len(turns)):
        a, b, c, d = turns[k, 0], turns[k, 1], turns[k, 2], turns[k, 3]
        cosine = abs(x * a + y * b + z * c + w * d)
        if axis == 0:
            cosine = math.hypot(cosine, x * d + y * c - z * b - w * a)
        elif axis == 1:
            cosine = math.hypot(cosine, y * d + z * a - x * c - w * b)
        elif axis == 2:
            cosine = math.hypot(cosine, z * d + x * b - y * a - w * c)
        if cosine > best:
            best, row = cosine, k
    turned = _times(_quaternion(measured), (turns[row, 0], turns[row, 1], turns[row, 2], turns[row, 3]))
    _put(out, measured[0], measured[1], measured[2], turned)


@kernel
def compose(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Compute `a * b` as `se3.compose`; may be in place."""
    x, y, z = turn_vector(matrix_of(a), b[0], b[1], b[2])
    _put(out, a[0] + x, a[1] + y, a[2] + z, _times(_quaternion(a), _quaternion(b)))


@kernel
def retract(pose: FloatArray, twist: FloatArray, out: FloatArray) -> None:
    """Compute `pose * exp(twist)` as `se3.retract`; may be in place."""
    a, b, c, u, v, w = twist[3], twist[4], twist[5], twist[0], twist[1], twist[2]
    q = a * a + b * b + c * c
    if q < 0.05:
        once = 1 / 2 - q * (1 / 24 - q * (1 / 720 - q * (1 / 40320 - q / 3628800)))
        twice = 1 / 6 - q * (1 / 120 - q * (1 / 5040 - q * (1 / 362880 - q / 39916800)))
    else:
        angle = math.sqrt(q)
        once, twice = (1.0 - math.cos(angle)) / q, (angle - math.sin(angle)) / (q * angle)
    half = 0.5 * math.sqrt(q)
    scale = 0.5 if half < 1e-8 else 0.5 * math.sin(half) / half
    along = a * u + b * v + c * w
    x = u + once * (b * w - c * v) + twice * (a * along - q * u)
    y = v + once * (c * u - a * w) + twice * (b * along - q * v)
    z = w + once * (a * v - b * u) + twice * (c * along - q * w)
    x, y, z = turn_vector(matrix_of(pose), x, y, z)
    turned = _times(_quaternion(pose), (scale * a, scale * b, scale * c, math.cos(half)))
    _put(out, pose[0] + x, pose[1] + y, pose[2] + z, turned)


@kernel
def _put(out: FloatArray, x: float, y: float, z: float, a: Quaternion) -> None:
    """Write a pose as `se3.normalise_poses`."""
    first = a[3]
    for k in (2, 1, 0):
        if first == 0.0:
            first = a[k]
    scale = math.copysign(1.0, first) / math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    out[0], out[1], out[2] = x, y, z
    out[3], out[4], out[5], out[6] = scale * a[0], scale * a[1], scale * a[2], scale * a[3]


@kernel
def position_residual(
    pose: FloatArray, landmark: FloatArray, mount: FloatArray, measured: FloatArray, residual: FloatArray,
    j_pose: FloatArray, j_mount: FloatArray,
) -> None:  # fmt: skip
    """Compute the first three rows of a detection, with derivatives by the robot's and the sensor's pose (3, 6)."""
    r_pose, r_mount = matrix_of(pose), matrix_of(mount)
    x, y, z = turn_vector_back(r_pose, landmark[0] - pose[0], landmark[1] - pose[1], landmark[2] - pose[2])
    for i in range(3):
        f, g, h = r_mount[i], r_mount[3 + i], r_mount[6 + i]
        j_pose[i, 0], j_pose[i, 1], j_pose[i, 2] = f, g, h
        j_pose[i, 3], j_pose[i, 4], j_pose[i, 5] = y * h - z * g, z * f - x * h, x * g - y * f
        for k in range(6):
            j_mount[i, k] = 0.0
        j_mount[i, i] = 1.0
    x, y, z = turn_vector_back(r_mount, x - mount[0], y - mount[1], z - mount[2])
    residual[0], residual[1], residual[2] = measured[0] - x, measured[1] - y, measured[2] - z
    j_mount[0, 4], j_mount[0, 5] = z, -y
    j_mount[1, 3], j_mount[1, 5] = -z, x
    j_mount[2, 3], j_mount[2, 4] = y, -x


@kernel
def _quaternion(pose: FloatArray) -> Quaternion:
    return pose[3], pose[4], pose[5], pose[6]


@kernel
def _conjugate(a: Quaternion) -> Quaternion:
    return -a[0], -a[1], -a[2], a[3]


@kernel
def _times(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] + a[1] * b[3] + a[2] * b[0] - a[0] * b[2],
        a[3] * b[2] + a[2] * b[3] + a[0] * b[1] - a[1] * b[0],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@kernel
def matrix_of(pose: FloatArray) -> Matrix:
    """Return the rotation matrix of a pose, row after row."""
    return _matrix(_quaternion(pose))


@kernel
def _matrix(a: Quaternion) -> Matrix:
    x, y, z, w = a
    first = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)
    second = 2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)
    return first + second + (2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y))


@kernel
def turn_vector(r: Matrix, x: float, y: float, z: float) -> Triple:
    """Return `r v`."""
    return r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z


@kernel
def turn_vector_back(r: Matrix, x: float, y: float, z: float) -> Triple:
    """Return `r' v`."""
    return r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z


@kernel
def _rotation_vector(a: Quaternion) -> Triple:
    """Rotation vector of at most half a turn, of a quaternion of either sign."""
    length = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    scale = 2.0 / a[3] if length < 1e-8 else math.copysign(2.0, a[3]) * math.atan2(length, abs(a[3])) / length
    return scale * a[0], scale * a[1], scale * a[2]


@kernel
def _inverse_coefficients(q: float) -> tuple[float, float]:
    """`inverse_coefficient` and `inverse_slope` of `geometry.jacobian`, of at most half a turn."""
    if q < 0.05:
        d = 1 / 12 + q * (1 / 720 + q * (1 / 30240 + q * (1 / 1209600 + q / 47900160)))
        return d, 1 / 720 + q * (1 / 15120 + q * (1 / 403200 + q / 11975040))
    half = 0.5 * math.sqrt(q)
    d = (1.0 - half * math.cos(half) / math.sin(half)) / q
    return d, (1.0 - 12.0 * d + 4.0 * q * d * d) / (8.0 * q)


@kernel
def _inverse_jacobian(a: float, b: float, c: float) -> Matrix:
    """Inverse right Jacobian of a rotation vector: `1 + W / 2 + d W^2`."""
    q = a * a + b * b + c * c
    d, _ = _inverse_coefficients(q)
    first = 1.0 + d * (a * a - q), d * a * b - 0.5 * c, d * a * c + 0.5 * b
    second = d * a * b + 0.5 * c, 1.0 + d * (b * b - q), d * b * c - 0.5 * a
    return first + second + (d * a * c - 0.5 * b, d * b * c + 0.5 * a, 1.0 + d * (c * c - q))
