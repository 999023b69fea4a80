"""Objects that look the same after some turns, detected in any of these orientations at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.errors import DataError
from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetry
from evermap.metrics.summary import Evaluation, compare_with_truth
from evermap.pipeline import run_session, run_slam
from evermap.types import ChangeKind, SlamResult, SpatialRecording, rows_of

from .rooms import CLASSES, SYMMETRIES, Room


def scored(recording: SpatialRecording, result: SlamResult) -> Evaluation:
    found = compare_with_truth(recording, result, rate_hz=10.0)
    assert found.poses is not None
    assert found.landmarks is not None
    return found


@pytest.mark.parametrize(
    ("seed", "how"),
    [
        (3, "map by hand"),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((0, "odometry"), (1, "by hand"), (2, "map"))),
    ],
)
def test_it_is_as_if_an_oracle_had_undone_the_turns(seed: int, how: str) -> None:
    room = Room.of(seed)
    known = room.map().as_prior(0.01) if "map" in how else None
    worlds = [room.walk(seed, odometry="hand" not in how, ambiguous=ambiguous) for ambiguous in (True, False)]
    found, oracle = (run_slam(world, prior_map=known) for world in worlds)
    ours, theirs = found.trajectory.pose_world_robot, oracle.trajectory.pose_world_robot
    assert np.linalg.norm(ours[:, :3] - theirs[:, :3], axis=1).max() < 1e-4
    np.testing.assert_allclose(found.landmarks.position_m, oracle.landmarks.position_m, atol=1e-4)
    np.testing.assert_allclose(found.landmarks.covariance_m2, oracle.landmarks.covariance_m2, rtol=1e-2, atol=1e-9)
    first, second = (scored(*pair) for pair in zip(worlds, (found, oracle), strict=True))
    assert first.landmarks.orientation_rmse_deg == pytest.approx(second.landmarks.orientation_rmse_deg, abs=1e-2)
    assert first.landmarks.orientation_rmse_deg < 3.5
    assert not found.changes
    levels = {parameter.name: parameter.value for parameter in found.parameters}
    assert levels["orientation_noise_factor"] == pytest.approx(1.0, abs=0.08)


def test_taken_at_face_value_orientations_say_nothing() -> None:
    room = Room.of(4, ("brick", "can", "drum", "cube"))
    plain = room.walk(4, stated=False)
    found = scored(plain, run_slam(plain))
    better = room.walk(4)
    assert scored(better, run_slam(better)).landmarks.orientation_rmse_deg < 3.5
    assert found.landmarks.orientation_rmse_deg > 30.0


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(8), marks=pytest.mark.slow)])
def test_what_nobody_sees_is_unknown_and_all_else_as_sure_as_it_says(seeds: range) -> None:
    """Turns about axes have the variance of any angle; of the others squared errors average the degrees of freedom."""
    squared, dof, of_poses = [], 0, []
    for seed in seeds:
        room = Room.of(seed, ("mug", "can", "drum", "brick"))
        recording = room.walk(seed, odometry=False)
        mugs = rows_of(room.map(), np.flatnonzero(room.kind == 0))
        found = run_slam(recording, prior_map=mugs.as_prior(0.001))
        marks, turn = found.landmarks, room.turn
        assert marks.rotation is not None
        assert marks.rotation_covariance is not None
        for k, name in enumerate(marks.landmark_id.tolist()):
            kind = CLASSES[room.kind[name]]
            seen = np.arange(3) != {"can": 2, "drum": 0}.get(kind, -1)
            own = marks.rotation_covariance[k]
            assert own[~seen][:, ~seen] == pytest.approx(np.pi**2 / 3.0 * np.eye(3)[~seen][:, ~seen])
            assert own[~seen][:, seen] == pytest.approx(0.0, abs=1e-9)
            if kind != "mug":
                alike = Symmetry.generate_group(SYMMETRIES[kind])
                true = alike.nearest(*(np.append(np.zeros(3), q) for q in (turn[name].as_quat(), marks.rotation[k])))
                off = se3.local(np.append(np.zeros(3), marks.rotation[k]), true)[3:][seen]
                squared.append(off @ np.linalg.solve(own[np.ix_(seen, seen)], off))
                dof += seen.sum()
        turns = Rotation.from_quat(found.trajectory.pose_world_robot[:, 3:])
        at = np.searchsorted(recording.truth.stamp_s, found.trajectory.stamp_s - 1e-6)
        gap = recording.truth.pose_world_robot[at, :3] - found.trajectory.pose_world_robot[:, :3]
        covariance = found.trajectory.covariance[:, :3, :3]
        of_poses += [g @ np.linalg.solve(c, g) for g, c in zip(turns.inv().apply(gap), covariance, strict=True)]
    assert np.sum(squared) / dof == pytest.approx(1.0, abs=0.25)
    assert 2.0 < np.mean(of_poses) < 3.6


def test_days_of_a_living_map() -> None:
    """Who turns a can about its axis, or a brick half around, changes nothing; a quarter of a turn does."""
    room = Room.of(5, ("brick", "can", "mug", "cube"), a_kind=4)
    living = run_session(room.walk(5, odometry=False)).living
    stood = living.places.rotation.copy()
    room.turned(0, Rotation.from_euler("x", np.pi))  # a brick
    room.turned(1, Rotation.from_euler("z", 2.0))  # a can
    second = run_session(room.walk(5, day=1, odometry=False), living)
    assert second.changes == ()
    off = se3.angle_between(*(np.pad(turns, ((0, 0), (3, 0))) for turns in (stood, second.living.places.rotation)))
    assert off.max() < 0.1  # nor does the map turn with them
    room.turned(4, Rotation.from_euler("z", np.pi / 2.0))  # another brick
    room.turned(9, Rotation.from_euler("x", 1.2))  # another can, laid down
    room.turned(14, Rotation.from_euler("z", 2.0))  # a mug
    third = run_session(room.walk(5, day=2, odometry=False), second.living)
    told = {change.landmark_ids: change for change in third.changes}
    assert told.keys() == {(4,), (9,), (14,)}
    assert {change.kind for change in told.values()} == {ChangeKind.MOVED}
    assert told[4,].rotation_rad == pytest.approx(np.pi / 2.0, abs=0.1)
    assert told[9,].rotation_rad == pytest.approx(1.2, abs=0.1)


def test_of_a_given_map_what_is_turned_is_told_where_it_shows() -> None:
    room = Room.of(6, ("brick", "can", "mug"), a_kind=4)
    known = room.map().as_prior(0.01)
    room.turned(0, Rotation.from_euler("z", np.pi))
    room.turned(1, Rotation.from_euler("z", 1.0))
    room.turned(2, Rotation.from_euler("z", 1.0))
    room.turned(4, Rotation.from_euler("y", 1.0))
    told = {
        change.landmark_ids: change.rotation_rad
        for change in run_slam(room.walk(6, odometry=False), prior_map=known).changes
    }
    assert told.keys() == {(2,), (4,)}
    assert list(told.values()) == pytest.approx([1.0, 1.0], abs=0.06)


def test_a_second_landmark_of_one_identity_looks_the_same_as_the_first() -> None:
    room = Room.of(7, ("can", "brick"), a_kind=5)
    recording = room.walk(7)
    name = recording.detections.landmark_id.copy()
    name[name == 4] = 0  # two cans of one identity
    found = run_slam(replace(recording, detections=replace(recording.detections, landmark_id=name)))
    assert "0#2" in found.landmarks.names.values()
    assert found.landmarks.rotation_covariance is not None
    twin = next(row for row, name in found.landmarks.names.items() if name == "0#2")
    own = found.landmarks.rotation_covariance[found.landmarks.landmark_id == twin][0]
    assert own[2, 2] > 1.0 > 100.0 * own[0, 0]


def test_a_wrong_text_is_named() -> None:
    recording = replace(Room.of(0).walk(0, n_frames=20), symmetries={"can": ("axis:q",)})
    with pytest.raises(DataError, match=r"field 'symmetries': room, day 0: unknown symmetry 'axis:q' \(try: axis:z"):
        run_slam(recording)
