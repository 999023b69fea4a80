"""Lifetime priors: how long features stay (MATH.md section 1, Rosen 2016 section V)."""

from evermap.survival.exponential import Exponential
from evermap.survival.gamma import Gamma
from evermap.survival.general_purpose import GeneralPurpose
from evermap.survival.lognormal import LogNormal
from evermap.survival.mixture import Mixture
from evermap.survival.periodic import PeriodicHazard
from evermap.survival.piecewise import PiecewiseConstantHazard
from evermap.survival.protocol import LifetimePrior, Seed
from evermap.survival.uniform import Uniform
from evermap.survival.weibull import Weibull

__all__ = [
    "Exponential",
    "Gamma",
    "GeneralPurpose",
    "LifetimePrior",
    "LogNormal",
    "Mixture",
    "PeriodicHazard",
    "PiecewiseConstantHazard",
    "Seed",
    "Uniform",
    "Weibull",
]
