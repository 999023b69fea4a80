"""Small tables for `evermap init`: of looks for `evermap persist`, of detections for `evermap track`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evermap.io.files import write_new
from evermap.io.table import csv_text
from evermap.types import FloatArray

_DAY_S, _HOUR_S = 86400.0, 3600.0

# ------------------------------------------- looks: a robot passes six things every now and then for a week

_WEEK_DAYS = 7
_P_MISS, _P_FALSE = 0.1, 0.02
# What is there from when to when [days]; a thing that is there at the end stays.
_THERE_DAYS: dict[str, tuple[str, tuple[tuple[float, float], ...]]] = {
    "pillar-1": ("pillar", ((0.0, 99.0),)),
    "pillar-2": ("pillar", ((0.0, 99.0),)),
    "pallet-7": ("pallet", ((0.0, 2.6),)),
    "pallet-8": ("pallet", ((1.4, 5.3),)),
    "pallet-9": ("pallet", ((3.2, 99.0),)),
    "cart-3": ("cart", ((0.0, 1.1), (1.9, 3.4), (4.5, 6.1))),
}
_ABOUT_LOOKS = """\
Looks of a detector at objects that leave and return: replace these rows with your own, in any order.
stamp_s     seconds, of any clock
feature_id  any name or number
detected    1: detected, 0: looked at and not detected; empty: no look, only the belief is requested
optional    p_miss, p_false: of this look, if they differ from --p-miss and --p-false
optional    class_id: any name, for lifetimes of classes, as in --prior cart=exponential:half-life=1d
optional    present: the truth, 1 or 0, empty where unknown; it only scores the result"""


def write_looks(path: str | Path) -> Path:
    """Write a commented table for `evermap persist`; the same bytes every time.

    Raises:
        InputError: the file exists, or cannot be written.
    """
    columns = _columns(("stamp_s", "feature_id", "class_id", "detected", "present"), _looks())
    return write_new(path, csv_text(columns, comment=_ABOUT_LOOKS))


def _columns(names: Sequence[str], rows: Iterable[tuple[str, ...]]) -> dict[str, list[str]]:
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))


def _looks() -> Iterator[tuple[str, ...]]:
    """Cells of each row."""
    random = np.random.default_rng(8)
    for day in range(_WEEK_DAYS):
        for hour in np.arange(8.0, 18.0, 0.5):  # half-hourly patrols, by day only
            stamp_s = day * _DAY_S + hour * _HOUR_S + float(random.integers(0, 900))
            for name, (kind, stays) in _THERE_DAYS.items():
                if random.random() < 0.3:
                    continue  # not in view this time
                there = any(begin <= stamp_s / _DAY_S < end for begin, end in stays)
                detected = random.random() < (1.0 - _P_MISS if there else _P_FALSE)
                yield f"{stamp_s:.0f}", name, kind, str(int(detected)), str(int(there))
    for name, (kind, _) in _THERE_DAYS.items():
        yield f"{(_WEEK_DAYS + 1) * _DAY_S:.0f}", name, kind, "", ""


# ------------------------------------------- detections: a robot passes through a yard seven times a day

RANGE_M = 12.0
"""Range of the example's sensor, for `--range-m`."""
_DAYS, _PATROL_HOURS = 4, range(8, 21, 2)
_STEP_S, _FRAMES, _SPEED_MPS = 0.5, 40, 1.5
_P_DETECT, _P_CLUTTER, _SIGMA_M = 0.95, 0.05, 0.1
_PLACES = tuple((x, y) for y in (-5.0, 5.0) for x in (3.0, 9.0, 15.0, 21.0, 27.0))
_MEAN_STAY_H = {"pallet": 20.0, "cart": 5.0}
_PILLARS = ((0.0, 8.0), (30.0, 8.0))
_ABOUT_DETECTIONS = """\
Detections of objects in space: replace these rows with your own, in any order.
stamp_s   seconds, of any clock; rows of one stamp are a frame
x_m, y_m, z_m  position in the world; a row without one is a frame in which nothing was detected, which is evidence
optional  class_id: any name or number
optional  cov_xx_m2, cov_xy_m2, cov_xz_m2, cov_yy_m2, cov_yz_m2, cov_zz_m2, or sigma_m: uncertainty
optional  score: the detector's confidence, on any scale; from 0 to 1 it is the probability of being real
optional  length_m, width_m, height_m, yaw_rad: a box around the position
optional  appearance_0, appearance_1, ...: any feature vector, similar for similar objects
optional  sensor_x_m, sensor_y_m, sensor_z_m: position of the sensor; with --range-m, misses in view are evidence"""


