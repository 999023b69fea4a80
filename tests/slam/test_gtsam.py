"""The whole run against gtsam's batch solvers of the same graph: Levenberg-Marquardt and its marginals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
import pytest
from problems import default_prior, slow_detection
from recordings import building, first_seconds

from evermap.config import SlamConfig
from evermap.geometry import se2
from evermap.slam.intake import prepare
from evermap.slam.noise import START
from evermap.slam.planar_filter import PlanarMotion, SessionFilter
from evermap.slam.problem import Estimate, Marginals, Noise, Problem
from evermap.slam.smoother import Smoother
from evermap.slam.streaming import StreamingSlam
from evermap.types import Recording
from evermap_studies.peers.isam import STATES_KEY, frame_factor

NOISE = replace(START, detection=np.array([0.03, 0.01]), odometry=np.array([0.02, 0.02, 0.01, 0.015, 0.02]))


def pose_key(row: int) -> int:
    return int(gtsam.symbol("x", row))


def landmark_key(row: int) -> int:
    return int(gtsam.symbol("l", row))


def graph_of(problem: Problem, noise: Noise, *, heavy: bool) -> gtsam.NonlinearFactorGraph:
    """All frames and priors of a problem."""
    graph = gtsam.NonlinearFactorGraph()
    prior = problem.prior
    graph.add(gtsam.PriorFactorVector(STATES_KEY, prior.mean, gtsam.noiseModel.Diagonal.Sigmas(prior.sigma)))
    held = gtsam.noiseModel.Isotropic.Precision(3, problem.start_information)
    graph.add(gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(*problem.start_pose), held))
    for j in range(len(problem.landmark_mean)):
        information = problem.landmark_information[2 * j : 2 * j + 2, 2 * j : 2 * j + 2].toarray()
        if information.any():
            noise_model = gtsam.noiseModel.Gaussian.Information(information)
            graph.add(gtsam.PriorFactorPoint2(landmark_key(j), problem.landmark_mean[j], noise_model))
    for row in range(len(problem.stamp_s)):
        detections = np.flatnonzero(problem.pose_row == row)
        graph.add(frame_factor(problem, noise, row, detections, before=row > 0, heavy=heavy))
    return graph


def as_values(estimate: Estimate) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(STATES_KEY, estimate.states)
    for row, pose in enumerate(estimate.pose):
        values.insert(pose_key(row), gtsam.Pose2(*pose))
    for j in np.flatnonzero(estimate.known):
        values.insert(landmark_key(j), estimate.landmark[j])
    return values


def as_estimate(values: gtsam.Values, like: Estimate) -> Estimate:
    at = [values.atPose2(pose_key(row)) for row in range(len(like.pose))]
    landmark = np.full_like(like.landmark, np.nan)
    for j in np.flatnonzero(like.known):
        landmark[j] = values.atPoint2(landmark_key(j))
    return Estimate(np.array([[p.x(), p.y(), p.theta()] for p in at]), landmark, values.atVector(STATES_KEY))


def levenberg_marquardt(graph: gtsam.NonlinearFactorGraph, start: Estimate) -> gtsam.Values:
    """To the last digit: it stops when the error stalls, which re-weighted residuals do early."""
    values = gtsam.LevenbergMarquardtOptimizer(graph, as_values(start)).optimize()
    for _ in range(40):
        values = values.retract(graph.linearize(values).optimize())
    return values


@dataclass
class Run:
    """A streamed recording, and what gtsam makes of the same graph."""

    problem: Problem
    streamed: Estimate
    smoothed: Estimate
    marginals: Marginals
    lm: Estimate
    gtsam_marginals: Any


def solve_both(recording: Recording, *, robust: bool, with_map: bool = False) -> Run:
    """Stream, smooth, and hand the same graph to gtsam."""
    prepared = prepare(recording, recording.true_landmarks if with_map else None)
    slam = StreamingSlam(
        prepared.problem,
        NOISE,
        default_prior(),
        prior_map=prepared.prior_map,
        settings=SlamConfig(robust=robust, estimate_noise=False),
    )
    for _ in prepared.problem.stamp_s:
        slam.step()
    streamed = slam._filter.estimate()
    outcome = slam.finish()
    assert outcome.aligned == with_map
    problem = outcome.problem
    smoother = Smoother(problem, NOISE, heavy=robust, robust=robust)
    smoothed = smoother.optimum(outcome.graph_estimate, tolerance=1e-8)
    graph = graph_of(problem, NOISE, heavy=robust)
    values = levenberg_marquardt(graph, streamed)
    return Run(
        problem,
        streamed,
        smoothed,
        smoother.marginals(smoothed),
        as_estimate(values, smoothed),
        gtsam.Marginals(graph, values),
    )


CASES = ["quadratic", "robust", "map", "mrclam"]


@pytest.fixture(scope="module", params=CASES)
def run(request) -> Run:
    if request.param == "mrclam":
        from evermap.io import read_recording

        zipped = request.getfixturevalue("shared_data") / "mrclam" / "MRCLAM_Dataset6.zip"
        return solve_both(first_seconds(read_recording(zipped, robot=2), 60.0), robust=True)
    faults = 0.0 if request.param == "quadratic" else 0.01
    recording = building(3, patrol_s=50.0, faults=faults).sessions[0]
    return solve_both(recording, robust=request.param != "quadratic", with_map=request.param == "map")


def test_batch_optimum_is_gtsams(run):
    assert np.abs(se2.between(run.lm.pose, run.smoothed.pose)).max() < 1e-5
    assert np.nanmax(np.abs(run.lm.landmark - run.smoothed.landmark)) < 1e-5
    assert np.array_equal(run.lm.known, run.smoothed.known)
    assert np.abs(run.lm.states - run.smoothed.states).max() < 1e-5


def assert_same_covariance(found, expected):
    """To 1e-4 of the standard deviations."""
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(sigma, sigma)).max() < 1e-4


def test_covariances_are_gtsams(run):
    for row in range(1, len(run.smoothed.pose)):
        assert_same_covariance(run.marginals.pose[row], run.gtsam_marginals.marginalCovariance(pose_key(row)))
    for j in np.flatnonzero(run.smoothed.known):
        assert_same_covariance(run.marginals.landmark[j], run.gtsam_marginals.marginalCovariance(landmark_key(j)))
    assert_same_covariance(run.marginals.states, run.gtsam_marginals.marginalCovariance(STATES_KEY))


def test_joint_covariances_are_gtsams(run):
    """Of consecutive poses, and of a pose with a landmark and the states."""
    n = len(run.smoothed.pose)
    for row in (n // 3, n // 2, n - 2):
        j = int(run.problem.landmark_row[run.problem.pose_row == row][0])
        keys = [pose_key(row), pose_key(row + 1), landmark_key(j), STATES_KEY]
        whole = run.gtsam_marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
        marginals = run.marginals
        ours = np.block(
            [[marginals.pose[row], marginals.consecutive[row]], [marginals.consecutive[row].T, marginals.pose[row + 1]]]
        )
        theirs = np.block([[whole.at(a, b) for b in keys[:2]] for a in keys[:2]])
        assert_same_covariance(ours, theirs)
        columns = [2 * j, 2 * j + 1, *range(marginals.shared.shape[0] - 11, marginals.shared.shape[0])]
        theirs = np.hstack([whole.at(keys[0], keys[2]), whole.at(keys[0], STATES_KEY)])
        sigma = np.outer(np.sqrt(np.diag(marginals.pose[row])), np.sqrt(np.diag(marginals.shared))[columns])
        assert np.abs((marginals.pose_shared[row][:, columns] - theirs) / sigma).max() < 1e-4


def test_streaming_ends_near_the_batch_optimum(run):
    """The newest pose, places and states: what remains is small beside the uncertainty."""
    gap = se2.log(se2.between(run.lm.pose[-1], run.streamed.pose[-1]))
    assert np.abs(gap / np.sqrt(np.diag(run.marginals.pose[-1]))).max() < 0.7
    off = (run.streamed.landmark - run.lm.landmark) / np.sqrt(np.einsum("lii->li", run.marginals.landmark))
    assert np.nanmax(np.abs(off)) < 0.7


@pytest.mark.parametrize("robust", [False, True])
def test_innovations_are_those_of_gtsams_marginals(robust):
    """S of the next frame from the marginals of the graph with the next pose in it, derivatives by differences."""
    recording = building(5, patrol_s=25.0).sessions[0]
    whole = replace(prepare(recording).problem, prior=default_prior().without_scale())
    row = 50
    problem = whole.until(row)
    known = np.unique(problem.landmark_row)
    slam = StreamingSlam(whole, NOISE, default_prior(), settings=SlamConfig(robust=robust, estimate_noise=False))
    for _ in range(row):
        slam.step()
    optimum = Smoother(problem, NOISE, heavy=robust, robust=robust).optimum(slam._filter.estimate(), tolerance=1e-9)
    local = SessionFilter(whole, NOISE, robust=robust)
    local.restart(optimum, NOISE, whole)
    detections = np.flatnonzero((whole.pose_row == row) & np.isin(whole.landmark_row, known))
    assert len(detections) >= 2
    motion = PlanarMotion.between(whole, NOISE, row, optimum.states)
    before = local.covariance.copy()
    local.drive(motion)
    nis, log_det = local.distances(detections, whole.landmark_row[detections])

    graph = graph_of(problem, NOISE, heavy=robust)
    graph.add(frame_factor(whole, NOISE, row, np.arange(0), before=True, heavy=robust))
    pose = se2.compose(optimum.pose[-1], motion.increment)
    marginals = gtsam.Marginals(graph, as_values(replace(optimum, pose=np.vstack([optimum.pose, pose]))))
    assert_same_covariance(before[:3, :3], marginals.marginalCovariance(pose_key(row - 1)))
    for k, m in enumerate(detections):
        j = int(whole.landmark_row[m])
        keys = [pose_key(row), landmark_key(j), STATES_KEY]
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
        full = np.block([[joint.at(a, b) for b in keys] for a in keys])

        def predicted(step, j=j):
            states = optimum.states + np.where(whole.prior.free, step[5:], 0.0)
            at = se2.compose(pose, se2.exp(step[:3]))
            return slow_detection(at, optimum.landmark[j] + step[3:5], states, whole.mount)

        h = np.stack([(predicted(1e-6 * d) - predicted(-1e-6 * d)) / 2e-6 for d in np.eye(16)], axis=1)
        s = h @ full @ h.T + np.diag(NOISE.detection**2)
        innovation = whole.reading[m] - predicted(np.zeros(16))
        innovation[1] = se2.wrap(innovation[1])
        assert nis[k] == pytest.approx(innovation @ np.linalg.solve(s, innovation), rel=1e-3)
        assert log_det[k] == pytest.approx(np.linalg.slogdet(s)[1], abs=1e-3)
    assert local.bring(known).tolist() == list(range(len(known)))
    keys = [pose_key(row - 1), STATES_KEY, *map(landmark_key, known.tolist())]
    joint = marginals.jointMarginalCovariance(gtsam.KeyVector(keys))
    size = 14 + 2 * len(known)
    assert_same_covariance(before[:size, :size], np.block([[joint.at(a, b) for b in keys] for a in keys]))
