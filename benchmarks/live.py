"""A robot that drives for an hour with the live engine: latency of a step, memory, share of a core.

Landmarks stand in a disc, a hundred always in view, in a map of 1,000 or 10,000; detections come 30 times a second,
odometry 50 times. What it takes of a core is its time, that of the processes that enter sessions included, over the
time that was driven. Fed as fast as it takes the readings, what is done beside the steps is done beside more of them:
latencies are those of `--paced`.

    python -m benchmarks.live                                 # an hour each: memory, share of a core
    python -m benchmarks.live --minutes 6 --size 1000 --paced # latency
    python -m benchmarks.live --minutes 6 --size 1000 --zenoh # of `evermap live`, from message to message
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from evermap.config import Config
from evermap.geometry import se2
from evermap.io.rosbag import ros2_types, stamp_of
from evermap.live.wires import Mailbox, Zenoh
from evermap.maps.living import LivingMap
from evermap.maps.store import Provenance, RevisionKind, open_store
from evermap.maps.vicinity import in_chunks
from evermap.runs.mcap import Ros, in_space
from evermap.types import Clock, FloatArray, IntArray, Landmarks, Sensor

SIZES = (1_000, 10_000)
IN_VIEW = 100
RANGE_M = 6.0
RADIUS_M, SPEED_MPS = 10.0, 1.0
FRAME_S, ODOMETRY_S = 1 / 30, 1 / 50
P_DETECT = 0.9
SIGMA = np.array([0.05, 0.02])
SIGMA_MAP_M = 0.03
SENSOR = Sensor(range_max_m=RANGE_M, p_detect=P_DETECT, sigma_range_m=0.05, sigma_bearing_rad=0.02)
START_S = 1000.0
"""Stamp of the first message over Zenoh: to ROS 0 is none."""
WARM_UP = 60
"""Frames at the beginning that are not timed: the start pose is searched for."""


def survey(size: int, seed: int = 0) -> tuple[FloatArray, Landmarks]:
    """(L, 2) where landmarks stand, and where the map has them."""
    rng = np.random.default_rng(seed)
    away = RANGE_M * np.sqrt((np.arange(size) + 0.5) / IN_VIEW)
    turn = rng.uniform(-np.pi, np.pi, size)
    landmark = np.column_stack([away * np.cos(turn), away * np.sin(turn)])
    known = landmark + rng.normal(0.0, SIGMA_MAP_M, landmark.shape)
    return landmark, Landmarks.at(np.arange(size), known, sigma_m=SIGMA_MAP_M)


def frames(
    landmark: FloatArray, seconds: float, seed: int = 1
) -> Iterator[tuple[float, FloatArray, IntArray, FloatArray]]:
    """Stamp, true pose, ids and readings of each frame: rounds in the middle."""
    rng = np.random.default_rng(seed)
    near = np.flatnonzero(np.hypot(*landmark.T) < RADIUS_M + RANGE_M)
    for k in range(int(seconds / FRAME_S)):
        stamp_s = k * FRAME_S
        turned = SPEED_MPS * stamp_s / RADIUS_M
        pose = np.array([RADIUS_M * np.cos(turned), RADIUS_M * np.sin(turned), turned + 0.5 * np.pi])
        seen = se2.transform(se2.inverse(pose), landmark[near])
        reading = np.column_stack([np.hypot(*seen.T), np.arctan2(seen[:, 1], seen[:, 0])])
        rows = np.flatnonzero(
            (np.abs(reading[:, 0] - 0.5 * RANGE_M - 0.2) < 0.5 * RANGE_M - 0.2) & (rng.random(len(near)) < P_DETECT)
        )
        yield stamp_s, pose, near[rows], reading[rows] + SIGMA * rng.normal(size=(len(rows), 2))


def drive(size: int, seconds: float, *, mapping: bool, known: bool = True, paced: bool = False) -> dict[str, Any]:
    """One row of the table; `known=False` begins without a map."""
    landmark, surveyed = survey(size)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "site.evermap"
        with open_store(path, create=True) as store:
            if known:
                living = in_chunks(LivingMap.begun(surveyed), Config().living)
                store.commit(living, Provenance(kind=RevisionKind.EDIT), parent=store.head())
                del living
        engine = em.Engine(path, SENSOR, Config(), mapping=mapping, clock=Clock.RECORDING)
        engine.warm_up()
        before = _cpu_s()
        row = _driven(engine, landmark, seconds, paced=paced)
        engine.close()  # waits for sessions that are being entered
        row["core"] = (_cpu_s() - before - row.pop("drawing_s")) / seconds
        with open_store(path) as store:
            row["revision"] = store.head()
    return {"map": size if known else 0, "mapping": mapping, "minutes": seconds / 60, **row}


def _driven(engine: em.Engine, landmark: FloatArray, seconds: float, *, paced: bool) -> dict[str, Any]:
    rng = np.random.default_rng(2)
    step_s, busy_s, off_m, memory, n_seen, odometry_s = [], [], [], [], [], 0.0
    drawing = 0.0
    last, start = time.process_time(), time.perf_counter()
    changes = 0
    for stamp_s, pose, names, reading in frames(landmark, seconds):
        drawing += time.process_time() - last
        if paced:
            time.sleep(max(stamp_s - (time.perf_counter() - start), 0.0))
        while odometry_s <= stamp_s + 0.11:  # detections come a tenth of a second late, as from a camera
            slip = rng.normal(size=2) * [0.02, 0.01]
            engine.odometry(odometry_s, SPEED_MPS + slip[0], 0.0, SPEED_MPS / RADIUS_M + slip[1])
            odometry_s += ODOMETRY_S
        engine.detections(stamp_s, names, reading[:, 0], reading[:, 1])
        began, busy = time.perf_counter(), time.thread_time()
        now = engine.step()
        step_s.append(time.perf_counter() - began)
        busy_s.append(time.thread_time() - busy)
        changes += len(now.changes)
        n_seen.append(len(now.in_view))
        if now.frame == "prior_map" and len(now.online):
            off_m.append(np.hypot(*(now.online.pose_world_robot[-1, :2] - pose[:2])))
        if len(step_s) % 1800 == 0:
            memory.append((_memory_mb(), engine.n_bytes / 1e6))
        last = time.process_time()
    ms = 1e3 * np.array(step_s[WARM_UP:])
    return {
        "in_view": float(np.mean(n_seen[WARM_UP:])),
        "median_ms": float(np.median(ms)),
        "p99_ms": float(np.quantile(ms, 0.99)),
        "p999_ms": float(np.quantile(ms, 0.999)),
        "max_ms": float(ms.max()),
        "own_p99_ms": 1e3 * float(np.quantile(busy_s[WARM_UP:], 0.99)),
        "drawing_s": drawing,
        "rmse_cm": 100 * float(np.sqrt(np.mean(np.square(off_m[WARM_UP:])))) if len(off_m) > WARM_UP else float("nan"),
        "memory_mb": [round(memory[0][0]), round(memory[len(memory) // 2][0]), round(memory[-1][0])] if memory else [],
        "readings_mb": max((one[1] for one in memory), default=float("nan")),
        "changes": changes,
    }


class _Poses(Mailbox):
    """How long after the odometry that tells of it each pose comes back from the bridge [s]."""

    def __init__(self) -> None:
        super().__init__(ours=True)
        self.sent: dict[int, float] = {}
        self.late_s: list[float] = []
        self._types = ros2_types()

    def put(self, topic: str, kind: str, raw: bytes, source: object) -> None:  # noqa: ARG002
        """Take a message of the bridge."""
        if topic.endswith("/pose"):
            stamp_s = stamp_of(self._types.deserialize_cdr(raw, kind))
            if (sent := self.sent.pop(round(stamp_s / ODOMETRY_S), None)) is not None:
                self.late_s.append(time.perf_counter() - sent)


def over_zenoh(size: int, seconds: float, *, known: bool) -> dict[str, Any]:
    """Latency of `evermap live`, a process of its own, at the robot's end of Zenoh; its memory and share of a core."""
    landmark, surveyed = survey(size)
    poses = _Poses()
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        path, sensor = Path(folder) / "site.evermap", Path(folder) / "sensor.toml"
        if known:
            with open_store(path, create=True) as store:
                living = in_chunks(LivingMap.begun(surveyed), Config().living)
                store.commit(living, Provenance(kind=RevisionKind.EDIT), parent=store.head())
        sensor.write_text(
            f"[limits]\nrange_max_m = {RANGE_M}\n[detection]\np_detect = {P_DETECT}\n[noise]\n"
            f"sigma_range_m = {SIGMA[0]}\nsigma_bearing_rad = {SIGMA[1]}\n"
        )
        free.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        free.close()
        wire = Zenoh(f"listen={where}", poses)
        command = [sys.executable, "-m", "evermap", "live", path, "--sensor", sensor, "--zenoh", where]
        bridge = subprocess.Popen([str(part) for part in command], stdout=subprocess.DEVNULL)
        _wait_until_idle(bridge.pid)
        used_s, start, memory = _used_s(bridge.pid), time.perf_counter(), []
        for stamp_s, topic, kind, raw in _messages(landmark, seconds):
            time.sleep(max(stamp_s - (time.perf_counter() - start), 0.0))
            if topic == "/odom":
                poses.sent[round((START_S + stamp_s) / ODOMETRY_S)] = time.perf_counter()
            wire.send(topic, kind, raw, 0)
            if len(memory) * 60.0 <= stamp_s:
                memory.append(round(_memory_mb(bridge.pid)))
        core = (_used_s(bridge.pid) - used_s) / seconds
        bridge.send_signal(signal.SIGTERM)
        bridge.wait()
        wire.close()
    ms = 1e3 * np.array(poses.late_s[int(5.0 / ODOMETRY_S) :])  # after the topics are guessed
    level = dict(
        zip(("median_ms", "p99_ms", "p999_ms", "max_ms"), np.quantile(ms, [0.5, 0.99, 0.999, 1.0]), strict=True)
    )
    return {"map": size if known else 0, "minutes": seconds / 60, "poses": len(ms), **level, "core": core, "mb": memory}


