"""Lifetime priors: how long features stay (MATH.md section 1, Rosen 2016 section V)."""

from evermap.survival.base import LifetimePrior, Seed
from evermap.survival.exponential import Exponential, half_life, mean_stay
from evermap.survival.gamma import Gamma
from evermap.survival.general_purpose import GeneralPurpose, somewhere_between
from evermap.survival.hazards import (
    CallableHazard,
    PeriodicHazard,
    PiecewiseConstantHazard,
    gone_by_day,
    gone_overnight,
)
from evermap.survival.lognormal import LogNormal
from evermap.survival.mixture import Mixture
from evermap.survival.step import StepLifetime, never_leaves
from evermap.survival.text import parse_prior
from evermap.survival.uniform import Uniform
from evermap.survival.weibull import Weibull

__all__ = [
    "CallableHazard",
    "Exponential",
    "Gamma",
    "GeneralPurpose",
    "LifetimePrior",
    "LogNormal",
    "Mixture",
    "PeriodicHazard",
    "PiecewiseConstantHazard",
    "Seed",
    "StepLifetime",
    "Uniform",
    "Weibull",
    "gone_by_day",
    "gone_overnight",
    "half_life",
    "mean_stay",
    "never_leaves",
    "parse_prior",
    "somewhere_between",
]
