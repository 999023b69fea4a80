"""Localisation in a fixed map: pose and calibration, frame by frame, at a fixed cost.

An error-state extended Kalman filter of the newest pose and the calibration states. What a frame costs depends on what
is in view, not on the size of the map: of its places only those used last are considered (see `local_filter`), and only
the neighbourhood is expected. Where the robot starts is not known; the same search finds it again when it was carried
away.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from evermap.config import LocalizeConfig, LooksConfig
from evermap.geometry import se2
from evermap.sensing.visibility import USUAL as FIELD
from evermap.sensing.visibility import NominalField
from evermap.show import Shown
from evermap.slam.batch import sight_at
from evermap.slam.calibration import CalibrationPrior
from evermap.slam.kernels import AT_PLACES, N_SENSOR
from evermap.slam.known_places import FrameSightings, KnownPlaces, LocalTrack, Neighbourhood, Placed
from evermap.slam.local_filter import BY_OTHERS, LocalFilter, Motion, Updated
from evermap.slam.nearby_places import NO_PLACES
from evermap.slam.planar_filter import FrameReadings, PlanarFilter, PlanarMotion
from evermap.slam.problem import Drive, Noise
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Sensor

USUAL = LocalizeConfig()
MOST_CONSIDERED = 256
"""Places whose errors are kept correlated with the pose's: those used last. Of a frame no more are used."""


@dataclass(frozen=True, slots=True)
class Located:
    """Result of one frame.

    Attributes:
        pose: (3,) in the map's frame, in space (7,); nan while it is not known.
        covariance: (3, 3) in the robot's frame, in space (6, 6).
        place: (M,) row of the place that each detection was compared with, `UNKNOWN` where the map lacks it.
        nis: (M,) squared Mahalanobis distance of the innovation; nan where nothing was compared.
        p_inlier: (M,) probability that the detection is of that place; below 1/2 it was gated. nan likewise.
        expected: (E,) rows of places that are in view.
        p_detect: (E,) probability of a detection, did the landmark stand there.
        missed: (E,) True where a landmark is believed to stand, well in view, and was not detected anywhere.
        lost: the pose is kept by odometry alone, or not known at all, while it is searched for.
    """

    pose: FloatArray
    covariance: FloatArray
    place: IntArray
    nis: FloatArray
    p_inlier: FloatArray
    expected: IntArray
    p_detect: FloatArray
    missed: BoolArray
    lost: bool


BaseLocalizerT = TypeVar("BaseLocalizerT", bound="BaseLocalizer")


