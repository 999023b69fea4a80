"""Alignment of a local map with a large one: an index of constellations, triangles of near places by their sides.

Trying every pair of places is quadratic in the map. The three lengths of a triangle of near landmarks are invariant to
motions; a k-d tree of the triangles of the map finds those with the lengths of one of the local map. Each match gives a
motion, scored by the number of landmarks of the local map near a place. The best motions, one per part of the map, are
weighed exactly (`constellation`). If two are similar, as in repeating aisles, or if the agreement may be by chance in a
map of this size, no pairs are returned.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from evermap.config import ConstellationConfig, SlamConfig
from evermap.geometry import se2
from evermap.geometry.group import SPACE, group_of
from evermap.geometry.rigid import rigid
from evermap.slam.association.constellation import MAX_MOTIONS, LocalMap, list_agreed_pairs
from evermap.slam.batch import USUAL
from evermap.types import BoolArray, FloatArray, IntArray

NEIGHBOURS = 7
"""Number of nearest places that form triangles with each place: bounds the size of the index."""
FLATTEST = 0.05
"""Least area of a triangle over its longest side squared: a tolerance, since points on a line determine no rotation."""
LOOKED_UP = 80
"""Maximum number of triangles of the local map that are looked up: bounds the work."""
MOST_MATCHES = 30_000
"""Maximum number of their matches that are used: bounds the work."""
PATCH = 20
"""Number of neighbouring landmarks of the local map that are aligned together: bounds the work."""
TRIES = 3
"""Maximum number of patches that are searched for in the whole map: bounds the work."""


class PlaceIndex:
    """Places (P, 2) of a map with covariances (P, 2, 2) each; uses about 1 kB per place.

    Up to `most_matches` of triangles are used, those of the rarest first. Of places (P, 3) in space it gives `motions`
    and those `around` a point.
    """

    def __init__(
        self, position_m: FloatArray, covariance_m2: FloatArray, *, most_matches: int = MOST_MATCHES,
        settings: SlamConfig = USUAL,
    ) -> None:  # fmt: skip
        self._settings, self._rules = settings, settings.association.constellation
        self._most_matches = most_matches
        self._position, self._covariance = np.ascontiguousarray(position_m), covariance_m2
        self._tree = KDTree(self._position)
        self._sigma_m = (
            math.sqrt(float(np.median(np.trace(covariance_m2, axis1=1, axis2=2)))) if len(position_m) else 0.0
        )
        self._corners = _triangles(self._position, self._tree, NEIGHBOURS, self._rules)
        sides, order = _sides(self._position[self._corners])
        self._corners = np.take_along_axis(self._corners, order, axis=1)
        self._by_sides = KDTree(sides, balanced_tree=False)

    def pairs(self, source: LocalMap, *, density: float, probability: float) -> list[tuple[int, int]]:
        """Return pairs (row of `source`, row of the map) that are certain; empty if there are none.

        Args:
            source: the local map, its best known landmarks first.
            density: expected landmarks per square metre, if they are not the same.
            probability: least probability of a pair, against all alignments that differ in this pair only.
        """
        done = np.zeros(len(source.place), dtype=bool)
        for _ in range(TRIES):
            if len(source.place) - int(done.sum()) < 3 or not len(self._corners):
                break
            rows = _patch(source.place, source.place[np.argmin(done)], done)
            done[rows] = True
            found = self._first(source, rows, density, probability)
            if found:
                mine, theirs = np.array(found).T
                left = np.ones(len(source.place), dtype=bool)
                left[rows] = False
                return found + self._further(source, mine, theirs, ~left, density, probability)
        return []

    def motions(self, place: FloatArray, sigma_m: float) -> FloatArray:
        """Return (K, 3) motions that align places (n, 2), of error `sigma_m`, with the map; the best of each part.

        In space they are (K, 7), those of different orientation are others, and fewer than three landmarks give none.
        """
        corners = _triangles(place, KDTree(place), min(NEIGHBOURS + 2, len(place) - 1), self._rules)
        sides, order = _sides(place[corners])
        corners = np.take_along_axis(corners, order, axis=1)
        within = self._rules.side_sigmas * math.hypot(sigma_m, self._sigma_m) + self._rules.side_slack_m
        mine, theirs = self._alike(corners, sides, within)
        motion = rigid(place[mine], self._position[theirs])
        group = group_of(motion)
        best = np.zeros(0, dtype=np.int64)
        count, error, near_m = np.zeros(len(motion)), np.zeros(len(motion)), self._rules.near_m
        for begin in range(0, len(motion), 4096):
            part = slice(begin, begin + 4096)
            gap = self._tree.query(group.transform(motion[part, None], place), distance_upper_bound=near_m)[0]
            count[part] = np.sum(np.isfinite(gap), axis=1)
            error[part] = np.sum(np.minimum(gap, near_m), axis=1)
        middle, left = group.transform(motion, place.mean(axis=0)), np.lexsort((error, -count))
        while len(left) and len(best) < MAX_MOTIONS:
            best = np.append(best, left[0])
            other = np.linalg.norm(middle[left] - middle[left[0]], axis=1) > self._rules.same_place_m
            if group is SPACE:
                turn = group.log(group.between(motion[left[0]], motion[left]))[:, 3:]
                other |= np.linalg.norm(turn, axis=1) > self._settings.association.space.same_turn_rad
            left = left[other]
        return motion[best]

    def _first(self, source: LocalMap, rows: IntArray, density: float, probability: float) -> list[tuple[int, int]]:
        """Pairs of some landmarks, anywhere in the map."""
        rules = self._rules
        local, fewest = source.part(rows), max(3, rules.least_found * len(rows))
        motions = self.motions(local.place, local.beside_m)
        best = se2.transform(motions[:1, None], local.place)
        if np.isfinite(self._tree.query(best, distance_upper_bound=rules.near_m)[0]).sum() < fewest:
            return []
        places = self.around(se2.transform(motions[:, None], local.place).reshape(-1, 2), 2.0 * rules.near_m)
        area_m2 = float(np.prod(np.ptp(self._position, axis=0)))
        elsewhere = math.log(max(1.0, area_m2 / (2.0 * math.pi * rules.free_m * rules.free_m)))
        margins = rules.certain_nats + elsewhere, rules.lead_nats
        found = self._list_agreeing(local, places, list(motions), density, probability, margins)
        return [(int(rows[k]), m) for k, m in found] if len(found) >= fewest else []

    def _further(
        self, source: LocalMap, mine: IntArray, theirs: IntArray, done: BoolArray, density: float, probability: float
    ) -> list[tuple[int, int]]:
        """Pairs of the other landmarks, patch by patch outwards from the known pairs."""
        found: list[tuple[int, int]] = []
        at, to = mine, theirs
        while not done.all():
            left = np.flatnonzero(~done)
            away = np.hypot(*(source.place[left, None] - source.place[at][None]).transpose(2, 0, 1)).min(axis=1)
            start = source.place[left[np.argmin(away)]]
            new = _patch(source.place, start, done)
            done[new] = True
            near = np.argsort(np.hypot(*(source.place[at] - start).T), kind="stable")[:PATCH]
            motion = rigid(source.place[at[near]], self._position[to[near]])
            rows = np.append(at[near], new)
            places = self.around(se2.transform(motion, source.place[rows]), self._rules.reach_m)
            pairs = self._list_agreeing(source.part(rows), places, [motion], density, probability)
            fresh = [(int(rows[k]), m) for k, m in pairs if k >= len(near) and m not in to]
            if fresh:
                found += fresh
                at, to = np.append(at, [k for k, _ in fresh]), np.append(to, [m for _, m in fresh])
        return found

    def around(self, at_m: FloatArray, reach_m: float) -> IntArray:
        """Return rows of the places near any point (n, 2), sorted."""
        near: Any = self._tree.query_ball_point(at_m, reach_m)
        return np.unique(np.fromiter(itertools.chain.from_iterable(near), dtype=np.int64))

    def _list_agreeing(
        self, local: LocalMap, places: IntArray, motions: list[FloatArray], density: float, probability: float,
        margins_nats: tuple[float, float] | None = None,
    ) -> list[tuple[int, int]]:  # fmt: skip
        """Pairs (row of `local`, row of the map) that are certain, among some places; see `list_agreed_pairs`."""
        joint = np.zeros((len(places), 2, len(places), 2))
        rows = np.arange(len(places))
        joint[rows, :, rows, :] = self._covariance[places]
        target = LocalMap(self._position[places], joint.reshape(2 * len(places), 2 * len(places)))
        allowed = np.ones((len(local.place), len(places)), dtype=bool)
        pairs = list_agreed_pairs(
            local, target, allowed, density=density, probability=probability, motions=motions,
            margins_nats=margins_nats, settings=self._settings,
        )  # fmt: skip
        return [(k, int(places[m])) for k, m in pairs]

    def _alike(self, corners: IntArray, sides: FloatArray, within: float) -> tuple[IntArray, IntArray]:
        """(K, 3) corners of local triangles and (K, 3) of matching ones of the map; the rarest first."""
        # spread over the landmarks: some triangles are without new or vanished ones
        chosen = np.arange(len(corners))[:: max(1, len(corners) // LOOKED_UP)][:LOOKED_UP]
        looked: Any = self._by_sides.query_ball_point(sides[chosen][:, _TURNS], within)
        count = np.vectorize(len, otypes=[np.int64])(looked) if len(chosen) else np.zeros((0, len(_TURNS)), np.int64)
        order = np.argsort(count.sum(axis=1), kind="stable")
        fits = np.cumsum(count.sum(axis=1)[order]) <= self._most_matches
        order = order[: max(int(fits.sum()), 1)]
        found = np.fromiter(itertools.chain.from_iterable(looked[order].ravel()), dtype=np.int64)
        mine = corners[chosen[order]][:, _TURNS].reshape(-1, 3)
        return np.repeat(mine, count[order].ravel(), axis=0), self._corners[found]


_TURNS = np.array(list(itertools.permutations(range(3))))
"""Permutations of corners: sides of nearly equal length may be exchanged."""


def _triangles(place: FloatArray, tree: KDTree, neighbours: int, rules: ConstellationConfig) -> IntArray:
    """(T, 3) corners of different triangles of places (n, D), each with two of its nearest; not too large, small or
    flat.
    """
    n = len(place)
    if n < 3:
        return np.zeros((0, 3), dtype=np.int64)
    near: IntArray = np.asarray(tree.query(place, k=min(neighbours, n - 1) + 1)[1])[:, 1:]
    two = np.array(list(itertools.combinations(range(near.shape[1]), 2)))
    corners = np.concatenate([np.repeat(np.arange(n), len(two))[:, None], near[:, two].reshape(-1, 2)], axis=1)
    corners = np.sort(corners, axis=1)
    key = (corners[:, 0] * n + corners[:, 1]) * n + corners[:, 2]
    corners = corners[np.unique(key, return_index=True)[1]]
    at = place[corners]
    a, b = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    squared = (a * a).sum(axis=1) * (b * b).sum(axis=1) - (a * b).sum(axis=1) ** 2
    area = 0.5 * np.sqrt(np.maximum(squared, 0.0))
    length = np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2)
    longest = length.max(axis=1)
    good = (longest < rules.longest_side_m) & (length.min(axis=1) > rules.least_span_m)
    good &= area > FLATTEST * longest**2
    return np.asarray(corners[good])


def _sides(at: FloatArray) -> tuple[FloatArray, IntArray]:
    """(T, 3) lengths of the sides of triangles (T, 3, D), longest first, and (T, 3) the corners opposite to them."""
    length = np.linalg.norm(np.roll(at, -1, axis=1) - np.roll(at, -2, axis=1), axis=2)
    order = np.argsort(-length, axis=1, kind="stable")
    return np.take_along_axis(length, order, axis=1), order


def _patch(place: FloatArray, start: FloatArray, done: BoolArray) -> IntArray:
    """Rows of the landmarks nearest to a point that are not done."""
    away = np.where(done, np.inf, np.hypot(*(place - start).T))
    near = np.argsort(away, kind="stable")[:PATCH]
    return np.asarray(near[np.isfinite(away[near])])
