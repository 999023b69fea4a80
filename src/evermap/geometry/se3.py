"""Rigid motions in space as arrays of `(x, y, z, qx, qy, qz, qw)`; every function broadcasts over leading axes.

The functions and conventions are those of `se2`: poses are perturbed on the right, `pose * exp(xi)`, with the twist
`xi = (forward, left, up, roll, pitch, yaw)`, that is the translation, then the rotation vector, in the pose's frame.
Quaternions are Hamilton's with the scalar last, of unit length, and of the one sign for which the last of their numbers
that is not zero is positive. They may be given with any sign; `normalised` accepts any length as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from evermap.geometry import jacobian
from evermap.types import FloatArray

dim = 6
size = 7
point_dim = 3
NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])
"""Quaternion of no rotation, and of one that nobody knows."""
BACKWARDS = np.array([-1.0, -1.0, -1.0, 1.0])
"""Signs that the numbers of a quaternion change by in that of the rotation back."""


def identity(*shape: int) -> FloatArray:
    """Return poses (*shape, 7) at the origin."""
    return np.broadcast_to(np.append(np.zeros(3), NO_TURN), (*shape, 7)).copy()


def from_plane(pose: ArrayLike) -> FloatArray:
    """Return poses (..., 3) of `se2`, x, y and heading, as poses (..., 7) on the floor."""
    pose = np.asarray(pose, dtype=np.float64)
    found, half = np.zeros((*pose.shape[:-1], 7)), 0.5 * pose[..., 2]
    found[..., :2], found[..., 5], found[..., 6] = pose[..., :2], np.sin(half), np.cos(half)
    return found


def from_angles(roll_pitch_yaw: ArrayLike) -> FloatArray:
    """Return poses (..., 7) at the origin rotated about the fixed axes x, then y, then z by angles (..., 3) [rad]."""
    angle = np.asarray(roll_pitch_yaw, dtype=np.float64)
    pose = identity(*angle.shape[:-1])
    for axis in (2, 1, 0):
        pose = compose(pose, exp(np.eye(6)[3 + axis] * angle[..., axis, None]))
    return pose


def normalised(pose: ArrayLike) -> FloatArray:
    """Return poses (..., 7) with quaternions of unit length and of one sign."""
    return _normalise(np.array(pose, dtype=np.float64))


def _normalise(pose: FloatArray) -> FloatArray:
    """Normalise in place."""
    quaternion = pose[..., 3:]
    scalar = quaternion[..., 3:]
    if not scalar.all():  # whichever of qw, qz, qy, qx is the first that is not zero outweighs all that follow
        scalar = (np.sign(quaternion) @ [1.0, 2.0, 4.0, 8.0])[..., None]
    quaternion /= np.copysign(np.sqrt(_dot(quaternion, quaternion)), scalar)
    return pose


def compose(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Return `a * b`: the pose `b`, given in the frame `a`. Shapes (..., 7), broadcast."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    return _pose(transform(a, b[..., :3]), _times(a[..., 3:], b[..., 3:]))


def inverse(a: ArrayLike) -> FloatArray:
    """Return the motion that undoes `a`. Shape (..., 7)."""
    a = np.asarray(a, dtype=np.float64)
    back = _conjugate(a[..., 3:])
    return _pose(-_turned(back, a[..., :3]), back)


def between(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Return `a^-1 * b`: the pose `b` seen from `a`. Shapes (..., 7), broadcast."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    back = _conjugate(a[..., 3:])
    return _pose(_turned(back, b[..., :3] - a[..., :3]), _times(back, b[..., 3:]))


def transform(pose: ArrayLike, point: ArrayLike) -> FloatArray:
    """Return points (..., 3) of the frame `pose` in the frame that `pose` is given in."""
    pose = np.asarray(pose, dtype=np.float64)
    return pose[..., :3] + _turned(pose[..., 3:], np.asarray(point, dtype=np.float64))


def scaled(pose: ArrayLike, factor: float) -> FloatArray:
    """Return poses (..., 7) with all lengths times a factor."""
    lengths: FloatArray = np.array([factor] * 3 + [1.0] * 4)
    return np.asarray(np.asarray(pose, dtype=np.float64) * lengths)


def rotation_of(pose: ArrayLike) -> FloatArray:
    """Return the rotation matrices (..., 3, 3) of poses (..., 7)."""
    quaternion = np.asarray(pose, dtype=np.float64)[..., None, 3:]
    return np.swapaxes(_turned(quaternion, np.eye(3)), -1, -2)


def exp(twist: ArrayLike) -> FloatArray:
    """Return the motion along a constant twist for unit time. Shapes (..., 6) and (..., 7)."""
    twist = np.asarray(twist, dtype=np.float64)
    shift, turn = twist[..., :3], twist[..., 3:]
    q = _dot(turn, turn)
    b, c = jacobian.coefficients(q)
    half = np.sqrt(q) / 2
    across = _cross(turn, shift)
    position = shift + b * across + c * _cross(turn, across)
    return _pose(position, np.concatenate([0.5 * np.sinc(half / np.pi) * turn, np.cos(half)], axis=-1))


def log(pose: ArrayLike) -> FloatArray:
    """Return the twist whose `exp` is `pose`, of smallest rotation. Shapes (..., 7) and (..., 6)."""
    pose = normalised(pose)
    axis, scalar = pose[..., 3:6], pose[..., 6:]
    length = np.sqrt(_dot(axis, axis))
    small = length < 1e-8  # the arc tangent of a tiny length is that length, whose square may underflow
    safe = np.where(small, 1.0, length)
    turn = np.where(small, 2.0, 2.0 * np.arctan2(safe, scalar) / safe) * axis
    d = jacobian.inverse_coefficient(_dot(turn, turn))
    across = _cross(turn, pose[..., :3])
    return np.concatenate([pose[..., :3] - 0.5 * across + d * _cross(turn, across), turn], axis=-1)


def retract(pose: ArrayLike, twist: ArrayLike) -> FloatArray:
    """Return `pose * exp(twist)`. Shapes (..., 7) and (..., 6), broadcast."""
    return compose(pose, exp(twist))


def local(pose: ArrayLike, other: ArrayLike) -> FloatArray:
    """Return the twist (..., 6) by which `retract` brings `pose` to `other`."""
    return log(between(pose, other))


def turn(rotation: ArrayLike) -> FloatArray:
    """Return poses (..., 7) at the origin with orientations (..., 4), nan of none."""
    given = np.asarray(rotation, dtype=np.float64)
    return np.concatenate([np.zeros((*given.shape[:-1], 3)), given], axis=-1)


def angle_between(pose: ArrayLike, other: ArrayLike) -> FloatArray:
    """Return the angles [rad] between the orientations of poses (..., 7), broadcast."""
    a, b = np.asarray(pose, dtype=np.float64), np.asarray(other, dtype=np.float64)
    return np.asarray(2.0 * np.arccos(np.clip(np.abs((a[..., 3:] * b[..., 3:]).sum(axis=-1)), 0.0, 1.0)))


def interpolate(knot_s: FloatArray, pose: FloatArray, stamp_s: FloatArray) -> FloatArray:
    """Return poses (F, 7) at stamps, along the screws between knots (P,); before and after them the end poses."""
    if len(knot_s) == 1:
        return np.repeat(pose, len(stamp_s), axis=0)
    before = np.clip(np.searchsorted(knot_s, stamp_s, side="right") - 1, 0, len(knot_s) - 2)
    share = np.clip((stamp_s - knot_s[before]) / (knot_s[before + 1] - knot_s[before]), 0.0, 1.0)
    return retract(pose[before], share[:, None] * local(pose[before], pose[before + 1]))


def adjoint(pose: ArrayLike) -> FloatArray:
    """Return adjoint matrices (..., 6, 6): `pose * exp(xi) = exp(Ad xi) * pose`."""
    pose = np.asarray(pose, dtype=np.float64)
    turn = rotation_of(pose)
    return _two_by_two(turn, _crossing(pose[..., :3]) @ turn)


def bracket(twist: ArrayLike) -> FloatArray:
    """Return matrices (..., 6, 6) of the Lie bracket with twists; their exponential is `adjoint(exp(twist))`."""
    twist = np.asarray(twist, dtype=np.float64)
    return _two_by_two(_crossing(twist[..., 3:]), _crossing(twist[..., :3]))


def right_jacobian_inverse(twist: ArrayLike) -> FloatArray:
    """Return matrices (..., 6, 6): `log(exp(twist) * exp(d)) = twist + right_jacobian_inverse d` for small `d`."""
    twist = np.asarray(twist, dtype=np.float64)
    return jacobian.right_jacobian_inverse(bracket(twist), _dot(twist[..., 3:], twist[..., 3:])[..., 0])


def rigid_directions(point: ArrayLike) -> FloatArray:
    """Return (3 k, 6) derivatives of points (k, 3), x, y and z interleaved, by shifts along and turns about x, y, z."""
    at = np.asarray(point, dtype=np.float64)
    shift = np.broadcast_to(np.eye(3), (len(at), 3, 3))
    return np.concatenate([shift, -_crossing(at)], axis=-1).reshape(-1, 6)


def _pose(position: FloatArray, quaternion: FloatArray) -> FloatArray:
    lead = position.shape[:-1]
    if quaternion.shape[:-1] != lead:
        lead = np.broadcast_shapes(lead, quaternion.shape[:-1])
    pose = np.empty((*lead, 7))
    pose[..., :3], pose[..., 3:] = position, quaternion
    return _normalise(pose)


def _conjugate(quaternion: FloatArray) -> FloatArray:
    return quaternion * BACKWARDS


def _times(a: FloatArray, b: FloatArray) -> FloatArray:
    """Products of quaternions (..., 4)."""
    axis_a, axis_b, scalar_a, scalar_b = a[..., :3], b[..., :3], a[..., 3:], b[..., 3:]
    axis = scalar_a * axis_b + scalar_b * axis_a + _cross(axis_a, axis_b)
    return np.concatenate([axis, scalar_a * scalar_b - _dot(axis_a, axis_b)], axis=-1)


def _turned(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """Vectors (..., 3), rotated by quaternions (..., 4)."""
    axis = quaternion[..., :3]
    across = 2.0 * _cross(axis, vector)
    return np.asarray(vector + quaternion[..., 3:] * across + _cross(axis, across))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return `np.cross`, in a tenth of the time."""
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return out


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """(..., 1)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))[..., None]


def _crossing(vector: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    return np.swapaxes(_cross(vector[..., None, :], np.eye(3)), -1, -2)


def _two_by_two(diagonal: FloatArray, corner: FloatArray) -> FloatArray:
    """`[[diagonal, corner], [0, diagonal]]` of (..., 3, 3) blocks."""
    out = np.zeros((*diagonal.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = diagonal
    out[..., :3, 3:] = corner
    return out
