"""Modes that are none: united where two places explain no more than one and a chance does.

A selector takes poses as known, so whatever bends the trajectory for a while looks to it like a landmark that went
away and came back. Here poses are marginalised: from the joint covariance of all places follows what it costs to have
two of them coincide, and what everything else then does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from evermap.slam.problem import Estimate, Marginals, Problem
from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.modes.places import FREE, Modes, at_places, moved_to

MOVE_SIGMA_M = 0.7
"""Standard deviation of a displacement, each axis; as the default of `slam.changes.move_sigma_m`."""
SHARED_ERROR_M = 0.01
"""Of a place, by what is wrong with all its sightings for a minute or so: it does not average out."""

LONGEST_BURST_S = 5.0
MOST_OF_A_BURST = 2.0
"""Outliers come in bursts, of something in the way or of an identity misread from where the robot stands. All of one
burst cost as much as so many by themselves: what was seen somewhere in one look only, and not since, did not move."""


def united(
    problem: Problem,
    estimate: Estimate,
    marginals: Marginals,
    weights: FloatArray,
    modes: Modes,
    *,
    switch_cost: float,
    outlier_cost: float,
) -> tuple[Problem, Estimate, Modes]:
    """With modes of a landmark united that do not pay for themselves, the least worth first.

    The difference of two places has covariance `V` if they are the same and `V + s^2 I` if the landmark moved. The log
    ratio of these densities at the difference is what the second place explains, its two free parameters paid for; it
    is at most what it costs to call the detections of the lesser place outliers. Against it stands the cost of every
    switch that one place does not need. After two are united, all others are what the joint Gaussian makes of them
    under that condition. The prior map's place stays, else the older one.

    Args:
        problem: the measurements.
        estimate: their optimum.
        marginals: of it.
        weights: (M,) inlier probabilities.
        modes: whose mode each place is.
        switch_cost: nats of one switch.
        outlier_cost: nats of taking one detection for an outlier.
    """
    mean = estimate.landmark
    covariance = marginals.shared[: mean.size, : mean.size] + SHARED_ERROR_M**2 * np.eye(mean.size)
    histories = _histories(problem, estimate, weights, modes)
    to = np.arange(len(mean))
    while True:
        least, worst = 0.0, None
        for history in histories:
            for one, other in combinations(np.unique(history.place).tolist(), 2):
                keep, leave = (other, one) if problem.mapped[other] else (one, other)
                outliers = min(history.outliers(place) for place in (keep, leave) if not problem.mapped[place])
                gain = min(_log_ratio(mean, covariance, keep, leave), outlier_cost * outliers)
                gain -= switch_cost * history.switches_saved(leave, keep)
                if gain < least:
                    least, worst = gain, (history, leave, keep)
        if worst is None:
            break
        history, leave, keep = worst
        mean, covariance = _coinciding(mean, covariance, leave, keep)
        history.place[history.place == leave] = keep
        to[to == leave] = keep
    gone = np.flatnonzero(to != np.arange(len(to)))
    if len(gone) == 0:
        return problem, estimate, modes
    estimate = at_places(replace(estimate, landmark=mean), gone, np.nan)
    return moved_to(problem, gone, to[gone]), estimate, modes.without(gone)


@dataclass(frozen=True, slots=True)
class _History:
    """Where one landmark was seen, in order of time; what a prior map holds was there before the session.

    Attributes:
        place: (n,) rows of places.
        stamp_s: (n,) when.
        weight: (n,) inlier probabilities.
    """

    place: IntArray
    stamp_s: FloatArray
    weight: FloatArray

    def switches_saved(self, leave: int, keep: int) -> int:
        """Switches that are none once two places are one."""
        after = np.where(self.place == leave, keep, self.place)
        return int(np.count_nonzero(np.diff(self.place)) - np.count_nonzero(np.diff(after)))

    def outliers(self, place: int) -> float:
        """How many independent outliers the detections of one place would be, were they outliers."""
        here = self.place == place
        stamp_s, weight = self.stamp_s[here], self.weight[here]
        total, first = 0.0, 0
        while first < len(stamp_s):
            behind = int(np.searchsorted(stamp_s, stamp_s[first] + LONGEST_BURST_S, side="right"))
            total += min(MOST_OF_A_BURST, float(weight[first:behind].sum()))
            first = behind
        return total


def _histories(problem: Problem, estimate: Estimate, weights: FloatArray, modes: Modes) -> list[_History]:
    """Of the landmarks that have several modes."""
    owner = modes.landmark[problem.landmark_row]
    stamp_s = problem.stamp_s[problem.pose_row]
    found = []
    for landmark in np.flatnonzero((modes.table(estimate) != FREE).sum(axis=1) > 1):
        mine = owner == landmark
        before = np.full(int(problem.mapped[landmark]), landmark)
        found.append(
            _History(
                np.append(before, problem.landmark_row[mine]),
                np.append(np.full(len(before), -np.inf), stamp_s[mine]),
                np.append(np.zeros(len(before)), weights[mine]),
            )
        )
    return found


def _log_ratio(mean: FloatArray, covariance: FloatArray, a: int, b: int) -> float:
    """Log of how much better a displacement explains the difference of two places than chance does."""
    # along the axes of chance; where a place is hardly known, rounding may leave less than what all sightings share
    variance, axes = np.linalg.eigh(_of_difference(covariance, a, b))
    variance = np.maximum(variance, SHARED_ERROR_M**2)
    moved = variance + MOVE_SIGMA_M**2
    apart = axes.T @ (mean[a] - mean[b])
    return 0.5 * float(np.sum(apart**2 * (1.0 / variance - 1.0 / moved) + np.log(variance / moved)))


def _of_difference(covariance: FloatArray, a: int, b: int) -> FloatArray:
    """(2, 2) covariance of the difference of two places."""
    rows, columns = slice(2 * a, 2 * a + 2), slice(2 * b, 2 * b + 2)
    cross = covariance[rows, columns]
    difference: FloatArray = covariance[rows, rows] + covariance[columns, columns] - cross - cross.T
    return difference


def _coinciding(mean: FloatArray, covariance: FloatArray, a: int, b: int) -> tuple[FloatArray, FloatArray]:
    """Mean (P, 2) and covariance of all places on condition that two are the same."""
    cross = covariance[:, 2 * a : 2 * a + 2] - covariance[:, 2 * b : 2 * b + 2]
    gain = np.linalg.solve(_of_difference(covariance, a, b), cross.T).T
    step = -gain @ (mean[a] - mean[b])
    return mean + step.reshape(-1, 2), covariance - gain @ cross.T
