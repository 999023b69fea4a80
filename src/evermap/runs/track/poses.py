"""Detections in the frame of a sensor that moves: its poses, and the same detections in the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.columns import read_columns
from evermap.runs.track.detections import POSITION, read_detections
from evermap.tracking.table import DetectionTable, Poses, in_world
from evermap.valid import STAMP_S, Quantity

_QUATERNION = tuple(Quantity(name, -2.0, 2.0, hint="a unit quaternion") for name in ("qx", "qy", "qz", "qw"))
_PLACE = tuple(Quantity(quantity.name, quantity.low, quantity.high, hint="metres") for quantity in POSITION)


def read_input(path: str | Path, *, min_score: float | None = None) -> DetectionTable:
    """Return the detections of a table, or of a folder with the tables `detections`, in a sensor's frame, and
    `odometry`, its poses.

    Args:
        path: what `read_detections` takes, or a folder.
        min_score: detections with a lower score are left out.

    Raises:
        InputError: a folder without these tables, or anything wrong in them.
    """
    if not Path(path).is_dir():
        return read_detections(path, min_score=min_score)
    detections = read_detections(_table_of(Path(path), "detections"), min_score=min_score)
    return in_world(detections, read_poses(_table_of(Path(path), "odometry")))


def _table_of(folder: Path, name: str) -> Path:
    """Return the table of a name in a folder, of whichever kind it is."""
    for ending in (".csv", ".csv.gz", ".parquet"):
        if (folder / f"{name}{ending}").is_file():
            return folder / f"{name}{ending}"
    hint = "detections.csv in the sensor's frame and odometry.csv, or the table itself for detections in the world"
    raise InputError(f"has no table '{name}'", path=folder, hint=hint)


def read_poses(path: Path) -> Poses:
    """Return a table with `stamp_s, x_m, y_m, z_m, qx, qy, qz, qw`; more columns are not read.

    Raises:
        InputError: anything wrong in the file, by line and column.
    """
    table = read_columns(path, [])
    table.expect((STAMP_S.name, *(q.name for q in (*_PLACE, *_QUATERNION))), tuple(table.cells))
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path, hint="one row a pose")
    stamp_s = table.numbers(STAMP_S)
    pose = np.stack([table.numbers(quantity) for quantity in (*_PLACE, *_QUATERNION)], axis=1)
    short = np.flatnonzero(np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1.0) > 1e-2)
    if short.size:
        raise table.error("is not of length one", row=int(short[0]), field="qx", hint="a unit quaternion")
    order = np.argsort(stamp_s, kind="stable")
    again = np.flatnonzero(np.diff(stamp_s[order]) <= 0.0)
    if again.size:
        problem = f"a second pose at {stamp_s[order[again[0]]]:g} s"
        raise table.error(problem, row=int(order[again[0] + 1]), field=STAMP_S.name)
    return Poses(stamp_s[order], se3.normalised(pose[order]), path)
