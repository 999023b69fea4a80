"""Log marginal likelihood of noise levels in space: which of several explanations of the same residuals is the better.

Learned in turns with the values, noise levels have several fixed points: one where the odometry is exact and all that
is seen errs for long, one where detections are exact and the odometry drifts. Their restricted likelihood (Laplace
approximation, poses, places and calibration integrated out; MATH.md, section 8),

    log p(z | levels) = -1/2 sum log |Sigma| - cost - 1/2 log |H|,

says which is more probable. Errors of detections that last have a density of their own: each residual is whitened by
those of the same landmark before it (Cholesky factor of their correlation), and counts in `H` as what is new in it. A
row of outliers is no more independent than a row of errors: each costs its share of the information, too. Else a
landmark that stands seems to have moved wherever one view of it errs for long.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from evermap.estimate.sparse.system import exhaust
from evermap.slam.correlation import Lasting
from evermap.slam.room import hold_in_room
from evermap.slam.space.estimate import SpatialOptimum
from evermap.slam.space.linearise import (
    ACROSS,
    ALONG,
    CORNERS,
    ORIENTATION,
    PIXEL,
    POINT,
    POSE,
    ROWS,
)
from evermap.slam.space.problem import SpatialNoise, SpatialProblem
from evermap.slam.space.smoother import SIGHTINGS, SpatialLinear, SpatialSmoother
from evermap.types import BoolArray, FloatArray

TOGETHER = 200
"""Sightings of one landmark whose errors are correlated with each other, at most: more make too large a factor."""
SHARES = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
"""Shares of the variance that last which are tried, beside those that a variogram has."""
OUTLIER = 0.5
"""Inlier probability below which a factor is an outlier."""
NUGGET = 1e-3
"""Share of the variance that is white at least."""
INDEPENDENT = Lasting(np.ones(1), np.zeros(1))
"""Errors that do not last."""


def log_marginal_likelihood(
    optimum: SpatialOptimum, begun: SpatialNoise, lasting: Lasting | None = None, *, of_places: bool = False
) -> float:
    """Return the log marginal likelihood of an optimum's noise levels, up to a constant of the measurements [nats].

    Outliers have the density that they have at the levels `begun`, whatever the levels are: else it would be best to
    call everything an outlier of exact sensors.

    Args:
        optimum: values that are the optimum of their levels.
        begun: levels to compare outliers with, the same for all that are compared.
        lasting: how long errors of detections last; None: they are independent.
        of_places: whether solutions with other places are compared: places of which no map says anything have a prior
            then, and of outliers of one place in a row only what is new counts.
    """
    smoother, noise = optimum.smoother, optimum.noise
    problem = smoother.problem
    now = smoother.linearised(optimum.estimate, noise, heavy=False)
    good = now.weight > OUTLIER
    new, of_inliers, shape = np.ones(len(good)), 0.5 * float((now.residual[good] ** 2).sum()), INDEPENDENT
    if lasting is not None and lasting.any:
        shape, new, noise, of_inliers = _likeliest_lasting(problem, now.residual, good, noise, lasting)
    of_inliers += float(_log_sigmas(problem, noise)[good].sum())
    of_inliers -= 0.5 * float((ROWS[problem.kind] * np.log(new))[good].sum())
    of_outliers = _cost_of_outliers(problem, begun, ~good, shape if of_places else INDEPENDENT)
    driven = smoother.driven(now)[..., -1]
    kept = now.odometry_weight > OUTLIER
    of_odometry = 0.5 * float((driven[kept] ** 2).sum())
    if problem.driven:
        of_odometry += 0.5 * float(np.log(problem.swing.variance(noise)[kept]).sum())
        of_odometry += 0.5 * float(np.log(problem.swing.variance(begun)[~kept]).sum())
        of_odometry += float(np.count_nonzero(~kept)) * problem.settings.jump_log_odds
    priors = _cost_of_priors(smoother, now)
    counted = SpatialSmoother(replace(problem, share=new), optimum.estimate.pose)
    linear = counted.linearised(optimum.estimate, noise, heavy=False)
    graph, of_room = counted.graph(noise, heavy=False), 0.0
    if of_places:
        free = np.setdiff1d(np.arange(len(problem.oriented)), problem.prior.place)
        graph, _, of_room = hold_in_room(graph, len(problem.stamp_s) + free)
    information = exhaust(graph.factorised(linear.now))
    return float(of_room - of_inliers - of_outliers - of_odometry - priors - 0.5 * information.log_determinant)


def _cost_of_outliers(problem: SpatialProblem, begun: SpatialNoise, odd: BoolArray, lasting: Lasting) -> float:
    """Return what outliers cost: of those of one place in a row only what is new, as they err for one reason."""
    new = lasting.information(problem.stamp_s[problem.pose_row[odd]], problem.place[odd])
    return float((new * problem.sightings.log_odds[problem.kind[odd]] + _log_sigmas(problem, begun)[odd]).sum())


def _log_sigmas(problem: SpatialProblem, noise: SpatialNoise) -> FloatArray:
    """Return (M,) sums of the logarithms of the levels of the components of each detection."""
    level, kind = np.log(noise.levels), problem.kind
    found = np.where(kind == CORNERS, 8.0 * level[PIXEL], 2.0 * level[ACROSS])
    found += np.where((kind != CORNERS) & ~problem.ray, level[ALONG], 0.0)
    return np.asarray(found + np.where(kind == POSE, (3.0 - problem.about_axis) * level[ORIENTATION], 0.0))


def _likeliest_lasting(
    problem: SpatialProblem, residual: FloatArray, good: BoolArray, noise: SpatialNoise, lasting: Lasting
) -> tuple[Lasting, FloatArray, SpatialNoise, float]:
    """Return how long errors last, what is new in each detection (M,), noise levels and half the sum of squares, by
    which inliers are most probable.

    Each shape has its best levels in closed form; one of the times and all of those of the variogram are tried.
    """
    shapes = [lasting]
    for persist_s in lasting.persist_s:
        shapes += [Lasting(np.array([persist_s]), np.array([share])) for share in SHARES]
    best, found = -np.inf, (lasting, np.ones(len(good)), noise, 0.0)
    for shape in shapes:
        white, new = _condition_errors(problem, residual, good, shape)
        scale = _scales(problem, white, good)
        at = SpatialNoise(*(noise.levels * scale).tolist())
        likelihood = 0.5 * float((ROWS[problem.kind] * np.log(new))[good].sum())
        likelihood -= float(_log_sigmas(problem, at)[good].sum())
        half = 0.5 * sum(
            float((white[good][problem.kind[good] == kind, rows] ** 2).sum()) / float(scale[level]) ** 2
            for level, kind, rows in _PARTS
        )
        if likelihood - half > best:
            best, found = likelihood - half, (shape, new, at, half)
    return found


_PARTS = (
    *((ACROSS, kind, slice(0, 2)) for kind in (POINT, POSE)),
    *((ALONG, kind, slice(2, 3)) for kind in (POINT, POSE)),
    (ORIENTATION, POSE, slice(3, 6)),
    (PIXEL, CORNERS, slice(0, 8)),
)
"""Level, kind of detection, and residuals that it is of."""


def _scales(problem: SpatialProblem, white: FloatArray, good: BoolArray) -> FloatArray:
    """Return (6,) root mean squares of whitened residuals by level; 1 of those that have none."""
    squares, counts = np.zeros((2, 6))
    for level, kind, rows in _PARTS:
        some = good & (problem.kind == kind) & ~(problem.ray & (level == ALONG))
        squares[level] += float((white[some, rows] ** 2).sum())
        counts[level] += int(some.sum()) * (rows.stop - rows.start)
        if level == ORIENTATION:
            counts[level] -= int((some & problem.about_axis).sum())
    return np.sqrt(np.where((counts > 0) & (squares > 0.0), squares / np.maximum(counts, 1), 1.0))


def _condition_errors(
    problem: SpatialProblem, residual: FloatArray, good: BoolArray, lasting: Lasting
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (M, 8) less what those of the same landmark before say of them, and (M,) informations of what
    is new in each, over that of an independent one.
    """
    white, new = residual.copy(), np.ones(len(residual))
    stamp_s = problem.stamp_s[problem.pose_row]
    for place in range(len(problem.oriented)):
        mine = np.flatnonzero(good & (problem.place == place))
        for begin in range(0, len(mine), TOGETHER):
            some = mine[begin : begin + TOGETHER]
            root = cholesky(lasting.correlation(stamp_s[some]) + NUGGET * np.eye(len(some)), lower=True)
            white[some] = solve_triangular(root, residual[some], lower=True)
            new[some] = np.diag(root) ** -2.0
    return white, new


def _cost_of_priors(smoother: SpatialSmoother, now: SpatialLinear) -> float:
    """Return what all else costs: the start, a map, measurements of other kinds, calibration."""
    structure, border = smoother.structure, now.now.border_right
    tree, first = structure.system.tree, structure.first[SIGHTINGS + 1]
    cost = 0.5 * float(border @ (border / smoother.states_information))
    for factor in range(first, structure.first[-1]):
        values = now.values[tree.value_first[factor] : tree.value_first[factor + 1]]
        right = values.reshape(int(structure.system.factors.rows[factor]), -1)[:, -1]
        cost += 0.5 * float(right @ right)
    return cost
