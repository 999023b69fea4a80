"""A run as ROS 2 messages in one MCAP file, which Foxglove opens directly, RViz plays, and `evermap slam` reads."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import MissingExtraError
from evermap.geometry import se2, se3
from evermap.io.landmarks import labels_of
from evermap.io.rosbag import ros2_types
from evermap.runs.summary import change_dict
from evermap.types import (
    UNKNOWN,
    AnyRecording,
    FloatArray,
    Landmarks,
    MapChange,
    Odometry,
    SlamResult,
    Trajectory,
    is_in_space,
    landmark_label,
)

TOPICS = {
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/odom": "nav_msgs/msg/Odometry",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/online_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/detections": "vision_msgs/msg/Detection3DArray",
    "/landmarks": "visualization_msgs/msg/MarkerArray",
    "/scene": "foxglove_msgs/msg/SceneUpdate",
    "/changes": "std_msgs/msg/String",
}
"""Topics of the file. Frames are `map`, `odom`, `base_link`, and those of the sensors by their names."""
POINT_M, PLATE_M = 0.1, 0.005
"""Edge of the marker of a landmark without a size, and the thickness of a tag."""
MARKER_ID = 2**31 - 1
"""Largest id of a marker: the last bits of a landmark's id."""
CUBE, SPHERE = 1, 2
"""Types of `visualization_msgs/Marker`."""


def write_mcap(recording: AnyRecording, result: SlamResult, path: Path) -> None:
    """Write `path` (.mcap): poses with covariance, odometry, frames, detections, the map with P(exists), changes.

    Poses of the smoothed trajectory are on `/pose` and in `/tf`, what the robot knew at the time on `/online_pose`. A
    landmark appears when it was first seen, as opaque as it probably exists. `/changes` has the lines of
    `changes.jsonl`; `/scene` draws them.

    Raises:
        MissingExtraError: `rosbags` is not installed.
    """
    from evermap.maps.sessions.admission import as_estimated

    recording = as_estimated(recording, result)
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
    except ImportError:
        problem = "MCAP needs the package rosbags, which is not installed"
        raise MissingExtraError(problem, hint="pip install 'evermap[ros]'") from None
    ros = Ros(ros2_types())
    with tempfile.TemporaryDirectory() as folder:
        with Writer(Path(folder) / "run", version=8, storage_plugin=StoragePlugin.MCAP) as bag:
            to = {name: bag.add_connection(name, kind, typestore=ros.types) for name, kind in TOPICS.items()}
            for stamp_s, topic, message in sorted(_messages(ros, recording, result), key=lambda one: one[0]):
                raw = ros.types.serialize_cdr(message, TOPICS[topic])
                bag.write(to[topic], nanoseconds(stamp_s), raw)
        shutil.move(next((Path(folder) / "run").glob("*.mcap")), path)


def nanoseconds(stamp_s: float) -> int:
    """Return a stamp in nanoseconds, from 0 on; seconds since 1970 keep all their bits."""
    whole = math.floor(stamp_s)
    return max(whole * 10**9 + round((stamp_s - whole) * 1e9), 0)


@cache
def _whole(name: str) -> str:
    """The name of a type as it is in a store."""
    return name.replace("/", "/msg/")


