"""A robot that drives past two tags, as bags of ROS 1 and ROS 2."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from evermap.geometry import se2, se3
from evermap.geometry.camera import project
from evermap.types import SpatialSensor

MOUNT = np.array([0.2, 0.0, 0.5, -0.5, 0.5, -0.5, 0.5])
"""Of the camera on the robot: it looks ahead, with x to the right and y down."""
CAMERA = SpatialSensor(intrinsics=(400.0, 410.0, 320.0, 240.0), mount_robot_sensor=tuple(MOUNT))
TAGS = {
    3: np.array([4.0, 0.5, 0.6, 0.5, -0.5, -0.5, 0.5]),
    7: np.array([4.5, -0.6, 0.4, 0.5, -0.5, -0.5, 0.5]),
}
SIZE_M = 0.2
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
START_S = 1.7e9
STEPS = 25


def path_of(k: int) -> np.ndarray:
    """Pose of the robot, which drives a curve."""
    return se3.exp(np.array([0.05 * k, 0.0, 0.0, 0.0, 0.0, 0.01 * k]))


class Ros:
    """Messages of one release, by the names of their types."""

    def __init__(self, version: int) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        from evermap.io.rosbag import UNSTATED

        self.version = version
        self.store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
        extra = {
            "aruco_msgs/msg/ArucoMarkers": "std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses",
            "aruco_msgs/msg/Marker": (
                "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence"
            ),
            "aruco_msgs/msg/MarkerArray": "std_msgs/Header header\naruco_msgs/Marker[] markers",
            "ar_track_alvar_msgs/msg/AlvarMarker": (
                "std_msgs/Header header\nuint32 id\nuint32 confidence\ngeometry_msgs/PoseStamped pose"
            ),
            "ar_track_alvar_msgs/msg/AlvarMarkers": (
                "std_msgs/Header header\nar_track_alvar_msgs/AlvarMarker[] markers"
            ),
            "cartographer_ros_msgs/msg/LandmarkEntry": (
                "string id\ngeometry_msgs/Pose tracking_from_landmark_transform\nfloat64 translation_weight\n"
                "float64 rotation_weight"
            ),
            "cartographer_ros_msgs/msg/LandmarkList": (
                "std_msgs/Header header\ncartographer_ros_msgs/LandmarkEntry[] landmarks"
            ),
            "fiducial_msgs/msg/FiducialTransform": (
                "int32 fiducial_id\ngeometry_msgs/Transform transform\nfloat64 image_error\nfloat64 object_error\n"
                "float64 fiducial_area"
            ),
            "fiducial_msgs/msg/FiducialTransformArray": (
                "std_msgs/Header header\nint32 image_seq\nfiducial_msgs/FiducialTransform[] transforms"
            ),
            "apriltag_ros/msg/AprilTagDetection": (
                "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose"
            ),
            "apriltag_ros/msg/AprilTagDetectionArray": (
                "std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections"
            ),
            "foxglove_msgs/msg/CubePrimitive": "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size",
            "foxglove_msgs/msg/SceneEntity": (
                "std_msgs/Header header\nstring id\nfoxglove_msgs/CubePrimitive[] cubes\n"
                "foxglove_msgs/CubePrimitive[] spheres\nfoxglove_msgs/CubePrimitive[] cylinders\n"
                "foxglove_msgs/CubePrimitive[] models"
            ),
            "foxglove_msgs/msg/SceneUpdate": "foxglove_msgs/SceneEntity[] entities",
        }
        if version == 1:
            extra["tf2_msgs/msg/TFMessage"] = "geometry_msgs/TransformStamped[] transforms"
        for name, text in (UNSTATED | extra).items():
            self.store.register(get_types_from_msg(text, name))

    def make(self, name: str, *values: Any) -> Any:
        package, kind = name.split("/")
        return self.store.types[f"{package}/msg/{kind}"](*values)

    def header(self, stamp_s: float, frame: str) -> Any:
        nano = round(stamp_s * 1e9)
        stamp = self.make("builtin_interfaces/Time", nano // 10**9, nano % 10**9)
        return self.make("std_msgs/Header", *([0] if self.version == 1 else []), stamp, frame)

    def pose(self, pose: np.ndarray) -> Any:
        at = self.make("geometry_msgs/Point", *map(float, pose[:3]))
        return self.make("geometry_msgs/Pose", at, self.make("geometry_msgs/Quaternion", *map(float, pose[3:])))

    def transform(self, stamp_s: float, parent: str, child: str, pose: np.ndarray) -> Any:
        return self.make("tf2_msgs/TFMessage", [self.stamped_transform(stamp_s, parent, child, pose)])

    def stamped_transform(self, stamp_s: float, parent: str, child: str, pose: np.ndarray) -> Any:
        inner = self.moved(pose)
        return self.make("geometry_msgs/TransformStamped", self.header(stamp_s, parent), child, inner)

    def moved(self, pose: np.ndarray) -> Any:
        at = self.make("geometry_msgs/Vector3", *map(float, pose[:3]))
        turn = self.make("geometry_msgs/Quaternion", *map(float, pose[3:]))
        return self.make("geometry_msgs/Transform", at, turn)

    def spread(self, pose: np.ndarray) -> Any:
        return self.make("geometry_msgs/PoseWithCovariance", self.pose(pose), 0.01 * np.eye(6).ravel())

    def twist(self, velocity: np.ndarray) -> Any:
        parts = (self.make("geometry_msgs/Vector3", *map(float, part)) for part in (velocity[:3], velocity[3:]))
        return self.make("geometry_msgs/Twist", *parts)

    def odometry(self, stamp_s: float, pose: np.ndarray) -> Any:
        still = self.make("geometry_msgs/TwistWithCovariance", self.twist(np.zeros(6)), np.zeros(36))
        return self.make("nav_msgs/Odometry", self.header(stamp_s, "odom"), "base_link", self.spread(pose), still)

    def motion(self, kind: str, stamp_s: float, pose: np.ndarray, velocity: np.ndarray) -> Any:
        """The pose, or the velocity from there on, as a message of one of the kinds that say where a robot drives."""
        header, package = self.header(stamp_s, "odom"), "geometry_msgs"
        if kind == "Odometry":
            return self.odometry(stamp_s, pose)
        if kind == "TransformStamped":
            return self.stamped_transform(stamp_s, "odom", "base_link", pose)
        said: Any = {
            "PoseStamped": lambda: self.pose(pose),
            "PoseWithCovarianceStamped": lambda: self.spread(pose),
            "TwistStamped": lambda: self.twist(velocity),
            "TwistWithCovarianceStamped": lambda: self.make(
                f"{package}/TwistWithCovariance", self.twist(velocity), np.zeros(36)
            ),
        }[kind]
        return self.make(f"{package}/{kind}", header, said())

    def camera(self, stamp_s: float) -> Any:
        fx, fy, cx, cy = CAMERA.intrinsics or ()
        k = np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        p = np.insert(k, (3, 6, 9), 0.0)
        bent = np.array([0.3, 0.1, 0.0, 0.0, 0.0])  # of the image before it is rectified
        region = self.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        header = self.header(stamp_s, "camera_optical")
        return self.make(
            "sensor_msgs/CameraInfo", header, 480, 640, "plumb_bob", bent, k, np.eye(3).ravel(), p, 0, 0, region
        )

    def fix(
        self, stamp_s: float, at: tuple[float, float, float], variance: Any, *, status: int = 0, kind: int = 2
    ) -> Any:
        """A fix at latitude, longitude [deg] and altitude [m], in the frame `gps`."""
        state = self.make("sensor_msgs/NavSatStatus", status, 1)
        spread = np.diag(np.asarray(variance, dtype=np.float64)).ravel()
        return self.make("sensor_msgs/NavSatFix", self.header(stamp_s, "gps"), state, *at, spread, kind)

    def imu(self, stamp_s: float, force: np.ndarray, rate: np.ndarray, frame: str = "imu") -> Any:
        """Readings of an accelerometer and a gyroscope, beside an orientation that is wrong."""
        force, rate = (self.make("geometry_msgs/Vector3", *map(float, part)) for part in (force, rate))
        turn, spread = self.make("geometry_msgs/Quaternion", 1.0, 0.0, 0.0, 0.0), np.zeros(9)
        return self.make("sensor_msgs/Imu", self.header(stamp_s, frame), turn, spread, rate, spread, force, spread)


def in_camera(k: int) -> dict[int, np.ndarray]:
    """Where the tags are in the camera, at a step."""
    eye = se3.inverse(se3.compose(path_of(k), MOUNT))
    return {name: se3.compose(eye, pose) for name, pose in TAGS.items()}


def corners_of(pose: np.ndarray) -> np.ndarray:
    at = np.hstack([CORNERS * SIZE_M / 2.0, np.zeros((4, 1))])
    return project(se3.transform(pose, at), CAMERA)[0]


def tags(ros: Ros, stamp_s: float, k: int) -> Any:
    found = []
    for name, pose in in_camera(k).items() if k % 5 else ():
        four = [ros.make("apriltag_msgs/Point", *map(float, corner)) for corner in corners_of(pose)]
        centre, plane = ros.make("apriltag_msgs/Point", 0.0, 0.0), np.eye(3).ravel()
        found.append(ros.make("apriltag_msgs/AprilTagDetection", "36h11", name, 0, 1.0, 50.0, centre, four, plane))
    return ros.make("apriltag_msgs/AprilTagDetectionArray", ros.header(stamp_s, "camera_optical"), found)


def objects(ros: Ros, stamp_s: float, k: int) -> Any:
    found = []
    for name, pose in in_camera(k).items():
        hypothesis = ros.make("vision_msgs/ObjectHypothesis", "crate", 0.8)
        spread = ros.make("geometry_msgs/PoseWithCovariance", ros.pose(pose), np.zeros(36))
        result = ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis, spread)
        size = ros.make("geometry_msgs/Vector3", 0.4, 0.3, 0.2)
        box = ros.make("vision_msgs/BoundingBox3D", ros.pose(pose), size)
        found.append(
            ros.make("vision_msgs/Detection3D", ros.header(stamp_s, "camera_optical"), [result], box, f"crate {name}")
        )
    return ros.make("vision_msgs/Detection3DArray", ros.header(stamp_s, "camera_optical"), found)


def directions(ros: Ros, stamp_s: float, k: int) -> Any:
    found = []
    for name, pose in in_camera(k).items():
        u, v = project(pose[None, :3], CAMERA)[0][0]
        middle = ros.make("vision_msgs/Pose2D", ros.make("vision_msgs/Point2D", float(u), float(v)), 0.0)
        box = ros.make("vision_msgs/BoundingBox2D", middle, 20.0, 30.0)
        found.append(ros.make("vision_msgs/Detection2D", ros.header(stamp_s, "camera_optical"), [], box, str(name)))
    return ros.make("vision_msgs/Detection2DArray", ros.header(stamp_s, "camera_optical"), found)


def aruco(ros: Ros, stamp_s: float, k: int) -> Any:
    seen = in_camera(k)
    names = np.array(list(seen), dtype=np.int64)
    poses = [ros.pose(pose) for pose in seen.values()]
    return ros.make("aruco_msgs/ArucoMarkers", ros.header(stamp_s, "camera_optical"), names, poses)


def scene(ros: Ros, stamp_s: float, k: int) -> Any:
    found = []
    for name, pose in in_camera(k).items():
        cube = ros.make("foxglove_msgs/CubePrimitive", ros.pose(pose), ros.make("geometry_msgs/Vector3", 1.0, 1.0, 1.0))
        header = ros.header(stamp_s, "camera_optical")
        found.append(ros.make("foxglove_msgs/SceneEntity", header, str(name), [cube], [], [], []))
    return ros.make("foxglove_msgs/SceneUpdate", found)


def fiducials(ros: Ros, stamp_s: float, k: int) -> Any:
    found = [
        ros.make("fiducial_msgs/FiducialTransform", name, ros.moved(pose), 0.1, 0.1, 100.0)
        for name, pose in in_camera(k).items()
    ]
    return ros.make("fiducial_msgs/FiducialTransformArray", ros.header(stamp_s, "camera_optical"), k, found)


def apriltag_ros(ros: Ros, stamp_s: float, k: int) -> Any:
    header, found = ros.header(stamp_s, "camera_optical"), []
    for name, pose in in_camera(k).items():
        posed = ros.make("geometry_msgs/PoseWithCovarianceStamped", header, ros.spread(pose))
        sizes = np.array([SIZE_M])
        found.append(ros.make("apriltag_ros/AprilTagDetection", np.array([name], dtype=np.int32), sizes, posed))
    return ros.make("apriltag_ros/AprilTagDetectionArray", header, found)


def markers(ros: Ros, stamp_s: float, k: int) -> Any:
    """Of ROS 2 only, whose markers have more fields."""
    header, found, nothing = ros.header(stamp_s, "camera_optical"), [], np.zeros(0, dtype=np.uint8)
    for name, pose in in_camera(k).items():
        size = ros.make("geometry_msgs/Vector3", 0.2, 0.2, 0.2)
        colour, ever = ros.make("std_msgs/ColorRGBA", 1.0, 0.0, 0.0, 1.0), ros.make("builtin_interfaces/Duration", 0, 0)
        picture, file = (ros.make("sensor_msgs/CompressedImage", header, "", nothing),
                         ros.make("visualization_msgs/MeshFile", "", nothing))  # fmt: skip
        found.append(ros.make(
            "visualization_msgs/Marker", header, "", name, 1, 0, ros.pose(pose), size, colour, ever, False, [], [], "",
            picture, [], "", "", file, False,
        ))  # fmt: skip
    return ros.make("visualization_msgs/MarkerArray", found)


def aruco_ros(ros: Ros, stamp_s: float, k: int) -> Any:
    """Markers of aruco_ros, whose array has the name of one of pictures."""
    header = ros.header(stamp_s, "camera_optical")
    found = [ros.make("aruco_msgs/Marker", header, name, ros.spread(pose), 0.9) for name, pose in in_camera(k).items()]
    return ros.make("aruco_msgs/MarkerArray", header, found)


def alvar(ros: Ros, stamp_s: float, k: int) -> Any:
    """Markers of ar_track_alvar; only each of them says its frame."""
    header = ros.header(stamp_s, "camera_optical")
    found = [
        ros.make(
            "ar_track_alvar_msgs/AlvarMarker",
            header,
            name,
            90,
            ros.make("geometry_msgs/PoseStamped", header, ros.pose(pose)),
        )
        for name, pose in in_camera(k).items()
    ]
    return ros.make("ar_track_alvar_msgs/AlvarMarkers", ros.header(stamp_s, ""), found)


def cartographer(ros: Ros, stamp_s: float, k: int) -> Any:
    """Landmarks as cartographer takes them."""
    found = [
        ros.make("cartographer_ros_msgs/LandmarkEntry", str(name), ros.pose(pose), 1.0, 1.0)
        for name, pose in in_camera(k).items()
    ]
    return ros.make("cartographer_ros_msgs/LandmarkList", ros.header(stamp_s, "camera_optical"), found)


def only_transforms(ros: Ros, stamp_s: float, k: int) -> Any:
    """Tags that are said nowhere but on /tf."""
    seen = [
        ros.stamped_transform(stamp_s, "camera_optical", f"tag36h11:{name}", pose)
        for name, pose in in_camera(k).items()
    ]
    return ros.make("tf2_msgs/TFMessage", seen)


DETECTORS: dict[str, tuple[str, Callable[[Ros, float, int], Any]]] = {
    "tags": ("apriltag_msgs/AprilTagDetectionArray", tags),
    "objects": ("vision_msgs/Detection3DArray", objects),
    "directions": ("vision_msgs/Detection2DArray", directions),
    "aruco": ("aruco_msgs/ArucoMarkers", aruco),
    "scene": ("foxglove_msgs/SceneUpdate", scene),
    "fiducials": ("fiducial_msgs/FiducialTransformArray", fiducials),
    "apriltag_ros": ("apriltag_ros/AprilTagDetectionArray", apriltag_ros),
    "markers": ("visualization_msgs/MarkerArray", markers),
    "aruco_ros": ("aruco_msgs/MarkerArray", aruco_ros),
    "alvar": ("ar_track_alvar_msgs/AlvarMarkers", alvar),
    "cartographer": ("cartographer_ros_msgs/LandmarkList", cartographer),
    "transforms": ("tf2_msgs/TFMessage", only_transforms),
}


release = cache(Ros)
"""Its types are read once."""
Further = Callable[[Ros], list[tuple[str, str, float, Any]]]
"""More messages of a bag: topic, type without 'msg', stamp [s] and message of each."""


def write(
    path: Path,
    detector: str,
    *,
    late_s: float = 0.0,
    mounted: bool = True,
    odometry: str = "Odometry",
    stand: int = 0,
    further: Further | None = None,
) -> Path:
    """A bag of the drive: of ROS 1 where its name ends in `.bag`, else of ROS 2, in SQLite where in `_sqlite`.

    At its end the robot stands for so many steps.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2 import StoragePlugin

    ros = release(1 if path.suffix == ".bag" else 2)
    if ros.version == 1:
        writer: Any = rosbag1.Writer(path)
        raw = ros.store.serialize_ros1
    else:
        plugin = StoragePlugin.SQLITE3 if path.name.endswith("_sqlite") else StoragePlugin.MCAP
        writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
        raw = ros.store.serialize_cdr
    kind, detect = DETECTORS[detector]
    topics = {
        "/odom": f"{'nav' if odometry == 'Odometry' else 'geometry'}_msgs/{odometry}",
        "/gt/pose": "geometry_msgs/PoseStamped",
        "/amcl_pose": "geometry_msgs/PoseStamped", "/camera/camera_info": "sensor_msgs/CameraInfo",
        "/tf_static": "tf2_msgs/TFMessage", "/tf": "tf2_msgs/TFMessage", "/camera/seen": kind,
        "/wheels/twist": "geometry_msgs/TwistStamped", "/rosout_agg": "std_msgs/String",
    }  # fmt: skip
    with writer as bag:
        full = {topic: "{}/msg/{}".format(*name.split("/")) for topic, name in topics.items()}
        to = {topic: bag.add_connection(topic, name, typestore=ros.store) for topic, name in full.items()}

        def put(topic: str, stamp_s: float, message: Any) -> None:
            bag.write(to[topic], round((stamp_s + 0.01) * 1e9), raw(message, full[topic]))

        if mounted:
            half = np.array([0.2, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
            rest = se3.compose(se3.inverse(half), MOUNT)
            put("/tf_static", START_S, ros.transform(START_S, "base_link", "camera", half))
            put("/tf_static", START_S, ros.transform(START_S, "/camera", "/camera_optical", rest))
        for step_number in range(STEPS + stand):
            stamp_s, k = START_S + 0.1 * step_number, min(step_number, STEPS - 1)
            pose = path_of(k)
            put("/tf", stamp_s, ros.transform(stamp_s, "odom", "base_link", pose))
            step = se3.log(se3.compose(se3.inverse(pose), path_of(k + 1))) / 0.1
            put("/odom", stamp_s, ros.motion(odometry, stamp_s, pose, step))
            put("/wheels/twist", stamp_s, ros.motion("TwistStamped", stamp_s, pose, step))
            for topic in ("/gt/pose", "/amcl_pose"):
                put(topic, stamp_s, ros.make("geometry_msgs/PoseStamped", ros.header(stamp_s, "map"), ros.pose(pose)))
            put("/camera/camera_info", stamp_s, ros.camera(stamp_s))
            put("/camera/seen", stamp_s, detect(ros, stamp_s - late_s, k))
        _put_further(bag, ros, raw, further)
    for file in path.glob("*.db3"):  # those of Humble do not hold the types of their messages
        with closing(sqlite3.connect(file)) as database, database:
            database.execute("DELETE FROM message_definitions")
    return path


def _put_further(bag: Any, ros: Ros, raw: Callable[[Any, str], Any], further: Further | None) -> None:
    to: dict[str, Any] = {}
    for topic, name, stamp_s, message in further(ros) if further is not None else ():
        full = "{}/msg/{}".format(*name.split("/"))
        if topic not in to:
            to[topic] = bag.add_connection(topic, full, typestore=ros.store)
        bag.write(to[topic], round((stamp_s + 0.01) * 1e9), raw(message, full))


TILTED = np.append([0.15, 0.0, 0.4], se3.from_angles([0.0, 0.3, 0.0])[3:])
"""A mount above the floor, that looks down."""


def dead_reckoned(odometry: Any) -> np.ndarray:
    """(N, 7) poses that the velocities of a robot on a floor lead to, from the origin."""
    pose, step = np.zeros(3), np.diff(odometry.stamp_s)
    found = [pose]
    twist = np.column_stack([odometry.forward_mps, odometry.lateral_mps, odometry.angular_radps])
    for row in range(len(step)):
        pose = se2.compose(pose, se2.exp(twist[row] * step[row]))
        found.append(pose)
    return se3.from_plane(np.array(found))


def write_floor(
    path: Path,
    recording: Any,
    *,
    mount: np.ndarray = TILTED,
    kind: str = "objects",
    odometry_unit: float = 1.0,
    unit: float = 1.0,
    rotation: Callable[[int, int], np.ndarray] | None = None,
    clock_s: float = 0.0,
    further: Further | None = None,
) -> Path:
    """A bag of ROS 2 of a recording in the plane: points by `Detection3DArray`, or tags by `ArucoMarkers`, in a frame
    that is mounted at a pose, each landmark at a height of its own.

    `rotation`: quaternion of the orientation of a landmark in a frame, by its row; without: the default of ROS.
    """
    from rosbags import rosbag2
    from rosbags.rosbag2 import StoragePlugin

    ros, seen, frames = release(2), recording.detections, recording.frames.stamp_s + clock_s
    flat, poses = np.array(recording.sensor.mount_robot_sensor), dead_reckoned(recording.odometry)
    ahead = np.column_stack([seen.range_m * np.cos(seen.bearing_rad), seen.range_m * np.sin(seen.bearing_rad)])
    height = 0.2 + 0.1 * (seen.landmark_id % 13)
    at = se3.transform(se3.inverse(mount), np.column_stack([se2.transform(flat, ahead), height])) * unit
    seen_type = {"objects": "vision_msgs/Detection3DArray", "tags": "aruco_msgs/ArucoMarkers"}[kind]
    topics = {"/odom": "nav_msgs/Odometry", "/tf_static": "tf2_msgs/TFMessage", "/seen": seen_type}
    with rosbag2.Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as bag:
        full = {topic: "{}/msg/{}".format(*name.split("/")) for topic, name in topics.items()}
        to = {topic: bag.add_connection(topic, name, typestore=ros.store) for topic, name in full.items()}

        def put(topic: str, stamp_s: float, message: Any) -> None:
            bag.write(to[topic], round(stamp_s * 1e9), ros.store.serialize_cdr(message, full[topic]))

        put("/tf_static", frames[0], ros.transform(frames[0], "base_link", "eye", mount))
        scale = np.array([odometry_unit] * 3 + [1.0] * 4)
        for stamp_s, pose in zip(recording.odometry.stamp_s + clock_s, poses, strict=True):
            put("/odom", stamp_s, ros.odometry(stamp_s, pose * scale))
        first = np.searchsorted(seen.frame, np.arange(len(frames) + 1))
        for frame, stamp_s in enumerate(frames):
            rows = range(first[frame], first[frame + 1])
            turn = [se3.NO_TURN if rotation is None else rotation(frame, row) for row in rows]
            found = [ros.pose(np.append(at[row], one)) for row, one in zip(rows, turn, strict=True)]
            header = ros.header(stamp_s, "eye")
            if kind == "tags":
                names = seen.landmark_id[rows.start : rows.stop]
                put("/seen", stamp_s, ros.make("aruco_msgs/ArucoMarkers", header, names, found))
                continue
            boxes = []
            for row, pose in zip(rows, found, strict=True):
                label = recording.class_names[seen.class_id[row]] if seen.class_id[row] >= 0 else ""
                spread = ros.make("geometry_msgs/PoseWithCovariance", pose, np.zeros(36))
                hypothesis = ros.make("vision_msgs/ObjectHypothesis", label, 0.9)
                result = ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis, spread)
                box = ros.make("vision_msgs/BoundingBox3D", pose, ros.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0))
                name = str(seen.landmark_id[row]) if seen.landmark_id[row] >= 0 else ""
                boxes.append(ros.make("vision_msgs/Detection3D", header, [result], box, name))
            put("/seen", stamp_s, ros.make("vision_msgs/Detection3DArray", header, boxes))
        _put_further(bag, ros, ros.store.serialize_cdr, further)
    return path
