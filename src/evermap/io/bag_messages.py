"""Motion, detections, measurements, cameras and frames from the messages in a bag, of types in any package.

Fields decide more than types: a pose may come with a header, a covariance, or both; a detection of a tag with its pose
or its corners; class and score of an object in the forms of three releases of `vision_msgs`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evermap.estimate.measurements import find_kinds
from evermap.geometry import se3
from evermap.io.rosbag import MOST_HAMMING, Handler, Topic, corners_of, pose_of, scan, seconds, stamp_of
from evermap.types import FloatArray, IntArray

if TYPE_CHECKING:
    from evermap.io.cdr import Parts

POSES = ("Odometry", "PoseWithCovarianceStamped", "PoseStamped", "TransformStamped")
TWISTS = ("TwistWithCovarianceStamped", "TwistStamped")
FRAMES = ("TFMessage", "tfMessage")
TRANSFORMS = "tf:"
"""Begin of the names under which transforms are kept as if they were a topic: of odometry, and of tags."""
_ODOMETRY = re.compile(r"(^|[/_])odom")
_TAG = re.compile(r"(tag|marker|aruco|fiducial).*?(\d{1,9})$", re.IGNORECASE)
"""Frames that are of odometry or of a tag, by the names that their packages give them."""


class Seen(NamedTuple):
    """One detection; `look` is the number of its message; numbers that it does not say are nan."""

    look: int
    identity: int | str | None = None
    label: str = ""
    score: float = float("nan")
    pose: tuple[float, ...] = (np.nan,) * 7
    covariance: FloatArray = np.full((3, 3), np.nan)
    corners: tuple[float, ...] = (np.nan,) * 8
    size: tuple[float, ...] = (np.nan,) * 3
    pixel: tuple[float, float] = (np.nan, np.nan)


class SeenColumns(NamedTuple):
    """M detections by columns, as `Seen` has them; numbers that a message does not say are nan.

    Attributes:
        look: (M,).
        identity: M, None where it is not said.
        label: M, '' where it is not said.
        score: (M,).
        pose: (M, 7).
        covariance: (M, 3, 3).
        corners: (M, 4, 2).
        size: (M, 3).
        pixel: (M, 2).
    """

    look: IntArray
    identity: Sequence[int | str | None]
    label: Sequence[str]
    score: FloatArray
    pose: FloatArray
    covariance: FloatArray
    corners: FloatArray
    size: FloatArray
    pixel: FloatArray

    @classmethod
    def of(cls, rows: Sequence[Seen]) -> SeenColumns:
        """Return the columns of some detections."""
        columns = {name: [getattr(one, name) for one in rows] for name in Seen._fields}
        shapes = {"score": (), "pose": (7,), "covariance": (3, 3), "corners": (4, 2), "size": (3,), "pixel": (2,)}
        numbers: dict[str, Any] = {
            name: np.array(columns[name], dtype=np.float64).reshape(-1, *shape) for name, shape in shapes.items()
        }
        look = np.array(columns["look"], dtype=np.int64)
        return cls(look, columns["identity"], columns["label"], **numbers)


@dataclass(slots=True)
class BagContent:
    """Motion, detections, cameras and frames of a bag; lists by topic, in the order of recording."""

    topics: dict[str, Topic] = field(default_factory=dict)
    stamps: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # in the header, and of recording
    motion: dict[str, list[tuple[float, ...]]] = field(default_factory=dict)
    frames: dict[str, str] = field(default_factory=dict)  # of a topic: the child of its poses, or where it sees things
    seen: dict[str, list[Seen]] = field(default_factory=dict)
    cameras: dict[str, Any] = field(default_factory=dict)
    measured: dict[tuple[str, str], list[tuple[int, tuple[float, ...]]]] = field(default_factory=dict)
    """By kind of measurement and topic: numbers of messages, and what these say."""
    edges: dict[tuple[str, str], FloatArray] = field(default_factory=dict)
    moving: set[tuple[str, str]] = field(default_factory=set)
    keeps_transforms: bool = False
    """Whether transforms of odometry and tags are kept as if they were messages of a topic."""

    def kind(self, topic: str) -> str:
        """Return the type of a topic without its package."""
        return self.topics[topic].kind.rsplit("/", 1)[-1] if topic in self.topics else ""

    def passed_over(self) -> str:
        """Return which topics are not read since their messages are not of ROS, as a sentence; '' for none."""
        by: dict[str, list[str]] = {}
        for name, one in sorted(self.topics.items()):
            by.setdefault(one.encoding, []).append(name)
        parts = [f"in {encoding}: {', '.join(names)}" for encoding, names in by.items() if encoding]
        return f"topics passed over, since only messages of ROS are read, {'; '.join(parts)}" if parts else ""

    def take_look(self, topic: str, stamp_s: float, received_s: float, frame: str) -> int:
        """Take a message of detections, stamped [s] and seen in a frame ('' for unknown); return its number."""
        self.stamps[topic].append((stamp_s, received_s))
        if frame:
            self.frames.setdefault(topic, _plain(frame))
        return len(self.stamps[topic]) - 1

    def has_moving(self, topic: str) -> bool:
        """Return whether what is kept under the name of a topic is of frames that move, as all real topics are."""
        if not topic.startswith(TRANSFORMS):
            return True
        parent, _, child = topic.removeprefix(TRANSFORMS).partition(">")
        return any(edge[0] == parent and child in ("", edge[1]) for edge in self.moving)

    def mount(self, base: str, sensor: str) -> FloatArray | None:
        """Return the pose (7,) of one frame in another, along frames that do not move; None without such a way."""
        ways: dict[str, list[tuple[str, FloatArray]]] = {}
        for (parent, child), pose in self.edges.items():
            if (parent, child) not in self.moving:
                ways.setdefault(parent, []).append((child, pose))
                ways.setdefault(child, []).append((parent, se3.inverse(pose)))
        found, front = {base: se3.identity()}, [base]
        while front and sensor not in found:
            here = front.pop()
            for there, pose in ways.get(here, ()):
                if there not in found:
                    found[there] = se3.compose(found[here], pose)
                    front.append(there)
        return found.get(sensor)


def scan_bag(path: Path) -> BagContent:
    """Return what a bag holds.

    Raises:
        InputError: it is missing or damaged.
        MissingExtraError: `rosbags` is not installed.
    """
    content = BagContent(keeps_transforms=True)

    def handlers(topics: Mapping[str, Topic]) -> dict[str, Handler]:
        content.topics = dict(topics)
        found = {topic: handler_of(content, topic) or _find_adder(content, topic) for topic in topics}
        return {topic: handler for topic, handler in found.items() if handler is not None}

    scan(path, handlers)
    return content


def handler_of(content: BagContent, topic: str) -> Handler | None:
    """Return what adds a message of a topic to the content, and when it was received [s]; None for other kinds."""
    kind = "" if content.topics[topic].encoding else content.kind(topic)
    if kind in POSES + TWISTS:
        return _motion_of(content, topic)
    if kind in _DETECTIONS:
        return _find_columns_of(content, topic, _DETECTIONS[kind])
    if kind == "CameraInfo":
        return _camera_of(content, topic)
    if kind in FRAMES:
        return lambda message, received_s: _edges_of(content, message, received_s)
    return None


def _find_adder(content: BagContent, topic: str) -> Handler | None:
    """Return what adds a message to the measurements that are made of its type; None of other types."""
    kind = "" if content.topics[topic].encoding else content.kind(topic)
    readers = [
        (one.messages.read, content.measured.setdefault((name, topic), []))
        for name, one in find_kinds().items()
        if one.messages is not None and kind in one.messages.types
    ]

    def handle(message: Any, received_s: float) -> None:
        stamp_s, frame = _said(message)
        number = content.take_look(topic, stamp_s, received_s, frame)
        for read, rows in readers:
            numbers = read(message)
            if numbers is not None:
                rows.append((number, numbers))

    if not readers:
        return None
    content.stamps.setdefault(topic, [])
    return handle


def _camera_of(content: BagContent, topic: str) -> Handler:
    def handle(message: Any, _: float) -> None:
        content.cameras.setdefault(topic, message)
        content.frames.setdefault(topic, _plain(message.header.frame_id))

    return handle


def _motion_of(content: BagContent, topic: str) -> Handler:
    rows, stamps = content.motion.setdefault(topic, []), content.stamps.setdefault(topic, [])

    def handle(message: Any, received_s: float) -> None:
        stamps.append((stamp_of(message), received_s))
        content.frames.setdefault(topic, _plain(getattr(message, "child_frame_id", "")))
        held: Any = getattr(message, "pose", getattr(message, "twist", getattr(message, "transform", None)))
        inner = getattr(held, "pose", getattr(held, "twist", held))
        if hasattr(inner, "linear"):
            rows.append(tuple(getattr(part, axis) for part in (inner.linear, inner.angular) for axis in "xyz"))
        else:
            spread = np.asarray(getattr(held, "covariance", np.zeros(36)), dtype=np.float64).reshape(6, 6)
            rows.append((*pose_of(inner), *np.diagonal(spread)))

    return handle


def _find_columns_of(content: BagContent, topic: str, parts: Callable[[Any, int], Iterator[Seen]]) -> Handler:
    rows = content.seen.setdefault(topic, [])
    content.stamps.setdefault(topic, [])

    def handle(message: Any, received_s: float) -> None:
        stamp_s, frame = _said(message)
        rows.extend(parts(message, content.take_look(topic, stamp_s, received_s, frame)))

    return handle


def _said(message: Any) -> tuple[float, str]:
    """Return stamp [s] and frame of a message, or of the first of its parts that says one; nan and '' if missing."""
    for one in (message, *getattr(message, "markers", ()), *getattr(message, "entities", ())):
        if hasattr(one, "header") and (one.header.frame_id or not len(getattr(one, "markers", ()))):
            return stamp_of(one), str(one.header.frame_id)
        if hasattr(one, "timestamp"):
            return seconds(one.timestamp), str(one.frame_id)
    return float("nan"), ""


def _edges_of(content: BagContent, message: Any, received_s: float) -> None:
    for one in message.transforms:
        edge, pose = (_plain(one.header.frame_id), _plain(one.child_frame_id)), np.array(pose_of(one.transform))
        if content.keeps_transforms:
            _take_transform(content, edge, pose, (stamp_of(one), received_s))
        if edge not in content.edges:
            content.edges[edge] = se3.normalise_poses(pose)
        elif np.abs(se3.log(se3.compose(se3.inverse(content.edges[edge]), se3.normalise_poses(pose)))).max() > 1e-6:
            content.moving.add(edge)


def _take_transform(content: BagContent, edge: tuple[str, str], pose: FloatArray, stamps: tuple[float, float]) -> None:
    """Keep a transform that may be all that a bag says of the odometry or of tags, under a name in place of a topic."""
    parent, child = edge
    if _ODOMETRY.search(parent):
        topic = f"{TRANSFORMS}{parent}>{child}"
        content.topics.setdefault(topic, Topic("geometry_msgs/msg/TransformStamped", 0))
        content.frames.setdefault(topic, child)
        content.stamps.setdefault(topic, []).append(stamps)
        content.motion.setdefault(topic, []).append((*pose.tolist(), *np.zeros(6)))
    elif (tag := _TAG.search(child)) is not None:
        topic = f"{TRANSFORMS}{parent}"
        content.stamps.setdefault(topic, [])
        look = content.take_look(topic, *stamps, parent)
        content.seen.setdefault(topic, []).append(Seen(look, int(tag[2]), pose=tuple(pose.tolist())))


def _plain(frame: str) -> str:
    """A frame's name without the slash that older messages begin it with."""
    return frame.lstrip("/")


