"""Bags of ROS 1 and ROS 2 (SQLite, MCAP), read by the package `rosbags` (extra `ros`), and TagSLAM's messages."""

from __future__ import annotations

import bz2
import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from evermap.errors import InputError, MissingExtraError
from evermap.io.text import reason
from evermap.types import Clock, FloatArray, IntArray, SpatialOdometry

Handler: TypeAlias = Callable[[Any, float], None]
BAG_ENDINGS = (".bag", ".bag.bz2", ".mcap", ".db3")
METADATA = "metadata.yaml"
"""Metadata file of a folder that is a ROS 2 bag."""
MOST_HAMMING = 2
"""Tags with more corrected bits are dropped: most of them are false detections."""


class Topic(NamedTuple):
    """Type of a topic's messages, such as 'nav_msgs/msg/Odometry', how many, and the encoding if it is not of ROS."""

    kind: str
    messages: int
    encoding: str = ""

    @property
    def text(self) -> str:
        """The type, with the encoding if it is not of ROS."""
        return f"{self.kind} ({self.encoding})".strip() if self.encoding else self.kind


class TagSightings(NamedTuple):
    """What cameras saw, as tables or bags have it.

    Attributes:
        looked_s: (K,) stamps of images, also of those without a tag.
        stamp_s: (M,) of the image in which a tag was seen.
        camera: (M,) number of the camera.
        tag_id: (M,) as decoded.
        hamming: (M,) bits that were corrected.
        corner_px: (M, 4, 2) counter-clockwise from the tag's lower left.
        line: (M,) in the file.
        complete: whether images without a tag are listed.
    """

    looked_s: FloatArray
    stamp_s: FloatArray
    camera: IntArray
    tag_id: IntArray
    hamming: IntArray
    corner_px: FloatArray
    line: IntArray
    complete: bool = True


def read_tag_bag(
    path: Path, tag_topics: Sequence[str], odometry_topic: str
) -> tuple[TagSightings, SpatialOdometry | None]:
    """Return what a bag's messages of tags hold, and its odometry.

    Args:
        path: a `.bag`, or one packed as `.bag.bz2`.
        tag_topics: of arrays of tags (`header`, and `apriltags` or `detections` with `id`, `hamming` and four
            `corners`), one a camera, in the order of the cameras.
        odometry_topic: of `nav_msgs/Odometry`.

    Returns:
        One look a message, with the stamp of its header; odometry None where the topic is not in the bag.

    Raises:
        InputError: the bag is missing, damaged, or has none of the topics.
        MissingExtraError: `rosbags` is not installed.
    """
    looks: list[tuple[float, int]] = []
    tags: list[tuple[float, ...]] = []
    odometry: list[tuple[float, ...]] = []
    camera_of = {topic: camera for camera, topic in enumerate(tag_topics) if topic}

    def driven(message: Any, _: float) -> None:
        variance = np.diagonal(message.pose.covariance.reshape(6, 6))
        odometry.append((stamp_of(message), *pose_of(message.pose.pose), *variance))

    def seen_by(camera: int) -> Handler:
        def handle(message: Any, _: float) -> None:
            looks.append((stamp_of(message), camera))
            tags.extend((stamp_of(message), camera, *tag) for tag in _tags(message))

        return handle

    def handlers(topics: Mapping[str, Topic]) -> dict[str, Handler]:
        if not topics.keys() & camera_of.keys():
            wanted, found = ", ".join(camera_of), ", ".join(sorted(topics))
            raise InputError(f"contains none of the topics {wanted}", path=path, hint=f"tagtopic: one of {found}")
        return {odometry_topic: driven} | {topic: seen_by(camera) for topic, camera in camera_of.items()}

    scan(path, handlers)
    rows = np.array(tags, dtype=np.float64).reshape(-1, 12)
    whole = rows[:, 1:4].astype(np.int64)
    seen = TagSightings(
        looked_s=np.array([stamp for stamp, _ in looks]),
        stamp_s=np.ascontiguousarray(rows[:, 0]),
        camera=np.ascontiguousarray(whole[:, 0]),
        tag_id=np.ascontiguousarray(whole[:, 1]),
        hamming=np.ascontiguousarray(whole[:, 2]),
        corner_px=rows[:, 4:].reshape(-1, 4, 2),
        line=np.zeros(len(rows), dtype=np.int64),
    )
    return seen, _odometry(odometry)


