"""Newton's method for the most probable numbers of a smooth process: damped, and safe where a likelihood is convex."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from evermap.types import FloatArray

MOST_STEPS, LONGEST, SHORTEST = 40, 2.0, 1e-6
"""Steps; change of any value of the process in one of them, at most; and share of a step below which none is better."""


def climb(
    goodness: Callable[[FloatArray], float],
    bend: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    start: FloatArray,
    columns: FloatArray,
    settled: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Return the most probable numbers (P,), the negative second derivative (P, P) there, and their log probability.

    Args:
        goodness: log probability of numbers, -inf where there is none.
        bend: gradient (P,) and negative second derivative (P, P), which is positive definite.
        start: numbers to begin with.
        columns: (K, P) that make values of the process of numbers.
        settled: gain of a step from which on none is taken.
    """
    at, best = start, goodness(start)
    slope, hessian = bend(at)
    for _ in range(MOST_STEPS):
        step = np.linalg.solve(hessian, slope)
        share = min(1.0, LONGEST / max(float(np.abs(columns @ step).max()), 1e-300))
        while (after := goodness(at + share * step)) < best and share > SHORTEST:
            share *= 0.5
        gain = after - best
        if gain > 0.0:
            at, best = at + share * step, after
            slope, hessian = bend(at)
        if gain < settled:
            break
    return at, hessian, best


def drop_negative(information: FloatArray, penalty: FloatArray) -> FloatArray:
    """Return an information (P, P) without its negative directions, if with half of a penalty (P, P) it has any."""
    try:
        np.linalg.cholesky(information + 0.5 * penalty)
    except np.linalg.LinAlgError:  # within a wide interval the likelihood may be convex
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
    return information


def log_determinant(matrix: FloatArray) -> float:
    """Return the logarithm of the size of a determinant."""
    return float(np.linalg.slogdet(matrix)[1])
