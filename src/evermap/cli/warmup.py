"""Compile (or load) what a job needs before it is timed: the same job, over a few frames that are made up."""

from __future__ import annotations

import functools

import numpy as np

from evermap.config import Config
from evermap.pipeline import run_session, run_slam
from evermap.slam.localize_recording import warm_up as of_the_localizer
from evermap.slam.warmup import warm_up as of_the_estimator
from evermap.types import UNKNOWN, Detections, Frames, Odometry, Recording, Sensor

FRAMES = 24
"""So many that a cell of the lines of sight is looked along more than once."""
PLACES = np.array([[2.0, 1.0], [3.0, -1.5], [5.0, 1.5], [4.0, 0.5]])
"""[m], beside a drive of 2.3 m along x."""


@functools.cache
def warm_up(*, search: bool = True, unknown_ids: bool = False, sessions: bool = False, localize: bool = False) -> None:
    """Compile what a job needs, or load it where that was done before; the job does it by itself, while it is timed.

    Args:
        search: what the search for changes needs, too; see `slam.changes.joint.may_search`.
        unknown_ids: what landmarks without identities need.
        sessions: what sessions of a living map need.
        localize: what the frames of localising in one need, and nothing else.
    """
    if localize:
        of_the_localizer()
        return
    of_the_estimator(search=search or sessions)
    if sessions:
        run_session(_drive(1e5), run_session(_drive(0.0)).living)
    else:
        run_slam(_drive(0.0), Config(slam={"unknown_ids": unknown_ids}))


def _drive(start_s: float) -> Recording:
    """A straight drive past a few landmarks, of which the last is seen in every other frame only."""
    stamp_s = start_s + np.linspace(0.0, 0.1 * (FRAMES - 1), FRAMES)
    frame, place = (pairs.ravel() for pairs in np.meshgrid(np.arange(FRAMES), np.arange(len(PLACES)), indexing="ij"))
    seen = (place < len(PLACES) - 1) | (frame % 2 == 0)
    frame, place = frame[seen], place[seen]
    away = PLACES[place] - np.column_stack([0.1 * frame, np.zeros(len(frame))])
    unsaid = np.full(len(frame), np.nan)
    return Recording(
        "warm-up",
        Odometry(stamp_s, np.ones(FRAMES), np.zeros(FRAMES), np.zeros(FRAMES)),
        Frames(stamp_s),
        Detections(
            frame,
            place,
            np.hypot(*away.T),
            np.arctan2(away[:, 1], away[:, 0]),
            np.full(len(frame), UNKNOWN),
            unsaid,
            unsaid,
            np.zeros(len(frame), dtype=np.int64),
        ),
        Sensor(range_max_m=8.0, sigma_range_m=0.05, sigma_bearing_rad=0.02),
    )
