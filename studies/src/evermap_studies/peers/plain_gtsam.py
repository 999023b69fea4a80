"""Plain gtsam: built-in factors, batch Levenberg-Marquardt with marginals, and iSAM2 frame after frame."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import gtsam
import numpy as np

from evermap.geometry import se2
from evermap.types import FloatArray
from evermap_studies.peers.factors import FIRST_POSE_SIGMA, Factors, PlainEstimate

_POSE, _LANDMARK = gtsam.symbol("x", 0), gtsam.symbol("l", 0)


class Seconds(NamedTuple):
    """Of a step: by the clock on the wall, and of all processors together."""

    wall_s: float
    cpu_s: float


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch solution.

    Attributes:
        estimate: the optimum.
        landmark_covariance: (L, 2, 2) marginals; empty where none were asked for.
        n_iterations: of Levenberg-Marquardt.
        build, solve, marginals: what graph, optimum and marginals took.
    """

    estimate: PlainEstimate
    landmark_covariance: FloatArray
    n_iterations: int
    build: Seconds
    solve: Seconds
    marginals: Seconds


@dataclass(frozen=True, slots=True)
class Stream:
    """iSAM2's final estimate, its causal poses (N, 3), and the (N,) CPU seconds of every frame."""

    estimate: PlainEstimate
    online_pose: FloatArray
    step_s: FloatArray


def graph_of(factors: Factors, *, logarithm: bool = True) -> Any:
    """Return the `gtsam.NonlinearFactorGraph` of all factors; poses are x0, x1 ..., landmarks l0, l1 ...

    Args:
        factors: the measurements.
        logarithm: of the residuals of motions, see `factors.objective`; without it these factors are in Python, slow.
    """
    graph, odometry = gtsam.NonlinearFactorGraph(), _odometry if logarithm else _odometry_by_coordinates
    graph.add(_first_pose())
    for row in range(1, len(factors.stamp_s)):
        graph.add(odometry(factors, row))
    noises = _Noises(factors.sigma)
    for m in range(len(factors.pose_row)):
        graph.add(_detection(factors, m, noises))
    return graph


def values_of(estimate: PlainEstimate) -> Any:
    """Return an estimate as `gtsam.Values`."""
    values = gtsam.Values()
    for row, (x, y, theta) in enumerate(estimate.pose.tolist()):
        values.insert(_POSE + row, gtsam.Pose2(x, y, theta))
    for row, point in enumerate(estimate.landmark):
        values.insert(_LANDMARK + row, point)
    return values


def levenberg_marquardt(
    factors: Factors,
    start: PlainEstimate,
    *,
    tolerance: float = 1e-5,
    marginals: bool = True,
    logarithm: bool = True,
) -> Batch:
    """Return the optimum from `start`, with the marginals of all landmarks.

    Args:
        factors: the problem.
        start: where to begin.
        tolerance: relative and absolute decrease of the error at which it stops (gtsam's default).
        marginals: whether they are wanted.
        logarithm: see `graph_of`.
    """
    at = [_now()]
    graph, values = graph_of(factors, logarithm=logarithm), values_of(start)
    at.append(_now())
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(tolerance)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    optimum = optimizer.optimize()
    at.append(_now())
    count = len(start.landmark) if marginals else 0
    covariance = np.empty((count, 2, 2))
    if marginals:
        found = gtsam.Marginals(graph, optimum)
        for row in range(count):
            covariance[row] = found.marginalCovariance(_LANDMARK + row)
    at.append(_now())
    took = [Seconds(*np.subtract(after, before)) for before, after in pairwise(at)]
    return Batch(
        _read(optimum, len(start.pose), len(start.landmark)),
        covariance,
        int(optimizer.iterations()),
        *took,
    )


