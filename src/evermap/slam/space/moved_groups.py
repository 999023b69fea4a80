"""The joint search over changes in space: which places of a given map moved together, with the trajectory marginalised.

Place by place, four tags on one shelf are four coincidences, and where the robot sees little else it is the robot that
seems elsewhere. So the map is loosened until it bends nothing, the whole is moved to where most places agree, and the
search of `slam.changes` weighs all sets of groups by the evidence there. The places of the best set are let go.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.align.candidates import AGREE_M, Matches, find_consensus
from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import exhaust
from evermap.slam.changes.weigh import MAP_FACTORS, ChangePosterior, weigh
from evermap.slam.space.against_map import AgainstMap, MovedTogether, evidence_against
from evermap.slam.space.estimate import SpatialOptimum, converge
from evermap.slam.space.problem import ANY_RAD, LEAST_WEIGHT
from evermap.slam.space.smoother import SpatialSmoother
from evermap.types import BoolArray, FloatArray, IntArray

LOOSE_RAD, UNKNOWN_RAD = 1.0, 1e3
"""Standard deviations of the orientations of a map that bends nothing, and of those that it doesn't know."""
LEAST_AGREE_M = 0.1
"""Least distance within which places agree where the whole is moved to these [m]."""
MOST_PLACES = 250
"""Places of a map that are searched together, as their information is a dense matrix; larger maps are not."""
FACTORS = tuple(factor for factor in MAP_FACTORS if factor >= 1.0)
"""By which the standard deviations of the map may be wrong. One factor is for positions and orientations, so that those
that are better than stated must not make the others look as good."""
FEWEST = 3
"""Places that agree where the whole is to be moved."""


def find_moved_groups(
    optimum: SpatialOptimum, stated: FloatArray, changes: ChangesConfig
) -> tuple[SpatialOptimum, tuple[MovedTogether, ...]]:
    """Return the optimum with the places of groups that moved let go, and these groups; the same where none did.

    Without odometry nothing is searched: whether a part of the map moved or the frames that see it alone are elsewhere,
    no measurement tells.

    Args:
        optimum: of a problem with a prior map.
        stated: (K, 6) standard deviations of the map's places.
        changes: settings of the search.
    """
    problem, prior = optimum.smoother.problem, optimum.smoother.problem.prior
    if not problem.driven or len(prior.place) > MOST_PLACES:
        return optimum, ()
    found: list[tuple[ChangePosterior, SpatialOptimum, AgainstMap]] = []
    for free in _loosen(optimum, stated, changes):
        against = evidence_against(free, stated)
        if len(against.row):
            found.append((exhaust(weigh(against.evidence, against.given, changes, 1, factors=FACTORS)), free, against))
    if not found:
        return optimum, ()
    posterior, free, against = max(found, key=lambda one: one[0].score)
    if len(posterior.groups) >= changes.most_groups:  # perhaps more moved, and what has no group of its own was merged
        return optimum, ()
    groups = tuple(
        MovedTogether(against.row[group.members], group.turns, group.motion, _probability(posterior, group.members))
        for group in posterior.groups
    )
    if not groups:
        return optimum, ()
    moved = np.isin(np.arange(len(prior.place)), np.concatenate([group.members for group in groups]))
    held = replace(prior, weight=np.where(moved, LEAST_WEIGHT, 1.0))
    return converge(replace(problem, prior=held), free.estimate, free.noise, heavy_rounds=1), groups


def _loosen(optimum: SpatialOptimum, stated: FloatArray, changes: ChangesConfig) -> list[SpatialOptimum]:
    """Return optima by a map that bends nothing, at where most of its places are, with errors that last counted.

    At first every place counts, and those that moved draw the whole along; then those that agree with each other. How
    near they come when they do is not known: where places are nearly on one line, a turn about that brings them all
    rather near. So two distances are tried; the session is the same, and the search tells where the map fits better.
    """
    problem, prior = optimum.smoother.problem, optimum.smoother.problem.prior
    unknown = stated[:, 3:] >= ANY_RAD
    sigma = np.maximum(stated, np.repeat([changes.loose_map_m, LOOSE_RAD], 3))
    sigma[:, 3:][unknown] = UNKNOWN_RAD
    loose = replace(problem, prior=replace(prior, sigma=sigma, weight=np.ones(len(prior.place))))
    free = converge(loose, optimum.estimate, optimum.noise, heavy_rounds=1)
    hits = np.bincount(problem.place, free.now.weight, minlength=len(problem.oriented))[prior.place]
    seen = np.flatnonzero(hits > problem.settings.map.least_seen)
    at, known = free.estimate.place[prior.place[seen]], prior.pose[seen].copy()
    plain = problem.oriented[prior.place[seen]] & (problem.symmetries.of[prior.place[seen]] == 0)
    known[~plain | unknown[seen].any(axis=1), 3:] = np.nan
    found, tried = list[SpatialOptimum](), list[BoolArray]()
    for agree_m in (AGREE_M, float(max(LEAST_AGREE_M, 3.0 * np.median(stated[:, 0])))):
        motion, agree = find_consensus(Matches.of(at, known), agree_m=agree_m)
        if np.count_nonzero(agree) < FEWEST or any(np.array_equal(agree, other) for other in tried):
            continue
        tried.append(agree)
        start = free.estimate.moved(motion, problem.oriented)
        weight = np.full(len(prior.place), LEAST_WEIGHT)
        weight[seen[agree]] = 1.0
        there = replace(loose, prior=replace(loose.prior, weight=weight))
        found.append(_count_again(SpatialOptimum(start, free.noise, SpatialSmoother(there, start.pose), free.now)))
    return found or [_count_again(free)]


def _count_again(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum next to this, with errors of detections that last counted as what they are worth."""
    smoother = optimum.smoother.counted(optimum.estimate, optimum.now)
    estimate, now = smoother.optimum(optimum.estimate, optimum.noise, heavy=False)
    return SpatialOptimum(estimate, optimum.noise, smoother, now)


def _probability(posterior: ChangePosterior, members: IntArray) -> float:
    """Return how probable it is that exactly these moved together, over all that was weighed."""
    weighed = ((posterior.groups, posterior.probability), *posterior.alternatives)
    return sum(p for groups, p in weighed if any(np.array_equal(group.members, members) for group in groups))
