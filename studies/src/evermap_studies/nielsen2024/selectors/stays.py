"""Kernels of a chain whose modes have a lifetime: exact dynamic programming over (mode, look at which its stay began).

They take the looks at one landmark block by block, because the transitions are a table over looks times beginnings:
`log_stay`, `log_leave` (B, S) are those over the gap before look `low + b`, of a stay that began at look `began[s]`;
entries of stays that begin later are not read. `gone` is the column that is never left, or -1.
"""

from __future__ import annotations

import math

from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.compiled import kernel, log_add


@kernel
def decode_rows(
    low: int,
    log_likelihood: FloatArray,
    log_start: FloatArray,
    log_stay: FloatArray,
    log_leave: FloatArray,
    gone: int,
    older: int,
    value: FloatArray,
    back_mode: IntArray,
    back_began: IntArray,
    began: IntArray,
) -> None:
    """Viterbi over the looks `low` to `low + B` of T.

    Of the S stays, `older` began before `low`, the others begin at `low`, `low + 1` and so on, as `began` (S,) says.
    `value` (K, S) is the log joint probability of the best sequence that ends in each stay, in and out. Fills
    `back_mode` and `back_began` (T, K): the stay that one in `k` that begins at look `n` follows on.
    """
    modes = log_likelihood.shape[1]
    for b in range(log_stay.shape[0]):
        n = low + b
        new = older + b
        if n == 0:
            value[:, 0] = log_start + log_likelihood[0]
            continue
        best, second = -1, -1
        best_value, second_value = -math.inf, -math.inf
        best_stay, second_stay = -1, -1
        for j in range(modes):
            if j == gone:
                continue
            top, at = -math.inf, -1
            for s in range(new):
                left = value[j, s] + log_leave[b, s]
                if left > top:
                    top, at = left, s
            if top > best_value:
                second, second_value, second_stay = best, best_value, best_stay
                best, best_value, best_stay = j, top, at
            elif top > second_value:
                second, second_value, second_stay = j, top, at
        for k in range(modes):
            for s in range(new):
                value[k, s] += log_likelihood[n, k] + (0.0 if k == gone else log_stay[b, s])
            other, entered, stay = best, best_value, best_stay
            if k == best:
                other, entered, stay = second, second_value, second_stay
            value[k, new] = entered + log_likelihood[n, k]
            back_mode[n, k] = other
            back_began[n, k] = began[stay] if stay >= 0 else -1


@kernel
def trace_back(
    mode: int, start: int, count: int, back_mode: IntArray, back_began: IntArray, indicator: IntArray
) -> None:
    """Fill `indicator` (T,) from its last stay, in `mode` since look `start`, backwards."""
    stop = count
    while True:
        indicator[start:stop] = mode
        if start == 0:
            return
        stop = start
        mode, start = back_mode[stop, mode], back_began[stop, mode]


@kernel
def filter_rows(
    low: int,
    log_likelihood: FloatArray,
    log_start: FloatArray,
    log_stay: FloatArray,
    log_leave: FloatArray,
    gone: int,
    weight: FloatArray,
    filtered: FloatArray,
    left: FloatArray,
) -> None:
    """The forward pass over the looks `low` to `low + B` of T; the stay of column `s` began at look `s`.

    `weight` (K, T) is the log probability of each stay together with the looks so far, in and out. Fills `filtered`
    (T, K), the same of each mode, and `left` (T, K), of each being left for one particular other before look `n`.
    """
    modes = log_likelihood.shape[1]
    for b in range(log_stay.shape[0]):
        n = low + b
        if n == 0:
            weight[:, 0] = log_start + log_likelihood[0]
            filtered[0] = weight[:, 0]
            left[0] = -math.inf
            continue
        for j in range(modes):
            left[n, j] = -math.inf if j == gone else _total_of_sum(weight[j], log_leave[b], n)
        for k in range(modes):
            entered = -math.inf
            for j in range(modes):
                if j != k:
                    entered = log_add(entered, left[n, j])
            for s in range(n):
                weight[k, s] += log_likelihood[n, k] + (0.0 if k == gone else log_stay[b, s])
            weight[k, n] = entered + log_likelihood[n, k]
            filtered[n, k] = _total_of(weight[k], n + 1)


@kernel
def smooth_rows(
    low: int,
    log_likelihood: FloatArray,
    log_stay: FloatArray,
    log_leave: FloatArray,
    gone: int,
    later: FloatArray,
    follow: FloatArray,
) -> None:
    """The backward pass over the looks `low + B - 1` down to `low`; the stay of column `s` began at look `s`.

    `later` (K, T) is the log probability of the looks after n by mode at n and stay, in and out: zeros for the last
    look, then one look further back at every step. Fills `follow` (T, K), the log probability of look `n` and all
    later ones if a stay in `k` begins there.
    """
    modes = log_likelihood.shape[1]
    for b in range(log_stay.shape[0] - 1, -1, -1):
        n = low + b
        for k in range(modes):
            follow[n, k] = log_likelihood[n, k] + later[k, n]
        if n == 0:
            return
        for k in range(modes):
            if k == gone:
                for s in range(n):
                    later[k, s] += log_likelihood[n, k]
                continue
            others = -math.inf
            for j in range(modes):
                if j != k:
                    others = log_add(others, follow[n, j])
            for s in range(n):
                kept = log_stay[b, s] + log_likelihood[n, k] + later[k, s]
                later[k, s] = log_add(kept, log_leave[b, s] + others)


@kernel
def marginals(
    log_start: FloatArray, left: FloatArray, follow: FloatArray, evidence: float, probability: FloatArray
) -> None:
    """Fill `probability` (T, K) of every mode at every look: stays that have begun less stays that have ended.

    Each is a posterior probability of its own (what came before times what follows); the sums are exact to the
    rounding of numbers below 1, and clipped to [0, 1].
    """
    count, modes = left.shape
    for k in range(modes):
        held = math.exp(log_start[k] + follow[0, k] - evidence)
        probability[0, k] = held
        for n in range(1, count):
            entered, followed = -math.inf, -math.inf
            for j in range(modes):
                if j != k:
                    entered = log_add(entered, left[n, j])
                    followed = log_add(followed, follow[n, j])
            held += math.exp(entered + follow[n, k] - evidence) - math.exp(left[n, k] + followed - evidence)
            probability[n, k] = min(max(held, 0.0), 1.0)


@kernel
def _total_of(values: FloatArray, count: int) -> float:
    """`log sum exp` of the first values."""
    top = -math.inf
    for s in range(count):
        top = max(top, values[s])
    if top == -math.inf:
        return top
    weight = 0.0
    for s in range(count):
        weight += math.exp(values[s] - top)
    return top + math.log(weight)


@kernel
def _total_of_sum(a: FloatArray, b: FloatArray, count: int) -> float:
    """`log sum exp(a + b)` of the first values."""
    top = -math.inf
    for s in range(count):
        top = max(top, a[s] + b[s])
    if top == -math.inf:
        return top
    weight = 0.0
    for s in range(count):
        weight += math.exp(a[s] + b[s] - top)
    return top + math.log(weight)
