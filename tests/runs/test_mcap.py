"""A run as ROS 2 messages, read by another project's reader and by our own."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.errors import MissingExtraError
from evermap.io.bag import read_bag
from evermap.runs.folder import write_run
from evermap.runs.mcap import TOPICS, write_mcap
from evermap.runs.summary import change_dict
from evermap.types import AnyRecording, Recording, SlamResult

sys.path.insert(0, str(Path(__file__).parents[1] / "metrics"))
sys.path.insert(0, str(Path(__file__).parents[1] / "io"))

pytest.importorskip("rosbags", reason="the extra ros is not installed")

Run = tuple[Recording, SlamResult]


@pytest.fixture(scope="module")
def run() -> Run:
    from synthetic_run import make_run, with_changes

    recording, result = make_run(duration_s=60.0)
    return recording, with_changes(result)


@pytest.fixture(scope="module")
def written(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    write_mcap(*run, path)
    return path


@pytest.fixture(scope="module")
def messages(written: Path) -> dict[str, list[Any]]:
    """By topic, as `mcap-ros2-support` decodes them by the types that the file holds."""
    reader = pytest.importorskip("mcap_ros2.reader", reason="mcap-ros2-support is not installed")
    found: dict[str, list[Any]] = {topic: [] for topic in TOPICS}
    for one in reader.read_ros2_messages(str(written)):
        assert one.channel.message_encoding == "cdr"
        assert one.schema.name == TOPICS[one.channel.topic]
        found[one.channel.topic].append(one.ros_msg)
    return found


def stamp_s(header: Any) -> float:
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)


def test_poses_and_their_covariances(messages: dict[str, list[Any]], run: Run) -> None:
    for topic, path in (("/pose", run[1].trajectory), ("/online_pose", run[1].online)):
        found = messages[topic]
        assert np.array([stamp_s(one.header) for one in found]) == pytest.approx(path.stamp_s, abs=1e-9)
        pose = path.pose_world_robot
        at = np.array([[one.pose.pose.position.x, one.pose.pose.position.y] for one in found])
        assert at == pytest.approx(pose[:, :2])
        turn = [one.pose.pose.orientation for one in found]
        heading = Rotation.from_quat([[q.x, q.y, q.z, q.w] for q in turn]).as_euler("xyz")[:, 2]
        assert np.cos(heading - pose[:, 2]) == pytest.approx(np.ones(len(pose)))
        # along the axes of the map: the robot's forward error lies along its heading
        spread = np.array([one.pose.covariance for one in found]).reshape(-1, 6, 6)
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        forward = np.stack([c, s], axis=1)
        along = np.einsum("ni,nij,nj->n", forward, spread[:, :2, :2], forward)
        assert along == pytest.approx(path.covariance[:, 0, 0])
        assert spread[:, 5, 5] == pytest.approx(path.covariance[:, 2, 2])


def test_frames_lead_from_the_map_to_the_sensor(messages: dict[str, list[Any]], run: Run) -> None:
    """`map -> odom -> base_link` is the pose, and the odometry is that alone."""
    recording, result = run
    for one, pose in zip(messages["/tf"], result.trajectory.pose_world_robot, strict=True):
        names = [(part.header.frame_id, part.child_frame_id) for part in one.transforms]
        assert names == [("map", "odom"), ("odom", "base_link")]
        turns = [Rotation.from_quat([q.x, q.y, q.z, q.w]) for q in (p.transform.rotation for p in one.transforms)]
        first, second = (np.array([t.x, t.y, t.z]) for t in (p.transform.translation for p in one.transforms))
        assert (first + turns[0].apply(second))[:2] == pytest.approx(pose[:2], abs=1e-9)
    ((mount,),) = [one.transforms for one in messages["/tf_static"]]
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "sensor")
    assert mount.transform.translation.x == pytest.approx(recording.sensor.mount_robot_sensor[0])


def test_the_map_with_its_beliefs(messages: dict[str, list[Any]], run: Run) -> None:
    landmarks = run[1].landmarks
    (markers,) = zip(*(one.markers for one in messages["/landmarks"]), strict=True)
    found = {one.text: one for one in markers}
    for row, identity in enumerate(landmarks.landmark_id.tolist()):
        one = found[str(identity)]
        assert [one.pose.position.x, one.pose.position.y] == pytest.approx(landmarks.position_m[row])
        assert one.color.a == pytest.approx(landmarks.p_exists[row])
    drawn = {entity.id: entity for one in messages["/scene"] for entity in one.entities}
    assert {f"landmark {identity}" for identity in landmarks.landmark_id.tolist()} <= drawn.keys()


def test_changes_are_lines_and_arrows(messages: dict[str, list[Any]], run: Run) -> None:
    lines = [json.loads(one.data) for one in messages["/changes"]]
    told = sorted(run[1].changes, key=lambda change: change.stamp_to_s)
    assert lines == [json.loads(json.dumps(change_dict(change))) for change in told]
    arrows = [entity for one in messages["/scene"] for entity in one.entities if entity.arrows]
    assert len(arrows) == len(run[1].changes) > 0
    moved = next(k for k, change in enumerate(run[1].changes) if np.linalg.norm(change.displacement_m) > 0.2)
    (arrow,) = next(entity for entity in arrows if entity.id == f"change {moved}").arrows
    turn = arrow.pose.orientation
    shaft = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply(
        [arrow.shaft_length + arrow.head_length, 0.0, 0.0]
    )
    assert shaft[:2] == pytest.approx(run[1].changes[moved].displacement_m)


def test_a_run_is_a_recording_again(written: Path, run: Run) -> None:
    """Detections and odometry, as any bag's."""
    recording = run[0]
    again = read_bag(written)
    seen = recording.detections
    assert again.frames.stamp_s == pytest.approx(recording.frames.stamp_s, abs=1e-6)
    assert np.linalg.norm(again.detections.position_sensor_m, axis=1) == pytest.approx(seen.range_m)
    assert again.detections.landmark_id.tolist() == seen.landmark_id.tolist()
    assert again.odometry is not None
    alone = run[1].dead_reckoning.pose_world_robot
    assert again.odometry.pose_world_robot[:, :2] == pytest.approx(alone[:, :2])


