"""The two measurement equations with their derivatives, compiled; every estimator of this package calls these.

Poses are `(x, y, theta)` and perturbed on the right, `pose * exp(xi)`; residuals are measured minus predicted for
detections and `increment^-1 * between(pose, next)` for odometry. Calibration states come as the vector of
`calibration.SPECS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit

from evermap.compiled import drop_stale_code
from evermap.types import FloatArray

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

_AXIS = np.array([0, 0, 1, 2, 2])  # forward, lateral, turn
_DRIVER = np.array([1, 2, 1, 0, 2])  # time, distance, angle

_Function = TypeVar("_Function", bound=Callable[..., Any])


drop_stale_code(__file__)


def kernel(function: _Function) -> _Function:
    """Compile a function at its first call, and keep the machine code beside the source."""
    return cast("_Function", njit(cache=True, error_model="numpy")(function))


@kernel
def inverse_of(matrix: FloatArray) -> FloatArray:
    """Inverse of a small matrix, row after row in memory as all others."""
    inverted: Any = np.linalg.inv(matrix)
    return np.ascontiguousarray(inverted)


@kernel
def wrapped(angle: float) -> float:
    """`angle` in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def integrate_odometry(
    stamp: FloatArray,
    velocity: FloatArray,
    unknown: FloatArray,
    start: float,
    stop: float,
    states: FloatArray,
    increment: FloatArray,
    jacobian: FloatArray,
    noise: FloatArray,
    floor: FloatArray,
) -> None:
    """Motion between two instants, its derivatives and its noise, from velocities held between odometry stamps.

    Args:
        stamp: (N,) odometry stamps; row i of `velocity` holds from stamp i to stamp i + 1.
        velocity: (N, 3) reported forward, lateral, turn.
        unknown: (N,) extra noise variance per second where the odometry is silent.
        start: first instant, on the detections' clock.
        stop: second instant.
        states: (9,) calibration states.
        increment: (3,) out, pose at `stop` seen from `start`.
        jacobian: (3, 4) out, right perturbation of the increment by delay, forward scale, turn scale, slip.
        noise: (5, 3, 3) out, covariance for unit noise of each kind in `NOISE_NAMES`.
        floor: (3, 3) out, covariance that is always there.
    """
    delay, scale_v, scale_w, slip = states[5], states[6], states[7], states[8]
    begin = start + delay
    end = stop + delay
    count = len(stamp)
    row = max(np.searchsorted(stamp, begin, side="right") - 1, 0)
    x = y = theta = 0.0
    jacobian[:] = 0.0
    noise[:] = 0.0
    floor[:] = 0.0
    turn_abs = abs(velocity[row, 2])
    first_v = scale_v * velocity[row, 0] - slip * turn_abs
    first_l = scale_v * velocity[row, 1]
    first_w = scale_w * velocity[row, 2]
    v, left, w = first_v, first_l, first_w
    now = begin
    ct, st = 1.0, 0.0
    # all sums are over twists seen from the start: one transformation at the end instead of one a step
    column, product = np.zeros((3, 3)), np.zeros((3, 3))
    while now < end:
        until = end if row + 1 >= count else min(end, stamp[row + 1])
        if until > now:
            reported_v, reported_l, reported_w = velocity[row, 0], velocity[row, 1], velocity[row, 2]
            turn_abs = abs(reported_w)
            speed = math.sqrt(reported_v * reported_v + reported_l * reported_l)
            v = scale_v * reported_v - slip * turn_abs
            left = scale_v * reported_l
            w = scale_w * reported_w
            pieces = max(1, math.ceil((until - now) / MAX_STEP_S))
            h = (until - now) / pieces
            turn = w * h
            c, s = math.cos(turn), math.sin(turn)
            if abs(turn) < 1e-4:
                sin_by = 1.0 - turn * turn / 6.0
                cos_by = 0.5 * turn
                sin_by2 = turn / 6.0
                cos_by2 = 0.5 - turn * turn / 24.0
            else:
                sin_by = s / turn
                cos_by = (1.0 - c) / turn
                sin_by2 = (turn - s) / (turn * turn)
                cos_by2 = (1.0 - c) / (turn * turn)
            step_x = (sin_by * v - cos_by * left) * h
            step_y = (cos_by * v + sin_by * left) * h
            # right Jacobian of the exponential: from a change of the twist to a change of the step, seen at its end
            by_turn_x, by_turn_y = (v * sin_by2 - left * cos_by2) * h, (v * cos_by2 + left * sin_by2) * h
            for _ in range(pieces):
                x += ct * step_x - st * step_y
                y += st * step_x + ct * step_y
                ct, st = ct * c - st * s, st * c + ct * s
                theta += turn
                column[0, 0], column[0, 1] = ct * sin_by + st * cos_by, st * sin_by - ct * cos_by
                column[1, 0], column[1, 1] = ct * cos_by - st * sin_by, st * cos_by + ct * sin_by
                column[2, 0] = ct * by_turn_x - st * by_turn_y + y
                column[2, 1] = st * by_turn_x + ct * by_turn_y - x
                column[2, 2] = 1.0
                for k in range(2):
                    jacobian[k, 1] += (column[0, k] * reported_v + column[1, k] * reported_l) * h
                    jacobian[k, 2] += column[2, k] * reported_w * h
                    jacobian[k, 3] -= column[0, k] * turn_abs * h
                jacobian[2, 2] += reported_w * h
                for axis in range(3):
                    base = FLOOR_TURN_RAD if axis == 2 else FLOOR_FORWARD_M
                    always = h * (base * base + unknown[row])
                    for i in range(3):
                        for j in range(i + 1):
                            product[i, j] = column[axis, i] * column[axis, j]
                            floor[i, j] += always * product[i, j]
                    for kind in range(N_NOISE):
                        if _AXIS[kind] != axis:
                            continue
                        driver = _DRIVER[kind]
                        amount = h if driver == 0 else (h * speed if driver == 1 else h * turn_abs)
                        for i in range(3):
                            for j in range(i + 1):
                                noise[kind, i, j] += amount * product[i, j]
        now = until
        if row + 1 < count and until >= stamp[row + 1]:
            row += 1
    c, s = math.cos(theta), math.sin(theta)
    # adjoint of the inverse increment: what is seen from the start, seen from the end
    lever_x, lever_y = s * x - c * y, c * x + s * y
    _carry(jacobian, c, s, lever_x, lever_y)
    for kind in range(N_NOISE):
        _carry_covariance(noise[kind], c, s, lever_x, lever_y)
    _carry_covariance(floor, c, s, lever_x, lever_y)
    for axis in range(3):
        floor[axis, axis] += FLOOR_VARIANCE
    increment[0], increment[1], increment[2] = x, y, theta
    # a later window gains the last velocity at its end and loses the first at its start
    jacobian[0, 0] = v - (c * first_v + s * first_l + (s * x - c * y) * first_w)
    jacobian[1, 0] = left - (-s * first_v + c * first_l + (c * x + s * y) * first_w)
    jacobian[2, 0] = w - first_w


