"""How much of a given map is in its place beside a map that was made without it: units, mirrors, axes of tags.

A map that is drawn into a solution bends it, and what is wrong with the map is then seen in everything but the map. So
both are laid over each other as two figures: by the rigid motion of a few common landmarks that brings most others to
their places (Fischler & Bolles 1981, RANSAC). A map whose shape is right after one transformation, and not before, has
that fault.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from evermap.geometry import se2, se3
from evermap.geometry.rigid import rigid
from evermap.types import FloatArray, IntArray, Landmarks

FEWEST = 4
"""Common landmarks that a shape needs: in space three always fit a mirror image."""
MOST_SUBSETS = 400
"""Sets of two landmarks, in space of three, by which the maps are laid over each other, at most."""
IN_PLACE, LEAST_M = 0.03, 0.02
"""Distance within which a landmark is in its place: share of the spread of all, and at least."""
TURNED_RAD = 0.35
"""Turn within which a tag's orientation is that of the map."""


class Agreement(NamedTuple):
    """How much of a map is where a solution without it has it.

    Attributes:
        n_common: landmarks that both have.
        placed: share of them whose position is.
        share: the same of positions and orientations together.
    """

    n_common: int
    placed: float
    share: float


def compare_shapes(found: Landmarks, given: Landmarks) -> Agreement:
    """Return how much of a map agrees with landmarks in another frame, of a solution that did not use it."""
    names, own, theirs = np.intersect1d(found.landmark_id, given.landmark_id, return_indices=True)
    at, to = given.position_m[theirs], found.position_m[own]
    dim = min(at.shape[1], to.shape[1])
    at, to = at[:, :dim], to[:, :dim]
    if len(names) < FEWEST:
        return Agreement(len(names), 0.0, 0.0)
    spread = float(np.sqrt(((to - to.mean(axis=0)) ** 2).sum(axis=1).mean()))
    sigma = np.sqrt(np.trace(found.covariance_m2[own], axis1=1, axis2=2))
    near = np.maximum(3.0 * sigma, max(IN_PLACE * spread, LEAST_M))
    near = np.minimum(near, 0.2 * spread)
    subsets = np.array(list(combinations(range(len(names)), dim)), dtype=np.int64)
    if len(subsets) > MOST_SUBSETS:
        subsets = subsets[np.random.default_rng(0).choice(len(subsets), MOST_SUBSETS, replace=False)]
    motion = rigid(at[subsets], to[subsets])
    transform = se3.transform if dim == 3 else se2.transform
    off = np.linalg.norm(transform(motion[:, None], at[None]) - to[None], axis=2)
    placed = off <= near
    turned = _turns(found, given, own, theirs, motion) if dim == 3 else None
    if turned is None:
        best = int(np.argmax(placed.sum(axis=1)))
        return Agreement(len(names), float(placed[best].mean()), float(placed[best].mean()))
    right = (turned <= TURNED_RAD) & placed
    known = np.isfinite(turned[0])
    total = placed.sum(axis=1) + right.sum(axis=1)
    best = int(np.argmax(total))
    return Agreement(len(names), float(placed[best].mean()), float(total[best] / (len(names) + int(known.sum()))))


def _turns(
    found: Landmarks, given: Landmarks, own: IntArray, theirs: IntArray, motion: FloatArray
) -> FloatArray | None:
    """Return (K, N) turns between orientations under motions (K, 7), nan of unknown ones; None if a map has none."""
    if found.rotation is None or given.rotation is None:
        return None
    ours, others = found.rotation[own], given.rotation[theirs]
    known = np.asarray(np.isfinite(ours).all(axis=1) & np.isfinite(others).all(axis=1))
    if not known.any():
        return None
    turned = np.full((len(motion), len(known)), np.nan)
    moved = se3.compose(motion[:, None], se3.turn(others[known])[None])
    turned[:, known] = se3.angle_between(moved, se3.turn(ours[known])[None])
    return turned
