"""Identities that were read wrongly are left out by the vote of the seconds around, in the plane and in space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from space.halls import hall
from space.test_range_noise import LAWS, field

from evermap import run_slam
from evermap.config import Config, SlamConfig, VotesConfig
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.votes import Read, contradicted, list_doubled_ids, without_contradicted_ids
from evermap.types import UNKNOWN, AnyRecordingT, IntArray
from evermap_studies.sim import WarehouseConfig, simulate_warehouse
from evermap_studies.sim.park import ParkConfig, simulate_park

SLAM = SlamConfig()
WAREHOUSE = simulate_warehouse(WarehouseConfig(n_landmarks=60, rate_hz=2.0))


def with_ids(recording: AnyRecordingT, landmark_id: IntArray) -> AnyRecordingT:
    return replace(recording, detections=replace(recording.detections, landmark_id=landmark_id))


def misread(recording: AnyRecordingT, rate: float) -> AnyRecordingT:
    """A share of the ids those of any landmark."""
    true, rng = recording.detections.landmark_id, np.random.default_rng(0)
    ids = np.unique(true[true != UNKNOWN])
    wrong = (rng.random(len(true)) < rate) & (true != UNKNOWN)
    return with_ids(recording, np.where(wrong, ids[rng.integers(0, len(ids), len(true))], true))


@pytest.mark.parametrize("rate", [0.02, 0.2])
@pytest.mark.parametrize(
    "recording",
    [
        pytest.param(WAREHOUSE, id="warehouse"),
        pytest.param(simulate_park(ParkConfig(n_trees=80, drive_m=600.0), seed=3), id="park"),
        pytest.param(hall(1, n_points=40, n_frames=300), id="space"),
    ],
)
def test_ids_that_the_seconds_around_contradict_are_left_out(recording, rate):
    true, wrongly = recording.detections.landmark_id, misread(recording, rate)
    given = wrongly.detections.landmark_id
    left_out = (without_contradicted_ids(wrongly, SLAM).detections.landmark_id == UNKNOWN) & (given != UNKNOWN)
    assert left_out[given != true].mean() > 0.75
    assert left_out[given == true].mean() < 0.01
    assert (without_contradicted_ids(recording, SLAM).detections.landmark_id != true).mean() < 0.002


def rmse_m(recording, *config):
    """Of the trajectory of the warehouse."""
    assert WAREHOUSE.truth is not None
    return evaluate_trajectory(run_slam(recording, *config).trajectory, WAREHOUSE.truth, rate_hz=2.0).rmse_m


AS_READ = Config(slam={"vote_ids": False})


def test_a_fifth_of_the_ids_wrong_is_nearly_as_good_as_none():
    right = rmse_m(WAREHOUSE, AS_READ)
    assert rmse_m(WAREHOUSE) == pytest.approx(right, rel=0.02)
    assert rmse_m(misread(WAREHOUSE, 0.2)) < 1.5 * right


@pytest.mark.slow
def test_without_the_vote_a_fifth_of_the_ids_wrong_is_far_worse():
    """What the vote is for; of the world, not of the vote: that would be missed by the test above."""
    assert rmse_m(misread(WAREHOUSE, 0.2), AS_READ) > 5.0 * rmse_m(WAREHOUSE, AS_READ)


def test_an_id_on_two_landmarks_is_not_used_and_named():
    recording = WAREHOUSE
    true = recording.detections.landmark_id
    together = np.zeros((60, 60))
    for frame in np.unique(recording.detections.frame):
        seen = true[recording.detections.frame == frame]
        together[np.ix_(seen, seen)] += 1
    one, other = np.unravel_index(np.triu(together, 1).argmax(), together.shape)
    twins = with_ids(recording, np.where(true == other, one, true))
    found = without_contradicted_ids(twins, SLAM)
    assert np.array_equal(found.detections.landmark_id == UNKNOWN, np.isin(true, (one, other)))
    assert f"landmark_id {one}: on two landmarks" in found.warnings[-1]
    assert recording.truth is not None
    assert list_doubled_ids(twins, found).tolist() == [one]
    assert list_doubled_ids(recording, recording).tolist() == []
    nameless = with_ids(twins, np.where(true == other, UNKNOWN, true))
    named = with_ids(twins, np.where(true == other, one, true))
    assert list_doubled_ids(nameless, named).tolist() == []
    none = with_ids(twins, np.where(twins.detections.landmark_id == 7, UNKNOWN, twins.detections.landmark_id))
    assert list_doubled_ids(twins, none).tolist() == []  # it was never read twice in a view
    result = run_slam(twins)
    assert found.warnings[-1] in result.warnings
    assert [(cause.code, cause.subject) for cause in result.causes] == [("double-identity", str(one))]
    off = evaluate_trajectory(result.trajectory, recording.truth, rate_hz=2.0).rmse_m
    assert off < 1.5 * rmse_m(recording)


def test_what_is_seen_beside_another_in_one_frame_is_no_misreading_of_it():
    """A landmark 2 cm from another one, and seen an eighth as often: in frames that have both, or in place of it."""
    stamp_s, name = np.repeat(np.arange(0.0, 20.0, 0.1), 2), np.tile([0, 1], 200)
    at = 0.05 * np.random.default_rng(0).normal(size=(400, 2)) + np.column_stack([np.zeros(400), 0.02 * name])
    second = np.arange(400) % 16 == 1
    for with_both in (True, False):
        some = second | ((name == 0) & (with_both | ~np.roll(second, -1)))
        view = np.round(10.0 * stamp_s[some]).astype(np.int64)
        read = Read(at[some], np.ones(some.sum()), stamp_s[some], view, name[some])
        wrong, doubled = contradicted(read, VotesConfig())
        assert not wrong[name[some] == 0].any()
        assert wrong[name[some] == 1].mean() >= 0.9 if not with_both else not wrong.any()
        assert not doubled.any()


def test_without_ids_or_odometry_there_is_no_vote():
    recording = simulate_park(ParkConfig(n_trees=80, drive_m=60.0), seed=3)
    nameless = with_ids(recording, np.full_like(recording.detections.landmark_id, UNKNOWN))
    assert without_contradicted_ids(nameless, SLAM) is nameless
    in_space = replace(hall(1, n_points=40, n_frames=50), odometry=None)
    assert without_contradicted_ids(in_space, SLAM) is in_space


def rig(*laws: str, seed: int = 3, **world):
    """Two sensors, one ahead and one to the left."""
    return field(seed, *[LAWS[law] for law in laws], n_frames=60, **world)


def with_second(recording, change):
    """Return the recording with other positions of what its second sensor saw."""
    seen, own = recording.detections, recording.detections.sensor == 1
    at = seen.position_sensor_m.copy()
    at[own] = change(at[own])
    return replace(recording, detections=replace(seen, position_sensor_m=at))


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda at: 1.08 * at, id="scale"),
        pytest.param(lambda at: Rotation.from_euler("z", 0.15).apply(at), id="turn"),
        pytest.param(lambda at: at + [0.0, 0.5, 0.0], id="shift"),
        pytest.param(lambda at: at * [-1.0, -1.0, 1.0], id="back to front"),
    ],
)
def test_where_sensors_contradict_each_other_ids_are_right(change):
    recording = with_second(rig("lidar", "lidar"), change)
    found = without_contradicted_ids(recording, SLAM)
    assert np.mean(found.detections.landmark_id == UNKNOWN) < 0.03
    assert not any("two landmarks" in warning for warning in found.warnings)


def test_where_a_sensor_is_late_ids_are_right():
    found = without_contradicted_ids(rig("lidar", "lidar", late_s=0.2), SLAM)
    assert np.mean(found.detections.landmark_id == UNKNOWN) < 0.03


@pytest.mark.parametrize("shared", [True, False])
def test_ids_on_two_landmarks_show_between_two_sensors(shared):
    """Five ids of two landmarks each, one seen ahead and one to the left; other landmarks are seen by both, or none."""
    recording = rig("lidar", "lidar")
    seen = recording.detections
    views = np.zeros((2, 60, 40))
    views[seen.sensor, seen.frame, seen.landmark_id] = 1.0
    together, name, side = views[0].T @ views[1] - 100.0 * np.eye(40), np.arange(40), np.full(40, 2)
    for _ in range(5):
        one, other = np.unravel_index(together.argmax(), together.shape)
        name[other], side[one], side[other] = one, 0, 1
        together[[one, other]], together[:, [one, other]] = -100.0, -100.0
    twin = side[seen.landmark_id] < 2
    some = np.where(twin, side[seen.landmark_id] == seen.sensor, shared | (seen.landmark_id % 2 == seen.sensor))
    recording = with_ids(recording, np.where(some, name[seen.landmark_id], UNKNOWN))
    found = without_contradicted_ids(recording, SLAM).detections.landmark_id
    assert np.mean(found[some & twin] == UNKNOWN) > 0.9
    assert np.mean(found[some & ~twin] == UNKNOWN) < 0.03
