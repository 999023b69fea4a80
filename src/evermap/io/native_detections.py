"""Detections of a native recording, and the frames that they were made in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from evermap import valid as q
from evermap.io.assemble import forward_stamps, wrap_far
from evermap.io.landmarks import class_ids
from evermap.io.sensor_toml import Settings
from evermap.io.table import Table
from evermap.io.text import counted
from evermap.types import Detections, FloatArray, Frames, IntArray

SAME_STAMP_S: float = 1e-6
"""Stamps closer than this are the same instant when detections are put into frames."""

POLAR = ("range_m", "bearing_rad")
_CARTESIAN = ("x_m", "y_m")
_POLAR_SIGMAS = ("sigma_range_m", "sigma_bearing_rad")
_ROUND_SIGMAS = ("sigma_m", "sigma")


def frames_and_detections(
    table: Table,
    frame_table: Table | None,
    class_names: tuple[str, ...],
    settings: Settings,
    warnings: list[str],
    names: dict[int, str],
) -> tuple[Frames, Detections]:
    """Frames of a native recording and the detections in them.

    Args:
        table: the detections.
        frame_table: every instant at which the sensor looked; None takes the distinct stamps of the detections.
        class_names: all class labels.
        settings: clock, and whether the frames are complete.
        warnings: gets a remark on repeated frames.
        names: gets the texts behind landmark ids that are texts.

    Raises:
        InputError: a value is malformed, or a detection lies in no frame.
    """
    given = table.one_form(POLAR, _CARTESIAN)
    table.expect(("stamp_s", "landmark_id", *given), ("class_id", *_POLAR_SIGMAS, *_ROUND_SIGMAS))
    stamp_s = forward_stamps(table)
    complete = settings.frames_complete if settings.frames_complete is not None else frame_table is not None
    looked_s = stamp_s
    if frame_table is not None:
        frame_table.expect(("stamp_s",))
        looked_s = forward_stamps(frame_table)
    is_first = np.diff(looked_s, prepend=-np.inf) > SAME_STAMP_S
    if frame_table is not None and not is_first.all():
        merged = counted(int(np.sum(~is_first)), "row")
        warnings.append(f"{frame_table.path.name}: {merged} with the stamp of the row before left out")
    frame_of_look = np.cumsum(is_first) - 1
    range_m, bearing_rad = polar(table) if given is POLAR else _polar_of_cartesian(table)
    sigma_range_m, sigma_bearing_rad = _sigmas(table, range_m)
    detections = Detections(
        frame=frame_of_look[_nearest_look(stamp_s, looked_s, table, frame_table)],
        landmark_id=table.ids("landmark_id", optional=True, names=names),
        range_m=range_m,
        bearing_rad=bearing_rad,
        class_id=class_ids(table, class_names),
        sigma_range_m=sigma_range_m,
        sigma_bearing_rad=sigma_bearing_rad,
        source_line=np.asarray(table.line, dtype=np.int64),
    )
    return Frames(looked_s[is_first], complete=complete, clock=settings.clock), detections


def polar(table: Table) -> tuple[FloatArray, FloatArray]:
    """Range and bearing, the latter within half a turn. Shapes (R,)."""
    return table.numbers(q.RANGE_M), wrap_far(table.numbers(q.BEARING_RAD))


def _polar_of_cartesian(table: Table) -> tuple[FloatArray, FloatArray]:
    x, y = table.numbers(q.X_M), table.numbers(q.Y_M)
    range_m = np.hypot(x, y)
    replace(q.RANGE_M, name="x_m, y_m", high=np.inf).check(range_m, path=table.path, line=table.line)
    return range_m, np.arctan2(y, x)


def _sigmas(table: Table, range_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    round_names = [name for name in _ROUND_SIGMAS if name in table]
    polar_names = [name for name in _POLAR_SIGMAS if name in table]
    if len(round_names) + bool(polar_names) > 1:
        other = (*polar_names, *round_names[1:])[0]
        problem = f"{round_names[0]} and {other} are both given"
        raise table.error(problem, row=None, field=round_names[0], hint="keep one of them")
    if round_names:
        # a position known equally well in all directions: to first order sigma along the ray, sigma / range across it
        sigma = table.numbers(replace(q.SIGMA_RANGE_M, name=round_names[0]))
        return sigma, sigma / range_m
    unknown = np.full(len(table), np.nan)
    return (
        table.numbers(q.SIGMA_RANGE_M) if "sigma_range_m" in table else unknown,
        table.numbers(q.SIGMA_BEARING_RAD) if "sigma_bearing_rad" in table else unknown.copy(),
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
        hint = f"list every instant at which the sensor looked, or leave {file} out"
        raise table.error(problem, row=row, field="stamp_s", hint=hint)
    return np.asarray(nearest - 1, dtype=np.int64)
