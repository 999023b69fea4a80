"""What a lifetime prior answers. Filters and plots ask for nothing else (MATH.md section 1)."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from evermap.types import FloatArray

Seed = np.random.Generator | int
"""A generator, or the seed of a new one."""


@runtime_checkable
class LifetimePrior(Protocol):
    """Distribution of the survival time `T` of a feature that is first seen at t = 0.

    Times are seconds, finite and not negative; arrays broadcast, and scalars give numpy scalars.
    `S(t) = P(T > t)`, and `q(a, b) = S(b) / S(a)` is the probability to see `b` for one that saw `a`.
    Where `S(a) = 0` the condition is void: then `q(a, b) = 0` for `b > a`, and `q(a, a) = 1` always.

    Raises (all methods): ConfigError for a time that is NaN, infinite or negative, or for `a > b`.
    """

    @property
    def p_never_leaves(self) -> float:
        """`P(T = inf)`: positive where the hazard has a finite integral."""
        ...

    def log_survival(self, t: ArrayLike) -> FloatArray:
        """`log S(t)`."""
        ...

    def log_conditional_survival(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        """`log q(a, b)`, for `a <= b`."""
        ...

    def log_conditional_death(self, a: ArrayLike, b: ArrayLike) -> FloatArray:
        """`log(1 - q(a, b))`, for `a <= b`; `-inf` where `a = b`."""
        ...

    def hazard(self, t: ArrayLike) -> FloatArray:
        """`h(t) = p(t) / S(t)` in 1/s; `inf` on a point of positive mass and where `S(t) = 0`."""
        ...

    def cumulative_hazard(self, t: ArrayLike) -> FloatArray:
        """`H(t) = -log S(t)`."""
        ...

    def log_density(self, t: ArrayLike) -> FloatArray:
        """`log p(t)`, `p` in 1/s; `+inf` on a point of positive mass."""
        ...

    def sample(self, rng: Seed, size: int | tuple[int, ...] | None = None) -> FloatArray:
        """Survival times in seconds, `inf` for those that never leave."""
        ...

    def mean(self) -> float:
        """`E[T]` in seconds, possibly `inf`."""
        ...

    def quantile(self, p: ArrayLike) -> FloatArray:
        """Smallest `t` with `P(T <= t) >= p`, for `p` in [0, 1]; `inf` where no finite time does."""
        ...
