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


@pytest.mark.parametrize(("seed", "count"), [(0, 12), (4, 12)])
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
