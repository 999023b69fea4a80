"""The steps of a session in a living map, in the order in which `pipeline.run_session` takes them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from evermap.config import Config, LivingConfig
from evermap.errors import DataError
from evermap.existence.sites import Evidence
from evermap.maps.bodies import without_missed
from evermap.maps.learning import ClassLives
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions import believe, decide
from evermap.maps.sessions.believe import Believed, arrived, departed
from evermap.maps.sessions.extend import Extended, Found, extended
from evermap.maps.sessions.looks import Arrivals, PlaceLooks, Sighting, Watch, arrivals, looked_at
from evermap.maps.sessions.placing import ANYWAY, Laid, Localised
from evermap.maps.sessions.planar import PlanarVisit
from evermap.maps.sessions.spatial import SpatialVisit, solve_visit
from evermap.maps.vicinity import in_chunks
from evermap.show import Shown
from evermap.slam import plane
from evermap.slam.association.features import medians
from evermap.slam.cleaning import clean
from evermap.slam.estimate import solve
from evermap.slam.mistakes import unusable
from evermap.slam.space.up import with_known_up
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    Detections,
    FloatArray,
    Landmarks,
    MapChange,
    Misses,
    Progress,
    Recording,
    Sensor,
    SlamResult,
    SpatialRecording,
    rows_of,
)
from evermap.valid import check_type

RecordingT = TypeVar("RecordingT", Recording, SpatialRecording)

Visit = PlanarVisit | SpatialVisit
"""A session that is solved: both have the same methods, which are all that is asked here."""


@dataclass(frozen=True, slots=True)
class Session(Shown):
    """Result of a session in a map.

    Attributes:
        living: the map after it.
        found: False if the session could not be localised in the map, which is then unchanged.
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
            f"{recording.name}: its stamps are on the clock '{recording.clock}', those of the map on '{living.clock}'",
            field="stamp_s",
            hint="sessions of one map need one clock, preferably seconds since 1970",
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


def in_its_space(recording: AnyRecording, living: LivingMap | None, config: Config) -> AnyRecording:
    """Return a recording as it goes into a map: in the plane where it is one of a robot on a floor (`slam.plane`).

    Raises:
        ConfigError: `slam.plane` is set, and it cannot be there.
    """
    dim = None if living is None or not len(living.places) else living.dim
    return plane.in_its_space(recording, config.slam, dim=dim)


def as_estimated(recording: AnyRecording, result: SlamResult) -> AnyRecording:
    """Return a recording in the space of its result: in the plane where it was estimated there."""
    flat = result.trajectory.pose_world_robot.shape[1] == 3
    if not flat or not isinstance(recording, SpatialRecording):
        return recording
    return plane.in_its_space(recording, Config().slam, dim=2)


def check_static(recording: SpatialRecording, config: Config) -> None:
    """Refuse a session in which a mistake in units, axes or clocks makes static landmarks move.

    Raises:
        DataError: names the mistake, as `evermap check` does. Where `living.search` is not 'joint', nothing is refused.
    """
    wrong = unusable(recording, config.slam.check) if config.living.search == "joint" else None
    if wrong is not None and not wrong.usable:
        raise DataError(f"{recording.name}: {wrong.message}", hint=ANYWAY)


def opened(living: LivingMap | None, recording: AnyRecording) -> LivingMap:
    """Return a map as a recording finds it: None, and one without a landmark, begin in its space and with its clock.

    Raises:
        InputError: no `Recording`.
        DataError: it begins before the newest session of the map.
    """
    check_type(recording)
    begun = _empty(recording)
    if living is None:
        living = begun
    elif begun.dim == 3 and not len(living.places):
        living = replace(living, places=begun.places, stays=begun.stays, clock=begun.clock)
    if len(recording.frames):
        start_s = float(recording.frames.stamp_s[0])
        living = living.from_now_on(start_s)
        if start_s < living.session_start_s:
            raise DataError(
                f"{recording.name}: begins at {start_s:.1f} s, before the newest session of the map, "
                f"{living.session_start_s:.1f} s",
                field="stamp_s",
                hint="evermap.enter_session(store, recording), or evermap slam --map FILE, enter it at its time",
            )
    return living


def _empty(recording: AnyRecording) -> LivingMap:
    """A map before its first session, in the plane or in space as a recording of it."""
    in_space = isinstance(recording, SpatialRecording)
    return LivingMap.in_space(recording.clock) if in_space else LivingMap(clock=recording.clock)


def repaired(recording: AnyRecording) -> AnyRecording:
    """Return a recording as it is condensed: one of the plane repaired, one of space as it is."""
    return clean(recording) if isinstance(recording, Recording) else recording


