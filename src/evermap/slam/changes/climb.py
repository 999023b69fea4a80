"""Hill climbing over sets of changes, compiled.

Adding groups one after another does not work when several things moved: the first group then explains a part of the
second. So a hypothesis changes as a whole, from many starts: a landmark joins another group, a new one or the static
ones, two groups merge, a group is dropped or changes places with the static ones, its time or its turning changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from evermap.slam.changes.gain import hypothesis_gain
from evermap.slam.kernels import kernel
from evermap.types import FloatArray, IntArray

WORTH_KEEPING = 25.0
"""Hypotheses that are further below the best [nats] weigh nothing."""


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
def _climb(
    label: IntArray,
    onset: IntArray,
    turns: Any,
    may_turn: bool,
    quadratic: FloatArray,
    linear: FloatArray,
    position: FloatArray,
    spread: FloatArray,
    log_prior: FloatArray,
    log_onset: FloatArray,
    kept_label: IntArray,
    kept_onset: IntArray,
    kept_turns: Any,
    kept_gain: FloatArray,
    kept: int,
) -> int:
    """From one start uphill to a local optimum, in place; all that was weighed is appended to `kept_*`."""
    count, groups, n_windows = len(label), len(onset) - 1, len(log_onset)
    trial, trial_onset, trial_turns = label.copy(), onset.copy(), turns.copy()
    best, _ = hypothesis_gain(label, onset, turns, quadratic, linear, position, spread, log_prior, log_onset)
    kept = _keep(label, onset, turns, best, kept_label, kept_onset, kept_turns, kept_gain, kept)
    relabels = count * (groups + 1)
    merges = groups * groups
    moves = relabels + merges + groups + groups + groups * n_windows + groups
    improved = True
    while improved:
        improved = False
        for move in range(moves):
            trial[:] = label
            trial_onset[:] = onset
            trial_turns[:] = turns
            if not _apply(trial, trial_onset, trial_turns, move, n_windows, may_turn):
                continue
            gain, _ = hypothesis_gain(
                trial, trial_onset, trial_turns, quadratic, linear, position, spread, log_prior, log_onset
            )
            kept = _keep(trial, trial_onset, trial_turns, gain, kept_label, kept_onset, kept_turns, kept_gain, kept)
            if gain > best + 1e-9:
                best = gain
                label[:] = trial
                onset[:] = trial_onset
                turns[:] = trial_turns
                improved = True
    _compact(label, onset, turns)
    return kept


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
    if move < groups * groups:
        g, h = 1 + move // groups, 1 + move % groups
        if g == h or not np.any(label == g) or not np.any(label == h):
            return False
        label[label == h] = g
        return True
    move -= groups * groups
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
def _keep(
    label: IntArray,
    onset: IntArray,
    turns: Any,
    gain: float,
    kept_label: IntArray,
    kept_onset: IntArray,
    kept_turns: Any,
    kept_gain: FloatArray,
    kept: int,
) -> int:
    """Write a hypothesis into the next row; the last row remembers the best gain so far."""
    last = len(kept_gain) - 1
    kept_gain[last] = max(kept_gain[last], gain)
    if gain < kept_gain[last] - WORTH_KEEPING or kept >= last:
        return kept
    kept_label[kept] = label
    kept_onset[kept] = onset
    kept_turns[kept] = turns
    _compact(kept_label[kept], kept_onset[kept], kept_turns[kept])
    kept_gain[kept] = gain
    return kept + 1


@kernel
def _best_pair(
    landmark: int,
    quadratic: FloatArray,
    linear: FloatArray,
    position: FloatArray,
    spread: FloatArray,
    log_prior: FloatArray,
    log_onset: FloatArray,
    label: IntArray,
    onset: IntArray,
    turns: Any,
) -> None:
    """One group of a landmark and the one that goes with it best, at the best time, into `label`, `onset`, `turns`.

    What moved with others may lose by moving alone, whenever that was.
    """
    best, partner, window = -np.inf, landmark, 0
    turns[:] = False
    for w in range(len(log_onset)):
        onset[:] = w
        for other in range(len(label)):
            label[:] = 0
            label[landmark] = 1
            label[other] = 1
            gain, _ = hypothesis_gain(label, onset, turns, quadratic, linear, position, spread, log_prior, log_onset)
            if gain > best:
                best, partner, window = gain, other, w
    label[:] = 0
    label[landmark] = 1
    label[partner] = 1
    onset[:] = 0
    onset[1] = window


@kernel
def climb_from_many_starts(
    may_turn: bool,
    quadratic: FloatArray,
    linear: FloatArray,
    position: FloatArray,
    spread: FloatArray,
    log_prior: FloatArray,
    log_onset: FloatArray,
    label: IntArray,
    onset: IntArray,
    turns: Any,
    kept_label: IntArray,
    kept_onset: IntArray,
    kept_turns: Any,
    kept_gain: FloatArray,
) -> int:
    """Climb from `label`, from the best pair of every landmark, and from the best so far with each landmark changed."""
    count, groups = len(label), len(onset) - 1
    last = len(kept_gain) - 1
    kept = 0
    kept = _climb(
        label, onset, turns, may_turn, quadratic, linear, position, spread, log_prior, log_onset,
        kept_label, kept_onset, kept_turns, kept_gain, kept,
    )  # fmt: skip
    best, best_onset, best_turns, best_gain = label.copy(), onset.copy(), turns.copy(), kept_gain[last]
    for start in range(3 * count):
        landmark = start % count
        if start < count:
            _best_pair(landmark, quadratic, linear, position, spread, log_prior, log_onset, label, onset, turns)
        else:
            label[:] = best
            onset[:] = best_onset
            turns[:] = best_turns
            _compact(label, onset, turns)
            free = np.max(label) + 1
            if start < 2 * count:
                if free > groups:
                    continue
                label[landmark] = free
            else:
                if label[landmark] == 0:
                    continue
                label[landmark] = 0
        kept = _climb(
            label, onset, turns, may_turn, quadratic, linear, position, spread, log_prior, log_onset,
            kept_label, kept_onset, kept_turns, kept_gain, kept,
        )  # fmt: skip
        gain, _ = hypothesis_gain(label, onset, turns, quadratic, linear, position, spread, log_prior, log_onset)
        if gain > best_gain:
            best[:] = label
            best_onset[:] = onset
            best_turns[:] = turns
            best_gain = gain
    return kept
