"""Compile (or load) what a job needs before it is timed: the same job, over a few frames that are made up."""

from __future__ import annotations

import functools
from typing import Literal

import numpy as np

from evermap.compiled import shared_with
from evermap.config import Config
from evermap.existence.lifetimes import log_death_odds
from evermap.geometry.se3 import NO_TURN
from evermap.pipeline import run_session, run_slam
from evermap.slam import warmup
from evermap.survival import GeneralPurpose
from evermap.types import (
    UNKNOWN,
    Detections,
    Frames,
    Odometry,
    Recording,
    Sensor,
    SlamResult,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    rows_of,
)

FRAMES = 24
"""Enough for more than one look along a cell of the lines of sight."""
PLACES = np.array([[2.0, 1.0], [3.0, -1.5], [5.0, 1.5], [4.0, 0.5], [3.5, 2.5], [6.0, -1.0]])
"""[m], beside a drive of 2.3 m along x."""


@functools.cache
def warm_up(
    *,
    search: bool = True,
    unknown_ids: bool | Literal["empty"] = False,
    sessions: bool = False,
    localize: bool = False,
    in_space: bool = False,
    traffic: bool = False,
) -> None:
    """Compile what a job needs, or load it where that was done before; the job does it by itself, while it is timed.

    Args:
        search: what the search for changes needs, too; see `slam.changes.joint.may_search`.
        unknown_ids: what landmarks without identities need.
        sessions: what sessions of a living map need.
        localize: what the frames of localising in one need, and nothing else.
        in_space: what recordings in space need, or sessions of them, and nothing else.
        traffic: what boxes without identity in these need, too.
    """
    config = Config(slam={"unknown_ids": unknown_ids, "plane": False if in_space else None})
    if unknown_ids:
        from evermap.slam.association.consensus import warm_up as of_the_association

        of_the_association()
    if in_space and localize and not traffic:
        from evermap.slam.localize_recording import warm_up_in_space

        warm_up_in_space()
        return
    if in_space:
        warmup.seldom_used()
    if in_space and sessions:
        first = run_session(_flight(0.0, len(PLACES) - 1), config=config)  # the last one appears in the second
        _done(first.slam, run_session(_flight(1e5), first.living, config).slam)
        return
    if in_space:
        if traffic:
            from evermap.tracking.run import warm_up as of_the_tracker

            of_the_tracker()
        _done(run_slam(_flight(0.0), config))
        return
    if localize:
        from evermap.slam.localize_recording import warm_up as of_the_localizer

        of_the_localizer()
        return
    with shared_with("evermap.cli.warmup"):  # about half of the time here, the other half at the end of this file
        warmup.filtered()
        if search or sessions:
            warmup.search_changes()
        log_death_odds((GeneralPurpose(1e-8, 1.0),), np.zeros(1, dtype=np.int64), np.zeros(1), np.ones(1))
    if unknown_ids:
        from evermap.slam.association.particles import warm_up as of_the_particles

        of_the_particles()
    if sessions:
        first = run_session(_drive(0.0), config=config)
        _done(first.slam, run_session(_drive(1e5), first.living, config).slam)
    else:
        _done(run_slam(_drive(0.0), config))


def _done(*results: SlamResult) -> None:
    """Raise `KeyboardInterrupt` where Ctrl-C ended one of the runs early: it was meant for the job."""
    if any(result.interrupted for result in results):
        raise KeyboardInterrupt


def _drive(start_s: float) -> Recording:
    """A straight drive past a few landmarks, of which the last is seen in every other frame only."""
    stamp_s = start_s + np.linspace(0.0, 0.1 * (FRAMES - 1), FRAMES)
    frame, place = (pairs.ravel() for pairs in np.meshgrid(np.arange(FRAMES), np.arange(len(PLACES)), indexing="ij"))
    seen = (place < len(PLACES) - 1) | (frame % 2 == 0)
    frame, place = frame[seen], place[seen]
    away = PLACES[place] - np.column_stack([0.1 * frame, np.zeros(len(frame))])
    unsaid, none = np.full(len(frame), np.nan), np.full(len(frame), UNKNOWN)
    distance, bearing = np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0])
    detections = Detections(frame, place, distance, bearing, none, unsaid, unsaid, np.zeros(len(frame), dtype=np.int64))
    odometry = Odometry(stamp_s, np.ones(FRAMES), np.zeros(FRAMES), np.zeros(FRAMES))
    sensor = Sensor(range_max_m=8.0, sigma_range_m=0.05, sigma_bearing_rad=0.02)
    return Recording("warm-up", odometry, Frames(stamp_s), detections, sensor)


def _flight(start_s: float, n_places: int = len(PLACES)) -> SpatialRecording:
    """The same in space, with objects that have an orientation; past some of them."""
    planar = _drive(start_s)
    seen = rows_of(planar.detections, planar.detections.landmark_id < n_places)
    count = len(seen)
    pose = np.zeros((FRAMES, 7))
    pose[:, 0], pose[:, 6] = 0.1 * np.arange(FRAMES), 1.0
    position = np.column_stack([PLACES[seen.landmark_id], np.ones(count)]) - pose[seen.frame, :3]
    unsaid = np.full(count, np.nan)
    detections = SpatialDetections(
        frame=seen.frame,
        sensor=seen.source_line,
        landmark_id=seen.landmark_id,
        position_sensor_m=position,
        rotation=np.tile(NO_TURN, (count, 1)),
        covariance_sensor_m2=np.full((count, 3, 3), np.nan),
        sigma_rad=unsaid,
        corner_px=np.full((count, 4, 2), np.nan),
        tag_size_m=unsaid,
        size_m=np.full((count, 3), np.nan),
        class_id=seen.class_id,
        score=unsaid,
        source_line=seen.source_line,
    )
    odometry = SpatialOdometry(planar.frames.stamp_s, pose, np.full((FRAMES, 6), np.nan))
    return Recording("warm-up", odometry, planar.frames, detections, sensors=(SpatialSensor(),))


if __name__ == "__main__":  # the second process: what is left when the first has compiled the filter and the search
    from evermap.slam.warmup import smoothed

    smoothed()
    run_slam(_drive(0.0))
