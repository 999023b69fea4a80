"""Landmarks on bodies by the masks of an image that they lie in."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from benchmarks.yard import error_m, group_owners, is_pure, is_true

import evermap as em
from evermap.config import Config
from evermap.slam.association import identify, with_identities
from evermap.slam.co_motion import Reckoned
from evermap.slam.mask_owners import is_scenery, see_masks
from evermap.slam.ownership import (
    BY_CHANCE,
    OWNED,
    Links,
    _weigh_with_masks,
    find_links,
    find_owned,
    with_owned,
)
from evermap.types import MASK_ID, UNKNOWN, AnyRecording, FloatArray, IntArray, masks_of, rows_of, traits_of
from evermap_studies.worlds.yard import STEP_S, YardConfig, YardDrive, flatten, simulate_yard

PARKED = YardConfig(moving=0, parked=6, stated=False, masked="image")
"""Nothing moves: only masks say what is on one body."""
DRIVING = replace(PARKED, moving=6, parked=0)
NAN = float("nan")
NOTHING: IntArray = np.zeros((0, 2), dtype=np.int64)


def in_its_space(drive: YardDrive, plane: bool) -> AnyRecording:
    return flatten(drive.recording) if plane else drive.recording


def without_masks(recording: Any) -> AnyRecording:
    bare: AnyRecording = replace(recording, detections=replace(recording.detections, features=None, feature_names=()))
    return bare


def count_visible(drive: YardDrive) -> int:
    """Tags that are seen with another one of their forklift in two seconds or more."""
    seen, found = drive.recording.detections, set[int]()
    frames = {one: seen.frame[seen.landmark_id == one] for one in np.unique(seen.landmark_id).tolist()}
    for (one, mine), (other, theirs) in itertools.combinations(frames.items(), 2):
        if drive.body_of_tag[one] == drive.body_of_tag[other] != UNKNOWN:
            seconds = np.floor(STEP_S * np.intersect1d(mine, theirs))
            found |= {one, other} if len(np.unique(seconds)) > 1 else set()
    return len(found)


@pytest.mark.parametrize(
    ("masked", "plane"),
    [
        ("image", False),
        ("tracked", True),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("image", True), ("tracked", False))),
    ],
)
def test_masks_own_the_tags_of_forklifts(masked: Literal["tracked", "image"], plane: bool) -> None:
    """One look in twenty is at another mask; the walls have none, or are one."""
    members = visible = 0
    for seed in range(4):
        drive = simulate_yard(replace(PARKED, masked=masked, walls_masked=seed > 1), seed)[0]
        found = find_owned(in_its_space(drive, plane), Config())
        assert is_pure(group_owners(drive, *found[:2]))
        assert min(len(one) for one in group_owners(drive, *found[:2])) > 1
        members, visible = members + len(found.landmark_id), visible + count_visible(drive)
    assert members >= 0.85 * visible
    assert visible > 30


@pytest.mark.parametrize("plane", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["space", "plane"])
def test_masks_and_motion_find_more_than_motion(plane: bool) -> None:
    config = replace(DRIVING, walls_masked=True)
    for seed in (2, 5, 7):
        drive = simulate_yard(config, seed)[0]
        recording = in_its_space(drive, plane)
        found, moving = find_owned(recording, Config()), find_owned(without_masks(recording), Config())
        assert is_pure(group_owners(drive, *found[:2]))
        assert len(found.landmark_id) >= len(moving.landmark_id) + 3


def test_boxes_masks_and_motion_agree() -> None:
    drive = simulate_yard(replace(DRIVING, boxed=True), 0)[0]
    found = find_owned(drive.recording, Config())
    assert is_pure(group_owners(drive, *found[:2]))
    without = simulate_yard(replace(DRIVING, boxed=True, masked=None), 0)[0]
    assert len(found.landmark_id) >= len(find_owned(without.recording, Config()).landmark_id)


def test_numbers_of_a_tracker_and_of_each_image_say_the_same() -> None:
    one, other = (simulate_yard(replace(DRIVING, masked=masked), 1)[0] for masked in ("tracked", "image"))
    a, b = (find_owned(drive.recording, Config()) for drive in (one, other))
    for mine, theirs in zip(a, b, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert len(a.landmark_id) > 10


@pytest.mark.parametrize(("seed", "moving", "by_motion"), [(1, 3, True), (9, 6, False)])
def test_masks_part_what_moves_alike(seed: int, moving: int, by_motion: bool) -> None:
    """In the plane, without orientations, motion alone takes tags of two forklifts for one body in the second yard."""
    drive = simulate_yard(replace(DRIVING, moving=moving, parked=6 - moving, walls_masked=True), seed)[0]
    recording = flatten(drive.recording)
    assert is_pure(group_owners(drive, *find_owned(without_masks(recording), Config())[:2])) is by_motion
    assert is_pure(group_owners(drive, *find_owned(recording, Config())[:2]))


def test_masks_against_motion_are_bounded() -> None:
    """Motion at .95 and masks that say no: a body that has two masks, at one in twenty, or two bodies."""
    pairs, p = np.array([[5, 3], [3, 5], [3, 5], [7, 8]]), np.array([0.95, 0.9999, 1.0, 0.6])
    masks = Links(np.array([5]), np.array([3]), np.array([0.0]))
    found = _weigh_with_masks(pairs, p, masks)
    assert found[0] == pytest.approx(0.95 * BY_CHANCE / (0.95 * BY_CHANCE + 0.05))
    assert found[1] == pytest.approx(0.9999 * BY_CHANCE / (0.9999 * BY_CHANCE + 0.0001))
    assert found[2:].tolist() == pytest.approx([1.0, 0.6])  # nothing is said of the last
    masks = Links(np.array([5]), np.array([3]), np.array([0.5]))  # four times its prior odds
    factor = BY_CHANCE + (1.0 - BY_CHANCE) * 4.0
    assert _weigh_with_masks(pairs[:1], p[:1], masks)[0] == pytest.approx(0.95 * factor / (0.95 * factor + 0.05))


@pytest.mark.parametrize("number", [NAN, -1.0])
def test_without_masks_nothing_changes(number: float) -> None:
    drive = simulate_yard(replace(DRIVING, masked=None), 0)[0]
    bare = drive.recording
    column = np.full((len(bare.detections), 1), number)
    outside = replace(bare, detections=replace(bare.detections, features=column, feature_names=(MASK_ID,)))
    for mine, theirs in zip(find_owned(outside, Config()), find_owned(bare, Config()), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    parked = simulate_yard(replace(PARKED, masked=None), 0)[0].recording
    assert with_owned(parked, Config())[0] is parked


@pytest.mark.slow
def test_bodies_by_masks_are_worth_what_stated_ones_are() -> None:
    drive = simulate_yard(replace(DRIVING, walls_masked=True), 0)[0]
    stated = simulate_yard(replace(DRIVING, masked=None, stated=True), 0)[0]
    result, expected = em.run_slam(drive.recording), em.run_slam(stated.recording)
    assert error_m(result, drive) < 1.1 * error_m(expected, stated)
    assert all(is_true(change, drive) for change in result.changes)
    assert any("masks" in remark for remark in result.warnings)


def sightings(rows: list[tuple[int, int, float, float]], every_s: float = 1.0) -> Reckoned:
    """Looks (landmark, frame, x, y) on the robot, which rests, in order of landmarks and frames."""
    name, frame, x, y = (np.array(column) for column in zip(*sorted(rows), strict=True))
    own, count = np.column_stack([x, y]), len(name)
    spread = np.full(count, 0.03)
    return Reckoned(
        name, every_s * frame, frame, np.arange(count), own, spread, own, spread, np.full((count, 2, 2), NAN)
    )


def pair_seen(mask_one: list[float], mask_other: list[float], x: list[float]) -> tuple[Reckoned, np.ndarray]:
    """Two landmarks a metre apart in frames of a second, at distances ahead; and their masks."""
    rows = [(name, k, at, float(name)) for name in (0, 1) for k, at in enumerate(x)]
    return sightings(rows), np.array([*mask_one, *mask_other])


def probability(seen: Reckoned, mask: np.ndarray) -> list[float]:
    sights = see_masks(seen, mask, np.zeros(len(mask), dtype=np.int64), NOTHING)
    return list(find_links(sights).probability)


@pytest.mark.parametrize(
    ("one", "other", "x", "owned"),
    [
        ([1.0], [1.0], [5.0], False),  # one look decides nothing
        ([1.0, 4.0, 2.0], [1.0, 4.0, 2.0], [5.0] * 3, True),
        ([1.0, 4.0, 2.0], [1.0, 4.0, 3.0], [5.0] * 3, False),  # apart in one of three
        ([1.0, 4.0, 2.0], [1.0, 4.0, NAN], [5.0] * 3, False),  # in none in one of three
        ([1.0, 4.0, NAN, NAN], [1.0, 4.0, NAN, NAN], [5.0] * 4, True),  # none of both says nothing
        ([1.0] * 8 + [NAN] * 2, [1.0] * 10, [5.0] * 8 + [9.0] * 2, False),  # by chance, in one view for long
        ([1.0] * 9 + [NAN], [1.0] * 10, [5.0] * 5 + [9.0] * 5, True),  # a mistake of ten, in two views
    ],
)
def test_two_are_on_one_body_that_lie_in_one_mask(
    one: list[float], other: list[float], x: list[float], owned: bool
) -> None:
    found = probability(*pair_seen(one, other, x))
    assert any(p >= OWNED for p in found) is owned


def test_looks_within_a_second_are_one() -> None:
    seen, mask = pair_seen([1.0] * 4, [1.0] * 4, [5.0] * 4)
    fast = seen._replace(stamp_s=0.2 * seen.stamp_s)
    assert max(probability(fast, mask)) < OWNED < max(probability(seen, mask))


def test_a_view_ends_where_landmarks_move_by_half_their_range() -> None:
    seen, mask = pair_seen([1.0] * 4, [1.0] * 4, [5.0, 5.5, 9.0, 9.5])
    assert see_masks(seen, mask, np.zeros(8, dtype=np.int64), NOTHING).place.tolist() == [0, 0, 1, 1]
    seen, mask = pair_seen([1.0] * 4, [1.0] * 4, [5.0, 5.5, 6.0, 6.5])
    assert see_masks(seen, mask, np.zeros(8, dtype=np.int64), NOTHING).place.tolist() == [0] * 4


def test_masks_of_two_cameras_are_not_compared() -> None:
    seen, mask = pair_seen([1.0] * 4, [1.0] * 4, [5.0] * 4)
    assert not len(see_masks(seen, mask, np.repeat([0, 1], 4), NOTHING).stamp_s)


def test_pairs_to_ask_about_are_looked_at_though_never_in_one_mask() -> None:
    seen, mask = pair_seen([1.0, 1.0, NAN], [2.0, NAN, NAN], [5.0] * 3)
    assert not len(see_masks(seen, mask, np.zeros(6, dtype=np.int64), NOTHING).stamp_s)
    asked = see_masks(seen, mask, np.zeros(6, dtype=np.int64), np.array([[1, 0]]))
    assert (asked.landmark_id.tolist(), asked.thing.tolist()) == ([1, 1], [0, 0])
    assert asked.within.tolist() == [False, False]


def test_a_mask_of_many_makes_few_pairs() -> None:
    seen = sightings([(name, k, 5.0, 0.01 * name) for name in range(100) for k in range(3)])
    found = see_masks(seen, np.zeros(300), np.zeros(300, dtype=np.int64), NOTHING)
    assert len(np.unique(np.column_stack([found.thing, found.landmark_id]), axis=0)) < 800
    assert (find_links(found).probability >= OWNED).all()


@pytest.mark.parametrize(
    ("apart_m", "others", "scenery"),
    [
        (0.4, 6, False),  # a cabinet that rests: a body
        (0.4, 4, True),  # most of all
        (2.9, 6, False),
        (3.1, 6, True),  # longer than nine metres, though three of it are in view at most
    ],
)
def test_what_is_around_is_no_body(apart_m: float, others: int, scenery: bool) -> None:
    row = [(name, k, 5.0, apart_m * (name - k)) for k in range(3) for name in range(4) if abs(name - k) < 2]
    seen = sightings([*row, *((10 + k, 0, 2.0, 1.0 * k) for k in range(others - 1))])
    pairs = np.array([[0, 1], [1, 2], [2, 3]])
    assert is_scenery(seen, np.zeros(len(seen.frame), dtype=np.int64), pairs) is scenery


def test_masks_are_no_traits(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = simulate_yard(replace(PARKED, drive_s=40.0), 0)[0]
    recording = flatten(drive.recording)
    walls = rows_of(recording.detections, drive.body_of_tag[recording.detections.landmark_id] == UNKNOWN)
    radius = np.ones(len(walls))
    both = replace(walls, features=np.column_stack([radius, walls.landmark_id]), feature_names=("radius_m", MASK_ID))
    features, names = traits_of(both)
    assert names == ("radius_m",)
    np.testing.assert_array_equal(features, radius[:, None])
    np.testing.assert_array_equal(masks_of(both), walls.landmark_id)
    column = walls.landmark_id[:, None].astype(np.float64)
    alone = replace(both, features=column, feature_names=(MASK_ID,))
    assert traits_of(alone) == (None, ())
    negative = replace(alone, features=-1.0 - column)
    assert np.isnan(masks_of(negative)).all()
    bare = replace(walls, features=None, feature_names=())
    assert np.isnan(masks_of(bare)).all()
    asked = Config(slam={"unknown_ids": True}).slam
    columns = list[int]()

    def count_columns(best: Any, features: FloatArray, *_: Any) -> Any:
        columns.append(features.shape[1])
        return best

    monkeypatch.setattr(identify, "with_traits", count_columns)
    found = [with_identities(replace(recording, detections=one), asked).detections for one in (alone, bare)]
    np.testing.assert_array_equal(found[0].landmark_id, found[1].landmark_id)
    assert not columns
    with_identities(replace(recording, detections=both), asked)
    assert columns == [1]
