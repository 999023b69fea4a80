"""Lifetime priors into the text that `text.parse_prior` reads: estimates that go to a command line or into a file."""

from __future__ import annotations

import math

from evermap.errors import ConfigError
from evermap.survival.exponential import Exponential
from evermap.survival.gamma import Gamma
from evermap.survival.general_purpose import GeneralPurpose
from evermap.survival.lognormal import LogNormal
from evermap.survival.mixture import Mixture
from evermap.survival.piecewise import PiecewiseConstantHazard
from evermap.survival.protocol import LifetimePrior
from evermap.survival.step import StepLifetime
from evermap.survival.uniform import Uniform
from evermap.survival.weibull import Weibull


def prior_text(prior: LifetimePrior) -> str:
    """The prior as text, in seconds and with all digits; reading it gives the same prior.

    Args:
        prior: any that has a form of its own, or a mixture of such.

    Raises:
        ConfigError: it has none, as a hazard that is a function.
    """
    match prior:
        case Exponential():
            return f"exponential:rate={prior.rate!r}/s"
        case Weibull():
            return f"weibull:scale={prior.scale_s!r}s,shape={prior.shape!r}"
        case LogNormal():
            return f"lognormal:median={math.exp(prior.mu)!r}s,spread={prior.sigma!r}"
        case Gamma():
            return f"gamma:scale={prior.scale_s!r}s,shape={prior.shape!r}"
        case Uniform():
            return f"uniform:limit={prior.limit_s!r}s"
        case GeneralPurpose():
            return f"general-purpose:low={prior.low!r}/s,high={prior.high!r}/s"
        case PiecewiseConstantHazard():
            steps = zip(prior.edges_s, prior.rates, strict=True)
            return "hazard:" + ",".join(f"{float(edge)!r}s={float(rate)!r}/s" for edge, rate in steps)
        case StepLifetime():
            return "mass:" + ",".join(_shares(prior))
        case Mixture():
            parts = zip(prior.weights, prior.components, strict=True)
            return "+".join(f"{float(weight)!r}*{prior_text(part)}" for weight, part in parts)
    raise ConfigError(f"a {type(prior).__name__} cannot be written as text", field="prior")


def _shares(prior: StepLifetime) -> list[str]:
    """`when=share` for every mass; what never leaves is one share, and points and spans that agree are one too."""
    total: dict[str, float] = {}
    for start, end, mass in zip(prior.starts_s, prior.ends_s, prior.masses, strict=True):
        when = "never" if math.isinf(end) else f"{end!r}s" if start == end else f"{start!r}s..{end!r}s"
        total[when] = total.get(when, 0.0) + mass
    return [f"{when}={mass!r}" for when, mass in total.items()]
