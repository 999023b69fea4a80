"""The map of a run: path and landmarks with their uncertainty against truth and odometry, and what changed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from evermap.geometry import se2
from evermap.geometry.group import group_of
from evermap.geometry.upright import level_pose, move_map
from evermap.metrics.summary import Evaluation
from evermap.types import AnyRecording, BoolArray, ChangeKind, FloatArray, Landmarks, MapChange, SlamResult, Up
from evermap.viz.change_words import near_alternatives, probability, what
from evermap.viz.panels import (
    View,
    corners_of,
    draw_footprints,
    draw_shapes,
    height_over_width,
    is_outlined,
    lay_out,
    mostly_boxes,
    seen,
    with_breaks,
)
from evermap.viz.style import (
    ALERT,
    ESTIMATE,
    GROUP,
    INK,
    MUTED,
    ODOMETRY,
    ONLINE,
    PAPER,
    NamedFigure,
    class_looks,
    label_points,
    legend_name,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

_MAX_POINTS = 6000
LABELS_UP_TO = 60
"""Maximum number of landmarks with names."""
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True, slots=True)
class _Scene:
    """Content of a map figure, in its frame; all with two or all with three coordinates.

    Attributes:
        path_m: (N, D) positions of the robot, nan between stretches of it; odometry_m: as odometry alone has them.
        truth_m, survey_m: true positions of robot and landmarks; None where there are none, or nothing ties the frames.
        mapped: (S,) which of the surveyed landmarks the map has.
        landmarks, gone: the map.
        changed: what changed.
        followed: class and (K, D) positions of what moved, a stretch each.
        up: where up was before all was turned so that it is z; of the plane None.
    """

    path_m: FloatArray
    odometry_m: FloatArray
    truth_m: FloatArray | None
    survey_m: FloatArray | None
    mapped: BoolArray
    landmarks: Landmarks
    gone: Landmarks
    changed: Sequence[Move]
    followed: Sequence[tuple[str, FloatArray]] = ()
    up: Up | None = None

    @property
    def street(self) -> bool:
        """Whether it is drawn from above alone."""
        return mostly_boxes(self.landmarks)

    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Return the corners of the required content; odometry and a larger survey may exceed it."""
        moved = [part for move in self.changed for part in (move.before_m, move.after_m)]
        survey = None if self.survey_m is None else self.survey_m[self.mapped]
        true = [part for part in (self.truth_m, survey) if part is not None]
        ways = [way for _, way in self.followed]
        return corners_of([self.path_m, self.landmarks.position_m, self.gone.position_m, *moved, *true, *ways])


def draw_map(recording: AnyRecording, result: SlamResult, evaluation: Evaluation) -> NamedFigure:
    """Draw path and map from above, in space from the side too: in the frame of the truth where there is one, else in
    the map's own; what changed, with arrows, and the ways of what moved.
    """
    scene = _scene(recording, result, evaluation)
    low, high = scene.corners()
    low, high = (low[:2], high[:2]) if scene.street else (low, high)
    changed, names = scene.changed, class_names_of(scene.landmarks)
    lines = 1 + (len(changed) if len(changed) <= _MOST_LINES else 1) + (len(set(names)) + 6) // 4
    highest = 7.2 if len(low) == 2 else 8.2
    lowest = 1.6 if scene.street else 2.6
    height_in = float(np.clip(6.6 * height_over_width(high - low), lowest, highest)) + 0.65 + 0.18 * lines
    figure = new_figure(7.2, height_in)
    panels = lay_out(figure, low, high, up=scene.up)
    (moved, *_) = [_draw_panel(axes, view, scene, low, high) for axes, view in panels]
    columns = 4 if len(panels) == 1 and not len(scene.gone) else 3  # its label is long
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=columns)
    if moved:
        of_changes = 1 if len(changed) <= _MOST_LINES else 3
        figure.legend(handles=moved, loc="outside lower left", ncols=of_changes, handlelength=3.2)
    return NamedFigure("map", figure, "Trajectory and map", _caption(recording, evaluation, scene))


