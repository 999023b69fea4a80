"""A lifetime as a table: hazards that are constant over narrow bins of age, found without a logarithm.

Bins are those of floating point numbers: 64 equal ones to every doubling of age, so that the bin of an age is the
leading bits of its representation. Survival is exact at their edges; in between, a hazard that changes by half over a
doubling is off by less than a percent for less than a percent of the age.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.survival.base import LifetimePrior
from evermap.types import FloatArray, IntArray

SHIFT = 46
"""Mantissa bits that do not count: 52 less the 6 of 64 bins."""
PER_DOUBLING = 64
DOUBLINGS_BELOW = 3
"""The first bin is a step divided by eight or more."""
DOUBLINGS_ABOVE = 25
CERTAIN = 800.0
"""Integrated hazard of a bin that nobody leaves alive: e^-800 is 0."""


class HazardTable(NamedTuple):
    """Cumulative hazard of a lifetime, linear within bins of age.

    Attributes:
        offset: leading bits of the first edge above 0, less 1.
        edge_s: (B,) starts of the bins, the first 0.
        hazard_hz: (B,) hazard in each; the last holds for ever.
        cumulative: (B,) integral of the hazard up to each edge.
    """

    offset: int
    edge_s: FloatArray
    hazard_hz: FloatArray
    cumulative: FloatArray

    @property
    def width_s(self) -> FloatArray:
        """(B,) widths of the bins; the last counts as wide as the one before."""
        widths = np.diff(self.edge_s)
        return np.append(widths, widths[-1])

    def survival(self) -> FloatArray:
        """(B,) `S` at the edges."""
        return np.asarray(np.exp(-self.cumulative), dtype=np.float64)


def edges(step_s: float) -> tuple[int, FloatArray]:
    """Offset and edges of the bins that suit a filter of this time step."""
    lowest = 2.0 ** (np.floor(np.log2(step_s)) - DOUBLINGS_BELOW)
    above = lowest * (2.0 ** np.arange(DOUBLINGS_BELOW + DOUBLINGS_ABOVE))[:, None]
    grid = (above * (1.0 + np.arange(PER_DOUBLING) / PER_DOUBLING)).ravel()
    offset = int(np.float64(lowest).view(np.int64) >> SHIFT) - 1
    return offset, np.concatenate([[0.0], grid])


def tabulate(prior: LifetimePrior, step_s: float) -> HazardTable:
    """The table of a lifetime for a filter of this time step."""
    offset, edge = edges(step_s)
    widths = np.diff(edge)
    integrated = np.minimum(-prior.log_conditional_survival(edge[:-1], edge[1:]), CERTAIN)
    hazard = np.append(integrated / widths, 0.0)
    later = -float(prior.log_conditional_survival(edge[-1], 2.0 * edge[-1]))
    hazard[-1] = min(later, CERTAIN) / edge[-1]
    return HazardTable(offset, edge, hazard, np.concatenate([[0.0], np.cumsum(integrated)]))


def bins_of(age_s: FloatArray, offset: int, n: int) -> IntArray:
    """The bin of each age."""
    leading = np.asarray(age_s, dtype=np.float64).view(np.int64) >> SHIFT
    return np.asarray(np.clip(leading - offset, 0, n - 1), dtype=np.int64)