def _inner(message: Any) -> Any:
    """The pose within a pose with a header, a covariance, or both."""
    while hasattr(message, "pose"):
        message = message.pose
    return message


def _tags(message: Any, look: int) -> Iterator[Seen]:
    for tag in getattr(message, "apriltags", getattr(message, "detections", ())):
        names = np.atleast_1d(tag.id).tolist()
        identity = int(names[0]) if len(names) == 1 else "bundle of " + ", ".join(map(str, names))
        if hasattr(tag, "pose"):
            yield Seen(look, identity, pose=pose_of(_inner(tag.pose)))
        elif int(tag.hamming) <= MOST_HAMMING:
            yield Seen(look, identity, corners=corners_of(tag))


def _markers(message: Any, look: int) -> Iterator[Seen]:
    """ArUco markers, in a list of each or in two."""
    if hasattr(message, "marker_ids"):
        for name, pose in zip(message.marker_ids, message.poses, strict=True):
            yield Seen(look, int(name), pose=pose_of(pose))
    for one in getattr(message, "markers", ()):
        yield Seen(look, int(getattr(one, "marker_id", getattr(one, "id", -1))), pose=pose_of(_inner(one.pose)))
    for one in getattr(message, "landmarks", ()):
        yield Seen(look, str(one.id), pose=pose_of(one.tracking_from_landmark_transform))
    for one in getattr(message, "transforms", ()):
        yield Seen(look, int(one.fiducial_id), pose=pose_of(one.transform))


