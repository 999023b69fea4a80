"""From a start that may be metres off to the optimum in space: positions first, then orientations, then corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from evermap.estimate.noise import Turns, alternate, restricted_level
from evermap.estimate.sparse.elimination import Spread
from evermap.geometry import se3
from evermap.slam.space.linearise import (
    ACROSS,
    ALONG,
    CORNERS,
    OF_STEP,
    ORIENTATION,
    PIXEL,
    POSE,
    ROTATION,
    ROWS,
    STATES,
    TRANSLATION,
)
from evermap.slam.space.problem import SpatialEstimate, SpatialNoise, SpatialProblem
from evermap.slam.space.smoother import SpatialLinear, SpatialSmoother
from evermap.types import BoolArray, FloatArray

ROUNDS = 12
"""Optimum and noise levels in turns, at most."""
FIRST_STEPS, STEPS_A_ROUND, LAST_STEPS = 15, 2, 6
"""Gauss-Newton steps of the first optimum, between two estimates of the noise, and of the last, at most."""
NEAR, NEAR_ROUND = 1e-5, 0.02
"""Step (m or rad) that is the last of an optimum, and of one whose levels will not stay."""
CONVERGED = 0.02
"""Relative change of all noise levels that ends it."""
MOST_CANDIDATES = 60
"""Detections whose orientations are asked."""


_Solution: TypeAlias = tuple[SpatialEstimate, SpatialLinear]
"""Values near the optimum of some noise levels, and the linearised problem there."""


@dataclass(frozen=True, slots=True)
class SpatialOptimum:
    """Values, noise, and the linearised problem at the optimum.

    Attributes:
        estimate: the values.
        noise: the levels.
        smoother, now: what covariances are of.
        sober: levels that covariances are of, where they are no better than other evidence has them; else None.
        fitted: the same as the values were found with, where covariances count errors that last; else None.
    """

    estimate: SpatialEstimate
    noise: SpatialNoise
    smoother: SpatialSmoother
    now: SpatialLinear
    fitted: tuple[SpatialSmoother, SpatialLinear] | None = None
    sober: SpatialNoise | None = None

    @property
    def last(self) -> tuple[SpatialSmoother, SpatialLinear]:
        """Return the problem that the values are the optimum of, linearised there, whatever covariances count."""
        return self.fitted or (self.smoother, self.now)


def converge(
    problem: SpatialProblem, start: SpatialEstimate, noise: SpatialNoise, *, heavy_rounds: int = 2
) -> SpatialOptimum:
    """Return the optimum and its noise levels, alternated until neither changes.

    Args:
        problem: the measurements.
        start: values to start from.
        noise: levels to start from, which count as a weak prior.
        heavy_rounds: rounds with tails that never let go, before it is decided what is an outlier.
    """
    smoother = SpatialSmoother(problem, start.pose)

    def optimise(before: _Solution | None, levels: SpatialNoise, heavy: bool) -> _Solution:
        # values and levels settle together: after a short step there is no need for the optimum of these levels
        steps, near = (FIRST_STEPS, NEAR) if before is None else (STEPS_A_ROUND, NEAR_ROUND)
        values = start if before is None else before[0]
        return smoother.optimum(values, levels, heavy=heavy, iterations=steps, tolerance=near)

    def learn(found: _Solution, levels: SpatialNoise) -> tuple[SpatialNoise, float]:
        following = refined(smoother, found[1], levels, noise)
        return following, float(np.abs(np.log(following.levels / levels.levels)).max())

    found, learned = alternate(noise, optimise, learn, lambda _, fit, __: fit, Turns(ROUNDS, heavy_rounds, CONVERGED))
    estimate, now = smoother.optimum(found[0], learned, heavy=False, iterations=LAST_STEPS)
    return SpatialOptimum(estimate, learned, smoother, now)


def with_worth(
    optimum: SpatialOptimum, share: FloatArray | None = None, sober: SpatialNoise | None = None
) -> SpatialOptimum:
    """Return the same values, with covariances that count detections as what they are worth beside others of a place.

    Args:
        optimum: as `converge` returns it.
        share: (M,) of their information that is new, as of `SpatialSmoother.counted`.
        sober: levels that covariances are of; None for those of the optimum.
    """
    smoother, now = optimum.smoother.counted(optimum.estimate, optimum.now, share), optimum.now
    if sober is not None or smoother is not optimum.smoother:
        now = smoother.linearised(optimum.estimate, optimum.noise if sober is None else sober, heavy=False)
    return replace(optimum, smoother=smoother, now=now, fitted=(optimum.smoother, optimum.now), sober=sober)


def converge_again(before: SpatialOptimum, problem: SpatialProblem, start: SpatialEstimate) -> SpatialOptimum:
    """Return the optimum of a problem that differs little from the one that values are the optimum of (`last`).

    Detections are worth in its covariances what they were before, and its odometry is no better there than it was.

    Args:
        before: the optimum.
        problem: of the same detections, in their order.
        start: values to start from.
    """
    found = converge(problem, start, before.noise, heavy_rounds=0)
    if before.fitted is None:
        return found
    return with_worth(found, before.smoother.problem.share, level_soberly(found.noise, before))


def level_soberly(noise: SpatialNoise, before: SpatialOptimum) -> SpatialNoise:
    """Return levels that covariances are of, where the odometry is no better than other evidence `before` had it."""
    was = before.noise if before.sober is None else before.sober
    return replace(
        noise, translation=max(noise.translation, was.translation), rotation=max(noise.rotation, was.rotation)
    )


def refined(smoother: SpatialSmoother, now: SpatialLinear, noise: SpatialNoise, begun: SpatialNoise) -> SpatialNoise:
    """Return noise levels after a step towards those of restricted likelihood, by inlier weight.

    What the fit absorbed is taken as it was under the levels before (expectation-maximisation: Dempster, Laird and
    Rubin 1977). Steps end at the same levels as whole ones, which where residuals are correlated in time are too sure
    of the odometry; but they are shorter, and `converge` stops before.
    """
    problem, kind = smoother.problem, smoother.problem.kind
    if not problem.estimate_noise:
        return noise
    n_steps, spread, worth = len(problem.increment), smoother.spread(now, nearly=True), problem.settings.pseudo_count
    of_steps, of_detections = leverages(smoother, spread)
    levels = noise.levels.copy()

    def learn(level: int, squares: float, numbers: float, leverage: float) -> None:
        expected = (squares + leverage) * float(noise.levels[level]) ** 2  # whitened as they are
        levels[level] = restricted_level(expected, numbers, begun.levels[level], worth)

    # odometry: its whitened residuals are in the right sides of its rows, with the root of their weights
    block = now.values[: 6 * OF_STEP * n_steps].reshape(n_steps, 6, OF_STEP)
    if problem.driven and not problem.steady:  # how fast a robot may move is no noise that shows in how it did
        swing, numbers = problem.swing, 3.0 * float(now.odometry_weight @ problem.swing.steps)
        by_turns = noise.rotation**2 * swing.arm_m2 / swing.variance(noise)[:, :3]
        for level, share in (
            (TRANSLATION, np.hstack([1.0 - by_turns, np.zeros_like(by_turns)])),
            (ROTATION, np.hstack([by_turns, np.ones_like(by_turns)])),
        ):
            unseen = numbers - float(now.odometry_weight @ share.sum(axis=1))  # of steps within an interval
            learn(level, float((share * block[:, :, 13] ** 2).sum()), numbers, float((share * of_steps).sum()) + unseen)
    for level, some, rows in (
        (ACROSS, kind != CORNERS, slice(0, 2)),
        (ALONG, (kind != CORNERS) & ~problem.ray, slice(2, 3)),  # ranges that nobody measured fit
        (ORIENTATION, kind == POSE, slice(3, 6)),
        (PIXEL, kind == CORNERS, slice(0, 8)),
    ):
        if some.any():
            w = now.weight[some]
            numbers = float(w.sum()) * (rows.stop - rows.start)
            if level == ORIENTATION:
                numbers -= float(w @ problem.about_axis[some])
            squares = float(w @ (now.residual[some, rows] ** 2).sum(axis=1))
            learn(level, squares, numbers, float(of_detections[some, rows].sum()))
    return SpatialNoise(*np.maximum(levels, problem.settings.least_noise).tolist())


def correlation(optimum: SpatialOptimum) -> float:
    """Return the correlation of the residuals of positions with those of the same place in the frame that saw it next.

    Outliers do not count. It is 0 where fewer than two frames see a place.
    """
    problem, now = optimum.smoother.problem, optimum.now
    good = np.flatnonzero((now.weight > problem.settings.inlier) & (problem.kind != CORNERS))
    order = good[np.lexsort((problem.pose_row[good], problem.place[good]))]
    same = problem.place[order[1:]] == problem.place[order[:-1]]
    before, after = now.residual[order[:-1][same], :3], now.residual[order[1:][same], :3]
    total = 0.5 * float((before**2).sum() + (after**2).sum())
    return float((before * after).sum()) / total if total > 0.0 else 0.0


def leverages(smoother: SpatialSmoother, spread: Spread) -> tuple[FloatArray, FloatArray]:
    """Return diagonals of `A S A'` of odometry (N - 1, 6) and detections (M, 8), weighted as the Jacobians are.

    These are leverages, in [0, 1] but for rounding.
    """
    n_steps, kind = len(smoother.problem.increment), smoother.problem.kind
    found = np.zeros((len(kind), 8))
    for k, rows in enumerate(ROWS.tolist()):
        some = np.flatnonzero(kind == k)
        found[some, :rows] = np.einsum("mrr->mr", spread.explained(n_steps + some, rows))
    steps = np.einsum("nrr->nr", spread.explained(np.arange(n_steps), 6))
    return np.clip(steps, 0.0, 1.0), np.clip(found, 0.0, 1.0)


def as_seen(problem: SpatialProblem, estimate: SpatialEstimate, measured: FloatArray) -> FloatArray:
    """Return (M, 7) where each detection puts its place in the world."""
    mount = estimate.mount(problem)[problem.sensor]
    return se3.compose(se3.compose(estimate.seen_from(problem)[0], mount), measured)


def oriented(problem: SpatialProblem, estimate: SpatialEstimate, weight: FloatArray) -> FloatArray:
    """Return (P, 7) places with the orientation that most of their detections agree on.

    A far tag looks the same from two sides; of each detection both orientations are asked.

    Args:
        problem: the measurements, with orientations.
        estimate: with places that may have none yet.
        weight: (M,) of detections, by their positions.
    """
    found = estimate.place.copy()
    first, other = (as_seen(problem, estimate, measured) for measured in problem.either)
    has_other = np.isfinite(problem.other[:, 3])
    gives = np.isfinite(problem.measured[:, 3]) & problem.oriented[problem.place]
    first_share = 1.0 / (1.0 + np.exp(-np.minimum(problem.other_log_odds, 50.0)))
    first_share = np.where(has_other, first_share, 1.0)
    sigma = np.hypot(problem.sigma_rad, problem.settings.repair.same_rad)
    for place in np.flatnonzero(problem.oriented):
        mine = np.flatnonzero(gives & (problem.place == place))
        if not len(mine):
            continue
        some = mine[:: max(1, len(mine) // MOST_CANDIDATES)]
        candidate = np.vstack([first[some], other[some][has_other[some]]])
        symmetry = problem.symmetries.kinds[problem.symmetries.of[place]]
        far = [
            np.exp(-0.5 * (symmetry.angle_between(candidate[:, None], seen[mine]) / sigma[mine]) ** 2)
            for seen in (first, np.where(has_other[:, None], other, first))
        ]
        mixed = first_share[mine] * far[0] + (1.0 - first_share[mine]) * far[1]
        score = np.log(mixed + 1e-6) @ weight[mine]
        best = candidate[int(np.argmax(score))]
        found[place, 3:] = symmetry.nearest(best, estimate.place[place])[3:]
    return found


def first_places(problem: SpatialProblem, pose: FloatArray) -> SpatialEstimate:
    """Return places where the middle one of their detections puts them, along given poses (N, 7)."""
    state = np.zeros((len(problem.mount), STATES))
    place = se3.identity(len(problem.oriented))
    estimate = SpatialEstimate(pose, place, state)
    at = as_seen(problem, estimate, np.where(np.isfinite(problem.measured), problem.measured, se3.identity()))
    for row in np.unique(problem.place).tolist():
        mine = np.flatnonzero(problem.place == row)
        away = np.linalg.norm(at[mine, :3] - np.median(at[mine, :3], axis=0), axis=1)
        place[row] = at[mine[int(np.argmin(away))]]
    place[~problem.oriented, 3:] = se3.NO_TURN
    return locate_unseen(problem, replace(estimate, place=place))


def locate_unseen(
    problem: SpatialProblem, estimate: SpatialEstimate, known: BoolArray | None = None
) -> SpatialEstimate:
    """Return values with places that no detection sees where further measurements have them along its poses.

    Those `known` (P,) stay. At the origin, where a place is that nobody located, a direction or range has no slope.
    """
    unseen = np.setdiff1d(np.arange(len(estimate.place)), problem.place)
    unseen = unseen if known is None else unseen[~known[unseen]]
    place = estimate.place.copy()
    for tied in problem.measurements:
        for row, at in tied.locate(estimate.pose, unseen).items():
            place[row, :3] = at
    return replace(estimate, place=place)
