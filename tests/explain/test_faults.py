"""Jumps and silences of the odometry: bridged by what is seen, and told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap import check_recording, run_slam
from evermap.geometry import se3
from evermap.geometry.group import accumulate
from evermap.slam.gaps import find_gaps
from evermap.slam.pairs import USUAL
from evermap.slam.silences import find_silences, without_silences
from evermap.types import AnyRecording, SlamResult, VerdictKind

from .worlds import World

SILENT_S = (12.0, 18.0)


def in_plane() -> Any:
    return World(seed=4, seconds=40.0).plane()


def in_space() -> Any:
    return World(seed=4, seconds=40.0).space()


def standing(recording: Any) -> Any:
    """The odometry says that the robot stands for a while, but it drives on."""
    odometry = recording.odometry
    still = (odometry.stamp_s >= SILENT_S[0]) & (odometry.stamp_s < SILENT_S[1])
    if recording.dim == 2:
        columns = {
            name: np.where(still, 0.0, getattr(odometry, name))
            for name in ("forward_mps", "lateral_mps", "angular_radps")
        }
        return replace(recording, odometry=replace(odometry, **columns))
    step = se3.between(odometry.pose_world_robot[:-1], odometry.pose_world_robot[1:])
    step[still[:-1]] = se3.identity(int(still[:-1].sum()))
    pose = se3.compose(odometry.pose_world_robot[:1], accumulate(step))
    return replace(recording, odometry=replace(odometry, pose_world_robot=np.asarray(pose)))


def without_rows(recording: Any) -> Any:
    odometry = recording.odometry
    keep = (odometry.stamp_s < SILENT_S[0]) | (odometry.stamp_s >= SILENT_S[1])
    return replace(recording, odometry=odometry[keep])


def worst_m(recording: AnyRecording, result: SlamResult) -> float:
    """Largest error of a position while the odometry is no help, in the frame of the first pose."""
    assert recording.truth is not None
    truth, path = recording.truth, result.trajectory
    row = np.searchsorted(truth.stamp_s, path.stamp_s).clip(0, len(truth) - 1)
    true, found = truth.pose_world_robot[row, :2], path.pose_world_robot[:, :2]
    off = true - true.mean(axis=0), found - found.mean(axis=0)
    left, _, right = np.linalg.svd(off[1].T @ off[0])
    return float(np.linalg.norm(off[0] - off[1] @ left @ right, axis=1).max())


@pytest.mark.parametrize(
    ("wrong", "make"),
    [
        (standing, in_plane),
        (without_rows, in_plane),
        (standing, in_space),
        pytest.param(without_rows, in_space, marks=pytest.mark.slow),
    ],
)
def test_a_silent_odometry_is_bridged_and_told(make: Any, wrong: Any) -> None:
    recording = wrong(make())
    (found,) = find_silences(recording, USUAL)
    assert found == pytest.approx(SILENT_S, abs=0.1)
    assert "odometry-silence" in [finding.code for finding in check_recording(recording).findings]
    result = run_slam(recording)
    (cause,) = [cause for cause in result.causes if cause.code == "odometry-silence"]
    assert cause.value == pytest.approx(6.0, abs=0.2)
    assert result.verdict is not None
    assert cause in result.verdict.causes
    assert result.verdict.kind in (VerdictKind.SOUND, VerdictKind.SENSOR_SUSPECT)
    assert worst_m(recording, result) < 0.5  # it drives 12 m meanwhile
    assert not result.changes


@pytest.mark.parametrize("make", [in_plane, in_space])
def test_an_odometry_that_says_enough_is_not_silent(make: Any) -> None:
    recording = make()
    assert not len(find_silences(recording, USUAL))
    result = run_slam(recording)
    assert not result.causes


@pytest.mark.parametrize("make", [in_plane, in_space])
def test_an_odometry_is_right_that_says_that_a_parked_robot_stands(make: Any) -> None:
    recording = standing(make())
    seen, stamp_s = recording.detections, recording.frames.stamp_s
    within = (stamp_s[seen.frame] > SILENT_S[0]) & (stamp_s[seen.frame] < SILENT_S[1])
    same = np.arange(len(seen))
    for identity in np.unique(seen.landmark_id[within]):
        rows = np.flatnonzero(within & (seen.landmark_id == identity))
        same[rows] = rows[0]  # as it was seen first
    columns = ("range_m", "bearing_rad") if recording.dim == 2 else ("corner_px",)
    seen = replace(seen, **{name: getattr(seen, name)[same] for name in columns})
    assert len(find_silences(recording, USUAL)) == 1
    assert not len(find_silences(replace(recording, detections=seen), USUAL))


def test_where_the_odometry_never_moves_it_is_not_asked_what_moved() -> None:
    """Everything did: the search took minutes, and its answers were false."""
    given = in_plane()
    odometry = given.odometry
    still = {name: 0.0 * getattr(odometry, name) for name in ("forward_mps", "lateral_mps", "angular_radps")}
    result = run_slam(replace(given, odometry=replace(odometry, **still)))
    assert not result.changes
    assert not result.causes
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
    assert "the odometry is zero throughout" in result.verdict.message


def test_rows_within_silences_are_left_out_and_no_others() -> None:
    recording = standing(in_plane())
    kept = without_silences(recording, find_silences(recording, USUAL)).odometry
    assert np.all((kept.stamp_s < SILENT_S[0] + 0.1) | (kept.stamp_s > SILENT_S[1] - 0.1))
    assert len(find_gaps(kept)) == 1
    assert not len(find_gaps(recording.odometry))
    assert without_silences(recording, np.zeros((0, 2))) is recording


@pytest.mark.parametrize("make", [in_plane, in_space])
def test_a_robot_that_is_carried_is_told_and_the_run_is_sound(make: Any) -> None:
    recording = make()
    odometry = recording.odometry
    row = int(np.searchsorted(odometry.stamp_s, 15.0))
    if recording.dim == 2:
        speed = odometry.forward_mps.copy()
        speed[row] += 0.9 / (odometry.stamp_s[row + 1] - odometry.stamp_s[row])
        odometry = replace(odometry, forward_mps=speed)
    else:
        pose = odometry.pose_world_robot.copy()
        pose[row:, 0] += 0.9
        odometry = replace(odometry, pose_world_robot=pose)
    result = run_slam(replace(recording, odometry=odometry))
    (cause,) = result.causes
    assert cause.code == "odometry-jumps"
    assert cause.value == pytest.approx(0.9, abs=0.1)
    assert f"{15.0 - float(odometry.stamp_s[0]):.0f}." in cause.message
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SOUND
    assert result.verdict.causes == (cause,)


def displaced_unseen(blind_s: float, ahead_m: float) -> Any:
    """The odometry begins anew elsewhere, and the frames about it saw nothing."""
    recording = in_space()
    odometry, seen = recording.odometry, recording.detections
    pose = odometry.pose_world_robot.copy()
    pose[odometry.stamp_s >= 15.0, 0] += ahead_m
    away = np.abs(recording.frames.stamp_s[seen.frame] - 15.0) > 0.5 * blind_s
    return replace(recording, odometry=replace(odometry, pose_world_robot=pose), detections=seen[np.flatnonzero(away)])


def test_poses_are_unknown_where_the_odometry_jumps_unseen() -> None:
    """Where among the frames that saw nothing the jump was, nothing tells, and no step is as long as it."""
    result = run_slam(displaced_unseen(1.0, 6.0))
    (cause,) = result.causes
    assert cause.code == "odometry-jumps"
    assert cause.value == pytest.approx(6.0, abs=0.2)
    assert "while nothing was seen" in cause.message
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT


def test_frames_that_saw_nothing_are_no_jump() -> None:
    assert not run_slam(displaced_unseen(1.0, 0.0)).causes


@pytest.mark.slow
def test_an_odometry_that_seems_far_too_short_is_asked_about() -> None:
    """Alone, tags of another size than stated only bend the odometry, which is taken for noisy."""
    result = run_slam(World(seconds=40.0, seed=4, longer=1.25).space())
    (cause,) = result.causes
    assert cause.code in ("tag-size", "odometry-scale")  # of the two nothing tells which it is
    assert cause.value == pytest.approx(1.25 if cause.code == "tag-size" else 0.8, rel=0.02)
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT


def rename(recording: Any, names: dict[int, int], until_s: float = np.inf) -> Any:
    """Landmarks with the identity of another one, until an instant."""
    seen, own = recording.detections, recording.detections.landmark_id.copy()
    early = recording.frames.stamp_s[seen.frame] < until_s
    for one, name in names.items():
        own[early & (seen.landmark_id == one)] = name
    return replace(recording, detections=replace(seen, landmark_id=own))


@pytest.mark.parametrize(
    ("in_map", "make"),
    [(False, in_plane), (True, in_plane), (False, in_space), pytest.param(True, in_space, marks=pytest.mark.slow)],
)
def test_an_identity_on_two_landmarks_is_named(make: Any, in_map: bool) -> None:
    """At both ends of the field, which the robot passes in turns: 12 m are between them."""
    recording, world = make(), World(seed=4)
    given = world.map_in_plane() if make is in_plane else world.map_in_space()
    result = run_slam(rename(recording, {14: 11}), prior_map=given if in_map else None)
    (cause,) = result.causes
    assert (cause.code, cause.subject) == ("double-identity", "11")
    if make is in_plane:
        assert cause.value == pytest.approx(np.linalg.norm((world.place[14] - world.place[11])[:2]), abs=0.1)
        assert "at two places in turns" in cause.message
    else:  # two cameras read both at once
        assert np.isnan(cause.value)
        assert "at two places at once" in cause.message
    assert result.verdict is not None
    assert result.verdict.causes == (cause,)
    assert not result.changes or {change.landmark_ids for change in result.changes} == {(14,)}


@pytest.mark.parametrize("make", [in_plane, pytest.param(in_space, marks=pytest.mark.slow)])
def test_an_identity_that_is_read_elsewhere_is_not_on_two_landmarks(make: Any) -> None:
    """One that another landmark carries, for a while: that one is read wrongly; and one that was carried off once."""
    recording = make()
    some = rename(recording, {14: 11}, until_s=6.0)
    names = [cause.code for cause in run_slam(some).causes]
    assert "double-identity" not in names


@pytest.mark.slow
def test_images_of_another_size_than_those_of_the_calibration_are_named() -> None:
    recording = in_space()
    seen = replace(recording.detections, corner_px=0.5 * recording.detections.corner_px)
    result = run_slam(replace(recording, detections=seen))
    (cause,) = result.causes
    assert cause.code == "resolution"
    assert "0.5 times" in cause.message
    assert result.verdict is not None
    assert result.verdict.kind is VerdictKind.SENSOR_SUSPECT
