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
from evermap.geometry import se2
from evermap.types import Clock, FloatArray, Frames, IntArray, Landmarks, Recording, Trajectory
from evermap_studies.sim.building import FloorPlan, Placer, SceneObject, draw_floor_plan, furnish
from evermap_studies.sim.changes import ChangeEvent, Stay, Timeline, events_of, live
from evermap_studies.sim.config import DAY_S, BuildingConfig
from evermap_studies.sim.detect import Scene, detect
from evermap_studies.sim.patrol import drive, patrol_route, report_odometry

P_PASS_BY: float = 1.0 / 3.0
"""Probability that a patrol with a route of its own does not visit a room."""


class _Stream(IntEnum):
    PLAN = 0
    FURNITURE = 1
    CHANGES = 2
    TIMES = 3
    ROUTE = 4
    DRIVE = 5
    ODOMETRY = 6
    SENSOR = 7
    PATROLS = 8
    DOORS = 9


@dataclass(frozen=True, slots=True)
class SessionTruth:
    """What only a simulation knows about a session.

    Attributes:
        day: 0 for the first.
        start_s, end_s: of the recording, seconds since 1970 UTC.
        detection_landmark_id: (M,) the landmark that each detection truly came from, `UNKNOWN` if from nothing.
        pose_world_sensor: (F, 3) true pose of the sensor at every frame.
        shut_rooms: rooms (rows of the plan) whose doors were shut.
        wing_shut: whether the eastern wing was closed.
    """

    day: int
    start_s: float
    end_s: float
    detection_landmark_id: IntArray
    pose_world_sensor: FloatArray
    shut_rooms: tuple[int, ...] = ()
    wing_shut: bool = False


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
        """Return the names of the object classes; row = class id."""
        return tuple(kind.name for kind in self.config.classes)

    @property
    def n_landmarks(self) -> int:
        """Count the landmarks that were ever there; their ids count from 0."""
        return sum(len(item.landmark_ids) for item in self.objects)

    def plan_in(self, session: int) -> FloorPlan:
        """Return the plan of a session, with shut doors and a shut wing as walls, as they blocked the sensor's view."""
        truth = self.truths[session]
        return self.plan.shut(truth.shut_rooms, wing=truth.wing_shut)

    def landmarks_at(self, stamp_s: float) -> Landmarks:
        """Return the true landmarks at a time, exact, in the frame 'truth'."""
        position = positions_at(self.objects, self.stays, stamp_s)
        return _as_landmarks(position, _class_ids(self.objects), self.class_names)


def positions_at(objects: tuple[SceneObject, ...], stays: tuple[Stay, ...], stamp_s: float) -> FloatArray:
    """Return landmark positions (L, 2) at a time, row = landmark id, nan where it is not there."""
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
    patrols = _patrols(config, plan, seed)
    timeline = _timeline(config, [patrol.length_s for patrol in patrols], _rng(seed, _Stream.TIMES))
    everyone, history = live(first_objects, config, placer, timeline, _sequence(seed, _Stream.CHANGES))
    objects, stays = tuple(everyone), tuple(history)
    n_known = sum(len(item.landmark_ids) for item in first_objects)

    doors = _shut_rooms(config, plan, timeline, seed)
    sessions, truths = [], []
    for row, start_s in enumerate(timeline.sessions_s[:, 0]):
        position = positions_at(objects, stays, float(start_s))
        scene = Scene(position, _class_ids(objects), n_known)
        recording, truth = _record(config, seed, row, float(start_s), plan, scene, patrols[row], doors[row])
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


@dataclass(frozen=True, slots=True)
class _Patrol:
    """What a patrol sets out to do.

    Attributes:
        length_s: how long it takes.
        reverse: the direction of its lap.
        passed_by: rooms that it does not visit even if it could.
        start: where on its lap it begins, as a share.
    """

    length_s: float
    reverse: bool
    passed_by: frozenset[int] = frozenset()
    start: float = 0.0


def _patrols(config: BuildingConfig, plan: FloorPlan, seed: int) -> list[_Patrol]:
    """Full laps from the dock, in alternating directions; with `patrol_lengths_s` each but the first has its own."""
    count = config.days * config.sessions_per_day
    if not config.patrol_lengths_s:
        return [_Patrol(config.patrol_s, row % 2 == 1) for row in range(count)]
    patrols = [_Patrol(config.longest_patrol_s, reverse=False)]
    for row in range(1, count):
        rng = _rng(seed, _Stream.PATROLS, row)
        length_s = float(rng.choice(config.patrol_lengths_s))
        reverse, start = bool(rng.random() < 0.5), float(rng.random())
        passed_by = frozenset(np.flatnonzero(rng.random(len(plan.rooms)) < P_PASS_BY).tolist())
        patrols.append(_Patrol(length_s, reverse, passed_by, start))
    return patrols