def _objects(message: Any, look: int) -> Iterator[Seen]:
    for one in message.detections:
        best = one.results[0] if len(one.results) == 1 else max(one.results, key=_score, default=None)
        hypothesis = getattr(best, "hypothesis", best)
        label = "" if hypothesis is None else str(getattr(hypothesis, "class_id", getattr(hypothesis, "id", "")))
        score = float("nan") if hypothesis is None else float(hypothesis.score)
        known = look, str(getattr(one, "id", "")) or None, label, score
        if hasattr(one.bbox, "size_x"):
            center = getattr(one.bbox.center, "position", one.bbox.center)
            yield Seen(*known, pixel=(center.x, center.y))
            continue
        size = (one.bbox.size.x, one.bbox.size.y, one.bbox.size.z)
        sized = size[0] > 0.0 and size[1] > 0.0 and size[2] > 0.0
        if not sized and best is not None:
            spread = np.asarray(best.pose.covariance, dtype=np.float64).reshape(6, 6)[:3, :3]
            said = spread[0, 0] + spread[1, 1] + spread[2, 2] > 0.0
            pose = pose_of(_inner(best.pose))
            yield Seen(*known, pose, spread) if said else Seen(*known, pose)
        else:
            yield Seen(*known, pose_of(one.bbox.center), size=size if sized else (np.nan,) * 3)


