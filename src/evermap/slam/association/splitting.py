"""Landmarks to be split: visits whose detections contradict the rest of the recording in spite of the fit.

Wrongly assigned detections distort the map until it fits, and leave small residuals. If the detections of one visit had
a landmark of their own, the optimum would place it at `d = V L' b` from that of the others, with
`V^-1 = L' (I - A S A') L` (a score test: `A x + L d = b` are these detections, linearised and whitened, `S` the
covariance of the solution). No further solution is needed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.slam.association.assignment import Assignment
from evermap.slam.association.features import Likeness
from evermap.slam.kernels import N_SENSOR, N_STATES
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

LEAST_M2 = 1e-6
"""Information [1/m^2] that keeps an unobservable visit regular: a tolerance."""
LEAST_SHARE = 1e-6
"""Least share of the information on a landmark from its other visits: a tolerance against cancellation."""
TOGETHER = 32
"""Number of visits per batch: bounds the memory."""


class Visits(NamedTuple):
    """Visits of landmarks that have several; V of them.

    Attributes:
        rows: (V,) of the detections of each.
        landmark: (V,) of each.
        squared: (V,) normalised squared distance from the position by the other visits.
        by_traits: (V,) evidence of the traits that both are the same landmark [nats].
        evidence: (V,) that both are the same, over two landmarks, including the traits [nats].
    """

    rows: list[IntArray]
    landmark: IntArray
    squared: FloatArray
    by_traits: FloatArray
    evidence: FloatArray


def weighed_visits(
    assignment: Assignment,
    marginals: Marginals,
    linear: FloatArray,
    *,
    among: BoolArray,
    density: float,
) -> Visits:
    """Weigh each visit against the estimate without it.

    Args:
        assignment: at its optimum.
        marginals: covariances at it.
        linear: (M, 2, 13) detections with a landmark, linearised there (`Smoother.detections`).
        among: (L,) landmarks whose visits are weighed.
        density: expected landmarks per square metre.
    """
    used = np.flatnonzero(assignment.landmark_row >= 0)
    row, pose = assignment.landmark_row[used], assignment.measured.pose_row[used]
    number = assignment.of_visits()[0][used]
    of = row[np.unique(number, return_index=True)[1]]
    wanted = (np.bincount(of, minlength=assignment.n_landmarks) > 1) & among
    every = np.split(np.argsort(number, kind="stable"), np.cumsum(np.bincount(number))[:-1])
    every = [every[k] for k in np.flatnonzero(wanted[of])]
    landmark = np.array([row[visit[0]] for visit in every], dtype=np.int64)
    in_time = np.argsort([visit[0] for visit in every], kind="stable")  # near in time: common poses
    shared = 2.0 * assignment.shared_variance[landmark]
    gap, own = np.empty((len(every), 2)), np.empty((len(every), 2, 2))
    for at in range(0, len(every), TOGETHER):
        some = in_time[at : at + TOGETHER]
        gap[some], own[some] = _apart(linear, pose, [every[k] for k in some], landmark[some], marginals)
    own += shared[:, None, None] * np.eye(2)
    squared = np.einsum("va,va->v", gap, np.linalg.solve(own, gap[:, :, None])[:, :, 0])
    evidence = -0.5 * (squared + np.linalg.slogdet(2.0 * np.pi * own)[1]) - math.log(density)
    by_traits = traits_against_others(assignment)[wanted[of]]
    return Visits([used[visit] for visit in every], landmark, squared, by_traits, evidence + by_traits)


def traits_against_others(assignment: Assignment) -> FloatArray:
    """Return (W,) evidence of the traits that each visit is to the landmark of its others [nats]; 0 without others."""
    visit, landmark = assignment.of_visits()
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
    """(V, 2) from the landmark of each visit to that of the others, if they are two, and the covariances (V, 2, 2)."""
    rows, of = np.concatenate(visits), np.repeat(np.arange(len(visits)), [len(visit) for visit in visits])
    (poses, at), (places, which) = (np.unique(each, return_inverse=True) for each in (pose[rows], landmark))
    tie, n = linear[rows][:, :, 3:5], 3 * len(poses)
    tied = np.einsum("kra,krb->kba", linear[rows][:, :, :-1], tie)
    through = np.zeros((len(visits), 2, n + 2 * len(places) + N_STATES))
    for b in range(3):
        np.add.at(through, (of[:, None], np.arange(2), 3 * at[:, None] + b), tied[:, :, b])
    own = np.zeros((len(visits), 2, 2 + N_SENSOR))
    np.add.at(own, of, tied[:, :, 3:])
    for b in range(2):
        through[np.arange(len(visits)), :, n + 2 * which + b] = own[:, :, b]
    through[:, :, n + 2 * len(places) : n + 2 * len(places) + N_SENSOR] = own[:, :, 2:]
    explained = marginals.each(places, poses, through)
    covariance = np.asarray(np.linalg.inv(own[:, :, :2] - explained + LEAST_M2 * np.eye(2)), dtype=np.float64)
    force = np.zeros((len(visits), 2))
    np.add.at(force, of, np.einsum("kra,kr->ka", tie, linear[rows][:, :, -1]))
    return np.einsum("vab,vb->va", covariance, force), covariance
