"""Many simulated runs as one: their cliques side by side, so that a filter takes a step of all runs at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evermap.types import BoolArray, FloatArray, IntArray
from evermap_studies.worlds.cliques import CliqueRun, CliqueWorld, simulate_cliques

TABLE, TUNING = 0, 1
"""Streams of seeds: the runs that are scored, and those on which a miss rate is measured."""


@dataclass(frozen=True, slots=True)
class Stack:
    """R runs of F steps with C cliques and K landmarks in all; landmarks sorted by clique, cliques by run.

    Attributes:
        runs: as they were drawn.
        run: (C,) which run each clique is in.
        clique: (K,) which clique each landmark is on.
        landmark_m: (K, 3), each run in its own world.
        first: (C,) step of birth.
        survival_steps: (C,) it is there up to and with `first + survival_steps`.
        detected: (F, K).
        expected: (F, K) whether each landmark is in the field, as far as the filters can know.
        in_view: (F, C) whether any landmark of a clique is expected, from its birth on: the possible detections.
        range_m: (F, K) distance from the sensor, as far as the filters can know.
    """

    runs: tuple[CliqueRun, ...]
    run: IntArray
    clique: IntArray
    landmark_m: FloatArray
    first: IntArray
    survival_steps: FloatArray
    detected: BoolArray
    expected: BoolArray
    in_view: BoolArray
    range_m: FloatArray

    @property
    def world(self) -> CliqueWorld:
        """What all runs were drawn from."""
        return self.runs[0].world

    @property
    def cliques(self) -> int:
        """Their number C."""
        return len(self.first)

    def there(self) -> BoolArray:
        """(F, C) whether each object exists."""
        return np.concatenate([run.there() for run in self.runs], axis=1)

    def p_detect(self) -> FloatArray:
        """(F, K) true probability of a detection while the object is there and nobody hides it."""
        return np.concatenate([run.p_detect() for run in self.runs], axis=1)

    def looks(self) -> FloatArray:
        """(F, C) time since birth of each look that shows a clique, nan where there is none; one step is 1 s."""
        return np.where(self.in_view, np.arange(len(self.in_view))[:, None] - self.first, np.nan)

    def tracked(self) -> IntArray:
        """(C,) landmark of each clique that faces the sensor in the field in the most steps.

        The thesis has the independent filter follow one that is "always observable from the trajectory". The truth
        says which: an advantage that no other filter has.
        """
        steps = self._faces().sum(axis=0)
        best_first = np.lexsort((-steps, self.clique))
        return best_first[np.searchsorted(self.clique[best_first], np.arange(self.cliques))]

    def observable(self) -> IntArray:
        """(M,) landmarks that face the sensor in the field at least once a lap: a weaker reading of the same."""
        return np.flatnonzero(self._faces()[: self.world.period].any(axis=0))

    def _faces(self) -> BoolArray:
        """(F, K) whether a landmark is more than a false alarm."""
        return self.p_detect() > self.world.p_false


def simulate(world: CliqueWorld, runs: int, seed: int, stream: int = TABLE) -> Stack:
    """Draw runs; a run of a number and seed has the same trajectory, objects and lifetimes in every world of a sensor.

    Raises:
        ConfigError: no place for the objects can be found.
    """
    return stack([simulate_cliques(world, np.random.SeedSequence((seed, stream, r))) for r in range(runs)])


def stack(runs: Sequence[CliqueRun]) -> Stack:
    """Put runs of one world side by side."""
    objects = [len(run.first) for run in runs]
    before = np.cumsum([0, *objects])
    clique = np.concatenate([run.clique + offset for run, offset in zip(runs, before, strict=False)])
    first = np.concatenate([run.first for run in runs])
    expected = np.concatenate([run.expected() for run in runs], axis=1)
    begin = np.searchsorted(clique, np.arange(len(first)))
    seen = np.logical_or.reduceat(expected, begin, axis=1)
    return Stack(
        runs=tuple(runs),
        run=np.repeat(np.arange(len(runs)), objects),
        clique=clique,
        landmark_m=np.concatenate([run.landmark_m for run in runs]),
        first=first,
        survival_steps=np.concatenate([run.survival_steps for run in runs]),
        detected=np.concatenate([run.detected for run in runs], axis=1),
        expected=expected,
        in_view=seen & (np.arange(len(seen))[:, None] >= first),
        range_m=np.concatenate([_range_m(run) for run in runs], axis=1),
    )


def _range_m(run: CliqueRun) -> FloatArray:
    return np.asarray(np.linalg.norm(run.landmark_m[None, :, :] - run.pose_position_m[:, None, :], axis=2))


def miss_rate(stack_: Stack) -> float:
    """Share of misses among the expected landmarks of cliques that are there, from their birth on."""
    there = (stack_.there() & stack_.in_view)[:, stack_.clique] & stack_.expected
    return float(1.0 - stack_.detected[there].mean())
