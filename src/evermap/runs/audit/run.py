"""Audit of a surveyed map by drives: which entries are wrong, since when, and what their numbers should be.

Every drive is solved in the map as it was given (`pipeline.run_slam`), so that one drive cannot hide what another one
shows. Of each entry the drives say how probably it is elsewhere, and where; a chain over the drives in order of time
joins these: it stood where the map has it until some drive, and elsewhere since. What the estimator knows of causes
other than moved landmarks, and its verdict, decide whether a drive is heard at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from evermap.config import Config
from evermap.errors import DataError, EvermapError
from evermap.pipeline import run_slam
from evermap.runs.audit.drives import HeardDrive, hear_drive, in_order, unheard
from evermap.runs.audit.entries import find_missing, judge_entry, with_exchanges
from evermap.runs.audit.result import ORDER, Audit, AuditDrive
from evermap.types import AnyRecording, Landmarks, Progress, is_in_space
from evermap.valid import strangers

REPORTED = 0.1
"""Probability of a move from which a drive says so: below `DECIDED`, since several drives are joined."""


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
    heard, told, errors = list[HeardDrive](), list[AuditDrive](), list[EvermapError]()
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
            told.append(unheard(recording, error.one_line()))
            continue
        one = hear_drive(recording, result, given)
        told.append(one.drive)
        if one.drive.is_heard:
            heard.append(one)
    if len(errors) == len(drives):
        raise errors[0]
    told, heard = _with_map_as_a_whole(told, heard)
    entries = [judge_entry(given, row, heard) for row in range(len(given))]
    entries = with_exchanges(entries, given)
    entries += find_missing(given, heard)
    entries.sort(key=lambda entry: (ORDER.index(entry.state), -_least(entry.distance_m), entry.landmark_id))
    clock = drives[0].clock
    return Audit(given, tuple(entries), tuple(told), clock)


def _with_map_as_a_whole(
    drives: Sequence[AuditDrive], heard: Sequence[HeardDrive]
) -> tuple[list[AuditDrive], list[HeardDrive]]:
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


def _least(value: float) -> float:
    return value if math.isfinite(value) else 0.0
