"""Forward and backward through the run-length filter's hypotheses, compiled: what happened, given all looks.

Looks are laid out on the time steps of the filter (`lattice`). The backward pass runs through the hypotheses that the
forward pass kept. To store all of it would take a megabyte for every thousand steps, so the forward pass keeps a
checkpoint every few thousand steps, and each stretch but the last is run again when the backward pass arrives there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evermap.existence.elementary import exp, expm1, kernel
from evermap.existence.protocol import LookColumns, Looks
from evermap.existence.run_length_kernels import (
    MOST,
    NO_MERGE,
    First,
    Law,
    RunHypotheses,
    Workspace,
    _look,
    _step,
    _sum,
    _week_bin,
    age_bin,
    begin,
    nothing_held,
    room,
)
from evermap.types import FloatArray, IntArray


def lattice(looks: Looks, step_s: float) -> LookColumns:
    """Return one feature's looks at (T + 1,) different instants, with steps between them as the filter takes them.

    After a look whole steps, and a shorter one before the next; likelihoods are 1 where there was no look.
    """
    stamp, first = np.unique(looks.stamp_s, return_index=True)
    _, *likelihoods = looks.columns()
    steps = np.maximum(np.ceil(np.diff(stamp) / step_s * (1.0 - 1e-12)).astype(np.int64), 1)
    place = np.concatenate([[0], np.cumsum(steps)])
    times = np.repeat(stamp[:-1], steps) + step_s * (np.arange(place[-1]) - np.repeat(place[:-1], steps))
    there, gone = np.ones(place[-1] + 1), np.ones(place[-1] + 1)
    there[place], gone[place] = (np.multiply.reduceat(values, first) for values in likelihoods)
    return LookColumns(np.append(times, stamp[-1]), there, gone)


STRETCH = 4096
"""Steps between two checkpoints."""


class SojournCounts(NamedTuple):
    """Expected events and exposure of absences (0) and stays (1), by age and time of the week.

    Attributes:
        events: (2, A, W) how many ended.
        exposure_s: (2, A, W) time spent, times the period's level.
        open_ended: (2, A) how many were going on at the end of the looks.
        of_period: (2, P) how many ended in each period of the calendar.
        expected_of_period: (2, P) how many would have by the hazards of the model alone, without the period's level.
    """

    events: FloatArray
    exposure_s: FloatArray
    open_ended: FloatArray
    of_period: FloatArray
    expected_of_period: FloatArray


class Calendar(NamedTuple):
    """Calendar times of T steps.

    Attributes:
        importance: (T,) weight of what happens in each step.
        period: (T,) period of the calendar of each step.
        level: (2, P) by what hazards are multiplied in each period.
    """

    importance: FloatArray
    period: IntArray
    level: FloatArray


@kernel
def _copy(held: RunHypotheses, out: RunHypotheses) -> None:
    """Copy hypotheses number by number, see `phase_kernels.copy_row`."""
    for s in range(2):
        out.number[s] = held.number[s]
        for j in range(held.start.shape[1]):
            out.start[s, j], out.weight[0, s, j] = held.start[s, j], held.weight[0, s, j]


@kernel
def _forward(
    steps: tuple[int, int], looks: LookColumns, calendar: Calendar, law: Law, held: RunHypotheses, space: Workspace,
    before: RunHypotheses, hazards: FloatArray, merges: IntArray, scales: FloatArray,
) -> None:  # fmt: skip
    """Take some steps, and keep hypotheses `before` each, its `hazards` and `merges`, and its look's probability."""
    a, b = steps
    stamp_s, present, absent = looks
    _, period, level = calendar
    for k in range(a, b):
        i = k - a
        _copy(held, RunHypotheses(before.start[i], before.weight[i], before.number[i]))
        scale = (level[0, period[k]], level[1, period[k]])
        _step(held, stamp_s[k], stamp_s[k + 1], law, scale, Workspace(hazards[i], space.scratch, merges[i]))
        scales[i] = _look(held, absent[k + 1], present[k + 1])


