"""Measurements of a recording, tied to the poses and places of a problem."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from evermap.estimate.measurement import Tied
from evermap.estimate.measurements import find_kinds
from evermap.types import FloatArray, IntArray, Measurements


def tie_measurements(
    tables: Sequence[Measurements],
    stamp_s: FloatArray,
    move: Callable[[FloatArray, FloatArray], FloatArray],
    landmark_id: IntArray,
) -> tuple[tuple[Tied, ...], list[str]]:
    """Tie measurements to the poses of a problem.

    Args:
        tables: the measurements; kinds that nobody knows are refused by whoever reads them.
        stamp_s: (N,) instants of the poses, on the clock of the tables.
        move: motion (K, 7) of the robot by the odometry, from some instants (K,) to others.
        landmark_id: (P,) sorted ids of the places.

    Returns:
        The measurements, and remarks on those that were left out.
    """
    found, remarks = [], []
    for table in tables:
        kind = find_kinds()[table.kind]
        to_s = table.columns.get("to_stamp_s", table.stamp_s)
        inside = np.minimum(table.stamp_s, to_s) >= stamp_s[0]
        inside &= np.maximum(table.stamp_s, to_s) <= stamp_s[-1]
        other = np.zeros(0, dtype=np.int64)
        if kind.ties == "pose_place":
            other = np.minimum(np.searchsorted(landmark_id, table.landmark_id), max(len(landmark_id) - 1, 0))
            inside &= landmark_id[other] == table.landmark_id if len(landmark_id) else False
        if not inside.all():
            remarks.append(f"{int((~inside).sum())} rows of {kind.name} beyond the poses, or of no landmark, not used")
        some = np.flatnonzero(inside)
        if not len(some):
            continue
        row, after = _instants(stamp_s, table.stamp_s[some], move)
        other_after = after
        if kind.ties == "pose_pose":
            other, other_after = _instants(stamp_s, to_s[some], move)
        elif len(other):
            other = other[some]
        columns = {name: column[some] for name, column in kind.fill_in(table.columns, len(table)).items()}
        found.append(Tied(kind, columns, row, after, other, other_after))
    return tuple(found), remarks


def _instants(
    stamp_s: FloatArray, instant_s: FloatArray, move: Callable[[FloatArray, FloatArray], FloatArray]
) -> tuple[IntArray, FloatArray]:
    """Return the last pose before each instant, and the motion (K, 7) from there."""
    row = np.clip(np.searchsorted(stamp_s, instant_s, side="right") - 1, 0, len(stamp_s) - 1)
    return row.astype(np.int64), move(stamp_s[row], instant_s)


def find_nearest(stamp_s: FloatArray, instant_s: FloatArray) -> IntArray:
    """Return the row (K,) of the pose whose stamp (N,) is nearest to each instant (K,); of two, the later one."""
    after = np.clip(np.searchsorted(stamp_s, instant_s), 1, len(stamp_s) - 1)
    return after - (instant_s - stamp_s[after - 1] < stamp_s[after] - instant_s)


def without_frames(tables: Sequence[Measurements]) -> tuple[Measurements, ...]:
    """Return the measurements without those that have a frame of their own: what is laid over others has none."""
    return tuple(table for table in tables if find_kinds()[table.kind].frame is None)
