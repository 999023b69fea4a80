"""Bags of ROS 1 and ROS 2 as recordings in space: topics, mounts and detections.

What a topic holds follows from the type of its messages, the sensors' mounts from the tree of frames, the cameras from
their `CameraInfo`. What is guessed can be written to a file beside the bag (`bag_settings`), edited there, and is read
with the bag from then on. ROS need not be installed.


- Odometry and truth: `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `TransformStamped`, `TwistStamped`, and those
  with covariance.
- Tags: `AprilTagDetectionArray` of several packages, `ArucoMarkers`, `ArucoDetection`, `FiducialTransformArray`.
- Objects: `vision_msgs/Detection3DArray`, `Detection2DArray`; else `visualization_msgs/MarkerArray`,
  `foxglove_msgs/SceneUpdate` in a frame of the robot.
- Other measurements: messages that a kind of `estimate.measurements` names, such as `sensor_msgs/NavSatFix` and `Imu`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os.path import commonprefix
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import DataError, InputError, suggestion
from evermap.estimate.kind import Messages, TableRows
from evermap.estimate.measurements import find_kinds
from evermap.geometry import se3
from evermap.io.assemble import finish_recording, looks_of
from evermap.io.bag_messages import POSES, TRANSFORMS, TWISTS, BagContent, SeenColumns, scan_bag
from evermap.io.files import FileSet, Reader, find_file_set
from evermap.io.rig_toml import Rig, cameras
from evermap.io.rosbag import BAG_ENDINGS, METADATA
from evermap.io.sensor_toml import Settings, TomlReader, toml_text
from evermap.io.spatial import directions, integrated, of_rig, spatial_detections, unit, with_tag_poses
from evermap.io.text import counted
from evermap.types import (
    UNKNOWN,
    Clock,
    FloatArray,
    Frames,
    IntArray,
    Measurements,
    Recording,
    SpatialDetections,
    SpatialOdometry,
    SpatialRecording,
    SpatialSensor,
    Trajectory,
    landmark_id_of,
)
from evermap.valid import CAMERA_MODELS, SINCE_1970_S, is_covariance

FEWEST_LOOKS = 20
"""Messages above which a detector without any empty one is assumed to publish only detections."""
MOST_DIGITS = 15
"""Of a text that is a number; larger ones are not exact in float64."""
LATE_S = 0.5
"""Difference between the delays of two topics from stamp to arrival that indicates different clocks."""
_NATIVE = ("odometry", "detections")
"""Tables that make a folder a recording of its own, whatever bag it was made from."""
_TRUTH = re.compile(r"(^|[/_])(gt|truth|ground_?truth|mocap|vicon|vrpn|optitrack|qualisys)([/_]|$)")
_NO_ODOMETRY = re.compile(r"amcl|goal|initialpose|target|plan|cmd|map_|landmark")
_PICTURES = ("MarkerArray", "SceneUpdate")
"""Visualisation messages: read only without other detections."""
_MODELS = {"plumb_bob": "radtan", "radtan": "radtan", "equidistant": "equidistant", "": "pinhole"}


@dataclass(frozen=True, slots=True)
class BagSensor:
    """Settings of one topic of detections.

    Attributes:
        topic: of the detections.
        frame: name of the frame in which they are.
        camera_info: topic of the camera's calibration; '' where there is none.
        rectified: whether pixels are those of the image without distortion.
        identity: what tells a landmark from others: its 'id', its 'class', or 'none'.
        stated: as the settings file says; None for what is guessed.
        stated_mount: whether that says where the sensor is.
    """

    topic: str
    frame: str = ""
    camera_info: str = ""
    rectified: bool = False
    identity: str = "id"
    stated: SpatialSensor | None = None
    stated_mount: bool = False


@dataclass(frozen=True, slots=True)
class BagSettings:
    """Settings of a bag.

    Attributes:
        odometry, truth: topics; '' for none.
        base_frame: name of the robot's frame, which the odometry moves.
        clock: 'header', the stamps of messages, or 'receive', when they were recorded.
        sensors: whose detections are read, by name.
        measurements: topics by the names of kinds of measurements; '' where none is read.
        rig: what is stated of the tags' sizes, and how objects look the same.
    """

    odometry: str = ""
    truth: str = ""
    base_frame: str = ""
    clock: str = "header"
    sensors: Mapping[str, BagSensor] = field(default_factory=dict)
    measurements: Mapping[str, str] = field(default_factory=dict)
    rig: Rig = field(default_factory=Rig)


def settings_path(path: str | Path) -> Path:
    """Return where the settings of a bag are: beside it, with '.toml' behind its name."""
    path = _bag_at(Path(path))
    return path.with_name(path.resolve().name + ".toml")


def _is_bag(files: FileSet) -> bool:
    """Return whether a folder is a bag of ROS 2, by its metadata, or holds one bag and no tables of a recording."""
    if files.zipped:
        return False
    if METADATA in files and b"rosbag2_bagfile_information" in files.read(METADATA):
        return True
    return len(_bags_in(files)) == 1 and not any(name.split(".")[0] in _NATIVE for name in files.members)


def _bags_in(files: FileSet) -> list[str]:
    return [name for name in files.members if name.endswith(BAG_ENDINGS)]


def _bag_at(path: Path) -> Path:
    """Return the bag that a path means: a file, a folder with metadata, or the only bag in a folder."""
    files = find_file_set(path, _is_bag) if path.is_dir() else None
    if files is None:
        return path
    whole = METADATA in files and b"rosbag2_bagfile_information" in files.read(METADATA)
    return files.root / files.folder if whole else files.path_of(_bags_in(files)[0])


def read_bag(path: str | Path, robot: int | None = None, topics: str | Path | None = None) -> SpatialRecording:
    """Return the recording in a bag, by its settings file if there is one, else by guessed topics.

    Args:
        path: `.bag` or `.bag.bz2` of ROS 1; of ROS 2 a folder with `metadata.yaml`, a `.mcap` or a `.db3`.
        robot: must be None.
        topics: its settings file; None for the one beside it.

    Raises:
        InputError: the bag or its settings are missing or damaged, or a topic in the settings is not in the bag.
        DataError: nothing was detected, or the size of tags or the calibration of a camera is not known.
        MissingExtraError: `rosbags` is not installed.
    """
    path = Path(path)
    if robot is not None:
        raise InputError(f"there is no robot {robot}: a bag has one robot", path=path, hint="omit the robot")
    content, stated = scan_bag(_bag_at(path)), settings_path(path) if topics is None else Path(topics)
    settings = guess_settings(content)
    if topics is None and not stated.is_file():
        return _recording(path, content, settings, guessed=True)
    return _recording(path, content, read_settings(stated, content, settings), guessed=False)


def bag_settings(path: str | Path) -> str:
    """Return the guessed settings of a bag, as the text of its settings file.

    Raises:
        InputError: the bag is missing or damaged.
        MissingExtraError: `rosbags` is not installed.
    """
    content = scan_bag(_bag_at(Path(path)))
    settings = guess_settings(content)
    sections: dict[str, dict[str, Any]] = {"bag": {key: getattr(settings, key) for key in _TEXTS}}
    for name, one in settings.sensors.items():
        given: dict[str, Any] = {key: getattr(one, key) for key in _OF_SENSOR}
        sections[f"camera.{name}"] = given if one.camera_info else given | {"rectified": None}
    if settings.measurements:
        sections["measurements"] = dict(settings.measurements)
    listed = "\n".join(f"#   {name}  {one.text}  {one.messages}" for name, one in sorted(content.topics.items()))
    return f"{_HEAD}{toml_text(sections)}\n# All topics, with the type and number of their messages:\n{listed}\n"


_TEXTS = ("odometry", "truth", "base_frame", "clock")
_OF_SENSOR = {"topic": str, "frame": str, "camera_info": str, "identity": str, "rectified": bool}
_HEAD = """\
# What evermap reads from this bag, guessed from the message types. Edit it; it is read with the bag.
# clock = "receive": recording times of the messages instead of their own stamps.
# identity = "id", "class" or "none": the field that identifies a landmark.
# A section [camera.NAME] takes all keys of a camera.toml, too, which override the bag:
#   intrinsics = [fx, fy, cx, cy], model, distortion; [camera.NAME.mount] with x_m, y_m, z_m, roll_rad, ...
# [measurements]: topics of further kinds of measurements, such as gnss = "/fix"; "" for none.
# Tags need a size if the messages contain only their corners:
# [tags]
# size_m = 0.16

