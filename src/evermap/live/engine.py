"""The live engine: `Engine` takes readings as they arrive, and returns causal estimates.

In a map the localiser of `run_localization` says where the robot is, in an unmapped place the stream of a
session; both frame by frame, as over a recording. What was driven is entered by `run_session`, in a process of its own
while the robot drives on, and the engine goes on in the map that comes of it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from evermap.compiled import single_threaded
from evermap.config import Config
from evermap.errors import ConfigError
from evermap.live.inbox import Inbox, LiveFrame, recording_of
from evermap.live.judge import Judge, warm_up
from evermap.live.keeper import Keeper, News
from evermap.maps.living import LivingMap
from evermap.maps.sessions.believe import aged
from evermap.runs.sessions import Entered
from evermap.slam.calibration import DELAY
from evermap.slam.intake import beliefs
from evermap.slam.known_places import FrameSightings, KnownPlaces
from evermap.slam.localize import Localizer, Located
from evermap.slam.mapper import Mapper
from evermap.slam.problem import Drive
from evermap.types import Clock, FloatArray, IntArray, Landmarks, MapChange, Sensor, Trajectory
from evermap.valid import check_sensor

Numbers = Sequence[float] | FloatArray


@dataclass(frozen=True, slots=True)
class Now:
    """Present state of the robot and its map.

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


