"""Trajectory and landmarks with their uncertainty, against truth and against odometry alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evermap.geometry import se2
from evermap.metrics.summary import Evaluation
from evermap.metrics.trajectory import rotate_covariance
from evermap.types import FloatArray, Recording, SlamResult
from evermap.viz.change_layer import draw_moves, moves
from evermap.viz.style import ESTIMATE, INK, LANDMARK, MUTED, ODOMETRY, PAPER, NamedFigure, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_POINTS = 6000
_MAX_LABELS = 40
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100)


def draw_map(recording: Recording, result: SlamResult, evaluation: Evaluation) -> NamedFigure:
    """Plan view in the frame of the truth where there is one, else in the map's own; what changed, with arrows."""
    pose_truth_map = _alignment(evaluation)
    poses = se2.compose(pose_truth_map, result.trajectory.pose_world_robot)
    points = se2.transform(pose_truth_map, result.landmarks.position_m)
    covariance = rotate_covariance(result.landmarks.covariance_m2, float(pose_truth_map[2]))
    truth = None if recording.truth is None else recording.truth.pose_world_robot
    survey = None if recording.true_landmarks is None else recording.true_landmarks.position_m
    if evaluation.poses is None and evaluation.landmarks_own is None:
        truth = survey = None  # nothing ties the frames together

    changed = moves(result, pose_truth_map)
    places = [poses[:, :2], points, *(part for move in changed for part in (move.before_m, move.after_m))]
    low, high = _frame([*places, *(part[:, :2] for part in (truth, survey) if part is not None)])
    size = high - low
    height_in = float(np.clip(6.6 * size[1] / size[0], 2.6, 7.2)) + 0.9 + 0.17 * len(changed)
    figure = new_figure(7.2, height_in)
    axes = figure.add_subplot()

    faint = 0.5 if changed else 1.0  # paths step back behind what changed
    odometry = evaluation.dead_reckoning
    pose_truth_odometry = pose_truth_map if odometry is None else odometry.pose_truth_estimate
    drifted = _thin(se2.compose(pose_truth_odometry, result.dead_reckoning.pose_world_robot)[:, :2])
    leaves = bool(np.any((drifted < low) | (drifted > high)))
    label = "odometry alone" + (" (leaves the picture)" if leaves else "")
    axes.plot(*drifted.T, color=ODOMETRY, lw=0.8, alpha=0.65 * faint, label=label, zorder=1)
    if truth is not None:
        axes.plot(*_thin(truth[:, :2]).T, color=INK, lw=1.6, alpha=0.35 * faint, label="true path", zorder=2)
    axes.plot(*_thin(poses[:, :2]).T, color=ESTIMATE, lw=0.9, alpha=faint, label="estimated path", zorder=3)
    if survey is not None:
        axes.plot(*survey.T, "s", mfc="none", mec=INK, ms=6.5, mew=0.9, label="surveyed landmark", zorder=4)
    _draw_landmarks(axes, points, covariance, result.landmarks.landmark_id, size)
    if len(poses):
        axes.plot(*poses[0, :2], "o", color=PAPER, mec=ESTIMATE, mew=1.4, ms=6, label="start", zorder=7)
    moved = draw_moves(axes, changed)

    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.spines[["top", "right"]].set_visible(True)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    if moved:
        figure.legend(handles=moved, loc="outside lower left", ncols=1, handlelength=3.2)
    return NamedFigure("map", figure, "Trajectory and map", _caption(recording, evaluation, bool(changed)))


def _alignment(evaluation: Evaluation) -> FloatArray:
    if evaluation.poses is not None:
        return evaluation.poses.pose_truth_estimate
    if evaluation.landmarks_own is not None:
        return evaluation.landmarks_own.pose_truth_estimate
    return np.zeros(3)


def _frame(parts: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Corners of what must be in the picture, with a margin; odometry may leave it."""
    finite = [part[np.all(np.isfinite(part), axis=1)] for part in parts if len(part)]
    everything = np.concatenate([part for part in finite if len(part)] or [np.zeros((1, 2))])
    low, high = everything.min(axis=0), everything.max(axis=0)
    margin = max(0.06 * float(np.max(high - low)), 0.5)
    return low - margin, high + margin


def _thin(points: FloatArray) -> FloatArray:
    """At most `_MAX_POINTS` of a path; more cannot be seen."""
    return points[:: max(1, -(-len(points) // _MAX_POINTS))]


def _draw_landmarks(
    axes: Axes, points: FloatArray, covariance: FloatArray, ids: FloatArray | np.ndarray, size: FloatArray
) -> None:
    """Points, ids and 2-sigma ellipses; ellipses too small to see are magnified, and the legend says so."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.patheffects import withStroke

    axes.plot(*points.T, "o", color=LANDMARK, ms=3.2, mec="none", label="mapped landmark", zorder=6)
    if len(points) == 0:
        return
    variance, axis = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    visible = 0.012 * float(np.max(size))
    typical = 2.0 * float(np.median(sigma[:, 1]))
    factor = next((m for m in _MAGNIFICATIONS if m * typical >= visible), _MAGNIFICATIONS[-1]) if typical > 0 else 1
    angle = np.degrees(np.arctan2(axis[:, 1, 1], axis[:, 0, 1]))
    full = 2.0 * 2.0 * factor * sigma
    axes.add_collection(
        EllipseCollection(
            full[:, 1],
            full[:, 0],
            angle,
            units="xy",
            offsets=points,
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors=LANDMARK,
            linewidths=1.0,
            zorder=5,
        )
    )
    label = "2σ of its position" + (f", drawn {factor} × larger" if factor > 1 else "")
    axes.plot([], [], "o", mfc="none", mec=LANDMARK, ms=7, label=label)
    if len(points) <= _MAX_LABELS:
        halo = [withStroke(linewidth=2.2, foreground=PAPER)]
        for name, point in zip(ids, points, strict=True):
            axes.annotate(
                str(name), point, (5, 5), textcoords="offset points", size=8, color=MUTED, path_effects=halo, zorder=8
            )


def _caption(recording: Recording, evaluation: Evaluation, changed: bool) -> str:
    if changed:
        arrows = (
            " Arrows lead from where a landmark was (diamond) to where it is now; dashed: another explanation. The"
            " displacements are in the map's own frame."
        )
        return _frame_caption(recording, evaluation) + arrows
    return _frame_caption(recording, evaluation)


def _frame_caption(recording: Recording, evaluation: Evaluation) -> str:
    poses, odometry = evaluation.poses, evaluation.dead_reckoning
    if poses is None and evaluation.landmarks_own is None:
        return "Frame of the first pose: the map's origin is where the robot stood at the start, x ahead of it."
    if poses is None:
        return "Turned and shifted (SE(2), no scale) onto the surveyed landmarks; there is no true path to compare."
    text = "Turned and shifted (SE(2), no scale) so that the estimated path fits the true one best, for display only."
    if odometry is not None:
        text += (
            f" Odometry alone, with an alignment of its own, is {odometry.rmse_m:.2f} m off;"
            f" the estimate {poses.rmse_m:.3f} m."
        )
    covered = (poses.stamp_s[-1] - poses.stamp_s[0]) / max(_duration(recording), 1e-9)
    return text + (f" Truth covers {covered:.0%} of the recording." if covered < 0.98 else "")


def _duration(recording: Recording) -> float:
    stamps = recording.frames.stamp_s
    return float(stamps[-1] - stamps[0]) if len(stamps) else 0.0
