"""The native recording: a folder of CSV or Parquet tables and a `sensor.toml`, as `docs/native-format.md` lays down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap import valid as q
from evermap.errors import DataError, InputError, similar, suggestion
from evermap.geometry import se2
from evermap.io.arrow import parquet_of
from evermap.io.assemble import finish_recording, forward_stamps, frames_of, last_of_equal, wrap_far
from evermap.io.bad_rows import Flaw, flaw_of
from evermap.io.columns import DataFrame, arrow_table
from evermap.io.files import FileSet, Reader, find_file_set
from evermap.io.landmarks import class_ids, distinct_labels, feature_columns, features_of, survey_of
from evermap.io.measurements import measurement_names, read_measurements
from evermap.io.native_space import in_space, spatial_recording, truth_of
from evermap.io.rig_toml import CAMERA_FILE, SENSOR_FILE, read_rig
from evermap.io.sensor_toml import Settings, parse_sensor_toml, toml_text
from evermap.io.table import ENDINGS, Table, parse_table
from evermap.io.tagslam import is_tagslam
from evermap.types import (
    Clock,
    Detections,
    FloatArray,
    Frames,
    IntArray,
    Odometry,
    Recording,
    RobotSightings,
    SpatialRecording,
)

TABLES = ("odometry", "detections", "frames", "truth", "landmarks", "robot_sightings", "objects")

_VELOCITIES = ("forward_mps", "angular_radps")
_INCREMENTS = ("dx_m", "dy_m", "dtheta_rad")


def read_native(path: str | Path, robot: int | None = None) -> Recording | SpatialRecording:
    """Return a recording in the plain native format.

    Args:
        path: folder, or zip of a folder, with `odometry` and `detections` as `.csv`, `.csv.gz` or `.parquet`, and
            optionally `frames`, `truth`, `landmarks`, `robot_sightings`, `objects`, `sensor.toml` and `camera.toml`.
        robot: must be None; a native recording is of one robot.

    Returns:
        Odometry as body velocities: increments become the constant twist that makes them (SE(2) logarithm). Frames from
        `frames`, else one for every distinct detection stamp with `complete=False`. A `SpatialRecording` where the
        columns are those of space; its odometry may be missing.

    Raises:
        InputError: a file or value is malformed, with its line; or stamps contradict each other.
        DataError: nothing to estimate from, for example no landmark was ever seen.
    """
    files = find_file_set(path, _is_native)
    if files is None:
        raise InputError("no native recording here", path=path, hint=NATIVE.looks_for)
    if robot is not None:
        problem = f"there is no robot {robot}: a native recording has one robot"
        raise InputError(problem, path=path, hint="omit the robot")
    return _recording_of(files, str(path))


def read_tables(
    tables: Mapping[str, DataFrame | Mapping[str, Any]], *, source: str | Path = ""
) -> Recording | SpatialRecording:
    """Return a recording from data frames: what `read_native` reads from a folder, by the names of its files.

    Args:
        tables: `odometry`, `detections`, and optionally the other tables, each a data frame with the columns of the
            file; `sensor` and `camera` are the sections of `sensor.toml` and `camera.toml`, as dictionaries.
        source: file that they were made of, for messages; '' for none.

    Raises:
        InputError, DataError: as of `read_native`; a name that no file has, or something else than a data frame.
    """
    memory, contents = Path(source or "tables"), dict[str, bytes]()
    settings = {Path(file).stem: file for file in (SENSOR_FILE, CAMERA_FILE)}
    known = (*TABLES, *measurement_names(), *settings)
    for name, table in tables.items():
        if name not in known:
            raise InputError(
                "is no table of a recording", path=memory, field=str(name)[:40], hint=suggestion(name, known)
            )
        if name in settings:
            if not isinstance(table, Mapping):
                raise InputError("is no dictionary", path=memory, field=name, hint=f"the sections of {settings[name]}")
            contents[settings[name]] = toml_text({key: dict(part) for key, part in table.items()}).encode()
        elif isinstance(table, DataFrame):
            contents[f"{name}.parquet"] = parquet_of(arrow_table(table))
        else:
            raise InputError("is no data frame", path=memory, field=name, hint="a table of pandas, polars or pyarrow")
    return _recording_of(
        FileSet(memory, "", {name: name for name in contents}, zipped=False, contents=contents), str(source)
    )


def _recording_of(files: FileSet, source: str) -> Recording | SpatialRecording:
    """Return what the files of a native recording hold."""
    warnings: list[str] = []
    _warn_of_similar_names(files, warnings)
    tables = {name: _read_table(files, name, warnings) for name in (*TABLES, *measurement_names())}
    seen = _find_needed("detections", tables, files)
    if in_space(tables, files):
        rig = read_rig(files, warnings)
        rig = replace(rig, settings=_on_clock(rig.settings, tables, files))
        planar, table = None, tables["odometry"]
        if table is not None and table.has_any((*_VELOCITIES, *_INCREMENTS)):
            planar, tables = _odometry(table, rig.settings.clock, warnings), {**tables, "odometry": None}
        found = spatial_recording(tables, rig, planar, title=files.title, source=source, warnings=warnings)
        return replace(found, objects=_objects(tables["objects"], dict(found.landmark_names)))
    settings = _on_clock(_read_settings(files, warnings), tables, files)
    clock, driven = settings.clock, _find_needed("odometry", tables, files)
    names: dict[int, str] = {}
    class_names = settings.class_names
    if class_names is None:
        class_names = distinct_labels(seen, tables["landmarks"])
    odometry = _odometry(driven, clock, warnings, settings.is_measured)
    frames, detections = _frames_and_detections(seen, tables["frames"], class_names, settings, warnings, names)
    recording = Recording(
        name=settings.name or files.title,
        odometry=odometry,
        frames=frames,
        detections=detections,
        sensor=settings.sensor,
        truth=truth_of(tables["truth"], ("x_m", "y_m", "theta_rad"), _poses, clock, warnings),
        true_landmarks=survey_of(tables["landmarks"], class_names=class_names, clock=clock, names=names),
        robot_sightings=_robot_sightings(tables["robot_sightings"], clock, warnings),
        objects=_objects(tables["objects"], names),
        class_names=class_names,
        source=source,
        clock=clock,
        robot=settings.robot,
        landmark_names=names,
        measurements=read_measurements(tables, names, warnings),
    )
    return finish_recording(recording, warnings=warnings)


def _find_needed(name: str, tables: Mapping[str, Table | None], files: FileSet) -> Table:
    """Return a table that a recording cannot do without."""
    table = tables[name]
    if table is None:
        hint = f"{name}.csv or .parquet"
        if name == "detections" and tables["ranges"] is not None:
            hint = "ranges are detections where nothing else is seen: its rows there, and kind = 'uwb' in sensor.toml"
        raise InputError("file is missing", path=files.path_of(f"{name}.csv"), hint=hint)
    return table


def _is_native(files: FileSet) -> bool:
    """Return whether a file set holds odometry or detections under their native names."""
    named = any(f"{name}{ending}" in files for name in ("odometry", "detections") for ending in ENDINGS)
    return named and not is_tagslam(files)


NATIVE = Reader("native", "odometry.csv and detections.csv (or .parquet)", _is_native, read_native)


def _read_settings(files: FileSet, warnings: list[str]) -> Settings:
    if SENSOR_FILE not in files:
        warnings.append(f"no {SENSOR_FILE}: the sensor is assumed to see in all directions, from the robot's centre")
        return Settings()
    return parse_sensor_toml(files.read(SENSOR_FILE), files.path_of(SENSOR_FILE))


def _read_table(files: FileSet, name: str, warnings: list[str]) -> Table | None:
    present = [f"{name}{ending}" for ending in ENDINGS if f"{name}{ending}" in files]
    if not present:
        return None
    if len(present) > 1:
        problem = f"exists together with {present[1]}"
        raise InputError(problem, path=files.path_of(present[0]), hint="remove one of them")
    file = present[0]
    return parse_table(files.read(file), files.path_of(file), warnings)


def _odometry(table: Table, clock: Clock, warnings: list[str], is_measured: bool | None = None) -> Odometry:
    """Return velocities; increments were measured, unless it is stated otherwise."""
    given = table.one_form(_VELOCITIES, _INCREMENTS)
    if given is _VELOCITIES:
        table.expect(("stamp_s", *_VELOCITIES), ("lateral_mps",))
    else:
        table.expect(("stamp_s", *_INCREMENTS))
    if len(table) == 0:
        raise DataError("contains no odometry", path=table.path)
    if given is _VELOCITIES:
        table = table.screened((q.STAMP_S, q.FORWARD_MPS, q.LATERAL_MPS, q.ANGULAR_RADPS), warnings)
    stamp_s = forward_stamps(table)
    if given is _VELOCITIES:
        keep = last_of_equal(stamp_s, path=table.path, warnings=warnings)
        return Odometry(
            stamp_s=stamp_s[keep],
            forward_mps=table.numbers(q.FORWARD_MPS)[keep],
            lateral_mps=table.filled(q.LATERAL_MPS, 0.0)[keep],
            angular_radps=table.numbers(q.ANGULAR_RADPS)[keep],
            clock=clock,
            is_measured=bool(is_measured),
        )
    increments = np.stack([table.numbers(quantity) for quantity in (q.DX_M, q.DY_M, q.DTHETA_RAD)], axis=1)
    driven = _from_increments(stamp_s, increments, table, clock, warnings)
    return replace(driven, is_measured=is_measured is not False)


def _from_increments(
    stamp_s: FloatArray, increments: FloatArray, table: Table, clock: Clock, warnings: list[str]
) -> Odometry:
    """Body velocities that hold from one stamp to the next and move by the increment given at the next."""
    if np.any(increments[0] != 0.0):
        warnings.append(f"{table.path.name}: the first increment is ignored, since its start is unknown")
    step = np.diff(stamp_s)
    twice = np.flatnonzero(step == 0.0)
    if len(twice):
        # unlike of a velocity, neither of two increments can be dropped without losing motion
        row, problem = int(twice[0]) + 1, "two increments with the same stamp"
        raise table.error(problem, row=row, field="stamp_s", hint="combine them into one row")
    if len(stamp_s) < 2:
        raise DataError("increments need at least two rows", path=table.path)
    twist = se2.log(increments[1:]) / step[:, None]
    # the last row only says where the last increment ends; the robot is taken to go on as before
    velocity = np.ascontiguousarray(np.vstack([twist, twist[-1:]]).T)
    return Odometry(stamp_s, velocity[0], velocity[1], velocity[2], clock=clock)


def _poses(table: Table) -> FloatArray:
    """Return the columns `x_m, y_m, theta_rad`. Shape (R, 3)."""
    heading = wrap_far(table.numbers(q.THETA_RAD))
    return np.stack([table.numbers(q.X_M), table.numbers(q.Y_M), heading], axis=1)


def _robot_sightings(table: Table | None, clock: Clock, warnings: list[str]) -> RobotSightings | None:
    if table is None or len(table) == 0:
        return None
    table.expect(("stamp_s", "robot_id", *_POLAR))
    table = table.screened((q.STAMP_S, q.RANGE_M, q.BEARING_RAD), warnings)
    range_m, bearing_rad = table.numbers(q.RANGE_M), wrap_far(table.numbers(q.BEARING_RAD))
    return RobotSightings(forward_stamps(table), table.ids("robot_id", optional=False), range_m, bearing_rad, clock)


def _on_clock(settings: Settings, tables: dict[str, Table | None], files: FileSet) -> Settings:
    """Return the settings with the clock of the dates in the tables; without any, as they are."""
    said = {table.clock(): table for table in tables.values() if table is not None and table.clock() is not None}
    if len(said) > 1:
        problem = "some tables have dates with a zone, others without"
        raise InputError(problem, path=files.root / files.folder, field="stamp_s", hint="a zone everywhere, or nowhere")
    for clock, table in said.items():
        assert clock is not None
        if settings.clock not in (Clock.RECORDING, clock):
            problem = f'dates on the clock {clock.value}, but {SENSOR_FILE} has clock = "{settings.clock.value}"'
            hint = "dates with a zone are unix, dates without one local_wall"
            raise table.error(problem, row=0, field="stamp_s", hint=hint)
        return replace(settings, clock=clock)
    return settings


def _objects(table: Table | None, names: dict[int, str]) -> IntArray:
    """(K, 2) landmarks and the objects that they are on, sorted by landmark."""
    if table is None:
        return np.zeros((0, 2), dtype=np.int64)
    table.expect(("landmark_id", "object_id"))
    landmark_id = table.ids("landmark_id", optional=False, names=names)
    pairs = np.column_stack([landmark_id, table.ids("object_id", optional=False, names={})])
    pairs = np.unique(pairs, axis=0)
    twice = np.flatnonzero(np.diff(pairs[:, 0]) == 0)
    if len(twice):
        name = int(pairs[twice[0], 0])
        row = int(np.flatnonzero(landmark_id == name)[-1])
        problem = f"landmark {names.get(name, name)} is on two objects"
        raise table.error(problem, row=row, field="object_id", hint="one object each")
    return pairs


def _warn_of_similar_names(files: FileSet, warnings: list[str]) -> None:
    """A misspelt optional file would be missed in silence."""
    known = [f"{name}{ending}" for name in (*TABLES, *measurement_names()) for ending in ENDINGS] + [
        SENSOR_FILE,
        CAMERA_FILE,
    ]
    for name in files.members:
        meant = similar(name, known, cutoff=0.85)
        if name not in known and meant:
            warnings.append(f"file {name} is not read; did you mean {meant}?")


_POLAR = ("range_m", "bearing_rad")
_CARTESIAN = ("x_m", "y_m")
_POLAR_SIGMAS = ("sigma_range_m", "sigma_bearing_rad")
_ROUND_SIGMAS = ("sigma_m", "sigma")


def _frames_and_detections(
    table: Table,
    frame_table: Table | None,
    class_names: tuple[str, ...],
    settings: Settings,
    warnings: list[str],
    names: dict[int, str],
) -> tuple[Frames, Detections]:
    """Return frames and the detections in them; `names` gets the texts behind landmark ids that are texts."""
    given = table.one_form(_POLAR, _CARTESIAN)
    optional = ("class_id", *_POLAR_SIGMAS, *_ROUND_SIGMAS, *feature_columns(table))
    required, more = (given, ()) if given is not _POLAR else (_POLAR[:1], _POLAR[1:])
    table.expect(("stamp_s", *required), ("landmark_id", *more, *optional))
    if frame_table is not None:
        frame_table.expect(("stamp_s",))
        frame_table = frame_table.screened((q.STAMP_S,), warnings)
    table = table.screened(_SEEN, warnings)
    if given is _CARTESIAN:
        table = table.screened((), warnings, [_at_the_sensor(table)])
    frames, frame = frames_of(
        table, frame_table, complete=settings.frames_complete, clock=settings.clock, warnings=warnings
    )
    range_m, bearing_rad = _polar(table) if given is _POLAR else _polar_of_cartesian(table)
    sigma_range_m, sigma_bearing_rad = _sigmas(table, range_m)
    detections = Detections(
        frame=frame,
        landmark_id=table.ids("landmark_id", optional=True, names=names),
        range_m=range_m,
        bearing_rad=bearing_rad,
        class_id=class_ids(table, class_names),
        sigma_range_m=sigma_range_m,
        sigma_bearing_rad=sigma_bearing_rad,
        source_line=np.asarray(table.line, dtype=np.int64),
        **features_of(table),
    )
    return frames, detections


def _polar(table: Table) -> tuple[FloatArray, FloatArray]:
    """Range and bearing within half a turn, nan where a bearing is empty, or there is no such column. Shapes (R,)."""
    bearing_rad = table.filled(replace(q.BEARING_RAD, optional=True), np.nan)
    return table.numbers(q.RANGE_M), np.where(np.isnan(bearing_rad), np.nan, wrap_far(bearing_rad))


_SEEN = (
    q.STAMP_S, q.RANGE_M, replace(q.BEARING_RAD, optional=True), q.X_M, q.Y_M, q.SIGMA_RANGE_M, q.SIGMA_BEARING_RAD,
    *(replace(q.SIGMA_RANGE_M, name=name) for name in _ROUND_SIGMAS),
)  # fmt: skip


def _at_the_sensor(table: Table) -> Flaw:
    """Detections at the place of the sensor itself, in no direction."""
    far = np.hypot(table.numbers(q.X_M), table.numbers(q.Y_M))
    return flaw_of(replace(q.RANGE_M, name="x_m, y_m", high=np.inf), far, table.path, table.line)


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
    return table.filled(q.SIGMA_RANGE_M, np.nan), table.filled(q.SIGMA_BEARING_RAD, np.nan)