def _shut_rooms(
    config: BuildingConfig, plan: FloorPlan, timeline: Timeline, seed: int
) -> list[tuple[tuple[int, ...], bool]]:
    """For every session: rooms whose doors are shut, and whether the wing is closed."""
    starts = timeline.sessions_s[:, 0]
    opens_s = timeline.start_s + config.wing_opens_day * DAY_S
    shut = np.zeros((len(starts), len(plan.rooms)), dtype=np.bool_)
    if config.doors is not None:
        for row in range(len(plan.rooms)):
            rng = _rng(seed, _Stream.DOORS, row)
            share_shut = config.doors[1].mean_days / (config.doors[0].mean_days + config.doors[1].mean_days)
            is_shut, since_s = bool(rng.random() < share_shut), timeline.start_s
            while since_s < timeline.end_s:
                end_s = since_s + config.doors[is_shut].sample_s(rng)
                shut[(starts >= since_s) & (starts < end_s), row] = is_shut
                since_s, is_shut = end_s, not is_shut
    return [
        (tuple(np.flatnonzero(rooms).tolist()), bool(start_s < opens_s))
        for rooms, start_s in zip(shut, starts, strict=True)
    ]


def _record(
    config: BuildingConfig,
    seed: int,
    row: int,
    start_s: float,
    plan: FloorPlan,
    scene: Scene,
    patrol: _Patrol,
    doors: tuple[tuple[int, ...], bool],
) -> tuple[Recording, SessionTruth]:
    """Drive, listen to the encoders and look around, once."""
    shut_rooms, wing_shut = doors
    jitter = _rng(seed, _Stream.ROUTE, row).uniform(-0.15, 0.15, (len(plan.rooms), 4))
    closed = {*shut_rooms, *(plan.wing if wing_shut else ())}
    within_reach = set(range(len(plan.rooms))) - closed
    # a patrol that would pass by all rooms visits those that it can
    visited = (within_reach - patrol.passed_by) or within_reach
    route = patrol_route(
        plan,
        reverse=patrol.reverse,
        jitter_m=jitter,
        skip=set(range(len(plan.rooms))) - visited,
        wing_shut=wing_shut,
        start=patrol.start,
    )
    path = drive(route, config.drive, start_s, patrol.length_s, _rng(seed, _Stream.DRIVE, row))
    odometry = report_odometry(path, config.odometry, _rng(seed, _Stream.ODOMETRY, row))
    # the camera runs on its own beat, a fraction of a period after the encoders
    passed_s = (np.arange(int(patrol.length_s * config.sensor.rate_hz) + 1) + 0.37) / config.sensor.rate_hz
    frame_s = start_s + passed_s[start_s + passed_s <= odometry.stamp_s[-1]]
    pose = path.pose_at(frame_s)
    sight = plan.shut(shut_rooms, wing=wing_shut)
    detections, true_ids = detect(pose, scene, sight, config.sensor, _sequence(seed, _Stream.SENSOR, row))
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
    mounted = se2.compose(pose, np.array(config.sensor.mount_robot_sensor))
    return recording, SessionTruth(
        day, start_s, float(path.stamp_s[-1]), true_ids, mounted, shut_rooms=shut_rooms, wing_shut=wing_shut
    )


def _timeline(config: BuildingConfig, lengths_s: list[float], rng: np.random.Generator) -> Timeline:
    """Sessions spread over the working hours of every day, each somewhere in the first third of its share."""
    share_s = 10 * 3600.0 / config.sessions_per_day
    longest_s = config.longest_patrol_s
    late_s = rng.random((config.days, config.sessions_per_day)) * min(share_s / 3, share_s - longest_s - 1.0)
    clock_s = 8 * 3600.0 + np.arange(config.sessions_per_day) * share_s + late_s
    start_s = np.floor(config.first_day_unix_s + np.arange(config.days)[:, None] * DAY_S + clock_s).ravel()
    sessions_s = np.stack([start_s, start_s + np.array(lengths_s) + 1.0], axis=1)
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
