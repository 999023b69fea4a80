"""TagSLAM folders and bags, object recordings, and the YAML that they are calibrated in."""

from __future__ import annotations

import bz2
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evermap.errors import InputError, MissingExtraError
from evermap.io import list_robots, read_prior_map, read_recording, reader_for
from evermap.io.tagslam import read_tagslam
from evermap.io.yaml import parse_yaml
from evermap.types import SpatialRecording, landmark_id_of

Files = dict[str, str]


def read(path: Path) -> SpatialRecording:
    recording = read_recording(path)
    assert isinstance(recording, SpatialRecording)
    return recording


def test_tags_of_two_cameras(lay_out: Callable, tagslam: Files) -> None:
    recording = read(lay_out(tagslam))
    assert recording.name == "TagSLAM MRCLAM_Test"
    assert recording.warnings == ("1 tag with more than 2 wrong bits left out",)
    np.testing.assert_array_equal(recording.frames.stamp_s, [0.0, 0.5, 1.0])
    assert recording.frames.complete
    seen = recording.detections
    np.testing.assert_array_equal(seen.frame, [1, 1, 2])
    np.testing.assert_array_equal(seen.sensor, [0, 1, 0])
    np.testing.assert_array_equal(seen.landmark_id, [7, 7, 7])
    np.testing.assert_array_equal(seen.tag_size_m, 0.3)
    np.testing.assert_array_equal(seen.source_line, [2, 3, 4])
    # 60 px of 400 px focal length: 0.3 m wide at 2 m; head on, its z axis towards the camera
    np.testing.assert_allclose(seen.position_sensor_m, [[0.4, 0.1, 2], [0.2, 0.1, 2], [0.4, 0.1, 2]], atol=1e-6)
    np.testing.assert_allclose(np.abs(seen.rotation), [[1, 0, 0, 0]] * 3, atol=1e-4)
    at = np.array([sensor.mount_robot_sensor[:3] for sensor in recording.sensors])[seen.sensor]
    np.testing.assert_allclose(seen.position_sensor_m + at, [[0.5, 0.1, 2]] * 3, atol=1e-6)
    assert recording.sensors[1].resolution_px == (640, 480)


def test_odometry_is_that_of_the_rig(lay_out: Callable, tagslam: Files) -> None:
    """The odometry's body is 0.5 m ahead of the rig, and turned by a quarter: against matrices of scipy."""
    odometry = read(lay_out(tagslam)).odometry
    assert odometry is not None
    mount = np.eye(4)
    mount[:3, :3], mount[0, 3] = Rotation.from_euler("z", np.pi / 2).as_matrix(), 0.5
    for row, pose in enumerate(odometry.pose_world_robot):
        body = np.eye(4)
        body[0, 3] = 0.1 * row
        rig = body @ np.linalg.inv(mount)
        np.testing.assert_allclose(pose[:3], rig[:3, 3], atol=1e-12)
        np.testing.assert_allclose(Rotation.from_quat(pose[3:]).as_matrix(), rig[:3, :3], atol=1e-12)
    # x of the rig is -y of the odometry's frame
    np.testing.assert_allclose(odometry.variance[0], [0.02, 0.01, 0.03, 2e-4, 1e-4, 3e-4], atol=1e-12)


def test_survey_and_reference(lay_out: Callable, tagslam: Files) -> None:
    recording = read(lay_out(tagslam))
    known, truth = recording.true_landmarks, recording.truth
    assert known is not None
    assert known.rotation is not None
    assert known.size_m is not None
    assert truth is not None
    np.testing.assert_allclose(known.rotation, [[0, 0, np.sqrt(0.5), np.sqrt(0.5)]], atol=1e-12)
    np.testing.assert_array_equal(known.size_m, [[0.3, 0.3, 0.0]])
    np.testing.assert_array_equal(truth.pose_world_robot, [[1, 2, 0.5, 0, 0, 0, 1]] * 2)


