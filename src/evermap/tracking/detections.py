"""The tables that `evermap track` reads: detections, put together into frames, poses of a sensor that moves, and how
often classes are confused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from evermap.errors import ConfigError, DataError, InputError
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.io.columns import Columns, DataFrame, TableSource, path_of, read_columns
from evermap.io.native_space import IMAGE_BOX
from evermap.io.spatial import BOX as SIDES
from evermap.io.spatial import COVARIANCE
from evermap.io.table import ENDINGS
from evermap.io.text import quote
from evermap.tracking.frame import DetectionTable, Poses, box_table, boxes_of, in_world
from evermap.types import UNKNOWN, BoolArray, Clock, FloatArray, IntArray, is_in_space, rows_of
from evermap.valid import QUATERNION, STAMP_S, X_M, Y_M, Z_M, Quantity

POSITION = tuple(replace(axis, optional=True) for axis in (X_M, Y_M, Z_M))
SENSOR = tuple(replace(axis, name=f"sensor_{axis.name}", hint="metres, in every row") for axis in (X_M, Y_M, Z_M))
SIGMA = Quantity("sigma_m", 0.0, 1e6, positive=True, optional=True, hint="metres; empty where unknown")
SCORE = Quantity("score", -1e9, 1e9, optional=True, hint="the detector's confidence, on any scale")
_HINT = "metres, in every row with a position"
BOX = (
    *(Quantity(name, 0.0, 1e4, positive=True, optional=True, hint=_HINT) for name in SIDES),
    Quantity("yaw_rad", -1e4, 1e4, optional=True, hint="radians, counter-clockwise from x"),
)
_REQUIRED = (STAMP_S.name, *(quantity.name for quantity in POSITION))
_OPTIONAL = (
    "class_id", *COVARIANCE, SIGMA.name, SCORE.name, *(quantity.name for quantity in (*BOX, *SENSOR)), *IMAGE_BOX,
)  # fmt: skip


def read_detections(source: TableSource, *, min_score: float | None = None) -> DetectionTable:
    """Return a table with `stamp_s, x_m, y_m, z_m` and perhaps class, box, covariance, score, appearance and the
    sensor's position.

    A row without a position is a frame in which nothing was detected.

    Args:
        source: a `.csv`, `.csv.gz` or `.parquet` file, or a data frame; rows in any order, those of one stamp are a
            frame.
        min_score: detections with a lower score are left out; their frames stay.

    Raises:
        InputError: anything wrong in the file, by line and column.
        ConfigError: `min_score` without scores.
    """
    warnings: list[str] = []
    table = read_columns(source, warnings)
    looks = _appearance_columns(table)
    table.expect(_REQUIRED, (*_OPTIONAL, *looks))
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path_of(source), hint="one row per detection")
    stamp_s = table.numbers(STAMP_S)
    position = np.stack([table.numbers(quantity) for quantity in POSITION], axis=1)
    given = ~np.isnan(position)
    partly = np.flatnonzero(given.any(axis=1) & ~given.all(axis=1))
    if partly.size:
        row = int(partly[0])
        field = POSITION[int(np.argmin(given[row]))].name
        raise table.error("is empty", row=row, field=field, hint="all of x_m, y_m, z_m, or none for an empty frame")
    kept = given.all(axis=1)
    strong = kept & _strong(table, min_score)
    if not strong.any():
        hint = "a row with a position" if not kept.any() else "a lower `min_score`"
        raise InputError("contains no detection", path=path_of(source), field="x_m", hint=hint)
    frames, frame = np.unique(stamp_s, return_inverse=True)
    rows = np.flatnonzero(strong)
    rows = rows[np.argsort(frame[rows], kind="stable")]
    class_names, class_id = table.labels("class_id") if "class_id" in table else ([], np.full(len(table), UNKNOWN))
    return DetectionTable(
        stamp_s=frames,
        first=np.searchsorted(frame[rows], np.arange(len(frames) + 1)),
        position_m=position[rows],
        class_names=tuple(class_names) or ("",),
        class_id=class_id[rows],
        covariance_m2=_covariances(table, rows),
        appearance=_appearances(table, looks, rows),
        sensor_m=_sensor(table, frame, len(frames)),
        line=table.line[rows],
        source="" if isinstance(source, DataFrame) else str(source),
        box=_boxes(table, rows),
        score=table.numbers(SCORE)[rows] if SCORE.name in table else None,
        n_weak=int((kept & ~strong).sum()),
        warnings=tuple(warnings),
        clock=table.clock() or Clock.RECORDING,
    )


def _boxes(table: Columns, rows: IntArray) -> FloatArray | None:
    """(M, 4) sizes and headings."""
    hint = "length_m, width_m, height_m and yaw_rad, or none of them"
    if not table.has_all([quantity.name for quantity in BOX], hint):
        return None
    box = np.stack([table.numbers(quantity) for quantity in BOX], axis=1)[rows]
    missing = np.argwhere(np.isnan(box))
    if len(missing):
        row, column = (int(k) for k in missing[0])
        hint = "all four, in every row with a position"
        raise table.error("is empty", row=int(rows[row]), field=BOX[column].name, hint=hint)
    return box


def _strong(table: Columns, min_score: float | None) -> BoolArray:
    """(R,) whether the score, where there is one, is high enough."""
    if min_score is None or (SCORE.name not in table and min_score <= 0.0):
        return np.ones(len(table), dtype=np.bool_)
    if SCORE.name not in table:
        raise ConfigError("the table has no scores", field="min_score", hint="a column score in the table")
    return np.asarray(~(table.numbers(SCORE) < min_score))


def _appearance_columns(table: Columns) -> list[str]:
    """`appearance_0` and so on, without a gap."""
    found = sorted(int(name[11:]) for name in table.columns if re.fullmatch(r"appearance_\d+", name))
    for number, name in enumerate(found):
        if number != name:
            raise table.error("missing column", row=None, field=f"appearance_{number}", hint="numbers from 0 on")
    return [f"appearance_{number}" for number in found]


def _appearances(table: Columns, names: Sequence[str], rows: IntArray) -> FloatArray | None:
    if not names:
        return None
    columns = [table.numbers(Quantity(name, -1e30, 1e30, optional=True)) for name in names]
    return np.nan_to_num(np.stack(columns, axis=1)[rows])


def _covariances(table: Columns, rows: IntArray) -> FloatArray | None:
    """(M, 3, 3), nan where a detection has none."""
    if SIGMA.name in table:
        for name in COVARIANCE:
            if name in table:
                raise table.error("duplicates sigma_m", row=None, field=name, hint="keep one of the two")
        return np.asarray(np.square(table.numbers(SIGMA))[rows, None, None] * np.eye(3))
    if not table.has_all(COVARIANCE, f"all of {', '.join(COVARIANCE)}, or none"):
        return None
    matrix = np.empty((len(rows), 3, 3))
    for name, i, j in zip(COVARIANCE, *np.triu_indices(3), strict=True):
        matrix[:, i, j] = matrix[:, j, i] = table.numbers(Quantity(name, -1e12, 1e12, optional=True))[rows]
    given = ~np.isnan(matrix)
    whole = np.atleast_1d(given.all(axis=(1, 2)))
    filled = np.where(whole[:, None, None], matrix, np.eye(3))
    wrong = (given.any(axis=(1, 2)) & ~whole) | (np.linalg.eigvalsh(filled)[:, 0] <= 0.0)
    if wrong.any():
        row = int(rows[np.argmax(wrong)])
        problem = "is not a covariance: not positive definite"
        raise table.error(problem, row=row, field=COVARIANCE[0], hint="or leave it empty")
    return np.where(whole[:, None, None], matrix, np.nan)


def _sensor(table: Columns, frame: IntArray, n_frames: int) -> FloatArray | None:
    """(F, 3) where the sensor was."""
    if not table.has_all([quantity.name for quantity in SENSOR], "all three, or none"):
        return None
    of_row = np.stack([table.numbers(quantity) for quantity in SENSOR], axis=1)
    sensor = np.empty((n_frames, 3))
    sensor[frame[::-1]] = of_row[::-1]  # of several assignments the last one holds: the first row
    elsewhere = np.flatnonzero(np.abs(of_row - sensor[frame]).max(axis=1) > 1e-6)
    if elsewhere.size:
        problem, row = "the sensor has two positions in one frame", int(elsewhere[0])
        raise table.error(problem, row=row, field=SENSOR[0].name, hint="one position per stamp")
    return sensor


def read_confusion(path: str | Path, class_names: Sequence[str]) -> FloatArray:
    """Return (C, C) `P(detected class | true class)` of a `.csv`, `.csv.gz` or `.parquet` table.

    It has a row for each true class: its name in `class_id`, and a column for each class that it is detected as.

    Raises:
        InputError: a class is missing or there twice, or a row is not a distribution; by line and column.
    """
    table = read_columns(path, [])
    table.expect(("class_id", *class_names))
    names, of_row = table.labels("class_id")
    columns = [table.numbers(Quantity(name, 0.0, 1.0, hint="a probability")) for name in class_names]
    p_detected = np.stack(columns, axis=1)
    confusion = np.full((len(class_names), len(class_names)), np.nan)
    for row, code in enumerate(of_row.tolist()):
        name = names[code] if code != UNKNOWN else ""
        if name not in class_names:
            hint = f"one of {', '.join(class_names)}"
            raise table.error(f"no detection is of class {quote(name)}", row=row, field="class_id", hint=hint)
        true = class_names.index(name)
        if not np.isnan(confusion[true, 0]):
            raise table.error(f"class {quote(name)} appears twice", row=row, field="class_id", hint="one row a class")
        total = float(p_detected[row].sum())
        if abs(total - 1.0) > 1e-6:
            raise table.error(f"the row sums to {total:g}", row=row, hint="probabilities that sum to 1")
        confusion[true] = p_detected[row]
    missing = np.flatnonzero(np.isnan(confusion[:, 0]))
    if missing.size:
        problem = f"has no row for class {quote(class_names[missing[0]])}"
        raise InputError(problem, path=path, field="class_id", hint="one row a class")
    return confusion


_POSE = (X_M, Y_M, Z_M, *(replace(one, hint="a unit quaternion") for one in QUATERNION))


def read_input(path: str | Path, *, min_score: float | None = None) -> DetectionTable:
    """Return what `read_detections` takes, or of a folder its tables `detections`, in a sensor's frame, and `odometry`.

    A recording with boxes, as `evermap slam` takes it, is followed along its odometry.

    Raises:
        InputError: a folder without these tables, or anything wrong in them.
        DataError: a recording without boxes, or without odometry.
        ConfigError: `min_score` without scores.
    """
    if not Path(path).is_dir():
        return read_detections(path, min_score=min_score)
    if "sensor" in read_columns(_table_of(Path(path), "detections"), []):
        return _boxes_of_recording(Path(path), min_score)
    detections = read_detections(_table_of(Path(path), "detections"), min_score=min_score)
    return in_world(detections, read_poses(_table_of(Path(path), "odometry")))


def _boxes_of_recording(path: Path, min_score: float | None) -> DetectionTable:
    """The boxes of a recording of `evermap slam`, in the frame of its odometry."""
    recording = read_recording(path)
    if not is_in_space(recording) or recording.odometry is None or not len(boxes_of(recording)):
        hint = "boxes with a size and without an id, and odometry"
        raise DataError(f"{path}: a recording without boxes to track", hint=hint)
    seen, odometry, stamp_s = recording.detections, recording.odometry, recording.frames.stamp_s
    if min_score is not None:
        if not np.isfinite(seen.score).any() and min_score > 0.0:
            raise ConfigError("the table has no scores", field="min_score", hint="a column score in the table")
        recording = replace(recording, detections=rows_of(seen, ~(seen.score < min_score)))
    driven = Poses(odometry.stamp_s, odometry.pose_world_robot, path)
    return in_world(box_table(recording), Poses(stamp_s, driven.at(stamp_s), path))


def _table_of(folder: Path, name: str) -> Path:
    """Return the table of a name in a folder, of whichever kind it is."""
    for ending in ENDINGS:
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
    table.expect((STAMP_S.name, *(one.name for one in _POSE)), tuple(table.columns))
    if len(table) == 0:
        raise InputError("has no rows below its header", path=path, hint="one row per pose")
    stamp_s = table.numbers(STAMP_S)
    pose = np.stack([table.numbers(quantity) for quantity in _POSE], axis=1)
    short = np.flatnonzero(np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1.0) > 1e-2)
    if short.size:
        raise table.error("is not of length one", row=int(short[0]), field="qx", hint="a unit quaternion")
    order = np.argsort(stamp_s, kind="stable")
    again = np.flatnonzero(np.diff(stamp_s[order]) <= 0.0)
    if again.size:
        problem = f"a second pose at {stamp_s[order[again[0]]]:g} s"
        raise table.error(problem, row=int(order[again[0] + 1]), field=STAMP_S.name)
    return Poses(stamp_s[order], se3.normalise_poses(pose[order]), path)
