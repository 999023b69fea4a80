"""Rows of the struct of arrays: begun, copied, and given up."""

from __future__ import annotations

import numpy as np

from evermap.tracking.frame import Frame, Rules
from evermap.tracking.kernels import inlined, kernel
from evermap.tracking.rest import start_rest
from evermap.tracking.tracklets import Tracklets, TrackState
from evermap.types import FloatArray, IntArray

BIRTH, WORKING_SET = int(TrackState.BIRTH), int(TrackState.WORKING_SET)


@inlined
def noise_of(frame: Frame, j: int) -> FloatArray:
    """Covariance (3, 3) of a detection."""
    shared: FloatArray = frame.noise[0]
    return shared if frame.noise.shape[0] == 1 else frame.noise[j]


@kernel
def start(t: Tracklets, i: int, track_id: int, frame: Frame, j: int, confusion: FloatArray, rules: Rules) -> None:
    """Begin a tracklet in row `i` with detection `j`: at rest as far as anybody knows, of any class that fits."""
    t.track_id[i] = track_id
    t.state[i] = BIRTH
    t.class_p[i] = 1.0 / t.class_p.shape[1]
    t.appearance[i] = 0.0
    place_filter(t, i, frame.position[j], noise_of(frame, j), rules)
    detected = frame.class_id[j]
    if detected >= 0:
        t.class_p[i] *= confusion[:, detected]
        t.class_p[i] /= max(t.class_p[i].sum(), 1e-300)
    t.appearance[i] = frame.appearance[j]
    t.inverse_odds[i] = rules.inverse_odds_new
    t.n_hits[i] = 1
    t.n_missed[i] = 0
    t.first_s[i] = frame.stamp_s
    t.elsewhere_s[i] = -np.inf
    t.slow[i] = 0
    start_rest(t, i, frame.stamp_s, frame.position[j], noise_of(frame, j))


@kernel
def place_filter(t: Tracklets, i: int, position: FloatArray, covariance: FloatArray, rules: Rules) -> None:
    """A filter that knows a position, and of its derivatives how large they usually are."""
    t.mean[i] = 0.0
    t.covariance[i] = 0.0
    t.mean[i, :3] = position
    t.covariance[i, :3, :3] = covariance
    for k in range(3, t.mean.shape[1]):
        sigma = rules.sigma_velocity_mps if k < 6 else rules.sigma_acceleration_mps2
        t.covariance[i, k, k] = sigma * sigma


@kernel
def start_all(
    t: Tracklets, n: int, next_id: int, frame: Frame, free: IntArray, confusion: FloatArray,
    rules: Rules, track_of_detection: IntArray,
) -> None:  # fmt: skip
    """Begin a tracklet behind row `n` with each of the detections `free`."""
    for k in range(free.shape[0]):
        start(t, n + k, next_id + k, frame, free[k], confusion, rules)
        track_of_detection[free[k]] = next_id + k


@kernel
def copy_row(t: Tracklets, into: int, row: int) -> None:
    """Overwrite row `into` by `row`."""
    t.track_id[into], t.state[into] = t.track_id[row], t.state[row]
    t.mean[into], t.covariance[into] = t.mean[row], t.covariance[row]
    t.class_p[into], t.appearance[into] = t.class_p[row], t.appearance[row]
    t.inverse_odds[into], t.n_hits[into], t.n_missed[into] = t.inverse_odds[row], t.n_hits[row], t.n_missed[row]
    t.first_s[into], t.rest_seen_s[into] = t.first_s[row], t.rest_seen_s[row]
    t.rest_mean[into], t.rest_covariance[into] = t.rest_mean[row], t.rest_covariance[row]
    t.rest_since_s[into], t.elsewhere_s[into] = t.rest_since_s[row], t.elsewhere_s[row]
    t.static[into], t.slow[into] = t.static[row], t.slow[row]


@kernel
def sweep(t: Tracklets, n: int) -> int:
    """Remove tracklets that are no longer active, by moving the last ones into the gaps; how many are left."""
    i = 0
    while i < n:
        if t.state[i] >= WORKING_SET:
            n -= 1
            if i < n:
                copy_row(t, i, n)
        else:
            i += 1
    return n
