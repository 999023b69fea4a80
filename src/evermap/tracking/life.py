"""Updates of tracklets by a frame: filters, classes, beliefs and states after detections and misses.

Belief is one number, as in the persistence filter (MATH.md section 2): inverse odds, multiplied by
`p(detection | nobody known) / (P_D p(detection | it))` at a detection and by `1 / (1 - P_D)` at a miss. It confirms
tracklets, and kills them; an object that cannot be seen (`P_D = 0`) loses nothing by not being seen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.existence.kernels import aged, observed
from evermap.tracking.association import (
    NOBODY,
    Likelihood,
    Targets,
    assign,
    candidates,
    is_misplaced,
)
from evermap.tracking.frame import Frame
from evermap.tracking.kalman import kernel, update
from evermap.tracking.rows import (
    LEAST,
    MISSED,
    believed,
    displacement,
    end_spell,
    noise_of,
    reset_filter,
    settle,
    start_rest,
    update_level,
)
from evermap.tracking.shape import update_shape
from evermap.tracking.tracklets import (
    ALIVE,
    BIRTH,
    DEAD,
    LOST,
    WORKING_SET,
    EventKind,
    EventTable,
    Rules,
    SpellTable,
    Tracklets,
)
from evermap.types import BoolArray, FloatArray, IntArray

EVENT_BORN, EVENT_LOST, EVENT_FOUND = int(EventKind.BORN), int(EventKind.LOST), int(EventKind.FOUND)
EVENT_STORED, EVENT_DIED = int(EventKind.STORED), int(EventKind.DIED)
NOTHING = -1
MOST = 1e30
"""Bound of inverse odds."""


class InSight(NamedTuple):
    """Evidence of a frame on N tracklets.

    Attributes:
        p_detect: (N,) probability to detect each, if it is there.
        view_known: whether that comes from a view; otherwise a confirmed object that is missed may be out of view.
        death_odds: odds of having ceased to exist since the last frame, `(1 - q) / q`.
    """

    p_detect: FloatArray
    view_known: bool
    death_odds: float


class Happened(NamedTuple):
    """Room for what happens in a frame.

    Attributes:
        track_of_detection: (M,) ids of the detections that have an object.
        events: one a row.
        spells: static spells that end now.
    """

    track_of_detection: IntArray
    events: EventTable
    spells: SpellTable


@kernel
def recognise(t: Tracklets, i: int, frame: Frame, j: int, confusion: FloatArray, memory: float) -> None:
    """Update class and appearance of tracklet `i` after detection `j`."""
    detected = frame.class_id[j]
    if detected >= 0:
        total = 0.0
        for c in range(t.class_p.shape[1]):
            t.class_p[i, c] = max(t.class_p[i, c] * confusion[c, detected], 1e-12)  # nothing is ever out of question
            total += t.class_p[i, c]
        t.class_p[i] /= total
    given = False
    for k in range(t.appearance.shape[1]):
        given |= frame.appearance[j, k] != 0.0
    if given:
        length = 0.0
        kept = memory if np.any(t.appearance[i] != 0.0) else 0.0
        for k in range(t.appearance.shape[1]):
            t.appearance[i, k] = kept * t.appearance[i, k] + (1.0 - kept) * frame.appearance[j, k]
            length += t.appearance[i, k] ** 2
        t.appearance[i] /= max(math.sqrt(length), 1e-12)


@kernel
def live(
    t: Tracklets, n: int, frame: Frame, in_sight: InSight, likelihood: Likelihood, rules: Rules, happened: Happened
) -> tuple[int, int, int]:
    """Give a frame's detections to the first `n` tracklets, which have been predicted to it, and draw the consequences.

    Args:
        t: changed in place.
        n: rows in use.
        frame: its detections.
        in_sight: what the frame can say of each.
        likelihood: numbers of the settings.
        rules: when states change.
        happened: filled in.

    Returns:
        How many events, how many static spells, and how many tracklets that are no longer active.
    """
    p_detect, view_known, death_odds = in_sight
    track_of_detection, events, spells = happened
    targets = Targets(t.mean, t.covariance, t.class_p, t.appearance, t.box, t.inverse_odds, p_detect)
    pairs = candidates(targets, n, frame, likelihood)
    chosen = assign(pairs.start, pairs.column, pairs.cost, frame.position.shape[0])
    n_events, n_gone = 0, 0
    boxes, scored = t.box.shape[1] > 0, t.level.shape[1] > 0  # in the loop it costs a tenth
    n_spells = int(0)  # noqa: RUF046, UP018 (of a literal, `settle` and `end_spell` would be compiled once more)
    for i in range(n):
        predicted = aged(t.inverse_odds[i], death_odds)
        if chosen[i] != NOBODY:
            j = pairs.column[chosen[i]]
            track_of_detection[j] = t.track_id[i]
            gone = math.exp(-min(max(pairs.log_ratio[chosen[i]], -60.0), 60.0))
            after, _ = observed(predicted, max(p_detect[i], likelihood.least_p_detect), gone)
            t.inverse_odds[i] = max(after, LEAST)
            if boxes and is_misplaced(t.mean[i], t.covariance[i], frame.position[j], noise_of(frame, j), likelihood):
                update(t.mean[i], t.covariance[i], frame.position[j], likelihood.misplaced * noise_of(frame, j))
            else:
                update(t.mean[i], t.covariance[i], frame.position[j], noise_of(frame, j))
            recognise(t, i, frame, j, likelihood.confusion, rules.appearance_memory)
            t.n_hits[i] += 1
            t.n_missed[i] = 0
            if boxes:
                update_shape(t.box[i], frame.box[j], frame.box_noise[j], t.mean[i], t.covariance[i], rules)
            if scored:
                update_level(t, i, frame.level[j, 0], rules)
            n_spells = settle(t, i, frame, j, rules, spells, n_spells)
            if t.state[i] == LOST:
                t.state[i] = ALIVE
                events.kind[n_events], events.row[n_events] = EVENT_FOUND, i
                n_events += 1
            elif t.state[i] == BIRTH and believed(t, i, rules):
                t.state[i] = ALIVE
                events.kind[n_events], events.row[n_events] = EVENT_BORN, i
                n_events += 1
            continue
        if view_known or t.state[i] == BIRTH:
            after, _ = observed(predicted, max(1.0 - p_detect[i], 1e-12), 1.0)
            t.inverse_odds[i] = min(after, MOST)
        t.n_missed[i] += 1
        if scored:
            t.level[i, MISSED] += rules.missed_nats if p_detect[i] > 0.0 else 0.0
        what = NOTHING
        if t.inverse_odds[i] > rules.odds_dead:
            what = EVENT_DIED
            if t.static[i] == 1 and t.state[i] != BIRTH:
                n_spells = end_spell(t, i, frame.stamp_s, spells, n_spells)
        elif t.n_missed[i] > rules.max_missed:
            stays = t.state[i] != BIRTH and (t.static[i] == 1 or t.slow[i] == 1)
            what = EVENT_STORED if stays else EVENT_DIED
        elif t.state[i] == ALIVE and t.n_missed[i] >= rules.lost_after:
            t.state[i], what = LOST, EVENT_LOST
        if what in (EVENT_STORED, EVENT_DIED):
            n_gone += 1
            if t.state[i] == BIRTH:  # it never was anything
                what = NOTHING
            t.state[i] = WORKING_SET if what == EVENT_STORED else DEAD
        if what != NOTHING:
            events.kind[n_events], events.row[n_events] = what, i
            n_events += 1
    return n_events, n_spells, n_gone


@kernel
def match(targets: Targets, frame: Frame, likelihood: Likelihood) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Return the best assignment of detections to K places of rest.

    Returns:
        (F,) places that have one, (F,) the detections, (F,) log-likelihood ratio of each to being of nobody known,
        (F,) whether each is elsewhere than its place.
    """
    pairs = candidates(targets, targets.mean.shape[0], frame, likelihood)
    chosen = assign(pairs.start, pairs.column, pairs.cost, frame.position.shape[0])
    found = np.flatnonzero(chosen != NOBODY)
    pair = chosen[found]
    detection = pairs.column[pair]
    moved = np.empty(found.shape[0], dtype=np.bool_)
    for k in range(found.shape[0]):
        squared = displacement(
            frame.position[detection[k]],
            noise_of(frame, detection[k]),
            targets.mean[found[k]],
            targets.covariance[found[k]],
            0.0,
        )
        moved[k] = squared > likelihood.displaced
    return found, detection, pairs.log_ratio[pair], moved


