"""Lifetime priors: how long features stay (MATH.md section 1, Rosen 2016 section V)."""

from evermap.survival.base import LifetimePrior, Seed
from evermap.survival.families import Exponential, Gamma, GeneralPurpose, LogNormal, Mixture, Uniform, Weibull
from evermap.survival.hazards import (
    PeriodicHazard,
    PiecewiseConstantHazard,
    ScaledHazard,
    StepLifetime,
    gone_daily,
    never_leaves,
)
from evermap.survival.text import parse_prior

__all__ = [
    "Exponential",
    "Gamma",
    "GeneralPurpose",
    "LifetimePrior",
    "LogNormal",
    "Mixture",
    "PeriodicHazard",
    "PiecewiseConstantHazard",
    "ScaledHazard",
    "Seed",
    "StepLifetime",
    "Uniform",
    "Weibull",
    "gone_daily",
    "never_leaves",
    "parse_prior",
]
