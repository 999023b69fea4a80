"""Planar rigid motions as arrays of `(x, y, theta)`; every function broadcasts over leading axes.

Right-perturbation convention: `pose * exp(xi)` with `xi = (forward, left, turn)`, the one of `types`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from evermap.geometry import jacobian
from evermap.types import FloatArray, IntArray

dim = 3
size = 3
point_dim = 2


def identity(*shape: int) -> FloatArray:
    """Return poses (*shape, 3) at the origin."""
    return np.zeros((*shape, 3))


def normalise_poses(pose: ArrayLike) -> FloatArray:
    """Return poses (..., 3) with angles in (-pi, pi]."""
    pose = np.array(pose, dtype=np.float64)
    pose[..., 2] = wrap(pose[..., 2])
    return pose


def wrap(angle_rad: ArrayLike) -> FloatArray:
    """Return angles wrapped to (-pi, pi]."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    wrapped = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return np.asarray(np.where(wrapped > -np.pi, wrapped, np.pi), dtype=np.float64)  # rounding may reach the open end


def compose(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Return `a * b`: the pose `b`, given in the frame `a`. Shapes (..., 3), broadcast."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    pose = np.empty(np.broadcast_shapes(a.shape, b.shape))
    pose[..., 0] = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    pose[..., 1] = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    pose[..., 2] = wrap(a[..., 2] + b[..., 2])
    return pose


def inverse(a: ArrayLike) -> FloatArray:
    """Return the motion that undoes `a`. Shape (..., 3)."""
    a = np.asarray(a, dtype=np.float64)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    pose = np.empty(a.shape)
    pose[..., 0] = -c * a[..., 0] - s * a[..., 1]
    pose[..., 1] = s * a[..., 0] - c * a[..., 1]
    pose[..., 2] = wrap(-a[..., 2])
    return pose


def between(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Return `a^-1 * b`: the pose `b` seen from `a`. Shapes (..., 3), broadcast."""
    return compose(inverse(a), b)


def transform(pose: ArrayLike, point: ArrayLike) -> FloatArray:
    """Return points (..., 2) of the frame `pose` in the frame that `pose` is given in."""
    pose, point = np.asarray(pose, dtype=np.float64), np.asarray(point, dtype=np.float64)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * point[..., 0] - s * point[..., 1]
    y = pose[..., 1] + s * point[..., 0] + c * point[..., 1]
    return np.stack([x, y], axis=-1)


def move_together(point: ArrayLike, displacement: ArrayLike, turn_rad: float = 0.0) -> FloatArray:
    """Return points (N, 2) moved as one rigid body: turned about their centroid, which itself moves by `displacement`.

    `move_together(moved, -displacement, -turn_rad)` undoes it.
    """
    point = np.asarray(point, dtype=np.float64)
    centroid = point.mean(axis=0)
    return np.asarray(centroid + displacement + (point - centroid) @ rotation(turn_rad).T, dtype=np.float64)


def exp(twist: ArrayLike) -> FloatArray:
    """Return motion along a constant twist (forward, left, turn) for unit time. Shape (..., 3)."""
    twist = np.asarray(twist, dtype=np.float64)
    turn = twist[..., 2]
    sinc = np.sinc(turn / np.pi)
    # (1 - cos w) / w = sin(w/2) sinc(w/2): no cancellation at w = 0
    cosc = np.sin(turn / 2) * np.sinc(turn / (2 * np.pi))
    x = sinc * twist[..., 0] - cosc * twist[..., 1]
    y = cosc * twist[..., 0] + sinc * twist[..., 1]
    return np.stack([x, y, wrap(turn)], axis=-1)


def log(pose: ArrayLike) -> FloatArray:
    """Return the twist whose `exp` is `pose`, of smallest turn. Shape (..., 3)."""
    pose = np.asarray(pose, dtype=np.float64)
    turn = wrap(pose[..., 2])
    half = turn / 2
    small = np.abs(half) < 1e-6
    safe = np.where(small, 1.0, half)
    cot = np.where(small, 1.0 - half**2 / 3.0, safe / np.tan(safe))
    x = cot * pose[..., 0] + half * pose[..., 1]
    y = -half * pose[..., 0] + cot * pose[..., 1]
    return np.stack([x, y, turn], axis=-1)


def retract(pose: ArrayLike, twist: ArrayLike) -> FloatArray:
    """Return `pose * exp(twist)`. Shapes (..., 3), broadcast."""
    return compose(pose, exp(twist))


def local(pose: ArrayLike, other: ArrayLike) -> FloatArray:
    """Return the twist (..., 3) by which `retract` brings `pose` to `other`."""
    return log(between(pose, other))


def adjoint(pose: ArrayLike) -> FloatArray:
    """Return adjoint matrices (..., 3, 3): `pose * exp(xi) = exp(Ad xi) * pose`."""
    pose = np.asarray(pose, dtype=np.float64)
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    out = np.zeros((*pose.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = c, -s, pose[..., 1]
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = s, c, -pose[..., 0]
    out[..., 2, 2] = 1.0
    return out


def bracket(twist: ArrayLike) -> FloatArray:
    """Return matrices (..., 3, 3) of the Lie bracket with twists; their exponential is `adjoint(exp(twist))`."""
    twist = np.asarray(twist, dtype=np.float64)
    out = np.zeros((*twist.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -twist[..., 2], twist[..., 1]
    out[..., 1, 0], out[..., 1, 2] = twist[..., 2], -twist[..., 0]
    return out


def right_jacobian_inverse(twist: ArrayLike) -> FloatArray:
    """Return matrices (..., 3, 3): `log(exp(twist) * exp(d)) = twist + right_jacobian_inverse d` for small `d`."""
    twist = np.asarray(twist, dtype=np.float64)
    return jacobian.right_jacobian_inverse(bracket(twist), twist[..., 2] ** 2)


def rotation_of(pose: ArrayLike) -> FloatArray:
    """Return the rotation matrices (..., 2, 2) of poses (..., 3)."""
    return rotation(np.asarray(pose, dtype=np.float64)[..., 2])


def rotation(angle_rad: ArrayLike) -> FloatArray:
    """Return rotation matrices (..., 2, 2)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def xy_rows(rows: ArrayLike, dim: int = 2) -> IntArray:
    """Return (2 k,) rows of x and y, interleaved, of points (k,) in a vector or covariance of all points together.

    Of x, y and z with `dim=3`, (3 k,).
    """
    return np.asarray(dim * np.asarray(rows, dtype=np.int64)[:, None] + np.arange(dim)).ravel()


def rigid_directions(point: ArrayLike) -> FloatArray:
    """Return (2 k, 3) derivatives of points (k, 2), x and y interleaved, by a shift along x, along y, and a turn."""
    at = np.asarray(point, dtype=np.float64)
    columns = np.zeros((2 * len(at), 3))
    columns[0::2, 0] = columns[1::2, 1] = 1.0
    columns[0::2, 2], columns[1::2, 2] = -at[:, 1], at[:, 0]
    return columns