"""


def guess_settings(content: BagContent) -> BagSettings:
    """Return what topics seem to be, by their types and names."""

    def rank(topic: str) -> tuple[bool, int, bool, int]:
        kind = (*POSES, *TWISTS).index(content.kind(topic))
        transform = kind == POSES.index("TransformStamped")
        return transform, kind > 0, "odom" not in topic and "vio" not in topic, -len(content.motion[topic])

    moving = [topic for topic in content.motion if content.motion[topic] and content.has_moving(topic)]
    true = sorted((one for one in moving if _TRUTH.search(one) and content.kind(one) in POSES), key=rank)
    driven = sorted((one for one in moving if not _TRUTH.search(one) and not _NO_ODOMETRY.search(one)), key=rank)
    odometry = driven[0] if driven else ""
    sighted = [topic for topic in content.seen if content.seen[topic] and content.has_moving(topic)]
    named = {name for edge in content.edges for name in edge}
    usual = next((name for name in ("base_link", "base_footprint") if name in named), "")
    base = content.frames.get(odometry, "") or usual
    transforms = [topic for topic in sighted if topic.startswith(TRANSFORMS)]  # of tags: only without messages of them
    sighted = [topic for topic in sighted if topic not in transforms]
    plain = [topic for topic in sighted if content.kind(topic) not in _PICTURES] or transforms
    base = base or next((content.frames.get(topic, "") for topic in plain), "")
    chosen = plain or [one for one in sighted if content.mount(base, content.frames.get(one, "")) is not None]
    sensors = {name: _sensor(content, topic) for topic, name in _short(chosen).items()}
    return BagSettings(odometry, true[0] if true else "", base, "header", sensors, _measuring(content))


def _measuring(content: BagContent) -> dict[str, str]:
    """Topics by kinds of measurements: the only sensor's, '' where several sensors measure the same.

    Topics of one frame are one sensor's, raw and filtered: the one with most messages is read.
    """
    found = {}
    for name, kind in find_kinds().items():
        derived = kind.messages.derived if kind.messages is not None else ()
        some = [topic for of, topic in content.measured if of == name and content.measured[of, topic]]
        some = [topic for topic in some if not any(word in topic.lower() for word in derived)]
        if some:
            one = min(some, key=lambda topic: (-len(content.measured[name, topic]), topic))
            found[name] = one if len({content.frames.get(topic, "") for topic in some}) == 1 else ""
    return found


def _short(topics: list[str]) -> dict[str, str]:
    """Names of sensors after their topics: the first part, where these differ, else all of it."""
    parts = {topic: topic.strip("/").split("/") for topic in topics}
    first = {topic: part[0] for topic, part in parts.items()}
    used = first if len(set(first.values())) == len(topics) else {one: "_".join(part) for one, part in parts.items()}
    return {topic: re.sub(r"[^A-Za-z0-9_-]", "_", name) or "sensor" for topic, name in used.items()}


def _sensor(content: BagContent, topic: str) -> BagSensor:
    seen, frame = content.seen[topic], content.frames.get(topic, "")
    pixels = any(np.isfinite(one.corners[0]) or np.isfinite(one.pixel[0]) for one in seen)
    same = [one for one in content.cameras if content.frames[one] == frame]
    alike = {one: len(commonprefix([one, topic])) for one in same or content.cameras}  # noqa: RUF071  'cam_left/...'
    camera = max(alike, key=lambda one: alike[one], default="")
    identity = "id"
    if content.kind(topic) in ("Detection3DArray", "Detection2DArray"):
        boxed = any(np.isfinite(one.size[0]) for one in seen)
        identity = "none" if boxed else "id" if any(one.identity is not None for one in seen) else "class"
    # the node apriltag_ros works on rectified images; TagSLAM's detector on the others
    rectified = content.kind(topic) == "AprilTagDetectionArray" or "rect" in topic
    return BagSensor(topic, frame, camera if pixels else "", rectified and pixels, identity)


def read_settings(path: Path, content: BagContent, guessed: BagSettings, *, whole: bool = True) -> BagSettings:
    """Return the settings in a file; what is missing is as guessed.

    `whole`: topics that the content lacks are errors; else they may come yet.

    Raises:
        InputError: the file is missing or wrong, or names a topic that is not there.
    """
    try:
        reader = TomlReader(path.read_bytes(), path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path, hint="evermap init bag BAG") from None
    reader.expect(("bag", "camera", "measurements", "tags"), reader.document, section=None)
    given, measured = reader.section("bag", _TEXTS), reader.section("measurements", tuple(find_kinds()))
    for section, values in {"bag": given, "measurements": measured}.items():
        for key, value in values.items():
            if not isinstance(value, str):
                raise reader.error(section, key, f"must be a text, not {type(value).__name__}")
    if given.get("clock", "header") not in ("header", "receive"):
        raise reader.error("bag", "clock", f"unknown clock '{given['clock']}'", hint='"header" or "receive"')
    for key in ("odometry", "truth"):
        if given.get(key) and whole:
            _check_topic(reader, "bag", key, given[key], content.motion, "poses or velocities")
    for kind, topic in measured.items():
        if topic and whole:
            of_kind = {one: rows for (name, one), rows in content.measured.items() if name == kind}
            _check_topic(reader, "measurements", kind, topic, of_kind, kind)
    settings = replace(guessed, **given, measurements={**guessed.measurements, **measured})
    if "camera" not in reader.document:
        return settings
    rig = cameras(reader, Settings(), SpatialSensor(), tuple(_OF_SENSOR))
    as_guessed = {one.topic: one for one in guessed.sensors.values()}
    sensors = {one.name: _parse_sensor(reader, one, content if whole else None, as_guessed) for one in rig.sensors}
    return replace(settings, sensors=sensors, rig=rig)


def _parse_sensor(
    reader: TomlReader, stated: SpatialSensor, content: BagContent | None, guessed: Mapping[str, BagSensor]
) -> BagSensor:
    section, given = f"camera.{stated.name}", reader.document["camera"][stated.name]
    for key, kind in _OF_SENSOR.items():
        if key in given and not isinstance(given[key], kind):
            wanted = "a text" if kind is str else "true or false"
            raise reader.error(section, key, f"must be {wanted}, not {type(given[key]).__name__}")
    topic = given.get("topic", "")
    if content is not None:
        _check_topic(reader, section, "topic", topic, content.seen, "detections")
        if given.get("camera_info"):
            _check_topic(reader, section, "camera_info", given["camera_info"], content.cameras, "calibration")
    if given.get("identity", "id") not in ("id", "class", "none"):
        raise reader.error(section, "identity", f"no identity '{given['identity']}'", hint='"id", "class" or "none"')
    sensor = guessed.get(topic) or (BagSensor(topic) if content is None else _sensor(content, topic))
    own = {key: given[key] for key in _OF_SENSOR if key in given}
    return replace(sensor, **own, stated=stated, stated_mount="mount" in given)


def _check_topic(reader: TomlReader, section: str, key: str, topic: str, held: Mapping[str, Any], what: str) -> None:
    known = sorted(one for one, messages in held.items() if messages)
    if topic not in known:
        hint = suggestion(topic, known) or (f"one of {', '.join(known)}" if known else f"the bag has no {what}")
        raise reader.error(section, key, f"no topic with {what}: '{topic}'", hint)


def _recording(path: Path, content: BagContent, settings: BagSettings, *, guessed: bool) -> SpatialRecording:
    passed_over = content.passed_over()
    if not settings.sensors:
        kinds = ", ".join(sorted({one.kind for one in content.topics.values() if not one.encoding})) or "no topics"
        kinds += f"; {passed_over}" if passed_over else ""
        hint = "detections of apriltag_msgs, vision_msgs, aruco or fiducial_msgs, or markers in a frame of the robot"
        raise InputError(f"contains no detections of landmarks; it contains {kinds}", path=path, hint=hint)
    warnings = [passed_over] if passed_over else []
    if guessed:
        read = ", ".join(one.topic for one in settings.sensors.values())
        moved = f"odometry {settings.odometry}" if settings.odometry else "no odometry"
        more = "".join(f"; {kind} {topic}" for kind, topic in settings.measurements.items() if topic)
        warnings.append(
            f"topics as guessed: detections {read}; {moved}{more} (`evermap init bag` writes them for editing)"
        )
        for kind in (kind for kind, topic in settings.measurements.items() if not topic):
            some = ", ".join(topic for name, topic in content.measured if name == kind)
            warnings.append(f"{kind} of several sensors not read: {some} (`evermap init bag`, then [measurements])")
    sensors = tuple(mount_sensor(path, content, settings, name, warnings) for name in settings.sensors)
    _tell_late(content, settings, warnings)
    stamps = [stamps_of(content, one.topic, settings.clock) for one in settings.sensors.values()]
    messages = sum(len({one.look for one in content.seen[sensor.topic]}) for sensor in settings.sensors.values())
    names: dict[int, str] = {}
    rows = [(k, one) for k, sensor in enumerate(settings.sensors.values()) for one in content.seen[sensor.topic]]
    of, seen = np.array([k for k, _ in rows], dtype=np.int64), SeenColumns.of([one for _, one in rows])
    labels = tuple(sorted(set(seen.label) - {""}))
    stamp_s = np.array([stamps[k][one.look] for k, one in rows])
    looked, frame = looks_of(np.concatenate(stamps), stamp_s)
    clock = Clock.UNIX if looked[0] > SINCE_1970_S else Clock.RECORDING
    detections = detections_of(path, settings, sensors, (seen, of, frame, labels, names), warnings)
    finite = np.asarray(np.isfinite(detections.position_sensor_m).all(axis=1))
    if not finite.all():
        warnings.append(f"{counted(int((~finite).sum()), 'detection')} without a finite position left out")
    here = finite & (detections.position_sensor_m == 0.0).all(axis=1)
    if here.any():
        warnings.append(f"{counted(int(here.sum()), 'detection')} at the sensor's own place left out")
    finite &= ~here
    detections = detections[np.flatnonzero(finite)[np.argsort(detections.frame[finite], kind="stable")]]
    truth = _odometry(path, content, settings, settings.truth, clock, warnings)
    odometry = _odometry(path, content, settings, settings.odometry, clock, warnings)
    recording = Recording(
        name=path.resolve().name.split(".")[0],
        odometry=odometry,
        frames=Frames(looked, complete=messages < sum(map(len, stamps)) or messages < FEWEST_LOOKS, clock=clock),
        detections=detections,
        sensors=sensors,
        truth=None if truth is None else _exactly(truth),
        class_names=labels,
        source=str(path),
        clock=clock,
        landmark_names=names,
        measurements=_measurements(content, settings, odometry, warnings),
    )
    return finish_recording(recording, warnings=warnings)


def _measurements(
    content: BagContent, settings: BagSettings, odometry: SpatialOdometry | None, warnings: list[str]
) -> tuple[Measurements, ...]:
    """Return the measurements of the chosen topics, in the order of their stamps; `warnings` gets remarks on them."""
    found = []
    for name, topic in settings.measurements.items():
        kind, rows = find_kinds()[name], content.measured.get((name, topic), [])
        if kind.messages is None or not rows:
            continue
        stamp_s = stamps_of(content, topic, settings.clock)[[look for look, _ in rows]]
        order = np.argsort(stamp_s, kind="stable")
        values = np.array([numbers for _, numbers in rows], dtype=np.float64)[order]
        frame = content.frames.get(topic, "")
        mount = content.mount(settings.base_frame, frame) if frame else None
        if kind.messages.rows is None:
            made = TableRows(stamp_s[order], dict(zip(kind.columns, values.T.copy(), strict=True)))
        else:
            made = kind.messages.rows(Messages(stamp_s[order], values, mount, odometry))
        if made.remark:
            warnings.append(f"{name} of {topic}: {made.remark}")
        if len(made.stamp_s):
            nowhere = np.full(len(made.stamp_s), UNKNOWN)
            found.append(Measurements(name, made.stamp_s, kind.fill_in(made.columns, len(nowhere)), nowhere))
    return tuple(found)


def detections_of(
    path: Path,
    settings: BagSettings,
    sensors: tuple[SpatialSensor, ...],
    seen: tuple[SeenColumns, IntArray, IntArray, Sequence[str], dict[int, str]],
    warnings: list[str],
) -> SpatialDetections:
    """Return the detections of messages, with poses, corners and directions.

    Args:
        path: of the bag, for errors.
        settings: how its topics are read.
        sensors: of these topics.
        seen: M detections; (M,) numbers of their sensors; (M,) frames; classes, and names by ids, which get those that
            are texts.
        warnings: gets what is left out.

    Raises:
        DataError: the size of a tag, or the calibration of a camera, is not known.
    """
    ones, sensor, frame, labels, names = seen
    number = {label: row for row, label in enumerate(labels)} | {"": UNKNOWN}
    found = spatial_detections(
        frame,
        sensor=sensor,
        landmark_id=_identities(ones, sensor, settings, names),
        class_id=np.array([number[label] for label in ones.label], dtype=np.int64),
        score=ones.score,
        size_m=ones.size,
    )
    return with_tag_poses(_with_poses(path, found, ones, sensors, settings), sensors, warnings)


def stamps_of(content: BagContent, topic: str, clock: str) -> FloatArray:
    """Return stamps (K,) of a topic's messages; those without one have the time at which they were recorded."""
    header, received = np.array(content.stamps[topic]).reshape(-1, 2).T
    return np.where((header > 0.0) & (clock == "header"), header, received)


