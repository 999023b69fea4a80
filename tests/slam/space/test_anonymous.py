"""Landmarks in space without identity, against those that made the measurements."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from bits import bits
from identity_scores import identity_scores

from evermap import run_session, run_slam
from evermap.config import Config, SlamConfig
from evermap.errors import DataError
from evermap.maps.living import LivingMap
from evermap.maps.sessions.nameless import number_in
from evermap.maps.sessions.session import Session
from evermap.slam.association import with_identities
from evermap.slam.association.in_space import SpatialAssignment, SpatialAssociator
from evermap.slam.space.intake import prepare_space
from evermap.types import MASK_ID, UNKNOWN, ChangeKind, Landmarks, SpatialRecording, rows_of

from .corridors import tagged_corridor
from .halls import hall, part_of_hall, tilt
from .rooms import Room

NAMELESS = Config(slam={"unknown_ids": True})


def scored(recording: SpatialRecording, *, purity: float, completeness: float) -> SpatialRecording:
    """The recording with ids by geometry, as right as stated, and with as many landmarks as there are."""
    found = with_identities(recording, NAMELESS.slam)
    real = recording.detections.landmark_id != UNKNOWN
    scores = identity_scores(found.detections.landmark_id[real], recording.detections.landmark_id[real])
    assert scores.purity >= purity
    assert scores.completeness >= completeness
    assert scores.n_landmarks == scores.n_identities
    return found


@pytest.mark.parametrize("drift", [pytest.param(0.01, marks=pytest.mark.slow), 0.1])
def test_points_of_a_hall_are_told_apart_and_met_again(drift):
    recording = hall(1, n_points=40, n_frames=400, drift=drift)
    found = scored(recording, purity=0.995, completeness=0.99)
    false = recording.detections.landmark_id == UNKNOWN
    assert np.mean(found.detections.landmark_id[false] == UNKNOWN) > 0.8


@pytest.mark.slow
def test_the_loop_is_closed_behind_a_drift_of_metres():
    """Odometry alone has the landmarks of the second round two spacings off."""
    recording = hall(2, n_points=60, n_frames=450, step_s=0.6, drift=0.1)
    scored(recording, purity=0.99, completeness=0.97)


@pytest.mark.slow
def test_tags_are_told_apart_and_the_estimate_is_as_good():
    world = tagged_corridor(0, n_tags=16, drift=0.05)
    scored(world.recording, purity=1.0, completeness=1.0)
    off = []
    for config in (NAMELESS, Config()):
        at = run_slam(world.recording, config).trajectory.pose_world_robot[:, :3]
        off.append(float(np.linalg.norm(np.ptp(at, axis=0) - np.ptp(world.true_pose[:, :3], axis=0))))
    assert off[0] < 1.15 * off[1] + 1e-3


def test_objects_that_look_the_same_however_they_are_turned():
    scored(Room.of(1).walk(1, drift=0.05), purity=1.0, completeness=1.0)


def test_what_jumps_is_followed():
    """Odometry that is a quarter of a metre off at once, as a visual one: the tags in view are the same."""
    recording = tagged_corridor(3, n_tags=24).recording
    assert recording.odometry is not None
    pose = recording.odometry.pose_world_robot.copy()
    pose[100:, :3] += (0.2, -0.1, 0.15)
    jumped = replace(recording, odometry=replace(recording.odometry, pose_world_robot=pose))
    scored(jumped, purity=1.0, completeness=1.0)


def test_landmarks_of_two_classes_at_one_place_stay_two():
    recording = tagged_corridor(1, n_tags=8).recording
    seen = recording.detections
    kind = np.arange(len(seen)) % 2
    doubled = replace(seen, class_id=kind, landmark_id=2 * seen.landmark_id + kind)
    scored(replace(recording, detections=doubled, class_names=("tag", "board")), purity=1.0, completeness=1.0)


def test_rejected_trials_in_space_change_nothing(monkeypatch):
    """Merged ones, whole searches, and what is only asked for: not a bit of what is held."""
    recording = hall(3, n_points=20, n_frames=150)
    intake = prepare_space(recording, NAMELESS.slam.space)
    none = np.full((len(intake.used), 2), UNKNOWN)
    associator = SpatialAssociator(intake, none, NAMELESS.slam)
    for _ in associator.stamp_s:
        associator.step()
    found = associator.finish()
    late = associator._problem.pose_row > np.median(associator._problem.pose_row)
    twice = np.where(late & (found.landmark_row == 2), found.landmark_row.max() + 1, found.landmark_row)
    start = SpatialAssignment(twice, found.estimate.pose, found.noise, found.traits)
    solved, trials = associator._solve_assignment(start), list[int]()
    before, value = bits(associator), bits(solved)

    def rejected(*_: object) -> float:
        trials.append(1)
        return -math.inf

    with monkeypatch.context() as no:
        no.setattr("evermap.slam.association.associator.find_accepted_rise", rejected)
        assert associator._merge_duplicates(solved) is solved
    assert trials
    assert len(associator._merge_duplicates(solved).estimate.place) == len(found.estimate.place)
    associator.against(solved)
    associator.finish(solved)
    associator.finish()
    assert (bits(associator), bits(solved)) == (before, value)


def test_identities_of_the_recording_are_not_looked_at():
    recording = hall(3, n_points=20, n_frames=150)
    hidden = replace(recording.detections, landmark_id=np.full(len(recording.detections), UNKNOWN))
    one, other = (with_identities(each, NAMELESS.slam) for each in (recording, replace(recording, detections=hidden)))
    np.testing.assert_array_equal(one.detections.landmark_id, other.detections.landmark_id)


@pytest.mark.slow
def test_two_at_one_place_are_told_apart_by_a_column():
    """Places alone exchange them; a colour that says nothing changes no identity."""
    recording = hall(1, n_points=20, n_frames=125, step_s=0.8, sigma_m=0.05, beside_m=0.06)
    seen, random = recording.detections, np.random.default_rng(0)
    real = seen.landmark_id != UNKNOWN

    def found(**columns):
        given = replace(recording, detections=replace(seen, **columns))
        return with_identities(given, NAMELESS.slam).detections.landmark_id

    alone = found()
    assert identity_scores(alone[real], seen.landmark_id[real]).purity < 0.7
    radius = random.uniform(0.0, 1.0, 20)[seen.landmark_id] + random.normal(0.0, 0.02, len(seen))
    told = identity_scores(found(features=radius[:, None], feature_names=("radius_m",))[real], seen.landmark_id[real])
    assert told.purity > 0.85
    assert told.completeness > 0.8
    useless = random.normal(size=(len(seen), 1))
    np.testing.assert_array_equal(found(features=useless, feature_names=("colour",)), alone)
    np.testing.assert_array_equal(found(features=radius[:, None], feature_names=(MASK_ID,)), alone)  # not of itself


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.2, 0.5])
def test_points_of_which_some_have_names(share):
    recording = hall(1, n_points=40, n_frames=400, drift=0.1)
    true = recording.detections.landmark_id
    named = np.isin(true, np.random.default_rng(0).permutation(40)[: int(40 * share)])
    given = np.where(named, 100 + true, UNKNOWN)
    some = replace(recording, detections=replace(recording.detections, landmark_id=given))
    found = with_identities(some, SlamConfig(unknown_ids="empty")).detections.landmark_id
    np.testing.assert_array_equal(found[named], given[named])
    assert not np.isin(found[~named], given[named]).any()
    real = true != UNKNOWN
    scores = identity_scores(found[real], true[real])
    assert scores.purity > 0.995
    assert scores.completeness > 0.98
    assert scores.n_landmarks == scores.n_identities


def test_tags_that_are_not_always_read():
    recording = tagged_corridor(0, n_tags=16, drift=0.05).recording
    true = recording.detections.landmark_id
    read = np.where(np.random.default_rng(0).random(len(true)) < 0.5, true, UNKNOWN)
    some = replace(recording, detections=replace(recording.detections, landmark_id=read))
    found = with_identities(some, SlamConfig(unknown_ids="empty")).detections.landmark_id
    assert np.mean(found == true) > 0.99


def test_without_odometry_it_is_refused():
    recording = tagged_corridor(0, n_frames=40, odometry=False).recording
    with pytest.raises(DataError, match="need odometry"):
        with_identities(recording, NAMELESS.slam)


def named_as(recording: SpatialRecording, found: SpatialRecording) -> dict[int, int]:
    """What landmarks are called, by their true identities."""
    name, true = found.detections.landmark_id, recording.detections.landmark_id
    real = (name != UNKNOWN) & (true != UNKNOWN)
    return {int(one): int(np.bincount(true[real & (name == one)]).argmax()) for one in np.unique(name[real])}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_points_are_found_in_a_fixed_map_from_anywhere_and_new_ones_get_numbers_of_their_own(seed):
    """The odometry of the drive starts in a frame that is turned about all axes."""
    drive = part_of_hall(hall(seed, n_points=60, n_frames=400, step_s=0.6, drift=0.05), 200, 400, tilt(seed))
    true = hall(seed, n_points=60, n_frames=400, step_s=0.6, drift=0.05).true_landmarks
    assert true is not None
    survey = replace(rows_of(true, np.arange(60) >= 6), landmark_id=true.landmark_id[6:] + 100)
    found = number_in(drive, survey, NAMELESS)
    name = named_as(drive, found)
    known = {one: real for one, real in name.items() if one >= 100}
    assert all(one == real + 100 for one, real in known.items())
    assert all(real < 6 for one, real in name.items() if one < 100)
    assert len(known) >= 0.95 * np.isin(np.unique(drive.detections.landmark_id), true.landmark_id[6:]).sum()
    result = run_slam(drive, NAMELESS, prior_map=survey)
    assert result.trajectory.frame == "prior_map"
    at = result.landmarks.position_m[np.isin(result.landmarks.landmark_id, survey.landmark_id)]
    there = survey.position_m[np.isin(survey.landmark_id, result.landmarks.landmark_id)]
    assert np.median(np.linalg.norm(at - there, axis=1)) < 0.05


@functools.cache
def first_session(seed: int) -> tuple[SpatialRecording, Session]:
    """The first half of a drive through a hall, and its map."""
    first = part_of_hall(hall(seed, n_points=60, n_frames=400, step_s=0.6, drift=0.05), 0, 200)
    return first, run_session(first, None, NAMELESS)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_points_keep_their_names_over_sessions_and_those_that_left_are_told(seed):
    whole, gone = hall(seed, n_points=60, n_frames=400, step_s=0.6, drift=0.05), [3, 20, 41]
    first, begun = first_session(seed)
    second = part_of_hall(whole, 200, 400, tilt(seed), without=gone, later_s=86_400.0)
    session = run_session(second, begun.living, NAMELESS)
    assert session.found
    before, now = named_as(first, begun.recording), named_as(second, session.recording)
    both = before.keys() & now.keys()
    assert len(both) > 40
    assert all(before[one] == now[one] for one in both)
    assert {change.kind for change in session.changes} == {ChangeKind.VANISHED}
    assert {before[one] for change in session.changes for one in change.landmark_ids} <= set(gone)
    assert len(session.changes) >= 2


def test_another_hall_is_refused():
    _, begun = first_session(1)
    other = part_of_hall(hall(7, n_points=60, n_frames=400, step_s=0.6), 0, 200, later_s=86_400.0)
    session = run_session(other, begun.living, NAMELESS)
    assert not session.found
    assert len(session.living.places) == len(begun.living.places)


@pytest.mark.slow
def test_points_that_were_exchanged_are_recognised_by_what_they_are_like():
    whole = hall(1, n_points=60, n_frames=400, step_s=0.6, drift=0.05)
    own, random = np.random.default_rng(5).normal(size=(61, 8)), np.random.default_rng(6)

    def like(recording: SpatialRecording, true: np.ndarray) -> SpatialRecording:
        value = own[true] + 0.2 * random.normal(size=(len(true), 8))
        names = tuple(f"descriptor_{k}" for k in range(8))
        return replace(recording, detections=replace(recording.detections, features=value, feature_names=names))

    first, second = part_of_hall(whole, 0, 200), part_of_hall(whole, 200, 400, tilt(1), later_s=86_400.0)
    begun = run_session(like(first, first.detections.landmark_id), None, NAMELESS)
    name = named_as(first, begun.recording)
    a, b = (int(one) for one in np.argsort(-np.bincount(second.detections.landmark_id + 1)[1:], kind="stable")[:2])
    true = second.detections.landmark_id.copy()
    true[second.detections.landmark_id == a], true[second.detections.landmark_id == b] = b, a
    session = run_session(like(second, true), begun.living, NAMELESS)
    given = {real: one for one, real in name.items()}
    both = {given[a], given[b]}
    assert {i for change in session.changes for i in change.landmark_ids} == both
    assert {change.kind for change in session.changes} <= {ChangeKind.MOVED, ChangeKind.SWAPPED}
    assert [change.kind for change in run_session(second, begun.living, NAMELESS).changes] == []


@pytest.mark.slow
def test_objects_that_look_the_same_however_they_are_turned_keep_their_names_over_sessions():
    room = Room.of(1)
    walks = [room.walk(10 + day, day=day) for day in range(2)]
    begun = run_session(walks[0], None, NAMELESS)
    session = run_session(walks[1], begun.living, NAMELESS)
    assert session.found
    assert session.changes == ()
    assert named_as(walks[0], begun.recording) == named_as(walks[1], session.recording)
    assert len(session.living.members) == len(room.place)


@pytest.mark.slow
def test_points_are_found_in_a_large_survey():
    """A thousand others lie beside the hall, so that the map is in chunks."""
    whole = hall(1, n_points=60, n_frames=400, step_s=0.6, drift=0.05)
    drive = part_of_hall(whole, 200, 400, tilt(1))
    assert whole.true_landmarks is not None
    beside = np.random.default_rng(0).uniform([30.0, 0.0, 0.0], [110.0, 80.0, 3.0], (1000, 3))
    place = np.vstack([whole.true_landmarks.position_m, beside])
    survey = replace(Landmarks.in_space(np.arange(1060), place), covariance_m2=np.tile(1e-4 * np.eye(3), (1060, 1, 1)))
    begun = replace(LivingMap.begun(survey), clock=drive.clock)
    session = run_session(drive, begun, NAMELESS)
    assert session.found
    assert all(name == real for name, real in named_as(drive, session.recording).items())


@pytest.mark.parametrize("share", [pytest.param(share, marks=pytest.mark.slow) for share in (0.05, 0.5)])
def test_points_of_which_some_have_names_keep_them_over_sessions(share):
    whole, gone = hall(1, n_points=60, n_frames=400, step_s=0.6, drift=0.05), [3, 20, 41]
    named = np.random.default_rng(0).permutation(60)[: int(60 * share)]
    days = part_of_hall(whole, 0, 200), part_of_hall(whole, 200, 400, tilt(1), without=gone, later_s=86_400.0)
    living, called = None, []
    for day in days:
        true = day.detections.landmark_id
        given = np.where(np.isin(true, named), true, UNKNOWN)
        some = replace(day, detections=replace(day.detections, landmark_id=given))
        session = run_session(some, living, Config(slam={"unknown_ids": "empty"}))
        assert session.found
        found = session.recording.detections.landmark_id
        np.testing.assert_array_equal(found[given != UNKNOWN], given[given != UNKNOWN])
        living, called = session.living, [*called, named_as(day, session.recording)]
    both = called[0].keys() & called[1].keys()
    assert len(both) > 40
    assert all(called[0][one] == called[1][one] for one in both)
    assert {called[0][one] for change in session.changes for one in change.landmark_ids} <= set(gone)