@kernel
def expectations(
    looks: LookColumns,
    calendar: Calendar,
    slots: int,
    law: Law,
    prior: First,
    counts_out: SojournCounts,
    smoothed: FloatArray,
) -> tuple[float, float]:
    """Add one feature's expected counts, and fill in its presence given all looks.

    Args:
        looks: T + 1 instants at most a step apart, in order and different, with their likelihoods.
        calendar: of the T steps.
        slots: places of a list of hypotheses.
        law: the model; its days are all of one kind.
        prior: its belief before the first look.
        counts_out: filled up.
        smoothed: (T + 1,) filled in.

    Returns:
        Log evidence of the looks (-inf if they are impossible), and the presence at the first instant, given all.
    """
    stamp_s, present, absent = looks
    importance, period, level = calendar
    steps = stamp_s.size - 1
    stretches = (steps + STRETCH - 1) // STRETCH
    held, space = nothing_held(slots, law), room(slots)
    start, weight, count = held
    most = min(steps, STRETCH)
    starts, weights, hazards = (np.empty((most, 2, slots)), np.empty((most, 1, 2, slots)), np.empty((most, 2, slots)))
    counts, merges = np.zeros((most, 2), dtype=np.int64), np.zeros((most, 2), dtype=np.int64)
    scales = np.zeros(most)
    before = RunHypotheses(starts, weights, counts)
    kept_start, kept_weight = np.zeros((stretches + 1, 2, slots)), np.zeros((stretches + 1, 1, 2, slots))
    kept_count = np.zeros((stretches + 1, 2), dtype=np.int64)

    begin(held, stamp_s[0], prior)
    evidence = np.log(_look(held, absent[0], present[0]))
    for c in range(stretches):
        _copy(held, RunHypotheses(kept_start[c], kept_weight[c], kept_count[c]))
        a, b = c * STRETCH, min(steps, (c + 1) * STRETCH)
        _forward((a, b), looks, calendar, law, held, space, before, hazards, merges, scales)
        for i in range(b - a):
            evidence += np.log(scales[i])
    if not np.isfinite(evidence):
        return -np.inf, 0.0

    n_bins, n_groups = law.hazard_hz.shape[1], counts_out.events.shape[1]
    group = np.arange(n_bins) // ((n_bins + n_groups - 1) // n_groups)
    weeks = counts_out.events.shape[2]
    for s in range(2):
        for j in range(count[s]):
            oldest = age_bin(stamp_s[steps] - start[s, j], law)
            counts_out.open_ended[s, group[oldest]] += weight[0, s, j] * (importance[steps - 1] if steps else 1.0)
    smoothed[steps] = weight[0, 1, : count[1]].sum()

    # what the looks to come say for each hypothesis, after this step and before it
    later, sooner = np.ones((2, slots)), np.ones((2, slots))
    usual, sums, ahead = np.empty((2, slots)), np.empty((4, slots)), np.empty(slots)
    lived, died, part = np.empty(slots), np.empty(slots), np.empty(slots)
    for c in range(stretches - 1, -1, -1):
        a, b = c * STRETCH, min(steps, (c + 1) * STRETCH)
        if c < stretches - 1:  # the last stretch is still there
            _copy(RunHypotheses(kept_start[c], kept_weight[c], kept_count[c]), held)
            _forward((a, b), looks, calendar, law, held, space, before, hazards, merges, scales)
        for k in range(b - 1, a - 1, -1):
            i = k - a
            now, then = stamp_s[k], stamp_s[k + 1]
            gap, middle = then - now, 0.5 * (now + then)
            week = _week_bin(middle, law.factor.shape[2])
            column = week if weeks > 1 else 0
            there, when = 0.0, period[k]
            for s in range(2):
                same = (present[k + 1] if s == 1 else absent[k + 1]) / scales[i]
                other = (absent[k + 1] if s == 1 else present[k + 1]) / scales[i]
                newcomer = counts[i, 1 - s]
                if merges[i, 1 - s] != NO_MERGE and newcomer > merges[i, 1 - s]:
                    newcomer -= 1
                other *= later[1 - s, newcomer]
                n, drift = counts[i, s], level[s, when]
                for j in range(n):
                    usual[s, j] = hazards[i, s, j] * law.factor[0, s, week]
                    x = min(drift * usual[s, j], MOST)
                    p_end, p_live = -expm1(-x), exp(-x)
                    died[j], lived[j] = p_end * other, p_live * same
                    # a stay that ends in this step lasted on the mean for this part of it
                    part[j] = 0.5 - x / 12.0 if x < 1e-2 else 1.0 / x - p_live / p_end
                merged = merges[i, s]
                for j in range(n if merged == NO_MERGE else merged + 1):
                    ahead[j] = later[s, j]
                for j in range(n if merged == NO_MERGE else merged + 1, n):
                    ahead[j] = later[s, j - 1]
                for j in range(n):
                    mass, lives, ends = weights[i, 0, s, j], lived[j] * ahead[j], died[j]
                    sooner[s, j] = lives + ends
                    sums[0, j] = mass * (lives + ends)
                    sums[1, j] = mass * ends
                    sums[2, j] = mass * (lives + part[j] * ends)
                    sums[3, j] = usual[s, j] * sums[2, j]
                if s == 1:
                    there = _sum(sums, 0, n)
                weigh, spend = importance[k], importance[k] * drift * gap
                for j in range(n):
                    row = group[age_bin(middle - starts[i, s, j], law)]
                    counts_out.events[s, row, column] += weigh * sums[1, j]
                    counts_out.exposure_s[s, row, column] += spend * sums[2, j]
                counts_out.of_period[s, when] += _sum(sums, 1, n)
                counts_out.expected_of_period[s, when] += _sum(sums, 3, n)
            smoothed[k] = there
            later, sooner = sooner, later
    return evidence, smoothed[0]


@kernel
def expect_all(
    first: IntArray,
    looks: LookColumns,
    calendar: Calendar,
    slots: int,
    law: Law,
    prior: First,
    counts_out: SojournCounts,
    smoothed: FloatArray,
) -> float:
    """Add the expected counts of F features by `expectations`, and fill in their presence; returns the log evidence.

    Args:
        first: (F + 1,) first instant of each feature in `looks`, and their number; F fewer steps than instants.
        looks: of all features.
        calendar: of the steps of all features.
        slots: as of `expectations`, likewise the others.
        law: the model.
        prior: its belief before the first look.
        counts_out: filled up.
        smoothed: of every instant, filled in.
    """
    stamp_s, present, absent = looks
    importance, period, level = calendar
    evidence = 0.0
    for f in range(len(first) - 1):
        a, b, c, d = first[f], first[f + 1], first[f] - f, first[f + 1] - f - 1
        own = LookColumns(stamp_s[a:b], present[a:b], absent[a:b])
        when = Calendar(importance[c:d], period[c:d], level)
        evidence += expectations(own, when, slots, law, prior, counts_out, smoothed[a:b])[0]
    return evidence
