"""Odometry between poses, integrated once for all uses with the same calibration states.

Between two changes of the calibration, neither the steps of the smoother's poses and landmarks nor its noise levels
change what the odometry says of an interval: increment, derivatives, and covariance for unit noise of every kind
(compare Forster et al. 2017, whose biases are our calibration states).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.estimate.sparse.system import Slices
from evermap.slam.kernels import (
    N_MOTION,
    N_NOISE,
    N_SENSOR,
    integrate_odometry,
    invert_3x3,
    kernel,
    odometry_covariance,
    odometry_residual,
    residual_by_states,
)
from evermap.types import FloatArray

A_SLICE = 500
"""Intervals that are integrated in about a millisecond."""


class Intervals(NamedTuple):
    """Odometry of n intervals; see `kernels.integrate_odometry`.

    Attributes:
        increment: (n, 3) pose at the end seen from the start.
        by_states: (n, 3, 4) its derivatives by delay, scales and slip.
        noise: (n, 5, 3, 3) covariance for unit noise of each kind.
        floor: (n, 3, 3) covariance that is always there.
    """

    increment: FloatArray
    by_states: FloatArray
    noise: FloatArray
    floor: FloatArray


class Preintegration:
    """The last integrated intervals, and their calibration."""

    def __init__(self) -> None:
        self._stamp_s = np.zeros(0)
        self._motion_states = np.zeros(0)
        self._intervals: Intervals | None = None

    def between(
        self, stamp_s: FloatArray, states: FloatArray, odometry: tuple[FloatArray, FloatArray, FloatArray]
    ) -> Slices[Intervals]:
        """Return the intervals between consecutive poses, of instants (N,), for states (11,), in slices.

        `odometry`, stamps (n,), velocities (n, 4) and unknown variance (n,), is the same at every call.
        """
        kept = self._intervals
        if kept is not None and np.array_equal(self._motion_states, states[N_SENSOR:]):
            first = int(np.searchsorted(self._stamp_s, stamp_s[0]))
            if np.array_equal(self._stamp_s[first : first + len(stamp_s)], stamp_s):
                rows = slice(first, first + len(stamp_s) - 1)
                return Intervals(*(part[rows] for part in kept))
        n = len(stamp_s) - 1
        noise = np.empty((n, N_NOISE, 3, 3))
        room = Intervals(np.empty((n, 3)), np.empty((n, 3, N_MOTION)), noise, np.empty((n, 3, 3)))
        for first in range(0, n, A_SLICE):
            _integrate(stamp_s, *odometry, states, room, first, min(first + A_SLICE, n))
            yield min(A_SLICE, n - first) / A_SLICE
        self._stamp_s, self._motion_states, self._intervals = stamp_s.copy(), states[N_SENSOR:].copy(), room
        return room


@kernel
def _integrate(
    stamp: FloatArray, odometry_stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, states: FloatArray,
    out: Intervals, first: int, last: int,
) -> None:  # fmt: skip
    for i in range(first, last):
        integrate_odometry(
            odometry_stamp, velocity, unknown, stamp[i], stamp[i + 1], states, out.increment[i], out.by_states[i],
            out.noise[i], out.floor[i],
        )  # fmt: skip


@kernel
def linearise_interval(
    intervals: Intervals, i: int, pose: FloatArray, variance: FloatArray, free: Any, residual: FloatArray,
    jacobian: FloatArray, information: FloatArray,
) -> None:  # fmt: skip
    """Linearise the odometry of interval `i` at poses `i` and `i + 1` of (N, 3), by the `free` (11,) states.

    Filled in are `residual` (3,) of `kernels.odometry_residual`, its derivatives (3, 10) by both poses and by delay,
    scales and slip, and the information (3, 3) of noise with a variance (5,) of each kind.
    """
    odometry_covariance(intervals.noise[i], intervals.floor[i], variance, information)
    invert_3x3(information, information)
    odometry_residual(pose[i], pose[i + 1], intervals.increment[i], residual, jacobian[:, :3], jacobian[:, 3:6])
    for a in range(3):
        for k in range(N_MOTION):
            jacobian[a, 6 + k] = intervals.by_states[i, a, k]
    residual_by_states(jacobian[:, 6:], residual, free)
