"""The tables of a native recording in space, as `docs/recordings-in-space.md` lays down; `native` reads the files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from evermap import valid as q
from evermap.errors import DataError
from evermap.geometry.camera import unproject
from evermap.io.assemble import finish_recording, forward_stamps, frames_of, last_of_equal
from evermap.io.bad_rows import flaw_of
from evermap.io.files import FileSet
from evermap.io.landmarks import class_ids, distinct_labels, feature_columns, features_of, survey_of
from evermap.io.measurements import read_measurements
from evermap.io.rig_toml import CAMERA_FILE, Rig
from evermap.io.spatial import (
    AT,
    BOX,
    COVARIANCE,
    QUATERNION,
    boxes,
    covariances,
    directions,
    integrated,
    pose_odometry,
    poses,
    positions,
    quaternions,
    sensor_rows,
    spatial_detections,
    true_poses,
    turn_flaws,
    unit,
    with_tag_poses,
    without_zero_turns,
)
from evermap.io.table import Table
from evermap.io.text import counted
from evermap.types import (
    BoolArray,
    Clock,
    FloatArray,
    Frames,
    IntArray,
    Odometry,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    Trajectory,
)
from evermap.valid import Quantity

TWIST = tuple(quantity.name for quantity in q.TWIST)
VARIANCES = ("var_x_m2", "var_y_m2", "var_z_m2", "var_rx_rad2", "var_ry_rad2", "var_rz_rad2")
CORNERS = tuple(f"{axis}{corner}_px" for corner in range(4) for axis in "uv")
"""Corners of a tag counter-clockwise from its lower left, as AprilTag detectors list them."""
POINT = ("u_px", "v_px")
RIGHT = ("u_right_px", "v_right_px")
IMAGE_BOX = ("left_px", "top_px", "right_px", "bottom_px")
"""A box in the image, as object detectors give it in addition to a box in space; not used."""
_WHERE = ("sensor", "camera")

_IN_SPACE = {
    "odometry": ("z_m", *QUATERNION, *TWIST),
    "detections": ("z_m", *QUATERNION, *CORNERS, *POINT),
    "truth": ("z_m", *QUATERNION),
}
_SIGMA_RAD = Quantity("sigma_rad", positive=True, optional=True, hint="radians")
_SIGMA_M = Quantity("sigma_m", high=1e6, positive=True, optional=True, hint="metres")


def _pixel(name: str, *, optional: bool) -> Quantity:
    return Quantity(name, -1e6, 1e6, optional=optional, hint="pixels")


def in_space(tables: Mapping[str, Table | None], files: FileSet) -> bool:
    """Return whether tables are those of a recording in space: their columns decide, else a `camera.toml`."""
    columns = ((tables[name], names) for name, names in _IN_SPACE.items())
    seen = tables["detections"]
    planar = seen is not None and seen.has_any(("range_m", "bearing_rad"))
    return (CAMERA_FILE in files and not planar) or any(
        table is not None and table.has_any(names) for table, names in columns
    )


def spatial_recording(
    tables: Mapping[str, Table | None],
    rig: Rig,
    driven: Odometry | None,
    *,
    title: str,
    source: str,
    warnings: list[str],
) -> SpatialRecording:
    """Return the recording that native tables hold; `driven` is odometry in the plane, where that is what there is.

    Raises:
        InputError: a value is malformed, with its line; or stamps contradict each other.
        DataError: nothing to estimate from.
    """
    table, landmarks, settings = tables["detections"], tables["landmarks"], rig.settings
    assert table is not None
    names: dict[int, str] = {}
    class_names = settings.class_names
    if class_names is None:
        class_names = distinct_labels(table, landmarks)
    table = _screen_rows(_by_sensor(table), warnings)
    frames, frame = _frames(table, tables["frames"], rig, warnings)
    detections = _detections(table, frame, rig, class_names, names, warnings)
    if landmarks is not None and len(landmarks):
        landmarks.expect(AT, tuple(landmarks.columns))
    surveyed = survey_of(landmarks, class_names=class_names, clock=settings.clock, names=names)
    recording = Recording(
        name=settings.name or title,
        odometry=_odometry(tables["odometry"], settings.clock, warnings) if driven is None else _in_space(driven),
        frames=frames,
        detections=detections,
        sensors=rig.sensors,
        truth=truth_of(tables["truth"], (*AT, *QUATERNION), poses, settings.clock, warnings),
        true_landmarks=surveyed,
        class_names=class_names,
        source=source,
        clock=settings.clock,
        robot=settings.robot,
        landmark_names=names,
        symmetries=rig.symmetries,
        measurements=read_measurements(tables, names, warnings),
    )
    unknown = [name for name in rig.symmetries if name not in class_names]
    if unknown:
        warnings.append(f"symmetries of unused classes: {', '.join(unknown)}")
    return finish_recording(recording, warnings=warnings)


def _frames(table: Table, frame_table: Table | None, rig: Rig, warnings: list[str]) -> tuple[Frames, IntArray]:
    if frame_table is not None:
        frame_table.expect(("stamp_s",), _WHERE)
        frame_table = frame_table.screened((q.STAMP_S,), warnings)
    complete, several = rig.settings.frames_complete, len(rig.sensors) > 1
    return frames_of(
        table, frame_table, complete=complete, clock=rig.settings.clock, warnings=warnings, several=several
    )


def _odometry(table: Table | None, clock: Clock, warnings: list[str]) -> SpatialOdometry | None:
    if table is None:
        return None
    given = table.one_form((*AT, *QUATERNION), TWIST)
    if given is TWIST:
        table.expect(("stamp_s",), TWIST)
    else:
        table.expect(("stamp_s", *given), VARIANCES)
    if len(table) == 0:
        raise DataError("contains no odometry", path=table.path)
    if given is not TWIST:
        return pose_odometry(table, VARIANCES, clock, warnings)
    table = table.screened((q.STAMP_S, *q.TWIST), warnings)
    stamp_s = forward_stamps(table)
    keep = last_of_equal(stamp_s, path=table.path, warnings=warnings)
    twist = np.stack([table.filled(axis, 0.0) for axis in q.TWIST], axis=1)
    return integrated(stamp_s[keep], twist[keep], clock)


def _in_space(odometry: Odometry) -> SpatialOdometry:
    """The odometry of a robot on a floor, as poses in space."""
    twist = np.zeros((len(odometry), 6))
    twist[:, 0], twist[:, 1], twist[:, 5] = odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps
    return replace(integrated(odometry.stamp_s, twist, odometry.clock), z_up=True)


def truth_of(
    table: Table | None,
    columns: tuple[str, ...],
    poses: Callable[[Table], FloatArray],
    clock: Clock,
    warnings: list[str],
) -> Trajectory | None:
    """Return the truth in a table with certain columns, of which a function makes poses; None without any row."""
    if table is None:
        return None
    table.expect(("stamp_s", *columns))
    if len(table) == 0:
        warnings.append(f"{table.path.name}: contains no pose, treated as missing")
        return None
    return true_poses(table, clock, warnings, poses)


def _screen_rows(table: Table, warnings: list[str]) -> Table:
    """The detections without bad rows, and without orientations of four zeros."""
    cornered = table.has_any(CORNERS)
    axes = [replace(axis, optional=cornered) for axis in (q.X_M, q.Y_M, q.Z_M)]
    pixels = [_pixel(name, optional=True) for name in CORNERS] + [
        _pixel(name, optional=False) for name in (*POINT, *RIGHT)
    ]
    turns = [replace(one, optional=True) for one in q.QUATERNION]
    table = table.screened((q.STAMP_S, *axes, *pixels, *turns, _SIGMA_RAD, _SIGMA_M), warnings)
    table = without_zero_turns(table, warnings)
    flaws = turn_flaws(table, optional=True)
    if all(axis in table for axis in AT):
        far = np.linalg.norm(positions(table, optional=cornered), axis=1)
        possible = replace(q.RANGE_M, name="x_m, y_m, z_m", high=np.inf, optional=cornered)
        flaws.append(flaw_of(possible, far, table.path, table.line))
    return table.screened((), warnings, flaws)


def _by_sensor(table: Table) -> Table:
    """The table with the column that names the sensor under one name."""
    if all(name in table for name in _WHERE):
        raise table.error("sensor and camera are both given", row=None, field="camera", hint="keep one of them")
    columns = {"sensor" if name == "camera" else name: cells for name, cells in table.columns.items()}
    return replace(table, columns=columns)


def _detections(
    table: Table,
    frame: IntArray,
    rig: Rig,
    class_names: tuple[str, ...],
    names: dict[int, str],
    warnings: list[str],
) -> SpatialDetections:
    form = _form(table)
    optional = (
        "landmark_id", "sensor", "class_id", "score", "sigma_rad", "sigma_m", *COVARIANCE, *BOX, *IMAGE_BOX,
        *feature_columns(table),
    )  # fmt: skip
    table.expect(("stamp_s", *form), (*optional, *_also(form)))
    columns: dict[str, Any] = {
        "sensor": _sensor_rows(table, rig),
        "class_id": class_ids(table, class_names),
        "landmark_id": table.ids("landmark_id", optional=True, names=names),
        "source_line": np.asarray(table.line, dtype=np.int64),
    }
    for quantity in (Quantity("score", optional=True), _SIGMA_RAD):
        columns[quantity.name] = table.filled(quantity, np.nan)
    if table.has_any(BOX):
        columns["size_m"] = boxes(table)
    if form is POINT:
        columns |= _points(table, columns["sensor"], rig)
    else:
        columns |= _read_places(table)
    detections = spatial_detections(frame, **columns, **features_of(table))
    if table.has_any(CORNERS):
        detections = _add_corners(table, detections, rig)
    detections = with_tag_poses(detections, rig.sensors, warnings)
    behind = np.asarray(np.isnan(detections.position_sensor_m).any(axis=1))
    if behind.any():
        seen = counted(int(behind.sum()), "detection")
        warnings.append(f"{table.path.name}: {seen} left out: no disparity, or no depth ahead of the camera")
        detections = detections[~behind]
    return detections


def _form(table: Table) -> tuple[str, ...]:
    """The columns that say where a detection is, of the three ways to say it."""
    forms = [form for form in (AT, CORNERS, POINT) if table.has_any(form)]
    if not forms:
        raise table.error("contains no position of a landmark", row=None, hint="x_m, y_m, z_m in the sensor's frame")
    if POINT in forms and len(forms) > 1:
        raise table.error(f"mixes u_px, v_px with {forms[0][0]}", row=None, hint="keep one form")
    return forms[0]


def _also(form: tuple[str, ...]) -> tuple[str, ...]:
    """Further columns that may stand beside a form."""
    return RIGHT if form is POINT else (*QUATERNION, "yaw_rad", *CORNERS, "tag_size_m")


def _sensor_rows(table: Table, rig: Rig) -> IntArray:
    if "sensor" in table:
        return sensor_rows(table, "sensor", rig.sensors, CAMERA_FILE)
    if len(rig.sensors) > 1:
        hint = "one of " + ", ".join(sensor.name for sensor in rig.sensors)
        raise table.error("does not name its sensor", row=None, field="sensor", hint=hint)
    return np.zeros(len(table), dtype=np.int64)


def _read_places(table: Table) -> dict[str, FloatArray]:
    """Position, orientation and covariance where the table gives them."""
    found: dict[str, FloatArray] = {}
    if table.has_any(AT):
        may_miss = table.has_any(CORNERS)
        position = positions(table, optional=may_miss)
        far = replace(q.RANGE_M, name="x_m, y_m, z_m", high=np.inf, optional=may_miss)
        far.check(np.linalg.norm(position, axis=1), path=table.path, line=table.line)
        found["position_sensor_m"] = position
    if table.has_any(QUATERNION) and "yaw_rad" in table:
        raise table.error("mixes qx, qy, qz, qw with yaw_rad", row=None, field="yaw_rad", hint="keep one form")
    if table.has_any(QUATERNION):
        found["rotation"] = quaternions(table, optional=True)
    elif "yaw_rad" in table:
        half = table.numbers(Quantity("yaw_rad", -1e6, 1e6, optional=True, hint="radians")) / 2.0
        rotation = np.zeros((len(half), 4))
        rotation[:, 2], rotation[:, 3] = np.sin(half), np.cos(half)
        rotation[np.isnan(half)] = np.nan
        found["rotation"] = unit(rotation)
    covariance = covariances(table, COVARIANCE, optional=True)
    if covariance is not None and "sigma_m" in table:
        raise table.error("both sigma_m and cov_* columns are given", row=None, field="sigma_m", hint="keep one")
    if "sigma_m" in table:
        sigma = table.numbers(_SIGMA_M)
        covariance = sigma[:, None, None] ** 2 * np.eye(3)
        covariance[np.isnan(sigma)] = np.nan
    if covariance is not None:
        found["covariance_sensor_m2"] = covariance
    return found


def _add_corners(table: Table, detections: SpatialDetections, rig: Rig) -> SpatialDetections:
    """The detections with the corners of tags, and the tags' sizes."""
    table.expect(CORNERS, tuple(table.columns))
    corner = np.stack([table.numbers(_pixel(name, optional=True)) for name in CORNERS], axis=1)
    given = np.isfinite(corner)
    partly = np.flatnonzero(given.any(axis=1) & ~given.all(axis=1))
    if len(partly):
        raise table.error("a tag has four corners", row=int(partly[0]), field=CORNERS[0], hint="all eight, or none")
    camera = np.array([sensor.intrinsics is not None for sensor in rig.sensors])[detections.sensor]
    _need_camera(table, given[:, 0] & ~camera, CORNERS[0], rig)
    size = rig.size_of(detections.landmark_id)
    stated = table.filled(Quantity("tag_size_m", high=1e3, positive=True, optional=True, hint="metres"), np.nan)
    size = np.where(np.isnan(stated), size, stated)
    sizeless = np.flatnonzero(given[:, 0] & np.isnan(size) & np.isnan(detections.position_sensor_m).any(axis=1))
    if len(sizeless):
        hint = f"a column tag_size_m, or size_m under [tags] of {CAMERA_FILE}"
        raise table.error("the size of this tag is unknown", row=int(sizeless[0]), field="tag_size_m", hint=hint)
    nowhere = np.flatnonzero(~given[:, 0] & np.isnan(detections.position_sensor_m).any(axis=1))
    if len(nowhere):
        raise table.error("has neither corners nor a position", row=int(nowhere[0]), field=CORNERS[0])
    return replace(detections, corner_px=corner.reshape(-1, 4, 2), tag_size_m=size)


