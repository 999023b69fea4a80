"""Localisation in a fixed map in space: the places, the search for a start, and the localiser, as in the plane.

A tag tells the whole pose, three points do, and odometry ties those that were seen one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from evermap.align.acceptance import SIGMA_M, SIGMA_RAD, accept_alignment
from evermap.align.candidates import Matches
from evermap.config import LocalizeConfig, SpaceConfig
from evermap.geometry import se3
from evermap.geometry.chunked import JointCovariance
from evermap.geometry.group import SPACE
from evermap.geometry.symmetry import Symmetry
from evermap.slam.known_places import DriveTrack, KnownPlaces, Placed
from evermap.slam.local_filter import BY_OTHERS, Motion, Updated
from evermap.slam.localize import USUAL, BaseLocalizer
from evermap.slam.space.linearise import POINT
from evermap.slam.space.local_filter import OF_PLACE, SpatialFilter, SpatialFrame, SpatialMotion
from evermap.slam.space.online_noise import OnlineNoise
from evermap.slam.space.problem import USUAL as IN_SPACE
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

VAGUE_M, VAGUE_RAD = 2.0, 0.5
"""A pose that is less certain is searched for: what it sees can't be linearised there."""
MOST_CONSIDERED = 128
"""As in the plane, where a place has a third of the numbers."""
FARTHEST_M = 100.0
"""A pose that may be so far off is not known."""
OF_POINT, OF_TAG, ENOUGH_NUMBERS, FEWEST_NUMBERS = 3, 6, 9, 6
"""Numbers that a point and a tag tell of the pose; those that a start needs, three more than it has, and those that do
where nothing else comes into view."""


@dataclass(frozen=True, slots=True)
class SpatialPlaces(KnownPlaces):
    """Places in space: as `KnownPlaces`, with (P, 3) positions.

    Attributes:
        rotation: (P, 4) quaternions; nan of points.
        rotation_rad2: (P, 3, 3) covariances of these, in the places' own axes.
    """

    rotation: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    rotation_rad2: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 3)))

    @classmethod
    def in_space(
        cls, landmarks: Landmarks, covariance_m2: JointCovariance, settings: SpaceConfig = IN_SPACE
    ) -> SpatialPlaces:
        """Return the places of landmarks, of which one may have several rows; those of probability 0 are left out."""
        points = KnownPlaces.of(landmarks.landmark_id, landmarks.position_m, covariance_m2, landmarks.p_exists)
        order, count = points.joint_row, len(points)
        rotation, spread = np.full((count, 4), np.nan), np.full((count, 3, 3), np.nan)
        if landmarks.rotation is not None:
            rotation = landmarks.rotation[order]
            if landmarks.rotation_covariance is not None:
                spread = landmarks.rotation_covariance[order]
        unknown = ~np.isfinite(spread).all(axis=(1, 2))
        spread = np.where(unknown[:, None, None], settings.map.sigma**2 * np.eye(3), spread)
        spread = spread + settings.map.drift_rad**2 * np.eye(3)
        places = cls(
            points.landmark_id, points.position_m, points.covariance_m2, points.p_here, points.joint_m2, order,
            rotation, spread,
        )  # fmt: skip
        kept = np.flatnonzero(places.p_here > 0.0)
        return replace(places.existing(), rotation=rotation[kept], rotation_rad2=spread[kept])

    @property
    def value(self) -> FloatArray:
        """(P, 7) the places, as the filter has them."""
        return np.hstack([self.position_m, self.rotation])

    def joint_of(self, rows: IntArray) -> FloatArray:
        """Return (6 K, 6 K) covariance of some places together, as the filter counts it."""
        count = len(rows)
        joint = KnownPlaces.joint_of(self, rows).reshape(count, 3, count, 3)
        turned = np.isfinite(self.rotation[rows, 0])
        back = np.tile(np.eye(3), (count, 1, 1))
        back[turned] = np.swapaxes(se3.rotation_of(self.value[rows[turned]]), 1, 2)
        found = np.zeros((count, OF_PLACE, count, OF_PLACE))
        found[:, :3, :, :3] = np.einsum("iab,ibjc,jdc->iajd", back, joint, back, optimize=True)
        some = np.flatnonzero(turned)
        found[some, 3:, some, 3:] = self.rotation_rad2[rows[some]]
        return found.reshape(OF_PLACE * count, OF_PLACE * count)


class LandmarkWays(NamedTuple):
    """A landmark that was seen: (2, 7) both explanations, log odds of the first, and whether it has an orientation."""

    ways: FloatArray
    log_odds: float
    turned: bool


