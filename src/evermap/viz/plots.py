"""Pictures of single objects, as their methods `plot` return them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.existence.protocol import Instants
from evermap.geometry import se3
from evermap.geometry.group import group_of
from evermap.metrics.summary import compare_with_truth
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    Clock,
    Detections,
    FloatArray,
    Frames,
    Landmarks,
    Odometry,
    Recording,
    SlamResult,
    Trajectory,
)
from evermap.viz.lifetime_figures import plot_lifetimes, plot_survival  # noqa: F401 (taken by their names)
from evermap.viz.living_map_figures import MapView, plot_living_map
from evermap.viz.map_figure import draw_map, moving_paths
from evermap.viz.panels import corners_of, height_over_width, lay_out
from evermap.viz.presence_figures import plot_raster
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    INK,
    LANDMARK,
    MUTED,
    PAPER,
    class_looks,
    drawing,
    house_style,
    legend_name,
    legend_of,
    settle,
)
from evermap.viz.time_axis import TimeAxis, guess_clock

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PLAN: Any = {"aspect": "equal", "xlabel": "x [m]", "ylabel": "y [m]"}
"""Axes of a plan view."""


def plot_result(result: SlamResult, recording: AnyRecording | None = None) -> Figure:
    """Draw path, odometry and map of a run, in the frame of the recording's truth where there is one."""
    whole = recording or _nothing_but_frames(result)
    with house_style():
        figure = draw_map(whole, result, compare_with_truth(whole, result)).figure
        settle(figure)
    return figure


def plot_map(living: Any, *, title: str = "") -> Figure:
    """Draw a `LivingMap`: landmarks, their other places, gone ones, and the sensor positions."""
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
    """Draw a map by class with 2-sigma ellipses; uncertain landmarks are fainter, probably gone ones crossed out."""
    if not len(landmarks):
        with drawing(6.0, 5.0) as figure:
            figure.add_subplot(**_PLAN)
        return figure
    return plot_living_map(MapView(landmarks, np.zeros(len(landmarks), dtype=np.bool_)), title="")


def plot_trajectory(trajectory: Trajectory) -> Figure:
    """Draw a path and its first pose, in space from above and from the side."""
    place = _places(trajectory)
    low, high = corners_of([place])
    with drawing(6.0, float(np.clip(5.6 * height_over_width(high - low), 3.0, 7.5))) as figure:
        for axes, view in lay_out(figure, low, high):
            axes.plot(*place[:, view].T, color=ESTIMATE, lw=1.0)
            axes.plot(*place[:1, view].T, "o", color=PAPER, mec=ESTIMATE, mew=1.4, ms=6)
    return figure


def plot_recording(recording: AnyRecording) -> Figure:
    """Draw detections and speeds over time, and the true path if there is one."""
    truth = recording.truth
    rows = _seen_rows(recording) | _driven_rows(recording)
    start_s = recording.frames.stamp_s[0] if len(recording.frames) else 0.0
    with drawing(10.0 if truth is not None else 7.2, 5.4) as figure:
        grid = figure.add_gridspec(len(rows), 2 if truth is not None else 1)
        top: Axes | None = None
        for k, (label, (stamp_s, values)) in enumerate(rows.items()):
            axes = figure.add_subplot(grid[k, 0], sharex=top)
            top = top or axes
            style, colour = (".", LANDMARK) if k < 2 else ("-", INK)
            axes.plot(stamp_s - start_s, values, style, color=colour, ms=1.5, lw=0.6)
            axes.set_ylabel(label)
        axes.set_xlabel("time since the first frame [s]")
        if truth is not None:
            path, survey = _places(truth), recording.true_landmarks
            places = path[:0] if survey is None else survey.position_m
            for plan, view in lay_out(figure, *corners_of([path, places]), grid[:, 1]):
                plan.plot(*path[:, view].T, color=INK, lw=0.8)
                plan.plot(*places[:, view].T, "s", mfc="none", mec=INK, ms=5, mew=0.8)
    return figure


