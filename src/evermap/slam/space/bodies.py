"""Bodies that carry landmarks, and move while the robot drives: a forklift with tags.

Which landmarks are on one body is stated (`Recording.objects`). Whether a body stands is asked of all of its landmarks
at once, along poses by all that is on no body. What stands is a place for as long as it does, as all landmarks
are; what is seen of it while it moves says nothing of a place. So no landmark of a body is an outlier, nor does it move
alone: rests of a body at which its landmarks agree are one, and else the body moved, as a whole.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.config import BodiesConfig, StillConfig
from evermap.estimate.sparse.elimination import Spread
from evermap.geometry import se3
from evermap.slam.intake import find_bodies
from evermap.slam.space.estimate import SpatialOptimum, as_seen, converge, first_places
from evermap.slam.space.intake import Rests, SpatialIntake, start_noise
from evermap.slam.space.problem import LEAST_WEIGHT, SpatialEstimate, SpatialProblem
from evermap.tracking.standing import log_factor_of_rest
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, SpatialRecording

STILL_M = 0.02
"""Error of the poses that are looked from, beside a landmark on no body."""
NEAR_S = 0.5
"""Time from a frame with a landmark on no body in which the odometry is believed."""
ROUNDS = 2
ELSEWHERE, SLACK_M, SLACK_RAD = 4.0, 0.05, 0.05
"""Standard deviations by which two places of a rest differ at least, with these errors more."""
STRAY_LOOKS, MOST_LOOKS = 6, 200
"""Looks at a landmark that are compared, at least and at most."""
STRAY, MOST_STRAY = 0.15, 0.3
"""Share of the looks that are at neither of its two usual places, from which a landmark is on a body that moves; and
the share of those on no body of which that may be so.
"""

FEWEST = 3
"""Landmarks on no body that tell where a session is in a map, at least."""
SAME_M = 0.5
"""What was seen last within this of its rest has not left it."""


class BodyMove(NamedTuple):
    """A body that moved from one rest to another one, or out of view.

    Attributes:
        before: (K,) rows of the places that its landmarks left.
        after: (K,) rows of those at which they were next, the same as before where none was seen.
        between_s: it moved between these two, on the problem's clock.
        last: which of the landmarks was seen last where no rest follows.
        seen: (7,) its motion until then; see `Rests`.
    """

    before: IntArray
    after: IntArray
    between_s: tuple[float, float]
    last: int
    seen: FloatArray


def with_rests(intake: SpatialIntake, recording: SpatialRecording, settings: StillConfig) -> SpatialIntake:
    """Return the input with a place for every rest of a body, and without what was seen of bodies that moved.

    The same where nothing moves, nothing is stated of bodies, or there is no odometry.

    Args:
        intake: one place for each landmark.
        recording: of which it is.
        settings: which tracks stand.
    """
    problem = intake.problem
    body_of = find_bodies(intake.landmark_id, recording.objects)
    body = body_of[problem.place]
    if not problem.driven or not (body != UNKNOWN).any():
        return intake
    rest = np.full(len(body), UNKNOWN)
    strays = find_strays(problem, *_poses(intake, body, rest), body_of)
    body_of = np.where(strays, body_of.max() + np.cumsum(strays), body_of)
    body = body_of[problem.place]
    for _ in range(ROUNDS):
        estimate, uncovered_m = _poses(intake, body, rest)
        before, rest = rest, _find_rests(problem, estimate, uncovered_m, body, settings)
        if not uncovered_m.any() or np.array_equal(rest, before):
            break
    return _with_places(intake, estimate, body_of, rest)


def find_strays(
    problem: SpatialProblem, estimate: SpatialEstimate, uncovered_m: FloatArray, body_of: IntArray
) -> BoolArray:
    """Return (L,) landmarks on no known body that are seen at so many places that they are on one.

    At two places is what moved once; a wrong identity is elsewhere for a look. Where bodies move, what is on one that
    nobody knows of is no error. Too many would say that the poses are wrong.

    Args:
        problem: a place for each landmark.
        estimate: poses by what is on no body.
        uncovered_m: (M,) errors of positions by the odometry.
        body_of: (L,) known bodies.
    """
    at = as_seen(problem, estimate, problem.measured)[:, :3]
    sigma_m = np.hypot(_sigmas_of(problem), uncovered_m * np.sqrt(NEAR_S))
    found, least_m = np.zeros(len(body_of), dtype=np.bool_), problem.settings.bodies.stray_m
    for one in np.flatnonzero(body_of == UNKNOWN).tolist():
        mine = np.flatnonzero(problem.place == one)
        mine = mine[np.unique(np.linspace(0, len(mine) - 1, min(len(mine), MOST_LOOKS)).astype(np.int64))]
        if len(mine) < STRAY_LOOKS:
            continue
        near = np.linalg.norm(at[mine, None] - at[mine], axis=2) < np.maximum(least_m, ELSEWHERE * sigma_m[mine])
        left = np.ones(len(mine), dtype=np.bool_)
        for _ in range(2):
            left &= ~near[int(np.argmax((near & left).sum(axis=1)))]
        found[one] = np.mean(left) > STRAY
    return found if found.sum() <= MOST_STRAY * np.count_nonzero(body_of == UNKNOWN) else np.zeros_like(found)


def _sigmas_of(problem: SpatialProblem) -> FloatArray:
    """(M,) errors of positions, and of the poses beside a landmark on no body."""
    own = (np.linalg.inv(problem.measured_root) ** 2).sum(axis=(1, 2)) / 3.0
    return np.asarray(np.sqrt(own + STILL_M**2))


def _poses(intake: SpatialIntake, body: IntArray, rest: IntArray) -> tuple[SpatialEstimate, FloatArray]:
    """Values by what is on no body, and by rests that are known; and (M,) errors of positions by the odometry [m]."""
    problem = intake.problem
    noise = start_noise(problem.settings, driven=True)
    split, _ = _by_rest(problem, rest)
    known = (body == UNKNOWN) | (rest != UNKNOWN)
    estimate = first_places(split, intake.driven_pose)
    if known.any():
        some = split.seeing(known).as_points()
        optimum = converge(some, first_places(some, intake.driven_pose), noise)
        estimate, noise = optimum.estimate, optimum.noise
    seen_s = problem.stamp_s[np.unique(problem.pose_row[known])]
    at_s = problem.seen_s
    near = np.searchsorted(seen_s, at_s + NEAR_S, side="right") > np.searchsorted(seen_s, at_s - NEAR_S)
    range_m = np.linalg.norm(problem.measured[:, :3], axis=1)
    return estimate, np.where(near, 0.0, np.hypot(noise.translation, noise.rotation * range_m))


def _by_rest(problem: SpatialProblem, rest: IntArray) -> tuple[SpatialProblem, IntArray]:
    """The problem with a place for each landmark and rest (M,), the first in the landmark's row; and rows of landmarks
    that its places are of.
    """
    count = len(problem.oriented)
    landmark = list(range(count))
    place = problem.place.copy()
    first: dict[int, int] = {}
    row_of: dict[tuple[int, int], int] = {}
    for m in np.flatnonzero(rest != UNKNOWN).tolist():
        one = int(problem.place[m])
        stay = first.setdefault(one, int(rest[m]))
        if rest[m] != stay:
            if (one, int(rest[m])) not in row_of:
                row_of[one, int(rest[m])] = len(landmark)
                landmark.append(one)
            place[m] = row_of[one, int(rest[m])]
    of = np.array(landmark, dtype=np.int64)
    return replace(problem, place=place, oriented=problem.oriented[of], symmetries=problem.symmetries[of]), of


def _find_rests(
    problem: SpatialProblem, estimate: SpatialEstimate, uncovered_m: FloatArray, body: IntArray, settings: StillConfig
) -> IntArray:
    """(M,) rests of bodies that detections are of, numbered over all bodies; `UNKNOWN` while they move."""
    found, count = np.full(len(body), UNKNOWN), 0
    at = as_seen(problem, estimate, problem.measured)[:, :3]
    sigma_m = np.hypot(_sigmas_of(problem), uncovered_m * np.sqrt(settings.window_s))
    stamp_s = problem.seen_s
    for one in np.unique(body[body != UNKNOWN]):
        mine = np.flatnonzero(body == one)
        moves = find_moving(
            stamp_s[mine], at[mine, :2], sigma_m[mine], problem.place[mine], problem.settings.bodies, settings
        )
        part = np.cumsum(np.diff(stamp_s[mine], prepend=-np.inf) > problem.settings.bodies.unseen_s)
        part = part + np.cumsum(np.abs(np.diff(moves.astype(np.int64), prepend=0)))
        for run in np.unique(part[~moves]):
            some = mine[(part == run) & ~moves]
            if len(np.unique(stamp_s[some])) >= settings.fewest or not moves.any():
                found[some] = count
                count += 1
    return found


def find_moving(
    stamp_s: FloatArray,
    at: FloatArray,
    sigma_m: FloatArray,
    landmark: IntArray,
    bodies: BodiesConfig,
    settings: StillConfig,
) -> BoolArray:
    """(K,) whether a body moves when it is seen, by all of its landmarks in a window around each instant.

    Where too few are seen to tell, one that is seen to move elsewhere is taken to move.
    """
    instants, of = np.unique(stamp_s, return_inverse=True)
    factor = np.zeros(len(instants))
    half_s = 0.5 * settings.window_s
    first = np.searchsorted(stamp_s, instants - half_s - 1e-6)
    last = np.searchsorted(stamp_s, instants + half_s + 1e-6)
    for k, (begin, end) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        for one in np.unique(landmark[begin:end]):
            some = begin + np.flatnonzero(landmark[begin:end] == one)
            factor[k] += log_factor_of_rest(stamp_s[some], at[some], sigma_m[some], bodies.limit_mps, settings)
    moves = factor < 0.0
    if not moves.any():
        return np.zeros(len(stamp_s), dtype=np.bool_)
    moves |= factor == 0.0
    moving_s, margin_s = instants[moves], bodies.margin_s
    last = np.searchsorted(moving_s, instants + margin_s, side="right")
    near = last > np.searchsorted(moving_s, instants - margin_s)
    return np.asarray(near[of.ravel()])


def _with_places(intake: SpatialIntake, estimate: SpatialEstimate, body_of: IntArray, rest: IntArray) -> SpatialIntake:
    """The input with a place for every rest."""
    whole = intake.problem
    still = (body_of[whole.place] == UNKNOWN) | (rest != UNKNOWN)
    problem, landmark = _by_rest(whole, rest)
    intake = replace(intake, bodies=body_of)
    if still.all() and len(landmark) == len(intake.landmark_id):
        return intake
    stamp_s, at = whole.seen_s, as_seen(whole, estimate, whole.measured)
    since_s, until_s = np.full(len(landmark), np.inf), np.full(len(landmark), -np.inf)
    np.minimum.at(since_s, problem.place[still], stamp_s[still])
    np.maximum.at(until_s, problem.place[still], stamp_s[still])
    moving = np.isin(body_of, np.unique(body_of[whole.place[~still]])) | np.isin(
        body_of, body_of[landmark[len(body_of) :]]
    )
    body = np.where(moving[landmark], body_of[landmark], UNKNOWN)
    away_s, seen_s = np.full((2, len(landmark)), np.nan)
    seen = se3.identity(len(landmark))
    for row in np.flatnonzero((body != UNKNOWN) & np.isfinite(until_s)).tolist():
        next_s = since_s[(landmark == landmark[row]) & (since_s > until_s[row])].min(initial=np.inf)
        later = (whole.place == landmark[row]) & (stamp_s > until_s[row]) & (stamp_s < next_s)
        if later.any():
            here, last = at[np.flatnonzero(still & (problem.place == row))[-1]], int(np.flatnonzero(later)[-1])
            away_s[row], seen_s[row] = stamp_s[np.flatnonzero(later)[0]], stamp_s[last]
            seen[row] = se3.between(here, at[last])
            if not problem.oriented[row]:
                seen[row] = np.append(at[last, :3] - here[:3], se3.NO_TURN)
    rests = Rests(landmark, body, since_s, until_s, away_s, seen_s, seen)
    return replace(intake, problem=problem.seeing(still), used=intake.used[still], rests=rests)


def mistrust_bodies(problem: SpatialProblem, bodies: IntArray) -> SpatialProblem:
    """Return the problem with a map that is not asked where bodies stand, which may have moved since, if it has others.

    Where the session agrees with the map all the same, it counts in the end (`against_map.compared`).

    Args:
        problem: in a map.
        bodies: of landmarks; see `SpatialIntake`.
    """
    prior = problem.prior
    if not len(bodies) or not len(prior.place):
        return problem
    carried = bodies[prior.place] != UNKNOWN
    seen = np.isin(prior.place, problem.place)
    if np.count_nonzero(seen & ~carried) < FEWEST:
        return problem
    return replace(problem, prior=replace(prior, weight=np.where(carried, LEAST_WEIGHT, prior.weight)))


def join_rests(optimum: SpatialOptimum, rests: Rests) -> tuple[SpatialOptimum, IntArray, tuple[BodyMove, ...]]:
    """Return the optimum with rests of a body put together at which its landmarks agree; rows of landmarks that its
    places are of; and how bodies moved between those that are left.

    Args:
        optimum: with a place for every rest.
        rests: which these are.
    """
    problem, estimate = optimum.smoother.problem, optimum.estimate
    spread = optimum.smoother.spread(optimum.now)
    into = np.arange(len(rests.landmark))
    seen = np.bincount(problem.place, minlength=len(into)) > 0
    of_bodies: list[list[IntArray]] = []
    for one in np.unique(rests.body[rests.body != UNKNOWN]):
        mine = np.flatnonzero((rests.body == one) & seen)
        groups: list[IntArray] = []
        before = mine[:0]
        for rows in _in_turn(mine, rests):
            if groups:
                a, b = _find_shared(groups[-1], rows, rests.landmark)
                stands = not (rests.away_s[before] < rests.since_s[rows].min()).any()
                if len(a):
                    stands = not _is_elsewhere(optimum, spread, a, b)
                if stands:
                    into[b] = a
                    groups[-1], before = np.append(groups[-1], np.setdiff1d(rows, b)), rows
                    continue
            groups.append(rows)
            before = rows
        of_bodies.append(groups)
    kept = np.flatnonzero(into == np.arange(len(into)))
    row = np.searchsorted(kept, into)
    together = rests._replace(until_s=rests.until_s.copy(), seen_s=rests.seen_s.copy(), seen=rests.seen.copy())
    for k in np.flatnonzero(into != np.arange(len(into))).tolist():
        together.until_s[into[k]] = max(together.until_s[into[k]], rests.until_s[k])
        together.seen_s[into[k]], together.seen[into[k]] = rests.seen_s[k], rests.seen[k]
    moves = [move for groups in of_bodies for move in _moves_of(groups, together)]
    moves = [move._replace(before=row[move.before], after=row[move.after]) for move in moves]
    if len(kept) == len(into):
        return optimum, rests.landmark, tuple(moves)
    first = np.searchsorted(kept, into[problem.prior.place])
    joined = replace(
        problem,
        place=row[problem.place].astype(np.int64),
        oriented=problem.oriented[kept],
        symmetries=problem.symmetries[kept],
        prior=replace(problem.prior, place=first.astype(np.int64)),
    )
    start = replace(estimate, place=estimate.place[kept])
    return converge(joined, start, optimum.noise, heavy_rounds=1), rests.landmark[kept], tuple(moves)


def _in_turn(mine: IntArray, rests: Rests) -> list[IntArray]:
    """Rows of places of a body by rest, in order of time: those whose times overlap are of one."""
    order = mine[np.argsort(rests.since_s[mine], kind="stable")]
    found: list[list[int]] = []
    until_s = -np.inf
    for row in order.tolist():
        if rests.since_s[row] > until_s or any(rests.landmark[row] == rests.landmark[one] for one in found[-1]):
            found.append([])
        found[-1].append(row)
        until_s = max(until_s, rests.until_s[row])
    return [np.array(rows, dtype=np.int64) for rows in found]


def _find_shared(one: IntArray, other: IntArray, landmark: IntArray) -> tuple[IntArray, IntArray]:
    """Rows of the places of landmarks that are in both."""
    _, a, b = np.intersect1d(landmark[one], landmark[other], return_indices=True)
    return one[a], other[b]


def _is_elsewhere(optimum: SpatialOptimum, spread: Spread, a: IntArray, b: IntArray) -> bool:
    """Tell whether landmarks of a body are elsewhere, or turned, in one rest (a) and in another one (b).

    A body that drives turns: where poses have drifted by half a metre between two rests, an orientation still tells.
    """
    problem, place, places = optimum.smoother.problem, optimum.estimate.place, np.append(a, b)
    variance = np.full((2 * len(a), 2), np.inf)
    for dim, some in ((3, ~problem.oriented[places]), (6, problem.oriented[places])):
        own = spread.of(len(problem.stamp_s) + places[some], dim)
        for part in range(dim // 3):
            rows = slice(3 * part, 3 * part + 3)
            variance[some, part] = np.trace(own[:, rows, rows], axis1=1, axis2=2) / 3.0
    off = np.linalg.norm(place[b, :3] - place[a, :3], axis=1)
    turn = np.where(problem.oriented[a], problem.symmetries[a].angle_between(place[a], place[b]), 0.0)
    sigma = np.sqrt(variance[: len(a)] + variance[len(a) :] + np.square([SLACK_M, SLACK_RAD]))
    return bool(np.median((np.column_stack([off, turn]) / sigma).max(axis=1)) > ELSEWHERE)


def _moves_of(groups: list[IntArray], rests: Rests) -> list[BodyMove]:
    """How a body moved from rest to rest, and from the last one out of view."""
    found = []
    for k, rows in enumerate(groups):
        later = groups[k + 1] if k + 1 < len(groups) else np.zeros(0, dtype=np.int64)
        a, b = _find_shared(rows, later, rests.landmark)
        alone = rows[~np.isin(rests.landmark[rows], rests.landmark[later])]
        if not len(a) and not np.isfinite(rests.seen_s[rows]).any():
            continue  # it stands there still, as far as anyone saw
        if not len(a) and np.linalg.norm(rests.seen[rows, :3], axis=1).max() < SAME_M:
            continue
        ends_s = float(rests.since_s[later].min() if len(a) else np.nanmax(rests.seen_s[rows]))
        before, after = np.append(a, alone), np.append(b, alone)
        last = int(np.argmax(np.nan_to_num(rests.seen_s[before], nan=-np.inf)))
        between_s = float(rests.until_s[rows].max()), ends_s
        found.append(BodyMove(before, after, between_s, last, rests.seen[before[last]]))
    return found


def shifts_of(move: BodyMove, place: FloatArray, oriented: BoolArray) -> tuple[FloatArray, float]:
    """Return (K, 3) displacements of the landmarks of a body that moved, nan where they are not known, and its turn.

    By one of them that was seen at both ends with its orientation, all are known.

    Args:
        move: of the body.
        place: (P, 7) places.
        oriented: (P,) those with an orientation.
    """
    stands = move.before != move.after
    shift = np.where(stands[:, None], (place[move.after] - place[move.before])[:, :3], np.nan)
    by = np.flatnonzero(stands)
    if not len(by):
        shift[move.last], by = move.seen[:3], np.array([move.last])
    if not oriented[move.before[by[0]]]:
        return shift, 0.0
    here = place[move.before[by[0]]]
    there = place[move.after[by[0]]] if stands.any() else se3.compose(here, move.seen)
    motion = se3.compose(there, se3.inverse(here))
    shift = se3.transform(motion, place[move.before, :3]) - place[move.before, :3]
    return shift, float(se3.angle_between(here, there))


def number_moved(number: IntArray, moves: tuple[BodyMove, ...]) -> IntArray:
    """Return which of those with its identity each place (P,) is: landmarks of bodies are one, wherever they stood."""
    found = number.copy()
    for move in moves:
        found[move.before] = found[move.after] = 1
    return found


def has_left(moves: tuple[BodyMove, ...], count: int) -> BoolArray:
    """Return which of `count` places landmarks of bodies have left."""
    found = np.zeros(count, dtype=np.bool_)
    for move in moves:
        found[move.before] = True
    return found
