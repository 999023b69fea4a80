"""What a prior says about the gap between two looks, in the form that the filters use."""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.survival import GeneralPurpose, LifetimePrior, PiecewiseConstantHazard
from evermap.types import FloatArray, IntArray

WIDE = 1.01
"""Ratio of highest to lowest rate above which the kernel of the unknown-rate prior keeps ten digits."""


def log_death_odds(
    priors: tuple[LifetimePrior, ...], prior_of_row: IntArray, start_s: FloatArray, stop_s: FloatArray
) -> FloatArray:
    """Log-odds of dying within a gap, `log(1 - q) - log q`, one prior call for each prior in use.

    Args:
        priors: lifetime priors.
        prior_of_row: (M,) index into them.
        start_s: (M,) begin of each gap, since birth.
        stop_s: (M,) its end.

    Returns:
        (M,) -inf for no chance to die, +inf for certain death, also where the feature had certainly died before.
    """
    odds = np.empty(len(start_s))
    for index, prior in enumerate(priors):
        rows: Any = slice(None) if len(priors) == 1 else np.flatnonzero(prior_of_row == index)
        with np.errstate(all="ignore"):
            start, stop = start_s[rows], stop_s[rows]
            if isinstance(prior, GeneralPurpose) and prior.high > WIDE * prior.low:
                odds[rows] = np.log(_unknown_rate(prior, start, stop))
                continue
            if isinstance(prior, PiecewiseConstantHazard):  # what maps learn, and thus asked for millions of gaps
                odds[rows] = np.log(np.expm1(prior.integrated_hazard(start, stop)))
                continue
            survival = np.asarray(prior.log_conditional_survival(start, stop), dtype=np.float64)
            death = np.asarray(prior.log_conditional_death(start, stop), dtype=np.float64)
            # After certain death the conditional is 0 / 0: nothing outlives it, whatever a prior answers.
            lost = np.isneginf(survival) | np.isnan(survival)
            odds[rows] = np.where(lost, np.inf, death - survival)
    return odds


def _unknown_rate(prior: GeneralPurpose, start_s: FloatArray, stop_s: FloatArray) -> FloatArray:
    """Odds of dying under the prior of robots that know nothing, compiled: the general road takes 10 us a gap."""
    from evermap.existence.kernels import general_purpose_gaps

    odds = np.empty(len(start_s))
    general_purpose_gaps(prior.low, prior.high, np.ascontiguousarray(start_s), np.ascontiguousarray(stop_s), odds)
    return odds
