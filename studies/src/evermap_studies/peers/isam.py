"""Incremental smoothing with iSAM2 (Kaess et al. 2012) through gtsam: one pose and one factor a frame.

The factor of a frame ties its pose to the one before by odometry, to the landmarks it saw, and both to the calibration
states. It whitens itself, because the odometry's noise depends on the states, and down-weights outliers at every
relinearisation (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import cholesky, solve_triangular

from evermap.geometry import se2
from evermap.slam.kernels import N_STATES
from evermap.slam.planar_filter import PlanarMotion
from evermap.slam.problem import ConditionalPrior, Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.types import FloatArray, IntArray
from evermap_studies.peers.whitened import whitened_detections, whitened_odometry

STATES_KEY = gtsam.symbol("c", 0)
KEPT = 100
"""Poses that stay in the tree after a restart; older ones are summed up in one factor."""
RELINEARIZE_SKIP = 10
RELINEARIZE_THRESHOLD = 0.1
"""How far (m, rad, or 1) a value may drift from where it was linearised; the batch smoother takes out the rest."""


def _pose_key(row: int) -> int:
    return int(gtsam.symbol("x", row))


def _landmark_key(row: int) -> int:
    return int(gtsam.symbol("l", row))


class IncrementalSmoother:
    """The incremental solver to compare `planar_filter.SessionFilter` with.

    The tree holds the last poses only. What the older ones say about them, about the landmarks and the states is one
    linear factor, so that a step costs what the map costs, whatever the age of the recording.

    Args:
        problem: the measurements.
        noise: standard deviations.
        robust: down-weight outliers (Cauchy, which never lets go of what may be right after all).
        kept: poses that stay in the tree after a restart.
    """

    def __init__(self, problem: Problem, noise: Noise, *, robust: bool = True, kept: int = KEPT) -> None:
        self.problem = problem
        self._robust, self._kept = robust, kept
        self._noise = noise
        self._first_detection = np.searchsorted(problem.pose_row, np.arange(len(problem.stamp_s) + 1))
        self._isam = gtsam.ISAM2(_parameters())
        self._n_poses = self._first_pose = 0
        self._known: set[int] = set()
        self._older = np.zeros((0, 3))
        self._last_pose = problem.start_pose

    def restart(self, estimate: Estimate, noise: Noise, problem: Problem, marginals: Marginals | None = None) -> None:
        """Throw the tree away and build it anew at `estimate`."""
        del marginals
        self.problem, self._noise = problem, noise
        self._isam = gtsam.ISAM2(_parameters())
        self._older = estimate.pose
        self._n_poses = len(estimate.pose)
        self._first_pose = max(self._n_poses - self._kept, 0)
        self._known = set()
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(STATES_KEY, estimate.states)
        if self._first_pose == 0:
            self._insert_priors(graph)
        else:
            self._insert_summary(graph, values, estimate)
        for row in range(self._first_pose, self._n_poses):
            self._insert_frame(graph, values, row, estimate.pose[row], estimate.landmark)
        self._isam.update(graph, values)
        self._last_pose = self._newest_pose()

    def add(self, row: int, motion: PlanarMotion | None, landmark: FloatArray) -> None:
        """Add pose `row` with its odometry and detections, and update the tree."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if motion is None:
            pose = self._last_pose
            self._insert_priors(graph)
            values.insert(STATES_KEY, self.problem.prior.mean)
        else:
            pose = se2.compose(self._last_pose, motion.increment)
        self._insert_frame(graph, values, row, pose, landmark)
        self._isam.update(graph, values)
        self._n_poses = row + 1
        self._last_pose = self._newest_pose()

    def last_pose(self) -> FloatArray:
        """(3,) the newest pose."""
        return self._last_pose

    def last_covariance(self) -> FloatArray:
        """(3, 3) covariance of the newest pose, in its own frame."""
        return np.asarray(self._isam.marginalCovariance(_pose_key(self._n_poses - 1)))

    def _newest_pose(self) -> FloatArray:
        pose = self._isam.calculateEstimatePose2(_pose_key(self._n_poses - 1))
        return np.array([pose.x(), pose.y(), pose.theta()])

    def states(self) -> FloatArray:
        """(11,) calibration states."""
        if self._n_poses == 0:
            return self.problem.prior.mean
        return np.asarray(self._isam.calculateEstimateVector(STATES_KEY))

    def landmark(self, row: int) -> FloatArray:
        """(2,) position of one landmark; nan where it is not in the graph."""
        if row not in self._known:
            return np.full(2, np.nan)
        return np.asarray(self._isam.calculateEstimatePoint2(_landmark_key(row)))

    def estimate(self) -> Estimate:
        """Values of all that is in the tree, behind the poses that no longer are."""
        values = self._isam.calculateBestEstimate()
        pose = np.empty((self._n_poses, 3))
        pose[: self._first_pose] = self._older[: self._first_pose]
        for row in range(self._first_pose, self._n_poses):
            at = values.atPose2(_pose_key(row))
            pose[row] = at.x(), at.y(), at.theta()
        landmark = np.full((len(self.problem.landmark_mean), 2), np.nan)
        for j in self._known:
            landmark[j] = values.atPoint2(_landmark_key(j))
        return Estimate(pose, landmark, np.asarray(values.atVector(STATES_KEY)))

    def around(self, places: IntArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return the joint covariance of newest pose, calibration states and places; these places; where each is."""
        different, column = np.unique(places, return_inverse=True)
        keys = [_pose_key(self._n_poses - 1), STATES_KEY, *(_landmark_key(int(j)) for j in different)]
        joint = self._isam.jointMarginalCovariance(gtsam.KeyVector(keys))
        place = np.array([self.landmark(int(j)) for j in different]).reshape(-1, 2)
        return np.block([[joint.at(a, b) for b in keys] for a in keys]), place, column

    def _insert_priors(self, graph: Any) -> None:
        problem = self.problem
        prior = problem.prior
        graph.add(gtsam.PriorFactorVector(STATES_KEY, prior.mean, gtsam.noiseModel.Diagonal.Sigmas(prior.sigma)))
        held = gtsam.noiseModel.Isotropic.Precision(3, problem.start_information)
        graph.add(gtsam.PriorFactorPose2(_pose_key(0), gtsam.Pose2(*problem.start_pose), held))

    def _insert_summary(self, graph: Any, values: Any, estimate: Estimate) -> None:
        """One factor for everything before the first pose of the tree, priors included."""
        row = self._first_pose
        before = self.problem.until(row + 1, last_is_blind=True)
        seen = np.zeros(len(estimate.landmark), dtype=bool)
        seen[before.landmark_row] = True
        linearised = Estimate(
            estimate.pose[: row + 1], np.where(seen[:, None], estimate.landmark, np.nan), estimate.states
        )
        smoother = Smoother(before, self._noise, heavy=True, robust=self._robust)
        landmarks = np.flatnonzero(linearised.known)
        for j in landmarks:
            values.insert(_landmark_key(int(j)), estimate.landmark[j])
            self._known.add(int(j))
        information, right = smoother.information(linearised, np.array([row]))
        root = cholesky(information, lower=False)
        summary = root, solve_triangular(root, right, trans="T")
        graph.add(_summary_factor(row, landmarks, linearised, *summary))

    def _insert_frame(self, graph: Any, values: Any, row: int, pose: FloatArray, landmark: FloatArray) -> None:
        problem = self.problem
        values.insert(_pose_key(row), gtsam.Pose2(*pose))
        detections = np.arange(self._first_detection[row], self._first_detection[row + 1])
        for j in dict.fromkeys(problem.landmark_row[detections].tolist()):
            if j in self._known:
                continue
            values.insert(_landmark_key(j), landmark[j])
            # chain rule: the joint prior is the product of each landmark's, given those before it
            known = np.zeros(len(problem.landmark_mean), dtype=bool)
            known[list(self._known)] = True
            prior = problem.conditional_prior(j, known)
            if prior.information.any():
                graph.add(landmark_factor(j, prior, problem.landmark_mean))
            self._known.add(j)
        # the first pose of the tree has no odometry: the summary holds it, or the start does
        before = row > self._first_pose
        if before or len(detections):
            graph.add(frame_factor(problem, self._noise, row, detections, before=before, heavy=self._robust))


def landmark_factor(row: int, prior: ConditionalPrior, landmark_mean: FloatArray) -> Any:
    """The gtsam factor of a landmark's prior, given those that it is tied to."""
    keys = [_landmark_key(row), *(_landmark_key(int(j)) for j in prior.given)]
    noise = gtsam.noiseModel.Gaussian.Information(prior.information)
    if len(keys) == 1:
        return gtsam.PriorFactorPoint2(keys[0], prior.mean, noise)

    def error(_this: Any, values: Any, jacobians: Any) -> FloatArray:
        tied = np.concatenate([values.atPoint2(key) for key in keys[1:]]) - landmark_mean[prior.given].ravel()
        if jacobians is not None:
            jacobians[0] = np.eye(2)
            for k in range(len(keys) - 1):
                jacobians[1 + k] = -prior.gain[:, 2 * k : 2 * k + 2]
        residual: FloatArray = values.atPoint2(keys[0]) - prior.mean - prior.gain @ tied
        return residual

    return gtsam.CustomFactor(noise, keys, error)


def _summary_factor(row: int, landmarks: IntArray, at: Estimate, root: FloatArray, right: FloatArray) -> Any:
    """`|R x - d|^2 / 2` of the step `x` that pose `row`, some landmarks and the states make from where they were."""
    keys = [_pose_key(row), *(_landmark_key(int(j)) for j in landmarks), STATES_KEY]
    bounds = np.cumsum([0, 3, *([2] * len(landmarks)), N_STATES])
    pose, points, states = gtsam.Pose2(*at.pose[row]), at.landmark[landmarks], at.states

    def error(_this: Any, values: Any, jacobians: Any) -> FloatArray:
        step = [pose.localCoordinates(values.atPose2(keys[0]))]
        step += [values.atPoint2(key) - point for key, point in zip(keys[1:-1], points, strict=True)]
        step.append(values.atVector(STATES_KEY) - states)
        if jacobians is not None:
            for k in range(len(keys)):
                jacobians[k] = root[:, bounds[k] : bounds[k + 1]]
        residual: FloatArray = root @ np.concatenate(step) - right
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(right)), keys, error)


