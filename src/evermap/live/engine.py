"""The engine of a robot that drives: `Engine` takes readings as they come, and tells what the robot may know by then.

In a map the localiser of `run_localization` says where the robot is, in a place that nobody knows the stream of a
session; both frame by frame, as over a recording. What was driven is entered by `run_session`, in a process of its own
while the robot drives on, and the engine goes on in the map that comes of it.
"""

from __future__ import annotations

import json
import math
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from evermap.config import Config
from evermap.errors import ConfigError, EvermapError, InputError
from evermap.live.inbox import Frame, Inbox, about
from evermap.live.judge import Judge
from evermap.live.spool import Brought, Spool, enter_waiting
from evermap.maps.living import LivingMap
from evermap.maps.sessions.believe import aged
from evermap.maps.store import open_store
from evermap.runs.sessions import Entered
from evermap.slam.intake import beliefs
from evermap.slam.known_places import KnownPlaces
from evermap.slam.localize import FrameSightings, Localizer, Located
from evermap.slam.mapper import Mapper
from evermap.slam.problem import Drive
from evermap.types import Clock, FloatArray, Landmarks, MapChange, Recording, Sensor, Trajectory
from evermap.valid import check_sensor

IDLE_S = 60.0
"""Odometry that is kept where nothing is mapped, at least."""