def _messages(landmark: FloatArray, seconds: float) -> Iterator[tuple[float, str, str, bytes]]:
    """What the robot publishes, by when: odometry at once, detections a tenth of a second late."""
    ros, rng, here, driven_s = Ros(ros2_types()), np.random.default_rng(2), se2.identity(), 0.0
    for stamp_s, _, names, reading in frames(landmark, seconds):
        while driven_s <= stamp_s + 0.1:
            odometry = ros.odometry(START_S + driven_s, in_space(here[None])[0])
            yield driven_s, "/odom", "nav_msgs/msg/Odometry", _raw(ros, odometry, "nav_msgs/msg/Odometry")
            slip = rng.normal(size=2) * [0.02, 0.01]
            step = np.array([SPEED_MPS + slip[0], 0.0, SPEED_MPS / RADIUS_M + slip[1]])
            here, driven_s = se2.compose(here, se2.exp(step * ODOMETRY_S)), driven_s + ODOMETRY_S
        found, header = [], ros.header(START_S + stamp_s, "base_link")
        for name, (range_m, bearing) in zip(names.tolist(), reading.tolist(), strict=True):
            at = np.array([range_m * np.cos(bearing), range_m * np.sin(bearing), 0.0, 0.0, 0.0, 0.0, 1.0])
            what = ros.make("vision_msgs/ObjectHypothesis", "", 1.0)
            result = ros.make("vision_msgs/ObjectHypothesisWithPose", what, ros.spread(at, np.zeros((6, 6))))
            box = ros.make("vision_msgs/BoundingBox3D", ros.pose(at), ros.vector(np.zeros(3)))
            found.append(ros.make("vision_msgs/Detection3D", header, [result], box, str(name)))
        kind = "vision_msgs/msg/Detection3DArray"
        yield (
            stamp_s + 0.1,
            "/detections",
            kind,
            _raw(ros, ros.make("vision_msgs/Detection3DArray", header, found), kind),
        )