@kernel
def resume(
    t: Tracklets,
    n: int,
    frame: Frame,
    detection: IntArray,
    moved: BoolArray,
    confusion: FloatArray,
    rules: Rules,
    spells: SpellTable,
) -> int:
    """Follow again the objects behind row `n`, copied from the working set.

    Args:
        t: changed in place.
        n: rows before the first of them.
        frame: the frame in which they are found.
        detection: (K,) what each is found by.
        moved: (K,) whether that is elsewhere than it was left.
        confusion: (C, C) `P(detected class | true class)`.
        rules: when states change.
        spells: out, static spells of those that moved.

    Returns:
        How many spells there are.
    """
    boxes, scored = t.box.shape[1] > 0, t.level.shape[1] > 0
    n_spells = int(0)  # noqa: RUF046, UP018 (as in `live`)
    for k in range(detection.shape[0]):
        i, j = n + k, detection[k]
        if moved[k]:
            if t.static[i] == 1:
                n_spells = end_spell(t, i, frame.stamp_s, spells, n_spells)
            t.elsewhere_s[i] = t.rest_seen_s[i]
            start_rest(t, i, frame.stamp_s, frame.position[j], noise_of(frame, j))
        else:
            update(t.rest_mean[i], t.rest_covariance[i], frame.position[j], noise_of(frame, j))
        t.state[i] = ALIVE
        reset_filter(t, i, frame, j, rules)
        recognise(t, i, frame, j, confusion, rules.appearance_memory)
        t.n_hits[i] += 1
        t.n_missed[i] = 0
        if boxes:
            update_shape(t.box[i], frame.box[j], frame.box_noise[j], t.mean[i], t.covariance[i], rules)
        if scored:
            update_level(t, i, frame.level[j, 0], rules)
        t.rest_seen_s[i] = frame.stamp_s
        t.slow[i] = 1
    return n_spells
