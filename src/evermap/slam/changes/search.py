"""The search over sets of changes: from a comparison with the map to hypotheses in the order of their gains."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.config import ChangesConfig
from evermap.estimate.sparse.system import Slices
from evermap.geometry import se2
from evermap.slam.changes.evidence import Comparison, WindowEvidence
from evermap.slam.changes.gain import (
    PLACES,
    Tables,
    far_prior,
    gain_of,
    hypothesis_gain,
    log_onset,
    log_prior,
    motion_spread,
    turning_columns,
)
from evermap.slam.kernels import kernel
from evermap.types import BoolArray, FloatArray, IntArray

NEAR = 5.0
"""Hypotheses within this of the best [nats] have their neighbours weighed too, or their own weights would be too large;
"""
MOST_WIDENED = 30
"""so many of them at most."""
MS_OF_CLIMB, MS_OF_CANDIDATE, MS_OF_NUMBER = 0.5, 0.01, 2e-6
"""Milliseconds of a usual core: of a climb, about, of a landmark by itself, and of a pass over a number of a table."""


class Hypotheses(NamedTuple):
    """Hypotheses of the search, the best first.

    Attributes:
        label: (H, L) group of every landmark, 0 = static; groups are numbered by their first member.
        onset: (H, G + 1) window from which on a group has moved; row 0 is not used.
        turns: (H, G + 1) whether a group also turned.
        motion: (H, G, 3 or 6) displacement of each group's centroid [m] and its angle or rotation vector [rad].
        gain: (H,) log posterior odds against 'nothing moved' [nats].
    """

    label: IntArray
    onset: IntArray
    turns: BoolArray
    motion: FloatArray
    gain: FloatArray


def find_changes(
    evidence: WindowEvidence,
    comparison: Comparison,
    position: FloatArray,
    n_windows: int,
    prior: ChangesConfig,
    *,
    start: Hypotheses | None = None,
) -> Slices[Hypotheses]:
    """Return the most probable sets of changes, and all that were weighed on the way, in slices.

    Groups turn about the centroid of mapped positions (L, D), in space with orientations (L, 6) behind them; the first
    hypothesis of `start` is one start of the search.
    """
    numbers = evidence.numbers
    candidates = _candidates(evidence, comparison, len(position), prior, start)
    yield MS_OF_CANDIDATE * len(position)
    quadratic, linear = yield from item_columns(evidence, comparison, position, n_windows, candidates)
    count = len(candidates)
    label, onset = np.zeros(count, np.int64), np.zeros(prior.most_groups + 1, np.int64)
    turns = np.zeros(prior.most_groups + 1, bool)
    if start is not None:
        label[:], onset[:], turns[:] = start.label[0, candidates], start.onset[0], start.turns[0]
    tables = Tables(
        quadratic,
        linear,
        position[candidates, : turning_columns(numbers).shape[1]],
        turning_columns(numbers),
        motion_spread(prior, numbers),
        log_prior(prior, len(np.unique(evidence.landmark)), count, numbers=numbers),
        log_onset(n_windows),
        far_prior(prior),
    )
    weighed = Weighed.nothing(count, prior.most_groups)
    # by the number of members: none, one, more
    may_turn = (prior.p_rotated > 0.0) & np.array([False, numbers == PLACES, True])
    yield from _climb_from_many_starts((label, onset, turns), tables, weighed, may_turn=may_turn)
    near = weighed.ranked
    for k in near[weighed.gain[near] > weighed.best[0] - NEAR][:MOST_WIDENED]:
        _climb(weighed.label[k], weighed.onset[k], weighed.turns[k], may_turn, tables, weighed, False)
        yield MS_OF_CLIMB
    ranked = weighed.ranked
    labels = np.zeros((len(ranked), len(position)), np.int64)
    labels[:, candidates] = weighed.label[ranked]
    onsets, turned = weighed.onset[ranked], weighed.turns[ranked]
    each = zip(weighed.label[ranked], onsets, turned, strict=True)
    motion = np.array([hypothesis_gain(*one, tables)[1] for one in each])
    return Hypotheses(labels, onsets, turned, motion, weighed.gain[ranked])


def _candidates(
    evidence: WindowEvidence, comparison: Comparison, n_landmarks: int, prior: ChangesConfig, start: Hypotheses | None
) -> IntArray:
    """Landmarks that may have moved: in a large map those that would gain most alone, and those already suspected."""
    gain, numbers = np.full(n_landmarks, -np.inf), evidence.numbers
    spread = np.diag(1.0 / motion_spread(prior, numbers)[:numbers] ** 2)
    seen, row = np.unique(evidence.landmark, return_inverse=True)
    # by one motion of all copies of a landmark
    pull = np.zeros((len(seen), numbers))
    np.add.at(pull, row, comparison.pull.reshape(-1, numbers))
    first, second = np.nonzero(row[:, None] == row)
    precision = comparison.precision.reshape(len(row), numbers, len(row), numbers)
    stiff = np.tile(spread, (len(seen), 1, 1))
    np.add.at(stiff, row[first], precision[first, :, second, :])
    gain[seen] = (pull * np.linalg.solve(stiff, pull[:, :, None])[:, :, 0]).sum(axis=1)
    suspected = np.zeros(n_landmarks, bool) if start is None else start.label[0] > 0
    gain[suspected] = np.inf
    order = np.argsort(-gain, kind="stable")[: prior.most_candidates]
    return np.sort(order[gain[order] > -np.inf])


def item_columns(
    evidence: WindowEvidence, comparison: Comparison, position: FloatArray, n_windows: int, candidates: IntArray
) -> Slices[tuple[FloatArray, FloatArray]]:
    """Return `T'AT` and `T'b`: the columns of every item 'this candidate, from this window on'; in slices.

    With one window for all of the session's, the items are 'this candidate, always'.
    """
    rank = np.full(len(position), -1)
    rank[candidates] = np.arange(len(candidates))
    rows = np.flatnonzero(rank[evidence.landmark] >= 0)
    numbers = evidence.numbers
    columns = _columns(position[evidence.landmark[rows]], numbers)
    both = se2.xy_rows(rows, numbers)
    precision = comparison.precision[np.ix_(both, both)].reshape(len(rows), numbers, len(rows), numbers)
    # what a copy says is said by every item that begins in its window or before: sums from the last window backwards
    width = columns.shape[2]
    size = (n_windows, len(candidates), width)
    window, column = np.minimum(evidence.window[rows], n_windows - 1), rank[evidence.landmark[rows]]
    item = window * len(candidates) + column
    linear = np.zeros((n_windows * len(candidates), width))
    np.add.at(linear, item, np.einsum("rka,rk->ra", columns, comparison.pull[both].reshape(-1, numbers)))
    linear = np.cumsum(linear.reshape(size)[::-1], axis=0)[::-1]
    half = np.einsum("rkqm,qmb->rkqb", precision, columns)
    blocks = np.einsum("rka,rkqb->raqb", columns, half)
    yield MS_OF_NUMBER * blocks.size
    quadratic = np.zeros((n_windows * len(candidates), width, n_windows * len(candidates), width))
    if len(np.unique(item)) == len(item):
        quadratic[item[:, None], :, item[None, :], :] = blocks.transpose(0, 2, 1, 3)
    else:
        np.add.at(quadratic.transpose(0, 2, 1, 3), (item[:, None], item[None, :]), blocks.transpose(0, 2, 1, 3))
    yield MS_OF_NUMBER * (blocks.size + quadratic.size)
    quadratic = quadratic.reshape(*size, *size)
    for later in range(n_windows - 1, 0, -1):
        quadratic[later - 1] += quadratic[later]
    yield MS_OF_NUMBER * quadratic.size
    for later in range(n_windows - 1, 0, -1):
        quadratic[:, :, :, later - 1] += quadratic[:, :, :, later]
    yield MS_OF_NUMBER * quadratic.size
    return quadratic.reshape(linear.size, linear.size), linear.ravel()


def _columns(position: FloatArray, numbers: int) -> FloatArray:
    """Return (R, numbers, D + T) by how much each column of a motion displaces copies at positions (R, D at least).

    The copies are the last axis in memory, along which they are summed.
    """
    turning = turning_columns(numbers)
    point_dim = turning.shape[1]
    columns = np.zeros((numbers, point_dim + len(turning), len(position)))
    columns[np.arange(point_dim), np.arange(point_dim)] = 1.0
    for t, a, c in np.argwhere(turning):
        columns[a, point_dim + t] = turning[t, a, c] * position[:, c]
    if numbers > point_dim:  # an orientation turns by the rotation vector
        columns[point_dim + np.arange(point_dim), -point_dim + np.arange(point_dim)] = 1.0
    return columns.transpose(2, 0, 1)


WORTH_KEEPING = 25.0
"""Hypotheses that are further below the best [nats] weigh nothing."""
MOST_KEPT = 20_000
SLOTS = 1 << 17
"""Room of the tables."""


class Weighed(NamedTuple):
    """All hypotheses evaluated so far: a hash table of gains, and the best ones row by row.

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
        """Return the state before the search."""
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
        return np.asarray(worth[np.argsort(-gain[worth], kind="stable")])


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
    """Return the gain of a hypothesis, after renumbering its groups in place; it is cached."""
    _compact(label, onset, turns)
    key = _hash(label, onset, turns)
    slot = (key ^ (key >> 32)) & (SLOTS - 1)
    while weighed.key[slot] != 0:
        if weighed.key[slot] == key:
            return float(weighed.value[slot])
        slot = (slot + 1) & (SLOTS - 1)
    gain = gain_of(label, onset, turns, tables)
    if 2 * weighed.used[1] < SLOTS:
        weighed.key[slot] = key
        weighed.value[slot] = gain
        weighed.used[1] += 1
    weighed.best[0] = max(weighed.best[0], gain)
    row = weighed.used[0]
    if gain > weighed.best[0] - WORTH_KEEPING and row < len(weighed.gain):
        _copy(label, onset, turns, weighed.label[row], weighed.onset[row], weighed.turns[row])
        weighed.gain[row] = gain
        weighed.used[0] += 1
    return gain


