"""Audit of a surveyed map by drives: which entries are wrong, since when, and what their numbers should be.

Every drive is solved in the map as it was given (`pipeline.run_slam`), so that one drive cannot hide what another one
shows. Of each entry the drives say how probably it is elsewhere, and where; a chain over the drives in order of time
joins these: it stood where the map has it until some drive, and elsewhere since. What the estimator knows of causes
other than moved landmarks, and its verdict, decide whether a drive is heard at all.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from evermap.config import Config
from evermap.errors import DataError, EvermapError
from evermap.geometry import se3
from evermap.io.map_entries import Correction
from evermap.pipeline import run_slam
from evermap.show import Shown
from evermap.types import (
    AnyRecording,
    Cause,
    ChangeKind,
    Clock,
    FloatArray,
    Landmarks,
    MapChange,
    ParameterEstimate,
    Progress,
    SlamResult,
    Verdict,
    VerdictKind,
    is_in_space,
)
from evermap.valid import strangers

DECIDED = 0.9
"""Probability from which an entry is called wrong, and its complement below which it is called right."""
REPORTED = 0.1
"""Probability of a move from which a drive says so: below `DECIDED`, since several drives are joined."""
UNREPORTED = 0.005
"""Probability of a move of which a drive says nothing: of what is seen often and contradicts nothing."""
P_MOVED = 0.03
"""Prior probability that an entry is wrong, or moves between two drives; that of `slam.space.map.p_moved`."""
P_SAME = 0.95
"""Probability that what is seen first at one place, then at another, and never at both, is one landmark that moved."""
MOST = 0.999
"""Greatest probability: drives by one robot share errors that no chain of independent ones knows."""
FEWEST = 3
"""Sightings from which it is said of an entry that it is right."""
ELSEWHERE = 0.3
"""Share of the readings of a number that fit no place of its landmark, from which this is told: it may be on two."""
SAME_PLACE = 16.3
"""Squared distance, in sigmas, within which two drives saw one place: 99.9 % of three coordinates."""
SIGNIFICANT = 11.3
"""Squared distance, in sigmas, from which a position or a turn is corrected: 99 % of three coordinates."""
NEAR_M, NEAR_RAD = 0.02, 0.03
"""Least tolerance of 'the place of another entry'."""
MAP = "map"
"""Subject of causes that are of the map as a whole."""
UNHEARD = "no drive judges single entries"
"""Reason of entries where no drive can be trusted, or the map as a whole is wrong."""
APART_S = 60.0
"""Time between drives whose clocks all start anew, by which they are told apart."""


class EntryState(StrEnum):
    """What is known of an entry of a map."""

    WRONG = "wrong"
    """Elsewhere ever since the first drive that saw it."""
    STALE = "stale"
    """Where the map has it at first, and elsewhere since."""
    EXCHANGED = "exchanged"
    """It stands where the map has another one, and so on around to it."""
    GONE = "gone"
    """Looked for where the map has it, and seen nowhere."""
    MISSING = "missing"
    """Seen, and not in the map."""
    UNDECIDED = "undecided"
    """Seen, but the drives do not say."""
    UNSEEN = "unseen"
    """Never seen, and never looked for so that it would have been."""
    RIGHT = "right"
    """Where the map has it."""

    @property
    def is_fault(self) -> bool:
        """Whether the map is wrong there."""
        return self in (EntryState.WRONG, EntryState.STALE, EntryState.EXCHANGED, EntryState.GONE, EntryState.MISSING)


ORDER = tuple(EntryState)


@dataclass(frozen=True, slots=True)
class AuditEntry(Shown):
    """What the drives say of an entry of a map.

    Attributes:
        landmark_id, label: which.
        state: what it is.
        probability: that it is not where the map has it, of one that is missing that it is there; nan where nothing
            can be said.
        displacement_m: (D,) from where the map has it to where it is; nan where it was not seen.
        sigma_m: standard deviation of that, the mean of all directions.
        turn_rad, turn_sigma_rad: angle by which it is turned, and its standard deviation; nan of points.
        from_s, to_s: it changed between these; nan and the first sighting where no drive saw it as the map has it.
        n_hits, n_misses: detections, and looks without one that should have seen it.
        n_drives: that saw it.
        position_m, covariance_m2: (D,), (D, D) where it is; nan where it was not seen.
        rotation, rotation_covariance: (4,), (3, 3) how it is turned; None of points.
        like_id: the entry at whose place it stands, -1 for none.
        reason: one line: why it cannot be decided and what would decide it, or what else is to be known.
        moved, turned: whether the position, the rotation is to be corrected.
    """

    landmark_id: int
    label: str
    state: EntryState
    probability: float
    displacement_m: FloatArray
    sigma_m: float
    turn_rad: float
    turn_sigma_rad: float
    from_s: float
    to_s: float
    n_hits: int
    n_misses: int
    n_drives: int
    position_m: FloatArray
    covariance_m2: FloatArray
    rotation: FloatArray | None = None
    rotation_covariance: FloatArray | None = None
    like_id: int = -1
    reason: str = ""
    moved: bool = False
    turned: bool = False

    @property
    def distance_m(self) -> float:
        """Return how far it is from where the map has it."""
        return float(np.linalg.norm(self.displacement_m))


@dataclass(frozen=True, slots=True)
class AuditDrive(Shown):
    """What is known of a drive.

    Attributes:
        name, source: of the recording.
        from_s, to_s: its first and last frame.
        n_detections: that it has.
        is_heard: whether its word counts.
        reason: why it does not; the verdict's line where it does.
        of_map: what is wrong with the map as a whole (scale, unit, mirror), and what mends it; '' of none.
        sensor: what the sensor is off by, one line each, with what mends it.
        warnings: of reader and estimator.
        path_m: (N, D) where it drove, in the map.
    """

    name: str
    source: str
    from_s: float
    to_s: float
    n_detections: int
    is_heard: bool
    reason: str
    of_map: str
    sensor: tuple[str, ...]
    warnings: tuple[str, ...]
    path_m: FloatArray


@dataclass(frozen=True, slots=True)
class Audit(Shown):
    """A map as drives found it.

    Attributes:
        given: the map.
        entries: all of it and what is missing, faults first.
        drives: in order of time.
        clock: of all stamps.
    """

    given: Landmarks
    entries: tuple[AuditEntry, ...]
    drives: tuple[AuditDrive, ...]
    clock: Clock

    @property
    def faults(self) -> tuple[AuditEntry, ...]:
        """Return entries that are wrong, stale, exchanged, gone or missing."""
        return tuple(entry for entry in self.entries if entry.state.is_fault)

    @property
    def is_heard(self) -> bool:
        """Whether any drive could be trusted."""
        return any(drive.is_heard for drive in self.drives)

    @property
    def of_map(self) -> str:
        """Return what is wrong with the map as a whole, and what mends it; '' if single entries are judged."""
        return next((drive.of_map for drive in self.drives if drive.is_heard and drive.of_map), "")

    def corrections(self) -> list[Correction]:
        """Return what is to be written into the map's file: of entries that moved, turned or were exchanged."""
        found = []
        for entry in self.entries:
            if entry.state is EntryState.EXCHANGED:
                found.append(Correction(entry.landmark_id, like_id=entry.like_id))
            elif entry.state in (EntryState.WRONG, EntryState.STALE):
                found.append(
                    Correction(
                        entry.landmark_id,
                        entry.position_m if entry.moved else None,
                        entry.covariance_m2 if entry.moved else None,
                        entry.rotation if entry.turned else None,
                        entry.rotation_covariance if entry.turned else None,
                    )
                )
        return found

    def _facts(self) -> dict[str, Any]:
        counts = {state.value: sum(entry.state is state for entry in self.entries) for state in ORDER}
        return {**{name: count for name, count in counts.items() if count}, "drives": len(self.drives)}


