"""Monte Carlo tree search over the sequence of modes (Nielsen 2024 section 5.4): the paper's own selector."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from evermap.errors import ConfigError
from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.chain import ModeChain, ModeLooks, impossible, log_joint
from evermap_studies.nielsen2024.selectors.inference import Stretch, landmarks
from evermap_studies.nielsen2024.selectors.protocol import Selection


@dataclass(frozen=True, slots=True)
class TreeSearch:
    """UCT: one search for every landmark, one decision for every look, approaching Viterbi as the budget grows.

    Landmarks are searched side by side in threads, so that their rollouts run in parallel; spreading the rollouts of
    one expansion over threads costs more than the rollouts. Every landmark has its own random numbers: the selection
    depends on the state of `rng`, not on the threads.

    Attributes:
        budget: iterations (selection, expansion, rollout, back-propagation) for every decision.
        window_s: looks that are older than the last look of all by more than this keep the mode that they had [s];
            None decides all anew.
        exploration: weight of the confidence bound `sqrt(log N / n)`; values are normalised to [0, 1].
        rollouts: sequences sampled from every new node.
        threads: at most; None for as many as suit the machine.
        max_nodes: of each landmark's tree; one that would outgrow them starts anew at the next decision.

    Raises:
        ConfigError: a budget or a number of rollouts, threads or nodes below 1.
    """

    budget: int = 200
    window_s: float | None = 40.0
    exploration: float = 0.5**0.5
    rollouts: int = 1
    threads: int | None = None
    max_nodes: int = 2_000_000

    def __post_init__(self) -> None:
        for field in ("budget", "rollouts", "threads", "max_nodes"):
            value = getattr(self, field)
            if value is not None and value < 1:
                raise ConfigError(f"{value} is too few", field=field, hint="1 or more")

    def select(
        self, looks: ModeLooks, chain: ModeChain, rng: np.random.Generator, *, previous: IntArray | None = None
    ) -> Selection:
        """The most visited mode of every look, one look after another."""
        from evermap_studies.nielsen2024.selectors.tree_kernels import search

        indicator = np.zeros(len(looks.stamp_s), dtype=np.int64)
        kept = self._kept(looks, previous)
        if previous is not None:
            indicator[kept] = previous[kept]
        # drawn for all landmarks before the first search: the threads share nothing
        seeds = rng.integers(2**63, size=looks.n_landmarks, dtype=np.uint64)

        def run(one: Stretch) -> bool:
            done = int(np.count_nonzero(kept[one.rows]))
            if done == len(one.stamp_s):
                return True
            task = _task(one, done, indicator[one.rows])
            return bool(
                search(
                    *task, one.gone, self.budget, self.rollouts, self.exploration, self.max_nodes,
                    seeds[one.number], indicator[one.rows][done:],
                )
            )  # fmt: skip

        stretches = list(landmarks(looks, chain))
        if self.threads == 1 or len(stretches) < 2:
            found = [run(one) for one in stretches]
        else:
            with ThreadPoolExecutor(self.threads) as pool:
                found = list(pool.map(run, stretches))
        for one, possible in zip(stretches, found, strict=True):
            if not possible:
                raise impossible(one.number)
        return Selection(indicator, log_joint(looks, chain, indicator))

    def _kept(self, looks: ModeLooks, previous: IntArray | None) -> BoolArray:
        """(R,) the looks whose modes are not decided anew: of every landmark, the first ones up to some look."""
        keep = np.zeros(len(looks.stamp_s), dtype=np.bool_)
        if previous is None or self.window_s is None or not len(keep):
            return keep
        keep = (looks.stamp_s < looks.stamp_s.max() - self.window_s) & (previous >= 0)
        keep &= np.isfinite(looks.log_likelihood[np.arange(len(keep)), np.maximum(previous, 0)])
        # what follows a look that is decided anew is decided anew
        free = np.cumsum(~keep)
        begin = looks.first[:-1][looks.landmark]
        undisturbed: BoolArray = free - free[begin] + ~keep[begin] == 0
        return undisturbed


class _Task(NamedTuple):
    """What is searched at one landmark: its M looks that are to be decided.

    Attributes:
        log_likelihood: (M, K).
        log_start: (K,) prior of the first of them, where no look before it is kept.
        mode: the mode of the last look that is kept, or -1.
        log_stay, log_leave: (M, S) over the gap before each; column 0 for the stay that is kept (or for a chain without
            memory, all), column `i + 1` for a stay that begins at the i-th of them.
    """

    log_likelihood: FloatArray
    log_start: FloatArray
    mode: int
    log_stay: FloatArray
    log_leave: FloatArray


def _task(one: Stretch, done: int, indicator: IntArray) -> _Task:
    """The looks after the first `done`, whose modes are the first of `indicator`."""
    count = len(one.stamp_s)
    mode, began = -1, 0
    if done:
        mode = int(indicator[done - 1])
        changes = np.flatnonzero(np.diff(indicator[:done])) + 1
        began = int(changes[-1]) if changes.size else 0
    if one.memoryless:
        stay, leave = (column[done:, None] for column in one.gaps())
    else:
        stay, leave = one.block(done, count, np.concatenate([[began], np.arange(done, count)]))
    log_likelihood = np.ascontiguousarray(one.log_likelihood[done:])
    return _Task(log_likelihood, one.log_start, mode, np.ascontiguousarray(stay), np.ascontiguousarray(leave))
