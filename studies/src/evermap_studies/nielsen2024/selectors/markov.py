"""Kernels of a chain without memory, over the looks at one landmark: smoothing and decoding in `O(T K^2)`, `O(T K)`.

Arguments of both: `log_likelihood` (T, K); `log_start` (K,); `log_stay` (T,) of keeping the mode over the gap before
each look; `log_leave` (T,) of leaving it for one particular other; `gone`, the column that is never left, or -1.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.types import FloatArray, IntArray
from evermap_studies.nielsen2024.selectors.compiled import kernel, log_add


@kernel
def smooth(
    log_likelihood: FloatArray,
    log_start: FloatArray,
    log_stay: FloatArray,
    log_leave: FloatArray,
    gone: int,
    filtered: FloatArray,
    smoothed: FloatArray,
) -> float:
    """Forward-backward in log space.

    Fills `filtered` and `smoothed` (T, K), log posteriors of the modes given the looks so far and given all; returns
    the log evidence, -inf where no sequence is possible.
    """
    count, modes = log_likelihood.shape
    for n in range(count):
        for k in range(modes):
            if n == 0:
                reached = log_start[k]
            else:
                reached = -math.inf
                for j in range(modes):
                    reached = log_add(reached, filtered[n - 1, j] + _step(j, k, log_stay[n], log_leave[n], gone))
            filtered[n, k] = reached + log_likelihood[n, k]
    evidence = total(filtered[count - 1])
    later = np.zeros(modes)  # log probability of the looks after n, by the mode at n
    earlier = np.empty(modes)
    for n in range(count - 1, -1, -1):
        smoothed[n] = filtered[n] + later
        for j in range(modes):
            value = -math.inf
            if n > 0:
                for k in range(modes):
                    step = _step(j, k, log_stay[n], log_leave[n], gone)
                    value = log_add(value, step + log_likelihood[n, k] + later[k])
            earlier[j] = value
        later[:] = earlier
    for n in range(count):
        filtered[n] -= total(filtered[n])
        smoothed[n] -= total(smoothed[n])
    return evidence


@kernel
def decode(
    log_likelihood: FloatArray,
    log_start: FloatArray,
    log_stay: FloatArray,
    log_leave: FloatArray,
    gone: int,
    indicator: IntArray,
) -> float:
    """Viterbi: fills `indicator` (T,) with the most probable sequence; returns its log joint probability.

    Among equally probable ones the sequence that changes late and prefers low columns.
    """
    count, modes = log_likelihood.shape
    back = np.empty((count, modes), dtype=np.int64)
    value = log_start + log_likelihood[0]
    new = np.empty(modes)
    for n in range(1, count):
        best, second = -1, -1
        for k in range(modes):
            if k == gone:
                continue
            if best < 0 or value[k] > value[best]:
                best, second = k, best
            elif second < 0 or value[k] > value[second]:
                second = k
        for k in range(modes):
            back[n, k] = k
            new[k] = value[k] + (0.0 if k == gone else log_stay[n])
            other = second if k == best else best
            if other >= 0 and value[other] + log_leave[n] > new[k]:
                new[k] = value[other] + log_leave[n]
                back[n, k] = other
            new[k] += log_likelihood[n, k]
        value[:] = new
    last = np.argmax(value)
    joint = value[last]
    for n in range(count - 1, -1, -1):
        indicator[n] = last
        last = back[n, last] if n > 0 else last
    return float(joint)


@kernel
def _step(before: int, after: int, log_stay: float, log_leave: float, gone: int) -> float:
    """Log probability of a transition."""
    if before == gone:
        return 0.0 if after == gone else -math.inf
    return log_stay if before == after else log_leave


@kernel
def total(values: FloatArray) -> float:
    """`log sum exp`; -inf for nothing but -inf."""
    top = -math.inf
    for value in values:
        top = max(top, value)
    if top == -math.inf:
        return top
    weight = 0.0
    for value in values:
        weight += math.exp(value - top)
    return top + math.log(weight)
