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
from evermap.existence.protocol import LookColumns
from evermap.existence.rhythm import BIN_S, BINS, DAY_S, MONDAY_S, WEEK_S
from evermap.types import FloatArray, IntArray

MOST = 700.0
"""Integrated hazard that nothing survives."""
NO_MERGE = -1
AS_THEY_ARE = (1.0, 1.0)
_POSITION = 0xFFFFF
_HIGHEST = 0x7FFFFFFFFFFFFFFF


class Law(NamedTuple):
    """Model data of the kernels.

    Attributes:
        step_s: longest step of time.
        share: (K,) of the kinds of day.
        factor: (K, 2, 1008) by what the hazards of absences (0) and stays (1) are multiplied at each ten minutes of the
            week on each kind of day; (1, 2, 1) ones where there is no rhythm.
        offset: of the bins of age (`lifetimes.HazardTable`).
        hazard_hz: (2, B) hazard in each bin.
        intercept: (2, B) the hazard integrated up to an age `a` in bin `i` is `intercept[i] + hazard_hz[i] a`.
    """

    step_s: float
    share: FloatArray
    factor: FloatArray
    offset: int
    hazard_hz: FloatArray
    intercept: FloatArray


class RunHypotheses(NamedTuple):
    """A feature's belief; with one more dimension in front, those of N features.

    Attributes:
        start: (2, S) since when it has been in state `s`.
        weight: (K, 2, S) with which probability, and on which kind of day.
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


class Workspace(NamedTuple):
    """Room to work in.

    Attributes:
        hazard: (2, S) filled in: integrated hazards of the last step, without a rhythm.
        scratch: (2, S).
        merged: (2,) filled in: where lists were merged in the last step.
    """

    hazard: FloatArray
    scratch: FloatArray
    merged: IntArray


class First(NamedTuple):
    """Beliefs before anything is known, for each ten minutes of the week, or for all of it.

    Attributes:
        age_s: (W, 2, S) how long it has been so.
        weight: (W, K, 2, S) with which probability, and on which kind of day.
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
def _integrate_state(age: Any, later: Any, s: Any, law: Any) -> Any:
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
def _hazards(start: Any, n: Any, s: Any, now: Any, later: Any, law: Any, hazard: Any) -> None:
    """Integrated hazard of every hypothesis of state `s` between two instants, without a rhythm, into `hazard[s]`.

    A loop of its own: one that looks up a table keeps a compiler from using vectors for the exponentials.
    """
    for j in range(n):
        hazard[s, j] = _integrate_state(now - start[s, j], later - start[s, j], s, law)


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
def _merge(start: FloatArray, weight: FloatArray, n: int, s: int, now: float, total: FloatArray) -> tuple[int, float]:
    """Unite the two cheapest neighbours; position of the first of them, and the mass of the lighter."""
    for j in range(n):
        total[s, j] = weight[0, s, j]
    for k in range(1, len(weight)):
        for j in range(n):
            total[s, j] += weight[k, s, j]
    best = _cheapest(start, total, n, s, now)
    a, b = total[s, best], total[s, best + 1]
    share = b / (a + b) if a + b > 0.0 else 0.5
    start[s, best] += share * (start[s, best + 1] - start[s, best])
    for j in range(best + 1, n - 1):
        start[s, j] = start[s, j + 1]
    for k in range(len(weight)):
        weight[k, s, best] += weight[k, s, best + 1]
        for j in range(best + 1, n - 1):
            weight[k, s, j] = weight[k, s, j + 1]
    return best, min(a, b)


