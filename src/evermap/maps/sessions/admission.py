"""How a recording goes into a map: in which space, with which names, and whether it fits at all."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np

from evermap.config import Config
from evermap.errors import DataError
from evermap.maps.living import LivingMap, Places, Stays
from evermap.maps.sessions.placing import ANYWAY
from evermap.slam import plane
from evermap.slam.cleaning import clean
from evermap.slam.mistake_search import unusable
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    Detections,
    FloatArray,
    Recording,
    SlamResult,
    SpatialRecording,
    is_in_space,
    rows_of,
)
from evermap.valid import OVERLAP_S, check_type, has_own_clock

RecordingT = TypeVar("RecordingT", Recording, SpatialRecording)


def admit(recording: RecordingT, living: LivingMap) -> tuple[RecordingT, LivingMap]:
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


def open_map(living: LivingMap | None, recording: AnyRecording) -> LivingMap:
    """Return a map as a recording finds it: None, and one without a landmark, begin in its space and with its clock.

    Raises:
        InputError: no `Recording`.
        DataError: it begins before the newest session of the map.
    """
    check_type(recording)
    if living is None:
        living = begin_empty(recording)
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


def begin_empty(recording: AnyRecording) -> LivingMap:
    """A map before its first session, in the plane or in space as a recording of it."""
    in_space = is_in_space(recording)
    return LivingMap.in_space(recording.clock) if in_space else LivingMap(clock=recording.clock)


def repair(recording: AnyRecording) -> AnyRecording:
    """Return a recording as it is condensed: one of the plane repaired, one of space as it is."""
    return recording if is_in_space(recording) else clean(recording)


def drive_of(recording: AnyRecording) -> tuple[FloatArray, FloatArray]:
    """Return what all copies of a drive have in common after `repair`: (F,) stamps of frames, and (M, K) sorted
    readings, each with the stamp of its frame, in single precision, as in a session that was condensed.
    """
    seen, stamp_s = recording.detections, recording.frames.stamp_s
    if isinstance(seen, Detections):
        read = np.column_stack([seen.range_m, seen.bearing_rad])
    else:
        read = np.column_stack([seen.position_sensor_m, seen.corner_px.reshape(len(seen), -1)])
    rows = np.column_stack([stamp_s[seen.frame], read.astype(np.float32)])
    return stamp_s, rows[np.lexsort(rows.T[::-1])]


def is_same_drive(one: tuple[FloatArray, ...], other: tuple[FloatArray, ...]) -> bool:
    """Return whether two results of `drive_of` are equal."""
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, other, strict=True))