@kernel
def _carry(columns: FloatArray, c: float, s: float, lever_x: float, lever_y: float) -> None:
    """Columns of perturbations before a step, as perturbations after it."""
    for k in range(columns.shape[1]):
        a, b, t = columns[0, k], columns[1, k], columns[2, k]
        columns[0, k] = c * a + s * b + lever_x * t
        columns[1, k] = -s * a + c * b + lever_y * t


@kernel
def _carry_covariance(p: FloatArray, c: float, s: float, lever_x: float, lever_y: float) -> None:
    """The same for a covariance of which the lower half is given."""
    for i in range(3):
        for j in range(i):
            p[j, i] = p[i, j]
    _carry(p, c, s, lever_x, lever_y)
    _carry(p.T, c, s, lever_x, lever_y)


@kernel
def odometry_residual(
    pose: FloatArray, following: FloatArray, increment: FloatArray, residual: FloatArray, j1: FloatArray, j2: FloatArray
) -> None:
    """`increment^-1 * between(pose, following)` as (x, y, theta), with (3, 3) derivatives by both poses."""
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
    for k in range(4):
        forward, left, turn = motion[0, k], motion[1, k], motion[2, k]
        on = 1.0 if free[5 + k] else 0.0
        motion[0, k] = on * (turn * residual[1] - forward)
        motion[1, k] = -on * (turn * residual[0] + left)
        motion[2, k] = -on * turn


@kernel
def detection_residual(
    pose: FloatArray,
    landmark: FloatArray,
    states: FloatArray,
    mount: FloatArray,
    range_m: float,
    bearing_rad: float,
    residual: FloatArray,
    j_pose: FloatArray,
    j_landmark: FloatArray,
    j_states: FloatArray,
) -> None:
    """Measured minus predicted (range, bearing), with derivatives by pose (2, 3), landmark (2, 2), states (2, 5)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    lever_x, lever_y = c * mount[0] - s * mount[1], s * mount[0] + c * mount[1]
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


@kernel
def inlier_weight(squared: float, log_odds: float, heavy: bool) -> float:
    """Weight of a detection with squared normalised residual `squared`.

    `heavy`: Cauchy with scale 3, which never lets go while the estimate is still far away. Otherwise the posterior
    probability of 'no outlier' when an outlier is as likely as an inlier at `squared = 2 log_odds`.
    """
    if heavy:
        return 1.0 / (1.0 + squared / 9.0)
    return 1.0 / (1.0 + math.exp(min(0.5 * squared - log_odds, 700.0)))


@kernel
def outlier_loss(squared: float, log_odds: float, heavy: bool) -> float:
    """Negative log likelihood, 0 at 0; `inlier_weight` is twice its derivative by `squared`."""
    if heavy:
        return 4.5 * math.log1p(squared / 9.0)
    # -log(exp(-s/2) + exp(-log_odds)) without overflow, 0 at s = 0
    d = 0.5 * squared - log_odds
    log_sum = math.log1p(math.exp(d)) if d < 0 else d + math.log1p(math.exp(-d))
    return 0.5 * squared - log_sum + math.log1p(math.exp(-log_odds))
