"""The bridge, between real sessions of Zenoh and with a real client of a WebSocket on this machine."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from feeding import AT_THE_END, SESSIONS, engine, map_of_two, online, stored

import evermap as em
from evermap.config import Config
from evermap.errors import ConfigError
from evermap.io.rosbag import ros2_types
from evermap.live.engine import Now
from evermap.live.feed import run_live
from evermap.maps.living import LivingMap
from evermap.types import Recording, Trajectory, rows_of
from evermap.viz.rerun_scene import LiveScene

zenoh = pytest.importorskip("zenoh", reason="the extra live is not installed")
pytest.importorskip("foxglove", reason="the extra live is not installed")

from evermap.live.ros import Listener, Teller, heard, look_on, play  # noqa: E402
from evermap.live.wires import Foxglove, Mailbox, Wire, Zenoh  # noqa: E402
from evermap.runs.mcap import Ros  # noqa: E402

SPEED = 20.0
"""Times as fast as it was driven."""
QUICK = Config(live={"revision_s": 0.0, "reorder_s": 0.1 * SPEED})
"""What arrives out of order by a tenth of a second, here, too."""
ROBOT = SESSIONS[2]
STRING = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
"""As the documents of rmw_zenoh print it."""


@pytest.fixture(scope="module")
def living(tmp_path_factory: pytest.TempPathFactory) -> LivingMap:
    path = tmp_path_factory.mktemp("map") / "site.evermap"
    path.write_bytes(map_of_two())
    return stored(path)


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A router of Zenoh, at which everybody meets."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    router = Zenoh(f"listen=tcp/127.0.0.1:{port}", None)
    yield f"tcp/127.0.0.1:{port}"
    router.close()


class Bridge:
    """An engine fed by messages in a thread of its own, as `evermap live` does it."""

    def __init__(self, live: em.Engine, wires: Callable[[Mailbox], list[Wire]], topics: Path | None = None) -> None:
        self.engine, self.mailbox = live, Mailbox()
        self.said: list[str] = []
        self.refused: list[str] = []
        self.steps: list[Now] = []
        self.step_s: list[float] = []
        self.heard: list[str] = []
        self.listener = Listener(live.sensor, topics, self.said.append)
        self.wires = wires(self.mailbox)
        self._teller = Teller(live, self.wires)
        self._stop = False
        read = self.listener.readings
        self.listener.readings = lambda message: (self.heard.append(message.topic), read(message))[1]  # type: ignore[method-assign]
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        def going_on() -> Iterator[Any]:
            for reading in heard(self.mailbox, self.listener, self.refused.append):
                if self._stop:
                    return
                began = time.perf_counter()
                yield reading
                self.step_s.append(time.perf_counter() - began)

        def tell(now: Now) -> None:
            self._teller.tell(now, self.listener)
            self.steps.append(now)

        run_live(self.engine, going_on(), tell, self.refused.append)

    def close(self) -> Trajectory:
        """End it when all messages are read; the poses that were told."""
        wait_until(lambda: not len(self.mailbox))
        time.sleep(0.1)
        self._stop = True
        self._thread.join()
        self._teller.close()
        for wire in self.wires:
            wire.close()
        return online(self.steps)


def wait_until(so: Callable[[], bool], seconds: float = 10.0) -> None:
    """At most so long."""
    until = time.monotonic() + seconds
    while not so() and time.monotonic() < until:
        time.sleep(0.02)


def drive(recording: Recording, wire: Any, bridge: Bridge, speed: float = SPEED) -> None:
    """A robot that is not there, from when the bridge hears it until it has heard all."""
    ros, heard = Ros(ros2_types()), len(bridge.heard)
    nothing = bytes(ros.types.serialize_cdr(ros.transforms(1.0, []), "tf2_msgs/msg/TFMessage"))

    def is_heard() -> bool:
        wire.send("/tf", "tf2_msgs/msg/TFMessage", nothing, 0)
        return len(bridge.heard) > heard

    wait_until(is_heard)
    play(recording, [wire], lambda: None, speed=speed)
    last_s = max(recording.frames.stamp_s[-1], recording.odometry.stamp_s[-2])
    wait_until(lambda: bridge.steps[-1].stamp_s > last_s - 0.5, 3.0)


def replayed(living: LivingMap, recording: Recording) -> Trajectory:
    return em.run_localization(recording, living, AT_THE_END).online


def differences(one: Trajectory, other: Trajectory) -> np.ndarray:
    """Of poses at the same stamps, which are most of them."""
    at = np.abs(one.stamp_s[:, None] - other.stamp_s).argmin(axis=1)
    same = np.abs(one.stamp_s - other.stamp_s[at]) < 1e-5
    assert same.sum() > 0.9 * len(other)
    return np.abs(one.pose_world_robot[same] - other.pose_world_robot[at[same]])


class Lossy:
    """A wire that loses some of what it is given; numbers go on, as those of a network."""

    def __init__(self, wire: Any, share: float) -> None:
        self._wire, self._share, self._rng = wire, share, np.random.default_rng(0)
        self.about, self.n_lost = "", 0

    def send(self, topic: str, kind: str, raw: bytes, stamp_ns: int) -> None:
        if topic != "/tf_static" and self._rng.random() < self._share and topic in self._wire._numbers:
            self._wire._numbers[topic] += 1
            self.n_lost += 1
        else:
            self._wire.send(topic, kind, raw, stamp_ns)


def test_poses_over_zenoh_are_those_of_the_replay(living: LivingMap, endpoint: str) -> None:
    live = engine(living, ROBOT, QUICK, mapping=False)
    bridge = Bridge(live, lambda box: [Zenoh(endpoint, box)])
    robot = Zenoh(endpoint, None)
    drive(ROBOT, robot, bridge)
    robot.close()
    path = bridge.close()
    assert bridge.refused == []
    assert bridge.mailbox.n_lost == 0
    assert any("/detections" in line and "/odom" in line for line in bridge.said)
    assert differences(path, replayed(living, ROBOT)).max() < 1e-6


def test_what_is_lost_is_counted_and_borne(living: LivingMap, endpoint: str) -> None:
    live = engine(living, ROBOT, QUICK, mapping=False)
    bridge = Bridge(live, lambda box: [Zenoh(endpoint, box)])
    robot = Zenoh(endpoint, None)
    lossy = Lossy(robot, 0.2)
    drive(ROBOT, lossy, bridge)
    path = bridge.close()
    robot.close()
    assert 0.9 * lossy.n_lost < bridge.mailbox.n_lost <= lossy.n_lost
    assert lossy.n_lost > 200
    true = replayed(living, ROBOT)
    at = np.abs(path.stamp_s[:, None] - true.stamp_s).argmin(axis=1)
    away = np.hypot(*(path.pose_world_robot - true.pose_world_robot[at])[:, :2].T)
    assert np.median(away) < 0.02
    sigma = np.sqrt(np.trace(path.covariance[:, :2, :2], axis1=1, axis2=2))
    assert (away < 4.0 * sigma).all()
    assert not bridge.steps[-1].lost


def half(recording: Recording, second: bool) -> Recording:
    """Of its time; the second half's odometry begins where it does, at its own origin."""
    frames, odometry, seen = recording.frames, recording.odometry, recording.detections
    middle = float(frames.stamp_s[len(frames) // 2])
    rows = np.flatnonzero((frames.stamp_s >= middle + 2.0) if second else (frames.stamp_s < middle))
    kept = np.flatnonzero(np.isin(seen.frame, rows))
    driven = (odometry.stamp_s >= middle + 2.0) if second else (odometry.stamp_s < middle)
    found = rows_of(seen, kept)
    return replace(
        recording,
        frames=rows_of(frames, rows),
        detections=replace(found, frame=found.frame - rows[0]),
        odometry=rows_of(odometry, np.flatnonzero(driven)),
    )


def test_a_robot_whose_odometry_starts_again_is_found_again(living: LivingMap, endpoint: str) -> None:
    """Its poses begin at the origin once more, which is no motion; and the bridge goes on."""
    live = engine(living, ROBOT, QUICK, mapping=False)
    bridge = Bridge(live, lambda box: [Zenoh(endpoint, box)])
    for second in (False, True):
        robot = Zenoh(endpoint, None)
        drive(half(ROBOT, second), robot, bridge)
        robot.close()
    path = bridge.close()
    true = replayed(living, ROBOT)
    late = path.stamp_s > ROBOT.frames.stamp_s[-1] - 5.0
    at = np.abs(path.stamp_s[late][:, None] - true.stamp_s).argmin(axis=1)
    assert late.sum() > 10
    assert np.hypot(*(path.pose_world_robot[late] - true.pose_world_robot[at])[:, :2].T).max() < 0.2


@pytest.mark.slow
def test_a_bridge_and_a_router_that_start_again(living: LivingMap) -> None:
    """The robot drives on meanwhile; nobody has to be started in any order."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    robot = Zenoh(where, None)  # before there is a router
    going = threading.Thread(target=play, args=(ROBOT, [robot], lambda: None), kwargs={"speed": 5.0})
    router = Zenoh(f"listen={where}", None)
    time.sleep(1.5)
    going.start()
    first = Bridge(engine(living, ROBOT, QUICK, mapping=False), lambda box: [Zenoh(where, box)])
    time.sleep(2.5)
    first.close()
    router.close()
    second = Bridge(engine(living, ROBOT, QUICK, mapping=False), lambda box: [Zenoh(where, box)])
    time.sleep(0.5)
    router = Zenoh(f"listen={where}", None)
    going.join()
    path = second.close()
    router.close()
    robot.close()
    assert len(online(first.steps)) > 5
    assert path.stamp_s[-1] > ROBOT.frames.stamp_s[-1] - 4.0  # those in the window wait for what may come
    assert not second.steps[-1].lost


def test_key_and_attachment_are_those_of_rmw_zenoh(living: LivingMap, endpoint: str) -> None:
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    got: list[Any] = []
    with zenoh.open(config) as session:
        session.declare_subscriber("0/**", got.append)
        wire = Zenoh(endpoint, None)
        time.sleep(0.3)
        for _ in range(2):
            wire.send("/evermap/changes", "std_msgs/msg/String", b"\0\1\0\0\2\0\0\0x\0", 0)
        time.sleep(0.3)
        wire.close()
    assert [str(one.key_expr) for one in got] == [f"0/evermap/changes/{STRING}"] * 2
    attached = [bytes(one.attachment) for one in got]
    assert [len(one) for one in attached] == [33, 33]
    assert [struct.unpack_from("<q", one)[0] for one in attached] == [1, 2]
    assert abs(struct.unpack_from("<q", attached[0], 8)[0] - time.time_ns()) < 60e9
    assert attached[0][16] == 16
    assert attached[0][17:] == attached[1][17:] != bytes(16)


def decoded(client: Any) -> dict[str, list[Any]]:
    """What a client got, by another project's decoder and the types that the server tells."""
    from mcap.records import Message, Schema
    from mcap_ros2.decoder import DecoderFactory

    found: dict[str, list[Any]] = {}
    for channel in client.channels.values():
        assert channel["encoding"] == "cdr"
        schema = Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode())
        decode = DecoderFactory().decoder_for("cdr", schema)
        assert decode is not None
        raws = [raw for topic, _, raw in client.received if topic == channel["topic"]]
        found[channel["topic"]] = [decode(raw) for raw in raws]
    assert Message
    return found


def test_a_client_of_the_websocket_is_a_robot_and_a_viewer(living: LivingMap) -> None:
    pytest.importorskip("mcap_ros2", reason="mcap-ros2-support is not installed")
    from websocket import Client

    bridge = Bridge(engine(living, ROBOT, QUICK, mapping=False), lambda box: [Foxglove("127.0.0.1:0", box)])
    (server,) = bridge.wires
    client = Client(server.port)

    class Publisher:
        about = ""
        channels: dict[str, int] = {}  # noqa: RUF012 (one only)

        def send(self, topic: str, kind: str, raw: bytes, stamp_ns: int) -> None:
            if topic not in self.channels:
                self.channels[topic] = len(self.channels) + 1
                said = {"id": self.channels[topic], "topic": topic, "encoding": "cdr", "schemaName": kind}
                client.tell(op="advertise", channels=[said])
            client.publish(self.channels[topic], raw)

    going = threading.Thread(target=drive, args=(ROBOT, Publisher(), bridge))
    going.start()
    while going.is_alive():
        client.listen(0.1)
    for _ in range(3):  # the map is told again every second
        client.listen(1.0)
    client.close()
    path = bridge.close()
    assert bridge.refused == []
    assert differences(path, replayed(living, ROBOT)).max() < 1e-6
    found = decoded(client)
    assert {"/evermap/pose", "/tf", "/evermap/landmarks", "/evermap/scene"} <= found.keys()
    pose = found["/evermap/pose"][-1]
    assert pose.header.frame_id == "map"
    stamp_s = pose.header.stamp.sec + 1e-9 * pose.header.stamp.nanosec
    assert stamp_s == pytest.approx(bridge.steps[-1].stamp_s, abs=1e-6)
    last = bridge.steps[-1].pose_world_robot
    assert [pose.pose.pose.position.x, pose.pose.pose.position.y] == pytest.approx(last[:2].tolist(), abs=1e-6)
    assert {(one.header.frame_id, one.child_frame_id) for tf in found["/tf"] for one in tf.transforms} >= {
        ("map", "odom")
    }
    alpha = {
        one.id: one.spheres[0].color.a for scene in found["/evermap/scene"] for one in scene.entities if one.spheres
    }
    believed = bridge.engine.landmarks()
    assert len(alpha) >= len(believed)
    for name, p in zip(believed.landmark_id.tolist(), believed.p_exists.tolist(), strict=True):
        assert alpha[f"landmark {name}"] == pytest.approx(p, abs=0.03)


def test_nobody_who_reads_slowly_holds_the_engine_up(living: LivingMap, endpoint: str) -> None:
    """A client that never reads with the smallest of buffers, and a subscriber that takes a second for a message."""
    from websocket import Client

    bridge = Bridge(
        engine(living, ROBOT, QUICK, mapping=False), lambda box: [Zenoh(endpoint, box), Foxglove("127.0.0.1:0", box)]
    )
    client = Client(bridge.wires[1].port, buffer=2048)
    client.listen(0.3)
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    with zenoh.open(config) as session:
        session.declare_subscriber("0/evermap/**", lambda _: time.sleep(1.0))
        robot = Zenoh(endpoint, None)
        drive(ROBOT, robot, bridge)
        robot.close()
        path = bridge.close()
    client.close()
    assert bridge.refused == []
    assert bridge.mailbox.n_lost == 0
    assert differences(path, replayed(living, ROBOT)).max() < 1e-6
    assert max(bridge.step_s) < 0.5


def test_a_drive_is_seen_while_it_happens(living: LivingMap, endpoint: str, tmp_path: Path) -> None:
    """Robot and landmarks as the engine tells them, and in a file for rerun."""
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    seen: dict[str, list[Any]] = {"robot": [], "landmark": [], "change": [], "erase": []}
    mailbox, scene = Mailbox(ours=True), LiveScene(tmp_path / "live.rrd")
    viewer, done = Zenoh(endpoint, mailbox), threading.Event()

    class Both:
        def __getattr__(self, name: str) -> Any:
            return lambda *told: (seen[name].append(told), getattr(scene, name)(*told))

    def going_on() -> None:
        if done.is_set():
            raise KeyboardInterrupt

    looking = threading.Thread(target=look_on, args=(mailbox, Both(), going_on))
    looking.start()
    bridge = Bridge(engine(living, ROBOT, QUICK, mapping=False), lambda box: [Zenoh(endpoint, box)])
    robot = Zenoh(endpoint, None)
    drive(ROBOT, robot, bridge)
    robot.close()
    wait_until(lambda: len({name for _, name, *_ in seen["landmark"]}) >= len(bridge.engine.landmarks()), 4.0)
    bridge.close()
    done.set()
    looking.join()
    viewer.close()
    scene.close()
    stamps = np.array([told[0] for told in seen["robot"]])
    assert len(stamps) > 20
    assert (np.diff(stamps) >= 0.0).all()
    assert stamps[-1] > ROBOT.frames.stamp_s[-1] - 5.0
    assert len({name for _, name, *_ in seen["landmark"]}) >= len(bridge.engine.landmarks())
    assert (tmp_path / "live.rrd").stat().st_size > 10_000


@pytest.mark.parametrize("where", ["tcp/localhost", "listen=tcp/[::1]", "udp/127.0.0.1#iface=lo"])
def test_an_endpoint_without_a_port_is_refused_and_not_waited_for(where):
    with pytest.raises(ConfigError, match="names no port"):
        Zenoh(where, None)
