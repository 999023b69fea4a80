"""The simulated building in space: its geometry against the pinhole formula, and a short life in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap_studies.building import study
from evermap_studies.building.patrol import CENTRE, FOCAL, SIGMA_PX, SIZE_M, patrolled
from evermap_studies.building.study import Settings
from evermap_studies.building.world import CORRIDOR_M, KINDS, ROOM_CENTRES, World, made


@pytest.fixture(scope="module")
def world() -> World:
    return made(3, 6)


def test_one_seed_one_world(world: World) -> None:
    again = made(3, 6)
    assert np.array_equal(again.thing, world.thing, equal_nan=True)
    assert not np.array_equal(made(4, 6).thing, world.thing, equal_nan=True)


def test_what_is_fixed_never_moves_and_the_rest_does(world: World) -> None:
    at = world.positions()
    fixed = np.array([np.isinf(KINDS[k].stay_days) for k in world.class_id])
    assert np.isfinite(at[:, fixed]).all()
    assert np.array_equal(at[:, fixed], np.broadcast_to(at[0, fixed], at[:, fixed].shape))
    other = at[:, ~fixed]
    assert np.any((other[1:] != other[:-1]) & np.isfinite(other[1:]) & np.isfinite(other[:-1]))
    assert np.isnan(other).any()


def test_tags_of_one_thing_move_as_one_body(world: World) -> None:
    at = world.positions()
    for thing in np.flatnonzero(world.kind == 3):
        own = at[:, world.of == thing]
        there = np.isfinite(own[:, 0, 0])
        gaps = np.linalg.norm(own[there][:, :, None] - own[there][:, None], axis=3)
        assert np.allclose(gaps, gaps[:1])


def test_corners_are_where_a_pinhole_camera_sees_them(world: World) -> None:
    recording = patrolled(world, 1, 3, np.array([0]), np.array([1]), by_hand=False).recording
    seen = recording.detections
    at, turn = world.landmarks(1)
    own = np.flatnonzero(np.isfinite(seen.corner_px[:, 0, 0]))
    assert len(own) > 100
    assert recording.truth is not None
    errors = []
    for row in own:
        pose = recording.truth.pose_world_robot[seen.frame[row]]
        mount = recording.sensors[seen.sensor[row]].mount_robot_sensor
        name = seen.landmark_id[row]
        robot = Rotation.from_quat(pose[3:])
        corner = at[name] + turn[name].apply(0.5 * SIZE_M * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]))
        local = Rotation.from_quat(mount[3:]).inv().apply(robot.inv().apply(corner - pose[:3]) - np.array(mount[:3]))
        errors.append(FOCAL * local[:, :2] / local[:, 2:] + np.array(CENTRE) - seen.corner_px[row])
    off = np.abs(np.array(errors)).reshape(len(own), -1)
    right = off.max(axis=1) < 6.0 * SIGMA_PX
    assert right.mean() > 0.985  # the others have wrong identities
    assert np.sqrt(np.mean(off[right] ** 2)) == pytest.approx(SIGMA_PX, rel=0.1)


def test_nothing_is_seen_through_a_shut_door(world: World) -> None:
    for day in range(1, 6):
        seen = patrolled(world, day, 3, np.array([0]), np.array([day]), by_hand=True).recording.detections
        at, _ = world.landmarks(day)
        names, count = np.unique(seen.landmark_id, return_counts=True)
        for room in np.flatnonzero(~world.door_open[day]):
            inside = np.all(np.abs(at[names, :2] - ROOM_CENTRES[room]) < (4.0, 3.0), axis=1)
            inside &= (at[names, 1] < CORRIDOR_M[0]) | (at[names, 1] > CORRIDOR_M[1])
            assert count[inside].sum() <= 2  # wrong identities


def test_without_changes_all_stays_as_on_the_first_day(world: World) -> None:
    still = made(3, 6, changes=False)
    assert np.array_equal(still.thing, np.broadcast_to(world.thing[:1], world.thing.shape), equal_nan=True)
    assert np.array_equal(still.door_open, world.door_open)


@pytest.mark.slow
def test_a_short_life(tmp_path: Path) -> None:
    content = study.reproduce(tmp_path / "out", Settings(worlds=1, days=2, methods=("evermap",)))
    (run,) = content["runs"]
    assert [row["found"] for row in run["sessions"]] == [True, True]
    assert all(row["pose_m"] < 0.1 for row in run["sessions"])
    assert not any(row["never"] for row in run["told"])
    table = (tmp_path / "out" / "table.md").read_text()
    assert "existence" in table
    assert "pallet" in table
    assert (tmp_path / "out" / "map.png").stat().st_size > 10_000
    assert (tmp_path / "out" / "existence.svg").exists()
