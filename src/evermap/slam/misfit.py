"""Errors that the law of a sensor leaves: ranges that are off by a curve of the distance, or of the direction.

Calibration states hold an offset, a slope, a skew. A real sensor is off by a curve: beams that graze, the motion during
a scan. Such an error is the same wherever its distance comes again, so no number of readings tells it from the states
that it resembles: the offset of a curve that bends is known as well as the bend goes on, however many readings there
are.

Curves are polynomials (Legendre) with random coefficients, of a variance and a smoothness that residuals tell by
marginal likelihood (empirical Bayes). What they may have moved the states by adds to the variances of these.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from evermap.types import BoolArray, FloatArray, IntArray

RANGE, BEARING = 0, 1
DEGREES = ((2, 5), (1, 4))
"""First and last degree of the polynomials by range and by bearing. A constant is a calibration state; a straight line
by range is that and the size of the map."""
SIGMAS_M = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)
"""Standard deviations of a straight line's coefficient that are tried [m]."""
FALLS = (0, 2)
"""Powers of the degree by which these fall, that are tried: 2 as of a curve whose second derivative is white (Wahba
1978), which goes on as it bends, or 0 of one that is as rough as there are degrees."""
CURVED = 3.0
"""Nats by which residuals must tell that there are curves: of three numbers more (Akaike 1974)."""
EDGE = 0.005
"""Share of the readings beyond either end of the interval on which the polynomials are orthogonal."""


class Curves(NamedTuple):
    """Curves of the ranges and bearings of some readings.

    Attributes:
        value: (M, K) values at the readings.
        argument: (K,) of each: `RANGE` or `BEARING`.
        degree: (K,) of each polynomial.
        straight: (2,) offset and slope of the straight line by range that belongs to them, which no reading tells from
            an offset and the size of the map.
    """

    value: FloatArray
    argument: IntArray
    degree: FloatArray
    straight: FloatArray


def build_curves(reading: FloatArray, used: BoolArray) -> Curves:
    """Return curves of readings (M, 2) of range and bearing, on the interval of those that are `used` (M,)."""
    value, argument, degree = list[FloatArray](), list[int](), list[int]()
    straight = np.zeros(2)
    for axis, (first, last) in enumerate(DEGREES):
        low, high = np.quantile(reading[used, axis], [EDGE, 1.0 - EDGE]) if used.any() else (0.0, 0.0)
        if not high > low:  # ranges alone have one bearing
            continue
        x = np.clip(2.0 * (reading[:, axis] - low) / (high - low) - 1.0, -1.0, 1.0)
        value.append(np.asarray(legvander(x, last)[:, first:], dtype=np.float64))
        argument += [axis] * (last + 1 - first)
        degree += range(first, last + 1)
        if axis == RANGE:
            straight = np.array([-(high + low), 2.0]) / (high - low)
    whole = np.hstack(value) if value else np.zeros((len(reading), 0))
    return Curves(whole, np.array(argument, dtype=np.int64), np.array(degree, dtype=np.float64), straight)


def variance_by_curves(
    information: FloatArray, right: FloatArray, prior: FloatArray, off: FloatArray, worth: float, curves: Curves
) -> FloatArray:
    """Return (S,) mean squares of what curves may have moved the estimates of calibration states by.

    Args:
        information: (S + K, S + K) of the readings on states and curves, all else marginalised.
        right: (S + K,) their pull at the estimate.
        prior: (S,) information of the states' prior; the first two are offset and slope of ranges.
        off: (S,) the estimate less the mean of that prior.
        worth: number of readings that count as one.
        curves: of the readings.
    """
    n, count = len(prior), len(curves.argument)
    states, cross = information[:n, :n] + np.diag(prior), information[:n, n:]
    moved = np.linalg.solve(states, cross)
    own = (information[n:, n:] - cross.T @ moved) / worth
    pull = (right[n:] - moved.T @ (right[:n] - prior * off)) / worth
    best, straight, mean, spread = CURVED, 0.0, np.zeros(count), np.zeros((count, count))
    for falls, *sigma in product(FALLS, *[SIGMAS_M] * len(DEGREES)):
        each = np.array(sigma)[curves.argument] / curves.degree**falls
        whole = np.eye(count) + each[:, None] * own * each
        estimate = each * np.linalg.solve(whole, each * pull)
        gain = 0.5 * float(estimate @ pull) - 0.5 * float(np.linalg.slogdet(whole)[1])
        if gain > best:
            best, straight, mean = gain, sigma[RANGE], estimate
            spread = each[:, None] * np.linalg.inv(whole) * each
    variance = np.einsum("sk,kl,sl->s", moved, np.outer(mean, mean) + spread, moved)
    line = straight * (np.eye(n) - np.linalg.inv(states) * prior)[:, : len(curves.straight)] @ curves.straight
    return np.asarray(variance + line**2)
