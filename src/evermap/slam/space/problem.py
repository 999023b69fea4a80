"""Problem, estimate and noise in space: the nouns that the modules of this package exchange."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from evermap.config import SpaceConfig
from evermap.geometry import se3
from evermap.geometry.symmetry import Symmetries
from evermap.slam.base_problem import BaseProblem
from evermap.slam.space.linearise import MOUNT, OF_SIGHTING, POINT, POSE, ROWS, SpatialSightings
from evermap.types import BoolArray, FloatArray, IntArray

NO_JUMP_LOG_ODDS = 1e3
"""Without odometry nothing takes a camera to somewhere else between two frames."""
USUAL = SpaceConfig()
MEDIAN_SQUARE = 0.455
"""Median of the square of a normal number of variance 1."""
LEAST_WEIGHT = 1e-6
"""Of a map's word on a landmark that is elsewhere."""
ANY_RAD = np.pi
"""Standard deviation of an orientation of which a map says nothing."""


@dataclass(frozen=True, slots=True)
class SpatialNoise:
    """Standard deviations.

    Attributes:
        translation: of the odometry, metres for the square root of a second.
        rotation: of the odometry, radians for the square root of a second.
        across: factor on the stated standard deviations of positions across the line of sight.
        along: the same of ranges, which detectors that know a size are far worse at than at directions.
        orientation: factor on those of orientations.
        pixel: of corners in an image [px].
    """

    translation: float = 0.05
    rotation: float = 0.02
    across: float = 1.0
    along: float = 1.0
    orientation: float = 1.0
    pixel: float = 1.0

    @property
    def levels(self) -> FloatArray:
        """Return them as (6,)."""
        return np.array([self.translation, self.rotation, self.across, self.along, self.orientation, self.pixel])

    @property
    def position(self) -> float:
        """Return the factor for all axes that gives a position the same volume of uncertainty."""
        return float(np.cbrt(self.across**2 * self.along))


class Swing(NamedTuple):
    """How the noise of the odometry's rotation, collected along K intervals, moves where these end.

    What is turned by the noise of a step is turned about where the robot was then. Seen from an interval's end, the
    noise of its rotation acts at a mean lever, and the variance of the levers about it adds to that of the translation.

    Attributes:
        steps: (K,) steps of each interval.
        lever_m: (K, 3) mean position of their ends.
        axes: (K, 3, 3) columns along which the translation's variances are independent, given the rotation.
        arm_m2: (K, 3) variance of the translation along these for each unit of that of the rotation.
    """

    steps: IntArray
    lever_m: FloatArray
    axes: FloatArray
    arm_m2: FloatArray

    @classmethod
    def none(cls, count: int) -> Swing:
        """Return that of intervals of a single step each."""
        axes = np.tile(np.eye(3), (count, 1, 1))
        return cls(np.ones(count, dtype=np.int64), np.zeros((count, 3)), axes, np.zeros((count, 3)))

    @classmethod
    def between(cls, ends: IntArray, lasted_s: FloatArray, driven: FloatArray) -> Swing:
        """Return that of the intervals between rows `ends` (K + 1,) of poses (F, 7) by the odometry, whose steps
        (F - 1,) lasted so long.
        """
        step = np.arange(ends[0] + 1, ends[-1] + 1)
        row, count = np.searchsorted(ends, step) - 1, len(ends) - 1
        at = se3.between(driven[ends[1:]][row], driven[step])[:, :3]
        share = np.maximum(lasted_s[step - 1], 1e-9)
        share /= np.bincount(row, share, count)[row]
        lever_m, about = np.zeros((count, 3)), np.zeros((count, 3, 3))
        np.add.at(lever_m, row, share[:, None] * at)
        off = at - lever_m[row]
        np.add.at(about, row, share[:, None, None] * off[:, :, None] * off[:, None, :])
        size, axes = np.linalg.eigh(about)
        arm_m2 = np.maximum(size.sum(axis=1, keepdims=True) - size, 0.0)
        return cls(np.diff(ends), lever_m, axes, arm_m2)

    def scaled(self, factor: float) -> Swing:
        """Return that of odometry with all lengths times a factor."""
        return self._replace(lever_m=factor * self.lever_m, arm_m2=factor**2 * self.arm_m2)

    def variance(self, noise: SpatialNoise) -> FloatArray:
        """Return (K, 6) variances for a unit of time: of translations along the axes, given the rotation; of that."""
        turns = noise.rotation**2
        along = noise.translation**2 + turns * self.arm_m2
        return np.hstack([along, np.full_like(along, turns)])