def topics_of(path: Path) -> dict[str, Topic]:
    """Return the topics of a bag, without its messages; raises what `scan` does."""
    return scan(path, lambda _: {})


def scan(path: Path, handlers: Callable[[Mapping[str, Topic]], Mapping[str, Handler]]) -> dict[str, Topic]:
    """Hand the messages of some topics of a bag, in the order in which they were recorded, to what handles them.

    Args:
        path: `.bag` or `.bag.bz2` of ROS 1; of ROS 2 a folder with `metadata.yaml`, a `.mcap` or a `.db3`.
        handlers: from all topics of the bag to a function for each topic that is wanted; it gets the message and the
            time at which it was recorded [s].

    Returns:
        All topics by name.

    Raises:
        InputError: the bag is missing or damaged, has no topic of ROS, or a message is not what its type says.
        MissingExtraError: `rosbags` or `mcap` is not installed.
    """
    try:
        import rosbags.highlevel  # noqa: F401 (asked here: an error below is one of the bag)
    except ImportError:
        raise MissingExtraError("bags need the package rosbags", path=path, hint="pip install evermap[ros]") from None
    try:
        with tempfile.TemporaryDirectory() as folder, _open_bag(_unpack(path, Path(folder))) as bag:
            foreign: dict[str, Topic] = getattr(bag, "foreign", {})
            if foreign and not bag.connections:
                encodings = ", ".join(sorted({one.encoding for one in foreign.values()}))
                hint = "record topics of ROS, such as by ros2 bag record -s mcap"
                raise InputError(f"has messages in {encodings} only", path=path, hint=hint)
            topics = foreign | {name: Topic(str(one.msgtype), one.msgcount) for name, one in bag.topics.items()}
            wanted = handlers(topics)
            held = [one for one in bag.connections if one.topic in wanted]
            for one, received_ns, raw in bag.messages(connections=held) if held else ():
                try:
                    message = bag.deserialize(raw, one.msgtype)
                except KeyError as error:
                    problem = f"contains no definition of the messages of {one.topic}, {one.msgtype}"
                    hint = "record it as MCAP, which contains the message definitions"
                    raise InputError(problem, path=path, hint=hint) from error
                wanted[one.topic](message, 1e-9 * received_ns)
    except (InputError, MissingExtraError):
        raise
    except Exception as error:  # the package has no error that all of its errors are
        hint = "check it with ros2 bag info, or rosbag check"
        raise InputError(f"cannot be read as a bag: {reason(error)}", path=path, hint=hint) from error
    return topics