class BaseLocalizer(Shown, ABC):
    """Localisation in a fixed map, in the plane or in space: feed frames in order with `step`.

    A subclass brings the filter, the search for a start, and the measurements.

    Args:
        places: the map.
        local: the filter.
        settings: when its place in the map is known, and when it is lost.
        most: detections of a frame that are used.
        learn: hold the pose by landmarks that the map lacks, too, where they were seen first; else they are not used.
    """

    def __init__(
        self, places: KnownPlaces, local: LocalFilter, settings: LocalizeConfig, *, most: int, learn: bool
    ) -> None:
        self.places, self._settings, self._filter, self._most = places, settings, local, most
        self._log_p = np.log(np.maximum(places.p_here, settings.least_belief))
        self._believed = self._log_p.copy()
        self._stamp_s: float | None = None
        self._agreed: dict[int, tuple[float, bool]] = {}
        self.learn = learn
        """Whether landmarks that the map lacks are used."""
        self._new: dict[int, int] = {}
        """Rows of landmarks that the map lacks, behind those of its places."""
        self._track: Any = self._begin_track()

    def _facts(self) -> dict[str, object]:
        last: dict[str, object] = {} if self._stamp_s is None else {"stamp_s": round(self._stamp_s, 6)}
        return last | {"places": len(self.places), "considered": len(self.considered), "placed": self._is_placed}

    def place_at(self, stamp_s: float, pose: FloatArray, covariance: FloatArray) -> None:
        """Say where the robot is: its pose and covariance at a stamp."""
        self._stamp_s = stamp_s
        self._place_at(Placed(pose, covariance, NO_PLACES, np.zeros((len(covariance), 0))))

    @property
    def states(self) -> FloatArray:
        """(C,) calibration states."""
        return self._filter.states.copy()

    @property
    def states_covariance(self) -> FloatArray:
        """(C, C) of them."""
        local = self._filter
        return local.covariance[local.group.dim : local.own, local.group.dim : local.own].copy()

    @property
    def considered(self) -> IntArray:
        """Rows of the places whose errors are kept correlated with the pose's."""
        return self._filter.active

    def step(self, stamp_s: float, drive: Any, seen: Any) -> Located:
        """Process a frame: predict, place if need be, compare, update, expect.

        Args:
            stamp_s: of the frame, on the clock of `drive`, not before the last one.
            drive: odometry since the last frame at least; nothing that is later than the frame by more than the delay
                is looked at.
            seen: its detections; those of unknown identity are not used.
        """
        if self._stamp_s is not None:
            self._drive(self._motion(drive, self._stamp_s, stamp_s))
        self._stamp_s = stamp_s
        first, last = self.places.rows_of(seen.landmark_id)
        named = seen.readable & (seen.landmark_id != UNKNOWN)
        used = np.flatnonzero(named & (last > first))[: self._most]
        if self._track is None and self._is_vague:
            self._track = self._begin_track()
        if self._track is not None:
            self._track.see(stamp_s, seen, used, self._filter.states)
            self._search(stamp_s)
        place = np.full(len(named), UNKNOWN, dtype=np.int64)
        nis, p_inlier = np.full((2, len(named)), np.nan)
        new = np.flatnonzero(named & (last == first) & self.learn)[: max(self._most - len(used), 0)]
        if self._is_placed and len(used) + len(new):
            place[used], nis[used], p_inlier[used] = self._update(stamp_s, first[used], last[used], seen, used, new)
        pose_dim = self._filter.group.dim
        return Located(
            self._filter.pose.copy(),
            self._filter.covariance[:pose_dim, :pose_dim].copy(),
            place,
            nis,
            p_inlier,
            *self._expect(seen.landmark_id),
            self._track is not None,
        )

    def ahead(self, stamp_s: float, drive: Any) -> tuple[FloatArray, FloatArray]:
        """Return the pose at a later instant by odometry alone, and its covariance; nan as `Located`."""
        if self._stamp_s is None or not self._is_placed:
            pose_dim = self._filter.group.dim
            return self._filter.pose.copy(), self._filter.covariance[:pose_dim, :pose_dim].copy()
        return self._filter.ahead(self._motion(drive, self._stamp_s, stamp_s))

    def _going_on(self, there: BaseLocalizerT) -> BaseLocalizerT:
        """Return another one, in another state of the map, that goes on from here."""
        local, before = there._filter, self._filter
        pose_dim, own = local.group.dim, local.own
        local.states[:] = before.states
        local.covariance[pose_dim:, pose_dim:] = before.covariance[pose_dim:own, pose_dim:own]
        there._stamp_s = self._stamp_s
        if self._stamp_s is not None and self._is_placed and self._track is None:
            there.place_at(self._stamp_s, before.pose.copy(), before.covariance[:pose_dim, :pose_dim].copy())
        return there

    @abstractmethod
    def _begin_track(self) -> Any:
        """Return the search for a start: a `DriveTrack`."""

    @abstractmethod
    def _motion(self, drive: Any, start_s: float, stop_s: float) -> Motion:
        """Return odometry between two instants."""

    @abstractmethod
    def _compare(self, row: IntArray, seen: Any, which: IntArray) -> tuple[FloatArray, FloatArray]:
        """Compare detections (M,) with a place (M,) each: squared distances, and `log |S|`."""

    @abstractmethod
    def _update_by(self, row: IntArray, seen: Any, which: IntArray) -> Updated:
        """Update by detections (M,) of places (M,)."""

    @abstractmethod
    def _sight(self, row: int, seen: Any, which: int) -> None:
        """Store the place of a landmark that the map lacks."""

    def _expect(self, _: IntArray) -> tuple[IntArray, FloatArray, BoolArray]:
        """Return rows of places in view, P(detect) of each, and those missed, of landmarks that were not seen (M,).

        In space none: what a sensor there should see is learned after a session.
        """
        return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.bool_)

    @property
    def _is_vague(self) -> bool:
        """Whether the pose is so uncertain that it is searched for."""
        return False

    @property
    def _is_placed(self) -> bool:
        return bool(np.isfinite(self._filter.pose[0]))

    def _drive(self, motion: Motion) -> None:
        if self._track is not None:
            self._track.drive(motion.increment)
        if self._is_placed:
            self._filter.drive(motion)

    def _search(self, stamp_s: float) -> None:
        """Align the drive since the robot got lost with the map, if that explains much more than the present pose."""
        placed = self._track.placed(stamp_s, self.places)
        if placed is None:
            return
        agreement, places, by = self._track.agreement, self.places, self._settings.better_by
        if self._is_placed and agreement(placed.pose, places) < by * agreement(self._filter.pose, places):
            self._track = None  # it is the world that differs from the map
            self._agreed.clear()
            return
        self._place_at(placed)

    def _place_at(self, placed: Placed) -> None:
        """Restart at a pose; the calibration is kept."""
        local, places = self._filter, self.places
        pose_dim, own = local.group.dim, local.own
        self._new.clear()
        self._log_p = self._log_p[: len(places)]
        alone = np.zeros((own, own))
        alone[pose_dim:, pose_dim:] = self.states_covariance
        local.hold(placed.pose, self.states, alone, NO_PLACES, places.value)
        local.lean_on(places.value, places.joint_of, tied=places.joint_m2 is not None)
        at = local.columns(local.bring(placed.rows))
        covariance = local.covariance
        follows = placed.by_places @ covariance[at]
        covariance[:pose_dim, own:], covariance[own:, :pose_dim] = follows[:, own:], follows[:, own:].T
        covariance[:pose_dim, :pose_dim] = placed.covariance + follows[:, at] @ placed.by_places.T
        self._believed = self._log_p.copy()
        self._track = None
        self._agreed.clear()

    def _update(
        self, stamp_s: float, first: IntArray, last: IntArray, seen: Any, used: IntArray, new: IntArray
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Place, innovation and weight of the detections `used`; `new` ones are of landmarks that the map lacks."""
        met = np.array([m for m in new.tolist() if int(seen.landmark_id[m]) in self._new], dtype=np.int64)
        which, count = np.append(used, met), len(used)
        row = self._choose_places(first, last, seen, used)
        row = np.append(row, np.array([self._new[int(seen.landmark_id[m])] for m in met], dtype=np.int64))
        self._filter.bring(row)
        nis, weight, _ = self._update_by(row, seen, which)
        doubt = self._log_p[row] - self._believed[row]
        agrees = weight * (1.0 + np.exp(doubt)) > 1.0  # would be more likely there than not, if it were not doubted
        step, most = self._settings.doubt, self._settings.most_doubt
        self._believed[row] = self._log_p[row] - np.clip(doubt + np.where(agrees, -step, step), 0.0, most)
        self._judge(stamp_s, seen.landmark_id[used], agrees[:count])
        if self.learn and self._track is None:
            self._meet(np.setdiff1d(new, met), seen)
        return row[:count], nis[:count], weight[:count]

    def _meet(self, new: IntArray, seen: Any) -> None:
        """Store places of landmarks that are seen for the first time, or whose place was often doubted."""
        known = len(self.places)
        doubted = self._believed[known:] <= self._log_p[known:] - self._settings.most_doubt
        self._new = {name: row for name, row in self._new.items() if not doubted[row - known]}
        for m in new.tolist():
            name, row = int(seen.landmark_id[m]), len(self._believed)
            if name in self._new:  # twice in this frame
                continue
            self._sight(row, seen, m)
            self._new[name] = row
            self._log_p, self._believed = np.append(self._log_p, 0.0), np.append(self._believed, 0.0)

    def _choose_places(self, first: IntArray, last: IntArray, seen: Any, used: IntArray) -> IntArray:
        """(M,) known place at which each landmark was seen: the most probable one (max-mixture, MATH.md section 5)."""
        count = last - first
        if np.count_nonzero(count > 1) == 0:
            return first
        begin = np.cumsum(count) - count
        row = np.repeat(first - begin, count) + np.arange(int(count.sum()))
        of = np.repeat(np.arange(len(first)), count)
        nis, log_det = self._compare(row, seen, used[of])
        score = self._believed[row] - 0.5 * nis - 0.5 * log_det
        best = np.maximum.reduceat(score, begin)[of] == score
        return np.asarray(row[best][np.unique(of[best], return_index=True)[1]])

    def _judge(self, stamp_s: float, landmark_id: IntArray, agrees: BoolArray) -> None:
        """Lost where most of the landmarks compared last were not where they should have been."""
        settings = self._settings
        for name, good in zip(landmark_id.tolist(), agrees.tolist(), strict=True):
            self._agreed.pop(name, None)
            self._agreed[name] = (stamp_s, good)
        while len(self._agreed) > max(settings.remembered, len(landmark_id)):
            self._agreed.pop(next(iter(self._agreed)))
        fresh = [good for seen_s, good in self._agreed.values() if seen_s >= stamp_s - settings.memory_s]
        lost = len(fresh) >= settings.least_remembered and 2 * sum(fresh) < len(fresh)
        if lost and self._track is None:
            self._track = self._begin_track()
        elif not lost:
            self._track = None


class Localizer(BaseLocalizer):
    """Localisation in the plane: feed frames in order with `step`.

    Args:
        places: the map.
        sensor: limits, mounting and detection probability. Where it has no largest range, all of the map is expected.
        prior: of the calibration states, a Gaussian (`CalibrationPrior.gaussian`).
        noise: standard deviations of detections and odometry; they are not estimated.
        settings: when its place in the map is known, and when it is lost.
        looks: how soft the edges of the field of view are, and what is worth a look.
        start: (3,) pose and (3, 3) covariance at the first frame, where these are known.
        learn: as `BaseLocalizer`.
    """

    def __init__(
        self,
        places: KnownPlaces,
        sensor: Sensor,
        prior: CalibrationPrior,
        noise: Noise,
        *,
        settings: LocalizeConfig = USUAL,
        looks: LooksConfig = FIELD,
        start: tuple[FloatArray, FloatArray] | None = None,
        learn: bool = False,
    ) -> None:
        self._field, self._prior, self.noise = NominalField(sensor, looks), prior, noise
        self._mount = np.array(sensor.mount_robot_sensor, dtype=np.float64)
        self._local = PlanarFilter(self._mount, prior, most=MOST_CONSIDERED, considered=True)
        super().__init__(places, self._local, settings, most=MOST_CONSIDERED, learn=learn)
        self._near = Neighbourhood(places.position_m, self._field.reach_m)
        self._believed_there = np.zeros(len(places), dtype=np.bool_)
        self._believed_there[places.most_probable()] = True
        self._believed_there &= places.p_here >= settings.believed
        if start is not None:
            self._place_at(Placed(*start, NO_PLACES, np.zeros((3, 0))))

    def over(self, places: KnownPlaces, sensor: Sensor) -> Localizer:
        """Return one that goes on from here in another state of the map."""
        settings, looks = self._settings, self._field.settings
        return self._going_on(
            Localizer(places, sensor, self._prior, self.noise, settings=settings, looks=looks, learn=self.learn)
        )

    def _begin_track(self) -> LocalTrack:
        return LocalTrack(self._mount, self._settings)

    def _motion(self, drive: Drive, start_s: float, stop_s: float) -> Motion:
        return PlanarMotion.over(drive, start_s, stop_s, self._local.states, self._prior.free, self.noise)

    def _compare(self, row: IntArray, seen: FrameSightings, which: IntArray) -> tuple[FloatArray, FloatArray]:
        return self._local.compare(row, self._readings(seen, which), self.places.covariance_m2[row])[:2]

    def _update_by(self, row: IntArray, seen: FrameSightings, which: IntArray) -> Updated:
        log_odds = self.noise.outlier_log_odds + self._believed[row]
        return self._local.update(row, self._readings(seen, which), weighing=BY_OTHERS, log_odds=log_odds)

    def _readings(self, seen: FrameSightings, which: IntArray) -> FrameReadings:
        return FrameReadings(
            np.ascontiguousarray(seen.reading[which]), self.noise.of_detections(seen.sigma_given[which])
        )

    def _sight(self, row: int, seen: FrameSightings, which: int) -> None:
        local, (_, sigma) = self._local, self._readings(seen, np.array([which]))
        place, by_pose, by_reading = _place_by(local.pose, seen.reading[which], local.states, self._mount)
        local.sight(row, place, by_pose, by_reading @ np.diag(sigma[0] ** 2) @ by_reading.T)

    def _expect(self, seen_id: IntArray) -> tuple[IntArray, FloatArray, BoolArray]:
        """Return rows of places in view, P(detect) of each, and the missed ones."""
        spread, pose = self._filter.covariance, self._filter.pose
        sigma = math.sqrt(max(spread[0, 0], spread[1, 1]))
        if not self._is_placed or self._track is not None or sigma > self._settings.sure_m:
            return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.bool_)
        rows = self._near(se2.compose(pose, self._mount)[:2])
        p = self._field.p_detect(pose[None], self.places.position_m[rows])[0]
        expected = p >= self._settings.least_p_detect
        rows, p = rows[expected], p[expected]
        well = self._believed_there[rows] & self._field.worth_a_look(p)
        return rows, p, well & ~np.isin(self.places.landmark_id[rows], seen_id)


STEP = 1e-6
"""Of numerical derivatives."""


def _place_by(
    pose: FloatArray, reading: FloatArray, states: FloatArray, mount: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(2,) where a reading (2,) points to, its derivatives (2, 14) by pose, in its own frame, and states, and (2, 2) by
    the reading.
    """
    place = sight_at(pose, reading, states, mount)
    by_pose, by_reading = np.zeros((2, AT_PLACES)), np.zeros((2, 2))
    for k, step in enumerate(STEP * np.eye(3)):
        by_pose[:, k] = (sight_at(se2.retract(pose, step), reading, states, mount) - place) / STEP
    for k, step in enumerate(STEP * np.eye(len(states))[:N_SENSOR]):
        by_pose[:, 3 + k] = (sight_at(pose, reading, states + step, mount) - place) / STEP
    for k, step in enumerate(STEP * np.eye(2)):
        by_reading[:, k] = (sight_at(pose, reading + step, states, mount) - place) / STEP
    return place, by_pose, by_reading