@kernel
def _copy(label: IntArray, onset: IntArray, turns: Any, to_label: IntArray, to_onset: IntArray, to_turns: Any) -> None:
    """Copy a hypothesis; assigning whole arrays compiles for longer, for the message of shapes that do not fit."""
    for i in range(len(label)):
        to_label[i] = label[i]
    for g in range(len(onset)):
        to_onset[g], to_turns[g] = onset[g], turns[g]


@kernel
def _climb(
    label: IntArray, onset: IntArray, turns: Any, may_turn: Any, tables: Tables, weighed: Weighed, uphill: bool
) -> float:
    """Climb from a start to a local optimum, in place, and return its gain; or evaluate all neighbours of the start."""
    n_windows = len(tables.log_onset)
    trial, trial_onset, trial_turns = label.copy(), onset.copy(), turns.copy()
    best = _weigh(label, onset, turns, tables, weighed) if uphill else np.inf
    improved, used = True, label.max()
    while improved:
        improved = False
        for move in range(_count_moves(len(label), len(onset) - 1, n_windows)):
            if used + 1 < move // len(label) < len(onset):  # to begin one empty group is to begin any
                continue
            _copy(label, onset, turns, trial, trial_onset, trial_turns)
            if not _apply(trial, trial_onset, trial_turns, move, n_windows, may_turn):
                continue
            gain = _weigh(trial, trial_onset, trial_turns, tables, weighed)
            if gain > best + 1e-9:
                best = gain
                _copy(trial, trial_onset, trial_turns, label, onset, turns)
                improved, used = True, label.max()
    return best


