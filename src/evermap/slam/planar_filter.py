"""The local filter in the plane: readings of range and bearing, what a turn does to points, the filter of a session.

Three drive it: the stream (`SessionFilter`), the association of detections without identities, and the localisation in
a fixed map.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from evermap.estimate.robust import HEAVY_TAIL
from evermap.geometry.group import PLANE
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.filter_kernels import vectorised
from evermap.slam.kernels import (
    AT_PLACES,
    N_MOTION,
    N_NOISE,
    N_SENSOR,
    N_STATES,
    adjoint,
    composed,
    detection_residual,
    integrate_odometry,
    inverted,
    kernel,
    odometry_covariance,
    wrapped,
)
from evermap.slam.local_filter import BELIEVED, HEAVY, LocalFilter, Motion
from evermap.slam.nearby_places import MOST_ACTIVE, NO_PLACES, grown
from evermap.slam.problem import Drive, Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import BoolArray, FloatArray, IntArray

BY_PLACE, WIDTH = 3 + N_SENSOR, 3 + N_SENSOR + 2
"""In what a detection depends on: where its place begins, and all; the states of the odometry are not among it."""
SMALL_TURN = 1e-6
"""Angle (rad) below which an arc is its second-order series."""
ROOM_SHARE = 0.75
"""Of the places that there is room for, those that a restart brings in at most."""


class PlanarMotion(Motion):
    """Odometry between two poses in the plane; derivatives (3, 4) by delay, scales and slip are zero where not free."""

    __slots__ = ()

    @classmethod
    def between(cls, problem: Problem, noise: Noise, row: int, states: FloatArray) -> PlanarMotion:
        """Return from pose `row - 1` to pose `row`."""
        start_s, stop_s = problem.stamp_s[row - 1 : row + 1]
        return cls.over(problem.drive, start_s, stop_s, states, problem.prior.free, noise)

    @classmethod
    def over(
        cls, drive: Drive, start_s: float, stop_s: float, states: FloatArray, free: BoolArray, noise: Noise
    ) -> PlanarMotion:
        """Return between two instants, with (11,) calibration states of which some are `free`."""
        odometry = drive.stamp_s, drive.velocity, drive.unknown
        return cls(*driven(*odometry, start_s, stop_s, states, free, noise.odometry))


class FrameReadings(NamedTuple):
    """Detections in the plane: (M, 2) range and bearing, and (M, 2) standard deviations."""

    reading: FloatArray
    sigma: FloatArray


class PlanarFilter(LocalFilter):
    """The newest pose (3,), the 11 calibration states and the places (2,) around; detections are `FrameReadings`."""

    def __init__(
        self, mount: FloatArray, prior: CalibrationPrior, *, most: int = MOST_ACTIVE, considered: bool = False
    ) -> None:
        variance = (prior.sigma * prior.free) ** 2
        super().__init__(PLANE, prior.mean.copy(), variance, 2, 2, most=most, considered=considered)
        self._mount, self._free = mount, prior.free

    def begin(self, estimate: Estimate, marginals: Marginals, pose_row: int, rows: IntArray) -> None:
        """Begin anew at a pose of a batch solution, with some of its places; the others are taken from there."""
        joint = marginals.joint(rows, poses=np.array([pose_row]), states=True)
        end = 3 + 2 * len(rows)
        order = np.concatenate([np.arange(3), end + np.arange(N_STATES), np.arange(3, end)])
        covariance = joint[np.ix_(order, order)]
        self.hold(estimate.pose[pose_row], estimate.states, covariance, rows, estimate.landmark.copy())
        self.lean_on(estimate.landmark, marginals.joint)

    def _move_pose(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        return drive(self.pose, motion.increment)

    def _sight_frame(self, rows: IntArray, seen: FrameReadings) -> _PlanarFrame:
        return _PlanarFrame(self, rows, seen)

    def _carry(self, step: FloatArray) -> None:
        carry(self.pose, self.position, self._row, self.covariance, step)


class _PlanarFrame:
    """Ranges and bearings of places (M,): a `SightedFrame`."""

    def __init__(self, of: PlanarFilter, rows: IntArray, seen: FrameReadings) -> None:
        count, self._seen = len(rows), seen
        self._start, self._sensor = (of.pose, of.states, of.position[rows]), (of._mount, of._free)
        self.residual, self.jacobian = np.zeros((count, 2)), np.zeros((count, 2, WIDTH))
        self.column, self.n_rows, self.tail = columns_of(count), np.full(count, 2), np.full(count, HEAVY_TAIL)

    def linearise(self, step: FloatArray) -> None:
        """Fill in residuals and derivatives at a step (14 + 2 M,)."""
        linearise_readings(*self._start, step, *self._seen, *self._sensor, self.residual, self.jacobian)


class SessionFilter(PlanarFilter):
    """The filter of a `Problem`: its newest pose, with its places and priors; if `robust`, with the Cauchy's tails.

    Rows of the problem beyond those added are not looked at. It may be exchanged between two steps for one whose coming
    detections belong to other places, or that has more frames or places at the end; what was added before stays as it
    was until `restart`.
    """

    def __init__(self, problem: Problem, noise: Noise, *, robust: bool = True, most: int = MOST_ACTIVE) -> None:
        super().__init__(problem.mount, problem.prior, most=most)
        self.problem = problem
        self._robust, self._noise = robust, noise
        self.covariance[:3, :3] = np.eye(3) / problem.start_information
        self.hold(problem.start_pose, self.states, self.covariance, NO_PLACES, self.position)
        self._old_pose = np.zeros((0, 3))
        self._new_pose: list[FloatArray] = []

    def restart(self, estimate: Estimate, noise: Noise, problem: Problem, marginals: Marginals | None = None) -> None:
        """Restart at `estimate`, an optimum of the first poses and all places that they saw.

        From here on with other noise, other places or other priors; `marginals` where they are known already.
        """
        self.problem, self._noise, self._free = problem, noise, problem.prior.free
        n = len(estimate.pose)
        room = max(int(ROOM_SHARE * self._most), len(np.unique(problem.landmark_row[problem.detections_of(n - 1)])))
        if marginals is None:
            marginals = Smoother(problem.until(n), noise, heavy=True, robust=self._robust).marginals(estimate)
        recent = problem.landmark_row[: np.searchsorted(problem.pose_row, n)][::-1]
        seen, first = np.unique(recent[: 50 * self._most], return_index=True)
        rows = seen[np.argsort(first, kind="stable")][:room]
        if np.count_nonzero(estimate.known) <= room:
            rows = np.flatnonzero(estimate.known)
        self.begin(estimate, marginals, n - 1, rows[estimate.known[rows]])
        self._old_pose, self._new_pose = estimate.pose[:-1], [self.pose.copy()]

    def motion(self, row: int) -> PlanarMotion:
        """Return odometry from the previous pose to pose `row`, with the present states."""
        return PlanarMotion.between(self.problem, self._noise, row, self.states)

    def distances(self, detections: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Compare detections (k,) of the newest pose, before they are used, with known places (k,).

        Returns:
            (k,) squared Mahalanobis distances with `S = H P H' + R`, and (k,) `log |S|`.
        """
        self.bring(places)
        seen = self._readings(detections)
        nis, log_det, _ = self.compare(places, seen)
        return nis, log_det + 2.0 * np.log(seen.sigma).sum(axis=1)

    def add(self, row: int, landmark: FloatArray) -> None:
        """Add the detections of pose `row`, one more than the last, to which the filter was driven.

        Places that are seen for the first time are at `landmark` (L, 2).
        """
        detections = self.problem.detections_of(row)
        rows = self.problem.landmark_row[detections]
        self.know_of(len(self.problem.landmark_mean))
        new = np.isnan(self.position[rows, 0])
        if np.count_nonzero(new):
            self.bring(rows[~new])
            for j in dict.fromkeys(rows[new].tolist()):
                self._meet(j, landmark)
        else:
            self.bring(rows)
        self.update(rows, self._readings(detections), weighing=HEAVY if self._robust else BELIEVED)
        self._new_pose.append(self.pose.copy())

    def estimate(self) -> Estimate:
        """Return values of everything so far; poses since the last restart as they were when they were added."""
        landmark = grown(self.position, len(self.problem.landmark_mean)).copy()
        return Estimate(np.vstack([self._old_pose, *self._new_pose]), landmark, self.states.copy())

    def _readings(self, detections: IntArray) -> FrameReadings:
        sigma = self._noise.of_detections(self.problem.sigma_given[detections])
        return FrameReadings(self.problem.reading[detections], sigma)

    def _meet(self, row: int, landmark: FloatArray) -> None:
        """Put a place that is seen for the first time at its prior, given those in the covariance, or at `landmark`."""
        problem, active = self.problem, np.zeros(len(self.problem.landmark_mean), dtype=bool)
        active[self.active] = True
        prior = problem.conditional_prior(row, active)
        if prior.information.any():
            place = prior.place(self.position, problem.landmark_mean)
            self.meet(row, place, np.asarray(np.linalg.inv(prior.information)), prior.given, prior.gain)
        else:
            self.meet(row, landmark[row])


