"""Lifetime priors as plain numbers and words, for JSON: exact, and read back as they were."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from evermap.errors import ConfigError
from evermap.survival.exponential import Exponential
from evermap.survival.gamma import Gamma
from evermap.survival.general_purpose import GeneralPurpose
from evermap.survival.lognormal import LogNormal
from evermap.survival.mixture import Mixture
from evermap.survival.periodic import PeriodicHazard
from evermap.survival.piecewise import PiecewiseConstantHazard
from evermap.survival.protocol import LifetimePrior
from evermap.survival.step import StepLifetime
from evermap.survival.uniform import Uniform
from evermap.survival.weibull import Weibull

KINDS: Mapping[str, type[Any]] = {
    kind.__name__: kind
    for kind in (
        Exponential,
        Gamma,
        GeneralPurpose,
        LogNormal,
        Mixture,
        PeriodicHazard,
        PiecewiseConstantHazard,
        StepLifetime,
        Uniform,
        Weibull,
    )
}
"""All that is made of numbers, by name; a hazard that is a function of the user's is not."""


def prior_to_dict(prior: LifetimePrior) -> dict[str, Any]:
    """`{"lifetime": name, field: value, ...}` of JSON's own types; infinity is the word 'inf'.

    Raises:
        ConfigError: the prior holds something that is no number, such as a function.
    """
    name = type(prior).__name__
    if KINDS.get(name) is not type(prior):
        raise ConfigError(f"{name} cannot be written down", field="prior", hint=f"one of {', '.join(KINDS)}")
    values: Any = prior
    return {"lifetime": name} | {item.name: _plain(getattr(values, item.name)) for item in fields(values)}


def prior_from_dict(content: Mapping[str, Any]) -> LifetimePrior:
    """What `prior_to_dict` wrote.

    Raises:
        ConfigError: an unknown name, a field too many or too few, or values that cannot be.
    """
    kind = KINDS.get(str(content.get("lifetime")))
    if kind is None:
        raise ConfigError(f"no lifetime is called {content.get('lifetime')!r}", field="lifetime", hint=", ".join(KINDS))
    known = {item.name for item in fields(kind)}
    for name in sorted(known ^ (content.keys() - {"lifetime"})):
        problem = "is missing" if name in known else f"is no value of {kind.__name__}"
        raise ConfigError(problem, field=name)
    try:
        prior: LifetimePrior = kind(**{name: _value(content[name]) for name in known})
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise ConfigError(f"is not what is expected: {error}", field=kind.__name__) from error
    return prior


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | int):
        return "inf" if value == float("inf") else float(value)
    return prior_to_dict(value)


def _value(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_value(item) for item in value)
    return prior_from_dict(value) if isinstance(value, Mapping) else float(value)
