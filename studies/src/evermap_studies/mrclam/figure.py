"""All robots side by side: where each went, where the landmarks are, and what the estimate makes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evermap.geometry import se2
from evermap.metrics.summary import Evaluation
from evermap.types import Recording, SlamResult
from evermap.viz.style import ESTIMATE, INK, LANDMARK, house_style, new_figure, save_png, settle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH_IN = 2.35
_MARGIN_M = 0.6


@dataclass(frozen=True, slots=True)
class Drawn:
    """A run to draw."""

    robot: int
    recording: Recording
    result: SlamResult
    evaluation: Evaluation


def draw_robots(runs: Sequence[Drawn], path: Path) -> None:
    """One panel a robot, in a row, all in the frame of the truth; runs without true poses are left out."""
    runs = [run for run in runs if run.evaluation.poses is not None]
    if not runs:
        return
    everything = np.concatenate([_truth_xy(run) for run in runs])
    low, high = everything.min(axis=0) - _MARGIN_M, everything.max(axis=0) + _MARGIN_M
    panel_in = _WIDTH_IN * float((high[1] - low[1]) / (high[0] - low[0]))
    with house_style():
        figure = new_figure(_WIDTH_IN * len(runs) + 0.5, panel_in + 1.0)
        panels = figure.subplots(1, len(runs), sharex=True, sharey=True, squeeze=False)[0]
        for axes, run in zip(panels, runs, strict=True):
            _draw_run(axes, run)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x [m]")
        panels[0].set_ylabel("y [m]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
        settle(figure)
    save_png(figure, path, dpi=150)


def _truth_xy(run: Drawn) -> np.ndarray:
    poses, landmarks = run.evaluation.poses, run.evaluation.landmarks
    assert poses is not None
    return poses.truth[:, :2] if landmarks is None else np.concatenate([poses.truth[:, :2], landmarks.truth_m])


def _draw_run(axes: Axes, run: Drawn) -> None:
    poses, landmarks, truth = run.evaluation.poses, run.evaluation.landmarks, run.recording.truth
    assert poses is not None
    assert truth is not None
    path = se2.compose(poses.pose_truth_estimate, run.result.trajectory.pose_world_robot)
    step = max(1, len(truth) // 4000)
    axes.plot(*truth.pose_world_robot[::step, :2].T, color=INK, lw=1.6, alpha=0.35, label="true path")
    axes.plot(*path[:, :2].T, color=ESTIMATE, lw=0.7, label="estimated path, map unknown at the start")
    if landmarks is not None:
        axes.plot(*landmarks.truth_m.T, "s", mfc="none", mec=INK, ms=6, mew=0.9, label="surveyed landmark")
        axes.plot(*landmarks.estimate_m.T, "o", color=LANDMARK, ms=3, mec="none", label="mapped landmark")
    axes.set_title(f"robot {run.robot}: {poses.rmse_m:.3f} m")
