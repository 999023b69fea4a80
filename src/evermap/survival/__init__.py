"""Lifetime priors: how long features stay (MATH.md section 1, Rosen 2016 section V)."""

from evermap.survival.callable import CallableHazard
from evermap.survival.exponential import Exponential
from evermap.survival.gamma import Gamma
from evermap.survival.general_purpose import GeneralPurpose
from evermap.survival.lognormal import LogNormal
from evermap.survival.mixture import Mixture
from evermap.survival.named import gone_by_day, gone_overnight, half_life, mean_stay, never_leaves, somewhere_between
from evermap.survival.periodic import PeriodicHazard
from evermap.survival.piecewise import PiecewiseConstantHazard
from evermap.survival.protocol import LifetimePrior, Seed
from evermap.survival.step import StepLifetime
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
