"""Expected changes of phase and times spent in them, given uncertain looks: the E-step of the EM algorithm, compiled.

Forward over the looks, backward over the pieces between them. For a piece with forward row `a` and backward column `b`
the expectations are those of `int a exp(Q s) (x) exp(Q (t - s)) b ds` (Hobolth and Jensen 2011); uniformisation turns
the integral into `sum_m (a U^m) (x) g_m / q` with `g_m = w_{m+1} b + U g_{m+1}`, all of it positive: two passes, where
the double sum over jumps before and after would need its square.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evermap.existence.elementary import inlined, kernel
from evermap.existence.phase_kernels import NEGLIGIBLE, PhaseLooks, advance, copy_row, jump, observe
from evermap.existence.rhythm import BIN_S, BINS, MONDAY_S, WEEK_S
from evermap.types import FloatArray, IntArray

PIECE = 16.0
"""Most expected jumps in one piece."""
_TERMS = 128
"""More than a Poisson variable of mean `PIECE` has with a chance of 1e-17."""


class Generator(NamedTuple):
    """A chain of n phases.

    Attributes:
        rates: (B, n, n) rates of changes of phase at each time of the week (B is 1008 or 1).
        exits: (B, n) sums of their rows.
        present: (n,) 1.0 where a phase is 'there'.
    """

    rates: FloatArray
    exits: FloatArray
    present: FloatArray


class Forgetting(NamedTuple):
    """Weights of expectations over time.

    Attributes:
        end_s: instant at which they weigh 1.
        half_life_s: by how much earlier they weigh half; inf: all the same.
    """

    end_s: float
    half_life_s: float


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
    """Return the integral over a piece, divided by the probability of the piece; `backward` goes to its begin, likewise
    divided.

    Args:
        forward: (n,) belief at the begin.
        backward: (n,) likelihood of all that comes after, at the end; at the begin afterwards.
        rates: (n, n) constant rates.
        exits: (n,) sums of their rows.
        span_s: length, at most `PIECE` jumps long.
        spare: (_TERMS + 1, n), (_TERMS + 2,) and (2, n) arrays to work in.
        integral: (n, n) filled in; times the rates these are expected changes, its diagonal is time spent.

    Returns:
        The probability.
    """  # fmt: skip
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
    chain: Generator, begin_s: float, begin: FloatArray, looks: PhaseLooks, fading: Forgetting, out: Expectations
) -> tuple[float, int]:
    """Add one feature's expectations to `out`; evidence, and the look that is impossible or -1.

    Args:
        chain: of the feature.
        begin_s: where the belief starts, not after the first look.
        begin: (n,) that belief.
        looks: at the feature.
        fading: of older events.
        out: filled in, integrals added to.
    """
    rates, exits, present = chain
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
    chain: Generator,
    begin_s: FloatArray,
    begin: FloatArray,
    first: IntArray,
    looks: PhaseLooks,
    fading: Forgetting,
    out: Expectations,
) -> tuple[float, int]:
    """Return `expect_feature` of all features; the sum of their evidence, and the first look that is impossible or
    -1.
    """
    evidence = 0.0
    for f in range(begin_s.size):
        a, b = first[f], first[f + 1]
        own = PhaseLooks(looks.stamp_s[a:b], looks.there[a:b], looks.gone[a:b])
        gained, bad = expect_feature(
            chain, begin_s[f], begin[f], own, fading, Expectations(out.integrals, out.smoothed[f], out.last[f])
        )
        if bad >= 0:
            return evidence, int(a + bad)
        evidence += gained
    return evidence, -1
