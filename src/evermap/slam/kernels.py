"""The two measurement equations with their derivatives, compiled; every estimator of this package calls these.

Poses are `(x, y, theta)` and perturbed on the right, `pose * exp(xi)`; residuals are measured minus predicted for
detections and `increment^-1 * between(pose, next)` for odometry. Calibration states come as the vector of
`calibration.SPECS`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from evermap.compiled import kept
from evermap.types import FloatArray, IntArray

NOISE_NAMES = (
    "sigma_forward_per_sqrt_m",
    "sigma_forward_per_sqrt_rad",
    "sigma_lateral_per_sqrt_m",
    "sigma_turn_per_sqrt_s",
    "sigma_turn_per_sqrt_rad",
)
"""What odometry noise grows with: distance driven, angle turned, time. Standard deviations, in metres and radians."""
N_NOISE = len(NOISE_NAMES)
FLOOR_FORWARD_M = 0.002
FLOOR_TURN_RAD = 0.001
"""Noise per square root of a second that always remains: nothing stands perfectly still."""
FLOOR_VARIANCE = 1e-8
"""And once for every interval, however short: 0.1 mm and 0.1 mrad."""
MAX_STEP_S = 0.1
N_SENSOR, N_MOTION = 7, 4
"""Calibration states of the sensor and, behind them, of the odometry (`calibration.SPECS`)."""
N_STATES = N_SENSOR + N_MOTION
AT_PLACES = 3 + N_STATES
"""Where places begin in a joint covariance: behind the newest pose and the calibration states."""

FARTHEST = float(np.finfo(np.float64).max)
"""Difference of logarithms of ranges at which one of them is 0."""

kernel = kept(effort=1, error_model="numpy")
"""Matrices of two to fifteen rows: there is nothing to vectorise, and much to compile."""


@kernel
def multiply(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Multiply a (r, 3) with a (3, n) matrix, without a temporary."""
    for i in range(a.shape[0]):
        a0, a1, a2 = a[i, 0], a[i, 1], a[i, 2]
        for k in range(b.shape[1]):
            out[i, k] = a0 * b[0, k] + a1 * b[1, k] + a2 * b[2, k]


@kernel
def find_from(stamp_s: FloatArray, at_s: float, near: float) -> int:
    """Return `np.searchsorted(stamp_s, at_s)`, sooner where it is near a row: odometry comes at an even pace."""
    count = len(stamp_s)
    row = int(near) if 0.0 <= near < count else 0
    for _ in range(8):
        if row > 0 and stamp_s[row - 1] >= at_s:
            row -= 1
        elif row < count and stamp_s[row] < at_s:
            row += 1
        else:
            return row
    return int(np.searchsorted(stamp_s, at_s))


@kernel
def reckon_motions(
    first_s: FloatArray,
    second_s: FloatArray,
    delay_s: float,
    stamp_s: FloatArray,
    track: FloatArray,
    mount: FloatArray,
    out: FloatArray,
) -> None:
    """Write the motions (P, 3) of a sensor from P first to second stamps, all delayed, by a track (N, 3) of the robot,
    x, y and unwrapped heading at `stamp_s` (N,), of which the ends hold beyond it.
    """
    pose = np.empty((2, 3))
    last = len(stamp_s) - 1
    per_s = last / max(stamp_s[last] - stamp_s[0], 1e-300)
    for p in range(len(first_s)):
        for end in range(2):
            at_s = (first_s[p] if end == 0 else second_s[p]) + delay_s
            after = min(max(find_from(stamp_s, at_s, (at_s - stamp_s[0]) * per_s), 1), last)
            lasted_s = max(stamp_s[after] - stamp_s[after - 1], 1e-300)  # stamps may be equal
            share = min(max((at_s - stamp_s[after - 1]) / lasted_s, 0.0), 1.0)
            for k in range(3):
                pose[end, k] = track[after - 1, k] + share * (track[after, k] - track[after - 1, k])
            c, s = math.cos(pose[end, 2]), math.sin(pose[end, 2])
            pose[end, 0] += c * mount[0] - s * mount[1]
            pose[end, 1] += s * mount[0] + c * mount[1]
        heading = pose[0, 2] + mount[2]
        c, s = math.cos(heading), math.sin(heading)
        x, y = pose[1, 0] - pose[0, 0], pose[1, 1] - pose[0, 1]
        out[p, 0], out[p, 1], out[p, 2] = c * x + s * y, c * y - s * x, pose[1, 2] - pose[0, 2]