class SpatialTrack(DriveTrack[LandmarkWays]):
    """A drive in space.

    Without odometry, `driven` False, nothing ties one frame to another: only those of the newest are kept.
    """

    def __init__(self, settings: LocalizeConfig, mount: FloatArray, pixel: float, *, driven: bool) -> None:
        super().__init__(SPACE, mount, settings)
        self._pixel, self._driven = pixel, driven

    def drive(self, increment: FloatArray) -> None:
        """Advance the pose by a motion (7,)."""
        super().drive(increment)
        if not self._driven:
            self._seen.clear()

    def see(self, stamp_s: float, seen: SpatialFrame, used: IntArray, states: FloatArray) -> None:
        """Add sightings (M,) of landmarks of the map; forget those that are too old."""
        mount = se3.retract(self._mount, states[:-1].reshape(-1, 6))[seen.sensor[used]]
        ways = se3.compose(self._pose, se3.compose(mount, seen.either[:, used]))
        turned = (seen.kind[used] != POINT) & (seen.symmetry[used] == 0)
        odds = np.where((ways[0] == ways[1]).all(axis=1), np.inf, seen.other_log_odds[used] / self._pixel**2)
        kept = [LandmarkWays(ways[:, k], float(odds[k]), bool(turned[k])) for k in range(len(used))]
        self._keep(stamp_s, seen.landmark_id[used].tolist(), kept)

    def placed(self, stamp_s: float, places: SpatialPlaces) -> Placed | None:
        """Align the drive with the map; None if that is uncertain, or was tried before with the same landmarks."""
        settings = self._settings
        if not self._seen or (self._driven and self._was_tried(stamp_s)):
            return None
        alone = not self._driven or stamp_s - self._began_s >= settings.alone_s
        matches, row = self._candidates(places)
        found = accept_alignment(matches, settings, covariance_m2=places.errors_at(row))
        some = np.flatnonzero(found.agree)
        turned = matches.oriented[some]
        numbers = int(np.where(turned, OF_TAG, OF_POINT).sum())
        if not found or numbers < (FEWEST_NUMBERS if alone else ENOUGH_NUMBERS):
            return None
        pose = se3.compose(found.motion, self._pose)
        return Placed(pose, *_uncertainty(pose, places.value[row[some]], turned, row[some]))

    def _candidates(self, places: KnownPlaces) -> tuple[Matches, IntArray]:
        """Return them as in the plane, twice where a tag has two explanations."""
        name, row = self._pair(places)
        seen = [one for _, one in self._seen.values()]
        ways = np.array([one.ways for one in seen]).reshape(-1, 2, 7)[name]
        ways[~np.array([one.turned for one in seen], dtype=np.bool_)[name], :, 3:] = np.nan
        odds = np.array([one.log_odds for one in seen])[name]
        either = np.flatnonzero(np.isfinite(odds) & np.isfinite(places.value[row, 3]))
        every = np.append(np.arange(len(row)), either)
        matches = Matches.of(
            np.concatenate([ways[:, 0], ways[either, 1]]),
            places.value[row[every]],
            landmark=name[every],
            weight=np.maximum(places.p_here[row[every]], self._settings.least_belief),
            log_prior=np.append(np.zeros(len(row)), -np.maximum(odds[either], 0.0)),
        )
        return matches, row[every]


