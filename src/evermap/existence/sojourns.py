"""Lifetimes of stays and absences from expected counts: the maximisation step of learning, one family a function.

What is given is a table of events and exposure by age (and time of the week), with fractional counts, as the
expectation step of EM leaves them. What is found is a lifetime, and a rhythm where one is wanted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import exp
from typing import NamedTuple

import numpy as np

from evermap.existence.elementary import kernel
from evermap.existence.lifetimes import CERTAIN
from evermap.existence.rhythm import HALF_AN_EVENT, Rhythm, SmoothRates, age_basis, constant, fit, week_basis
from evermap.show import Shown
from evermap.survival import Exponential, Gamma, LogNormal, Mixture, PiecewiseConstantHazard, Weibull
from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray

KNOTS_PER_DOUBLING = 2
MOST_KNOTS = 40
MOST_PEAKS = 5
IN_VAIN = 2
"""Peaks that do not pay for themselves, after which no more are tried."""
PEAK_SPREAD = 0.05
"""Spread of a peak to begin with. Then each peak's spread is its own and, as one more event, that of all peaks
together: a peak of one event would have none else."""
BACKGROUND_SPREAD = 1.0
"""Spread of the wide component that takes what is not a peak, as one event."""
SHARE_STRENGTH = 0.5
"""Events added to each component, so that none dies out."""
_MOST_LOG_SHAPE = 6.0
_ROUNDS = 200


@dataclass(frozen=True, slots=True)
class Sojourns(Shown):
    """Counts of one state.

    Attributes:
        edge_s: (A + 1,) edges of the bins.
        events: (A, W) how many ended.
        exposure_s: (A, W) time spent.
        open_ended: (A,) how many went on.
    """

    edge_s: FloatArray
    events: FloatArray
    exposure_s: FloatArray
    open_ended: FloatArray

    @property
    def age_s(self) -> FloatArray:
        """(A,) middle of each bin of age."""
        return np.asarray(0.5 * (self.edge_s[:-1] + self.edge_s[1:]), dtype=np.float64)

    @property
    def n_events(self) -> float:
        """Number of ended stays."""
        return float(self.events.sum())


@dataclass(frozen=True, slots=True)
class Fitted(Shown):
    """A lifetime that was fitted.

    Attributes:
        family: its kind.
        prior: the lifetime.
        rhythm: factor on its hazard, or None.
        freedom: how many parameters it took.
        rates: the smooth rates behind it, for the next fit to begin with.
    """

    family: str
    prior: LifetimePrior
    rhythm: Rhythm | None
    freedom: float
    rates: SmoothRates | None = None

    def log_likelihood(self, counts: Sojourns) -> float:
        """Return `sum events log h - exposure h` of the table of counts."""
        hazard = mean_hazards(self.prior.cumulative_hazard(counts.edge_s), counts.edge_s)[:, None]
        events, exposure_s = counts.events, counts.exposure_s
        if self.rhythm is not None:
            hazard = hazard * self.rhythm.factor[None, :]
        else:
            events, exposure_s = events.sum(1)[:, None], exposure_s.sum(1)[:, None]
        log_hazard = np.log(np.where(events > 0.0, np.maximum(hazard, 1e-300), 1.0))
        return float((events * log_hazard).sum() - (exposure_s * hazard).sum())

    def score(self, counts: Sojourns) -> float:
        """Return log likelihood less the price of the parameters (Schwarz 1978)."""
        return self.log_likelihood(counts) - 0.5 * self.freedom * float(np.log(max(counts.n_events, 2.0)))


def mean_hazards(cumulative: FloatArray, edge_s: FloatArray) -> FloatArray:
    """Return (A,) mean hazard in each bin of age, of the cumulative hazard (A + 1,) at the edges."""
    with np.errstate(invalid="ignore"):
        within = np.where(np.isfinite(cumulative[1:]), np.minimum(np.diff(cumulative), CERTAIN), CERTAIN)
    return np.asarray(within / np.diff(edge_s), dtype=np.float64)


def exponential(counts: Sojourns, start: Fitted | None = None, *, rhythm: bool = False) -> Fitted:
    """Return a hazard that does not depend on age."""
    total = counts.exposure_s.sum()
    if rhythm:
        events, exposure = counts.events.sum(0)[None, :], counts.exposure_s.sum(0)[None, :]
        rates = fit(events, exposure, constant(1), week_basis(), start.rates if start else None)
        return Fitted(
            "exponential", Exponential(float(np.exp(rates.log_age[0]))), Rhythm(rates.log_week), rates.freedom
        )
    rate = (counts.n_events + HALF_AN_EVENT) / total if total > 0.0 else 0.0
    return Fitted("exponential", Exponential(float(rate)), None, 1.0)


def smooth(counts: Sojourns, start: Fitted | None = None, *, rhythm: bool = False) -> Fitted:
    """Return a smooth function of log age as log hazard, constant beyond the ages that were seen."""
    seen = np.flatnonzero(counts.exposure_s.sum(1) > 0.0)
    if not seen.size:
        return exponential(counts, rhythm=rhythm)
    earlier = start.rates if start else None
    rows = slice(int(seen[0]), int(seen[-1]) + 1)
    log_age = np.log(counts.age_s[rows])
    knots = int(np.clip(KNOTS_PER_DOUBLING * (log_age[-1] - log_age[0]) / np.log(2.0), 4, MOST_KNOTS))
    basis = age_basis(log_age, knots)
    if rhythm:
        rates = fit(counts.events[rows], counts.exposure_s[rows], basis, week_basis(), earlier)
    else:
        rates = fit(counts.events[rows].sum(1)[:, None], counts.exposure_s[rows].sum(1)[:, None], basis, None, earlier)
    edge = counts.edge_s[:-1][rows].copy()
    edge[0] = 0.0
    prior = PiecewiseConstantHazard(tuple(edge), tuple(np.exp(rates.log_age)))
    return Fitted("smooth", prior, Rhythm(rates.log_week) if rhythm else None, rates.freedom, rates)


def peaks(counts: Sojourns, _: Fitted | None = None) -> Fitted:
    """Return some typical durations, each with a small spread, on a wide background; as many as pay for themselves."""
    best, paid = _mixture(counts, 0), 0
    for n in range(1, MOST_PEAKS + 1):
        fitted = _mixture(counts, n)
        if fitted.score(counts) > best.score(counts):
            best, paid = fitted, n
        elif n >= paid + IN_VAIN:
            break
    return best


def _two_parameters(
    family: str,
    build: Callable[[float, float], LifetimePrior],
    cumulative: Callable[[float, float, FloatArray], FloatArray],
    counts: Sojourns,
    _: Fitted | None = None,
) -> Fitted:
    """Fit a family with two parameters: the logarithms of a typical duration and of a shape.

    Args:
        family: its name.
        build: makes the lifetime of the two.
        cumulative: makes its cumulative hazard at some ages, quicker than the lifetime's own.
        counts: data of the fit.
    """
    from scipy.optimize import minimize

    events, exposure = counts.events.sum(1), counts.exposure_s.sum(1)
    used = np.flatnonzero(exposure > 0.0)
    if counts.n_events < 2.0 or not used.size:
        return exponential(counts)
    edge = counts.edge_s[: used[-1] + 2]
    events, exposure = events[: used[-1] + 1], exposure[: used[-1] + 1]

    def bounded(parameters: FloatArray) -> tuple[float, float]:
        return float(parameters[0]), float(np.clip(parameters[1], -_MOST_LOG_SHAPE, _MOST_LOG_SHAPE))

    def loss(parameters: FloatArray) -> float:
        a, b = bounded(parameters)
        hazard = np.maximum(mean_hazards(cumulative(a, b, edge), edge), 1e-300)
        likelihood = (events * np.log(hazard)).sum() - (exposure * hazard).sum()
        return float(0.01 * parameters[1] ** 2 - likelihood)  # a weak pull to shape 1

    log_mean = float(np.log(exposure.sum() / counts.n_events))
    # from a triangle of some size: scipy's own, a hair's breadth around shape 1, is taken for an optimum
    triangle = np.array([[log_mean, 0.0], [log_mean + 0.5, 0.0], [log_mean, 0.5]])
    found = minimize(
        loss, triangle[0], method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3, "initial_simplex": triangle}
    )
    return Fitted(family, build(*bounded(found.x)), None, 2.0)


def _gamma_hazard(a: float, b: float, edge_s: FloatArray) -> FloatArray:
    """Cumulative hazard as of `Gamma`, but for its far tails, at a fortieth of the time."""
    from scipy.special import gammaincc

    with np.errstate(divide="ignore"):
        return np.asarray(-np.log(gammaincc(exp(b), edge_s / exp(a - b))), dtype=np.float64)


def _lognormal_hazard(a: float, b: float, edge_s: FloatArray) -> FloatArray:
    """Cumulative hazard as of `LogNormal`, at a fifth of the time."""
    from scipy.special import log_ndtr

    with np.errstate(divide="ignore"):
        return np.asarray(-log_ndtr((a - np.log(edge_s)) / exp(b)), dtype=np.float64)


def _weibull_hazard(a: float, b: float, edge_s: FloatArray) -> FloatArray:
    """Cumulative hazard as of `Weibull`, at a third of the time."""
    with np.errstate(over="ignore"):
        return np.asarray((edge_s / exp(a)) ** exp(b), dtype=np.float64)


class Peaks(NamedTuple):
    """Log-normal components, the wide one first.

    Attributes:
        mean, spread: (n + 1,) mean and standard deviation of the log duration.
        share: (n + 1,) of sum 1.
        typical: (n + 1,) variance that one more event of each would have.
    """

    mean: FloatArray
    spread: FloatArray
    share: FloatArray
    typical: FloatArray


@kernel
def _climb_mixture(x: FloatArray, width: FloatArray, ended: FloatArray, going: FloatArray, peaks: Peaks) -> None:
    """Fit `peaks` in place by EM to log durations (B,) in bins of some width, that ended or went on so often."""
    mean, spread, share, typical = peaks
    n, root_half = len(mean), math.sqrt(0.5)
    density, beyond, ratio, second = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for _ in range(_ROUNDS):
        weight, total, moment, bent = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
        # events of each bin and component by their moments about the old mean; these are exact about the new one, too
        for i in range(len(x)):
            all_density = all_beyond = 0.0
            for c in range(n):
                z = (x[i] - mean[c]) / spread[c]
                height = math.exp(-0.5 * z * z)
                density[c] = share[c] * height / spread[c]
                all_density += density[c]
                if going[i] == 0.0:
                    continue
                survival = 0.5 * math.erfc(z * root_half)
                beyond[c] = share[c] * survival
                all_beyond += beyond[c]
                # moments of a normal variable known to lie beyond x
                ratio[c] = height / math.sqrt(2.0 * math.pi) / max(survival, 1e-300)
                second[c] = spread[c] ** 2 * (1.0 + z * ratio[c]) - (spread[c] * ratio[c]) ** 2
            for c in range(n):
                mine = ended[i] * density[c] / max(all_density, 1e-300)
                open_mine = going[i] * beyond[c] / max(all_beyond, 1e-300)
                at, expected = x[i] - mean[c], spread[c] * ratio[c]
                weight[c] += mine + open_mine
                moment[c] += mine * at + open_mine * expected
                bent[c] += mine * (at * at + width[i] ** 2 / 12.0)
                bent[c] += open_mine * (max(second[c], 0.0) + expected * expected)
        for c in range(n):
            total[c] = max(weight[c], 1e-9)
        step = np.where(weight > 1e-6, moment / total, 0.0)
        squares = bent - 2.0 * step * moment + step * step * weight
        if n > 1:
            typical[1:] = squares[1:].sum() / max(weight[1:].sum(), 1e-9)
        new_share = (weight + SHARE_STRENGTH) / (weight + SHARE_STRENGTH).sum()
        change = np.abs(step).max() + np.abs(new_share - share).max()
        mean += step
        spread[:] = np.sqrt((squares + typical) / (weight + 1.0))
        share[:] = new_share
        if change < 1e-6:
            break


def _mixture(counts: Sojourns, n: int) -> Fitted:
    """A wide log-normal and `n` narrow ones, by EM on binned durations, those that went on counted by survival."""
    events = counts.events.sum(1)
    used = np.flatnonzero((events > 1e-6) | (counts.open_ended > 1e-6))
    if counts.n_events < 2.0:
        return exponential(counts)
    x = np.log(counts.age_s[used])
    width = np.log(np.diff(counts.edge_s)[used] / counts.age_s[used] + 1.0)
    ended, going = events[used], counts.open_ended[used]
    typical = np.full(n + 1, PEAK_SPREAD**2)
    typical[0] = BACKGROUND_SPREAD**2
    centre = float((ended * x).sum() / ended.sum())
    mean = np.concatenate([[centre], _highest(x, ended, n)])
    spread, share = np.sqrt(typical), np.full(n + 1, 1.0 / (n + 1))
    _climb_mixture(x, width, ended, going, Peaks(mean, spread, share, typical))
    parts = [LogNormal(float(m), float(s)) for m, s in zip(mean, spread, strict=True)]
    prior = Mixture.of(parts, [float(s) for s in share]) if n else parts[0]
    return Fitted("peaks", prior, None, 3.0 * n + 2.0)


def _highest(x: FloatArray, ended: FloatArray, n: int) -> FloatArray:
    """Return initial peaks: the maxima of the events, one after another, each removing the events that it explains."""
    left, found = ended.copy(), np.empty(n)
    for i in range(n):
        near = np.exp(-0.5 * ((x[:, None] - x[None, :]) / (2.0 * PEAK_SPREAD)) ** 2)
        found[i] = x[int(np.argmax(near @ left))]
        left = left * (1.0 - np.exp(-0.5 * ((x - found[i]) / (3.0 * PEAK_SPREAD)) ** 2))
    return found


Family = Callable[[Sojourns, Fitted | None], Fitted]
"""Counts, and an earlier fit to begin with, to a lifetime."""
FAMILIES: dict[str, Family] = {
    "exponential": exponential,
    "weibull": partial(_two_parameters, "weibull", lambda a, b: Weibull(exp(a), exp(b)), _weibull_hazard),
    "gamma": partial(_two_parameters, "gamma", lambda a, b: Gamma(exp(a - b), exp(b)), _gamma_hazard),
    "lognormal": partial(_two_parameters, "lognormal", lambda a, b: LogNormal(a, exp(b)), _lognormal_hazard),
    "peaks": peaks,
    "smooth": smooth,
}
"""Families without a rhythm, by name."""
WITH_RHYTHM: dict[str, Family] = {
    "exponential": partial(exponential, rhythm=True),
    "smooth": partial(smooth, rhythm=True),
}
"""Families with a rhythm of the week."""