class _Stay(NamedTuple):
    kind: str
    place: tuple[float, float]
    begin_h: float
    end_h: float


def write_detections(path: str | Path) -> Path:
    """Write a commented table for `evermap track --range-m 12`; the same bytes every time.

    Raises:
        InputError: the file exists, or cannot be written.
    """
    names = ("stamp_s", "class_id", "x_m", "y_m", "z_m", "sigma_m", "sensor_x_m", "sensor_y_m", "sensor_z_m")
    columns = _columns(names, _rows(np.random.default_rng(12)))
    return write_new(path, csv_text(columns, comment=_ABOUT_DETECTIONS))


def _rows(random: np.random.Generator) -> Iterator[tuple[str, ...]]:
    """Cells of each row, frame after frame."""
    stays = list(_stays(random))
    for day in range(_DAYS):
        for hour in _PATROL_HOURS:
            walker = random.random() < 0.5
            for k in range(_FRAMES):
                time_h = day * 24.0 + hour + k * _STEP_S / _HOUR_S
                sensor = np.array([_SPEED_MPS * _STEP_S * k, 0.0, 1.0])
                there = [(s.kind, np.array([*s.place, 0.5])) for s in stays if s.begin_h <= time_h < s.end_h]
                if walker:
                    there.append(("person", np.array([28.0 - 1.2 * _STEP_S * k, 1.5, 0.9])))
                seen = _draw_detections(random, there, sensor)
                rows = [(kind, *(f"{value:.3f}" for value in position), str(_SIGMA_M)) for kind, position in seen]
                for cells in rows or [("", "", "", "", "")]:
                    yield (f"{time_h * _HOUR_S:.1f}", *cells, *(f"{value:.2f}" for value in sensor))


def _draw_detections(
    random: np.random.Generator, there: list[tuple[str, FloatArray]], sensor: FloatArray
) -> Iterator[tuple[str, FloatArray]]:
    """Return detections of present objects, and some false ones."""
    for kind, position in there:
        if np.linalg.norm(position - sensor) <= RANGE_M and random.random() < _P_DETECT:
            yield kind, position + random.normal(0.0, _SIGMA_M, 3)
    if random.random() < _P_CLUTTER:
        yield str(random.choice(["pallet", "cart"])), sensor + random.uniform(-8.0, 8.0, 3) * [1.0, 1.0, 0.0]


def _stays(random: np.random.Generator) -> Iterator[_Stay]:
    """Pillars for ever; in each place one pallet or cart after another, with a while between them.

    Each stands elsewhere in its place than the one before, as nobody can tell two that look alike by less.
    """
    for place in _PILLARS:
        yield _Stay("pillar", place, -np.inf, np.inf)
    for place in _PLACES:
        begin_h, side_m = random.exponential(8.0) - 8.0, 0.8
        while begin_h < 24.0 * _DAYS:
            kind = str(random.choice(list(_MEAN_STAY_H)))
            end_h = begin_h + random.exponential(_MEAN_STAY_H[kind])
            yield _Stay(kind, (place[0] + side_m, place[1]), begin_h, end_h)
            side_m = -side_m
            begin_h = end_h + random.exponential(6.0)
