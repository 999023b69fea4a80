"""Priors of several kinds, and random streams of observations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Uniform, Weibull
from evermap.types import FloatArray

PRIORS: dict[str, LifetimePrior] = {
    "exponential": Exponential(0.02),
    "general purpose": GeneralPurpose(1e-4, 2.0),
    "uniform": Uniform(80.0),
    "weibull": Weibull(60.0, 1.7),
}


@dataclass(frozen=True)
class Stream:
    """Looks at one feature, sorted by time."""

    time: FloatArray
    detected: FloatArray
    p_miss: FloatArray
    p_false: FloatArray

    def __len__(self) -> int:
        return len(self.time)


@st.composite
def streams(draw: st.DrawFn, longest: int = 12) -> Stream:
    """One to `longest` looks with gaps of 0 to 20 s and probabilities well inside (0, 1)."""
    n = draw(st.integers(1, longest))

    def column(low: float, high: float) -> FloatArray:
        return np.array(draw(st.lists(st.floats(low, high), min_size=n, max_size=n)))

    detected = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)), dtype=np.float64)
    gap = np.where(column(0.0, 1.0) < 0.1, 0.0, column(1e-3, 20.0))
    return Stream(np.minimum(np.cumsum(gap), 79.0), detected, column(0.01, 0.9), column(0.01, 0.9))
