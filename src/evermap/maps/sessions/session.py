"""The steps of a session in a living map, in the order in which `pipeline.run_session` takes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from evermap.config import Config, LivingConfig, LooksConfig
from evermap.errors import DataError, NumericalError
from evermap.existence.sites import Evidence
from evermap.explain.answer import in_given_units
from evermap.explain.causes.suspect import Inputs
from evermap.explain.competition import explain
from evermap.explain.evidence import AnySession, SpatialSession
from evermap.explain.put_right import find_late_sensor
from evermap.explain.scores import ScreenedSession
from evermap.explain.trial import Explained, SessionSolution, Trial
from evermap.maps.bodies import without_missed
from evermap.maps.learning import ClassLives
from evermap.maps.living import EXISTS, LivingMap, Places, Stays
from evermap.maps.sessions import believe, decide
from evermap.maps.sessions.believe import Believed, arrived, departed, follow_occupants
from evermap.maps.sessions.extend import Extended, Found, extended
from evermap.maps.sessions.looks import (
    Arrivals,
    PlaceLooks,
    Sighting,
    Watch,
    arrivals,
    find_departures,
    looked_at,
    weigh_misses,
)
from evermap.maps.sessions.placing import ANYWAY, Laid, Localised
from evermap.maps.sessions.planar import PlanarVisit
from evermap.maps.sessions.spatial import SpatialVisit, solve_visit
from evermap.maps.vicinity import in_chunks
from evermap.show import Shown
from evermap.slam import plane
from evermap.slam.association.features import medians
from evermap.slam.cleaning import clean
from evermap.slam.estimate import Solved, solve
from evermap.slam.mistake_search import unusable
from evermap.slam.space.up import with_known_up
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    ChangeKind,
    Detections,
    FloatArray,
    IntArray,
    Landmarks,
    MapChange,
    Misses,
    Progress,
    Recording,
    Sensor,
    SlamResult,
    SpatialRecording,
    VerdictKind,
    is_in_space,
    rows_of,
    traits_of,
)
from evermap.valid import OVERLAP_S, check_type, has_own_clock

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
        changes: what appeared, vanished, moved, was exchanged or returned since the session before; none of a session
            that its verdict keeps out of the map (`refusal`).
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

    def refusal(self, config: LivingConfig) -> str:
        """Return why the session does not enter the map by itself (`living.accept`), in a line; '' where it does."""
        if not self.found:
            return self.set_aside[0]
        verdict = self.slam.verdict
        if verdict is None or config.accept == "any" or verdict.kind is VerdictKind.SOUND:
            return ""
        if config.accept == "weak" and verdict.kind.is_trustworthy:
            return ""
        return verdict.text


def admitted(recording: RecordingT, living: LivingMap) -> tuple[RecordingT, LivingMap]:
    """Return the recording as of `admit_recording`, and the map as of `with_names_of`, which raise the same."""
    return admit_recording(recording, living), with_names_of(living, recording)


def admit_recording(recording: RecordingT, living: LivingMap) -> RecordingT:
    """Return the recording without landmarks that an operator deleted, and with the map's class numbers.

    Raises:
        DataError: another clock than the map's, or of the plane where that is of space.
    """
    check_fits(recording, living)
    names = _class_names(living, recording)
    number = np.array([names.index(name) for name in recording.class_names] + [UNKNOWN], dtype=np.int64)
    kept = ~np.isin(recording.detections.landmark_id, living.members.landmark_id[living.members.deleted])
    detections = rows_of(recording.detections, kept)
    detections = replace(detections, class_id=number[detections.class_id])
    return replace(recording, detections=detections, class_names=names)


def with_names_of(living: LivingMap, recording: AnyRecording) -> LivingMap:
    """Return the map with the names of a recording's classes and landmarks, and with its clock.

    Raises:
        DataError: another clock than the map's, or of the plane where that is of space.
    """
    check_fits(recording, living)
    return replace(
        living,
        class_names=_class_names(living, recording),
        landmark_texts=tuple(sorted({*living.landmark_texts, *recording.landmark_names.values()})),
        clock=recording.clock,
    )


def check_fits(recording: AnyRecording, living: LivingMap) -> None:
    """Refuse a recording of another space or on another clock than the map."""
    if (living.dim == 3) != is_in_space(recording):
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


def _class_names(living: LivingMap, recording: AnyRecording) -> tuple[str, ...]:
    """Names of the map's classes, then of the recording's new ones."""
    return living.class_names + tuple(name for name in recording.class_names if name not in living.class_names)


def with_overlap(recording: AnyRecording, living: LivingMap | None) -> AnyRecording:
    """Return a recording with a remark where its clock overlaps what the map has seen, and it names no robot.

    `enter_session`, which knows whose the other sessions are, refuses it.
    """
    stamp_s = recording.frames.stamp_s
    if (
        living is None
        or not has_own_clock(recording)
        or recording.robot
        or not float(stamp_s[0]) < living.stamp_s - OVERLAP_S
    ):
        return recording
    remark = (
        f"its clock ({stamp_s[0]:.1f} to {stamp_s[-1]:.1f} s) overlaps what the map has seen (until "
        f"{living.stamp_s:.1f} s): one robot cannot have driven both at once; give each session its own time"
    )
    return replace(recording, warnings=(*recording.warnings, remark))


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
    if not flat or not is_in_space(recording):
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
    if living is None:
        living = _empty(recording)
    elif is_in_space(recording) and not len(living.places):
        living = replace(living, places=Places.empty(3), stays=Stays.empty(3), clock=recording.clock)
    if len(recording.frames):
        start_s = float(recording.frames.stamp_s[0])
        living = living.from_now_on(start_s)
        if start_s < living.session_start_s:
            raise DataError(
                f"{recording.name}: begins at {start_s:.1f} s, before the newest session of the map, "
                f"{living.session_start_s:.1f} s",
                field="stamp_s",
                hint="evermap.enter_session(store, recording), or evermap map enter, enter it at its time",
            )
    return living


def _empty(recording: AnyRecording) -> LivingMap:
    """A map before its first session, in the plane or in space as a recording of it."""
    in_space = is_in_space(recording)
    return LivingMap.in_space(recording.clock) if in_space else LivingMap(clock=recording.clock)


def repaired(recording: AnyRecording) -> AnyRecording:
    """Return a recording as it is condensed: one of the plane repaired, one of space as it is."""
    return recording if is_in_space(recording) else clean(recording)


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
    if start_s == session.living.session_start_s:
        return session
    return replace(session, living=replace(session.living, session_start_s=start_s))


@dataclass(frozen=True, slots=True)
class Judged:
    """What a session says of a map.

    Attributes:
        living: the map after it, but for what it teaches of lifetimes and of lines of sight.
        changes: what changed since the session before.
        found: landmarks of the session.
        entry: the map with these, before its beliefs were updated.
        now: its beliefs.
        seen: looks at its places.
        watch: which places it looked at.
    """

    living: LivingMap
    changes: tuple[MapChange, ...]
    found: Found
    entry: Extended
    now: Believed
    seen: PlaceLooks
    watch: Watch


def judged(
    living: LivingMap,
    where: Laid | None,
    visit: Visit,
    config: LivingConfig,
    classes: ClassLives | None = None,
    known: Judged | None = None,
) -> Judged:
    """Return the map after the session, and the changes.

    What was found goes into the map, then hits and misses into beliefs, and those into decisions. A map's first session
    lies nowhere. When it is judged for the second time, what it teaches of lifetimes and what was found are `known`.
    """
    span_s, sensor = visit.span_s, visit.floor_sensor
    aged = believe.aged(living, config, span_s[0])
    found = visit.found(where, living, config) if known is None else known.found
    living, drift_m = (visit.begun(living), 0.0) if where is None else (living, where.drift_m)
    entry = extended(living, aged, found, config, drift_m)
    watch = known.watch if known is not None and known.entry.has_places_of(entry) else visit.watched(entry, config)
    seen = looked_at(entry.living, entry.p_start, watch, config)
    now = believe.believed(entry, seen, sensor, span_s, config)
    came = arrivals(entry.before, entry.living, now.until_s, seen, sensor, config)
    came = follow_occupants(came, now, entry)
    if len(visit.witnessed.landmark_id):
        came = arrived(came, visit.witnessed, entry)
        now, seen = departed(now, seen, visit.witnessed, entry)
    after, changes = decide.decided(
        entry.before, entry.living, now, seen, came, span_s[0], classes, settings=config.decisions
    )
    after, changes = decide.with_replaced(after, changes, visit.witnessed, entry)
    changes = decide.join_replaced(changes, visit.witnessed, entry, config.decisions)
    changes = decide.doubt_moves(changes, visit.witnessed, entry, config)
    if config.cliques and config.existence and config.misses:
        after = without_missed(entry.before, after, config.grouping)
    after = decide.without_forgotten(after, config.most_sites, config.decisions)
    return Judged(after, changes, found, entry, now, seen, watch)


def missed(living: LivingMap, p_site: FloatArray, seen: PlaceLooks, visit: Visit) -> Misses:
    """Return the looks that count as misses of landmarks at their most probable places after the session, by beliefs
    (S,) in the sites of the map.

    These are looks in the field of view, without a detection, along lines of sight that are known to be clear.
    """
    place = seen.place
    member = np.searchsorted(living.members.landmark_id, living.places.landmark_id)
    here = living.site_of(p_site)[member] == living.places.site_id
    rows = np.flatnonzero(seen.counts & ~seen.rows.hit & here[place])
    rows = rows[np.lexsort((place[rows], seen.rows.stamp_s[rows]))]
    frame = np.searchsorted(visit.recording.frames.stamp_s, seen.rows.stamp_s[rows])
    p_detect = seen.lines.p_detect[seen.rows.key[rows]]
    return Misses(frame.astype(np.int64), living.places.landmark_id[place[rows]], p_detect)


def learned(judged: Judged, classes: ClassLives | None, config: LivingConfig) -> LivingMap:
    """Return the map after a session, with what it taught of lifetimes, and of from where places are seen."""
    after, seen = judged.living, judged.seen
    lines = after.sightlines if config.learn_sight else judged.entry.before.sightlines
    views, glimpses = after.views, after.glimpses
    if config.learn_sight and config.existence:
        places = judged.entry.living.places
        weight = np.where(seen.settled, 1.0, judged.now.sites.p_here[seen.rows.site])
        names = places.site_id, places.landmark_id
        lines = lines.learned(names, seen.place, seen.cell, seen.rows.hit, weight, seen.rate)
        lines = replace(lines, open_space=seen.open_space)
        views = views.seen_from(judged.watch.eye, after.stamp_s, seen.rate)
        glimpses = glimpses.joined(judged.watch.glimpsed_m, after.stamp_s)
    lives = after.lives if classes is None else classes.lives
    return replace(after, sightlines=lines, views=views, glimpses=glimpses, lives=lives)


def told(judged: Judged, living: LivingMap, where: Laid | None, visit: Visit) -> Session:
    """Return the session with its map and changes; its landmarks have hits and misses of all sessions of the map."""
    frame = "first_pose" if where is None else "prior_map"
    names = {**visit.recording.landmark_names, **living.landmark_names}
    known = replace(living.landmarks(), frame=frame, names=names)
    landmarks, gone = rows_of(known, known.p_exists >= EXISTS), rows_of(known, known.p_exists < EXISTS)
    changes = tuple(change.named(names) for change in judged.changes)
    misses = missed(judged.entry.living, judged.now.sites.p_here, judged.seen, visit)
    concluded = visit.concluded()
    known = replace(landmarks, up=concluded.landmarks.up)
    slam = replace(concluded, landmarks=known, misses=misses, changes=changes, gone=gone)
    if living.dim == 3:
        slam = with_known_up(slam, living.up)
        living = replace(living, up=slam.landmarks.up)
    return Session(living, True, visit.used, slam, changes, judged.now.evidence)


def brought_in(
    session: Localised[PlanarVisit] | Localised[SpatialVisit], whole: LivingMap, config: LivingConfig
) -> Session:
    """Return the result of a session in a map, judged twice: the second time with the lifetimes learned in the first.

    A session that cannot be localised keeps its own result, and the map is unchanged.
    """
    visit, where = session.visit, session.where
    if session.reason:
        slam = existing(visit, visit.concluded(), config)
        slam = replace(slam, warnings=(*slam.warnings, f"set aside: {session.reason[0]}"))
        return Session(whole, False, visit.used, slam, (), Evidence.empty(), session.reason)
    living = replace(session.living, sightlines=replace(session.living.sightlines, rules=config.sight))
    judged_now = judged(living, where, visit, config)
    classes = lives_after(judged_now.living, config)
    if classes is not None:
        living = replace(living, lives=replace(classes.lives, looks_s=living.lives.looks_s))
        judged_now = judged(living, where, visit, config, classes, judged_now)
        classes = lives_after(judged_now.living, config)
    after = told(judged_now, learned(judged_now, classes, config), where, visit)
    living = after.living if session.vicinity is None else session.vicinity.put_back(after.living)
    return replace(after, living=decide.without_strays(in_chunks(with_traits(living, visit.used), config)))


def with_traits(living: LivingMap, recording: AnyRecording) -> LivingMap:
    """Return a map with what a session's detections say of what its landmarks are like."""
    seen = recording.detections
    features, columns = traits_of(seen)
    if features is None:
        return living
    names, row = np.unique(seen.landmark_id, return_inverse=True)
    value, _ = medians(features, row, len(names))
    known = np.isin(names, living.members.landmark_id)
    return replace(living, traits=living.traits.met(names[known], columns, value[known]))


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
    if is_in_space(recording):
        return solve_visit(recording, config, prior_map, remarks, progress=progress)
    alone = solve(recording, config.slam, prior_map=prior_map, remarks=remarks, realtime=realtime, progress=progress)
    return PlanarVisit(alone)


