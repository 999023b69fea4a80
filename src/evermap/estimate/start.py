"""The prior of the first pose, in the plane and in space."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from evermap.estimate.graph import Room
from evermap.estimate.sparse.system import Slices
from evermap.types import FloatArray, IntArray


class Posed(Protocol):
    """Values of variables with poses (N, size), the first ones."""

    @property
    def pose(self) -> FloatArray: ...


class StartFactor(NamedTuple):
    """The first pose, held where it is.

    Attributes:
        mean: (size,) where.
        root: (d,) how firmly: inverse standard deviations, in its own frame.
        deviate: how far a pose is off the mean (d,), and the derivative (d, d) by a step of the pose.
    """

    mean: FloatArray
    root: FloatArray
    deviate: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

    @property
    def ties(self) -> IntArray:
        """Return (1, 1) the first variable."""
        return np.zeros((1, 1), dtype=np.int64)

    @property
    def rows(self) -> IntArray:
        """Return (1,) as many as a pose has degrees of freedom."""
        return np.full(1, len(self.root))

    @property
    def pose(self) -> IntArray:
        """Return (1,) the first pose."""
        return np.zeros(1, dtype=np.int64)

    def linearise(self, state: Posed, out: Room) -> Slices[float]:
        """Fill in one factor."""
        off, by_step = self.deviate(self.mean, state.pose[0])
        out.values[:] = np.column_stack([self.root[:, None] * by_step, -self.root * off]).ravel()
        yield from ()
        return 0.5 * float(np.sum((self.root * off) ** 2))
