"""Bags of ROS 1 and ROS 2: what is guessed of their topics, and that tags are where they are, in every form."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import CAMERA, MOUNT, SIZE_M, START_S, STEPS, TAGS, in_camera, path_of, write
from mcap.writer import Writer
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.errors import DataError, InputError
from evermap.geometry import se3
from evermap.geometry.camera import project, unproject
from evermap.io import list_robots, read_recording, reader_for
from evermap.io.bag import bag_settings, guess_settings, read_bag, settings_path
from evermap.io.bag_messages import scan_bag
from evermap.io.rosbag import UNSTATED
from evermap.types import UNKNOWN, SpatialRecording, landmark_id_of

pytest.importorskip("rosbags", reason="the extra ros is not installed")

from rosbags.highlevel import AnyReader


def state_size(bag: Path) -> None:
    settings_path(bag).write_text(bag_settings(bag) + f"\n[tags]\nsize_m = {SIZE_M}\n")


def places(recording: SpatialRecording) -> Iterator[tuple[int, np.ndarray]]:
    """Identity and pose in the world of every detection, by the odometry."""
    seen, odometry = recording.detections, recording.odometry
    assert odometry is not None
    mount = np.array([one.mount_robot_sensor for one in recording.sensors])[seen.sensor]
    row = np.searchsorted(odometry.stamp_s, recording.frames.stamp_s[seen.frame] - 1e-3)
    robot = odometry.pose_world_robot[row]
    rotation = np.where(np.isnan(seen.rotation), se3.NO_TURN, seen.rotation)
    pose = se3.compose(se3.compose(robot, mount), np.hstack([seen.position_sensor_m, rotation]))
    yield from zip(seen.landmark_id.tolist(), pose, strict=True)


@pytest.mark.parametrize(
    ("name", "detector"),
    [
        ("drive.bag", "tags"),
        ("drive.bag", "aruco"),
        ("drive.bag", "fiducials"),
        ("drive.bag", "apriltag_ros"),
        ("drive", "tags"),
        ("drive", "aruco"),
        ("drive", "fiducials"),
        ("drive", "apriltag_ros"),
        ("drive_sqlite", "tags"),
        ("drive", "aruco_ros"),
        ("drive.bag", "alvar"),
        ("drive", "cartographer"),
        ("drive", "transforms"),
    ],
)
def test_tags_are_where_they_are(name: str, detector: str, tmp_path: Path) -> None:
    bag = write(tmp_path / name, detector)
    if detector == "tags":
        with pytest.raises(DataError, match=r"state the size of its tags.*evermap init bag"):
            read_bag(bag)
        state_size(bag)
    assert reader_for(bag).name == "bag"
    assert list_robots(bag) == ()
    recording = read_recording(bag)
    assert isinstance(recording, SpatialRecording)
    assert len(recording.frames) == STEPS
    assert recording.frames.stamp_s[0] == pytest.approx(START_S, abs=1e-6)
    assert len(recording.detections) == (40 if detector == "tags" else 50)
    assert recording.odometry is not None
    assert recording.odometry.variance == pytest.approx(np.full((STEPS, 6), 0.01))
    for identity, pose in places(recording):
        off = se3.log(se3.compose(se3.inverse(TAGS[identity]), pose))
        assert np.abs(off).max() < 1e-6
    assert recording.truth is not None
    assert recording.truth.pose_world_robot == pytest.approx(np.array([path_of(k) for k in range(STEPS)]))
    # without an empty message among so many the detector may be one that is silent where it sees nothing
    assert recording.frames.complete == (detector == "tags")


def test_odometry_that_is_only_in_transforms(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "aruco")
    content = scan_bag(bag)
    assert guess_settings(content).odometry == "/odom"
    for topic in ("/odom", "/wheels/twist"):
        del content.motion[topic]
    assert guess_settings(content).odometry == "tf:odom>base_link"
    settings_path(bag).write_text(bag_settings(bag).replace('"/odom"', '"tf:odom>base_link"'))
    odometry = read_bag(bag).odometry
    assert odometry is not None
    assert odometry.pose_world_robot == pytest.approx(np.array([path_of(k) for k in range(STEPS)]))


def test_a_single_file_of_mcap(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "aruco")
    (file,) = bag.glob("*.mcap")
    assert [identity for identity, _ in places(read_bag(file))] == [identity for identity, _ in places(read_bag(bag))]


def test_boxes_have_class_size_and_score_but_no_identity(tmp_path: Path) -> None:
    recording = read_bag(write(tmp_path / "drive", "objects"))
    seen = recording.detections
    assert (seen.landmark_id == UNKNOWN).all()
    assert recording.class_names == ("crate",)
    assert set(seen.class_id) == {0}
    assert seen.score == pytest.approx(np.full(50, 0.8))
    assert seen.size_m == pytest.approx(np.tile([0.4, 0.3, 0.2], (50, 1)))


def test_identity_is_what_the_settings_say(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "objects")
    text = bag_settings(bag)
    settings_path(bag).write_text(text.replace('identity = "none"', 'identity = "id"'))
    recording = read_bag(bag)
    assert set(recording.landmark_names.values()) == {"crate 3", "crate 7"}
    for identity, pose in places(recording):
        tag = int(recording.landmark_names[identity].split()[1])
        assert pose == pytest.approx(TAGS[tag], abs=1e-6)
    settings_path(bag).write_text(text.replace('identity = "none"', 'identity = "class"'))
    assert set(read_bag(bag).detections.landmark_id) == {landmark_id_of("crate")}


def test_directions_to_what_one_camera_sees(tmp_path: Path) -> None:
    recording = read_bag(write(tmp_path / "drive", "directions"))
    seen = recording.detections
    truth = [in_camera(k)[name][:3] for k in range(STEPS) for name in TAGS]
    ahead = np.array([point / np.linalg.norm(point) for point in truth])
    # pixels of Detection2DArray are taken to be of the image as it is
    bent = replace(CAMERA, distortion=(0.3, 0.1, 0.0, 0.0), distortion_model="radtan")
    assert seen.position_sensor_m == pytest.approx(unproject(project(np.array(truth), CAMERA)[0], bent), abs=1e-9)
    assert np.abs(seen.position_sensor_m - ahead).max() > 1e-3
    assert set(seen.landmark_id.tolist()) == {3, 7}  # texts of digits
    bag = tmp_path / "drive"
    settings_path(bag).write_text(bag_settings(bag).replace("rectified = false", "rectified = true"))
    assert read_bag(bag).detections.position_sensor_m == pytest.approx(ahead, abs=1e-9)


@pytest.mark.parametrize("detector", ["scene", "markers"])
def test_drawings_are_read_where_there_is_nothing_else(detector: str, tmp_path: Path) -> None:
    recording = read_bag(write(tmp_path / "drive", detector))
    assert len(recording.detections) == 2 * STEPS
    for identity, pose in places(recording):
        assert pose == pytest.approx(TAGS[identity], abs=1e-6)


@pytest.mark.parametrize("name", ["drive", "drive.bag"])
@pytest.mark.parametrize(
    "kind",
    [
        "PoseStamped",
        "PoseWithCovarianceStamped",
        "TransformStamped",
        "TwistStamped",
        "TwistWithCovarianceStamped",
    ],
)
def test_motion_is_read_of_poses_and_of_velocities(name: str, kind: str, tmp_path: Path) -> None:
    bag = write(tmp_path / name, "aruco", odometry=kind)
    settings_path(bag).write_text(bag_settings(bag).replace('odometry = "/wheels/twist"', 'odometry = "/odom"'))
    recording = read_bag(bag)
    assert recording.odometry is not None
    assert recording.odometry.pose_world_robot == pytest.approx(np.array([path_of(k) for k in range(STEPS)]), abs=1e-6)
    if kind == "PoseWithCovarianceStamped":
        assert recording.odometry.variance == pytest.approx(np.full((STEPS, 6), 0.01))


def test_clocks_that_differ_are_told_and_can_be_given_up(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "aruco", late_s=3.0)
    recording = read_bag(bag)
    assert any("recorded 3 s later, relative to their stamps, than those of /odom" in one for one in recording.warnings)
    settings_path(bag).write_text(bag_settings(bag).replace('clock = "header"', 'clock = "receive"'))
    recording = read_bag(bag)
    assert not any("recorded" in one for one in recording.warnings)
    assert recording.frames.stamp_s[0] == pytest.approx(START_S + 0.01, abs=1e-6)


def test_a_check_of_a_bag_tells_what_its_reader_tells(tmp_path: Path) -> None:
    late = CliRunner().invoke(app, ["check", str(write(tmp_path / "drive", "aruco", late_s=1.0, mounted=False))])
    assert late.exit_code == 0, late.output
    assert "by sensor      camera 50" in late.stdout
    assert "recorded 1 s later, relative to their stamps" in late.stderr
    assert "no fixed transform from 'base_link' to 'camera_optical'" in late.stderr
    sizeless = CliRunner().invoke(app, ["check", str(write(tmp_path / "other", "tags"))])
    assert sizeless.exit_code == 2
    assert "does not state the size of its tags" in sizeless.stderr


def test_a_sensor_without_a_transform_is_told_and_can_be_mounted(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "aruco", mounted=False)
    recording = read_bag(bag)
    assert any("no fixed transform from 'base_link' to 'camera_optical'" in one for one in recording.warnings)
    x, y, z, qx, qy, qz, qw = MOUNT
    mount = f"[camera.camera.mount]\nx_m = {x}\ny_m = {y}\nz_m = {z}\nqx = {qx}\nqy = {qy}\nqz = {qz}\nqw = {qw}\n"
    settings_path(bag).write_text(bag_settings(bag) + mount)
    recording = read_bag(bag)
    assert recording.warnings == ()
    for identity, pose in places(recording):
        assert pose == pytest.approx(TAGS[identity], abs=1e-6)


def test_what_is_guessed_is_told_and_reads_back_the_same(tmp_path: Path, assert_same: Callable) -> None:
    bag = write(tmp_path / "drive", "aruco")
    guessed = read_bag(bag)
    assert guessed.warnings == (
        "topics as guessed: detections /camera/seen; odometry /odom (`evermap init bag` writes them for editing)",
    )
    text = bag_settings(bag)
    assert "#   /rosout_agg  std_msgs/msg/String  0" in text
    settings_path(bag).write_text(text)
    stated = read_bag(bag)
    assert stated.warnings == ()
    assert_same(stated.detections, guessed.detections)
    assert_same(stated.odometry, guessed.odometry)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (
            'odometry = "/odom"',
            'odometry = "/odo"',
            r"drive\.toml:12: field 'bag\.odometry': no topic .*'/odo' \(try: /odom",
        ),
        ('topic = "/camera/seen"', 'topic = "/camera/sen"', r"'camera\.camera\.topic': no topic with detections.*seen"),
        ('clock = "header"', 'clock = "wall"', r"'bag\.clock': unknown clock 'wall'"),
        ('\nidentity = "id"', '\nidentity = "name"', r"'camera\.camera\.identity': no identity 'name'"),
        ('\nidentity = "id"', "\nidentity = 3", r"'camera\.camera\.identity': must be a text, not int"),
        ('truth = "/gt/pose"', "truth = true", r"'bag\.truth': must be a text, not bool"),
        ("[bag]", "[bags]", r"'bags': unknown section"),
        ('frame = "camera_optical"', "intrinsics = [1, 2, 3]", r"'camera\.camera\.intrinsics': must be a list of 4"),
    ],
)
def test_settings_that_are_wrong(old: str, new: str, match: str, tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "aruco")
    text = bag_settings(bag)
    assert old in text
    settings_path(bag).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=match):
        read_bag(bag)


def test_bags_that_cannot_be_used(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "tags")
    (file,) = bag.glob("*.mcap")
    raw = file.read_bytes()
    file.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(InputError, match="cannot be read as a bag"):
        read_bag(file)
    with pytest.raises(InputError, match="robot 2"):
        read_recording(bag, 2)
    bag = write(tmp_path / "other", "tags")
    text = bag_settings(bag).replace('camera_info = "/camera/camera_info"', 'camera_info = ""')
    settings_path(bag).write_text(f"{text}\n[tags]\nsize_m = 0.2\n")
    with pytest.raises(DataError, match=r"no calibration of the camera 'camera'"):
        read_bag(bag)


@pytest.mark.parametrize("count", [30, pytest.param(60, marks=pytest.mark.slow)])
def test_mutated_bags_are_read_or_refused(count: int, tmp_path: Path) -> None:
    """A byte here and there is another: nothing but what the library says in a line."""
    rng = np.random.default_rng(0)
    raws = {".bag": write(tmp_path / "drive.bag", "aruco").read_bytes()}
    (file,) = write(tmp_path / "drive", "aruco").glob("*.mcap")
    raws[".mcap"] = file.read_bytes()
    refused = 0
    for suffix, raw in raws.items():
        for k in range(count):
            broken = np.frombuffer(raw, dtype=np.uint8).copy()
            broken[rng.integers(0, len(raw), 1 + k % 8)] = rng.integers(0, 256, 1 + k % 8)
            path = tmp_path / f"broken{k}{suffix}"
            path.write_bytes(broken[: len(raw) if k % 3 else int(rng.integers(1, len(raw)))].tobytes())
            try:
                read_bag(path)
            except (InputError, DataError):
                refused += 1
    assert refused > count // 3


def test_types_that_nothing_defines_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no definition of the messages of /camera/seen, aruco_msgs/msg/ArucoMarkers"):
        read_bag(write(tmp_path / "drive_sqlite", "aruco"))


def test_settings_are_written_beside_the_bag_once(tmp_path: Path) -> None:
    bag = write(tmp_path / "drive", "tags")
    run = CliRunner().invoke
    written = run(app, ["init", "bag", str(bag)])
    assert written.exit_code == 0
    assert settings_path(bag).read_text() == bag_settings(bag)
    assert 'odometry = "/odom"' in written.output
    again = run(app, ["init", "bag", str(bag)])
    assert again.exit_code == 2
    assert "is there already" in again.output


def test_settings_of_another_bag_are_taken_by_an_option(tmp_path: Path) -> None:
    """One file for all bags of a robot; it comes before the one beside a bag."""
    bag, file = write(tmp_path / "drive", "tags"), tmp_path / "robot.toml"
    file.write_text(bag_settings(bag) + f"\n[tags]\nsize_m = {SIZE_M}\n")
    settings_path(bag).write_text("[bag]\nodometry = 'none such'\n")
    run, out = CliRunner().invoke, tmp_path / "native"
    done = run(app, ["convert", str(bag), str(out), "--topics", str(file)])
    assert done.exit_code == 0, done.output
    assert len(read_recording(out).detections) == len(read_bag(bag, topics=file).detections) > 0
    missing = run(app, ["slam", str(bag), "--topics", str(tmp_path / "none.toml")])
    assert missing.exit_code == 2
    assert "none.toml: cannot be read" in missing.output
    no_bag = run(app, ["slam", str(out), "--topics", str(file)])
    assert no_bag.exit_code == 2
    assert "native: has no topics" in no_bag.output


def with_protobuf(bag: Path, to: Path, profile: str, **how: Any) -> Path:
    """The messages of a bag, and scenes as Foxglove's own recorders write them, as an MCAP file."""
    scene = pytest.importorskip("foxglove.messages", reason="the extra live is not installed").SceneUpdate
    with AnyReader([bag]) as ros, to.open("wb") as file:
        writer = Writer(file, **how)
        writer.start(profile, "test")
        schema = writer.register_schema("foxglove.SceneUpdate", "protobuf", scene.get_schema().data)
        drawn = writer.register_channel("/scene", "protobuf", schema)
        text, data = ("ros2msg", "cdr") if ros.is2 else ("ros1msg", "ros1")
        channels = {}
        for one in ros.connections:
            kind = one.msgtype if ros.is2 else one.msgtype.replace("/msg/", "/")
            schema = writer.register_schema(kind, text, one.msgdef.data.encode())
            channels[one.topic] = writer.register_channel(one.topic, data, schema)
        for one, stamp_ns, raw in ros.messages():
            writer.add_message(channels[one.topic], stamp_ns, raw, stamp_ns)
            writer.add_message(drawn, stamp_ns, scene().encode(), stamp_ns)
        writer.finish()
    return to


