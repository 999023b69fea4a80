"""When a group moved: every detection of a member says 'still there' or 'already gone', and one instant parts them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from evermap.slam.arrow import Smoother
from evermap.slam.kernels import detection_residual, kernel, outlier_loss
from evermap.slam.problem import Estimate, Noise, Problem
from evermap.types import FloatArray, IntArray

SHARE = 0.95
"""Of the posterior of the instant that lies between the two stamps reported."""
HELD_M = 0.005
"""To this the other landmarks are held meanwhile."""


def unswayed(problem: Problem, estimate: Estimate, noise: Noise, members: IntArray) -> Estimate:
    """The estimate with poses that no sighting of the members has bent.

    Sightings that were given to the wrong places have drawn the poses towards these, and would be right again there.
    """
    others = ~np.isin(problem.landmark_row, members)
    rest = replace(
        problem,
        pose_row=problem.pose_row[others],
        landmark_row=problem.landmark_row[others],
        reading=problem.reading[others],
        sigma_given=problem.sigma_given[others],
        # the other landmarks stay where they are, or the whole might turn away from the members' places
        landmark_mean=np.nan_to_num(estimate.landmark[: len(problem.landmark_mean)]),
        landmark_information=np.eye(problem.landmark_mean.size) / HELD_M**2,
    )
    start = Estimate(estimate.pose, estimate.landmark[: len(problem.landmark_mean)], estimate.states)
    free = Smoother(rest, noise, heavy=True).optimum(start, iterations=5, tolerance=1e-4)
    return Estimate(free.pose, estimate.landmark, free.states)


def parting_time(
    problem: Problem,
    estimate: Estimate,
    noise: Noise,
    members: IntArray,
    old: FloatArray,
    new: FloatArray,
    within_s: tuple[float, float],
) -> tuple[float, tuple[float, float]]:
    """First stamp [s] at the new places, and two stamps between which the change happened.

    Args:
        problem: the measurements; `landmark_row` says which landmark was seen.
        estimate: poses and states.
        noise: the noise levels.
        members: (k,) landmarks of the group.
        old: (k, 2) their places before.
        new: (k, 2) and after.
        within_s: the change is known to lie between these two stamps.
    """
    stamp_s = problem.stamp_s[problem.pose_row]
    inside = (stamp_s >= within_s[0]) & (stamp_s <= within_s[1])
    mine = np.flatnonzero(np.isin(problem.landmark_row, members) & inside)
    if len(mine) < 2:
        return within_s[1], within_s
    column = np.searchsorted(members, problem.landmark_row[mine])
    sigma = noise.of_detections(problem.sigma_given[mine])
    loss = np.empty((2, len(mine)))
    for k, place in enumerate((old, new)):
        _losses(
            estimate.pose[problem.pose_row[mine]],
            place[column],
            estimate.states,
            problem.mount,
            problem.reading[mine],
            sigma,
            noise.outlier_log_odds,
            loss[k],
        )
    stamp_s = stamp_s[mine]
    # log likelihood of the change just before detection k, for k = 1 .. n - 1: both places were seen
    log_likelihood = -np.cumsum(loss[0] - loss[1])[:-1]
    weight = np.exp(log_likelihood - log_likelihood.max())
    # between two detections every instant is as likely as another
    weight *= np.maximum(np.diff(stamp_s), 1e-9)
    cumulated = np.cumsum(weight) / weight.sum()
    best = int(np.argmax(weight))
    low = int(np.searchsorted(cumulated, 0.5 * (1.0 - SHARE)))
    high = min(int(np.searchsorted(cumulated, 0.5 * (1.0 + SHARE))), len(weight) - 1)
    return float(stamp_s[best + 1]), (float(stamp_s[low]), float(stamp_s[high + 1]))


@kernel
def _losses(
    pose: FloatArray,
    place: FloatArray,
    states: FloatArray,
    mount: FloatArray,
    reading: FloatArray,
    sigma: FloatArray,
    log_odds: float,
    out: Any,
) -> None:
    """Negative log likelihood of every reading of a landmark at `place`, outliers included."""
    e, jx, jl, jc = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 5))
    for m in range(len(reading)):
        detection_residual(pose[m], place[m], states, mount, reading[m, 0], reading[m, 1], e, jx, jl, jc)
        squared = (e[0] / sigma[m, 0]) ** 2 + (e[1] / sigma[m, 1]) ** 2
        out[m] = outlier_loss(squared, log_odds, False)