@dataclass(frozen=True, slots=True)
class PlacePrior:
    """Prior of some places from a given map.

    Attributes:
        place: (K,) rows of places.
        pose: (K, 7) where they are; of points the orientation is not looked at.
        sigma: (K, 6) standard deviations in the place's own frame, the axes of the map for points.
        weight: (K,) probability that each still is there.
    """

    place: IntArray
    pose: FloatArray
    sigma: FloatArray
    weight: FloatArray

    @classmethod
    def none(cls) -> PlacePrior:
        """Return an empty prior."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 7)), np.ones((0, 6)), np.ones(0))


class OdometryPath(NamedTuple):
    """Poses (K, 7) of the odometry at stamps (K,).

    Between two stamps poses are interpolated, and so less noisy: a delay that is no whole number of steps would fit
    better for that alone. So the whole steps are taken back along the path, and the rest by the velocity, which jitters
    the less the longer the time that it is of.
    """

    stamp_s: FloatArray
    pose: FloatArray

    @property
    def step_s(self) -> float:
        """Return the usual time between two stamps."""
        return float(np.median(np.diff(self.stamp_s)))

    @property
    def jitter(self) -> FloatArray:
        """Return (6,) how fast the variance of what the odometry adds at random grows, for each second.

        By second differences of its motions, medians of them: a robot that starts or stops does not jitter.
        """
        motion = se3.local(self.pose[:-1], self.pose[1:])[1:-1]  # without what leads on at both ends
        if len(motion) < 3:
            return np.zeros(6)
        return np.asarray(np.median(np.diff(motion, 2, axis=0) ** 2, axis=0) / (6.0 * MEDIAN_SQUARE * self.step_s))

    def at(self, stamp_s: FloatArray) -> FloatArray:
        """Return poses (N, 7) at stamps (N,); before and after its own the end poses."""
        return se3.interpolate(self.stamp_s, self.pose, stamp_s)

    def velocity(self, stamp_s: FloatArray, within_s: float) -> FloatArray:
        """Return twists (N, 6) for each second at stamps (N,), on average from `within_s` before to after."""
        since_s, until_s = (np.clip(stamp_s + by, *self.stamp_s[[0, -1]]) for by in (-within_s, within_s))
        return se3.local(self.at(since_s), self.at(until_s)) / np.maximum(until_s - since_s, 1e-9)[:, None]

    def earlier(
        self, stamp_s: FloatArray, delay_s: float, whole_s: float, within_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return twists (N, 6) from where the robot is at stamps (N,) to where it was a delay before, and their
        derivatives (N, 6), twists there; `whole_s` of the delay are whole steps, velocities are averaged `within_s`.
        """
        velocity = self.velocity(stamp_s - whole_s, within_s)
        then = se3.retract(self.at(stamp_s - whole_s), (whole_s - delay_s) * velocity)
        return se3.local(self.at(stamp_s), then), -velocity


