"""Gaps of an odometry, times of which it says nothing, and its spikes, of which what it says cannot be."""

from __future__ import annotations

import numpy as np

from evermap.config import CleaningConfig
from evermap.types import BoolArray, FloatArray, Odometry, SpatialOdometry

SILENT_S, FEW_STEPS = 2.0, 10.0
"""Time, and usual steps, without a row from which the odometry is silent, or with rows by which the robot stands."""


def find_gaps(odometry: Odometry | SpatialOdometry) -> FloatArray:
    """Return (K, 2) from when to when an odometry has no rows, for long beside its usual steps [s]."""
    step_s = np.diff(odometry.stamp_s)
    if not len(step_s):
        return np.zeros((0, 2))
    row = np.flatnonzero(step_s > max(SILENT_S, FEW_STEPS * float(np.median(step_s))))
    return np.column_stack([odometry.stamp_s[row], odometry.stamp_s[row + 1]])


def is_outside(gaps_s: FloatArray, start_s: FloatArray, stop_s: FloatArray) -> BoolArray:
    """Return (W,) which of some stretches of time have nothing of gaps (K, 2) within them."""
    found = np.ones(len(start_s), dtype=np.bool_)
    for since_s, until_s in gaps_s.tolist():
        found &= (start_s >= until_s) | (stop_s <= since_s)
    return found


def find_spikes(stamp_s: FloatArray, velocity: FloatArray, settings: CleaningConfig) -> BoolArray:
    """Return (N,) which velocities (K, N) differ from those around them by more than a robot can accelerate."""
    if len(stamp_s) < 3 or np.ptp(velocity, axis=1).max() <= settings.sharpest:  # as of most robots
        return np.zeros(len(stamp_s), dtype=np.bool_)
    step_s = np.diff(stamp_s)
    step_s = np.minimum(np.append(step_s, np.inf), np.insert(step_s, 0, np.inf))
    step_s = np.maximum(step_s, np.median(step_s))  # rows that are stamped when they arrive may come in bursts
    usual = np.stack([find_running_median(column, settings.around) for column in velocity])
    most = np.maximum(settings.hardest * step_s, settings.sharpest)
    return np.asarray(np.any(np.abs(velocity - usual) > most, axis=0))


def find_running_median(values: FloatArray, around: int) -> FloatArray:
    """Return (N,) the median of the `around` values centred on each; ends are padded with their values."""
    if len(values) == 0:
        return values
    padded = np.pad(values, around // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, around), axis=1))