def _tell_late(content: BagContent, settings: BagSettings, warnings: list[str]) -> None:
    """Warn where stamps of two topics seem to be of different clocks."""
    late = {}
    measured = tuple(topic for topic in settings.measurements.values() if topic)
    for topic in (*(one.topic for one in settings.sensors.values()), settings.odometry, *measured):
        if settings.clock == "header" and topic in content.stamps:
            header, received = np.array(content.stamps[topic]).reshape(-1, 2).T
            late[topic] = float(np.median(np.where(header > 0.0, received - header, 0.0)))
    if late and max(late.values()) - min(late.values()) > LATE_S:
        slow, fast = max(late, key=lambda one: late[one]), min(late, key=lambda one: late[one])
        warnings.append(
            f"messages of {slow} were recorded {late[slow] - late[fast]:.3g} s later, relative to their stamps, than "
            f'those of {fast}: if their clocks differ, set clock = "receive" (`evermap init bag`)'
        )


def mount_sensor(
    path: Path, content: BagContent, settings: BagSettings, name: str, warnings: list[str]
) -> SpatialSensor:
    """Return a sensor with its mount and calibration, as stated, or as the bag has them.

    Raises:
        InputError: a camera model that is not known.
    """
    one = settings.sensors[name]
    sensor = SpatialSensor(name=name) if one.stated is None else one.stated
    if not one.stated_mount:
        mount = content.mount(settings.base_frame, one.frame)
        if mount is None:
            where = f"'{name}' is assumed at the robot's centre; state its mount (`evermap init bag`)"
            warnings.append(f"no fixed transform from '{settings.base_frame}' to '{one.frame}': {where}")
        sensor = replace(sensor, mount_robot_sensor=tuple((se3.identity() if mount is None else mount).tolist()))
    if sensor.intrinsics is not None or not one.camera_info:
        return sensor
    info = content.cameras[one.camera_info]
    k, d, p = (np.asarray(getattr(info, name, getattr(info, name.upper(), ())), dtype=np.float64) for name in "kdp")
    k, p = k.reshape(3, 3), p.reshape(3, 4)
    model, used = _MODELS.get(str(info.distortion_model)), np.trim_zeros(d, "b")
    if one.rectified and p[0, 0] > 0.0:
        k, used = p[:, :3], np.zeros(0)
    if not len(used):
        model = "pinhole"
    if model is None or len(used) > max(CAMERA_MODELS[model]) or not (k[0, 0] > 0.0 and k[1, 1] > 0.0):
        problem = f"{one.camera_info} has an unknown camera model: '{info.distortion_model}'"
        hint = "plumb_bob or equidistant; rectified = true; or state it (`evermap init bag`)"
        raise InputError(problem, path=path, hint=hint)
    count = next(n for n in CAMERA_MODELS[model] if n >= len(used))
    return replace(
        sensor,
        intrinsics=(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])),
        distortion=tuple(np.pad(used, (0, count - len(used))).tolist()),
        distortion_model=model,
        resolution_px=(int(info.width), int(info.height)) if info.width and info.height else None,
    )