OBJECT_FIELDS = (
    "id", "results/hypothesis/class_id", "results/hypothesis/score", "results/pose/pose", "results/pose/covariance",
    "bbox/center", "bbox/size",
)  # fmt: skip
"""What a detection of `vision_msgs` in space says (`cdr.parts_of`)."""


def objects_in_space(parts: Parts, look: int) -> SeenColumns:
    """Return objects in space of the message number `look`, as `handler_of` adds them."""
    size, score = parts.numbers["bbox/size"], parts.numbers["results/hypothesis/score"][:, 0]
    sized, count = np.all(size > 0.0, axis=1), len(size)
    spread = parts.numbers["results/pose/covariance"].reshape(-1, 6, 6)[:, :3, :3]
    said = ~sized & (np.trace(spread, axis1=1, axis2=2) > 0.0)
    return SeenColumns(
        np.full(count, look, dtype=np.int64),
        [one or None for one in parts.texts["id"]],
        parts.texts["results/hypothesis/class_id"],
        score,
        np.where(sized[:, None], parts.numbers["bbox/center"], parts.numbers["results/pose/pose"]),
        np.where(said[:, None, None], spread, np.nan),
        np.full((count, 4, 2), np.nan),
        np.where(sized[:, None], size, np.nan),
        np.full((count, 2), np.nan),
    )


def _score(result: Any) -> float:
    return float(getattr(result, "hypothesis", result).score)


def _drawn(message: Any, look: int) -> Iterator[Seen]:
    for one in getattr(message, "markers", ()):
        if not hasattr(one, "action"):  # of aruco_msgs: a detection, not a picture of one
            yield Seen(look, int(one.id), pose=pose_of(_inner(one.pose)))
        elif one.action == 0:  # added or changed
            name = int(one.id) if not one.ns else f"{one.ns}/{one.id}"
            yield Seen(look, name, label=str(one.ns), pose=pose_of(one.pose))
    for one in getattr(message, "entities", ()):
        shapes = [*one.cubes, *one.spheres, *one.cylinders, *one.models]
        if shapes:
            yield Seen(look, str(one.id), pose=pose_of(shapes[0].pose))


_DETECTIONS: dict[str, Callable[[Any, int], Iterator[Seen]]] = {
    "AprilTagDetectionArray": _tags,
    "ApriltagArrayStamped": _tags,
    "TagDetectionArray": _tags,
    "ArucoMarkers": _markers,
    "ArucoDetection": _markers,
    "FiducialTransformArray": _markers,
    "AlvarMarkers": _markers,
    "LandmarkList": _markers,
    "Detection3DArray": _objects,
    "Detection2DArray": _objects,
    "MarkerArray": _drawn,
    "SceneUpdate": _drawn,
}
KINDS = (*POSES, *TWISTS, *_DETECTIONS, "CameraInfo", *FRAMES)
"""All types of messages that are read, without their packages."""