@kernel
def pair_residuals(
    motion: FloatArray, which: IntArray, undone: FloatArray, first: FloatArray, second: FloatArray, out: FloatArray
) -> None:
    """Write (M, 2, P) second reading minus what the first and the motion predict, as log range and bearing.

    Of motions (D, P, 3) that of row `which` (M,) holds, divided by the factor on ranges; readings (2, P) are ranges and
    bearings. `undone` (M, 3) are that factor, and the factor and the offset that bearings are corrected by. What has no
    range tells nothing of it.
    """
    for m in range(len(which)):
        length, factor, offset = undone[m, 0], undone[m, 1], undone[m, 2]
        for p in range(first.shape[1]):
            bearing = factor * first[1, p] + offset
            x = first[0, p] * math.cos(bearing) - motion[which[m], p, 0] / length
            y = first[0, p] * math.sin(bearing) - motion[which[m], p, 1] / length
            distance = math.hypot(x, y)
            far = np.log(second[0, p]) - np.log(max(distance, 1e-12))
            out[m, 0, p] = 0.0 if np.isnan(far) else max(far, -FARTHEST)
            left = factor * second[1, p] + offset - math.atan2(y, x) + motion[which[m], p, 2]
            out[m, 1, p] = left - 2.0 * math.pi * np.floor(left / (2.0 * math.pi) + 0.5)


@kernel
def sandwich(j: FloatArray, cov: FloatArray, part: FloatArray, out: FloatArray) -> None:
    """Compute `j cov j'` for j (r, n) and a symmetric cov, with room for `j cov` in `part` (r, n)."""
    size = j.shape[1]
    for a in range(j.shape[0]):
        for b in range(size):
            part[a, b] = 0.0
        for k in range(size):
            for b in range(size):
                part[a, b] += j[a, k] * cov[k, b]
        for c in range(a + 1):
            total = 0.0
            for b in range(size):
                total += part[a, b] * j[c, b]
            out[a, c] = out[c, a] = total


@kernel
def invert_3x3(matrix: FloatArray, out: FloatArray) -> None:
    """Invert a symmetric positive definite (3, 3) by its factors `L D L'`, without a temporary; may be in place."""
    a, b, c, f = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[2, 2]
    l10, l20 = b / a, c / a
    d1, rest = matrix[1, 1] - l10 * b, matrix[1, 2] - l20 * b
    l21 = rest / d1
    d2 = f - l20 * c - l21 * rest
    m20 = l10 * l21 - l20
    i02, i12 = m20 / d2, -l21 / d2
    out[0, 0], out[1, 1], out[2, 2] = 1.0 / a + l10 * l10 / d1 + m20 * i02, 1.0 / d1 - l21 * i12, 1.0 / d2
    out[0, 1] = out[1, 0] = -l10 / d1 - l21 * i02
    out[0, 2] = out[2, 0] = i02
    out[1, 2] = out[2, 1] = i12


@kernel
def wrapped(angle: float) -> float:
    """Return `angle` in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def composed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return `a * b`, as `se2.compose`, but the heading is not wrapped."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]])


@kernel
def inverted(a: FloatArray) -> FloatArray:
    """Return the inverse as `se2.inverse`, but the heading is not wrapped."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([-c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]])


@kernel
def adjoint(a: FloatArray) -> FloatArray:
    """Return the adjoint as `se2.adjoint`. That of an inverted motion carries perturbations at its start to its end."""
    c, s = math.cos(a[2]), math.sin(a[2])
    return np.array([[c, -s, a[1]], [s, c, -a[0]], [0.0, 0.0, 1.0]])