class Ros(NamedTuple):
    """Messages of ROS 2 by the names of their types, with what is in most of them."""

    types: Any

    def make(self, name: str, *values: Any) -> Any:
        return self.types.types[_whole(name)](*values)

    def time(self, stamp_s: float) -> Any:
        nano = nanoseconds(stamp_s)
        return self.make("builtin_interfaces/Time", nano // 10**9, nano % 10**9)

    def header(self, stamp_s: float, frame: str) -> Any:
        return self.make("std_msgs/Header", self.time(stamp_s), frame)

    def vector(self, values: FloatArray) -> Any:
        return self.make("geometry_msgs/Vector3", *values.tolist())

    def pose(self, pose: FloatArray) -> Any:
        values = pose.tolist()
        at, turn = self.make("geometry_msgs/Point", *values[:3]), self.make("geometry_msgs/Quaternion", *values[3:])
        return self.make("geometry_msgs/Pose", at, turn)

    def spread(self, pose: FloatArray, covariance: FloatArray) -> Any:
        return self.make("geometry_msgs/PoseWithCovariance", self.pose(pose), covariance.ravel())

    def posed(self, stamp_s: float, pose: FloatArray, covariance: FloatArray) -> Any:
        spread = self.spread(pose, covariance)
        return self.make("geometry_msgs/PoseWithCovarianceStamped", self.header(stamp_s, "map"), spread)

    def odometry(self, stamp_s: float, pose: FloatArray) -> Any:
        still = self.make("geometry_msgs/Twist", self.vector(np.zeros(3)), self.vector(np.zeros(3)))
        unsaid = self.make("geometry_msgs/TwistWithCovariance", still, np.zeros(36))
        here = self.spread(pose, np.zeros((6, 6)))
        return self.make("nav_msgs/Odometry", self.header(stamp_s, "odom"), "base_link", here, unsaid)

    def transforms(self, stamp_s: float, frames: list[tuple[str, str, FloatArray]]) -> Any:
        found = []
        for parent, child, pose in frames:
            turn = self.make("geometry_msgs/Quaternion", *map(float, pose[3:]))
            inner = self.make("geometry_msgs/Transform", self.vector(pose[:3]), turn)
            found.append(self.make("geometry_msgs/TransformStamped", self.header(stamp_s, parent), child, inner))
        return self.make("tf2_msgs/TFMessage", found)

    def colour(self, rgb: tuple[int, int, int], alpha: float, package: str) -> Any:
        red, green, blue = (part / 255.0 for part in rgb)
        name = "foxglove_msgs/Color" if package == "foxglove_msgs" else "std_msgs/ColorRGBA"
        return self.make(name, red, green, blue, alpha)


_Stamped = tuple[float, str, Any]


def _messages(ros: Ros, recording: AnyRecording, result: SlamResult) -> Iterator[_Stamped]:
    yield from _motion(ros, recording, result)
    yield from _detections(ros, recording)
    start_s = float(result.trajectory.stamp_s[0]) if len(result.trajectory) else 0.0
    for landmarks in (result.landmarks, result.gone):
        yield from _map(ros, landmarks, start_s)
    yield from _changes(ros, result, start_s)


def _motion(ros: Ros, recording: AnyRecording, result: SlamResult) -> Iterator[_Stamped]:
    path, alone = result.trajectory, in_space(result.dead_reckoning.pose_world_robot)
    poses = in_space(path.pose_world_robot)
    if len(path):
        mounts = [("base_link", name, pose) for name, pose in _mounts(recording)]
        yield float(path.stamp_s[0]), "/tf_static", ros.transforms(float(path.stamp_s[0]), mounts)
    known = len(alone) == len(poses)
    drift = se3.compose(poses, se3.inverse(alone)) if known else poses
    for row, stamp_s in enumerate(path.stamp_s.tolist()):
        frames = [("map", "odom", drift[row]), ("odom", "base_link", alone[row] if known else se3.identity())]
        yield stamp_s, "/tf", ros.transforms(stamp_s, frames)
        if known:
            yield stamp_s, "/odom", ros.odometry(stamp_s, alone[row])
    for topic, some in (("/pose", path), ("/online_pose", result.online)):
        poses, covariances = in_space(some.pose_world_robot), ros_covariance(some)
        for stamp_s, pose, covariance in zip(some.stamp_s.tolist(), poses, covariances, strict=True):
            yield stamp_s, topic, ros.posed(stamp_s, pose, covariance)


def robot_messages(recording: AnyRecording) -> Iterator[tuple[float, str, str, bytes]]:
    """Yield what a robot publishes that drives as in a recording: frames, odometry, detections, as time goes.

    Yields:
        Stamp [s], topic, type and serialised message.

    Raises:
        MissingExtraError: `rosbags` is not installed.
    """
    ros, odometry = Ros(ros2_types()), recording.odometry
    if isinstance(odometry, Odometry):
        velocity = np.stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps], axis=1)
        poses = [se2.identity()]
        for step in velocity[:-1] * np.diff(odometry.stamp_s)[:, None]:
            poses.append(se2.compose(poses[-1], se2.exp(step)))
        stamps, pose = odometry.stamp_s, in_space(np.array(poses))
    else:
        stamps = np.zeros(0) if odometry is None else odometry.stamp_s
        pose = np.zeros((0, 7)) if odometry is None else odometry.pose_world_robot
    start_s = float(min(recording.frames.stamp_s[:1].tolist() + stamps[:1].tolist(), default=0.0))
    mounts = [("base_link", name, at) for name, at in _mounts(recording)]
    driven = [(s, "/odom", ros.odometry(s, at)) for s, at in zip(stamps.tolist(), pose, strict=True)]
    still = (start_s, "/tf_static", ros.transforms(start_s, mounts))
    for stamp_s, topic, message in sorted([still, *driven, *_detections(ros, recording)], key=lambda one: one[0]):
        yield stamp_s, topic, TOPICS[topic], bytes(ros.types.serialize_cdr(message, TOPICS[topic]))


