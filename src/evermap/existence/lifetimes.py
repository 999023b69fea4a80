"""Lifetimes of stays and absences of a presence model, as distributions of `survival`.

A living map, a forecast or a report needs only these two of a model. Every `PresenceModel` has `lifetimes`;
`models.lifetimes_of` reads them from the text of a prior or from a file of models.

For a filter a lifetime is the log-odds of dying within a gap (`log_death_odds`), a mixture of exponentials
(`exponential_mixture_of`), or a table of hazards that are constant over narrow bins of age (`HazardTable`). Its bins
are those of floating point numbers: 64 equal ones to every doubling of age, so that the bin of an age is the leading
bits of its representation. Survival is exact at their edges; in between, a hazard that changes by half over a doubling
is off by less than a percent for less than a percent of the age.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Mixture, PiecewiseConstantHazard, never_leaves
from evermap.survival.logmath import gauss_legendre
from evermap.types import BoolArray, FloatArray, IntArray

NODES = 12
"""Rates that stand for an unknown one."""
AGES_PER_DOUBLING = 16
DOUBLINGS = 24
"""Of age, in a table of phases: from a thousandth of the fastest change to some thousands of the slowest phase."""
WIDE = 1.01
"""Ratio of highest to lowest rate above which the kernel of the unknown-rate prior keeps ten digits."""
CERTAIN = 800.0
"""Integrated hazard that nothing survives: e^-800 is 0."""


class Lifetimes(NamedTuple):
    """Lifetimes of the stays and absences of a class.

    Attributes:
        stay: lifetime of a stay, from arrival on.
        absence: lifetime of an absence, from departure on; its `p_never_leaves` is the share that never returns.
    """

    stay: LifetimePrior
    absence: LifetimePrior

    def p_leave(self, age_s: ArrayLike, gap_s: ArrayLike) -> FloatArray:
        """Return the probability that a feature which has stayed for `age_s` leaves within the next `gap_s`."""
        return _ends(self.stay, age_s, gap_s)

    def p_return(self, age_s: ArrayLike, gap_s: ArrayLike) -> FloatArray:
        """Return the probability that a feature which has been away for `age_s` returns within the next `gap_s`."""
        return _ends(self.absence, age_s, gap_s)


def _ends(prior: LifetimePrior, age_s: ArrayLike, gap_s: ArrayLike) -> FloatArray:
    age, gap = np.asarray(age_s, dtype=np.float64), np.asarray(gap_s, dtype=np.float64)
    return np.asarray(np.exp(prior.log_conditional_death(age, age + gap)), dtype=np.float64)


def proportional(prior: LifetimePrior, factor: float, edges_s: FloatArray) -> LifetimePrior:
    """Return the lifetime whose hazard is `factor` times that of `prior`.

    Args:
        prior: a lifetime.
        factor: positive.
        edges_s: (B,) ages from 0 on between which other hazards than constant ones are replaced by their means.
    """
    if factor == 1.0:
        return prior
    if isinstance(prior, Exponential):
        return Exponential(prior.rate * factor)
    if isinstance(prior, PiecewiseConstantHazard):
        return PiecewiseConstantHazard(prior.edges_s, tuple(rate * factor for rate in prior.rates))
    ends = np.append(edges_s, 2.0 * edges_s[-1])
    integrated = np.minimum(-prior.log_conditional_survival(ends[:-1], ends[1:]), CERTAIN)
    return PiecewiseConstantHazard(tuple(edges_s), tuple(factor * integrated / np.diff(ends)))


def lifetime_of_phases(rates_hz: FloatArray, inside: BoolArray, entered: FloatArray) -> LifetimePrior:
    """Return the time that a Markov chain spends in some phases before it leaves them (Neuts 1981, phase type).

    A mixture of exponentials where no change leads from one of these phases to another of them. Otherwise the hazard is
    constant over narrow bins of age; survival is exact at their edges.

    Args:
        rates_hz: (n, n) rates of changes, the diagonal zero.
        inside: (n,) phases to be left.
        entered: (n,) probability of each at the beginning; sums to 1 over those inside.
    """
    first = np.asarray(entered[inside], dtype=np.float64)
    exits = rates_hz[inside].sum(1)
    within = rates_hz[np.ix_(inside, inside)]
    if not within.any():
        parts = [(never_leaves() if rate == 0.0 else Exponential(float(rate))) for rate in exits[first > 0.0]]
        return parts[0] if len(parts) == 1 else Mixture.of(parts, [float(p) for p in first[first > 0.0]])
    from scipy.linalg import expm

    fastest = float(exits.max())
    edges = 1e-3 / fastest * 2.0 ** (np.arange(AGES_PER_DOUBLING * DOUBLINGS) / AGES_PER_DOUBLING)
    edge = np.append(0.0, edges)
    spans = np.append(np.diff(edge), edge[-1])
    steps = expm((within - np.diag(exits)) * spans[:, None, None])
    hazards, row = np.empty(len(edge)), first / first.sum()
    for k, step in enumerate(steps):
        row = row @ step
        left = float(row.sum())
        hazards[k] = min(-math.log(left) if left > 0.0 else CERTAIN, CERTAIN) / spans[k]
        row = row / left if left > 0.0 else row
    return PiecewiseConstantHazard(tuple(edge), tuple(np.maximum(hazards, 0.0)))


def exponential_mixture_of(prior: LifetimePrior, n: int = NODES) -> tuple[FloatArray, FloatArray]:
    """Return a lifetime prior as a mixture of K exponentials, which is what a Markov chain can hold.

    Exact for exponentials and mixtures of them; the general-purpose prior (unknown rate, Rosen 2016 eqs. 25-29) by
    Gauss-Legendre quadrature with `n` nodes over the logarithm of the rate.

    Returns:
        (K,) rates in 1/s and (K,) probabilities.

    Raises:
        ConfigError: any other prior.
    """
    if isinstance(prior, Exponential):
        return np.array([prior.rate]), np.ones(1)
    if isinstance(prior, GeneralPurpose):
        nodes, weights = gauss_legendre(n)
        return prior.low * np.exp(math.log(prior.high / prior.low) * nodes), weights
    if isinstance(prior, Mixture):
        parts = [exponential_mixture_of(component, n) for component in prior.components]
        shares = [weight * own for weight, (_, own) in zip(prior.weights, parts, strict=True)]
        return np.concatenate([rates for rates, _ in parts]), np.concatenate(shares)
    raise ConfigError(
        f"{type(prior).__name__} is not a mixture of exponentials",
        field="prior",
        hint="Exponential, GeneralPurpose, a Mixture of them, or the run-length filter",
    )


def log_death_odds(
    priors: tuple[LifetimePrior, ...], prior_of_row: IntArray, start_s: FloatArray, stop_s: FloatArray
) -> FloatArray:
    """Return the log-odds of dying within a gap, `log(1 - q) - log q`, one prior call for each prior in use.

    Args:
        priors: lifetime priors.
        prior_of_row: (M,) index into them.
        start_s: (M,) begin of each gap, since birth.
        stop_s: (M,) its end.

    Returns:
        (M,) -inf for no chance to die, +inf for certain death, also where the feature had certainly died before.
    """
    odds = np.empty(len(start_s))
    for index, prior in enumerate(priors):
        rows: Any = slice(None) if len(priors) == 1 else np.flatnonzero(prior_of_row == index)
        with np.errstate(all="ignore"):
            start, stop = start_s[rows], stop_s[rows]
            if isinstance(prior, GeneralPurpose) and prior.high > WIDE * prior.low:
                from evermap.existence.kernels import general_purpose_gaps  # the general road takes 10 us a gap

                gap_odds = np.empty(len(start))
                general_purpose_gaps(
                    prior.low, prior.high, np.ascontiguousarray(start), np.ascontiguousarray(stop), gap_odds
                )
                odds[rows] = np.log(gap_odds)
                continue
            if isinstance(prior, PiecewiseConstantHazard):  # learned by maps, and thus evaluated for millions of gaps
                odds[rows] = np.log(np.expm1(prior.integrated_hazard(start, stop)))
                continue
            survival = np.asarray(prior.log_conditional_survival(start, stop), dtype=np.float64)
            death = np.asarray(prior.log_conditional_death(start, stop), dtype=np.float64)
            # After certain death the conditional is 0 / 0: nothing outlives it, whatever a prior answers.
            lost = np.isneginf(survival) | np.isnan(survival)
            odds[rows] = np.where(lost, np.inf, death - survival)
    return odds


SHIFT = 46
"""Mantissa bits that do not count: 52 less the 6 of 64 bins."""
PER_DOUBLING = 64
DOUBLINGS_BELOW = 3
"""The first bin is a step divided by eight or more."""
DOUBLINGS_ABOVE = 25


class HazardTable(NamedTuple):
    """Cumulative hazard of a lifetime, linear within bins of age.

    Attributes:
        offset: leading bits of the first edge above 0, less 1.
        edge_s: (B,) starts of the bins, the first 0.
        hazard_hz: (B,) hazard in each; the last one is unbounded.
        cumulative: (B,) integral of the hazard up to each edge.
    """

    offset: int
    edge_s: FloatArray
    hazard_hz: FloatArray
    cumulative: FloatArray

    def survival(self) -> FloatArray:
        """Return (B,) `S` at the edges."""
        return np.asarray(np.exp(-self.cumulative), dtype=np.float64)


def edges(step_s: float) -> tuple[int, FloatArray]:
    """Return the offset and edges of the bins that suit a filter of this time step."""
    lowest = 2.0 ** (np.floor(np.log2(step_s)) - DOUBLINGS_BELOW)
    above = lowest * (2.0 ** np.arange(DOUBLINGS_BELOW + DOUBLINGS_ABOVE))[:, None]
    grid = (above * (1.0 + np.arange(PER_DOUBLING) / PER_DOUBLING)).ravel()
    offset = int(np.float64(lowest).view(np.int64) >> SHIFT) - 1
    return offset, np.concatenate([[0.0], grid])


def tabulate(prior: LifetimePrior, step_s: float) -> HazardTable:
    """Return the table of a lifetime for a filter of this time step."""
    offset, edge = edges(step_s)
    widths = np.diff(edge)
    integrated = np.minimum(-prior.log_conditional_survival(edge[:-1], edge[1:]), CERTAIN)
    hazard = np.append(integrated / widths, 0.0)
    later = -float(prior.log_conditional_survival(edge[-1], 2.0 * edge[-1]))
    hazard[-1] = min(later, CERTAIN) / edge[-1]
    return HazardTable(offset, edge, hazard, np.concatenate([[0.0], np.cumsum(integrated)]))


def bins_of(age_s: FloatArray, offset: int, n: int) -> IntArray:
    """Return the bin of each age."""
    leading = np.asarray(age_s, dtype=np.float64).view(np.int64) >> SHIFT
    return np.asarray(np.clip(leading - offset, 0, n - 1), dtype=np.int64)
