"""Out of wrong optima: poses and orientations that another explanation of the same views fits better.

The view of a single far tag has two explanations, and the optimum of one is no way to the other. So the poses that
every detection by itself suggests, in both ways, are asked, and the orientations that all detections of a place vote.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.geometry import se3
from evermap.slam.space.estimate import SpatialOptimum, as_seen, converged, oriented
from evermap.slam.space.linearise import linearise_sightings
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.types import FloatArray, IntArray

ROUNDS = 3
BETTER = 6.0
"""Nats by which the detections of a stretch of frames must prefer other poses."""
OTHER_RAD = 0.3
"""Orientations that differ by more are two explanations."""
GAIN = 3.0
"""Nats by which all must be more probable in the end."""
TOGETHER_M = 0.5
"""Outliers of one identity that are this close are another landmark which carries it."""
FEWEST, FEWEST_FRAMES = 5, 3
"""Detections, and frames, that it takes."""
LEAST_SEEN = 1.0
"""Sum of inlier probabilities below which a landmark was not seen at its place."""
LEAST_WEIGHT = 1e-6
"""Of a map's word on a landmark that is elsewhere."""
MOVED_NATS = 5.0
"""What it costs that a landmark of the map was moved, instead of the robot."""
ONLY_THERE = 0.9
"""Share of a landmark's sightings in a stretch of frames with which it can have moved without a trace elsewhere."""


