"""Starts in a map of which a part is wrong: the session by itself, laid over the places that most of it agree on.

From a start by all places of a map, those that moved bend the poses until detections of places that stand look like
outliers. A session by itself is bent by nothing. So it is laid over the map by consensus, and only places that agree
are held. Which start is best is a question of evidence: of the detections, and of a map whose places stand or moved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.align.candidates import AGREE_M, Matches, rank_motions
from evermap.geometry import se3
from evermap.slam.space.estimate import SpatialOptimum, as_seen, converged
from evermap.slam.space.problem import LEAST_WEIGHT, SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.smoother import SpatialSmoother
from evermap.types import BoolArray, FloatArray

MOST_MOTIONS = 2
"""Different motions that are tried."""
CLOSER = 0.5
"""Share of the distance within which places usually agree, that is tried, too."""
FEWEST = 3
"""Places that agree, at least."""
SAME_M = 0.2
"""Sightings that put a place within this distance agree [m]."""
FEWEST_SIGHTINGS = 2
"""Sightings that agree where a place is put."""
ROUNDS = 6
"""Times that places are put elsewhere, at most."""


def laid_by_consensus(
    problem: SpatialProblem, alone: SpatialOptimum, stated: FloatArray
) -> tuple[SpatialOptimum, float] | None:
    """Return the most probable optimum in the map from the session by itself, and its cost; None if nothing agrees.

    Args:
        problem: with a prior map.
        alone: the session by itself; its first places are those of the problem.
        stated: (K, 6) standard deviations of the map's places.
    """
    prior, count = problem.prior, len(problem.oriented)
    hits = np.bincount(alone.smoother.problem.place, alone.now.weight, minlength=count)[prior.place]
    seen = np.flatnonzero(hits > problem.settings.map.least_seen)
    at, known = alone.estimate.place[prior.place[seen], :3], prior.pose[seen, :3]
    best: tuple[SpatialOptimum, float] | None = None
    tried = list[BoolArray]()
    for agree_m in (AGREE_M, CLOSER * AGREE_M):
        for motion, agree in rank_motions(Matches.of(at, known), most=MOST_MOTIONS, agree_m=agree_m):
            if np.count_nonzero(agree) < FEWEST or any(np.array_equal(agree, other) for other in tried):
                continue
            tried.append(agree)
            place = se3.compose(motion, alone.estimate.place[:count])
            place[~problem.oriented, 3:] = se3.NO_TURN
            start = SpatialEstimate(se3.compose(motion, alone.estimate.pose), place, alone.estimate.state)
            weight = np.full(len(prior.place), LEAST_WEIGHT)
            weight[seen[agree]] = 1.0
            held = replace(problem, prior=replace(prior, weight=weight))
            found = reseated(converged(held, start, alone.noise, heavy_rounds=1), stated)
            cost = cost_in_map(found, stated, alone.noise)
            if best is None or cost < best[1]:
                best = found, cost
    return best


def reseated(optimum: SpatialOptimum, stated: FloatArray) -> SpatialOptimum:
    """Return the optimum with places where most of their sightings put them, as long as that is more probable.

    What the map holds at a wrong place looks like outliers only, and says nothing of where it is.
    """
    noise = optimum.noise
    cost = cost_in_map(optimum, stated, noise)
    for _ in range(ROUNDS):
        start = _with_places_as_seen(optimum)
        if start is None:
            break
        found = converged(start[0], start[1], noise, heavy_rounds=0)
        after = cost_in_map(found, stated, noise)
        if after > cost - optimum.smoother.problem.settings.repair.gain_nats:
            break
        optimum, cost = found, after
    return optimum


def _with_places_as_seen(optimum: SpatialOptimum) -> tuple[SpatialProblem, SpatialEstimate] | None:
    """The problem and values with mapped places where more sightings agree than are inliers now; None without any.

    Frames in which nothing else is an inlier do not count: they may be anywhere.
    """
    problem, estimate, weight = optimum.smoother.problem, optimum.estimate, optimum.now.weight
    inlier = weight > problem.settings.inlier
    at = as_seen(problem, estimate, problem.measured)[:, :3]
    others = np.bincount(problem.pose_row[inlier], minlength=len(problem.stamp_s))[problem.pose_row] - inlier
    place, of_map = estimate.place.copy(), problem.prior.weight.copy()
    changed = False
    for k, row in enumerate(problem.prior.place.tolist()):
        mine = np.flatnonzero((problem.place == row) & (others > 0))
        if len(mine) < FEWEST_SIGHTINGS:
            continue
        near = np.linalg.norm(at[mine, None] - at[None, mine], axis=2) < SAME_M
        centre = int(np.argmax(near.sum(axis=1)))
        agree = mine[near[centre]]
        there = np.median(at[agree], axis=0)
        if len(agree) <= max(FEWEST_SIGHTINGS - 1, int(inlier[problem.place == row].sum())):
            continue
        if np.linalg.norm(there - place[row, :3]) > SAME_M:
            place[row, :3], of_map[k], changed = there, LEAST_WEIGHT, True
    if not changed:
        return None
    return replace(problem, prior=replace(problem.prior, weight=of_map)), replace(estimate, place=place)


def cost_in_map(optimum: SpatialOptimum, stated: FloatArray, noise: SpatialNoise) -> float:
    """Return the negative log posterior with places of the map that stand or moved, up to a constant.

    Args:
        optimum: values.
        stated: (K, 6) standard deviations of the map's places.
        noise: levels, the same for all that are compared.
    """
    problem, settings = optimum.smoother.problem, optimum.smoother.problem.settings.map
    nothing = replace(problem, prior=replace(problem.prior, weight=np.zeros(len(problem.prior.place))))
    cost = SpatialSmoother(nothing, optimum.estimate.pose).linearised(optimum.estimate, noise, heavy=False).cost
    seen = np.bincount(problem.place, minlength=len(problem.oriented))[problem.prior.place] > 0
    for k in np.flatnonzero(seen).tolist():
        row = int(problem.prior.place[k])
        off = problem.off_map(np.array([k]), optimum.estimate.place[row][None], oriented=bool(problem.oriented[row]))[0]
        sigma = np.maximum(stated[k, : len(off)], settings.loose_m)
        scales = [(m, rad) for m in settings.moved_m for rad in settings.moved_rad[: None if len(off) == 6 else 1]]
        moved = [_log_density(off, np.hypot(sigma, [m] * 3 + [rad] * (len(off) - 3))) for m, rad in scales]
        stands = np.log1p(-settings.p_moved) + _log_density(off, sigma)
        away = np.log(settings.p_moved) + np.logaddexp.reduce(moved) - np.log(len(scales))
        cost -= float(np.logaddexp(stands, away))
    return cost


def _log_density(off: FloatArray, sigma: FloatArray) -> float:
    return float(-0.5 * np.sum((off / sigma) ** 2) - np.log(sigma).sum())
