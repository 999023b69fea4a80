"""Messages as readings of an engine: what is guessed, what is stated, and what cannot be read."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evermap.errors import DataError, InputError
from evermap.geometry import se2, se3
from evermap.live.feed import SensorLook, Velocity

pytest.importorskip("rosbags", reason="the extra ros is not installed")

sys.path.insert(0, str(Path(__file__).parents[1] / "io"))

from bags import MOUNT, TAGS, Ros, path_of

from evermap.live import ros
from evermap.live.ros import Listener
from evermap.live.wires import Message
from evermap.types import Sensor

START_S = 1.7e9
SENSOR = Sensor(range_max_m=9.0, mount_robot_sensor=(0.2, 0.0, 0.0))


class Robot:
    """Messages of a robot that drives past two tags, as a listener gets them."""

    def __init__(self, listener: Listener) -> None:
        self.listener, self.ros, self.source, self.readings = listener, Ros(2), "first", list[Any]()

    def say(self, k: int, topic: str, kind: str, message: Any) -> None:
        raw = bytes(self.ros.store.serialize_cdr(message, kind))
        self.readings += self.listener.readings(Message(topic, kind, raw, START_S + 0.1 * k, (topic, self.source)))

    def odometry(self, k: int, pose: np.ndarray) -> None:
        self.say(k, "/odom", "nav_msgs/msg/Odometry", self.ros.odometry(START_S + 0.1 * k, pose))

    def frames(self) -> None:
        message = self.ros.transform(START_S, "base_link", "camera", MOUNT)
        self.say(0, "/tf_static", "tf2_msgs/msg/TFMessage", message)

    def boxes(self, k: int, seen: dict[str, np.ndarray], frame: str = "camera") -> None:
        ros, found = self.ros, []
        header = ros.header(START_S + 0.1 * k, frame)
        for name, at in seen.items():
            pose = ros.pose(np.append(at, [0.0, 0.0, 0.0, 1.0]))
            posed = ros.make("geometry_msgs/PoseWithCovariance", pose, np.diag([4e-4] * 3 + [0.0] * 3).ravel())
            hypothesis = ros.make("vision_msgs/ObjectHypothesis", "chair", 0.9)
            result = ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis, posed)
            box = ros.make("vision_msgs/BoundingBox3D", pose, ros.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0))
            found.append(ros.make("vision_msgs/Detection3D", header, [result], box, name))
        message = ros.make("vision_msgs/Detection3DArray", header, found)
        self.say(k, "/seen", "vision_msgs/msg/Detection3DArray", message)

    def of(self, kind: type) -> list[Any]:
        return [one for one in self.readings if isinstance(one, kind)]


def robot(stated: Path | None = None) -> tuple[Robot, list[str]]:
    said: list[str] = []
    return Robot(Listener(SENSOR, stated, said.append)), said


def where(k: int, tag: int) -> np.ndarray:
    """A tag in the frame of the camera."""
    return se3.transform(se3.inverse(se3.compose(path_of(k), MOUNT)), TAGS[tag][:3])


def test_poses_become_velocities_and_detections_lie_on_the_floor() -> None:
    """The camera has x to the right and y down, as its frame says; the floor is the robot's."""
    one, said = robot()
    one.frames()
    for k in range(20):
        one.odometry(k, path_of(k))
        one.boxes(k, {"3": where(k, 3), "gate": where(k, 7)})
    assert len(said) == 1
    assert "/seen" in said[0]
    assert "/odom" in said[0]
    velocity = np.array([tuple(reading) for reading in one.of(Velocity)])
    assert velocity[:, 0] == pytest.approx(START_S + 0.1 * np.arange(19), abs=1e-6)
    assert velocity[:, 1:4] == pytest.approx(np.tile([0.5, 0.0, 0.1], (19, 1)), abs=1e-5)
    assert velocity[:, 4] == pytest.approx(velocity[:, 0] + 0.1, abs=1e-6)  # known until the newest pose
    looks = one.of(SensorLook)
    assert len(looks) == 20
    for k, look in enumerate(looks):
        assert look.landmark_id == [3, "gate"]
        assert look.class_name == ["chair", "chair"]
        pose = np.array([*path_of(k)[:2], 0.01 * k])
        at = [se2.transform(se2.inverse(se2.compose(pose, np.array([0.2, 0.0, 0.0]))), TAGS[tag][:2]) for tag in TAGS]
        assert look.range_m == pytest.approx(np.hypot(*np.transpose(at)))
        assert look.bearing_rad == pytest.approx([np.arctan2(y, x) for x, y in at])
        assert look.sigma_range_m == pytest.approx([0.02, 0.02])
        assert look.sigma_bearing_rad == pytest.approx(0.02 / look.range_m)
    frame, pose = one.listener.odometry_at(START_S + 0.5)
    assert frame == "odom"
    assert pose == pytest.approx([*path_of(5)[:2], 0.05])
    assert one.listener.odometry_at(3.0) == ("base_link", None)


