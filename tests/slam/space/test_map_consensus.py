"""A map of which a part is wrong, and a camera without odometry: who is where it says, and who not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import Config
from evermap.slam.space import against_map
from evermap.slam.space.against_map import MapComparison, compared, compared_without_rare
from evermap.slam.space.estimate import SpatialOptimum, converge
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.problem import SpatialProblem
from evermap.slam.space.smoother import SpatialSmoother
from evermap.slam.space.solve import SpatialSolved, _with_map, fit_to_map, solve_space
from evermap.types import FloatArray, Landmarks, SpatialRecording, rows_of

from .corridors import World, as_poses, tagged_corridor
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


def as_points(world: World, seed: int) -> SpatialRecording:
    """The same walk, of every tag only its position."""
    recording = as_poses(world, seed, 0.03, 0.05)
    seen = recording.detections
    turn, sigma_rad = np.full((len(seen), 4), np.nan), np.full(len(seen), np.nan)
    return replace(recording, detections=replace(seen, rotation=turn, sigma_rad=sigma_rad))


def solve_held(by_m: tuple[float, float, float]) -> tuple[World, SpatialOptimum, FloatArray]:
    """A walk without odometry in a map of which tag 5 is elsewhere, all else solved right; and what the map states."""
    world = tagged_corridor(3, odometry=False, n_frames=80)
    intake = prepare_space(as_points(world, 3), Config().slam.space)
    true = Landmarks.in_space(world.tags.landmark_id, world.tags.position_m)
    right = solve_space(intake, true.as_prior(0.02)).optimum
    position = true.position_m.copy()
    position[5] += by_m
    problem, stated = _with_map(intake, replace(true, position_m=position).as_prior(0.02))
    place = right.estimate.place.copy()
    place[5, :3] = position[5]
    return world, converge(problem, replace(right.estimate, place=place), right.noise, heavy_rounds=0), stated


def test_what_its_detections_see_elsewhere_moved_though_all_of_them_are_outliers():
    world, held, stated = solve_held((0.0, 0.0, 4.0))
    assert held.now.weight[held.smoother.problem.place == 5].max() < 1e-6
    found, from_map = compared(held, stated)
    assert from_map.p_stands[5] < 1e-3
    assert np.delete(from_map.p_stands, 5).min() > 0.95
    assert found.estimate.place[5, :3] == pytest.approx(world.tags.position_m[5], abs=0.06)


def test_turns_that_explain_detections_and_map_worse_are_not_taken(monkeypatch):
    """As if places that stand were let go in turn for a few that do not, and the frames went with these."""
    _, held, stated = solve_held((0.0, 0.0, 0.0))

    def lead_astray(problem: SpatialProblem, *_: object, **__: object) -> SpatialOptimum:
        pose = held.estimate.pose.copy()
        pose[: len(pose) // 2, 1] += 0.5
        estimate = replace(held.estimate, pose=pose)
        smoother = SpatialSmoother(problem, pose)
        return SpatialOptimum(estimate, held.noise, smoother, smoother.linearised(estimate, held.noise, heavy=False))

    monkeypatch.setattr(against_map, "converge", lead_astray)
    found, from_map = compared(held, stated)
    assert found.estimate is held.estimate
    assert from_map.p_stands.min() > 0.9


def test_what_was_let_go_does_not_seem_to_stand(monkeypatch):
    """Of a map in another scale all is let go at once; without it all is so uncertain that it may as well stand."""
    _, held, stated = solve_held((0.0, 0.0, 0.0))

    def is_held(problem: SpatialProblem) -> bool:
        return bool((problem.prior.weight >= 0.5).any())

    def judge(problem: SpatialProblem, found: MapComparison, *_: FloatArray) -> MapComparison:
        return replace(found, p_stands=np.full(len(found.off), 0.0 if is_held(problem) else 0.9))

    def cost(optimum: SpatialOptimum, *_: object) -> float:
        return 100.0 if is_held(optimum.smoother.problem) else 0.0

    monkeypatch.setattr(against_map, "_judge_places", judge)
    monkeypatch.setattr(against_map, "cost_in_map", cost)
    found, from_map = compared(held, stated)
    assert is_held(found.smoother.problem)
    assert not ((from_map.p_stands >= 0.5) & (found.smoother.problem.prior.weight < 0.5)).any()


@pytest.mark.parametrize(("again", "is_taken"), [((5, 6), False), ((6,), True)])
def test_a_start_without_what_was_hardly_seen_is_taken_where_another_place_comes_back(monkeypatch, again, is_taken):
    """Solutions that are alike, and which places have moved in them: 5 by the first one, others by the second."""
    _, worse, stated = solve_held((0.0, 0.0, 4.0))
    better, from_map = compared(worse, stated)

    def settle(optimum: SpatialOptimum, moved: tuple[int, ...]) -> tuple[SpatialOptimum, MapComparison]:
        return optimum, replace(from_map, p_stands=np.where(np.isin(np.arange(12), moved), 0.0, 0.97))

    monkeypatch.setattr(against_map, "FEWEST", 30.0)  # all are rare
    made = iter([settle(better, again), settle(better, again)])
    monkeypatch.setattr(against_map, "_settle_places", lambda *_, **__: next(made))
    found, told = compared_without_rare(worse, settle(worse, (5,)), stated)
    assert (found is better) == is_taken
    assert (told.p_stands[5] > 0.9) == is_taken


def test_what_was_seen_once_does_not_hold_what_others_stand_by():
    """Half of a map of 24 is .3 to 2 m off, and a third of it was seen once or twice. None that stands has moved."""
    seed, random = 5, np.random.default_rng(12)
    world = tagged_corridor(seed, n_tags=24, odometry=False)
    recording = as_points(world, seed)
    seen = recording.detections
    rare, kept = random.random(24) < 0.3, random.random(len(seen)) < 0.5
    for tag in np.flatnonzero(rare):
        mine = np.flatnonzero(seen.landmark_id == tag)
        kept[mine] = False
        kept[random.choice(mine, min(len(mine), 1 + random.integers(2)), replace=False)] = True
    moved = random.choice(24, 12, replace=False)
    position, by_m = world.tags.position_m.copy(), random.normal(size=(12, 3))
    by_m *= np.exp(random.uniform(np.log(0.3), np.log(2.0), (12, 1))) / np.linalg.norm(by_m, axis=1, keepdims=True)
    position[moved] += by_m
    known = Landmarks.in_space(world.tags.landmark_id, position).as_prior(0.02)
    result = run_slam(replace(recording, detections=rows_of(seen, kept)), prior_map=known)
    told = {one for change in result.changes if change.probability > 0.5 for one in change.landmark_ids}
    assert told <= set(moved.tolist())
    assert len(told) >= 6