@kernel
def _step(
    held: RunHypotheses, now: float, later: float, law: Law, scale: tuple[float, float], space: Workspace
) -> float:
    """Take one step without a look and return the mass merged.

    Hazards are those of the law times `scale`.
    """
    start, weight, count = held
    hazard, scratch, merged = space
    middle = 0.5 * (now + later)
    week = _week_bin(middle, law.factor.shape[2])
    for s in range(2):
        _hazards(start, count[s], s, now, later, law, hazard)
        for k in range(len(weight)):
            factor = scale[s] * law.factor[k, s, week]
            for j in range(count[s]):
                x, mass = min(factor * hazard[s, j], MOST), weight[k, s, j]
                scratch[1 - s, j] = -mass * expm1(-x)
                weight[k, s, j] = mass * exp(-x) if x < MOST else 0.0
            weight[k, 1 - s, count[1 - s]] = _sum(scratch, 1 - s, count[s])
    moved = 0.0
    for s in range(2):
        n = count[s]
        start[s, n] = middle
        merged[s] = NO_MERGE
        n += 1
        if n == start.shape[1]:
            merged[s], mass = _merge(start, weight, n, s, later, scratch)
            moved += mass
            n -= 1
        count[s] = n
    return moved


@kernel
def _redraw(held: RunHypotheses, now: float, later: float, share: FloatArray) -> None:
    """Draw the kind of a day that begins between two instants."""
    weight, count = held.weight, held.number
    if len(weight) == 1 or later // DAY_S == now // DAY_S:
        return
    for s in range(2):
        for j in range(count[s]):
            total = 0.0
            for k in range(len(weight)):
                total += weight[k, s, j]
            for k in range(len(weight)):
                weight[k, s, j] = share[k] * total


@reordered
def _mass(weight: Any, k: Any, s: Any, n: Any) -> Any:
    """Probability of state `s` on a day of kind `k`, added as `_sum` adds."""
    total = 0.0
    for j in range(n):
        total += weight[k, s, j]
    return total


@inlined
def _masses(weight: Any, s: Any, n: Any) -> Any:
    """Probability of state `s`."""
    total = 0.0
    for k in range(len(weight)):
        total += _mass(weight, k, s, n)
    return total


@kernel
def _look(held: RunHypotheses, absent: float, present: float) -> float:
    """Multiply by the likelihoods of a look and normalise; returns the probability of the look.

    A state that the look rules out keeps no hypotheses.
    """
    weight, count = held.weight, held.number
    mass = (absent * _masses(weight, 0, count[0]), present * _masses(weight, 1, count[1]))
    total: float = mass[0] + mass[1]
    for s in range(2):
        if mass[s] == 0.0:
            count[s] = 0
        scale = (present if s == 1 else absent) / total
        for k in range(len(weight)):
            for j in range(count[s]):
                weight[k, s, j] *= scale
    return total


@kernel
def _present(held: RunHypotheses, now: float, later: float, law: Law, scratch: FloatArray) -> float:
    """Probability of presence at `later`, at most a step after `now`."""
    start, weight, count = held
    middle = 0.5 * (now + later)
    week = _week_bin(middle, law.factor.shape[2])
    if len(weight) > 1 and middle // DAY_S > now // DAY_S:
        weight = weight.copy()
        _redraw(RunHypotheses(start, weight, count), now, middle, law.share)
    absent, there = _masses(weight, 0, count[0]), _masses(weight, 1, count[1])
    present = there
    for s in range(2):
        _hazards(start, count[s], s, now, later, law, scratch)
        for k in range(len(weight)):
            factor = law.factor[k, s, week]
            for j in range(count[s]):
                scratch[1 - s, j] = -weight[k, s, j] * expm1(-min(factor * scratch[s, j], MOST))
            present += (1.0 - 2.0 * s) * _sum(scratch, 1 - s, count[s])
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
    moved, kinds = 0.0, len(law.share)
    while now < until:
        later = min(now + law.step_s, until)
        if whole and until - now <= law.step_s:
            break
        if kinds > 1:
            _redraw(held, now, 0.5 * (now + later), law.share)
        moved += _step(held, now, later, law, AS_THEY_ARE, space)
        if kinds > 1:
            _redraw(held, 0.5 * (now + later), later, law.share)
        now = later
    return now, moved


@kernel
def room(slots: int) -> Workspace:
    """Return room to work in."""
    return Workspace(np.zeros((2, slots)), np.zeros((2, slots)), np.zeros(2, dtype=np.int64))