@dataclass(frozen=True, slots=True)
class _Word:
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
class _Heard:
    """A drive that is trusted, with what it says by landmark.

    Attributes:
        drive, words, names: the drive, what it says, and what landmarks are called.
        p_gone, missed: probability that one is not there, and looks that missed it.
        read: how often its number was read, but for where a second landmark with it stands.
    """

    drive: AuditDrive
    words: Mapping[int, _Word]
    names: Mapping[int, str]
    p_gone: Mapping[int, float]
    missed: Mapping[int, int]
    read: Mapping[int, int]


def audit_map(
    given: Landmarks,
    recordings: Sequence[AnyRecording],
    config: Config | None = None,
    *,
    progress: Callable[[AnyRecording], Progress | None] | None = None,
) -> Audit:
    """Compare a map with one or more drives.

    Args:
        given: the map, with covariances, as `read_prior_map` returns it.
        recordings: of any order; where their clocks all start anew, the order in which they are given is that of time.
        config: settings.
        progress: of each drive.

    Raises:
        DataError: no drive sees a landmark of the map, or none can be read as one in it.
    """
    config = _with_all_changes(config or Config())
    drives = in_order(recordings)
    given = _in_space_of(given, drives)
    if problem := strangers(given, drives):
        raise DataError(problem, hint="the map of this site, with the ids that the detector reports")
    heard, told, errors = list[_Heard](), list[AuditDrive](), list[EvermapError]()
    for recording in drives:
        try:
            result = run_slam(
                recording,
                config,
                prior_map=given,
                progress=None if progress is None else progress(recording),
            )
        except EvermapError as error:
            errors.append(error)
            told.append(_unheard(recording, error.one_line()))
            continue
        one = _hear(recording, result, given)
        told.append(one.drive)
        if one.drive.is_heard:
            heard.append(one)
    if len(errors) == len(drives):
        raise errors[0]
    told, heard = _with_map_as_a_whole(told, heard)
    entries = [_judge(given, row, heard) for row in range(len(given))]
    entries = _with_exchanges(entries, given)
    entries += _missing(given, heard)
    entries.sort(key=lambda entry: (ORDER.index(entry.state), -_least(entry.distance_m), entry.landmark_id))
    clock = drives[0].clock
    return Audit(given, tuple(entries), tuple(told), clock)


