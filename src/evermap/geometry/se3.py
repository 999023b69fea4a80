"""Rigid motions in space as arrays of `(x, y, z, qx, qy, qz, qw)`; every function broadcasts over leading axes.

The functions and conventions are those of `se2`: poses are perturbed on the right, `pose * exp(xi)`, with the twist
`xi = (forward, left, up, roll, pitch, yaw)`, that is the translation, then the rotation vector, in the pose's frame.
Quaternions are Hamilton's with the scalar last, of unit length, and of the one sign for which the last of their numbers
that is not zero is positive. They may be given with any sign; `normalise_poses` accepts any length as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evermap.geometry import jacobian
from evermap.types import FloatArray

dim = 6
size = 7
point_dim = 3
NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])
"""Quaternion of no rotation, and of one that nobody knows."""


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


def normalise_poses(pose: ArrayLike) -> FloatArray:
    """Return poses (..., 7) with quaternions of unit length and of one sign."""
    from evermap.geometry import se3_kernels

    found = np.array(pose, dtype=np.float64, order="C")
    se3_kernels.normalise(found.reshape(-1, 7))
    return found


def compose(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Return `a * b`: the pose `b`, given in the frame `a`. Shapes (..., 7), broadcast."""
    from evermap.geometry import se3_kernels

    lead, one, other = _rows(a, b)
    found = np.empty((*lead, 7))
    se3_kernels.compose(one, other, found.reshape(-1, 7))
    return found


def inverse(a: ArrayLike) -> FloatArray:
    """Return the motion that undoes `a`. Shape (..., 7)."""
    from evermap.geometry import se3_kernels

    lead, one = _rows(a)
    found = np.empty((*lead, 7))
    se3_kernels.inverse(one, found.reshape(-1, 7))
    return found


def between(a: ArrayLike, b: ArrayLike) -> FloatArray:
    """Return `a^-1 * b`: the pose `b` seen from `a`. Shapes (..., 7), broadcast."""
    from evermap.geometry import se3_kernels

    lead, one, other = _rows(a, b)
    found = np.empty((*lead, 7))
    se3_kernels.between(one, other, found.reshape(-1, 7))
    return found


def transform(pose: ArrayLike, point: ArrayLike) -> FloatArray:
    """Return points (..., 3) of the frame `pose` in the frame that `pose` is given in."""
    from evermap.geometry import se3_kernels

    lead, one, other = _rows(pose, point)
    found = np.empty((*lead, 3))
    se3_kernels.transform(one, other, found.reshape(-1, 3))
    return found


def scaled(pose: ArrayLike, factor: float) -> FloatArray:
    """Return poses (..., 7) with all lengths times a factor."""
    lengths: FloatArray = np.array([factor] * 3 + [1.0] * 4)
    return np.asarray(np.asarray(pose, dtype=np.float64) * lengths)


def rotation_of(pose: ArrayLike) -> FloatArray:
    """Return the rotation matrices (..., 3, 3) of poses (..., 7)."""
    from evermap.geometry import se3_kernels

    lead, one = _rows(pose)
    found = np.empty((*lead, 3, 3))
    se3_kernels.rotation_of(one, found.reshape(-1, 3, 3))
    return found


def exp(twist: ArrayLike) -> FloatArray:
    """Return the motion along a constant twist for unit time. Shapes (..., 6) and (..., 7)."""
    from evermap.geometry import se3_kernels

    lead, one = _rows(twist)
    found = np.empty((*lead, 7))
    se3_kernels.exp(one, found.reshape(-1, 7))
    return found


def log(pose: ArrayLike) -> FloatArray:
    """Return the twist whose `exp` is `pose`, of smallest rotation. Shapes (..., 7) and (..., 6)."""
    from evermap.geometry import se3_kernels

    normal = np.array(pose, dtype=np.float64, order="C")
    found = np.empty((*normal.shape[:-1], 6))
    se3_kernels.log(normal.reshape(-1, 7), found.reshape(-1, 6))
    return found


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


def warm_up() -> None:
    """Compile what motions need, or load it where that was done before: for steps that may not wait for it."""
    pose = compose(inverse(identity(1)), normalise_poses(exp(np.zeros((1, 6)))))
    log(between(pose, pose))
    transform(pose, np.zeros(point_dim))
    rotation_of(pose)


def _rows(*given: ArrayLike) -> tuple[Any, ...]:
    """Return the leading axes of arrays (..., k), broadcast, and the rows (N, k) of each, or (1, k)."""
    arrays = [np.asarray(each, dtype=np.float64) for each in given]
    lead = arrays[0].shape[:-1]
    if len(arrays) > 1 and arrays[1].shape[:-1] != lead:
        one, other = arrays
        if one.ndim == 1 or other.ndim == 1:
            lead = other.shape[:-1] if one.ndim == 1 else lead
        else:
            lead = np.broadcast_shapes(lead, other.shape[:-1])
            arrays = [
                each if each.size == each.shape[-1] else np.broadcast_to(each, (*lead, each.shape[-1]))
                for each in arrays
            ]
    return lead, *[_as_rows(each) for each in arrays]


def _as_rows(array: FloatArray) -> FloatArray:
    """Return arrays (..., k) as rows (N, k) in one piece; of those that may not be written to machine code would be
    made once more.
    """
    flags = array.flags
    if not (flags.c_contiguous and flags.writeable):
        array = np.array(array, order="C")
    return array if array.ndim == 2 else array.reshape(-1, array.shape[-1])


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
