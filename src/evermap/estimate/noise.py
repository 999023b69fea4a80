"""Noise levels from residuals: restricted maximum likelihood of variance components (Patterson and Thompson 1971).

At the optimum a residual is smaller than the noise that made it, by what the fit absorbed: its leverage, the diagonal
of `A S A'` of whitened Jacobians A and the covariance S. The level at which squares equal what is left for them is that
of the marginal likelihood with everything else integrated out (MATH.md, section 8).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from evermap.types import FloatArray


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
