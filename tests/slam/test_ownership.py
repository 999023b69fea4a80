"""Landmarks on bodies that nobody states: by boxes around them, and by how they move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.yard import error_m, group_owners, is_pure, is_true

import evermap as em
from evermap.config import Config
from evermap.geometry import se3
from evermap.slam.co_motion import Movers, Reckoned, find_movers, locate_by_odometry, pair_movers
from evermap.slam.ownership import OWNED, PRIOR, find_links, find_owned, weigh_looks, with_owned
from evermap.slam.space.box_owners import Sights, see_boxes
from evermap.slam.space.moving import is_located
from evermap.types import UNKNOWN, SpatialRecording, rows_of
from evermap_studies.worlds.yard import YardConfig, YardDrive, simulate_yard

UNSTATED = YardConfig(moving=6, parked=0, stated=False)
USUAL = Config().slam.space.traffic
BOXED = replace(UNSTATED, boxed=True)


def movers_of(recording: SpatialRecording) -> Movers | None:
    """What moves in view, by where the odometry has the sightings."""
    seen = locate_by_odometry(recording, Config().slam.space)
    assert seen is not None
    return find_movers(seen, Config())


def sights(within: list[bool], place: list[int], every_s: float = 1.0) -> Sights:
    count = len(within)
    zero = np.zeros(count, dtype=np.int64)
    return Sights(zero, zero, np.array(place), every_s * np.arange(count), np.array(within))


@pytest.mark.parametrize(
    ("within", "place", "owned"),
    [
        ([True], [0], False),  # one look alone
        ([True] * 4, [0] * 4, True),  # what lies within, lies within
        ([True, True], [0, 1], True),  # and goes with it
        ([True, False], [0, 1], False),
        ([True] * 4 + [False] * 2, [0] * 4 + [1] * 2, False),  # it went without the landmark
        ([False] * 3, [0, 1, 2], False),
    ],
)
def test_a_member_is_within_wherever_its_body_goes(within: list[bool], place: list[int], owned: bool) -> None:
    assert bool(find_links(sights(within, place)).probability[0] >= OWNED) is owned


def test_looks_within_a_second_are_one() -> None:
    assert find_links(sights([True] * 5, [0] * 5, every_s=0.1)).probability[0] == pytest.approx(
        find_links(sights([True], [0])).probability[0]
    )


def test_the_odds_of_membership_are_those_of_two_explanations() -> None:
    """At two places, three looks and one: by chance at either, or each look by mistake."""
    p_owned = PRIOR * 0.9**4
    p_other = (1.0 - PRIOR) * (0.05 * 0.9**3 + 0.05**3) * (0.05 * 0.9 + 0.05)
    found = find_links(sights([True] * 4, [0, 0, 0, 1])).probability[0]
    assert found == pytest.approx(p_owned / (p_owned + p_other), rel=1e-9)
    assert weigh_looks(0, 2) == pytest.approx(2.0 * np.log(0.1 / 0.95))


@pytest.mark.parametrize("seed", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_boxes_own_the_tags_within_them(seed: int) -> None:
    drive = simulate_yard(BOXED, seed)[0]
    found, remarks = with_owned(drive.recording, Config())
    assert is_pure(group_owners(drive, *found.objects.T))
    seen = np.unique(drive.recording.detections.landmark_id)
    carried = seen[(seen >= 0) & (drive.body_of_tag[seen] >= 0)]
    assert len(found.objects) > 0.6 * len(carried)
    assert f"{len(found.objects)} landmarks" in remarks[0]
    assert is_located(found, USUAL)


def test_what_is_stated_stays_and_names_the_body() -> None:
    drive = simulate_yard(BOXED, 0)[0]
    free = with_owned(drive.recording, Config())[0].objects
    body, count = np.unique(free[:, 1], return_counts=True)
    some = free[free[:, 1] == body[np.argmax(count)], 0]
    stated = with_owned(replace(drive.recording, objects=np.array([[some[0], 70]])), Config())[0].objects
    number = dict(stated.tolist())
    assert [number[one] for one in some.tolist()] == [70] * len(some)
    assert len(stated) == len(free)
    assert (np.diff(stated[:, 0]) > 0).all()


@pytest.mark.parametrize("oriented", [pytest.param(True, marks=pytest.mark.slow), False], ids=["poses", "points"])
def test_what_moves_together_is_on_one_body(oriented: bool) -> None:
    for seed in (5, 6):
        drive = simulate_yard(replace(UNSTATED, oriented=oriented), seed)[0]
        movers = movers_of(drive.recording)
        assert movers is not None
        assert (drive.body_of_tag[movers.landmark_id] >= 0).all()
        assert drive.moves[drive.body_of_tag[movers.seen.landmark_id], movers.seen.frame][movers.moves].mean() > 0.9
        pairs, p = pair_movers(movers, PRIOR, Config().track.still)
        body = drive.body_of_tag[pairs]
        sure = p >= OWNED
        assert sure.sum() > 3
        assert (body[sure, 0] == body[sure, 1]).mean() > 0.85
        assert (body[sure] >= 0).all()


def test_nothing_moves_where_the_robot_alone_does() -> None:
    drive = simulate_yard(replace(UNSTATED, standing=True), 1)[0]
    assert movers_of(drive.recording) is None
    found, remarks = with_owned(drive.recording, Config())
    assert found is drive.recording
    assert remarks == ()


def test_an_odometry_that_errs_moves_no_landmark() -> None:
    """It turns by ten degrees a second too much for a while: all that is in view seems to move."""
    drive = simulate_yard(replace(UNSTATED, standing=True), 1)[0]
    odometry = drive.recording.odometry
    assert odometry is not None
    since_s = odometry.stamp_s - odometry.stamp_s[0]
    step = se3.between(odometry.pose_world_robot[:-1], odometry.pose_world_robot[1:])
    twist = np.zeros((len(step), 6))
    twist[(since_s[1:] > 20.0) & (since_s[1:] < 30.0), 5] = 0.17 * 0.2
    step = se3.retract(step, twist)
    pose = [odometry.pose_world_robot[0]]
    for one in step:
        pose.append(se3.compose(pose[-1], one))
    wrong = replace(drive.recording, odometry=replace(odometry, pose_world_robot=np.array(pose)))
    assert movers_of(wrong) is None


def looks_at(spans: list[tuple[int, float, float, float]]) -> Reckoned:
    """Five looks a second at landmarks (id, from [s], until [s], speed by the odometry [m/s])."""
    rows = [
        (one, t, mps * (t - since_s)) for one, since_s, until_s, mps in spans for t in np.arange(since_s, until_s, 0.2)
    ]
    name, stamp_s, way_m = (np.array(column) for column in zip(*rows, strict=True))
    at = np.column_stack([way_m, 3.0 * name, np.zeros(len(rows))])
    frame, own = np.round(5.0 * stamp_s).astype(np.int64), at - [0.0, 0.0, 0.5]
    sigma_m, turn = np.full(len(rows), 0.05), np.full((len(rows), 3, 3), np.nan)
    return Reckoned(name, stamp_s, frame, np.arange(len(rows)), at, sigma_m, own, sigma_m, turn)


@pytest.mark.parametrize(
    ("stands_s", "moves"), [(10.0, False), (15.0, True)], ids=["glimpsed", "beside one that stands"]
)
def test_a_landmark_moves_beside_one_that_stands(stands_s: float, moves: bool) -> None:
    """Where others are seen too briefly to tell, an odometry that is silent for five seconds explains as much."""
    others = [(0, 0.0, stands_s, 0.0), (1, 0.0, 10.0, 0.0), (2, 0.0, 10.0, 0.0)]
    glimpses = [(4, 11.0, 11.4, 0.5), (5, 12.0, 12.4, 0.5), (6, 13.0, 13.4, 0.5)]
    movers = find_movers(looks_at([*others, (3, 10.0, 15.0, 0.5), *glimpses]), Config())
    assert (movers is not None) is moves
    assert movers is None or movers.landmark_id.tolist() == [3]


def test_a_wall_behind_a_parked_forklift_is_not_owned_once_it_drives_off() -> None:
    """A tag on a wall that is within a box at its first place, and seen on its own while that drives."""
    assert find_links(sights([True] * 8 + [False] * 3, [0] * 8 + [1, 1, 2])).probability[0] < 0.1


@pytest.mark.parametrize("config", [pytest.param(BOXED, marks=pytest.mark.slow), UNSTATED], ids=["boxes", "motion"])
def test_bodies_that_are_found_are_worth_what_stated_ones_are(config: YardConfig) -> None:
    drive = simulate_yard(config, 0)[0]
    stated = simulate_yard(replace(config, stated=True, boxed=False), 0)[0]
    result, expected = em.run_slam(drive.recording), em.run_slam(stated.recording)
    assert error_m(result, drive) < 1.1 * error_m(expected, stated)
    of_tags = [change for change in result.changes if max(change.landmark_ids) < len(drive.tag)]
    assert all(is_true(change, drive) for change in of_tags)
    assert result.verdict is not None
    assert result.verdict.kind == "sound"


def without_walls(drive: YardDrive) -> SpatialRecording:
    given = drive.recording.detections
    return replace(drive.recording, detections=rows_of(given, drive.body_of_tag[given.landmark_id] != UNKNOWN))


def test_boxes_locate_where_landmarks_do_not() -> None:
    drive = simulate_yard(BOXED, 0)[0]
    given = drive.recording.detections
    named = given.landmark_id != UNKNOWN
    on_walls = named & (drive.body_of_tag[np.maximum(given.landmark_id, 0)] == UNKNOWN)
    assert is_located(drive.recording, USUAL)
    assert not is_located(replace(drive.recording, detections=rows_of(given, ~on_walls & ~named)), USUAL)
    early = given.frame < 0.4 * len(drive.recording.frames)
    assert not is_located(replace(drive.recording, detections=rows_of(given, (on_walls & early) | ~named)), USUAL)


def test_boxes_without_landmarks_show_no_members() -> None:
    drive = simulate_yard(BOXED, 0)[0]
    given = drive.recording.detections
    alone = replace(drive.recording, detections=rows_of(given, given.landmark_id == UNKNOWN))
    assert not len(see_boxes(alone, Config()).stamp_s)
    assert not len(find_owned(alone, Config()).landmark_id)
