"""A metric as items that sessions and landmarks contribute, so that every number can be bootstrapped the same way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from evermap_score.episodes import FloatArray, IntArray, TextArray

OfSums = Callable[[FloatArray], float]
OfItems = Callable[[FloatArray, FloatArray], float]


@dataclass(frozen=True)
class Metric:
    """One number, and the items it is computed from.

    Attributes:
        name: with '/' between its parts.
        unit: 'm', 's', 'looks', or empty.
        columns: (n, c) what each item contributes.
        session: (n,) index of the session of each item; -1: of none.
        landmark: (n,) id of the landmark of each item; empty: of none.
        of_sums: the number from the sums of the columns (c,); None if it is no function of sums.
        of_items: else the number from the columns (n, c) and the weights of the items (n,).
    """

    name: str
    unit: str
    columns: FloatArray
    session: IntArray
    landmark: TextArray
    of_sums: OfSums | None = None
    of_items: OfItems | None = None

    def value(self, weights: FloatArray | None = None) -> float:
        """Return the number, with a weight (n,) for each item; NaN if there is nothing to compute it from."""
        if weights is None:
            weights = np.ones(len(self.columns))
        if self.of_sums is not None:
            return self.of_sums(weights @ self.columns)
        assert self.of_items is not None
        return self.of_items(self.columns, weights)


def metric_of_rows(
    name: str, unit: str, rows: Sequence[tuple[int, str, Sequence[float]]], width: int, **how: Any
) -> Metric:
    """Return a metric from rows of (session, landmark, values); `width` values each."""
    return Metric(
        name,
        unit,
        np.array([row[2] for row in rows], dtype=np.float64).reshape(len(rows), width),
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.str_),
        **how,
    )


def ratio(over: Sequence[int], under: Sequence[int]) -> OfSums:
    """Return the function that divides the sum of some columns by that of others; NaN where that is 0."""

    def of_sums(sums: FloatArray) -> float:
        below = float(sums[list(under)].sum())
        return float(sums[list(over)].sum()) / below if below > 0.0 else float("nan")

    return of_sums


def f1_of(true: int, false: int, missed: int) -> OfSums:
    """Return the function of the sums that is F1, 2 TP / (2 TP + FP + FN); NaN without any."""

    def of_sums(sums: FloatArray) -> float:
        below = 2.0 * sums[true] + sums[false] + sums[missed]
        return float(2.0 * sums[true] / below) if below > 0.0 else float("nan")

    return of_sums


def root_of_ratio(over: int, under: int) -> OfSums:
    """Return the function that is the root of the sum of one column divided by that of another."""

    def of_sums(sums: FloatArray) -> float:
        return float(np.sqrt(sums[over] / sums[under])) if sums[under] > 0.0 else float("nan")

    return of_sums
