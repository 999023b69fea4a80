"""Clocks of the sessions of a map: one robot cannot be at two places at once.

A recording whose clock starts anew with each session says nothing about when it was made. Two of them overlap, and so
contradict each other; they enter one map only with the user's word on when they began (`start_at`), or on what lies
between them (`living.clock_gap_s`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evermap.errors import ConfigError, DataError
from evermap.io.text import clock_of_date, date_s
from evermap.maps.store import Revision, RevisionKind
from evermap.types import AnyRecording, Clock, Measurements
from evermap.valid import OVERLAP_S, SINCE_1970_S, has_own_clock


def place_session(recording: AnyRecording, log: Sequence[Revision], clock_gap_s: float | None) -> AnyRecording:
    """Return a recording with the stamps that it has in a map, whose newest revisions are in `log`.

    With `clock_gap_s` a recording on a clock of its own begins so long after the end of the last session; without, it
    keeps its stamps.

    Raises:
        DataError: it keeps its stamps, and its clock was not set, or another session of the same robot was at the same
            time.
    """
    stamp_s = recording.frames.stamp_s
    if not len(stamp_s):
        return recording
    first_s, last_s = float(np.nanmin(stamp_s)), float(np.nanmax(stamp_s))
    if recording.clock is Clock.UNIX and first_s < SINCE_1970_S:
        raise DataError(
            f"{recording.name}: its clock was not set: its stamps begin {first_s:.1f} s after 1970",
            field="stamp_s",
            hint="when it began, as --start 2026-11-29T09:30Z",
        )
    origins = [one.provenance for one in log if one.provenance.kind is RevisionKind.SESSION]
    spans = [(one.stamp_from_s, one.stamp_to_s, one) for one in origins if np.isfinite(one.stamp_to_s)]
    if not spans:
        return recording
    if clock_gap_s is not None and has_own_clock(recording):
        by_s = max(last for _, last, _ in spans) + clock_gap_s - first_s
        return shift_stamps(recording, by_s, "laid after the newest session of the map")
    for start_s, stop_s, other in spans:
        common_s = min(stop_s, last_s) - max(start_s, first_s)
        if common_s > min(OVERLAP_S, 0.5 * (last_s - first_s)) and other.robot == recording.robot:
            mine, whose = f"{first_s:.1f} to {last_s:.1f} s", f"'{other.recording}' ({start_s:.1f} to {stop_s:.1f} s)"
            raise DataError(
                f"{recording.name}: its clock ({mine}) overlaps that of the session {whose}, and one robot cannot have "
                "driven both at once",
                field="stamp_s",
                hint="when it began, as --start 2026-11-29T09:30Z; where sessions come in their order, --set "
                "living.clock_gap_s=SECONDS between two of them; of several robots, robot in sensor.toml",
            )
    return recording


def start_at(recording: AnyRecording, date: str) -> AnyRecording:
    """Return a recording whose first frame was at a date (ISO 8601), by the clock of which it is from then on.

    Raises:
        ConfigError: `date` is none.
        DataError: the recording has no frames.
    """
    clock, stamp_s = clock_of_date(date), recording.frames.stamp_s
    if clock is None:
        raise ConfigError(f"'{date}' is no date", field="start", hint="as 2026-11-29T09:30Z, or without a zone")
    if not len(stamp_s):
        raise DataError(f"{recording.name}: it has no frames", field="stamp_s")
    by_s = date_s(date) - float(np.nanmin(stamp_s))
    return replace(shift_stamps(recording, by_s, f"begun at {date}, as stated"), clock=clock)


def shift_stamps(recording: AnyRecording, by_s: float, why: str) -> AnyRecording:
    """Return a recording with all its stamps later by `by_s`, which its warnings say, and `why`."""
    parts = {
        name: replace(part, stamp_s=part.stamp_s + by_s)
        for name in ("odometry", "frames", "truth", "robot_sightings")
        if (part := getattr(recording, name)) is not None
    }
    measurements = tuple(_shifted(table, by_s) for table in recording.measurements)
    remark = f"{why}: its clock was put forward by {by_s:.3f} s"
    return replace(recording, **parts, measurements=measurements, warnings=(*recording.warnings, remark))


def _shifted(table: Measurements, by_s: float) -> Measurements:
    columns = {name: column + by_s if name == "to_stamp_s" else column for name, column in table.columns.items()}
    return replace(table, stamp_s=table.stamp_s + by_s, columns=columns)
