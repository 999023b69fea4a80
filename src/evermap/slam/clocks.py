"""How late clocks are, and when one steps, by pairs of sightings: the odometry of another time between them tells it
without a solution.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from math import inf

import numpy as np

from evermap.config import CheckConfig
from evermap.slam.mistakes import DELAYS_S, HONEST, Mistake, make_late
from evermap.slam.pairs import USUAL, Pairs, PlanarPairs, measure_loss, off, pairs_of, sighting_pairs
from evermap.types import FloatArray, IntArray, Recording, SpatialRecording

LATEST_S, DELAY_STEP_S, DELAY_FINE_S = 5.0, 0.25, 0.01
"""Delays that are tried: up to this, at first in such steps, within which motions are alike, and at last in these."""
FALLS = 0.2
"""Share by which the loss of pairs must fall."""
LIKELIEST_BY = 250
"""Pairs that show which delay is the likeliest for a whole recording."""
LEAST_STEP_S = 0.4
"""Minimum clock difference that is reported; smaller ones are estimated by the calibration."""


def find_pair_loss(pairs: Pairs, settings: CheckConfig, mistake: Mistake = HONEST) -> float:
    """Return Cauchy's loss of pairs of sightings [nats], those without a mistake of the readings."""
    apart = np.minimum(off(pairs.residual(mistake)), 10.0)
    return float(np.log1p((apart / settings.fits) ** 2).sum())


def find_delay(pairs: Pairs, settings: CheckConfig) -> float:
    """Return by how much stamps of detections are late for landmarks to stand still [s].

    The score of a solution sees a delay as far as motions last, some .1 s; pairs of sightings say how far it is.
    """
    best, step = 0.0, DELAY_STEP_S
    tried = np.arange(-LATEST_S, LATEST_S + step, step)
    while step > DELAY_FINE_S:
        losses = [find_pair_loss(pairs, settings, late_by(by)) for by in tried.tolist()]
        best = float(tried[int(np.argmin(losses))])
        tried, step = best + step * np.linspace(-1.0, 1.0, 9), step / 4.0
    return best


def late_by(delay_s: float) -> Mistake:
    """Return the mistake of detections that are stamped so late: to their clock the odometry is early."""
    return Mistake("clock", "", delay_s=-delay_s)


def are_of_several_clocks(recording: SpatialRecording, settings: CheckConfig) -> bool:
    """Return whether some of the sensors are late by another delay than others, against the odometry.

    What one sees is nearer to standing still by its own delay than by that of another sensor, by what a mistake must
    gain.
    """
    seen = recording.detections
    parts = (replace(recording, detections=seen[seen.sensor == row]) for row in range(len(recording.sensors)))
    told = [pairs for pairs in (pairs_of(part, settings) for part in parts) if pairs is not None and not pairs.still]
    delays = [find_delay(pairs, settings) for pairs in told]
    for pairs, own_s in zip(told, delays, strict=True):
        least = find_pair_loss(pairs, settings, late_by(own_s))
        most = max(find_pair_loss(pairs, settings, late_by(other_s)) for other_s in delays)
        if most - least > max(settings.gain, FALLS * most):
            return True
    return False


def clock_steps(recording: Recording, longest_s: float = inf) -> tuple[FloatArray, FloatArray]:
    """Return from when on the odometry's clock is ahead of the detections', and by how much.

    Piecewise constant, by dynamic programming (Viterbi 1967): in every second a pair of sightings has a Cauchy loss, on
    the scale of the usual residual, at each delay, and a step costs `CheckConfig.gain`.

    Args:
        recording: in the plane.
        longest_s: by how much a step may be at most; delays that are further from the likeliest one are not tried.

    Returns:
        (K,) stamps of frames, the first -inf, and (K,) delays that hold from then on [s].
    """
    settings = USUAL
    first, second = sighting_pairs(recording, settings)
    if len(first) < settings.fewest:
        return np.array([-inf]), np.zeros(1)
    pairs = PlanarPairs(recording, first, second)
    delays_s = np.concatenate([[0.0, 0.5, -0.5], DELAYS_S, np.negative(DELAYS_S)])
    if longest_s < np.ptp(delays_s):  # a share of the pairs shows which is likeliest
        part = pairs.among(slice(None, None, max(1, len(first) // LIKELIEST_BY)))
        usual_s = delays_s[np.argmin(measure_loss(part.residual(*map(make_late, delays_s)), settings))]
        delays_s = delays_s[np.abs(delays_s - usual_s) <= longest_s + 0.5]
    far = np.minimum(off(pairs.residual(*map(make_late, delays_s))), 10.0)
    until_s = recording.frames.stamp_s[recording.detections.frame[second]]
    begin_s, second_of = np.unique(np.floor(until_s), return_inverse=True)
    usual, path = settings.fits, np.zeros(len(begin_s), dtype=np.int64)
    for _ in range(2):  # the usual difference is only visible at the right delays
        usual = max(settings.fits, float(np.median(far[path[second_of], np.arange(len(first))])))
        # a sighting is in two pairs
        loss = 0.5 * np.log1p((far / usual) ** 2)
        path = _cheapest(np.stack([np.bincount(second_of, row, len(path)) for row in loss], axis=1), settings.gain)
    begin = np.flatnonzero(np.diff(path, prepend=-1))
    since_s, delay_s = [-inf], [0.0]
    for row, (start, stop) in enumerate(pairwise([*begin.tolist(), len(path)])):
        mine = (second_of >= start) & (second_of < stop)
        near_s = delays_s[path[start]] + 0.1 * np.arange(-5, 6)
        left = measure_loss(pairs.residual(*map(make_late, near_s))[..., mine], settings)
        found = float(near_s[int(np.argmin(left))])
        if row == 0:
            delay_s[0] = found
        elif abs(found - delay_s[-1]) > LEAST_STEP_S:
            since_s.append(float(begin_s[start]))
            delay_s.append(found)
    return np.array(since_s), np.array(delay_s)


def _cheapest(loss: FloatArray, step: float) -> IntArray:
    """(T,) options, one for each row of a table of losses (T, D), of which each change costs `step`."""
    total, came = loss[0].copy(), np.zeros(loss.shape, dtype=np.int64)
    every = np.arange(loss.shape[1])
    for row in range(1, len(loss)):
        best = int(np.argmin(total))
        changed = total > total[best] + step
        came[row] = np.where(changed, best, every)
        total = np.where(changed, total[best] + step, total) + loss[row]
    path = np.full(len(loss), np.argmin(total), dtype=np.int64)
    for row in range(len(loss) - 1, 0, -1):
        path[row - 1] = came[row, path[row]]
    return path
