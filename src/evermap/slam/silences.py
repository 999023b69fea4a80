"""Silences of an odometry: it has no rows, or says that the robot stands, although the robot drives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from evermap.config import CheckConfig
from evermap.geometry import se3
from evermap.slam.gaps import SILENT_S, find_gaps
from evermap.slam.mistakes import HONEST
from evermap.slam.pairs import MOVED, make_pairs, off, sighting_pairs
from evermap.slam.ranges import has_range_changed
from evermap.types import AnyRecording, FloatArray, is_in_space, rows_of

STANDS = 1e-3
"""Speed up to which the odometry says that the robot stands [m/s, rad/s]."""


def find_silences(recording: AnyRecording, settings: CheckConfig) -> FloatArray:
    """Return (K, 2) from when to when the odometry has no rows, or says that the robot stands, although it drives [s].

    It drives if most pairs of sightings of several landmarks within such a time have moved in the sensor's view. Where
    the odometry never says anything, all of it is wrong, and nothing is silent.
    """
    odometry = recording.odometry
    if odometry is None or len(odometry) < 2:
        return np.zeros((0, 2))
    quiet_s = np.concatenate([find_gaps(odometry), _find_standstills(recording)])
    if not len(quiet_s):
        return quiet_s
    blind = not is_in_space(recording) and bool(np.isnan(recording.detections.bearing_rad).mean() > 0.5)
    first, second = sighting_pairs(recording, settings, with_bearing=not blind)
    if blind:
        moves = has_range_changed(recording, first, second)  # type: ignore[arg-type]
    elif len(first) >= settings.fewest:
        moves = off(make_pairs(recording, first, second).residual(HONEST, stands=True)[0]) > MOVED
    else:
        return np.zeros((0, 2))
    seen_s, landmark = recording.frames.stamp_s[recording.detections.frame], recording.detections.landmark_id[first]
    driven = np.zeros(len(quiet_s), dtype=np.bool_)
    for row, (start_s, stop_s) in enumerate(quiet_s.tolist()):
        own = (seen_s[first] >= start_s) & (seen_s[second] <= stop_s)
        several = len(np.unique(landmark[own & moves])) > 1
        driven[row] = np.count_nonzero(own) >= settings.fewest and several and np.mean(moves[own]) > 0.5
    return quiet_s[driven][np.argsort(quiet_s[driven, 0])]


def _find_standstills(recording: AnyRecording) -> FloatArray:
    """(K, 2) from when to when the odometry says for long that the robot stands [s]; none if it never says else."""
    odometry = recording.odometry
    assert odometry is not None
    step_s = np.diff(odometry.stamp_s)
    if is_in_space(recording):
        pose = recording.odometry.pose_world_robot  # type: ignore[union-attr]
        step = np.abs(se3.local(pose[:-1], pose[1:])).max(axis=1)
    else:
        driven = recording.odometry
        speeds = driven.forward_mps[:-1], driven.lateral_mps[:-1], driven.angular_radps[:-1]
        step = np.abs(speeds).max(axis=0) * step_s
    stands = step <= STANDS * step_s
    if stands.all():
        return np.zeros((0, 2))
    bounds = np.diff(np.concatenate([[False], stands, [False]]).astype(np.int64))
    span_s = odometry.stamp_s[np.column_stack([np.flatnonzero(bounds == 1), np.flatnonzero(bounds == -1)])]
    return span_s[span_s[:, 1] - span_s[:, 0] > SILENT_S]


def without_silences(recording: Any, silence_s: FloatArray) -> Any:
    """Return a recording without the odometry's rows within silences (K, 2): estimators know what a gap says."""
    if not len(silence_s):
        return recording
    stamp_s, silent = recording.odometry.stamp_s, np.zeros(len(recording.odometry), dtype=np.bool_)
    for start_s, stop_s in silence_s.tolist():  # poses hold at both ends, velocities from the first of them on
        silent |= ((stamp_s > start_s) if is_in_space(recording) else (stamp_s >= start_s)) & (stamp_s < stop_s)
    silent[0] = False
    return replace(recording, odometry=rows_of(recording.odometry, ~silent))