def isam2(factors: Factors, *, relinearize_skip: int = 10, relinearize_threshold: float = 0.1) -> Stream:
    """Return what iSAM2 finds frame after frame, each pose begun by odometry, each landmark by its first sighting.

    A frame's time holds its factors, the update, and reading the newest pose.
    """
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(relinearize_threshold)
    parameters.relinearizeSkip = relinearize_skip
    isam, known, noises = gtsam.ISAM2(parameters), set[int](), _Noises(factors.sigma)
    first = factors.first_detection
    online, step_s = np.zeros((len(factors.stamp_s), 3)), np.zeros(len(factors.stamp_s))
    at = gtsam.Pose2()
    for row in range(len(step_s)):
        began = time.thread_time()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if row == 0:
            graph.add(_first_pose())
        else:
            graph.add(_odometry(factors, row))
            at = at.compose(gtsam.Pose2(*factors.increment[row - 1]))
        values.insert(_POSE + row, at)
        for m in range(first[row], first[row + 1]):
            j = int(factors.landmark_row[m])
            if j not in known:
                known.add(j)
                distance, bearing = factors.reading[m]
                seen = at.transformFrom(distance * np.array([np.cos(bearing), np.sin(bearing)]))
                values.insert(_LANDMARK + j, seen)
            graph.add(_detection(factors, m, noises))
        isam.update(graph, values)
        at = isam.calculateEstimatePose2(_POSE + row)
        online[row] = at.x(), at.y(), at.theta()
        step_s[row] = time.thread_time() - began
    return Stream(_read(isam.calculateEstimate(), len(step_s), len(factors.landmark_id)), online, step_s)


class _Noises:
    """One noise model for equal standard deviations: most detections share theirs."""

    def __init__(self, sigma: FloatArray) -> None:
        different, self._row = np.unique(sigma, axis=0, return_inverse=True)
        self._models = [gtsam.noiseModel.Diagonal.Sigmas(pair[::-1]) for pair in different]

    def __getitem__(self, detection: int) -> Any:
        return self._models[self._row[detection]]


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _first_pose() -> Any:
    return gtsam.PriorFactorPose2(_POSE, gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, FIRST_POSE_SIGMA))


def _odometry(factors: Factors, row: int) -> Any:
    """The factor between pose `row` and the one before."""
    noise = gtsam.noiseModel.Gaussian.Covariance(factors.covariance[row - 1])
    return gtsam.BetweenFactorPose2(_POSE + row - 1, _POSE + row, gtsam.Pose2(*factors.increment[row - 1]), noise)


def _odometry_by_coordinates(factors: Factors, row: int) -> Any:
    """The same with the residual (x, y, theta) of the motion left over."""
    noise = gtsam.noiseModel.Gaussian.Covariance(factors.covariance[row - 1])
    increment = gtsam.Pose2(*factors.increment[row - 1])
    back = increment.rotation().matrix().T

    def error(this: Any, values: Any, jacobians: Any) -> FloatArray:
        before, after = (values.atPose2(key) for key in this.keys())  # noqa: SIM118
        between = before.between(after)
        left = increment.between(between)
        if jacobians is not None:
            first, second = -np.eye(3), np.eye(3)
            first[:2, :2] = -back
            first[:2, 2] = back @ [between.y(), -between.x()]
            second[:2, :2] = left.rotation().matrix()
            jacobians[0], jacobians[1] = first, second
        return np.array([left.x(), left.y(), left.theta()])

    return gtsam.CustomFactor(noise, [_POSE + row - 1, _POSE + row], error)


def _detection(factors: Factors, m: int, noises: _Noises) -> Any:
    distance, bearing = factors.reading[m]
    pose, landmark = _POSE + int(factors.pose_row[m]), _LANDMARK + int(factors.landmark_row[m])
    return gtsam.BearingRangeFactor2D(pose, landmark, gtsam.Rot2(bearing), distance, noises[m])


def _read(values: Any, n_poses: int, n_landmarks: int) -> PlainEstimate:
    poses = gtsam.utilities.extractPose2(values)[:n_poses]
    points = gtsam.utilities.extractPoint2(values)[:n_landmarks]
    return PlainEstimate(np.column_stack([poses[:, :2], se2.wrap(poses[:, 2])]), points)