def explained(
    inputs: Inputs,
    config: Config,
    remarks: tuple[str, ...],
    *,
    realtime: bool = False,
    progress: Progress | None = None,
    is_read_well: bool = False,
    is_suspected: bool = False,
    solution: SessionSolution[Visit] | None = None,
) -> Explained[Visit]:
    """Return a session solved, with its result: as given, or under the causes that explain it better (`explain`), its
    calibration in the units that were given.

    Args:
        inputs: with identities.
        config: settings.
        remarks: on the recording, the first warnings.
        realtime: as of `run_slam`, of the session as given.
        progress: the same.
        is_read_well: whether pairs of sightings are known to show no mistake.
        is_suspected: whether scores say that a calibration is not as stated.
        solution: of the inputs as given, where it is known.

    Raises:
        DataError, NumericalError: as of `run_slam`.
    """

    def under(given: Inputs, known: Solved | None = None, **more: Any) -> SessionSolution[Visit]:
        visit: Visit
        if known is None:
            visit = solved(given.recording, config, given.prior_map, remarks, **more)
        else:
            visit = PlanarVisit(known)
        result = visit.concluded()
        if not np.isfinite(result.trajectory.pose_world_robot).all():
            raise NumericalError("the solution has poses that are no numbers", hint="check units, mounts and stamps")
        return SessionSolution(visit, ScreenedSession(solution_of(visit), given), result)

    told = list[str]()
    try:
        as_given = solution or under(inputs, realtime=realtime, progress=progress)
    except (DataError, NumericalError):
        found = None
        if config.slam.explain.on:
            found = explain(inputs, None, under, config.slam, told.append)
        if found is None:
            raise
    else:
        if not config.slam.explain.on or as_given.result.interrupted or realtime:
            return Explained(Trial(as_given, (), math.nan, 1.0), ())
        found = explain(
            inputs, as_given, under, config.slam, told.append, is_read_well=is_read_well, is_suspected=is_suspected
        )
        assert found is not None
    if not found.causes:
        return found
    result = replace(in_given_units(found.best), causes=found.causes)
    return replace(found, best=replace(found.best, solution=replace(found.best.solution, result=result)))