@kernel
def integrate_odometry(
    stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, start: float, stop: float, states: FloatArray,
    increment: FloatArray, jacobian: FloatArray, noise: FloatArray, floor: FloatArray,
) -> None:  # fmt: skip
    """Integrate the motion between two instants, its derivatives and noise; velocities hold between odometry stamps.

    Args:
        stamp: (N,) odometry stamps; row i of `velocity` holds from stamp i to stamp i + 1.
        velocity: (N, 4) reported forward, lateral, turn, and how much of the latter is no jitter.
        unknown: (N,) extra noise variance per second where the odometry is silent.
        start: first instant, on the detections' clock.
        stop: second instant.
        states: (11,) calibration states.
        increment: (3,) out, pose at `stop` seen from `start`.
        jacobian: (3, 4) out, right perturbation of the increment by delay, forward scale, turn scale, slip.
        noise: (5, 3, 3) out, covariance for unit noise of each kind in `NOISE_NAMES`.
        floor: (3, 3) out, covariance that is always there.
    """
    delay, scale_v, scale_w, slip = states[N_SENSOR], states[N_SENSOR + 1], states[N_SENSOR + 2], states[N_SENSOR + 3]
    begin = start + delay
    end = stop + delay
    count = len(stamp)
    row = max(np.searchsorted(stamp, begin, side="right") - 1, 0)
    turn_abs = abs(velocity[row, 2])
    first_v = scale_v * velocity[row, 0] - slip * turn_abs
    first_l = scale_v * velocity[row, 1]
    first_w = velocity[row, 2] + (scale_w - 1.0) * velocity[row, 3]
    v, left, w = first_v, first_l, first_w
    x = y = theta = 0.0
    ct, st = 1.0, 0.0
    # All sums are over twists seen from the start, one transformation at the end instead of one a step, and in scalars:
    # derivatives by forward scale, turn scale and slip,
    scale_x = scale_y = turn_x = turn_y = slip_x = slip_y = angle = 0.0
    # squares of the forward twist by distance and by angle (the lateral one is the same, turned by 90 degrees),
    f_xx = f_xy = f_yy = g_xx = g_xy = g_yy = 0.0
    # squares of the turning twist by time, by angle and by what is unknown, and of the other two for the floor
    t_xx = t_xy = t_yy = t_x = t_y = 0.0
    a_xx = a_xy = a_yy = a_x = a_y = a_t = 0.0
    u_xx = u_xy = u_yy = u_x = u_y = u_t = 0.0
    even = 0.0
    now = begin
    while now < end:
        until = end if row + 1 >= count else min(end, stamp[row + 1])
        if until > now:
            reported_v, reported_l, reported_w = velocity[row, 0], velocity[row, 1], velocity[row, 2]
            scaled_w = velocity[row, 3]
            turn_abs = abs(reported_w)
            v = scale_v * reported_v - slip * turn_abs
            left = scale_v * reported_l
            w = reported_w + (scale_w - 1.0) * scaled_w
            extra = unknown[row]
            pieces, h = 1, until - now
            if h > MAX_STEP_S and (reported_v != 0.0 or reported_l != 0.0 or reported_w != 0.0):  # else it is exact
                pieces = math.ceil(h / MAX_STEP_S)
                h /= pieces
            by_distance, by_angle = h * math.sqrt(reported_v * reported_v + reported_l * reported_l), h * turn_abs
            turn = w * h
            sin_by, cos_by, sin_by2, cos_by2 = _of_turn(turn)
            c, s = 1.0 - cos_by * turn, sin_by * turn
            step_x = (sin_by * v - cos_by * left) * h
            step_y = (cos_by * v + sin_by * left) * h
            # right Jacobian of the exponential: from a change of the twist to a change of the step, seen at its end
            by_turn_x, by_turn_y = (v * sin_by2 - left * cos_by2) * h, (v * cos_by2 + left * sin_by2) * h
            for _ in range(pieces):
                x += ct * step_x - st * step_y
                y += st * step_x + ct * step_y
                ct, st = ct * c - st * s, st * c + ct * s
                theta += turn
                fx, fy = ct * sin_by + st * cos_by, st * sin_by - ct * cos_by
                tx, ty = ct * by_turn_x - st * by_turn_y + y, st * by_turn_x + ct * by_turn_y - x
                scale_x += (fx * reported_v - fy * reported_l) * h
                scale_y += (fy * reported_v + fx * reported_l) * h
                turn_x += tx * scaled_w * h
                turn_y += ty * scaled_w * h
                angle += scaled_w * h
                slip_x -= fx * by_angle
                slip_y -= fy * by_angle
                xx, xy, yy = fx * fx, fx * fy, fy * fy
                f_xx, f_xy, f_yy = f_xx + by_distance * xx, f_xy + by_distance * xy, f_yy + by_distance * yy
                g_xx, g_xy, g_yy = g_xx + by_angle * xx, g_xy + by_angle * xy, g_yy + by_angle * yy
                even += h * (FLOOR_FORWARD_M * FLOOR_FORWARD_M + extra) * (xx + yy)
                xx, xy, yy = tx * tx, tx * ty, ty * ty
                t_xx, t_xy, t_yy, t_x, t_y = t_xx + h * xx, t_xy + h * xy, t_yy + h * yy, t_x + h * tx, t_y + h * ty
                a_xx, a_xy, a_yy = a_xx + by_angle * xx, a_xy + by_angle * xy, a_yy + by_angle * yy
                a_x, a_y, a_t = a_x + by_angle * tx, a_y + by_angle * ty, a_t + by_angle
                if extra > 0.0:
                    more = h * extra
                    u_xx, u_xy, u_yy = u_xx + more * xx, u_xy + more * xy, u_yy + more * yy
                    u_x, u_y, u_t = u_x + more * tx, u_y + more * ty, u_t + more
        now = until
        if row + 1 < count and until >= stamp[row + 1]:
            row += 1
    increment[0], increment[1], increment[2] = x, y, theta
    c, s = math.cos(theta), math.sin(theta)
    # adjoint of the inverse increment: what is seen from the start, seen from the end
    lever_x, lever_y = s * x - c * y, c * x + s * y
    # a later window gains the last velocity at its end and loses the first at its start
    jacobian[0, 0] = v - (c * first_v + s * first_l + lever_x * first_w)
    jacobian[1, 0] = left - (-s * first_v + c * first_l + lever_y * first_w)
    jacobian[2, 0] = w - first_w
    jacobian[0, 1], jacobian[1, 1], jacobian[2, 1] = c * scale_x + s * scale_y, -s * scale_x + c * scale_y, 0.0
    jacobian[0, 2] = c * turn_x + s * turn_y + lever_x * angle
    jacobian[1, 2] = -s * turn_x + c * turn_y + lever_y * angle
    jacobian[2, 2] = angle
    jacobian[0, 3], jacobian[1, 3], jacobian[2, 3] = c * slip_x + s * slip_y, -s * slip_x + c * slip_y, 0.0
    seconds = max(end - begin, 0.0)
    _carry_covariance(noise[0], f_xx, f_xy, f_yy, 0.0, 0.0, 0.0, c, s, lever_x, lever_y)
    _carry_covariance(noise[1], g_xx, g_xy, g_yy, 0.0, 0.0, 0.0, c, s, lever_x, lever_y)
    _carry_covariance(noise[2], f_yy, -f_xy, f_xx, 0.0, 0.0, 0.0, c, s, lever_x, lever_y)
    _carry_covariance(noise[3], t_xx, t_xy, t_yy, t_x, t_y, seconds, c, s, lever_x, lever_y)
    _carry_covariance(noise[4], a_xx, a_xy, a_yy, a_x, a_y, a_t, c, s, lever_x, lever_y)
    _carry_covariance(floor, u_xx + even, u_xy, u_yy + even, u_x, u_y, u_t, c, s, lever_x, lever_y)
    for i in range(3):
        for j in range(3):
            floor[i, j] += FLOOR_TURN_RAD * FLOOR_TURN_RAD * noise[3, i, j]
        floor[i, i] += FLOOR_VARIANCE