class Engine:
    """Feed readings with `odometry` and `detections`, from any thread, and call `step` for estimates.

    As a context manager it enters the drive when the block ends; after an error or a crash the next engine does.

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
            problem = "association of landmarks without identity needs later detections"
            raise ConfigError(problem, field="slam.unknown_ids", hint="a recording: evermap slam --unknown-ids")
        recording = recording_of(sensor, name, clock, tuple(class_names))
        self._sensor = self._config.sensor.applied_to(recording.sensor)
        check_sensor(self._sensor)
        self._inbox = Inbox(recording, self._config)
        self._lock, self._told = threading.RLock(), News()
        path = None if isinstance(map, LivingMap) else Path(map)
        self._keeper = Keeper(path, self._config, self._inbox, self._told, threads=beside)
        self._filter: Localizer | Mapper | None = None
        self._judge: Judge | None = None
        self._located: Located | None = None
        self._last: LiveFrame | None = None
        self._online: list[tuple[float, FloatArray, FloatArray]] = []
        self._session_s = self._judged_s = -math.inf
        self._met: set[int] = set()
        self._in_view = Landmarks.at([], np.zeros((0, 2)), frame="first_pose")
        self._mapping = mapping
        self._living = self._keeper.begin(map if isinstance(map, LivingMap) else None, recording.clock, mapping=mapping)

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
            if isinstance(self._filter, Localizer):
                self._filter.learn = mapping

    @property
    def living(self) -> LivingMap:
        """The stored map that the robot is in."""
        return self._living

    @property
    def sensor(self) -> Sensor:
        """The sensor of landmarks."""
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
            InputError: no finite numbers, or so late that frames after it are processed.
        """
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
            InputError: values that cannot be, or so late that frames after it are processed.
        """
        columns = landmark_id, range_m, bearing_rad, class_name, sigma_range_m, sigma_bearing_rad
        self._inbox.detections(stamp_s, columns)

    @single_threaded()
    def step(self) -> Now:
        """Process new readings, and return the present estimates; without new readings in some microseconds."""
        with self._lock:
            if self._keeper.collect():
                self._keeper.beside("load", self._go_on)
            ready = self._inbox.ready(0.0 if self._filter is None else float(self._filter.states[DELAY]))
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
        rows, start_s = frame.rows, self._inbox.first_s
        seen = FrameSightings(frame.landmark_id, rows[:, 1:3].copy(), rows[:, 4:6].copy())
        if isinstance(self._filter, Localizer):
            drive = Drive.from_rows(odometry[:, 0] - start_s, odometry[:, 1:], self._config.slam.odometry)
            located = self._filter.step(frame.stamp_s - start_s, drive, seen)
        else:
            assert self._filter is not None
            driven = odometry - [start_s, 0.0, 0.0, 0.0]
            if not kept:
                self._filter.skip(driven)
                return
            located = self._filter.step(frame.stamp_s - start_s, driven, seen)
        self._located, self._last = located, frame
        if isinstance(self._filter, Mapper):
            self._in_view = self._filter.landmarks(frame.landmark_id, self._config.living.decisions.new_clique_p)
        self._online.append((frame.stamp_s, located.pose, located.covariance))
        if self._judge is not None:
            self._judge.look(frame, located, self._filter.states)
            self._met.update(frame.landmark_id[located.p_inlier > 0.5].tolist())
            self._in_view = self._judge.in_view(located)

    def _begin(self, stamp_s: float) -> None:
        """Choose the filter: in a map the robot is localised, a place without one is mapped."""
        self._living = self._living.from_now_on(stamp_s)
        if len(self._living.places):
            places = self._places(self._living, stamp_s)
            self._filter = self._localizer(places, learn=self._mapping)
            self._judge = Judge(self._living, places, self._sensor, self._config)
        else:
            self._filter = Mapper(self._sensor, *beliefs(self._sensor, self._config.slam), self._config.slam)

    def _localizer(self, places: KnownPlaces, *, learn: bool) -> Localizer:
        settings, looks = self._config.slam, self._config.living.looks
        prior, noise = beliefs(self._sensor, settings)
        prior = prior.gaussian()
        return Localizer(places, self._sensor, prior, noise, settings=settings.localize, looks=looks, learn=learn)

    def _places(self, living: LivingMap, stamp_s: float) -> KnownPlaces:
        rows = living.sighted_rows(aged(living, self._config.living, stamp_s).p_here)
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
            if isinstance(self._filter, Localizer)
            else self._keeper.n_sessions == 1
        )

    def _go_on(self) -> None:
        """Go on in the newest map, from where the robot is."""
        before, config = self._filter, self._config
        living, changes = self._keeper.load(create=True)
        if before is None or not len(living.places):
            self._living = living
            return
        places = self._places(living, self._inbox.settled_s)
        judge = Judge(living, places, self._sensor, config, self._judge)
        with self._lock:
            self._told.add([*(self._judge.told() if self._judge is not None else ()), *changes])
            self._told.known.clear()
            if isinstance(before, Localizer):
                self._filter = before.over(places, self._sensor)
            else:
                self._filter = self._localizer(places, learn=True)
                if (here := self._located) is not None and self._last is not None and np.isfinite(here.pose[0]):
                    self._filter.place_at(self._last.stamp_s - self._inbox.first_s, here.pose, here.covariance)
            self._living, self._judge = living, judge

    def _now(self) -> Now:
        stamp_s, located, filter_ = self._inbox.odometry_s, self._located, self._filter
        in_map = not isinstance(filter_, Mapper)
        frame = "prior_map" if in_map else "first_pose"
        pose, covariance = np.full(3, math.nan), np.full((3, 3), math.nan)
        if located is not None and filter_ is not None and self._last is not None:
            pose, covariance = located.pose, located.covariance
            if stamp_s > self._last.stamp_s:
                driven = self._inbox.window() - [self._inbox.first_s, 0.0, 0.0, 0.0]
                drive = Drive.from_rows(driven[:, 0], driven[:, 1:], self._config.slam.odometry)
                pose, covariance = filter_.ahead(stamp_s - self._inbox.first_s, drive)
        online, self._online = self._online, []
        changes, warnings = self._told.taken()
        return Now(
            stamp_s=stamp_s if math.isfinite(stamp_s) else math.nan,
            pose_world_robot=pose,
            covariance=covariance,
            frame=frame,
            lost=located is None or located.lost or bool(np.isnan(pose[0])),
            online=_trajectory_of(online, frame, self._living.clock),
            in_view=self._in_view,
            changes=changes,
            revision=self._keeper.revision,
            warnings=warnings,
        )


def _trajectory_of(online: list[tuple[float, FloatArray, FloatArray]], frame: str, clock: Clock) -> Trajectory:
    """Return the poses that are known, of stamps, poses and covariances."""
    known = [one for one in online if math.isfinite(one[1][0])]
    stamps, poses, spread = zip(*known, strict=True) if known else ((), (), ())
    pose, covariance = np.array(poses).reshape(-1, 3), np.array(spread).reshape(-1, 3, 3)
    return Trajectory(np.array(stamps), pose, covariance, frame, clock)
