"""Escapes from wrong optima: poses and orientations that another explanation of the same views fits better.

The view of a single far tag has two explanations, and the optimum of one is no way to the other. So the poses that
every detection by itself suggests, in both ways, are asked, and the orientations that all detections of a place vote.
A wrong identity that is alone in view explains itself by two jumps of the odometry, which are asked to be none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from evermap.geometry import se3
from evermap.slam.space.estimate import MOST_CANDIDATES, SpatialOptimum, as_seen, converge, oriented
from evermap.slam.space.linearise import linearise_sightings
from evermap.slam.space.problem import LEAST_WEIGHT, SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.starts import locate_again
from evermap.types import BoolArray, FloatArray, IntArray

MOST_TURNED = 6
"""Places whose other orientation is tried in a round, at most."""
ROUNDS = 3
"""Times that other explanations are tried, at most."""
STEPS, ENDING = 20, 0.1
"""Gauss-Newton steps from one of them, at most, before it is known whether it is better; the last gains less than this
share of what it must."""


def repaired(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum, or a better one that begins where other explanations lead."""
    problem, gain_nats = optimum.smoother.problem, optimum.smoother.problem.settings.repair.gain_nats
    asked: dict[object, SpatialOptimum] = {}  # what each was last asked about: of the same it says the same
    for _ in range(ROUNDS):
        before = optimum
        for explain in (bridge_poses, other_explanations, _locate_again):
            if asked.get(explain) is optimum:
                continue
            asked[explain] = optimum
            if (start := explain(optimum)) is None:
                continue
            # at the same noise, or a level that fits worse would look better
            found, there = optimum.smoother.optimum(
                start, optimum.noise, heavy=False, iterations=STEPS, settled=ENDING * gain_nats
            )
            if there.cost < optimum.now.cost - gain_nats:
                optimum = converge(problem, found, optimum.noise, heavy_rounds=0)
        if optimum is before and (optimum := _with_one_turned(optimum)) is before:
            break
    return optimum


