"""Clocks of the sessions of a map: one robot cannot be at two places at once.

A recording whose clock starts anew with each session says nothing about when it was made. Two of them overlap, and so
contradict each other; they enter one map only with the user's word on what lies between them (`living.clock_gap_s`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from evermap.errors import DataError
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
            hint='the right stamps; or clock = "recording" in sensor.toml and --set living.clock_gap_s=SECONDS from '
            "the newest session to it",
        )
    origins = [one.provenance for one in log if one.provenance.kind is RevisionKind.SESSION]
    spans = [(one.stamp_from_s, one.stamp_to_s, one) for one in origins if np.isfinite(one.stamp_to_s)]
    if not spans:
        return recording
    if clock_gap_s is not None and has_own_clock(recording):
        return shift_stamps(recording, max(last for _, last, _ in spans) + clock_gap_s - first_s)
    for start_s, stop_s, other in spans:
        common_s = min(stop_s, last_s) - max(start_s, first_s)
        if common_s > min(OVERLAP_S, 0.5 * (last_s - first_s)) and other.robot == recording.robot:
            mine, whose = f"{first_s:.1f} to {last_s:.1f} s", f"'{other.recording}' ({start_s:.1f} to {stop_s:.1f} s)"
            raise DataError(
                f"{recording.name}: its clock ({mine}) overlaps that of the session {whose}, and one robot cannot have "
                "driven both at once",
                field="stamp_s",
                hint='stamps since 1970 with clock = "unix" in sensor.toml; if clocks start anew with each session, '
                "--set living.clock_gap_s=SECONDS between two of them; of several robots, robot in sensor.toml",
            )
    return recording


def shift_stamps(recording: AnyRecording, by_s: float) -> AnyRecording:
    """Return a recording with all its stamps later by `by_s`, which its warnings say."""
    parts = {
        name: replace(part, stamp_s=part.stamp_s + by_s)
        for name in ("odometry", "frames", "truth", "robot_sightings")
        if (part := getattr(recording, name)) is not None
    }
    measurements = tuple(_shifted(table, by_s) for table in recording.measurements)
    remark = f"laid after the newest session of the map: its clock was put forward by {by_s:.3f} s"
    warnings = (*recording.warnings, remark)
    return replace(recording, **parts, measurements=measurements, warnings=warnings)


def _shifted(table: Measurements, by_s: float) -> Measurements:
    columns = {name: column + by_s if name == "to_stamp_s" else column for name, column in table.columns.items()}
    return replace(table, stamp_s=table.stamp_s + by_s, columns=columns)