def drive_of(recording: AnyRecording) -> tuple[FloatArray, FloatArray]:
    """Return what all copies of a drive have in common once they are `repaired`: (F,) stamps of frames, and (M, K)
    sorted readings, each with the stamp of its frame, in single precision, as in a session that was condensed.
    """
    seen, stamp_s = recording.detections, recording.frames.stamp_s
    if isinstance(seen, Detections):
        read = np.column_stack([seen.range_m, seen.bearing_rad])
    else:
        read = np.column_stack([seen.position_sensor_m, seen.corner_px.reshape(len(seen), -1)])
    rows = np.column_stack([stamp_s[seen.frame], read.astype(np.float32)])
    return stamp_s, rows[np.lexsort(rows.T[::-1])]


def same_drive(one: tuple[FloatArray, ...], other: tuple[FloatArray, ...]) -> bool:
    """Return whether two results of `drive_of` are equal."""
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))


def begun_with(session: Session, recording: AnyRecording) -> Session:
    """Return a session of a map that began with its recording, whatever of that was left out: sessions are in the order
    of their recordings (`opened`).
    """
    if not session.found:
        return session
    start_s = float(np.fmin(recording.frames.stamp_s[0], session.living.session_start_s))
    return replace(session, living=replace(session.living, session_start_s=start_s))


@dataclass(frozen=True, slots=True)
class Judged:
    """What a session says of a map.

    Attributes:
        living: the map after it.
        changes: what changed since the session before.
        evidence: what was seen of every clique, frame by frame.
        misses: of landmarks at their most probable places, as the map counts them.
        classes: learned lifetimes of classes; None if nothing was learned.
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
    """Return the map after the session, the changes, the evidence and the misses.

    What was found goes into the map, then hits and misses into beliefs, and those into decisions. A map's first session
    lies nowhere. Lifetimes that the session teaches are `known` when it is judged for the second time.
    """
    if known is not None:
        living = replace(living, lives=replace(known.living.lives, looks_s=living.lives.looks_s))
    living = replace(living, sightlines=replace(living.sightlines, rules=config.sight))
    aged = believe.aged(living, config, visit.start_s)
    living = replace(living, sites=replace(living.sites, p_kept=aged.p_kept))
    found = visit.found(where, living, config) if known is None else known.found
    living, drift_m = (visit.begun(living), 0.0) if where is None else (living, where.drift_m)
    entry = extended(living, aged.p_here, found, config, drift_m)
    watch = visit.watched(entry, config)
    seen = looked_at(entry.living, entry.p_start, watch, config)
    now = believe.believed(entry, seen, visit.floor_sensor, (visit.start_s, visit.end_s), config)
    now, seen = departed(now, seen, visit.witnessed, entry)
    after, changes = decided(entry, now, seen, visit, config, known.classes if known is not None else None)
    after, classes = learned(after, seen, replace(entry, living=now.living), watch.eye, config)
    return Judged(after, changes, now.evidence, missed(now.living, seen, visit), classes, found)


def missed(living: LivingMap, seen: PlaceLooks, visit: Visit) -> Misses:
    """Return the looks that count as misses of landmarks at their most probable places after the session.

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
    """Return the map with updated stays and without forgotten cliques, and the changes since the previous session, by
    what it teaches of how long things stay, None for nothing.
    """
    before = entry.before
    came = arrivals(before, now.living, seen, visit.floor_sensor, config.looks)
    came = arrived(came, now.living, visit.witnessed, entry)
    after, changes = decide.decided(
        before, now.living, seen, now.log_evidence, came, visit.start_s, classes, settings=config.decisions
    )
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
        lines = after.sightlines.learned(names, seen.place, seen.cell, seen.rows.hit, weight, seen.rate)
        views = after.views.seen_from(eye, after.stamp_s, seen.rate)
        after = replace(after, sightlines=lines, views=views)
    if not config.learn_lifetimes:
        return after, None
    classes = ClassLives.of(after.stays, after.lives, after.stamp_s, config.lifetimes)
    return replace(after, lives=classes.lives), classes


def told(found: Judged, where: Laid | None, visit: Visit) -> Session:
    """Return the session with its map and changes; its landmarks have hits and misses of all sessions of the map."""
    frame = "first_pose" if where is None else "prior_map"
    names = {**visit.recording.landmark_names, **found.living.landmark_names}
    known = replace(found.living.landmarks(), frame=frame, names=names)
    landmarks, gone = rows_of(known, known.p_exists >= EXISTS), rows_of(known, known.p_exists < EXISTS)
    changes = tuple(change.named(names) for change in found.changes)
    concluded = visit.concluded()
    known = replace(landmarks, up=concluded.landmarks.up)
    slam = replace(concluded, landmarks=known, misses=found.misses, changes=changes, gone=gone)
    living = found.living
    if living.dim == 3:
        slam = with_known_up(slam, living.up)
        living = replace(living, up=slam.landmarks.up)
    return Session(living, True, visit.used, slam, changes, found.evidence)


