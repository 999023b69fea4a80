"""The checks of every recording, in any format, and defects that are tolerated with a counted warning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from evermap.errors import DataError, InputError
from evermap.geometry import se2
from evermap.io.bad_rows import Flaw, count_allowed_bad, flaw_of, sound_rows
from evermap.io.table import Table
from evermap.io.text import counted
from evermap.types import (
    UNKNOWN,
    BoolArray,
    Clock,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Odometry,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
)
from evermap.valid import BEARING_RAD, RANGE_M, SIGMA_BEARING_RAD, SIGMA_RANGE_M, STAMP_S, validate

SAME_STAMP_S = 1e-6
"""Stamps closer than this are the same instant when detections are assigned to frames."""

ODOMETRY_GAP_S = 10.0
"""Longer pauses of the odometry are reported, and frames farther than this from any odometry are dropped."""
FEWEST_STAMPS = 10
"""Stamps of frames, and of the odometry, from which their unit is asked."""
STAMP_UNITS = {1: "milliseconds", 2: "microseconds", 3: "nanoseconds"}
"""By the power of 1,000."""

OUTSIDE = 0.1
"""Share of an image by which the corner of a tag may lie outside: lenses and detectors extrapolate."""

_Seen = TypeVar("_Seen", Detections, SpatialDetections)
_Recorded = TypeVar("_Recorded", Recording, SpatialRecording)


def check_forward(stamp_s: FloatArray, *, path: Path, line: IntArray) -> None:
    """Raise InputError at the first stamp that is smaller than the one before."""
    back = np.flatnonzero(np.diff(stamp_s) < 0)
    if len(back):
        row = int(back[0]) + 1
        step = stamp_s[row - 1] - stamp_s[row]
        hint = "sort the rows by time if only their order is wrong"
        problem = f"time runs backwards by {step:.6g} s"
        raise InputError(problem, path=path, line=int(line[row]), field="stamp_s", hint=hint)


def forward_stamps(table: Table) -> FloatArray:
    """Return the column `stamp_s`, checked not to run backwards. Shape (R,)."""
    table.expect((STAMP_S.name,), tuple(table.columns))
    stamp_s = table.numbers(STAMP_S)
    check_forward(stamp_s, path=table.path, line=table.line)
    return stamp_s


def repeats(values: IntArray) -> IntArray:
    """Return rows that are equal to an earlier one. Shape (N,) or (N, K) -> (number of repeats,)."""
    columns = np.atleast_2d(values.T)
    order = np.lexsort(columns[::-1])
    same = np.all(columns[:, order[1:]] == columns[:, order[:-1]], axis=0)
    return np.sort(order[1:][same])


def wrap_far(angle_rad: FloatArray) -> FloatArray:
    """Return angles beyond half a turn wrapped to (-pi, pi]; the others keep every bit, so that files read back the
    same.
    """
    return np.where(np.abs(angle_rad) <= np.pi, angle_rad, se2.wrap(angle_rad))


def last_of_equal(stamp_s: FloatArray, *, path: Path, warnings: list[str]) -> BoolArray:
    """Return the mask (N,) that keeps the last row of every stamp; repeated stamps are counted in `warnings`."""
    keep = np.append(stamp_s[1:] != stamp_s[:-1], True)[: len(stamp_s)]
    repeated = int(np.sum(~keep))
    if repeated:
        warnings.append(f"{path.name}: {counted(repeated, 'row')} with the stamp of the next row left out")
    return np.asarray(keep, dtype=np.bool_)


def frames_of(
    table: Table,
    frame_table: Table | None,
    *,
    complete: bool | None,
    clock: Clock,
    warnings: list[str],
    several: bool = False,
) -> tuple[Frames, IntArray]:
    """Return the frames of a recording, and (M,) the one in which each detection was made.

    Args:
        table: the detections.
        frame_table: every instant at which a sensor looked; None takes the distinct stamps of the detections.
        complete: whether empty frames are listed; None: they are where there is a table of frames.
        clock: of all stamps.
        warnings: gets a remark on repeated frames.
        several: whether several sensors may look at the same instant, which needs no remark.

    Raises:
        InputError: time runs backwards, or a detection lies in no frame.
    """
    stamp_s = forward_stamps(table)
    complete = complete if complete is not None else frame_table is not None
    looked_s = stamp_s if frame_table is None else forward_stamps(frame_table)
    is_first = np.diff(looked_s, prepend=-np.inf) > SAME_STAMP_S
    if frame_table is not None and not several and not is_first.all():
        merged = counted(int(np.sum(~is_first)), "row")
        warnings.append(f"{frame_table.path.name}: {merged} with the stamp of the row before left out")
    frame_of_look = np.cumsum(is_first) - 1
    frame = frame_of_look[_nearest_look(stamp_s, looked_s, table, frame_table)]
    return Frames(looked_s[is_first], complete=complete, clock=clock), np.asarray(frame, dtype=np.int64)


def looks_of(looked_s: FloatArray, stamp_s: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct ones of some stamps (K,), ascending, and which of them each detection (M,) has."""
    looked_s = np.unique(looked_s)
    looked_s = looked_s[np.diff(looked_s, prepend=-np.inf) > SAME_STAMP_S]
    frame = np.clip(np.searchsorted(looked_s, stamp_s + SAME_STAMP_S) - 1, 0, None)
    return looked_s, np.asarray(frame, dtype=np.int64)


