"""Poses between poses: the most probable path of the odometry that starts and ends where the smoother says.

Between two measured instants only odometry speaks. Dead reckoning from both ends, each weighted by how uncertain it
is by then, is the exact posterior of the linearised chain: a pose in the middle of a blind stretch follows the
odometry's shape, shares out its closing error in proportion to the noise that was collected, and carries a covariance
that swells in the middle. In the plane and in space this is `condition_on_ends`; `bridge_poses` is for the odometry of
the plane, `space.bridge` for that of space.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.geometry import se2
from evermap.slam.kernels import adjoint, composed, integrate_odometry, inverted, kernel, odometry_covariance, wrapped
from evermap.slam.problem import Drive, Noise
from evermap.types import FloatArray, IntArray


class HeldChain(NamedTuple):
    """Poses (K,) of a chain of odometry given the poses before and after; errors have D numbers, each in its own frame.

    Attributes:
        gain: (K, D, D) of the error that the odometry leaves at the pose after.
        by_ends: (K, D, 2 D) derivatives by the poses before and after.
        lost: (K, D, D) covariance given both.
    """

    gain: FloatArray
    by_ends: FloatArray
    lost: FloatArray


def condition_on_ends(carry: FloatArray, ahead: FloatArray, at: FloatArray, whole: FloatArray) -> HeldChain:
    """Condition poses (K,) that odometry leads to on those that it leads to afterwards.

    Args:
        carry: (K, D, D) what an error of the pose before is here.
        ahead: (K, D, D) what one here is at the pose after.
        at: (K, D, D) covariance of the odometry from the pose before to here, and
        whole: (K, D, D) to the pose after.
    """
    shared = ahead @ at
    gain = np.swapaxes(np.linalg.solve(whole, shared), 1, 2)
    return HeldChain(gain, np.concatenate([carry - gain @ ahead @ carry, gain], axis=2), at - gain @ shared)


def joint_of_ends(before: FloatArray, after: FloatArray, across: FloatArray) -> FloatArray:
    """Return covariances (K, 2 D, 2 D) of two poses, of those (K, D, D) of each and of the first with the second."""
    return np.concatenate(
        [np.concatenate([before, across], axis=2), np.concatenate([np.swapaxes(across, 1, 2), after], axis=2)], axis=1
    )


def bridge_poses(
    stamp_s: FloatArray,
    pose_stamp_s: FloatArray,
    pose: FloatArray,
    covariance: FloatArray,
    consecutive: FloatArray,
    drive: Drive,
    states: FloatArray,
    noise: Noise,
) -> tuple[FloatArray, FloatArray]:
    """Return poses and covariances at any stamps, given the smoothed ones.

    Args:
        stamp_s: (K,) where poses are wanted; before the first and after the last pose it is dead reckoning.
        pose_stamp_s: (N,) instants of the smoothed poses.
        pose: (N, 3) smoothed poses.
        covariance: (N, 3, 3) of each.
        consecutive: (N, 3, 3) of pose i with pose i + 1.
        drive: odometry.
        states: (11,) calibration states.
        noise: odometry noise.

    Returns:
        (K, 3) poses and (K, 3, 3) covariances in the robot's frame.
    """
    before = np.searchsorted(pose_stamp_s, stamp_s, side="right") - 1
    of = np.maximum(before, 0)
    out, spread = pose[of], covariance[of]
    between = np.flatnonzero(stamp_s != pose_stamp_s[of])
    if len(between):
        ends = pose_stamp_s, pose, covariance, consecutive
        out[between], spread[between] = _between_ends(stamp_s[between], before[between], ends, drive, states, noise)
    return out, _semidefinite(0.5 * (spread + spread.transpose(0, 2, 1)))


def _between_ends(
    stamp_s: FloatArray,
    before: IntArray,
    ends: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    drive: Drive,
    states: FloatArray,
    noise: Noise,
) -> tuple[FloatArray, FloatArray]:
    """Return what `bridge_poses` does, at stamps (K,) that are no poses', which follow poses `before` (K,), or -1."""
    pose_stamp_s, pose, covariance, consecutive = ends
    n = len(pose)
    increment, collected = np.zeros((2, len(stamp_s), 3)), np.zeros((2, len(stamp_s), 3, 3))
    odometry = drive.stamp_s, drive.velocity, drive.unknown
    _integrate_legs(stamp_s, pose_stamp_s, before, *odometry, states, noise.odometry**2, increment, collected)
    # dead reckoning from the pose before
    of, carry = np.maximum(before, 0), se2.adjoint(se2.inverse(increment[0]))
    out = se2.compose(pose[of], increment[0])
    spread = carry @ covariance[of] @ np.swapaxes(carry, 1, 2) + collected[0]
    # and backwards from the first pose
    first = np.flatnonzero(before < 0)
    back = se2.adjoint(increment[1, first])
    out[first] = se2.compose(pose[0], se2.inverse(increment[1, first]))
    spread[first] = back @ (covariance[0] + collected[1, first]) @ np.swapaxes(back, 1, 2)
    some = np.flatnonzero((before >= 0) & (before < n - 1))
    of, ahead, at = before[some], se2.adjoint(se2.inverse(increment[1, some])), collected[0, some]
    whole = ahead @ at @ np.swapaxes(ahead, 1, 2) + collected[1, some]
    chain = condition_on_ends(carry[some], ahead, at, whole)
    closing = se2.between(se2.compose(out[some], increment[1, some]), pose[of + 1])
    out[some] = se2.compose(out[some], np.einsum("kij,kj->ki", chain.gain, closing))
    joint = joint_of_ends(covariance[of], covariance[of + 1], consecutive[of])
    spread[some] = chain.by_ends @ joint @ np.swapaxes(chain.by_ends, 1, 2) + chain.lost
    return out, spread


