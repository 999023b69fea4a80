"""A map of which a part is wrong, and a camera without odometry: who is where it says, and who not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.config import Config
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.solve import SpatialSolved, fit_to_map, solve_space
from evermap.types import Landmarks, SpatialRecording

from .rigs import Rig


def edit_survey(true: Landmarks, seed: int, count: int, least_m: float = 0.4) -> tuple[Landmarks, set[int]]:
    """The map with some places elsewhere, by up to 2 m, and which."""
    random = np.random.default_rng(seed)
    some = random.choice(len(true), count, replace=False)
    by = random.normal(size=(count, 3))
    position = true.position_m.copy()
    position[some] += by * (random.uniform(least_m, 2.0, count) / np.linalg.norm(by, axis=1))[:, None]
    return replace(true.as_prior(0.02), position_m=position), set(true.landmark_id[some].tolist())


def solve_in(recording: SpatialRecording, known: Landmarks) -> tuple[SpatialSolved, dict[int, float]]:
    """The solution in the map, and the probability of each that it moved."""
    intake = fit_to_map(prepare_space(recording, Config().slam.space), known, surveyed=True)
    found = solve_space(intake, known)
    assert found.from_map is not None
    name = intake.landmark_id[found.optimum.smoother.problem.prior.place]
    return found, dict(zip(name.tolist(), (1.0 - found.from_map.p_stands).tolist(), strict=True))


def off_m(found: SpatialSolved, recording: SpatialRecording) -> float:
    """Median error of the poses, in the frame of the map."""
    true = recording.truth.pose_world_robot[
        np.searchsorted(recording.truth.stamp_s, found.optimum.smoother.problem.stamp_s - 1e-6)
    ]
    return float(np.median(np.linalg.norm(found.optimum.estimate.pose[:, :3] - true[:, :3], axis=1)))


@pytest.mark.parametrize(("seed", "count"), [pytest.param(seed, 12, marks=pytest.mark.slow) for seed in (0, 4)])
def test_who_moved_is_found_without_odometry_where_many_did(seed, count):
    recording = Rig(seed, bias_px=0.3, gaps=4, turns=6).walk()
    known, moved = edit_survey(recording.true_landmarks, seed, count)
    name, seen = np.unique(recording.detections.landmark_id, return_counts=True)
    found, p_moved = solve_in(recording, known)
    assert {one for one, p in p_moved.items() if p > 0.5} == moved & set(name[seen >= 3].tolist())
    assert off_m(found, recording) < 0.1


def test_a_wrong_identity_that_was_seen_once_is_no_move():
    recording = Rig(5).walk()
    seen = recording.detections
    stranger = 7
    mine = np.flatnonzero(seen.landmark_id == stranger)
    other = np.flatnonzero(seen.landmark_id == 11)[10]
    name = seen.landmark_id.copy()
    keep = np.ones(len(seen), dtype=bool)
    keep[mine] = False  # it is seen nowhere else
    name[other] = stranger
    once = replace(recording, detections=replace(seen, landmark_id=name)[keep])
    known = recording.true_landmarks.as_prior(0.02)
    _, p_moved = solve_in(once, known)
    assert p_moved[stranger] < 0.2
    assert max(p_moved.values()) < 0.2


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_errors_that_detections_share_are_no_moves(seed):
    """A disparity that is off for all, and pixels that are off for all detections of a point."""
    recording = Rig(seed, points=30, bias_px=0.7, point_px=0.4, seconds=40.0).walk()
    known, moved = edit_survey(recording.true_landmarks, seed, 6, least_m=0.8)
    name, seen = np.unique(recording.detections.landmark_id, return_counts=True)
    found, p_moved = solve_in(recording, known)
    assert {one for one, p in p_moved.items() if p > 0.5} == moved & set(name[seen >= 3].tolist())
    error = found.optimum.smoother.problem.range_error[0]
    assert -1.6 < error < -0.5  # of a disparity whose standard deviation is 0.5 sqrt(2) px


def test_range_errors_are_taken_off_and_put_back_exactly():
    problem = prepare_space(Rig(3, seconds=10.0).walk(), Config().slam.space).problem
    off = problem.with_range_error(np.array([-0.6]))
    depth, was = off.measured[:, 2], problem.measured[:, 2]
    sigma = 1.0 / np.linalg.norm(problem.measured_root[:, 2], axis=1) / np.linalg.norm(problem.measured[:, :3], axis=1)
    np.testing.assert_allclose(1.0 / depth, (1.0 - 0.6 * sigma) / was, rtol=1e-12)  # by the disparity
    np.testing.assert_allclose(off.with_range_error(np.zeros(1)).measured, problem.measured, rtol=1e-12)
    little = problem.with_range_error(np.array([1e-6]))
    slope = (problem.measured[:, :3] - little.measured[:, :3]) / 1e-6
    np.testing.assert_allclose(slope, problem.range_slope, rtol=1e-3)