def _places(trajectory: Trajectory) -> FloatArray:
    """Positions (N, 2) or (N, 3)."""
    poses = trajectory.pose_world_robot
    return poses[:, : group_of(poses).point_dim]


_Rows = dict[str, tuple[FloatArray, FloatArray]]
"""Stamps and values by the label of their axis."""


def _seen_rows(recording: AnyRecording) -> _Rows:
    """How far every detection was, or where in the image, and of which landmark, or of which class."""
    detections = recording.detections
    seen_s = recording.frames.stamp_s[detections.frame]
    known = detections.landmark_id != UNKNOWN
    what, ids = ("landmark", detections.landmark_id) if known.any() else ("class", detections.class_id)
    _, rank = np.unique(ids, return_inverse=True)
    which = {what: (seen_s, np.where(ids == UNKNOWN, np.nan, rank))}
    if isinstance(detections, Detections):
        return {"range [m]": (seen_s, detections.range_m), **which}
    distance = np.linalg.norm(detections.position_sensor_m, axis=1)
    if np.isfinite(distance).any():
        return {"distance [m]": (seen_s, distance), **which}
    return {"column [px]": (seen_s, detections.corner_px[:, :, 0].mean(axis=1)), **which}


def _driven_rows(recording: AnyRecording) -> _Rows:
    """Speed and turn rate by odometry; nothing without any."""
    odometry = recording.odometry
    if odometry is None:
        return {}
    if isinstance(odometry, Odometry):
        forward, turn = odometry.forward_mps, odometry.angular_radps
        return {"forward [m/s]": (odometry.stamp_s, forward), "turn [rad/s]": (odometry.stamp_s, turn)}
    poses, stamps = odometry.pose_world_robot, odometry.stamp_s
    rate = se3.local(poses[:-1], poses[1:]) / np.diff(stamps)[:, None]
    speed, turned = np.linalg.norm(rate[:, :3], axis=1), np.linalg.norm(rate[:, 3:], axis=1)
    return {"speed [m/s]": (stamps[1:], speed), "turn [rad/s]": (stamps[1:], turned)}


def _nothing_but_frames(result: SlamResult) -> Recording:
    nothing = np.zeros(0)
    whole = nothing.astype(np.int64)
    detections = Detections(whole, whole, nothing, nothing, whole, nothing, nothing, whole)
    return Recording("", Odometry(nothing, nothing, nothing, nothing), Frames(result.trajectory.stamp_s), detections)


MOST_SPELLS = 80
"""Maximum rows of the right half: the longest spells."""


def plot_track_run(result: Any) -> Figure:
    """Draw a `TrackResult`: paths and places of rest from above; beside it, a bar for each spell at rest.

    A bar is from the first sighting to the last. The thin line before it begins at the last look at which the object
    was not there, that behind it ends at the first; an arrow instead of an end: nobody knows. Objects that left their
    place of rest are crossed out.
    """
    table, rests, paths = result.table, result.spells, moving_paths(result)
    start_s, end_s = float(table.stamp_s[0]), float(table.stamp_s[-1])
    looks = class_looks(table.class_names)
    left = np.isfinite(rests.gone_s)
    with drawing(9.0, 4.8) as figure:
        above, bars = figure.subplots(1, 2, width_ratios=(1.1, 1.0))
        if table.sensor_m is not None:
            above.plot(*table.sensor_m[:, :2].T, color=MUTED, lw=0.8, ls=":", zorder=1, label="path of the sensor")
        for k, name in enumerate(table.class_names):
            look = looks[name]
            for _, path in (one for one in paths if one[0] == k):
                above.plot(*path[:, :2].T, color=look.colour, lw=0.9, alpha=0.7, zorder=2)
            mark: Any = {"ls": "none", "marker": look.marker, "ms": 6.0, "mec": look.colour}
            here = rests.class_id == k
            above.plot(*rests.position_m[here & left, :2].T, mfc="none", alpha=0.6, zorder=3, **mark)
            above.plot(*rests.position_m[here & ~left, :2].T, mfc=look.colour, zorder=4, **mark)
            above.plot([], [], color=look.colour, mfc=look.colour, **(mark | {"ls": "-"}),
                       label=legend_name(name) or "objects")  # fmt: skip
        if left.any():
            above.plot(
                *rests.position_m[left, :2].T, "x", color=ALERT, ms=6.0, mew=1.1, zorder=3.5, label="has left again"
            )
        above.set(xlabel="x [m]", ylabel="y [m]")
        above.set_aspect("equal", adjustable="datalim")
        above.set_title("paths, and places of rest")
        axis = TimeAxis.over(start_s, end_s, guess_clock(table.stamp_s))
        _draw_bars(bars, rests, [looks[name].colour for name in table.class_names], axis, end_s)
        figure.legend(*legend_of(above, bars), loc="outside lower center", ncols=5)
    return figure


