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
from evermap.slam.association.features import Likeness
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

LEAST_M2 = 1e-6
"""Information [1/m^2] of what ties a visit to nothing else."""

LEAST_SHARE = 1e-6
"""Share of what is known of a landmark by other visits, at least."""
TOGETHER = 32
"""Visits that are weighed at a time."""


class Visits(NamedTuple):
    """Stretches of time in which a landmark was seen, of landmarks that have several; V of them.

    Attributes:
        rows: (V,) of the detections of each.
        landmark: (V,) that they were given to.
        squared: (V,) normalised squared distance from where the others put it.
        told: (V,) by what they are like, that both are one [nats].
        evidence: (V,) that both are one, over being two [nats], with that.
    """

    rows: list[IntArray]
    landmark: IntArray
    squared: FloatArray
    told: FloatArray
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
    in_time = np.argsort([visit[0] for visit in every], kind="stable")  # what is near in time shares its way
    shared = 2.0 * assignment.shared_variance[landmark]
    gap, own = np.empty((len(every), 2)), np.empty((len(every), 2, 2))
    for at in range(0, len(every), TOGETHER):
        some = in_time[at : at + TOGETHER]
        gap[some], own[some] = _apart(linear, pose, [every[k] for k in some], landmark[some], marginals)
    own += shared[:, None, None] * np.eye(2)
    squared = np.einsum("va,va->v", gap, np.linalg.solve(own, gap[:, :, None])[:, :, 0])
    evidence = -0.5 * (squared + np.linalg.slogdet(2.0 * np.pi * own)[1]) - math.log(density)
    told = told_by_others(assignment, pause_s)[wanted[of]]
    return Visits([used[visit] for visit in every], landmark, squared, told, evidence + told)


def told_by_others(assignment: Assignment, pause_s: float) -> FloatArray:
    """Return (W,) nats for each visit to be to the landmark of its others, by what it is like; 0 where it has none."""
    visit, landmark = assignment.of_visits(pause_s)
    if assignment.traits is None:
        return np.zeros(len(landmark))
    one = assignment.traits.of_visits(visit, len(landmark))
    every = assignment.traits.of_landmarks(one, landmark, assignment.n_landmarks).part(landmark)
    known = np.isfinite(one.value)
    weight = 1.0 / every.variance - np.where(known, 1.0 / one.variance, 0.0)
    weight = np.where(weight > LEAST_SHARE / every.variance, weight, np.nan)
    rest = every.value / every.variance - np.where(known, one.value / one.variance, 0.0)
    others = Likeness(rest / weight, 1.0 / weight, every.readings - one.readings)
    return assignment.traits.same(one, others)


def _apart(
    linear: FloatArray, pose: IntArray, visits: list[IntArray], landmark: IntArray, marginals: Marginals
) -> tuple[FloatArray, FloatArray]:
    """(V, 2) from each visit's landmark to that of the others, were they two, and the covariances (V, 2, 2)."""
    rows, of = np.concatenate(visits), np.repeat(np.arange(len(visits)), [len(visit) for visit in visits])
    (poses, at), (places, which) = (np.unique(each, return_inverse=True) for each in (pose[rows], landmark))
    tie, n = linear[rows][:, :, 3:5], 3 * len(poses)
    tied = np.einsum("kra,krb->kba", linear[rows][:, :, :10], tie)
    through = np.zeros((len(visits), 2, n + 2 * len(places) + 9))
    for b in range(3):
        np.add.at(through, (of[:, None], np.arange(2), 3 * at[:, None] + b), tied[:, :, b])
    own = np.zeros((len(visits), 2, 7))
    np.add.at(own, of, tied[:, :, 3:])
    for b in range(2):
        through[np.arange(len(visits)), :, n + 2 * which + b] = own[:, :, b]
    through[:, :, n + 2 * len(places) : n + 2 * len(places) + 5] = own[:, :, 2:]
    explained = marginals.each(places, poses, through)
    covariance = np.asarray(np.linalg.inv(own[:, :, :2] - explained + LEAST_M2 * np.eye(2)), dtype=np.float64)
    force = np.zeros((len(visits), 2))
    np.add.at(force, of, np.einsum("kra,kr->ka", tie, linear[rows][:, :, 10]))
    return np.einsum("vab,vb->va", covariance, force), covariance