def _identities(seen: SeenColumns, sensor: IntArray, settings: BagSettings, names: dict[int, str]) -> IntArray:
    """(M,) identities of detections, by what their sensor's settings say; `names` gets those that are texts. A text of
    digits is a number, as in tables: `vision_msgs` has no other way to say one.
    """
    kinds = [one.identity for one in settings.sensors.values()]
    identity = np.full(len(sensor), UNKNOWN)
    for row, (k, own, label) in enumerate(zip(sensor.tolist(), seen.identity, seen.label, strict=True)):
        said = own if kinds[k] == "id" else label or None if kinds[k] == "class" else None
        if isinstance(said, str) and not (said.isascii() and said.isdigit() and len(said) <= MOST_DIGITS):
            identity[row] = landmark_id_of(said)
            names[int(identity[row])] = said
        elif said is not None:
            identity[row] = int(said)
    return identity


def _with_poses(
    path: Path,
    found: SpatialDetections,
    seen: SeenColumns,
    sensors: tuple[SpatialSensor, ...],
    settings: BagSettings,
) -> SpatialDetections:
    """Return the detections with poses, corners and directions; raises what `detections_of` does."""
    pose, corner, pixel = seen.pose.copy(), seen.corners, seen.pixel
    cornered, aimed = np.isfinite(corner[:, 0, 0]), np.isfinite(pixel[:, 0])
    size = settings.rig.size_of(found.landmark_id)
    if (cornered & np.isnan(size)).all() and cornered.any():
        hint = f"`evermap init bag {path}`, then [tags] with size_m in {settings_path(path).name}"
        raise DataError("does not state the size of its tags", path=path, hint=hint)
    blind = np.array([one.intrinsics is None for one in sensors])[found.sensor] & (cornered | aimed)
    if blind.any():
        name = sensors[int(found.sensor[blind][0])].name
        hint = "record its CameraInfo, or state its intrinsics (`evermap init bag`)"
        raise DataError(f"contains no calibration of the camera '{name}'", path=path, hint=hint)
    unturned = np.isnan(pose).any(axis=1) | ~(np.linalg.norm(pose[:, 3:], axis=1) > 1e-6)
    pose[unturned, 3:] = np.nan
    position, covariance = pose[:, :3].copy(), found.covariance_sensor_m2.copy()
    told = np.flatnonzero(~np.isnan(seen.covariance[:, 0, 0]))
    if len(told):
        stated = told[is_covariance(seen.covariance[told])]
        covariance[stated] = seen.covariance[stated]
    rays, spread = directions(pixel, found.sensor, sensors)
    position[aimed], covariance[aimed] = rays[aimed], spread[aimed]
    return replace(
        found,
        position_sensor_m=position,
        rotation=unit(pose[:, 3:]),
        covariance_sensor_m2=covariance,
        corner_px=corner,
        tag_size_m=np.where(cornered, size, np.nan),
    )


