"""Writes any recording in the native format: as it is, so that `read_native` gives back equal arrays, or condensed."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap.io.arrow import parquet_bytes
from evermap.io.files import stage_folder, write_atomic
from evermap.io.landmarks import labels_of, survey_columns
from evermap.io.measurements import measurement_columns, measurement_names
from evermap.io.native_space import CORNERS, VARIANCES
from evermap.io.rig_toml import SENSOR_FILE, rig_toml
from evermap.io.sensor_toml import Settings, sensor_toml
from evermap.io.spatial import AT, BOX, COVARIANCE, QUATERNION, upper_triangle
from evermap.io.table import csv_text
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    IntArray,
    Landmarks,
    Odometry,
    Recording,
    SpatialOdometry,
    SpatialRecording,
    Trajectory,
    identity_text,
    is_in_space,
    is_text_of,
)

LONGEST_S = 0.5
"""Longest odometry row of a condensed session, unless the odometry was silent for longer."""


def write_native(
    recording: Recording | SpatialRecording,
    folder: str | Path,
    format: Literal["csv", "parquet"] = "csv",  # noqa: A002 (the word that callers expect)
) -> Path:
    """Write a recording as a native folder, which must not exist or be empty, in 'csv' or 'parquet'; return the folder.

    Odometry is written as velocities, in space as poses; detections as range and bearing, in space as positions,
    orientations and corners. What is derived from files is not written: `source`, `warnings` and the line numbers of
    detections.

    Raises:
        ConfigError: `format` is neither 'csv' nor 'parquet'.
        InputError: the folder holds something, or cannot be written; nothing is changed then.
    """
    if format not in ("csv", "parquet"):
        raise ConfigError(f"unknown native format '{format}'", field="format", hint="csv or parquet")
    texts, tables = _contents(recording)
    with stage_folder(folder) as staging:
        for name, text in texts.items():
            (staging / name).write_text(text, encoding="utf-8")
        for name, columns in tables.items():
            if format == "csv":
                (staging / f"{name}.csv").write_text(csv_text(columns), encoding="utf-8", newline="\n")
            else:
                (staging / f"{name}.parquet").write_bytes(parquet_bytes(columns))
    return Path(folder)


def write_session(recording: Recording | SpatialRecording, file: str | Path) -> Path:
    """Write what a map needs of a recording (rows in the order of time) to a zip in the native format; return its path.

    Odometry is composed between frames, numbers but stamps are of single precision, and truth is left out: twelve
    minutes of a robot with odometry at 84 Hz take 81 kB instead of 370 kB. Motion from frame to frame stays as it was.

    Raises:
        InputError: it cannot be written; nothing is changed then.
    """
    fewer: dict[str, Any] = {"truth": None, "true_landmarks": None}
    if recording.odometry is not None:
        fewer["odometry"] = _compose_odometry(recording.odometry, recording.frames.stamp_s)
    texts, tables = _contents(replace(recording, **fewer))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(zipfile.ZipInfo(name), text)
        for name, columns in tables.items():
            # fixes are far from an origin: single precision would be decimetres
            some = columns if name in measurement_names() else _single(columns)
            archive.writestr(zipfile.ZipInfo(f"{name}.parquet"), parquet_bytes(some))
    return write_atomic(file, buffer.getvalue())


def _compose_odometry(odometry: Any, frame_s: FloatArray) -> Any:
    """Odometry with rows at the last of its stamps before each frame and the first after it, and at times between."""
    stamp_s = odometry.stamp_s
    if len(stamp_s) < 2:
        return odometry
    after = np.searchsorted(stamp_s, frame_s, side="right")
    kept = np.zeros(len(stamp_s), dtype=np.bool_)
    kept[[0, -1]] = kept[np.maximum(after - 1, 0)] = kept[np.minimum(after, len(stamp_s) - 1)] = True
    kept[1:] |= np.diff(np.floor((stamp_s - stamp_s[0]) / LONGEST_S)) > 0.0
    silent = np.diff(stamp_s) > LONGEST_S
    kept[:-1] |= silent
    kept[1:] |= silent
    rows = np.flatnonzero(kept)
    if isinstance(odometry, SpatialOdometry):
        return odometry[rows]
    twist = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    pose = np.zeros((len(stamp_s), 3))
    step = se2.exp(twist[:-1] * np.diff(stamp_s)[:, None])
    pose[1:, 2] = np.cumsum(step[:, 2])
    pose[1:, :2] = np.cumsum(se2.transform(pose[:-1] * [0.0, 0.0, 1.0], step[:, :2]), axis=0)
    driven = se2.log(se2.between(pose[rows[:-1]], pose[rows[1:]])) / np.diff(stamp_s[rows])[:, None]
    held = np.diff(rows, append=rows[-1] + 1) == 1  # a single row is kept as it is
    twist = np.where(held[:, None], twist[rows], np.vstack([driven, twist[-1]]))
    return replace(odometry[rows], forward_mps=twist[:, 0], lateral_mps=twist[:, 1], angular_radps=twist[:, 2])


def _single(columns: dict[str, Any]) -> dict[str, Any]:
    """Columns with their numbers, but for stamps, in single precision."""
    return {
        name: cells.astype(np.float32)
        if isinstance(cells, np.ndarray) and cells.dtype == np.float64 and name != "stamp_s"
        else cells
        for name, cells in columns.items()
    }


def _contents(recording: Recording | SpatialRecording) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    """Texts of its settings files, and columns of its tables."""
    settings = Settings(
        name=recording.name,
        robot=recording.robot,
        clock=recording.clock,
        frames_complete=recording.frames.complete,
        class_names=_class_names(recording),
        sensor=recording.sensor,
    )
    if not is_in_space(recording):
        settings = replace(settings, is_measured=recording.odometry.is_measured or None)
        return {SENSOR_FILE: sensor_toml(settings)}, native_tables(recording)
    known = {name: said for name, said in recording.symmetries.items() if name in _class_names(recording)}
    return rig_toml(recording.sensors, settings, known), native_tables(recording)


def native_tables(recording: Recording | SpatialRecording) -> dict[str, dict[str, Any]]:
    """Return columns of every table that the recording has something for: arrays, or lists of text.

    In space columns that hold nothing are left out.
    """
    detections, names, called = recording.detections, _class_names(recording), recording.landmark_names
    tables: dict[str, dict[str, Any]] = {}
    if recording.odometry is not None:
        tables["odometry"] = _odometry(recording.odometry)
    seen = _in_space(recording) if is_in_space(recording) else _in_plane(recording)
    tables["detections"] = {"stamp_s": recording.frames.stamp_s[detections.frame], **seen}
    if np.any(detections.class_id != UNKNOWN):
        tables["detections"]["class_id"] = labels_of(detections.class_id, names)
    if detections.features is not None:
        tables["detections"] |= dict(zip(detections.feature_names, detections.features.T, strict=True))
    if isinstance(detections, Detections):
        tables["detections"] |= _keep_known(_columns(detections, "sigma_range_m", "sigma_bearing_rad"))
    tables["frames"] = {"stamp_s": recording.frames.stamp_s}
    if recording.truth is not None:
        tables["truth"] = _pose_columns(recording.truth)
    if recording.true_landmarks is not None:
        tables["landmarks"] = _survey(recording.true_landmarks, called, names)
    if recording.robot_sightings is not None:
        tables["robot_sightings"] = _columns(recording.robot_sightings, "stamp_s", "robot_id", "range_m", "bearing_rad")
    if len(recording.objects):
        landmark_id = _label_ids(recording.objects[:, 0], called)
        tables["objects"] = {"landmark_id": landmark_id, "object_id": recording.objects[:, 1]}
    for table in recording.measurements:
        columns = measurement_columns(table)
        place = {"landmark_id": _label_ids(table.landmark_id, called)} if "landmark_id" in columns else {}
        tables[table.kind] = _keep_known({**columns, **place})
    return tables


def _pose_columns(path: Trajectory | SpatialOdometry) -> dict[str, FloatArray]:
    pose = path.pose_world_robot
    names = (*AT, *QUATERNION) if pose.shape[1] == 7 else ("x_m", "y_m", "theta_rad")
    return {"stamp_s": path.stamp_s, **dict(zip(names, pose.T, strict=True))}


def _columns(table: Any, *names: str) -> dict[str, FloatArray]:
    return {name: getattr(table, name) for name in names}


def _odometry(odometry: Odometry | SpatialOdometry) -> dict[str, FloatArray]:
    if isinstance(odometry, Odometry):
        return _columns(odometry, "stamp_s", "forward_mps", "lateral_mps", "angular_radps")
    return {**_pose_columns(odometry), **_keep_known(dict(zip(VARIANCES, odometry.variance.T, strict=True)))}


def _in_plane(recording: Recording) -> dict[str, Any]:
    detections = recording.detections
    landmark_id = _label_ids(detections.landmark_id, recording.landmark_names)
    return {"landmark_id": landmark_id, **_columns(detections, "range_m", "bearing_rad")}


def _in_space(recording: SpatialRecording) -> dict[str, Any]:
    detections = recording.detections
    sensors = [sensor.name for sensor in recording.sensors]
    details = {
        **dict(zip(QUATERNION, detections.rotation.T, strict=True)),
        **upper_triangle(detections.covariance_sensor_m2, COVARIANCE),
        "sigma_rad": detections.sigma_rad,
        **dict(zip(CORNERS, detections.corner_px.reshape(-1, 8).T, strict=True)),
        "tag_size_m": detections.tag_size_m,
        **dict(zip(BOX, detections.size_m.T, strict=True)),
        "score": detections.score,
    }
    return {
        "sensor": [sensors[row] for row in detections.sensor.tolist()],
        "landmark_id": _label_ids(detections.landmark_id, recording.landmark_names),
        **dict(zip(AT, detections.position_sensor_m.T, strict=True)),
        **_keep_known(details),
    }


def _keep_known(columns: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The columns in which anything is known."""
    return {name: column for name, column in columns.items() if not np.all(np.isnan(column))}


