"""Poses between poses: the most probable path of the odometry that starts and ends where the smoother says.

Between two measured instants only odometry speaks. Dead reckoning from both ends, each weighted by how uncertain it
is by then, is the exact posterior of the linearised chain: a pose in the middle of a blind stretch follows the
odometry's shape, shares out its closing error in proportion to the noise that was collected, and carries a covariance
that swells in the middle.
"""

from __future__ import annotations

import numpy as np

from evermap.slam.kernels import (
    adjoint,
    composed,
    integrate_odometry,
    invert_3x3,
    inverted,
    kernel,
    multiply,
    odometry_covariance,
    sandwich,
    wrapped,
)
from evermap.slam.problem import Drive, Noise
from evermap.types import FloatArray


def bridged(
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
    out, spread = np.empty((len(stamp_s), 3)), np.empty((len(stamp_s), 3, 3))
    odometry = drive.stamp_s, drive.velocity, drive.unknown
    _bridge(stamp_s, pose_stamp_s, pose, covariance, consecutive, *odometry, states, noise.odometry**2, out, spread)
    return out, _semidefinite(0.5 * (spread + spread.transpose(0, 2, 1)))


def _semidefinite(covariance: FloatArray) -> FloatArray:
    """(K, 3, 3) without the negative eigenvalues that rounding leaves of the difference of two huge ones."""
    size, direction = np.linalg.eigh(covariance)
    for k in np.flatnonzero(size[:, 0] < 0.0):
        covariance[k] = (direction[k] * np.maximum(size[k], 0.0)) @ direction[k].T
    return covariance


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
def _bridge(
    stamp: FloatArray, pose_stamp: FloatArray, pose: FloatArray, covariance: FloatArray, consecutive: FloatArray,
    odometry_stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, states: FloatArray, variance: FloatArray,
    out: FloatArray, spread: FloatArray,
) -> None:  # fmt: skip
    n = len(pose_stamp)
    motion, noise, floor = np.zeros((3, 4)), np.zeros((5, 3, 3)), np.zeros((3, 3))
    increment, collected = np.zeros((2, 3)), np.zeros((2, 3, 3))
    joint = np.zeros((6, 6))
    ends, ends_part = np.zeros((3, 6)), np.zeros((3, 6))
    share, gain, part = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(len(stamp)):
        i = min(np.searchsorted(pose_stamp, stamp[k], side="right") - 1, n - 1)
        for side in range(2):  # from the pose before, and to the pose after
            if (side == 0 and i < 0) or (side == 1 and i >= n - 1):
                continue
            begin = pose_stamp[i] if side == 0 else stamp[k]
            end = stamp[k] if side == 0 else pose_stamp[i + 1]
            integrate_odometry(
                odometry_stamp, velocity, unknown, begin, end, states, increment[side], motion, noise, floor
            )
            odometry_covariance(noise, floor, variance, collected[side])
        if i < 0:  # dead reckoning backwards from the first pose
            _write(composed(pose[0], inverted(increment[1])), out[k])
            for a in range(3):
                for b in range(3):
                    share[a, b] = covariance[0, a, b] + collected[1, a, b]
            sandwich(adjoint(increment[1]), share, part, spread[k])
            continue
        forward = composed(pose[i], increment[0])
        from_start = adjoint(inverted(increment[0]))
        if i >= n - 1:
            _write(forward, out[k])
            sandwich(from_start, covariance[i], part, spread[k])
            for a in range(3):
                for b in range(3):
                    spread[k, a, b] += collected[0, a, b]
            continue
        closing = composed(inverted(composed(forward, increment[1])), pose[i + 1])
        closing[2] = wrapped(closing[2])
        to_end = adjoint(inverted(increment[1]))
        multiply(collected[0], to_end.T, share)
        multiply(to_end, share, gain)
        for a in range(3):
            for b in range(3):
                part[a, b] = gain[a, b] + collected[1, a, b]
        invert_3x3(part, part)
        multiply(share, part, gain)
        # perturbations of the two ends, carried to this instant
        multiply(to_end, from_start, share)
        multiply(gain, share, part)
        step = np.zeros(3)
        for a in range(3):
            for b in range(3):
                step[a] += gain[a, b] * closing[b]
                ends[a, b], ends[a, 3 + b] = from_start[a, b] - part[a, b], gain[a, b]
                joint[a, b], joint[3 + a, 3 + b] = covariance[i, a, b], covariance[i + 1, a, b]
                joint[a, 3 + b] = joint[3 + b, a] = consecutive[i, a, b]
        _write(composed(forward, step), out[k])
        sandwich(ends, joint, ends_part, spread[k])
        multiply(collected[0], to_end.T, share)
        multiply(gain, share.T, part)
        for a in range(3):
            for b in range(3):
                spread[k, a, b] += collected[0, a, b] - part[a, b]
