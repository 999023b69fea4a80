"""A landmark that is carried about is at many places: it is named, and its detections are not used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap import Config, run_slam
from evermap.explain.carried import APART_M, AT_TWO, CARRIED, ELSEWHERE, _fill_places, _moves_in_view, find_carried
from evermap.explain.expectations import find_instants, find_poses_at, locate_detections
from evermap.geometry import se2
from evermap.slam.plane import in_its_space
from evermap.types import UNKNOWN, AnyRecording, ParameterEstimate, SlamResult, VerdictKind
from evermap_studies.causes.catalogue import catalogue
from evermap_studies.causes.drives import as_recording
from evermap_studies.causes.judge import make_case

from .worlds import World

NAME = 2
STEP_S = 2.0


def wander(stamp_s: np.ndarray, speed_mps: float = 0.4) -> np.ndarray:
    """(N, 2) displacements: another one every two seconds."""
    step = np.random.default_rng(5).normal(0.0, STEP_S * speed_mps / np.sqrt(2.0), (100, 2))
    return np.cumsum(step, axis=0)[(stamp_s / STEP_S).astype(int)]


def move_once(stamp_s: np.ndarray) -> np.ndarray:
    return np.where(stamp_s[:, None] > 18.0, [[1.2, 0.9]], 0.0)


def move_and_return(stamp_s: np.ndarray) -> np.ndarray:
    return np.where((stamp_s[:, None] > 12.0) & (stamp_s[:, None] < 26.0), [[1.2, 0.9]], 0.0)


def carry(recording: Any, how: Callable[[np.ndarray], np.ndarray], name: int = NAME) -> Any:
    """The recording with a landmark displaced by (x, y) at its instants, by the true poses."""
    seen, taken_s = recording.detections, recording.frames.stamp_s[recording.detections.frame]
    by = np.where((seen.landmark_id == name)[:, None], how(taken_s), 0.0)
    pose = recording.truth.pose_world_robot[seen.frame]
    if recording.dim == 2:
        turn, (range_m, bearing) = pose[:, 2], (seen.range_m, seen.bearing_rad)
        x = range_m * np.cos(bearing) + by[:, 0] * np.cos(turn) + by[:, 1] * np.sin(turn)
        y = range_m * np.sin(bearing) - by[:, 0] * np.sin(turn) + by[:, 1] * np.cos(turn)
        return replace(recording, detections=replace(seen, range_m=np.hypot(x, y), bearing_rad=np.arctan2(y, x)))
    mount = Rotation.from_quat([recording.sensors[one].mount_robot_sensor[3:] for one in seen.sensor])
    axes = Rotation.from_quat(pose[:, 3:]) * mount
    at = seen.position_sensor_m + axes.inv().apply(np.column_stack([by, np.zeros(len(by))]))
    return replace(recording, detections=replace(seen, position_sensor_m=at))


def make_plane(seed: int = 3) -> Any:
    return World(seed=seed, seconds=40.0).plane()


def make_space(seed: int = 3) -> Any:
    return World(seed=seed, seconds=40.0).space(corners=False)


@cache
def solve(make: Callable[[], Any]) -> SlamResult:
    return run_slam(make())


def list_codes(result: SlamResult) -> list[str]:
    return [cause.code for cause in result.causes]


@pytest.mark.parametrize(
    ("make", "in_map"),
    [
        pytest.param(make_plane, False, marks=pytest.mark.slow),
        (make_plane, True),
        (make_space, False),
        pytest.param(make_space, True, marks=pytest.mark.slow),
    ],
)
def test_what_is_carried_about_is_named_and_not_used(make: Any, in_map: bool) -> None:
    given = make()
    wrong = carry(given, wander)
    known = given.true_landmarks if in_map else None
    result = run_slam(wrong, prior_map=known)
    (cause,) = result.causes
    assert (cause.code, cause.subject, cause.probability) == (CARRIED, str(NAME), 1.0)
    (found,) = find_carried(result, in_its_space(wrong, Config().slam, dim=given.dim if in_map else None))
    assert found.landmark_id == NAME
    assert cause.value == found.apart_m
    taken_s = wrong.frames.stamp_s[wrong.detections.frame[wrong.detections.landmark_id == NAME]]
    true_m = float(np.linalg.norm(np.ptp(wander(taken_s), axis=0)))
    assert found.apart_m == pytest.approx(true_m, abs=0.3)
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND
    assert cause in result.verdict.causes
    assert not result.changes
    assert not (result.innovations.landmark_id == NAME).any()
    if not in_map:  # as without it
        seen = given.detections
        name = np.where(seen.landmark_id == NAME, UNKNOWN, seen.landmark_id)
        alone = run_slam(replace(given, detections=replace(seen, landmark_id=name)))
        same = alone.trajectory.pose_world_robot
        np.testing.assert_allclose(result.trajectory.pose_world_robot, same, atol=1e-4)


@pytest.mark.parametrize("how", [move_once, move_and_return])
@pytest.mark.parametrize("make", [make_plane, make_space])
def test_what_moves_between_two_places_is_not_carried_about(make: Any, how: Any) -> None:
    assert not find_carried(solve(make), in_its_space(carry(make(), how), Config().slam))


@pytest.mark.parametrize(
    ("make", "how"),
    [
        (make_plane, move_and_return),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in ((make_plane, move_once), (make_space, move_once), (make_space, move_and_return))
        ),
    ],
)
def test_a_run_in_which_something_moved_names_nothing_that_is_carried_about(make: Any, how: Any) -> None:
    assert CARRIED not in list_codes(run_slam(carry(make(), how)))


def move_twice(stamp_s: np.ndarray, at_s: float = 18.0) -> np.ndarray:
    """Displaced before the drive, and once more at an instant."""
    return np.where(stamp_s[:, None] > at_s, [[-0.6, 1.4]], [[1.2, 0.9]])


@cache
def solve_in_map(make: Callable[[], Any]) -> SlamResult:
    given = make()
    return run_slam(given, prior_map=given.true_landmarks)


@pytest.mark.parametrize(
    ("make", "how", "expected"),
    [
        (make_plane, move_twice, True),
        (make_space, move_twice, True),
        (make_plane, partial(move_twice, at_s=31.0), False),  # while nobody looks
        (make_space, partial(move_twice, at_s=21.0), False),
        (make_plane, partial(move_twice, at_s=-1.0), False),
        (make_plane, move_once, False),
        (make_space, move_once, False),
    ],
)
def test_what_is_elsewhere_than_in_a_map_and_moves_in_view_is_carried_about(
    make: Any, how: Callable[[np.ndarray], np.ndarray], expected: bool
) -> None:
    """Where the map has it is one of its places. Unseen it may have moved before the drive, and once within it."""
    given, result = make(), solve_in_map(make)
    wrong = in_its_space(carry(given, how), Config().slam, dim=given.dim)
    found = [one.landmark_id for one in find_carried(result, wrong, given.true_landmarks)]
    assert found == ([NAME] if expected else [])
    assert not find_carried(result, wrong)
    elsewhere = replace(result, trajectory=replace(result.trajectory, frame="first_pose"))
    assert not find_carried(elsewhere, wrong, given.true_landmarks)
    others = given.true_landmarks[given.true_landmarks.landmark_id != NAME]
    assert not find_carried(result, wrong, others)


@pytest.mark.parametrize("make", [make_plane, pytest.param(make_space, marks=pytest.mark.slow)])
def test_what_moves_in_view_is_no_certain_move_of_a_map(make: Any) -> None:
    """Nor is all else of an exact map, seen from the place where the map has what moved, while it was elsewhere."""
    given = make()
    result = run_slam(carry(given, move_twice), prior_map=given.true_landmarks)
    assert list_codes(result) == [CARRIED]
    assert not result.changes


def test_the_place_of_a_map_is_the_first_whatever_is_seen_there() -> None:
    at = np.repeat([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [1, 4, 5], axis=0)
    radius_m = np.full(10, 0.3)
    for row, expected, elsewhere in ((0, [0.1, 0.5, 0.4], at[:, 0] == 1.0), (9, [0.5, 0.4, 0.1], at[:, 0] == 0.0)):
        shares, found = _fill_places(at, radius_m, np.linalg.norm(at - at[row], axis=1) < radius_m)
        assert shares == pytest.approx(expected)
        np.testing.assert_array_equal(found, elsewhere)
    shares, found = _fill_places(at, radius_m, np.zeros(10, dtype=np.bool_))  # never seen there
    assert shares == pytest.approx([0.0, 0.5, 0.4, 0.1])
    np.testing.assert_array_equal(found, at[:, 0] < 2.0)


def test_looks_that_jump_are_no_move_in_view() -> None:
    """As of identities that are misread for a look or two: what moves is at either place in a row."""
    at, radius_m, taken_s = np.zeros((12, 2)), np.full(12, 0.3), 0.2 * np.arange(12.0)
    assert not _moves_in_view(at, radius_m, taken_s)
    for first, count, expected in ((5, 1, False), (5, 2, False), (6, 6, True), (9, 3, True), (10, 2, False)):
        jumped = at.copy()
        jumped[first : first + count] = 1.0
        assert _moves_in_view(jumped, radius_m, taken_s) is expected
        assert not _moves_in_view(0.2 * jumped, radius_m, taken_s)
        slept_s = taken_s + np.where(np.arange(12) >= first, 5.0, 0.0)
        assert not _moves_in_view(jumped, radius_m, slept_s)
    strayed = np.where(np.arange(12) < 6, 0.0, 1.0) + np.where(np.arange(12) % 3 == 0, 0.2, 0.0)
    assert not _moves_in_view(np.column_stack([strayed, strayed]), radius_m, taken_s)  # in no place in a row


@pytest.mark.parametrize("size", [0.85, 1.3])
def test_a_landmark_of_another_size_is_not_carried_about(size: float) -> None:
    """Its detections are too near or too far: along the drive they are at many places."""
    wrong = World(seed=3, seconds=40.0, sizes={NAME: size}).plane()
    result = solve(make_plane)
    at, radius_m = put_along(result, wrong)
    shares, elsewhere = _fill_places(at, radius_m)
    assert sum(shares[:2]) < AT_TWO  # as of what is carried about
    assert np.count_nonzero(elsewhere) > ELSEWHERE
    assert not find_carried(result, wrong)


def put_along(result: SlamResult, recording: Any) -> tuple[np.ndarray, np.ndarray]:
    """Where detections of the landmark are, and radii of a place."""
    rows = np.flatnonzero(recording.detections.landmark_id == NAME)
    pose = find_poses_at(result.trajectory, find_instants(recording, result)[rows])[0]
    at = se2.transform(pose, locate_detections(recording)[rows])
    return at, np.full(len(rows), APART_M)


def test_identities_that_are_misread_are_not_carried_about() -> None:
    """One that is read of any other for a look."""
    given, random = make_plane(), np.random.default_rng(2)
    seen, name = given.detections, given.detections.landmark_id.copy()
    rows, others = np.flatnonzero(name == NAME), np.flatnonzero(name != NAME)
    name[random.choice(rows, len(rows) // 2, replace=False)] = UNKNOWN
    name[random.choice(others, len(rows) // 2, replace=False)] = NAME
    wrong, result = replace(given, detections=replace(seen, landmark_id=name)), solve(make_plane)
    assert sum(_fill_places(*put_along(result, wrong))[0][:2]) < AT_TWO
    assert not find_carried(result, wrong)


def test_of_many_landmarks_not_all_are_carried_about() -> None:
    """Where a few are, it is they; where more seem to be, it is the poses."""
    given, result = make_plane(), solve(make_plane)
    few, many = given, given
    for name in range(2):
        few = carry(few, wander, name)
    for name in range(5):
        many = carry(many, wander, name)
    assert [one.landmark_id for one in find_carried(result, few)] == [0, 1]
    assert not find_carried(result, many)


def test_where_poses_are_hardly_known_nothing_is_carried_about() -> None:
    wrong, result = carry(make_plane(), wander), solve(make_plane)
    path = result.trajectory
    vague = replace(result, trajectory=replace(path, covariance=path.covariance + np.eye(3)))
    assert find_carried(result, wrong)
    assert not find_carried(vague, wrong)


def test_a_person_who_walks_slowly_is_found_and_one_who_leans_is_not() -> None:
    result = solve(make_plane)

    def lean(stamp_s: np.ndarray) -> np.ndarray:
        return 0.14 * np.column_stack([np.sin(stamp_s), np.cos(stamp_s)])

    def stroll(stamp_s: np.ndarray) -> np.ndarray:
        return np.column_stack([0.05 * stamp_s, 0.0 * stamp_s])

    path = result.trajectory
    result = replace(result, trajectory=replace(path, covariance=0.01 * path.covariance))  # of a few millimetres
    found: list[AnyRecording] = [carry(make_plane(), how) for how in (stroll, lean)]
    assert [len(find_carried(result, each)) for each in found] == [1, 0]


def test_looks_at_what_is_carried_fast_are_farther_apart() -> None:
    """A third of a metre, of landmarks that are seen 2.5 times a second and carried at .8 m/s."""
    given, result = make_plane(), solve(make_plane)
    seen = given.detections
    name = np.where((seen.landmark_id == NAME) & (seen.frame % 2 == 1), UNKNOWN, seen.landmark_id)
    some = replace(given, detections=replace(seen, landmark_id=name))
    wrong = carry(some, lambda stamp_s: np.column_stack([0.8 * stamp_s, 0.0 * stamp_s]))
    at, radius_m = put_along(result, wrong)
    assert np.median(np.linalg.norm(np.diff(at, axis=0), axis=1)) > radius_m[0]
    assert [one.landmark_id for one in find_carried(result, wrong)] == [NAME]


@pytest.mark.parametrize("change", [pytest.param({"bias_m": 0.3}, marks=pytest.mark.slow), {"slope": 0.05}])
def test_ranges_that_are_off_carry_nothing_about(change: dict[str, float]) -> None:
    """Raw ranges put a landmark on a circle; the calibration that was estimated takes that off."""
    given = make_plane()
    seen = given.detections
    read_m = change.get("bias_m", 0.0) + (1.0 + change.get("slope", 0.0)) * seen.range_m
    result = run_slam(replace(given, detections=replace(seen, range_m=read_m)), prior_map=given.true_landmarks)
    assert CARRIED not in list_codes(result)


def test_a_clock_that_is_put_right_carries_nothing_about() -> None:
    """At the stamps that were given the robot is .2 s on, and a landmark aside is seen at many places."""
    world = next(one for one in catalogue() if one.name == "laser in a map: sensor 0.2 s late")
    given = make_case(replace(world, make=replace(world.make, duration_s=40.0)), 4).given
    result = run_slam(as_recording(given), prior_map=given.places)
    assert list_codes(result) == ["clock"]
    assert result.causes[0].value == pytest.approx(0.2, abs=0.01)


def test_what_is_carried_about_is_found_by_axes_that_are_put_right() -> None:
    given = make_plane()
    wrong = carry(given, wander)
    mirrored = replace(wrong, detections=replace(wrong.detections, bearing_rad=-wrong.detections.bearing_rad))
    result = run_slam(mirrored, prior_map=given.true_landmarks)
    assert [(cause.code, cause.subject) for cause in result.causes] == [
        ("bearing-sign", "bearing_rad"),
        (CARRIED, str(NAME)),
    ]
    assert not result.changes


def test_detections_are_where_the_estimated_sensor_read_them() -> None:
    """Readings of a sensor with every error that can be estimated in the plane."""
    off = {
        "range_bias_m": 0.2, "range_slope": 0.03, "range_skew_per_rad": 0.02, "range_curvature_per_rad2": 0.01,
        "bearing_bias_rad": 0.1, "mount_forward_m": 0.3, "mount_left_m": -0.2,
    }  # fmt: skip
    given = make_plane()
    mount = np.array(given.sensor.mount_robot_sensor) + [0.3, -0.2, 0.0]
    point = np.random.default_rng(0).normal(0.0, 3.0, (len(given.detections), 2))
    x, y = se2.transform(se2.inverse(mount), point).T
    range_m, bearing = np.hypot(x, y), np.arctan2(y, x)
    read_m = 0.2 + range_m * (1.03 + 0.02 * bearing + 0.01 * bearing**2)
    read = replace(given.detections, range_m=read_m, bearing_rad=bearing + 0.1)
    found = tuple(ParameterEstimate(name, value, 1e-3, 0.0, 1.0, "") for name, value in off.items())
    np.testing.assert_allclose(locate_detections(replace(given, detections=read), found), point, atol=1e-9)


@pytest.mark.parametrize("make", [make_plane, make_space])
def test_a_landmark_on_a_stated_body_is_not_carried_about(make: Any) -> None:
    """A forklift with tags drives: that it moves is asked of the body, and what it does at rest is used."""
    wrong, result = carry(make(), wander), solve(make)
    on_a_body = replace(wrong, objects=np.array([[NAME, 0]]))
    assert find_carried(result, in_its_space(wrong, Config().slam))
    assert not find_carried(result, in_its_space(on_a_body, Config().slam))


@pytest.mark.parametrize("make", [make_plane, pytest.param(make_space, marks=pytest.mark.slow)])
def test_a_run_names_no_landmark_on_a_stated_body(make: Any) -> None:
    on_a_body = replace(carry(make(), wander), objects=np.array([[NAME, 0]]))
    assert CARRIED not in list_codes(run_slam(on_a_body))
