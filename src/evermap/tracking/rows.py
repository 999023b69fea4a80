"""Rows of the struct of arrays: started, copied and deleted; and the test for rest.

The place of rest of a tracklet, its speed, and the static spells that follow.

Two tests, both with their uncertainty. *Speed*: `|v|^2` of the filter overestimates by the trace of its covariance
`P`; less that, it is compared with the square of the class' threshold in units of its standard deviation,
`sqrt(4 v'Pv + 2 tr P^2)`. *Displacement*: the filtered position against the mean of all detections since it came to
rest. The second sees the slow drift that no instant's velocity shows. An object that is not significantly fast and not
displaced for `rest_for_s` is static; it ceases to be when either test says so.

Log odds of a tracklet being a real object, from the scores of a detector: a false alarm is often detected again in the
next frame (a pole that looks like a person), so being seen once more is weak evidence, and scores of one object are
alike. The log odds that a tracklet is real are therefore a mean of the log odds of its detections, which forgets, plus
a little for every doubling of their number, less some for every frame in a row that should have shown it and did not.
Where detections have no scores, a tracklet is as real as it is there.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.tracking.frame import Frame
from evermap.tracking.kalman import distance_and_log_det, inlined, kernel, sum_of, update
from evermap.tracking.shape import begin_shape
from evermap.tracking.tracklets import ALIVE, BIRTH, YAW, Rules, SpellTable, Tracklets
from evermap.types import FloatArray, IntArray

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
        begin_level(t, i, frame.level[j, 0])
        if frame.level[j, 0] < np.inf:  # something is there; what the score doubts is that it is real
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
def begin_level(t: Tracklets, i: int, log_odds: float) -> None:
    """Set what scores say of a new tracklet; infinite log odds are those of a detection without a score."""
    t.level[i] = 0.0
    t.level[i, LEVEL] = log_odds
    t.level[i, WEIGHT] = 1.0 if log_odds < np.inf else 0.0


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
