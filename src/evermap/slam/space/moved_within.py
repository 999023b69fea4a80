"""Landmarks that moved while the robot drove: one identity at two places, of which one is seen before an instant and
the other one after it.

Their sightings are consistent with the odometry on either side, so the robot is bent, the identity seems to be on two
landmarks, or a neighbour's does. So landmarks are asked where the solution has a symptom: an identity at several
places, outliers in a row, a jump of the odometry, a place that is not where the map has it. The suspects are left out,
and their sightings tell two places and an instant along the poses without them. What explains everything best is
compared by evidence with the solution without it (`explanation`).

Two places that are seen in turns are two landmarks (`repair.split`). So are two places that were never looked at when
nothing was there: that one is empty while the other is seen says that it is one landmark.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from evermap.geometry import se3
from evermap.slam.changes.explain import find_instant
from evermap.slam.space.estimate import SpatialOptimum, as_seen, converge, oriented
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.repair import losses_at, repaired
from evermap.slam.space.smoother import SpatialSmoother
from evermap.types import BoolArray, FloatArray, IntArray

MOST_SUSPECTS, MOST_TURNS = 4, 2
"""Landmarks that are left out together, and times that others are, at most."""
ROUNDS = 4
"""Moves that are found, at most."""
STEPS = 10
"""Gauss-Newton steps without a suspect, and with its move, at most."""
MEETINGS, LEAST_RANGE_M = 10, 0.1
"""Times that a point where directions meet is found, in turn with their weights; and its range, at least [m]."""
UNUSED = 1e-9
"""Share of the information of detections that are left out."""
MOST_CENTRES = 60
"""Sightings of which one is the middle, at most."""
PARTED, FAR = 0.8, 6.0
"""Share of the distances that two places leave, at most; and standard deviations that a sighting is away, at most."""
CONTRADICTS_NATS = 3.0
"""By which a detection must prefer the place of the other side to contradict an instant."""
LEAST_FALL = 15.0
"""Nats by which the cost falls with a second place, at least: its prior, and six numbers that are free."""
BESIDE_RAD = 0.05
"""A place is in view as near to the direction of a sighting."""
A_LOOK, A_VISIT = math.log(2.0), 3.5
"""Nats by which a look at an empty place says that nothing is there, and all looks of one visit at most: what stood in
the way, stood there for a while."""
VISIT_S = 5.0
"""Looks with more time between them are of two visits."""


class MovedWithin(NamedTuple):
    """One landmark that moved during the session.

    Attributes:
        before, after: rows of its places.
        since_s: first stamp at the new place, on the problem's clock.
        between_s: it moved between these two.
        probability: that it moved then, over that it stood, or that there are two.
    """

    before: int
    after: int
    since_s: float
    between_s: tuple[float, float]
    probability: float


class TwoPlaces(NamedTuple):
    """One identity at a place before an instant, and at another one after it.

    Attributes:
        optimum: with both.
        before, after: rows of the places.
        since_s, between_s: as of `MovedWithin`.
        nats: by which looks say that it is one landmark, not two.
    """

    optimum: SpatialOptimum
    before: int
    after: int
    since_s: float
    between_s: tuple[float, float]
    nats: float


def find_superseded(moves: tuple[MovedWithin, ...], count: int) -> BoolArray:
    """Return which of `count` places landmarks have left."""
    left = np.zeros(count, dtype=np.bool_)
    left[[move.before for move in moves]] = True
    return left


def list_movers(optimum: SpatialOptimum, identity: IntArray, asked: BoolArray, off_map: IntArray) -> IntArray:
    """Return rows of landmarks that may have moved within the session, the likeliest first; none without a symptom.

    What moved bends the poses beside it, so that others have the outliers: it need not be among the first.

    Args:
        optimum: the solution without a further move.
        identity: (P,) rows of landmarks that its places are of.
        asked: (L,) landmarks that may be asked.
        off_map: rows of places that are not where a map has them.
    """
    problem, settings = optimum.smoother.problem, optimum.smoother.problem.settings.repair
    of, good = identity[problem.place], optimum.now.weight > problem.settings.inlier
    odd = _odd_sightings(optimum, identity)
    own = np.bincount(of[odd], minlength=len(asked))
    own[[row for row in off_map.tolist() if _is_parted(optimum, row)]] += 1
    bent = _frames_beside_jumps(optimum)
    if not (own > 0).any() and not bent.any():
        return np.zeros(0, dtype=np.int64)
    # where one landmark has outliers, or the robot jumps, because of another one, this is in view there, too
    bent[problem.pose_row[odd]] = True
    beside = np.bincount(of[bent[problem.pose_row] & good], minlength=len(asked))
    may = asked & (np.bincount(of, minlength=len(asked)) >= 2 * settings.fewest) & (own + beside > 0)
    order = np.lexsort((-beside, -own))
    return order[may[order]][: MOST_TURNS * MOST_SUSPECTS]


def _is_parted(optimum: SpatialOptimum, row: int) -> bool:
    """Tell whether the sightings of a place are of two places in turn, by themselves or by where others put it."""
    problem, estimate = optimum.smoother.problem, optimum.estimate
    mine = np.flatnonzero(problem.place == row)
    at = as_seen(problem, estimate, problem.measured)
    # poses that are bent to one point for two let directions meet there; ranges are of the odometry, which isn't bent
    if _part_in_two(at[mine], bool(problem.oriented[row]), problem.settings.repair.fewest) is not None:
        return True
    return bool(problem.ray[mine].any()) and _part_sightings(optimum, estimate, at, mine) is not None


def _frames_beside_jumps(optimum: SpatialOptimum) -> BoolArray:
    """Return (N,) frames that are the last few that saw something before a jump of the odometry, or the first after."""
    problem, fewest = optimum.smoother.problem, optimum.smoother.problem.settings.repair.fewest_frames
    found, seen = np.zeros(len(problem.stamp_s), dtype=np.bool_), np.unique(problem.pose_row)
    if problem.driven:
        for jump in np.flatnonzero(optimum.now.odometry_weight < problem.settings.inlier).tolist():
            at = int(np.searchsorted(seen, jump, side="right"))
            found[seen[max(at - fewest, 0) : at + fewest]] = True
    return found


def _odd_sightings(optimum: SpatialOptimum, identity: IntArray) -> BoolArray:
    """Return (M,) sightings that are outliers in a row, or not of the place where their landmark was seen most."""
    problem, settings = optimum.smoother.problem, optimum.smoother.problem.settings.repair
    inlier = optimum.now.weight > problem.settings.inlier
    of, odd = identity[problem.place], np.zeros(len(problem.place), dtype=np.bool_)
    hits = np.bincount(problem.place[inlier], minlength=len(identity))
    for landmark in np.unique(identity):
        rows = np.flatnonzero(identity == landmark)
        most = rows[int(np.argmax(hits[rows]))]
        mine = np.flatnonzero(of == landmark)
        strange = ~inlier[mine] | (problem.place[mine] != most)
        begin = np.flatnonzero(np.diff(strange.astype(np.int64), prepend=0) == 1)
        end = np.flatnonzero(np.diff(strange.astype(np.int64), append=0) == -1)
        for first, last in zip(begin.tolist(), end.tolist(), strict=True):
            run = mine[first : last + 1]
            if len(np.unique(problem.pose_row[run])) >= max(settings.fewest, settings.fewest_frames):
                odd[run] = True
    return odd


def find_two_places(
    optimum: SpatialOptimum, suspects: IntArray, interval: float, single: frozenset[int] = frozenset()
) -> tuple[TwoPlaces | None, frozenset[int]]:
    """Return the most probable solution in which one of some landmarks is at two places in turn, None without any; and
    the rows that are known to be at one place then.

    Args:
        optimum: before landmarks were split.
        suspects: rows of places, the likeliest first: the next few are asked where none of those before them is.
        interval: probability of the interval in which the change is reported.
        single: rows that are known to be at one place of this optimum.
    """
    for first in range(0, len(suspects), MOST_SUSPECTS):
        two, single = _find_among(optimum, suspects[first : first + MOST_SUSPECTS], interval, single)
        if two is not None:
            return two, single
    return None, single


def _find_among(
    optimum: SpatialOptimum, suspects: IntArray, interval: float, single: frozenset[int]
) -> tuple[TwoPlaces | None, frozenset[int]]:
    asked = [row for row in suspects.tolist() if row not in single]
    if not asked:
        return None, single
    free = _without(optimum, suspects)
    at = as_seen(optimum.smoother.problem, free, optimum.smoother.problem.measured)
    found = list[TwoPlaces]()
    for row in asked:
        two = _at_two_places(optimum, free, at, row, interval)
        if two is None:
            single |= {row}
        else:
            found.append(two)
    if not found:
        return None, single
    best = min(found, key=lambda two: two.optimum.now.cost)
    better = repaired(converge(best.optimum.smoother.problem, best.optimum.estimate, optimum.noise, heavy_rounds=0))
    nats = _nats_of_looks(better, best.before, best.after, best.since_s)
    return best._replace(optimum=better, nats=nats), single


def _at_two_places(
    optimum: SpatialOptimum, free: SpatialEstimate, at: FloatArray, row: int, interval: float
) -> TwoPlaces | None:
    """The optimum with a landmark at two places; None where it was seen at both in turns, or is at one.

    Args:
        optimum: with one place.
        free: values without what is suspected.
        at: (M, 7) where detections put their places then.
        row: the place.
        interval: as of `find_two_places`.
    """
    problem, noise, settings = optimum.smoother.problem, optimum.noise, optimum.smoother.problem.settings
    mine = np.flatnonzero(problem.place == row)
    if len(mine) < 2 * settings.repair.fewest:
        return None
    parted = _part_sightings(optimum, free, at, mine)
    if parted is None:
        return None
    cut, old, new = parted
    larger = replace(
        problem,
        oriented=np.append(problem.oriented, problem.oriented[row]),
        symmetries=problem.symmetries[np.append(np.arange(len(problem.oriented)), row)],
    )
    place = np.vstack([free.place, new])
    place[row] = old
    place[[row, -1], 3:] = np.where(problem.oriented[row], place[[row, -1], 3:], se3.NO_TURN)
    after, since_s, between_s = len(problem.oriented), 0.0, (0.0, 0.0)
    start, stamp_s = replace(free, place=place), problem.stamp_s[problem.pose_row[mine]]
    found, loss = optimum, [np.zeros(0), np.zeros(0)]
    for _ in range(2):
        moved = larger.place.copy()
        moved[mine[cut:]] = after
        trial = replace(larger, place=moved)
        if found is optimum:  # a single sighting may have either orientation
            voted = oriented(trial, start, np.ones(len(moved)))[[row, after]]
            place[[row, after]] = voted
        found = _settle(trial, start, noise)
        if found.now.cost > optimum.now.cost - LEAST_FALL:
            return None
        start = found.estimate
        loss = [losses_at(trial, start, noise, mine, own) for own in (row, after)]
        cut, (low, high) = find_instant(loss[0] - loss[1], stamp_s, interval)
        since_s, between_s = float(stamp_s[cut]), (float(stamp_s[low]), float(stamp_s[high]))
    other = np.where(np.arange(len(mine)) < cut, loss[0] - loss[1], loss[1] - loss[0])
    if np.count_nonzero(other > CONTRADICTS_NATS) >= settings.repair.fewest:  # seen at both places in turns
        return None
    if not all(_is_seen_at(found, own, settings.repair.fewest) for own in (row, after)):
        return None
    return TwoPlaces(found, row, after, since_s, between_s, 0.0)


def _is_seen_at(optimum: SpatialOptimum, row: int, fewest: int) -> bool:
    """Tell whether enough detections of a place are no outliers, and most of them."""
    weight = optimum.now.weight[optimum.smoother.problem.place == row]
    return bool(np.count_nonzero(weight > 0.5) >= max(fewest, 0.5 * len(weight)))


def _without(optimum: SpatialOptimum, rows: IntArray) -> SpatialEstimate:
    """The values without the detections of some places."""
    problem = optimum.smoother.problem
    share = np.where(np.isin(problem.place, rows), UNUSED, problem.share)
    return _settle(replace(problem, share=share), optimum.estimate, optimum.noise).estimate


def _settle(problem: SpatialProblem, start: SpatialEstimate, noise: SpatialNoise) -> SpatialOptimum:
    """The optimum at given noise levels, first with tails that never let go."""
    smoother = SpatialSmoother(problem, start.pose)
    start, _ = smoother.optimum(start, noise, heavy=True, iterations=STEPS)
    estimate, now = smoother.optimum(start, noise, heavy=False, iterations=STEPS)
    return SpatialOptimum(estimate, noise, smoother, now)


def _part_sightings(
    optimum: SpatialOptimum, estimate: SpatialEstimate, at: FloatArray, mine: IntArray
) -> tuple[int, FloatArray, FloatArray] | None:
    """Return how sightings (K,) of one landmark part into those of two places, along given values, by which detections
    put their places `at` (M, 7); None if it is one.

    The ranges of directions are no part of it: they were triangulated as if everything stood, from sightings of both
    places where these are close in time.
    """
    problem, fewest = optimum.smoother.problem, optimum.smoother.problem.settings.repair.fewest
    if not problem.ray[mine].any():
        return _part_in_two(at[mine], bool(problem.oriented[problem.place[mine[0]]]), fewest)
    eye_m = as_seen(problem, estimate, se3.identity(len(problem.place)))[mine, :3]
    range_m = np.linalg.norm(problem.measured[mine, :3], axis=1)
    sigma_rad = optimum.noise.across * problem.sigma_position_m[mine, 0] / range_m
    parted = _part_rays(eye_m, (at[mine, :3] - eye_m) / range_m[:, None], sigma_rad, fewest)
    if parted is None:
        return None
    cut, *both_m = parted
    old, new = se3.identity(2)
    old[:3], new[:3] = both_m
    return cut, old, new


def _part_rays(
    eye_m: FloatArray, ahead: FloatArray, sigma_rad: FloatArray, fewest: int
) -> tuple[int, FloatArray, FloatArray] | None:
    """Return as `_part_in_two`, with points (3,), of directions `ahead` (N, 3) from `eye_m` (N, 3): by the points at
    which those before and after each cut meet best. How far directions miss one point is told by the best cut: poses
    err, too.
    """
    count = len(eye_m)
    if count < 2 * fewest:
        return None
    cuts = np.unique(np.linspace(fewest, count - fewest, min(count, MOST_CENTRES)).astype(np.int64))
    before = np.arange(count) < cuts[:, None]
    sides = np.concatenate([np.ones((1, count), dtype=np.bool_), before, ~before])
    across = (np.eye(3) - ahead[:, :, None] * ahead[:, None, :]) / sigma_rad[:, None, None] ** 2
    weight, range_m = sides.astype(np.float64), np.ones(sides.shape)
    middle_m = eye_m.mean(axis=0)
    for _ in range(MEETINGS):
        scaled = weight / range_m**2
        total = np.einsum("sn,nij->sij", scaled, across) + UNUSED * np.eye(3)
        pull = np.einsum("sn,nij,nj->si", scaled, across, eye_m - middle_m)
        meet_m = middle_m + np.linalg.solve(total, pull[..., None])[..., 0]
        out = meet_m[:, None] - eye_m
        range_m = np.maximum(np.linalg.norm(out, axis=2), LEAST_RANGE_M)
        off = np.arctan2(np.linalg.norm(np.cross(out, ahead), axis=2), (out * ahead).sum(axis=2)) / sigma_rad
        of_cut = np.where(before, off[1 : 1 + len(cuts)], off[1 + len(cuts) :])
        off /= max(float(np.median(of_cut, axis=1).min()), 1.0)
        weight = sides / (1.0 + off**2)
    loss = np.where(sides, np.minimum(off, FAR), 0.0).sum(axis=1)
    both = loss[1 : 1 + len(cuts)] + loss[1 + len(cuts) :]
    best = int(np.argmin(both))
    if not both[best] <= PARTED * loss[0]:
        return None
    return int(cuts[best]), meet_m[1 + best], meet_m[1 + len(cuts) + best]


def _part_in_two(at: FloatArray, has_turn: bool, fewest: int) -> tuple[int, FloatArray, FloatArray] | None:
    """The first sighting (of N, 7, in order of time) at a new place, and the two places (7,); None if it is one.

    By the least sum of distances from the middle sighting before and after. How far sightings of one place are apart is
    told by those that follow each other.
    """
    count = len(at)
    if count < 2 * fewest:
        return None
    step = se3.local(at[:-1], at[1:])
    sigma_m = max(float(np.median(np.linalg.norm(step[:, :3], axis=1))), 1e-6)
    sigma_rad = max(float(np.median(np.linalg.norm(step[:, 3:], axis=1))), 1e-6) if has_turn else np.inf

    asked = np.unique(np.linspace(0, count - 1, min(count, MOST_CENTRES)).astype(np.int64))
    off = se3.local(at[asked, None], at[None])
    off = np.hypot(np.linalg.norm(off[..., :3], axis=2) / sigma_m, np.linalg.norm(off[..., 3:], axis=2) / sigma_rad)
    total = np.cumsum(np.minimum(off, FAR), axis=1)  # distances from each of those asked to the first ones
    cuts = np.arange(fewest, count - fewest + 1)
    before = np.where(asked[:, None] < cuts, total[:, cuts - 1], np.inf)
    after = np.where(asked[:, None] >= cuts, total[:, -1:] - total[:, cuts - 1], np.inf)
    losses = before.min(axis=0) + after.min(axis=0)
    best = int(np.argmin(losses))
    if not losses[best] <= PARTED * float(total[:, -1].min()):
        return None
    ends = asked[[int(np.argmin(before[:, best])), int(np.argmin(after[:, best]))]]
    return int(cuts[best]), at[ends[0]], at[ends[1]]


def _nats_of_looks(optimum: SpatialOptimum, before: int, after: int, since_s: float) -> float:
    """Return by how much looks at either place, when the landmark was at the other one, say that nothing was there."""
    problem, estimate = optimum.smoother.problem, optimum.estimate
    total = 0.0
    for row, then in ((before, problem.stamp_s >= since_s), (after, problem.stamp_s < since_s)):
        stamp_s = problem.stamp_s[_frames_in_view(optimum, estimate.place[row], bool(problem.oriented[row])) & then]
        visit = np.cumsum(np.diff(stamp_s, prepend=-np.inf) > VISIT_S)
        total += float(np.minimum(A_LOOK * np.bincount(visit), A_VISIT).sum())
    return total


def _frames_in_view(optimum: SpatialOptimum, place: FloatArray, oriented_: bool) -> BoolArray:
    """Return (N,) frames from which a place (7,) is in view: a sensor saw others there, as far away and as oblique."""
    problem, estimate, settings = optimum.smoother.problem, optimum.estimate, optimum.smoother.problem.settings
    good = optimum.now.weight > settings.inlier
    found = np.zeros(len(problem.stamp_s), dtype=np.bool_)
    mounts = estimate.mount(problem)
    for sensor in range(len(problem.mount)):
        mine = np.flatnonzero(good & (problem.sensor == sensor))
        if len(mine) < settings.repair.fewest:
            continue
        frames = np.unique(problem.pose_row[mine])
        eye = se3.compose(estimate.pose[frames], mounts[sensor])
        seen = problem.measured[mine, :3]
        range_m = np.linalg.norm(seen, axis=1)
        off = se3.transform(se3.inverse(eye), place[None, :3])
        far = np.linalg.norm(off, axis=1)
        tree = cKDTree(seen / np.maximum(range_m, 1e-9)[:, None])
        near = tree.query(off / np.maximum(far, 1e-9)[:, None])[0] < BESIDE_RAD
        near &= (far < np.quantile(range_m, settings.usual_range)) & (far > range_m.min())
        if oriented_:
            faced = _incidence(
                eye[np.searchsorted(frames, problem.pose_row[mine])], estimate.place[problem.place[mine]]
            )
            usual = np.quantile(np.abs(faced), 1.0 - settings.usual_range)
            cosine = _incidence(eye, np.broadcast_to(place, eye.shape))
            near &= (np.abs(cosine) > usual) & (np.sign(cosine) == np.sign(np.median(faced)))
        found[frames[near]] = True
    return found


def _incidence(eye: FloatArray, place: FloatArray) -> FloatArray:
    """Return (K,) cosines between lines of sight to places (K, 7) and what these face."""
    ray = place[:, :3] - eye[:, :3]
    normal = se3.rotation_of(place)[..., 2]
    return np.asarray((ray * normal).sum(axis=1) / np.maximum(np.linalg.norm(ray, axis=1), 1e-9))