def _scene(recording: AnyRecording, result: SlamResult, evaluation: Evaluation) -> _Scene:
    group = group_of(result.trajectory.pose_world_robot)
    size = group.point_dim
    tie = evaluation.landmarks_own if evaluation.poses is None else evaluation.poses
    pose_truth_map = group.identity() if tie is None else tie.pose_truth_estimate
    level, up = group.identity(), None
    if size == 3:  # from above is along what is up in the frame of the picture
        up = move_map(result.landmarks, pose_truth_map).up
        level = level_pose(up)
        pose_truth_map = group.compose(level, pose_truth_map)
    path = group.compose(pose_truth_map, result.trajectory.pose_world_robot)[:, :size]
    truth = recording.truth
    way = None
    if truth is not None:
        way = with_breaks(truth.stamp_s, group.transform(level, truth.pose_world_robot[:, :size]))[1]
    known = Landmarks.at([], np.zeros((0, 2))) if recording.true_landmarks is None else recording.true_landmarks
    survey = None if recording.true_landmarks is None else group.transform(level, known.position_m)
    if tie is None:  # nothing ties the frames together
        way = survey = None
    odometry = evaluation.dead_reckoning
    pose_truth_odometry = pose_truth_map if odometry is None else group.compose(level, odometry.pose_truth_estimate)
    drifted = result.dead_reckoning.pose_world_robot
    if len(drifted):  # a run without odometry need not say how many coordinates it has
        drifted = group.compose(pose_truth_odometry, drifted)
    return _Scene(
        path_m=with_breaks(result.trajectory.stamp_s, path)[1],
        odometry_m=drifted[:, :size],
        truth_m=way,
        survey_m=survey,
        mapped=np.isin(known.landmark_id, result.landmarks.landmark_id),
        landmarks=move_map(result.landmarks, pose_truth_map),
        gone=move_map(result.gone, pose_truth_map),
        up=up,
        changed=moves(result, pose_truth_map),
        followed=[
            (result.followed.table.class_names[kind], group.transform(pose_truth_map, way[:, :size]))
            for kind, way in ([] if result.followed is None else moving_paths(result.followed))
        ],
    )


def _draw_panel(axes: Axes, view: View, scene: _Scene, low: FloatArray, high: FloatArray) -> list[Artist]:
    """Draw a scene into one panel; returns what a legend may say of the changes."""
    faint = 0.5 if scene.changed else 1.0  # paths step back behind what changed
    if len(scene.odometry_m):
        drifted = _thin(scene.odometry_m)
        leaves = bool(np.any((drifted[:, : len(low)] < low) | (drifted[:, : len(low)] > high)))
        label = "odometry alone" + (" (leaves the figure)" if leaves else "")
        axes.plot(*drifted[:, view].T, color=ODOMETRY, lw=0.8, alpha=0.65 * faint, label=label, zorder=1)
    if scene.truth_m is not None:
        dashes = "-" if len(low) == 2 else (0, (4, 1.5))
        axes.plot(*_thin(scene.truth_m)[:, view].T, color=INK, lw=1.6, ls=dashes, alpha=0.35 * faint,
                  label="true path", zorder=2)  # fmt: skip
    axes.plot(*_thin(scene.path_m)[:, view].T, color=ESTIMATE, lw=0.9, alpha=faint, label="estimated path", zorder=3)
    if scene.survey_m is not None:
        axes.plot(*scene.survey_m[:, view].T, "s", mfc="none", mec=INK, ms=8.0, mew=0.7, label="surveyed landmark",
                  zorder=4)  # fmt: skip
    reach_m = float(np.max(high - low))
    _draw_landmarks(axes, view, scene, reach_m)
    draw_gone(axes, seen(scene.gone, view))
    if len(scene.path_m):
        axes.plot(*scene.path_m[0, view], "o", color=PAPER, mec=ESTIMATE, mew=1.4, ms=6, label="start", zorder=7)
    axes.spines[["top", "right"]].set_visible(True)
    return draw_moves(axes, [
        replace(move, before_m=move.before_m[:, view], after_m=move.after_m[:, view]) for move in scene.changed
    ])  # fmt: skip


