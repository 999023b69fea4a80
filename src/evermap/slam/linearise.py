"""Odometry, detections and priors in the plane as blocks of factors."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from evermap.estimate.graph import Room
from evermap.estimate.robust import weigh
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se2
from evermap.slam.kernels import N_MOTION, N_SENSOR, detection_residual, kernel
from evermap.slam.preintegration import Intervals, linearise_interval
from evermap.slam.problem import Estimate, Problem, between_rows
from evermap.types import BoolArray, FloatArray, IntArray

OF_INTERVAL, OF_DETECTION = 3 + 3 + N_MOTION + 1, 3 + 2 + N_SENSOR + 1
"""Numbers of a row: by two poses and the states of the odometry, by pose, place and the states of the sensor; and the
right side."""
ODOMETRY, DETECTION = 3 * OF_INTERVAL, 2 * OF_DETECTION
"""Numbers of one factor, of three rows and of two."""
INTERVALS_A_SLICE, DETECTIONS_A_SLICE = 1000, 2000
"""Factors that are linearised in about a millisecond."""


class Readings(NamedTuple):
    """Detections as the kernel reads them: (M,) rows of pose and place, (M, 2) readings and sigmas, (M,) shares of
    information that is new; (3,) mount.

    `free` (11,) are the calibration states that are estimated; `log_odds` and `tail` as for `robust.weigh`.
    """

    pose_row: IntArray
    place: IntArray
    reading: FloatArray
    sigma: FloatArray
    share: FloatArray
    mount: FloatArray
    free: BoolArray
    log_odds: float
    tail: float


@kernel
def root_of(information: FloatArray, root: FloatArray) -> None:
    """Compute the upper triangular root of `information = root' root`, (3, 3); what is below stays as it is."""
    for a in range(3):
        for b in range(a, 3):
            total = information[a, b]
            for k in range(a):
                total -= root[k, a] * root[k, b]
            root[a, b] = math.sqrt(total) if a == b else total / root[a, a]


@kernel
def linearise_odometry(
    pose: FloatArray, driven: Intervals, variance: FloatArray, free: Any, values: FloatArray, begin: int, end: int,
    cost: float,
) -> float:  # fmt: skip
    """Linearise the odometry from poses `begin` to `end - 1` of (N, 3), by the `free` (11,) calibration states.

    `variance` (5,) is that of each kind of noise. Filled in are `values`, those of a factor for each interval. Returns
    the negative log likelihood, up to a constant, added to `cost`, that of the intervals before: a sum in one order,
    however it is cut.
    """
    at = ODOMETRY * begin
    information, e, root = np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    j = np.zeros((3, OF_INTERVAL - 1))
    for i in range(begin, end):
        linearise_interval(driven, i, pose, variance, free, e, j, information)
        root_of(information, root)
        for a in range(3):
            for b in range(OF_INTERVAL - 1):
                total = 0.0
                for k in range(a, 3):
                    total += root[a, k] * j[k, b]
                values[at + b] = total
            total = 0.0
            for k in range(a, 3):
                total += root[a, k] * e[k]
            values[at + OF_INTERVAL - 1] = -total
            cost += 0.5 * total * total
            at += OF_INTERVAL
    return cost


@kernel
def linearise_detections(
    pose: FloatArray, place: FloatArray, states: FloatArray, seen: Readings, values: FloatArray, weight: FloatArray,
    first: int, last: int, cost: float,
) -> float:  # fmt: skip
    """Linearise the detections from `first` to `last - 1` at poses (N, 3), places (P, 2) and states (11,).

    Filled in are `values`, those of a factor for each detection, and inlier weights (M,). Returns the negative log
    likelihood, up to a constant, added to `cost`, that of the detections before.
    """
    at = DETECTION * first
    z, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(first, last):
        detection_residual(
            pose[seen.pose_row[m]], place[seen.place[m]], states, seen.mount, seen.reading[m, 0], seen.reading[m, 1],
            z, jx, jl, jc,
        )  # fmt: skip
        squared = (z[0] / seen.sigma[m, 0]) ** 2 + (z[1] / seen.sigma[m, 1]) ** 2
        weight[m], loss = weigh(squared, seen.log_odds, seen.tail, 0.0)
        cost += seen.share[m] * loss
        for row in range(2):
            scale = math.sqrt(weight[m] * seen.share[m]) / seen.sigma[m, row]
            for a in range(3):
                values[at + a] = scale * jx[row, a]
            for a in range(2):
                values[at + 3 + a] = scale * jl[row, a]
            for a in range(N_SENSOR):
                values[at + 5 + a] = scale * jc[row, a] if seen.free[a] else 0.0
            values[at + OF_DETECTION - 1] = -scale * z[row]
            at += OF_DETECTION
    return cost


class OdometryFactors(NamedTuple):
    """Odometry between consecutive poses, with its calibration states.

    Attributes:
        problem: the drive, and which states are free.
        variance: (5,) of each kind of noise.
        states: the variable of the motion states.
    """

    problem: Problem
    variance: FloatArray
    states: int

    @property
    def ties(self) -> IntArray:
        """Return (N - 1, 3) two poses and the motion states."""
        step = self.pose
        return np.column_stack([step, step + 1, np.full(len(step), self.states)])

    @property
    def rows(self) -> IntArray:
        """Return (N - 1,) threes."""
        return np.full(len(self.problem.stamp_s) - 1, 3)

    @property
    def pose(self) -> IntArray:
        """Return (N - 1,) the first pose of each interval."""
        return np.arange(len(self.problem.stamp_s) - 1)

    def linearise(self, state: Estimate, out: Room) -> Slices[float]:
        """Fill in `linearise_odometry`; no interval is an outlier."""
        problem, cost, count = self.problem, 0.0, len(out.weights)
        driven = yield from problem.drive.in_slices(problem.stamp_s, state.states)
        for begin in range(0, count, INTERVALS_A_SLICE):
            end = min(begin + INTERVALS_A_SLICE, count)
            cost = linearise_odometry(
                state.pose, driven, self.variance, problem.prior.free, out.values, begin, end, cost
            )
            yield (end - begin) / INTERVALS_A_SLICE
        return cost


class DetectionFactors(NamedTuple):
    """Ranges and bearings of places, with the calibration states of the sensor.

    Attributes:
        seen: the readings, by known places.
        known: (L,) places that have a position; these are the variables.
        places: the variable of the first of them.
        states: the variable of the sensor states.
    """

    seen: Readings
    known: BoolArray
    places: int
    states: int

    @property
    def ties(self) -> IntArray:
        """Return (M, 3) pose, place and sensor states."""
        return np.column_stack([self.pose, self.places + self.seen.place, np.full(len(self.pose), self.states)])

    @property
    def rows(self) -> IntArray:
        """Return (M,) twos."""
        return np.full(len(self.pose), 2)

    @property
    def pose(self) -> IntArray:
        """Return (M,) the poses that saw them."""
        return self.seen.pose_row

    def linearise(self, state: Estimate, out: Room) -> Slices[float]:
        """Fill in `linearise_detections`."""
        place, cost, count = state.landmark[self.known], 0.0, len(out.weights)
        for first in range(0, count, DETECTIONS_A_SLICE):
            last = min(first + DETECTIONS_A_SLICE, count)
            cost = linearise_detections(
                state.pose, place, state.states, self.seen, out.values, out.weights, first, last, cost
            )
            yield (last - first) / DETECTIONS_A_SLICE
        return cost


def deviate(mean: FloatArray, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far a pose (3,) is off another (3,), in its own axes; its derivative (3, 3) by a step, near there."""
    off = np.array(se2.between(mean, pose))
    off[:2] = se2.rotation(-pose[2]) @ (pose[:2] - mean[:2])
    return off, np.eye(3)