def solution_of(visit: Visit) -> AnySession:
    """Return what a session's estimate is, as causes are asked of it."""
    return visit.solved if isinstance(visit, PlanarVisit) else SpatialSession(visit.intake, visit.solved)


def without_doubted(session: Session, before: LivingMap, config: LivingConfig) -> Session:
    """Return a session; where it does not enter the map (`Session.refusal`), which was as `before` it, without what it
    says has changed: what is not believed is not reported.
    """
    if not session.refusal(config):
        return session
    known = before.landmarks(p_least=0.0)
    gone = known.landmark_id[known.p_exists < EXISTS]
    still = rows_of(session.slam.gone, np.isin(session.slam.gone.landmark_id, gone))
    return replace(session, slam=replace(session.slam, changes=(), alternatives=(), gone=still), changes=())


def with_causes(session: Session, living: LivingMap, config: Config) -> Session:
    """Return a session that was set aside with causes other than changes, if any explain why it does not fit the map.

    It is not entered under them: that is for who trusts them, or mends the recording.
    """
    if session.found or not config.slam.explain.on or not len(living.places):
        return session
    found = find_causes(session, living, config)
    return session if found is None else replace(session, slam=replace(session.slam, causes=found.causes))


def find_causes(
    session: Session, living: LivingMap, config: Config, *, is_suspected: bool = False
) -> Explained[Visit] | None:
    """Return what explains a session, solved by itself with the map as one that is given; None if nothing can be.

    `is_suspected` is as of `explain`.
    """
    expected = living.landmarks(p_least=EXISTS) if len(living.places) else None
    try:
        return explained(Inputs.of(session.recording, expected), config, (), is_suspected=is_suspected)
    except (DataError, NumericalError):
        return None


