"""The search over sets of changes: from a comparison with the map to hypotheses in the order of their gains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.geometry import se2
from evermap.slam.changes.climb import Tables, Weighed, climb_from_many_starts, weigh_neighbours
from evermap.slam.changes.evidence import Comparison, Evidence
from evermap.slam.changes.gain import hypothesis_gain
from evermap.slam.changes.prior import ChangePrior
from evermap.types import BoolArray, FloatArray, IntArray

MOST_GROUPS = 4
"""Groups in one hypothesis, at most."""
MOST_CANDIDATES = 40
"""Landmarks that may move in one search; in larger maps those that would gain most alone."""
NEAR = 5.0
"""Hypotheses within this of the best [nats] have their neighbours weighed too, or their own weights would be too large;
"""
MOST_WIDENED = 30
"""so many of them at most."""


class Hypotheses(NamedTuple):
    """Hypotheses of the search, the best first.

    Attributes:
        label: (H, L) group of every landmark, 0 = static; groups are numbered by their first member.
        onset: (H, G + 1) window from which on a group has moved; row 0 is not used.
        turns: (H, G + 1) whether a group also turned.
        motion: (H, G, 3) displacement of each group's centroid [m] and its angle [rad].
        gain: (H,) log posterior odds against 'nothing moved' [nats].
    """

    label: IntArray
    onset: IntArray
    turns: BoolArray
    motion: FloatArray
    gain: FloatArray


def find_changes(
    evidence: Evidence,
    comparison: Comparison,
    position: FloatArray,
    n_windows: int,
    prior: ChangePrior,
    *,
    start: Hypotheses | None = None,
) -> Hypotheses:
    """The most probable sets of changes, and all that were weighed on the way.

    Args:
        evidence: of the copies.
        comparison: the same, seen from the map.
        position: (L, 2) mapped positions; groups turn about the centroid of these.
        n_windows: windows of the evidence.
        prior: how changes are distributed.
        start: hypotheses of which the first is one start of the search.
    """
    candidates = _candidates(evidence, comparison, len(position), prior, start)
    quadratic, linear = item_columns(evidence, comparison, position, n_windows, candidates)
    count = len(candidates)
    label, onset, turns = (
        np.zeros(count, np.int64),
        np.zeros(MOST_GROUPS + 1, np.int64),
        np.zeros(MOST_GROUPS + 1, bool),
    )
    if start is not None:
        label[:], onset[:], turns[:] = start.label[0, candidates], start.onset[0], start.turns[0]
    tables = Tables(
        quadratic,
        linear,
        position[candidates],
        prior.spread,
        prior.log_prior(len(np.unique(evidence.landmark)), count),
        prior.log_onset(n_windows),
    )
    may_turn, weighed = prior.p_rotated > 0.0, Weighed.nothing(count, MOST_GROUPS)
    climb_from_many_starts(may_turn, tables, label, onset, turns, weighed)
    near = weighed.ranked
    for k in near[weighed.gain[near] > weighed.best[0] - NEAR][:MOST_WIDENED]:
        weigh_neighbours(weighed.label[k], weighed.onset[k], weighed.turns[k], may_turn, tables, weighed)
    ranked = weighed.ranked
    labels = np.zeros((len(ranked), len(position)), np.int64)
    labels[:, candidates] = weighed.label[ranked]
    motion = np.array(
        [hypothesis_gain(weighed.label[k], weighed.onset[k], weighed.turns[k], *tables)[1] for k in ranked]
    )
    return Hypotheses(labels, weighed.onset[ranked], weighed.turns[ranked], motion, weighed.gain[ranked])


def _candidates(
    evidence: Evidence, comparison: Comparison, n_landmarks: int, prior: ChangePrior, start: Hypotheses | None
) -> IntArray:
    """Landmarks that may have moved: in a large map those that would gain most alone, and those already suspected."""
    gain = np.full(n_landmarks, -np.inf)
    for j in np.unique(evidence.landmark):
        rows = np.flatnonzero(evidence.landmark == j)
        both = se2.xy_rows(rows)
        identity = np.tile(np.eye(2), (len(rows), 1))
        pull = identity.T @ comparison.pull[both]
        precision = identity.T @ comparison.precision[np.ix_(both, both)] @ identity
        gain[j] = pull @ np.linalg.solve(precision + np.eye(2) / prior.spread[0] ** 2, pull)
    suspected = np.zeros(n_landmarks, bool) if start is None else start.label[0] > 0
    gain[suspected] = np.inf
    order = np.argsort(-gain, kind="stable")[:MOST_CANDIDATES]
    return np.sort(order[gain[order] > -np.inf])


def item_columns(
    evidence: Evidence, comparison: Comparison, position: FloatArray, n_windows: int, candidates: IntArray
) -> tuple[FloatArray, FloatArray]:
    """`T'AT` and `T'b`: the four columns of every item 'this candidate, from this window on'.

    With one window for all of the session's, the items are 'this candidate, always'.
    """
    rank = np.full(len(position), -1)
    rank[candidates] = np.arange(len(candidates))
    rows = np.flatnonzero(rank[evidence.landmark] >= 0)
    x, y = position[evidence.landmark[rows]].T
    zero, one = np.zeros(len(rows)), np.ones(len(rows))
    columns = np.array([[one, zero, x, -y], [zero, one, y, x]]).transpose(2, 0, 1)  # (R, 2, 4)
    both = se2.xy_rows(rows)
    precision = comparison.precision[np.ix_(both, both)].reshape(len(rows), 2, len(rows), 2)
    # what a copy says is said by every item that begins in its window or before: sums from the last window backwards
    size = (n_windows, len(candidates), 4)
    window, column = np.minimum(evidence.window[rows], n_windows - 1), rank[evidence.landmark[rows]]
    item = window * len(candidates) + column
    linear = np.zeros((n_windows * len(candidates), 4))
    np.add.at(linear, item, np.einsum("rka,rk->ra", columns, comparison.pull[both].reshape(-1, 2)))
    linear = np.cumsum(linear.reshape(size)[::-1], axis=0)[::-1]
    half = np.einsum("rkqm,qmb->rkqb", precision, columns)
    blocks = np.einsum("rka,rkqb->raqb", columns, half)
    quadratic = np.zeros((n_windows * len(candidates), 4, n_windows * len(candidates), 4))
    np.add.at(quadratic.transpose(0, 2, 1, 3), (item[:, None], item[None, :]), blocks.transpose(0, 2, 1, 3))
    quadratic = quadratic.reshape(*size, *size)
    for axis in (0, 3):
        quadratic = np.flip(np.cumsum(np.flip(quadratic, axis), axis=axis), axis)
    return np.ascontiguousarray(quadratic.reshape(linear.size, linear.size)), linear.ravel()
