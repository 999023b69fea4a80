"""What all ranges of a sensor err by alike: found where a given map tells it, else part of what is not known.

A stereo pair whose disparity is off by half a pixel sees everything too near or too far, the more the farther it is, as
its standard deviation grows: by the square of the range. So the error is a number of standard deviations, the same for
all detections of a sensor; of ranges that are all alike uncertain it is a bias. Taken for independent noise it adds up,
over hundreds of detections, to evidence that places moved which a robot sees beside nearer or farther ones.

Without a map and odometry it is all but the metre of the session. Residuals would tell it in theory, but those of
pixels that err alike seem to tell it as well: of two in four recordings of a stereo pair they had the wrong sign, by 7
and 14 standard deviations. So values are those without an error, and covariances consider one (Schmidt 1966).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.estimate.sparse.system import exhaust
from evermap.slam.space.estimate import SpatialOptimum
from evermap.slam.space.linearise import ACROSS, ALONG, ROWS
from evermap.slam.space.problem import SpatialProblem
from evermap.slam.space.smoother import SpatialLinear, SpatialSmoother
from evermap.types import FloatArray

USUAL = 0.5
"""Standard deviation of a sensor's range error, over that of its ranges."""


def consider_range_errors(optimum: SpatialOptimum) -> FloatArray:
    """Return by what a standard deviation of each sensor's range error moves all numbers (numbers, S).

    Covariances at the optimum do not have it: those of two numbers are larger by the sum of their products (Schmidt
    1966, the consider filter). None (numbers, 0) where a map or odometry tells the error or the metre, or nothing has
    a range.
    """
    smoother, now = optimum.last
    problem = smoother.problem
    if problem.driven or len(problem.prior.place) or not problem.has_range.any():
        return np.zeros((smoother.structure.system.tree.begin[-1], 0))
    shape = USUAL * _by_error(replace(optimum, smoother=smoother, now=now))
    found = exhaust(smoother.factorised(now).solution())
    moved = [
        exhaust(smoother.factorised(smoother.with_residuals(now, own)).solution()) - found
        for own in (
            np.where((problem.sensor == sensor)[:, None], shape, 0.0)
            for sensor in np.unique(problem.sensor[problem.has_range]).tolist()
        )
    ]
    return np.column_stack(moved)


def find_range_errors(optimum: SpatialOptimum) -> FloatArray:
    """Return the errors of ranges (S,), in their standard deviations, after a step from the optimum in a map.

    All else is marginalised; what gains little is left as it is.
    """
    smoother, now, error = optimum.smoother, optimum.now, optimum.smoother.problem.range_error
    problem = smoother.problem
    if not problem.has_range.any() or not shows_errors(problem):
        return error
    information, pull = np.zeros(len(error)), np.zeros(len(error))
    counts = now.weight * problem.share
    counts *= problem.new_information(smoother.lasting(now))
    shape, residual = _by_error(optimum), _find_residuals(smoother, now)
    for sensor in np.unique(problem.sensor[problem.has_range]).tolist():
        own = np.where((problem.sensor == sensor)[:, None], shape, 0.0)
        left = _find_residuals(smoother, smoother.with_residuals(now, own)) - residual  # nothing else makes up for it
        information[sensor] = max(float(counts @ (own * left).sum(axis=1)), 0.0)
        pull[sensor] = -float(counts @ (own * residual).sum(axis=1))
    variance = 1.0 / (information + USUAL**-2)
    found = variance * (pull + information * error)
    return np.asarray(np.where(0.5 * found**2 / variance > problem.settings.repair.gain_nats, found, 0.0))


def shows_errors(problem: SpatialProblem) -> bool:
    """Tell whether errors that detections have in common can show: without odometry, in a map, more numbers were
    measured than are sought. With odometry, range errors are part of its scale, and what lasts is in its drift.
    """
    sought = 6 * len(problem.stamp_s) + 3 * len(problem.oriented)
    return not problem.driven and len(problem.prior.place) > 0 and int(ROWS[problem.kind].sum()) > sought


def _by_error(optimum: SpatialOptimum) -> FloatArray:
    """Return (M, 3) derivatives of whitened residuals by the range error of their sensor; 0 of what has no range."""
    problem, noise = optimum.smoother.problem, optimum.noise
    by = np.einsum("mij,mj->mi", problem.measured_root, problem.range_slope)
    return np.asarray(-by / noise.levels[[ACROSS, ACROSS, ALONG]])


def _find_residuals(smoother: SpatialSmoother, now: SpatialLinear) -> FloatArray:
    """Return (M, 3) whitened residuals at the optimum of the linearised problem."""
    return np.asarray(smoother.after(now, exhaust(smoother.factorised(now).solution())).residual[:, :3])