@functools.cache
def ros2_types() -> Any:
    """Return the message types of ROS 2 and those of `UNSTATED`, as `rosbags` has them; the same object every time.

    Raises:
        MissingExtraError: `rosbags` is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        problem = "ROS messages need the package rosbags, which is not installed"
        raise MissingExtraError(problem, hint="pip install 'evermap[ros]'") from None
    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in UNSTATED.items():
        types.register(get_types_from_msg(text, name))
    return types


@contextmanager
def _open_bag(path: Path) -> Iterator[Any]:
    """The reader of a bag; that of `rosbags` fails at MCAP files with other messages than those of ROS 2."""
    from rosbags.highlevel import AnyReader, AnyReaderError

    bag: Any = AnyReader([path], default_typestore=ros2_types())
    try:
        bag.open()
    except (AnyReaderError, KeyError, UnicodeDecodeError) as error:
        damaged = isinstance(error, AnyReaderError) and "Profile" not in str(error)
        if damaged or path.suffix != ".mcap":
            raise
        bag = _Mixed(path)
    with closing(bag):
        yield bag


class _Channel(NamedTuple):
    topic: str
    msgtype: str
    msgcount: int


_OF_ROS = {"ros1msg": "ros1", "ros2msg": "cdr", "ros2idl": "cdr", "omgidl": "cdr"}
"""Encodings of messages by those of their schemas."""


class _Mixed:
    """Channels of ROS in an MCAP file of any profile, with what `scan` needs of `rosbags.highlevel.AnyReader`.

    Attributes:
        topics: by name, those of ROS only.
        connections: their channels.
        foreign: topics in other encodings.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.reader import make_reader
        except ImportError:
            problem = "MCAP files with other messages than those of ROS 2 need the package mcap"
            raise MissingExtraError(problem, path=path, hint="pip install 'evermap[ros]'") from None
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        counts = Counter[int]()
        with path.open("rb") as file:
            about = make_reader(file).get_summary()
            if about is None or about.statistics is None:  # the recorder was killed before it wrote them
                channels = {}
                for schema, one, _ in make_reader(file).iter_messages(log_time_order=False):
                    channels[one.id] = (schema, one)
                    counts[one.id] += 1
            else:
                channels = {key: (about.schemas.get(one.schema_id), one) for key, one in about.channels.items()}
                counts.update(about.statistics.channel_message_counts)
        self._path, self._types = path, get_typestore(Stores.EMPTY)
        self._channels: dict[int, _Channel] = {}
        self._of_ros1: set[str] = set()
        self.foreign: dict[str, Topic] = {}
        types: dict[str, Any] = {}
        for key, (schema, one) in channels.items():
            kind, encoding = (schema.name, schema.encoding) if schema else ("", "")
            if schema is None or _OF_ROS.get(encoding) != one.message_encoding:
                self.foreign[one.topic] = Topic(kind, counts[key], one.message_encoding or encoding or "no encoding")
                continue
            kind, text = kind if "/msg/" in kind else kind.replace("/", "/msg/"), schema.data.decode()
            if encoding.endswith("msg"):
                types |= get_types_from_msg(text, kind)
            else:  # of each type, where it is of ROS, a line with its name comes first
                parts = [part for part in text.split("=" * 80 + "\n") if part.strip()]
                bare = [part.partition("\n")[2] if part.startswith("IDL: ") else part for part in parts]
                types.update(one for part in bare for one in get_types_from_idl(part).items())
            self._channels[key] = _Channel(one.topic, kind, counts[key])
            self._of_ros1 |= {kind} if encoding == "ros1msg" else set()
        self._types.register(types)
        self.connections = list(self._channels.values())
        self.topics = {one.topic: one for one in self.connections}

    def messages(self, connections: list[_Channel]) -> Iterator[tuple[_Channel, int, bytes]]:
        from mcap.reader import make_reader

        with self._path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(topics=[one.topic for one in connections]):
                if channel.id in self._channels:
                    yield self._channels[channel.id], message.log_time, message.data

    def deserialize(self, raw: bytes, kind: str) -> Any:
        types = self._types
        return types.deserialize_ros1(raw, kind) if kind in self._of_ros1 else types.deserialize_cdr(raw, kind)

    def close(self) -> None:
        """Leave it: no file is open but while messages are read."""


