"""Hill climbing over sets of changes, compiled.

Adding groups one after another does not work when several things moved: the first group then explains a part of the
second. So a hypothesis changes as a whole, from many starts: a landmark joins another group, a new one or the static
ones, two groups merge, a group is dropped or changes places with the static ones, its time or its turning changes.
Climbs meet the same hypotheses again and again, so what was weighed is remembered.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.slam.changes.gain import hypothesis_gain
from evermap.slam.kernels import kernel
from evermap.types import BoolArray, FloatArray, IntArray

WORTH_KEEPING = 25.0
"""Hypotheses that are further below the best [nats] weigh nothing."""
MOST_KEPT = 20_000
SLOTS = 1 << 17


class Tables(NamedTuple):
    """What the gain is computed from: the arguments of `hypothesis_gain` behind the hypothesis."""

    quadratic: FloatArray
    linear: FloatArray
    position: FloatArray
    spread: FloatArray
    log_prior: FloatArray
    log_onset: FloatArray


class Weighed(NamedTuple):
    """All hypotheses weighed so far: a hash table of gains, and those that were worth keeping row by row.

    Attributes:
        key, value: (SLOTS,) hash of a hypothesis, 0 where the slot is free, and its gain.
        label, onset, turns, gain: (MOST_KEPT, ...) hypotheses as in `hypothesis_gain`, groups numbered by their first
            member.
        used: (2,) rows kept and slots taken.
        best: (1,) largest gain.
    """

    key: IntArray
    value: FloatArray
    label: IntArray
    onset: IntArray
    turns: BoolArray
    gain: FloatArray
    used: IntArray
    best: FloatArray

    @classmethod
    def nothing(cls, landmarks: int, groups: int) -> Weighed:
        """Before the search."""
        return cls(
            np.zeros(SLOTS, np.int64),
            np.zeros(SLOTS),
            np.zeros((MOST_KEPT, landmarks), np.int64),
            np.zeros((MOST_KEPT, groups + 1), np.int64),
            np.zeros((MOST_KEPT, groups + 1), np.bool_),
            np.zeros(MOST_KEPT),
            np.zeros(2, np.int64),
            np.full(1, -np.inf),
        )

    @property
    def ranked(self) -> IntArray:
        """Rows that weigh something, the best first."""
        gain = self.gain[: self.used[0]]
        worth = np.flatnonzero(gain > self.best[0] - WORTH_KEEPING)
        order: IntArray = worth[np.argsort(-gain[worth], kind="stable")]
        return order


@kernel
def _compact(label: IntArray, onset: IntArray, turns: Any) -> None:
    """Number the groups by their first member, in place."""
    groups = len(onset) - 1
    new = np.zeros(groups + 1, dtype=np.int64)
    used = 0
    for i in range(len(label)):
        g = label[i]
        if g > 0 and new[g] == 0:
            used += 1
            new[g] = used
    old_onset, old_turns = onset.copy(), turns.copy()
    onset[:] = 0
    turns[:] = False
    for g in range(1, groups + 1):
        if new[g] > 0:
            onset[new[g]] = old_onset[g]
            turns[new[g]] = old_turns[g]
    for i in range(len(label)):
        label[i] = new[label[i]]


@kernel
def _gain(label: IntArray, onset: IntArray, turns: Any, tables: Tables) -> float:
    gain, _ = hypothesis_gain(
        label,
        onset,
        turns,
        tables.quadratic,
        tables.linear,
        tables.position,
        tables.spread,
        tables.log_prior,
        tables.log_onset,
    )
    return gain


@kernel
def _hash(label: IntArray, onset: IntArray, turns: Any) -> int:
    """FNV-1a over the numbers that make a hypothesis; never 0."""
    key = 1469598103934665603
    for i in range(len(label)):
        key = (key ^ label[i]) * 1099511628211
    for g in range(len(onset)):
        key = (key ^ (2 * onset[g] + (1 if turns[g] else 0))) * 1099511628211
    return key if key != 0 else 1


@kernel
def _weigh(label: IntArray, onset: IntArray, turns: Any, tables: Tables, weighed: Weighed) -> float:
    """Gain of a hypothesis, whose groups are numbered anew in place; remembered."""
    _compact(label, onset, turns)
    key = _hash(label, onset, turns)
    slot = (key ^ (key >> 32)) & (SLOTS - 1)
    while weighed.key[slot] != 0:
        if weighed.key[slot] == key:
            return float(weighed.value[slot])
        slot = (slot + 1) & (SLOTS - 1)
    gain = _gain(label, onset, turns, tables)
    if 2 * weighed.used[1] < SLOTS:
        weighed.key[slot] = key
        weighed.value[slot] = gain
        weighed.used[1] += 1
    weighed.best[0] = max(weighed.best[0], gain)
    row = weighed.used[0]
    if gain > weighed.best[0] - WORTH_KEEPING and row < len(weighed.gain):
        weighed.label[row] = label
        weighed.onset[row] = onset
        weighed.turns[row] = turns
        weighed.gain[row] = gain
        weighed.used[0] += 1
    return gain


@kernel
def _climb(label: IntArray, onset: IntArray, turns: Any, may_turn: bool, tables: Tables, weighed: Weighed) -> float:
    """From one start uphill to a local optimum, in place; its gain."""
    n_windows = len(tables.log_onset)
    trial, trial_onset, trial_turns = label.copy(), onset.copy(), turns.copy()
    best = _weigh(label, onset, turns, tables, weighed)
    improved = True
    while improved:
        improved = False
        for move in range(_count_moves(len(label), len(onset) - 1, n_windows)):
            trial[:] = label
            trial_onset[:] = onset
            trial_turns[:] = turns
            if not _apply(trial, trial_onset, trial_turns, move, n_windows, may_turn):
                continue
            gain = _weigh(trial, trial_onset, trial_turns, tables, weighed)
            if gain > best + 1e-9:
                best = gain
                label[:] = trial
                onset[:] = trial_onset
                turns[:] = trial_turns
                improved = True
    return best


@kernel
def _count_moves(count: int, groups: int, n_windows: int) -> int:
    relabels, merges = count * (groups + 1), 2 * groups * groups
    return relabels + merges + groups + groups + groups * n_windows + groups


@kernel
def _apply(label: IntArray, onset: IntArray, turns: Any, move: int, n_windows: int, may_turn: bool) -> bool:
    """Move number `move` in place; False where it changes nothing."""
    count, groups = len(label), len(onset) - 1
    if move < count * (groups + 1):
        i, g = move % count, move // count
        if label[i] == g:
            return False
        label[i] = g
        return True
    move -= count * (groups + 1)
    if move < 2 * groups * groups:
        # two that turned together are no one group that only moved, so merging and turning is one step
        turn, pair = move // (groups * groups), move % (groups * groups)
        g, h = 1 + pair // groups, 1 + pair % groups
        if g == h or not np.any(label == g) or not np.any(label == h) or (turn and (turns[g] or not may_turn)):
            return False
        label[label == h] = g
        turns[g] = turns[g] or turn
        return True
    move -= 2 * groups * groups
    if move < groups:
        if not np.any(label == move + 1):
            return False
        label[label == move + 1] = 0
        return True
    move -= groups
    if move < groups:
        g = move + 1
        if not np.any(label == g):
            return False
        for i in range(count):
            if label[i] == g:
                label[i] = 0
            elif label[i] == 0:
                label[i] = g
        return True
    move -= groups
    if move < groups * n_windows:
        g, window = 1 + move // n_windows, move % n_windows
        if onset[g] == window or not np.any(label == g):
            return False
        onset[g] = window
        return True
    g = move - groups * n_windows + 1
    if not may_turn or np.sum(label == g) < 2:
        return False
    turns[g] = not turns[g]
    return True


@kernel
def _add_best_pair(
    landmark: int, group: int, may_turn: bool, tables: Tables, label: IntArray, onset: IntArray, turns: Any
) -> None:
    """A new group of a static landmark and the static one that goes with it best, at the best time, in place.

    What moved with others may lose by moving alone, whenever that was; and what turned has no displacement in common.
    """
    n_windows = len(tables.log_onset)
    best, partner, window, turning = -np.inf, landmark, 0, False
    for attempt in range(n_windows + (1 if may_turn else 0)):
        turns[group] = attempt == n_windows  # last, at the time that was best without
        onset[group] = window if turns[group] else attempt
        for other in range(len(label)):
            if label[other] > 0 or (turns[group] and other == landmark):
                continue
            label[landmark] = group
            label[other] = group
            gain = _gain(label, onset, turns, tables)
            label[landmark] = 0
            label[other] = 0
            if gain > best:
                best, partner, window, turning = gain, other, onset[group], turns[group]
    label[landmark] = group
    label[partner] = group
    onset[group] = window
    turns[group] = turning


@kernel
def climb_from_many_starts(
    may_turn: bool, tables: Tables, label: IntArray, onset: IntArray, turns: Any, weighed: Weighed
) -> None:
    """Climb from `label`, from the best pair of every landmark, and from the best so far with each landmark changed.

    A static landmark changes by moving on its own, and by moving with the one that goes with it best.
    """
    count, groups = len(label), len(onset) - 1
    best_gain = _climb(label, onset, turns, may_turn, tables, weighed)
    best, best_onset, best_turns = label.copy(), onset.copy(), turns.copy()
    for start in range(3 * count):
        landmark = start % count
        if start < count:
            label[:] = 0
            onset[:] = 0
            turns[:] = False
        else:
            label[:] = best
            onset[:] = best_onset
            turns[:] = best_turns
        free = int(np.max(label)) + 1
        if start >= 2 * count and label[landmark] > 0:
            label[landmark] = 0
        elif label[landmark] > 0 or free > groups:
            continue
        elif start >= 2 * count:
            label[landmark] = free
        else:
            _add_best_pair(landmark, free, may_turn, tables, label, onset, turns)
        gain = _climb(label, onset, turns, may_turn, tables, weighed)
        if gain > best_gain:
            best[:] = label
            best_onset[:] = onset
            best_turns[:] = turns
            best_gain = gain


@kernel
def weigh_neighbours(
    label: IntArray, onset: IntArray, turns: Any, may_turn: bool, tables: Tables, weighed: Weighed
) -> None:
    """All that one move makes of a hypothesis is weighed."""
    n_windows = len(tables.log_onset)
    trial, trial_onset, trial_turns = label.copy(), onset.copy(), turns.copy()
    for move in range(_count_moves(len(label), len(onset) - 1, n_windows)):
        trial[:] = label
        trial_onset[:] = onset
        trial_turns[:] = turns
        if _apply(trial, trial_onset, trial_turns, move, n_windows, may_turn):
            _weigh(trial, trial_onset, trial_turns, tables, weighed)
