"""What a run of the tracker says afterwards: tracks from their first detection to their last, and all events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.errors import DataError
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import Event, Followed, TrackState
from evermap.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Tracks:
    """Objects over time, one row an object and frame, sorted by track and time.

    Attributes:
        stamp_s: (R,) frames.
        track_id: (R,).
        state: (R,) a `TrackState`.
        position_m, velocity_mps: (R, 3) in the world, filtered.
        position_covariance_m2, velocity_covariance_m2ps2: (R, 3, 3).
        class_p: (R, C) posterior over classes.
        p_exists: (R,) probability of being a real object that is there.
        static: (R,) whether it had been where it was for long enough to be static.
    """

    stamp_s: FloatArray
    track_id: IntArray
    state: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    position_covariance_m2: FloatArray
    velocity_covariance_m2ps2: FloatArray
    class_p: FloatArray
    p_exists: FloatArray
    static: BoolArray

    def __len__(self) -> int:
        return len(self.stamp_s)


class Recorder:
    """Collects what a tracker says, frame after frame."""

    def __init__(self) -> None:
        self._frames: list[Followed] = []
        self.events: list[Event] = []

    def add(self, tracker: Tracker, events: list[Event]) -> None:
        """The tracker right after a frame, and what that frame brought about."""
        self._frames.append(tracker.followed())
        self.events.extend(events)

    def tracks(self) -> Tracks:
        """Everything about tracklets that were confirmed sooner or later, their first frames too.

        Rows after the last detection before a tracklet was given up are left out: they were guesses.

        Raises:
            DataError: no frame was recorded.
        """
        frames = self._frames
        if not frames:
            raise DataError("no frame was tracked")
        counts = [len(f) for f in frames]
        frame = np.repeat(np.arange(len(frames)), counts)
        columns = {
            name: np.concatenate([getattr(f, name) for f in frames]) for name in Followed.__slots__ if name != "stamp_s"
        }
        ids = columns["track_id"]
        confirmed = np.isin(ids, np.unique(ids[columns["state"] != TrackState.BIRTH]))
        order = np.lexsort((frame, ids))
        order = order[confirmed[order]]
        keep = order[~_given_up_after(ids[order], frame[order], columns["n_missed"][order], len(frames))]
        stamps = np.array([f.stamp_s for f in frames])
        return Tracks(stamp_s=stamps[frame[keep]], **{n: c[keep] for n, c in columns.items() if n != "n_missed"})


def _given_up_after(ids: IntArray, frame: IntArray, n_missed: IntArray, n_frames: int) -> BoolArray:
    """(R,) rows without a detection at the end of a stretch of frames, unless the recording ends there too."""
    guess = np.zeros(len(ids), dtype=np.bool_)
    if not len(ids):
        return guess
    last = np.ones(len(ids), dtype=np.bool_)
    last[:-1] = (ids[1:] != ids[:-1]) | (frame[1:] != frame[:-1] + 1)
    for row in np.flatnonzero(last & (frame < n_frames - 1)):
        guess[row - n_missed[row] + 1 : row + 1] = True
    return guess
