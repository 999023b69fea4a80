"""Poses between poses: the most probable path of the odometry that starts and ends where the smoother says.

Between two measured instants only odometry speaks. Dead reckoning from both ends, each weighted by how uncertain it
is by then, is the exact posterior of the linearised chain: a pose in the middle of a blind stretch follows the
odometry's shape, shares out its closing error in proportion to the noise that was collected, and carries a covariance
that swells in the middle.
"""

from __future__ import annotations

import numpy as np

from evermap import se2
from evermap.slam.kernels import integrate_odometry, kernel, wrapped
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
    """Poses and covariances at any stamps, given the smoothed ones.

    Args:
        stamp_s: (K,) where poses are wanted; before the first and after the last pose it is dead reckoning.
        pose_stamp_s: (N,) instants of the smoothed poses.
        pose: (N, 3) smoothed poses.
        covariance: (N, 3, 3) of each.
        consecutive: (N, 3, 3) of pose i with pose i + 1.
        drive: odometry.
        states: (9,) calibration states.
        noise: odometry noise.

    Returns:
        (K, 3) poses and (K, 3, 3) covariances in the robot's frame.
    """
    n = len(pose_stamp_s)
    segment = np.clip(np.searchsorted(pose_stamp_s, stamp_s, side="right") - 1, -1, n - 1)
    out = np.empty((len(stamp_s), 3))
    spread = np.empty((len(stamp_s), 3, 3))
    increment, noise_increment = np.empty((2, 3)), np.empty((2, 3, 3))
    variance = noise.odometry**2
    for k, i in enumerate(segment):
        before = i >= 0
        after = i < n - 1
        if before:
            _odometry(drive, pose_stamp_s[i], stamp_s[k], states, variance, increment[0], noise_increment[0])
        if after:
            _odometry(drive, stamp_s[k], pose_stamp_s[i + 1], states, variance, increment[1], noise_increment[1])
        if before and after:
            forward = se2.compose(pose[i], increment[0])
            closing = se2.between(se2.compose(forward, increment[1]), pose[i + 1])
            to_end = se2.adjoint(se2.inverse(increment[1]))
            total = to_end @ noise_increment[0] @ to_end.T + noise_increment[1]
            gain = noise_increment[0] @ to_end.T @ np.linalg.inv(total)
            out[k] = se2.compose(forward, gain @ closing)
            # perturbations of the two ends, carried to this instant
            from_start = se2.adjoint(se2.inverse(increment[0]))
            ends = np.hstack([from_start - gain @ to_end @ from_start, gain])
            joint = np.block([[covariance[i], consecutive[i]], [consecutive[i].T, covariance[i + 1]]])
            spread[k] = ends @ joint @ ends.T + noise_increment[0] - gain @ to_end @ noise_increment[0]
        elif before:
            out[k] = se2.compose(pose[i], increment[0])
            carry = se2.adjoint(se2.inverse(increment[0]))
            spread[k] = carry @ covariance[i] @ carry.T + noise_increment[0]
        else:
            out[k] = se2.compose(pose[0], se2.inverse(increment[1]))
            carry = se2.adjoint(increment[1])
            spread[k] = carry @ (covariance[0] + noise_increment[1]) @ carry.T
    return out, 0.5 * (spread + spread.transpose(0, 2, 1))


def dead_reckoned(stamp_s: FloatArray, drive: Drive, states: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Odometry alone from (0, 0, 0) at the first stamp: (K, 3) poses and (K, 3, 3) covariances."""
    out, spread = np.zeros((len(stamp_s), 3)), np.zeros((len(stamp_s), 3, 3))
    _reckon(stamp_s, drive.stamp_s, drive.velocity, drive.unknown, states, noise.odometry**2, out, spread)
    return out, spread


@kernel
def _reckon(
    stamp: FloatArray,
    odometry_stamp: FloatArray,
    velocity: FloatArray,
    unknown: FloatArray,
    states: FloatArray,
    variance: FloatArray,
    out: FloatArray,
    spread: FloatArray,
) -> None:
    increment, motion, noise, floor = np.zeros(3), np.zeros((3, 4)), np.zeros((5, 3, 3)), np.zeros((3, 3))
    carry = np.eye(3)
    for i in range(1, len(stamp)):
        integrate_odometry(
            odometry_stamp, velocity, unknown, stamp[i - 1], stamp[i], states, increment, motion, noise, floor
        )
        c, s = np.cos(out[i - 1, 2]), np.sin(out[i - 1, 2])
        out[i, 0] = out[i - 1, 0] + c * increment[0] - s * increment[1]
        out[i, 1] = out[i - 1, 1] + s * increment[0] + c * increment[1]
        out[i, 2] = wrapped(out[i - 1, 2] + increment[2])
        c, s = np.cos(increment[2]), np.sin(increment[2])
        carry[0, 0], carry[0, 1], carry[0, 2] = c, s, s * increment[0] - c * increment[1]
        carry[1, 0], carry[1, 1], carry[1, 2] = -s, c, c * increment[0] + s * increment[1]
        spread[i] = carry @ spread[i - 1] @ carry.T + floor
        for kind in range(len(variance)):
            spread[i] += variance[kind] * noise[kind]


def _odometry(
    drive: Drive,
    start_s: float,
    stop_s: float,
    states: FloatArray,
    variance: FloatArray,
    increment: FloatArray,
    covariance: FloatArray,
) -> None:
    """Increment and its covariance between two instants, written into the last two arguments."""
    motion, noise = np.empty((3, 4)), np.empty((len(variance), 3, 3))
    integrate_odometry(
        drive.stamp_s, drive.velocity, drive.unknown, start_s, stop_s, states, increment, motion, noise, covariance
    )
    covariance += np.tensordot(variance, noise, 1)
