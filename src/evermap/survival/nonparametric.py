"""Nonparametric estimates of lifetimes: of any censored ones (Turnbull 1976), and of right censored ones.

**Turnbull.** The maximum likelihood estimate, exact to its optimality conditions.

1. **Cells.** Mass can only be on the maximal intersections of the samples; one sort and one sweep find them.
2. **Rough steps.** Expectation maximisation and the iterative convex minorant alternate; a few steps, each linear in
   samples and cells, find which cells have mass.
3. **Newton steps** on those cells and, as in Wang's (2007) constrained Newton method, on the best of the others in
   every gap between them. In terms of the mass below each node a sample couples two numbers only, so the Hessian is the
   Laplacian of a graph with the samples for edges: solved directly while the support is small or the band narrow, else
   by conjugate gradients. These need few steps, because only exact samples make a support large, and those couple
   neighbours.

Left truncation divides every probability by that of having entered. By the masses the likelihood is then not concave;
by the cumulative hazards it is, as `log(exp(-x) - exp(-y))` is concave and terms of what lies above a node are linear,
so a point where the conditions hold is the maximum there too. There may be none: where few are at risk early and all of
them may be gone, the likelihood grows without bound as the mass beyond goes to 0.

**Kaplan and Meier (1958).** The product-limit estimate, with delayed entry. It equals the former where every end was
either observed or never seen, and its uncertainty has closed forms.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError, NumericalError
from evermap.show import ShownTable
from evermap.survival.base import SurvivalEstimate, check_open_share, check_times
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.hazards import StepLifetime
from evermap.survival.turnbull import Point, best_between, contract, from_samples, names, newton_step, rough_step
from evermap.types import FloatArray

ROUGH, ROUGH_STEPS = 0.02, 40
"""Newton's method takes over below this violation of the optimality conditions, or after this many steps."""
GOOD, GOOD_ENOUGH = 1e-11, 1e-8
"""Violation that is sought, and the largest that is accepted where rounding stops the search."""
STEPS = 300
SHARE = 0.02
"""Cells without mass join if their slope is at least this share of the violation."""
VANISHING, VANISHING_SLOWLY = 1e-12, 1e-4
"""Mass beyond the latest entry that is taken to vanish: at any step, and where no maximum was found."""
TRACE = 1e-10
"""Mass of a cell that is taken for 0 in the end."""