def frame_factor(problem: Problem, noise: Noise, row: int, detections: IntArray, *, before: bool, heavy: bool) -> Any:
    """The gtsam factor of one frame: its detections and, with `before`, the odometry since the pose before."""
    landmarks = list(dict.fromkeys(problem.landmark_row[detections].tolist()))
    keys = [STATES_KEY, _pose_key(row), *map(_landmark_key, landmarks)]
    if before:
        keys.append(_pose_key(row - 1))
    size = 2 * len(detections) + (3 if before else 0)
    error = _frame_error(problem, noise, row, detections, landmarks, before, heavy)
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error)


def _frame_error(
    problem: Problem, noise: Noise, row: int, detections: IntArray, landmarks: list[int], before: bool, heavy: bool
) -> Callable[[Any, Any, Any], FloatArray]:
    """Whitened residual of a frame and its Jacobians by states, pose, landmarks and the pose before."""
    column = np.array([landmarks.index(int(j)) for j in problem.landmark_row[detections]], dtype=np.int64)
    reading = problem.reading[detections]
    sigma = noise.of_detections(problem.sigma_given[detections])
    variance = noise.odometry**2
    n_rows = 2 * len(detections)
    size = n_rows + (3 if before else 0)
    landmark_keys = [_landmark_key(j) for j in landmarks]
    key, key_before = _pose_key(row), _pose_key(row - 1) if before else None
    drive, stamp, free, mount = problem.drive, problem.stamp_s, problem.prior.free, problem.mount

    def error(_this: Any, values: Any, jacobians: Any) -> FloatArray:
        states = values.atVector(STATES_KEY)
        at = values.atPose2(key)
        pose = np.array([at.x(), at.y(), at.theta()])
        points = np.array([values.atPoint2(k) for k in landmark_keys]).reshape(-1, 2)
        residual = np.zeros(size)
        by_states, by_pose = np.zeros((size, N_STATES)), np.zeros((size, 3))
        by_points = np.zeros((len(landmarks), size, 2))
        whitened_detections(
            pose, points, states, mount, reading, sigma, column, free, heavy, residual, by_pose, by_points, by_states
        )
        by_before = None
        if key_before is not None:
            at = values.atPose2(key_before)
            pose_before = np.array([at.x(), at.y(), at.theta()])
            by_before = np.zeros((size, 3))
            whitened_odometry(
                pose_before,
                pose,
                states,
                drive.stamp_s,
                drive.velocity,
                drive.unknown,
                stamp[row - 1],
                stamp[row],
                variance,
                free,
                residual[n_rows:],
                by_before[n_rows:],
                by_pose[n_rows:],
                by_states[n_rows:],
            )
        if jacobians is not None:
            jacobians[0] = by_states
            jacobians[1] = by_pose
            for k in range(len(landmarks)):
                jacobians[2 + k] = by_points[k]
            if by_before is not None:
                jacobians[2 + len(landmarks)] = by_before
        return residual

    return error


def _parameters() -> Any:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(RELINEARIZE_THRESHOLD)
    parameters.relinearizeSkip = RELINEARIZE_SKIP
    # Cholesky takes a clique for indeterminate whose pivots span more than 2^12: a millisecond's odometry beside a
    # calibration state does, and is none the worse for it
    parameters.setFactorization("QR")
    return parameters
