"""Lifetimes of which only bounds are known (MATH.md section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import DataError
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class CensoredLifetimes:
    """N samples `left < T <= right`, each known only because `T > entry`.

    ```
    exact            left = right          the end was watched
    interval         left < right          there at left, gone at right
    right censored   right = inf           never seen gone
    left censored    left = 0              gone at the first look
    left truncated   entry > 0             had it been gone by then, nobody would have heard of it
    ```

    Attributes:
        left_s: (N,) in seconds, not negative.
        right_s: (N,) in seconds, positive, `>= left`, possibly `inf`.
        entry_s: (N,) in seconds, not negative, `< right`; 0 where nothing is truncated. A `left` below it says no more
            than the entry does.
        weight: (N,) how many lifetimes each stands for; not negative, not all 0. Rows of weight 0 say nothing.

    Raises:
        DataError: for anything else; names row (from 0) and field.
    """

    left_s: FloatArray
    right_s: FloatArray
    entry_s: FloatArray
    weight: FloatArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=np.float64))
            if getattr(self, name).shape != (np.size(self.left_s),):
                raise DataError(f"must be as long as left_s, {self.left_s.size} rows in one dimension", field=name)
        if self.left_s.size == 0:
            raise DataError("no lifetimes at all", field="left_s", hint="at least one row")
        left, right, entry, weight = self.left_s, self.right_s, self.entry_s, self.weight
        _refuse(~((left >= 0.0) & (left < np.inf)), left, "left_s", "must be finite and not negative")
        _refuse(~(right > 0.0), right, "right_s", "must be positive, `inf` for never seen gone")
        _refuse(right < left, right, "right_s", "ends before its left_s")
        _refuse(~((entry >= 0.0) & (entry < np.inf)), entry, "entry_s", "must be finite and not negative")
        _refuse(entry >= right, entry, "entry_s", "known only because it was there after its right_s")
        _refuse(~((weight >= 0.0) & (weight < np.inf)), weight, "weight", "must be finite and not negative")
        if not weight.any():
            raise DataError("all weights are 0", field="weight", hint="a weight of 1 for a lifetime seen once")

    @classmethod
    def of(cls, left_s: ArrayLike, right_s: ArrayLike, entry_s: ArrayLike = 0.0, weight: ArrayLike = 1.0) -> Self:
        """From anything that numpy takes for (N,) numbers; a single entry or weight holds for all rows."""
        left = np.asarray(left_s, dtype=np.float64)
        right, entry, counts = (np.asarray(column, dtype=np.float64) for column in (right_s, entry_s, weight))
        entry, counts = (np.full(left.shape, c) if c.ndim == 0 else c for c in (entry, counts))
        return cls(left, right, entry, counts)

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        """The samples in some rows, by number or by a mask, at least one of positive weight."""
        return type(self)(self.left_s[rows], self.right_s[rows], self.entry_s[rows], self.weight[rows])

    @property
    def exact(self) -> BoolArray:
        """(N,) whether the end was watched."""
        return np.asarray(self.left_s == self.right_s)


def _refuse(bad: BoolArray, values: FloatArray, field: str, problem: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{problem}: found {float(values[row])!r}, row {row}", field=field)
