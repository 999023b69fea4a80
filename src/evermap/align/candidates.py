"""Candidate motions that lay landmarks over landmarks, and the one that most of them agree on."""

from __future__ import annotations

import numpy as np

from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.types import BoolArray, FloatArray, IntArray

AGREE_M = 0.5
"""Landmarks agree with a map where they lie this close to its places."""
N_PAIRS = 5000
"""Pairs that are tried, about: all of them up to 70 points, else every point with those that are farthest from it."""
AT_ONCE = 200_000
"""Numbers in a table that is worked on at once."""


def find_consensus(
    source: FloatArray, target: FloatArray, *, landmark: IntArray | None = None, weight: FloatArray | None = None
) -> tuple[FloatArray, BoolArray]:
    """Return the motion that brings most points near their partners, over all motions defined by two of them.

    Args:
        source: (k, 2) points.
        target: (k, 2) partner of each.
        landmark: (k,) what the pairs are of, where one landmark may be in several rows, one a place where it is known;
            it agrees with one of them at most. None where every row is another landmark's.
        weight: (k,) what agreement is worth, for example the probability that the landmark is there; None for 1.

    Returns:
        (3,) the motion, by least squares over all that agree; zeros where no two do. (k,) which agree.
    """
    count = len(source)
    agree = np.zeros(count, dtype=np.bool_)
    name = np.arange(count) if landmark is None else np.asarray(landmark)
    order = np.argsort(name, kind="stable")
    source, target, name = source[order], target[order], name[order]
    worth = np.ones(count) if weight is None else np.asarray(weight, dtype=np.float64)[order]
    i, j = _pairs_of_one_length(source, target, name)
    if len(i) == 0:
        return np.zeros(3), agree
    pose = _rigid_pairs(source[i], source[j], target[i], target[j])
    best = _best(pose, source, target, worth, np.flatnonzero(np.append(True, name[1:] != name[:-1])))
    fit = _fit(_gaps(pose[best : best + 1], source, target)[0]) * worth
    near = np.flatnonzero(fit > 0.0)
    near = near[np.lexsort((-fit[near], name[near]))]
    near = np.sort(near[np.unique(name[near], return_index=True)[1]])
    if len(near) < 2:
        return np.zeros(3), agree
    agree[order[near]] = True
    return rigid(source[near], target[near]), agree


def _pairs_of_one_length(source: FloatArray, target: FloatArray, name: IntArray) -> tuple[IntArray, IntArray]:
    """Return pairs of different landmarks with about equal distance in both maps; distant ones determine a heading
    best.

    Every point has some, so that those at the far ends, if these moved, are not in all.
    """
    count = len(source)
    partners = max(2, N_PAIRS // max(count, 1))
    found = []
    for first in range(0, count, max(1, AT_ONCE // max(count, 1))):
        rows = np.arange(first, min(first + max(1, AT_ONCE // count), count))
        span = _distances(target[rows], target)
        mismatch = np.abs(span - _distances(source[rows], source))
        span[(span < AGREE_M) | (mismatch > AGREE_M) | (name[rows][:, None] == name)] = -1.0
        if partners < count:
            far = np.argsort(-span, axis=1, kind="stable")[:, :partners]
            row, rank = np.nonzero(np.take_along_axis(span, far, axis=1) > 0.0)
            found.append(np.column_stack([rows[row], far[row, rank]]))
        else:
            found.append(np.argwhere(span > 0.0) + [first, 0])
    pairs = np.sort(np.vstack([np.zeros((0, 2), dtype=np.int64), *found]), axis=1)
    both = np.unique(pairs[:, 0] * count + pairs[:, 1])
    return both // max(count, 1), both % max(count, 1)


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    """(m, n) from points (m, 2) to points (n, 2)."""
    return np.asarray(np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1]), dtype=np.float64)


def _rigid_pairs(a: FloatArray, b: FloatArray, to_a: FloatArray, to_b: FloatArray) -> FloatArray:
    """(m, 3) motions that bring the points `a`, `b` (m, 2) onto `to_a`, `to_b`: `rigid` of two points, m times."""
    was, now = a - b, to_a - to_b
    theta = np.arctan2(was[:, 0] * now[:, 1] - was[:, 1] * now[:, 0], (was * now).sum(axis=1))
    turned = np.column_stack([np.zeros((len(a), 2)), theta])
    return np.column_stack([0.5 * (to_a + to_b) - se2.transform(turned, 0.5 * (a + b)), theta])


def _best(pose: FloatArray, source: FloatArray, target: FloatArray, worth: FloatArray, first: IntArray) -> int:
    """Return the motion (m, 3) of highest score; landmarks begin at the rows `first`."""
    score = np.empty(len(pose))
    step = max(1, AT_ONCE // len(source))
    for k in range(0, len(pose), step):
        fit = _fit(_gaps(pose[k : k + step], source, target)) * worth
        score[k : k + step] = np.maximum.reduceat(fit, first, axis=1).sum(axis=1)
    return int(np.argmax(score))


def _fit(gap: FloatArray) -> FloatArray:
    """How well points agree by their distance: 1 at the place, 0 from `AGREE_M` on (M-SAC: Torr and Zisserman 2000)."""
    return np.asarray(np.maximum(1.0 - (gap / AGREE_M) ** 2, 0.0))


def _gaps(pose: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """(m, k) between points (k, 2), brought over by every motion (m, 3), and their partners."""
    moved = se2.transform(pose[:, None, :], source[None, :, :])
    return np.asarray(np.hypot(moved[..., 0] - target[:, 0], moved[..., 1] - target[:, 1]), dtype=np.float64)
