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

from evermap.existence.elementary import exp, expm1, inlined, kernel, parallel_kernel, reordered
from evermap.existence.lifetimes import SHIFT
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S
from evermap.types import FloatArray, IntArray

MOST = 700.0
"""Integrated hazard that nothing survives."""
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


class RunHypotheses(NamedTuple):
    """A feature's belief; with one more dimension in front, those of N features.

    Attributes:
        start: (2, S) since when it has been in state `s`.
        weight: (2, S) with which probability.
        number: (2,) of hypotheses; places beyond it hold anything.
    """

    start: FloatArray
    weight: FloatArray
    number: IntArray


class BeliefRows(NamedTuple):
    """Beliefs of N features.

    Attributes:
        held: their hypotheses.
        now_s: (N,) when these held.
        evidence: (N,) log evidence so far.
        moved: (N,) mass merged so far.
    """

    held: RunHypotheses
    now_s: FloatArray
    evidence: FloatArray
    moved: FloatArray


class LookColumns(NamedTuple):
    """M looks: when, and their likelihoods if the feature is absent and if it is present."""

    stamp_s: FloatArray
    absent: FloatArray
    present: FloatArray


class Workspace(NamedTuple):
    """Room to work in.

    Attributes:
        scratch: (2, S).
        merged: (2,) filled in: where lists were merged in the last step.
    """

    scratch: FloatArray
    merged: IntArray


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
    """Return the bin of an age."""
    return min(max((np.float64(age_s).view(np.int64) >> SHIFT) - law.offset, 0), law.hazard_hz.shape[1] - 1)


@inlined
def _integrated(age: Any, later: Any, s: Any, law: Any) -> Any:
    """Integral of the hazard of state `s` between two ages."""
    i, j = age_bin(age, law), age_bin(later, law)
    levels = law.intercept[s, j] - law.intercept[s, i]
    return max(levels + (law.hazard_hz[s, j] * later - law.hazard_hz[s, i] * age), 0.0)


@reordered
def _sum(values: Any, s: Any, n: Any) -> Any:
    """Sum of the first `n` of row `s`, in any order, so that vectors add them."""
    total = 0.0
    for j in range(n):
        total += values[s, j]
    return total


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
    held: RunHypotheses, now: float, later: float, law: Law, scale: tuple[float, float], space: Workspace
) -> float:
    """Take one step without a look and return the mass merged.

    Hazards are those of the law times `scale`.
    """
    start, weight, count = held
    scratch, merged = space
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
def _present(held: RunHypotheses, now: float, later: float, law: Law, scratch: FloatArray) -> float:
    """Probability of presence at `later`, at most a step after `now`."""
    start, weight, count = held
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
    held: RunHypotheses, now: float, until: float, law: Law, space: Workspace, whole: bool
) -> tuple[float, float]:
    """Return whole steps from `now` on as long as they end before `until`, and the rest of the way unless `whole`.

    Returns:
        The time reached, and the mass merged.
    """
    moved = 0.0
    while until - now > law.step_s:
        moved += _step(held, now, now + law.step_s, law, AS_THEY_ARE, space)
        now += law.step_s
    if not whole and until > now:
        moved += _step(held, now, until, law, AS_THEY_ARE, space)
        now = until
    return now, moved


@kernel
def _room(slots: int) -> Workspace:
    return Workspace(np.zeros((2, slots)), np.zeros(2, dtype=np.int64))


@kernel
def nothing_held(slots: int) -> RunHypotheses:
    """Return room for the hypotheses of a feature."""
    return RunHypotheses(np.zeros((2, slots)), np.zeros((2, slots)), np.zeros(2, dtype=np.int64))


@kernel
def begin(held: RunHypotheses, stamp_s: float, prior: First) -> None:
    """Set the belief before anything is known: ages and weights for this time of the week."""
    start, weight, count = held
    week = _week_bin(stamp_s, len(prior.number))
    for s in range(2):
        count[s] = prior.number[week, s]
        for j in range(count[s]):
            start[s, j] = stamp_s - prior.age_s[week, s, j]
            weight[s, j] = prior.weight[week, s, j]


