"""Looks at cliques of landmarks, and the sums over all times of death that the filters abbreviate, in 40 digits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate, pairwise, product
from operator import mul
from typing import Any

import mpmath as mp
import numpy as np
from hypothesis import strategies as st

from evermap.survival import Exponential, GeneralPurpose, LifetimePrior, Uniform, Weibull
from evermap.types import BoolArray, FloatArray, IntArray

DIGITS = 40
PRIORS: dict[str, tuple[LifetimePrior, Callable[[Any], Any]]] = {
    "exponential": (Exponential(0.02), lambda t: mp.exp(-mp.mpf(0.02) * t)),
    "uniform": (Uniform(80.0), lambda t: max(mp.mpf(0), 1 - t / 80)),
    "weibull": (Weibull(60.0, 1.7), lambda t: mp.exp(-((t / 60) ** mp.mpf(1.7)))),
    "general purpose": (
        GeneralPurpose(1e-4, 2.0),
        lambda t: (mp.e1(mp.mpf(1e-4) * t) - mp.e1(2 * t)) / mp.log(2 / mp.mpf(1e-4)) if t > 0 else mp.mpf(1),
    ),
}


@dataclass(frozen=True)
class Looks:
    """N looks at C cliques with K landmarks in all, at the same instants.

    Attributes:
        stamp_s: (N,) never decreasing.
        clique: (K,) which clique each landmark is of, in any order.
        detected, p_miss, p_false, expected: (N, K).
    """

    stamp_s: FloatArray
    clique: IntArray
    detected: BoolArray
    p_miss: FloatArray
    p_false: FloatArray
    expected: BoolArray

    def __len__(self) -> int:
        return len(self.stamp_s)

    def step(self, n: int) -> tuple[Any, ...]:
        """Arguments of a filter for look `n`, from the stamp on."""
        return float(self.stamp_s[n]), self.detected[n], self.p_miss[n], self.p_false[n], self.expected[n]

    def likelihoods(self, landmarks: Any) -> tuple[list[Any], list[Any]]:
        """For each look the likelihood of what these landmarks gave, if they are there and if they are gone."""
        there, gone = [mp.mpf(1) for _ in self.stamp_s], [mp.mpf(1) for _ in self.stamp_s]
        for n, k in product(range(len(self)), landmarks):
            if self.expected[n, k]:
                miss, false = mp.mpf(self.p_miss[n, k]), mp.mpf(self.p_false[n, k])
                there[n] *= 1 - miss if self.detected[n, k] else miss
                gone[n] *= false if self.detected[n, k] else 1 - false
        return there, gone


@st.composite
def looks(draw: st.DrawFn, *, cliques: int = 3, landmarks: int = 6, longest: int = 6) -> Looks:
    """Up to `longest` looks with gaps of 0 to 12 s; probabilities well inside (0, 1), some landmarks not expected."""
    k = draw(st.integers(1, landmarks))
    n = draw(st.integers(1, longest))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    gap = np.where(rng.random(n) < 0.2, 0.0, rng.uniform(1e-3, 12.0, n))
    return Looks(
        stamp_s=np.cumsum(gap),
        clique=rng.integers(0, cliques, k),
        detected=rng.random((n, k)) < draw(st.sampled_from([0.1, 0.5, 0.9])),
        p_miss=rng.uniform(0.02, 0.95, (n, k)),
        p_false=rng.uniform(0.01, 0.5, (n, k)),
        expected=rng.random((n, k)) < draw(st.sampled_from([0.4, 1.0])),
    )


def deaths(survival: Callable[[Any], Any], stamp_s: FloatArray) -> list[Any]:
    """(N + 1) probabilities to die before the first look, between the looks, and after the last."""
    edges = [mp.mpf(1), *(survival(mp.mpf(t)) for t in stamp_s), mp.mpf(0)]
    return [a - b for a, b in pairwise(edges)]


def given_death(there: list[Any], gone: list[Any]) -> list[Any]:
    """(N + 1) likelihoods of all looks, for a death in each of the intervals of `deaths`."""
    while_there = accumulate(there, mul, initial=mp.mpf(1))
    while_gone = list(accumulate(reversed(gone), mul, initial=mp.mpf(1)))[::-1]
    return [a * b for a, b in zip(while_there, while_gone, strict=True)]


def summed(survival: Callable[[Any], Any], looks: Looks, landmarks: Any, query_s: float) -> tuple[float, float]:
    """Belief at `query_s` (at or after the last look) that landmarks with one death are there, and the log evidence.

    One term for each interval in which they may have died (Bateman 2020 eq. 3.15, Rosen 2016 eqs. 6 to 9).
    """
    with mp.workdps(DIGITS):
        there, gone = looks.likelihoods(landmarks)
        evidence = mp.fdot(deaths(survival, looks.stamp_s), given_death(there, gone))
        belief = mp.fprod(there) * survival(mp.mpf(query_s)) / evidence
        return float(belief), float(mp.log(evidence))