def finish_recording(recording: _Recorded, *, warnings: list[str]) -> _Recorded:
    """Return the recording with frames that have no odometry near them left out and all remarks counted.

    Raises:
        DataError: fewer than two odometry rows, no frame within the odometry's time, or no landmark seen.
    """
    recording = _without_bad(recording, warnings)
    validate(recording)
    odometry, source = recording.odometry, recording.source
    if odometry is not None:
        _warn_of_gaps(odometry, warnings)
        frames, detections = _without_far_frames(odometry, recording.frames, recording.detections, source, warnings)
        recording = replace(recording, frames=frames, detections=detections)
    if len(recording.detections) == 0:
        raise DataError("no landmark was detected during the odometry", path=source)
    _warn_of_repeats(recording.detections, warnings)
    return replace(recording, warnings=tuple(warnings))


def _without_bad(recording: _Recorded, warnings: list[str]) -> _Recorded:
    """The recording without a few detections that cannot be; if there are many, `validate` says what is wrong."""
    seen, path = recording.detections, Path(recording.source)
    if isinstance(seen, Detections):
        quantities = (RANGE_M, replace(BEARING_RAD, optional=True), SIGMA_RANGE_M, SIGMA_BEARING_RAD)
        flaws = [flaw_of(quantity, getattr(seen, quantity.name), path, seen.source_line) for quantity in quantities]
    else:
        cornered = np.isfinite(seen.corner_px).all(axis=(1, 2))
        far = np.linalg.norm(seen.position_sensor_m, axis=1)
        flaws = [flaw_of(replace(RANGE_M, high=np.inf), np.where(cornered, 1.0, far), path, seen.source_line)]
        flaws += _outside_image(seen, recording.sensors, path, warnings)
    if any(flaw.bad.sum() > count_allowed_bad(len(seen)) for flaw in flaws):
        return recording
    sound = sound_rows(flaws, len(seen), path, warnings)
    return recording if sound is None else replace(recording, detections=seen[sound])


def _outside_image(
    seen: SpatialDetections, sensors: Sequence[SpatialSensor], path: Path, warnings: list[str]
) -> list[Flaw]:
    """Tags whose corners are far outside the image; many of them mean a calibration of another resolution."""
    outside = np.zeros(len(seen), dtype=np.bool_)
    for number, sensor in enumerate(sensors):
        if sensor.resolution_px is None:
            continue
        rows = np.flatnonzero(seen.sensor == number)
        share = seen.corner_px[rows] / np.array(sensor.resolution_px, dtype=np.float64)
        outside[rows] = ((share < -OUTSIDE) | (share > 1.0 + OUTSIDE)).any(axis=(1, 2))
    count = int(outside.sum())
    if count > count_allowed_bad(len(seen)):
        known = ", ".join(
            f"{one.name} {one.resolution_px[0]} x {one.resolution_px[1]}" for one in sensors if one.resolution_px
        )
        warnings.append(
            f"{counted(count, 'tag')} of {len(seen)} lie outside the image ({known}): is the calibration of another "
            "resolution?"
        )
        return []

    def error(row: int) -> InputError:
        line = int(seen.source_line[row]) or None
        return InputError("lies outside the image", path=path, line=line, field="corners")

    return [Flaw(outside, error)]


def _warn_of_gaps(odometry: Odometry | SpatialOdometry, warnings: list[str]) -> None:
    pause = np.diff(odometry.stamp_s)
    gaps = np.flatnonzero(pause > ODOMETRY_GAP_S)
    if len(pause) >= FEWEST_STAMPS and 2 * len(gaps) > len(pause):
        usual_s = float(np.median(pause))
        warnings.append(
            f"odometry has a row every {usual_s:.4g} s only: stamp_s may be in {STAMP_UNITS[1]} or {STAMP_UNITS[2]}, "
            "seconds are expected"
        )
    elif len(gaps):
        start = odometry.stamp_s[0]
        shown = ", ".join(f"{pause[i]:.1f} s from {odometry.stamp_s[i] - start:.1f} s" for i in gaps[:3])
        more = ", ..." if len(gaps) > 3 else ""
        warnings.append(
            f"odometry has {counted(len(gaps), 'gap')} over {ODOMETRY_GAP_S:g} s: {shown}{more} after its start"
        )