def _points(table: Table, sensor: IntArray, rig: Rig) -> dict[str, FloatArray]:
    """Positions (M, 3) and covariances of points that a camera saw; nan where the point is not ahead.

    In a stereo pair the depth follows from the disparity of the undistorted pixels, its covariance from a pixel's to
    first order. Of one camera it is the direction, at a range of 1 m of which nothing is known.
    """
    camera = np.array([one.intrinsics is not None for one in rig.sensors])[sensor]
    baseline = np.array(rig.baseline_m)[sensor]
    _need_camera(table, ~camera, POINT[0], rig)
    left = np.stack([table.numbers(_pixel(name, optional=False)) for name in POINT], axis=1)
    if RIGHT[0] not in table:
        position, covariance = directions(left, sensor, rig.sensors)
        return {"position_sensor_m": position, "covariance_sensor_m2": covariance}
    lone = np.flatnonzero(np.isnan(baseline))
    if len(lone):
        hint = f"baseline_m of the left camera in {CAMERA_FILE}"
        raise table.error("the baseline is unknown", row=int(lone[0]), field=RIGHT[0], hint=hint)
    right = left.copy()
    for axis, name in enumerate(RIGHT):
        if name in table:
            right[:, axis] = table.numbers(_pixel(name, optional=False))
    position, covariance = np.full((len(table), 3), np.nan), np.full((len(table), 3, 3), np.nan)
    for number, one in enumerate(rig.sensors):
        rows = np.flatnonzero(sensor == number)
        if len(rows) and one.intrinsics is not None:
            rays = unproject(np.stack([left[rows], right[rows]]), one)
            with np.errstate(divide="ignore", invalid="ignore"):
                plane = rays[..., :2] / rays[..., 2:]
            noise = (one.sigma_px or 1.0) / np.array(one.intrinsics[:2])
            position[rows], covariance[rows] = _triangulated(plane, baseline[rows], noise)
    return {"position_sensor_m": position, "covariance_sensor_m2": covariance}


