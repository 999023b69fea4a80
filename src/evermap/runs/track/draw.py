"""The pictures of a run: its figure, and its recording for rerun."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evermap.runs.track.run import TrackResult
from evermap.tracking.tracklets import EventKind
from evermap.types import FloatArray
from evermap.viz.time_axis import guess_clock
from evermap.viz.track_figures import Rests, plot_objects

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_run(result: TrackResult) -> Figure:
    """Paths and places of rest from above, and when objects rested."""
    table, spells = result.table, result.spells
    rests = Rests(
        class_id=spells.class_id,
        position_m=spells.position_m[:, :2],
        elsewhere_s=spells.elsewhere_s,
        first_s=spells.first_s,
        last_s=spells.last_s,
        gone_s=spells.gone_s,
    )
    return plot_objects(
        table.class_names,
        _paths(result),
        rests,
        start_s=float(table.stamp_s[0]),
        end_s=float(table.stamp_s[-1]),
        sensor_m=None if table.sensor_m is None else table.sensor_m[:, :2],
        clock=guess_clock(table.stamp_s),
    )


def write_recording(result: TrackResult, path: Path) -> None:
    """Objects, frame after frame, with those that rest out of view.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    from evermap.viz.rerun_scene import log_tracks

    table, tracks = result.table, result.tracks
    rows = np.argsort(tracks.stamp_s, kind="stable")
    parts = np.searchsorted(tracks.stamp_s[rows], table.stamp_s[1:])
    log_tracks(
        path,
        stamp_s=table.stamp_s - table.stamp_s[0],
        track_id=np.split(tracks.track_id[rows], parts),
        position_m=np.split(tracks.position_m[rows], parts),
        static=np.split(tracks.static[rows], parts),
        resting_m=_resting(result),
        sensor_m=table.sensor_m,
        reach_m=result.config.range_m,
    )


def _paths(result: TrackResult) -> list[tuple[int, FloatArray]]:
    """Class and (K, 2) positions of each stretch in which an object was followed and did not rest."""
    tracks = result.tracks
    frame = np.searchsorted(result.table.stamp_s, tracks.stamp_s)
    rows = np.flatnonzero(~tracks.static)
    ends = np.flatnonzero((np.diff(tracks.track_id[rows]) != 0) | (np.diff(frame[rows]) != 1)) + 1
    ids, class_of_track = np.unique(tracks.track_id), result.class_of_track()
    return [
        (int(class_of_track[np.searchsorted(ids, tracks.track_id[part[0]])]), tracks.position_m[part, :2])
        for part in np.split(rows, ends)
        if len(part) > 1
    ]


def _resting(result: TrackResult) -> list[FloatArray]:
    """(F) of (K, 3) places of the objects in the working set at each frame, where they were last seen."""
    tracks = result.tracks
    place = dict(zip(tracks.track_id.tolist(), tracks.position_m, strict=True))  # the last row of each
    events = iter(sorted(result.events, key=lambda event: event.stamp_s))
    event = next(events, None)
    there: set[int] = set()
    resting = []
    for stamp_s in result.table.stamp_s.tolist():
        while event is not None and event.stamp_s <= stamp_s:
            if event.kind == EventKind.STORED:
                there.add(event.track_id)
            else:
                there.discard(event.track_id)
            event = next(events, None)
        resting.append(np.array([place[track] for track in sorted(there) if track in place]).reshape(-1, 3))
    return resting