@dataclass(frozen=True, slots=True)
class Now:
    """What the robot knows.

    Attributes:
        stamp_s: of the newest odometry; nan before any.
        pose_world_robot: (3,) there; nan while it is not known.
        covariance: (3, 3) of it, in the robot's frame.
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


@dataclass
class _Told:
    """What the next step tells."""

    changes: list[MapChange] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    known: set[tuple[Any, ...]] = field(default_factory=set)

    def add(self, changes: Sequence[MapChange]) -> None:
        """Add changes that were not told."""
        for change in changes:
            if (key := (change.kind, change.landmark_ids)) not in self.known:
                self.known.add(key)
                self.changes.append(change)


class Engine:
    """Feed readings with `odometry` and `detections`, from any thread, and ask with `step`.

    As a context manager it enters what was driven when the block ends; where that ends by an error, and after a crash,
    what was driven is entered by the next engine of the map.

    Args:
        map: file of a living map, made where there is none; or a map in memory, which stays as it is.
        sensor: what sees landmarks, or a `sensor.toml`, which may name clock and classes, too.
        config: settings; None for the defaults.
        mapping: False only localises; see `mapping`.
        clock: what stamps count.
        class_names: of landmarks; others are added as they come.
        name: of the session.
        beside: False does in `step` itself what else is done beside it; for tests and replays.

    Raises:
        InputError: no map, or no sensor.
        ConfigError: another process feeds the map.
    """

    def __init__(
        self,
        map: str | Path | LivingMap,  # noqa: A002 (the word that callers expect)
        sensor: Sensor | str | Path,
        config: Config | None = None,
        *,
        mapping: bool = True,
        clock: Clock = Clock.UNIX,
        class_names: Sequence[str] = (),
        name: str = "live",
        beside: bool = True,
    ) -> None:
        self._config = config or Config()
        if self._config.slam.unknown_ids:
            problem = "landmarks without identity are told by what is seen later"
            raise ConfigError(problem, field="slam.unknown_ids", hint="a recording: evermap slam --unknown-ids")
        recording = _about(sensor, name, clock, tuple(class_names))
        self._sensor = self._config.sensor.applied_to(recording.sensor)
        check_sensor(self._sensor)
        self._name, self._n_sessions = recording.name, 1
        live = self._config.live
        self._inbox = Inbox(recording, live.reorder_s, live.readings_hz)
        self._step_lock, self._told = threading.RLock(), _Told()
        self._pool = ThreadPoolExecutor(2, "evermap-live") if beside else None
        self._jobs: dict[str, Future[None]] = {}
        self._child: subprocess.Popen[str] | None = None
        self._tried: list[Path] = []
        self._filter: Localizer | Mapper | None = None
        self._judge: Judge | None = None
        self._located: Located | None = None
        self._last: Frame | None = None
        self._online: list[tuple[float, FloatArray, FloatArray]] = []
        self._session_s = self._judged_s = -math.inf
        self._written_s, self._revision = time.monotonic(), 0
        self._spool: Spool | None = None
        self._path = None if isinstance(map, LivingMap) else Path(map)
        if self._path is None:
            if mapping:
                raise InputError("a map in memory stays as it is", field="mapping", hint="a file, or mapping=False")
            assert isinstance(map, LivingMap)
            self._living = map
            self._mapping = False
        else:
            self._mapping = mapping
            if mapping:
                self._open_spool()
            self._living, _ = self._load(create=mapping)

    @property
    def mapping(self) -> bool:
        """Whether what is driven enters the map. It may be set at any time; what was driven until then is entered."""
        return self._mapping

    @mapping.setter
    def mapping(self, mapping: bool) -> None:
        with self._step_lock:
            if mapping == self._mapping:
                return
            if mapping and self._path is None:
                raise InputError("a map in memory stays as it is", field="mapping", hint="an engine of a file")
            if mapping:
                self._open_spool()
                self._inbox.cut(self._named())
            else:
                self._finish_session()
            self._mapping, self._session_s = mapping, self._inbox.settled_s

    @property
    def living(self) -> LivingMap:
        """The map that the robot is in, as it is stored."""
        return self._living

    @property
    def late(self) -> int:
        """Readings that were refused because they came too late."""
        return self._inbox.n_late

    @property
    def n_bytes(self) -> int:
        """Memory of the readings that wait to enter the map, about."""
        return self._inbox.n_bytes

    def odometry(
        self, stamp_s: float, forward_mps: float, lateral_mps: float = 0.0, angular_radps: float = 0.0
    ) -> None:
        """Take velocities, which hold until the next ones.

        Raises:
            InputError: no finite numbers, or so late that frames after it are processed.
        """
        self._inbox.odometry(stamp_s, (forward_mps, lateral_mps, angular_radps))

    def detections(
        self,
        stamp_s: float,
        landmark_id: Sequence[int | str] = (),
        range_m: Sequence[float] = (),
        bearing_rad: Sequence[float] = (),
        *,
        class_name: Sequence[str | None] | None = None,
        sigma_range_m: Sequence[float] | None = None,
        sigma_bearing_rad: Sequence[float] | None = None,
    ) -> None:
        """Take what the sensor saw in a frame. A frame in which it saw nothing is one, too: what was expected is missed.

        Args:
            stamp_s: when it looked.
            landmark_id: (M,) what was seen, as numbers or texts; -1 for unknown.
            range_m: (M,) distances from the sensor.
            bearing_rad: (M,) counter-clockwise from where it looks.
            class_name: (M,) classes, None for unknown ones.
            sigma_range_m: (M,) standard deviations of these very detections, nan where unknown.
            sigma_bearing_rad: (M,) the same.

        Raises:
            InputError: values that cannot be, or so late that frames after it are processed.
        """
        self._inbox.detections(
            stamp_s, (landmark_id, range_m, bearing_rad, class_name, sigma_range_m, sigma_bearing_rad)
        )

    def step(self) -> Now:
        """Process what has come, and tell what the robot knows by now; without anything new in some microseconds."""
        return self._step(everything=False)

    def landmarks(
        self, *, at: float | None = None, within: tuple[float, float, float, float] | None = None
    ) -> Landmarks:
        """Return the landmarks of the map as they are believed in by now, or at a later stamp.

        Args:
            at: stamp for which the probabilities are asked.
            within: leave out what lies outside of this box `(x_min, y_min, x_max, y_max)`.
        """
        with self._step_lock:
            living = self._living if self._judge is None else self._judge.living
        return living.landmarks(at=at, within=within)

    def warm_up(self) -> None:
        """Compile the kernels, or load them, so that no step has to wait for it."""
        from evermap.live.judge import warm_up

        warm_up(self._config)

    def save(self) -> Entered | None:
        """Enter what was driven as a revision, and go on in the map that comes of it.

        Returns:
            What it made of the map; None where there was nothing to enter, or it could not be localised in the map:
            that is a warning of the next step.

        Raises:
            InputError: the map is in memory.
        """
        if self._path is None:
            raise InputError("a map in memory stays as it is", field="map", hint="an engine of a file")
        with self._step_lock:
            self._told.warnings.extend(self._step(everything=True).warnings)
            self._finish_session()
            self._wait()
            entered = None
            for brought in enter_waiting(self._path):
                self._take(brought)
                entered = brought.entered or entered
            self._go_on()
            return entered

    def close(self) -> None:
        """End without entering what was driven since the last time; the next engine of the map does."""
        with self._step_lock:
            if self._spool is not None:
                self._write(last=True)
            self._wait()
            if self._pool is not None:
                self._pool.shutdown()
            if self._spool is not None:
                self._spool.close()
                self._spool = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Any, trace: TracebackType | None) -> None:
        try:
            if kind is None and self._mapping:
                self.save()
        finally:
            self.close()

    def _step(self, *, everything: bool) -> Now:
        with self._step_lock:
            self._listen()
            done = 0
            for frame, odometry, kept in self._inbox.ready(self._delay_s(), everything=everything):
                if frame.stamp_s >= self._inbox.first_s and len(odometry):
                    self._process(frame, odometry, kept=kept)
                    done += 1
            if done:
                self._keep_house()
            return self._now()

    def _process(self, frame: Frame, odometry: FloatArray, *, kept: bool) -> None:
        """A frame through the filter."""
        if self._filter is None:
            self._begin(frame.stamp_s)
        if not self._session_s > -math.inf:
            self._session_s = self._judged_s = frame.stamp_s
        rows, start_s = frame.rows, self._inbox.first_s
        seen = FrameSightings(frame.landmark_id, rows[:, 1:3].copy(), rows[:, 4:6].copy())
        if isinstance(self._filter, Localizer):
            drive = Drive.from_rows(odometry[:, 0] - start_s, odometry[:, 1:])
            located = self._filter.step(frame.stamp_s - start_s, drive, seen)
        else:
            assert self._filter is not None
            driven = odometry - [start_s, 0.0, 0.0, 0.0]
            if not kept:
                self._filter.drive(driven)
                return
            located = self._filter.step(frame.stamp_s - start_s, driven, seen)
        self._located, self._last = located, frame
        self._online.append((frame.stamp_s, located.pose, located.covariance))
        if self._judge is not None:
            self._judge.look(frame, located, self._filter.states)

    def _begin(self, stamp_s: float) -> None:
        """Choose the filter: in a map the robot is localised, a place without one is mapped."""
        self._living = self._living.from_now_on(stamp_s)
        prior, noise = beliefs(self._sensor, self._config.slam)
        if len(self._living.places):
            places = self._places(self._living, stamp_s)
            self._filter = Localizer(places, self._sensor, prior, noise)
            self._judge = Judge(self._living, places, self._sensor, self._config)
        else:
            self._filter = Mapper(self._sensor, prior, noise, self._config.slam)

    def _places(self, living: LivingMap, stamp_s: float) -> KnownPlaces:
        rows = living.sighted_rows(aged(living, self._config.living, stamp_s).p_here)
        return KnownPlaces.of(rows.landmark_id, rows.position_m, living.covariance_m2, rows.p_exists).existing()

    def _delay_s(self) -> float:
        return 0.0 if self._filter is None else float(self._filter.states[5])

    def _keep_house(self) -> None:
        """What is due: a revision, the readings on the disk, what has changed."""
        live, now_s = self._config.live, self._inbox.settled_s
        if self._mapping:
            if 0.0 < live.revision_s <= now_s - self._session_s and len(self._inbox):
                self._finish_session()
                self._session_s = now_s
            elif time.monotonic() >= self._written_s + live.checkpoint_s:
                self._written_s = time.monotonic()
                self._beside("write", self._write)
            waiting = [] if self._spool is None or self._child is not None else self._spool.waiting()
            if waiting and waiting != self._tried:
                self._tried = waiting
                self._enter_beside()
        elif now_s - self._session_s >= IDLE_S:
            self._inbox.cut(self._name)
            self._session_s = now_s
        if self._judge is not None and now_s - self._judged_s >= live.judge_s:
            self._judged_s = now_s
            self._beside("judge", self._judge.judge)

    def _beside(self, name: str, job: Callable[[], None]) -> None:
        """Do something beside the steps, unless it is still being done."""
        before = self._jobs.get(name)
        if self._pool is None:
            job()
        elif before is None or before.done():
            self._jobs[name] = self._pool.submit(job)

    def _write(self, *, last: bool = False) -> None:
        if self._spool is not None:
            part = self._inbox.written(last=last)
            if len(part.odometry) or len(part.frames):
                self._spool.write(part)

    def _finish_session(self) -> None:
        """End the session of the readings so far: it waits to be entered."""
        if self._spool is None or not len(self._inbox):
            return
        if "write" in self._jobs:
            self._jobs.pop("write").result()
        self._write(last=True)
        self._spool.finish()
        self._n_sessions += 1
        self._inbox.cut(self._named())

    def _named(self) -> str:
        return self._name if self._n_sessions == 1 else f"{self._name} {self._n_sessions}"

    def _open_spool(self) -> None:
        """Feed the map from here on; what a process that was killed has left is entered first."""
        assert self._path is not None
        if self._spool is None:
            self._spool = Spool(self._path)
            for brought in enter_waiting(self._path):
                self._told.warnings.append(f"recovered: {brought.name}")
                self._take(brought)
            self._spool.settle(self._config)

    def _enter_beside(self) -> None:
        assert self._spool is not None
        if self._pool is not None:
            self._child = self._spool.enter_beside()
            return
        for brought in enter_waiting(self._spool.map_file):
            self._take(brought)
        self._go_on()

    def _listen(self) -> None:
        """Take what was done beside the steps."""
        for name, job in list(self._jobs.items()):
            if job.done():
                del self._jobs[name]
                if (error := job.exception()) is not None:
                    if not isinstance(error, EvermapError | OSError):
                        raise error
                    self._told.warnings.append(f"{name}: {error}")
        if self._judge is not None:
            if not self._mapping:
                self._told.known.clear()
            self._told.add(self._judge.told())
        if self._child is not None and self._child.poll() is not None:
            child, self._child = self._child, None
            told = [] if child.stdout is None else child.stdout.read().splitlines()
            for line in told:
                self._take(Brought(**json.loads(line)))
            if child.returncode:
                self._told.warnings.append(f"entering a session ended with code {child.returncode}; it waits")
            self._beside("load", self._go_on)

    def _take(self, brought: Brought) -> None:
        if brought.problem:
            self._told.warnings.append(f"{brought.name}: not entered: {brought.problem}")

    def _load(self, *, create: bool) -> tuple[LivingMap, list[MapChange]]:
        """Read the newest map, and what changed since the one before."""
        assert self._path is not None
        with open_store(self._path, create=create) as store:
            head, before = store.head(), self._revision
            new = range(before + 1, head + 1) if self._filter is not None else ()
            changes = [change for number in new for change in store.changes(number)]
            self._revision = head
            return store.load(head), changes

    def _go_on(self) -> None:
        """Go on in the newest map, from where the robot is."""
        living, changes = self._load(create=True)
        at_s = self._inbox.settled_s
        before, here = self._filter, self._located
        known = before is not None and len(living.places) > 0
        places = self._places(living, at_s) if known else None
        judge = None if places is None else Judge(living, places, self._sensor, self._config, self._judge)
        with self._step_lock:
            self._living = living
            self._told.add(changes)
            self._told.known.clear()
            if places is None:
                return
            if isinstance(before, Localizer):
                self._filter = before.over(places, self._sensor)
            else:
                prior, noise = beliefs(self._sensor, self._config.slam)
                self._filter = Localizer(places, self._sensor, prior, noise)
                if here is not None and self._last is not None and np.isfinite(here.pose[0]):
                    self._filter.place_at(self._last.stamp_s - self._inbox.first_s, here.pose, here.covariance)
            self._judge = judge

    def _wait(self) -> None:
        """Wait for what is done beside the steps."""
        while self._child is not None or self._jobs:
            if self._child is not None:
                self._child.wait()
            self._step_lock.release()  # what is done beside may need it
            try:
                for job in list(self._jobs.values()):
                    job.exception()
            finally:
                self._step_lock.acquire()
            self._listen()

    def _now(self) -> Now:
        stamp_s, located = self._inbox.odometry_s, self._located
        pose, covariance = np.full(3, math.nan), np.full((3, 3), math.nan)
        if located is not None and self._filter is not None:
            odometry, start_s = self._inbox.window(), self._inbox.first_s
            pose, covariance = located.pose, located.covariance
            if self._last is not None and stamp_s > self._last.stamp_s:
                odometry = odometry - [start_s, 0.0, 0.0, 0.0]
                if isinstance(self._filter, Mapper):
                    pose, covariance = self._filter.ahead(stamp_s - start_s, odometry)
                else:
                    drive = Drive.from_rows(odometry[:, 0], odometry[:, 1:])
                    pose, covariance = self._filter.ahead(stamp_s - start_s, drive)
        in_map = not isinstance(self._filter, Mapper)
        frame = "prior_map" if in_map else "first_pose"
        online, self._online = self._online, []
        changes, self._told.changes = tuple(self._told.changes), []
        warnings, self._told.warnings = tuple(self._told.warnings), []
        return Now(
            stamp_s=stamp_s if math.isfinite(stamp_s) else math.nan,
            pose_world_robot=pose,
            covariance=covariance,
            frame=frame,
            lost=located is None or located.lost or bool(np.isnan(pose[0])),
            online=_trajectory(online, frame, self._living.clock),
            in_view=self._in_view(frame),
            changes=changes,
            revision=self._revision,
            warnings=warnings,
        )

    def _in_view(self, frame: str) -> Landmarks:
        located, last = self._located, self._last
        if located is None or last is None:
            return Landmarks.at([], np.zeros((0, 2)), frame=frame)
        if isinstance(self._filter, Mapper):
            names = np.unique(last.landmark_id)
            known, position, covariance = self._filter.landmarks(names)
            found = Landmarks.at(known, position, frame=frame)
            p_new = np.full(len(known), self._config.living.decisions.new_clique_p)
            return replace(found, covariance_m2=covariance, p_exists=p_new)
        assert self._judge is not None
        return self._judge.in_view(located)


def _trajectory(online: list[tuple[float, FloatArray, FloatArray]], frame: str, clock: Clock) -> Trajectory:
    """Poses that are known."""
    known = [one for one in online if math.isfinite(one[1][0])]
    stamps, poses, spread = zip(*known, strict=True) if known else ((), (), ())
    pose, covariance = np.array(poses).reshape(-1, 3), np.array(spread).reshape(-1, 3, 3)
    return Trajectory(np.array(stamps), pose, covariance, frame, clock)


def _about(sensor: Sensor | str | Path, name: str, clock: Clock, class_names: tuple[str, ...]) -> Recording:
    """An empty recording with the sensor."""
    if isinstance(sensor, Sensor):
        return about(name, sensor, clock, class_names)
    if not isinstance(sensor, str | Path):
        hint = "evermap.Sensor(range_max_m=8.0), or the path of a sensor.toml"
        raise InputError(f"a Sensor is needed, not {type(sensor).__name__}", field="sensor", hint=hint)
    from evermap.io.sensor_toml import parse_sensor_toml

    path = Path(sensor)
    try:
        said = parse_sensor_toml(path.read_bytes(), path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path, hint="a sensor.toml") from None
    return about(said.name or name, said.sensor, said.clock, said.class_names or class_names)