def _with_map_as_a_whole(
    drives: Sequence[AuditDrive], heard: Sequence[_Heard]
) -> tuple[list[AuditDrive], list[_Heard]]:
    """Return drives, and those by which entries are judged.

    Where most drives find the map as a whole to be wrong, entries are judged by none: they are all off. A few drives
    that do are not heard.
    """
    off = [one for one in heard if one.drive.of_map]
    if 2 * len(off) > len(heard):
        return list(drives), []
    names = [one.drive for one in off]
    kept = [one for one in heard if not one.drive.of_map]
    return [replace(one, is_heard=False) if any(one is other for other in names) else one for one in drives], kept


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


def _in_space_of(given: Landmarks, drives: Sequence[AnyRecording]) -> Landmarks:
    """The map in the plane where a drive is."""
    if given.position_m.shape[1] == 2 or all(map(is_in_space, drives)):
        return given
    at, spread = given.position_m[:, :2], given.covariance_m2[:, :2, :2]
    flat = replace(given, rotation=None, rotation_covariance=None, size_m=None)
    return replace(flat, position_m=at.copy(), covariance_m2=spread.copy())


def _with_all_changes(config: Config) -> Config:
    """The settings by which also improbable moves are told."""
    space = config.slam.space
    of_map = space.map.model_copy(update={"p_told": min(REPORTED, space.map.p_told)})
    slam = config.slam.model_copy(update={"space": space.model_copy(update={"map": of_map})})
    return config.model_copy(update={"slam": slam})


