"""The live engine: `Engine` takes readings as they arrive, and returns causal estimates.

In a map the localiser of `run_localization` says where the robot is, in an unmapped place the stream of a
session; both frame by frame, as over a recording. What was driven is entered by `run_session`, in a process of its own
while the robot drives on, and the engine goes on in the map that comes of it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from evermap.compiled import single_threaded
from evermap.config import Config
from evermap.errors import ConfigError, InputError
from evermap.geometry import se3
from evermap.geometry.group import PLANE, SPACE, Group
from evermap.geometry.symmetry import Symmetry
from evermap.live.inbox import Inbox, LiveFrame, recording_of
from evermap.live.judge import Judge, warm_up
from evermap.live.keeper import Keeper, News
from evermap.live.spatial_inbox import SpatialInbox, detections_of
from evermap.maps.living import LivingMap
from evermap.maps.sessions.believe import aged
from evermap.runs.sessions import Entered
from evermap.slam.calibration import DELAY
from evermap.slam.intake import beliefs
from evermap.slam.known_places import FrameSightings, KnownPlaces
from evermap.slam.localize import BaseLocalizer, Localizer, Located
from evermap.slam.localize_recording import warm_up_in_space
from evermap.slam.mapper import Mapper
from evermap.slam.problem import Drive
from evermap.slam.space.intake import frames_of, start_noise, state_sigmas
from evermap.slam.space.localize import SpatialLocalizer, SpatialPlaces
from evermap.slam.space.mapper import SpatialMapper
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.types import (
    UNKNOWN,
    Clock,
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    MapChange,
    Sensor,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    is_in_space,
    rows_of,
)
from evermap.valid import check_rig, check_sensor

Numbers = Sequence[float] | FloatArray


@dataclass(frozen=True, slots=True)
class Now:
    """Present state of the robot and its map.

    Attributes:
        stamp_s: of the newest odometry; nan before any.
        pose_world_robot: (3,) there, in space (7,); nan while it is not known.
        covariance: (3, 3) of it, in the robot's frame; in space (6, 6).
        frame: 'prior_map', or 'first_pose' where there is no map yet.
        lost: the pose is not known, or kept by odometry alone while it is searched for.
        online: poses of the frames that this step has processed.
        in_view: landmarks that are in view, or should be, with the probability that each exists.
        changes: what has become certain since the last step.
        revision: newest one of the map that the robot is in; 0 before any.
        warnings: what else there is to tell since the last step.
    """

    stamp_s: float
    pose_world_robot: FloatArray
    covariance: FloatArray
    frame: str
    lost: bool
    online: Trajectory
    in_view: Landmarks
    changes: tuple[MapChange, ...] = ()
    revision: int = 0
    warnings: tuple[str, ...] = ()


class Engine:
    """Feed readings with `odometry` and `detections`, from any thread, and call `step` for estimates.

    With sensors in space it is fed with `odometry_in_space` and `detections_in_space`.

    As a context manager it enters the drive when the block ends; after an error or a crash the next engine does.

    Args:
        map: file of a living map, made where there is none; or a map in memory, which stays as it is.
        sensor: what sees landmarks, or a `sensor.toml`, which may name clock and classes, too; a `SpatialSensor`, or
            several of them, in space.
        config: settings; None for the defaults.
        mapping: False only localises; see `mapping`.
        clock: what stamps count.
        class_names: of landmarks; others are added as they come.
        name: of the session.
        beside: False does in `step` itself what else is done beside it; for tests and replays.
        symmetries: in space turns after which landmarks look the same, as of `SpatialRecording`.

    Raises:
        InputError: no map, or no sensor.
        ConfigError: another process feeds the map.
    """

    def __init__(
        self,
        map: str | Path | LivingMap,  # noqa: A002 (the word that callers expect)
        sensor: Sensor | SpatialSensor | Sequence[SpatialSensor] | str | Path,
        config: Config | None = None,
        *,
        mapping: bool = True,
        clock: Clock = Clock.UNIX,
        class_names: Sequence[str] = (),
        name: str = "live",
        beside: bool = True,
        symmetries: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        self._config = config or Config()
        if self._config.slam.unknown_ids:
            problem = "association of landmarks without identity needs later detections"
            raise ConfigError(problem, field="slam.unknown_ids", hint="a recording: evermap slam --unknown-ids")
        recording = recording_of(sensor, name, clock, tuple(class_names))
        self._rig: SpatialRecording | None = None
        """Sensors and classes in space, without readings; None in the plane."""
        self._sensor: Sensor | tuple[SpatialSensor, ...]
        if is_in_space(recording):
            self._sensor = self._config.sensor.apply_in_space(recording.sensors)
            self._rig = replace(recording, sensors=self._sensor, symmetries=symmetries or {})
            check_rig(self._sensor)
            self._inbox: Inbox = SpatialInbox(self._rig, self._config)
        else:
            self._sensor = self._config.sensor.apply_to(recording.sensor)
            check_sensor(self._sensor)
            self._inbox = Inbox(recording, self._config)
        self._group = PLANE if self._rig is None else SPACE
        self._lock, self._told = threading.RLock(), News()
        path = None if isinstance(map, LivingMap) else Path(map)
        self._keeper = Keeper(path, self._config, self._inbox, self._told, threads=beside)
        self._filter: Localizer | Mapper | SpatialLocalizer | SpatialMapper | None = None
        self._judge: Judge | None = None
        self._table = Landmarks.at([], np.zeros((0, 2)))
        self._located: Located | None = None
        self._last: LiveFrame | None = None
        self._online: list[tuple[float, FloatArray, FloatArray]] = []
        self._session_s = self._judged_s = -math.inf
        self._met: set[int] = set()
        self._in_view = Landmarks.at([], np.zeros((0, 2)), frame="first_pose")
        if self._rig is not None:
            self._in_view = Landmarks.in_space([], np.zeros((0, 3)))
        self._mapping, dim = mapping, self._group.point_dim
        given = map if isinstance(map, LivingMap) else None
        self._living = self._keeper.begin(given, recording.clock, dim=dim, mapping=mapping)

    @property
    def mapping(self) -> bool:
        """Whether the drive enters the map. It may be set at any time; the drive until then is entered."""
        return self._mapping

    @mapping.setter
    def mapping(self, mapping: bool) -> None:
        with self._lock:
            if mapping and not self._mapping:
                self._keeper.feed()
                self._inbox.cut(self._inbox.name)
            elif self._mapping and not mapping:
                self._keeper.end_session()
            self._mapping, self._session_s = mapping, self._inbox.settled_s
            if isinstance(self._filter, BaseLocalizer):
                self._filter.learn = mapping

    @property
    def living(self) -> LivingMap:
        """The stored map that the robot is in."""
        return self._living

    @property
    def sensor(self) -> Sensor | tuple[SpatialSensor, ...]:
        """The sensor of landmarks; in space all of them."""
        return self._sensor

    @property
    def late(self) -> int:
        """Readings that were refused because they came too late."""
        return self._inbox.n_late

    @property
    def n_bytes(self) -> int:
        """Memory of the readings that are kept, about."""
        return self._inbox.n_bytes

    def odometry(
        self,
        stamp_s: float,
        forward_mps: float,
        lateral_mps: float = 0.0,
        angular_radps: float = 0.0,
        until_s: float = -math.inf,
    ) -> None:
        """Take velocities, which hold until the next ones.

        Args:
            stamp_s: from when on they hold.
            forward_mps: along the robot.
            lateral_mps: to its left.
            angular_radps: its turn, counter-clockwise.
            until_s: until when they are known to hold, as between two poses; where only the next ones tell, leave out.

        Raises:
            InputError: no finite numbers, or so late that frames after it are processed; the sensors are in space.
        """
        self._refuse_of(SPACE, "odometry_in_space")
        self._inbox.odometry(stamp_s, (forward_mps, lateral_mps, angular_radps), until_s)

    def detections(
        self,
        stamp_s: float,
        landmark_id: Sequence[int | str] | IntArray = (),
        range_m: Numbers = (),
        bearing_rad: Numbers = (),
        *,
        class_name: Sequence[str | None] | None = None,
        sigma_range_m: Numbers | None = None,
        sigma_bearing_rad: Numbers | None = None,
    ) -> None:
        """Take the detections of a frame; also call it for a frame without any: expected landmarks are misses.

        Args:
            stamp_s: when it looked.
            landmark_id: (M,) detected landmarks, as numbers or texts; -1 for unknown.
            range_m: (M,) distances from the sensor.
            bearing_rad: (M,) counter-clockwise from where it looks.
            class_name: (M,) classes, None for unknown ones.
            sigma_range_m: (M,) standard deviations of these very detections, nan where unknown.
            sigma_bearing_rad: (M,) the same.

        Raises:
            InputError: values that cannot be, or so late that frames after it are processed; the sensors are in space.
        """
        self._refuse_of(SPACE, "detections_in_space")
        columns = landmark_id, range_m, bearing_rad, class_name, sigma_range_m, sigma_bearing_rad
        self._inbox.detections(stamp_s, columns)

    def odometry_in_space(self, stamp_s: float, pose: Numbers | None = None, *, twist: Numbers | None = None) -> None:
        """Take a pose of the odometry, in a frame that drifts; or velocities, which hold until the next ones.

        Args:
            stamp_s: of the pose, or from when on the velocities hold.
            pose: (7,) x, y, z, qx, qy, qz, qw.
            twist: (6,) along x, y, z of the robot [m/s], and about them [rad/s]; in the order of their stamps.

        Raises:
            InputError: neither, both, or values that cannot be; too late; the sensor is in the plane.
        """
        self._refuse_of(PLANE, "odometry")
        assert isinstance(self._inbox, SpatialInbox)
        if (pose is None) == (twist is None):
            raise InputError("a pose or a twist is needed", field="pose", hint="one of the two")
        if pose is not None:
            self._inbox.pose(stamp_s, pose)
        else:
            self._inbox.twist(stamp_s, twist)

    def detections_in_space(
        self,
        stamp_s: float,
        landmark_id: Sequence[int | str] | IntArray = (),
        position_sensor_m: FloatArray | None = None,
        *,
        rotation: FloatArray | None = None,
        corner_px: FloatArray | None = None,
        tag_size_m: Numbers | None = None,
        covariance_sensor_m2: FloatArray | None = None,
        sigma_rad: Numbers | None = None,
        sensor: int | Sequence[int] | IntArray = 0,
        class_name: Sequence[str | None] | None = None,
    ) -> None:
        """Take the detections of a frame: points, landmarks with an orientation, or corners of square tags.

        Args:
            stamp_s: when it looked.
            landmark_id: (M,) detected landmarks, as numbers or texts; -1 for unknown.
            position_sensor_m: (M, 3) in the frame of the sensor; nan of tags by their corners.
            rotation: (M, 4) quaternions of landmarks there; nan of points.
            corner_px: (M, 4, 2) corners of tags in the image, as of `SpatialDetections`.
            tag_size_m: (M,) edges of these.
            covariance_sensor_m2: (M, 3, 3) of positions.
            sigma_rad: (M,) of orientations.
            sensor: (M,) which of the sensors.
            class_name: (M,) classes, None for unknown ones.

        Raises:
            InputError: values that cannot be; so late that frames after it are processed; the sensor is in the plane.
        """
        self._refuse_of(PLANE, "detections")
        given = {
            "position_sensor_m": position_sensor_m, "rotation": rotation, "corner_px": corner_px,
            "tag_size_m": tag_size_m, "covariance_sensor_m2": covariance_sensor_m2, "sigma_rad": sigma_rad,
        }  # fmt: skip
        self._inbox.detections(stamp_s, (landmark_id, class_name, sensor, given))

    @single_threaded()
    def step(self) -> Now:
        """Process new readings, and return the present estimates; without new readings in some microseconds."""
        with self._lock:
            if self._keeper.collect():
                self._keeper.beside("load", self._go_on)
            is_delayed = isinstance(self._filter, Localizer | Mapper)
            ready = self._inbox.ready(float(self._filter.states[DELAY]) if is_delayed else 0.0)  # type: ignore[union-attr]
            for frame, odometry, kept in ready:
                self._process(frame, odometry, kept=kept)
            if isinstance(self._filter, Mapper) and not any(kept for *_, kept in ready):
                self._filter.work()
            if ready:
                self._keep_house()
            if self._judge is not None:
                if not self._mapping:  # no revision will report these
                    self._told.known.clear()
                self._told.add(self._judge.told())
            return self._now()

    def landmarks(
        self, *, at: float | None = None, within: tuple[float, float, float, float] | None = None
    ) -> Landmarks:
        """Return the landmarks of the map with their present beliefs, or at a later stamp.

        Args:
            at: stamp for which the probabilities are asked.
            within: leave out what lies outside of this box `(x_min, y_min, x_max, y_max)`.
        """
        with self._lock:
            living, judge = self._living, self._judge
        return (living if judge is None else judge.living).landmarks(at=at, within=within)

    @single_threaded()
    def warm_up(self) -> None:
        """Compile the kernels, or load them, so that no step has to wait for it."""
        se3.warm_up()
        if self._rig is not None:
            warm_up_in_space()
        else:
            warm_up(self._config)

    @single_threaded()
    def save(self) -> Entered | None:
        """Enter the drive so far as a revision, and continue in that map.

        Returns:
            The entered session; None if nothing was entered, which is a warning of the next step.

        Raises:
            InputError: the map is in memory.
        """
        file = self._keeper.file
        with self._lock:
            for frame, odometry, kept in self._inbox.ready(0.0, everything=True):
                self._process(frame, odometry, kept=kept)
            self._keeper.end_session()
            self._keeper.wait(self._lock)
            entered = self._keeper.enter(file)
            self._session_s = self._inbox.settled_s
            self._go_on()
            return entered

    def close(self) -> None:
        """End without entering the drive since the last revision; the next engine of the map does."""
        with self._lock:
            self._keeper.wait(self._lock)
            self._keeper.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None and self._mapping:
                self.save()
        finally:
            self.close()

    def _process(self, frame: LiveFrame, odometry: FloatArray, *, kept: bool) -> None:
        """Process a frame by the filter; before any odometry it has no effect."""
        if frame.stamp_s < self._inbox.first_s or not len(odometry):
            return
        if self._filter is None:
            self._begin(frame.stamp_s)
        if not self._session_s > -math.inf:
            self._session_s = self._judged_s = frame.stamp_s
        seen, since_s = self._sightings(frame), frame.stamp_s - self._inbox.first_s
        if isinstance(self._filter, Mapper):
            driven = odometry - [self._inbox.first_s, 0.0, 0.0, 0.0]
            if not kept:
                self._filter.skip(driven)
                return
            located = self._filter.step(since_s, driven, seen)
        else:
            assert self._filter is not None
            located = self._filter.step(since_s, self._drive_of(odometry), seen)
        self._located, self._last = located, frame
        if isinstance(self._filter, BaseLocalizer):
            self._met.update(frame.landmark_id[located.p_inlier > 0.5].tolist())
        else:
            self._in_view = self._filter.landmarks(frame.landmark_id, self._config.living.decisions.new_clique_p)
        self._online.append((frame.stamp_s, located.pose, located.covariance))
        if self._judge is not None:
            self._judge.look(frame, located, self._filter.states)
            self._in_view = self._judge.in_view(located)
        elif isinstance(self._filter, SpatialLocalizer):
            seen_there = np.unique(frame.landmark_id[located.place != UNKNOWN])
            self._in_view = rows_of(self._table, np.isin(self._table.landmark_id, seen_there))

    def _refuse_of(self, group: Group, instead: str) -> None:
        """Refuse readings of another group than the sensor's."""
        if self._group is group:
            problem = f"the sensor is in {'space' if group is SPACE else 'the plane'}"
            raise InputError(problem, field="sensor", hint=f"Engine.{instead}")

    def _sightings(self, frame: LiveFrame) -> Any:
        """Return the detections of a frame as the filter reads them."""
        rows = frame.rows
        if self._rig is None:
            return FrameSightings(frame.landmark_id, rows[:, 1:3].copy(), rows[:, 4:6].copy())
        names, detections = self._inbox.class_names, detections_of(rows, np.zeros(len(rows), dtype=np.int64))
        look = Frames(np.array([frame.stamp_s]), clock=self._rig.clock)
        recording = replace(self._rig, frames=look, detections=detections, class_names=names)
        return frames_of(recording, self._config.slam.space)[0]

    def _drive_of(self, odometry: FloatArray) -> Any:
        """Return odometry, from the first one on, as the filter reads it."""
        stamp_s = odometry[:, 0] - self._inbox.first_s
        if self._rig is None:
            return Drive.from_rows(stamp_s, odometry[:, 1:], self._config.slam.odometry)
        return OdometryPath(stamp_s, odometry[:, 1:])

    def _begin(self, stamp_s: float) -> None:
        """Choose the filter: in a map the robot is localised, a place without one is mapped."""
        self._living = self._living.from_now_on(stamp_s)
        if len(self._living.places):
            places = self._places(self._living, stamp_s)
            self._filter = self._localizer(places, learn=self._mapping)
            self._judge, self._table = self._judge_of(self._living, places), self._living.landmarks()
        elif self._rig is not None:
            mount, sigma, level, symmetries = self._beliefs_in_space()
            self._filter = SpatialMapper(mount, sigma, level, symmetries, self._config.slam.space)
        else:
            assert isinstance(self._sensor, Sensor)
            self._filter = Mapper(self._sensor, *beliefs(self._sensor, self._config.slam), self._config.slam)

    def _judge_of(self, living: LivingMap, places: KnownPlaces, before: Judge | None = None) -> Judge | None:
        """Return what asks for changes during the drive; None in space, where detection is learned from a session."""
        if not isinstance(self._sensor, Sensor):
            return None
        return Judge(living, places, self._sensor, self._config, before)

    def _beliefs_in_space(self) -> tuple[FloatArray, FloatArray, SpatialNoise, tuple[Symmetry, ...]]:
        """Return mounts, deviations of states, noise and symmetries in space."""
        assert self._rig is not None
        settings, sensors = self._config.slam.space, self._rig.sensors
        mount = np.array([one.mount_robot_sensor for one in sensors])
        symmetries = (Symmetry(), *(Symmetry.generate_group(texts) for texts in self._rig.symmetries.values()))
        return mount, state_sigmas(sensors, settings, driven=True), start_noise(settings, driven=True), symmetries

    def _localizer(self, places: Any, *, learn: bool) -> Localizer | SpatialLocalizer:
        if not isinstance(self._sensor, Sensor):
            mount, sigma, level, symmetries = self._beliefs_in_space()
            return SpatialLocalizer(
                places, mount, sigma, level, driven=True, symmetries=symmetries, settings=self._config.slam.localize,
                space=self._config.slam.space, learn=learn,
            )  # fmt: skip
        settings, looks = self._config.slam, self._config.living.looks
        prior, noise = beliefs(self._sensor, settings)
        prior = prior.gaussian()
        return Localizer(places, self._sensor, prior, noise, settings=settings.localize, looks=looks, learn=learn)

    def _places(self, living: LivingMap, stamp_s: float) -> KnownPlaces:
        rows = living.list_sighted(aged(living, self._config.living, stamp_s).p_here)
        if self._rig is not None:
            return SpatialPlaces.in_space(rows, living.covariance_m2, self._config.slam.space)
        return KnownPlaces.of(rows.landmark_id, rows.position_m, living.covariance_m2, rows.p_exists).existing()

    def _keep_house(self) -> None:
        """Do periodic work: a revision, readings to the disk, an update of changes."""
        live, now_s = self._config.live, self._inbox.settled_s
        if not self._mapping:
            if now_s - self._session_s >= live.idle_s:
                self._inbox.cut(self._inbox.name)
                self._session_s = now_s
        elif 0.0 < live.revision_s <= now_s - self._session_s and self._can_be_found:
            self._keeper.end_session()
            self._session_s = now_s
            self._met.clear()
        else:
            self._keeper.write_if_due()
        if self._keeper.enter_if_waiting():
            self._go_on()
        if self._judge is not None and now_s - self._judged_s >= max(live.judge_s, self._judge.rest_s):
            self._judged_s = now_s
            self._keeper.beside("judge", self._judge.judge)

    @property
    def _can_be_found(self) -> bool:
        """Return whether the session so far shows enough of the map to be entered; an exploring one continues."""
        return (
            len(self._met) >= self._config.slam.localize.enough
            if isinstance(self._filter, BaseLocalizer)
            else self._keeper.n_sessions == 1
        )

    def _go_on(self) -> None:
        """Go on in the newest map, from where the robot is."""
        before = self._filter
        living, changes = self._keeper.load(create=True)
        if before is None or not len(living.places):
            self._living = living
            return
        places = self._places(living, self._inbox.settled_s)
        judge = self._judge_of(living, places, self._judge)
        with self._lock:
            self._told.add([*(self._judge.told() if self._judge is not None else ()), *changes])
            self._told.known.clear()
            if isinstance(before, SpatialLocalizer):
                assert isinstance(places, SpatialPlaces)
                self._filter = before.over(places)
            elif isinstance(before, Localizer):
                assert isinstance(self._sensor, Sensor)
                self._filter = before.over(places, self._sensor)
            else:
                self._filter = self._localizer(places, learn=True)
                if (here := self._located) is not None and self._last is not None and np.isfinite(here.pose[0]):
                    self._filter.place_at(self._last.stamp_s - self._inbox.first_s, here.pose, here.covariance)
            self._living, self._judge, self._table = living, judge, living.landmarks()

    def _now(self) -> Now:
        stamp_s, located, filter_ = self._inbox.odometry_s, self._located, self._filter
        in_map = not isinstance(filter_, Mapper | SpatialMapper)
        frame, dim = "prior_map" if in_map else "first_pose", self._group.dim
        pose, covariance = np.full(self._group.size, math.nan), np.full((dim, dim), math.nan)
        if located is not None and filter_ is not None and self._last is not None:
            pose, covariance = located.pose, located.covariance
            if stamp_s > self._last.stamp_s:
                drive = self._drive_of(self._inbox.window())
                pose, covariance = filter_.ahead(stamp_s - self._inbox.first_s, drive)
        online, self._online = self._online, []
        changes, warnings = self._told.taken()
        return Now(
            stamp_s=stamp_s if math.isfinite(stamp_s) else math.nan,
            pose_world_robot=pose,
            covariance=covariance,
            frame=frame,
            lost=located is None or located.lost or bool(np.isnan(pose[0])),
            online=_trajectory_of(online, self._group, frame, self._living.clock),
            in_view=self._in_view,
            changes=changes,
            revision=self._keeper.revision,
            warnings=warnings,
        )


def _trajectory_of(
    online: list[tuple[float, FloatArray, FloatArray]], group: Group, frame: str, clock: Clock
) -> Trajectory:
    """Return the poses that are known, of stamps, poses and covariances."""
    known = [one for one in online if math.isfinite(one[1][0])]
    stamps, poses, spread = zip(*known, strict=True) if known else ((), (), ())
    pose, covariance = np.array(poses).reshape(-1, group.size), np.array(spread).reshape(-1, group.dim, group.dim)
    return Trajectory(np.array(stamps), pose, covariance, frame, clock)