def is_doubtful(session: Session) -> bool:
    """Return whether causes are to be asked of a session with its verdict: it is neither sound nor weak, or its sensor
    is late.
    """
    slam = session.slam
    return not slam.is_trustworthy or find_late_sensor(slam, Inputs.of(session.recording, None)) is not None


def with_calibration(session: Session, found: Explained[Visit]) -> Session:
    """Return a session that was entered without what causes did, with these, and its calibration in the units given."""
    trial = replace(found.best, solution=replace(found.best.solution, result=session.slam))
    return replace(session, slam=replace(in_given_units(trial), causes=found.causes))


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
    empty = _empty(visit.recording)
    lines = replace(empty.sightlines, rules=config.sight)
    empty = replace(empty, class_names=visit.recording.class_names, sightlines=lines)
    entry = extended(empty, empty.sites, found, config, 0.0)
    seen = looked_at(entry.living, entry.p_start, visit.watched(entry, config), config)
    now = believe.believed(entry, seen, visit.floor_sensor, visit.span_s, config)
    living = replace(entry.living, stamp_s=now.until_s, places=now.places, sites=now.sites)
    judged_now = living.landmarks(p_least=0.0)
    row = np.searchsorted(judged_now.landmark_id, mapped.landmark_id)
    p_exists = judged_now.p_exists[row] if config.existence else mapped.p_exists
    mapped = replace(mapped, p_exists=p_exists, n_misses=judged_now.n_misses[row])
    return replace(slam, landmarks=mapped, misses=missed(living, now.sites.p_here, seen, visit))


