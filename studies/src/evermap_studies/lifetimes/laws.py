"""Bands and forecasts of learned lifetimes under six laws, with and without truncation, against who knows the law.

Objects arrive at any hour and are looked at again and again, at gaps that vary; ends lie between two looks, and some
outlast the watch. Where samples are truncated, objects are met at an age that is known, and who left before is missing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap.errors import NumericalError
from evermap.maps.lives import general_purpose
from evermap.survival import Exponential, LifetimePrior, LogNormal, Mixture, Weibull
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.gaussian_process import gp_fit
from evermap.survival.parametric_fit import fit
from evermap.survival.pooled_hazards import learn_hazards
from evermap.survival.stay_likelihood import StayAges
from evermap.types import FloatArray

HOUR_S, DAY_S = 3600.0, 86_400.0
SHARES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
"""Of true lifetimes that are over at the ages at which bands are judged."""
GAP, WATCH = 0.1, 4.0
"""Mean gap between looks, in median lifetimes; and the time after which nobody looks any more."""
STARTS = 480
"""Instants of arrival over which the law of what leaves at night is averaged."""


@dataclass(frozen=True, slots=True)
class Pareto:
    """`S(t) = (1 + t / scale) ** -power`: of a mean that is infinite where the power is at most 1."""

    scale_s: float
    power: float

    def sample(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw (n,) lifetimes."""
        return np.asarray(self.scale_s * (rng.random(n) ** (-1.0 / self.power) - 1.0))

    def log_survival(self, t: FloatArray) -> FloatArray:
        """Return `log S`."""
        return np.asarray(-self.power * np.log1p(t / self.scale_s))

    def quantile(self, p: FloatArray) -> FloatArray:
        """Return the times by which shares are gone."""
        return np.asarray(self.scale_s * ((1.0 - p) ** (-1.0 / self.power) - 1.0))


