"""Displaced stretches of a recording: recognised by their constellation, and realigned.

After a loop that was closed wrongly, or not closed because the heading error was too large, all landmarks since then
are in the map twice, and each half is consistent: no gate detects that. But consecutive landmarks have the same
constellation as others that were mapped long before. Such a stretch is aligned with those, together with the poses
since then, and its other associations are removed: an initial value from which the solver finds an optimum to compare.
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
from evermap.slam.association.merging import entries
from evermap.slam.association.place_index import PATCH, PlaceIndex
from evermap.slam.problem import Marginals
from evermap.types import BoolArray, FloatArray, IntArray

MATCHES = 4_000
"""Maximum number of matching triangles: bounds the work, since nearly all of a returning stretch match."""
SAMPLED = 100
"""Number of landmarks, about, from which the uncertainty between neighbours is estimated: bounds the work."""
GROWN = 1.25
"""Growth of the number of landmarks after which the older ones are indexed again: bounds the work."""


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


def displaced_stretches(
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
        if assignment.traits is not None and like is not None:
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