@pytest.mark.parametrize("profile", ["ros2", "", "ros1"])
@pytest.mark.parametrize("how", [{}, {"use_chunking": False, "use_statistics": False}], ids=["chunks", "plain"])
def test_topics_of_ros_are_read_beside_those_in_protobuf(tmp_path: Path, profile: str, how: dict[str, Any]) -> None:
    bag = write(tmp_path / ("drive.bag" if profile == "ros1" else "drive"), "apriltag_ros")
    plain, mixed = read_bag(bag), read_bag(with_protobuf(bag, tmp_path / "mixed.mcap", profile, **how))
    warning = "topics passed over, since only messages of ROS are read, in protobuf: /scene"
    assert [one for one in mixed.warnings if one not in plain.warnings] == [warning]
    assert plain.odometry is not None
    assert mixed.odometry is not None
    for ours, theirs in ((mixed.odometry, plain.odometry), (mixed.detections, plain.detections)):
        for one in fields(ours):
            np.testing.assert_array_equal(getattr(ours, one.name), getattr(theirs, one.name))
    np.testing.assert_array_equal(mixed.frames.stamp_s, plain.frames.stamp_s)
    assert mixed.sensors == plain.sensors
    shown = CliRunner().invoke(app, ["info", str(tmp_path / "mixed.mcap"), "--json"])
    assert json.loads(shown.stdout)["topics"]["/scene"]["messages"] > 2 * STEPS
    settings = bag_settings(tmp_path / "mixed.mcap")
    assert "#   /scene  foxglove.SceneUpdate (protobuf)  " in settings


