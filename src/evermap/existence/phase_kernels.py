"""The filter and the smoother of a Markov chain of phases, compiled.

A belief is a row of phase probabilities. Over a gap it is multiplied by `exp(Q gap)`, computed by uniformisation: with
`q` the fastest exit, `exp(Q t) = sum_k Poisson(k; q t) U^k`, `U = I + Q / q` (Jensen 1953). Every term is positive, so
nothing cancels and small probabilities keep their digits. Rates may differ from each ten minutes of the week to the
next; whole tens of minutes and whole weeks are multiplied with matrices made beforehand.

The E-step of the EM algorithm goes forward over the looks, and backward over the pieces between them. For a piece with
forward row `a` and backward column `b` the expected changes of phase and times spent are those of
`int a exp(Q s) (x) exp(Q (t - s)) b ds` (Hobolth and Jensen 2011); uniformisation turns the integral into
`sum_m (a U^m) (x) g_m / q` with `g_m = w_{m+1} b + U g_{m+1}`, all of it positive: two passes, where the double sum
over jumps before and after would need its square.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.existence.elementary import inlined, kernel
from evermap.existence.protocol import LookColumns
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S
from evermap.types import FloatArray, IntArray

LONG = 16.0
"""Jumps in a gap above which squaring a matrix is cheaper than a row times its powers."""
NEGLIGIBLE = 1e-17


class PhaseChain(NamedTuple):
    """Model data of the kernels; B is 1, or 1008 with a rhythm.

    Attributes:
        rates_hz: (B, n, n) rate of each change of phase, the diagonal zero.
        exit_hz: (B, n) sums of its rows.
        whole: (B, n, n) transition over ten whole minutes.
        week: (n, n) transition over a week from Monday 00:00.
        present: (n,) 1.0 where a feature in this phase is there, else 0.0.
    """

    rates_hz: FloatArray
    exit_hz: FloatArray
    whole: FloatArray
    week: FloatArray
    present: FloatArray


@inlined
def _two_states(leave: Any, comes: Any, span: Any) -> Any:
    """Probability of a change from 0 to 1, and from 1 to 0, in a chain of two phases; `1 -` each is safe to take."""
    total = leave + comes
    changed = -np.expm1(-total * span) / total if total > 0.0 else 0.0
    return leave * changed, comes * changed


@kernel
def multiply(belief: FloatArray, matrix: FloatArray, spare: FloatArray) -> None:
    """Compute `belief @ matrix`, in place."""
    n = belief.size
    for j in range(n):
        total = 0.0
        for i in range(n):
            total += belief[i] * matrix[i, j]
        spare[j] = total
    for j in range(n):
        belief[j] = spare[j]


@inlined
def copy_row(row: Any, out: Any) -> None:
    """Copy numbers; assigning a whole array compiles for longer, for the message of shapes that do not fit."""
    for i in range(row.size):
        out[i] = row[i]


@inlined
def jump(row: Any, rates: Any, exits: Any, fastest: Any, out: Any) -> None:
    """Fill `out` with a row after one jump of the uniformised chain, `row @ U`."""
    per_fastest = 1.0 / fastest
    for j in range(row.size):
        total = row[j] * (fastest - exits[j])
        for i in range(row.size):
            total += row[i] * rates[i, j]
        out[j] = total * per_fastest


@kernel
def advance(belief: FloatArray, rates: FloatArray, exits: FloatArray, span_s: float, spare: FloatArray) -> None:
    """Compute `belief @ exp(Q span)`, in place, for constant rates and few jumps; `spare` is (3, n)."""
    n = belief.size
    if n == 2:
        a, b = _two_states(rates[0, 1], rates[1, 0], span_s)
        decay = np.exp(-(exits[0] + exits[1]) * span_s)
        first, second = belief[0], belief[1]
        belief[0] = first * (b + decay) + second * b
        belief[1] = first * a + second * (a + decay)
        return
    fastest = exits.max()
    mean = fastest * span_s
    if mean <= 0.0:
        return
    term, following = spare[0], spare[1]
    weight = np.exp(-mean)
    reference = weight
    for j in range(n):
        term[j] = belief[j]
        belief[j] *= weight
    k = 0
    while True:
        k += 1
        weight *= mean / k
        jump(term, rates, exits, fastest, following)
        term, following = following, term
        for j in range(n):
            belief[j] += weight * term[j]
        if k < n:
            reference = weight
        elif weight <= NEGLIGIBLE * reference:
            return


@kernel
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """`a @ b` of small matrices."""
    n = len(a)
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@kernel
def transition(rates: FloatArray, exits: FloatArray, span_s: float, out: FloatArray) -> None:
    """Compute `exp(Q span)`: a short piece row by row, then squared; rows keep their sum of 1."""
    n = exits.size
    fastest = exits.max()
    squarings = 0
    if n > 2:
        while fastest * span_s > 1.0:
            span_s *= 0.5
            squarings += 1
    spare = np.empty((3, n))
    for i in range(n):
        for j in range(n):
            out[i, j] = 1.0 if i == j else 0.0
        advance(out[i], rates, exits, span_s, spare)
    square = np.empty((n, n))
    for _ in range(squarings):
        _product(out, out, square)
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += square[i, j]
            for j in range(n):
                out[i, j] = square[i, j] / total


@kernel
def transitions(rates: FloatArray, exits: FloatArray, span_s: float) -> FloatArray:
    """Return `transition` of (B, n, n) rates."""
    out = np.empty_like(rates)
    for b in range(len(rates)):
        transition(rates[b], exits[b], span_s, out[b])
    return out


@kernel
def leap(belief: FloatArray, rates: FloatArray, exits: FloatArray, span_s: float, spare: FloatArray) -> None:
    """Compute `belief @ exp(Q span)`, in place, for constant rates and any gap."""
    if exits.size > 2 and exits.max() * span_s > LONG:
        matrix = np.empty_like(rates)
        transition(rates, exits, span_s, matrix)
        multiply(belief, matrix, spare[0])
    else:
        advance(belief, rates, exits, span_s, spare)


@kernel
def travel(belief: FloatArray, chain: Any, from_s: float, to_s: float, spare: FloatArray) -> None:
    """Carry the belief to `to_s`, in place, through as many tens of minutes of the week as lie between."""
    left = to_s - from_s
    if left <= 0.0:
        return
    if len(chain.rates_hz) == 1:
        leap(belief, chain.rates_hz[0], chain.exit_hz[0], left, spare)
        return
    phase = (from_s - MONDAY_S) % WEEK_S
    b = min(int(phase / BIN_S), BINS - 1)
    part = (b + 1) * BIN_S - phase
    while left > 0.0:
        if b == 0 and part == BIN_S and left >= WEEK_S:
            multiply(belief, chain.week, spare[0])
            left -= WEEK_S
            continue
        if left >= part and part == BIN_S:
            multiply(belief, chain.whole[b], spare[0])
        else:
            leap(belief, chain.rates_hz[b], chain.exit_hz[b], min(left, part), spare)
        left -= part
        b = b + 1 if b + 1 < BINS else 0
        part = BIN_S


@kernel
def observe(belief: FloatArray, present: FloatArray, there: float, gone: float) -> float:
    """Weigh the phases by an observation, in place; its likelihood, 0 where it is impossible."""
    likelihood = 0.0
    for j in range(belief.size):
        belief[j] *= there if present[j] == 1.0 else gone
        likelihood += belief[j]
    if likelihood > 0.0:
        for j in range(belief.size):
            belief[j] /= likelihood
    return likelihood


@kernel
def first_belief(start: FloatArray, chain: Any, at_s: float, belief: FloatArray, spare: FloatArray) -> None:
    """Fill in the belief before anything was seen: one row of `start`, or one of 1008 at their ten minutes' begin."""
    if len(start) == 1:
        copy_row(start[0], belief)
        return
    phase = (at_s - MONDAY_S) % WEEK_S
    b = min(int(phase / BIN_S), BINS - 1)
    copy_row(start[b], belief)
    leap(belief, chain.rates_hz[b], chain.exit_hz[b], phase - b * BIN_S, spare)