@kernel
def nothing_held(slots: int, law: Law) -> RunHypotheses:
    """Return room for the hypotheses of a feature."""
    kinds = len(law.share)
    return RunHypotheses(np.zeros((2, slots)), np.zeros((kinds, 2, slots)), np.zeros(2, dtype=np.int64))


@kernel
def begin(held: RunHypotheses, stamp_s: float, prior: First) -> None:
    """Set the belief before anything is known: ages and weights for this time of the week."""
    start, weight, count = held
    week = _week_bin(stamp_s, len(prior.number))
    for s in range(2):
        count[s] = prior.number[week, s]
        for j in range(count[s]):
            start[s, j] = stamp_s - prior.age_s[week, s, j]
            for k in range(len(weight)):
                weight[k, s, j] = prior.weight[week, k, s, j]


@kernel
def begin_rows(held: RunHypotheses, stamp_s: FloatArray, prior: First) -> None:
    """Begin every row by `begin`."""
    for f in range(len(stamp_s)):
        begin(RunHypotheses(held.start[f], held.weight[f], held.number[f]), stamp_s[f], prior)


@kernel
def _track_one(
    looks: LookColumns, asked_s: FloatArray, slots: int, law: Law, prior: First, answer: FloatArray
) -> tuple[float, float, int]:
    """Filter all looks at one feature; return log evidence, merged mass, impossible look or -1."""
    stamp_s, present, absent = looks
    held, space = nothing_held(slots, law), room(slots)
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
            likelihood = _look(held, absent[i], present[i])
            if not likelihood > 0.0:
                return evidence, moved, i
            evidence += np.log(likelihood)
    return evidence, moved, -1


