"""A survival function for each group of lifetimes, by whichever estimator; always with a prior that filters take."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.errors import ConfigError, EvermapError
from evermap.runs.track.lifetimes import Group, LifetimeTable
from evermap.survival.base import LifetimePrior
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.text import prior_text
from evermap.types import FloatArray

if TYPE_CHECKING:
    from evermap.survival.hazard_regression import HazardDraws
    from evermap.survival.nonparametric import KaplanMeier, Npmle
    from evermap.survival.parametric_fit import ParametricFit

NPMLE, KAPLAN_MEIER, BEST, GP = "npmle", "kaplan-meier", "best", "gp"


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an estimator says of N lifetimes.

    Attributes:
        estimator: its name; of 'best', the family that was chosen.
        fitted: what the estimator returned.
        prior: the same as a lifetime prior.
        text: the prior as `survival.text` reads it.
        numbers: by name, for JSON; no nan and no infinity.
    """

    estimator: str
    fitted: Npmle | KaplanMeier | ParametricFit | HazardDraws
    prior: LifetimePrior
    text: str
    numbers: dict[str, Any]


def estimators() -> tuple[str, ...]:
    """All names that `estimate` takes."""
    from evermap.survival.parametric_fit import KINDS

    return (NPMLE, KAPLAN_MEIER, *KINDS, BEST, GP)


def check_estimator(name: str) -> None:
    """Raises ConfigError for a name that `estimate` does not take."""
    if name not in estimators():
        raise ConfigError(f"'{name}' is no estimator", field="estimator", hint=", ".join(estimators()))


def estimates(name: str, table: LifetimeTable, groups: Sequence[Group]) -> Iterator[Estimate]:
    """What an estimator says of each group, one after the other, so that a progress bar can follow.

    The Gaussian process learns from all groups what they have in common; the others see one group at a time.

    Args:
        name: one of `estimators()`.
        table: the lifetimes.
        groups: of them.

    Raises:
        ConfigError: an unknown name.
        DataError: lifetimes from which this estimator can learn nothing, or of a sort that it does not take.
        NumericalError: there is no most probable distribution.
    """
    check_estimator(name)
    if name == GP:
        yield from _gaussian_process(table, groups)
        return
    for group in groups:
        try:
            yield estimate(name, table.data[group.rows])
        except EvermapError as error:
            whose = f"{group.label}: " if len(groups) > 1 else ""
            raise type(error)(whose + error.problem, path=table.source, field=error.field, hint=error.hint) from error


def estimate(name: str, data: CensoredLifetimes) -> Estimate:
    """Fit lifetimes by themselves.

    Args:
        name: one of `estimators()` but for the Gaussian process.
        data: N lifetimes.

    Raises:
        DataError, NumericalError: as `estimates`.
    """
    if name == NPMLE:
        return _npmle(data)
    if name == KAPLAN_MEIER:
        return _kaplan_meier(data)
    return _parametric(name, data)


def _npmle(data: CensoredLifetimes) -> Estimate:
    from evermap.survival.nonparametric import npmle

    fitted = npmle(data)
    numbers = {
        "loglik": fitted.loglik,
        "kkt_violation": fitted.kkt_violation,
        "iterations": fitted.iterations,
        "support_left": fitted.support_left.tolist(),
        "support_right": _nulls(fitted.support_right),
        "mass": fitted.mass.tolist(),
    }
    return _with_prior(NPMLE, fitted, fitted.prior(), numbers)


def _kaplan_meier(data: CensoredLifetimes) -> Estimate:
    from evermap.survival.nonparametric import kaplan_meier

    fitted = kaplan_meier(data)
    lower, upper = fitted.band(fitted.time_s) if fitted.time_s.size else (fitted.time_s, fitted.time_s)
    numbers = {
        "time": fitted.time_s.tolist(),
        "survives": fitted.survives.tolist(),
        "lower_95": np.atleast_1d(lower).tolist(),
        "upper_95": np.atleast_1d(upper).tolist(),
        "at_risk": fitted.at_risk.tolist(),
        "deaths": fitted.deaths.tolist(),
    }
    return _with_prior(KAPLAN_MEIER, fitted, fitted.prior(), numbers)


def _parametric(name: str, data: CensoredLifetimes) -> Estimate:
    from evermap.survival.parametric_fit import fit, fit_best

    fitted = fit_best(data) if name == BEST else fit(name, data)
    numbers = {
        "loglik": fitted.loglik,
        "aic": fitted.aic,
        "bic": fitted.bic,
        "parameters": dict(zip(fitted.names, fitted.parameters.tolist(), strict=True)),
        "standard_errors": dict(zip(fitted.names, _nulls(fitted.standard_errors), strict=True)),
    }
    return _with_prior(fitted.kind, fitted, fitted.prior, numbers)


def _gaussian_process(table: LifetimeTable, groups: Sequence[Group]) -> Iterator[Estimate]:
    """One process over all groups, with class and place as covariates where they tell groups apart."""
    from evermap.survival.gaussian_process import Covariates, gp_fit

    known: dict[str, Any] = {}
    if groups[0].class_id is not None:
        known["class_id"] = table.class_of_row
    if groups[0].chunk is not None:
        known["place_m"] = table.position_m
    hazard = gp_fit(table.data, Covariates(**known))
    for group in groups:
        mean = {"class_id": table.class_of_row[group.rows[0]], "place_m": table.position_m[group.rows].mean(axis=0)}
        draws = hazard.at(**{name: mean[name] for name in known})
        expected, lower, upper = draws.survival(draws.edges_s)
        numbers = {
            "log_evidence": hazard.log_evidence,
            "scales": hazard.scales,
            "time": draws.edges_s.tolist(),
            "survives": expected.tolist(),
            "lower_95": lower.tolist(),
            "upper_95": upper.tolist(),
        }
        yield _with_prior(GP, draws, draws.prior(), numbers)


def _with_prior(
    name: str, fitted: Npmle | KaplanMeier | ParametricFit | HazardDraws, prior: LifetimePrior, numbers: dict[str, Any]
) -> Estimate:
    return Estimate(name, fitted, prior, prior_text(prior), numbers)


def _nulls(values: FloatArray) -> list[float | None]:
    """For JSON, which knows no infinity."""
    return [value if math.isfinite(value) else None for value in values.tolist()]
