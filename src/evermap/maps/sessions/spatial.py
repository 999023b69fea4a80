"""A session in space: its landmarks and looks, for the same map and the same steps as in the plane.

A camera that is carried by hand has no information on the motion between groups of tags, so that a session by itself
may be loose. Therefore it is solved within the map from the beginning, every landmark weighted by the probability that
it stands (`slam.space.against_map`); what the session says by itself is that optimum without what the map said. It is
laid over the map as any other session, and solved once more with what stands.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from evermap.config import Config, LivingConfig, LocalizeConfig, LooksConfig
from evermap.geometry import se2, se3
from evermap.geometry.chunked import blocks, of_places
from evermap.maps.living import EXISTS, Dated, LivingMap
from evermap.maps.sessions.believe import Witnessed, aged
from evermap.maps.sessions.extend import Extended, Found, fellows_of, first_and_last
from evermap.maps.sessions.gaussian import anchored, drifted
from evermap.maps.sessions.looks import Watch
from evermap.maps.sessions.placing import NOT_FOUND, Laid, Localised, Turned, lay_over_map, places_in, widened
from evermap.maps.vicinity import Vicinity, cliques_of
from evermap.sensing import learned
from evermap.sensing.profile import Assumed, Field, Projection
from evermap.sensing.visibility import LooksAt
from evermap.slam.intake import find_bodies, most_of
from evermap.slam.space.against_map import by_itself
from evermap.slam.space.bodies import with_rests
from evermap.slam.space.bridge import bridge
from evermap.slam.space.estimate import SpatialOptimum, converge_again
from evermap.slam.space.intake import SpatialIntake, prepare_space
from evermap.slam.space.problem import ANY_RAD, PlacePrior
from evermap.slam.space.result import conclude_in_space, identities_of, located, numbered
from evermap.slam.space.solve import FREE, SpatialSolved, fit_to_map, solve_space
from evermap.slam.space.together import SolvedRobot, solve_space_together
from evermap.slam.space.up import sensor_axes
from evermap.types import (
    BoolArray,
    FloatArray,
    IntArray,
    Landmarks,
    Progress,
    Sensor,
    SlamResult,
    SpatialRecording,
    landmark_id_of,
)

MOST_OF_ONE_IDENTITY = 4
"""Maximum landmarks that share one identity in a map."""
MOST_VIEWS = 2000
"""Looks that detection is learned from."""


@dataclass(frozen=True)
class SpatialVisit:
    """A session in space, in a frame of its own or in that of a map.

    Attributes:
        recording: as it was used.
        intake: as the estimator wants it.
        solved: its values.
        witnessed: observed arrivals and departures.
    """

    recording: SpatialRecording
    intake: SpatialIntake
    solved: SpatialSolved
    witnessed: Witnessed = field(default_factory=Witnessed.nothing)

    @property
    def used(self) -> SpatialRecording:
        """The recording of which `concluded` names rows."""
        return self.recording

    def concluded(self, scratch: str = "first_pose") -> SlamResult:
        """Return the session as the estimator has it; `scratch` is what its frame is where there is no map."""
        return conclude_in_space(self.recording, self.intake, self.solved, scratch)

    def begun(self, living: LivingMap) -> LivingMap:
        """Return an empty map: in space the scale is that of the sensors."""
        return living

    @property
    def span_s(self) -> tuple[float, float]:
        """Stamps of the first and of the last frame that have a pose."""
        start_s = self.intake.start_s
        return start_s, start_s + float(self.solved.optimum.smoother.problem.stamp_s[-1])

    @property
    def optimum(self) -> SpatialOptimum:
        """The last values."""
        return self.solved.optimum

    @functools.cached_property
    def located(self) -> tuple[BoolArray, BoolArray]:
        """(N,) poses and (P,) places of which it is known where they are."""
        found, placed = located(self.optimum.smoother.problem, self.optimum.now)
        return found, placed & ~self.solved.left

    @functools.cached_property
    def path(self) -> FloatArray:
        """(F, 7) poses of all frames of the trajectory."""
        return bridge(self.intake.frames, self.optimum.smoother.problem, self.optimum.estimate, self.optimum.noise)

    @property
    def path_m(self) -> FloatArray:
        """(F, 3) of the poses of which it is known where they are."""
        return self.path[self._located_frames, :3]

    @property
    def _located_frames(self) -> BoolArray:
        """(F,) frames of which it is known where they are: all with odometry."""
        return self.located[0][self.intake.frames.before]

    @property
    def inlier(self) -> FloatArray:
        """(M,) probability of each detection that is used to be no outlier."""
        return self.optimum.now.weight

    @functools.cached_property
    def landmark_id(self) -> IntArray:
        """(P,) ids of the places of the problem."""
        return identities_of(self.intake, self.solved)[0]

    def named(self, living: LivingMap) -> LivingMap:
        """Return the map with the names of landmarks that carry the identity of others."""
        texts = identities_of(self.intake, self.solved)[1].values()
        return replace(living, landmark_texts=tuple(sorted({*living.landmark_texts, *texts})))

    @functools.cached_property
    def floor_sensor(self) -> Sensor:
        """Range and field of view of the sensors, as one planar sensor, for earlier looks."""
        direction, range_m = self._directions(np.flatnonzero(self.inlier >= EXISTS))
        settings = self.intake.problem.settings
        half = float(np.abs(np.arctan2(direction[:, 1], direction[:, 0])).max(initial=0.0)) + settings.field_margin_rad
        told = self.recording.sensors[0]
        return Sensor(
            range_min_m=told.range_min_m,
            range_max_m=float(np.quantile(range_m, settings.usual_range)) if len(range_m) else told.range_max_m,
            bearing_min_rad=max(-half, -np.pi),
            bearing_max_rad=min(half, np.pi),
            p_detect=told.p_detect,
            p_false=told.p_false,
        )

    @functools.cached_property
    def _axes(self) -> FloatArray:
        """(S, 3, 3) ahead, left and up of each sensor, by where it saw most."""
        return sensor_axes(self.optimum.smoother.problem, self.recording.sensors)

    def _directions(self, some: IntArray) -> tuple[FloatArray, FloatArray]:
        """(N, 3) unit vectors of detections by the axes of their sensors, and (N,) ranges."""
        problem = self.optimum.smoother.problem
        along = np.einsum("nji,nj->ni", self._axes[problem.sensor[some]], problem.measured[some, :3])
        range_m = np.linalg.norm(along, axis=1)
        return along / np.maximum(range_m, 1e-9)[:, None], range_m

    @functools.cached_property
    def n_fit(self) -> FloatArray:
        """(P,) sums of the inlier probabilities of each place's detections."""
        problem = self.optimum.smoother.problem
        return np.bincount(problem.place, self.inlier, minlength=len(problem.oriented)).astype(np.float64)

    def told(self, some: BoolArray) -> tuple[IntArray, FloatArray]:
        """Return rows (K,) of located places among (P,), by their ids; and orientations (K, 4), nan for points."""
        row = np.flatnonzero(some & self.located[1])
        row = row[np.argsort(self.landmark_id[row], kind="stable")]
        oriented = self.optimum.smoother.problem.oriented[row, None]
        return row, np.where(oriented, self.optimum.estimate.place[row, 3:], np.nan)

    def found(self, where: Laid | None, living: LivingMap, config: LivingConfig) -> Found:
        """Return the landmarks of the session in the frame of a map; None for `where` begins one."""
        settings = config.fit
        problem, place = self.optimum.smoother.problem, self.optimum.estimate.place
        names, count = self.landmark_id, len(place)
        good = np.flatnonzero(self.inlier >= settings.inlier)
        (laid, probability), alone = places_in(where, names), by_itself(self.optimum)
        least = np.where(laid >= 0, settings.sightings_in_place, settings.sightings)
        seen = np.bincount(problem.place[good], minlength=count) > 0
        row, rotation = self.told((self.n_fit >= least) & seen)
        stamps = self.recording.frames.stamp_s[self.recording.detections.frame[self.intake.used[good]]]
        first, last = first_and_last(problem.place[good], stamps, count)
        at = se2.xy_rows(row, 3)
        position, covariance = place[row, :3] + alone.shift_m[row], alone.covariance_m2[np.ix_(at, at)]
        if where is None:
            covariance = anchored(position, covariance)
        else:
            position, covariance = _fuse_places(position, covariance, laid[row], living, where.drift_m)
        kind = most_of(problem.place, self.recording.detections.class_id[self.intake.used], count)
        rotation = self._as_known(row, rotation, laid[row], living)
        body = find_bodies(self.intake.landmark_id, self.recording.objects)[self.solved.identity[row]]
        return Found(
            names[row], kind[row], laid[row], probability[row], position, covariance,
            body, first[row], last[row], rotation, alone.rotation[row],
            fellows_of(names[row], self.recording.objects, living),
        )  # fmt: skip

    def _as_known(self, row: IntArray, rotation: FloatArray, laid: IntArray, living: LivingMap) -> FloatArray:
        """Orientations (K, 4) of places (K,): of those that look the same the nearest to what the map has, where they
        are laid (K,), or else anywhere.
        """
        alike, names = self.optimum.smoother.problem.symmetries[row], living.places.landmark_id
        found = se3.identity(len(row))
        found[:, 3:] = rotation
        for k in np.flatnonzero((alike.of > 0) & np.isfinite(rotation[:, 0])):
            places = laid[[k]] if laid[k] >= 0 else np.flatnonzero(names == self.landmark_id[row[k]])
            known = living.places.rotation[places]
            if len(known) and np.isfinite(known[-1, 0]):
                found[k] = alike.kinds[alike.of[k]].nearest(found[k], np.append(np.zeros(3), known[-1]))
        return found[:, 3:]

    def watched(self, entry: Extended, config: LivingConfig) -> Watch:
        """Return at which places of the map the session looked: where its own sightings show that it would have seen
        them.

        The detection by range, incidence and direction is learned from what stood (`sensing.learned`).
        """
        eye, which, stamp_s, hits = self._views(entry, config)
        places, axes = entry.living.places, self._axes
        pose, p = np.tile(np.eye(4), (len(stamp_s), 1, 1)), np.zeros((len(stamp_s), len(places)))
        pose[:, :3, 3] = eye[:, :3]
        pose[:, :3, :3] = se3.rotation_of(eye) @ axes[which]
        detected = np.zeros(p.shape, dtype=np.bool_)
        detected[hits] = True
        for sensor in np.unique(which) if len(places) else ():
            mine = np.flatnonzero(which == sensor)
            model = self._model(int(sensor), places.position_m, places.rotation, pose[mine], detected[mine])
            there = _near_hits(stamp_s[mine], detected[mine], config.looks.settled_s)
            some = mine[:: max(1, len(mine) // MOST_VIEWS)]
            chosen = np.isin(mine, some)
            model = learned.watched(model, stamp_s[some], pose[some], detected[some], there[chosen])
            p[mine] = model.p_detect(pose[mine], places.position_m)
        looked = detected | (p >= config.looks.worth_a_look * p.max(initial=0.0))
        view, place = map(np.ascontiguousarray, np.nonzero(looked))
        listed = LooksAt(view, place, p[view, place], detected[view, place])
        heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
        return Watch(stamp_s, listed, np.column_stack([pose[:, 0, 3], pose[:, 1, 3], heading]))

    def _views(
        self, entry: Extended, config: LivingConfig
    ) -> tuple[FloatArray, IntArray, FloatArray, tuple[IntArray, IntArray]]:
        """(V, 7) poses of sensors in the map, (V,) which, (V,) stamps; rows of looks and of places of hits."""
        problem, optimum, frames = self.optimum.smoother.problem, self.optimum, self.intake.frames
        n_sensors = len(problem.mount)
        view = frames.posed[problem.pose_row] * n_sensors + problem.sensor
        views = np.unique(view)
        if n_sensors == 1 and problem.driven:  # it looked in every frame
            views = np.arange(len(frames.row))
        elif problem.driven:
            own = np.zeros((len(frames.row), n_sensors), dtype=np.bool_)
            own.ravel()[views] = True
            views = np.flatnonzero(find_looks(frames.stamp_s, own, config.looks))
        views = views[self._located_frames[views // n_sensors]]
        row, sensor = views // n_sensors, views % n_sensors
        eye = se3.compose(self.path[row], optimum.estimate.mount(problem)[sensor])
        place_of = entry.places_of(self.landmark_id)
        hit = np.flatnonzero((self.inlier >= config.fit.inlier) & (place_of[problem.place] >= 0) & np.isin(view, views))
        at = np.searchsorted(views, view[hit]), place_of[problem.place[hit]]
        return eye, sensor, self.intake.start_s + frames.stamp_s[row], at

    def _model(
        self, sensor: int, position_m: FloatArray, rotation: FloatArray, pose: FloatArray, detected: BoolArray
    ) -> learned.LearnedDetection:
        """The detection model of a sensor before the session: its field is where it has seen anything."""
        problem, told = self.optimum.smoother.problem, self.recording.sensors[sensor]
        settings = problem.settings
        direction, range_m = self._directions(np.flatnonzero((problem.sensor == sensor) & (self.inlier >= EXISTS)))
        camera = told.intrinsics is not None or not np.array_equal(self._axes[sensor], np.eye(3))
        across = direction[:, 0] if camera else np.hypot(direction[:, 0], direction[:, 1])
        azimuth = np.abs(np.arctan2(direction[:, 1], direction[:, 0])).max(initial=0.1) + settings.field_margin_rad
        elevation = np.abs(np.arctan2(direction[:, 2], across)).max(initial=0.1) + settings.field_margin_rad
        widest = np.pi / 2 if camera else np.pi
        view, place = np.nonzero(detected)
        outward = np.zeros_like(position_m)
        turned = np.isfinite(rotation[:, 0])
        outward[turned] = se3.rotation_of(np.hstack([position_m, rotation])[turned])[:, :, 2]
        to_eye = pose[view, :3, 3] - position_m[place]
        cosine = (to_eye * outward[place]).sum(axis=1) / np.maximum(np.linalg.norm(to_eye, axis=1), 1e-9)
        middle = float(np.median(cosine[turned[place]])) if turned[place].any() else 0.0
        faced = abs(middle) > settings.faced
        assumed = Assumed(
            Field(
                min(told.range_max_m, settings.range_margin * float(range_m.max(initial=1.0))),
                float(min(azimuth, widest)),
                float(min(elevation, np.pi / 2)),
                Projection.PINHOLE if camera else Projection.SPHERICAL,
            ),
            fading_m=np.inf,
            viewing_angle_rad=settings.widest_rad if faced else np.pi,
        )
        model = learned.init(position_m, np.arange(len(position_m)), assumed)
        return replace(model, outward=np.sign(middle) * outward if faced else 0.0 * outward)


def solve_visit(
    recording: SpatialRecording,
    config: Config,
    prior_map: Landmarks | None,
    remarks: tuple[str, ...],
    *,
    progress: Progress | None = None,
) -> SpatialVisit:
    """Return a recording with identities solved, by itself or in a map that is given; arguments as of `run_slam`."""
    intake = fit_to_map(_take_in(recording, config, remarks), prior_map, surveyed=True)
    solved = solve_space(intake, prior_map, progress=progress, changes=config.slam.changes)
    return SpatialVisit(recording, intake, solved)


def _take_in(recording: SpatialRecording, config: Config, remarks: tuple[str, ...]) -> SpatialIntake:
    """Return a recording as input of the estimator, with the rests of bodies that move."""
    of_slam = config.slam
    intake = prepare_space(
        recording, of_slam.space, remarks, robust=of_slam.robust, estimate_noise=of_slam.estimate_noise
    )
    return with_rests(intake, recording, config.track.still)


def solve_visits_together(visits: Sequence[SpatialVisit], rules: LocalizeConfig) -> list[SpatialVisit]:
    """Return robots that were solved alone solved as one problem: `slam.space.together`.

    Raises:
        DataError: nothing ties one of them to the others.
    """
    members = [SolvedRobot(visit.intake, visit.solved) for visit in visits]
    solved = solve_space_together(members, [visit.recording.name for visit in visits], rules)
    return [replace(visit, solved=own) for visit, own in zip(visits, solved, strict=True)]


def find_looks(stamp_s: FloatArray, seen: BoolArray, settings: LooksConfig) -> BoolArray:
    """Return (F, S) in which frames several sensors looked, which nothing says of frames in which they saw nothing.

    Sensors look at a beat: of views of one that follow each other, many have detections. A frame on its beat, counted
    from the nearest of these, is a look of it; cameras that take turns, or are triggered together, are told apart so.

    Args:
        stamp_s: (F,) stamps of all frames, rising.
        seen: (F, S) where a sensor has detections.
        settings: what a beat is.
    """
    looks = seen.copy()
    for sensor, own in enumerate(seen.T):
        hit_s = stamp_s[own]
        gap_s = np.diff(hit_s)
        if len(gap_s) < settings.fewest_beats:
            continue
        beat_s = float(np.median(gap_s[gap_s < 1.5 * np.quantile(gap_s, 0.1)]))
        before = np.clip(np.searchsorted(hit_s, stamp_s, side="right") - 1, 0, len(hit_s) - 2)
        beats = np.minimum(np.abs(stamp_s - hit_s[before]), np.abs(stamp_s - hit_s[before + 1])) / beat_s
        looks[:, sensor] |= (np.abs(beats - np.round(beats)) < settings.off_beat) & (
            np.round(beats) <= settings.most_beats
        )
    return looks


def _near_hits(stamp_s: FloatArray, detected: BoolArray, within_s: float) -> BoolArray:
    """(V, K) looks with a detection of the same landmark so shortly before or after."""
    before = np.maximum.accumulate(np.where(detected, stamp_s[:, None], -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(detected, stamp_s[:, None], np.inf)[::-1], axis=0)[::-1]
    return np.asarray((stamp_s[:, None] - before <= within_s) | (after - stamp_s[:, None] <= within_s))


def localise_in_space(
    recording: SpatialRecording,
    living: LivingMap,
    config: Config,
    remarks: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Localised[SpatialVisit]:
    """Return a session solved at its alignment with a map, or with the part of a large one that it can observe. The map
    has the session's classes (`session.admitted`).
    """
    settings, intake = config.living, _take_in(recording, config, remarks)
    large, named = len(living.places) > settings.whole_places, cliques_of(living, names_of(intake).ravel())
    part = Vicinity.of(living, named, settings).part if large else living
    p_site = aged(part, settings, intake.start_s).p_here
    if not len(part.places):
        visit = SpatialVisit(recording, intake, solve_space(intake, None, progress=progress))
        return Localised.lost(visit, living, NOT_FOUND) if large else Localised(visit, visit.named(part))
    stands = standing(part, p_site)
    intake = fit_to_map(intake, stands)
    solved = solve_space(intake, stands, progress=progress)
    visit = SpatialVisit(recording, intake, _name_nearest(intake, solved, part))
    where = _laid(visit, part, p_site, settings)
    if where is None or np.count_nonzero(where.place >= 0) < 2:
        return Localised.lost(visit, living, NOT_FOUND)
    visit = replace(visit, solved=replace(visit.solved, optimum=_hold_places(visit, part, where), from_map=None))
    vicinity = None
    if large:
        vicinity, where = widened(living, part, named, where, visit.path_m, visit.floor_sensor, settings)
        part = vicinity.part
    return Localised(visit, visit.named(part), where, vicinity)


def standing(living: LivingMap, p_site: FloatArray) -> Landmarks:
    """Return landmarks with P(exists) above one half at their most probable places, by beliefs (S,) in the sites."""
    believed = replace(living, sites=replace(living.sites, p_here=p_site), dated=Dated.empty(), stamp_s=-np.inf)
    return believed.landmarks(p_least=EXISTS)


def names_of(intake: SpatialIntake) -> IntArray:
    """Return (K, `MOST_OF_ONE_IDENTITY`) ids that a map may have for landmarks with each identity of a session."""
    called = [intake.names.get(own, own) for own in intake.landmark_id.tolist()]
    others = [[landmark_id_of(numbered(name, k)) for k in range(2, MOST_OF_ONE_IDENTITY + 1)] for name in called]
    others_of = np.array(others, dtype=np.int64).reshape(-1, MOST_OF_ONE_IDENTITY - 1)
    return np.column_stack([intake.landmark_id, others_of])


def _name_nearest(intake: SpatialIntake, solved: SpatialSolved, living: LivingMap) -> SpatialSolved:
    """The session with landmarks of one identity named as the map names those that are nearest."""
    from scipy.optimize import linear_sum_assignment

    number, place = solved.number.copy(), solved.optimum.estimate.place
    for row, names in enumerate(names_of(intake)):
        known = np.flatnonzero(np.isin(names, living.members.landmark_id))
        mine = np.flatnonzero((solved.identity == row) & ~solved.left)
        if len(mine) == 1 and not (known > 0).any():
            continue
        site = living.site_of()[np.searchsorted(living.members.landmark_id, names[known])]
        at = living.places.position_m[living.place_row(names[known], site)]
        nearest = linear_sum_assignment(np.linalg.norm(place[mine, None, :3] - at, axis=2))
        called = dict(zip(nearest[0].tolist(), known[nearest[1]].tolist(), strict=True))
        rest = iter(np.setdiff1d(np.arange(len(names) + len(mine)), known).tolist())
        number[mine] = [1 + (called[k] if k in called else next(rest)) for k in range(len(mine))]
    return replace(solved, number=number)


def _laid(visit: SpatialVisit, living: LivingMap, p_site: FloatArray, config: LivingConfig) -> Laid | None:
    """Return the alignment of the session with the map, from its own information."""
    alone, names, place = by_itself(visit.optimum), visit.landmark_id, visit.optimum.estimate.place
    row, rotation = visit.told(visit.n_fit >= config.fit.sightings_in_place)
    at = se2.xy_rows(row, 3)
    alike = visit.optimum.smoother.problem.symmetries[row]
    turned = Turned(se3.identity(), rotation, alone.rotation[row], alike)
    position = place[row, :3] + alone.shift_m[row]
    return lay_over_map(living, p_site, names[row], position, alone.covariance_m2[np.ix_(at, at)], config, turned)


def _fuse_places(
    position_m: FloatArray, covariance_m2: FloatArray, place: IntArray, living: LivingMap, drift_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return positions (K, 3) and their joint covariance from a session and the map, fused for those with a `place`."""
    stand = np.flatnonzero(place >= 0)
    s = se2.xy_rows(stand, 3)
    known = drifted(of_places(living.covariance_m2, place[stand], 3), drift_m)
    gain = np.linalg.solve(covariance_m2[np.ix_(s, s)] + known, covariance_m2[s]).T
    off = (living.places.position_m[place[stand]] - position_m[stand]).ravel()
    covariance = covariance_m2 - gain @ covariance_m2[s]
    return position_m + (gain @ off).reshape(-1, 3), 0.5 * (covariance + covariance.T)


def _hold_places(visit: SpatialVisit, living: LivingMap, where: Laid) -> SpatialOptimum:
    """Solve the session once more, with matched landmarks constrained to their places in the map."""
    optimum = visit.optimum
    problem, places = optimum.last[0].problem, living.places
    _, row, at = np.intersect1d(visit.landmark_id, where.landmark_id[where.place >= 0], return_indices=True)
    place = where.place[where.place >= 0][at]
    pose = se3.identity(len(row))
    pose[:, :3] = places.position_m[place]
    turned = np.isfinite(places.rotation[place, 0]) & problem.oriented[row]
    pose[turned, 3:] = places.rotation[place[turned]]
    sigma = np.full((len(row), 6), ANY_RAD)
    own = blocks(living.covariance_m2, 3)[place]
    sigma[:, :3] = np.sqrt(np.trace(own, axis1=1, axis2=2) / 3.0 + where.drift_m**2)[:, None]
    unseen = problem.symmetries[row].unseen
    spread = np.einsum("kii,ki->k", places.rotation_covariance[place], 1.0 - unseen) / (3.0 - unseen.sum(axis=1))
    sigma[turned, 3:] = np.sqrt(spread[turned] + problem.settings.map.drift_rad**2)[:, None]
    sigma[:, 3:][unseen > 0.0] = ANY_RAD
    prior = PlacePrior(row.astype(np.int64), pose, sigma, np.ones(len(row)))
    problem = replace(problem, prior=prior, start_sigma=FREE)
    return converge_again(optimum, problem, optimum.estimate)