def test_without_rosbags_the_run_is_written_all_the_same(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    from evermap.config import Config, OutputConfig

    wanted = Config(output=OutputConfig(mcap=True, figures=False, report=False))
    summary = write_run(tmp_path / "a", *run, wanted)
    assert any("run.mcap was left out" in one for one in summary["warnings"])
    with pytest.raises(MissingExtraError, match="rosbags"):
        write_run(tmp_path / "b", *run, wanted, mcap=True)
    assert not (tmp_path / "b").exists()


def test_in_space(tmp_path: Path) -> None:
    """Tags turned in space, cameras where they are mounted, by our own reader."""
    from bags import TAGS, path_of, write

    from evermap.config import Config
    from evermap.pipeline import run_slam

    recording: AnyRecording = read_bag(write(tmp_path / "drive", "aruco"))
    result = run_slam(recording, Config())
    write_mcap(recording, result, tmp_path / "run.mcap")
    again = read_bag(tmp_path / "run.mcap")
    assert again.sensors[0].mount_robot_sensor == pytest.approx(recording.sensors[0].mount_robot_sensor)
    assert again.detections.position_sensor_m == pytest.approx(recording.detections.position_sensor_m, abs=1e-9)
    assert again.detections.rotation == pytest.approx(recording.detections.rotation, abs=1e-9)
    assert set(again.detections.landmark_id) == set(TAGS)
    assert again.odometry is not None
    assert again.odometry.pose_world_robot == pytest.approx(np.array([path_of(k) for k in range(len(again.odometry))]))