@kernel
def _count_moves(count: int, groups: int, n_windows: int) -> int:
    relabels, merges = count * (groups + 1), 2 * groups * groups
    parts = count if n_windows > 1 else 0  # else what leaves a group begins one at the same time anyway
    return relabels + merges + groups + groups + groups * n_windows + groups + parts


@kernel
def _size(label: IntArray, group: int) -> int:
    size = 0
    for i in range(len(label)):
        if label[i] == group:
            size += 1
    return size


@kernel
def _apply(label: IntArray, onset: IntArray, turns: Any, move: int, n_windows: int, may_turn: Any) -> bool:
    """Move number `move` in place; False where it changes nothing."""
    count, groups = len(label), len(onset) - 1
    if move < count * (groups + 1):
        i, g = move % count, move // count
        left = label[i]
        if left == g:
            return False
        label[i] = g
        turns[left] = turns[left] and may_turn[min(_size(label, left), 2)]  # who is left alone, if that shows
        return True
    move -= count * (groups + 1)
    if move < 2 * groups * groups:
        # two that turned together are no one group that only moved, so merging and turning is one step
        turn, pair = move // (groups * groups), move % (groups * groups)
        g, h = 1 + pair // groups, 1 + pair % groups
        if g == h or _size(label, g) == 0 or _size(label, h) == 0 or (turn and (turns[g] or not may_turn[2])):
            return False
        for i in range(count):
            if label[i] == h:
                label[i] = g
        turns[g] = turns[g] or turn
        return True
    move -= 2 * groups * groups
    if move < groups:
        if _size(label, move + 1) == 0:
            return False
        for i in range(count):
            if label[i] == move + 1:
                label[i] = 0
        return True
    move -= groups
    if move < groups:
        g = move + 1
        if _size(label, g) == 0:
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
        if onset[g] == window or _size(label, g) == 0:
            return False
        onset[g] = window
        return True
    move -= groups * n_windows
    if move < groups:
        g = move + 1
        if _size(label, g) == 0 or not may_turn[min(_size(label, g), 2)]:
            return False
        turns[g] = not turns[g]
        return True
    return _part(label, onset, turns, move - groups, may_turn)