def _unheard(recording: AnyRecording, reason: str) -> AuditDrive:
    nowhere = np.zeros((0, 3 if is_in_space(recording) else 2))
    count = len(recording.detections)
    return AuditDrive(
        recording.name, recording.source, *_span(recording), count, False, reason, "", (), recording.warnings, nowhere
    )


def _hear(recording: AnyRecording, result: SlamResult, given: Landmarks) -> _Heard:
    """What a solved drive says of the map."""
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
    return _Heard(
        drive,
        words,
        {**recording.landmark_names, **result.landmarks.names},
        dict(zip(gone.landmark_id.tolist(), (1.0 - gone.p_exists).tolist(), strict=True)),
        dict(zip(missed[0].tolist(), missed[1].tolist(), strict=True)),
        _count_read(recording, words, result.landmarks.names),
    )


def _count_read(recording: AnyRecording, words: Mapping[int, _Word], names: Mapping[int, str]) -> dict[int, int]:
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


def _words(result: SlamResult, start_s: float) -> dict[int, _Word]:
    """What a drive says of each landmark that it saw."""
    p_moved, told, instead = dict[int, float](), dict[int, MapChange](), dict[int, str]()
    for change in result.changes:
        if change.kind in (ChangeKind.APPEARED, ChangeKind.RETURNED, ChangeKind.VANISHED):
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
        found[name] = _Word(
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


def _with_twins(words: Mapping[int, _Word], names: Mapping[int, str], given: Mapping[int, str]) -> dict[int, _Word]:
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


def _judge(given: Landmarks, row: int, heard: Sequence[_Heard]) -> AuditEntry:
    """What all drives say of an entry."""
    name, dim = int(given.landmark_id[row]), given.position_m.shape[1]
    nothing = np.full(dim, np.nan)
    sighted = [one for one in heard if name in one.words]
    blank = AuditEntry(
        name, given.names.get(name, str(name)), EntryState.UNSEEN, math.nan, nothing, math.nan, math.nan, math.nan,
        math.nan, math.nan, 0, sum(one.missed.get(name, 0) for one in heard), len(sighted),
        nothing, np.full((dim, dim), np.nan),
    )  # fmt: skip
    if not sighted:
        return _never_seen(blank, given, row, heard)
    words = [one.words[name] for one in sighted]
    p_wrong, since = join_drives([word.p_moved for word in words])
    late = words[since:]
    used = late if p_wrong > 0.5 else words[-1:]
    place = _place(used)
    entry = _with_place(blank, given, row, place)
    entry = replace(entry, probability=p_wrong, n_hits=sum(word.n_hits for word in words))
    change = words[since].change
    within = change is not None and math.isfinite(change.stamp_from_s)
    if p_wrong <= 1.0 - DECIDED:
        few = entry.n_hits < FEWEST
        reason = f"seen {entry.n_hits} time{'s' if entry.n_hits > 1 else ''}; {FEWEST} sightings decide" if few else ""
        read = sum(one.read.get(name, 0) for one in sighted)
        if not few and read - entry.n_hits >= max(FEWEST, ELSEWHERE * read):
            reason = f"{read - entry.n_hits} of {read} readings of its number are of something elsewhere"
        return replace(entry, state=EntryState.UNDECIDED if few else EntryState.RIGHT, reason=reason)
    if within and change is not None:
        entry = replace(entry, from_s=change.stamp_from_s, to_s=change.stamp_to_s)
    else:
        entry = replace(entry, from_s=words[since - 1].last_s if since else math.nan, to_s=words[since].first_s)
    if p_wrong < DECIDED:
        return replace(entry, state=EntryState.UNDECIDED, reason=_doubt(name, words, sighted))
    disagree = [one.drive.name for one, word in zip(sighted[since:], late, strict=True) if word.p_moved < 0.5]
    if disagree:
        where = ", ".join(disagree)
        reason = f"elsewhere in one drive, and where the map has it in {where}; another drive decides"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    hits, read = sum(word.n_hits for word in late), sum(one.read.get(name, 0) for one in sighted[since:])
    if hits < FEWEST or (not within and 2 * hits < read):  # the one that fits may be the wrong one
        reason = f"seen {hits} times at its place, of {read} readings of its number; more sightings decide"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    state = EntryState.STALE if since or within else EntryState.WRONG
    moved, turned = _what_to_correct(entry, given, row)
    return replace(entry, state=state, moved=moved, turned=turned)


def join_drives(p_moved: Sequence[float]) -> tuple[float, int]:
    """Return the probability that an entry is elsewhere at the last of some drives, and the first of them in which it
    most probably was, by what each says alone with the prior `P_MOVED`.

    An entry stands until some drive, with the same prior before each, and is elsewhere from then on.
    """
    p = np.clip(np.asarray(p_moved, dtype=np.float64), UNREPORTED / 10.0, 1.0 - 1e-6)
    odds = np.log(p / (1.0 - p)) - math.log(P_MOVED / (1.0 - P_MOVED))
    since = np.cumsum(odds[::-1])[::-1] + math.log(P_MOVED / (1.0 - P_MOVED))
    weight = np.exp(since - np.logaddexp(0.0, np.logaddexp.reduce(since)))
    return float(np.clip(weight.sum(), 1.0 - MOST, MOST)), int(np.argmax(weight))


def _doubt(name: int, words: Sequence[_Word], sighted: Sequence[_Heard]) -> str:
    """Why a move is neither certain nor ruled out, and what decides it."""
    word = max(words, key=lambda one: one.p_moved)
    change = word.change
    if change is not None and len(change.landmark_ids) > 1:
        others = ", ".join(label for label, one in zip(change.labels, change.landmark_ids, strict=True) if one != name)
        why = f"it, with {others}, may have moved, or the others have"
        return f"{word.instead or why}; a drive that sees both from one place decides"
    if word.n_hits < FEWEST:
        return f"seen {word.n_hits} times only; more sightings, from another side, decide"
    if len(sighted) == 1:
        return "one drive does not tell; another one, past it from another side, decides"
    return "the drives differ; another one, past it from another side, decides"


def _place(words: Sequence[_Word]) -> _Word:
    """The last place of a landmark: the mean of the drives from the last one back that saw it at one place."""
    last = words[-1]
    same = [last]
    for word in words[-2::-1]:
        off = word.position_m - last.position_m
        if (
            off @ np.linalg.solve(word.covariance_m2 + last.covariance_m2 + NEAR_M**2 * np.eye(len(off)), off)
            > SAME_PLACE
        ):
            break
        same.append(word)
    if len(same) == 1:
        return last
    weights = [np.linalg.inv(word.covariance_m2 + 1e-8 * np.eye(len(last.position_m))) for word in same]
    covariance = np.linalg.inv(np.sum(weights, axis=0))
    position = covariance @ np.sum([w @ word.position_m for w, word in zip(weights, same, strict=True)], axis=0)
    apart = sum(float((o := word.position_m - position) @ w @ o) for w, word in zip(weights, same, strict=True))
    scale = max(1.0, apart / (len(position) * (len(same) - 1)))
    best = min(
        same, key=lambda word: math.inf if word.rotation_covariance is None else np.trace(word.rotation_covariance)
    )
    return replace(best, position_m=position, covariance_m2=scale * covariance)


def _with_place(entry: AuditEntry, given: Landmarks, row: int, place: _Word) -> AuditEntry:
    """The entry with where it is, and how far that is from where the map has it."""
    dim = given.position_m.shape[1]
    at, spread = place.position_m[:dim], place.covariance_m2[:dim, :dim]
    turn = turn_sigma = math.nan
    known = None if given.rotation is None else given.rotation[row]
    if known is not None and np.isfinite(known).all() and place.rotation is not None:
        turn = float(np.linalg.norm(_turn(known, place.rotation)))
        if place.rotation_covariance is not None:
            turn_sigma = math.sqrt(max(float(np.trace(place.rotation_covariance)) / 3.0, 0.0))
    return replace(
        entry,
        displacement_m=at - given.position_m[row],
        sigma_m=math.sqrt(max(float(np.trace(spread)) / dim, 0.0)),
        turn_rad=turn,
        turn_sigma_rad=turn_sigma,
        position_m=at,
        covariance_m2=spread,
        rotation=place.rotation,
        rotation_covariance=place.rotation_covariance,
    )


def _turn(before: FloatArray, after: FloatArray) -> FloatArray:
    """(3,) rotation vector between two quaternions."""
    poses = [np.concatenate([np.zeros(3), one]) for one in (before, after)]
    return np.asarray(se3.log(se3.between(*poses))[3:])


def _what_to_correct(entry: AuditEntry, given: Landmarks, row: int) -> tuple[bool, bool]:
    """Whether position and rotation differ from the map by more than both are uncertain; at least one does."""
    dim = given.position_m.shape[1]
    off = entry.displacement_m
    far = float(off @ np.linalg.solve(entry.covariance_m2 + given.covariance_m2[row] + 1e-8 * np.eye(dim), off))
    turned = _is_turned(entry, given, row, 1e-4, SIGNIFICANT)
    return far > SIGNIFICANT or not turned, turned


def _is_turned(entry: AuditEntry, given: Landmarks, row: int, least_rad: float, most: float) -> bool:
    """Whether an entry is turned otherwise than a row of the map by more than `most` squared sigmas."""
    if entry.rotation is None or entry.rotation_covariance is None or given.rotation is None:
        return False
    turn = _turn(given.rotation[row], entry.rotation)
    said = np.zeros((3, 3)) if given.rotation_covariance is None else given.rotation_covariance[row]
    spread = entry.rotation_covariance + said + least_rad**2 * np.eye(3)
    return bool(turn @ np.linalg.solve(spread, turn) > most)


def _never_seen(entry: AuditEntry, given: Landmarks, row: int, heard: Sequence[_Heard]) -> AuditEntry:
    """An entry that no drive that counts has seen: gone, or not looked for."""
    name = entry.landmark_id
    if not heard:
        return replace(entry, state=EntryState.UNDECIDED, reason=UNHEARD)
    missed = [one for one in heard if one.missed.get(name, 0)]
    p_gone = [one.p_gone.get(name, math.nan) for one in missed]
    sure = [p for p in p_gone if p >= DECIDED]
    stamp, read = missed[0].drive if missed else None, sum(one.read.get(name, 0) for one in heard)
    if read >= max(FEWEST, ELSEWHERE * entry.n_misses):  # it is there, wherever; fewer readings may be misread
        reason = f"its number was read {read} times, but at no one place: it may be on two landmarks"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    if sure and stamp is not None:
        p = min(float(1.0 - np.prod([1.0 - value for value in sure])), MOST)
        reason = f"{entry.n_misses} looks at its place found nothing; remove it, or look where it went"
        return replace(entry, state=EntryState.GONE, probability=p, to_s=stamp.from_s, reason=reason)
    if read:
        reason = "its number was read, but no reading fits a place; more sightings decide"
        return replace(entry, state=EntryState.UNDECIDED, reason=reason)
    if missed:
        p = max((value for value in p_gone if math.isfinite(value)), default=math.nan)
        state = EntryState.UNDECIDED if p > 0.5 else EntryState.UNSEEN
        reason = f"{entry.n_misses} looks found nothing, but it may be hidden; looks from more sides decide"
        return replace(entry, state=state, probability=p, reason=reason)
    paths = [one.drive.path_m for one in heard if len(one.drive.path_m)]
    if not paths:
        return entry
    nearest = min(float(np.linalg.norm(path - given.position_m[row], axis=1).min()) for path in paths)
    return replace(entry, reason=f"nobody looked at it: no drive came nearer than {nearest:.1f} m, or faced it")


def _with_exchanges(entries: Sequence[AuditEntry], given: Landmarks) -> list[AuditEntry]:
    """Entries of which each stands where the map has the next, around to the first, as exchanged."""
    wrong = {entry.landmark_id: entry for entry in entries if entry.state in (EntryState.WRONG, EntryState.STALE)}
    at = {name: k for k, name in enumerate(given.landmark_id.tolist())}
    stands_at = {name: _whose_place(entry, [at[other] for other in wrong if other != name], given)
                 for name, entry in wrong.items()}  # fmt: skip
    like = dict[int, int]()
    for name in wrong:
        ring = [name]
        while (after := stands_at[ring[-1]]) not in (-1, name) and after not in ring:
            ring.append(after)
        if stands_at[ring[-1]] == name and len(ring) > 1:
            like[name] = stands_at[name]
    labels = {entry.landmark_id: entry.label for entry in entries}
    return [
        replace(
            entry,
            state=EntryState.EXCHANGED,
            like_id=like[entry.landmark_id],
            reason=f"it stands where the map has {labels[like[entry.landmark_id]]}",
        )
        if entry.landmark_id in like
        else entry
        for entry in entries
    ]


def _whose_place(entry: AuditEntry, rows: Sequence[int], given: Landmarks) -> int:
    """The entry at whose place in the map another one stands, -1 for none."""
    dim, best, found = given.position_m.shape[1], SAME_PLACE, -1
    for row in rows:
        off = entry.position_m - given.position_m[row]
        spread = entry.covariance_m2 + given.covariance_m2[row] + NEAR_M**2 * np.eye(dim)
        far = float(off @ np.linalg.solve(spread, off))
        if far < best and not _is_turned(entry, given, row, NEAR_RAD, SAME_PLACE):
            best, found = far, int(given.landmark_id[row])
    return found


def _missing(given: Landmarks, heard: Sequence[_Heard]) -> list[AuditEntry]:
    """Landmarks that were seen often enough and are not in the map."""
    known, dim = set(given.landmark_id.tolist()), given.position_m.shape[1]
    names = {**given.names, **{key: label for one in heard for key, label in one.names.items()}}
    words = dict[int, list[_Word]]()
    for one in heard:
        for name, word in one.words.items():
            if name not in known:
                words.setdefault(name, []).append(word)
    found = []
    for name, said in words.items():
        hits = sum(word.n_hits for word in said)
        p_there = min(1.0 - math.prod(1.0 - word.p_exists for word in said), MOST)
        if hits < FEWEST or p_there < DECIDED:
            continue
        place, label = _place(said), names.get(name, str(name))
        spread = place.covariance_m2[:dim, :dim]
        twin = label.partition("#")[0] if "#" in label else ""
        reason = f"a second landmark with the number {twin}" if twin else "not in the map"
        found.append(
            AuditEntry(
                name, label, EntryState.MISSING, p_there, np.full(dim, np.nan),
                math.sqrt(max(float(np.trace(spread)) / dim, 0.0)), math.nan, math.nan, math.nan, said[0].first_s,
                hits, 0, len(said), place.position_m[:dim], spread, place.rotation, place.rotation_covariance,
                reason=reason,
            )
        )  # fmt: skip
    return found


def _least(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def format_percent(value: float) -> str:
    """Return a probability as text, never as certain."""
    return "> 99 %" if value > 0.99 else "< 1 %" if value < 0.01 else f"{100 * value:.0f} %"


def count_states(entries: Iterable[AuditEntry]) -> dict[str, int]:
    """Return how many entries are in which state, all states in their order."""
    every = list(entries)
    return {state.value: sum(entry.state is state for entry in every) for state in ORDER}