@kernel
def along_turn(x: float, y: float, turn: float) -> tuple[float, float]:
    """Return the chord (2,) of an arc that begins in the direction of, and is as long as, (x, y), and turns by `turn`.

    `V(turn) (x, y)` of the exponential of SE(2).
    """
    if abs(turn) < SMALL_TURN:
        return x - 0.5 * turn * y, y + 0.5 * turn * x
    s, c = math.sin(turn) / turn, (1.0 - math.cos(turn)) / turn
    return s * x - c * y, c * x + s * y


@kernel
def linearise_readings(
    pose: FloatArray, states: FloatArray, place: FloatArray, step: FloatArray, reading: FloatArray, sigma: FloatArray,
    mount: FloatArray, free: Any, residual: FloatArray, jacobian: FloatArray,
) -> None:  # fmt: skip
    """Compute whitened residuals (M, 2) at a step, and derivatives (M, 2, 12) by the errors before it.

    Args:
        pose: (3,) before the step.
        states: (11,) before it.
        place: (M, 2) before it.
        step: (14 + 2 M,) of these.
        reading: (M, 2) range and bearing.
        sigma: (M, 2) their noise.
        mount: (3,) pose of the sensor on the robot.
        free: (11,) which calibration states are estimated.
        residual: filled in.
        jacobian: filled in, by pose, states of the sensor, and place.
    """
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    moved, now, at = pose.copy(), states + step[3:AT_PLACES], np.zeros(2)
    move(moved, step)
    c, s = math.cos(pose[2] - moved[2]), math.sin(pose[2] - moved[2])
    for m in range(len(reading)):
        dx, dy = along_turn(step[AT_PLACES + 2 * m], step[AT_PLACES + 2 * m + 1], step[2])
        at[0], at[1] = place[m, 0] + dx, place[m, 1] + dy
        x, y = dx - moved[0] + pose[0], dy - moved[1] + pose[1]
        detection_residual(moved, at, now, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        for k in range(2):
            scale, by = 1.0 / sigma[m, k], jacobian[m, k]
            residual[m, k] = scale * e[k]
            by[0] = scale * (c * jx[k, 0] + s * jx[k, 1])
            by[1] = scale * (-s * jx[k, 0] + c * jx[k, 1])
            by[2] = scale * (jx[k, 2] + x * jl[k, 1] - y * jl[k, 0])
            for a in range(N_SENSOR):
                by[3 + a] = scale * jc[k, a] if free[a] else 0.0
            by[BY_PLACE], by[BY_PLACE + 1] = scale * jl[k, 0], scale * jl[k, 1]


@kernel
def columns_of(count: int) -> IntArray:
    """Return (M, 12) the numbers that readings depend on, of pose, calibration and a place each."""
    column = np.empty((count, WIDTH), dtype=np.int64)
    for m in range(count):
        for a in range(WIDTH):
            column[m, a] = a if a < BY_PLACE else AT_PLACES + 2 * m + a - BY_PLACE
    return column


@kernel
def drive(pose: FloatArray, increment: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pose after a motion, and the derivatives (3, 3) of its error by that of the pose before."""
    moved = composed(pose, increment)
    moved[2] = wrapped(moved[2])
    return moved, adjoint(inverted(increment))


@kernel
def move(pose: FloatArray, step: FloatArray) -> None:
    """Move a pose by a twist in its own frame, the first numbers of a step, in place."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = along_turn(c * step[0] - s * step[1], s * step[0] + c * step[1], step[2])
    pose[0], pose[1], pose[2] = pose[0] + x, pose[1] + y, wrapped(pose[2] + step[2])


@kernel
def driven(
    stamp: FloatArray, velocity: FloatArray, unknown: FloatArray, start_s: float, stop_s: float, states: FloatArray,
    free: Any, sigma: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return increment, derivatives by free states, and covariance of the motion between two instants: `Motion`."""
    increment, by_states = np.zeros(3), np.zeros((3, N_MOTION))
    kinds, covariance = np.zeros((N_NOISE, 3, 3)), np.zeros((3, 3))
    integrate_odometry(stamp, velocity, unknown, start_s, stop_s, states, increment, by_states, kinds, covariance)
    odometry_covariance(kinds, covariance, sigma**2, covariance)
    for k in range(N_MOTION):
        if not free[N_SENSOR + k]:
            by_states[:, k] = 0.0
    return increment, by_states, covariance


@kernel
def told(
    pose: FloatArray, covariance: FloatArray, front: FloatArray, scale: float, in_map: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the pose (3,) of the robot's front in metres, and its covariance (3, 3), in its own frame.

    The pose of the state is the first in its covariance, `front` (3,) is seen from it, `scale` are metres in a unit of
    the state. The frame is that of the poses in a map, else that of the front at the first of them.
    """
    seen, back = composed(pose, front), inverted(front)
    if not in_map:
        seen = composed(back, seen)
    carry = adjoint(back)
    spread = carry @ covariance[:3, :3].copy() @ carry.T
    for k in range(2):
        seen[k] *= scale
        spread[k] *= scale
        spread[:, k] *= scale
    seen[2] = wrapped(seen[2])
    return seen, spread


@kernel
def carry(pose: FloatArray, position: FloatArray, row: Any, covariance: FloatArray, step: FloatArray) -> None:
    """Move pose and places by a step, as `LocalFilter._carry`, and re-express the covariance there, all in place.

    Args:
        pose: (3,) in and out.
        position: (L, 2) in and out, of all places.
        row: (K,) which of them is in each slot, negative in a free one.
        covariance: in and out.
        step: of pose, calibration and slots, or without the slots.
    """
    lever, before = np.zeros(len(step)), pose.copy()
    move(pose, step)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] - before[0], pose[1] - before[1]
    lever[0], lever[1] = s * x - c * y, c * x + s * y
    for k in range((len(step) - AT_PLACES) // 2):
        if row[k] >= 0:
            x, y = along_turn(step[AT_PLACES + 2 * k], step[AT_PLACES + 2 * k + 1], step[2])
            position[row[k], 0], position[row[k], 1] = position[row[k], 0] + x, position[row[k], 1] + y
            lever[AT_PLACES + 2 * k], lever[AT_PLACES + 2 * k + 1] = -y, x
    _turn_on(covariance, step[2], lever)


@vectorised
def _turn_on(covariance: FloatArray, turned: float, lever: FloatArray) -> None:
    """Re-express a covariance at the corrected state: of the pose in its own frame, which has turned, and of everything
    that has moved, by `lever` times the error of the heading.
    """
    c, s, heading = math.cos(turned), math.sin(turned), covariance[2].copy()
    for k in range(len(covariance)):
        x, y = covariance[0, k], covariance[1, k]
        covariance[0, k], covariance[1, k] = c * x + s * y, c * y - s * x
    for k in range(len(covariance)):
        x, y = covariance[k, 0], covariance[k, 1]
        covariance[k, 0], covariance[k, 1] = c * x + s * y, c * y - s * x
    x, y = heading[0], heading[1]
    heading[0], heading[1] = c * x + s * y, c * y - s * x
    for i in range(len(covariance)):
        mine = covariance[i]
        for k in range(len(covariance) if i < len(lever) else 0):
            mine[k] += lever[i] * heading[k]
        by = mine[2]
        for k in range(len(lever)):
            mine[k] += by * lever[k]
