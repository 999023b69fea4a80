"""Whether an object is where it was: the place of rest of a tracklet, its speed, and the static spells that follow.

Two tests, both with their uncertainty. *Speed*: `|v|^2` of the filter overestimates by the trace of its covariance
`P`; less that, it is compared with the square of the class' threshold in units of its standard deviation,
`sqrt(4 v'Pv + 2 tr P^2)`. *Displacement*: the filtered position against the mean of all detections since it came to
rest. The second sees the slow drift that no instant's velocity shows. An object that is not significantly fast and not
displaced for `rest_for_s` is static; it ceases to be when either test says so.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.tracking.frame import SpellTable
from evermap.tracking.kalman import update
from evermap.tracking.kernels import distance_and_log_det, inlined, kernel
from evermap.tracking.tracklets import Tracklets
from evermap.types import FloatArray

FAST = 2.33
"""Standard deviations above the threshold from which a speed is above it: one error in a hundred."""
DISPLACED = 30.66
"""Squared Mahalanobis distance from which a position is another: chi-square with 3 degrees of freedom at one in a
million, for the test is done at every detection, and one false alarm would cut a stay of days in two."""
MIDDLE = 2.366
"""Squared Mahalanobis distance up to which it is still in its place beyond doubt: the median. Whoever drives off is
outside long before the test of displacement says so, and whoever rests is inside every other time."""


@inlined
def speed_score(mean: FloatArray, covariance: FloatArray, threshold_mps: float) -> float:
    """Standard deviations by which the squared speed, without its bias, is above the squared threshold."""
    squared, trace, spread = 0.0, 0.0, 0.0
    for a in range(3):
        squared += mean[3 + a] * mean[3 + a]
        trace += covariance[3 + a, 3 + a]
        for b in range(3):
            p = covariance[3 + a, 3 + b]
            spread += 4.0 * mean[3 + a] * p * mean[3 + b] + 2.0 * p * p
    return (squared - trace - threshold_mps * threshold_mps) / math.sqrt(spread)


@inlined
def displacement(mean: FloatArray, covariance: FloatArray, place: FloatArray, place_covariance: FloatArray) -> float:
    """Squared Mahalanobis distance of a filter from a place; both have seen the same, so it comes out too small."""
    squared, _ = distance_and_log_det(
        mean[0] - place[0],
        mean[1] - place[1],
        mean[2] - place[2],
        covariance[0, 0] + place_covariance[0, 0],
        covariance[0, 1] + place_covariance[0, 1],
        covariance[0, 2] + place_covariance[0, 2],
        covariance[1, 1] + place_covariance[1, 1],
        covariance[1, 2] + place_covariance[1, 2],
        covariance[2, 2] + place_covariance[2, 2],
    )
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
    """From now on, the place is that of this detection."""
    t.rest_mean[i] = position
    t.rest_covariance[i] = noise
    t.rest_since_s[i] = t.rest_seen_s[i] = stamp_s
    t.static[i] = 0


@inlined
def departure(t: Tracklets, i: int, stamp_s: float) -> float:
    """When an object that is found moved set off, at the earliest: with constant jerk `d = v t / 3`."""
    d, v = 0.0, 1e-300
    for a in range(3):
        d += (t.mean[i, a] - t.rest_mean[i, a]) ** 2
        v += t.mean[i, 3 + a] ** 2
    return stamp_s - 3.0 * math.sqrt(d / v)


@kernel
def settle(
    t: Tracklets,
    i: int,
    stamp_s: float,
    position: FloatArray,
    noise: FloatArray,
    class_speed_mps: FloatArray,
    rest_for_s: float,
    spells: SpellTable,
    n_spells: int,
) -> int:
    """Renew the place of rest of tracklet `i` after a detection, and write the spell that this ends, if any."""
    score = speed_score(t.mean[i], t.covariance[i], class_speed_mps[np.argmax(t.class_p[i])])
    t.slow[i] = 1 if score <= 0.0 else 0
    squared = displacement(t.mean[i], t.covariance[i], t.rest_mean[i], t.rest_covariance[i])
    if score > FAST or squared > DISPLACED:
        if t.static[i] == 1:
            t.rest_seen_s[i] = max(t.rest_since_s[i], min(t.rest_seen_s[i], departure(t, i, stamp_s)))
            n_spells = end_spell(t, i, stamp_s, spells, n_spells)
        t.elsewhere_s[i] = t.rest_since_s[i]  # the only stamp at which it was elsewhere beyond doubt
        start_rest(t, i, stamp_s, position, noise)
        return n_spells
    update(t.rest_mean[i], t.rest_covariance[i], position, noise)
    if squared <= MIDDLE:
        t.rest_seen_s[i] = stamp_s
    if t.static[i] == 0 and t.slow[i] == 1 and stamp_s - t.rest_since_s[i] >= rest_for_s:
        t.static[i] = 1
        t.rest_since_s[i] = stamp_s  # it may have crept into its place; by now it is there
    return n_spells