def _triangulated(plane: FloatArray, baseline: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points from image coordinates (2, K, 2) left and right in units of the focal length, with noise (2,)."""
    (x, y), (x_right, _) = plane[0].T, plane[1].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(x - x_right > 1e-9, baseline / (x - x_right), np.nan)
    by_shift = -depth * depth / baseline
    slope = np.zeros((len(x), 3, 3))  # by x, y and x_right
    slope[:, 0, 0], slope[:, 0, 2] = depth + x * by_shift, -x * by_shift
    slope[:, 1, 0], slope[:, 1, 1], slope[:, 1, 2] = y * by_shift, depth, -y * by_shift
    slope[:, 2, 0], slope[:, 2, 2] = by_shift, -by_shift
    scaled = slope * noise[[0, 1, 0]]
    position = np.stack([x * depth, y * depth, depth], axis=1)
    return position, scaled @ np.swapaxes(scaled, 1, 2)


def _need_camera(table: Table, lacking: BoolArray, column: str, rig: Rig) -> None:
    rows = np.flatnonzero(lacking)
    if len(rows):
        names = ", ".join(sensor.name for sensor in rig.sensors if sensor.intrinsics is None)
        hint = f"intrinsics = [fx, fy, cx, cy] under [camera.NAME] of {CAMERA_FILE}"
        raise table.error(f"pixels of a sensor without intrinsics ({names})", row=int(rows[0]), field=column, hint=hint)
