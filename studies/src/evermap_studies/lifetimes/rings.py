"""Lifetimes of a place as Bateman (2020, section 4.2) has them: a query that joins rings of chunks until it is certain.

The thesis leaves the estimator open. Greenwood's variance needs ends that were watched, and the nonparametric estimate
of intervals has none in closed form; a parametric model has one for every kind of censoring, so that is used here. Its
variance is taken at its median, where a share is least certain. `pooling` is compared with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError, NumericalError
from evermap.survival.base import check_positive
from evermap.survival.censored import CensoredLifetimes
from evermap.survival.parametric_fit import ParametricFit, fit
from evermap.types import IntArray
from evermap_studies.lifetimes.pooling import Chunk, chunks_of


@dataclass(frozen=True, slots=True, eq=False)
class ChunkIndex:
    """Rows of N things by the square chunk of the ground that they lie in.

    Attributes:
        size_m: side of a chunk.
        rows: for each chunk that is not empty, the rows of what it holds.
    """

    size_m: float
    rows: Mapping[Chunk, IntArray]

    @classmethod
    def of(cls, place_m: ArrayLike, size_m: float) -> ChunkIndex:
        """Index (N, 2) places in metres.

        Raises:
            ConfigError: a size that is not positive.
            DataError: a place that is not finite.
        """
        chunks = chunks_of(place_m, size_m)
        unique, which = np.unique(chunks, axis=0, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        ends = np.cumsum(np.bincount(which.ravel(), minlength=len(unique)))
        parts = np.split(order.astype(np.int64), ends[:-1])
        return cls(size_m, {(int(x), int(y)): part for (x, y), part in zip(unique, parts, strict=True)})

    def chunk(self, place_m: ArrayLike) -> Chunk:
        """Return the chunk of one place (2,)."""
        column, row = chunks_of(np.asarray(place_m)[None, :], self.size_m)[0]
        return int(column), int(row)

    def ring(self, chunk: Chunk, radius: int) -> IntArray:
        """Return the rows in the square ring of chunks `radius` steps away; 0 is the chunk itself."""
        x, y = chunk
        reach = range(-radius, radius + 1)
        here = ((x + i, y + j) for i in reach for j in reach if max(abs(i), abs(j)) == radius)
        found = [self.rows[one] for one in here if one in self.rows]
        return np.concatenate(found) if found else np.zeros(0, dtype=np.int64)

    def farthest(self, chunk: Chunk) -> int:
        """Return the radius of the last ring that holds anything."""
        return max((max(abs(x - chunk[0]), abs(y - chunk[1])) for x, y in self.rows), default=0)


@dataclass(frozen=True, slots=True, eq=False)
class RingEstimate:
    """Estimate from the neighbourhood of a chunk.

    Attributes:
        fitted: the model of all samples within `radius`.
        variance: of its survival function at its median.
        radius: rings that were joined to the chunk.
        rows: of the samples that were used.
    """

    fitted: ParametricFit
    variance: float
    radius: int
    rows: IntArray


def ring_query(
    data: CensoredLifetimes, index: ChunkIndex, chunk: Chunk, variance_bound: float, kind: str = "weibull"
) -> RingEstimate:
    """Fit a model to the samples of a chunk, joined by ring after ring until its variance is below a bound.

    Where all samples together do not reach the bound, their model is returned; its variance says so.

    Args:
        data: N samples.
        index: of their places.
        chunk: the one in question; it may be empty.
        variance_bound: of `P(T > median)`: 0.0025 is a standard deviation of 5 %.
        kind: of model, as `parametric_fit.KINDS` has them.

    Raises:
        ConfigError: a bound that is not positive, or an unknown kind.
        DataError: no lifetime has an end, or the index holds none.
        NumericalError: even all samples do not determine a model.
    """
    check_positive(variance_bound, "variance_bound")
    rows = np.zeros(0, dtype=np.int64)
    farthest = index.farthest(chunk)
    for radius in range(farthest + 1):
        rows = np.sort(np.concatenate([rows, index.ring(chunk, radius)]))
        if not (rows.size and data.weight[rows].any()):
            continue
        try:
            fitted = fit(kind, data[rows])
        except (DataError, NumericalError):
            if radius == farthest:
                raise
            continue
        variance = float(fitted.variance(fitted.prior.quantile(0.5)))
        if variance <= variance_bound or radius == farthest:
            return RingEstimate(fitted, variance, radius, rows)
    raise DataError("holds no samples", field="index", hint="an index of the same samples")
