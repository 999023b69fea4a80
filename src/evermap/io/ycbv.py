"""Objects with poses around a camera carried by hand, as SLAM-Super-6D publishes YCB-Video (Lu et al., IROS 2022).

A folder holds TUM files, gzipped or not: `odometry`, `detections_NAME` (the object in the camera's frame; seven zeros
where it was not detected) of each object, and for evaluation `camera_truth` and `object_truth_NAME`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.assemble import SAME_STAMP_S, finish_recording
from evermap.io.files import FileSet, Reader, find_file_set
from evermap.io.spatial import spatial_detections
from evermap.io.text import Rows, counted
from evermap.io.tum import pose_rows, poses_in_order
from evermap.types import (
    FloatArray,
    Frames,
    IntArray,
    Landmarks,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    landmark_id_of,
)

_DETECTIONS = re.compile(r"detections_(.+?)\.tum(\.gz)?")


def read_ycbv(path: str | Path, robot: int | None = None) -> SpatialRecording:
    """Return the recording of a folder of TUM files, or a zip of it; `robot` must be None.

    Frames are at the stamps of the odometry; one class an object; the camera is the robot. True landmarks are the
    objects' typical poses over all frames that have both truths.

    Raises:
        InputError: a file is missing or malformed, with its line.
        DataError: no object was detected.
    """
    files = find_file_set(path, _is_ycbv)
    if files is None:
        raise InputError("no recording of objects here", path=path, hint=YCBV.looks_for)
    if robot is not None:
        raise InputError(f"there is no robot {robot}: the recording has one camera", path=path, hint="omit the robot")
    warnings: list[str] = []
    names = sorted(match[1] for name in files.members if (match := _DETECTIONS.fullmatch(name)))
    rows = pose_rows(*_file(files, "odometry"), warnings)
    stamp_s, pose = poses_in_order(rows, warnings)
    truth = _trajectory(files, "camera_truth", warnings)
    recording = Recording(
        name=f"YCB-Video {files.title}",
        odometry=SpatialOdometry(stamp_s, pose, np.full((len(pose), 6), np.nan)),
        frames=Frames(stamp_s.copy()),
        detections=_detections(files, names, stamp_s, warnings),
        sensors=(SpatialSensor(name="camera"),),
        truth=truth,
        true_landmarks=None if truth is None else _true_landmarks(files, names, truth, warnings),
        class_names=tuple(names),
        source=str(path),
        landmark_names={landmark_id_of(name): name for name in names},
    )
    return finish_recording(recording, warnings=warnings)


def _is_ycbv(files: FileSet) -> bool:
    return _name(files, "odometry") is not None and any(_DETECTIONS.fullmatch(name) for name in files.members)


YCBV = Reader("ycbv", "odometry.tum.gz and detections_OBJECT.tum.gz", _is_ycbv, read_ycbv)


def _name(files: FileSet, name: str) -> str | None:
    return next((file for file in (f"{name}.tum", f"{name}.tum.gz") if file in files), None)


def _file(files: FileSet, name: str) -> tuple[bytes, Path]:
    file = _name(files, name) or f"{name}.tum"
    return files.read(file), files.path_of(file)


def _trajectory(files: FileSet, name: str, warnings: list[str]) -> Trajectory | None:
    if _name(files, name) is None:
        return None
    stamp_s, pose = poses_in_order(pose_rows(*_file(files, name), warnings), warnings)
    return Trajectory(stamp_s, pose, np.zeros((len(pose), 6, 6)), frame="truth")


def _detections(files: FileSet, names: list[str], stamp_s: FloatArray, warnings: list[str]) -> SpatialDetections:
    frames, poses, kinds, lines = [], [], [], []
    for kind, name in enumerate(names):
        rows = _keep_seen(files, f"detections_{name}", warnings)
        somewhere = rows.values[:, 1:4].any(axis=1)
        if not somewhere.all():
            degenerate = counted(int(np.sum(~somewhere)), "detection")
            warnings.append(f"{rows.path.name}: {degenerate} at the camera's own place left out")
            rows = rows[np.flatnonzero(somewhere)]
        frames.append(_row_of(rows, stamp_s))
        poses.append(rows.values[:, 1:])
        kinds.append(np.full(len(rows), kind))
        lines.append(rows.line)
    frame, kind_of = np.concatenate(frames), np.concatenate(kinds)
    order = np.argsort(frame, kind="stable")
    pose = np.concatenate(poses)[order]
    ids = np.array([landmark_id_of(name) for name in names], dtype=np.int64)
    return spatial_detections(
        frame[order],
        landmark_id=ids[kind_of[order]],
        class_id=kind_of[order],
        position_sensor_m=pose[:, :3].copy(),
        rotation=pose[:, 3:].copy(),
        source_line=np.concatenate(lines)[order],
    )


def _keep_seen(files: FileSet, name: str, warnings: list[str]) -> Rows:
    """The rows of a file that are not seven zeros."""
    rows = pose_rows(*_file(files, name), warnings, zeros=True)
    return rows[np.flatnonzero(rows.values[:, 1:].any(axis=1))]


def _row_of(rows: Rows, stamp_s: FloatArray) -> IntArray:
    """Which of the odometry's stamps each row has. Shape (R,)."""
    padded = np.concatenate([stamp_s, [np.inf]])
    row = np.searchsorted(stamp_s, rows.column(0) - SAME_STAMP_S)
    lost = np.flatnonzero(np.abs(padded[row] - rows.column(0)) > SAME_STAMP_S)
    if len(lost):
        raise rows.error("is not a stamp of the odometry", row=int(lost[0]), field="stamp_s")
    return np.asarray(row, dtype=np.int64)


def _true_landmarks(files: FileSet, names: list[str], truth: Trajectory, warnings: list[str]) -> Landmarks | None:
    ids, found = [], []
    for name in names:
        if _name(files, f"object_truth_{name}") is None:
            continue
        rows = _keep_seen(files, f"object_truth_{name}", warnings)
        both = np.isin(rows.column(0).round(6), truth.stamp_s.round(6))
        at = np.searchsorted(truth.stamp_s, rows.column(0)[both] - SAME_STAMP_S)
        if len(at):
            ids.append(landmark_id_of(name))
            found.append(_typical(se3.compose(truth.pose_world_robot[at], rows.values[both, 1:])))
    if not found:
        return None
    pose = np.array(found)
    kinds = np.array([names.index(name) for name in names if landmark_id_of(name) in ids])
    named = {landmark_id_of(name): name for name in names}
    return Landmarks.in_space(
        ids, pose[:, :3], rotation=pose[:, 3:], class_id=kinds, class_names=tuple(names), names=named
    )


def _typical(pose: FloatArray) -> FloatArray:
    """The pose (7,) with the least sum of distances to poses (N, 7), in metres and in radians (Weiszfeld's steps)."""
    typical = pose[len(pose) // 2]
    for _ in range(50):
        twist = se3.local(typical, pose)
        distance = np.stack([np.linalg.norm(twist[:, :3], axis=1), np.linalg.norm(twist[:, 3:], axis=1)])
        weight = 1.0 / np.maximum(distance, 1e-6)
        weight /= weight.sum(axis=1, keepdims=True)
        step = np.concatenate([weight[0] @ twist[:, :3], weight[1] @ twist[:, 3:]])
        typical = se3.retract(typical, step)
        if np.abs(step).max() < 1e-7:
            break
    return np.asarray(typical)