BAD: dict[str, tuple[str, str, str, str]] = {
    "camera": (
        "detections.csv",
        "cam1",
        "cam2",
        r"detections\.csv:3: field 'camera': no camera 'cam2' in cameras\.yaml",
    ),
    "model": (
        "cameras.yaml",
        "radtan",
        "cubic",
        r"cameras\.yaml: field 'cam0\.distortion_model': unknown camera model",
    ),
    "coefficients": (
        "cameras.yaml",
        "[0.0, 0.0, 0.0, 0.0]",
        "[0.0]",
        r"cameras\.yaml: field 'cam0\.distortion_coeffs': must be a list of 0 or 4 or 5 numbers",
    ),
    "mount": ("camera_poses.yaml", "cam1", "cam3", r"camera_poses\.yaml: field 'cam1': is missing"),
    "number": ("camera_poses.yaml", "x: 0.1", "x: abc", r"camera_poses\.yaml: .*must be numbers"),
    "tab": ("tagslam.yaml", "     is_static", "\tis_static", r"tagslam\.yaml:4: contains a tab"),
    "size": ("survey.csv", "7,0.3", "7,0", r"survey\.csv:2: field 'size_m': 0 where a number greater than zero"),
    "corner": ("detections.csv", "370,290", "370,x", r"detections\.csv:2: field 'v0_px': 'x' is not a number"),
    "tag": ("tagslam.yaml", "id: 7", "id: seven", r"tagslam\.yaml: field 'hall': its tags or board are not described"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_folders_are_refused(name: str, lay_out: Callable, tagslam: Files) -> None:
    file, old, new, message = BAD[name]
    assert old in tagslam[file]
    with pytest.raises(InputError, match=message):
        read_recording(lay_out({**tagslam, file: tagslam[file].replace(old, new)}))


def test_a_tag_of_unknown_size_is_left_out(lay_out: Callable, tagslam: Files) -> None:
    settings = tagslam["tagslam.yaml"].replace("     default_tag_size: 0.3\n", "")
    detections = tagslam["detections.csv"].replace("cam1,7", "cam1,8")
    recording = read(lay_out({**tagslam, "tagslam.yaml": settings, "detections.csv": detections}))
    np.testing.assert_array_equal(recording.detections.landmark_id, [7, 7])
    assert "1 tag of unknown size left out (ids 8)" in recording.warnings


def write_bag(path: Path, tagslam: Files) -> None:
    """The tables as a ROS 1 bag, with the messages of TagSLAM's detector."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    tag = "int32 id\nstring family\nint32 hamming\nint32 border\nint32 bits\ngeometry_msgs/Point center\n"
    store.register(get_types_from_msg(f"{tag}geometry_msgs/Point[4] corners\n", "apriltag_msgs/msg/Apriltag"))
    array = "std_msgs/Header header\napriltag_msgs/Apriltag[] apriltags\n"
    store.register(get_types_from_msg(array, "apriltag_msgs/msg/ApriltagArrayStamped"))
    types = store.types

    def make(name: str, *values: Any) -> Any:
        return types[name](*values)

    def header(stamp_s: float) -> Any:
        return make(
            "std_msgs/msg/Header", 0, make("builtin_interfaces/msg/Time", int(stamp_s), int(stamp_s % 1 * 1e9)), ""
        )

    def point(x: float, y: float, z: float = 0.0) -> Any:
        return make("geometry_msgs/msg/Point", x, y, z)

    def rows(name: str) -> list[list[str]]:
        return [line.split(",") for line in tagslam[name].splitlines()[1:]]

    with Writer(path) as bag:
        kind = "apriltag_msgs/msg/ApriltagArrayStamped"
        topics = {name: bag.add_connection(f"/{name}/tags", kind, typestore=store) for name in ("cam0", "cam1")}
        for stamp, camera, _ in rows("frames.csv"):
            tags = []
            for seen, other, tag_id, hamming, *corner in rows("detections.csv"):
                if (float(seen), other) == (float(stamp), camera):
                    four = [point(*map(float, corner[k : k + 2])) for k in range(0, 8, 2)]
                    name = "apriltag_msgs/msg/Apriltag"
                    tags.append(make(name, int(tag_id), "tf36h11", int(hamming), 1, 6, point(0.0, 0.0), four))
            message = make(kind, header(float(stamp)), tags)
            bag.write(topics[camera], int(float(stamp) * 1e9), store.serialize_ros1(message, kind))
        kind = "nav_msgs/msg/Odometry"
        topic = bag.add_connection("/odom", kind, typestore=store)
        zero = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        still = make("geometry_msgs/msg/TwistWithCovariance", make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36))
        for line in rows("odometry.csv"):
            stamp, x, y, z, qx, qy, qz, qw, *variance = map(float, line)
            turn = make("geometry_msgs/msg/Quaternion", qx, qy, qz, qw)
            covariance = np.diag(variance).ravel()
            pose = make(
                "geometry_msgs/msg/PoseWithCovariance", make("geometry_msgs/msg/Pose", point(x, y, z), turn), covariance
            )
            message = make(kind, header(stamp), "body", pose, still)
            bag.write(topic, int(stamp * 1e9), store.serialize_ros1(message, kind))


@pytest.mark.parametrize("packed", [False, True])
def test_a_bag_says_what_its_tables_say(packed: bool, lay_out: Callable, tagslam: Files) -> None:
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    folder = lay_out(tagslam)
    tables = read(folder)
    bag = folder / "tag_detections.bag"
    write_bag(bag, tagslam)
    if packed:
        (folder / "tag_detections.bag.bz2").write_bytes(bz2.compress(bag.read_bytes()))
        bag.unlink()
        bag = folder / "tag_detections.bag.bz2"
    for name in ("detections.csv", "frames.csv", "odometry.csv"):
        (folder / name).unlink()
    assert reader_for(bag).name == "tagslam"
    assert list_robots(bag) == ()
    recording = read(bag)
    assert recording.source == str(bag)
    assert recording.warnings == tables.warnings
    for part, columns in {
        "detections": ("frame", "sensor", "landmark_id", "corner_px", "position_sensor_m", "rotation", "tag_size_m"),
        "frames": ("stamp_s",),
        "odometry": ("stamp_s", "pose_world_robot", "variance"),
    }.items():
        for column in columns:
            ours, theirs = (getattr(getattr(one, part), column) for one in (recording, tables))
            np.testing.assert_allclose(ours, theirs, atol=1e-12, err_msg=column)


def test_a_folder_with_nothing_but_a_bag(lay_out: Callable, tagslam: Files) -> None:
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    tables = read(lay_out(tagslam))
    folder = lay_out(tagslam)
    write_bag(folder / "tags.bag", tagslam)
    (folder / "detections.csv").unlink()
    assert reader_for(folder).name == "tagslam"
    np.testing.assert_allclose(read(folder).detections.corner_px, tables.detections.corner_px)
    (folder / "more.bag").write_bytes(b"")
    with pytest.raises(InputError, match=r"contains 2 bags: more\.bag, tags\.bag"):
        read_recording(folder)


def test_without_frames_nothing_is_known_of_misses(lay_out: Callable, tagslam: Files) -> None:
    del tagslam["frames.csv"]
    frames = read(lay_out(tagslam)).frames
    assert not frames.complete
    np.testing.assert_array_equal(frames.stamp_s, [0.5, 1.0])


def test_a_survey_is_a_prior_map(lay_out: Callable, tagslam: Files) -> None:
    folder = lay_out(tagslam)
    for path in (folder, folder / "survey.csv"):
        prior = read_prior_map(path, sigma_m=0.1, sigma_rad=0.2)
        assert prior.rotation is not None
        assert prior.size_m is not None
        np.testing.assert_array_equal(prior.landmark_id, [7])
        np.testing.assert_allclose(prior.covariance_m2, [0.01 * np.eye(3)])
        np.testing.assert_allclose(prior.rotation_covariance, [0.04 * np.eye(3)])
        np.testing.assert_allclose(prior.rotation, [[0, 0, np.sqrt(0.5), np.sqrt(0.5)]], atol=1e-12)
        np.testing.assert_array_equal(prior.size_m, [[0.3, 0.3, 0.0]])
    with pytest.raises(InputError, match="must be a positive number of radians"):
        read_prior_map(folder, sigma_rad=0.0)


def test_bags_that_cannot_be_read(lay_out: Callable, tagslam: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = lay_out(tagslam)
    bag = folder / "tag_detections.bag"
    bag.write_bytes(b"#ROSBAG V2.0\nand nothing more")
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    with pytest.raises(InputError, match=r"tag_detections\.bag: cannot be read"):
        read_recording(bag)
    bag.unlink()
    write_bag(bag, tagslam)
    cameras = folder / "cameras.yaml"
    cameras.write_text(cameras.read_text().replace("/tags", "/labels"))
    with pytest.raises(InputError, match=r"none of the topics /cam0/labels.*one of /cam0/tags, /cam1/tags, /odom"):
        read_tagslam(bag)
    assert reader_for(bag).name == "bag"  # a calibration of other topics says nothing of it
    cameras.write_text(cameras.read_text().replace("/labels", "/tags"))
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingExtraError, match=r"tag_detections\.bag: .*pip install evermap\[ros\]"):
        read_recording(bag)


@pytest.mark.data
def test_real_tags_agree_with_the_survey_and_the_bag(shared_data: Path) -> None:
    """By the reference, tags are where they were surveyed, to a few centimetres and degrees, also in orientation."""
    folder = shared_data / "tagslam" / "test_11"
    recording = read(folder)
    assert recording.odometry is not None
    assert (len(recording.frames), len(recording.detections), len(recording.odometry)) == (4500, 3635, 4500)
    seen, truth, known = recording.detections, recording.truth, recording.true_landmarks
    assert truth is not None
    assert known is not None
    assert known.rotation is not None
    row = np.searchsorted(truth.stamp_s, recording.frames.stamp_s[seen.frame] - 1e-3)
    listed = np.isin(seen.landmark_id, known.landmark_id)
    rig = truth.pose_world_robot[row]
    mount = np.array([sensor.mount_robot_sensor for sensor in recording.sensors])[seen.sensor]
    turn, tilt = Rotation.from_quat(rig[:, 3:]), Rotation.from_quat(mount[:, 3:])
    at = turn.apply(tilt.apply(seen.position_sensor_m) + mount[:, :3]) + rig[:, :3]
    place = np.searchsorted(known.landmark_id, seen.landmark_id[listed])
    shift = np.linalg.norm(at[listed] - known.position_m[place], axis=1)
    facing = (turn * tilt * Rotation.from_quat(seen.rotation))[listed]
    angle = (Rotation.from_quat(known.rotation[place]).inv() * facing).magnitude()
    assert np.median(shift) < 0.06
    assert np.median(angle) < 0.06
    pytest.importorskip("rosbags", reason="the extra ros is not installed")
    bag = read(folder / "tag_detections.bag.bz2")
    np.testing.assert_array_equal(bag.detections.landmark_id, seen.landmark_id)
    np.testing.assert_array_equal(bag.detections.frame, seen.frame)
    np.testing.assert_allclose(bag.detections.corner_px, seen.corner_px, rtol=0, atol=6e-4)
    assert bag.odometry is not None
    np.testing.assert_allclose(bag.odometry.pose_world_robot, recording.odometry.pose_world_robot, rtol=0, atol=1e-6)


def test_objects_around_a_camera(lay_out: Callable, ycbv: Files) -> None:
    recording = read(lay_out(ycbv))
    assert recording.class_names == ("001_box", "002_can")
    assert recording.odometry is not None
    np.testing.assert_allclose(recording.odometry.pose_world_robot[:, 0], 0.1 * np.arange(6))
    seen = recording.detections
    np.testing.assert_array_equal(seen.frame, [0, 0, 1, 2, 2, 3, 3, 4, 5, 5])
    np.testing.assert_array_equal(seen.class_id, [0, 1, 1, 0, 1, 0, 1, 1, 0, 1])
    box, can = landmark_id_of("001_box"), landmark_id_of("002_can")
    np.testing.assert_array_equal(seen.landmark_id, np.array([box, can])[seen.class_id])
    assert recording.landmark_names == {box: "001_box", can: "002_can"}
    known = recording.true_landmarks
    assert known is not None
    np.testing.assert_array_equal(known.landmark_id, [can])
    np.testing.assert_allclose(known.position_m, [[1, 0, 2]], atol=1e-9)


def test_a_few_wrong_truths_of_an_object_do_not_matter(lay_out: Callable, ycbv: Files) -> None:
    lines = ycbv["object_truth_002_can.tum"].splitlines()
    lines[2] = "0.2 5 5 5 1 0 0 0"
    known = read(lay_out({**ycbv, "object_truth_002_can.tum": "\n".join(lines)})).true_landmarks
    assert known is not None
    assert known.rotation is not None
    np.testing.assert_allclose(known.position_m, [[1, 0, 2]], atol=1e-5)
    np.testing.assert_allclose(known.rotation, [[0, 0, 0, 1]], atol=1e-5)


def test_bad_objects(lay_out: Callable, ycbv: Files) -> None:
    for name, text, message in (
        (
            "detections_001_box.tum",
            "0.05 1 0 0 0 0 0 1\n",
            r"detections_001_box\.tum:1: field 'stamp_s': is not a stamp",
        ),
        ("detections_001_box.tum", "0 1 0 0 0 0 0 0.5\n", r"detections_001_box\.tum:1: .*is not a unit quaternion"),
        ("odometry.tum", "0 0 0 0 0 0 0 0\n", r"odometry\.tum:1: .*is not a unit quaternion"),
        ("odometry.tum", "", r"odometry\.tum: contains no pose"),
    ):
        with pytest.raises(Exception, match=message):
            read_recording(lay_out({**ycbv, name: text}))
    recording = read(lay_out({**ycbv, "detections_001_box.tum": "0 0 0 0 1 0 0 0\n"}))
    assert "detections_001_box.tum: 1 detection at the camera's own place left out" in recording.warnings


@pytest.mark.data
def test_every_object_recording_is_read(shared_data: Path) -> None:
    """Half of the detections, brought into the world by the true camera, are where the object is, to 0.25 m."""
    for folder in sorted(path for path in (shared_data / "ycbv").iterdir() if path.is_dir()):
        recording = read(folder)
        seen, truth, known = recording.detections, recording.truth, recording.true_landmarks
        assert truth is not None
        assert known is not None
        pose = truth.pose_world_robot[seen.frame]
        at = Rotation.from_quat(pose[:, 3:]).apply(seen.position_sensor_m) + pose[:, :3]
        place = np.searchsorted(known.landmark_id, seen.landmark_id)
        assert np.median(np.linalg.norm(at - known.position_m[place], axis=1)) < 0.25


@pytest.mark.data
def test_boxes_of_a_car_are_a_native_recording(shared_data: Path) -> None:
    recording = read(shared_data / "kitti_tracking" / "0004")
    assert (len(recording.detections), recording.class_names) == (3122, ("Car", "Cyclist", "Pedestrian"))
    assert (recording.detections.landmark_id == -1).all()
    assert np.isfinite(recording.detections.size_m).all()


DOCUMENT = """\
# a comment
a: 1
b:
  - 2.5   # another
  - [1, 2,
     -3e-4]
  -
    c: "a # text: with, marks"
    d: ~
list:
- x: 1
  y: [[1, 2], ['q', true]]
  z: {x: 0, "y": -1.5, at: [1, {b: }, plain text],
    word: http://x}
- plain text
-1.5: key
e: {0}
"""


def test_yaml_is_what_another_reader_says() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    text = DOCUMENT.replace("{0}", "off-road").replace("-3e-4", "-3.0e-4").replace("-1.5: key\n", "")
    assert parse_yaml(text.encode(), Path("x.yaml")) == yaml.safe_load(text)


@pytest.mark.data
def test_real_yaml_is_what_another_reader_says(shared_data: Path) -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    files = sorted((shared_data / "tagslam").glob("*/*.yaml"))
    assert len(files) == 12
    for file in files:
        assert parse_yaml(file.read_bytes(), file) == yaml.safe_load(file.read_bytes()), file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\n  b: 2\n", r"x\.yaml:2: is indented more"),
        ("  a: 1\nb: 2\n", r"x\.yaml:2: is indented less"),
        ("a: 1\na: 2\n", r"x\.yaml:2: field 'a': appears twice"),
        ("a: [1, 2\nb: 3\n", r"x\.yaml:1: opens a bracket"),
        ("a: [1]]\n", r"x\.yaml:1: .*bracket"),
        ("a: {b: 1\nc: 3\n", r"x\.yaml:1: opens a bracket"),
        ("a: {b: 1}}\n", r"x\.yaml:1: text after the last bracket"),
        ("a: {b: 1, b: 2}\n", r"x\.yaml:1: field 'b': appears twice"),
        ("a: {b}\n", r"x\.yaml:1: .*no 'key: value'"),
        ("a: {b: [1}]\n", r"x\.yaml:1: brackets do not match"),
        ("a: [1 [2]]\n", r"x\.yaml:1: brackets do not match"),
        ("a: {b: &name 1}\n", r"x\.yaml:1: .*unsupported YAML"),
        ("a: &name 1\n", r"x\.yaml:1: .*unsupported YAML"),
        ("a: |\n  text\n", r"x\.yaml:1: .*unsupported YAML"),
        ("a: 1\njust words\n", r"x\.yaml:2: .*neither"),
        ("\ta: 1\n", r"x\.yaml:1: contains a tab"),
    ],
)
def test_yaml_that_is_not_read_is_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_yaml(text.encode(), Path("x.yaml"))


@given(st.text(alphabet="ab:-[]{}, \n'\"#1.", max_size=60))
def test_no_yaml_surprises(text: str) -> None:
    """Whatever is written: a value, or one line that says what is wrong."""
    with suppress(InputError):
        parse_yaml(text.encode(), Path("x.yaml"))