def looked_for(
    visit: Visit, slam: SlamResult, given: Landmarks, config: LivingConfig, interval: float = 0.95
) -> SlamResult:
    """Return the result of a recording in a given map with the entries of that which were never detected: the looks
    that missed them; and those that are not believed to be there among `gone`, and as changes that are told.

    What was detected is where the result has it; the beliefs about it stay as they are, but of what left its place
    while the robot drove, between two stamps that hold the instant with probability `interval`.
    """
    found = slam.landmarks
    unseen = given[~np.isin(given.landmark_id, found.landmark_id)]
    if slam.trajectory.frame != "prior_map" or found.position_m.shape != (
        len(found), given.position_m.shape[1]
    ):  # fmt: skip
        return slam
    names = np.concatenate([found.landmark_id, unseen.landmark_id])
    position = np.concatenate([found.position_m, unseen.position_m])
    both = Landmarks.at(names, position[:, :2], class_id=np.full(len(names), UNKNOWN))
    order = np.argsort(names, kind="stable")
    rotation = None
    if position.shape[1] == 3:
        none_m = [np.full((len(some), 4), np.nan) for some in (found, unseen)]
        turns = [none_m[k] if some.rotation is None else some.rotation for k, some in enumerate((found, unseen))]
        rotation = np.concatenate(turns)[order]
    small = np.broadcast_to(1e-6 * np.eye(position.shape[1]), (len(names), *2 * (position.shape[1],)))
    both = replace(both, position_m=position[order], covariance_m2=small.copy(), rotation=rotation)
    if rotation is not None:
        both = replace(both, rotation_covariance=np.broadcast_to(1e-6 * np.eye(3), (len(names), 3, 3)).copy())
    living = replace(LivingMap.begun(both), clock=visit.recording.clock).from_now_on(visit.span_s[0])
    none = np.zeros(len(living.sites), dtype=np.bool_)
    site = living.sites.site_id[np.searchsorted(both.landmark_id, found.landmark_id)]
    place = living.place_row(found.landmark_id, site)
    entry = Extended(living, living, found.landmark_id, place, living.sites.p_here, none)
    watch = visit.watched(entry, config)
    names, floor_m = living.places.landmark_id, np.ascontiguousarray(living.places.position_m[:, :2])
    asked = np.isin(names, unseen.landmark_id)
    oriented = np.zeros(len(names), dtype=np.bool_) if rotation is None else np.isfinite(living.places.rotation[:, 0])
    counts, p_missed = weigh_misses(watch, floor_m, asked, oriented, config.looks)
    row = np.searchsorted(names, unseen.landmark_id)  # one place each, in the order of their names
    p_gone = config.looks.p_gone
    p_exists = p_missed[row] * (1.0 - p_gone) / (p_missed[row] * (1.0 - p_gone) + p_gone)
    pose, which = watch.listed.pose[counts], watch.listed.landmark[counts]
    frame = np.searchsorted(visit.recording.frames.stamp_s, watch.stamp_s[pose])
    every = slam.misses.joined(Misses(frame.astype(np.int64), names[which], watch.listed.p_detect[counts]))
    every = rows_of(every, np.lexsort((every.landmark_id, every.frame)))
    unseen = replace(unseen, p_exists=p_exists, n_misses=np.bincount(which, minlength=len(names))[row])
    gone = replace(unseen[p_exists < EXISTS], frame=found.frame)
    slam = _with_departures(replace(slam, misses=every), watch, names, given, config.looks, interval)
    if not len(gone):
        return slam
    nowhere = (math.nan,) * given.position_m.shape[1]
    told = tuple(
        MapChange((identity,), ChangeKind.VANISHED, math.nan, visit.span_s[0], nowhere, 0.0, 1.0 - p, 0, misses).named(
            given.names
        )
        for identity, p, misses in zip(
            gone.landmark_id.tolist(), gone.p_exists.tolist(), gone.n_misses.tolist(), strict=True
        )
    )
    return replace(slam, gone=gone, changes=(*slam.changes, *told))


