"""Tags that are moved while a robot drives through a corridor: which, from when, by how much; and what is no move."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evermap import run_slam
from evermap.config import Config
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.io.map_formats import read_map_file
from evermap.metrics.summary import compare_with_truth
from evermap.slam.correlation import Lasting
from evermap.slam.space import moved_within
from evermap.slam.space.against_map import AS_STATED, MapComparison
from evermap.slam.space.estimate import SpatialOptimum
from evermap.slam.space.explanation import SpatialExplanation, _contradicts_map, find_p_apart
from evermap.slam.space.intake import prepare_space
from evermap.slam.space.marginal import _cost_of_outliers
from evermap.slam.space.problem import SpatialNoise, SpatialProblem
from evermap.slam.space.solve import solve_space
from evermap.types import ANY_RANGE_M2, ChangeKind, Frames, SlamResult, SpatialRecording

from .corridors import Move, World, as_poses, tagged_corridor

FAR = Move(5, 20.0, (1.0, 0.0, 0.0))
NEAR = Move(5, 20.0, (0.1, 0.0, 0.0))
TURN = Move(5, 20.0, turn_rad=0.4)
IN_VIEW = Move(3, 8.0, (0.6, 0.0, 0.3))
LATE = Move(1, 35.5, (0.5, 0.0, 0.2))


def robot_error(recording: SpatialRecording, result: SlamResult) -> float:
    found = compare_with_truth(recording, result, rate_hz=10.0).poses
    assert found is not None
    return float(np.sqrt(np.mean(found.position_error_m**2)))


def rename_moved(recording: SpatialRecording, moves: tuple[Move, ...]) -> SpatialRecording:
    """The recording of somebody who knows: what was moved has another identity from then on."""
    seen, names = recording.detections, recording.detections.landmark_id.copy()
    for move in moves:
        names[(recording.frames.stamp_s[seen.frame] >= move.at_s) & (names == move.tag)] = 100 + move.tag
    return replace(recording, detections=replace(seen, landmark_id=names))


def check_moves(world: World, recording: SpatialRecording, moves: tuple[Move, ...], *, mapped: bool) -> SlamResult:
    given = world.tags.as_prior(0.01) if mapped else None
    result = run_slam(recording, prior_map=given)
    told = {change.landmark_ids: change for change in result.changes}
    assert told.keys() == {(move.tag,) for move in moves}
    for move in moves:
        change = told[(move.tag,)]
        assert change.kind is ChangeKind.MOVED
        assert change.displacement_m == pytest.approx(move.by_m, abs=0.05 if mapped else 0.08)
        assert change.rotation_rad == pytest.approx(move.turn_rad, abs=0.05)
        assert change.probability > 0.9
        start_s = recording.frames.stamp_s[0]
        assert change.stamp_from_s - start_s <= move.at_s <= change.stamp_to_s - start_s
    assert not any("#2" in warning for warning in result.warnings)
    known = run_slam(rename_moved(recording, moves), prior_map=given)
    assert robot_error(recording, result) < 1.2 * robot_error(recording, known)
    return result


@pytest.mark.slow
@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("corners", [True, False])
@pytest.mark.parametrize("move", [FAR, TURN])
def test_a_tag_that_is_moved_is_one_tag_that_moved(move, corners, mapped):
    world = tagged_corridor(1, moves=(move,))
    result = check_moves(world, world.recording if corners else as_poses(world, 1), (move,), mapped=mapped)
    if mapped:  # it is where it is now
        at = result.landmarks.position_m[result.landmarks.landmark_id == move.tag]
        assert at == pytest.approx(world.tags.position_m[[move.tag]] + move.by_m, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_a_move_by_less_than_another_landmark_would_be_away_is_found_by_corners(seed):
    world = tagged_corridor(seed, moves=(NEAR,))
    check_moves(world, world.recording, (NEAR,), mapped=False)


def test_a_move_within_the_noise_of_poses_is_no_move_before_the_drive():
    """With one place for it, the map seems to be wrong by half of the way."""
    world = tagged_corridor(6, moves=(NEAR,))
    check_moves(world, as_poses(world, 6), (NEAR,), mapped=True)


@pytest.mark.parametrize(("move", "seed"), [(IN_VIEW, 0), pytest.param(LATE, 6, marks=pytest.mark.slow)])
def test_the_instant_is_known_where_the_tag_is_in_view(move, seed):
    world = tagged_corridor(seed, moves=(move,))
    (change,) = check_moves(world, world.recording, (move,), mapped=False).changes
    assert change.stamp_to_s - change.stamp_from_s < 2.0


def as_directions(world: World, seed: int, sigma_rad: float = 0.001) -> SpatialRecording:
    """The same drive, of every tag only where it is seen, not how far away."""
    recording = as_poses(world, seed, 1e-4, 0.02)
    at = recording.detections.position_sensor_m
    at = at / np.linalg.norm(at, axis=1, keepdims=True)
    at = at + np.cross(at, sigma_rad * np.random.default_rng(seed).normal(size=at.shape))
    at /= np.linalg.norm(at, axis=1, keepdims=True)
    along = at[:, :, None] * at[:, None, :]
    covariance = sigma_rad**2 * (np.eye(3) - along) + 2.0 * ANY_RANGE_M2 * along
    nothing = {"rotation": np.full((len(at), 4), np.nan), "sigma_rad": np.full(len(at), np.nan)}
    seen = replace(recording.detections, position_sensor_m=at, covariance_sensor_m2=covariance, **nothing)
    return replace(recording, detections=seen)


@pytest.mark.parametrize(
    ("move", "mapped"),
    [
        (Move(3, 8.0, (0.6, 0.0, 0.3)), True),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in ((Move(5, 20.0, (0.0, 0.5, 0.0)), True), (Move(3, 8.0, (0.6, 0.0, 0.3)), False))
        ),
    ],
)
def test_a_landmark_of_which_only_directions_are_seen_is_moved(move, mapped):
    """Its ranges were triangulated from sightings of both places, where it is seen at both within a while. Poses may be
    bent until what is seen of both meets at one point.
    """
    world = tagged_corridor(4, moves=(move,))
    check_moves(world, as_directions(world, 4), (move,), mapped=mapped)


@pytest.mark.parametrize(("strays", "cut"), [(0, 30), (4, 30), (0, 60)])
def test_directions_part_where_they_meet_at_two_points(strays, cut):
    """Exact directions with a milliradian of noise from a curve; some stray far off; none part at one point."""
    random = np.random.default_rng(7)
    angle = np.linspace(0.0, 2.0, 60)
    eye_m = np.column_stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), 0.1 * angle])
    both_m = np.array([[0.2, -0.1, 1.0], [0.2, 0.4, 1.0]])
    ahead = both_m[(np.arange(60) >= cut).astype(int)] - eye_m
    ahead[7 : 7 + 9 * strays : 9] += 1.0
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    ahead += 1e-3 * random.normal(size=ahead.shape)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    parted = moved_within._part_rays(eye_m, ahead, np.full(60, 1e-3), 3)
    if cut == 60:
        assert parted is None
        return
    assert parted is not None
    assert parted[0] == cut
    assert np.array(parted[1:]) == pytest.approx(both_m, abs=0.004)
    assert moved_within._part_rays(eye_m[27:32], ahead[27:32], np.full(5, 1e-3), 3) is None  # too few


@pytest.mark.slow
@pytest.mark.parametrize("mapped", [False, True])
def test_two_tags_that_are_moved_make_the_robot_jump_no_more(mapped):
    """One of them bends the robot, by two jumps of the odometry, and hardly has outliers."""
    moves = IN_VIEW._replace(at_s=15.0), Move(8, 24.0, (-0.5, 0.0, 0.4))
    world = tagged_corridor(1, moves=moves)
    check_moves(world, world.recording, moves, mapped=mapped)


def test_what_moved_before_the_drive_and_what_moved_within_it_are_told_apart():
    world = tagged_corridor(7, moves=(FAR,))
    before = np.array([0.0, -0.1, 0.4])
    position = world.tags.position_m.copy()
    position[8] -= before
    result = run_slam(world.recording, prior_map=replace(world.tags.as_prior(0.01), position_m=position))
    told = {change.landmark_ids[0]: change for change in result.changes}
    assert told.keys() == {5, 8}
    assert told[5].stamp_from_s > 0.0
    assert told[5].displacement_m == pytest.approx(FAR.by_m, abs=0.05)
    assert np.isnan(told[8].stamp_from_s)
    assert told[8].displacement_m == pytest.approx(before, abs=0.05)


@pytest.mark.parametrize("seed", [6, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (7, 8))])
@pytest.mark.parametrize("corners", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_two_tags_with_one_identity_that_are_seen_in_turns_did_not_move(seed, corners):
    world = tagged_corridor(seed, rename={10: 1})
    result = run_slam(world.recording if corners else as_poses(world, seed))
    assert not result.changes
    assert "1#2" in result.landmarks.names.values()
    assert "1#3" not in result.landmarks.names.values()


@pytest.mark.parametrize("seed", [6, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (7, 8))])
@pytest.mark.parametrize("corners", [pytest.param(True, marks=pytest.mark.slow), False])
def test_two_tags_with_one_identity_are_two_where_no_look_shows_that_one_left(seed, corners):
    """One way, each is passed once: the first one may still be there, for all that was seen."""
    world = tagged_corridor(seed, rename={10: 1}, there_and_back=False)
    result = run_slam(world.recording if corners else as_poses(world, seed))
    assert not result.changes
    assert "1#2" in result.landmarks.names.values()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("late_s", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
def test_nothing_moved_where_the_camera_is_late_or_identities_are_wrong(seed, late_s):
    world = tagged_corridor(seed, p_wrong=0.03)
    frames = Frames(world.recording.frames.stamp_s + late_s)
    assert not run_slam(replace(world.recording, frames=frames)).changes


@pytest.mark.parametrize(("n_off", "is_in_doubt"), [(0, False), (5, False), (6, True), (10, True)])
def test_a_map_of_which_most_is_elsewhere_is_in_doubt_not_its_landmarks(n_off: int, is_in_doubt: bool) -> None:
    """Of ten places of a map; without a map nothing contradicts it."""
    p_stands = np.where(np.arange(10) < n_off, 0.49, 0.51)
    found = MapComparison(p_stands, np.zeros((10, 6)), np.zeros((10, 6, 6)), AS_STATED)
    unused: Any = None
    assert _contradicts_map(SpatialExplanation(unused, np.arange(10), (), found, unused)) is is_in_doubt
    assert not _contradicts_map(SpatialExplanation(unused, np.arange(10), (), None, unused))


def test_others_are_asked_where_none_of_the_likeliest_is_at_two_places(monkeypatch):
    """What moved bends the poses beside it, so that tags that stand there have the outliers."""
    asked = []

    def find(_optimum, suspects, _interval, single):
        asked.append(suspects.tolist())
        return (suspects, single) if 6 in suspects else (None, single | {*suspects.tolist()})

    monkeypatch.setattr(moved_within, "_find_among", find)
    found, single = moved_within.find_two_places(None, np.array([4, 1, 0, 2, 8, 6, 3, 5]), 0.95)
    assert asked == [[4, 1, 0, 2], [8, 6, 3, 5]]
    assert found.tolist() == asked[1]
    assert single == {4, 1, 0, 2}
    assert moved_within.find_two_places(None, np.array([4, 1, 0, 2, 8]), 0.95) == (None, {4, 1, 0, 2, 8})


def test_what_is_at_one_place_of_an_optimum_is_asked_once(monkeypatch):
    """Beside the same others, or with those that are asked now left out."""
    asked, left_out = [], []

    def ask(_optimum, _free, _at, row, _interval):
        asked.append(row)

    monkeypatch.setattr(moved_within, "as_seen", lambda *_: None)
    monkeypatch.setattr(moved_within, "_without", lambda _, suspects: left_out.append(suspects.tolist()))
    monkeypatch.setattr(moved_within, "_at_two_places", ask)
    optimum = SimpleNamespace(smoother=SimpleNamespace(problem=SimpleNamespace(measured=None)))
    _, single = moved_within.find_two_places(optimum, np.array([4, 1, 0, 2, 8]), 0.95, frozenset({1}))
    assert asked == [4, 0, 2, 8]
    found = moved_within.find_two_places(optimum, np.array([4, 1, 0, 2, 8, 7]), 0.95, single)
    assert found == (None, {4, 1, 0, 2, 8, 7})
    assert asked == [4, 0, 2, 8, 7]
    assert left_out == [[4, 1, 0, 2], [8], [8, 7]]


@cache
def solve_poses() -> SpatialProblem:
    """What is solved of a drive on which nothing moved."""
    recording = as_poses(tagged_corridor(3), 3)
    return solve_space(prepare_space(recording, Config().slam.space), None).optimum.smoother.problem


@pytest.mark.parametrize(
    ("every_s", "places", "persist_s", "share", "count"),
    [
        (0.1, 1, 1.0, 0.0, 8.0),
        (0.1, 1, 1.0, 0.85, 1.465),
        (0.1, 1, 100.0, 1.0, 1.0),
        (0.1, 8, 100.0, 1.0, 8.0),
        (0.1, 2, 100.0, 1.0, 2.0),
        (60.0, 1, 1.0, 1.0, 8.0),
    ],
)
def test_outliers_in_a_row_of_one_place_have_one_reason(every_s, places, persist_s, share, count):
    """How many independent outliers eight count as that alternate between places. Else one long bad view is a move."""
    problem = solve_poses()
    rows = np.arange(8)
    row = replace(
        problem, stamp_s=every_s * np.arange(len(problem.stamp_s)), pose_row=np.arange(len(problem.pose_row)),
        place=np.arange(len(problem.place)) % places,
    )  # fmt: skip
    odd = np.isin(np.arange(len(problem.place)), rows)
    noise = SpatialNoise(1.0, 1.0)
    lasting = Lasting(np.array([persist_s]), np.array([share]))
    found = _cost_of_outliers(row, noise, odd, lasting)
    assert found == pytest.approx(count * float(problem.sightings.log_odds[problem.kind[0]]), rel=0.01)


@pytest.mark.data
@pytest.mark.slow
def test_no_tag_of_a_real_room_moves_while_a_camera_passes(shared_data, tmp_path):
    """STAR-loc, whose tags stand; two of its survey are exchanged. One view of three is 4 cm off, with outliers."""
    folder = shared_data / "starloc"
    command = [sys.executable, folder / "starloc_to_plain.py", folder, "loop-3d_s1", tmp_path / "drive"]
    subprocess.run(command, check=True)
    survey = read_map_file(folder / "mocap" / "environment_v1.csv").landmarks
    told = run_slam(read_recording(tmp_path / "drive"), prior_map=survey).changes
    assert [change.stamp_from_s for change in told if np.isfinite(change.stamp_from_s)] == []
    assert {change.landmark_ids for change in told if change.probability > 0.9} == {(35,), (36,)}


def test_what_is_at_one_place_in_the_end_did_not_move():
    world = tagged_corridor(3)
    optimum = solve_space(prepare_space(world.recording, Config().slam.space), None).optimum
    place = optimum.estimate.place.copy()
    both = replace(optimum, estimate=replace(optimum.estimate, place=place))
    move = moved_within.MovedWithin(2, 3, 1.0, (0.0, 2.0), 1.0)
    assert find_p_apart(both, move) > 0.99
    place[3] = place[2]
    place[3, 0] += 0.001
    assert find_p_apart(both, move) < 0.1
    place[3, 0] += 0.1
    assert find_p_apart(both, move) > 0.99
    place[3] = se3.compose(place[2], se3.from_angles([0.0, 0.0, 0.2]))
    assert find_p_apart(both, move) > 0.99


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow), 7])
@pytest.mark.parametrize("by_m", [0.0, 0.5])
def test_errors_that_last_move_nothing_that_is_seen_twice(by_m, seed):
    """A tag that has another identity on the way back, seen for some 3 s on either way with errors of 3 cm that persist
    for 5 s: they put it at places 13 cm apart, which a dozen sightings that err by themselves would not.
    """
    moves = (Move(5, 20.0, (by_m, 0.0, 0.0)),)
    world = tagged_corridor(seed, odometry=False, moves=moves)
    recording = err_for_a_while(rename_moved(as_poses(world, seed, 0.005), moves), persist_s=5.0, sigma_m=0.03)
    others = world.tags[np.delete(np.arange(12), 5)]  # hold the poses
    solved = solve_space(prepare_space(recording, Config().slam.space), others.as_prior(0.01)).optimum
    each = SpatialOptimum(solved.estimate, solved.noise, *solved.last)  # as the search sees it: detections count as one
    move = moved_within.MovedWithin(5, 12, 20.0, (19.0, 21.0), 1.0)
    p_moved = find_p_apart(each, move)
    assert p_moved > 0.99 if by_m > 0.0 else p_moved < 0.1
    assert find_p_apart(each, move, alike=10.0) < 0.1  # errors of a metre that all sightings of a place share


def err_for_a_while(recording: SpatialRecording, persist_s: float, sigma_m: float) -> SpatialRecording:
    """The same sightings, where errors of each tag's position have an exponential correlation over time."""
    seen, random = recording.detections, np.random.default_rng(1)
    stamp_s, off = recording.frames.stamp_s[seen.frame], np.zeros((len(seen), 3))
    for tag in np.unique(seen.landmark_id):
        mine = np.flatnonzero(seen.landmark_id == tag)
        lag_s = np.abs(stamp_s[mine, None] - stamp_s[mine])
        root = np.linalg.cholesky(np.exp(-lag_s / persist_s) + 1e-9 * np.eye(len(mine)))
        off[mine] = sigma_m * root @ random.normal(size=(len(mine), 3))
    return replace(recording, detections=replace(seen, position_sensor_m=seen.position_sensor_m + off))
