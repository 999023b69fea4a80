"""The protocol of a group of rigid motions: what an estimator may know of SE(2) (`se2`) and of SE(3) (`se3`).

The modules themselves are the groups: `PLANE.compose(a, b)` is `se2.compose(a, b)`. All arrays broadcast over leading
axes. Twists hold the translation first, then the rotation, in the frame of the pose; poses are perturbed on the right.
"""

from __future__ import annotations

from math import isqrt
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from evermap.geometry import se2, se3
from evermap.types import FloatArray


class Group(Protocol):
    """Rigid motions of one dimension; the laws are checked by `tests/geometry/test_group.py`."""

    dim: int
    """Degrees of freedom, numbers in a twist: 3 or 6."""
    size: int
    """Numbers that a pose is stored in: 3 for `(x, y, theta)`, 7 for `(x, y, z, qx, qy, qz, qw)`."""
    point_dim: int
    """Coordinates of a point: 2 or 3. The first of a pose, and the first of a twist, are the translation."""

    def identity(self, *shape: int) -> FloatArray:
        """Return poses (*shape, size) at the origin."""

    def normalise_poses(self, pose: ArrayLike) -> FloatArray:
        """Return each pose (..., size) in the one form that all functions return."""

    def compose(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        """Return `a * b`: the pose `b`, given in the frame `a`."""

    def inverse(self, a: ArrayLike) -> FloatArray:
        """Return the motion that undoes `a`."""

    def between(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        """Return `a^-1 * b`: the pose `b` seen from `a`."""

    def transform(self, pose: ArrayLike, point: ArrayLike) -> FloatArray:
        """Return points (..., point_dim) of the frame `pose` in the frame that `pose` is given in."""

    def rotation_of(self, pose: ArrayLike) -> FloatArray:
        """Return the rotation matrices (..., point_dim, point_dim) of poses."""

    def exp(self, twist: ArrayLike) -> FloatArray:
        """Return the motion along a constant twist (..., dim) for unit time."""

    def log(self, pose: ArrayLike) -> FloatArray:
        """Return the twist (..., dim) whose `exp` is `pose`, of smallest rotation."""

    def retract(self, pose: ArrayLike, twist: ArrayLike) -> FloatArray:
        """Return `pose * exp(twist)`."""

    def local(self, pose: ArrayLike, other: ArrayLike) -> FloatArray:
        """Return the twist by which `retract` brings `pose` to `other`."""

    def adjoint(self, pose: ArrayLike) -> FloatArray:
        """Return matrices (..., dim, dim): `pose * exp(xi) = exp(adjoint xi) * pose`."""

    def bracket(self, twist: ArrayLike) -> FloatArray:
        """Return Lie brackets with twists as matrices (..., dim, dim); their exponential is `adjoint(exp(twist))`."""

    def right_jacobian_inverse(self, twist: ArrayLike) -> FloatArray:
        """Return matrices (..., dim, dim): `log(exp(twist) * exp(d)) = twist + right_jacobian_inverse d`, small `d`."""

    def rigid_directions(self, point: ArrayLike) -> FloatArray:
        """Return (k point_dim, dim) derivatives of points (k, point_dim), interleaved, moved together by `exp(xi)`."""


PLANE: Group = se2
SPACE: Group = se3


def group_of(pose: ArrayLike) -> Group:
    """Return the group of poses (..., 3) or (..., 7), by how many numbers each has."""
    return SPACE if np.shape(pose)[-1] == SPACE.size else PLANE


def accumulate(motion: FloatArray) -> FloatArray:
    """Return the poses (N + 1, size) to which motions (N, size) lead one after the other from the origin.

    Stretches of about sqrt(N) motions are composed all at once, then one is appended to the other.
    """
    group, count = group_of(motion), len(motion)
    length = isqrt(count) + 1
    pose = group.identity(-(-count // length), length)
    pose.reshape(-1, group.size)[:count] = motion
    for k in range(1, length):
        pose[:, k] = group.compose(pose[:, k - 1], pose[:, k])
    for k in range(1, len(pose)):
        pose[k] = group.compose(pose[k - 1, -1], pose[k])
    return np.concatenate([group.identity(1), pose.reshape(-1, group.size)[:count]])