@dataclass(frozen=True, slots=True, eq=False)
class Npmle(SurvivalEstimate, ShownTable):
    """A nonparametric estimate: mass on s cells in order of time.

    Attributes:
        support_left, support_right: (s,) in seconds; `left < T <= right`, a point where equal, `right` possibly `inf`.
            The likelihood does not depend on how mass is spread within a cell.
        mass: (s,) positive, of sum 1.
        loglik: `sum w log P(left < T <= right | T > entry)`, exact samples with the mass of their point.
        kkt_violation: with `d_j` the derivative of `loglik` by the mass of cell j, less its own average weighted by
            the masses: the larger of `max d_j` over all cells and `max |d_j|` over the support, over the sum of the
            weights. At a maximum it is 0.
        iterations: steps of both kinds.
    """

    support_left: FloatArray
    support_right: FloatArray
    mass: FloatArray
    loglik: float
    kkt_violation: float
    iterations: int

    def survival(self, t: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bound of `P(T > t)`, which differ inside a cell, for times in seconds."""
        values = check_times(t)
        above = np.append(np.cumsum(self.mass[::-1])[::-1], 0.0)
        certain = np.searchsorted(self.support_right, values, side="right")
        possible = np.maximum(certain, np.searchsorted(self.support_left, values, side="left"))
        return np.minimum(above[possible], 1.0), np.minimum(above[certain], 1.0)

    def prior(self) -> StepLifetime:
        """Return it as a lifetime prior, mass spread evenly in every cell; that of an endless cell never leaves."""
        return StepLifetime(tuple(self.support_left), tuple(self.support_right), tuple(self.mass / self.mass.sum()))


def npmle(data: CensoredLifetimes) -> Npmle:
    """Estimate the distribution under which the samples are most probable.

    Raises:
        NumericalError: there is no maximum, which happens only with truncation, or it was not found.
    """
    start, end, terms = from_samples(data)
    last_entry = int(np.flatnonzero(terms.entered)[-1])
    point = best = Point(terms, np.full(start.size, 1.0 / start.size))
    steps, stale, fine = 0, 0, False
    while best.kkt_violation > GOOD and steps < STEPS and not (stale > 2 and best.kkt_violation < GOOD_ENOUGH):
        fine = fine or point.kkt_violation < ROUGH or steps >= ROUGH_STEPS
        if fine:
            least = SHARE * point.kkt_violation * terms.entered.sum()
            support = best_between(point.slope, least, point.mass > 0.0)
            mass = np.zeros(start.size)
            mass[support] = newton_step(Point(contract(terms, names(support)), point.mass[support])).mass
            point = Point(terms, mass)
        else:
            point = rough_step(point)
        steps += 1
        if not point.above[last_entry] > VANISHING:
            break
        best, stale = (point, 0) if point.kkt_violation < best.kkt_violation else (best, stale + 1)
    beyond = float(point.above[last_entry])
    if best.kkt_violation > GOOD_ENOUGH:
        if not beyond > VANISHING_SLOWLY:
            raise NumericalError(
                "the likelihood has no maximum: it grows as the mass beyond the latest entries "
                f"(up to {float(data.entry_s.max()):g} s) goes to 0, because all samples at risk before may be gone "
                "by then",
                field="entry_s",
                hint="leave out the few samples of the earliest entries, or estimate given survival of a later time",
            )
        problem = f"no maximum of the likelihood found in {steps} steps, {best.kkt_violation:.1g} from optimal"
        raise NumericalError(problem)
    # Where the conditions hold with equality and without mass, the last trace of mass vanishes slowly.
    tidy = np.where(best.mass > TRACE, best.mass, 0.0)
    tidied = Point(terms, tidy / tidy.sum())
    best = tidied if tidied.kkt_violation <= max(GOOD, best.kkt_violation) else best
    kept = best.mass > 0.0
    return Npmle(start[kept], end[kept], best.mass[kept], best.loglik, best.kkt_violation, steps)


@dataclass(frozen=True, slots=True, eq=False)
class KaplanMeier(SurvivalEstimate, ShownTable):
    """A survival function with D steps.

    Attributes:
        time_s: (D,) in seconds, increasing; empty where no end was observed.
        at_risk: (D,) weight of the samples known to be present just before, and entered by then.
        deaths: (D,) weight of the samples that ended.
        survives: (D,) `P(T > time)`.
        log_variance: (D,) Greenwood's variance of `log P(T > time)`; `inf` where none is left.
    """

    time_s: FloatArray
    at_risk: FloatArray
    deaths: FloatArray
    survives: FloatArray
    log_variance: FloatArray

    def survival(self, t: ArrayLike) -> FloatArray:
        """Return `P(T > t)` for times in seconds."""
        return np.asarray(self._at(t, self.survives, 1.0))[()]

    def variance(self, t: ArrayLike) -> FloatArray:
        """Return Greenwood's variance of `P(T > t)`; 0 before the first death and where none is left."""
        values = np.where(self.survives > 0.0, np.square(self.survives), 0.0)
        spread = np.where(values > 0.0, self.log_variance, 0.0)
        return np.asarray(self._at(t, values * spread, 0.0))[()]

    def band(self, t: ArrayLike, confidence: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Return pointwise lower and upper bounds of `P(T > t)`, on the scale of `log(-log S)`.

        Both are 1 before the first death, and both 0 where none is left: this scale has no width there.

        Raises:
            ConfigError: `confidence` is not in (0, 1).
        """
        check_open_share(confidence)
        some = (self.survives > 0.0) & (self.survives < 1.0)
        log_survival = np.log(np.where(some, self.survives, 0.5))
        half_width = NormalDist().inv_cdf(0.5 + 0.5 * confidence) * np.sqrt(np.where(some, self.log_variance, 0.0))
        bounds = (np.exp(log_survival * np.exp(sign * half_width / -log_survival)) for sign in (1.0, -1.0))
        lower, upper = (self._at(t, np.where(some, bound, self.survives), 1.0) for bound in bounds)
        return lower[()], upper[()]

    def prior(self) -> StepLifetime:
        """Return it as a lifetime prior; mass beyond the last death never leaves."""
        left = np.append(self.survives, 0.0)
        masses = -np.diff(np.concatenate(([1.0], left)))
        return StepLifetime.at_points((*self.time_s.tolist(), np.inf), masses.tolist())

    def _at(self, t: ArrayLike, values: FloatArray, first: float) -> FloatArray:
        rows = np.searchsorted(self.time_s, check_times(t), side="right")
        return np.asarray(np.concatenate(([first], values))[rows])


def kaplan_meier(data: CensoredLifetimes) -> KaplanMeier:
    """Compute the product-limit estimate; samples censored or entering at the time of a death count as after it.

    Raises:
        DataError: a lifetime is neither exact nor right censored; names the row (from 0).
    """
    exact, counted = data.exact, data.weight > 0.0
    bad = counted & ~exact & np.isfinite(data.right_s)
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(
            f"neither exact nor right censored: ({data.left_s[row]:g}, {data.right_s[row]:g}], row {row}",
            field="right_s",
            hint="the Turnbull estimate, which takes intervals",
        )
    # A right censored sample that entered after its last sighting was seen at the entry.
    seen_until = np.maximum(data.left_s, data.entry_s)
    died = exact & counted
    time_s, which = np.unique(data.right_s[died], return_inverse=True)
    deaths = np.bincount(which, data.weight[died], time_s.size).astype(np.float64)
    at_risk = _weight_at_least(seen_until, data.weight, time_s) - _weight_at_least(data.entry_s, data.weight, time_s)
    at_risk = np.asarray(np.maximum(at_risk, deaths))
    left = at_risk - deaths
    left = np.where(left > 1e-12 * at_risk, left, 0.0)  # where all end, what is left is rounding
    with np.errstate(divide="ignore"):
        log_variance = np.asarray(np.cumsum(deaths / (at_risk * left)), np.float64)
    return KaplanMeier(time_s, at_risk, deaths, np.asarray(np.cumprod(left / at_risk), np.float64), log_variance)


def _weight_at_least(values: FloatArray, weight: FloatArray, times: FloatArray) -> FloatArray:
    """Return, for each time, the weight of all values that are not smaller."""
    order = np.argsort(values)
    total = np.append(np.cumsum(weight[order][::-1])[::-1], 0.0)
    return np.asarray(total[np.searchsorted(values[order], times, side="left")])