def _thin(points: FloatArray) -> FloatArray:
    """At most `_MAX_POINTS` of a path; more cannot be seen."""
    return points[:: max(1, -(-len(points) // _MAX_POINTS))]


def class_names_of(landmarks: Landmarks) -> list[str]:
    """Return the name of the class of each landmark, '' where it is not known."""
    names = landmarks.class_names
    return [names[k] if 0 <= k < len(names) else "" for k in landmarks.class_id.tolist()]


def _draw_landmarks(axes: Axes, view: View, scene: _Scene, reach_m: float) -> None:
    """Landmarks by class with their names, shapes and 2-sigma ellipses."""
    from matplotlib.lines import Line2D

    landmarks = seen(scene.landmarks, view)
    names, looks = class_names_of(landmarks), class_looks(landmarks.class_names)
    for name in sorted(set(names)):
        look, mine = looks[name], [k for k, other in enumerate(names) if other == name]
        label = legend_name(name) or ("mapped landmark" if set(names) == {""} else "class unknown")
        at = np.where(is_outlined(scene.landmarks, reach_m)[mine, None], np.nan, landmarks.position_m[mine])
        axes.plot(*at.T, look.marker, color=look.colour, ms=4.5, mec=PAPER, mew=0.4, label=label, zorder=6)
    _draw_ways(axes, view, scene, 0.02 * reach_m)
    if len(landmarks) == 0:
        return
    colours = np.array([looks[name].colour for name in names])
    if scene.street:
        axes.add_line(draw_footprints(axes, scene.landmarks, colours))
        return
    factor = magnification(scene.landmarks.covariance_m2, reach_m)
    draw_shapes(axes, scene.landmarks, view, colours, reach_m, _thin(scene.path_m))
    label = draw_ellipses(axes, landmarks.position_m, landmarks.covariance_m2, colours, factor)
    axes.add_line(Line2D([], [], ls="", marker="o", mfc="none", mec=MUTED, ms=7, label=label))
    if len(landmarks) <= LABELS_UP_TO:
        label_points(axes, landmarks.position_m, landmarks.labels)


def _draw_ways(axes: Axes, view: View, scene: _Scene, least_m: float) -> None:
    """Draw the ways of what moved at least so far, in the colour of its class, to where it was seen last."""
    looks = class_looks(tuple(sorted({*scene.landmarks.class_names, *(name for name, _ in scene.followed)})))
    far = [(name, way) for name, way in scene.followed if np.linalg.norm(np.ptp(way, axis=0)) > least_m]
    for k, (name, way) in enumerate(far):
        label = "seen moving, and where last" if k == 0 else None
        axes.plot(*way[:, view].T, color=looks[name].colour, lw=0.9, alpha=0.8, ls=(0, (3, 1)), label=label, zorder=4)
        axes.plot(*way[-1, view], looks[name].marker, mfc=PAPER, mec=looks[name].colour, ms=3.5, mew=0.9, zorder=5)


def moving_paths(result: Any) -> list[tuple[int, FloatArray]]:
    """Return class and (K, 3) positions of each stretch in which an object of a `TrackResult` was seen moving."""
    tracks = result.objects()
    frame = np.searchsorted(result.table.stamp_s, tracks.stamp_s)
    rows = np.flatnonzero(~tracks.static)
    ends = np.flatnonzero((np.diff(tracks.track_id[rows]) != 0) | (np.diff(frame[rows]) != 1)) + 1
    ids, class_of_track = np.unique(tracks.track_id), result.class_of_track()
    return [
        (int(class_of_track[np.searchsorted(ids, tracks.track_id[part[0]])]), tracks.position_m[part])
        for part in np.split(rows, ends)
        if len(part) > 1
    ]


def draw_gone(axes: Axes, gone: Landmarks) -> None:
    """Draw landmarks that are believed gone: hollow, faint, and crossed out."""
    from matplotlib.lines import Line2D

    names, looks = class_names_of(gone), class_looks(gone.class_names)
    for name in sorted(set(names)):
        mine = [k for k, other in enumerate(names) if other == name]
        look = looks[name]
        axes.plot(*gone.position_m[mine].T, look.marker, mfc="none", mec=look.colour, mew=1.1, ms=7.0, alpha=0.6,
                  zorder=3)  # fmt: skip
    if len(gone):
        axes.plot(*gone.position_m.T, "x", color=ALERT, ms=6, mew=1.1, alpha=0.8, zorder=3.5)
        axes.add_line(Line2D([], [], marker="x", color=ALERT, ls="", ms=6, mew=1.1, alpha=0.8, label=GONE))


def magnification(covariance: FloatArray, reach_m: float) -> int:
    """Return how many times larger 2-sigma ellipses of covariances (K, D, D) are drawn in a picture, to be seen."""
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    visible = 0.012 * reach_m
    typical = 2.0 * float(np.median(sigma[:, -1])) if len(sigma) else 0.0
    return next((m for m in _MAGNIFICATIONS if m * typical >= visible), _MAGNIFICATIONS[-1]) if typical > 0 else 1


def draw_ellipses(axes: Axes, points: FloatArray, covariance: FloatArray, colours: Any, factor: int) -> str:
    """Draw 2-sigma ellipses about points (K, 2) and return their label; those wider than the panel are left out.

    Args:
        axes: a panel, with its limits.
        points: (K, 2).
        covariance: (K, 2, 2) [m²].
        colours: (K,).
        factor: how many times larger.
    """
    from matplotlib.collections import EllipseCollection

    variance, axis = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    angle = np.degrees(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
    full = 2.0 * 2.0 * factor * sigma
    fits = full[:, 1] <= max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    ellipses = EllipseCollection(
        full[fits, 1], full[fits, 0], angle[fits], units="xy", offsets=points[fits], offset_transform=axes.transData,
        facecolors="none", edgecolors=np.asarray(colours)[fits], linewidths=0.9, zorder=5,
    )  # fmt: skip
    axes.add_collection(ellipses)
    larger = f", drawn {factor} × larger" if factor > 1 else ""
    return "2σ of its position" + larger + ("" if fits.all() else f" ({np.count_nonzero(~fits)} wider than the panel)")


def _caption(recording: AnyRecording, evaluation: Evaluation, scene: _Scene) -> str:
    text = _frame_caption(recording, evaluation, scene.path_m.shape[1])
    if scene.up is not None:
        text += f" Up in that frame: {scene.up.text}."
        text += " The picture is turned by it." if level_pose(scene.up)[:6].any() else ""
    if scene.landmarks.rotation is not None:
        text += " Short lines show the z axis of landmarks with an orientation; boxes have their edges."
    if scene.changed:
        text += (
            " Arrows lead from the former place of a landmark (diamond) to the present one; plus: appeared; cross: "
            "vanished; dashed: another explanation. Displacements are in the map's own frame."
        )
    return text


def _frame_caption(recording: AnyRecording, evaluation: Evaluation, size: int) -> str:
    poses, odometry = evaluation.poses, evaluation.dead_reckoning
    if poses is None and evaluation.landmarks_own is None:
        ahead = ", x ahead of it" if size == 2 else ""
        return f"Frame of the first pose: the map's origin is the robot's position at the start{ahead}."
    moved = f"Rotated and translated (SE({size}), no scale)"
    if poses is None:
        return f"{moved} onto the surveyed landmarks; there is no true path to compare."
    text = f"{moved} so that the estimated path fits the true one best, for display only."
    if odometry is not None:
        off = f"{odometry.rmse_m:.2f} m off; the estimate {poses.rmse_m:.3f} m"
        text += f" Odometry alone, aligned separately, is {off}."
    stamps = recording.frames.stamp_s
    covered = np.ptp(poses.stamp_s) / max(np.ptp(stamps) if len(stamps) else 0.0, 1e-9)
    return text + (f" Truth covers {covered:.0%} of the recording." if covered < 0.98 else "")


GROUP_COLOURS = (ALERT, ONLINE, GROUP)
"""Interleaved: groups of one colour are distinguished by the legend."""
_MAX_ALTERNATIVES = 2
_MOST_LINES = 8
"""Number of changes above which the legend has one line per kind; the report lists them all."""
GONE = "gone: P(exists) below 50 %"
_KIND_MARKS = {ChangeKind.APPEARED: "+", ChangeKind.VANISHED: "x"}


@dataclass(frozen=True, slots=True)
class Move:
    """One change, ready to be drawn.

    Attributes:
        change: what it is.
        before_m, after_m: (K, D) places of its landmarks that are in the map. Two that exchanged their identities have
            not moved: `before_m` is where the other one is.
        label: for the legend.
        colour: of its group.
        alternative: belongs to another explanation than the most probable one.
    """

    change: MapChange
    before_m: FloatArray
    after_m: FloatArray
    label: str
    colour: str
    alternative: bool

    @property
    def swapped(self) -> bool:
        """Whether identities were exchanged, and nothing moved."""
        return self.change.kind is ChangeKind.SWAPPED


def moves(result: SlamResult, pose_truth_map: FloatArray) -> list[Move]:
    """Return the changes to draw: those of the run by time, then those of the nearest alternatives.

    Args:
        result: what came out.
        pose_truth_map: (3,) or (7,) from the map's frame to that of the picture.
    """
    found = []
    drawn = partial(group_of(pose_truth_map).transform, pose_truth_map)
    for number, (change, _, before, after) in enumerate(places_of((result.landmarks, result.gone), result.changes)):
        label = f"{what(change)}, {probability(change.probability)}"
        colour = GROUP_COLOURS[number % len(GROUP_COLOURS)]
        found.append(Move(change, drawn(before), drawn(after), label, colour, alternative=False))
    for other in near_alternatives(result)[:_MAX_ALTERNATIVES]:
        for number, (change, _, before, after) in enumerate(places_of((other.landmarks,), other.changes)):
            label = f"and {what(change)}" if number else f"or: {what(change)}, {probability(other.probability)}"
            found.append(Move(change, drawn(before), drawn(after), label, MUTED, alternative=True))
    return found


def draw_moves(axes: Axes, drawn: Sequence[Move]) -> list[Artist]:
    """Draw diamonds where landmarks were, arrows to where they are, a plus for what appeared, a cross for what is gone.

    Returns what to put into a legend: a line a change, or a line a kind where there are many.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import FancyArrowPatch

    few = len(drawn) <= _MOST_LINES
    handles: list[Artist] = []
    kinds: Counter[str] = Counter()
    for move in drawn:
        colour = move.colour if few or move.alternative else ALERT
        line: dict[str, Any] = {"ls": "--" if move.alternative else "-", "lw": 1.0 if move.alternative else 1.5}
        mark = _change_mark(move.change.kind, colour)
        if not move.swapped:
            axes.plot(*move.before_m.T, ls="", zorder=9, **mark)
        for start, end in zip(move.before_m, move.after_m, strict=True):
            if np.array_equal(start, end):
                continue
            way, gap = ("arc3,rad=0.15", 2.0) if move.swapped else ("arc3", 0.0)
            arrow = FancyArrowPatch(
                (start[0], start[1]), (end[0], end[1]), arrowstyle="-|>", connectionstyle=way, mutation_scale=8.0,
                shrinkA=2.0, shrinkB=gap, color=colour, zorder=8 if move.alternative else 9, **line,
            )  # fmt: skip
            axes.add_patch(arrow)
        if move.change.kind in _KIND_MARKS:
            line["ls"] = ""
        kind = "or: other explanations" if move.alternative else move.change.kind.value
        kinds[kind] += len(move.before_m)
        if few or kinds[kind] == len(move.before_m):
            handles.append(Line2D([], [], color=colour, label=move.label if few else kind, **line, **mark))
    for handle in handles if not few else []:
        handle.set_label(f"{handle.get_label()}, {kinds[str(handle.get_label())]} landmarks")
    return handles


def _change_mark(kind: ChangeKind, colour: str) -> dict[str, Any]:
    """Return the marker of a kind of change; a moved landmark has a diamond at its former place."""
    if kind in _KIND_MARKS:
        return {"marker": _KIND_MARKS[kind], "mec": colour, "mew": 1.6, "ms": 8.0}
    return {"marker": "D", "mfc": PAPER, "mec": colour, "mew": 1.1, "ms": 4.0}


def places_of(
    known: Sequence[Landmarks], changes: Sequence[MapChange]
) -> list[tuple[MapChange, list[int], FloatArray, FloatArray]]:
    """Return changes by time, each with the landmarks whose places are known, those before it and those after it.

    They are undone one after the other from the last, for some landmarks move twice.
    """
    place = {name: at for some in known for name, at in zip(some.landmark_id.tolist(), some.position_m, strict=True)}
    found = []
    by_time = sorted(changes, key=lambda change: change.stamp_to_s)
    for change in by_time[::-1]:
        ids = [identity for identity in change.landmark_ids if identity in place]
        if not ids:
            continue
        after = np.array([place[identity] for identity in ids])
        if change.kind is ChangeKind.SWAPPED:
            before = after[::-1]
        elif change.kind is ChangeKind.REPLACED or not np.all(np.isfinite(change.displacement_m)):  # nothing moved
            before = after
        else:
            turn = change.rotation_rad if after.shape[1] == 2 else None  # in space nobody knows about which axis
            step = np.array(change.displacement_m)
            before = after - step if turn is None else se2.move_together(after, -step, -turn)
            place |= zip(ids, before, strict=True)
        found.append((change, ids, before, after))
    return found[::-1]
