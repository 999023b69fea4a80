"""Landmarks that moved while the robot drove: one identity at two places, of which one is seen before an instant and
the other one after it.

Their sightings are consistent with the odometry on either side, so the robot is made to jump instead, or the identity
seems to be on two landmarks. Each suspect is left out, the poses are found without it, and its sightings then tell two
places and an instant; the move stays if everything is more probable with it. Two places that are seen in turns are two
landmarks (`repair.split`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from evermap.slam.changes.explain import find_instant
from evermap.slam.space.estimate import SpatialOptimum, as_seen, converged, oriented
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.repair import losses_at, repaired
from evermap.types import BoolArray, FloatArray, IntArray

MOST_SUSPECTS = 6
"""Places that are asked in a round, those with most outliers first."""
ROUNDS = 4
"""Moves that are found, at most."""
STEPS = 20
"""Gauss-Newton steps without a suspect, and with its move, at most."""
UNUSED = 1e-9
"""Share of the information of detections that are left out."""
MOST_INSTANTS = 60
"""Instants that are tried at first, at most."""
CONTRADICTS_NATS = 3.0
"""By which a detection must prefer the place of the other side to contradict an instant."""


class MovedWithin(NamedTuple):
    """One landmark that moved during the session.

    Attributes:
        before, after: rows of its places.
        since_s: first stamp at the new place, on the problem's clock.
        between_s: it moved between these two.
        probability: that it moved then, over that it stood.
    """

    before: int
    after: int
    since_s: float
    between_s: tuple[float, float]
    probability: float


def find_moves_within(
    optimum: SpatialOptimum, identity: IntArray, whole: BoolArray, interval: float
) -> tuple[SpatialOptimum, IntArray, tuple[MovedWithin, ...]]:
    """Return the optimum with a second place for each landmark that moved, the identities of places, and the moves.

    Args:
        optimum: with outliers, or jumps of the odometry.
        identity: (P,) rows of landmarks that the places are of.
        whole: (L,) landmarks that were followed, and are never asked.
        interval: probability of the interval in which a move is reported.
    """
    moves = list[MovedWithin]()
    for _ in range(ROUNDS):
        found = None
        for suspect in _suspects(optimum, ~whole[identity]):
            found = _with_move(optimum, suspect, interval)
            if found is not None:
                break
        if found is None:
            break
        optimum, move = found
        identity, moves = np.append(identity, identity[move.before]), [*moves, move]
    return optimum, identity, tuple(moves)


def superseded(moves: tuple[MovedWithin, ...], count: int) -> BoolArray:
    """Return which of `count` places landmarks have left."""
    left = np.zeros(count, dtype=np.bool_)
    left[[move.before for move in moves]] = True
    return left


def _suspects(optimum: SpatialOptimum, asked: BoolArray) -> list[int]:
    """Places with outliers in several frames, or seen where the odometry jumps; those with most of them first."""
    problem, settings = optimum.smoother.problem, optimum.smoother.problem.settings.repair
    outlier, count = optimum.now.weight < 0.5, len(problem.oriented)
    bad = np.bincount(problem.place[outlier], minlength=count)
    seen = np.bincount(problem.place, minlength=count)
    jump = np.flatnonzero(optimum.now.odometry_weight < 0.5) if problem.driven else np.zeros(0, dtype=np.int64)
    beside = np.isin(problem.pose_row, np.append(jump, jump + 1))
    jumps = np.bincount(problem.place[beside], minlength=count)
    may = asked & (seen >= 2 * settings.fewest) & ((bad >= settings.fewest) | (jumps > 0))
    order = np.argsort(-(bad + jumps), kind="stable")
    return [row for row in order.tolist() if may[row]][:MOST_SUSPECTS]


def _with_move(optimum: SpatialOptimum, suspect: int, interval: float) -> tuple[SpatialOptimum, MovedWithin] | None:
    """The optimum with a move of one place, and this; None where it is not more probable by what a move costs."""
    problem, noise, settings = optimum.smoother.problem, optimum.noise, optimum.smoother.problem.settings
    free = _without(optimum, suspect)
    mine = np.flatnonzero(problem.place == suspect)
    parted = _parted(as_seen(problem, free, problem.measured)[mine], settings.repair.fewest)
    if parted is None:
        return None
    cut, old, new = parted
    larger = replace(
        problem,
        oriented=np.append(problem.oriented, problem.oriented[suspect]),
        symmetries=problem.symmetries[np.append(np.arange(len(problem.oriented)), suspect)],
    )
    place = np.vstack([free.place, new])
    place[suspect] = old
    after, since_s, between_s = len(problem.oriented), 0.0, (0.0, 0.0)
    start, stamp_s = replace(free, place=place), problem.stamp_s[problem.pose_row[mine]]
    found = optimum
    for _ in range(2):
        moved = larger.place.copy()
        moved[mine[cut:]] = after
        trial = replace(larger, place=moved)
        if found is optimum:  # a single sighting may have either orientation
            voted = oriented(trial, start, np.ones(len(moved)))[[suspect, after]]
            place[[suspect, after]] = voted
        found = _settled(trial, start, noise, heavy=True)
        start = found.estimate
        loss = [losses_at(trial, start, noise, mine, row) for row in (suspect, after)]
        cut, (low, high) = find_instant(loss[0] - loss[1], stamp_s, interval)
        since_s, between_s = float(stamp_s[cut]), (float(stamp_s[low]), float(stamp_s[high]))
    other = np.where(np.arange(len(mine)) < cut, loss[0] - loss[1], loss[1] - loss[0])
    if np.count_nonzero(other > CONTRADICTS_NATS) >= settings.repair.fewest:  # seen at both places in turns
        return None
    if not all(_is_seen_at(found, row, settings.repair.fewest) for row in (suspect, after)):
        return None
    gain = optimum.now.cost - found.now.cost - settings.map.moved_nats - math.log(len(mine))
    if gain < settings.repair.gain_nats:
        return None
    better = repaired(converged(found.smoother.problem, found.estimate, noise, heavy_rounds=0))
    probability = 1.0 / (1.0 + math.exp(-min(gain, 50.0)))
    return better, MovedWithin(suspect, after, since_s, between_s, probability)


def _is_seen_at(optimum: SpatialOptimum, row: int, fewest: int) -> bool:
    """Tell whether enough detections of a place are no outliers, and most of them."""
    weight = optimum.now.weight[optimum.smoother.problem.place == row]
    return bool(np.count_nonzero(weight > 0.5) >= max(fewest, 0.5 * len(weight)))


def _without(optimum: SpatialOptimum, suspect: int) -> SpatialEstimate:
    """The values without the detections of a place, and without what a map says of it."""
    problem = optimum.smoother.problem
    share = np.where(problem.place == suspect, UNUSED, problem.share)
    return _settled(replace(problem, share=share), optimum.estimate, optimum.noise, heavy=True).estimate


def _settled(
    problem: SpatialProblem, start: SpatialEstimate, noise: SpatialNoise, *, heavy: bool = False
) -> SpatialOptimum:
    """The optimum at given noise levels; first with tails that never let go, if `heavy`."""
    from evermap.slam.space.smoother import SpatialSmoother

    smoother = SpatialSmoother(problem, start.pose)
    if heavy:
        start, _ = smoother.optimum(start, noise, heavy=True, iterations=STEPS)
    estimate, now = smoother.optimum(start, noise, heavy=False, iterations=STEPS)
    return SpatialOptimum(estimate, noise, smoother, now)


def _parted(at: FloatArray, fewest: int) -> tuple[int, FloatArray, FloatArray] | None:
    """The first sighting (of N, 7, in order of time) at a new place, and the two places (7,); None if it is one.

    By the least sum of distances from the median before and after, each at most as far as the whole is spread.
    """
    count = len(at)
    if count < 2 * fewest:
        return None
    far = max(float(np.quantile(np.linalg.norm(at[:, :3] - np.median(at[:, :3], axis=0), axis=1), 0.9)), 1e-6)

    def loss(some: FloatArray) -> float:
        away = np.linalg.norm(some[:, :3] - np.median(some[:, :3], axis=0), axis=1)
        return float(np.minimum(away, far).sum())

    cuts = np.unique(np.linspace(fewest, count - fewest, min(count - 2 * fewest + 1, MOST_INSTANTS)).astype(np.int64))
    losses = [loss(at[:cut]) + loss(at[cut:]) for cut in cuts.tolist()]
    cut = int(cuts[int(np.argmin(losses))])
    ends = []
    for some in (at[:cut], at[cut:]):
        away = np.linalg.norm(some[:, :3] - np.median(some[:, :3], axis=0), axis=1)
        ends.append(some[int(np.argmin(away))])
    if min(losses) > 0.8 * loss(at):
        return None
    return cut, ends[0], ends[1]
