"""A month in a building: a robot patrols the same rooms again and again while things move, come and go.

One seed makes independent random streams for the building, its changes and every session, so a config that differs
in one part (say `change_rate`) leaves the others as they are.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from evermap.errors import ConfigError
from evermap.sim.building import Placer, SceneObject, furnish
from evermap.sim.changes import ChangeEvent, Stay, Timeline, events_of, live
from evermap.sim.classes import DAY_S
from evermap.sim.config import BuildingConfig
from evermap.sim.detect import Scene, detect
from evermap.sim.floorplan import FloorPlan, draw_floor_plan
from evermap.sim.patrol import drive, patrol_route, report_odometry
from evermap.types import Clock, FloatArray, Frames, IntArray, Landmarks, Recording, Trajectory


class _Stream(IntEnum):
    PLAN = 0
    FURNITURE = 1
    CHANGES = 2
    TIMES = 3
    ROUTE = 4
    DRIVE = 5
    ODOMETRY = 6
    SENSOR = 7


@dataclass(frozen=True, slots=True)
class SessionTruth:
    """What only a simulation knows about a session.

    Attributes:
        day: 0 for the first.
        start_s, end_s: of the recording, seconds since 1970 UTC.
        detection_landmark_id: (M,) the landmark that each detection truly came from, `UNKNOWN` if from nothing.
    """

    day: int
    start_s: float
    end_s: float
    detection_landmark_id: IntArray


@dataclass(frozen=True, slots=True)
class BuildingSimulation:
    """Recordings of a robot in a changing building, and the whole truth.

    Attributes:
        config, seed: what it was made from.
        plan: walls (`plan.walls_m`, (W, 2, 2) segments to draw) and rooms.
        objects: everything that was ever there; its place in the tuple is its `object_id`.
        stays: every spell of every object at one pose, by object, then by time.
        events: what changed between midnight of day 0 and the end of the last session, in order of time.
        sessions: one recording a patrol, in order of time, stamps on `Clock.UNIX`; each with its true trajectory and
            the true landmarks that were there during it.
        truths: (one a session) what else is known.
    """

    config: BuildingConfig
    seed: int
    plan: FloorPlan
    objects: tuple[SceneObject, ...]
    stays: tuple[Stay, ...]
    events: tuple[ChangeEvent, ...]
    sessions: tuple[Recording, ...]
    truths: tuple[SessionTruth, ...]

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the object classes; row = class id."""
        return tuple(kind.name for kind in self.config.classes)

    @property
    def n_landmarks(self) -> int:
        """Landmarks that were ever there; their ids count from 0."""
        return sum(len(item.landmark_ids) for item in self.objects)

    def landmarks_at(self, stamp_s: float) -> Landmarks:
        """True landmarks that are there at a time, exact, in the frame 'truth'."""
        position = positions_at(self.objects, self.stays, stamp_s)
        return _as_landmarks(position, _class_ids(self.objects), self.class_names)


def positions_at(objects: tuple[SceneObject, ...], stays: tuple[Stay, ...], stamp_s: float) -> FloatArray:
    """(L, 2) landmark positions at a time, row = landmark id, nan where it is not there."""
    position = np.full((sum(len(item.landmark_ids) for item in objects), 2), np.nan)
    for stay in stays:
        if stay.start_s <= stamp_s < stay.end_s:
            item = objects[stay.object_id]
            position[list(item.landmark_ids)] = item.landmarks_at(stay.pose)
    return position


def simulate_building(config: BuildingConfig | None = None, seed: int = 0) -> BuildingSimulation:
    """Simulate a building and all patrols through it. The same config and seed give the same arrays.

    Args:
        config: defaults to `BuildingConfig()`: 6 sessions of 165 s on 6 days, about 80 landmarks.
        seed: any integer from 0.

    Raises:
        ConfigError: a value is out of range or the furniture does not fit, with the name of the field.
    """
    config = BuildingConfig() if config is None else config
    config.check()
    try:
        seed = operator.index(seed)
    except TypeError:
        seed = -1
    if seed < 0:
        raise ConfigError("is not an integer from 0", field="seed", hint="0")

    plan = draw_floor_plan(config, _rng(seed, _Stream.PLAN))
    placer = Placer(plan, np.concatenate([patrol_route(plan), patrol_route(plan, reverse=True)]))
    first_objects, _ = furnish(config.classes, placer, _rng(seed, _Stream.FURNITURE))
    timeline = _timeline(config, _rng(seed, _Stream.TIMES))
    everyone, history = live(first_objects, config, placer, timeline, _sequence(seed, _Stream.CHANGES))
    objects, stays = tuple(everyone), tuple(history)
    n_known = sum(len(item.landmark_ids) for item in first_objects)

    sessions, truths = [], []
    for row, start_s in enumerate(timeline.sessions_s[:, 0]):
        position = positions_at(objects, stays, float(start_s))
        scene = Scene(position, _class_ids(objects), n_known)
        recording, truth = _record(config, seed, row, float(start_s), plan, scene)
        sessions.append(recording)
        truths.append(truth)
    return BuildingSimulation(
        config=config,
        seed=seed,
        plan=plan,
        objects=objects,
        stays=stays,
        events=events_of(objects, stays, timeline),
        sessions=tuple(sessions),
        truths=tuple(truths),
    )


