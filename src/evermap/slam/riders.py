"""Riders: what moves with the robot, as a tag on the robot itself, or on what it tows or follows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from evermap.config import CheckConfig
from evermap.slam.mistakes import HONEST
from evermap.slam.pairs import MOVED, make_pairs, off, sighting_pairs
from evermap.types import AnyRecording, IntArray, is_in_space, rows_of

RIDES, NEARLY = 0.2, 0.9
"""What moves with the robot changes in view by less than this, over what the odometry says, in more of its pairs."""


def find_riders(recording: AnyRecording, settings: CheckConfig) -> IntArray:
    """Return identities of what moves with the robot: a tag on the robot itself, or on what it tows or follows.

    By pairs of sightings between which the odometry says that a landmark must have moved in the sensor's view: nearly
    all of a rider show it where it was, while the others, seen then, have moved as the odometry says.
    """
    none = np.zeros(0, dtype=np.int64)
    first, second = sighting_pairs(recording, settings)
    if len(first) < settings.fewest or (pairs := make_pairs(recording, first, second)).still:
        return none
    frame, identity = recording.detections.frame[first], recording.detections.landmark_id[first]
    in_view, against_odometry = (off(pairs.residual(HONEST, stands=stands)[0]) for stands in (True, False))
    shows = against_odometry > MOVED
    if is_in_space(recording):  # a box may keep its distance: the tracker follows it
        shows &= ~np.isfinite(recording.detections.size_m[first]).all(axis=1)
    found = list[int]()
    for one in np.unique(identity[shows]).tolist():
        mine = np.flatnonzero(shows & (identity == one))
        others = np.flatnonzero((identity != one) & np.isin(frame, frame[mine]))
        if min(len(mine), len(others)) < settings.fewest:
            continue
        rests = in_view[mine] < RIDES * against_odometry[mine]
        is_right = np.median(against_odometry[others]) < np.median(in_view[others])  # or all else rides as well
        if np.mean(rests) > NEARLY and is_right:
            found.append(one)
    return np.array(found, dtype=np.int64)


def without_riders(recording: Any, riders: IntArray) -> Any:
    """Return a recording without the detections of some identities."""
    if not len(riders):
        return recording
    stays = ~np.isin(recording.detections.landmark_id, riders)
    return replace(recording, detections=rows_of(recording.detections, stays))