class PlacePriors(NamedTuple):
    """What a map says about places, so many of them together in each factor.

    Attributes:
        ties: (F, k) variables of the places.
        pose: (F,) the pose that saw each first; -1 of several places.
        place: (F, k) their rows.
        root: (F, r, 2 k) square roots of the information.
        mean: (F, 2 k) prior positions.
    """

    ties: IntArray
    pose: IntArray
    place: IntArray
    root: FloatArray
    mean: FloatArray

    @property
    def rows(self) -> IntArray:
        """Return (F,) the rank of what is known."""
        return np.full(len(self.root), self.root.shape[1])

    def linearise(self, state: Estimate, out: Room) -> Slices[float]:
        """Fill in linear factors."""
        off = state.landmark[self.place].reshape(self.mean.shape) - self.mean
        pull = -np.einsum("frk,fk->fr", self.root, off)
        out.values[:] = np.concatenate([self.root, pull[..., None]], axis=2).ravel()
        yield from ()
        return 0.5 * float(np.sum(pull**2))


def build_place_priors(problem: Problem, known: BoolArray, places: int) -> tuple[PlacePriors, ...]:
    """Return what the prior says about `known` landmarks, whose variables begin at `places`.

    Landmarks that it ties to each other are one factor; those of as many landmarks and the same rank are one block.
    """
    if not problem.landmark_information.nnz:
        return ()
    information = problem.prior_information(known)
    row: IntArray = np.flatnonzero(known)
    at, to = information.nonzero()
    given = np.unique(at // 2)
    if not len(given):
        return ()
    ties = sparse.csr_array((np.ones(len(at)), (at // 2, to // 2)), shape=(len(row), len(row)))
    _, group = connected_components(ties, directed=False)
    given = given[np.argsort(group[given], kind="stable")]
    first_seen = np.full(len(known), -1)
    first_seen[problem.landmark_row[::-1]] = problem.pose_row[::-1]
    found: dict[tuple[int, int], list[tuple[IntArray, FloatArray]]] = {}
    parts = np.split(given, 1 + np.flatnonzero(np.diff(group[given])))
    alone = np.array([part[0] for part in parts if len(part) == 1], dtype=np.int64)
    own = np.zeros((len(alone), 2, 2))
    own[:, 0, 0], own[:, 1, 1] = information.diagonal()[2 * alone], information.diagonal()[2 * alone + 1]
    own[:, 0, 1], own[:, 1, 0] = information.diagonal(1)[2 * alone], information.diagonal(-1)[2 * alone]
    together = [part.astype(np.int64) for part in parts if len(part) > 1]
    tied = (between_rows(information, se2.xy_rows(part)).toarray() for part in together)
    for mine, (size, direction) in (
        *zip(alone[:, None], zip(*np.linalg.eigh(own), strict=True), strict=True),
        *zip(together, map(np.linalg.eigh, tied), strict=True),
    ):
        kept = size > 1e-12 * size[-1]
        root = np.sqrt(size[kept])[:, None] * direction[:, kept].T
        found.setdefault((len(mine), len(root)), []).append((mine, root))
    blocks = []
    for (width, _), factors in found.items():
        members = np.array([mine for mine, _ in factors])
        pose = first_seen[row[members[:, 0]]] if width == 1 else np.full(len(members), -1)
        root = np.array([own for _, own in factors])
        mean = problem.landmark_mean[row[members]].reshape(len(members), -1)
        blocks.append(PlacePriors(places + members, pose, row[members], root, mean))
    return tuple(blocks)


def detection_residuals(problem: Problem, estimate: Estimate) -> FloatArray:
    """Return (M, 2) measured minus predicted range [m] and bearing [rad]."""
    out = np.empty((len(problem.pose_row), 2))
    _detection_residuals(
        estimate.pose, estimate.landmark, estimate.states, problem.pose_row, problem.landmark_row, problem.reading,
        problem.mount, out,
    )  # fmt: skip
    return out


@kernel
def _detection_residuals(
    pose: FloatArray, landmark: FloatArray, states: FloatArray, pose_row: Any, landmark_row: Any, reading: FloatArray,
    mount: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    jx, jl, jc = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, N_SENSOR))
    for m in range(len(pose_row)):
        detection_residual(
            pose[pose_row[m]], landmark[landmark_row[m]], states, mount, reading[m, 0], reading[m, 1], out[m],
            jx, jl, jc,
        )  # fmt: skip
