"""What a sensor can see, from what it saw, where nobody says it: of a camera, a miss beside its view is no miss."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evermap.config import TrackConfig
from evermap.tracking.frame import DetectionTable
from evermap.tracking.views import View
from evermap.types import FloatArray, IntArray

N_WAYS = 12
"""Directions of the world that are told apart: frames of one of them show the same things."""


@dataclass(frozen=True, slots=True)
class FieldOfView:
    """The directions that a sensor sees, of each frame.

    Attributes:
        yaw_rad: (F,) the middle of what is seen, in the world.
        fov_rad: (F,) angle within which all is seen.
        beside_rad: (F,) angle, on either side of that, over which what may be in view falls from all to nothing.
        remark: half a line for people; '' where it was stated.
    """

    yaw_rad: FloatArray
    fov_rad: FloatArray
    beside_rad: FloatArray
    remark: str = ""

    def view(self, k: int, centre_m: FloatArray, reach_m: float, p_detect: float) -> View:
        """Return the view of frame `k`."""
        angles = float(self.yaw_rad[k]), float(self.fov_rad[k]), float(self.beside_rad[k])
        return View.sector(centre_m, reach_m, p_detect, *angles)


def find_field_of_view(table: DetectionTable, config: TrackConfig) -> FieldOfView | None:
    """Return what the sensor of a table can see, as stated or from its detections; None for all around.

    Where its heading is known, or it does not turn, that is the sector that holds all detections. Where it turns and
    its heading is unknown, it is a sector as wide as the widest of a frame, which holds the detections of each frame:
    what is between these is in view, and what is beside them with a probability.
    """
    n = table.n_frames
    if table.sensor_m is None:
        return None
    heading = np.zeros(n) if table.sensor_yaw_rad is None else table.sensor_yaw_rad
    if config.fov_deg is not None:
        return FieldOfView(heading, np.full(n, np.radians(config.fov_deg)), np.zeros(n))
    counts = np.diff(table.first)
    off = table.position_m - np.repeat(table.sensor_m, counts, axis=0)
    bearing = np.arctan2(off[:, 1], off[:, 0]) - np.repeat(heading, counts)
    middle, width = smallest_sector(bearing)
    if width < np.radians(config.all_around_deg):
        where = "" if table.sensor_yaw_rad is None else f" from {_degrees(middle - 0.5 * width)}"
        remark = f"the field of view is taken from detections: {np.degrees(width):.0f} deg{where} (`fov_deg` sets it)"
        return FieldOfView(heading + middle, np.full(n, width), np.zeros(n), remark)
    if table.sensor_yaw_rad is not None:
        return None
    sectors = np.array([smallest_sector(bearing[a:b]) for a, b in zip(table.first[:-1], table.first[1:], strict=True)])
    widest = float(sectors[:, 1].max())
    if _chance(sectors, counts, widest) > config.p_all_around:
        return None
    fov = np.where(counts > 0, sectors[:, 1], 0.0)
    beside = np.where(counts > 0, np.maximum(widest - fov, 0.0), 0.0)
    remark = (
        f"the sensor turns, and its heading is unknown: it sees {np.degrees(widest):.0f} deg at once, so misses count"
        " between detections of the same frame (give its poses: see `evermap track --help`)"
    )
    return FieldOfView(sectors[:, 0], fov, beside, remark)


def _chance(sectors: FloatArray, counts: IntArray, widest_rad: float) -> float:
    """How often a sensor that sees all around has everything within `widest_rad`, whichever way it is.

    Of m directions by chance `m (w / 2 pi)^(m - 1)` at most lie within an angle w (exactly, up to half a turn); and
    what is seen one way knows nothing of what is seen another way.
    """
    way = np.floor(np.remainder(sectors[:, 0], 2.0 * np.pi) / (2.0 * np.pi) * N_WAYS).astype(np.int64) % N_WAYS
    chance = 1.0
    for k in range(N_WAYS):
        m = counts[(way == k) & (counts > 0)]
        if len(m):
            usual = float(np.median(m))
            chance *= min(1.0, usual * (widest_rad / (2.0 * np.pi)) ** (usual - 1.0))
    return chance


def smallest_sector(bearing_rad: FloatArray) -> tuple[float, float]:
    """Return the middle and the width [rad] of the smallest sector that holds all bearings (M,); 0, 0 of none."""
    if not len(bearing_rad):
        return 0.0, 0.0
    sorted_rad = np.sort(np.remainder(bearing_rad, 2.0 * np.pi))
    gaps = np.diff(np.append(sorted_rad, sorted_rad[0] + 2.0 * np.pi))
    widest = int(np.argmax(gaps))
    width = 2.0 * np.pi - float(gaps[widest])
    first = float(sorted_rad[(widest + 1) % len(sorted_rad)])
    return float(np.remainder(first + 0.5 * width + np.pi, 2.0 * np.pi) - np.pi), width


def _degrees(angle_rad: float) -> str:
    turned = np.degrees(np.remainder(angle_rad + np.pi, 2.0 * np.pi) - np.pi)
    return f"{turned:+.0f} deg on"
