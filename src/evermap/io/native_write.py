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
from evermap.io.files import staged_folder, write_atomic
from evermap.io.landmarks import labels_of, survey_columns
from evermap.io.native_space import CORNERS, VARIANCES
from evermap.io.rig_toml import SENSOR_FILE, rig_toml
from evermap.io.sensor_toml import Settings, sensor_toml
from evermap.io.spatial import AT, BOX, COVARIANCE, QUATERNION, upper_triangle
from evermap.io.table import csv_text, parquet_bytes
from evermap.types import (
    UNKNOWN,
    Detections,
    FloatArray,
    IntArray,
    Landmarks,
    Recording,
    Sensor,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    rows_of,
)

LONGEST_S = 0.5
"""Longest odometry row of a condensed session, unless the odometry was silent for longer."""


def write_native(
    recording: Recording | SpatialRecording,
    folder: str | Path,
    format: Literal["csv", "parquet"] = "csv",  # noqa: A002 (the word that callers expect)
) -> Path:
    """Write a recording as a native folder and returns the folder.

    Odometry is written as velocities, in space as poses; detections as range and bearing, in space as positions,
    orientations and corners. What is derived from files is not written: `source`, `warnings` and the line numbers of
    detections.

    Args:
        recording: what to write.
        folder: is created; must not exist, or be empty.
        format: 'csv' or 'parquet'.

    Raises:
        ConfigError: `format` is neither 'csv' nor 'parquet'.
        InputError: the folder holds something, or cannot be written; nothing is changed then.
    """
    if format not in ("csv", "parquet"):
        raise ConfigError(f"unknown native format '{format}'", field="format", hint="csv or parquet")
    texts, tables = _contents(recording)
    with staged_folder(folder) as staging:
        for name, text in texts.items():
            (staging / name).write_text(text, encoding="utf-8")
        for name, columns in tables.items():
            if format == "csv":
                (staging / f"{name}.csv").write_text(csv_text(columns), encoding="utf-8", newline="\n")
            else:
                (staging / f"{name}.parquet").write_bytes(parquet_bytes(columns))
    return Path(folder)


def write_session(recording: Recording | SpatialRecording, file: str | Path) -> Path:
    """Write what a map needs of a recording to a zip in the native format, and return its path.

    Odometry is composed between frames, numbers but stamps are of single precision, and truth is left out: twelve
    minutes of a robot with odometry at 84 Hz take 81 kB instead of 370 kB. Motion from frame to frame stays as it was.

    Args:
        recording: what to write, its rows in the order of time.
        file: a zip; an older one is replaced.

    Raises:
        InputError: it cannot be written; nothing is changed then.
    """
    fewer: dict[str, Any] = {"truth": None, "true_landmarks": None}
    if recording.odometry is not None:
        fewer["odometry"] = _composed(recording.odometry, recording.frames.stamp_s)
    texts, tables = _contents(replace(recording, **fewer))
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(zipfile.ZipInfo(name), text)
        for name, columns in tables.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.parquet"), parquet_bytes(_single(columns)))
    return write_atomic(file, buffer.getvalue())


def _composed(odometry: Any, frame_s: FloatArray) -> Any:
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
        return rows_of(odometry, rows)
    twist = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    pose = np.zeros((len(stamp_s), 3))
    step = se2.exp(twist[:-1] * np.diff(stamp_s)[:, None])
    pose[1:, 2] = np.cumsum(step[:, 2])
    pose[1:, :2] = np.cumsum(se2.transform(pose[:-1] * [0.0, 0.0, 1.0], step[:, :2]), axis=0)
    driven = se2.log(se2.between(pose[rows[:-1]], pose[rows[1:]])) / np.diff(stamp_s[rows])[:, None]
    held = np.diff(rows, append=rows[-1] + 1) == 1  # a single row is kept as it is
    twist = np.where(held[:, None], twist[rows], np.vstack([driven, twist[-1]]))
    return replace(rows_of(odometry, rows), forward_mps=twist[:, 0], lateral_mps=twist[:, 1], angular_radps=twist[:, 2])


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
    settings = _settings(recording)
    if isinstance(recording, Recording):
        return {SENSOR_FILE: sensor_toml(settings)}, native_tables(recording)
    known = {name: said for name, said in recording.symmetries.items() if name in _class_names(recording)}
    return rig_toml(recording.sensors, settings, known), spatial_tables(recording)


