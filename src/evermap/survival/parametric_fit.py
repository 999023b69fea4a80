"""Lifetime models fitted to censored lifetimes by maximum likelihood (MATH.md section 6).

A sample `left < T <= right`, known because `T > entry`, has the log likelihood

    log q(entry, a) + log(1 - q(a, right))      a = max(left, entry); the second term only where right is finite
    log p(T) - log S(entry)                     an exact one

and a prior computes each term without cancellation, so any model that can be built from real numbers can be fitted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError, DataError, NumericalError
from evermap.survival.base import LifetimePrior, SurvivalEstimate, check_open_share
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.families import Exponential, Gamma, GeneralPurpose, LogNormal, Mixture, Weibull
from evermap.survival.hazards import never_leaves
from evermap.types import FloatArray

_IMPOSSIBLE = 1e10
"""Replaces an infinite mean of minus the log likelihood, from which the search could not step back."""
_GRADIENT_STEP, _HESSIAN_STEP = 1e-5, 1e-3
"""Steps of central differences; parameters are logarithms, so these are relative changes."""
_FARTHEST = 12.0
"""How far from its start, in logarithms, a parameter is sought; at that bound there is no maximum."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A family of lifetimes with P real parameters.

    Attributes:
        names: P names of the parameters; times are in seconds.
        build: makes the prior with given (P,) parameters.
        starts: gives starting points for a rough mean stay in seconds; the best maximum is taken.
    """

    names: tuple[str, ...]
    build: Callable[[FloatArray], LifetimePrior]
    starts: Callable[[float], Sequence[Sequence[float]]]


def _share(logit: float) -> float:
    return 1.0 / (1.0 + math.exp(-logit))


KINDS: Mapping[str, Kind] = {
    "exponential": Kind(("log_rate",), lambda p: Exponential(math.exp(p[0])), lambda mean: [[-math.log(mean)]]),
    "weibull": Kind(
        ("log_scale_s", "log_shape"),
        lambda p: Weibull(math.exp(p[0]), math.exp(p[1])),
        lambda mean: [[math.log(mean), 0.0]],
    ),
    "lognormal": Kind(
        ("mu", "log_sigma"),
        lambda p: LogNormal(float(p[0]), math.exp(p[1])),
        lambda mean: [[math.log(mean) - 0.5, 0.0]],
    ),
    "gamma": Kind(
        ("log_scale_s", "log_shape"),
        lambda p: Gamma(math.exp(p[0]), math.exp(p[1])),
        lambda mean: [[math.log(mean), 0.0]],
    ),
    "general-purpose": Kind(
        ("log_low", "log_decades"),
        lambda p: GeneralPurpose(math.exp(p[0]), math.exp(p[0]) * 10.0 ** math.exp(p[1])),
        lambda mean: [[-math.log(mean) - 1.0, 0.0]],
    ),
    "two-exponentials": Kind(
        ("log_rate_of_first", "log_rate_of_second", "logit_share_of_first"),
        lambda p: Mixture.of((Exponential(math.exp(p[0])), Exponential(math.exp(p[1]))), (_share(p[2]), _share(-p[2]))),
        lambda mean: [
            [math.log(ratio / mean), -math.log(2.0 * mean), logit] for ratio, logit in ((3.0, 0.0), (30.0, -1.0))
        ],
    ),
    "some-never-leave": Kind(
        ("log_rate", "logit_share_that_leaves"),
        lambda p: Mixture.of((Exponential(math.exp(p[0])), never_leaves()), (_share(p[1]), _share(-p[1]))),
        lambda mean: [[math.log(2.0 / mean), 0.0]],
    ),
}
"""Families by name; `fit` takes a `Kind` of your own as well."""


@dataclass(frozen=True, slots=True, eq=False)
class ParametricFit(SurvivalEstimate):
    """Maximum likelihood estimate within a family.

    Attributes:
        kind: the family's name.
        family: the family.
        prior: its most probable member.
        parameters: (P,) numbers that it was built from, named by `names`.
        covariance: (P, P) inverse of the observed information.
        loglik: `sum w log P(left < T <= right | T > entry)`; densities in 1/s for exact samples.
        n_samples: sum of the weights.
    """

    kind: str
    family: Kind
    prior: LifetimePrior
    parameters: FloatArray
    covariance: FloatArray
    loglik: float
    n_samples: float

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return self.family.names

    @property
    def n_parameters(self) -> int:
        """Return the number of parameters."""
        return len(self.parameters)

    @property
    def standard_errors(self) -> FloatArray:
        """Return the standard errors (P,) of the parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def aic(self) -> float:
        """Return Akaike's criterion, `2 P - 2 loglik`; smaller is better."""
        return 2.0 * self.n_parameters - 2.0 * self.loglik

    @property
    def bic(self) -> float:
        """Return the Bayesian criterion, `P log n - 2 loglik`."""
        return self.n_parameters * math.log(self.n_samples) - 2.0 * self.loglik

    def band(self, t: ArrayLike, confidence: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Return pointwise lower and upper bounds of `P(T > t)`, valid if the family is right.

        By the delta method on the scale of `log(-log S)`, on which the bounds stay in [0, 1].

        Raises:
            ConfigError: `confidence` is not in (0, 1), or an invalid time.
        """
        check_open_share(confidence)
        middle, spread = self._log_hazard(self.parameters, t), self._spread(t)
        half_width = NormalDist().inv_cdf(0.5 + 0.5 * confidence) * spread
        lower, upper = (np.exp(-np.exp(middle + sign * half_width)) for sign in (1.0, -1.0))
        return lower[()], upper[()]

    def variance(self, t: ArrayLike) -> FloatArray:
        """Return the variance of the estimated `P(T > t)`, by the delta method."""
        cumulative = np.asarray(self.prior.cumulative_hazard(t))
        finite = np.where(np.isfinite(cumulative), cumulative, 0.0)
        return np.asarray(np.square(np.exp(-finite) * finite * self._spread(t)))[()]

    def _log_hazard(self, parameters: FloatArray, t: ArrayLike) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(self.family.build(parameters).cumulative_hazard(t)))

    def _spread(self, t: ArrayLike) -> FloatArray:
        """Return the standard deviation of the logarithm of the cumulative hazard."""
        steps = _GRADIENT_STEP * np.eye(self.n_parameters)
        with np.errstate(invalid="ignore"):
            changes = np.stack(
                [self._log_hazard(self.parameters + s, t) - self._log_hazard(self.parameters - s, t) for s in steps]
            )
        slopes = np.where(np.isfinite(changes), changes, 0.0) / (2.0 * _GRADIENT_STEP)
        return np.asarray(np.sqrt(np.einsum("i...,ij,j...->...", slopes, self.covariance, slopes)))


def log_likelihood(prior: LifetimePrior, data: CensoredLifetimes) -> FloatArray:
    """Return the log probability (N,) of each sample, in 1/s for exact ones; weights are not applied."""
    exact, ends = data.exact, np.isfinite(data.right_s)
    since = np.maximum(data.left_s, data.entry_s)
    result = np.asarray(prior.log_conditional_survival(np.where(exact, 0.0, data.entry_s), np.where(exact, 0.0, since)))
    bounded = ends & ~exact
    result[bounded] += prior.log_conditional_death(since[bounded], data.right_s[bounded])
    result[exact] += prior.log_density(data.right_s[exact]) - prior.log_survival(data.entry_s[exact])
    # -inf minus -inf where even the entry is impossible
    return np.where(np.isnan(result), -np.inf, result)


def fit(kind: str | Kind, data: CensoredLifetimes) -> ParametricFit:
    """Fit one family by maximum likelihood.

    Args:
        kind: one of `KINDS`, by name or itself.
        data: N samples; rows of weight 0 are ignored.

    Raises:
        ConfigError: an unknown family.
        DataError: no lifetime has an end.
        NumericalError: the likelihood has no clear maximum in this family.
    """
    data = _keep_counted(data)

    def of_samples(prior: LifetimePrior) -> float:
        return float(data.weight @ log_likelihood(prior, data))

    return fit_likelihood(kind, of_samples, _rough_mean(data), float(data.weight.sum()))


def fit_likelihood(
    kind: str | Kind, log_likelihood_of: Callable[[LifetimePrior], float], rough_mean_s: float, n_samples: float
) -> ParametricFit:
    """Fit one family by any likelihood.

    Args:
        kind: one of `KINDS`, by name or itself.
        log_likelihood_of: of all samples together under a prior; -inf or NaN where they are impossible.
        rough_mean_s: rough mean stay to start from, in seconds.
        n_samples: number of samples.

    Raises:
        ConfigError: an unknown family.
        NumericalError: the likelihood has no clear maximum in this family.
    """
    name, family = _name_family(kind)

    def cost(parameters: FloatArray) -> float:
        try:
            with np.errstate(all="ignore"):
                value = -log_likelihood_of(family.build(parameters)) / n_samples
        except (ConfigError, OverflowError):  # parameters out of range
            return _IMPOSSIBLE
        return min(_IMPOSSIBLE, value)  # also where it is NaN

    found, least = min((_search(cost, np.array(s)) for s in family.starts(rough_mean_s)), key=lambda r: r[1])
    hessian = _hessian(cost, found)
    if not (np.isfinite(found).all() and np.linalg.eigvalsh(hessian)[0] > 1e-7):
        raise NumericalError(
            f"the likelihood of these lifetimes has no clear maximum among '{name}' models",
            field="kind",
            hint="more data" if len(found) == 1 else "one with fewer parameters, as exponential, or more data",
        )
    covariance = np.asarray(np.linalg.inv(hessian)) / n_samples
    return ParametricFit(name, family, family.build(found), found, covariance, -least * n_samples, n_samples)


def fit_best(data: CensoredLifetimes, kinds: Sequence[str | Kind] = tuple(KINDS)) -> ParametricFit:
    """Fit several families, and return that of least AIC among those whose likelihood has a maximum.

    Raises:
        ConfigError: no family to choose from, or an unknown one.
        DataError: no lifetime has an end.
        NumericalError: none has a maximum.
    """
    if not kinds:
        raise ConfigError("no kind of lifetime to choose from", field="kinds", hint=", ".join(KINDS))
    fits, failures = [], []
    for kind in kinds:
        try:
            fits.append(fit(kind, data))
        except NumericalError as error:
            failures.append(error)
    if not fits:
        raise failures[0]
    return min(fits, key=lambda one: one.aic)


def _name_family(kind: str | Kind) -> tuple[str, Kind]:
    if isinstance(kind, Kind):
        return "/".join(kind.names), kind
    if kind not in KINDS:
        raise ConfigError(f"unknown kind of lifetime '{kind}'", field="kind", hint=", ".join(KINDS))
    return kind, KINDS[kind]


def _keep_counted(data: CensoredLifetimes) -> CensoredLifetimes:
    """Return the rows of positive weight."""
    rows = data.weight > 0.0
    if not np.isfinite(data.right_s[rows]).any():
        raise DataError(
            "no lifetime has an end, so longer stays always fit better",
            field="right_s",
            hint="look again later, or state a prior",
        )
    return data[rows]


def _rough_mean(data: CensoredLifetimes) -> float:
    """Return the time observed over the number of ends; an end in an interval counts at its middle."""
    ends = np.isfinite(data.right_s)
    since = np.maximum(data.left_s, data.entry_s)
    last = np.where(ends, 0.5 * (since + np.where(ends, data.right_s, 0.0)), since)
    return float(data.weight @ (last - data.entry_s) / data.weight[ends].sum())


def _search(cost: Callable[[FloatArray], float], start: FloatArray) -> tuple[FloatArray, float]:
    """Minimise the cost from one start; NaN where the minimum lies at a bound."""
    from scipy.optimize import minimize

    limits: Any = [(value - _FARTHEST, value + _FARTHEST) for value in start]
    options: Any = {"ftol": 1e-15, "gtol": 1e-9, "maxiter": 200}
    first: Any = start
    slope: Any = partial(_gradient, cost)
    result: Any = minimize(cost, first, jac=slope, method="L-BFGS-B", bounds=limits, options=options)
    found, least = np.asarray(result.x), float(result.fun)
    if least >= _IMPOSSIBLE or (np.abs(found - start) > _FARTHEST - 1e-3).any():
        return np.full(len(start), np.nan), least
    return found, least


def _gradient(cost: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    steps = _GRADIENT_STEP * np.eye(len(at))
    return np.array([(cost(at + step) - cost(at - step)) / (2.0 * _GRADIENT_STEP) for step in steps])


def _hessian(cost: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    steps = _HESSIAN_STEP * np.eye(len(at))
    rows = [[cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b) for b in steps] for a in steps]
    return np.array(rows) / (4.0 * _HESSIAN_STEP**2)
