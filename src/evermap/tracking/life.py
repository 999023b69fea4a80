"""Lives of tracklets: rows are started, updated by a frame, and given up; filters, classes, beliefs, rest, states.

*Belief* is one number, as in the persistence filter (MATH.md section 2): inverse odds, multiplied by
`p(detection | nobody known) / (P_D p(detection | it))` at a detection and by `1 / (1 - P_D)` at a miss. It confirms
tracklets, and kills them; an object that cannot be seen (`P_D = 0`) loses nothing by not being seen.

*Rest* has two tests, both with their uncertainty. *Speed*: `|v|^2` of the filter overestimates by the trace of its
covariance `P`; less that, it is compared with the square of the class' threshold in units of its standard deviation,
`sqrt(4 v'Pv + 2 tr P^2)`. *Displacement*: the filtered position against the mean of all detections since it came to
rest. The second sees the slow drift that no instant's velocity shows. An object that is not significantly fast and not
displaced for `rest_for_s` is static; it ceases to be when either test says so.

*Scores* of a detector: a false alarm is often detected again in the next frame (a pole that looks like a person), so
being seen once more is weak evidence, and scores of one object are alike. The log odds that a tracklet is real are
therefore a mean of the log odds of its detections, which forgets, plus a little for every doubling of their number,
less some for every frame in a row that should have shown it and did not. Where detections have no scores, a tracklet is
as real as it is there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from evermap.existence.kernels import aged, observed
from evermap.tracking.association import NOBODY, Likelihood, Targets, assign, candidates, is_misplaced
from evermap.tracking.frame import Frame
from evermap.tracking.kalman import begin_shape, distance_and_log_det, inlined, kernel, sum_of, update, update_shape
from evermap.tracking.tracklets import (
    ALIVE,
    BIRTH,
    DEAD,
    LOST,
    WORKING_SET,
    YAW,
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
LEAST = 1e-12
"""Bound of inverse odds: however long an object was watched, a dozen misses may undo it."""
MIDDLE = 2.366
"""Squared Mahalanobis distance up to which it is still in its place beyond doubt: the median. Whoever drives off is
outside long before the test of displacement says so, and whoever rests is inside every other time."""


@inlined
def noise_of(frame: Frame, j: int) -> FloatArray:
    """Return the covariance (3, 3) of a detection."""
    shared: FloatArray = frame.noise[0]
    return shared if frame.noise.shape[0] == 1 else frame.noise[j]


@inlined
def speed_score(mean: FloatArray, covariance: FloatArray, threshold_mps: float) -> float:
    """Return standard deviations by which the squared speed, without its bias, is above the squared threshold."""
    squared, trace, spread = 0.0, 0.0, 0.0
    for a in range(3):
        squared += mean[3 + a] * mean[3 + a]
        trace += covariance[3 + a, 3 + a]
        for b in range(3):
            p = covariance[3 + a, 3 + b]
            spread += 4.0 * mean[3 + a] * p * mean[3 + b] + 2.0 * p * p
    return (squared - trace - threshold_mps * threshold_mps) / math.sqrt(spread)


@inlined
def displacement(
    mean: FloatArray, covariance: FloatArray, place: FloatArray, place_covariance: FloatArray, place_m2: float
) -> float:
    """Return the squared Mahalanobis distance of a filter from a place; both have seen the same, so it comes out too
    small.

    `place_m2` is the variance of what detections of an object at rest have in common for a while: the centre of a box
    wanders with the side that is seen.
    """
    offset = mean[0] - place[0], mean[1] - place[1], mean[2] - place[2]
    xx, xy, xz, yy, yz, zz = sum_of(covariance, place_covariance)
    squared, _ = distance_and_log_det(offset, (xx + place_m2, xy, xz, yy + place_m2, yz, zz + place_m2))
    return squared


@kernel
def end_spell(t: Tracklets, i: int, gone_s: float, spells: SpellTable, n_spells: int) -> int:
    """Write the spell of a static tracklet, first seen gone at `gone_s`; how many there are then."""
    spells.track_id[n_spells] = t.track_id[i]
    spells.class_id[n_spells] = np.argmax(t.class_p[i])
    for a in range(3):
        spells.position[n_spells, a] = t.rest_mean[i, a]
    spells.times[n_spells, 0] = t.elsewhere_s[i]
    spells.times[n_spells, 1] = t.rest_since_s[i]
    spells.times[n_spells, 2] = t.rest_seen_s[i]
    spells.times[n_spells, 3] = gone_s
    return n_spells + 1


@kernel
def start_rest(t: Tracklets, i: int, stamp_s: float, position: FloatArray, noise: FloatArray) -> None:
    """Set the place of rest to that of this detection."""
    t.rest_mean[i] = position
    t.rest_covariance[i] = noise
    t.rest_since_s[i] = t.rest_seen_s[i] = stamp_s
    t.static[i] = 0


@inlined
def departure(t: Tracklets, i: int, stamp_s: float) -> float:
    """Return when an object that is found moved set off, at the earliest: with constant jerk `d = v t / 3`."""
    d, v = 0.0, 1e-300
    for a in range(3):
        d += (t.mean[i, a] - t.rest_mean[i, a]) ** 2
        v += t.mean[i, 3 + a] ** 2
    return stamp_s - 3.0 * math.sqrt(d / v)


@kernel
def settle(t: Tracklets, i: int, frame: Frame, j: int, rules: Rules, spells: SpellTable, n_spells: int) -> int:
    """Renew the place of rest of tracklet `i` after detection `j`, and write the spell that this ends, if any."""
    stamp_s, position, noise = frame.stamp_s, frame.position[j], noise_of(frame, j)
    score = speed_score(t.mean[i], t.covariance[i], rules.class_speed_mps[np.argmax(t.class_p[i])])
    t.slow[i] = 1 if score <= 0.0 else 0
    squared = displacement(t.mean[i], t.covariance[i], t.rest_mean[i], t.rest_covariance[i], rules.place_m2)
    if score > rules.fast_sigmas or squared > rules.displaced:
        if t.static[i] == 1:
            t.rest_seen_s[i] = max(t.rest_since_s[i], min(t.rest_seen_s[i], departure(t, i, stamp_s)))
            n_spells = end_spell(t, i, stamp_s, spells, n_spells)
        t.elsewhere_s[i] = t.rest_since_s[i]  # the only stamp at which it was elsewhere beyond doubt
        start_rest(t, i, stamp_s, position, noise)
        return n_spells
    update(t.rest_mean[i], t.rest_covariance[i], position, noise)
    if squared <= MIDDLE:
        t.rest_seen_s[i] = stamp_s
    if t.static[i] == 0 and t.slow[i] == 1 and stamp_s - t.rest_since_s[i] >= rules.rest_for_s:
        t.static[i] = 1
        t.rest_since_s[i] = stamp_s  # it may have crept into its place; by now it is there
    return n_spells


@inlined
def believed(t: Tracklets, i: int, rules: Rules) -> bool:
    """Return whether a tracklet is to be confirmed: by its scores, or without them by detections and belief."""
    if t.level.shape[1] and t.level[i, LEVEL] < np.inf:
        return log_odds_real(t, i, rules) >= rules.log_odds_believed
    return bool(t.n_hits[i] >= rules.warm_up and t.inverse_odds[i] <= rules.odds_confirm)


@kernel
def start(t: Tracklets, i: int, track_id: int, frame: Frame, j: int, confusion: FloatArray, rules: Rules) -> None:
    """Start a tracklet in row `i` with detection `j`: assumed at rest, of any compatible class."""
    t.track_id[i] = track_id
    t.state[i] = BIRTH
    t.class_p[i] = 1.0 / t.class_p.shape[1]
    t.appearance[i] = 0.0
    reset_filter(t, i, frame, j, rules)
    if t.box.shape[1]:
        begin_shape(t.box[i], frame.box[j], frame.box_noise[j], rules.forward_nats)
    detected = frame.class_id[j]
    if detected >= 0:
        t.class_p[i] *= confusion[:, detected]
        t.class_p[i] /= max(t.class_p[i].sum(), 1e-300)
    t.appearance[i] = frame.appearance[j]
    t.inverse_odds[i] = rules.inverse_odds_new
    if t.level.shape[1]:
        scored = frame.level[j, 0] < np.inf
        t.level[i] = 0.0
        t.level[i, LEVEL], t.level[i, WEIGHT] = frame.level[j, 0], 1.0 if scored else 0.0
        if scored:  # something is there; what the score doubts is that it is real
            t.inverse_odds[i] = LEAST
    t.n_hits[i] = 1
    t.n_missed[i] = 0
    t.first_s[i] = frame.stamp_s
    t.elsewhere_s[i] = -np.inf
    t.slow[i] = 0
    start_rest(t, i, frame.stamp_s, frame.position[j], noise_of(frame, j))
    if believed(t, i, rules):
        t.state[i] = ALIVE


@kernel
def reset_filter(t: Tracklets, i: int, frame: Frame, j: int, rules: Rules) -> None:
    """Set a filter to a detection, and its derivatives to their usual spread: along a box its length counts."""
    t.mean[i] = 0.0
    t.covariance[i] = 0.0
    t.mean[i, :3] = frame.position[j]
    t.covariance[i, :3, :3] = noise_of(frame, j)
    for k in range(3, t.mean.shape[1]):
        sigma = rules.sigma_velocity_mps if k < 6 else rules.sigma_acceleration_mps2
        t.covariance[i, k, k] = sigma * sigma
    if t.box.shape[1]:
        c, s = math.cos(frame.box[j, YAW]), math.sin(frame.box[j, YAW])
        more = (rules.speed_per_length_hz * frame.box[j, 0]) ** 2
        t.covariance[i, 3, 3] += more * c * c
        t.covariance[i, 4, 4] += more * s * s
        t.covariance[i, 3, 4] += more * c * s
        t.covariance[i, 4, 3] += more * c * s


@kernel
def start_all(
    t: Tracklets, n: int, next_id: int, frame: Frame, free: IntArray, confusion: FloatArray,
    rules: Rules, track_of_detection: IntArray,
) -> int:  # fmt: skip
    """Begin a tracklet behind row `n` with each of the detections `free`; return how many are ALIVE at once."""
    n_alive = 0
    for k in range(free.shape[0]):
        start(t, n + k, next_id + k, frame, free[k], confusion, rules)
        track_of_detection[free[k]] = next_id + k
        n_alive += t.state[n + k] == ALIVE
    return n_alive


LEVEL, WEIGHT, MISSED = 0, 1, 2
"""Columns of a level."""


@inlined
def update_level(t: Tracklets, i: int, log_odds: float, rules: Rules) -> None:
    """Update what scores say of a tracklet by a detection."""
    t.level[i, MISSED] = 0.0
    if log_odds == np.inf:
        return
    if t.level[i, WEIGHT] == 0.0:
        t.level[i, LEVEL] = 0.0
    t.level[i, WEIGHT] = rules.score_memory * t.level[i, WEIGHT] + 1.0
    t.level[i, LEVEL] += (log_odds - t.level[i, LEVEL]) / t.level[i, WEIGHT]


@inlined
def log_odds_real(t: Tracklets, i: int, rules: Rules) -> float:
    """Return the log odds that a tracklet is real, infinite where no detection of it has a score."""
    again = rules.seen_nats * math.log(min(t.n_hits[i], rules.most_counted))
    return float(t.level[i, LEVEL] + again - t.level[i, MISSED])


@kernel
def p_real(t: Tracklets, n: int, rules: Rules) -> FloatArray:
    """Return (n,) probabilities that tracklets of a tracker with scores are real."""
    found = np.empty(n)
    for i in range(n):
        found[i] = 1.0 / (1.0 + math.exp(-min(max(log_odds_real(t, i, rules), -700.0), 700.0)))
    return found


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


@kernel
def recognise(
    t: Tracklets, i: int, frame: Frame, j: int, confusion: FloatArray, rules: Rules, boxes: bool, scored: bool
) -> None:
    """Update tracklet `i` after detection `j`: class, appearance, counts, shape and score."""
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
        kept = rules.appearance_memory if np.any(t.appearance[i] != 0.0) else 0.0
        for k in range(t.appearance.shape[1]):
            t.appearance[i, k] = kept * t.appearance[i, k] + (1.0 - kept) * frame.appearance[j, k]
            length += t.appearance[i, k] ** 2
        t.appearance[i] /= max(math.sqrt(length), 1e-12)
    t.n_hits[i] += 1
    t.n_missed[i] = 0
    if boxes:
        update_shape(t.box[i], frame.box[j], frame.box_noise[j], t.mean[i], t.covariance[i], rules)
    if scored:
        update_level(t, i, frame.level[j, 0], rules)


@kernel
def live(
    t: Tracklets, n: int, frame: Frame, in_sight: InSight, likelihood: Likelihood, rules: Rules,
    track_of_detection: IntArray, events: EventTable, spells: SpellTable,
) -> tuple[int, int, int]:  # fmt: skip
    """Give a frame's detections to the first `n` tracklets, which have been predicted to it, and draw the consequences.

    Args:
        t: changed in place.
        n: rows in use.
        frame: its detections.
        in_sight: what the frame can say of each.
        likelihood: numbers of the settings.
        rules: when states change.
        track_of_detection: (M,) filled in, ids of the detections that have an object.
        events: filled in.
        spells: filled in, static spells that end now.

    Returns:
        How many events, how many static spells, and how many tracklets that are no longer active.
    """
    p_detect, view_known, death_odds = in_sight
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
            recognise(t, i, frame, j, likelihood.confusion, rules, boxes, scored)
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
        i, j = found[k], detection[k]
        squared = displacement(frame.position[j], noise_of(frame, j), targets.mean[i], targets.covariance[i], 0.0)
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
        recognise(t, i, frame, j, confusion, rules, boxes, scored)
        t.rest_seen_s[i] = frame.stamp_s
        t.slow[i] = 1
    return n_spells
