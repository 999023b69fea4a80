"""The robust rule: how much a factor counts, by the square of its normalised residual; and a robust scale of errors."""

from __future__ import annotations

import math

from evermap.compiled import kept

MEDIAN_TO_SIGMA = 1.4826
"""Standard deviation of normal errors over the median of their sizes: the scale of a median absolute deviation."""
HEAVY_TAIL = 9.0
"""Square of a residual at which the Cauchy begins, while the estimate may be far off."""

kernel = kept(effort=1, error_model="numpy")


@kernel
def weigh(squared: float, log_odds: float, tail: float, share: float) -> tuple[float, float]:
    """Return the weight of a factor, and its negative log likelihood, which is 0 at 0.

    The weight is twice the derivative of the latter by `squared`.

    Args:
        squared: square of the normalised residual.
        log_odds: half of it at which an outlier is as likely as an inlier; infinite where none is.
        tail: 0 for the mixture of an inlier and an outlier; else the square at which a Cauchy begins, whose influence
            never vanishes, as while the estimate may be far off.
        share: information of an outlier, as a share of that of an inlier; 0 of what says nothing then.
    """
    if tail > 0.0:
        return 1.0 / (1.0 + squared / tail), 0.5 * tail * math.log1p(squared / tail)
    # -log(exp(-s / 2) + exp(-share s / 2 - log_odds)) without overflow
    d = 0.5 * squared * (1.0 - share) - log_odds
    log_sum = math.log1p(math.exp(d)) if d < 0.0 else d + math.log1p(math.exp(-d))
    inlier = 1.0 / (1.0 + math.exp(min(d, 700.0)))
    return inlier + (1.0 - inlier) * share, 0.5 * squared - log_sum + math.log1p(math.exp(-log_odds))