@dataclass(frozen=True, slots=True)
class Nights:
    """What leaves between 20 h and 6 h only, a third of it each night, and arrives at any hour."""

    def sample(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw (n,) lifetimes."""
        night = rng.exponential(-10.0 * HOUR_S / np.log1p(-1.0 / 3.0), n)  # time at risk
        start = rng.uniform(0.0, 24.0, n) * HOUR_S
        first = np.maximum(10.0 * HOUR_S - start, 0.0)  # what is left of the first night
        later = np.maximum(night - first, 0.0)
        whole = 24.0 * HOUR_S - start + later // (10.0 * HOUR_S) * DAY_S + later % (10.0 * HOUR_S)
        return np.asarray(np.where(night < first, night, whole))

    def log_survival(self, t: FloatArray) -> FloatArray:
        """Return `log S`, averaged over the hours of arrival."""
        at = np.asarray(t, dtype=np.float64)
        start = (np.arange(STARTS) + 0.5) / STARTS * DAY_S
        until = start + at[..., None]
        passed = until // DAY_S * 10.0 * HOUR_S + np.minimum(until % DAY_S, 10.0 * HOUR_S)
        risk = passed - np.minimum(start, 10.0 * HOUR_S)
        return np.asarray(np.log(np.exp(np.log1p(-1.0 / 3.0) / (10.0 * HOUR_S) * risk).mean(axis=-1)))

    def quantile(self, p: FloatArray) -> FloatArray:
        """Return the times by which shares are gone."""
        times = np.linspace(0.0, 60.0, 60 * 96 + 1) * DAY_S
        return np.asarray(np.interp(p, 1.0 - np.exp(self.log_survival(times)), times))


LAWS: dict[str, Callable[[], Any]] = {
    "two kinds": lambda: Mixture.of(
        (Exponential.from_mean(2.0 * HOUR_S), Exponential.from_mean(30.0 * DAY_S)), (0.5, 0.5)
    ),
    "shift": lambda: LogNormal.from_half_life(8.0 * HOUR_S, 0.1),
    "night only": Nights,
    "Weibull": lambda: Weibull(3.0 * DAY_S, 1.6),
    "log-normal": lambda: LogNormal.from_half_life(2.0 * DAY_S, 1.0),
    "heavy tail": lambda: Pareto(6.0 * HOUR_S, 0.8),
}


def samples(law: Any, n: int, rng: np.random.Generator, truncated: bool) -> CensoredLifetimes:
    """Draw n lifetimes as they are known from looks."""
    median = float(law.quantile(np.array(0.5)))
    lifetime, entry = np.zeros(0), np.zeros(0)
    while len(lifetime) < n:
        drawn = np.asarray(law.sample(rng, 4 * n))
        at = rng.uniform(0.0, median, 4 * n) if truncated else np.zeros(4 * n)
        lifetime, entry = np.append(lifetime, drawn[drawn > at]), np.append(entry, at[drawn > at])
    lifetime, entry = lifetime[:n], entry[:n]
    gap = GAP * median * rng.gamma(2.0, 0.5, n)
    left = entry + np.floor((lifetime - entry) / gap) * gap
    until = entry + WATCH * median * rng.uniform(0.5, 1.5, n)
    ended = left + gap < until
    return CensoredLifetimes.of(
        np.where(ended, left, np.minimum(left, until)), np.where(ended, left + gap, np.inf), entry
    )


Curve = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]


def pooled(data: CensoredLifetimes) -> tuple[Curve, LifetimePrior]:
    """The model of maps."""
    found = learn_hazards(StayAges.of_samples(data), [None], general_purpose())[0]
    return found.survival, found.prior()


def process(data: CensoredLifetimes) -> tuple[Curve, LifetimePrior]:
    """A Gaussian process about a Weibull model."""
    found = gp_fit(data).at()
    return found.survival, found.prior()


def weibull(data: CensoredLifetimes) -> tuple[Curve, LifetimePrior]:
    """Maximum likelihood of a Weibull model: what a family of one hump makes of the others."""
    found = fit("weibull", data)
    return (lambda t: (np.exp(found.prior.log_survival(t)), *found.band(t))), found.prior


ESTIMATORS = {"pooled hazards": pooled, "Gaussian process": process, "Weibull model": weibull}


def excess(law: Any, prior: LifetimePrior) -> float:
    """Return the mean loss in nats of forecasts of the next look, beyond that of who knows the law.

    What is there at a look is of any age by which up to nine in ten are gone; the next look is a quarter of a median
    lifetime away.
    """
    shares = (np.arange(50) + 0.5) / 50 * 0.9
    age, gap = law.quantile(shares), 0.25 * float(law.quantile(np.array(0.5)))
    true = np.exp(np.asarray(law.log_survival(age + gap)) - np.asarray(law.log_survival(age)))
    told = np.clip(np.exp(prior.log_conditional_survival(age, age + gap)), 1e-9, 1.0 - 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        loss = np.where(true > 0.0, true * np.log(true / told), 0.0)
        loss += np.where(true < 1.0, (1.0 - true) * np.log((1.0 - true) / (1.0 - told)), 0.0)
    return float(loss.mean())


def judge(
    counts: tuple[int, ...], repetitions: int, seed: int, names: tuple[str, ...] = tuple(ESTIMATORS)
) -> list[dict[str, Any]]:
    """Return coverage of the 95 % bands, bias and excess loss of each estimator under each law."""
    rows = []
    shares = np.array(SHARES)
    for number, (law_name, make) in enumerate(LAWS.items()):
        law = make()
        ages = np.asarray(law.quantile(shares))
        for truncated in (False, True):
            for n in counts:
                seen: dict[str, list[Any]] = {name: [] for name in names}
                for run in range(repetitions):
                    rng = np.random.default_rng([seed, number, truncated, n, run])
                    data = samples(law, n, rng, truncated)
                    for name in names:
                        try:
                            curve, prior = ESTIMATORS[name](data)
                        except NumericalError:
                            continue
                        mean, lower, upper = curve(ages)
                        inside = (lower <= 1.0 - shares) & (1.0 - shares <= upper)
                        seen[name].append((inside, mean - (1.0 - shares), upper - lower, excess(law, prior)))
                for name, values in seen.items():
                    if not values:
                        continue
                    inside, bias, width, loss = (np.array(column) for column in zip(*values, strict=True))
                    rows.append(
                        {
                            "law": law_name, "truncated": truncated, "n": n, "estimator": name,
                            "failed": repetitions - len(values),
                            "coverage": inside.mean(axis=0).tolist(), "bias": bias.mean(axis=0).tolist(),
                            "width": width.mean(axis=0).tolist(), "excess": float(loss.mean()),
                        }
                    )  # fmt: skip
    return rows
