"""Noise levels from residuals: restricted maximum likelihood of variance components (Patterson and Thompson 1971).

At the optimum a residual is smaller than the noise that made it, by what the fit absorbed: its leverage, the diagonal
of `A S A'` of whitened Jacobians A and the covariance S. The level at which squares equal what is left for them is that
of the marginal likelihood with everything else integrated out (MATH.md, section 8).

The optimum depends on the levels, and the levels on what the optimum leaves: `alternate` seeks them in turns, in the
plane and in space.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from evermap.types import FloatArray

Levels = TypeVar("Levels")
"""Noise levels."""
Found = TypeVar("Found")
"""Values near the optimum of some levels, with what levels are learned from."""
Fit = TypeVar("Fit")
"""Levels that were learned."""


def restricted_level(squares: ArrayLike, count: ArrayLike, start: ArrayLike, pseudo: float) -> FloatArray:
    """Return standard deviations (...), one a component.

    Args:
        squares: sums of squared residuals, in the square of the level's unit, by inlier weight.
        count: sums of inlier weights less leverages: the degrees of freedom that are left.
        start: levels that `pseudo` imaginary residuals vouch for.
        pseudo: how many.
    """
    total = np.asarray(squares) + pseudo * np.asarray(start) ** 2
    return np.asarray(np.sqrt(total / (np.maximum(count, 0.0) + pseudo)))


def fit_variances(columns: FloatArray, squares: FloatArray, counts: FloatArray) -> FloatArray:
    """Return the most probable variances (K,), sums of columns (K, P) with weights that are not negative.

    By multiplicative steps, as variance components are sought (`slam.noise`): they stay positive.

    Args:
        columns: shapes of the variance, none of them negative.
        squares: (K,) sums of squares.
        counts: (K,) of so many numbers each.
    """
    share: FloatArray = (squares.sum() / counts.sum()) / columns.mean(axis=0)
    component = share / len(share)
    for _ in range(STEPS):
        variance = columns @ component
        component = component * ((squares / variance**2) @ columns) / ((counts / variance) @ columns)
    return np.asarray(columns @ component)


def raise_ranges(powers: tuple[int, ...], expected_m: FloatArray, measured_m: FloatArray) -> FloatArray:
    """Return (M, P) powers of ranges (M,), as they are shapes of the variance of what was measured there.

    By measured ranges, what is measured too short would count for more, and all lengths come out too short. So ranges
    are expected ones, but for one of four factors where the noise grows with the square: there an inverse range was
    measured, a disparity or the size of an image. The score of its squared residual, by the range, is
    `(1/m - 1/e) / e^2 = (e - m) / (e^3 m)`, and has no bias; by `e^4` lengths come out too long by the squared relative
    noise.
    """
    columns = expected_m[:, None] ** np.array(powers, dtype=np.float64)
    columns[:, np.array(powers) == 4] *= (measured_m / expected_m)[:, None]
    return np.asarray(columns)


def gain_by_variances(
    squares: FloatArray, counts: FloatArray, before: FloatArray, after: FloatArray, share: FloatArray | float
) -> float:
    """Return the log likelihood that variances (K,) gain over those before, of sums of squares of so many numbers.

    Of each a share (K,) is new.
    """
    return float(0.5 * np.sum(share * (squares * (1.0 / before - 1.0 / after) - counts * np.log(after / before))))


STEPS = 100
"""Multiplicative steps to the most probable variances."""
GAIN_NATS = 3.0
"""That a noise by range of up to three numbers more must gain over the noise before (Akaike 1974)."""


class Turns(NamedTuple):
    """Rules of `alternate`.

    Attributes:
        most: turns, at most.
        heavy: first turns, in which outliers have tails that never let go: the values may still be far off.
        within: change of the levels below which they are settled.
    """

    most: int
    heavy: int
    within: float


def alternate(
    levels: Levels,
    optimise: Callable[[Found | None, Levels, bool], Found],
    learn: Callable[[Found, Levels], tuple[Fit, float]],
    follow: Callable[[Levels, Fit, bool], Levels],
    turns: Turns,
) -> tuple[Found, Fit]:
    """Seek values and noise levels in turns until the levels change no more.

    Args:
        levels: to start from.
        optimise: values for these levels, from those of the turn before (None in the first); True in `heavy` turns.
        learn: levels by what these values leave of the residuals, and their change relative to those they belong to.
        follow: levels of the next turn, by those of this one and what was learned; True after a `heavy` turn.
        turns: rules.

    Returns:
        The values of the last turn, and what was learned there.
    """
    found, fit = None, None
    for turn in range(turns.most):
        heavy = turn < turns.heavy
        found = optimise(found, levels, heavy)
        fit, change = learn(found, levels)
        if change < turns.within and not heavy:
            break
        levels = follow(levels, fit, heavy)
    assert found is not None
    assert fit is not None
    return found, fit
