"""The two exact selectors: the most probable mode of every look (EM), and the most probable sequence (Viterbi)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.types import IntArray
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, log_joint
from evermap_studies.nielsen2024.selectors.inference import most_probable, smoothed
from evermap_studies.nielsen2024.selectors.nearest import largest
from evermap_studies.nielsen2024.selectors.protocol import Selection


@dataclass(frozen=True, slots=True)
class MostProbableModes:
    """EM, winner takes all (Nielsen 2024 section 5.3): per look the mode of largest posterior probability.

    It minimises the expected number of wrong modes. The sequence as a whole may be improbable, or even impossible.
    """

    def select(
        self,
        looks: ModeLooks,
        chain: ModeChain,
        rng: np.random.Generator,
        *,
        previous: IntArray | None = None,  # noqa: ARG002 - the protocol's
    ) -> Selection:
        """Forward-backward, then the largest of every look; ties at random."""
        return largest(looks, chain, smoothed(looks, chain).log_smoothed, rng)


@dataclass(frozen=True, slots=True)
class MostProbableSequence:
    """Viterbi: the sequence of largest joint probability, which is what the tree search approximates."""

    def select(
        self,
        looks: ModeLooks,
        chain: ModeChain,
        rng: np.random.Generator,  # noqa: ARG002 - the protocol's
        *,
        previous: IntArray | None = None,  # noqa: ARG002 - the protocol's
    ) -> Selection:
        """Dynamic programming; nothing random."""
        indicator = most_probable(looks, chain)
        return Selection(indicator, log_joint(looks, chain, indicator))