def in_space(pose: FloatArray) -> FloatArray:
    """Return poses (N, 3) in the plane as poses (N, 7) in space; those in space as they are."""
    return pose if pose.shape[1] == 7 else se3.from_plane(pose)


def ros_covariance(trajectory: Trajectory) -> FloatArray:
    """Return covariances (N, 6, 6) as ROS has them, along and about the axes of the map, not of the robot."""
    given, poses = trajectory.covariance, in_space(trajectory.pose_world_robot)
    whole = np.zeros((len(given), 6, 6))
    rows = np.arange(6) if given.shape[1:] == (6, 6) else np.array([0, 1, 5])
    whole[:, rows[:, None], rows] = given
    turn = np.zeros((len(given), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = se3.rotation_of(poses)
    return np.asarray(turn @ whole @ np.swapaxes(turn, 1, 2))


def _mounts(recording: AnyRecording) -> list[tuple[str, FloatArray]]:
    """Name and pose (7,) of each sensor on the robot."""
    if is_in_space(recording):
        return [(one.name, np.array(one.mount_robot_sensor)) for one in recording.sensors]
    return [("sensor", in_space(np.array([recording.sensor.mount_robot_sensor]))[0])]


def _detections(ros: Ros, recording: AnyRecording) -> Iterator[_Stamped]:
    """A message for every frame and sensor, also where nothing was seen."""
    stamps, mounts, names = recording.frames.stamp_s, _mounts(recording), recording.landmark_names
    if is_in_space(recording):
        seen = recording.detections
        at, turn, size = seen.position_sensor_m, seen.rotation, np.nan_to_num(seen.size_m)
        sensor, score = seen.sensor, np.nan_to_num(seen.score, nan=1.0)
        spread = np.zeros((len(seen), 6, 6))
        ids, frames, classes = seen.landmark_id, seen.frame, seen.class_id
    else:
        flat = recording.detections[np.isfinite(recording.detections.bearing_rad)]  # a position takes both
        ids, frames, classes = flat.landmark_id, flat.frame, flat.class_id
        bearing, zero = flat.bearing_rad, np.zeros(len(flat))
        at = np.stack([flat.range_m * np.cos(bearing), flat.range_m * np.sin(bearing), zero], axis=1)
        turn, size = np.full((len(flat), 4), np.nan), np.zeros((len(flat), 3))
        sensor, score = np.zeros(len(flat), dtype=np.int64), np.ones(len(flat))
        axis = np.array([[np.cos(bearing), -np.sin(bearing)], [np.sin(bearing), np.cos(bearing)]])
        axis = axis * np.stack([flat.sigma_range_m, flat.range_m * flat.sigma_bearing_rad])
        spread = np.pad(np.nan_to_num(np.einsum("ikn,jkn->nij", axis, axis)), ((0, 0), (0, 4), (0, 4)))
    labels = labels_of(classes, recording.class_names)
    turn = np.where(np.isnan(turn), se3.NO_TURN, turn)
    first = np.searchsorted(frames, np.arange(len(stamps) + 1))
    for frame, stamp_s in enumerate(stamps.tolist()):
        for number, (name, _) in enumerate(mounts):
            header, found = ros.header(stamp_s, name), []
            for row in range(first[frame], first[frame + 1]):
                if sensor[row] == number:
                    pose, identity = np.append(at[row], turn[row]), int(ids[row])
                    hypothesis = ros.make("vision_msgs/ObjectHypothesis", labels[row], float(score[row]))
                    result = ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis, ros.spread(pose, spread[row]))
                    box = ros.make("vision_msgs/BoundingBox3D", ros.pose(pose), ros.vector(size[row]))
                    text = "" if identity == UNKNOWN else landmark_label(identity, names)
                    found.append(ros.make("vision_msgs/Detection3D", header, [result], box, text))
            yield stamp_s, "/detections", ros.make("vision_msgs/Detection3DArray", header, found)


def _map(ros: Ros, landmarks: Landmarks, start_s: float) -> Iterator[_Stamped]:
    """The landmarks, each when it was first seen."""
    seen_s = np.maximum(np.nan_to_num(landmarks.first_seen_s, nan=start_s), start_s)
    for stamp_s, (marker, entity) in zip(seen_s.tolist(), drawn(ros, landmarks, seen_s), strict=True):
        yield stamp_s, "/landmarks", ros.make("visualization_msgs/MarkerArray", [marker])
        yield stamp_s, "/scene", ros.make("foxglove_msgs/SceneUpdate", [], [entity])


def drawn(ros: Ros, landmarks: Landmarks, stamp_s: FloatArray) -> Iterator[tuple[Any, Any]]:
    """Yield a marker and a scene entity for each landmark from `stamp_s` (L,) on, as opaque as it probably exists."""
    from evermap.viz.rerun_scene import rgb
    from evermap.viz.style import LANDMARK

    pose = poses_of(landmarks)
    size = np.full((len(landmarks), 3), np.nan) if landmarks.size_m is None else landmarks.size_m
    size = np.where(np.isnan(size), POINT_M, np.maximum(size, PLATE_M))
    labels = labels_of(landmarks.class_id, landmarks.class_names)
    none, tint = ros.make("builtin_interfaces/Duration", 0, 0), rgb(LANDMARK)
    nothing = np.zeros(0, dtype=np.uint8)
    file = ros.make("visualization_msgs/MeshFile", "", nothing)
    picture = ros.make("sensor_msgs/CompressedImage", ros.header(0.0, ""), "", nothing)
    called = landmarks.labels
    for row, identity in enumerate(landmarks.landmark_id.tolist()):
        at_s, p = float(stamp_s[row]), float(landmarks.p_exists[row])
        name, shape, here = called[row], ros.vector(size[row]), ros.pose(pose[row])
        turned = landmarks.rotation is not None and np.isfinite(landmarks.rotation[row]).all()
        marker = ros.make(
            "visualization_msgs/Marker", ros.header(at_s, "map"), labels[row], identity & MARKER_ID,
            CUBE if turned else SPHERE, 0, here, shape, ros.colour(tint, p, "std_msgs"), none,
            False, [], [], "", picture, [], name, "", file, False,
        )  # fmt: skip
        colour = ros.colour(tint, p, "foxglove_msgs")
        body = ros.make(f"foxglove_msgs/{'Cube' if turned else 'Sphere'}Primitive", here, shape, colour)
        said = {"class": labels[row], "p_exists": f"{p:.4f}"}
        text = f"{name} {p:.2f}" if p < 0.995 else name
        yield marker, _entity(ros, at_s, entity_id(name), body, said, text, pose[row])


def entity_id(name: str) -> str:
    """Return what a landmark is called in a scene."""
    return f"landmark {name}"


def poses_of(landmarks: Landmarks) -> FloatArray:
    """Return poses (L, 7) of landmarks, on the floor where the map is one of the plane."""
    at = np.zeros((len(landmarks), 3))
    at[:, : landmarks.position_m.shape[1]] = landmarks.position_m
    turn = np.full((len(landmarks), 4), np.nan) if landmarks.rotation is None else landmarks.rotation
    return np.hstack([at, np.where(np.isnan(turn), se3.NO_TURN, turn)])


def _entity(
    ros: Ros, stamp_s: float, name: str, body: Any, said: Mapping[str, str], text: str, pose: FloatArray
) -> Any:
    """An entity of a scene: a cube, a sphere or an arrow, and its name."""
    from evermap.viz.rerun_scene import rgb
    from evermap.viz.style import INK

    above = pose.copy()
    above[2] += 2.0 * POINT_M
    ink = ros.colour(rgb(INK), 1.0, "foxglove_msgs")
    label = ros.make("foxglove_msgs/TextPrimitive", ros.pose(above), True, POINT_M, False, ink, text)
    kind = type(body).__name__
    shapes = [[body] if part in kind else [] for part in ("Arrow", "Cube", "Sphere")]
    metadata = [ros.make("foxglove_msgs/KeyValuePair", key, value) for key, value in said.items()]
    lifetime = ros.make("builtin_interfaces/Duration", 0, 0)
    return ros.make(
        "foxglove_msgs/SceneEntity", ros.time(stamp_s), "map", name, lifetime, False, metadata, *shapes, [], [], [],
        [label], [],
    )  # fmt: skip


def _changes(ros: Ros, result: SlamResult, start_s: float) -> Iterator[_Stamped]:
    there = {**where(result.gone), **where(result.landmarks)}
    for number, change in enumerate(result.changes):
        stamp_s = max(float(np.nan_to_num(change.stamp_to_s, nan=start_s)), start_s)
        line, entity = told(ros, change, stamp_s, f"change {number}", there)
        yield stamp_s, "/changes", line
        if entity is not None:
            yield stamp_s, "/scene", ros.make("foxglove_msgs/SceneUpdate", [], [entity])


def told(ros: Ros, change: MapChange, stamp_s: float, name: str, there: Mapping[int, FloatArray]) -> tuple[Any, Any]:
    """Return a change as a line and as a named arrow in a scene from `stamp_s` on, or None without a known landmark.

    `there` has positions (3,) of landmarks by their ids, after the change.
    """
    from evermap.viz.change_words import probability, what
    from evermap.viz.rerun_scene import rgb
    from evermap.viz.style import ALERT

    line = ros.make("std_msgs/String", json.dumps(change_dict(change), allow_nan=False))
    at = [there[identity] for identity in change.landmark_ids if identity in there]
    if not at:
        return line, None
    moved = np.zeros(3)
    moved[: len(change.displacement_m)] = np.nan_to_num(change.displacement_m)
    length = float(np.linalg.norm(moved))
    along = moved / length if length > 0.0 else np.array([0.0, 0.0, -1.0])
    pose = _pointing(np.mean(at, axis=0) - moved, along)
    colour = ros.colour(rgb(ALERT), change.probability, "foxglove_msgs")
    shaft = max(length - POINT_M, 0.0) if length > 0.0 else 2.0 * POINT_M
    arrow = ros.make(
        "foxglove_msgs/ArrowPrimitive", ros.pose(pose), shaft, 0.3 * POINT_M, POINT_M, 0.6 * POINT_M, colour
    )
    text = f"{what(change)}, {probability(change.probability)}"
    return line, _entity(ros, stamp_s, name, arrow, {"kind": change.kind.value}, text, pose)


def where(landmarks: Landmarks) -> dict[int, FloatArray]:
    """Return positions (3,) of landmarks by their ids."""
    return dict(zip(landmarks.landmark_id.tolist(), poses_of(landmarks)[:, :3], strict=True))


def _pointing(at: FloatArray, along: FloatArray) -> FloatArray:
    """A pose (7,) whose x points along a unit vector (3,)."""
    yaw, pitch = math.atan2(along[1], along[0]), -math.asin(float(np.clip(along[2], -1.0, 1.0)))
    pose = se3.from_angles([0.0, pitch, yaw])
    pose[:3] = at
    return pose