def _record(
    config: BuildingConfig, seed: int, row: int, start_s: float, plan: FloorPlan, scene: Scene
) -> tuple[Recording, SessionTruth]:
    """Drive, listen to the encoders and look around, once."""
    jitter = _rng(seed, _Stream.ROUTE, row).uniform(-0.15, 0.15, (len(plan.rooms), 4))
    route = patrol_route(plan, reverse=row % 2 == 1, jitter_m=jitter)
    path = drive(route, config.drive, start_s, config.patrol_s, _rng(seed, _Stream.DRIVE, row))
    odometry = report_odometry(path, config.odometry, _rng(seed, _Stream.ODOMETRY, row))
    # the camera runs on its own beat, a fraction of a period after the encoders
    passed_s = (np.arange(int(config.patrol_s * config.sensor.rate_hz) + 1) + 0.37) / config.sensor.rate_hz
    frame_s = start_s + passed_s[start_s + passed_s <= odometry.stamp_s[-1]]
    pose = path.pose_at(frame_s)
    detections, true_ids = detect(pose, scene, plan, config.sensor, _sequence(seed, _Stream.SENSOR, row))
    day = row // config.sessions_per_day
    class_names = tuple(kind.name for kind in config.classes)
    recording = Recording(
        name=f"building day {day + 1} session {row % config.sessions_per_day + 1}",
        odometry=odometry,
        frames=Frames(frame_s, complete=True, clock=Clock.UNIX),
        detections=detections,
        sensor=config.sensor.nominal(),
        truth=Trajectory(
            stamp_s=path.stamp_s,
            pose_world_robot=path.pose_world_robot,
            covariance=np.zeros((len(path.stamp_s), 3, 3)),
            frame="truth",
            clock=Clock.UNIX,
        ),
        true_landmarks=_as_landmarks(scene.position_m, scene.class_id, class_names),
        class_names=class_names,
        source=f"simulated building, seed {seed}",
        clock=Clock.UNIX,
    )
    return recording, SessionTruth(day, start_s, float(path.stamp_s[-1]), true_ids)


def _timeline(config: BuildingConfig, rng: np.random.Generator) -> Timeline:
    """Sessions spread over the working hours of every day, each somewhere in the first third of its share."""
    share_s = 10 * 3600.0 / config.sessions_per_day
    late_s = rng.random((config.days, config.sessions_per_day)) * min(share_s / 3, share_s - config.patrol_s - 1.0)
    clock_s = 8 * 3600.0 + np.arange(config.sessions_per_day) * share_s + late_s
    start_s = np.floor(config.first_day_unix_s + np.arange(config.days)[:, None] * DAY_S + clock_s).ravel()
    sessions_s = np.stack([start_s, start_s + config.patrol_s + 1.0], axis=1)
    return Timeline(config.first_day_unix_s, float(sessions_s[-1, 1]), sessions_s)


def _class_ids(objects: tuple[SceneObject, ...]) -> IntArray:
    """(L,) class of every landmark."""
    return np.array([item.class_id for item in objects for _ in item.landmark_ids], dtype=np.int64)


def _as_landmarks(position_m: FloatArray, class_id: IntArray, class_names: tuple[str, ...]) -> Landmarks:
    there = np.flatnonzero(np.isfinite(position_m[:, 0]))
    landmarks = Landmarks.at(there, position_m[there], class_id=class_id[there], class_names=class_names)
    return replace(landmarks, clock=Clock.UNIX)


def _sequence(seed: int, stream: _Stream, row: int = 0) -> np.random.SeedSequence:
    return np.random.SeedSequence(entropy=seed, spawn_key=(int(stream), row))


def _rng(seed: int, stream: _Stream, row: int = 0) -> np.random.Generator:
    return np.random.default_rng(_sequence(seed, stream, row))
