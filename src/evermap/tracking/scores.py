"""Log odds of a tracklet being a real object, from the scores of a detector.

A false alarm is often detected again in the next frame (a pole that looks like a person), so being seen once more is
weak evidence, and scores of one object are alike. The log odds that a tracklet is real are therefore a mean of the log
odds of its detections, which forgets, plus a little for every doubling of their number, less some for every frame in a
row that should have shown it and did not. Where detections have no scores, a tracklet is as real as it is there.
"""

from __future__ import annotations

import math

import numpy as np

from evermap.tracking.kalman import inlined, kernel
from evermap.tracking.tracklets import Rules, Tracklets
from evermap.types import FloatArray

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