@kernel
def odometry_covariance(noise: FloatArray, floor: FloatArray, variance: FloatArray, out: FloatArray) -> None:
    """Compute the covariance (3, 3) of an interval: `floor` and what (5,) variances make of `noise` (5, 3, 3)."""
    for i in range(3):
        for j in range(i + 1):
            total = floor[i, j]
            for kind in range(N_NOISE):
                total += variance[kind] * noise[kind, i, j]
            out[i, j] = out[j, i] = total


@kernel
def _of_turn(turn: float) -> tuple[float, float, float, float]:
    """`sin(a) / a`, `(1 - cos(a)) / a`, `(a - sin(a)) / a^2`, `(1 - cos(a)) / a^2`; by series where `a` is small."""
    if abs(turn) > 0.05:
        c, s = math.cos(turn), math.sin(turn)
        return s / turn, (1.0 - c) / turn, (turn - s) / (turn * turn), (1.0 - c) / (turn * turn)
    q = turn * turn
    to_sin = 1.0 / 6.0 - q * (1.0 / 120.0 - q / 5040.0)
    cos_by2 = 0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q / 40320.0))
    return 1.0 - q * to_sin, turn * cos_by2, turn * to_sin, cos_by2


@kernel
def _carry_covariance(
    out: FloatArray, xx: float, xy: float, yy: float, xt: float, yt: float, tt: float, c: float, s: float,
    lever_x: float, lever_y: float,
) -> None:  # fmt: skip
    """A covariance of perturbations before a step, as one of perturbations after it."""
    x_x, x_y, x_t = c * xx + s * xy + lever_x * xt, c * xy + s * yy + lever_x * yt, c * xt + s * yt + lever_x * tt
    y_x, y_y, y_t = c * xy - s * xx + lever_y * xt, c * yy - s * xy + lever_y * yt, c * yt - s * xt + lever_y * tt
    out[0, 0] = x_x * c + x_y * s + x_t * lever_x
    out[1, 1] = y_y * c - y_x * s + y_t * lever_y
    out[0, 1] = out[1, 0] = x_y * c - x_x * s + x_t * lever_y
    out[0, 2] = out[2, 0] = x_t
    out[1, 2] = out[2, 1] = y_t
    out[2, 2] = tt