class SpatialLocalizer(BaseLocalizer):
    """Localisation in space: feed frames in order with `step`, with the odometry as an `OdometryPath`, or None.

    Args:
        places: the map.
        mount: (S, 7) poses of the sensors on the robot.
        sigma: (6 S + 1,) of the states: twists of the mounts, and the logarithm of the odometry's scale.
        noise: standard deviations to start from. Without odometry those of a hand, which stay.
        driven: whether there is odometry.
        symmetries: turns after which landmarks look the same, the first without any.
        settings: when its place in the map is known, and when it is lost.
        space: what is believed of sensors in space.
    """

    def __init__(
        self,
        places: SpatialPlaces,
        mount: FloatArray,
        sigma: FloatArray,
        noise: SpatialNoise,
        *,
        driven: bool,
        symmetries: tuple[Symmetry, ...] = (Symmetry(),),
        settings: LocalizeConfig = USUAL,
        space: SpaceConfig = IN_SPACE,
        learn: bool = False,
    ) -> None:
        self._mount, self._sigma, self._start, self._driven = mount, sigma, noise, driven
        self._noise = OnlineNoise(noise, space, driven=driven)
        self._symmetries, self._space = symmetries, space
        self._local = SpatialFilter(mount, sigma, noise, symmetries, most=MOST_CONSIDERED, considered=True)
        super().__init__(places, self._local, settings, most=MOST_CONSIDERED, learn=learn)

    @property
    def noise(self) -> SpatialNoise:
        """Noise levels as they are known now."""
        return self._noise.now

    def over(self, places: SpatialPlaces) -> SpatialLocalizer:
        """Return one that goes on from here in another state of the map."""
        there = SpatialLocalizer(
            places, self._mount, self._sigma, self._start, driven=self._driven, symmetries=self._symmetries,
            settings=self._settings, space=self._space, learn=self.learn,
        )  # fmt: skip
        there._noise, there._local.levels = self._noise, self._local.levels
        return self._going_on(there)

    def _drive(self, motion: Motion) -> None:
        super()._drive(motion)
        if np.diag(self._local.covariance)[:3].max() > FARTHEST_M**2:
            self._local.pose = np.full(7, np.nan)  # so it is not known
        self._noise.drive(motion.increment, motion.covariance)

    def _place_at(self, placed: Placed) -> None:
        super()._place_at(placed)
        self._noise.forget_motion()

    def _begin_track(self) -> SpatialTrack:
        return SpatialTrack(self._settings, self._mount, self._start.pixel, driven=self._driven)

    def _motion(self, drive: OdometryPath | None, start_s: float, stop_s: float) -> SpatialMotion:
        return SpatialMotion.over(drive, start_s, stop_s, self._local.log_scale, self.noise)

    @property
    def _is_vague(self) -> bool:
        variance = np.diag(self._local.covariance)[:6]
        return bool(variance[:3].max() > VAGUE_M**2 or variance[3:].max() > VAGUE_RAD**2)

    def _compare(self, row: IntArray, seen: SpatialFrame, which: IntArray) -> tuple[FloatArray, FloatArray]:
        own = np.array([self.places.joint_of(one) for one in row[:, None]])
        return self._local.compare(row, seen.rows(which), own, is_apart=True)[:2]

    def _update_by(self, row: IntArray, seen: SpatialFrame, which: IntArray) -> Updated:
        some = seen.rows(which)
        kind = np.where(np.isfinite(self._local.position[row, 3]), some.kind, POINT)
        log_odds = np.array(self._space.outlier_log_odds)[kind] + self._believed[row]
        found = self._local.update(row, some, weighing=BY_OTHERS, log_odds=log_odds)
        if self._track is None and found.before is not None:  # where it is lost nothing fits
            self._noise.learn(found.before, found.weight, kind)
            self._local.levels = self._noise.now.levels
        self._noise.forget_motion()
        return found

    def _update(
        self, stamp_s: float, first: IntArray, last: IntArray, seen: SpatialFrame, used: IntArray, new: IntArray
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """As in the plane; a frame that does not fit is searched for at once where nothing ties the next one to it."""
        was_searched = self._track is not None
        found = super()._update(stamp_s, first, last, seen, used, new)
        fits = 2 * np.count_nonzero(found[2] > 0.5) >= len(used)
        if self._driven or was_searched or fits or len(used) < self._settings.fewest:
            return found
        pose, self._track = self._local.pose, self._begin_track()
        self._track.see(stamp_s, seen, used, self._local.states)
        self._search(stamp_s)
        if self._local.pose is pose:
            return found
        return super()._update(stamp_s, first, last, seen, used, new)

    def _sight(self, row: int, seen: SpatialFrame, which: int) -> None:
        oriented = bool(seen.kind[which] != POINT and seen.symmetry[which] == 0)
        self._local.sight(row, *self._local.place_of(seen, which, oriented=oriented))


def _uncertainty(
    pose: FloatArray, known: FloatArray, turned: BoolArray, rows: IntArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return the covariance of an aligned pose, with agreeing places (n, 7); see `Placed`."""
    turn, information, pull = se3.rotation_of(pose), 1e-4 * np.eye(6), []
    for place, oriented in zip(known, turned, strict=True):
        away = se3.transform(se3.inverse(pose), place[:3])
        by = np.hstack([turn, -turn @ -se3.rigid_directions(away[None])[:, 3:]]) / SIGMA_M
        axes = se3.rotation_of(place) if np.isfinite(place[3]) else np.eye(3)
        own = np.zeros((6, OF_PLACE))
        own[:, :3] = by.T @ axes / SIGMA_M
        information += by.T @ by
        if oriented:
            about = np.hstack([np.zeros((3, 3)), turn]) / SIGMA_RAD
            own[:, 3:] = about.T @ axes / SIGMA_RAD
            information += about.T @ about
        pull.append(own)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return covariance, rows, covariance @ np.hstack(pull)
