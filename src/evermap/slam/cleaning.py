"""Repair what a live robot logs: a valid `Recording`, with every repair counted in its warnings.

Readers of files refuse what looks like a mistake of the file's author. A robot on duty gets messages late, twice or
never, its clocks are set, its drivers send invalid values. A valid recording is returned unchanged.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from evermap.config import CleaningConfig
from evermap.errors import DataError
from evermap.slam.clocks import LEAST_STEP_S, clock_steps
from evermap.slam.gaps import find_running_median, find_spikes
from evermap.types import UNKNOWN, BoolArray, Detections, FloatArray, Frames, IntArray, Odometry, Recording, rows_of
from evermap.valid import LATEST_S

USUAL = CleaningConfig()
AROUND_S = 3.0
"""Accuracy to which readings determine the time of a clock change."""
SET_BACK = "was set back"
SINGLE = 10.0
"""Factor on the required motion for a frame with a single reading."""


def clean(recording: Recording, settings: CleaningConfig = USUAL) -> Recording:
    """Return the recording in order of time, without impossible values; every kind of repair is a counted warning.

    Args:
        recording: columns of equal length; everything else may be wrong. Rows stand in the order of arrival.
        settings: what is impossible.

    Returns:
        A valid recording, maybe an empty one; the same object where nothing was wrong. Repaired are:

        * stamps that are none or stand alone: their rows are left out;
        * late rows: sorted in; rows with equal stamps: the last odometry is kept, frames are united;
        * clocks that were set back by over 1 s, and clocks of one sensor set forward by over 2 s: taken back,
          to within a few periods of the sensor;
        * odometry that was stamped by another clock for a while: moved to where landmarks stand still by it;
        * frames more than 10 s before or after the odometry: left out;
        * odometry that is no number, faster than any robot, or a spike: left out, the row before holds on;
        * readings that are no number, not positive, or beyond the sensor's reach: left out;
        * readings repeated in the same frame, or in the next one though the robot moved: left out;
        * identities below -1 and classes without a name: unknown; standard deviations that are none: not given.
    """
    remarks: list[str] = []
    odometry, detections = _odometry(recording.odometry, settings, remarks), _readings(recording, settings, remarks)
    cleaned = replace(recording, odometry=odometry, detections=detections)
    for repaired in (_in_time, _one_clock, _in_step, _while_driving, _fresh):
        cleaned = repaired(cleaned, settings, remarks)
    return replace(cleaned, warnings=(*recording.warnings, *remarks)) if remarks else recording


def _odometry(odometry: Odometry, settings: CleaningConfig, remarks: list[str]) -> Odometry:
    """Possible velocities at increasing stamps."""
    stamps = _mend_stamps("odometry", odometry.stamp_s, settings, remarks)
    order = np.argsort(stamps, kind="stable")
    order = order[np.isfinite(stamps[order])]
    last = np.append(stamps[order][1:] != stamps[order][:-1], True)[: len(order)]
    _remark(remarks, "odometry rows with a repeated stamp dropped", int(np.sum(~last)))
    kept = order[last]
    if len(kept) < len(stamps) or np.any(np.diff(kept) != 1) or np.any(stamps != odometry.stamp_s):
        odometry = replace(rows_of(odometry, kept), stamp_s=stamps[kept])
    velocity = np.stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    possible = np.all(np.abs(velocity) <= settings.fastest, axis=0)
    _remark(remarks, "odometry rows beyond possible velocities dropped", int(np.sum(~possible)))
    odometry, velocity = rows_of(odometry, possible), velocity[:, possible]
    spike = find_spikes(odometry.stamp_s, velocity, settings)
    _remark(remarks, "odometry rows with a spike dropped", int(np.sum(spike)))
    return rows_of(odometry, ~spike)


def of_ranges_only(detections: Detections, settings: CleaningConfig) -> bool:
    """Return whether the sensor measures no bearings; a few detections without one are damaged."""
    ranged = np.isfinite(detections.range_m)
    return bool(np.isnan(detections.bearing_rad[ranged]).sum() > settings.ranges_only * ranged.sum())


def _readings(recording: Recording, settings: CleaningConfig, remarks: list[str]) -> Detections:
    """Detections that a sensor can have made, of frames that exist."""
    detections, sensor = recording.detections, recording.sensor
    ranges = detections.range_m
    real = np.isfinite(ranges) & (ranges > 0.0)
    reach_m = settings.too_far * sensor.range_max_m
    if not np.isfinite(reach_m):
        reach_m = settings.far_from_median * float(np.median(ranges[real])) if real.any() else 0.0
    far = real & (ranges > reach_m)
    count, n_far = int(real.sum()), int(far.sum())
    if n_far and n_far >= min(count, 0.5 * count + 1.5 * count**0.5):  # a mistake in the unit: 3 sigma above half
        limit = f"{settings.too_far:g} times range_max_m = {sensor.range_max_m:g}"
        problem = f"{n_far} of {len(far)} ranges lie beyond {limit}"
        raise DataError(problem, field="range_m", hint="ranges and range_max_m in metres")
    real &= ~far
    blind = np.isnan(detections.bearing_rad) & of_ranges_only(detections, settings)
    real &= (np.abs(detections.bearing_rad) <= 2.0 * np.pi) | blind
    real &= (detections.frame >= 0) & (detections.frame < len(recording.frames))
    _remark(remarks, "impossible readings dropped", int(np.sum(~real)))
    if not real.all():
        detections = rows_of(detections, real)
    strange = detections.landmark_id < UNKNOWN
    unnamed = (detections.class_id < UNKNOWN) | (detections.class_id >= max(len(recording.class_names), 1))
    unnamed &= len(recording.class_names) > 0
    _remark(remarks, "invalid identities and classes treated as unknown", int(np.sum(strange | unnamed)))
    if np.any(strange | unnamed):
        names = np.where(strange, UNKNOWN, detections.landmark_id)
        detections = replace(detections, landmark_id=names, class_id=np.where(unnamed, UNKNOWN, detections.class_id))
    for name in ("sigma_range_m", "sigma_bearing_rad"):
        sigma = getattr(detections, name)
        bad = ~np.isnan(sigma) & ~((sigma > 0.0) & (sigma < np.inf))
        _remark(remarks, f"invalid values of {name} treated as missing", int(np.sum(bad)))
        if bad.any():
            mended: dict[str, Any] = {name: np.where(bad, np.nan, sigma)}
            detections = replace(detections, **mended)
    return detections


def _in_time(recording: Recording, settings: CleaningConfig, remarks: list[str]) -> Recording:
    """Frames at increasing stamps, those with equal stamps united, and detections sorted by frame."""
    frames, detections = recording.frames, recording.detections
    stamps = _mend_stamps("sensor", frames.stamp_s, settings, remarks)
    instants: FloatArray = np.unique(stamps[np.isfinite(stamps)])
    sorted_already = np.all(np.diff(detections.frame) >= 0)
    if len(instants) == len(frames) and np.array_equal(instants, frames.stamp_s) and sorted_already:
        return recording
    _remark(remarks, "repeated frames merged", int(np.isfinite(stamps).sum()) - len(instants))
    row: IntArray = np.searchsorted(instants, stamps).astype(np.int64)[detections.frame]
    order = np.argsort(row, kind="stable")
    order = order[np.isfinite(stamps[detections.frame[order]])]
    detections = replace(rows_of(detections, order), frame=row[order])
    bearing_rad = np.nan_to_num(detections.bearing_rad, nan=np.inf)  # nan is not equal to itself
    same = np.column_stack([detections.frame, detections.landmark_id, detections.range_m, bearing_rad])
    _, first = np.unique(same, axis=0, return_index=True)
    _remark(remarks, "repeated readings of a frame dropped", len(same) - len(first))
    if not sorted_already:
        remarks.append("detections sorted by frame")
    frames, detections = replace(frames, stamp_s=instants), rows_of(detections, np.sort(first))
    return replace(recording, frames=frames, detections=detections)


def _one_clock(recording: Recording, settings: CleaningConfig, remarks: list[str]) -> Recording:
    """Steps forward that one of the two clocks made alone are taken back, the last one first."""
    frames, odometry = recording.frames, recording.odometry
    for _ in range(len(frames)):
        step = set_forward(frames.stamp_s, odometry.stamp_s, settings)
        if step is not None:
            frames = replace(frames, stamp_s=_take_back(frames.stamp_s, step, "sensor", remarks))
            continue
        step = set_forward(odometry.stamp_s, frames.stamp_s, settings)
        if step is None:
            break
        odometry = replace(odometry, stamp_s=_take_back(odometry.stamp_s, step, "odometry", remarks))
    return replace(recording, frames=frames, odometry=odometry)


def _take_back(stamp_s: FloatArray, step: tuple[int, float], what: str, remarks: list[str]) -> FloatArray:
    row, by_s = step
    remarks.append(f"clock of the {what} was set forward by {by_s:.1f} s, undone")
    return np.append(stamp_s[:row], stamp_s[row:] - by_s)


def _in_step(recording: Recording, _: CleaningConfig, remarks: list[str]) -> Recording:
    """Odometry on the clock of the frames, if sightings show that the two differ.

    A clock that was set forward leaves a pause in its own stream. One that was set back was taken back already, by
    counting messages, and is off by those that were lost at that moment.
    """
    odometry, frame_s = recording.odometry, recording.frames.stamp_s
    unsure_s = AROUND_S if any(SET_BACK in remark for remark in remarks) else LEAST_STEP_S
    pause_s = max((float(np.diff(one).max(initial=0.0)) for one in (odometry.stamp_s, frame_s)), default=0.0)
    since_s, delay_s = (column.tolist() for column in clock_steps(recording, pause_s + unsure_s))

    def step(row: int) -> tuple[int, float]:
        """Return the row of odometry at which the clocks part, and for how long that stream paused."""
        before_s, after_s = delay_s[row - 1 : row + 1]
        if after_s > before_s:
            return _longest_pause(odometry.stamp_s, since_s[row] + before_s, since_s[row] + after_s)
        frame, pause_s = _longest_pause(frame_s, since_s[row], since_s[row])
        return int(np.searchsorted(odometry.stamp_s, frame_s[frame] - pause_s + before_s, side="right")), pause_s

    row = 1
    while row < len(since_s):
        by_s = abs(delay_s[row] - delay_s[row - 1])
        if by_s >= LEAST_STEP_S and step(row)[1] >= by_s - unsure_s:
            row += 1
            continue
        # no clock can have done that: the shorter stretch is as the other
        lasts_s = np.diff([frame_s[0], *since_s[1:], frame_s[-1]])
        shorter = row if lasts_s[row] < lasts_s[row - 1] else row - 1
        del delay_s[shorter], since_s[row]
        row = max(row - 1, 1)
    if len(delay_s) == 1:
        return recording
    rows = np.maximum.accumulate([0, *(step(row)[0] for row in range(1, len(since_s)))])
    stamp_s = odometry.stamp_s - np.repeat(delay_s, np.diff([*rows, len(odometry)])) + min(delay_s, key=abs)
    for at_s, by_s in zip(since_s[1:], np.diff(delay_s).tolist(), strict=True):
        remarks.append(f"odometry is later by {by_s:+.1f} s than the detections from {at_s:.1f} s on, undone")
    kept = stamp_s > np.maximum.accumulate(np.append(-np.inf, stamp_s[:-1]))
    return replace(recording, odometry=replace(rows_of(odometry, kept), stamp_s=stamp_s[kept]))


def _longest_pause(stamp_s: FloatArray, first_s: float, last_s: float) -> tuple[int, float]:
    """The row after the longest pause between two instants, and a few seconds around, and how long it is."""
    first, last = np.searchsorted(stamp_s, [first_s - AROUND_S, last_s + AROUND_S]).tolist()
    first = min(max(first, 1), len(stamp_s) - 1)
    pauses = np.diff(stamp_s[first - 1 : max(last, first) + 1])
    longest = int(np.argmax(pauses))
    return first + longest, float(pauses[longest])


def _while_driving(recording: Recording, settings: CleaningConfig, remarks: list[str]) -> Recording:
    """Drop frames far before the first or after the last odometry, where the motion is unknown."""
    if len(odometry := recording.odometry) == 0:
        return recording
    stray_s, stamp_s = settings.stray_s, recording.frames.stamp_s
    near = (stamp_s >= odometry.stamp_s[0] - stray_s) & (stamp_s <= odometry.stamp_s[-1] + stray_s)
    _remark(remarks, f"frames more than {stray_s:g} s before or after the odometry dropped", int(np.sum(~near)))
    return recording if near.all() else some_frames(recording, near)


def some_frames(recording: Recording, kept: BoolArray) -> Recording:
    """Return the recording with the `kept` (F,) frames and their detections only."""
    seen = rows_of(recording.detections, kept[recording.detections.frame])
    row: IntArray = (np.cumsum(kept) - 1).astype(np.int64)
    frames = replace(recording.frames, stamp_s=recording.frames.stamp_s[kept])
    return replace(recording, frames=frames, detections=replace(seen, frame=row[seen.frame]))


def _fresh(recording: Recording, settings: CleaningConfig, remarks: list[str]) -> Recording:
    """Without frames that repeat the one before, number by number, though the robot moved: the sensor hangs.

    A single reading may repeat by chance, where a camera counts whole pixels, but not over a metre.
    """
    frames, detections, odometry = recording.frames, recording.detections, recording.odometry
    if len(frames) < 2 or len(odometry) < 2:
        return recording
    first = np.searchsorted(detections.frame, np.arange(len(frames) + 1))
    count = np.diff(first)
    before = detections.frame - 1
    alike = (before >= 0) & (count[detections.frame] == count[before])
    at = np.where(alike, first[before] + np.arange(len(detections)) - first[detections.frame], 0)
    for name in ("landmark_id", "range_m", "bearing_rad"):
        column = np.nan_to_num(getattr(detections, name), nan=np.inf)
        alike &= column == column[at]
    repeated = (count > 0) & (np.bincount(detections.frame, alike, minlength=len(frames)) == count)
    least = np.where(count > 1, 1.0, SINGLE) * settings.moved
    since = np.maximum.accumulate(np.where(repeated, 0, np.arange(len(frames))))
    repeated &= _has_moved_since(since, frames, odometry, least)
    _remark(remarks, "frames dropped that repeat the previous one although the robot moved", int(repeated.sum()))
    return some_frames(recording, ~repeated) if repeated.any() else recording


def _has_moved_since(row: IntArray, frames: Frames, odometry: Odometry, most: FloatArray) -> BoolArray:
    """Return (F,) whether the robot drove or turned by more than `most` since the frames in `row` (F,)."""
    speed = np.stack([np.hypot(odometry.forward_mps, odometry.lateral_mps), np.abs(odometry.angular_radps)])
    way = np.pad(np.cumsum(speed[:, :-1] * np.diff(odometry.stamp_s), axis=1), ((0, 0), (1, 0)))
    at = np.stack([np.interp(frames.stamp_s, odometry.stamp_s, column) for column in way])
    return np.asarray(np.any(at - at[:, row] > most, axis=0))


def _mend_stamps(what: str, stamp_s: FloatArray, settings: CleaningConfig, remarks: list[str]) -> FloatArray:
    """Return (N,) stamps of a clock that is never set back, nan for invalid ones."""
    stamps, back_s = restored(stamp_s, settings)
    real = stamps[np.isfinite(stamps)]
    _remark(remarks, f"invalid stamps of the {what} dropped with their rows", len(stamps) - len(real))
    late = int(np.sum(real < np.maximum.accumulate(real))) if len(real) else 0
    _remark(remarks, f"late stamps of the {what} sorted", late)
    if len(back_s):
        steps = ", ".join(f"{step:.1f}" for step in back_s[:3]) + (", ..." if len(back_s) > 3 else "")
        remarks.append(f"clock of the {what} {SET_BACK}, by {steps} s; later stamps continue from there")
    return stamps


def _remark(remarks: list[str], what: str, count: int) -> None:
    if count:
        remarks.append(f"{what}: {count}")


def restored(stamp_s: FloatArray, settings: CleaningConfig) -> tuple[FloatArray, FloatArray]:
    """Return the stamps (N,) of a clock that is never set back, of any stamps in the order of arrival.

    Returns:
        (N,) stamps, nan where one is none; late ones still stand where they arrived. And (K,) by how much the clock was
        set back, each time.
    """
    stamps = np.where(np.abs(stamp_s) <= LATEST_S, stamp_s, np.nan)  # nan fails the comparison
    if np.all(np.diff(stamps) > 0.0):
        return stamps, np.zeros(0)
    found = np.flatnonzero(np.isfinite(stamps))
    told = stamps[found]
    kept = np.abs(told - find_running_median(told, settings.around)) <= settings.stray_s
    stamps[found[~kept]] = np.nan
    found, told = found[kept], told[kept]
    forward = np.diff(told)
    forward = forward[forward > 0.0]
    # against a clock that ticks once a message, a loss is a step up, and only a clock that is set back a step down
    ahead = find_running_median(
        told - np.arange(len(told)) * (np.median(forward) if len(forward) else 0.0), settings.around
    )
    fall = np.diff(ahead, prepend=ahead[:1])
    set_back = fall < -settings.step_s
    stamps[found] = told - np.cumsum(np.where(set_back, fall, 0.0))
    return stamps, -fall[set_back]


def set_forward(stamp_s: FloatArray, other_s: FloatArray, settings: CleaningConfig) -> tuple[int, float] | None:
    """Return whether a clock was set forward, judged by another stream of the same robot; both increase.

    It was, if this stream seems to end later than the other, and has a pause of just that length in which the other
    goes on.

    Returns:
        First row after the step and the step's size [s]; None if it was not.
    """
    if len(stamp_s) < settings.around or len(other_s) < settings.around:
        return None
    later_s = stamp_s[-1] - other_s[-1]
    if later_s < 2.0 * settings.step_s:
        return None
    pause = np.diff(stamp_s)
    step_s = pause - np.median(pause)
    row = int(np.argmin(np.abs(step_s - later_s)))
    if abs(step_s[row] - later_s) > settings.step_s:
        return None
    between = other_s[(other_s > stamp_s[row]) & (other_s < stamp_s[row + 1])]
    longest_s = np.max(np.diff(between, prepend=stamp_s[row], append=min(stamp_s[row + 1], other_s[-1])))
    return None if longest_s > 0.5 * step_s[row] else (row + 1, float(step_s[row]))
