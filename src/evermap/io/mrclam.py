"""UTIAS Multi-Robot Cooperative Localization and Mapping (MRCLAM) recordings, as their authors publish them.

Leung, Halpern, Barfoot, Liu: The UTIAS Multi-Robot Cooperative Localization and Mapping Dataset, IJRR 30(8), 2011.
Read from the zip or its unpacked folder; only one robot at a time.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from evermap import valid as q
from evermap.errors import DataError, InputError
from evermap.io.assemble import check_forward, finish_recording, last_of_equal, repeats, wrap_far
from evermap.io.bad_rows import longest_forward
from evermap.io.files import FileSet, Reader, find_file_set
from evermap.io.text import Rows, counted, parse_rows
from evermap.types import (
    UNKNOWN,
    Clock,
    Detections,
    Frames,
    IntArray,
    Landmarks,
    Odometry,
    Recording,
    RobotSightings,
    Sensor,
    SensorKind,
    Trajectory,
)

LAST_ROBOT_SUBJECT = 5
"""Subjects 1 to 5 are robots, 6 to 20 landmarks, in all nine datasets."""

CAMERA = Sensor(
    kind=SensorKind.CAMERA,
    range_min_m=0.5,
    range_max_m=10.0,
    bearing_min_rad=-0.65,
    bearing_max_rad=0.65,
    p_detect=0.4,
    p_false=0.001,
)
"""The robots' forward camera. Rounded outwards from their readings (0.8 to 9.6 m, -0.59 to 0.57 rad).
It decodes less than half of the barcodes in view. Noise is estimated from the recording."""

MOST_STRAY = 1e-3
"""Maximum share of rows out of order in a file that is sorted."""

_NAME = re.compile(r"Robot(\d{1,6})_(Odometry|Measurement)\.dat", re.ASCII)
_SUBJECT = q.Quantity("subject", 1, 1e6, hint="subjects count from 1")
_BARCODE = q.Quantity("barcode", 0, 1e6, hint="barcodes are whole numbers")


def read_mrclam(path: str | Path, robot: int | None = None) -> Recording:
    """Return one robot's part of an MRCLAM recording.

    Args:
        path: `MRCLAM_DatasetN.zip`, with a folder inside or not, or the unpacked folder.
        robot: number from 1; None takes the lowest that has both odometry and measurements.

    Returns:
        Unix stamps; one frame for every distinct measurement stamp, also where only robots were seen; `frames.complete`
        is False since the recordings do not log empty images. Ground truth where its files are there, in part or whole.

    Raises:
        InputError: a file that is needed is missing or malformed; the robot is not in the recording.
        DataError: nothing to estimate from, for example no landmark was ever seen.
    """
    files = find_file_set(path, _is_mrclam)
    if files is None:
        raise InputError("no MRCLAM recording here", path=path, hint=MRCLAM.looks_for)
    robot = _choose_robot(files, robot)
    warnings: list[str] = []
    odometry = _read_odometry(files, robot, warnings)
    frames, detections, sightings = _read_measurements(files, robot, warnings)
    name = files.title if files.title.startswith("MRCLAM") else f"MRCLAM {files.title}"
    recording = Recording(
        name=f"{name} robot {robot}",
        odometry=odometry,
        frames=frames,
        detections=detections,
        sensor=CAMERA,
        truth=_read_truth(files, robot, warnings),
        true_landmarks=_read_landmarks(files, warnings),
        robot_sightings=sightings,
        source=str(path),
        clock=Clock.UNIX,
        robot=f"robot {robot}",
    )
    return finish_recording(recording, warnings=warnings)


def _is_mrclam(files: FileSet) -> bool:
    return any(_NAME.fullmatch(name) for name in files.members)


def _complete_robots(files: FileSet) -> tuple[int, ...]:
    kinds = Counter(int(match[1]) for name in files.members if (match := _NAME.fullmatch(name)))
    return tuple(sorted(robot for robot, count in kinds.items() if count == 2))


MRCLAM = Reader(
    "mrclam",
    "Robot<N>_Odometry.dat, Robot<N>_Measurement.dat and Barcodes.dat",
    _is_mrclam,
    read_mrclam,
    _complete_robots,
)


def _choose_robot(files: FileSet, robot: int | None) -> int:
    complete = _complete_robots(files)
    numbers = ", ".join(map(str, complete)) or "none"
    if robot is None:
        if not complete:
            raise InputError("no robot has both odometry and measurements", path=files.root / files.folder)
        return complete[0]
    if robot not in complete:
        lacking = [kind for kind in ("Odometry", "Measurement") if f"Robot{robot}_{kind}.dat" not in files]
        only_one = len(lacking) == 1
        problem = f"robot {robot} has no {lacking[0].lower()} file" if only_one else f"there is no robot {robot}"
        raise InputError(problem, path=files.root / files.folder, hint=f"robots with both files: {numbers}")
    return robot


def _read_odometry(files: FileSet, robot: int, warnings: list[str]) -> Odometry:
    name = f"Robot{robot}_Odometry.dat"
    rows = _parse(files, name, (q.STAMP_S, q.FORWARD_MPS, q.ANGULAR_RADPS), warnings)
    if len(rows) == 0:
        raise DataError("contains no odometry", path=rows.path)
    rows = _forward_in_time(rows, warnings)
    return Odometry(
        stamp_s=rows.column(0),
        forward_mps=rows.column(1),
        lateral_mps=np.zeros(len(rows)),
        angular_radps=rows.column(2),
        clock=Clock.UNIX,
    )


def _read_measurements(
    files: FileSet, robot: int, warnings: list[str]
) -> tuple[Frames, Detections, RobotSightings | None]:
    name = f"Robot{robot}_Measurement.dat"
    # the file's second column is headed 'Subject #' but holds barcodes
    rows = _parse(files, name, (q.STAMP_S, _BARCODE, q.RANGE_M, q.BEARING_RAD), warnings)
    if len(rows) == 0:
        raise DataError("contains no measurement", path=rows.path)
    rows = _sort_rows(rows, warnings)
    subject = _subjects(files, _whole(rows, 1, "barcode"), name, warnings)
    stamps, frame = np.unique(rows.column(0), return_inverse=True)
    landmark = np.flatnonzero(subject > LAST_ROBOT_SUBJECT)
    other = np.flatnonzero((subject > 0) & (subject <= LAST_ROBOT_SUBJECT))
    detections = Detections(
        frame=np.asarray(frame[landmark], dtype=np.int64),
        landmark_id=subject[landmark],
        range_m=rows.column(2)[landmark],
        bearing_rad=wrap_far(rows.column(3))[landmark],
        class_id=np.full(len(landmark), UNKNOWN),
        sigma_range_m=np.full(len(landmark), np.nan),
        sigma_bearing_rad=np.full(len(landmark), np.nan),
        source_line=rows.line[landmark],
    )
    sightings = RobotSightings(
        stamp_s=rows.column(0)[other],
        robot_id=subject[other],
        range_m=rows.column(2)[other],
        bearing_rad=wrap_far(rows.column(3))[other],
        clock=Clock.UNIX,
    )
    if not len(landmark):
        raise DataError("no landmark was seen in the whole recording", path=rows.path)
    return Frames(stamps, complete=False, clock=Clock.UNIX), detections, sightings if len(other) else None


def _subjects(files: FileSet, barcode: IntArray, name: str, warnings: list[str]) -> IntArray:
    """Subject of every barcode, 0 where `Barcodes.dat` does not list it. Shape (M,)."""
    rows = _parse(files, "Barcodes.dat", (_SUBJECT, _BARCODE), warnings)
    listed_subject, listed_barcode = _whole(rows, 0, "subject"), _whole(rows, 1, "barcode")
    _refuse_repeats(rows, listed_subject, "subject")
    _refuse_repeats(rows, listed_barcode, "barcode")
    subject_of = dict(zip(listed_barcode.tolist(), listed_subject.tolist(), strict=True))
    subject = np.array([subject_of.get(code, 0) for code in barcode.tolist()], dtype=np.int64)
    unknown = Counter(barcode[subject == 0].tolist())
    if unknown:
        codes = ", ".join(f"{code} ({count}x)" for code, count in sorted(unknown.items()))
        sightings = counted(sum(unknown.values()), "sighting")
        warnings.append(f"{name}: {sightings} of barcodes not in Barcodes.dat left out: {codes}")
    return subject


def _read_truth(files: FileSet, robot: int, warnings: list[str]) -> Trajectory | None:
    name = f"Robot{robot}_Groundtruth.dat"
    if name not in files:
        return None
    rows = _parse(files, name, (q.STAMP_S, q.X_M, q.Y_M, q.THETA_RAD), warnings)
    if len(rows) == 0:
        warnings.append(f"{name}: contains no pose, treated as missing")
        return None
    rows = _forward_in_time(rows, warnings)
    pose = rows.values[:, 1:].copy()
    pose[:, 2] = wrap_far(pose[:, 2])
    return Trajectory(rows.column(0), pose, np.zeros((len(rows), 3, 3)), frame="truth", clock=Clock.UNIX)


def _read_landmarks(files: FileSet, warnings: list[str]) -> Landmarks | None:
    name = "Landmark_Groundtruth.dat"
    if name not in files:
        return None
    sigmas = tuple(q.Quantity(f"{axis}_std_m", 0.0, 1e6, hint="standard deviation in metres") for axis in "xy")
    rows = _parse(files, name, (_SUBJECT, q.X_M, q.Y_M, *sigmas), warnings)
    if len(rows) == 0:
        warnings.append(f"{name}: contains no landmark, treated as missing")
        return None
    ids = _whole(rows, 0, "subject")
    _refuse_repeats(rows, ids, "subject")
    surveyed = Landmarks.at(ids, rows.values[:, 1:3], sigma_m=rows.values[:, 3:5], frame="truth")
    return replace(surveyed, clock=Clock.UNIX)


def _parse(files: FileSet, name: str, quantities: tuple[q.Quantity, ...], warnings: list[str]) -> Rows:
    return parse_rows(files.read(name), files.path_of(name), quantities, warnings)


def _forward_in_time(rows: Rows, warnings: list[str]) -> Rows:
    rows = _sort_rows(rows, warnings)
    return rows[last_of_equal(rows.column(0), path=rows.path, warnings=warnings)]


def _sort_rows(rows: Rows, warnings: list[str]) -> Rows:
    """The rows by time, where only a few are out of order: the first odometry row of data set 9 is, as published.

    Raises:
        InputError: so many are that the clock was set back, or the file is another one.
    """
    stamp_s = rows.column(0)
    if np.all(np.diff(stamp_s) >= 0.0):
        return rows
    stray = len(rows) - longest_forward(stamp_s)
    if stray > max(1, MOST_STRAY * len(rows)):
        check_forward(stamp_s, path=rows.path, line=rows.line)
    row = int(np.argmax(np.diff(stamp_s) < 0.0)) + 1
    where = f"time runs backwards at line {rows.line[row]}"
    warnings.append(f"{rows.path.name}: {counted(stray, 'row')} out of order sorted ({where})")
    return rows[np.argsort(stamp_s, kind="stable")]


def _refuse_repeats(rows: Rows, numbers: IntArray, field: str) -> None:
    again = repeats(numbers)
    if len(again):
        row = int(again[0])
        raise rows.error(f"{numbers[row]} is listed twice", row=row, field=field)


def _whole(rows: Rows, column: int, field: str) -> IntArray:
    values = rows.column(column)
    fractions = np.flatnonzero(values != np.floor(values))
    if len(fractions):
        row = int(fractions[0])
        raise rows.error(f"{values[row]:g} is not a whole number", row=row, field=field)
    return np.asarray(values, dtype=np.int64)
