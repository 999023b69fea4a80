"""Starts in a map of which a part is wrong: the session by itself, laid over the places that most of it agrees on.

From a start by all places of a map, those that moved bend the poses until detections of places that stand look like
outliers. A session by itself is bent by nothing. So it is laid over the map by consensus, and only places that agree
are held. Which start is best is a question of evidence: of the detections, and of a map whose places stand or moved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from evermap.align.candidates import AGREE_M, Matches, rank_motions
from evermap.slam.space.against_map import cost_in_map, square
from evermap.slam.space.estimate import SpatialOptimum, converge
from evermap.slam.space.problem import LEAST_WEIGHT, PlacePrior, SpatialEstimate, SpatialProblem
from evermap.types import BoolArray, FloatArray, IntArray

MOST_MOTIONS = 2
"""Different motions that are tried."""
CLOSER = 0.5
"""Share of the distance within which places usually agree, that is tried, too."""
FEWEST = 3
"""Places that agree, at least."""


def start_by_consensus(
    problem: SpatialProblem, alone: SpatialOptimum, stated: FloatArray
) -> tuple[SpatialOptimum, float] | None:
    """Return the most probable optimum in a map from the session by itself, and its cost; None if nothing agrees.

    Args:
        problem: with a prior map.
        alone: the same without the map.
        stated: (K, 6) standard deviations of the map's places.
    """
    best: tuple[SpatialOptimum, float] | None = None
    spread = spread_loosely(problem, stated)
    tried = list[BoolArray]()
    for agree_m in (AGREE_M, CLOSER * AGREE_M):
        for start, agree in _overlays(problem.prior, alone, agree_m):
            if any(np.array_equal(agree, other) for other in tried):
                continue
            tried.append(agree)
            held = replace(problem, prior=replace(problem.prior, weight=np.where(agree, 1.0, LEAST_WEIGHT)))
            found = converge(held, start, alone.noise, heavy_rounds=1)
            cost = cost_in_map(found, spread, alone.noise)
            if best is None or cost < best[1]:
                best = found, cost
    return best


def spread_loosely(problem: SpatialProblem, stated: FloatArray) -> FloatArray:
    """Return covariances (K, 6, 6) of places of a map before it is known which of them stand, as of `cost_in_map`."""
    return square(np.maximum(stated, problem.settings.map.loose_m))


def _overlays(prior: PlacePrior, alone: SpatialOptimum, agree_m: float) -> list[tuple[SpatialEstimate, BoolArray]]:
    """Return a session by itself as it may lie in the map, and which places of the prior (K,) agree there.

    A part of it that no frame ties to the rest lies by itself, where the rest says nothing of it.
    """
    problem, estimate = alone.smoother.problem, alone.estimate
    hits = np.bincount(problem.place, alone.now.weight, minlength=len(problem.oriented))[prior.place]
    seen, (of_pose, of_place) = hits > problem.settings.map.least_seen, _rigid_parts(alone)
    found = list[tuple[SpatialEstimate, BoolArray]]()
    for whole, first_agree in _motions(prior, estimate.place, seen, agree_m):
        agree, by_pose, by_place = first_agree, *(np.tile(whole, (len(of), 1)) for of in (of_pose, of_place))
        for part in range(int(of_place.max()) + 1):
            mine = seen & (of_place[prior.place] == part)
            if 2 * np.count_nonzero(agree & mine) >= np.count_nonzero(mine):
                continue
            for motion, here in _motions(prior, estimate.place, mine, agree_m)[:1]:
                by_pose[of_pose == part] = by_place[of_place == part] = motion
                agree = np.where(mine, here, agree)
        found.append((estimate.moved(by_pose, problem.oriented, by_place), agree))
    return found


def _motions(
    prior: PlacePrior, place: FloatArray, some: BoolArray, agree_m: float
) -> list[tuple[FloatArray, BoolArray]]:
    """Motions (7,) by which most of some places of the prior (K,) are where the map has them, and which (K,) agree."""
    row, found = np.flatnonzero(some), list[tuple[FloatArray, BoolArray]]()
    if len(row) < FEWEST:
        return found
    matches = Matches.of(place[prior.place[row], :3], prior.pose[row, :3])
    for motion, agree in rank_motions(matches, most=MOST_MOTIONS, agree_m=agree_m):
        of_all = np.zeros(len(some), dtype=np.bool_)
        of_all[row[agree]] = True
        if np.count_nonzero(agree) >= FEWEST:
            found.append((motion, of_all))
    return found


def _rigid_parts(alone: SpatialOptimum) -> tuple[IntArray, IntArray]:
    """Return which part each pose (N,) and each place (P,) is of: between two parts no frame has an inlier of both."""
    problem = alone.smoother.problem
    n, count = len(problem.stamp_s), len(problem.oriented)
    good = alone.now.weight > problem.settings.inlier
    graph = csr_array(
        (np.ones(int(good.sum())), (problem.pose_row[good], n + problem.place[good])), shape=(n + count, n + count)
    )
    part = connected_components(graph, directed=False)[1].astype(np.int64)
    return part[:n], part[n:]