def seconds(stamp: Any) -> float:
    """Return a time of ROS in seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def stamp_of(message: Any) -> float:
    """Return the stamp [s] in the header of a message."""
    return seconds(message.header.stamp)


def _unpack(path: Path, folder: Path) -> Path:
    """The bag itself, in `folder` where it was packed: the package reads from files only."""
    if path.suffix != ".bz2":
        return path
    plain = folder / path.stem
    plain.write_bytes(bz2.decompress(path.read_bytes()))
    return plain


def _tags(message: Any) -> list[tuple[float, ...]]:
    """Id, wrong bits, and u, v of four corners of each tag."""
    found = message.apriltags if hasattr(message, "apriltags") else message.detections
    return [(float(tag.id), float(tag.hamming), *corners_of(tag)) for tag in found]


def corners_of(tag: Any) -> tuple[float, ...]:
    """Return u, v of the four corners of a tag."""
    return tuple(value for corner in tag.corners for value in (corner.x, corner.y))


def pose_of(message: Any) -> tuple[float, ...]:
    """Return x, y, z, qx, qy, qz, qw of a pose or of a transform."""
    at = message.position if hasattr(message, "position") else message.translation
    turn = message.orientation if hasattr(message, "orientation") else message.rotation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def _odometry(rows: list[tuple[float, ...]]) -> SpatialOdometry | None:
    if not rows:
        return None
    values = np.array(rows)
    _, keep = np.unique(values[:, 0], return_index=True)
    columns = values[keep]
    return SpatialOdometry(columns[:, 0].copy(), columns[:, 1:8].copy(), columns[:, 8:].copy(), clock=Clock.UNIX)


_DRAWN = "geometry_msgs/Pose pose\n{}foxglove_msgs/Color color"
_FOXGLOVE = {
    "Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
    "KeyValuePair": "string key\nstring value",
    "ArrowPrimitive": _DRAWN.format(
        "float64 shaft_length\nfloat64 shaft_diameter\nfloat64 head_length\nfloat64 head_diameter\n"
    ),
    "CubePrimitive": _DRAWN.format("geometry_msgs/Vector3 size\n"),
    "SpherePrimitive": _DRAWN.format("geometry_msgs/Vector3 size\n"),
    "CylinderPrimitive": _DRAWN.format("geometry_msgs/Vector3 size\nfloat64 bottom_scale\nfloat64 top_scale\n"),
    "LinePrimitive": (
        "uint8 type\ngeometry_msgs/Pose pose\nfloat64 thickness\nbool scale_invariant\ngeometry_msgs/Point[] points\n"
        "foxglove_msgs/Color color\nfoxglove_msgs/Color[] colors\nuint32[] indices"
    ),
    "TriangleListPrimitive": _DRAWN.format("geometry_msgs/Point[] points\n")
    + "\nfoxglove_msgs/Color[] colors\nuint32[] indices",
    "TextPrimitive": _DRAWN.format("bool billboard\nfloat64 font_size\nbool scale_invariant\n") + "\nstring text",
    "ModelPrimitive": _DRAWN.format("geometry_msgs/Vector3 scale\n")
    + "\nbool override_color\nstring url\nstring media_type\nuint8[] data",
    "SceneEntityDeletion": "builtin_interfaces/Time timestamp\nuint8 type\nstring id",
    "SceneEntity": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\nbuiltin_interfaces/Duration lifetime\n"
        "bool frame_locked\nfoxglove_msgs/KeyValuePair[] metadata\nfoxglove_msgs/ArrowPrimitive[] arrows\n"
        "foxglove_msgs/CubePrimitive[] cubes\nfoxglove_msgs/SpherePrimitive[] spheres\n"
        "foxglove_msgs/CylinderPrimitive[] cylinders\nfoxglove_msgs/LinePrimitive[] lines\n"
        "foxglove_msgs/TriangleListPrimitive[] triangles\nfoxglove_msgs/TextPrimitive[] texts\n"
        "foxglove_msgs/ModelPrimitive[] models"
    ),
    "SceneUpdate": "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities",
}
UNSTATED = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography"
    ),
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections"
    ),
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    **{
        f"vision_msgs/msg/Detection{size}": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            f"vision_msgs/BoundingBox{size} bbox\nstring id"
        )
        for size in ("2D", "3D")
    },
    **{f"foxglove_msgs/msg/{name}": text for name, text in _FOXGLOVE.items()},
    **{
        f"vision_msgs/msg/Detection{size}Array": f"std_msgs/Header header\nvision_msgs/Detection{size}[] detections"
        for size in ("2D", "3D")
    },
}
"""Message definitions that SQLite bags lack: apriltag_msgs 2, vision_msgs 4, foxglove_msgs."""
