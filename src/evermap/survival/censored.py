"""Lifetimes of which only bounds are known, given as such or by sightings (MATH.md section 6).

```
            elsewhere      arrival b       first ........... last       gone
  looks  ------|--------------?--------------|-------|---------|----------|------
                                left = last - b      right = gone - b
                                entry = first - b
```

A stay that begins and ends between two looks is never observed, so the observed ones are longer on average: a stay is
known only because it lasted until the first look, `T > first - b`. To take `(last - first, gone - elsewhere]` for a
plain interval ignores that, and overestimates lifetimes, the more the rarer the looks.

The arrival is unknown, too. Arrivals are uniform in time, so every instant b since the look before is equally probable,
and the likelihood of a stay is

    sum_b [ S(last - b) - S(gone - b) ]  /  sum_b S(first - b)

Estimators that take plain samples get several rows for each stay, one an instant, whose bounds and entries are exact,
and which share its weight. Bands ignore that the instants are unknown, and are a little too narrow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError, DataError
from evermap.show import ShownTable
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class CensoredLifetimes(ShownTable):
    """N samples `left < T <= right`, each known only because `T > entry`.

    ```
    exact            left = right          the end was observed
    interval         left < right          present at left, gone at right
    right censored   right = inf           never seen gone
    left censored    left = 0              gone at the first look
    left truncated   entry > 0             it would not be in the sample, had it gone by then
    ```

    Attributes:
        left_s: (N,) in seconds, not negative.
        right_s: (N,) in seconds, positive, `>= left`, possibly `inf`.
        entry_s: (N,) in seconds, not negative, `< right`; 0 where nothing is truncated. A `left` below it adds nothing
            to the entry.
        weight: (N,) number of lifetimes that each stands for; not negative, not all 0. Rows of weight 0 are ignored.

    Raises:
        DataError: anything else; names row (from 0) and field.
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
            raise DataError("no lifetimes", field="left_s", hint="at least one row")
        left, right, entry, weight = self.left_s, self.right_s, self.entry_s, self.weight
        _refuse(~((left >= 0.0) & (left < np.inf)), left, "left_s", "must be finite and not negative")
        _refuse(~(right > 0.0), right, "right_s", "must be positive, `inf` for never seen gone")
        _refuse(right < left, right, "right_s", "ends before its left_s")
        _refuse(~((entry >= 0.0) & (entry < np.inf)), entry, "entry_s", "must be finite and not negative")
        _refuse(entry >= right, entry, "entry_s", "is at or after its right_s")
        _refuse(~((weight >= 0.0) & (weight < np.inf)), weight, "weight", "must be finite and not negative")
        if not weight.any():
            raise DataError("all weights are 0", field="weight", hint="a weight of 1 for a lifetime seen once")

    @classmethod
    def of(cls, left_s: ArrayLike, right_s: ArrayLike, entry_s: ArrayLike = 0.0, weight: ArrayLike = 1.0) -> Self:
        """Make samples from anything that numpy takes for (N,) numbers; a single entry or weight holds for all rows."""
        left = np.asarray(left_s, dtype=np.float64)
        right, entry, counts = (np.asarray(column, dtype=np.float64) for column in (right_s, entry_s, weight))
        entry, counts = (np.full(left.shape, c) if c.ndim == 0 else c for c in (entry, counts))
        return cls(left, right, entry, counts)

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        """Return the samples in some rows, by number or by a mask, at least one of positive weight."""
        return type(self)(self.left_s[rows], self.right_s[rows], self.entry_s[rows], self.weight[rows])

    @property
    def exact(self) -> BoolArray:
        """Return (N,) whether the end was observed."""
        return np.asarray(self.left_s == self.right_s)

    @property
    def at_risk_s(self) -> tuple[float, float]:
        """Return the ages between which an end would have been seen: of others no estimate knows anything."""
        counts = self.weight > 0.0
        last_s = np.where(np.isinf(self.right_s), np.maximum(self.left_s, self.entry_s), self.right_s)
        return float(self.entry_s[counts].min()), float(last_s[counts].max())


def _refuse(bad: BoolArray, values: FloatArray, field: str, problem: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{problem}: found {float(values[row])!r}, row {row}", field=field)


def lifetimes_of_sightings(
    elsewhere_s: ArrayLike,
    first_s: ArrayLike,
    last_s: ArrayLike,
    gone_s: ArrayLike,
    *,
    instants: int = 5,
    least_stay_s: float = 0.0,
) -> tuple[CensoredLifetimes, IntArray]:
    """Make censored samples from the sightings of stays.

    Stays without a look before are left out: their age at the first look is unknown.

    Args:
        elsewhere_s: (K,) last look before the first sighting, at which it was not there; -inf if there was none.
        first_s: (K,) first sighting.
        last_s: (K,) last sighting.
        gone_s: (K,) first look after the last sighting, at which it was not there; inf if there was none.
        instants: number of instants of arrival for each stay.
        least_stay_s: a stay is counted only if it is seen to last this long.

    Returns:
        the samples, `instants` rows for each stay, and (N,) the stay that each row belongs to.

    Raises:
        ConfigError: `instants` is not positive.
        DataError: columns of different lengths or out of order in time, or no stay with a look before it.
    """
    if instants < 1:
        raise ConfigError(f"must be positive, not {instants}", field="instants")
    columns = {"elsewhere_s": elsewhere_s, "first_s": first_s, "last_s": last_s, "gone_s": gone_s}
    elsewhere, first, last, gone = (np.asarray(values, dtype=np.float64) for values in columns.values())
    for name, column in zip(columns, (elsewhere, first, last, gone), strict=True):
        if column.shape != (first.size,):
            raise DataError(f"shape {column.shape} instead of ({first.size},)", field=name)
    wrong = ~((elsewhere < first) & (first <= last) & (last < gone) & np.isfinite(first) & np.isfinite(last))
    if wrong.any():
        problem = f"not in order, row {int(np.argmax(wrong))}"
        raise DataError(problem, field="first_s", hint="elsewhere_s < first_s <= last_s < gone_s")
    stay = np.flatnonzero(np.isfinite(elsewhere) & (last - first >= least_stay_s))
    if stay.size == 0:
        hint = "look at the places more than once"
        raise DataError("every stay began before the first look", field="elsewhere_s", hint=hint)
    rows = np.repeat(stay, instants)
    share = np.tile((np.arange(instants) + 0.5) / instants, stay.size)
    arrival = elsewhere[rows] + share * (first[rows] - elsewhere[rows])
    left, right = last[rows] - arrival, gone[rows] - arrival
    return CensoredLifetimes.of(left, right, first[rows] + least_stay_s - arrival, 1.0 / instants), rows