def test_a_frame_without_detections_is_a_look_and_a_text_of_digits_is_a_number() -> None:
    one, _ = robot()
    for k in range(20):
        one.odometry(k, path_of(k))
        one.boxes(k, {} if k % 2 else {"3": np.array([2.0, 0.0, 0.0]), "3b": np.array([1.0, 1.0, 0.0])}, "base_link")
    looks = one.of(SensorLook)
    assert [list(look.landmark_id) for look in looks[:3]] == [[3, "3b"], [], [3, "3b"]]
    assert looks[0].range_m == pytest.approx([1.8, np.hypot(0.8, 1.0)])  # from the sensor, .2 m ahead


def test_objects_by_columns_are_the_objects_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sizes and covariances that are said or not, texts of any kind, and hypotheses that only `decode` takes."""

    def drive() -> list[Any]:
        one, rng = robot()[0], np.random.default_rng(3)
        one.frames()
        for k in range(30):
            one.odometry(k, path_of(k))
            if k < 12:
                one.boxes(k, {"3": where(k, 3)})
                continue
            ros, found = one.ros, []
            header = ros.header(0.0 if k == 20 else START_S + 0.1 * k, "camera")
            for name in rng.permutation(["", "3", "gate", "käse"])[: rng.integers(5)].tolist():
                at = ros.pose(np.append(rng.normal(size=3) + [0.0, 0.0, 5.0], [0.0, 0.0, 0.0, 1.0]))
                spread = np.diag([4e-4] * 3 + [0.0] * 3) * rng.integers(2)
                posed = ros.make("geometry_msgs/PoseWithCovariance", at, spread.ravel())
                label = rng.choice(["", "chair", "7"])
                hypothesis = ros.make("vision_msgs/ObjectHypothesis", str(label), rng.random())
                result = ros.make("vision_msgs/ObjectHypothesisWithPose", hypothesis, posed)
                size = ros.make("geometry_msgs/Vector3", *rng.integers(2, size=3).astype(float).tolist())
                box = ros.make("vision_msgs/BoundingBox3D", ros.pose(np.array([1, 2, 3, 0, 0, 0, 1.0])), size)
                found.append(ros.make("vision_msgs/Detection3D", header, [result] * (1 + (k == 25)), box, name))
            message = ros.make("vision_msgs/Detection3DArray", header, found)
            one.say(k, "/seen", "vision_msgs/msg/Detection3DArray", message)
        return one.readings

    by_columns = drive()
    monkeypatch.setattr(ros, "parts_of", lambda *_: None)
    one_by_one = drive()
    assert len(by_columns) == len(one_by_one) == 29 + 30
    for mine, other in zip(by_columns, one_by_one, strict=True):
        assert type(mine) is type(other)
        for a, b in zip(mine, other, strict=True):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


@pytest.mark.parametrize("columns", [True, False])
def test_a_look_that_cannot_be_read_leaves_the_next_alone(columns: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not columns:
        monkeypatch.setattr(ros, "parts_of", lambda *_: None)
    one, real, bad = robot()[0], ros.detections_of, [False]

    def read(*given: Any) -> Any:
        if bad[0]:
            raise DataError("cannot be read")
        return real(*given)

    monkeypatch.setattr(ros, "detections_of", read)
    for k in range(20):
        one.odometry(k, path_of(k))
        bad[0] = k == 15
        with pytest.raises(InputError) if bad[0] else contextlib.nullcontext():
            one.boxes(k, {"3": where(k, 3)})
    looks = one.of(SensorLook)
    assert [round(10 * (look.stamp_s - START_S)) for look in looks] == [*range(15), *range(16, 20)]
    assert all(look.landmark_id == [3] for look in looks)


def test_where_no_message_says_where_the_sensor_is_its_file_does() -> None:
    one, said = robot()
    for k in range(15):
        one.odometry(k, path_of(k))
        one.boxes(k, {"3": np.array([2.0, 1.0, 0.3])}, "camera")
    assert one.of(SensorLook)[0].range_m == pytest.approx([np.hypot(2.0, 1.0)])
    assert any("no fixed transform from 'base_link' to 'camera'" in line for line in said)


def test_a_publisher_that_starts_again_has_not_jumped() -> None:
    one, _ = robot()
    for k in range(15):
        one.odometry(k, path_of(k + 50))
        one.boxes(k, {"3": where(k, 3)})
    one.source = "second"
    for k in range(30, 40):
        one.odometry(k, path_of(k - 30))
    speed = np.array([reading.forward_mps for reading in one.of(Velocity)])
    assert speed == pytest.approx(np.full(14 + 9, 0.5), abs=1e-5)


def test_velocities_are_taken_as_they_are() -> None:
    one, _ = robot()
    ros = one.ros
    for k in range(20):
        twist = ros.make(
            "geometry_msgs/Twist", *(ros.make("geometry_msgs/Vector3", *v) for v in ((0.3, 0.1, 0.0), (0.0, 0.0, -0.2)))
        )
        message = ros.make("geometry_msgs/TwistStamped", ros.header(START_S + 0.1 * k, "base_link"), twist)
        one.say(k, "/wheels", "geometry_msgs/msg/TwistStamped", message)
        one.boxes(k, {"3": where(k, 3)}, "base_link")
    assert one.of(Velocity)[-1][1:4] == pytest.approx((0.3, 0.1, -0.2))
    assert one.listener.odometry_at(START_S) == ("base_link", None)


STATED = """
[bag]
odometry = "/odom"
base_frame = "base_link"
[camera.eye]
topic = "/seen"
frame = "camera"
identity = "id"
[camera.eye.mount]
x_m = 1.0
y_m = 0.5
"""


def test_what_is_stated_is_read_from_the_first_message_on(tmp_path: Path) -> None:
    path = tmp_path / "topics.toml"
    path.write_text(STATED)
    one, said = robot(path)
    one.boxes(0, {"3": np.array([2.0, 0.5, 0.0])})
    (look,) = one.of(SensorLook)
    assert look.range_m == pytest.approx([np.hypot(2.8, 1.0)])
    assert said == ["detections /seen; odometry /odom (as stated)"]
    path.write_text(STATED.replace("topic =", "topik ="))
    with pytest.raises(InputError, match=r"topics.toml:6: .*unknown key \(try: topic\)"):
        robot(path)
    with pytest.raises(InputError, match="No such file"):
        robot(tmp_path / "none.toml")


def test_what_cannot_be_read_is_refused_in_one_line_and_the_rest_goes_on() -> None:
    one, said = robot()
    rng = np.random.default_rng(0)
    message = one.ros.odometry(START_S, path_of(0))
    raw = bytearray(one.ros.store.serialize_cdr(message, "nav_msgs/msg/Odometry"))
    for _ in range(200):
        broken = bytes(raw[: rng.integers(0, len(raw))]) if rng.random() < 0.5 else rng.bytes(len(raw))
        with contextlib.suppress(InputError):
            one.listener.readings(Message("/odom", "nav_msgs/msg/Odometry", broken, START_S, 0))
    assert one.listener.readings(Message("/x", "my_msgs/msg/TagDetectionArray", b"\0\1\0\0", START_S, 0)) == []
    assert "my_msgs/msg/TagDetectionArray of /x is unknown" in said[-1]
    assert one.listener.readings(Message("/image", "sensor_msgs/msg/Image", b"", START_S, 0)) == []
