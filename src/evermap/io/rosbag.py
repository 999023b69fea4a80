"""ROS 1 bags of tag detections and odometry, read by the package `rosbags` (extra `ros`)."""

from __future__ import annotations

import bz2
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evermap.errors import InputError, MissingExtraError
from evermap.io.text import reason
from evermap.types import Clock, FloatArray, IntArray, SpatialOdometry


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
    try:
        from rosbags.rosbag1 import Reader, ReaderError
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtraError("bags need the package rosbags", path=path, hint="pip install evermap[ros]") from None
    store = get_typestore(Stores.ROS1_NOETIC)
    looks: list[tuple[float, int]] = []
    tags: list[tuple[float, ...]] = []
    odometry: list[tuple[float, ...]] = []
    camera_of = {topic: camera for camera, topic in enumerate(tag_topics) if topic}
    try:
        with tempfile.TemporaryDirectory() as folder, Reader(_unpacked(path, Path(folder))) as bag:
            held = [one for one in bag.connections if one.topic in (*camera_of, odometry_topic)]
            if not any(one.topic in camera_of for one in held):
                wanted, found = ", ".join(camera_of), ", ".join(sorted(bag.topics))
                raise InputError(f"holds none of the topics {wanted}", path=path, hint=f"tagtopic: one of {found}")
            for one in held:
                store.register(get_types_from_msg(one.msgdef.data, one.msgtype))
            for one, _, raw in bag.messages(connections=held):
                message: Any = store.deserialize_ros1(raw, one.msgtype)
                stamp_s = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
                if one.topic == odometry_topic:
                    odometry.append((stamp_s, *_pose(message), *np.diagonal(message.pose.covariance.reshape(6, 6))))
                else:
                    looks.append((stamp_s, camera_of[one.topic]))
                    tags += [(stamp_s, camera_of[one.topic], *tag) for tag in _tags(message)]
    except (ReaderError, OSError, EOFError, ValueError, KeyError, AttributeError) as error:
        raise InputError(f"cannot be read: {reason(error)}", path=path, hint="a ROS 1 bag of tags") from error
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


def _unpacked(path: Path, folder: Path) -> Path:
    """The bag itself, in `folder` where it was packed: the package reads from files only."""
    if path.suffix != ".bz2":
        return path
    plain = folder / path.stem
    plain.write_bytes(bz2.decompress(path.read_bytes()))
    return plain


def _tags(message: Any) -> list[tuple[float, ...]]:
    """Id, wrong bits, and u, v of four corners of each tag."""
    found = message.apriltags if hasattr(message, "apriltags") else message.detections
    return [
        (float(tag.id), float(tag.hamming), *(value for corner in tag.corners for value in (corner.x, corner.y)))
        for tag in found
    ]


def _pose(message: Any) -> tuple[float, ...]:
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    return at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w


def _odometry(rows: list[tuple[float, ...]]) -> SpatialOdometry | None:
    if not rows:
        return None
    values = np.array(rows)
    _, keep = np.unique(values[:, 0], return_index=True)
    columns = values[keep]
    return SpatialOdometry(columns[:, 0].copy(), columns[:, 1:8].copy(), columns[:, 8:].copy(), clock=Clock.UNIX)