def _raw(ros: Ros, message: Any, kind: str) -> bytes:
    return bytes(ros.types.serialize_cdr(message, kind))


def _used_s(pid: int) -> float:
    """Time that a process and those that it has waited for took."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _wait_until_idle(pid: int) -> None:
    """Wait until a process that loads, or compiles, kernels has done so."""
    before, used_s = -np.inf, 0.0
    while used_s - before > 0.05:
        time.sleep(5.0)
        before, used_s = used_s, _used_s(pid)


def _cpu_s() -> float:
    own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def _memory_mb(pid: int | str = "self") -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    """Print a row for each map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--size", type=int, nargs="*", default=list(SIZES))
    parser.add_argument("--localize", action="store_true", help="the map stays as it is")
    parser.add_argument("--unknown", action="store_true", help="begin without a map")
    parser.add_argument("--paced", action="store_true", help="as fast as the robot drives, not as fast as it goes")
    parser.add_argument("--zenoh", action="store_true", help="`evermap live`, at the pace of the robot")
    given = parser.parse_args()
    for size in given.size:
        known, seconds = not given.unknown, 60 * given.minutes
        if given.zenoh:
            row = over_zenoh(size, seconds, known=known)
        else:
            row = drive(size, seconds, mapping=not given.localize, known=known, paced=given.paced)
        shown = (f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values())
        print(" ".join(f"{name}={value}" for name, value in zip(row, shown, strict=True)), flush=True)


if __name__ == "__main__":
    main()
