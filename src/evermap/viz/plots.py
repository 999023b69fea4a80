"""Pictures of single objects, as their methods `plot` return them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.metrics.summary import compare_with_truth
from evermap.survival.base import LifetimePrior
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    SlamResult,
    Trajectory,
)
from evermap.viz.lifetime_figures import plot_lifetimes, plot_survival
from evermap.viz.living_map_figures import MapView, plot_living_map
from evermap.viz.map_figure import draw_map
from evermap.viz.style import (
    ESTIMATE,
    INK,
    LANDMARK,
    MUTED,
    PAPER,
    drawing,
    house_style,
)
from evermap.viz.time_axis import guess_clock
from evermap.viz.track_figures import plot_objects

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PLAN: Any = {"aspect": "equal", "xlabel": "x [m]", "ylabel": "y [m]"}
"""Axes of a plan view."""


def plot_result(result: SlamResult, recording: Recording | None = None) -> Figure:
    """Draw path, odometry and map of a run, in the frame of the recording's truth where there is one."""
    whole = recording or _nothing_but_frames(result)
    with house_style():
        return draw_map(whole, result, compare_with_truth(whole, result)).figure


def plot_map(living: Any, *, title: str = "") -> Figure:
    """Draw a `LivingMap`: landmarks, their other places, what is gone, and from where the robot looked."""
    landmarks, places = living.landmarks(), living.places
    views = living.views if living.sight is None else living.sight.views.table()
    here = living.place_row(living.members.landmark_id, living.site_of())
    other = np.setdiff1d(np.flatnonzero(np.isin(places.landmark_id, landmarks.landmark_id)), here)
    view = MapView(
        landmarks,
        np.isin(landmarks.landmark_id, living.members.landmark_id[living.members.pinned]),
        places.position_m[other],
        np.searchsorted(landmarks.landmark_id, places.landmark_id[other]),
        np.asarray(views.cell_m * (np.unique(views.cell, axis=0) + 0.5), dtype=np.float64),
        views.cell_m,
    )
    return plot_living_map(view, title=title)


def plot_followed(followed: Any, resting_m: FloatArray) -> Figure:
    """Draw objects of a tracker from above, with where they go in a second; those out of view that rest as crosses.

    Args:
        followed: `Tracker.followed()`.
        resting_m: (K, 3) places of the objects of its working set.
    """
    with drawing(6.0, 5.0) as figure:
        axes = figure.add_subplot(**_PLAN)
        if len(resting_m):
            axes.plot(*resting_m[:, :2].T, "x", color=MUTED, ms=5, lw=0, label="at rest, out of view")
        for static, marker, label in ((True, "s", "at rest"), (False, "o", "moving")):
            rows = followed.static == static
            if rows.any():
                axes.plot(*followed.position_m[rows, :2].T, marker, color=LANDMARK, ms=5, lw=0, label=label)
        moving = ~followed.static
        start, way = followed.position_m[moving, :2], followed.velocity_mps[moving, :2]
        for (x, y), (dx, dy) in zip(start, way, strict=True):
            axes.plot([x, x + dx], [y, y + dy], color=ESTIMATE, lw=1.0)
        if axes.get_legend_handles_labels()[1]:
            axes.legend()
    return figure


def plot_landmarks(landmarks: Landmarks) -> Figure:
    """Draw a map by class with 2-sigma ellipses; what may be gone is fainter, what probably is, crossed out."""
    if not len(landmarks):
        with drawing(6.0, 5.0) as figure:
            figure.add_subplot(**_PLAN)
        return figure
    return plot_living_map(MapView(landmarks, np.zeros(len(landmarks), dtype=np.bool_)), title="")


def plot_track_run(result: Any) -> Figure:
    """Draw a `TrackResult`: paths and places of rest from above, and when objects rested."""
    table = result.table
    return plot_objects(
        table.class_names,
        _paths(result),
        result.spells,
        start_s=float(table.stamp_s[0]),
        end_s=float(table.stamp_s[-1]),
        sensor_m=None if table.sensor_m is None else table.sensor_m[:, :2],
        clock=guess_clock(table.stamp_s),
    )


def _paths(result: Any) -> list[tuple[int, FloatArray]]:
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


def plot_trajectory(trajectory: Trajectory) -> Figure:
    """Draw a path and its first pose."""
    with drawing(6.0, 5.0) as figure:
        axes = figure.add_subplot(**_PLAN)
        axes.plot(*trajectory.pose_world_robot[:, :2].T, color=ESTIMATE, lw=1.0)
        axes.plot(*trajectory.pose_world_robot[:1, :2].T, "o", color=PAPER, mec=ESTIMATE, mew=1.4, ms=6)
    return figure


def plot_recording(recording: Recording) -> Figure:
    """Draw range and landmark of every detection over time, odometry, and the true path where there is one."""
    start_s = recording.frames.stamp_s[0] if len(recording.frames) else 0.0
    seen_s = recording.frames.stamp_s[recording.detections.frame] - start_s
    odometry = recording.odometry
    panels = {
        "range [m]": (seen_s, recording.detections.range_m),
        "landmark": (seen_s, _rows_of_landmarks(recording.detections)),
        "forward [m/s]": (odometry.stamp_s - start_s, odometry.forward_mps),
        "turn [rad/s]": (odometry.stamp_s - start_s, odometry.angular_radps),
    }
    with drawing(10.0 if recording.truth is not None else 7.2, 5.4) as figure:
        grid = figure.add_gridspec(len(panels), 2 if recording.truth is not None else 1)
        top: Axes | None = None
        for k, (label, (time_s, values)) in enumerate(panels.items()):
            axes = figure.add_subplot(grid[k, 0], sharex=top)
            top = top or axes
            axes.plot(time_s, values, "." if k < 2 else "-", color=LANDMARK if k < 2 else INK, ms=1.5, lw=0.6)
            axes.set_ylabel(label)
        axes.set_xlabel("time since the first frame [s]")
        if recording.truth is not None:
            plan = figure.add_subplot(grid[:, 1], **_PLAN)
            plan.plot(*recording.truth.pose_world_robot[:, :2].T, color=INK, lw=0.8)
            if recording.true_landmarks is not None:
                plan.plot(*recording.true_landmarks.position_m.T, "s", mfc="none", mec=INK, ms=5, mew=0.8)
    return figure


def plot_lifetime(prior: LifetimePrior, **options: Any) -> Figure:
    """Draw hazard, survival and density of a lifetime prior; options as of `plot_lifetimes`."""
    return plot_lifetimes(prior, **options)


def plot_estimate(estimate: Any, **options: Any) -> Figure:
    """Draw the survival function of an estimate; options as of `plot_survival`."""
    return plot_survival({type(estimate).__name__: estimate}, **options)


def _rows_of_landmarks(detections: Detections) -> np.ndarray:
    """Return the rank (M,) of each detection's landmark among the ids; nan where it is unknown."""
    _, rank = np.unique(detections.landmark_id, return_inverse=True)
    return np.where(detections.landmark_id == UNKNOWN, np.nan, rank)


def _nothing_but_frames(result: SlamResult) -> Recording:
    nothing = np.zeros(0)
    whole = nothing.astype(np.int64)
    detections = Detections(whole, whole, nothing, nothing, whole, nothing, nothing, whole)
    return Recording("", Odometry(nothing, nothing, nothing, nothing), Frames(result.online.stamp_s), detections)
