"""The live engine in space against the recordings' own entry points: the same maps, the same poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from feeding import AT_THE_END, online, stored

import evermap as em
from evermap.config import Config
from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.spatial import spatial_detections
from evermap.live.engine import Now
from evermap.live.feed import SpatialLook, SpatialPose, replay_in_space, run_live
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap.runs.sessions import enter_session
from evermap.types import Frames, Sensor, SpatialOdometry, SpatialRecording, SpatialSensor

N_FRAMES, SIGMA_M, SIGMA_RAD = 120, 0.02, 0.02
RIG = SpatialSensor("front", range_max_m=9.0, sigma_m=SIGMA_M, sigma_rad=SIGMA_RAD)


def room(day: int, gone: tuple[int, ...] = ()) -> SpatialRecording:
    """A round through a room with twelve landmarks, every other one with an orientation."""
    random, world = np.random.default_rng([5, day]), np.random.default_rng(9)
    angle = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    turn = world.normal(0.0, 0.5, (12, 3))
    at = np.column_stack([5.0 * np.cos(angle), 4.0 * np.sin(angle), world.uniform(-0.5, 1.5, 12)])
    place = np.hstack([at, se3.exp(np.hstack([np.zeros((12, 3)), turn]))[:, 3:]])
    way = np.linspace(0.0, 2.0 * np.pi, N_FRAMES)
    flat = np.column_stack([np.zeros((N_FRAMES, 4)), 0.05 * np.sin(3.0 * way), way])
    pose = np.hstack(
        [np.column_stack([2.0 * np.sin(way), 2.0 - 2.0 * np.cos(way), 0.1 * np.sin(way)]), se3.exp(flat)[:, 3:]]
    )
    stamp_s = 1e9 + 86_400.0 * day + 0.25 * np.arange(N_FRAMES)
    frame, tag = (pairs.ravel() for pairs in np.meshgrid(np.arange(N_FRAMES), np.arange(12), indexing="ij"))
    ahead = se3.between(pose[frame], place[tag])
    seen = (ahead[:, 0] > -0.5) & ~np.isin(tag, gone) & (random.random(len(tag)) < 0.9)
    frame, tag, ahead = frame[seen], tag[seen], ahead[seen]
    ahead = se3.retract(ahead, random.normal(0.0, [SIGMA_M] * 3 + [SIGMA_RAD] * 3, (len(tag), 6)))
    rotation = np.where((tag % 2 == 0)[:, None], ahead[:, 3:], np.nan)
    detections = spatial_detections(
        frame, landmark_id=tag, position_sensor_m=ahead[:, :3], rotation=rotation, class_id=tag % 2
    )
    step = se3.between(pose[:-1], pose[1:])
    step = se3.retract(step, random.normal(0.0, [0.01] * 3 + [0.003] * 3, (N_FRAMES - 1, 6)))
    driven = [se3.exp([3.0, 1.0, -2.0, 0.2, 0.1, 1.0])]
    for one in step:
        driven.append(se3.compose(driven[-1], one))
    odometry = SpatialOdometry(stamp_s, np.array(driven), np.full((N_FRAMES, 6), np.nan))
    return SpatialRecording(f"day {day}", odometry, Frames(stamp_s), detections, (RIG,), class_names=("box", "pole"))


def engine(path: Path | LivingMap, recording: SpatialRecording, config: Config = AT_THE_END, **how: bool) -> em.Engine:
    return em.Engine(
        path, recording.sensors, config, clock=recording.clock, class_names=recording.class_names,
        name=recording.name, **{"beside": False, **how},
    )  # fmt: skip


def fed(live: em.Engine, recording: SpatialRecording) -> list[Now]:
    steps: list[Now] = []

    def refused(line: str) -> None:
        raise AssertionError(line)

    run_live(live, replay_in_space(recording), steps.append, refused)
    return steps


def entered(path: Path, recording: SpatialRecording) -> LivingMap:
    with open_store(path, create=True) as store:
        enter_session(store, recording, AT_THE_END).commit(store, AT_THE_END)
        return store.load()


def test_a_recording_fed_live_gives_the_map_and_the_poses_of_its_replay(tmp_path: Path) -> None:
    for number, recording in enumerate((room(0), room(1, gone=(4,)))):
        before = stored(tmp_path / "replay.evermap") if number else LivingMap.in_space(recording.clock)
        with engine(tmp_path / "live.evermap", recording) as live:
            steps = fed(live, recording)
            assert live.save() is not None
        made, replay = stored(tmp_path / "live.evermap"), entered(tmp_path / "replay.evermap", recording)
        ours, theirs = made.landmarks(), replay.landmarks()
        np.testing.assert_array_equal(ours.landmark_id, theirs.landmark_id)
        np.testing.assert_allclose(ours.p_exists, theirs.p_exists, atol=0.02)
        np.testing.assert_allclose(ours.position_m, theirs.position_m, atol=1e-6)
        assert steps[-1].frame == ("prior_map" if number else "first_pose")
        if not number:
            continue
        steps = fed(engine(before, recording, mapping=False), recording)
        ours_online, replayed = online(steps), em.run_localization(recording, before, AT_THE_END).online
        both, mine, there = np.intersect1d(ours_online.stamp_s, replayed.stamp_s, return_indices=True)
        assert len(both) >= len(replayed) - 2
        np.testing.assert_allclose(
            ours_online.pose_world_robot[mine], replayed.pose_world_robot[there], rtol=0, atol=1e-9
        )
        names = steps[-1].in_view
        assert len(names)
        assert set(names.landmark_id.tolist()) <= set(range(12))
    assert made.landmarks().p_exists[4] < 0.5


def test_an_unmapped_place_is_mapped_while_the_robot_drives_and_after_a_revision_it_goes_on_there(
    tmp_path: Path,
) -> None:
    recording = room(0)
    odometry = recording.odometry
    assert odometry is not None
    often = Config(live={"revision_s": 12.0})
    with engine(tmp_path / "site.evermap", recording, often) as live:
        steps = fed(live, recording)
    frames = [one.frame for one in steps]
    assert frames[10] == "first_pose"
    assert frames[-1] == "prior_map"
    at = np.searchsorted(recording.frames.stamp_s, online(steps).stamp_s)
    way = np.linspace(0.0, 2.0 * np.pi, N_FRAMES)[at]
    true = np.column_stack([2.0 * np.sin(way), 2.0 - 2.0 * np.cos(way), 0.1 * np.sin(way)])
    off = np.linalg.norm(online(steps).pose_world_robot[:, :3] - true, axis=1)
    assert off.max() < 0.15
    assert stored(tmp_path / "site.evermap").dim == 3


def test_twists_are_as_good_as_the_poses_that_they_lead_to(tmp_path: Path) -> None:
    recording = room(0)
    by_poses = engine(tmp_path / "a.evermap", recording)
    by_twists = engine(tmp_path / "b.evermap", recording)
    steps: list[list[Now]] = [[], []]
    readings = list(replay_in_space(recording))
    poses = [one for one in readings if isinstance(one, SpatialPose)]
    count = 0
    for one in readings:
        if isinstance(one, SpatialPose):
            by_poses.odometry_in_space(*one)
            after = poses[min(count + 1, len(poses) - 1)]
            twist = se3.local(one.pose, after.pose) / max(after.stamp_s - one.stamp_s, 0.25)
            by_twists.odometry_in_space(one.stamp_s, twist=twist)
            count += 1
        elif isinstance(one, SpatialLook):
            values = one._asdict()
            stamp_s = values.pop("stamp_s")
            for live in (by_poses, by_twists):
                live.detections_in_space(stamp_s, **values)
        else:
            for live, told in zip((by_poses, by_twists), steps, strict=True):
                told.append(live.step())
    one, other = (online(told).pose_world_robot for told in steps)
    np.testing.assert_allclose(one, other, atol=1e-7)
    by_poses.close()
    by_twists.close()


def test_readings_that_cannot_be_are_refused(tmp_path: Path) -> None:
    recording = room(0)
    live = engine(tmp_path / "site.evermap", recording)
    with pytest.raises(InputError, match="the sensor is in space"):
        live.odometry(0.0, 0.1)
    with pytest.raises(InputError, match="the sensor is in space"):
        live.detections(0.0)
    with pytest.raises(InputError, match="a pose or a twist"):
        live.odometry_in_space(0.0)
    with pytest.raises(InputError, match="is not a pose"):
        live.odometry_in_space(0.0, [0.0] * 7)
    with pytest.raises(InputError, match="no position"):
        live.detections_in_space(0.0, [1], np.full((1, 3), np.nan))
    with pytest.raises(InputError, match="shape"):
        live.detections_in_space(0.0, [1, 2], np.zeros((1, 3)))
    with pytest.raises(InputError, match="sensor"):
        live.detections_in_space(0.0, [1], np.ones((1, 3)), sensor=3)
    live.close()
    with em.Engine(tmp_path / "flat.evermap", Sensor(range_max_m=5.0), clock=recording.clock) as flat:
        with pytest.raises(InputError, match="the sensor is in the plane"):
            flat.odometry_in_space(0.0, se3.identity())
        flat.mapping = False
    map_of_space = replace(entered(tmp_path / "space.evermap", recording))
    with pytest.raises(InputError, match="a map in space"):
        em.Engine(map_of_space, Sensor(range_max_m=5.0), mapping=False, clock=recording.clock)