def _survey(landmarks: Landmarks, names: Mapping[int, str], class_names: tuple[str, ...]) -> dict[str, Any]:
    columns = survey_columns(landmarks)
    columns["landmark_id"] = _label_ids(landmarks.landmark_id, {**names, **landmarks.names})
    if np.any(landmarks.class_id != UNKNOWN):
        columns["class_id"] = labels_of(landmarks.class_id, landmarks.class_names or class_names)
    return columns


def _label_ids(landmark_id: IntArray, names: Mapping[int, str]) -> Any:
    """Return a column of ids: as numbers, or as text if any id is one; other names would be read as other ids."""
    if not any(is_text_of(names[one], one) for one in {*landmark_id.tolist()} & names.keys()):
        return landmark_id
    return ["" if number == UNKNOWN else identity_text(number, names) for number in landmark_id.tolist()]


def _class_names(recording: Recording | SpatialRecording) -> tuple[str, ...]:
    """The recording's classes, those without a name called by their number, and those only on true landmarks."""
    landmarks = recording.true_landmarks
    largest = int(recording.detections.class_id.max(initial=UNKNOWN))
    if landmarks is not None and not landmarks.class_names:
        largest = max(largest, int(landmarks.class_id.max(initial=UNKNOWN)))
    names = [*recording.class_names, *(str(number) for number in range(len(recording.class_names), largest + 1))]
    extra = [] if landmarks is None else [name for name in landmarks.class_names if name not in names]
    return (*names, *extra)