@kernel
def track_feature(
    chain: Any, start: FloatArray, fixed: bool, seen: LookColumns, asked_s: FloatArray,
    p_present: FloatArray, belief: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """Filter one feature's looks up to instants, both in order; return evidence, and the impossible look or -1.

    `belief`, (n,), is filled with the belief at the last of them.
    """
    look_s, there, gone = seen
    looks, asks = look_s.size, asked_s.size
    if looks + asks == 0:
        return 0.0, -1
    n = chain.present.size
    spare = np.empty((3, n))
    begin = look_s[0] if looks else asked_s[0]
    if asks and not fixed:
        begin = min(begin, asked_s[0])
    first_belief(start, chain, begin, belief, spare)
    now, evidence, k = begin, 0.0, 0
    for i in range(asks + 1):
        until = asked_s[i] if i < asks else np.inf
        while k < looks and look_s[k] <= until:
            travel(belief, chain, now, look_s[k], spare)
            now = look_s[k]
            likelihood = observe(belief, chain.present, there[k], gone[k])
            if not likelihood > 0.0:
                return evidence, k
            evidence += np.log(likelihood)
            k += 1
        if i < asks:
            travel(belief, chain, now, until, spare)
            now = max(now, until)
            total = 0.0
            for j in range(n):
                total += belief[j] * chain.present[j]
            p_present[i] = min(total, 1.0)
    return evidence, -1


@kernel
def track_all(
    chain: Any, start: FloatArray, fixed: bool, first_look: IntArray, looks: LookColumns, first_asked: IntArray,
    asked_s: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Filter every feature in turn.

    Args:
        chain: of the features.
        start: (1, n) phases before the first look, or (1008, n) at the begin of each ten minutes of the week.
        fixed: whether they hold at the first look, even where presence is asked for before it.
        first_look: (F + 1,) where the looks of each feature begin.
        looks: M of them.
        first_asked: (F + 1,) where its instants begin.
        asked_s: (Q,) of them.

    Returns:
        (Q,) presence at the instants asked for, (F,) log evidence, (F, n) phases at the last look or instant, and (F,)
        the look that is impossible, counted over all, or -1.
    """
    stamp_s, there, gone = looks
    features = len(first_look) - 1
    p_present, evidence, bads = np.empty(len(asked_s)), np.zeros(features), np.full(features, -1)
    beliefs = np.empty((features, chain.present.size))
    for f in range(features):
        a, b, c, d = first_look[f], first_look[f + 1], first_asked[f], first_asked[f + 1]
        own = LookColumns(stamp_s[a:b], there[a:b], gone[a:b])
        evidence[f], bad = track_feature(chain, start, fixed, own, asked_s[c:d], p_present[c:d], beliefs[f])
        bads[f] = a + bad if bad >= 0 else -1
    return p_present, evidence, beliefs, bads


@kernel
def travel_rows(beliefs: FloatArray, chain: Any, from_s: FloatArray, to_s: FloatArray) -> None:
    """Carry (N, n) beliefs by `travel`, each between its own instants, in place."""
    spare = np.empty((3, beliefs.shape[1]))
    for row in range(len(beliefs)):
        travel(beliefs[row], chain, from_s[row], to_s[row], spare)


PIECE = 16.0
"""Most expected jumps in one piece."""
_TERMS = 128
"""More than a Poisson variable of mean `PIECE` has with a chance of 1e-17."""


class Expectations(NamedTuple):
    """Expectations of F features; of one feature without the first dimension.

    Attributes:
        integrals: (B, n, n) added to: as in `piece_integral`.
        smoothed: (F, n) filled in: belief at the beginning given all looks.
        last: (F, n) filled in: belief after the last look.
    """

    integrals: FloatArray
    smoothed: FloatArray
    last: FloatArray


@kernel
def piece_integral(
    forward: FloatArray,
    backward: FloatArray,
    rates: FloatArray,
    exits: FloatArray,
    span_s: float,
    spare: Any,
    integral: FloatArray,
) -> float:
    """Return the probability of a piece; fill in its integral, and move `backward` to its begin, both divided by that.

    Args:
        forward: (n,) belief at the begin.
        backward: (n,) likelihood of all that comes after, at the end; at the begin afterwards.
        rates: (n, n) constant rates.
        exits: (n,) sums of their rows.
        span_s: length, at most `PIECE` jumps long.
        spare: (_TERMS + 1, n), (_TERMS + 2,) and (2, n) arrays to work in.
        integral: (n, n) filled in; times the rates these are expected changes, its diagonal is time spent.
    """
    tails, weight, rows = spare
    n = forward.size
    fastest = exits.max()
    mean = fastest * span_s
    if mean <= 0.0:
        probability = 0.0
        for i in range(n):
            probability += forward[i] * backward[i]
        for i in range(n):
            for j in range(n):
                integral[i, j] = span_s / probability * forward[i] * backward[j]
        for j in range(n):
            backward[j] /= probability
        return probability
    last = 0
    weight[0] = np.exp(-mean)
    reference = weight[0]
    while last < _TERMS:
        last += 1
        weight[last] = weight[last - 1] * mean / last
        if last <= n:
            reference = weight[last]
        elif weight[last] <= NEGLIGIBLE * reference:
            break
    for i in range(n):
        tails[last - 1, i] = weight[last] * backward[i]
    for m in range(last - 2, -1, -1):
        _jump_back(tails[m + 1], rates, exits, (fastest, weight[m + 1]), backward, tails[m])
    row, following = rows[0], rows[1]
    _jump_back(tails[0], rates, exits, (fastest, weight[0]), backward, following)
    probability = 0.0
    for i in range(n):
        probability += forward[i] * following[i]
    for i in range(n):
        backward[i] = following[i] / probability
        row[i] = forward[i]
        for j in range(n):
            integral[i, j] = 0.0
    for m in range(last):
        for i in range(n):
            for j in range(n):
                integral[i, j] += row[i] * tails[m, j]
        jump(row, rates, exits, fastest, following)
        row, following = following, row
    scale = 1.0 / (fastest * probability)
    for i in range(n):
        for j in range(n):
            integral[i, j] *= scale
    return probability


@inlined
def _jump_back(column: Any, rates: Any, exits: Any, pace: Any, backward: Any, out: Any) -> None:
    """Fill `out` with a column before one jump, `U column`, plus a part of `backward`."""
    fastest, weight = pace
    per_fastest = 1.0 / fastest
    for i in range(column.size):
        total = column[i] * (fastest - exits[i])
        for j in range(column.size):
            total += rates[i, j] * column[j]
        out[i] = weight * backward[i] + total * per_fastest


@kernel
def _cut(from_s: float, to_s: float, exits: FloatArray, spans: FloatArray, bins: IntArray) -> int:
    """Pieces of a gap, at the edges of the week's bins and `PIECE` jumps long at most; their number.

    Only counts where the arrays are too short.
    """
    left = to_s - from_s
    count = 0
    b = 0
    part = np.inf
    if len(exits) > 1:
        phase = (from_s - MONDAY_S) % WEEK_S
        b = min(int(phase / BIN_S), BINS - 1)
        part = (b + 1) * BIN_S - phase
    while left > 0.0:
        stretch = min(left, part)
        pieces = max(1, int(np.ceil(exits[b].max() * stretch / PIECE)))
        if count + pieces <= spans.size:
            for p in range(pieces):
                spans[count + p] = stretch / pieces
                bins[count + p] = b
        count += pieces
        left -= stretch
        part = BIN_S
        b = b + 1 if b + 1 < len(exits) else 0
    return count


@kernel
def expect_feature(
    chain: Any, begin_s: float, begin: FloatArray, looks: LookColumns, fading: tuple[float, float], out: Expectations
) -> tuple[float, int]:
    """Add one feature's expectations to `out`; evidence, and the look that is impossible or -1.

    Args:
        chain: of the feature.
        begin_s: where the belief starts, not after the first look.
        begin: (n,) that belief.
        looks: at the feature.
        fading: instant at which an event weighs 1, and by how much earlier one weighs half (inf: all weigh the same).
        out: filled in, integrals added to.
    """
    rates, exits, _, _, present = chain
    look_s, there, gone = looks
    end_s, half_life_s = fading
    integrals, smoothed, last = out
    m, n = look_s.size, present.size
    forward = np.empty((m + 1, n))
    copy_row(begin, forward[0])
    spare = np.empty((3, n))
    spans, bins = np.empty(256), np.empty(256, dtype=np.int64)
    evidence = 0.0
    for k in range(m):
        from_s = look_s[k - 1] if k else begin_s
        pieces = _cut(from_s, look_s[k], exits, spans, bins)
        if pieces > spans.size:
            spans, bins = np.empty(2 * pieces), np.empty(2 * pieces, dtype=np.int64)
            pieces = _cut(from_s, look_s[k], exits, spans, bins)
        row = forward[k + 1]
        copy_row(forward[k], row)
        for p in range(pieces):
            advance(row, rates[bins[p]], exits[bins[p]], spans[p], spare)
        likelihood = observe(row, present, there[k], gone[k])
        if not likelihood > 0.0:
            return evidence, k
        evidence += np.log(likelihood)
    copy_row(forward[m], last)
    backward = np.ones(n)
    starts = np.empty((spans.size, n))
    integral = np.empty((n, n))
    work = (np.empty((_TERMS + 1, n)), np.empty(_TERMS + 2), np.empty((2, n)))
    for k in range(m - 1, -1, -1):
        from_s = look_s[k - 1] if k else begin_s
        pieces = _cut(from_s, look_s[k], exits, spans, bins)
        observe(backward, present, there[k], gone[k])
        copy_row(forward[k], starts[0])
        for p in range(1, pieces):
            copy_row(starts[p - 1], starts[p])
            advance(starts[p], rates[bins[p - 1]], exits[bins[p - 1]], spans[p - 1], spare)
        at_s = look_s[k]
        for p in range(pieces - 1, -1, -1):
            b, span = bins[p], spans[p]
            piece_integral(starts[p], backward, rates[b], exits[b], span, work, integral)
            weight = 2.0 ** (-(end_s - (at_s - 0.5 * span)) / half_life_s)
            at_s -= span
            for i in range(n):
                for j in range(n):
                    integrals[b, i, j] += weight * integral[i, j]
    total = 0.0
    for i in range(n):
        smoothed[i] = begin[i] * backward[i]
        total += smoothed[i]
    for i in range(n):
        smoothed[i] /= total
    return evidence, -1


@kernel
def expect_all(
    chain: Any, begin_s: FloatArray, begin: FloatArray, first: IntArray, looks: LookColumns,
    fading: tuple[float, float], out: Expectations,
) -> tuple[float, int]:  # fmt: skip
    """Return `expect_feature` of all features: the sum of their evidence, and the first impossible look or -1."""
    evidence = 0.0
    for f in range(begin_s.size):
        a, b = first[f], first[f + 1]
        own = LookColumns(looks.stamp_s[a:b], looks.there[a:b], looks.gone[a:b])
        gained, bad = expect_feature(
            chain, begin_s[f], begin[f], own, fading, Expectations(out.integrals, out.smoothed[f], out.last[f])
        )
        if bad >= 0:
            return evidence, int(a + bad)
        evidence += gained
    return evidence, -1
