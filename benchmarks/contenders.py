"""The same work by evermap and by plain gtsam calls: built-in factors, no calibration states, no noise learning."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from benchmarks.world import World
from evermap.geometry import se2
from evermap.slam.planar_filter import PlanarMotion
from evermap.slam.problem import Estimate
from evermap.slam.smoother import Smoother
from evermap.types import FloatArray
from evermap_studies.peers.isam import RELINEARIZE_SKIP, RELINEARIZE_THRESHOLD, IncrementalSmoother

CAUCHY_SCALE = 3.0
"""Of evermap's heavy-tailed kernel; gtsam's Cauchy loss with it weighs a detection alike."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What a contender found and how long it took.

    Attributes:
        pose: (N, 3); landmark: (L, 2), nan where never seen.
        pose_covariance: (N, 3, 3), empty for the streaming contenders.
        elapsed_s: wall time of the work, without preparing the input and without reading the answer out.
    """

    pose: FloatArray
    landmark: FloatArray
    pose_covariance: FloatArray
    elapsed_s: float


def stream_evermap(world: World) -> Answer:
    """`IncrementalSmoother`, frame after frame, calibration states included if the world's problem frees them."""
    smoother = IncrementalSmoother(world.problem, world.noise)
    landmark = _first_sightings(world)
    start = time.perf_counter()
    pose, motion = np.zeros(3), None
    for row in range(len(world.pose)):
        if row > 0:
            motion = PlanarMotion(world.increment[row - 1], np.zeros((3, 4)), np.zeros((3, 3)))
            pose = se2.compose(smoother.last_pose(), motion.increment)
        smoother.add(row, motion, _placed(landmark, world, row, pose))
    elapsed_s = time.perf_counter() - start
    estimate = smoother.estimate()
    return Answer(estimate.pose, estimate.landmark, np.zeros((0, 3, 3)), elapsed_s)