def _with_one_turned(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum, or a better one in which a place has the other orientation that explains its views.

    Poses from which little else is seen follow a wrong orientation, so that no vote at their optimum tells of it.
    """
    smoother, noise, gain_nats = optimum.smoother, optimum.noise, optimum.smoother.problem.settings.repair.gain_nats
    turned, asked = _turn_places(optimum)
    both = (
        _losses(smoother.problem, replace(optimum.estimate, place=at), noise) for at in (turned, optimum.estimate.place)
    )
    more = smoother.problem.share * np.subtract(*both)
    cost = np.bincount(smoother.problem.place, more, minlength=len(turned))[asked]
    wanted = optimum.now.cost - gain_nats
    for row in asked[np.argsort(cost, kind="stable")[:MOST_TURNED]].tolist():
        place = optimum.estimate.place.copy()
        place[row] = turned[row]
        found, there = smoother.optimum(
            replace(optimum.estimate, place=place), noise, heavy=False, iterations=STEPS, settled=ENDING * gain_nats,
            wanted=wanted,
        )  # fmt: skip
        if there.cost < wanted:
            return converge(smoother.problem, found, noise, heavy_rounds=0)
    return optimum


def _turn_places(optimum: SpatialOptimum) -> tuple[FloatArray, IntArray]:
    """Return places (P, 7), turned as their views say by the explanation that is not taken, and rows (K,) of these."""
    problem, estimate, weight = optimum.smoother.problem, optimum.estimate, optimum.now.weight
    sigma = np.hypot(problem.sigma_rad * optimum.noise.pixel, problem.settings.repair.same_rad)
    both = np.stack([as_seen(problem, estimate, measured) for measured in problem.either])
    angle = se3.angle_between(both, estimate.place[problem.place])
    other = np.where((angle[0] < angle[1])[:, None], both[1], both[0])
    asked = np.isfinite(problem.other[:, 3]) & problem.oriented[problem.place]
    turned, rows = estimate.place.copy(), np.unique(problem.place[asked])
    for place in rows.tolist():
        mine = np.flatnonzero(asked & (problem.place == place))
        mine = mine[:: max(1, len(mine) // MOST_CANDIDATES)]
        off = se3.angle_between(other[mine, None], other[mine]) / sigma[mine]
        best = mine[int(np.argmax(np.exp(-0.5 * off**2) @ weight[mine]))]
        turned[place, 3:] = other[best, 3:]
    return turned, rows


def _locate_again(optimum: SpatialOptimum) -> SpatialEstimate | None:
    return locate_again(optimum.smoother.problem, optimum.noise, optimum.estimate, optimum.now.weight)


def bridge_poses(optimum: SpatialOptimum) -> SpatialEstimate | None:
    """Return the values with frames between jumps of the odometry where it has them, if that is cheaper; else None."""
    smoother, now, estimate, problem = optimum.smoother, optimum.now, optimum.estimate, optimum.smoother.problem
    bounds, n = np.flatnonzero(now.odometry_weight < 0.5) + 1, len(optimum.estimate.pose)
    if not problem.driven or not len(bounds):
        return None
    ends = np.unique(np.append(bounds, [0, n]))
    # at the odometry's poses all that is seen there is an outlier: no gain where that costs more than the jumps
    seen, sightings = problem.pose_row, problem.sightings
    lost = np.append(0.0, np.cumsum(np.bincount(seen, now.weight * sightings.log_odds[sightings.kind], minlength=n)))
    found: list[tuple[float, int, int]] = []
    for k, first in enumerate(ends[:-1].tolist()):
        for end in ends[k + 1 : k + 1 + problem.settings.repair.jumps].tolist():
            jumps = np.count_nonzero((bounds >= first) & (bounds <= end))
            if lost[end] - lost[first] < jumps * problem.settings.jump_log_odds:
                trial = _bridge_poses(problem, estimate, first, end)
                found.append((smoother.linearised(trial, optimum.noise, heavy=False).cost - now.cost, first, end))
    taken = np.zeros(n, dtype=np.bool_)
    for cost, first, end in sorted(found):
        if cost < 0.0 and not taken[max(first - 1, 0) : end + 1].any():
            estimate, taken[first:end] = _bridge_poses(problem, estimate, first, end), True
    return estimate if taken.any() else None


def _bridge_poses(problem: SpatialProblem, estimate: SpatialEstimate, first: int, end: int) -> SpatialEstimate:
    """The values with some poses by the odometry, from the pose before them to the one after them."""
    pose = estimate.pose.copy()
    step = se3.scaled(problem.increment, np.exp(estimate.log_scale))
    if first == 0:
        for k in range(end - 1, -1, -1):
            pose[k] = se3.compose(pose[k + 1], se3.inverse(step[k]))
        return replace(estimate, pose=pose)
    for k in range(first, min(end + 1, len(pose))):
        pose[k] = se3.compose(pose[k - 1], step[k - 1])
    if end < len(pose):
        stamp, some = problem.stamp_s, slice(first, end + 1)
        share = (stamp[some] - stamp[first - 1]) / (stamp[end] - stamp[first - 1])
        pose[some] = se3.retract(pose[some], share[:, None] * se3.local(pose[end], estimate.pose[end]))
    return replace(estimate, pose=pose)


def undo_jumps(optimum: SpatialOptimum) -> SpatialOptimum:
    """Return the optimum, or a better one in which landmarks of the map were moved instead of a jump of the robot.

    A robot that sees only things that were carried away together finds itself where these had been, and jumps back
    with the next view. So the stretches of frames between jumps of the odometry are asked once more without them,
    those together that see the same landmarks of the map.
    """
    for _ in range(ROUNDS):
        problem = optimum.smoother.problem
        bounds = np.flatnonzero(optimum.now.odometry_weight < 0.5) + 1
        if not len(bounds):
            break
        stretch = np.searchsorted(bounds, np.arange(len(optimum.estimate.pose)), side="right")
        seen = np.zeros((len(bounds) + 1, len(problem.oriented)))
        np.add.at(seen, (stretch[problem.pose_row], problem.place), optimum.now.weight)
        known = (seen >= problem.settings.map.least_seen) & np.isin(np.arange(seen.shape[1]), problem.prior.place)
        group = connected_components(known.astype(np.int64) @ known.T, directed=False)[1]
        nowhere = ~known.any(axis=1)  # follows what is before it
        asked = [
            _as_driven(optimum, stretch, (group == one) | nowhere, known[group == one].any(axis=0))
            for one in np.unique(group)
        ]
        cost, best = min((found for found in asked if found is not None), key=lambda one: one[0], default=(0.0, None))
        if best is None or cost > optimum.now.cost - problem.settings.repair.gain_nats:
            break
        optimum = best
    return optimum


def _as_driven(
    optimum: SpatialOptimum, stretch: IntArray, some: BoolArray, moved: BoolArray
) -> tuple[float, SpatialOptimum] | None:
    """The optimum with some stretches where the odometry has them, and places moved with the first; and its cost.

    None for stretches without such places, or for more than half of the frames.
    """
    problem, inside = optimum.smoother.problem, some[stretch]
    if not moved.any() or 2 * inside.sum() > len(inside):
        return None
    start = replace(optimum.estimate, pose=optimum.estimate.pose.copy(), place=optimum.estimate.place.copy())
    pose, places_go = start.pose, moved
    for one in np.flatnonzero(some).tolist():
        mine = np.flatnonzero(stretch == one)
        first, last = int(mine[0]), int(mine[-1])
        if first:
            at, to = first, se3.compose(pose[first - 1], problem.increment[first - 1])
        else:
            at, to = last, se3.compose(pose[last + 1], se3.inverse(problem.increment[last]))
        motion = se3.compose(to, se3.inverse(pose[at]))
        pose[mine] = se3.compose(motion, pose[mine])
        start.place[places_go] = se3.compose(motion, start.place[places_go])
        places_go = np.zeros_like(moved)
    held = moved[problem.prior.place]
    prior = replace(problem.prior, weight=np.where(held, LEAST_WEIGHT, problem.prior.weight))
    found = converge(replace(problem, prior=prior), start, optimum.noise, heavy_rounds=1)
    cost = found.smoother.linearised(found.estimate, optimum.noise, heavy=False).cost
    return cost + problem.settings.map.moved_nats * float(held.sum()), found


def other_explanations(optimum: SpatialOptimum) -> SpatialEstimate | None:
    """Return the values with poses and orientations that fit better by themselves; None if there are none."""
    problem, estimate, noise = optimum.smoother.problem, optimum.estimate, optimum.noise
    voted = oriented(problem, estimate, optimum.now.weight)
    other = problem.symmetries.angle_between(voted, estimate.place) > problem.settings.repair.other_rad
    place = np.where(other[:, None], voted, estimate.place)
    pose, n_better = _better_poses(problem, replace(estimate, place=place), noise)
    return replace(estimate, pose=pose, place=place) if n_better or other.any() else None


def _better_poses(problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise) -> tuple[FloatArray, int]:
    """Poses (N, 7), other ones where a stretch of frames fits them better; and in how many frames."""
    cost = _cost_of_frames(problem, estimate, noise)
    best, pose = cost.copy(), estimate.pose.copy()
    mount = estimate.mount(problem)[problem.sensor]
    seen_from, back = estimate.seen_from(problem)
    oriented_place = problem.oriented[problem.place]
    rank = np.arange(len(problem.place)) - np.searchsorted(problem.pose_row, problem.pose_row)
    symmetries, place = problem.symmetries[problem.place], estimate.place[problem.place]
    for measured in problem.explanations:
        seen = se3.compose(mount, measured)
        turned = symmetries.twisted(place, se3.compose(seen_from, seen))
        suggested = se3.retract(se3.compose(turned, se3.inverse(seen)), -back)
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
    taken = seen_in[jumps & (total[stretch] > problem.settings.repair.stretch_nats)]
    mixed = estimate.pose.copy()
    mixed[taken] = pose[taken]
    return mixed, len(taken)


def _cost_of_frames(problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise) -> FloatArray:
    """(N,) negative log likelihood of the detections in each frame, up to a constant."""
    loss = problem.share * _losses(problem, estimate, noise)
    return np.bincount(problem.pose_row, loss, minlength=len(estimate.pose)).astype(np.float64)


def losses_at(
    problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise, some: IntArray, row: int
) -> FloatArray:
    """Return (K,) negative log likelihoods of some detections (K,) if they were of the place in a row."""
    place = problem.place.copy()
    place[some] = row
    return _losses(replace(problem, place=place), estimate, noise)[some]


def _losses(problem: SpatialProblem, estimate: SpatialEstimate, noise: SpatialNoise) -> FloatArray:
    """(M,) negative log likelihood of each detection, up to a constant."""
    seen = problem.sightings
    values, weight = np.empty(int(seen.first[-1])), np.empty(len(seen.kind))
    residual = np.zeros((len(seen.kind), 8))
    linearise_sightings(
        estimate.pose, estimate.place, estimate.mount(problem), *problem.earlier(estimate.delay_s), noise.levels, seen,
        False, values, weight, residual,
    )  # fmt: skip
    squared = (residual**2).sum(axis=1)
    return np.asarray(0.5 * squared - np.logaddexp(0.0, 0.5 * squared - seen.log_odds[seen.kind]))


def rejoined(
    optimum: SpatialOptimum, identity: IntArray, apart: BoolArray
) -> tuple[SpatialProblem, SpatialEstimate] | None:
    """Return the problem with landmarks of one identity put together that came to be at one place; None without any.

    The same where the first of them is not seen any more, or this one hardly ever. Places `apart` (P,) stay: one
    landmark was there for a while.
    """
    problem, estimate = optimum.smoother.problem, optimum.estimate
    settings, least_seen = problem.settings.repair, problem.settings.map.least_seen
    place, at = problem.place.copy(), estimate.place.copy()
    hits = np.bincount(place, optimum.now.weight, minlength=len(at))
    held = np.isin(np.arange(len(at)), problem.prior.place)
    for row in range(int(identity.max(initial=-1)) + 1, len(identity)):
        own = int(identity[row])
        if apart[row]:
            continue
        near = np.linalg.norm(at[row, :3] - at[own, :3]) < settings.together_m
        if near or hits[row] < settings.fewest or (hits[own] < least_seen and not held[own]):
            at[own] = at[row] if hits[row] > hits[own] else at[own]
            place[place == row] = own
    if np.array_equal(place, problem.place):
        return None
    return replace(problem, place=place), replace(estimate, place=at)


def split(
    optimum: SpatialOptimum, identity: IntArray, whole: BoolArray
) -> tuple[SpatialProblem, SpatialEstimate, IntArray] | None:
    """Return the problem with places of their own for landmarks that carry the identity of others; None without any.

    Of a landmark that was never seen where a map has it the first of them is its own: it was moved there.

    Args:
        optimum: with outliers.
        identity: (P,) rows of landmarks that the places are of; grows by that of each new place.
        whole: (L,) landmarks that are one each, as boxes that were followed: outliers are errors.
    """
    problem, estimate = optimum.smoother.problem, optimum.estimate
    settings = problem.settings.repair
    outlier = optimum.now.weight < 0.5
    located = np.zeros(len(estimate.pose), dtype=np.bool_)
    located[problem.pose_row[~outlier]] = True
    located |= problem.driven
    asked = outlier & located[problem.pose_row] & ~whole[identity[problem.place]]
    at = as_seen(problem, estimate, problem.measured)
    place, places, copied = problem.place.copy(), list[FloatArray](), list[int]()
    begun, votes = list[int](), np.zeros(len(problem.place))
    at_places, prior = estimate.place.copy(), problem.prior
    unseen = np.bincount(problem.place, optimum.now.weight, minlength=len(at_places)) < problem.settings.map.least_seen
    for known in np.unique(problem.place[asked]):
        mine = np.flatnonzero(asked & (problem.place == known))
        while len(mine) >= settings.fewest:
            gap = np.linalg.norm(at[mine, None, :3] - at[None, mine, :3], axis=2)
            centre = int(np.argmax((gap < settings.together_m).sum(axis=1)))
            near = mine[gap[centre] < settings.together_m]
            away = np.linalg.norm(np.median(at[near, :3], axis=0) - estimate.place[known, :3])
            if (
                len(near) < settings.fewest
                or len(np.unique(problem.pose_row[near])) < settings.fewest_frames
                or away < settings.together_m
            ):
                break
            votes[near] = 1.0
            begun.append(int(known) if unseen[known] else len(estimate.place) + len(places))
            if unseen[known]:
                at_places[known], unseen[known] = at[mine[centre]], False
                prior = replace(prior, weight=np.where(prior.place == known, LEAST_WEIGHT, prior.weight))
            else:
                place[near] = len(estimate.place) + len(places)
                places.append(at[mine[centre]])
                copied.append(int(known))
            mine = mine[gap[centre] >= settings.together_m]
    if not places and prior is problem.prior:
        return None
    source = np.append(np.arange(len(problem.oriented)), copied).astype(np.int64)
    larger = replace(
        problem, place=place, oriented=problem.oriented[source], symmetries=problem.symmetries[source], prior=prior
    )
    added = replace(estimate, place=np.vstack([at_places, *places]))
    added.place[begun] = oriented(larger, added, votes)[begun]  # a single detection may have seen it the other way
    return larger, added, identity[source]
