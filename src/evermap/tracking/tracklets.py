"""The tracker's state: a struct of arrays, one row per tracklet; and the states of tracklets."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from evermap.types import FloatArray, IntArray


class TrackState(IntEnum):
    """The five states of a tracklet (Bateman 2020, section 4.1)."""

    BIRTH = 0
    """Warming up: too few detections, or too little belief, to be told from false alarms."""
    ALIVE = 1
    """Followed."""
    LOST = 2
    """Followed until a few frames ago."""
    WORKING_SET = 3
    """Static and out of view: may be seen again, where it was."""
    DEAD = 4
    """Given up."""


BIRTH, ALIVE, LOST, WORKING_SET, DEAD = map(int, TrackState)
"""The same as numbers, which kernels read, and loops faster than attributes of an enumeration."""


class EventKind(IntEnum):
    """Events of tracklets."""

    BORN = 0
    """It is ALIVE for the first time; the stamp is that of its first detection."""
    LOST = 1
    FOUND = 2
    """ALIVE again before it was given up."""
    STORED = 3
    """Put into the working set."""
    REIDENTIFIED = 4
    DIED = 5


N_DETECTED, N_FILTERED, N_LEVEL = 4, 9, 3
"""Numbers of a detected box, of one in the state, and of what scores say."""
YAW, VARIANCE, FORWARD = 3, 4, 8
"""Where a box in the state has its heading, its four variances, and the log odds that the heading is not opposite."""


class Rules(NamedTuple):
    """When tracklets change their state; see `TrackerConfig`."""

    odds_confirm: float
    odds_dead: float
    warm_up: int
    lost_after: int
    max_missed: int
    class_speed_mps: FloatArray
    rest_for_s: float
    appearance_memory: float
    sigma_velocity_mps: float
    sigma_acceleration_mps2: float
    inverse_odds_new: float
    speed_per_length_hz: float
    place_m2: float
    log_odds_believed: float
    score_memory: float
    seen_nats: float
    missed_nats: float
    most_counted: int
    fast_sigmas: float
    displaced: float
    forward_nats: float
    most_forward_nats: float
    sure_of_way: float


class Tracklets(NamedTuple):
    """The active tracklets: rows 0 to n - 1 are in use, those behind are room to grow. Changed in place by kernels.

    States of a filter are (position xyz, velocity xyz, acceleration xyz), D = 9, or D = 6 without the last.

    Attributes:
        track_id: (N,) unique over all time.
        state: (N,) a `TrackState`.
        mean: (N, D) filtered motion; covariance: (N, D, D).
        class_p: (N, C) posterior over classes.
        appearance: (N, A) unit vectors, zeros where none was given.
        box: (N, 9) size and heading as `kalman` says, (N, 0) of points.
        level: (N, 3) mean log odds of its detections to be real, their weight, and what misses since the last one take
            from them, see `life`; (N, 0) where detections have no scores.
        inverse_odds: (N,) `(1 - p) / p` of being a real object that is there.
        n_hits: (N,) detections so far; n_missed: (N,) frames in a row without one.
        first_s: (N,) first detection.
        rest_mean: (N, 3) the place where it has stayed lately; rest_covariance: (N, 3, 3).
        rest_since_s, rest_seen_s: (N,) first and last detection that was in that place beyond doubt.
        elsewhere_s: (N,) last stamp at which it was elsewhere, or its place was seen empty; -inf where unknown.
        static: (N,) 1 where its stay has been long enough to be a static spell.
        slow: (N,) 1 where its speed was not above its class' threshold at its last detection.
    """

    track_id: IntArray
    state: IntArray
    mean: FloatArray
    covariance: FloatArray
    class_p: FloatArray
    appearance: FloatArray
    box: FloatArray
    level: FloatArray
    inverse_odds: FloatArray
    n_hits: IntArray
    n_missed: IntArray
    first_s: FloatArray
    rest_seen_s: FloatArray
    rest_mean: FloatArray
    rest_covariance: FloatArray
    rest_since_s: FloatArray
    elsewhere_s: FloatArray
    static: IntArray
    slow: IntArray


def room_for(
    n: int, order: int, n_classes: int, n_appearance: int, *, boxes: bool = False, scored: bool = False
) -> Tracklets:
    """Return room for `n` tracklets, with `order` derivatives of the position, itself included."""
    d = 3 * order
    shape = {"mean": (d,), "covariance": (d, d), "class_p": (n_classes,), "appearance": (n_appearance,)}
    shape |= {"rest_mean": (3,), "rest_covariance": (3, 3), "box": (N_FILTERED * boxes,), "level": (N_LEVEL * scored,)}
    whole = {"track_id", "state", "n_hits", "n_missed", "static", "slow"}
    columns: dict[str, Any] = {
        name: np.zeros((n, *shape.get(name, ())), np.int64 if name in whole else np.float64)
        for name in Tracklets._fields
    }
    return Tracklets(**columns)


def grown(tracklets: Tracklets, n: int) -> Tracklets:
    """Return the same tracklets with room for `n`."""
    return Tracklets(*(np.concatenate([a, np.zeros((n - len(a), *a.shape[1:]), dtype=a.dtype)]) for a in tracklets))


def sweep(tracklets: Tracklets, n: int) -> int:
    """Remove those of the first `n` that are no longer active, by moving the last ones there; how many are left."""
    active = tracklets.state[:n] < WORKING_SET
    left = int(np.count_nonzero(active))
    gaps = np.flatnonzero(~active[:left])
    if not len(gaps):  # the last ones went, as false alarms do
        return left
    movers = left + np.flatnonzero(active[left:])[::-1]
    for column in tracklets:
        column[gaps] = column[movers]
    return left


class EventTable(NamedTuple):
    """Room for what happens in a frame, one row each.

    Attributes:
        kind: (K,) an `EventKind`.
        row: (K,) the tracklet's row.
    """

    kind: IntArray
    row: IntArray


class SpellTable(NamedTuple):
    """Buffer for static spells that end in a frame, one row each.

    Attributes:
        track_id, class_id: (K,) whose.
        position: (K, 3) where.
        times: (K, 4) last seen elsewhere, first seen there, last seen there, first seen gone.
    """

    track_id: IntArray
    class_id: IntArray
    position: FloatArray
    times: FloatArray
