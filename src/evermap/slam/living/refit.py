"""A session solved once more, with the map that it lies over as the prior of its landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap import se2
from evermap.slam.arrow import Smoother
from evermap.slam.calibration import FORWARD, N_STATES, SLOPE, CalibrationPrior
from evermap.slam.problem import Estimate
from evermap.slam.streaming import ALIGNED_INFORMATION, FINAL_TOLERANCE, Outcome
from evermap.types import FloatArray, IntArray

HEAVY_STEPS = 6


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
) -> Outcome:
    """The session in the frame of the map.

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
    # first with the kernel that never lets go: what was near the session's own map need not be near this one
    start = Smoother(problem, noise, heavy=True, robust=robust).optimum(start, iterations=HEAVY_STEPS, tolerance=1e-3)
    smoother = Smoother(problem, noise, robust=robust)
    estimate = smoother.optimum(start, tolerance=FINAL_TOLERANCE)
    marginals = smoother.marginals(estimate)
    return replace(
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
