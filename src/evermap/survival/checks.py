"""Checks of times, probabilities and parameters, with messages that name the row."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from evermap.errors import ConfigError
from evermap.types import BoolArray, FloatArray


def times(t: ArrayLike, name: str = "t") -> FloatArray:
    """`t` as float64, or a ConfigError if any is NaN, infinite or negative."""
    values = np.asarray(t, dtype=np.float64)
    good = (values >= 0.0) & np.isfinite(values)
    if not good.all():
        _refuse(values, good, name, "a time since the first sighting must be finite and not negative, in seconds")
    return values


def intervals(a: ArrayLike, b: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """`a` and `b` broadcast against each other, or a ConfigError if any time is bad or `a > b`."""
    first, last = np.broadcast_arrays(times(a, "a"), times(b, "b"))
    good = first <= last
    if not good.all():
        _refuse(last, good, "b", f"time goes back from a = {float(first[~good].flat[0])!r}", hint="a <= b")
    return first, last


def probabilities(p: ArrayLike) -> FloatArray:
    """`p` as float64, or a ConfigError if any is outside [0, 1]."""
    values = np.asarray(p, dtype=np.float64)
    good = (values >= 0.0) & (values <= 1.0)
    if not good.all():
        _refuse(values, good, "p", "a probability must lie in [0, 1]")
    return values


def positive(value: float, name: str) -> None:
    """A ConfigError unless `value` is finite and positive."""
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"must be finite and positive, not {value!r}", field=name)


def hazard_rates(rates: Sequence[float], name: str = "rates") -> None:
    """A ConfigError unless every rate is finite and not negative."""
    for row, rate in enumerate(rates):
        if not (math.isfinite(rate) and rate >= 0.0):
            raise ConfigError(
                f"a hazard must be finite and not negative, row {row} is {rate!r}",
                field=name,
                hint="a rate of 0 where nothing ever leaves",
            )


def increasing_from_zero(edges: Sequence[float], name: str = "edges_s") -> None:
    """A ConfigError unless `edges` start at 0 and increase strictly."""
    if len(edges) == 0 or edges[0] != 0.0:
        raise ConfigError("edges must start at 0", field=name)
    for row, (left, right) in enumerate(itertools.pairwise(edges), start=1):
        if not (math.isfinite(right) and right > left):
            raise ConfigError(f"edges must be finite and increase strictly, row {row} is {right!r}", field=name)


def _refuse(values: FloatArray, good: BoolArray, name: str, problem: str, hint: str | None = None) -> None:
    where = tuple(int(i) for i in np.argwhere(~good)[0])
    row = "" if not where else f", row {where[0] if len(where) == 1 else where}"
    raise ConfigError(f"{problem}: found {float(values[where])!r}{row}", field=name, hint=hint)
