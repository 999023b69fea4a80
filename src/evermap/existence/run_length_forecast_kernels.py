"""How long the present state lasts, hypothesis by hypothesis through the hours of the week, compiled."""

from __future__ import annotations

import numpy as np

from evermap.existence.elementary import exp, expm1, kernel
from evermap.existence.rhythm import BIN_S, MONDAY_S, WEEK_S
from evermap.existence.run_length_kernels import MOST, Law, _hazards, _sum, _week_bin
from evermap.types import FloatArray, IntArray

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
    start: FloatArray,
    left: FloatArray,
    n: int,
    s: int,
    now: float,
    later: float,
    law: Law,
    scratch: FloatArray,
    spent: FloatArray,
) -> None:
    """Take from `left[s]` what ends before `later`; `spent[s]` is how long each went on, times its probability."""
    week = _week_bin(0.5 * (now + later), law.factor.shape[1])
    _hazards(start, n, s, now, later, law.factor[s, week], law, scratch)
    gap = later - now
    for j in range(n):
        x, mass = scratch[s, j], left[s, j]
        spent[s, j] = mass * gap * (-expm1(-x) / x if x > 1e-9 else 1.0)
        left[s, j] = mass * exp(-x) if x < MOST else 0.0


@kernel
def lasting_rows(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now_s: FloatArray,
    s: int,
    asked_s: FloatArray,
    law: Law,
    out: FloatArray,
) -> None:
    """Probability that state `s` goes on without a break until instants in order, given that it is the present one."""
    scratch, spent = np.empty((2, start.shape[2])), np.empty((2, start.shape[2]))
    constant = law.factor.shape[1] == 1
    for f in range(len(now_s)):
        left, n, now = weight[f].copy(), count[f, s], now_s[f]
        total = _sum(left, s, n)
        for k in range(len(asked_s)):
            while now < asked_s[k]:
                later = asked_s[k] if constant else min(_step_end(now, law), asked_s[k])
                _go_on(start[f], left, n, s, now, later, law, scratch, spent)
                now = later
            out[f, k] = min(_sum(left, s, n) / total, 1.0) if total > 0.0 else np.nan


@kernel
def remaining_rows(
    start: FloatArray,
    weight: FloatArray,
    count: IntArray,
    now_s: FloatArray,
    s: int,
    law: Law,
    weeks: int,
    out: FloatArray,
) -> None:
    """Expected time that state `s` goes on, given that it is the present one: step by step for some weeks.

    Of what is left then, each further week leaves the same part as the last one did.
    """
    scratch, spent = np.empty((2, start.shape[2])), np.empty((2, start.shape[2]))
    for f in range(len(now_s)):
        left, n, now = weight[f].copy(), count[f, s], now_s[f]
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
                _go_on(start[f], left, n, s, now, later, law, scratch, spent)
                of_week += _sum(spent, s, n)
                now = later
            passed += of_week
            kept = _sum(left, s, n) / before
            if _sum(left, s, n) < _NOTHING * total:
                kept = 0.0
                break
        out[f] = np.inf if kept == 1.0 else (passed + of_week * kept / (1.0 - kept)) / total
