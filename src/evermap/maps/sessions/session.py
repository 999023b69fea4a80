"""The steps of a session in a living map, in the order in which `pipeline.run_session` takes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from evermap.config import LivingConfig
from evermap.existence.sites import Evidence
from evermap.maps.bodies import without_missed
from evermap.maps.learning import ClassLives
from evermap.maps.living import EXISTS, LivingMap
from evermap.maps.sessions import believe, decide
from evermap.maps.sessions.admission import begin_empty
from evermap.maps.sessions.believe import Believed, arrived, departed, follow_occupants
from evermap.maps.sessions.extend import Extended, Found, extended
from evermap.maps.sessions.looks import (
    Arrivals,
    PlaceLooks,
    Sighting,
    Watch,
    arrivals,
    looked_at,
    weigh_misses,
)
from evermap.maps.sessions.placing import Laid, Localised
from evermap.maps.sessions.planar import PlanarVisit
from evermap.maps.sessions.spatial import SpatialVisit
from evermap.maps.vicinity import in_chunks
from evermap.show import Shown
from evermap.slam.association.features import medians
from evermap.slam.space.up import with_known_up
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    ChangeKind,
    FloatArray,
    Landmarks,
    MapChange,
    Misses,
    Recording,
    Sensor,
    SlamResult,
    SpatialRecording,
    VerdictKind,
    rows_of,
    traits_of,
)

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


def with_start_of(session: Session, recording: AnyRecording) -> Session:
    """Return a session of a map that began with its recording, whatever of that was left out: sessions are in the order
    of their recordings (`open_map`).
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


def judge(
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


def list_misses(living: LivingMap, p_site: FloatArray, seen: PlaceLooks, visit: Visit) -> Misses:
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


def learn(judged: Judged, classes: ClassLives | None, config: LivingConfig) -> LivingMap:
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


def conclude(judged: Judged, living: LivingMap, where: Laid | None, visit: Visit) -> Session:
    """Return the session with its map and changes; its landmarks have hits and misses of all sessions of the map."""
    frame = "first_pose" if where is None else "prior_map"
    names = {**visit.recording.landmark_names, **living.landmark_names}
    known = replace(living.landmarks(), frame=frame, names=names)
    landmarks, gone = rows_of(known, known.p_exists >= EXISTS), rows_of(known, known.p_exists < EXISTS)
    changes = tuple(change.named(names) for change in judged.changes)
    misses = list_misses(judged.entry.living, judged.now.sites.p_here, judged.seen, visit)
    concluded = visit.concluded()
    known = replace(landmarks, up=concluded.landmarks.up)
    slam = replace(concluded, landmarks=known, misses=misses, changes=changes, gone=gone)
    if living.dim == 3:
        slam = with_known_up(slam, living.up)
        living = replace(living, up=slam.landmarks.up)
    return Session(living, True, visit.used, slam, changes, judged.now.evidence)


def bring_in(
    session: Localised[PlanarVisit] | Localised[SpatialVisit], whole: LivingMap, config: LivingConfig
) -> Session:
    """Return the result of a session in a map, judged twice: the second time with the lifetimes learned in the first.

    A session that cannot be localised keeps its own result, and the map is unchanged.
    """
    visit, where = session.visit, session.where
    if session.reason:
        slam = add_existence(visit, visit.concluded(), config)
        slam = replace(slam, warnings=(*slam.warnings, f"set aside: {session.reason[0]}"))
        return Session(whole, False, visit.used, slam, (), Evidence.empty(), session.reason)
    living = replace(session.living, sightlines=replace(session.living.sightlines, rules=config.sight))
    judged_now = judge(living, where, visit, config)
    classes = lives_after(judged_now.living, config)
    if classes is not None:
        living = replace(living, lives=replace(classes.lives, looks_s=living.lives.looks_s))
        judged_now = judge(living, where, visit, config, classes, judged_now)
        classes = lives_after(judged_now.living, config)
    after = conclude(judged_now, learn(judged_now, classes, config), where, visit)
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


def add_existence(visit: Visit, slam: SlamResult, config: LivingConfig) -> SlamResult:
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
    empty = begin_empty(visit.recording)
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
    return replace(slam, landmarks=mapped, misses=list_misses(living, now.sites.p_here, seen, visit))


def looked_for(visit: Visit, slam: SlamResult, given: Landmarks, config: LivingConfig) -> SlamResult:
    """Return the result of a recording in a given map with the entries of that which were never detected: the looks
    that missed them; and those that are not believed to be there among `gone`, and as changes that are told.

    What was detected is where the result has it; the beliefs about it stay as they are.
    """
    found = slam.landmarks
    unseen = given[~np.isin(given.landmark_id, found.landmark_id)]
    if slam.trajectory.frame != "prior_map" or not len(unseen) or found.position_m.shape != (
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
    if not len(gone):
        return replace(slam, misses=every)
    nowhere = (math.nan,) * given.position_m.shape[1]
    told = tuple(
        MapChange((identity,), ChangeKind.VANISHED, math.nan, visit.span_s[0], nowhere, 0.0, 1.0 - p, 0, misses).named(
            given.names
        )
        for identity, p, misses in zip(
            gone.landmark_id.tolist(), gone.p_exists.tolist(), gone.n_misses.tolist(), strict=True
        )
    )
    return replace(slam, misses=every, gone=gone, changes=(*slam.changes, *told))


def judge_so_far(
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