def repaired(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum, or a better one that begins where other explanations lead."""
    problem = optimum.smoother.problem
    for _ in range(ROUNDS):
        start, asked = other_explanations(problem, optimum)
        if not asked:
            break
        found = converged(problem, start, optimum.noise, heavy_rounds=0)
        # at the same noise, or a level that fits worse would look better
        cost = optimum.smoother.linearised(found.estimate, optimum.noise, heavy=False).cost
        if cost > optimum.now.cost - GAIN:
            break
        optimum = found
    return optimum


def unjumped(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum, or a better one in which not the robot jumped, but landmarks of the map were moved.

    A robot that sees only things that were carried away together finds itself where these had been, and jumps back
    with the next view. So each stretch of frames between jumps of the odometry is asked once more without them.
    """
    for _ in range(ROUNDS):
        jumps = np.flatnonzero(optimum.now.odometry_weight < 0.5)
        bounds = np.unique(np.concatenate([[0], jumps + 1, [len(optimum.estimate.pose)]]))
        stretches = zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
        better = next((found for a, b in stretches if (found := _as_driven(optimum, a, b)) is not None), None)
        if not len(jumps) or better is None:
            break
        optimum = better
    return optimum


def _as_driven(optimum: SpatialOptimum, first: int, end: int) -> SpatialOptimum | None:
    """The optimum with a stretch of frames where the odometry has it, and what was seen only there moved with it; None
    if that is no better.
    """
    problem, pose = optimum.smoother.problem, optimum.estimate.pose
    if 2 * (end - first) > len(pose):
        return None
    inside = (problem.pose_row >= first) & (problem.pose_row < end)
    seen, there = (
        np.bincount(problem.place, optimum.now.weight * some, minlength=len(problem.oriented))
        for some in (np.ones(len(inside)), inside)
    )
    only = np.flatnonzero((there >= LEAST_SEEN) & (there >= ONLY_THERE * seen))
    held = np.isin(problem.prior.place, only)
    if not held.any():
        return None
    if first:
        at, to = first, se3.compose(pose[first - 1], problem.increment[first - 1])
    else:
        at, to = end - 1, se3.compose(pose[end], se3.inverse(problem.increment[end - 1]))
    motion = se3.compose(to, se3.inverse(pose[at]))
    start = replace(optimum.estimate, pose=pose.copy(), place=optimum.estimate.place.copy())
    start.pose[first:end] = se3.compose(motion, pose[first:end])
    start.place[only] = se3.compose(motion, start.place[only])
    prior = replace(problem.prior, weight=np.where(held, LEAST_WEIGHT, problem.prior.weight))
    found = converged(replace(problem, prior=prior), start, optimum.noise, heavy_rounds=0)
    cost = found.smoother.linearised(found.estimate, optimum.noise, heavy=False).cost
    return found if cost + MOVED_NATS * held.sum() < optimum.now.cost - GAIN else None


def other_explanations(problem: SpatialProblem, optimum: SpatialOptimum) -> tuple[SpatialEstimate, bool]:
    """Return the values with poses and orientations that fit better by themselves, and whether there are any."""
    estimate, noise = optimum.estimate, optimum.noise
    voted = oriented(problem, estimate, optimum.now.weight)
    turned = se3.angle_between(voted, estimate.place)
    place = np.where((turned > OTHER_RAD)[:, None], voted, estimate.place)
    pose, n_better = _better_poses(problem, replace(estimate, place=place), noise)
    return replace(estimate, pose=pose, place=place), n_better + int((turned > OTHER_RAD).sum()) > 0


def _better_poses(problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise) -> tuple[FloatArray, int]:
    """Poses (N, 7), other ones where a stretch of frames fits them better; and in how many frames."""
    cost = _cost_of_frames(problem, estimate, noise)
    best, pose = cost.copy(), estimate.pose.copy()
    mount = estimate.mount(problem)[problem.sensor]
    oriented_place = problem.oriented[problem.place]
    rank = np.arange(len(problem.place)) - np.searchsorted(problem.pose_row, problem.pose_row)
    for measured in problem.either:
        suggested = se3.compose(estimate.place[problem.place], se3.inverse(se3.compose(mount, measured)))
        for k in range(int(rank.max(initial=-1)) + 1):
            some = np.flatnonzero((rank == k) & oriented_place)
            rows = problem.pose_row[some]
            trial = estimate.pose.copy()
            trial[rows] = suggested[some]
            found = _cost_of_frames(problem, replace(estimate, pose=trial), noise)
            better = rows[found[rows] < best[rows]]
            best[better], pose[better] = found[better], trial[better]
    gain = cost - best
    seen_in = np.unique(problem.pose_row)
    off = se3.local(estimate.pose[seen_in], pose[seen_in])
    jumps = (np.linalg.norm(off[:, 3:], axis=1) > 0.1) & (gain[seen_in] > 0.0)
    stretch = np.cumsum(np.diff(jumps.astype(np.int64), prepend=0) != 0)
    total = np.bincount(stretch, gain[seen_in] * jumps, minlength=int(stretch.max(initial=0)) + 1)
    taken = seen_in[jumps & (total[stretch] > BETTER)]
    mixed = estimate.pose.copy()
    mixed[taken] = pose[taken]
    return mixed, len(taken)


def _cost_of_frames(problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise) -> FloatArray:
    """(N,) negative log likelihood of the detections in each frame, up to a constant."""
    seen = problem.sightings
    values, weight = np.empty(int(seen.first[-1])), np.empty(len(seen.kind))
    residual = np.zeros((len(seen.kind), 8))
    linearise_sightings(
        estimate.pose, estimate.place, estimate.mount(problem), problem.velocity, noise.levels, seen, False, values,
        weight, residual,
    )  # fmt: skip
    squared = (residual**2).sum(axis=1)
    d = 0.5 * squared - seen.log_odds[seen.kind]
    loss = 0.5 * squared - np.logaddexp(0.0, d)
    return np.bincount(problem.pose_row, problem.share * loss, minlength=len(estimate.pose)).astype(np.float64)


def rejoined(optimum: SpatialOptimum, identity: IntArray) -> tuple[SpatialProblem, SpatialEstimate] | None:
    """Return the problem with landmarks of one identity put together that came to be at one place; None without any.

    The same where the first of them is not seen any more, or this one hardly ever.
    """
    problem, estimate = optimum.smoother.problem, optimum.estimate
    place, at = problem.place.copy(), estimate.place.copy()
    hits = np.bincount(place, optimum.now.weight, minlength=len(at))
    held = np.isin(np.arange(len(at)), problem.prior.place)
    for row in range(int(identity.max(initial=-1)) + 1, len(identity)):
        own = int(identity[row])
        near = np.linalg.norm(at[row, :3] - at[own, :3]) < TOGETHER_M
        if near or hits[row] < FEWEST or (hits[own] < LEAST_SEEN and not held[own]):
            at[own] = at[row] if hits[row] > hits[own] else at[own]
            place[place == row] = own
    if np.array_equal(place, problem.place):
        return None
    return replace(problem, place=place), replace(estimate, place=at)


def split(optimum: SpatialOptimum, identity: IntArray) -> tuple[SpatialProblem, SpatialEstimate, IntArray] | None:
    """Return the problem with places of their own for landmarks that carry the identity of others; None without any.

    Of a landmark that was never seen where a map has it the first of them is its own: it was moved there.

    Args:
        optimum: with outliers.
        identity: (P,) rows of landmarks that the places are of; grows by that of each new place.
    """
    problem, estimate = optimum.smoother.problem, optimum.estimate
    outlier = optimum.now.weight < 0.5
    located = np.zeros(len(estimate.pose), dtype=np.bool_)
    located[problem.pose_row[~outlier]] = True
    located |= problem.driven
    asked = outlier & located[problem.pose_row]
    at = as_seen(problem, estimate, problem.measured)
    place, places, oriented_too, whose = problem.place.copy(), list[FloatArray](), [], []
    at_places, prior = estimate.place.copy(), problem.prior
    unseen = np.bincount(problem.place, optimum.now.weight, minlength=len(at_places)) < LEAST_SEEN
    for known in np.unique(problem.place[asked]):
        mine = np.flatnonzero(asked & (problem.place == known))
        while len(mine) >= FEWEST:
            gap = np.linalg.norm(at[mine, None, :3] - at[None, mine, :3], axis=2)
            centre = int(np.argmax((gap < TOGETHER_M).sum(axis=1)))
            near = mine[gap[centre] < TOGETHER_M]
            away = np.linalg.norm(np.median(at[near, :3], axis=0) - estimate.place[known, :3])
            if len(near) < FEWEST or len(np.unique(problem.pose_row[near])) < FEWEST_FRAMES or away < TOGETHER_M:
                break
            if unseen[known]:
                at_places[known], unseen[known] = at[mine[centre]], False
                prior = replace(prior, weight=np.where(prior.place == known, LEAST_WEIGHT, prior.weight))
            else:
                place[near] = len(estimate.place) + len(places)
                places.append(at[mine[centre]])
                oriented_too.append(problem.oriented[known])
                whose.append(identity[known])
            mine = mine[gap[centre] >= TOGETHER_M]
    if not places and prior is problem.prior:
        return None
    larger = replace(
        problem, place=place, oriented=np.append(problem.oriented, oriented_too).astype(np.bool_), prior=prior
    )
    added = replace(estimate, place=np.vstack([at_places, *places]))
    return larger, added, np.append(identity, whose).astype(np.int64)
