"""How long the selectors of modes take over the same looks: dynamic programming beside the tree search, on one core."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks
from evermap_studies.nielsen2024.selectors.protocol import Selector, selector_by_name
from evermap_studies.nielsen2024.selectors.tree_search import TreeSearch

N_LANDMARKS, N_LOOKS, N_MODES = 15, 200, 3
TURNS = 5
CHAIN = ModeChain(switch_probability=1e-4)

METRICS: dict[str, tuple[str, float, str]] = {
    "viterbi_mcts_speed_ratio": ("higher", 0.5, "speed of Viterbi over the tree search at its default budget"),
}
"""Metric: which direction is better, relative tolerance, meaning."""


def contenders() -> dict[str, Selector]:
    """All that know the chain, by name; the tree search over all looks, on one thread."""
    return {
        "viterbi": selector_by_name("viterbi"),
        "em": selector_by_name("em"),
        "mcts": TreeSearch(window_s=None, threads=1),
    }


def landmarks(n_looks: int = N_LOOKS, seed: int = 0) -> ModeLooks:
    """Landmarks that change their mode three times on the mean, seen at two looks of three."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(N_LANDMARKS):
        position_m = rng.normal(0.0, 1.0, (N_MODES, 2))
        changes = np.where(rng.random(n_looks) < 3.0 / n_looks, rng.integers(1, N_MODES, n_looks), 0)
        mode = (rng.integers(N_MODES) + np.cumsum(changes)) % N_MODES
        squared = ((position_m[mode] + rng.normal(0.0, 0.15, (n_looks, 2)))[:, None] - position_m) ** 2
        detected = rng.random((n_looks, 1)) < 2 / 3
        rows.append(np.where(detected, -0.5 * squared.sum(axis=2) / 0.15**2, 0.0))
    stamp_s = np.tile(0.1 * np.arange(n_looks), N_LANDMARKS)
    return ModeLooks(n_looks * np.arange(N_LANDMARKS + 1), stamp_s, np.concatenate(rows))


def run(n_looks: int = N_LOOKS, turns: int = TURNS) -> tuple[dict[str, float], dict[str, Any]]:
    """The metric, and the median time of each contender [ms]; they take turns."""
    looks = landmarks(n_looks)
    times: dict[str, list[float]] = {name: [] for name in contenders()}
    for turn in range(turns + 1):
        for name, selector in contenders().items():
            began = time.perf_counter()
            selector.select(looks, CHAIN, np.random.default_rng(turn))
            times[name].append(time.perf_counter() - began)
    # the first turn compiled
    took_ms = {name: 1e3 * statistics.median(row[1:]) for name, row in times.items()}
    return {"viterbi_mcts_speed_ratio": took_ms["mcts"] / took_ms["viterbi"]}, {"n_looks": n_looks, "ms": took_ms}
