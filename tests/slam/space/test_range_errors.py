"""What a disparity that is off for all leaves unknown of a session without a map."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from evermap.config import Config
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.space.against_map import by_itself
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.range_errors import consider_range_errors
from evermap.slam.space.solve import SpatialSolved, solve_space
from evermap.types import FloatArray, Landmarks, SpatialRecording

from .rigs import Rig

OFF_PX = 0.35
"""Half of the standard deviation of a disparity, which is 0.5 sqrt(2) px: an error as it is usual."""


def carry_stereo(seed: int, bias_px: float, **more: float) -> SpatialRecording:
    return Rig(seed, bias_px=bias_px, seconds=40.0, gaps=0, turns=2, **more).walk()


def solve(recording: SpatialRecording, known: Landmarks | None = None) -> SpatialSolved:
    config = Config().slam
    intake = prepare_space(recording, config.space)
    return solve_space(intake, known, changes=config.changes)


@cache
def solve_biased(bias_px: float) -> tuple[SpatialRecording, SpatialSolved]:
    recording = carry_stereo(3, bias_px)
    return recording, solve(recording)


def nees_of_distances(recording: SpatialRecording, solved: SpatialSolved) -> FloatArray:
    """Of the distances between all places, which no frame moves, by what the session says by itself."""
    true = recording.true_landmarks
    assert true is not None
    at, covariance = solved.optimum.estimate.place[:, :3], by_itself(solved.optimum).covariance_m2
    seen = prepare_space(recording, Config().slam.space).landmark_id[solved.identity]
    at_truth, found = true.position_m[np.searchsorted(true.landmark_id, seen)], []
    for i in range(len(at)):
        for j in range(i):
            way = at[i] - at[j]
            along = np.zeros(len(covariance))
            along[3 * i : 3 * i + 3] = way / np.linalg.norm(way)
            along[3 * j : 3 * j + 3] = -along[3 * i : 3 * i + 3]
            off = np.linalg.norm(way) - np.linalg.norm(at_truth[i] - at_truth[j])
            found.append(off**2 / (along @ covariance @ along))
    return np.array(found)


@pytest.mark.parametrize("bias_px", [pytest.param(OFF_PX, marks=pytest.mark.slow), -OFF_PX])
def test_a_session_does_not_know_its_metre_better_than_its_disparities(bias_px: float):
    """NEES of distances is 20 to 40 times its expectation if errors of single pixels are all that there is."""
    assert 0.3 < np.mean(nees_of_distances(*solve_biased(bias_px))) < 2.0


def test_the_result_says_so_too():
    recording, solved = solve_biased(-OFF_PX)
    result = run_slam(recording)
    scores = compare_with_truth(recording, result)
    assert scores.landmarks_anchored is not None
    assert 0.3 < np.mean(scores.landmarks_anchored.nees) / 3.0 < 2.0  # 8.9 without
    optimum, by = solved.optimum, consider_range_errors(solved.optimum)
    n = len(optimum.estimate.pose)
    poses = np.arange(n)
    own = by[optimum.smoother.structure.system.tree.begin[poses][:, None] + np.arange(6)]
    more = result.trajectory.covariance - optimum.smoother.spread(optimum.now).of(poses, 6)
    assert more == pytest.approx(own @ np.swapaxes(own, 1, 2), abs=1e-3 * float((own**2).max()))


def test_an_error_moves_places_as_solving_with_it_does():
    recording = carry_stereo(3, 0.0)
    solved = solve(recording)
    optimum = solved.optimum
    smoother, _ = optimum.last
    by = consider_range_errors(optimum)
    assert by.shape[1] == 1
    begin = smoother.structure.system.tree.begin[len(smoother.problem.stamp_s) :][: len(optimum.estimate.place)]
    own = by[begin[:, None] + np.arange(3), 0]
    moved = smoother.problem.with_range_error(np.array([0.1]))
    again = type(smoother)(moved, optimum.estimate.pose).optimum(optimum.estimate, optimum.noise, heavy=False)[0]
    shift = again.place[:, :3] - optimum.estimate.place[:, :3]
    assert np.linalg.norm(own) > 0.02
    assert shift / 0.1 == pytest.approx(own / 0.5, abs=0.1 * np.abs(own / 0.5).max())


def test_odometry_or_a_map_tell_the_metre():
    driven = carry_stereo(3, OFF_PX, drift=0.01)
    assert consider_range_errors(solve(driven).optimum).shape[1] == 0
    recording = carry_stereo(3, OFF_PX)
    assert recording.true_landmarks is not None
    known = recording.true_landmarks.as_prior(0.02)
    assert consider_range_errors(solve(recording, known).optimum).shape[1] == 0


@pytest.mark.slow
def test_without_odometry_a_data_sheet_says_how_well_the_metre_is_known():
    recording = carry_stereo(3, 0.0)
    stated = replace(recording, sensors=tuple(replace(one, sigma_scale=0.02) for one in recording.sensors))
    known = recording.true_landmarks
    assert known is not None
    found, alone = run_slam(stated), run_slam(recording)
    at = alone.landmarks.position_m
    assert found.landmarks.position_m == pytest.approx(at)
    more = found.landmarks.covariance_m2 - alone.landmarks.covariance_m2
    assert more == pytest.approx(0.02**2 * at[:, :, None] * at[:, None, :], abs=1e-9)
    in_map = [run_slam(one, prior_map=known.as_prior(0.02)).landmarks.covariance_m2 for one in (stated, recording)]
    assert in_map[0] == pytest.approx(in_map[1])
