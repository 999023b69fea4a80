"""The run-length filter, compiled: hypotheses about when the present stay, or the present absence, began.

A feature's belief is `start[s, j]`, `weight[s, j]` for `j < count[s]`: with this probability it has been in state `s`
(0 absent, 1 present) since this instant. They are in order of `start`. One step multiplies each by the conditional
survival of its age and gives the rest to one new hypothesis of the other state, begun in the middle of the step
(Adams and MacKay 2007, for two alternating lifetimes). When a list is full, the two neighbours whose union changes the
belief least become one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange

from evermap.existence.elementary import exp, expm1, inlined, kernel, parallel_kernel
from evermap.existence.hazard_table import SHIFT
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S
from evermap.types import FloatArray, IntArray

MOST = 700.0
"""Integrated hazard that nobody survives."""
NO_MERGE = -1
AS_THEY_ARE = (1.0, 1.0)
_POSITION = 0xFFFFF
_HIGHEST = 0x7FFFFFFFFFFFFFFF


class Law(NamedTuple):
    """All that the kernels know of a model.

    Attributes:
        step_s: longest step of time.
        factor: (2, 1008) by what the hazards of absences (0) and stays (1) are multiplied at each ten minutes of the
            week; (2, 1) ones where there is no rhythm.
        offset: of the bins of age (`hazard_table`).
        hazard_hz: (2, B) hazard in each bin.
        intercept: (2, B) the hazard integrated up to an age `a` in bin `i` is `intercept[i] + hazard_hz[i] a`.
    """

    step_s: float
    factor: FloatArray
    offset: int
    hazard_hz: FloatArray
    intercept: FloatArray


class First(NamedTuple):
    """Beliefs before anything is known, for each ten minutes of the week, or for all of it.

    Attributes:
        age_s: (W, 2, S) how long it has been so.
        weight: (W, 2, S) with which probability.
        number: (W, 2) number of hypotheses.
    """

    age_s: FloatArray
    weight: FloatArray
    number: IntArray


@inlined
def age_bin(age_s: Any, law: Any) -> Any:
    """The bin of an age."""
    return min(max((np.float64(age_s).view(np.int64) >> SHIFT) - law.offset, 0), law.hazard_hz.shape[1] - 1)


@inlined
def _integrated(age: Any, later: Any, s: Any, law: Any) -> Any:
    """Integral of the hazard of state `s` between two ages."""
    i, j = age_bin(age, law), age_bin(later, law)
    levels = law.intercept[s, j] - law.intercept[s, i]
    return max(levels + (law.hazard_hz[s, j] * later - law.hazard_hz[s, i] * age), 0.0)


@inlined
def _sum(values: Any, s: Any, n: Any) -> Any:
    """Sum of the first `n` of row `s`: eight sums side by side, which a compiler may not make of one."""
    a = b = c = d = e = f = g = h = 0.0
    whole = n & ~7
    for j in range(0, whole, 8):
        a += values[s, j]
        b += values[s, j + 1]
        c += values[s, j + 2]
        d += values[s, j + 3]
        e += values[s, j + 4]
        f += values[s, j + 5]
        g += values[s, j + 6]
        h += values[s, j + 7]
    for j in range(whole, n):
        a += values[s, j]
    return ((a + b) + (c + d)) + ((e + f) + (g + h))


@inlined
def _week_bin(stamp_s: Any, n: Any) -> Any:
    """The ten minutes of the week; 0 where there is no rhythm."""
    if n == 1:
        return 0
    phase = (stamp_s - MONDAY_S) % WEEK_S
    return min(np.int64(phase / BIN_S), BINS - 1)


@inlined
def _hazards(start: Any, n: Any, s: Any, now: Any, later: Any, factor: Any, law: Any, hazard: Any) -> None:
    """Integrated hazard of every hypothesis of state `s` between two instants, into `hazard[s]`.

    A loop of its own: one that looks up a table keeps a compiler from using vectors for the exponentials.
    """
    for j in range(n):
        hazard[s, j] = min(factor * _integrated(now - start[s, j], later - start[s, j], s, law), MOST)


@inlined
def _cheapest(start: Any, weight: Any, n: Any, s: Any, now: Any) -> Any:
    """Position of the neighbours that differ least: product of shares times squared relative difference of age.

    Positive numbers are ordered as their bits are; the last bits of a cost give way to its position, so that the
    least cost brings it along.
    """
    best = np.int64(_HIGHEST)
    for j in range(n - 1):
        a, b = weight[s, j], weight[s, j + 1]
        apart = start[s, j + 1] - start[s, j]
        ages = (now - start[s, j]) * (now - start[s, j + 1])
        cost = (a * b) * (apart * apart) / ((a + b + 1e-300) * ages + 1e-300)
        best = min(best, (np.float64(cost).view(np.int64) & ~_POSITION) | j)
    return best & _POSITION


@kernel
def _merge(start: FloatArray, weight: FloatArray, n: int, s: int, now: float) -> tuple[int, float]:
    """Unite the two cheapest neighbours; position of the first of them, and the mass of the lighter."""
    best = _cheapest(start, weight, n, s, now)
    a, b = weight[s, best], weight[s, best + 1]
    share = b / (a + b) if a + b > 0.0 else 0.5
    start[s, best] += share * (start[s, best + 1] - start[s, best])
    weight[s, best] = a + b
    for j in range(best + 1, n - 1):
        start[s, j] = start[s, j + 1]
    for j in range(best + 1, n - 1):
        weight[s, j] = weight[s, j + 1]
    return best, min(a, b)


@kernel
def _step(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now: float,
    later: float,
    law: Law,
    scale: tuple[float, float],
    scratch: FloatArray,
    merged: IntArray,
) -> float:
    """One step without a look; where lists were merged goes into `merged`. Returns the mass merged.

    Hazards are those of the law times `scale`.
    """
    middle = 0.5 * (now + later)
    week = _week_bin(middle, law.factor.shape[1])
    for s in range(2):
        _hazards(start, count[s], s, now, later, scale[s] * law.factor[s, week], law, scratch)
        for j in range(count[s]):
            x, mass = scratch[s, j], weight[s, j]
            scratch[s, j] = -mass * expm1(-x)
            weight[s, j] = mass * exp(-x) if x < MOST else 0.0
    ended = (_sum(scratch, 0, count[0]), _sum(scratch, 1, count[1]))
    moved = 0.0
    for s in range(2):
        n = count[s]
        start[s, n] = middle
        weight[s, n] = ended[1 - s]
        merged[s] = NO_MERGE
        n += 1
        if n == start.shape[1]:
            merged[s], mass = _merge(start, weight, n, s, later)
            moved += mass
            n -= 1
        count[s] = n
    return moved


@kernel
def _look(weight: FloatArray, count: IntArray, absent: float, present: float) -> float:
    """Multiply by the likelihoods of a look and normalise; returns the probability of the look.

    A state that the look rules out keeps no hypotheses.
    """
    mass = (absent * _sum(weight, 0, count[0]), present * _sum(weight, 1, count[1]))
    total: float = mass[0] + mass[1]
    for s in range(2):
        if mass[s] == 0.0:
            count[s] = 0
        scale = (present if s == 1 else absent) / total
        for j in range(count[s]):
            weight[s, j] *= scale
    return total


@kernel
def _present(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now: float,
    later: float,
    law: Law,
    scratch: FloatArray,
) -> float:
    """Probability of presence at `later`, at most a step after `now`."""
    week = _week_bin(0.5 * (now + later), law.factor.shape[1])
    for s in range(2):
        _hazards(start, count[s], s, now, later, law.factor[s, week], law, scratch)
        for j in range(count[s]):
            scratch[s, j] = -weight[s, j] * expm1(-scratch[s, j])
    absent, there = _sum(weight, 0, count[0]), _sum(weight, 1, count[1])
    present = there - _sum(scratch, 1, count[1]) + _sum(scratch, 0, count[0])
    share: float = present / (absent + there)
    return min(max(share, 0.0), 1.0)


@kernel
def advance(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now: float,
    until: float,
    law: Law,
    scratch: FloatArray,
    merged: IntArray,
    whole: bool,
) -> tuple[float, float]:
    """Whole steps from `now` on as long as they end before `until`, and the rest of the way unless `whole`.

    Returns:
        The time reached, and the mass merged.
    """
    moved = 0.0
    while until - now > law.step_s:
        moved += _step(start, weight, count, now, now + law.step_s, law, AS_THEY_ARE, scratch, merged)
        now += law.step_s
    if not whole and until > now:
        moved += _step(start, weight, count, now, until, law, AS_THEY_ARE, scratch, merged)
        now = until
    return now, moved


@kernel
def begin(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    stamp_s: float,
    prior: First,
) -> None:
    """The belief before anything is known: ages and weights for this time of the week."""
    week = _week_bin(stamp_s, len(prior.number))
    for s in range(2):
        count[s] = prior.number[week, s]
        for j in range(count[s]):
            start[s, j] = stamp_s - prior.age_s[week, s, j]
            weight[s, j] = prior.weight[week, s, j]


@kernel
def begin_rows(start: FloatArray, weight: FloatArray, count: IntArray, stamp_s: FloatArray, prior: First) -> None:
    """`begin` for every row."""
    for f in range(len(stamp_s)):
        begin(start[f], weight[f], count[f], stamp_s[f], prior)


@kernel
def _track_one(
    stamp_s: FloatArray,
    absent: FloatArray,
    present: FloatArray,
    asked_s: FloatArray,
    slots: int,
    law: Law,
    prior: First,
    answer: FloatArray,
) -> tuple[float, float, int]:
    """All looks at one feature and all instants asked for; log evidence, mass merged, impossible look or -1."""
    start, weight = np.zeros((2, slots)), np.zeros((2, slots))
    count, merged = np.zeros(2, dtype=np.int64), np.zeros(2, dtype=np.int64)
    scratch = np.zeros((2, slots))
    evidence, moved = 0.0, 0.0
    m, n = stamp_s.size, asked_s.size
    if m + n == 0:
        return evidence, moved, -1
    now = stamp_s[0] if m else asked_s[0]
    if n and asked_s[0] < now:
        now = asked_s[0]
    begin(start, weight, count, now, prior)
    k = 0
    for i in range(m + 1):
        while k < n and (i == m or asked_s[k] < stamp_s[i]):
            now, mass = advance(start, weight, count, now, asked_s[k], law, scratch, merged, True)
            moved += mass
            answer[k] = _present(start, weight, count, now, asked_s[k], law, scratch)
            k += 1
        if i < m:
            now, mass = advance(start, weight, count, now, stamp_s[i], law, scratch, merged, False)
            moved += mass
            likelihood = _look(weight, count, absent[i], present[i])
            if not likelihood > 0.0:
                return evidence, moved, i
            evidence += np.log(likelihood)
    return evidence, moved, -1


@parallel_kernel
def track(
    first: IntArray,
    stamp_s: FloatArray,
    absent: FloatArray,
    present: FloatArray,
    first_asked: IntArray,
    asked_s: FloatArray,
    slots: int,
    law: Law,
    prior: First,
    answer: FloatArray,
    evidence: FloatArray,
    moved: FloatArray,
    impossible: IntArray,
) -> None:
    """`_track_one` for every feature, over all threads."""
    for f in prange(len(first) - 1):
        a, b, c, d = first[f], first[f + 1], first_asked[f], first_asked[f + 1]
        evidence[f], moved[f], impossible[f] = _track_one(
            stamp_s[a:b], absent[a:b], present[a:b], asked_s[c:d], slots, law, prior, answer[c:d],
        )  # fmt: skip


@kernel
def look_rows(
    rows: IntArray,
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now_s: FloatArray,
    stamp_s: FloatArray,
    absent: FloatArray,
    present: FloatArray,
    law: Law,
    evidence: FloatArray,
    moved: FloatArray,
    belief: FloatArray,
) -> int:
    """One look at each of many features, in place; the first row that is impossible under both states, or -1."""
    scratch, merged = np.zeros((2, start.shape[2])), np.zeros(2, dtype=np.int64)
    for i in range(len(rows)):
        f = rows[i]
        now, mass = advance(start[f], weight[f], count[f], now_s[f], stamp_s[i], law, scratch, merged, False)
        likelihood = _look(weight[f], count[f], absent[i], present[i])
        if not likelihood > 0.0:
            return i
        now_s[f] = now
        moved[f] += mass
        evidence[f] += np.log(likelihood)
        belief[i] = min(_sum(weight[f], 1, count[f, 1]), 1.0)
    return -1


@kernel
def predict_rows(
    rows: IntArray,
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now_s: FloatArray,
    stamp_s: FloatArray,
    law: Law,
    belief: FloatArray,
) -> None:
    """Presence of many features at one instant each; nothing of the state changes."""
    scratch, merged = np.zeros((2, start.shape[2])), np.zeros(2, dtype=np.int64)
    for i in range(len(rows)):
        f = rows[i]
        begun, mass, number, now = start[f], weight[f], count[f], now_s[f]
        if stamp_s[i] - now > law.step_s:
            begun, mass, number = begun.copy(), mass.copy(), number.copy()
            now, _ = advance(begun, mass, number, now, stamp_s[i], law, scratch, merged, True)
        belief[i] = _present(begun, mass, number, now, stamp_s[i], law, scratch)


@kernel
def week_of_beliefs(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    law: Law,
    ages: FloatArray,
    weights: FloatArray,
    counts: IntArray,
) -> None:
    """Let a belief run for two weeks from a Monday 00:00, and keep it at every ten minutes of the second."""
    scratch, merged = np.zeros((2, start.shape[1])), np.zeros(2, dtype=np.int64)
    now = MONDAY_S
    for i in range(2 * BINS):
        at = MONDAY_S + i * BIN_S
        now, _ = advance(start, weight, count, now, at, law, scratch, merged, False)
        _look(weight, count, 1.0, 1.0)
        if i >= BINS:
            for s in range(2):
                counts[i - BINS, s] = count[s]
                for j in range(count[s]):
                    ages[i - BINS, s, j] = now - start[s, j]
                    weights[i - BINS, s, j] = weight[s, j]