@kernel
def _part(label: IntArray, onset: IntArray, turns: Any, landmark: int, may_turn: Any) -> bool:
    """Let a landmark leave its group and move by itself, at the same time, in place; False where it is in none.

    A group that was joined by mistake explains much at its time, so that neither standing still nor moving since before
    the session is a way out of it.
    """
    group = label[landmark]
    if group == 0 or _size(label, group) < 2:
        return False
    for free in range(1, len(onset)):
        if _size(label, free) == 0:
            label[landmark], onset[free] = free, onset[group]
            turns[free] = turns[group] and may_turn[1]
            turns[group] = turns[group] and may_turn[min(_size(label, group), 2)]
            return True
    return False


@kernel
def _add_best_pair(
    landmark: int, group: int, may_turn: Any, tables: Tables, label: IntArray, onset: IntArray, turns: Any
) -> None:
    """Add a group of a static landmark and its best static partner, at the best time, in place.

    What moved with others may lose by moving alone, whenever that was; and what turned has no displacement in common.
    """
    n_windows = len(tables.log_onset)
    best, partner, window, turning = -np.inf, landmark, 0, False
    for attempt in range(n_windows + (1 if may_turn[2] else 0)):
        turns[group] = attempt == n_windows  # last, at the time that was best without
        onset[group] = window if turns[group] else attempt
        for other in range(len(label)):
            if label[other] > 0 or (turns[group] and other == landmark and not may_turn[1]):
                continue
            label[landmark] = group
            label[other] = group
            gain = gain_of(label, onset, turns, tables)
            label[landmark] = 0
            label[other] = 0
            if gain > best:
                best, partner, window, turning = gain, other, onset[group], turns[group]
    label[landmark] = group
    label[partner] = group
    onset[group] = window
    turns[group] = turning


def _climb_from_many_starts(
    start: tuple[IntArray, IntArray, BoolArray], tables: Tables, weighed: Weighed, *, may_turn: BoolArray
) -> Slices[None]:
    """Climb from a start, from the best pair of every landmark, and from the best so far with each landmark changed.

    A static landmark changes by moving on its own, and by moving with the one that goes with it best. Not
    compiled: the machine code of a climb would be made again within it.
    """
    label, onset, turns = start
    count, groups = len(label), len(onset) - 1
    best_gain = _climb(label, onset, turns, may_turn, tables, weighed, True)
    yield MS_OF_CLIMB
    best = label.copy(), onset.copy(), turns.copy()
    for attempt in range(3 * count):
        landmark = attempt % count
        label[:], onset[:], turns[:] = (0, 0, False) if attempt < count else best
        free = int(label.max()) + 1
        if count <= attempt < 2 * count and free == 1:  # as if nothing had moved: as before
            continue
        if attempt >= 2 * count and label[landmark] > 0:
            label[landmark] = 0
        elif label[landmark] > 0 or free > groups:
            continue
        elif attempt >= 2 * count:
            label[landmark] = free
        else:
            _add_best_pair(landmark, free, may_turn, tables, label, onset, turns)
        gain = _climb(label, onset, turns, may_turn, tables, weighed, True)
        yield MS_OF_CLIMB
        if gain > best_gain:
            best, best_gain = (label.copy(), onset.copy(), turns.copy()), gain
