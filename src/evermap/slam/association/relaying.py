"""Stretches of a recording that lie beside where they belong: recognised by their constellation, and laid there.

Where a loop was closed wrongly, or not closed because the robot had turned farther than it knew, everything met from
then on is in the map twice, and each half agrees with itself: no gate finds that. But landmarks met one after the other
have the shape of others that were met long before. Such a stretch is laid over those together with the poses since
then, and what held it elsewhere is cut: a start from which the solver finds an optimum that can be compared.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.slam.association.assignment import Assignment, alike
from evermap.slam.association.constellation import LocalMap
from evermap.slam.association.features import MISREAD_NATS
from evermap.slam.association.merging import entries
from evermap.slam.association.place_index import PATCH, PlaceIndex
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

MATCHES = 4_000
"""Triangles that are followed: nearly all of a stretch that was met before are there."""
FEWEST = 4
"""Landmarks of a stretch that must be found, seen in no frame beside those that they are."""
SAMPLED = 100
"""Landmarks by which it is told how well neighbours are known beside each other, about."""
GROWN = 1.25
"""Landmarks, relative to those at the last time, at which the older ones are indexed anew."""


class Displaced(NamedTuple):
    """Landmarks that were first met between two stamps and lie beside older ones that they probably are.

    Attributes:
        younger, older: (K,) their rows.
        since_s, until_s: the stamps.
        motion: (3,) from where they lie to where they belong.
    """

    younger: IntArray
    older: IntArray
    since_s: float
    until_s: float
    motion: FloatArray


def displaced_stretches(
    assignment: Assignment, marginals: Marginals, trusted: BoolArray, *, density: float, probability: float
) -> list[Displaced]:
    """Return stretches of landmarks, met one after the other, with the shape of older ones; most landmarks first.

    Args:
        assignment: at its optimum.
        marginals: covariances at it.
        trusted: (L,) landmarks that are looked at.
        density: landmarks a square metre that one expects.
        probability: least probability of a pair.
    """
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
            index = PlaceIndex(place[older], variance[:, None, None] * np.eye(2), most_matches=MATCHES)
        some = order[begin : begin + PATCH]
        pairs = index.pairs(local(some), density=density, probability=probability)
        mine, theirs = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        younger, older = some[mine], order[theirs]
        apart = (entries(together, younger, older) == 0) & alike(kind[younger], kind[older])
        younger, older = younger[apart], older[apart]
        if assignment.traits is not None and like is not None:
            alike_too = assignment.traits.same(like.part(younger), like.part(older)) >= -MISREAD_NATS
            younger, older = younger[alike_too], older[alike_too]
        if len(younger) >= FEWEST:
            motion = rigid(place[younger], place[older])
            found.append(Displaced(younger, older, first_s[some[0]], first_s[some[-1]], motion))
    return sorted(found, key=lambda each: -len(each.younger))


def _with_nearest(place: FloatArray, rows: IntArray) -> IntArray:
    """Some rows, spread over all, each with the one whose place is nearest."""
    some = rows[:: max(1, len(rows) // SAMPLED)]
    nearest = np.asarray(KDTree(place[rows]).query(place[some], k=2)[1])[:, 1]
    return np.unique(np.concatenate([some, rows[nearest]]))


def laid(assignment: Assignment, stretch: Displaced, before: float) -> Assignment:
    """Return the assignment with a stretch where it belongs, all since then with it.

    Args:
        assignment: at its optimum.
        stretch: what lies beside where it belongs.
        before: how long before it landmarks that were met again are not believed to be those, relative to its length.
    """
    since_s = stretch.since_s - before * (stretch.until_s - stretch.since_s)
    row, stamp_s = assignment.landmark_row, assignment.measured.stamp_s[assignment.measured.pose_row]
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