def brought_in(
    session: Localised[PlanarVisit] | Localised[SpatialVisit], whole: LivingMap, config: LivingConfig
) -> Session:
    """Return the result of a session in a map, computed twice: the second time with the lifetimes learned in the first.

    A session that cannot be localised keeps its own result, and the map is unchanged.
    """
    visit, where = session.visit, session.where
    if session.reason:
        slam = existing(visit, visit.concluded(), config)
        slam = replace(slam, warnings=(*slam.warnings, f"set aside: {session.reason[0]}"))
        return Session(whole, False, visit.used, slam, (), Evidence.empty(), session.reason)
    known = judged(session.living, where, visit, config)
    told_now = told(judged(session.living, where, visit, config, known), where, visit)
    after = told_now.living if session.vicinity is None else session.vicinity.put_back(told_now.living)
    return replace(told_now, living=decide.without_strays(in_chunks(with_traits(after, visit.used), config)))


def with_traits(living: LivingMap, recording: AnyRecording) -> LivingMap:
    """Return a map with what a session's detections say of what its landmarks are like."""
    seen = recording.detections
    if seen.features is None:
        return living
    names, row = np.unique(seen.landmark_id, return_inverse=True)
    value, _ = medians(seen.features, row, len(names))
    known = np.isin(names, living.members.landmark_id)
    return replace(living, traits=living.traits.met(names[known], seen.feature_names, value[known]))


def solved(
    recording: AnyRecording,
    config: Config,
    prior_map: Landmarks | None,
    remarks: tuple[str, ...],
    *,
    realtime: bool = False,
    progress: Progress | None = None,
) -> Visit:
    """Return a recording with identities solved, by itself or in a map that is given; arguments as of `run_slam`."""
    if isinstance(recording, SpatialRecording):
        return solve_visit(recording, config, prior_map, remarks, progress=progress)
    alone = solve(recording, config.slam, prior_map=prior_map, remarks=remarks, realtime=realtime, progress=progress)
    return PlanarVisit(alone)


def existing(visit: Visit, slam: SlamResult, config: LivingConfig) -> SlamResult:
    """Return the result of a single recording with its misses and the belief that each landmark exists.

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
    empty = replace(_empty(visit.recording), class_names=visit.recording.class_names)
    empty = replace(empty, sightlines=replace(empty.sightlines, rules=config.sight))
    entry = extended(empty, np.zeros(0), found, config, 0.0)
    seen = looked_at(entry.living, entry.p_start, visit.watched(entry, config), config)
    now = believe.believed(entry, seen, visit.floor_sensor, (visit.start_s, visit.end_s), config).living
    judged_now = now.landmarks(p_least=0.0)
    row = np.searchsorted(judged_now.landmark_id, mapped.landmark_id)
    p_exists = judged_now.p_exists[row] if config.existence else mapped.p_exists
    mapped = replace(mapped, p_exists=p_exists, n_misses=judged_now.n_misses[row])
    return replace(slam, landmarks=mapped, misses=missed(now, seen, visit))


def judged_so_far(
    living: LivingMap, sighting: Sighting, sensor: Sensor, config: LivingConfig, classes: ClassLives | None = None
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """Return the map with beliefs after a part of a drive, from the causal poses, and the changes since the last
    report; without places that the map does not have yet, and bodies. How long things stay is as `lives_of` tells.
    """
    start_s, end_s = (max(float(stamp_s), living.stamp_s) for stamp_s in sighting.stamp_s[[0, -1]])
    living = replace(living, sightlines=replace(living.sightlines, rules=config.sight))
    aged = believe.aged(living, config, start_s)
    living = replace(living, sites=replace(living.sites, p_kept=aged.p_kept))
    looks = config.looks.model_copy(update={"settled_s": min(config.looks.settled_online_s, config.looks.settled_s)})
    config = config.model_copy(update={"looks": looks})
    seen = looked_at(living, aged.p_here, Watch.of(sighting, living.places.position_m, sensor, looks), config)
    none = np.zeros(0, dtype=np.int64)
    entry = Extended(living, living, none, none, aged.p_here, np.zeros(len(living.sites), dtype=np.bool_))
    now = believe.believed(entry, seen, sensor, (start_s, end_s), config)
    nowhere = Arrivals(none, np.zeros(0), np.zeros(0))
    settings = config.decisions
    after, changes = decide.decided(
        living, now.living, seen, now.log_evidence, nowhere, start_s, classes, settings=settings
    )
    return after, tuple(change.named(after.landmark_names) for change in changes)


def lives_of(living: LivingMap, config: LivingConfig) -> ClassLives | None:
    """Return the lifetimes from the history of a map; None if nothing is learned or given."""
    if not (config.learn_lifetimes and len(living.stays) and len(living.lives.looks_s)):
        return None
    return ClassLives.of(living.stays, living.lives, None, config.lifetimes)
