"""Wrong associations: visits that contradict the rest of the recording, and stretches that are displaced as a whole.

Wrongly assigned detections distort the map until it fits, and leave small residuals. If the detections of one visit had
a landmark of their own, the optimum would place it at `d = V L' b` from that of the others, with
`V^-1 = L' (I - A S A') L` (a score test: `A x + L d = b` are these detections, linearised and whitened, `S` the
covariance of the solution). No further solution is needed.

After a loop that was closed wrongly, or not closed because the heading error was too large, all landmarks since then
are in the map twice, and each half is consistent: no gate detects that. But consecutive landmarks have the same
constellation as others that were mapped long before. Such a stretch is aligned with those, together with the poses
since then, and its other associations are removed: an initial value from which the solver finds an optimum to compare.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.slam.association.assignment import Assignment, alike
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.features import Likeness
from evermap.slam.association.merging import entries
from evermap.slam.association.place_index import PATCH, PlaceIndex
from evermap.slam.kernels import N_SENSOR, N_STATES
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

LEAST_M2 = 1e-6
"""Information [1/m^2] that keeps an unobservable visit regular: a tolerance."""
LEAST_SHARE = 1e-6
"""Least share of the information on a landmark from its other visits: a tolerance against cancellation."""
TOGETHER = 32
"""Number of visits per batch: bounds the memory."""
MATCHES = 4_000
"""Maximum number of matching triangles: bounds the work, since nearly all of a returning stretch match."""
SAMPLED = 100
"""Number of landmarks, about, from which the uncertainty between neighbours is estimated: bounds the work."""
GROWN = 1.25
"""Growth of the number of landmarks after which the older ones are indexed again: bounds the work."""


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


def weigh_visits(assignment: Assignment, marginals: Marginals, linear: FloatArray, *, density: float) -> Visits:
    """Weigh each visit against the estimate without it.

    Args:
        assignment: at its optimum.
        marginals: covariances at it.
        linear: (M, 2, 13) detections with a landmark, linearised there (`Smoother.detections`).
        density: expected landmarks per square metre.
    """
    used = np.flatnonzero(assignment.landmark_row >= 0)
    row, pose = assignment.landmark_row[used], assignment.measured.pose_row[used]
    number = assignment.of_visits()[0][used]
    of = row[np.unique(number, return_index=True)[1]]
    wanted = np.bincount(of, minlength=assignment.n_landmarks) > 1
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


class Displaced(NamedTuple):
    """Landmarks that were first detected between two stamps and are probably displaced copies of older ones.

    Attributes:
        younger, older: (K,) their rows.
        since_s, until_s: the stamps.
        motion: (3,) that corrects the displacement.
    """

    younger: IntArray
    older: IntArray
    since_s: float
    until_s: float
    motion: FloatArray


def find_displaced(
    assignment: Assignment, marginals: Marginals, trusted: BoolArray, *, density: float, probability: float
) -> list[Displaced]:
    """Return stretches of consecutive landmarks with the constellation of older ones; those with most landmarks first.

    Args:
        assignment: at its optimum.
        marginals: covariances at it.
        trusted: (L,) landmarks that are used.
        density: expected landmarks per square metre.
        probability: least probability of a pair.
    """
    settings = assignment.settings
    rules = settings.association
    place, first_s, found = assignment.estimate.landmark, assignment.first_seen_s, list[Displaced]()
    order = np.flatnonzero(trusted)[np.argsort(first_s[trusted], kind="stable")]
    shared, together, kind = assignment.shared_variance, assignment.together, assignment.of_kind
    like, indexed = assignment.like(), 0

    def local(rows: IntArray) -> LocalMap:
        joint = marginals.joint(rows)
        return LocalMap(place[rows], joint + np.diag(np.repeat(shared[rows], 2)))

    for begin in range(PATCH, len(order) - PATCH // 2, PATCH // 2):
        if begin >= GROWN * indexed:
            older, indexed = order[:begin], begin
            variance = shared[older] + local(_with_nearest(place, older)).beside_m ** 2
            spread = variance[:, None, None] * np.eye(2)
            index = PlaceIndex(place[older], spread, most_matches=MATCHES, settings=settings)
        some = order[begin : begin + PATCH]
        pairs = index.pairs(local(some), density=density, probability=probability)
        mine, theirs = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        younger, older = some[mine], order[theirs]
        apart = (entries(together, younger, older) == 0) & alike(kind[younger], kind[older])
        younger, older = younger[apart], older[apart]
        alike_too = assignment.traits.same(like.part(younger), like.part(older)) >= -rules.readings.misread_nats
        younger, older = younger[alike_too], older[alike_too]
        if len(younger) >= rules.fewest_displaced:
            motion = rigid(place[younger], place[older])
            found.append(Displaced(younger, older, first_s[some[0]], first_s[some[-1]], motion))
    return sorted(found, key=lambda each: -len(each.younger))


def _with_nearest(place: FloatArray, rows: IntArray) -> IntArray:
    """A sample of rows, each with its nearest neighbour."""
    some = rows[:: max(1, len(rows) // SAMPLED)]
    nearest = np.asarray(KDTree(place[rows]).query(place[some], k=2)[1])[:, 1]
    return np.unique(np.concatenate([some, rows[nearest]]))


def laid(assignment: Assignment, stretch: Displaced, before: float) -> Assignment:
    """Return the assignment with a stretch realigned, and everything since then with it.

    Args:
        assignment: at its optimum.
        stretch: to be realigned.
        before: duration before the stretch, relative to its length, in which associations with older landmarks are cut.
    """
    since_s = stretch.since_s - before * (stretch.until_s - stretch.since_s)
    row, stamp_s = assignment.landmark_row, assignment.measured.seen_s
    old = assignment.first_seen_s < since_s
    inside = np.flatnonzero((row >= 0) & (stamp_s >= since_s) & (stamp_s <= stretch.until_s))
    inside = inside[old[row[inside]]]
    cut = assignment.split([inside[row[inside] == one] for one in np.unique(row[inside])])
    late, new = cut.measured.stamp_s >= since_s, cut.first_seen_s >= since_s
    pose, place = cut.estimate.pose.copy(), cut.estimate.landmark.copy()
    pose[late], place[new] = se2.compose(stretch.motion, pose[late]), se2.transform(stretch.motion, place[new])
    moved = replace(cut, estimate=replace(cut.estimate, pose=pose, landmark=place))
    pairs = np.sort(np.column_stack([stretch.younger, stretch.older]), axis=1)[:, ::-1]
    return moved.merged([(int(u), int(o)) for u, o in pairs])
