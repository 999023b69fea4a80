"""A session in the plane: solved alone, aligned with a map, solved again with the map as its prior."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from evermap.config import Config, LivingConfig, MetreConfig, SlamConfig
from evermap.errors import DataError, NumericalError
from evermap.estimate.tie import without_frames
from evermap.geometry import se2
from evermap.geometry.chunked import of_places
from evermap.geometry.rigid import rigid
from evermap.maps.living import LivingMap, Metres
from evermap.maps.sessions import believe, gaussian, placing
from evermap.maps.sessions.extend import Extended, Found, fellows_of, first_and_last
from evermap.maps.sessions.gaussian import OwnLandmarks
from evermap.maps.sessions.looks import Sighting, Watch
from evermap.maps.sessions.overlay import ELSEWHERE
from evermap.maps.sessions.placing import Held, Laid, Localised
from evermap.maps.vicinity import Vicinity, cliques_of
from evermap.slam import result as of_slam
from evermap.slam.batch import Outcome, silent_links
from evermap.slam.cleaning import some_frames
from evermap.slam.estimate import Solved, solve
from evermap.slam.intake import find_bodies
from evermap.slam.mistake_search import unusable
from evermap.types import UNKNOWN, BoolArray, FloatArray, IntArray, Recording, Sensor, SlamResult


@dataclass(frozen=True, slots=True)
class PlanarVisit:
    """A session in the plane, in a frame of its own or in that of a map.

    Attributes:
        solved: the recording and its estimate.
    """

    solved: Solved
    witnessed = believe.Witnessed.nothing()
    """Observed arrivals and departures: none, since nothing is tracked."""

    @property
    def recording(self) -> Recording:
        """The recording as it was used."""
        return self.solved.recording

    @property
    def used(self) -> Recording:
        """The recording of which `concluded` names rows."""
        return self.recording

    @property
    def span_s(self) -> tuple[float, float]:
        """Stamps of the first frame that has a pose, and of the last one that was processed."""
        return self.solved.start_s, self.solved.end_s

    @property
    def floor_sensor(self) -> Sensor:
        """The sensor."""
        return self.recording.sensor

    def concluded(self, scratch: str = "first_pose") -> SlamResult:
        """Return the session as the estimator has it; without a map in the frame that is called `scratch`."""
        return of_slam.concluded(self.solved, scratch)

    def begun(self, living: LivingMap) -> LivingMap:
        """Return an empty map with the scale of this session, its first."""
        variance = self.solved.outcome.log_scale_sigma**2
        information = 1.0 / variance if variance > 0.0 else np.inf
        living = replace(living, log_size_variance=variance, log_size_information=information)
        if robot := self.recording.robot:
            living = replace(living, metres=Metres.of(robot, variance, information))
        return living

    def found(self, where: Laid | None, living: LivingMap, config: LivingConfig) -> Found:
        """Return the landmarks of the session in the frame of a map; None for `where` begins one."""
        visit = self.solved
        begins, in_place = where is None, None
        if where is not None:
            in_place = np.searchsorted(visit.prepared.landmark_id, where.landmark_id[where.place >= 0])
        own = gaussian.own_landmarks(visit.outcome, config.fit, in_place)
        detection, landmark = _inliers(visit, config.fit.inlier)
        stamps = visit.recording.frames.stamp_s[visit.recording.detections.frame[detection]]
        count = len(visit.prepared.landmark_id)
        first, last = first_and_last(landmark, stamps, count)
        kind = np.full(count, UNKNOWN, dtype=np.int64)
        kind[landmark] = visit.recording.detections.class_id[detection]
        seen = np.flatnonzero(np.isfinite(last[own.row]))
        row = own.row[seen]
        names = visit.prepared.landmark_id[row]
        place, probability = placing.places_in(where, names)
        covariance = own.begun(seen, config.whole_places) if begins else of_places(own.covariance_m2, seen)
        body = find_bodies(names, visit.recording.objects)
        return Found(
            names, kind[row], place, probability, own.position_m[seen], covariance, body, first[row], last[row],
            fellow=fellows_of(names, visit.recording.objects, living),
        )  # fmt: skip

    def watched(self, entry: Extended, config: LivingConfig) -> Watch:
        """Return at which places of the map the session looked, by the nominal field of view."""
        visit = self.solved
        recording, prepared = visit.recording, visit.prepared
        stamps = recording.frames.stamp_s
        frames = np.flatnonzero((stamps >= visit.start_s) & (stamps <= visit.end_s + 1e-9)).astype(np.int64)
        pose, _ = of_slam.poses_at(visit, stamps[frames])
        detection, landmark = _inliers(visit, config.fit.inlier)
        place_of = entry.places_of(prepared.landmark_id)
        _place_glimpsed(place_of, entry, visit, config.fit.glimpse_m)
        hit = place_of[landmark]
        frame = np.searchsorted(frames, recording.detections.frame[detection])
        sighting = Sighting(stamps[frames], pose, frame[hit >= 0], hit[hit >= 0])
        return Watch.of(sighting, entry.living.places.position_m, recording.sensor, config.looks)


def prepare_alone(recording: Recording, config: Config) -> tuple[Recording, SlamConfig]:
    """Return a cleaned session with known identities, and the settings, for its solution alone: moves are searched for
    after its alignment with the map.
    """
    settings = config.slam.model_copy(update={"method": "nohyp", "unknown_ids": False})
    return replace(recording, measurements=without_frames(recording.measurements)), settings


def localised(alone: Solved, living: LivingMap, config: Config, *, cut: bool = True) -> Localised[PlanarVisit]:
    """Return a session that was solved alone, solved again at its alignment with a map, whose classes it has
    (`session.admitted`); and `cut`, without doubtful frames (`doubtful`), if there are any.
    """
    settings, known = config.living, len(living.places) > 0
    lost = functools.partial(Localised.lost, PlanarVisit(alone), living)
    contradicted = placing.CONTRADICTED if known else placing.DISTORTED
    joint = settings.search == "joint"
    wrong = unusable(alone.recording, config.slam.check) if joint and cut else None
    if wrong is not None and not wrong.usable:
        return lost((wrong.message, placing.ANYWAY))
    if wrong is not None and known:
        return lost(contradicted)
    large, own = len(living.places) > settings.whole_places, gaussian.own_landmarks(alone.outcome, settings.fit)
    vicinity, where = near_session(living, alone, own, settings) if large else (None, None)
    part, visit = living if vicinity is None else vicinity.part, alone
    p_site = believe.aged(part, settings, alone.start_s).p_here
    where = where if large else laid(part, p_site, alone, own, settings)
    if where is None and len(part.places):
        return lost(placing.NOT_FOUND)
    if where is not None and where.reason:
        return lost((where.reason, placing.ANYWAY))
    if where is not None:
        in_part = vicinity is not None
        part, where, visit = refit(part, p_site, where, alone, own, settings, robust=config.slam.robust, part=in_part)
    if joint:
        if cut:
            some = without(visit, *doubtful(visit, where, settings))
            if some is None:
                return lost(contradicted)
            if some is not visit.recording:
                try:
                    rest = solve(*prepare_alone(some, config), remarks=visit.prepared.warnings)
                    return localised(rest, living, config, cut=False)
                except (DataError, NumericalError):  # too little is left
                    return lost(contradicted)
        # what fits together by itself does not fit once it is held there
        if where is not None and visit.outcome.inlier.mean() < settings.fit.least_fit * alone.outcome.inlier.mean():
            return lost(contradicted)
    return Localised(PlanarVisit(visit), part, where, vicinity)


def laid(living: LivingMap, p_site: FloatArray, alone: Solved, own: OwnLandmarks, config: LivingConfig) -> Laid | None:
    """Return the alignment of the session, by its own landmarks, with the map; None if no landmarks match."""
    names = alone.prepared.landmark_id[own.row]
    log_sigma = float(np.hypot(alone.outcome.log_scale_sigma, np.sqrt(living.log_size_variance)))
    where = placing.lay_over_map(
        living, p_site, names, own.position_m, gaussian.of_unknown_size(own, log_sigma), config
    )
    if where is None or np.sum(where.place >= 0) < 2:  # one landmark says nothing of a heading
        return None
    if where.reason:
        return where
    if config.search == "joint":
        together = _count_together(alone, own.row, config.fit.inlier)
        where = placing.unbent(living, p_site, where, own.position_m, together, config.fit)
    glimpsed = alone.prepared.landmark_id[np.setdiff1d(np.flatnonzero(alone.outcome.estimate.known), own.row)]
    return placing.with_glimpsed(living, where, glimpsed)


def _count_together(alone: Solved, row: IntArray, least: float) -> sparse.csr_array:
    """(K, K) frames in which two landmarks of a session, rows of its problem, were seen where they are."""
    fits = alone.outcome.inlier >= least
    problem = alone.outcome.problem
    landmark, pose = (rows[: len(fits)][fits] for rows in (problem.landmark_row, problem.pose_row))
    rank = np.full(len(problem.landmark_mean), -1, dtype=np.int64)
    rank[row] = np.arange(len(row))
    known = rank[landmark] >= 0
    ones = np.ones(int(known.sum()))
    seen = sparse.csr_array((ones, (rank[landmark[known]], pose[known])), shape=(len(row), len(problem.stamp_s)))
    return sparse.csr_array(seen @ seen.T)


def near_session(
    living: LivingMap, alone: Solved, own: OwnLandmarks, config: LivingConfig
) -> tuple[Vicinity, Laid | None]:
    """Return the part of a large map that a session can observe, and its alignment there; None as of `laid`.

    That is what the sensor may have seen on its way, once the session is laid over those that it names, and some more.
    """
    named = cliques_of(living, alone.prepared.landmark_id[own.row])
    seen = Vicinity.of(living, named, config)
    where = laid(seen.part, believe.aged(seen.part, config, alone.start_s).p_here, alone, own, config)
    if where is None or where.reason:
        return seen, where
    path = se2.transform(where.pose_map_session, alone.outcome.estimate.pose[:, :2])
    return placing.widened(living, seen.part, named, where, path, alone.recording.sensor, config)


def refit(
    living: LivingMap,
    p_site: FloatArray,
    where: Laid,
    alone: Solved,
    own: OwnLandmarks,
    config: LivingConfig,
    *,
    robust: bool,
    part: bool,
) -> tuple[LivingMap, Laid, Solved]:
    """Return the session solved again with its matched landmarks constrained by the map, and the rescaled map.

    A session that had to be straightened for that is asked again what stands where it stood. Where the map is only a
    part of a larger one it keeps its size.
    """
    outcome, names = alone.outcome, alone.prepared.landmark_id
    size = outcome.scale
    if outcome.log_scale_sigma > 0.0:
        _, mine, theirs = np.intersect1d(names[own.row], where.landmark_id[where.place >= 0], return_indices=True)
        places = where.place[where.place >= 0][theirs]
        shown = gaussian.log_ratio(
            own.position_m[mine],
            of_places(own.covariance_m2, mine),
            living.places.position_m[places],
            gaussian.drifted(of_places(living.covariance_m2, places), where.drift_m),
        )
        own_metre = 0.0, outcome.log_scale_sigma
        if part:  # it does not change the metre of the rest
            found = gaussian.settled(*shown, own_metre, living.log_size_variance, np.inf, config.metre)
        else:
            found, metres = gaussian.settle_scales(shown, own_metre, living, alone.recording.robot, config.metre)
            living = gaussian.resize(living, found, metres)
        size *= found.session_factor
        alone = _add_remark(alone, shown[0], found, config.metre)

    hold = functools.partial(_hold, outcome, names, living, size)
    solve_held = functools.partial(placing.refitted, outcome, outcome.prior, settings=config.fit, robust=robust)
    solved, straightened = solve_held(*hold(where))
    if where.assumed.any() and solved.inlier.mean() < (1.0 - config.fit.most_lost) * outcome.inlier.mean():
        place = np.where(where.assumed, ELSEWHERE, where.place)
        as_seen = replace(where, place=place, assumed=np.zeros_like(where.assumed))
        other, straightened_too = solve_held(*hold(as_seen))
        if other.inlier.mean() > solved.inlier.mean():  # it was not bent: they did move together
            where, solved, straightened = as_seen, other, straightened_too
    if straightened:
        # where it lies if nothing has moved
        at_home = replace(where, place=np.where(where.place >= 0, where.place, placing.homes(living, p_site, where)))
        solved, _ = solve_held(*hold(at_home))
        landmark = alone.prepared.problem.landmark_row[: len(solved.inlier)]
        n_fit, count = (np.bincount(landmark, w, minlength=len(names)) for w in (solved.inlier, np.ones(len(landmark))))
        stays = (2.0 * n_fit > count)[np.searchsorted(names, where.landmark_id)]
        where = replace(
            where,
            place=np.where(stays, at_home.place, where.place),
            probability=np.where(stays, 1.0, where.probability),
        )
        solved, _ = solve_held(*hold(where))
    return living, where, replace(alone, outcome=solved)


def _hold(
    outcome: Outcome, landmark_id: IntArray, living: LivingMap, size: float, where: Laid
) -> tuple[FloatArray, float, Held]:
    """Return where the frame of a session is in the map (3,), `size`, and its landmarks (L,) that a map holds."""
    stand = np.flatnonzero(where.place >= 0)
    row = np.searchsorted(landmark_id, where.landmark_id[stand])
    position = living.places.position_m[where.place[stand]]
    motion = rigid(outcome.graph_estimate.landmark[row] * size, position)
    covariance = gaussian.drifted(of_places(living.covariance_m2, where.place[stand]), where.drift_m)
    return motion, size, Held(row, position, covariance)


def _add_remark(alone: Solved, log_ratio: float, found: gaussian.Size, settings: MetreConfig) -> Solved:
    """A session with a remark where its metre contradicts the map's, or its robot's those of the others."""
    contradicts = found.off > settings.contradicts
    if not (contradicts or found.apart):
        return alone
    off, than = (-log_ratio, "the map's") if contradicts else (found.apart, "that of all robots of the map together")
    by = f"{found.off:.1f} standard deviations" if contradicts else "more than these differ"
    remark = (
        f"its metre is {abs(off):.1%} {'shorter' if off < 0.0 else 'longer'} than {than}, {by}: its ranges or its "
        "odometer have drifted; it is entered in the scale of the map"
    )
    return replace(alone, prepared=replace(alone.prepared, warnings=(*alone.prepared.warnings, remark)))


def doubtful(visit: Solved, where: Laid | None, config: LivingConfig) -> tuple[BoolArray, BoolArray]:
    """Return (F,) frames of a session that nothing ties to the rest, and (F,) that contradict it: neither are entered.

    Where the odometry was silent, a session falls into parts, if what was seen does not tie them. Those that show none
    of the map, or in a map that begins, all but the largest, may be anywhere. And where most sightings of a stretch
    contradict all others, its poses are wrong, or the identities.
    """
    outcome, settings = visit.outcome, config.fit
    problem, pose, marginals = outcome.problem, outcome.graph_estimate.pose, outcome.graph_marginals
    n_poses, n_seen = len(pose), len(outcome.inlier)
    loose = silent_links(problem, outcome.graph_estimate, visit.settings.odometry.loose_rad)
    if loose.any():
        carry = se2.adjoint(se2.between(pose[1:], pose[:-1]))
        across = carry @ marginals.consecutive[:-1]
        spread = carry @ marginals.pose[:-1] @ carry.transpose(0, 2, 1) + marginals.pose[1:]
        spread -= across + across.transpose(0, 2, 1)
        off_m = np.sqrt(np.maximum(np.linalg.eigvalsh(spread[:, :2, :2])[:, -1], 0.0))
        loose &= (spread[:, 2, 2] > settings.loose_rad**2) | (off_m > settings.loose_m)
    part = np.append(0, np.cumsum(loose))
    row, landmark = problem.pose_row[:n_seen], problem.landmark_row[:n_seen]
    counts = outcome.inlier >= settings.inlier
    if where is not None:
        held = np.isin(visit.prepared.landmark_id, where.landmark_id[where.place >= 0])
        counts &= np.append(held, np.zeros(len(problem.landmark_mean) - len(held), dtype=np.bool_))[landmark]
    of_part = np.unique(np.column_stack([part[row[counts]], landmark[counts]]), axis=0)[:, 0]
    shown = np.bincount(of_part, minlength=part[-1] + 1)
    tied = shown >= 2 if where is not None else np.arange(len(shown)) == np.argmax(np.bincount(part[row], counts))
    window = min(settings.bent_windows * settings.window, n_seen)
    fits = np.convolve(outcome.inlier, np.ones(window) / window, "valid")
    first = np.clip(np.searchsorted(row, np.arange(n_poses)) - window // 2, 0, len(fits) - 1)
    frames = np.arange(len(visit.recording.frames))
    at = np.searchsorted(visit.prepared.pose_frame, frames)
    before, after = np.clip(at - 1, 0, n_poses - 1), np.minimum(at, n_poses - 1)
    seen = visit.prepared.pose_frame[after] == frames

    def of_frames(wrong: BoolArray) -> BoolArray:
        return np.asarray(np.where(seen, wrong[after], wrong[before] | wrong[after]))

    return of_frames(~tied[part]), of_frames(fits[first] < settings.inlier)


def without(visit: Solved, untied: BoolArray, wrong: BoolArray) -> Recording | None:
    """Return the recording of a session without frames (F,) that are untied or wrong, see `doubtful`; None where most
    of what is tied contradicts the rest.
    """
    recording, doubt = visit.recording, untied | wrong
    if not doubt.any():
        return recording
    some = some_frames(recording, ~doubt)
    n_tied = np.count_nonzero(~untied[recording.detections.frame])
    if 2 * len(some.detections) < n_tied or len(np.unique(some.detections.frame)) < 2:
        return None
    start_s = recording.frames.stamp_s[0]
    spans = np.flatnonzero(np.diff(np.concatenate([[False], doubt, [False]])))
    after_s = recording.frames.stamp_s - start_s
    told = ", ".join(f"{after_s[a]:.0f} to {after_s[b - 1]:.0f} s" for a, b in spans.reshape(-1, 2)[:3])
    remark = (
        f"{int(doubt.sum())} frames left out ({told}{', ...' if len(spans) > 6 else ''} after the first): most of "
        f"their detections contradict the rest, or the odometry was silent and nothing connects them to it"
    )
    return replace(some, warnings=(*recording.warnings, remark))


def _place_glimpsed(place_of: IntArray, entry: Extended, visit: Solved, near_m: float) -> None:
    """Sightings too few for a place of their own are of the place that the map has, if they are near it."""
    living, estimate = entry.living, visit.outcome.estimate
    names = visit.prepared.landmark_id
    known = estimate.known[: len(names)]  # a method may have given landmarks further places, behind these
    row = np.flatnonzero((place_of < 0) & known & np.isin(names, living.members.landmark_id))
    member = np.searchsorted(living.members.landmark_id, names[row])
    place = living.place_row(names[row], living.site_of()[member])
    row, place = row[place >= 0], place[place >= 0]
    near = np.hypot(*(estimate.landmark[row] - living.places.position_m[place]).T) < near_m
    place_of[row[near]] = place[near]


def _inliers(visit: Solved, least: float) -> tuple[IntArray, IntArray]:
    """Return rows of the inlier detections, and of their landmarks."""
    good = np.flatnonzero(visit.outcome.inlier >= least)
    return visit.prepared.used[good], visit.prepared.problem.landmark_row[good]