@kernel
def begin_rows(held: RunHypotheses, stamp_s: FloatArray, prior: First) -> None:
    """Begin every row by `begin`."""
    for f in range(len(stamp_s)):
        begin(RunHypotheses(held.start[f], held.weight[f], held.number[f]), stamp_s[f], prior)


@kernel
def _track_one(
    looks: LookColumns, asked_s: FloatArray, slots: int, law: Law, prior: First, answer: FloatArray
) -> tuple[float, float, int]:
    """All looks at one feature and all instants asked for; log evidence, mass merged, impossible look or -1."""
    stamp_s, absent, present = looks
    held, space = nothing_held(slots), _room(slots)
    evidence, moved = 0.0, 0.0
    m, n = stamp_s.size, asked_s.size
    if m + n == 0:
        return evidence, moved, -1
    now = stamp_s[0] if m else asked_s[0]
    if n and asked_s[0] < now:
        now = asked_s[0]
    begin(held, now, prior)
    k = 0
    for i in range(m + 1):
        while k < n and (i == m or asked_s[k] < stamp_s[i]):
            now, mass = advance(held, now, asked_s[k], law, space, True)
            moved += mass
            answer[k] = _present(held, now, asked_s[k], law, space.scratch)
            k += 1
        if i < m:
            now, mass = advance(held, now, stamp_s[i], law, space, False)
            moved += mass
            likelihood = _look(held.weight, held.number, absent[i], present[i])
            if not likelihood > 0.0:
                return evidence, moved, i
            evidence += np.log(likelihood)
    return evidence, moved, -1


