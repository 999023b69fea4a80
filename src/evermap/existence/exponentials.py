"""Lifetime priors as mixtures of exponentials, which is what a Markov chain can hold."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.errors import ConfigError
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Mixture

NODES = 12
"""Rates that stand for an unknown one."""


class ExponentialMixture(NamedTuple):
    """A mixture of exponentials: the components and their probabilities."""

    components: tuple[Exponential, ...]
    weights: tuple[float, ...]


def exponential_mixture_of(prior: LifetimePrior, n: int = NODES) -> ExponentialMixture:
    """A lifetime prior as a mixture of exponentials.

    Exact for exponentials and mixtures of them; the general-purpose prior (unknown rate, Rosen 2016 eqs. 25-29) by
    Gauss-Legendre quadrature with `n` nodes over the logarithm of the rate.

    Raises:
        ConfigError: any other prior.
    """
    if isinstance(prior, Exponential):
        return ExponentialMixture((prior,), (1.0,))
    if isinstance(prior, GeneralPurpose):
        nodes, weights = np.polynomial.legendre.leggauss(n)
        rates = prior.low * np.exp(math.log(prior.high / prior.low) * 0.5 * (nodes + 1.0))
        return ExponentialMixture(tuple(Exponential(float(r)) for r in rates), tuple((0.5 * weights).tolist()))
    if isinstance(prior, Mixture):
        parts = [exponential_mixture_of(component, n) for component in prior.components]
        return ExponentialMixture(
            tuple(c for part in parts for c in part.components),
            tuple(w * v for w, part in zip(prior.weights, parts, strict=True) for v in part.weights),
        )
    raise ConfigError(
        f"{type(prior).__name__} is no mixture of exponentials",
        field="prior",
        hint="Exponential, GeneralPurpose, a Mixture of them, or the run-length filter",
    )
