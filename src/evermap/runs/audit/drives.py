"""What each drive says of a map: drives in order of time, whether one is heard, and its word on every landmark."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evermap.runs.audit.result import AuditDrive, format_percent
from evermap.types import (
    AnyRecording,
    Cause,
    ChangeKind,
    Clock,
    FloatArray,
    Landmarks,
    MapChange,
    ParameterEstimate,
    SlamResult,
    Verdict,
    VerdictKind,
    is_in_space,
)

UNREPORTED = 0.005
"""Probability of a move of which a drive says nothing: of what is seen often and contradicts nothing."""
P_SAME = 0.95
"""Probability that what is seen first at one place, then at another, and never at both, is one landmark that moved."""
SAME_PLACE = 16.3
"""Squared distance, in sigmas, within which two drives saw one place: 99.9 % of three coordinates."""
NEAR_M = 0.02
"""Least tolerance of two positions that are one place."""
MAP = "map"
"""Subject of causes that are of the map as a whole."""
APART_S = 60.0
"""Time between drives whose clocks all start anew, by which they are told apart."""


@dataclass(frozen=True, slots=True)
class Word:
    """What a drive says of a landmark.

    Attributes:
        p_moved: that it is not where the map has it.
        change: that the drive tells of it.
        position_m, covariance_m2, rotation, rotation_covariance: where it is.
        n_hits: sightings.
        first_s, last_s: of them.
        p_exists: that it is there.
        instead: another explanation of the drive.
    """

    p_moved: float
    change: MapChange | None
    position_m: FloatArray
    covariance_m2: FloatArray
    rotation: FloatArray | None
    rotation_covariance: FloatArray | None
    n_hits: int
    first_s: float
    last_s: float
    p_exists: float
    instead: str = ""


@dataclass(frozen=True, slots=True)
class HeardDrive:
    """A drive that is trusted, with what it says by landmark.

    Attributes:
        drive, words, names: the drive, what it says, and what landmarks are called.
        p_gone, missed: probability that one is not there, and looks that missed it.
        read: how often its number was read, but for where a second landmark with it stands.
    """

    drive: AuditDrive
    words: Mapping[int, Word]
    names: Mapping[int, str]
    p_gone: Mapping[int, float]
    missed: Mapping[int, int]
    read: Mapping[int, int]


def in_order(recordings: Sequence[AnyRecording]) -> list[AnyRecording]:
    """Return drives in order of time; those whose clocks start anew, or are of different kinds, are put one after the
    other as they are given.
    """
    spans = [(_span(one), one) for one in recordings]
    spans.sort(key=lambda item: item[0][0])
    starts_anew = any(
        later[0][0] < before[0][1] and not math.isnan(later[0][0]) for before, later in itertools.pairwise(spans)
    )
    clocks = {one.clock for one in recordings}
    if len(clocks) == 1 and not (starts_anew and clocks == {Clock.RECORDING}):
        return [one for _, one in spans]
    found, end_s = [], -APART_S if len(clocks) > 1 else -math.inf
    for one in recordings:
        start_s, last_s = _span(one)
        follows = len(clocks) == 1 and start_s > end_s
        shift_s = 0 if follows or math.isnan(start_s) else math.ceil(end_s + APART_S - start_s)
        found.append(one if shift_s == 0 else _later(one, shift_s))
        end_s = max(end_s, last_s + shift_s)
    return found


def _span(recording: AnyRecording) -> tuple[float, float]:
    stamps = recording.frames.stamp_s
    return (float(stamps[0]), float(stamps[-1])) if len(stamps) else (math.nan, math.nan)


def _later(recording: AnyRecording, by_s: float) -> AnyRecording:
    """The drive with all its stamps moved, without what it does not need here."""
    odometry = recording.odometry
    moved: dict[str, Any] = {
        "frames": replace(recording.frames, stamp_s=recording.frames.stamp_s + by_s),
        "odometry": None
        if odometry is None
        else replace(odometry, stamp_s=odometry.stamp_s + by_s, clock=Clock.RECORDING),
        "measurements": tuple(replace(one, stamp_s=one.stamp_s + by_s) for one in recording.measurements),
        "truth": None,
        "robot_sightings": None,
        "clock": Clock.RECORDING,
    }
    known = recording.__dataclass_fields__
    return replace(recording, **{name: part for name, part in moved.items() if name in known})


def unheard(recording: AnyRecording, reason: str) -> AuditDrive:
    """Return a drive that says nothing of the map, and why."""
    nowhere = np.zeros((0, 3 if is_in_space(recording) else 2))
    count = len(recording.detections)
    return AuditDrive(
        recording.name, recording.source, *_span(recording), count, False, reason, "", (), recording.warnings, nowhere
    )


def hear_drive(recording: AnyRecording, result: SlamResult, given: Landmarks) -> HeardDrive:
    """Return what a solved drive says of the map."""
    verdict, dim = result.verdict, given.position_m.shape[1]
    lost = result.trajectory.frame != "prior_map" or result.landmarks.frame != "prior_map"
    reason = "" if verdict is None else verdict.message
    if lost:
        otherwise = "it could not be laid on the map" if verdict is None or verdict.kind.is_trustworthy else reason
        reason = next((text for text in result.warnings if "cannot localise" in text), otherwise)
    trusted = verdict is None or verdict.kind.is_trustworthy or _is_usable(verdict, result, given)
    drive = AuditDrive(
        name=recording.name,
        source=recording.source,
        from_s=_span(recording)[0],
        to_s=_span(recording)[1],
        n_detections=len(recording.detections),
        is_heard=not lost and trusted,
        reason=reason,
        of_map=next((_cause_line(one) for one in result.causes if one.subject == MAP), ""),
        sensor=_sensor_lines(result),
        warnings=(*recording.warnings, *result.warnings),
        path_m=result.trajectory.pose_world_robot[:, :dim],
    )
    words = {} if lost else _words(result, float(recording.frames.stamp_s[0]))
    words = _with_twins(words, result.landmarks.names, recording.landmark_names)
    gone = result.gone
    missed = np.unique(result.misses.landmark_id, return_counts=True)
    return HeardDrive(
        drive,
        words,
        {**recording.landmark_names, **result.landmarks.names},
        dict(zip(gone.landmark_id.tolist(), (1.0 - gone.p_exists).tolist(), strict=True)),
        dict(zip(missed[0].tolist(), missed[1].tolist(), strict=True)),
        _count_read(recording, words, result.landmarks.names),
    )


def _count_read(recording: AnyRecording, words: Mapping[int, Word], names: Mapping[int, str]) -> dict[int, int]:
    """Return how often each number was read, without what is explained by a second landmark with it, as '7#2'."""
    number, count = np.unique(recording.detections.landmark_id, return_counts=True)
    read = dict(zip(number.tolist(), count.tolist(), strict=True))
    for key, base in _twins(names, recording.landmark_names).items():
        if key in words and base in read:
            read[base] -= words[key].n_hits
    return read


def _twins(names: Mapping[int, str], given: Mapping[int, str]) -> dict[int, int]:
    """Return the first landmark of each that the estimator calls the second, third with its number."""
    ids = {name: key for key, name in given.items()}
    found = dict[int, int]()
    for key, label in names.items():
        stem, mark, _ = label.partition("#")
        base = ids.get(stem, int(stem) if stem.isdecimal() else -1)
        if mark:
            found[key] = base
    return found


def _is_usable(verdict: Verdict, result: SlamResult, given: Landmarks) -> bool:
    """Whether a drive that is not sound says something of the map: a suspect sensor, if its cause was found and is in
    the solution; an outdated map, if most of what was seen of it is where it says.
    """
    if verdict.kind is VerdictKind.SENSOR_SUSPECT:
        return bool(result.causes)
    if verdict.kind is not VerdictKind.MAP_OUTDATED:
        return False
    seen = np.isin(result.landmarks.landmark_id, given.landmark_id)
    moved = {name for change in result.changes if change.probability > 0.5 for name in change.landmark_ids}
    return 2 * len(moved) < int(seen.sum())


def _words(result: SlamResult, start_s: float) -> dict[int, Word]:
    """What a drive says of each landmark that it saw."""
    p_moved, told, instead = dict[int, float](), dict[int, MapChange](), dict[int, str]()
    for change in result.changes:
        if change.kind in (ChangeKind.APPEARED, ChangeKind.RETURNED, ChangeKind.VANISHED, ChangeKind.REPLACED):
            continue
        for name in change.landmark_ids:
            p_moved[name] = min(p_moved.get(name, 0.0) + change.probability, 1.0)
            told.setdefault(name, change)
    for other in result.alternatives:
        for change in other.changes:
            for name in change.landmark_ids:
                p_moved[name] = min(p_moved.get(name, 0.0) + other.probability, 1.0)
                if name not in told:
                    told[name] = change
                    instead[name] = f"instead of other moves, with {format_percent(other.probability)}"
    found, mapped = {}, result.landmarks
    for row, name in enumerate(mapped.landmark_id.tolist()):
        rotation = None if mapped.rotation is None else mapped.rotation[row]
        if rotation is not None and not np.isfinite(rotation).all():
            rotation = None
        spread = None if rotation is None or mapped.rotation_covariance is None else mapped.rotation_covariance[row]
        found[name] = Word(
            p_moved.get(name, UNREPORTED),
            told.get(name),
            mapped.position_m[row],
            mapped.covariance_m2[row],
            rotation,
            spread,
            int(mapped.n_hits[row]),
            float(np.fmax(mapped.first_seen_s[row], start_s)),
            float(mapped.last_seen_s[row]),
            float(mapped.p_exists[row]),
            instead.get(name, ""),
        )
    return found


def _with_twins(words: Mapping[int, Word], names: Mapping[int, str], given: Mapping[int, str]) -> dict[int, Word]:
    """Words in which a number at two places, first at one and then at the other, is one landmark that moved between.

    The estimator calls the second place '7#2'. What is no farther from the first than both are uncertain is no place.
    """
    found = dict(words)
    for key, base in _twins(names, given).items():
        if key not in found or base not in found:
            continue
        one, twin = found[base], found[key]
        off = twin.position_m - one.position_m
        spread = one.covariance_m2 + twin.covariance_m2 + NEAR_M**2 * np.eye(len(off))
        if off @ np.linalg.solve(spread, off) < SAME_PLACE:
            del found[key]
        elif one.last_s <= twin.first_s and one.p_moved < 0.5:
            moved = MapChange((base,), ChangeKind.MOVED, one.last_s, twin.first_s, tuple(off.tolist()), 0.0, P_SAME)
            found[base] = replace(twin, p_moved=P_SAME, change=moved, first_s=one.first_s)
            del found[key]
    return found


def _sensor_lines(result: SlamResult) -> tuple[str, ...]:
    """What a sensor is off by: causes that were found, and calibration states that are not what is stated."""
    lines = [_cause_line(one) for one in result.causes if one.subject != MAP]
    named = {one.subject for one in result.causes} | {one.code for one in result.causes}
    for one in result.parameters:
        if not _is_off(one) or one.name in named:
            continue
        value = f"{one.name} = {one.value:.4g} ± {one.sigma:.2g} {one.unit if one.unit != '1' else ''}".rstrip()
        lines.append(f"{value}, stated {one.prior_mean:.4g}: {one.meaning}")
    return tuple(lines)


def _cause_line(cause: Cause) -> str:
    return f"{cause.message}; {cause.fix}" if cause.fix else cause.message


def _is_off(one: ParameterEstimate) -> bool:
    if one.fixed or not one.prior_sigma > 0.0 or not one.sigma > 0.0:
        return False
    off = abs(one.value - one.prior_mean)
    needed = one.p_needed > 0.95 if math.isfinite(one.p_needed) else off > 2.0 * one.prior_sigma
    return bool(needed and off > 3.0 * one.sigma)