def test_a_file_without_topics_of_ros_is_refused_in_one_line(tmp_path: Path) -> None:
    with (tmp_path / "scene.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "foxglove")
        for encoding in ("protobuf", "json"):
            schema = writer.register_schema("foxglove.SceneUpdate", {"json": "jsonschema"}.get(encoding, encoding), b"")
            writer.add_message(writer.register_channel(f"/{encoding}", encoding, schema), 0, b"", 0)
        writer.finish()
    told = CliRunner().invoke(app, ["slam", str(tmp_path / "scene.mcap"), "--out", str(tmp_path / "run")])
    assert told.exit_code == 2
    assert "has messages in json, protobuf only" in " ".join(told.output.split())


PROTOBUF = {1: "float64", 8: "bool", 9: "string", 12: "uint8[]", 13: "uint32", 14: "uint8", 7: "uint32"}
"""Types of fields by their numbers in descriptors: `bytes` and enumerations are numbers in ROS."""


def fields_of(raw: bytes) -> list[tuple[int, Any]]:
    """Fields of a message in protobuf's encoding, numbers and bytes only."""

    def varint(at: int) -> tuple[int, int]:
        value = shift = 0
        while True:
            value |= (raw[at] & 127) << shift
            at, shift = at + 1, shift + 7
            if raw[at - 1] < 128:
                return value, at

    found, at = [], 0
    while at < len(raw):
        key, at = varint(at)
        value, at = varint(at)
        if key & 7 == 2:
            found.append((key >> 3, raw[at : at + value]))
            at += value
        else:
            found.append((key >> 3, value))
    return found


def test_scenes_are_as_foxglove_defines_them() -> None:
    """Field by field, against the descriptors that Foxglove's own package carries."""
    messages = pytest.importorskip("foxglove.messages", reason="the extra live is not installed")
    stated: dict[str, list[str]] = {}
    for number, file in fields_of(messages.SceneUpdate.get_schema().data):
        assert number == 1
        for kind in (value for field, value in fields_of(file) if field == 4):
            name = next(value.decode() for field, value in fields_of(kind) if field == 1)
            columns = [dict(fields_of(value)) for field, value in fields_of(kind) if field == 2]
            for one in sorted(columns, key=lambda column: column[3]):
                called = one.get(6, b"").decode().rsplit(".", 1)[-1]
                text = PROTOBUF.get(one[5], called) + ("[]" if one[4] == 3 else "")
                stated.setdefault(name, []).append(f"{text} {one[1].decode()}")
    ours = {name.rsplit("/", 1)[-1]: text for name, text in UNSTATED.items() if name.startswith("foxglove_msgs")}
    assert len(ours) == 13
    for name, text in ours.items():
        plain = [re.sub(r"^\w+/", "", line) for line in text.splitlines() if line]
        assert [line.replace("Point[]", "Point3[]").replace("Time ", "Timestamp ") for line in plain] == stated[name]