@kernel
def odometry_residual(
    pose: FloatArray, following: FloatArray, increment: FloatArray, residual: FloatArray, j1: FloatArray, j2: FloatArray
) -> None:
    """Compute `increment^-1 * between(pose, following)` as (x, y, theta), with (3, 3) derivatives by both poses."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = following[0] - pose[0], following[1] - pose[1]
    bx, by = c * dx + s * dy, -s * dx + c * dy
    ci, si = np.cos(increment[2]), np.sin(increment[2])
    ux, uy = bx - increment[0], by - increment[1]
    residual[0], residual[1] = ci * ux + si * uy, -si * ux + ci * uy
    residual[2] = wrapped(following[2] - pose[2] - increment[2])
    ce, se = np.cos(residual[2]), np.sin(residual[2])
    j2[:] = 0.0
    j2[0, 0], j2[0, 1], j2[1, 0], j2[1, 1], j2[2, 2] = ce, -se, se, ce, 1.0
    j1[0, 0], j1[0, 1], j1[0, 2] = -ci, -si, ci * by - si * bx
    j1[1, 0], j1[1, 1], j1[1, 2] = si, -ci, -si * by - ci * bx
    j1[2, 0], j1[2, 1], j1[2, 2] = 0.0, 0.0, -1.0


@kernel
def residual_by_states(motion: FloatArray, residual: FloatArray, free: Any) -> None:
    """Turn the increment's derivatives (3, 4) by its states, in place, into the residual's; zero where not free."""
    for k in range(N_MOTION):
        forward, left, turn = motion[0, k], motion[1, k], motion[2, k]
        on = 1.0 if free[N_SENSOR + k] else 0.0
        motion[0, k] = on * (turn * residual[1] - forward)
        motion[1, k] = -on * (turn * residual[0] + left)
        motion[2, k] = -on * turn


@kernel
def detection_residual(
    pose: FloatArray, landmark: FloatArray, states: FloatArray, mount: FloatArray, range_m: float, bearing_rad: float,
    residual: FloatArray, j_pose: FloatArray, j_landmark: FloatArray, j_states: FloatArray,
) -> None:  # fmt: skip
    """Compute (range, bearing) measured minus predicted, derivatives by pose (2, 3), landmark (2, 2), and the
    sensor's states (2, 7).
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = mount[0] + states[5], mount[1] + states[6]
    lever_x, lever_y = c * x - s * y, s * x + c * y
    dx, dy = landmark[0] - pose[0] - lever_x, landmark[1] - pose[1] - lever_y
    r = max(np.sqrt(dx * dx + dy * dy), 1e-6)
    b = wrapped(np.arctan2(dy, dx) - pose[2] - mount[2])
    gain = 1.0 + states[1] + states[2] * b + states[3] * b * b
    by_bearing = r * (states[2] + 2.0 * states[3] * b)
    residual[0] = range_m - states[0] - r * gain
    residual[1] = wrapped(bearing_rad - b - states[4])
    rx, ry = dx / r, dy / r
    bx, by = -ry / r, rx / r
    j_landmark[0, 0], j_landmark[0, 1] = -(gain * rx + by_bearing * bx), -(gain * ry + by_bearing * by)
    j_landmark[1, 0], j_landmark[1, 1] = -bx, -by
    for k in range(3):
        ax = c if k == 0 else (-s if k == 1 else -lever_y)
        ay = s if k == 0 else (c if k == 1 else lever_x)
        dr = -(rx * ax + ry * ay)
        db = -(bx * ax + by * ay) - (1.0 if k == 2 else 0.0)
        j_pose[0, k] = -(gain * dr + by_bearing * db)
        j_pose[1, k] = -db
    j_states[:] = 0.0
    j_states[0, 0], j_states[0, 1], j_states[0, 2], j_states[0, 3] = -1.0, -r, -r * b, -r * b * b
    j_states[1, 4] = -1.0
    # where the sensor sits moves it as the robot does, along the robot's axes
    for row in range(2):
        j_states[row, 5], j_states[row, 6] = j_pose[row, 0], j_pose[row, 1]