def _exactly(path: SpatialOdometry) -> Trajectory:
    return Trajectory(path.stamp_s, path.pose_world_robot, np.zeros((len(path), 6, 6)), "truth", path.clock)


def _odometry(
    path: Path, content: BagContent, settings: BagSettings, topic: str, clock: Clock, warnings: list[str]
) -> SpatialOdometry | None:
    """Poses of the robot, in the order of their stamps; the last of those with the same. `warnings` counts bad ones."""
    if not topic:
        return None
    rows, stamp_s = np.array(content.motion[topic], dtype=np.float64), stamps_of(content, topic, settings.clock)
    late = int(np.sum(stamp_s < np.maximum.accumulate(stamp_s)))
    order = np.argsort(stamp_s, kind="stable")
    is_number = np.isfinite(rows[order, : 7 if content.kind(topic) in POSES else 6]).all(axis=1)
    order = order[is_number & np.isfinite(stamp_s[order])]
    bad = {"not a number": len(rows) - len(order)}
    if content.kind(topic) in POSES:  # the orientation of a robot is unknown if its message lacks it
        turned = np.linalg.norm(rows[order, 3:7], axis=1) > 0.5
        bad["without orientation"], order = int((~turned).sum()), order[turned]
    if not len(order):
        raise DataError(f"poses on {topic} have no orientation", path=path, hint="another topic (`evermap init bag`)")
    keep = order[np.append(np.diff(stamp_s[order]) > 0.0, True)]
    bad["with the stamp of the next"] = len(order) - len(keep)
    left_out = ", ".join(f"{count} {what}" for what, count in bad.items() if count)
    if left_out:
        warnings.append(f"{topic}: of {len(rows)} messages left out: {left_out}")
    if late:
        warnings.append(f"{topic}: {counted(late, 'message')} out of order sorted")
    stamp_s, rows = stamp_s[keep], rows[keep]
    child = content.frames.get(topic, "")
    z_up = "optical" not in child and "optical" not in settings.base_frame  # REP 103
    if content.kind(topic) in TWISTS:
        return replace(integrated(stamp_s, rows, clock), z_up=z_up)
    variance = np.where(rows[:, 7:] > 0.0, rows[:, 7:], np.nan)
    odometry = SpatialOdometry(stamp_s, se3.normalise_poses(rows[:, :7]), variance, clock=clock, z_up=z_up)
    mount = content.mount(settings.base_frame, child) if child else None
    return of_rig(odometry, se3.identity() if mount is None else mount)


BAG = Reader(
    "bag",
    "ROS 1 (.bag) or ROS 2 (folder, .mcap, .db3)",
    _is_bag,
    read_bag,
    endings=BAG_ENDINGS,
)
