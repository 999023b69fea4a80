"""A small table of looks for `evermap persist --init`: a robot passes six things every now and then for a week."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from evermap.io.files import write_new
from evermap.io.table import csv_text

_DAY_S, _HOUR_S = 86400.0, 3600.0
_DAYS = 7
_P_MISS, _P_FALSE = 0.1, 0.02
# What is there from when to when [days]; a thing that is there at the end stays.
_STAYS: dict[str, tuple[str, tuple[tuple[float, float], ...]]] = {
    "pillar-1": ("pillar", ((0.0, 99.0),)),
    "pillar-2": ("pillar", ((0.0, 99.0),)),
    "pallet-7": ("pallet", ((0.0, 2.6),)),
    "pallet-8": ("pallet", ((1.4, 5.3),)),
    "pallet-9": ("pallet", ((3.2, 99.0),)),
    "cart-3": ("cart", ((0.0, 1.1), (1.9, 3.4), (4.5, 6.1))),
}
_COMMENT = """\
Looks of a detector at things that come and go: replace these rows by your own, in any order.
stamp_s     seconds, of any clock
feature_id  any name or number
detected    1: detected, 0: looked at and not detected; empty: no look, but the belief is wanted
optional    p_miss, p_false: of this look, where --p-miss and --p-false do not fit
optional    class_id: any name, for lifetimes of classes, as in --prior cart=exponential:half-life=1d
optional    present: the truth, 1 or 0, empty where unknown; it only scores the result"""


def write_example(path: str | Path) -> Path:
    """Write a commented table that `evermap persist` takes as it is; the same bytes every time.

    Raises:
        InputError: the file exists, or cannot be written.
    """
    return write_new(path, csv_text(_columns(), comment=_COMMENT))


def _columns() -> dict[str, Any]:
    random = np.random.default_rng(8)
    columns: dict[str, list[str]] = {"stamp_s": [], "feature_id": [], "class_id": [], "detected": [], "present": []}
    for day in range(_DAYS):
        for hour in np.arange(8.0, 18.0, 0.5):  # half-hourly patrols, by day only
            stamp_s = day * _DAY_S + hour * _HOUR_S + float(random.integers(0, 900))
            for name, (kind, stays) in _STAYS.items():
                if random.random() < 0.3:
                    continue  # not in view this time
                there = any(begin <= stamp_s / _DAY_S < end for begin, end in stays)
                detected = random.random() < (1.0 - _P_MISS if there else _P_FALSE)
                _append(columns, stamp_s, name, kind, str(int(detected)), str(int(there)))
    for name, (kind, _) in _STAYS.items():
        _append(columns, (_DAYS + 1) * _DAY_S, name, kind, "", "")
    return columns


def _append(columns: dict[str, list[str]], stamp_s: float, *cells: str) -> None:
    for column, cell in zip(columns.values(), (f"{stamp_s:.0f}", *cells), strict=True):
        column.append(cell)