@parallel_kernel
def track(
    first: IntArray,
    looks: LookColumns,
    first_asked: IntArray,
    asked_s: FloatArray,
    slots: int,
    law: Law,
    prior: First,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Return `_track_one` for every feature, over all threads.

    Returns:
        (Q,) presence at the instants asked for, (F,) log evidence, (F,) mass merged, and (F,) the number of the first
        look that is impossible under both states, or -1.
    """
    # arrays of its own, taken out of tuples: what is written to others, a parallel loop takes for dead
    stamp_s, absent, present = looks
    n = len(first) - 1
    p_present, evidence, moved = np.empty(len(asked_s)), np.empty(n), np.empty(n)
    impossible = np.empty(n, dtype=np.int64)
    for f in prange(n):
        a, b, c, d = first[f], first[f + 1], first_asked[f], first_asked[f + 1]
        own = LookColumns(stamp_s[a:b], absent[a:b], present[a:b])
        evidence[f], moved[f], impossible[f] = _track_one(own, asked_s[c:d], slots, law, prior, p_present[c:d])
    return p_present, evidence, moved, impossible


@kernel
def look_rows(rows: IntArray, state: BeliefRows, looks: LookColumns, law: Law) -> int:
    """Return one look at each of many features, in place; the first row that is impossible under both states, or -1."""
    everyone, now_s, evidence, moved = state
    stamp_s, absent, present = looks
    space = _room(everyone.start.shape[2])
    for i in range(len(rows)):
        f = rows[i]
        held = RunHypotheses(everyone.start[f], everyone.weight[f], everyone.number[f])
        now, mass = advance(held, now_s[f], stamp_s[i], law, space, False)
        likelihood = _look(held.weight, held.number, absent[i], present[i])
        if not likelihood > 0.0:
            return i
        now_s[f] = now
        moved[f] += mass
        evidence[f] += np.log(likelihood)
    return -1


@kernel
def predict_rows(rows: IntArray, state: BeliefRows, stamp_s: FloatArray, law: Law, belief: FloatArray) -> None:
    """Evaluate presence of many features at one instant each; nothing of the state changes."""
    everyone, now_s = state.held, state.now_s
    space = _room(everyone.start.shape[2])
    for i in range(len(rows)):
        f = rows[i]
        held, now = RunHypotheses(everyone.start[f], everyone.weight[f], everyone.number[f]), now_s[f]
        if stamp_s[i] - now > law.step_s:
            held = RunHypotheses(held.start.copy(), held.weight.copy(), held.number.copy())
            now, _ = advance(held, now, stamp_s[i], law, space, True)
        belief[i] = _present(held, now, stamp_s[i], law, space.scratch)


@kernel
def week_of_beliefs(held: RunHypotheses, law: Law, week: First) -> None:
    """Let a belief run for two weeks from a Monday 00:00, and keep it at every ten minutes of the second."""
    start, weight, count = held
    ages, weights, counts = week
    space = _room(start.shape[1])
    now = MONDAY_S
    for i in range(2 * BINS):
        at = MONDAY_S + i * BIN_S
        now, _ = advance(held, now, at, law, space, False)
        _look(weight, count, 1.0, 1.0)
        if i >= BINS:
            for s in range(2):
                counts[i - BINS, s] = count[s]
                for j in range(count[s]):
                    ages[i - BINS, s, j] = now - start[s, j]
                    weights[i - BINS, s, j] = weight[s, j]


_NOTHING = 1e-10
"""Probability of going on below which what remains does not matter."""
_SLIVER_S = 1e-3
"""Shortest step, lest rounding makes one of nothing."""


@kernel
def _step_end(now: float, law: Law) -> float:
    """End of a step that begins now: as the filter's, but within one ten minutes of the week."""
    rest = BIN_S - (now - MONDAY_S) % BIN_S
    return now + min(law.step_s, rest if rest > _SLIVER_S else rest + BIN_S)


@kernel
def _go_on(
    held: RunHypotheses, s: int, now: float, later: float, law: Law, scratch: FloatArray, spent: FloatArray
) -> None:
    """Take from the weights of state `s` what ends before `later`; `spent[s]`: its time, times probability."""
    start, left, n = held.start, held.weight, held.number[s]
    week = _week_bin(0.5 * (now + later), law.factor.shape[1])
    _hazards(start, n, s, now, later, law.factor[s, week], law, scratch)
    gap = later - now
    for j in range(n):
        x, mass = scratch[s, j], left[s, j]
        spent[s, j] = mass * gap * (-expm1(-x) / x if x > 1e-9 else 1.0)
        left[s, j] = mass * exp(-x) if x < MOST else 0.0


@kernel
def lasting_rows(state: BeliefRows, s: int, asked_s: FloatArray, law: Law, out: FloatArray) -> None:
    """Evaluate the probability that state `s`, the present one, lasts until instants in order."""
    start, weight, count = state.held
    now_s = state.now_s
    scratch, spent = np.empty((2, start.shape[2])), np.empty((2, start.shape[2]))
    constant = law.factor.shape[1] == 1
    for f in range(len(now_s)):
        left, n, now = weight[f].copy(), count[f, s], now_s[f]
        held = RunHypotheses(start[f], left, count[f])
        total = _sum(left, s, n)
        for k in range(len(asked_s)):
            while now < asked_s[k]:
                later = asked_s[k] if constant else min(_step_end(now, law), asked_s[k])
                _go_on(held, s, now, later, law, scratch, spent)
                now = later
            out[f, k] = min(_sum(left, s, n) / total, 1.0) if total > 0.0 else np.nan


@kernel
def remaining_rows(state: BeliefRows, s: int, law: Law, weeks: int, out: FloatArray) -> None:
    """Evaluate the expected time that state `s` goes on, given that it is the present one: step by step for some weeks.

    Of what is left then, each further week leaves the same part as the last one did.
    """
    start, weight, count = state.held
    now_s = state.now_s
    scratch, spent = np.empty((2, start.shape[2])), np.empty((2, start.shape[2]))
    for f in range(len(now_s)):
        left, n, now = weight[f].copy(), count[f, s], now_s[f]
        held = RunHypotheses(start[f], left, count[f])
        total = _sum(left, s, n)
        if total == 0.0:
            out[f] = np.nan
            continue
        passed, of_week, kept = 0.0, 0.0, 1.0
        for _ in range(weeks):
            before, of_week = _sum(left, s, n), 0.0
            end_of_week = now + WEEK_S
            while now < end_of_week:
                later = min(_step_end(now, law), end_of_week)
                _go_on(held, s, now, later, law, scratch, spent)
                of_week += _sum(spent, s, n)
                now = later
            passed += of_week
            kept = _sum(left, s, n) / before
            if _sum(left, s, n) < _NOTHING * total:
                kept = 0.0
                break
        out[f] = np.inf if kept == 1.0 else (passed + of_week * kept / (1.0 - kept)) / total
