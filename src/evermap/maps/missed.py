"""Members of a body that are missed where the others are seen: they left alone, so they were on a body of their own.

Two chairs side by side are taken for one body until one moves. When one is carried away the other's detections speak
for both, and the map would keep what is gone. So landmarks are held against their fellows: from where the robot looked
these were detected as often as ever or less, and that share of its own usual rate is what a landmark owes.
"""

from __future__ import annotations

import numpy as np

from evermap.maps.grouping import Fate, regrouped
from evermap.maps.living import LivingMap
from evermap.maps.relabel import relabelled
from evermap.types import FloatArray, IntArray

STICKY = 4.0
"""Misses of one session come in runs: so many of them say as much as one that is independent of all others."""
P_WRONG = 1e-3
"""Of detections that fit a landmark, that they are of another one, all through a session."""


def without_missed(before: LivingMap, after: LivingMap) -> LivingMap:
    """The map after a session, its bodies without members that were missed alone; whether these exist is then open.

    Args:
        before: the map as the session found it.
        after: as the session leaves it, beliefs and counts up to date.
    """
    members = after.members
    site = after.site_of()
    place, counted = after.place_row(members.landmark_id, site), before.place_row(members.landmark_id, site)
    usual_hits, usual_misses = (_at(counted, column) for column in (before.places.n_hits, before.places.n_misses))
    hits = _at(place, after.places.n_hits) - usual_hits
    misses = _at(place, after.places.n_misses) - usual_misses
    p_missed = np.exp(-_owed(members.clique_id, usual_hits, usual_misses, hits, misses) / STICKY)
    known = (place >= 0) & (counted >= 0)
    fate = np.select([known & (hits > 0), known & (p_missed < 0.5)], [Fate.STAYED, Fate.GONE], Fate.UNSEEN)
    if not (fate == Fate.GONE).any():
        return after
    nowhere = np.zeros((len(members), 2))
    clique_id = regrouped(
        members.clique_id,
        members.class_id,
        fate,
        nowhere,
        nowhere,
        np.zeros((len(members), 2, 2)),
        reach_m=0.0,
        next_id=after.n_cliques_ever,
        p_wrong=np.where(fate == Fate.GONE, p_missed, P_WRONG),
    )
    if np.array_equal(clique_id, members.clique_id):
        return after
    return relabelled(after, clique_id)[0]


def _at(row: IntArray, column: IntArray) -> FloatArray:
    """(L,) a column by rows, 0 where there is none."""
    return np.append(column, 0)[row].astype(np.float64)  # row -1 is the last


def _owed(
    clique_id: IntArray, usual_hits: FloatArray, usual_misses: FloatArray, hits: FloatArray, misses: FloatArray
) -> FloatArray:
    """(L,) detections of each landmark that its own rate until now, and what its fellows showed, lead to expect."""
    looks = hits + misses
    expected = looks * usual_hits / np.maximum(usual_hits + usual_misses, 1.0)
    _, body = np.unique(clique_id, return_inverse=True)
    of_fellows, seen_of_fellows = (np.bincount(body.ravel(), w)[body.ravel()] - w for w in (expected, hits))
    return expected * np.minimum(seen_of_fellows / np.maximum(of_fellows, 1.0), 1.0)
