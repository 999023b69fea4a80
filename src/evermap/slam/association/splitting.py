"""Landmarks that are two: visits whose detections contradict the rest of the recording, though the map was bent to fit.

Detections that were given to a landmark wrongly bend the map until it fits, and the residuals look small. If the
detections of one visit had a landmark of their own, the optimum would put it at `d = V L' b` from that of the others,
with `V^-1 = L' (I - A S A') L` (a score test: `A x + L d = b` are these detections, linearised and whitened, `S` the
covariance of the solution). No other solution is needed for that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.slam.association.assignment import Assignment
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

LEAST_M2 = 1e-6
"""Information [1/m^2] of what ties a visit to nothing else."""


class Visits(NamedTuple):
    """Stretches of time in which a landmark was seen, of landmarks that have several; V of them.

    Attributes:
        rows: (V,) of the detections of each.
        landmark: (V,) that they were given to.
        squared: (V,) normalised squared distance from where the others put it.
        evidence: (V,) that both are one, over being two [nats].
    """

    rows: list[IntArray]
    landmark: IntArray
    squared: FloatArray
    evidence: FloatArray


def weighed_visits(
    assignment: Assignment,
    marginals: Marginals,
    linear: FloatArray,
    *,
    among: BoolArray,
    density: float,
    pause_s: float,
) -> Visits:
    """Return how well each visit agrees with all that is known without it.

    Args:
        assignment: at its optimum.
        marginals: covariances at it.
        linear: (M, 2, 11) detections with a landmark, linearised there (`Smoother.detections`).
        among: (L,) landmarks whose visits are weighed.
        density: landmarks a square metre that one expects.
        pause_s: time without a detection that ends a visit.
    """
    used = np.flatnonzero(assignment.landmark_row >= 0)
    row, pose = assignment.landmark_row[used], assignment.measured.pose_row[used]
    number = assignment.visits(pause_s)[used]
    of = row[np.unique(number, return_index=True)[1]]
    wanted = (np.bincount(of, minlength=assignment.n_landmarks) > 1) & among
    every = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])
    every = [every[k] for k in np.flatnonzero(wanted[of])]
    landmark = np.array([row[visit[0]] for visit in every], dtype=np.int64)
    squared, evidence = np.empty(len(every)), np.empty(len(every))
    shared = 2.0 * assignment.shared_variance
    for k, visit in enumerate(every):
        gap, own = _apart(linear[visit], pose[visit], int(landmark[k]), marginals)
        own = own + shared[landmark[k]] * np.eye(2)
        squared[k] = gap @ np.linalg.solve(own, gap)
        evidence[k] = -0.5 * (squared[k] + np.linalg.slogdet(2.0 * np.pi * own)[1]) - math.log(density)
    return Visits([used[visit] for visit in every], landmark, squared, evidence)


def _apart(linear: FloatArray, pose: IntArray, landmark: int, marginals: Marginals) -> tuple[FloatArray, FloatArray]:
    """(2,) from a visit's landmark to that of the others, were they two, and its covariance (2, 2)."""
    poses, at = np.unique(pose, return_inverse=True)
    n, tie = 3 * len(poses), linear[:, :, 3:5]
    tied = np.einsum("kra,krb->kab", linear[:, :, :10], tie)
    through = np.zeros((n + 11, 2))
    np.add.at(through[:n].reshape(-1, 3, 2), at, tied[:, :3])
    through[n : n + 7] = tied[:, 3:].sum(axis=0)
    explained = marginals.joint(np.array([landmark]), poses=poses, states=True, by=through.T)
    information = through[n : n + 2] - explained + LEAST_M2 * np.eye(2)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return covariance @ np.einsum("kra,kr->a", tie, linear[:, :, 10]), covariance