def stream_gtsam(world: World) -> Answer:
    """`gtsam.ISAM2` with the same parameters and one factor a measurement."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(RELINEARIZE_THRESHOLD)
    parameters.relinearizeSkip = RELINEARIZE_SKIP
    isam = gtsam.ISAM2(parameters)
    rows, detection_noise = _rows_of_poses(world), _detection_noise(world)
    landmark, known = _first_sightings(world), set()
    start = time.perf_counter()
    pose = np.zeros(3)
    for row in range(len(world.pose)):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if row > 0:
            last = isam.calculateEstimatePose2(_x(row - 1))
            pose = se2.compose([last.x(), last.y(), last.theta()], world.increment[row - 1])
        values.insert(_x(row), gtsam.Pose2(*pose))
        placed = _placed(landmark, world, row, pose)
        for j in world.problem.landmark_row[rows[row] : rows[row + 1]].tolist():
            if j not in known:
                known.add(j)
                values.insert(_l(j), placed[j])
        _add_factors(graph, world, row, rows, detection_noise)
        isam.update(graph, values)
    elapsed_s = time.perf_counter() - start
    return _read_out(isam.calculateBestEstimate(), world, known, np.zeros((0, 3, 3)), elapsed_s)


def batch_evermap(world: World) -> Answer:
    """`Smoother`: optimum and all marginals."""
    begin = _batch_start(world)
    start = time.perf_counter()
    smoother = Smoother(world.problem, world.noise, heavy=True)
    estimate = smoother.optimum(begin)
    spread = smoother.marginals(estimate).pose  # worked out here, with all others that fronts hold
    elapsed_s = time.perf_counter() - start
    return Answer(estimate.pose, estimate.landmark, spread, elapsed_s)


def batch_gtsam(world: World) -> Answer:
    """`LevenbergMarquardtOptimizer`, then `Marginals` of every pose and landmark."""
    begin = _batch_start(world)
    known = np.flatnonzero(begin.known)
    rows, detection_noise = _rows_of_poses(world), _detection_noise(world)
    start = time.perf_counter()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for row in range(len(world.pose)):
        values.insert(_x(row), gtsam.Pose2(*begin.pose[row]))
        _add_factors(graph, world, row, rows, detection_noise)
    for j in known.tolist():
        values.insert(_l(j), begin.landmark[j])
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, optimum)
    covariance = np.array([marginals.marginalCovariance(_x(row)) for row in range(len(world.pose))])
    for j in known.tolist():
        marginals.marginalCovariance(_l(j))
    elapsed_s = time.perf_counter() - start
    return _read_out(optimum, world, set(known.tolist()), covariance, elapsed_s)


CONTENDERS: dict[str, tuple[Callable[[World], Answer], Callable[[World], Answer]]] = {
    "isam2": (stream_evermap, stream_gtsam),
    "batch": (batch_evermap, batch_gtsam),
}
"""Name of a race: evermap, then plain gtsam."""


def _x(row: int) -> int:
    return int(gtsam.symbol("x", row))


def _l(row: int) -> int:
    return int(gtsam.symbol("l", row))


def _rows_of_poses(world: World) -> FloatArray:
    """(N + 1,) first detection of every pose."""
    return np.searchsorted(world.problem.pose_row, np.arange(len(world.pose) + 1))


def _detection_noise(world: World) -> Any:
    sigma_range, sigma_bearing = world.noise.detection
    diagonal = gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma_bearing, sigma_range]))
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SCALE), diagonal)


def _add_factors(graph: Any, world: World, row: int, rows: FloatArray, detection_noise: Any) -> None:
    problem = world.problem
    if row == 0:
        held = gtsam.noiseModel.Isotropic.Precision(3, problem.start_information)
        graph.add(gtsam.PriorFactorPose2(_x(0), gtsam.Pose2(0.0, 0.0, 0.0), held))
    else:
        noise = gtsam.noiseModel.Gaussian.Covariance(world.covariance[row - 1])
        graph.add(gtsam.BetweenFactorPose2(_x(row - 1), _x(row), gtsam.Pose2(*world.increment[row - 1]), noise))
    for m in range(rows[row], rows[row + 1]):
        distance, bearing = problem.reading[m]
        at = _l(int(problem.landmark_row[m]))
        graph.add(gtsam.BearingRangeFactor2D(_x(row), at, gtsam.Rot2(bearing), distance, detection_noise))


def _first_sightings(world: World) -> FloatArray:
    """(L, 3): pose row, range and bearing of every landmark's first sighting."""
    first = np.full((len(world.landmark), 3), np.nan)
    for m in range(len(world.problem.pose_row) - 1, -1, -1):
        first[world.problem.landmark_row[m]] = (world.problem.pose_row[m], *world.problem.reading[m])
    return first


def _placed(first: FloatArray, world: World, row: int, pose: FloatArray) -> FloatArray:
    """(L, 2) where the landmarks that are first seen at this pose must be; nan for the others."""
    position = np.full((len(world.landmark), 2), np.nan)
    for j in np.flatnonzero(first[:, 0] == row):
        _, distance, bearing = first[j]
        position[j] = se2.transform(pose, distance * np.array([np.cos(bearing), np.sin(bearing)]))
    return position


def _batch_start(world: World) -> Estimate:
    """Near enough to the truth that both find the same optimum, far enough that both have to work."""
    rng = np.random.default_rng(1)
    pose = se2.compose(world.pose, rng.normal(size=world.pose.shape) * [0.05, 0.05, 0.02])
    pose[0] = 0.0
    landmark = world.landmark + 0.1 * rng.normal(size=world.landmark.shape)
    return Estimate(pose, landmark, world.problem.prior.mean.copy())


def _read_out(values: Any, world: World, known: set[int], covariance: FloatArray, elapsed_s: float) -> Answer:
    pose = np.empty_like(world.pose)
    for row in range(len(pose)):
        at = values.atPose2(_x(row))
        pose[row] = at.x(), at.y(), at.theta()
    landmark = np.full_like(world.landmark, np.nan)
    for j in known:
        landmark[j] = values.atPoint2(_l(j))
    return Answer(pose, landmark, covariance, elapsed_s)