def _semidefinite(covariance: FloatArray) -> FloatArray:
    """(K, 3, 3) without the negative eigenvalues that rounding leaves of the difference of two huge ones."""
    c = covariance
    minor = c[:, 0, 0] * c[:, 1, 1] - c[:, 0, 1] ** 2
    definite = (c[:, 0, 0] > 0.0) & (minor > 0.0) & (np.linalg.det(c) > 0.0)  # nearly all, in a tenth of the time
    rest = np.flatnonzero(~definite)
    size, direction = np.linalg.eigh(c[rest])
    for k in np.flatnonzero(size[:, 0] < 0.0):
        c[rest[k]] = (direction[k] * np.maximum(size[k], 0.0)) @ direction[k].T
    return c


def dead_reckoned(stamp_s: FloatArray, drive: Drive, states: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Return odometry alone from (0, 0, 0) at the first stamp: (K, 3) poses and (K, 3, 3) covariances."""
    out, spread = np.zeros((len(stamp_s), 3)), np.zeros((len(stamp_s), 3, 3))
    _reckon(stamp_s, drive.stamp_s, drive.velocity, drive.unknown, states, noise.odometry**2, out, spread)
    return out, spread


@kernel
def _write(pose: FloatArray, out: FloatArray) -> None:
    out[0], out[1], out[2] = pose[0], pose[1], pose[2]


@kernel
def _reckon(
    stamp: FloatArray, odometry_stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, states: FloatArray,
    variance: FloatArray, out: FloatArray, spread: FloatArray,
) -> None:  # fmt: skip
    increment, motion, noise, floor = np.zeros(3), np.zeros((3, 4)), np.zeros((5, 3, 3)), np.zeros((3, 3))
    for i in range(1, len(stamp)):
        integrate_odometry(
            odometry_stamp, velocity, unknown, stamp[i - 1], stamp[i], states, increment, motion, noise, floor
        )
        _write(composed(out[i - 1], increment), out[i])
        out[i, 2] = wrapped(out[i, 2])
        carry = adjoint(inverted(increment))
        odometry_covariance(noise, floor, variance, spread[i])
        carried = carry @ spread[i - 1] @ carry.T
        for a in range(3):
            for b in range(3):
                spread[i, a, b] += carried[a, b]


@kernel
def _integrate_legs(
    stamp: FloatArray, pose_stamp: FloatArray, before: IntArray, odometry_stamp: FloatArray, velocity: FloatArray,
    unknown: FloatArray, states: FloatArray, variance: FloatArray, increment: FloatArray, collected: FloatArray,
) -> None:  # fmt: skip
    """Fill in increments (2, K, 3) from the pose before and to the pose after, where there is one, and their noise."""
    n, motion, noise, floor = len(pose_stamp), np.zeros((3, 4)), np.zeros((5, 3, 3)), np.zeros((3, 3))
    for k in range(len(stamp)):
        i = before[k]
        for side in range(2):
            if (side == 0 and i < 0) or (side == 1 and i >= n - 1):
                continue
            begin = pose_stamp[i] if side == 0 else stamp[k]
            end = stamp[k] if side == 0 else pose_stamp[i + 1]
            integrate_odometry(
                odometry_stamp, velocity, unknown, begin, end, states, increment[side, k], motion, noise, floor
            )
            odometry_covariance(noise, floor, variance, collected[side, k])
