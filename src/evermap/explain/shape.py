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
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

FEWEST = 4
"""Common landmarks that a shape needs: in space three always fit a mirror image."""
MOST_SUBSETS = 400
"""Sets of two landmarks, in space of three, by which the maps are laid over each other, at most."""
IN_PLACE, LEAST_M = 0.03, 0.02
"""Distance within which a landmark is in its place: share of the spread of all, and at least."""
PART = 0.6
"""Share of the landmarks that are not in their place from which one mirror explains them."""
BESIDE = 0.5
"""Distance from its place in the mirror, over that from the one of the map, up to which a landmark is mirrored."""
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
    dim = min(given.position_m.shape[1], found.position_m.shape[1])
    if len(names) < FEWEST:
        return Agreement(len(names), 0.0, 0.0)
    motion, placed = _lay_over(given.position_m[theirs, :dim], found.position_m[own, :dim], _find_near(found, own, dim))
    turned = _turns(found, given, own, theirs, motion) if dim == 3 else None
    if turned is None:
        best = int(np.argmax(placed.sum(axis=1)))
        return Agreement(len(names), float(placed[best].mean()), float(placed[best].mean()))
    right = (turned <= TURNED_RAD) & placed
    known = np.isfinite(turned[0])
    total = placed.sum(axis=1) + right.sum(axis=1)
    best = int(np.argmax(total))
    return Agreement(len(names), float(placed[best].mean()), float(total[best] / (len(names) + int(known.sum()))))


def find_mirrored_part(found: Landmarks, given: Landmarks) -> tuple[IntArray, FloatArray] | None:
    """Return identities (K,) of landmarks that a given map has as in a mirror, and (K, D) where they are in its frame.

    Of those that are not in their place, most are in one that is mirrored, and not in one that is moved together.
    """
    names, own, theirs = np.intersect1d(found.landmark_id, given.landmark_id, return_indices=True)
    dim = min(given.position_m.shape[1], found.position_m.shape[1])
    if len(names) < FEWEST:
        return None
    at, to, near = given.position_m[theirs, :dim], found.position_m[own, :dim], _find_near(found, own, dim)
    placed = _lay_over(at, to, near)[1]
    best = int(np.argmax(placed.sum(axis=1)))
    rest = np.flatnonzero(~placed[best])
    if len(rest) < max(FEWEST, dim + 2):  # in space three always fit a mirror image, in the plane two
        return None
    reflected = at * np.where(np.arange(dim) == 1, -1.0, 1.0)
    mirrored = _lay_over(reflected[rest], to[rest], near[rest])[1]
    alike = int(_lay_over(at[rest], to[rest], near[rest])[1].sum(axis=1).max())
    mine = rest[mirrored[int(np.argmax(mirrored.sum(axis=1)))]]
    if len(mine) < max(PART * len(rest), alike + dim, FEWEST):
        return None
    transform = se3.transform if dim == 3 else se2.transform
    as_given, as_mirrored = rigid(at[placed[best]], to[placed[best]]), rigid(reflected[mine], to[mine])
    off, off_mirrored = (
        np.linalg.norm(transform(one, points) - to, axis=1)
        for one, points in ((as_given, at), (as_mirrored, reflected))
    )
    mine = np.flatnonzero((off_mirrored <= near) & (off > LEAST_M) & (off_mirrored < BESIDE * off))
    inverse = se3.inverse(as_given) if dim == 3 else se2.inverse(as_given)
    return names[mine], np.asarray(transform(inverse, transform(as_mirrored, reflected[mine])))


def _find_near(found: Landmarks, own: IntArray, dim: int) -> FloatArray:
    """Return distances (N,) within which landmarks are in their place."""
    to = found.position_m[own, :dim]
    spread = float(np.sqrt(((to - to.mean(axis=0)) ** 2).sum(axis=1).mean()))
    sigma = np.sqrt(np.trace(found.covariance_m2[own], axis1=1, axis2=2))
    near = np.maximum(3.0 * sigma, max(IN_PLACE * spread, LEAST_M))
    return np.asarray(np.minimum(near, 0.2 * spread))


def _lay_over(at: FloatArray, to: FloatArray, near: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return rigid motions by sets of landmarks from places (N, D) to others, and (K, N) which each brings near."""
    dim = at.shape[1]
    subsets = np.array(list(combinations(range(len(at)), dim)), dtype=np.int64)
    if len(subsets) > MOST_SUBSETS:
        subsets = subsets[np.random.default_rng(0).choice(len(subsets), MOST_SUBSETS, replace=False)]
    motion = rigid(at[subsets], to[subsets])
    transform = se3.transform if dim == 3 else se2.transform
    off = np.linalg.norm(transform(motion[:, None], at[None]) - to[None], axis=2)
    return motion, np.asarray(off <= near)


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
