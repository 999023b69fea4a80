"""The prior of log hazards over age: a grid of Gaussian processes, their probabilities, and how many draws each has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from evermap.types import FloatArray

SLOW = 4.0
"""Length of the slow process over age, in natural logarithms above an hour."""
HOUR_S = 3600.0
YOUNG = 4.0
"""Factor of the distances of ages below an hour, for the slow process: short stops tell little of what is parked."""
SLOW_SCALE, COMMON = 2.8, (0.3, 0.8)
"""Standard deviation of log hazards (of the rates of the general-purpose prior, an hour to ten years: 3.3), and the
share of their variance that classes have in common."""
FAST = ((0.8, 0.1, 0.85), (0.8, 0.5, 0.1), (0.8, 1.5, 0.03), (0.8, 4.0, 0.02))
"""Lengths and standard deviations of the fast process, and their probabilities: hazards are smooth, as a rule. The
steepest is beyond what the end of a shift has most evidence for: where the edge of a grid is more probable than all
within, bands are too narrow, and too sure that some leave long before that end. Such ends come hours after an arrival:
below an hour the standard deviations fall in proportion to age."""
DRAWS, LEAST_DRAWS, NEGLIGIBLE = 256, 32, 5e-3
"""Draws for the most probable member of the grid, half of them mirror images of the other half, and for others in
proportion to their probability, but so many; and the probability below which there are none."""
NEGLECTED = 1e-6
"""Share of the largest variance below which a direction of the process is dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class HazardScale:
    """One member of the grid.

    Attributes:
        columns: (K, R) that make log hazards, relative to the stated one, of R independent standard normal numbers.
        common: share of their variance that all classes have in common.
        p: prior probability of this member.
    """

    columns: FloatArray
    common: float
    p: float


@lru_cache(maxsize=16)
def make_scales(edges: tuple[float, ...]) -> tuple[HazardScale, ...]:
    """Return the members of the grid, on stretches that begin at these ages in seconds."""
    edges_s = np.asarray(edges)
    ends_s = np.append(edges_s[1:], 2.0 * edges_s[-1])
    age = np.log(np.sqrt(np.maximum(edges_s, 0.25 * ends_s) * ends_s) / HOUR_S)
    where = np.where(age < 0.0, YOUNG * age, age)
    share = np.minimum(np.exp(age), 1.0)
    found = []
    for length, fast, p in FAST:
        of_fast = fast**2 * np.outer(share, share) * _matern(age, length)
        values, vectors = np.linalg.eigh(SLOW_SCALE**2 * _matern(where, SLOW) + of_fast)
        kept = values > NEGLECTED * values[-1]
        columns = vectors[:, kept] * np.sqrt(values[kept])
        found += [HazardScale(columns, common, p / len(COMMON)) for common in COMMON]
    return tuple(found)


def _matern(where: FloatArray, length: float) -> FloatArray:
    """Return the Matern kernel of smoothness 3/2."""
    far = np.sqrt(3.0) * np.abs(where[:, None] - where) / length
    return np.asarray((1.0 + far) * np.exp(-far))


def find_shares(scales: Sequence[HazardScale], log_evidence: ArrayLike) -> FloatArray:
    """(M,) probabilities of members of the grid."""
    log_p = np.log([scale.p for scale in scales]) + np.asarray(log_evidence)
    weight = np.exp(log_p - log_p.max())
    return np.asarray(weight / weight.sum())


def count_draws(share: FloatArray) -> list[int]:
    """Return how many draws each member of the grid has, by their probabilities (M,)."""
    counts = np.maximum(2.0 * np.ceil(0.5 * DRAWS * share / share.max()), LEAST_DRAWS)
    return [int(count) for count in np.where(share < NEGLIGIBLE, 0.0, counts)]


def weigh_draws(scales: Sequence[HazardScale], log_evidence: Sequence[float] | None = None) -> FloatArray:
    """(S,) of the draws of all members of the grid, before any data where no evidence is given."""
    share = find_shares(scales, np.zeros(len(scales)) if log_evidence is None else log_evidence)
    return np.repeat(share / DRAWS, DRAWS)


@lru_cache(maxsize=64)
def draw_normals(r: int, n: int = DRAWS) -> tuple[FloatArray, FloatArray]:
    """Return standard normal draws (N, R) twice, the same for all, each with its mirror image."""
    rng = np.random.default_rng(0)
    one, other = (rng.standard_normal((n // 2, r)) for _ in range(2))
    return np.concatenate([one, -one]), np.concatenate([other, -other])