def _with_departures(
    slam: SlamResult, watch: Watch, names: IntArray, given: Landmarks, looks: LooksConfig, interval: float
) -> SlamResult:
    """Return the result with what of a `given` map left its place while the robot drove, by looks at landmarks (P,)."""
    elsewhere = [one for change in slam.changes for one in change.landmark_ids]
    asked = np.isin(names, given.landmark_id) & np.isin(names, slam.landmarks.landmark_id) & ~np.isin(names, elsewhere)
    p_exists, told = slam.landmarks.p_exists.copy(), list[MapChange]()
    nowhere = (math.nan,) * given.position_m.shape[1]
    for left in find_departures(watch, asked, interval, looks):
        name = int(names[left.place])
        p_exists[slam.landmarks.landmark_id == name] = left.p_stands
        change = MapChange(
            (name,), ChangeKind.VANISHED, *left.between_s, nowhere, 0.0, 1.0 - left.p_stands, 0, left.n_misses
        )
        told.append(change.named(slam.landmarks.names))
    return replace(slam, landmarks=replace(slam.landmarks, p_exists=p_exists), changes=(*slam.changes, *told))


def judged_so_far(
    living: LivingMap, sighting: Sighting, sensor: Sensor, config: LivingConfig, classes: ClassLives | None = None
) -> tuple[LivingMap, tuple[MapChange, ...]]:
    """Return the map with beliefs after a part of a drive, from the causal poses, and the changes since the last
    report; without places that the map does not have yet, and bodies. How long things stay is as `lives_of` tells.
    """
    start_s, end_s = (max(float(stamp_s), living.stamp_s) for stamp_s in sighting.stamp_s[[0, -1]])
    aged = believe.aged(living, config, start_s)
    lines = replace(living.sightlines, rules=config.sight)
    living = replace(living, sightlines=lines, sites=replace(living.sites, p_kept=aged.p_kept))
    looks = config.looks.model_copy(update={"settled_s": min(config.looks.settled_online_s, config.looks.settled_s)})
    config = config.model_copy(update={"looks": looks})
    seen = looked_at(living, aged.p_here, Watch.of(sighting, living.places.position_m, sensor, looks), config)
    none = np.zeros(0, dtype=np.int64)
    entry = Extended(living, living, none, none, aged.p_here, np.zeros(len(living.sites), dtype=np.bool_))
    now = believe.believed(entry, seen, sensor, (start_s, end_s), config)
    nowhere = Arrivals(none, np.zeros(0), np.zeros(0))
    after, changes = decide.decided(living, living, now, seen, nowhere, start_s, classes, settings=config.decisions)
    return after, tuple(change.named(after.landmark_names) for change in changes)


def lives_after(living: LivingMap, config: LivingConfig) -> ClassLives | None:
    """Return what a map teaches of lifetimes after a session; None if nothing is to be learned."""
    if not config.learn_lifetimes:
        return None
    return ClassLives.of(living.stays, living.lives, living.stamp_s, config.lifetimes, living.clock)


def lives_of(living: LivingMap, config: LivingConfig) -> ClassLives | None:
    """Return the lifetimes from the history of a map; None if nothing is learned or given."""
    if not (config.learn_lifetimes and len(living.stays) and len(living.lives.looks_s)):
        return None
    return ClassLives.of(living.stays, living.lives, None, config.lifetimes, living.clock)
