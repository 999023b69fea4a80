"""What every selector answers, and selectors by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from evermap.errors import ConfigError
from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks

NAMES = ("max-mixture", "nn", "em", "mcts", "viterbi")


@dataclass(frozen=True, slots=True)
class Selection:
    """One mode for every look.

    Attributes:
        indicator: (R,) column of `ModeLooks.log_likelihood` that holds at each look.
        log_joint: (L,) log of the chain's prior times the likelihoods of that sequence, of each landmark; -inf for a
            sequence that the chain rules out, as selectors that look at single looks may return.
    """

    indicator: IntArray
    log_joint: FloatArray


@runtime_checkable
class Selector(Protocol):
    """Chooses the sequence of modes of every landmark, poses and positions given."""

    def select(
        self, looks: ModeLooks, chain: ModeChain, rng: np.random.Generator, *, previous: IntArray | None = None
    ) -> Selection:
        """Modes of all landmarks at all looks.

        Args:
            looks: what every look says.
            chain: how modes change.
            rng: of ties and of the tree search; the same state gives the same selection.
            previous: (R,) modes as selected before, -1 for new looks. A selector with a window keeps those of looks
                older than its window; the others take no notice.

        Raises:
            NumericalError: a landmark for which no sequence of modes is possible.
        """
        ...


def selector_by_name(name: str, *, mcts_budget: int = 200, mcts_window_s: float | None = 40.0) -> Selector:
    """The selector of that name; one of `NAMES`.

    Args:
        name: as in the configuration's `slam.method`.
        mcts_budget: iterations of the tree search for every decision.
        mcts_window_s: how far back the tree search decides anew [s]; None: to the start.

    Raises:
        ConfigError: no such selector.
    """
    from evermap_studies.nielsen2024.selectors.nearest import Nearest
    from evermap_studies.nielsen2024.selectors.posterior import MostProbableModes, MostProbableSequence
    from evermap_studies.nielsen2024.selectors.tree_search import TreeSearch

    if name in {"max-mixture", "nn"}:
        return Nearest()
    if name == "em":
        return MostProbableModes()
    if name == "viterbi":
        return MostProbableSequence()
    if name == "mcts":
        return TreeSearch(budget=mcts_budget, window_s=mcts_window_s)
    raise ConfigError(f"no selector '{name}'", field="method", hint=" | ".join(NAMES))
