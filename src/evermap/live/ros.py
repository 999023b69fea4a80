"""Conversion of ROS 2 messages to readings of an engine, and of its outputs to messages, without ROS.

What topics hold is guessed or stated as for a bag (`io.bag`). The engine drives in the plane, so what was seen is laid
on the floor under the robot.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from evermap.errors import EvermapError, InputError
from evermap.geometry import se2, se3
from evermap.io.bag import BagSettings, detections_of, guess_settings, mount_sensor, read_settings, stamps_of
from evermap.io.bag_messages import OBJECT_FIELDS, POSES, BagContent, SeenColumns, handler_of, objects_in_space
from evermap.io.cdr import parts_of
from evermap.io.rosbag import Topic, pose_of, ros2_types, seconds, stamp_of
from evermap.live.engine import Engine, Now
from evermap.live.feed import Reading, SensorLook, Velocity, in_time
from evermap.live.wires import OURS, Mailbox, Message, Wire
from evermap.runs.mcap import Ros, drawn, entity_id, in_space, nanoseconds, robot_messages, ros_covariance, told, where
from evermap.types import (
    ANY_RANGE_M2,
    UNKNOWN,
    AnyRecording,
    BoolArray,
    FloatArray,
    Landmarks,
    MapChange,
    Sensor,
    rows_of,
)

GUESS_S = 1.0
"""Time of receiving odometry and detections after which topics are guessed."""
MOST_KEPT = 2_000
"""Messages of a topic that are kept until the topics are chosen."""
TOLD_S = 0.1
"""Time between two messages that repeat a part of the map."""
PART = 20
"""Landmarks of such a part: late clients have the whole map after some of them; few delay no pose."""
SEEN_P = 0.02
"""Change of P(exists), or of the position [m], after which a landmark in view is published again."""
WAIT_S = 0.2
"""Maximum time between two checks for the end."""
REMEMBERED = 2_000
"""Poses of the odometry that are kept, to locate its origin in the map."""
TELLS = {
    f"{OURS}pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    f"{OURS}landmarks": "visualization_msgs/msg/MarkerArray",
    f"{OURS}scene": "foxglove_msgs/msg/SceneUpdate",
    f"{OURS}changes": "std_msgs/msg/String",
}
"""Topics of the engine, and their types."""
_POSE, _TF, _LANDMARKS, _SCENE, _CHANGES = TELLS
_NO_PATH = Path("live")


class Listener:
    """Readings of an engine, from messages as they come.

    Args:
        sensor: of the engine: it says where the sensor is on the robot, where no message does.
        stated: file that states what topics are; None to guess.
        say: called with a remark, once.

    Raises:
        InputError: the file is missing or wrong.
    """

    def __init__(self, sensor: Sensor, stated: Path | None, say: Callable[[str], None]) -> None:
        self._mount, self._say = np.array(sensor.mount_robot_sensor), say
        self._types, self._content = ros2_types(), BagContent()
        self._handlers: dict[str, Any] = {}
        self._sources: dict[str, object] = {}
        self._said: set[str] = set()
        self._first_s = math.inf
        self._driven: tuple[object, float, FloatArray] | None = None
        self._odometry: deque[tuple[float, FloatArray]] = deque(maxlen=REMEMBERED)
        self.settings: BagSettings | None = None
        """Chosen topics, once they are known."""
        if stated is not None:
            guessed = guess_settings(self._content)
            self.settings = read_settings(stated, self._content, guessed, whole=False)
            self._tell_settings("as stated")

    @property
    def base_frame(self) -> str:
        """Name of the robot's frame."""
        return (self.settings.base_frame if self.settings is not None else "") or "base_link"

    def readings(self, message: Message) -> list[Reading]:
        """Return the readings of a message, and of earlier ones that waited for the choice of topics.

        Raises:
            InputError: it cannot be read, or says what cannot be.
        """
        if message.topic not in self._handlers:
            self._content.topics[message.topic] = Topic(message.kind, 0)
            self._handlers[message.topic] = handler_of(self._content, message.topic)
        if (handler := self._handlers[message.topic]) is None:
            return []
        self._sources[message.topic] = message.source
        if (looks := self._objects(message)) is not None:
            return looks
        try:
            handler(self._types.deserialize_cdr(message.raw, message.kind), message.received_s)
        except KeyError:
            self._once(f"the type {message.kind} of {message.topic} is unknown: it is not read")
            return []
        except Exception as error:  # the package has no error that all of its errors are
            raise InputError(f"a message of {message.topic} is not a {message.kind}: {error}") from None
        if self.settings is None and not self._guess(message.received_s):
            return []
        found: list[Reading] = []
        assert self.settings is not None
        for topic in [topic for topic, stamps in self._content.stamps.items() if stamps]:
            try:
                if topic == self.settings.odometry:
                    found += self._velocities(topic)
                elif topic in [one.topic for one in self.settings.sensors.values()]:
                    found += self._looks(topic, SeenColumns.of(self._content.seen[topic]))
            finally:  # what cannot be read is not asked again with the next message
                self._forget(topic, 0)
        return sorted(found, key=lambda one: one.stamp_s)

    def _objects(self, message: Message) -> list[Reading] | None:
        """Return the look at objects in space that a message is, by columns; None for others."""
        topic, content = message.topic, self._content
        if content.kind(topic) != "Detection3DArray" or self.settings is None:
            return None
        if topic not in [one.topic for one in self.settings.sensors.values()]:
            return []
        if (parts := parts_of(message.raw, message.kind, OBJECT_FIELDS)) is None:
            return None
        look = content.take_look(topic, parts.stamp_s, message.received_s, parts.frame)
        try:
            return list(self._looks(topic, objects_in_space(parts, look)))
        finally:
            self._forget(topic, 0)

    def odometry_at(self, stamp_s: float) -> tuple[str, FloatArray | None]:
        """Return the frame of the odometry, and the pose (3,) in it at a stamp; else the robot's frame, and None."""
        for known_s, pose in reversed(self._odometry):
            if abs(known_s - stamp_s) < 1e-6:
                return "odom", pose
        return self.base_frame, None

    def _guess(self, now_s: float) -> bool:
        """Return whether the topics are chosen."""
        guessed = guess_settings(self._content)
        if guessed.odometry and guessed.sensors:
            self._first_s = min(self._first_s, now_s)
            if now_s >= self._first_s + GUESS_S:
                most = max(guessed.sensors, key=lambda one: len(self._content.stamps[guessed.sensors[one].topic]))
                self.settings = replace(guessed, sensors={most: guessed.sensors[most]})
                self._tell_settings("as guessed; evermap init bag writes what --topics reads")
                for one in guessed.sensors.keys() - {most}:
                    self._say(f"not read, since the engine has one sensor: {guessed.sensors[one].topic}")
                return True
        for topic in {*self._content.motion, *self._content.seen}:
            self._forget(topic, MOST_KEPT)
        return False

    def _tell_settings(self, how: str) -> None:
        assert self.settings is not None
        read = ", ".join(one.topic for one in self.settings.sensors.values())
        self._say(f"detections {read}; odometry {self.settings.odometry} ({how})")

    def _once(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._say(text)

    def _forget(self, topic: str, most: int) -> None:
        """Drop messages of a topic beyond a number."""
        content = self._content
        if len(content.stamps.get(topic, ())) > most:
            for kept in (content.stamps, content.motion, content.seen):
                kept.get(topic, []).clear()

    def _velocities(self, topic: str) -> Iterator[Velocity]:
        """Return velocities between successive poses; none between those of different publishers."""
        assert self.settings is not None
        content, source = self._content, self._sources[topic]
        stamps = stamps_of(content, topic, self.settings.clock).tolist()
        if content.kind(topic) not in POSES:
            for stamp_s, row in zip(stamps, content.motion[topic], strict=True):
                yield Velocity(stamp_s, row[0], row[1], row[5])
            return
        child = content.frames.get(topic, "")
        mount = content.mount(self.base_frame, child) if child not in ("", self.base_frame) else None
        for stamp_s, row in zip(stamps, content.motion[topic], strict=True):
            pose = np.array(row[:7])
            if not np.linalg.norm(pose[3:]) > 0.5:
                continue
            here = _on_the_floor(pose if mount is None else se3.compose(se3.normalise_poses(pose), se3.inverse(mount)))
            before, self._driven = self._driven, (source, stamp_s, here)
            self._odometry.append((stamp_s, here))
            if before is not None and before[0] == source and stamp_s > before[1]:
                forward, lateral, turn = se2.log(se2.between(before[2], here)) / (stamp_s - before[1])
                yield Velocity(before[1], float(forward), float(lateral), float(turn), stamp_s)

    def _looks(self, topic: str, seen: SeenColumns) -> Iterator[SensorLook]:
        assert self.settings is not None
        content, remarks = self._content, list[str]()
        stamps = stamps_of(content, topic, self.settings.clock)
        name = next(name for name, one in self.settings.sensors.items() if one.topic == topic)
        how = self.settings.sensors[name]
        if not how.frame and topic in content.frames:
            how = replace(how, frame=content.frames[topic])
        settings = replace(self.settings, sensors={name: how})
        sensor = mount_sensor(_NO_PATH, content, settings, name, remarks)
        placed = how.stated_mount or not remarks  # else where `sensor.toml` says
        names: dict[int, str] = {}
        labels = sorted(set(seen.label) - {""})
        columns = seen, np.zeros_like(seen.look), seen.look, labels, names
        try:
            found = detections_of(_NO_PATH, settings, (sensor,), columns, remarks)
        except EvermapError as error:
            raise InputError(f"{topic}: {error.problem}", hint=error.hint) from None
        for remark in remarks:
            self._once(f"{topic}: {remark}")
        mount = np.array(sensor.mount_robot_sensor) if placed else se3.from_plane(self._mount[None])[0]
        robot_m = se3.transform(mount, found.position_sensor_m)
        at = se2.transform(se2.inverse(self._mount), robot_m[:, :2])
        range_m, bearing_rad = np.hypot(*at.T), np.arctan2(at[:, 1], at[:, 0])
        turn = se3.rotation_of(mount)
        spread = (turn @ found.covariance_sensor_m2 @ turn.T)[:, :2, :2]
        ranged = np.isfinite(range_m) & (range_m > 0.0)
        ranged &= ~(np.trace(found.covariance_sensor_m2, axis1=1, axis2=2) > ANY_RANGE_M2)
        if not ranged.all():
            self._once(f"{topic}: detections without a range are dropped")
        angle = bearing_rad + self._mount[2]
        along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        sigma_range = np.sqrt(np.einsum("ni,nij,nj->n", along, spread, along))
        sigma_bearing = np.sqrt(np.einsum("ni,nij,nj->n", across, spread, across)) / np.maximum(range_m, 1e-9)
        for k, stamp_s in enumerate(stamps.tolist()):
            rows = np.flatnonzero(ranged & (found.frame == k))
            ids = [names.get(one, one) for one in found.landmark_id[rows].tolist()]
            classes = [labels[row] if row != UNKNOWN else None for row in found.class_id[rows].tolist()]
            sigmas = sigma_range[rows], sigma_bearing[rows]
            yield SensorLook(stamp_s, ids, range_m[rows], bearing_rad[rows], classes, *sigmas)


def heard(mailbox: Mailbox, listener: Listener, refused: Callable[[str], None]) -> Iterator[Reading | None]:
    """Yield readings as they arrive, without end, and None after every frame and if none waits.

    `refused` is called with one line for a message that is not taken.
    """
    stepped = False
    while True:
        if (message := mailbox.take()) is None:
            if not stepped:
                yield None
            stepped = False
            mailbox.wait(WAIT_S)
            continue
        for reading in _read(listener, message, refused):
            yield reading
            if stepped := isinstance(reading, SensorLook):
                yield None


def spoken(
    recording: AnyRecording, listener: Listener, refused: Callable[[str], None], *, paced: bool = False
) -> Iterator[Reading | None]:
    """Yield the readings of a listener for messages made from a recording, and None after each.

    `refused` is called with one line for a message that is not taken; `paced` messages come as fast as they did.
    """
    for stamp_s, topic, kind, raw in in_time(robot_messages(recording), paced=paced):
        yield from _read(listener, Message(topic, kind, raw, stamp_s, "recording"), refused)
        yield None


def play(recording: AnyRecording, wires: Sequence[Wire], going_on: Callable[[], None], *, speed: float = 1.0) -> int:
    """Publish the messages of a recorded drive, `speed` times as fast as it was driven; returns their number.

    `going_on` is called before each message; what it raises ends the drive.
    """
    count = 0
    for stamp_s, topic, kind, raw in in_time(robot_messages(recording), paced=True, speed=speed):
        going_on()
        for wire in wires:
            wire.send(topic, kind, raw, nanoseconds(stamp_s))
        count += 1
    return count


def _read(listener: Listener, message: Message, refused: Callable[[str], None]) -> list[Reading]:
    try:
        return listener.readings(message)
    except InputError as error:
        refused(error.one_line())
        return []


def _on_the_floor(pose: FloatArray) -> FloatArray:
    """A pose (7,), whose quaternion may have any length, as (3,): where it is on the floor, and its heading."""
    x, y, _, qx, qy, qz, qw = pose.tolist()
    return np.array([x, y, math.atan2(2.0 * (qx * qy + qw * qz), qw**2 + qx**2 - qy**2 - qz**2)])


class Scene(Protocol):
    """Protocol of viewers of a drive; stamps in seconds, places (3,) in the map."""

    def robot(self, stamp_s: float, position_m: FloatArray, quaternion: FloatArray) -> None:
        """Show where the robot is."""

    def landmark(self, stamp_s: float, name: str, position_m: FloatArray, p_exists: float, text: str) -> None:
        """Show a landmark, or show it anew."""

    def change(self, stamp_s: float, name: str, line_m: FloatArray, text: str) -> None:
        """Show a change as an arrow from the first of (2, 3) places to the second."""

    def erase(self, stamp_s: float, name: str) -> None:
        """Show something no more."""


def look_on(mailbox: Mailbox, scene: Scene, going_on: Callable[[], None]) -> None:
    """Show the outputs of an engine, until `going_on` raises `KeyboardInterrupt`."""
    types = ros2_types()
    try:
        while True:
            going_on()
            if (message := mailbox.take()) is None:
                mailbox.wait(WAIT_S)
            elif message.topic in (_POSE, _SCENE) and message.kind == TELLS[message.topic]:
                _show(types.deserialize_cdr(message.raw, message.kind), scene)
    except KeyboardInterrupt:
        return


def _show(message: Any, scene: Scene) -> None:
    if hasattr(message, "pose"):
        pose = np.array(pose_of(message.pose.pose))
        scene.robot(stamp_of(message), pose[:3], pose[3:])
        return
    for one in message.deletions:
        scene.erase(seconds(one.timestamp), one.id)
    for one in message.entities:
        stamp_s, text = seconds(one.timestamp), one.texts[0].text
        for body in (*one.spheres, *one.cubes):
            scene.landmark(stamp_s, one.id, np.array(pose_of(body.pose))[:3], float(body.color.a), text)
        for arrow in one.arrows:
            pose = np.array(pose_of(arrow.pose))
            ends = np.array([[0.0, 0.0, 0.0], [arrow.shaft_length + arrow.head_length, 0.0, 0.0]])
            scene.change(stamp_s, one.id, se3.transform(pose, ends), text)


class Teller:
    """Publishes the outputs of an engine on wires, in a separate thread: the newest pose, and all changes."""

    def __init__(self, engine: Engine, wires: Sequence[Wire]) -> None:
        self._engine, self._wires = engine, wires
        self._ros = Ros(ros2_types())
        self._lock, self._news, self._stop = threading.Lock(), threading.Event(), False
        self._now: Now | None = None
        self._driven: tuple[str, FloatArray | None] = "base_link", None
        self._changes: list[MapChange] = []
        self._n_changes, self._at = 0, 0
        self._whole: Landmarks | None = None
        self._seen: Landmarks | None = None
        self._told: dict[int, FloatArray] = {}
        self._drawn: dict[int, str] = {}
        self._revision, self._next_s, self._stamp_s = -1, -math.inf, math.nan
        for wire in wires:
            for topic, kind in TELLS.items():
                wire.announce(topic, kind)
        self._thread = threading.Thread(target=self._run, name="evermap-tell", daemon=True)
        self._thread.start()

    def tell(self, now: Now, listener: Listener | None = None) -> None:
        """Take the present state, and the odometry's pose of the listener; returns at once."""
        driven = ("base_link", None) if listener is None else listener.odometry_at(now.stamp_s)
        with self._lock:
            self._now, self._driven = now, driven
            self._changes += now.changes
        self._news.set()

    def close(self) -> None:
        """Send pending messages, and end."""
        self._stop = True
        self._news.set()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while True:
            self._news.wait()
            self._news.clear()
            with self._lock:
                now, driven, self._now = self._now, self._driven, None
                changes, self._changes = self._changes, []
            if now is not None and math.isfinite(now.stamp_s):
                self._pose(now, *driven)
                self._map(now)
                self._tell_changes(now.stamp_s, changes)
            if self._stop:
                return

    def _send(self, topic: str, message: Any, stamp_s: float) -> None:
        raw = bytes(self._ros.types.serialize_cdr(message, TELLS[topic]))
        for wire in self._wires:
            wire.send(topic, TELLS[topic], raw, nanoseconds(stamp_s))

    def _pose(self, now: Now, child: str, driven: FloatArray | None) -> None:
        """The pose and the frame of the odometry (or the robot's, where that has no frame) in that of the map."""
        if not np.isfinite(now.pose_world_robot).all() or now.stamp_s == self._stamp_s:
            return
        self._stamp_s = now.stamp_s
        ros, here = self._ros, now.pose_world_robot
        stamp_s, covariance = np.array([now.stamp_s]), now.covariance[None]
        path = replace(now.online, stamp_s=stamp_s, pose_world_robot=here[None], covariance=covariance)
        message = ros.posed(now.stamp_s, in_space(here[None])[0], ros_covariance(path)[0])
        self._send(_POSE, message, now.stamp_s)
        if driven is not None:
            here = se2.compose(here, se2.inverse(driven))
        frames = [("map", child, in_space(here[None])[0])]
        self._send(_TF, ros.transforms(now.stamp_s, frames), now.stamp_s)

    def _map(self, now: Now) -> None:
        """Landmarks in view of which something new is believed, and every second a part of all others."""
        some = []
        if now.in_view is not self._seen:  # else no frame was processed since
            self._seen = now.in_view
            some.append(rows_of(now.in_view, np.flatnonzero(self._is_news(now.in_view))))
        if time.monotonic() >= self._next_s or now.revision != self._revision:
            if now.revision != self._revision or self._whole is None or self._at >= len(self._whole):
                self._whole, self._at, self._revision = self._engine.landmarks(), 0, now.revision
                if now.frame == "prior_map":
                    self._erase(self._whole, now.stamp_s)
            self._next_s = time.monotonic() + TOLD_S
            some.append(rows_of(self._whole, np.arange(self._at, min(self._at + PART, len(self._whole)))))
            self._at += PART
        for landmarks in some:
            if not len(landmarks):
                continue
            said = np.column_stack([landmarks.position_m, landmarks.p_exists])
            self._told.update(zip(landmarks.landmark_id.tolist(), said, strict=True))
            self._drawn.update(zip(landmarks.landmark_id.tolist(), landmarks.labels, strict=True))
            pairs = list(drawn(self._ros, landmarks, np.full(len(landmarks), now.stamp_s)))
            self._draw([marker for marker, _ in pairs], [], [entity for _, entity in pairs], now.stamp_s)

    def _is_news(self, seen: Landmarks) -> BoolArray:
        """Return whether position or belief of each landmark differs from the published one."""
        now = np.column_stack([seen.position_m, seen.p_exists])
        untold = np.full(now.shape[1], np.nan)
        said = np.array([self._told.get(one, untold) for one in seen.landmark_id.tolist()]).reshape(now.shape)
        return np.asarray(~(np.abs(said - now) <= SEEN_P).all(axis=1))

    def _draw(self, markers: list[Any], gone: list[Any], entities: list[Any], stamp_s: float) -> None:
        ros = self._ros
        if markers:
            message = ros.make("visualization_msgs/MarkerArray", markers)
            self._send(_LANDMARKS, message, stamp_s)
        scene = ros.make("foxglove_msgs/SceneUpdate", gone, entities)
        self._send(_SCENE, scene, stamp_s)

    def _erase(self, whole: Landmarks, stamp_s: float) -> None:
        """Landmarks that the map does not have any more, as after a merge."""
        lost = self._drawn.keys() - set(whole.landmark_id.tolist())
        gone = []
        for one in lost:
            name = entity_id(self._drawn.pop(one))
            gone.append(self._ros.make("foxglove_msgs/SceneEntityDeletion", self._ros.time(stamp_s), 0, name))
        if gone:
            self._draw([], gone, [], stamp_s)

    def _tell_changes(self, stamp_s: float, changes: Sequence[MapChange]) -> None:
        there = where(self._engine.landmarks()) if changes else {}
        for change in changes:
            self._n_changes += 1
            line, entity = told(self._ros, change, stamp_s, f"change {self._n_changes}", there)
            self._send(_CHANGES, line, stamp_s)
            if entity is not None:
                self._draw([], [], [entity], stamp_s)
