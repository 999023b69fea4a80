"""How late clocks are, by pairs of sightings: the odometry of another time between them tells it without a solution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap.config import CheckConfig
from evermap.slam.mistakes import HONEST, Mistake, Pairs, off, pairs_of
from evermap.types import SpatialRecording

LATEST_S, DELAY_STEP_S, DELAY_FINE_S = 5.0, 0.25, 0.01
"""Delays that are tried: up to this, at first in such steps, within which motions are alike, and at last in these."""
FALLS = 0.2
"""Share by which the loss of pairs must fall."""


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
