"""A session solved once more, with the map that it lies over as the prior of its landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.slam.arrow import Smoother
from evermap.slam.calibration import FORWARD, N_STATES, SLOPE, CalibrationPrior
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.slam.streaming import ALIGNED_INFORMATION, FINAL_TOLERANCE, Outcome, sighted_at
from evermap.types import FloatArray, IntArray

HEAVY_STEPS = 6
MOST_LOST = 0.03
"""A session that fitted by itself and whose sightings fit the map less often, by this share, was bent."""
WINDOW = 12
"""Sightings around a pose by which it is placed in the map."""
PLACING_ROUNDS, PLACING_M = 10, 0.3
"""Reweighted rigid fits for that, and the residual from which sightings count for less."""


def refitted(
    outcome: Outcome,
    prior: CalibrationPrior,
    pose_map_session: FloatArray,
    size: float,
    row: IntArray,
    mean_m: FloatArray,
    covariance_m2: FloatArray,
    *,
    robust: bool,
) -> tuple[Outcome, bool]:
    """The session in the frame of the map, and whether it had to be straightened for that.

    Args:
        outcome: of the session alone.
        prior: of the calibration states.
        pose_map_session: (3,) where the session's frame is in the map.
        size: metres of the map for one of the session's graph.
        row: (K,) landmarks of the problem that stand at places of the map.
        mean_m: (K, 2) positions of these places.
        covariance_m2: (2 K, 2 K) joint covariance of them.
        robust: explain outliers.

    Raises:
        NumericalError: no finite optimum.
    """
    count = len(outcome.problem.landmark_mean)
    mean, information = np.zeros((count, 2)), np.zeros((2 * count, 2 * count))
    at = se2.xy_rows(row)
    mean[row] = mean_m
    information[np.ix_(at, at)] = np.linalg.inv(covariance_m2)
    own = outcome.graph_estimate
    stretch = np.array([size, size, 1.0])
    landmark = se2.transform(pose_map_session, own.landmark * size)
    landmark[row] = mean_m
    states, prior = own.states.copy(), prior.without_scale()
    if not prior.free[SLOPE]:  # held, in the map's metres
        states[SLOPE] = (1.0 + prior.mean[SLOPE]) / size - 1.0
        states[FORWARD] *= size
        prior = replace(prior, mean=np.where(np.arange(N_STATES) == SLOPE, states[SLOPE], prior.mean))
    start = Estimate(se2.compose(pose_map_session, own.pose * stretch), landmark, states)
    problem = replace(
        outcome.problem,
        prior=prior,
        start_pose=start.pose[0],
        start_information=ALIGNED_INFORMATION,
        landmark_mean=mean,
        landmark_information=information,
    )
    noise = outcome.noise.noise
    smoother, estimate = _solved(problem, noise, start, robust=robust)
    straightened = False
    if smoother.inlier_probability(estimate).mean() < (1.0 - MOST_LOST) * outcome.inlier.mean():
        # a blind stretch bent the session by more than a descent can take back: every stretch placed by itself
        other, straight = _solved(problem, noise, _placed(problem, start, row), robust=robust)
        if other.cost(straight) < smoother.cost(estimate):
            smoother, estimate, straightened = other, straight, True
    marginals = smoother.marginals(estimate)
    outcome = replace(
        outcome,
        estimate=estimate,
        states_covariance=marginals.states.copy(),
        problem=problem,
        graph_estimate=estimate,
        graph_marginals=marginals,
        inlier=smoother.inlier_probability(estimate),
        scale=1.0,
        log_scale_sigma=0.0,
        aligned=True,
    )
    return outcome, straightened


def _solved(problem: Problem, noise: Noise, start: Estimate, *, robust: bool) -> tuple[Smoother, Estimate]:
    """The optimum near `start`."""
    # first with the kernel that never lets go: what was near the session's own map need not be near this one
    start = Smoother(problem, noise, heavy=True, robust=robust).optimum(start, iterations=HEAVY_STEPS, tolerance=1e-3)
    smoother = Smoother(problem, noise, robust=robust)
    return smoother, smoother.optimum(start, tolerance=FINAL_TOLERANCE)


def _placed(problem: Problem, start: Estimate, row: IntArray) -> Estimate:
    """`start` with every pose where the sightings around it show the landmarks `row` (K,) of the map.

    Each pose is moved by the rigid motion that brings these sightings, as the poses nearby have them, onto the
    landmarks; reweighted, since some carry wrong identities and some belong to the other side of a bend.
    """
    held = np.zeros(len(start.landmark), dtype=np.bool_)
    held[row] = True
    used = np.flatnonzero(held[problem.landmark_row])
    if len(used) < 2:
        return start
    seen_m = sighted_at(start.pose[problem.pose_row], problem.reading, start.states, problem.mount)
    middle = np.searchsorted(problem.pose_row[used], np.arange(len(start.pose)))
    first = np.clip(middle - WINDOW // 2, 0, max(len(used) - WINDOW, 0))
    window = used[np.minimum(first[:, None] + np.arange(WINDOW), len(used) - 1)]
    a, b = seen_m[window], start.landmark[problem.landmark_row[window]]
    weight = np.ones(window.shape)
    for _ in range(PLACING_ROUNDS):
        motion = rigid(a, b, weight)
        gap = np.hypot(*np.moveaxis(se2.transform(motion[:, None, :], a) - b, -1, 0))
        weight = 1.0 / (1.0 + (gap / PLACING_M) ** 2)
    pose = se2.compose(motion, start.pose)
    landmark = start.landmark.copy()
    anew = sighted_at(pose[problem.pose_row], problem.reading, start.states, problem.mount)
    for j in np.setdiff1d(problem.landmark_row, row):
        landmark[j] = np.median(anew[problem.landmark_row == j], axis=0)
    return Estimate(pose, landmark, start.states)
