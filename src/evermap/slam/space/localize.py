"""Localisation in a fixed map in space: the places, the search for a start, and the localiser, as in the plane.

A tag tells the whole pose, three points do, and odometry ties those that were seen one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from evermap.align.candidates import AGREE_M
from evermap.config import LocalizeConfig, SpaceConfig
from evermap.geometry import se3
from evermap.geometry.chunked import JointCovariance
from evermap.geometry.rigid import rigid
from evermap.geometry.symmetry import Symmetry
from evermap.slam.filter_kernels import BY_OTHERS
from evermap.slam.known_places import MOST_LANDMARKS, RETRY_S, SIGMA_M, KnownPlaces, Placed
from evermap.slam.localize import USUAL, BaseLocalizer
from evermap.slam.space.linearise import POINT
from evermap.slam.space.local_filter import OF_PLACE, SpatialFilter, SpatialFrame, SpatialMotion
from evermap.slam.space.online_noise import OnlineNoise
from evermap.slam.space.problem import USUAL as IN_SPACE
from evermap.slam.space.problem import OdometryPath, SpatialNoise
from evermap.types import BoolArray, FloatArray, IntArray, Landmarks

AGREE_RAD, SIGMA_RAD = 0.5, 0.2
"""An orientation agrees with the map to within this; and what it is good for, of one landmark laid over the map."""
POINTS_OF_TRIPLES, MOST_TRIPLES = 14, 300
"""Landmarks whose triples are tried, and triples."""
FLAT_M = 0.3
"""A triangle has this height at least, or it leaves a turn about its long side."""
CERTAIN_NATS = 2.0
"""By which one explanation of a single tag must be more probable than the other."""
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


class SpatialTrack:
    """A drive by odometry alone, and where landmarks were seen during it, in the frame of its first pose.

    Without odometry, `driven` False, nothing ties one frame to another: only those of the newest are kept.
    """

    def __init__(self, settings: LocalizeConfig, mount: FloatArray, pixel: float, *, driven: bool) -> None:
        self._settings, self._mount, self._pixel, self._driven = settings, mount, pixel, driven
        self._pose = se3.identity()
        self._began_s = np.nan
        self._seen: dict[int, tuple[float, FloatArray, float, bool]] = {}
        self._tried: tuple[float, frozenset[int]] = (-np.inf, frozenset())

    def drive(self, increment: FloatArray) -> None:
        """Advance the pose by a motion (7,)."""
        self._pose = se3.compose(self._pose, increment)
        if not self._driven:
            self._seen.clear()

    def see(self, stamp_s: float, seen: SpatialFrame, used: IntArray, states: FloatArray) -> None:
        """Add sightings (M,) of landmarks of the map; forget those that are too old."""
        if np.isnan(self._began_s):
            self._began_s = stamp_s
        mount = se3.retract(self._mount, states[:-1].reshape(-1, 6))[seen.sensor[used]]
        ways = se3.compose(self._pose, se3.compose(mount, seen.either[:, used]))
        turned = (seen.kind[used] != POINT) & (seen.symmetry[used] == 0)
        for k, name in enumerate(seen.landmark_id[used].tolist()):
            self._seen.pop(name, None)
            odds = float(seen.other_log_odds[used[k]]) / self._pixel**2
            alike = np.array_equal(ways[0, k], ways[1, k])
            self._seen[name] = (stamp_s, ways[:, k], np.inf if alike else odds, bool(turned[k]))
        old = [name for name, (seen_s, *_) in self._seen.items() if seen_s < stamp_s - self._settings.track_s]
        for name in [*old, *list(self._seen)[: max(len(self._seen) - len(old) - MOST_LANDMARKS, 0)]]:
            self._seen.pop(name, None)

    def placed(self, stamp_s: float, places: SpatialPlaces) -> Placed | None:
        """Align the drive with the map; None if that is uncertain, or was tried before with the same landmarks."""
        names, settings = frozenset(self._seen), self._settings
        if not names or (self._driven and names <= self._tried[1] and stamp_s < self._tried[0] + RETRY_S):
            return None
        self._tried = (stamp_s, names)
        alone = not self._driven or stamp_s - self._began_s >= settings.alone_s
        table = self._candidates(places)
        motion, odds = self._motions(table, places)
        if not len(motion):
            return None
        belief = np.maximum(places.p_here[table.row], settings.least_belief)
        fit, turned = _fit(motion, table, places)
        score = _of_names(fit * belief, table.name) + 1e-3 * np.minimum(odds, 0.0)
        best = int(np.argmax(score))
        agree = np.flatnonzero((fit[best] > 0.0) & (fit[best] >= _best_of_name(fit[best], table.name)))
        count = len(np.unique(table.name[agree]))
        numbers = int(np.where(turned[best, agree], OF_TAG, OF_POINT).sum())
        if numbers < (FEWEST_NUMBERS if alone else ENOUGH_NUMBERS):
            return None
        if count < settings.fewest and not turned[best, agree].any():
            return None
        if not (2 * count > len(names) or count >= settings.enough):
            return None
        if count == 1 and table.odds[agree[0]] < CERTAIN_NATS:
            return None
        found = motion[best]
        if count >= 3 and _height(table.local[agree, 0, :3]) > FLAT_M:
            found = rigid(table.local[agree, 0, :3], places.position_m[table.row[agree]])
        pose = se3.compose(found, self._pose)
        return Placed(pose, *_uncertainty(pose, places.value[table.row[agree]], turned[best, agree], table.row[agree]))

    def agreement(self, pose_map_robot: FloatArray, places: SpatialPlaces) -> float:
        """Return how well the track fits the map with the robot at a pose (7,): 1 per landmark exactly at a place."""
        table = self._candidates(places)
        motion = se3.compose(pose_map_robot, se3.inverse(self._pose))[None]
        return float(_of_names(_fit(motion, table, places)[0], table.name)[0])

    def _candidates(self, places: SpatialPlaces) -> _Candidates:
        """One row for every place a landmark may be at."""
        first, last = places.rows_of(np.fromiter(self._seen, dtype=np.int64))
        count = last - first
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        name = np.repeat(np.arange(len(first)), count)
        row = np.repeat(first, count) + within
        seen = list(self._seen.values())
        local = np.array([ways for _, ways, *_ in seen]).reshape(-1, 2, 7)[name]
        turned = np.array([one[3] for one in seen], dtype=np.bool_)[name] & np.isfinite(places.rotation[row, 0])
        return _Candidates(local, row, name, turned, np.array([one[2] for one in seen])[name])

    def _motions(self, table: _Candidates, places: SpatialPlaces) -> tuple[FloatArray, FloatArray]:
        """(C, 7) motions from the track to the map that tags, or three landmarks, tell; (C,) log odds of each."""
        tags = np.flatnonzero(table.turned)
        back = se3.inverse(table.local[tags])
        by_tags = se3.compose(places.value[table.row[tags]][:, None], back)
        odds = np.column_stack([np.zeros(len(tags)), -table.odds[tags]])
        kept = np.column_stack([np.ones(len(tags), dtype=np.bool_), np.isfinite(table.odds[tags])])
        some = np.unique(table.name, return_index=True)[1]
        some = some[np.linspace(0, len(some) - 1, min(len(some), POINTS_OF_TRIPLES)).astype(np.int64)]
        triple = np.array(list(combinations(some.tolist(), 3)), dtype=np.int64).reshape(-1, 3)
        source, target = table.local[triple, 0, :3], places.position_m[table.row[triple]]
        ways = [(0, 1), (1, 2), (2, 0)]
        gap = [np.abs(_span(source, a, b) - _span(target, a, b)) for a, b in ways]
        fits = (np.max(gap, axis=0) < AGREE_M) & (_heights(target) > FLAT_M)
        chosen = np.flatnonzero(fits)
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_TRIPLES)).astype(np.int64)]
        by_points = rigid(source[chosen], target[chosen]).reshape(-1, 7)
        return np.vstack([by_tags[kept], by_points]), np.append(odds[kept], np.zeros(len(by_points)))


@dataclass(frozen=True, slots=True)
class _Candidates:
    """(K,) pairs of a landmark of the track and a place of the map.

    Attributes:
        local: (K, 2, 7) where it was seen, by both explanations.
        row: of the place.
        name: which landmark.
        turned: both have an orientation.
        odds: log odds of the first explanation; inf where it is the only one.
    """

    local: FloatArray
    row: IntArray
    name: IntArray
    turned: BoolArray
    odds: FloatArray


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

    def _drive(self, motion: SpatialMotion) -> None:
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
        return self._local.compare(row, seen.rows(which), own)

    def _update_by(self, row: IntArray, seen: SpatialFrame, which: IntArray) -> tuple[FloatArray, FloatArray]:
        some = seen.rows(which)
        kind = np.where(np.isfinite(self._local.position[row, 3]), some.kind, POINT)
        log_odds = np.array(self._space.outlier_log_odds)[kind] + self._believed[row]
        noise = self._noise if self._track is None else None  # where it is lost nothing fits
        found = self._local.update(row, some, weighing=BY_OTHERS, log_odds=log_odds, noise=noise)
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


def _fit(motion: FloatArray, table: _Candidates, places: SpatialPlaces) -> tuple[FloatArray, BoolArray]:
    """(C, K) how well each pair agrees under motions (C, 7), 1 exactly at its place, and whether its orientation does,
    too. What has an orientation agrees by that or not at all.
    """
    known = places.value[table.row]
    at = se3.transform(motion[:, None, None], table.local[None, ..., :3])
    gap = np.linalg.norm(at - known[:, None, :3], axis=3)
    turned = np.broadcast_to(table.turned[:, None], gap.shape)
    local, placed = table.local[table.turned], known[table.turned]
    angle = np.zeros(gap.shape)
    angle[:, table.turned] = se3.angle_between(se3.compose(motion[:, None, None], local[None]), placed[:, None])
    fit = np.where(turned & (angle > AGREE_RAD), 0.0, np.maximum(1.0 - (gap / AGREE_M) ** 2, 0.0))
    return fit.max(axis=2), np.broadcast_to(table.turned, fit.shape[:2])


def _of_names(fit: FloatArray, name: IntArray) -> FloatArray:
    """(C,) sums over landmarks of the best of each."""
    first = np.flatnonzero(np.append(True, name[1:] != name[:-1]))
    return np.asarray(np.maximum.reduceat(fit, first, axis=1).sum(axis=1)) if len(name) else np.zeros(len(fit))


def _best_of_name(fit: FloatArray, name: IntArray) -> FloatArray:
    """(K,) the best of each pair's landmark."""
    first = np.flatnonzero(np.append(True, name[1:] != name[:-1]))
    return np.asarray(np.maximum.reduceat(fit, first)[np.cumsum(np.append(0, name[1:] != name[:-1]))])


def _span(points: FloatArray, a: int, b: int) -> FloatArray:
    return np.asarray(np.linalg.norm(points[:, a] - points[:, b], axis=1))


def _heights(points: FloatArray) -> FloatArray:
    """(T,) least heights of triangles (T, 3, 3)."""
    across = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    longest = np.maximum(np.maximum(_span(points, 0, 1), _span(points, 1, 2)), _span(points, 2, 0))
    return np.asarray(np.linalg.norm(across, axis=1) / np.maximum(longest, 1e-9))


def _height(points: FloatArray) -> float:
    """How far points (K, 3) lie off a line."""
    arm = points - points.mean(axis=0)
    return float(np.linalg.svd(arm, compute_uv=False)[1])


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