def native_tables(recording: Recording) -> dict[str, dict[str, Any]]:
    """Return columns of every table that the recording has something for: arrays, or lists of text."""
    odometry, detections, names = recording.odometry, recording.detections, _class_names(recording)
    tables: dict[str, dict[str, Any]] = {
        "odometry": {
            name: getattr(odometry, name) for name in ("stamp_s", "forward_mps", "lateral_mps", "angular_radps")
        },
        "detections": {
            "stamp_s": recording.frames.stamp_s[detections.frame],
            "landmark_id": _called(detections.landmark_id, recording.landmark_names),
            "range_m": detections.range_m,
            "bearing_rad": detections.bearing_rad,
        },
        "frames": {"stamp_s": recording.frames.stamp_s},
    }
    if np.any(detections.class_id != UNKNOWN):
        tables["detections"]["class_id"] = labels_of(detections.class_id, names)
    tables["detections"] |= _features(detections)
    for name in ("sigma_range_m", "sigma_bearing_rad"):
        sigma = getattr(detections, name)
        if not np.all(np.isnan(sigma)):
            tables["detections"][name] = sigma
    if recording.truth is not None:
        pose = zip(("x_m", "y_m", "theta_rad"), recording.truth.pose_world_robot.T, strict=True)
        tables["truth"] = {"stamp_s": recording.truth.stamp_s, **dict(pose)}
    if recording.true_landmarks is not None:
        tables["landmarks"] = _survey(recording.true_landmarks, recording.landmark_names, names)
    if recording.robot_sightings is not None:
        shown = ("stamp_s", "robot_id", "range_m", "bearing_rad")
        tables["robot_sightings"] = {name: getattr(recording.robot_sightings, name) for name in shown}
    if len(recording.objects):
        landmark_id = _called(recording.objects[:, 0], recording.landmark_names)
        tables["objects"] = {"landmark_id": landmark_id, "object_id": recording.objects[:, 1]}
    return tables


def spatial_tables(recording: SpatialRecording) -> dict[str, dict[str, Any]]:
    """Return columns as `native_tables`, of a recording in space; columns that hold nothing are left out."""
    odometry, detections, names = recording.odometry, recording.detections, _class_names(recording)
    tables: dict[str, dict[str, Any]] = {}
    if odometry is not None:
        variances = dict(zip(VARIANCES, odometry.variance.T, strict=True))
        tables["odometry"] = {"stamp_s": odometry.stamp_s, **_pose(odometry.pose_world_robot), **_given(variances)}
    sensors = [sensor.name for sensor in recording.sensors]
    corner = detections.corner_px.reshape(-1, 8)
    tables["detections"] = {
        "stamp_s": recording.frames.stamp_s[detections.frame],
        "sensor": [sensors[row] for row in detections.sensor.tolist()],
        "landmark_id": _called(detections.landmark_id, recording.landmark_names),
        **dict(zip(AT, detections.position_sensor_m.T, strict=True)),
        **_given(
            {
                **dict(zip(QUATERNION, detections.rotation.T, strict=True)),
                **upper_triangle(detections.covariance_sensor_m2, COVARIANCE),
                "sigma_rad": detections.sigma_rad,
                **dict(zip(CORNERS, corner.T, strict=True)),
                "tag_size_m": detections.tag_size_m,
                **dict(zip(BOX, detections.size_m.T, strict=True)),
                "score": detections.score,
            }
        ),
    }
    if np.any(detections.class_id != UNKNOWN):
        tables["detections"]["class_id"] = labels_of(detections.class_id, names)
    tables["detections"] |= _features(detections)
    tables["frames"] = {"stamp_s": recording.frames.stamp_s}
    if recording.truth is not None:
        tables["truth"] = {"stamp_s": recording.truth.stamp_s, **_pose(recording.truth.pose_world_robot)}
    if recording.true_landmarks is not None:
        tables["landmarks"] = _survey(recording.true_landmarks, recording.landmark_names, names)
    return tables


def _pose(pose: FloatArray) -> dict[str, FloatArray]:
    return dict(zip((*AT, *QUATERNION), pose.T, strict=True))


def _given(columns: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The columns in which anything is known."""
    return {name: column for name, column in columns.items() if not np.all(np.isnan(column))}


def _features(detections: Detections | SpatialDetections) -> dict[str, FloatArray]:
    return (
        {} if detections.features is None else dict(zip(detections.feature_names, detections.features.T, strict=True))
    )


def _survey(landmarks: Landmarks, names: Mapping[int, str], class_names: tuple[str, ...]) -> dict[str, Any]:
    columns = survey_columns(landmarks)
    columns["landmark_id"] = _called(landmarks.landmark_id, {**names, **landmarks.names})
    if np.any(landmarks.class_id != UNKNOWN):
        columns["class_id"] = labels_of(landmarks.class_id, landmarks.class_names or class_names)
    return columns


def _called(landmark_id: IntArray, names: Mapping[int, str]) -> Any:
    """Return a column of ids: as numbers, or as text if any id has a text."""
    if not names.keys() & set(landmark_id.tolist()):
        return landmark_id
    return ["" if number == UNKNOWN else names.get(number, str(number)) for number in landmark_id.tolist()]


def _settings(recording: Recording | SpatialRecording) -> Settings:
    return Settings(
        name=recording.name,
        robot=recording.robot,
        clock=recording.clock,
        frames_complete=recording.frames.complete,
        class_names=_class_names(recording),
        sensor=recording.sensor if isinstance(recording, Recording) else Sensor(),
    )


def _class_names(recording: Recording | SpatialRecording) -> tuple[str, ...]:
    """The recording's classes, those without a name called by their number, and those only on true landmarks."""
    landmarks = recording.true_landmarks
    largest = int(recording.detections.class_id.max(initial=UNKNOWN))
    if landmarks is not None and not landmarks.class_names:
        largest = max(largest, int(landmarks.class_id.max(initial=UNKNOWN)))
    names = [*recording.class_names, *(str(number) for number in range(len(recording.class_names), largest + 1))]
    extra = [] if landmarks is None else [name for name in landmarks.class_names if name not in names]
    return (*names, *extra)