def _refuse_other_units(odometry: Odometry | SpatialOdometry, frames: Frames, source: str) -> None:
    """Refuse stamps by which frames, or the odometry, last about a thousand times as long as the other, or a million.

    Both are of one drive, so lengths and steps differ alike by the unit. Those of a camera that was on for a moment, or
    is slow, differ in one of the two only.
    """
    spans_s, steps_s = (
        [float(measure(each.stamp_s)) for each in (frames, odometry)]
        for measure in (np.ptp, lambda stamp_s: np.median(np.diff(stamp_s)) if len(stamp_s) > 1 else 0.0)
    )
    if min(len(frames), len(odometry)) < FEWEST_STAMPS or not min(*spans_s, *steps_s) > 0.0:
        return
    longer, slower = (math.log(seen / driven, 1e3) for seen, driven in (spans_s, steps_s))
    power = round(longer)
    if power == 0 or abs(longer - power) > 0.25 or abs(slower - power) > 0.5:
        return
    tables = ("frames and detections", "odometry")
    wrong, other = tables if power > 0 else tables[::-1]
    unit = STAMP_UNITS.get(abs(power), "another unit")
    problem = (
        f"stamps of the {wrong} seem to be in {unit}: they last {max(spans_s):.4g} s, the {other} {min(spans_s):.4g} s"
    )
    raise DataError(problem, path=source, field="stamp_s", hint="stamp both in seconds, with the same clock")


def _without_far_frames(
    odometry: Odometry | SpatialOdometry, frames: Frames, detections: _Seen, source: str, warnings: list[str]
) -> tuple[Frames, _Seen]:
    _refuse_other_units(odometry, frames, source)
    first, last = odometry.stamp_s[0], odometry.stamp_s[-1]
    keep = (frames.stamp_s >= first - ODOMETRY_GAP_S) & (frames.stamp_s <= last + ODOMETRY_GAP_S)
    if keep.all():
        return frames, detections
    if not keep.any():
        looked = f"{frames.stamp_s[0]:.3f} to {frames.stamp_s[-1]:.3f} s"
        problem = f"odometry ({first:.3f} to {last:.3f} s) and detections ({looked}) do not overlap in time"
        raise DataError(problem, path=source, hint="stamp both with the same clock, in seconds")
    seen = keep[detections.frame]
    new_frame = np.cumsum(keep) - 1
    warnings.append(
        f"{counted(int(np.sum(~keep)), 'frame')} with {counted(int(np.sum(~seen)), 'detection')} left out: "
        f"more than {ODOMETRY_GAP_S:g} s before or after the odometry"
    )
    kept = detections[seen]
    kept = replace(kept, frame=np.asarray(new_frame[kept.frame], dtype=np.int64))
    return replace(frames, stamp_s=frames.stamp_s[keep]), kept


def _warn_of_repeats(detections: Detections | SpatialDetections, warnings: list[str]) -> None:
    known = np.flatnonzero(detections.landmark_id != UNKNOWN)
    sensor = detections.sensor if isinstance(detections, SpatialDetections) else np.zeros_like(detections.frame)
    pairs = np.stack([detections.frame[known], detections.landmark_id[known], sensor[known]], axis=1)
    again = repeats(pairs)
    if len(again):
        row = known[again[0]]
        warnings.append(
            f"{counted(len(again), 'detection')} of a landmark that the same frame has already, kept "
            f"(first: landmark {detections.landmark_id[row]}, line {detections.source_line[row]})"
        )


def _nearest_look(stamp_s: FloatArray, looked_s: FloatArray, table: Table, frame_table: Table | None) -> IntArray:
    """Row of `looked_s` at which each detection was made. Shape (M,).

    Raises:
        InputError: none of them is within `SAME_STAMP_S` of a detection.
    """
    padded_s = np.concatenate([[-np.inf], looked_s, [np.inf]])
    after = np.searchsorted(looked_s, stamp_s) + 1
    before_is_nearer = stamp_s - padded_s[after - 1] < padded_s[after] - stamp_s
    nearest = np.where(before_is_nearer, after - 1, after)
    lost = np.flatnonzero(np.abs(padded_s[nearest] - stamp_s) > SAME_STAMP_S)
    if len(lost) and frame_table is not None:  # without frames, the detections' own stamps were the looks
        row, file = int(lost[0]), frame_table.path.name
        near = f"; the nearest is {float(padded_s[nearest[row]])!r}" if len(looked_s) else ""
        problem = f"{float(stamp_s[row])!r} and {len(lost) - 1} more have no row in {file}{near}"
        hint = f"list every instant at which the sensor looked, or omit {file}"
        raise table.error(problem, row=row, field="stamp_s", hint=hint)
    return np.asarray(nearest - 1, dtype=np.int64)