def _draw_bars(axes: Axes, rests: Any, colours: Sequence[str], axis: TimeAxis, end_s: float) -> None:
    longest = np.argsort(rests.first_s - rests.last_s, kind="stable")[:MOST_SPELLS]
    order = longest[np.argsort(rests.first_s[longest], kind="stable")]
    at = axis.coordinates
    unbounded = bounded = False
    for row, k in enumerate(order.tolist()):
        colour = colours[int(rests.class_id[k])]
        first_s, last_s = rests.first_s[k], rests.last_s[k]
        for outer_s, inner_s, mark in ((rests.elsewhere_s[k], first_s, "<"), (rests.gone_s[k], last_s, ">")):
            if np.isfinite(outer_s):
                axes.plot(at([outer_s, inner_s]), [row, row], color=colour, lw=0.8)
                bounded = True
            else:
                axes.plot(at([inner_s]), [row], color=colour, marker=mark, ms=3.5)
                unbounded = True
        axes.plot(at([first_s, last_s]), [row, row], color=colour, lw=3.0, solid_capstyle="butt")
    axes.plot([], [], color=MUTED, lw=3.0, label="seen at rest")
    if bounded:
        axes.plot([], [], color=MUTED, lw=0.8, label="arrived or left in between")
    if unbounded:
        axes.plot([], [], color=MUTED, marker=">", ls="", ms=3.5, label="beginning or end unknown")
    all_of_them = len(order) == len(rests.first_s)
    which = "spells" if all_of_them else f"the {len(order)} longest of {len(rests.first_s):,} spells"
    axes.set(yticks=[], ylim=(len(order), -1.0))
    axes.axvline(at(end_s), color=INK, lw=0.6, ls=":", label="last frame")
    axis.label(axes)
    axes.set_title(f"{which} at rest")


_BINS = 480
"""Times of a figure of beliefs."""


def plot_persist_run(result: Any, clock: Clock | None = None) -> Figure:
    """Draw a `PersistResult`: beliefs over time, a row a feature, of those that changed most.

    Args:
        result: of `run_persist`.
        clock: what its stamps count; None for what the table says, or a guess.
    """
    features = result.most_changed()
    start_s, stop_s, _, last_look_s = result.table.span
    edge_s = np.linspace(start_s, max(stop_s, float(result.forecasts.stamp_s[-1])), _BINS + 1)
    looks, _ = result.looks.at(features)
    middle_s = 0.5 * (edge_s[1:] + edge_s[:-1])
    track = result.models.only(features).track(looks, Instants.same_for_all(len(features), middle_s))
    row = {feature: k for k, feature in enumerate(features.tolist())}
    columns = (getattr(result.changes, name).tolist() for name in ("feature", "stamp_s", "returned"))
    return plot_raster(
        [result.table.names[feature] for feature in features.tolist()],
        edge_s,
        track.p_present.reshape(len(features), -1),
        changes=[(row[of], stamp_s, back) for of, stamp_s, back in zip(*columns, strict=True) if of in row],
        forecast_from_s=last_look_s,
        clock=clock or result.table.clock or guess_clock(result.table.stamp_s),
    )