@dataclass(frozen=True, slots=True, kw_only=True)
class SpatialProblem(BaseProblem):
    """All measurements and priors in space.

    Attributes:
        increment: (N - 1, 7) motion by the odometry; identity where there is none.
        lasted_s: (N - 1,) what its variance grows with: the time; without odometry the time squared, at a speed of
            which nothing is known but its size.
        swing: of the odometry's noise between the poses.
        driven: True if there is odometry.
        steady: True where the noise of that is not learned, but held where it starts.
        place, sensor, kind: (M,) which place each detection is of, and how it was seen.
        measured: (M, 7) the place in the sensor's frame.
        measured_root: (M, 3, 3) whitens the position but for its noise levels; see `SpatialSightings`.
        usual_m: (M, 2) standard deviations across and along the line of sight that positions usually have, where none
            is stated; nan of others.
        sigma_rad: (M,) of the orientation, but for its noise level.
        corner, corner_root, half_m: of tags in an image; see `SpatialSightings`.
        other: (M, 7) the other orientation that explains the corners, with its position; nan where there is none.
        other_log_odds: (M,) of the first against the other.
        share: (M,) of the information of each detection that is new.
        ray: (M,) detections of which only the direction was seen; their ranges are triangulated first values.
        oriented: (P,) places with an orientation; the others are points.
        symmetries: (P,) turns after which places look the same.
        mount: (S, 7) nominal poses of the sensors on the robot.
        mount_sigma: (S, 6) standard deviations of their twists; 0 where exact.
        delay_sigma_s: (S,) standard deviations of how late the stamps of the sensors are; 0 where they are right.
        scale_sigma: standard deviation of the logarithm of the odometry's scale; 0 where it is exact.
        ranges_share: of what ranges and odometer show together, that is the ranges'; see `in_shared_metre`.
        ranges_log: logarithm of ranges over true distances, that was taken off the measurements.
        odometry_log: logarithm of the odometry's scale that was put on its increments.
        range_error: (S,) errors of the ranges of points, in their standard deviations, that were taken off the
            measurements; see `range_errors`.
        prior: on places.
        start_sigma: (6,) how firmly the first pose is held where it is.
        path: the odometry, in the time of the poses, from which delays are estimated; None without.
        has_clock_of_frames: whether the odometry was made of the frames, as visual odometry is, and has their clock.
        velocity_s: time before and after an instant over which its velocity is averaged.
        whole_s: (S,) what of each delay are whole steps of the odometry; see `OdometryPath`.
        delay_jitter: (S,) information that detections seem to hold on the rest of each delay, since the velocity
            jitters: it pulls to whole steps, and is taken off (errors in variables).
        robust: whether outliers are down-weighted.
        estimate_noise: whether noise levels are learned.
        settings: what is believed of sensors and of a map.
    """

    COLUMNS = (
        "pose_row", "place", "sensor", "kind", "measured", "measured_root", "usual_m", "sigma_rad", "corner",
        "corner_root", "half_m", "other", "other_log_odds", "share", "ray",
    )  # fmt: skip

    increment: FloatArray
    lasted_s: FloatArray
    swing: Swing
    driven: bool
    place: IntArray
    sensor: IntArray
    kind: IntArray
    measured: FloatArray
    measured_root: FloatArray
    usual_m: FloatArray
    sigma_rad: FloatArray
    corner: FloatArray
    corner_root: FloatArray
    half_m: FloatArray
    other: FloatArray
    other_log_odds: FloatArray
    share: FloatArray
    ray: BoolArray
    oriented: BoolArray
    symmetries: Symmetries
    mount: FloatArray
    mount_sigma: FloatArray
    delay_sigma_s: FloatArray
    prior: PlacePrior = field(default_factory=PlacePrior.none)
    steady: bool = False
    scale_sigma: float = 0.0
    ranges_share: float = 0.0
    ranges_log: float = 0.0
    odometry_log: float = 0.0
    range_error: FloatArray = field(default_factory=lambda: np.zeros(0))
    start_sigma: FloatArray = field(default_factory=lambda: np.full(6, 1e-4))
    path: OdometryPath | None = None
    has_clock_of_frames: bool = False
    velocity_s: float = 1.0
    whole_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    delay_jitter: FloatArray = field(default_factory=lambda: np.zeros(0))
    robust: bool = True
    estimate_noise: bool = True
    settings: SpaceConfig = USUAL

    @property
    def seen_place(self) -> IntArray:
        """(M,) which place each detection is of."""
        return self.place

    def earlier(self, delay_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (S, N, 6) twists by the odometry from each pose to where the robot was delays (S,) before, and
        (S, N, 6) their derivatives, twists there; zero for sensors whose stamps are right.
        """
        back, by_delay = np.zeros((2, len(delay_s), len(self.stamp_s), 6))
        for row in np.flatnonzero(self.delay_sigma_s):
            assert self.path is not None
            back[row], by_delay[row] = self.path.earlier(
                self.stamp_s, float(delay_s[row]), float(self.whole_s[row]), self.velocity_s
            )
        return back, by_delay

    def with_range_error(self, error: FloatArray) -> SpatialProblem:
        """Return the problem with other errors of the ranges of points (S,) taken off its measurements.

        An inverse range is off by the error times its own standard deviation: that of a disparity, for a stereo pair.
        """
        found, (as_measured_m, sigma_m) = self.measured.copy(), self._ranges
        wanted_m = as_measured_m**2 / (as_measured_m + error[self.sensor] * sigma_m)
        some = self.has_range
        factor = wanted_m / np.linalg.norm(self.measured[:, :3], axis=1)
        found[some, :3] *= factor[some, None]
        return replace(self, measured=found, range_error=error)

    @property
    def sigma_position_m(self) -> FloatArray:
        """Return (M, 2) standard deviations across and along the line of sight, but for their noise levels."""
        return 1.0 / np.asarray(np.linalg.norm(self.measured_root[:, [0, 2]], axis=2))

    def with_sigma_position(self, sigma_m: FloatArray) -> SpatialProblem:
        """Return the problem with other standard deviations (M, 2) of positions of which none is stated."""
        factor = np.where(np.isfinite(self.usual_m), self.sigma_position_m / sigma_m, 1.0)
        return replace(self, measured_root=self.measured_root * factor[:, [0, 0, 1], None])

    @property
    def range_slope(self) -> FloatArray:
        """Return (M, 3) by how much nearer detections are, for a range error that is larger by one."""
        (range_m, sigma_m), error = self._ranges, self.range_error[self.sensor]
        ray = self.measured[:, :3] / np.linalg.norm(self.measured[:, :3], axis=1, keepdims=True)
        slope = sigma_m * (range_m / (range_m + error * sigma_m)) ** 2
        return np.where(self.has_range[:, None], slope[:, None] * ray, 0.0)

    @property
    def has_range(self) -> BoolArray:
        """Return (M,) detections of points with a measured range."""
        return np.asarray((self.kind == POINT) & ~self.ray)

    @property
    def _ranges(self) -> tuple[FloatArray, FloatArray]:
        """Return ranges (M,) before their errors were taken off, and their standard deviations (M,)."""
        sigma_m = 1.0 / np.linalg.norm(self.measured_root[:, 2], axis=1)
        now_m, error_m = np.linalg.norm(self.measured[:, :3], axis=1), self.range_error[self.sensor] * sigma_m
        return 0.5 * (now_m + np.sqrt(np.maximum(now_m**2 + 4.0 * now_m * error_m, 0.0))), sigma_m

    @property
    def either(self) -> FloatArray:
        """Return (2, M, 7) both explanations of each detection; the first twice where there is one only."""
        return np.stack([self.measured, np.where(np.isfinite(self.other), self.other, self.measured)])

    @property
    def explanations(self) -> FloatArray:
        """Return (E, M, 7) as `either`, also those of turns after which a place looks the same, beside those about an
        axis; the first again where there are fewer.
        """
        kinds, of = self.symmetries.kinds, self.symmetries.of[self.place]
        most = max(2, *(len(kind.turns) for kind in kinds))
        found = np.concatenate([self.either, np.repeat(self.measured[None], most - 2, axis=0)])
        for row in np.unique(of[of > 0]).tolist():
            mine = np.flatnonzero((of == row) & (self.kind == POSE))
            turns = np.hstack([np.zeros((len(kinds[row].turns), 3)), kinds[row].turns])
            found[: len(turns), mine] = se3.compose(self.measured[mine], turns[:, None])
        return found

    def off_map(self, row: IntArray, place: FloatArray, *, oriented: bool) -> FloatArray:
        """Return twists (K, 6) from where the map has some of its places (K,) to `place` (K, 7); shifts (K, 3) of
        points. Of what looks the same the nearest counts.
        """
        known = self.prior.pose[row]
        if oriented:
            return se3.local(self.symmetries[self.prior.place[row]].nearest(known, place), place)
        return np.asarray(place[:, :3] - known[:, :3])

    @property
    def about_axis(self) -> BoolArray:
        """Return (M,) detections of an orientation that is not seen about an axis."""
        return np.asarray((self.kind == POSE) & (self.symmetries.axis[self.place] >= 0))

    @property
    def dof(self) -> IntArray:
        """Return (M,) numbers that each detection measures."""
        return np.asarray(ROWS[self.kind] - self.ray - self.about_axis, dtype=np.int64)

    @property
    def sightings(self) -> SpatialSightings:
        """Return the detections as the kernel reads them."""
        kinds = self.symmetries.kinds
        oriented = self.oriented[self.place].astype(np.int64)
        width = OF_SIGHTING + np.where(oriented, 6, 3)
        first = np.append(0, np.cumsum(ROWS[self.kind] * width))
        return SpatialSightings(
            self.pose_row, self.place, self.sensor, self.kind, oriented, self.measured, self.measured_root,
            self.sigma_rad, self.corner, self.corner_root, self.half_m, first, self.share,
            np.array(self.settings.outlier_log_odds) if self.robust else np.full(3, np.inf),
            self.symmetries.of[self.place], np.array([kind.axis for kind in kinds]),
            np.append(0, np.cumsum([len(kind.turns) for kind in kinds])), np.vstack([kind.turns for kind in kinds]),
            self.ray,
        )  # fmt: skip

    def in_shared_metre(self, log_scale: float) -> SpatialProblem:
        """Return the same with ranges and odometry each corrected by its share of the scale between them.

        Args:
            log_scale: logarithm of distances by the ranges over those by the odometry.
        """
        ranges, driven = self.ranges_share * log_scale, (1.0 - self.ranges_share) * log_scale
        shorter, longer = np.exp([-ranges, driven]).tolist()
        path = None if self.path is None else self.path._replace(pose=se3.scaled(self.path.pose, longer))
        return replace(
            self,
            measured=se3.scaled(self.measured, shorter),
            other=se3.scaled(self.other, shorter),
            measured_root=self.measured_root / shorter,
            usual_m=self.usual_m * shorter,
            half_m=self.half_m * shorter,
            increment=se3.scaled(self.increment, longer),
            swing=self.swing.scaled(longer),
            path=path,
            ranges_log=ranges,
            odometry_log=driven,
        )

    def as_points(self) -> SpatialProblem:
        """Return the same with positions only, which has one optimum, near any start."""
        prior = replace(self.prior, sigma=np.hstack([self.prior.sigma[:, :3].max(axis=1, keepdims=True)] * 6))
        return replace(self, kind=np.full_like(self.kind, POINT), oriented=np.zeros_like(self.oriented), prior=prior)


@dataclass(frozen=True, slots=True)
class SpatialEstimate:
    """Values of all variables.

    Attributes:
        pose: (N, 7) of the robot.
        place: (P, 7) of places; of points the orientation is the identity.
        state: (S, 7) twist of each sensor's mount, and by how much its stamps are late [s].
        log_scale: logarithm of true distances over those of the odometry.
    """

    pose: FloatArray
    place: FloatArray
    state: FloatArray
    log_scale: float = 0.0

    def moved(self, by: FloatArray, oriented: BoolArray, by_place: FloatArray | None = None) -> SpatialEstimate:
        """Return everything moved together by a motion (7,); or poses by (N, 7), places by (P, 7).

        Of places (P,) without an orientation only the positions move.
        """
        place = se3.compose(by if by_place is None else by_place, self.place)
        place[~oriented, 3:] = se3.NO_TURN
        return replace(self, pose=se3.compose(by, self.pose), place=place)

    def mount(self, problem: SpatialProblem) -> FloatArray:
        """Return (S, 7) the sensors' poses on the robot."""
        return se3.retract(problem.mount, self.state[:, :MOUNT])

    @property
    def delay_s(self) -> FloatArray:
        """Return (S,) by how much the stamps of the sensors are late."""
        return self.state[:, MOUNT]

    def seen_from(self, problem: SpatialProblem) -> tuple[FloatArray, FloatArray]:
        """Return (M, 7) the robot's pose when each detection was made, and (M, 6) the twist there from its stamp's."""
        back = problem.earlier(self.delay_s)[0][problem.sensor, problem.pose_row]
        pose = self.pose[problem.pose_row]
        return se3.retract(pose, back) if back.any() else pose, back


@dataclass(frozen=True, slots=True)
class SpatialView:
    """The variables of a problem in space, as measurements see them; `oriented` (P,) are places with an orientation."""

    oriented: BoolArray

    def poses(self, state: SpatialEstimate) -> FloatArray:
        """Return (N, 7) poses."""
        return state.pose

    def places(self, state: SpatialEstimate) -> FloatArray:
        """Return (P, 3) positions of places."""
        return state.place[:, :3]

    def by_pose(self, by_twist: FloatArray) -> FloatArray:
        """Return (K, r, 6) the same: a step of a pose is a twist."""
        return by_twist

    def by_place(self, state: SpatialEstimate, place: IntArray, by_position: FloatArray) -> list[FloatArray]:
        """Return derivatives (r, 3) by points, (r, 6) by twists of places with an orientation."""
        turned = by_position @ se3.rotation_of(state.place[place])
        return [
            np.hstack([own, np.zeros_like(own)]) if self.oriented[row] else by_position[k]
            for k, (row, own) in enumerate(zip(place, turned, strict=True))
        ]
