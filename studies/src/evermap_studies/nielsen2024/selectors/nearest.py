"""Max-mixture and nearest neighbour: the mode that explains each look best, whatever the looks around it say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, impossible, log_joint
from evermap_studies.nielsen2024.selectors.protocol import Selection


@dataclass(frozen=True, slots=True)
class Nearest:
    """The largest `psi` of every look, ties at random (Nielsen 2024 section 5.2).

    The two methods differ by their callers: max-mixture (Olson and Agarwal 2013) gives no misses and doesn't iterate.
    """

    def select(
        self,
        looks: ModeLooks,
        chain: ModeChain,
        rng: np.random.Generator,
        *,
        previous: IntArray | None = None,  # noqa: ARG002 - the protocol's
    ) -> Selection:
        """The likeliest mode of every look by itself."""
        return largest(looks, chain, looks.log_likelihood, rng)


def largest(looks: ModeLooks, chain: ModeChain, score: FloatArray, rng: np.random.Generator) -> Selection:
    """The largest `score` (R, K) of every look among the modes that exist there, ties at random."""
    if not len(score):
        return Selection(np.empty(0, dtype=np.int64), np.zeros(looks.n_landmarks))
    possible = np.isfinite(looks.log_likelihood)
    without = np.flatnonzero(~possible.any(axis=1))
    if without.size:
        raise impossible(int(looks.landmark[without[0]]))
    allowed = np.where(possible, score, -np.inf)
    tied = possible & (allowed == allowed.max(axis=1, keepdims=True))
    indicator = np.where(tied, rng.random(tied.shape), -1.0).argmax(axis=1).astype(np.int64)
    return Selection(indicator, log_joint(looks, chain, indicator))
