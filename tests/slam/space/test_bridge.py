"""Frames that saw nothing have no pose in the problem in space: what is told of them is that of the whole chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.geometry import se3
from evermap.pipeline import run_slam
from evermap.slam.space.bridge import bridge, bridge_covariance
from evermap.slam.space.estimate import SpatialOptimum, first_places, refined
from evermap.slam.space.intake import SpatialIntake, prepare_space
from evermap.slam.space.problem import SpatialNoise, SpatialProblem, Swing
from evermap.slam.space.smoother import SpatialSmoother
from evermap.types import SpatialRecording, rows_of

from .rooms import Room

NOISE = SpatialNoise(translation=0.02, rotation=0.03, pixel=1.0)
FIRST, LAST = 100, 140
"""Frames between which nothing is seen, most of a half round; else every third sees anything."""


def with_blind_frames(seed: int = 2) -> SpatialRecording:
    """Return a walk whose camera sees in some frames only."""
    recording = Room.of(seed).walk(seed, drift=0.02, ambiguous=False)
    frame = recording.detections.frame
    kept = (frame % 3 == 0) & ((frame < FIRST) | (frame > LAST))
    return replace(recording, detections=rows_of(recording.detections, kept))


def with_all_poses(intake: SpatialIntake) -> SpatialProblem:
    """Return the problem with a pose for every frame."""
    frames = intake.frames
    return replace(
        intake.problem, stamp_s=frames.stamp_s, increment=se3.between(frames.driven[:-1], frames.driven[1:]),
        lasted_s=np.diff(frames.stamp_s), swing=Swing.none(len(frames.row) - 1),
        pose_row=frames.posed[intake.problem.pose_row],
    )  # fmt: skip


def solved(problem: SpatialProblem, driven: np.ndarray) -> SpatialOptimum:
    """Return the optimum at given noise levels."""
    smoother, start = SpatialSmoother(problem, driven), first_places(problem, driven)
    estimate, now = smoother.optimum(start, NOISE, heavy=False, iterations=60, tolerance=1e-9, settled=1e-9)
    return SpatialOptimum(estimate, NOISE, smoother, now)


@pytest.fixture(scope="module")
def both() -> tuple[SpatialIntake, SpatialOptimum, SpatialOptimum]:
    """The same walk with poses where anything was seen, and with all; the odometry's scale is unknown."""
    intake = prepare_space(with_blind_frames(), Config().slam.space, robust=False)
    intake = replace(intake, problem=replace(intake.problem, scale_sigma=0.05))
    return intake, solved(intake.problem, intake.driven_pose), solved(with_all_poses(intake), intake.frames.driven)


def test_only_frames_that_saw_something_have_a_pose(both: tuple[SpatialIntake, SpatialOptimum, SpatialOptimum]) -> None:
    intake = both[0]
    assert 3 * len(intake.frames.posed) < len(intake.frames.row) + 6
    assert np.isin(intake.frames.blind, intake.frames.posed).sum() == 0
    assert intake.problem.swing.steps.max() > LAST - FIRST


def test_blind_frames_have_the_mean_of_the_whole_chain(
    both: tuple[SpatialIntake, SpatialOptimum, SpatialOptimum],
) -> None:
    intake, few, whole = both
    found = bridge(intake.frames, intake.problem, few.estimate, NOISE)
    sigma = np.sqrt(np.einsum("nii->ni", of_poses(whole)))
    off = se3.local(whole.estimate.pose, found) / np.maximum(sigma, 1e-3)
    assert np.abs(off).max() < 0.03
    driven = se3.compose(few.estimate.pose[intake.frames.before], se3.between(*ends_of(intake)))
    assert np.abs(se3.local(whole.estimate.pose, driven) / np.maximum(sigma, 1e-3)).max() > 0.5


def test_blind_frames_have_the_covariance_of_the_whole_chain(
    both: tuple[SpatialIntake, SpatialOptimum, SpatialOptimum],
) -> None:
    intake, few, whole = both
    found = bridge_covariance(
        intake.frames, intake.problem, few.estimate, NOISE, few.now.odometry_weight, few.smoother.spread(few.now)
    )
    expected = of_poses(whole)
    root = np.linalg.inv(np.linalg.cholesky(expected[1:] + 1e-12 * np.eye(6)))
    ratio = np.linalg.eigvalsh(root @ found[1:] @ np.swapaxes(root, 1, 2))
    assert ratio.min() > 0.95
    assert ratio.max() < 1.05


def test_noise_levels_are_those_of_the_whole_chain(both: tuple[SpatialIntake, SpatialOptimum, SpatialOptimum]) -> None:
    """A step of the estimation counts what each step of an interval contributed."""
    levels = [refined(of.smoother, of.now, NOISE, SpatialNoise()).levels for of in both[1:]]
    assert levels[0] == pytest.approx(levels[1], rel=5e-3)
    assert np.abs(np.log(levels[0][:2] / NOISE.levels[:2])).min() > 0.01


def test_results_have_all_frames() -> None:
    recording = with_blind_frames()
    result = run_slam(recording)
    count = len(recording.frames)
    for path in (result.trajectory, result.online, result.dead_reckoning):
        assert path.stamp_s == pytest.approx(recording.frames.stamp_s)
        assert len(path.pose_world_robot) == len(path.covariance) == count
    assert len(result.step_s) == count
    assert recording.truth is not None
    true = se3.between(recording.truth.pose_world_robot[0], recording.truth.pose_world_robot)
    off = se3.local(true, result.trajectory.pose_world_robot)
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.pinv(result.trajectory.covariance), off)[1:]
    assert 1.5 < nees[FIRST : LAST + 1].mean() < 15.0


def of_poses(optimum: SpatialOptimum) -> np.ndarray:
    """Return (N, 6, 6) covariances of the poses of a problem."""
    count = len(optimum.estimate.pose)
    return optimum.smoother.spread(optimum.now).own[: 36 * count].reshape(count, 6, 6)


def ends_of(intake: SpatialIntake) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (F, 7) by the odometry of the last pose, and of each frame."""
    return intake.frames.driven[intake.frames.posed][intake.frames.before], intake.frames.driven