@parallel_kernel
def track(
    first: IntArray, looks: LookColumns, first_asked: IntArray, asked_s: FloatArray, slots: int, law: Law, prior: First
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Return `_track_one` for every feature, over all threads.

    Returns:
        (Q,) presence at the instants asked for, (F,) log evidence, (F,) mass merged, and (F,) the number of the first
        look that is impossible under both states, or -1.
    """
    # arrays of its own, taken out of tuples: a parallel loop takes writes to others for dead
    stamp_s, present, absent = looks
    n = len(first) - 1
    p_present, evidence, moved = np.empty(len(asked_s)), np.empty(n), np.empty(n)
    impossible = np.empty(n, dtype=np.int64)
    for f in prange(n):
        a, b, c, d = first[f], first[f + 1], first_asked[f], first_asked[f + 1]
        own = LookColumns(stamp_s[a:b], present[a:b], absent[a:b])
        evidence[f], moved[f], impossible[f] = _track_one(own, asked_s[c:d], slots, law, prior, p_present[c:d])
    return p_present, evidence, moved, impossible


@kernel
def look_rows(rows: IntArray, state: BeliefRows, looks: LookColumns, law: Law) -> int:
    """Return one look at each of many features, in place; the first row that is impossible under both states, or -1."""
    everyone, now_s, evidence, moved = state
    stamp_s, present, absent = looks
    space = room(everyone.start.shape[2])
    for i in range(len(rows)):
        f = rows[i]
        held = RunHypotheses(everyone.start[f], everyone.weight[f], everyone.number[f])
        now, mass = advance(held, now_s[f], stamp_s[i], law, space, False)
        likelihood = _look(held, absent[i], present[i])
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
    space = room(everyone.start.shape[2])
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
    space = room(start.shape[1])
    now = MONDAY_S
    for i in range(2 * BINS):
        at = MONDAY_S + i * BIN_S
        now, _ = advance(held, now, at, law, space, False)
        _look(held, 1.0, 1.0)
        if i >= BINS:
            for s in range(2):
                counts[i - BINS, s] = count[s]
                for j in range(count[s]):
                    ages[i - BINS, s, j] = now - start[s, j]
                    for k in range(len(weight)):
                        weights[i - BINS, k, s, j] = weight[k, s, j]


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
def _go_on(held: RunHypotheses, s: int, now: float, later: float, law: Law, scratch: FloatArray) -> float:
    """Take from the weights of state `s` what ends before `later`; return its time, times probability."""
    start, left, n = held.start, held.weight, held.number[s]
    middle = 0.5 * (now + later)
    week = _week_bin(middle, law.factor.shape[2])
    _redraw(held, now, middle, law.share)
    _hazards(start, n, s, now, later, law, scratch)
    gap, spent = later - now, 0.0
    for k in range(len(left)):
        factor = law.factor[k, s, week]
        for j in range(n):
            x, mass = min(factor * scratch[s, j], MOST), left[k, s, j]
            scratch[1 - s, j] = mass * gap * (-expm1(-x) / x if x > 1e-9 else 1.0)
            left[k, s, j] = mass * exp(-x) if x < MOST else 0.0
        spent += _sum(scratch, 1 - s, n)
    _redraw(held, middle, later, law.share)
    return spent


@kernel
def lasting_rows(state: BeliefRows, s: int, asked_s: FloatArray, law: Law, out: FloatArray) -> None:
    """Evaluate the probability that state `s`, the present one, lasts until instants in order."""
    start, weight, count = state.held
    now_s = state.now_s
    scratch = np.empty((2, start.shape[2]))
    constant = law.factor.shape[2] == 1
    for f in range(len(now_s)):
        held, now = RunHypotheses(start[f], weight[f].copy(), count[f]), now_s[f]
        total = _masses(held.weight, s, count[f, s])
        for k in range(len(asked_s)):
            while now < asked_s[k]:
                later = asked_s[k] if constant else min(_step_end(now, law), asked_s[k])
                _go_on(held, s, now, later, law, scratch)
                now = later
            out[f, k] = min(_masses(held.weight, s, count[f, s]) / total, 1.0) if total > 0.0 else np.nan


@kernel
def remaining_rows(state: BeliefRows, s: int, law: Law, weeks: int, out: FloatArray) -> None:
    """Evaluate the expected time that state `s` goes on, given that it is the present one: step by step for some weeks.

    Of what is left then, each further week leaves the same part as the last one did.
    """
    start, weight, count = state.held
    now_s = state.now_s
    scratch = np.empty((2, start.shape[2]))
    for f in range(len(now_s)):
        held, now = RunHypotheses(start[f], weight[f].copy(), count[f]), now_s[f]
        total = _masses(held.weight, s, count[f, s])
        if total == 0.0:
            out[f] = np.nan
            continue
        passed, of_week, kept = 0.0, 0.0, 1.0
        for _ in range(weeks):
            before, of_week = _masses(held.weight, s, count[f, s]), 0.0
            end_of_week = now + WEEK_S
            while now < end_of_week:
                later = min(_step_end(now, law), end_of_week)
                of_week += _go_on(held, s, now, later, law, scratch)
                now = later
            passed += of_week
            kept = _masses(held.weight, s, count[f, s]) / before
            if _masses(held.weight, s, count[f, s]) < _NOTHING * total:
                kept = 0.0
                break
        out[f] = np.inf if kept == 1.0 else (passed + of_week * kept / (1.0 - kept)) / total


@kernel
def kinds_of_days(looks: LookColumns, slots: int, law: Law, prior: First) -> FloatArray:
    """Return (D, K) the likelihood of each day's looks on each kind of day, relative to that on a day of any kind."""
    stamp_s, present, absent = looks
    held, space = nothing_held(slots, law), room(slots)
    now, day, kinds = stamp_s[0], stamp_s // DAY_S - stamp_s[0] // DAY_S, len(law.share)
    out = np.ones((int(day[-1]) + 1, kinds))
    begin(held, now, prior)
    for i in range(len(stamp_s)):
        now, _ = advance(held, now, stamp_s[i], law, space, False)
        if not _look(held, absent[i], present[i]) > 0.0:
            break
        for k in range(kinds):  # which had its share at the begin of the day
            mass = _mass(held.weight, k, 0, held.number[0]) + _mass(held.weight, k, 1, held.number[1])
            out[int(day[i]), k] = mass / law.share[k]
    return out
