"""Gaps of an odometry: times of which it says nothing."""

from __future__ import annotations

import numpy as np

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
