"""The steps of a session in a living map, in the order in which `pipeline.run_session` takes them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy import sparse

from evermap.config import LivingConfig
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.geometry.chunked import of_places
from evermap.geometry.rigid import rigid
from evermap.maps.bodies import without_missed
from evermap.maps.learning import ClassLives
from evermap.maps.living import EXISTS, Evidence, LivingMap, Metres, clique_rows
from evermap.maps.sessions import believe, decide
from evermap.maps.sessions.extend import Extended, Found, extended
from evermap.maps.sessions.gaussian import (
    CONTRADICTS,
    Size,
    drifted,
    log_ratio,
    of_unknown_size,
    own_landmarks,
    resized,
    settled,
    settled_by,
)
from evermap.maps.sessions.looks import PlaceLooks, Sighting, Watch, arrivals, looked_at
from evermap.maps.sessions.placing import Held, Laid, all_at_home, laid_over, refitted, unbent, with_glimpsed
from evermap.maps.sessions.spatial import SpatialVisit
from evermap.maps.sessions.witnessed import arrived, departed
from evermap.maps.vicinity import Vicinity, cliques_of, in_chunks, near
from evermap.show import Shown
from evermap.slam import result as of_slam
from evermap.slam.cleaning import some_frames
from evermap.slam.estimate import Solved
from evermap.slam.streaming import Outcome, silent_links
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    BoolArray,
    FloatArray,
    IntArray,
    MapChange,
    Misses,
    Recording,
    Sensor,
    SlamResult,
    SpatialRecording,
    landmark_id_of,
    rows_of,
)

RecordingT = TypeVar("RecordingT", Recording, SpatialRecording)

Visit = Solved | SpatialVisit
"""A session that is solved, in the plane or in space."""
NOT_FOUND = (
    "too few of its landmarks were seen standing to each other as it says",
    "begin another map with it, or first enter a session that sees both",
)
CONTRADICTED = (
    "most sightings contradict it or each other; the session is bent, or of another place",
    "`evermap check` names what is odd; `--set living.search=gate` enters it all the same, by what most agree on",
)
"""Why a session cannot be localised in a map, and what to try."""
STRETCH = 3
"""Windows of sightings that contradict the rest where poses are wrong: a few misread ones are outliers, and no more."""


@dataclass(frozen=True, slots=True)
class Session(Shown):
    """What a session made of a map.

    Attributes:
        living: the map after it.
        found: False where the session could not be found in the map, which then stays as it was.
        recording: as it was used: repaired, with the map's class numbers, without deleted landmarks; rows of `slam`
            that name detections and frames are rows of it.
        slam: trajectory, landmarks and all else, in the map's frame.
        changes: what appeared, vanished, moved, was exchanged or returned since the session before.
        evidence: what was seen of every clique, frame by frame.
        set_aside: why it was not found, and what to try; empty where it was.
    """

    living: LivingMap
    found: bool
    recording: AnyRecording
    slam: SlamResult
    changes: tuple[MapChange, ...]
    evidence: Evidence
    set_aside: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Believed:
    """The map with the session's beliefs.

    Attributes:
        living: all but stays and what is learned.
        log_evidence: (C,) what the session's looks say for 'it stands at one of its sites' against 'it is away', as a
            log likelihood ratio, by clique, in the order of `living.clique_rows`.
        evidence: of every clique and frame.
    """

    living: LivingMap
    log_evidence: FloatArray
    evidence: Evidence


def admitted(recording: RecordingT, living: LivingMap) -> tuple[RecordingT, LivingMap]:
    """Return the recording without landmarks that an operator deleted, and with the map's class numbers.

    Raises:
        DataError: another clock than the map's, or of the plane where that is of space.
    """
    if (living.dim == 3) != isinstance(recording, SpatialRecording):
        of = {2: "the plane", 3: "space"}
        raise DataError(
            f"{recording.name}: a recording in {of[5 - living.dim]}, the map is of {of[living.dim]}",
            field="living",
            hint="one map file each",
        )
    if len(living.places) and recording.clock != living.clock:
        raise DataError(
            f"{recording.name}: its stamps count '{recording.clock}', the map's '{living.clock}'",
            field="stamp_s",
            hint="sessions of one map need one clock, best seconds since 1970",
        )
    names = living.class_names + tuple(name for name in recording.class_names if name not in living.class_names)
    number = np.array([names.index(name) for name in recording.class_names] + [UNKNOWN], dtype=np.int64)
    kept = ~np.isin(recording.detections.landmark_id, living.members.landmark_id[living.members.deleted])
    detections = rows_of(recording.detections, kept)
    detections = replace(detections, class_id=number[detections.class_id])
    return replace(recording, detections=detections, class_names=names), replace(
        living,
        class_names=names,
        landmark_texts=tuple(sorted({*living.landmark_texts, *recording.landmark_names.values()})),
        clock=recording.clock,
    )


def check_in_order(recording: AnyRecording, living: LivingMap) -> None:
    """Raise `DataError` for a session that begins before the newest one of the map."""
    stamps = recording.frames.stamp_s
    if len(stamps) and stamps[0] < living.session_start_s:
        raise DataError(
            f"{recording.name}: begins at {stamps[0]:.1f} s, before the newest session of the map, "
            f"{living.session_start_s:.1f} s",
            field="stamp_s",
            hint="evermap.enter_session(store, recording), or evermap slam --map FILE, enter it where it belongs",
        )


def laid(living: LivingMap, p_site: FloatArray, alone: Solved, config: LivingConfig) -> Laid | None:
    """Return where the session lies in the map; None where it shows nothing that stands as in the map."""
    own = own_landmarks(alone.outcome, config.fit)
    names = alone.prepared.landmark_id[own.row]
    log_sigma = np.hypot(alone.outcome.log_scale_sigma, np.sqrt(living.log_size_variance))
    where = laid_over(living, p_site, names, own.position_m, of_unknown_size(own, float(log_sigma)), config)
    if where is None or np.sum(where.place >= 0) < 2:  # one landmark says nothing of a heading
        return None
    if config.search == "joint":
        together = _seen_together(alone, own.row, config.fit.inlier)
        where = unbent(living, p_site, where, own.position_m, together, config.fit)
    glimpsed = alone.prepared.landmark_id[np.setdiff1d(np.flatnonzero(alone.outcome.estimate.known), own.row)]
    return with_glimpsed(living, where, glimpsed)


def _seen_together(alone: Solved, row: IntArray, least: float) -> sparse.csr_array:
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


def near_session(living: LivingMap, alone: Solved, config: LivingConfig) -> tuple[Vicinity, Laid | None]:
    """Return the part of a large map that a session can touch, and where the session lies in it; None as of `laid`.

    That is what the sensor may have seen on its way, once the session is laid over those that it names, and some more.
    """
    own = own_landmarks(alone.outcome, config.fit)
    named = cliques_of(living, alone.prepared.landmark_id[own.row])
    seen = Vicinity.of(living, named, config)
    where = laid(seen.part, believe.aged(seen.part, config, alone.start_s).p_here, alone, config)
    if where is None:
        return seen, None
    path = se2.transform(where.pose_map_session, alone.outcome.estimate.pose[:, :2])
    return widened(seen, where, path, alone.recording.sensor, config)


def widened(
    seen: Vicinity, where: Laid, path_m: FloatArray, sensor: Sensor, config: LivingConfig
) -> tuple[Vicinity, Laid]:
    """Return the part of a large map with all that a sensor may have seen on a path (N, 2 or 3), and where a session
    lies in it.
    """
    living, reach_m = seen.whole, sensor.range_max_m + config.near_m
    cliques, box = living.sites.clique_id, np.array([-np.inf, -np.inf, np.inf, np.inf])
    if np.isfinite(reach_m):  # else all there is may be in view
        cliques, box = near(living, path_m, reach_m)
    vicinity = Vicinity.of(living, np.union1d(np.unique(seen.part.sites.clique_id), cliques), config, box)
    at = where.place >= 0
    place = where.place.copy()
    places = seen.part.places[place[at]]
    place[at] = vicinity.part.place_row(places.landmark_id, places.site_id)
    return vicinity, replace(where, place=place)


def around(living: LivingMap, where: Laid, visit: SpatialVisit, config: LivingConfig) -> tuple[Vicinity, Laid]:
    """Return the part of a large map that a session can touch, and where it lies there, by rows of the whole."""
    at = where.place >= 0
    seen = Vicinity.of(living, cliques_of(living, where.landmark_id[at]), config)
    place, places = where.place.copy(), living.places[where.place[at]]
    place[at] = seen.part.place_row(places.landmark_id, places.site_id)
    return widened(seen, replace(where, place=place), visit.path_m, visit.floor_sensor, config)


def refit(
    living: LivingMap, p_site: FloatArray, where: Laid, alone: Solved, config: LivingConfig, *, robust: bool, part: bool
) -> tuple[LivingMap, Laid, Solved]:
    """Return the session solved again, its landmarks held by the map's places at which they stand; and the map,
    resized.

    A session that had to be straightened for that is asked again what stands where it stood. Where the map is only a
    part of a larger one it keeps its size.
    """
    outcome, names = alone.outcome, alone.prepared.landmark_id
    size = outcome.scale
    if outcome.log_scale_sigma > 0.0:
        own = own_landmarks(outcome, config.fit)
        _, mine, theirs = np.intersect1d(names[own.row], where.landmark_id[where.place >= 0], return_indices=True)
        places = where.place[where.place >= 0][theirs]
        shown = log_ratio(
            own.position_m[mine],
            of_places(own.covariance_m2, mine),
            living.places.position_m[places],
            drifted(of_places(living.covariance_m2, places), where.drift_m),
        )
        own_metre = 0.0, outcome.log_scale_sigma
        if part:  # it does not change the metre of the rest
            found = settled(*shown, own_metre, living.log_size_variance, np.inf)
        else:
            found, metres = settled_by(shown, own_metre, living, alone.recording.robot)
            living = resized(living, found, metres)
        size *= found.session_factor
        alone = _remarked(alone, shown[0], found)

    def in_map(where: Laid) -> tuple[Outcome, bool]:
        stand = np.flatnonzero(where.place >= 0)
        row = np.searchsorted(names, where.landmark_id[stand])
        position = living.places.position_m[where.place[stand]]
        motion = rigid(outcome.graph_estimate.landmark[row] * size, position)
        covariance = drifted(of_places(living.covariance_m2, where.place[stand]), where.drift_m)
        return refitted(
            outcome, outcome.prior, motion, size, Held(row, position, covariance), settings=config.fit, robust=robust
        )

    solved, straightened = in_map(where)
    if where.assumed.any() and solved.inlier.mean() < (1.0 - config.fit.most_lost) * outcome.inlier.mean():
        as_seen = where.as_seen()
        other, straightened_too = in_map(as_seen)
        if other.inlier.mean() > solved.inlier.mean():  # it was not bent: they did move together
            where, solved, straightened = as_seen, other, straightened_too
    if straightened:
        at_home = all_at_home(living, p_site, where)
        solved, _ = in_map(at_home)
        landmark = alone.prepared.problem.landmark_row[: len(solved.inlier)]
        n_fit, count = (np.bincount(landmark, w, minlength=len(names)) for w in (solved.inlier, np.ones(len(landmark))))
        stays = (2.0 * n_fit > count)[np.searchsorted(names, where.landmark_id)]
        where = replace(
            where,
            place=np.where(stays, at_home.place, where.place),
            probability=np.where(stays, 1.0, where.probability),
        )
        solved, _ = in_map(where)
    return living, where, replace(alone, outcome=solved)


def _remarked(alone: Solved, log_ratio: float, found: Size) -> Solved:
    """A session with a remark where its metre contradicts the map's, or its robot's those of the others."""
    contradicts = found.off > CONTRADICTS
    if not (contradicts or found.apart):
        return alone
    off, than = (-log_ratio, "the map's") if contradicts else (found.apart, "that of all robots of the map together")
    by = f"{found.off:.1f} standard deviations" if contradicts else "more than these differ"
    remark = (
        f"its metre is {abs(off):.1%} {'shorter' if off < 0.0 else 'longer'} than {than}, {by}: its ranges or its "
        "odometer have drifted; it is entered in the metres of the map"
    )
    return replace(alone, prepared=replace(alone.prepared, warnings=(*alone.prepared.warnings, remark)))


def fits(visit: Solved, alone: Solved, config: LivingConfig) -> bool:
    """Return False for a session that the map contradicts: what fits together by itself does not fit once it is held
    there.
    """
    return bool(visit.outcome.inlier.mean() >= config.fit.least_fit * alone.outcome.inlier.mean())


def doubtful(visit: Solved, where: Laid | None, config: LivingConfig) -> BoolArray:
    """Return (F,) frames of a session that say nothing sure: they are not entered.

    Where the odometry was silent, a session falls into parts, if what was seen does not tie them. Those that show none
    of the map, or in a map that begins, all but the largest, may be anywhere. And where most sightings of a stretch
    contradict all others, its poses are wrong, or the identities.

    Args:
        visit: the session, solved with the map as its prior.
        where: it lies in the map; None for a map's first.
        config: `fit`.
    """
    outcome, settings = visit.outcome, config.fit
    problem, pose, marginals = outcome.problem, outcome.graph_estimate.pose, outcome.graph_marginals
    n_poses, n_seen = len(pose), len(outcome.inlier)
    loose = silent_links(problem, outcome.graph_estimate)
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
    window = min(STRETCH * settings.window, n_seen)
    fits = np.convolve(outcome.inlier, np.ones(window) / window, "valid")
    first = np.clip(np.searchsorted(row, np.arange(n_poses)) - window // 2, 0, len(fits) - 1)
    wrong = ~tied[part] | (fits[first] < settings.inlier)
    frames = np.arange(len(visit.recording.frames))
    at = np.searchsorted(visit.prepared.pose_frame, frames)
    before, after = np.clip(at - 1, 0, n_poses - 1), np.minimum(at, n_poses - 1)
    seen = visit.prepared.pose_frame[after] == frames
    return np.asarray(np.where(seen, wrong[after], wrong[before] | wrong[after]))


def without(visit: Solved, doubt: BoolArray) -> Recording | None:
    """Return the recording of a session without doubtful frames (F,); None where that is most of it."""
    recording = visit.recording
    if not doubt.any():
        return recording
    frames, detections = some_frames(recording.frames, recording.detections, ~doubt)
    if 2 * len(detections) < len(recording.detections) or len(np.unique(detections.frame)) < 2:
        return None
    start_s = recording.frames.stamp_s[0]
    spans = np.flatnonzero(np.diff(np.concatenate([[False], doubt, [False]])))
    after_s = recording.frames.stamp_s - start_s
    told = ", ".join(f"{after_s[a]:.0f} to {after_s[b - 1]:.0f} s" for a, b in spans.reshape(-1, 2)[:3])
    remark = (
        f"{int(doubt.sum())} frames left out ({told}{', ...' if len(spans) > 6 else ''} after the first): most of what "
        "they show contradicts the rest, or the odometry was silent and nothing ties them to it"
    )
    return replace(recording, frames=frames, detections=detections, warnings=(*recording.warnings, remark))


@dataclass(frozen=True, slots=True)
class Judged:
    """What a session says of a map.

    Attributes:
        living: the map after it.
        changes: what changed since the session before.
        evidence: what was seen of every clique, frame by frame.
        misses: of landmarks at the places where they most probably stand, as the map counts them.
        classes: what was learned of the lifetimes of classes; None where nothing is.
        found: landmarks of the session.
    """

    living: LivingMap
    changes: tuple[MapChange, ...]
    evidence: Evidence
    misses: Misses
    classes: ClassLives | None
    found: Found


def judged(
    living: LivingMap, where: Laid | None, visit: Visit, config: LivingConfig, known: Judged | None = None
) -> Judged:
    """Return the map after the session, what changed, and what was seen and missed.

    What was found goes into the map, then hits and misses into beliefs, and those into decisions.

    Args:
        living: the map before the session, resized to it.
        where: the session lies in the map; None for a map's first.
        visit: the session, solved with the map as its prior.
        config: which parts of the engine are on.
        known: the same, judged without knowing what the session teaches of lifetimes; None for the first time.
    """
    if known is not None:
        living = replace(living, lives=replace(known.living.lives, looks_s=living.lives.looks_s))
    living = replace(living, sightlines=replace(living.sightlines, rules=config.sight))
    aged = believe.aged(living, config, visit.start_s)
    living = replace(living, sites=replace(living.sites, p_kept=aged.p_kept))
    found = found_in(living, where, visit, config) if known is None else known.found
    entry = entered(living, aged.p_here, where, found, visit, config)
    seen, eye = looks(entry, visit, config)
    now = believed(entry, seen, _sensor(visit), (visit.start_s, visit.end_s), config)
    now, seen = _without_departed(entry, now, seen, visit)
    after, changes = decided(entry, now, seen, visit, config, known.classes if known is not None else None)
    after, classes = learned(after, seen, replace(entry, living=now.living), eye, config)
    return Judged(after, changes, now.evidence, missed(now.living, seen, visit), classes, found)


def entered(
    living: LivingMap, p_site: FloatArray, where: Laid | None, found: Found, visit: Visit, config: LivingConfig
) -> Extended:
    """Return the map with the places and sites that the session found."""
    if where is None and isinstance(visit, Solved):
        variance = visit.outcome.log_scale_sigma**2
        information = 1.0 / variance if variance > 0.0 else np.inf
        living = replace(living, log_size_variance=variance, log_size_information=information)
        if robot := visit.recording.robot:
            first = [landmark_id_of(robot)], [0.0], [variance], [information]
            living = replace(living, metres=Metres(*map(np.array, first)))
    return extended(living, p_site, found, config, 0.0 if where is None else where.drift_m)


def found_in(living: LivingMap, where: Laid | None, visit: Visit, config: LivingConfig) -> Found:
    """Return the landmarks of a session, in the frame of the map; None for `where` begins one."""
    if isinstance(visit, SpatialVisit):
        return visit.found(where, living, config.fit)
    begins, in_place = where is None, None
    if where is not None:
        in_place = np.searchsorted(visit.prepared.landmark_id, where.landmark_id[where.place >= 0])
    own = own_landmarks(visit.outcome, config.fit, in_place)
    detection, landmark = _inliers(visit, config.fit.inlier)
    stamps = visit.recording.frames.stamp_s[visit.recording.detections.frame[detection]]
    count = len(visit.prepared.landmark_id)
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, landmark, stamps)
    np.maximum.at(last, landmark, stamps)
    kind = np.full(count, UNKNOWN, dtype=np.int64)
    kind[landmark] = visit.recording.detections.class_id[detection]
    seen = np.flatnonzero(np.isfinite(last[own.row]))
    row = own.row[seen]
    names = visit.prepared.landmark_id[row]
    place, probability = np.full(len(names), -1, dtype=np.int64), np.ones(len(names))
    if where is not None:
        _, here, there = np.intersect1d(names, where.landmark_id, return_indices=True)
        place[here], probability[here] = where.place[there], where.probability[there]
    covariance = own.begun(seen, config.whole_places) if begins else of_places(own.covariance_m2, seen)
    body = np.full(len(names), UNKNOWN, dtype=np.int64)
    _, here, there = np.intersect1d(names, visit.recording.objects[:, 0], return_indices=True)
    body[here] = visit.recording.objects[there, 1]
    return Found(names, kind[row], place, probability, own.position_m[seen], covariance, body, first[row], last[row])


def looks(entry: Extended, visit: Visit, config: LivingConfig) -> tuple[PlaceLooks, FloatArray]:
    """Return which places of the map were looked at in the session, and which of them were seen; and (F, 3) sensor
    poses.
    """
    if isinstance(visit, SpatialVisit):
        watch = visit.watched(entry, config)
        return looked_at(entry.living, entry.p_start, watch, config), watch.eye
    recording, prepared, outcome = visit.recording, visit.prepared, visit.outcome
    trajectory = of_slam.trajectory(prepared, outcome, recording, "")
    stamps = recording.frames.stamp_s
    frames = np.flatnonzero((stamps >= visit.start_s) & (stamps <= visit.end_s + 1e-9)).astype(np.int64)
    pose = trajectory.pose_world_robot[of_slam.rows_at(trajectory, recording, frames)]
    detection, landmark = _inliers(visit, config.fit.inlier)
    place_of = np.full(len(prepared.landmark_id), -1, dtype=np.int64)
    _, rows, found = np.intersect1d(prepared.landmark_id, entry.landmark_id, return_indices=True)
    place_of[rows] = entry.place[found]
    _place_glimpsed(place_of, entry, visit, config.fit.glimpse_m)
    hit = place_of[landmark]
    frame = np.searchsorted(frames, recording.detections.frame[detection])
    sighting = Sighting(stamps[frames], pose, frame[hit >= 0], hit[hit >= 0])
    watch = Watch.of(sighting, entry.living.places.position_m, recording.sensor)
    return looked_at(entry.living, entry.p_start, watch, config), watch.eye


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


def believed(
    entry: Extended, seen: PlaceLooks, sensor: Sensor, span_s: tuple[float, float], config: LivingConfig
) -> Believed:
    """Return the map with the beliefs and the counts of the session, which goes from one instant to another."""
    start_s, end_s = span_s
    living, rows = entry.living, seen.rows
    hit, missed = rows.hit, seen.counts & ~rows.hit
    places = replace(
        living.places,
        n_hits=living.places.n_hits + np.bincount(seen.place[hit], minlength=len(living.places)),
        n_misses=living.places.n_misses + np.bincount(seen.place[missed], minlength=len(living.places)),
    )
    count = len(living.sites)
    first, last = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(first, rows.site[hit], rows.stamp_s[hit])
    np.maximum.at(last, rows.site[hit], rows.stamp_s[hit])
    sites = living.sites
    if config.existence:
        beliefs = believe.believed(living, entry.p_start, seen, sensor, config, start_s, end_s)
        sites, log_evidence = believe.with_beliefs(sites, entry.p_start, beliefs), believe.said(living, beliefs)
        evidence = believe.evidence(living, beliefs)
    else:
        sites = replace(sites, p_here=_as_seen(living, rows.site[hit], last))
        log_evidence, evidence = np.zeros(len(np.unique(sites.clique_id))), Evidence.empty()
    stood = (entry.p_start >= EXISTS) & ~entry.is_new
    arrived = np.isfinite(first) & ~stood & (sites.p_here >= EXISTS)
    sites = replace(
        sites,
        since_s=np.where(arrived & ~entry.is_new, first, living.sites.since_s),
        seen_s=np.maximum(living.sites.seen_s, last),
    )
    until_s = max(end_s, living.stamp_s)
    living = replace(living, stamp_s=until_s, session_start_s=start_s, places=places, sites=sites)
    return Believed(living, log_evidence, evidence)


def _without_departed(entry: Extended, now: Believed, seen: PlaceLooks, visit: Visit) -> tuple[Believed, PlaceLooks]:
    """Beliefs and looks with what was seen to leave."""
    if not isinstance(visit, SpatialVisit):
        return now, seen
    site = visit.witnessed.sites(entry.living, entry.landmark_id, entry.place)
    living, said, evidence, seen = departed(now.living, now.log_evidence, now.evidence, seen, visit.witnessed, site)
    return Believed(living, said, evidence), seen


def _sensor(visit: Visit) -> Sensor:
    return visit.floor_sensor if isinstance(visit, SpatialVisit) else visit.recording.sensor


def missed(living: LivingMap, seen: PlaceLooks, visit: Visit) -> Misses:
    """Return the looks that the map counts as misses of landmarks where they most probably stand after the session.

    These are looks in the field of view, without a detection, along lines of sight that are known to be clear.
    """
    place = seen.place
    member = np.searchsorted(living.members.landmark_id, living.places.landmark_id)
    here = living.site_of()[member] == living.places.site_id
    rows = np.flatnonzero(seen.counts & ~seen.rows.hit & here[place])
    rows = rows[np.lexsort((place[rows], seen.rows.stamp_s[rows]))]
    frame = np.searchsorted(visit.recording.frames.stamp_s, seen.rows.stamp_s[rows])
    p_detect = seen.lines.p_detect[seen.rows.key[rows]]
    return Misses(frame.astype(np.int64), living.places.landmark_id[place[rows]], p_detect)


def decided(
    entry: Extended, now: Believed, seen: PlaceLooks, visit: Visit, config: LivingConfig, classes: ClassLives | None
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """Return the map with its stays up to date and without what is forgotten, and what changed since the session
    before.

    Args:
        entry: the map as the session found it, and what it found.
        now: with the session's beliefs.
        seen: looks of the session.
        visit: the session.
        config: which parts of the engine are on.
        classes: how long things stay, as the session teaches; None for nothing.
    """
    before = entry.before
    came = arrivals(before, now.living, seen, _sensor(visit), config.looks)
    if isinstance(visit, SpatialVisit):
        site = visit.witnessed.sites(entry.living, entry.landmark_id, entry.place)
        came = arrived(came, now.living, before, visit.witnessed, site)
    after, changes = decide.decided(
        before, now.living, seen, now.log_evidence, came, visit.start_s, classes, settings=config.decisions
    )
    changes = tuple(change.named(after.landmark_names) for change in changes)
    if not config.learn_sight:
        after = replace(after, sightlines=before.sightlines)
    if config.cliques and config.existence and config.misses:
        after = without_missed(before, after, config.grouping)
    return decide.without_forgotten(after, config.most_sites, config.decisions), changes


def learned(
    after: LivingMap, seen: PlaceLooks, entry: Extended, eye: FloatArray, config: LivingConfig
) -> tuple[LivingMap, ClassLives | None]:
    """Return the map with what the session taught of lifetimes, and of from where places are seen."""
    if config.learn_sight and config.existence:
        names = entry.living.places.site_id, entry.living.places.landmark_id
        p_there = entry.living.sites.p_here[seen.rows.site]
        weight = np.where(seen.settled, 1.0, p_there)
        lines = after.sightlines.learned(names, seen.place, seen.cell, seen.rows.hit, weight)
        after = replace(after, sightlines=lines, views=after.views.seen_from(eye, after.stamp_s))
    if not config.learn_lifetimes:
        return after, None
    classes = ClassLives.of(after.stays, after.lives, after.stamp_s, config.lifetimes)
    return replace(after, lives=classes.lives), classes


def told(found: Judged, where: Laid | None, visit: Visit) -> Session:
    """Return the session that made a map of another; its landmarks have hits and misses of all sessions of the map."""
    frame = "first_pose" if where is None else "prior_map"
    names = {**visit.recording.landmark_names, **found.living.landmark_names}
    known = replace(found.living.landmarks(), frame=frame, names=names)
    landmarks, gone = rows_of(known, known.p_exists >= EXISTS), rows_of(known, known.p_exists < EXISTS)
    changes = tuple(change.named(names) for change in found.changes)
    slam = visit.concluded() if isinstance(visit, SpatialVisit) else of_slam.result(visit, frame, landmarks)
    slam = replace(slam, landmarks=landmarks, misses=found.misses, changes=changes, gone=gone)
    return Session(found.living, True, visit.recording, slam, changes, found.evidence)


def judged_twice(
    living: LivingMap, where: Laid | None, visit: Visit, vicinity: Vicinity | None, config: LivingConfig
) -> Session:
    """Return the session with the whole map after it, judged twice: the second time by the lifetimes of the first."""
    known = judged(living, where, visit, config)
    session = told(judged(living, where, visit, config, known), where, visit)
    after = session.living if vicinity is None else vicinity.put_back(session.living)
    return replace(session, living=in_chunks(after, config))


def lost(alone: Visit, living: LivingMap, config: LivingConfig, reason: tuple[str, str]) -> Session:
    """Return a session that cannot be found in the map: it stands by itself, and the map as it was."""
    if isinstance(alone, SpatialVisit):
        result = alone.concluded()
    else:
        landmarks = of_slam.landmarks(alone.prepared, alone.outcome, alone.recording, "first_pose")
        result = of_slam.result(alone, "first_pose", landmarks)
    slam = existing(alone, result, config)
    slam = replace(slam, warnings=(*slam.warnings, f"cannot localise in the map: {reason[0]}"))
    return Session(living, False, alone.recording, slam, (), Evidence.empty(), reason)


def existing(visit: Visit, slam: SlamResult, config: LivingConfig) -> SlamResult:
    """Return the result of a recording by itself with its misses, and with the belief that each landmark still exists.

    Both are those of a living map whose first session the recording is.
    """
    mapped = slam.landmarks
    count = len(mapped)
    nowhere = np.full(count, UNKNOWN, dtype=np.int64)
    found = Found(
        landmark_id=mapped.landmark_id,
        class_id=mapped.class_id,
        place=nowhere,
        probability=np.ones(count),
        position_m=mapped.position_m,
        covariance_m2=mapped.covariance_m2,  # beliefs look at each by itself
        object_id=nowhere,
        first_s=mapped.first_seen_s,
        last_s=mapped.last_seen_s,
        rotation=mapped.rotation,
        rotation_covariance=mapped.rotation_covariance,
    )
    begun = LivingMap.in_space() if isinstance(visit, SpatialVisit) else LivingMap()
    empty = replace(begun, clock=visit.recording.clock, class_names=visit.recording.class_names)
    empty = replace(empty, sightlines=replace(empty.sightlines, rules=config.sight))
    entry = extended(empty, np.zeros(0), found, config, 0.0)
    seen, _ = looks(entry, visit, config)
    now = believed(entry, seen, _sensor(visit), (visit.start_s, visit.end_s), config).living
    judged_now = now.landmarks(p_least=0.0)
    row = np.searchsorted(judged_now.landmark_id, mapped.landmark_id)
    p_exists = judged_now.p_exists[row] if config.existence else mapped.p_exists
    mapped = replace(mapped, p_exists=p_exists, n_misses=judged_now.n_misses[row])
    return replace(slam, landmarks=mapped, misses=missed(now, seen, visit))


def _inliers(visit: Solved, least: float) -> tuple[IntArray, IntArray]:
    """Rows of the detections that fit, and of their landmarks."""
    good = np.flatnonzero(visit.outcome.inlier >= least)
    return visit.prepared.used[good], visit.prepared.problem.landmark_row[good]


def _as_seen(living: LivingMap, hit_site: IntArray, last_s: FloatArray) -> FloatArray:
    """Beliefs of a map that never doubts: a clique stands where it was seen last."""
    p_here = living.sites.p_here.copy()
    _, clique = clique_rows(living.sites)
    seen = np.unique(hit_site)
    for row in np.unique(clique[seen]):
        mine = np.flatnonzero(clique == row)
        p_here[mine] = 0.0
        p_here[mine[np.argmax(last_s[mine])]] = 1.0
    return p_here
