"""Nonparametric maximum likelihood of censored lifetimes (Turnbull 1976), exact to its optimality conditions.

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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import NumericalError
from evermap.show import ShownTable
from evermap.survival.base import SurvivalEstimate, check_times
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.step import StepLifetime
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
    from evermap.survival.turnbull_kernels import best_between
    from evermap.survival.turnbull_steps import Point, contract, from_samples, names, newton_step, rough_step

    start, end, terms = from_samples(data)
    last_entry = int(np.flatnonzero(terms.entered)[-1])
    point = best = Point(terms, np.full(start.size, 1.0 / start.size))
    steps, stale, fine = 0, 0, False
    while best.kkt_violation > GOOD and steps < STEPS and not (stale > 2 and best.kkt_violation < GOOD_ENOUGH):
        fine = fine or point.kkt_violation < ROUGH or steps >= ROUGH_STEPS
        if fine:
            support = point.mass > 0.0
            best_between(point.slope, SHARE * point.kkt_violation * terms.entered.sum(), support)
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
        raise (
            _no_maximum(data)
            if not beyond > VANISHING_SLOWLY
            else NumericalError(
                f"no maximum of the likelihood found in {steps} steps, {best.kkt_violation:.1g} from optimal"
            )
        )
    # Where the conditions hold with equality and without mass, the last trace of mass vanishes slowly.
    tidy = np.where(best.mass > TRACE, best.mass, 0.0)
    tidied = Point(terms, tidy / tidy.sum())
    best = tidied if tidied.kkt_violation <= max(GOOD, best.kkt_violation) else best
    kept = best.mass > 0.0
    return Npmle(start[kept], end[kept], best.mass[kept], best.loglik, best.kkt_violation, steps)


def _no_maximum(data: CensoredLifetimes) -> NumericalError:
    return NumericalError(
        "the likelihood has no maximum: it grows as the mass beyond the latest entries "
        f"(up to {float(data.entry_s.max()):g} s) goes to 0, because all samples at risk before may be gone by then",
        field="entry_s",
        hint="leave out the few samples of the earliest entries, or estimate given survival of a later time",
    )
