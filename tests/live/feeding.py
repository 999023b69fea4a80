"""A recording as a robot would have fed it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import evermap as em
from evermap.config import Config
from evermap.maps.living import LivingMap
from evermap.maps.store import open_store
from evermap.types import Recording, Trajectory
from evermap_studies.sim import BuildingConfig, simulate_building

SESSIONS = simulate_building(BuildingConfig(days=4, patrol_s=35.0), 3).sessions
AT_THE_END = Config(live={"revision_s": 0.0})


@cache
def map_of_two() -> bytes:
    """The file of a map into which the first two sessions came, as recordings enter."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "site.evermap"
        for recording in SESSIONS[:2]:
            entered(path, recording)
        return path.read_bytes()


Message = tuple[float, str, int]
"""Stamp, 'odometry' or 'frame', and its row."""


def messages(recording: Recording) -> list[Message]:
    """All messages of a recording, by their stamps."""
    odometry = [(float(stamp), "odometry", k) for k, stamp in enumerate(recording.odometry.stamp_s)]
    return sorted([*odometry, *((float(stamp), "frame", k) for k, stamp in enumerate(recording.frames.stamp_s))])


def engine(path: Path | LivingMap, recording: Recording, config: Config = AT_THE_END, **how: Any) -> em.Engine:
    """An engine for a recording's robot, which does everything in its steps."""
    about = {"clock": recording.clock, "class_names": recording.class_names, "name": recording.name}
    return em.Engine(path, recording.sensor, config, **{"beside": False, **about, **how})


def send(to: em.Engine, recording: Recording, message: Message) -> None:
    """Feed one message."""
    stamp_s, kind, row = message
    odometry, seen = recording.odometry, recording.detections
    if kind == "odometry":
        to.odometry(stamp_s, odometry.forward_mps[row], odometry.lateral_mps[row], odometry.angular_radps[row])
        return
    rows = slice(*np.searchsorted(seen.frame, [row, row + 1]))
    to.detections(
        stamp_s,
        seen.landmark_id[rows].tolist(),
        seen.range_m[rows],
        seen.bearing_rad[rows],
        class_name=[recording.class_names[k] if k >= 0 else None for k in seen.class_id[rows]],
        sigma_range_m=seen.sigma_range_m[rows],
        sigma_bearing_rad=seen.sigma_bearing_rad[rows],
    )


def fed(to: em.Engine, recording: Recording, order: list[Message] | None = None) -> Iterator[Any]:
    """Feed all messages, with a step after each frame."""
    for message in messages(recording) if order is None else order:
        send(to, recording, message)
        if message[1] == "frame":
            yield to.step()


def online(steps: list[Any]) -> Trajectory:
    """The poses of all steps."""
    stamps = np.concatenate([one.online.stamp_s for one in steps])
    pose = np.concatenate([one.online.pose_world_robot for one in steps])
    covariance = np.concatenate([one.online.covariance for one in steps])
    return replace(steps[-1].online, stamp_s=stamps, pose_world_robot=pose, covariance=covariance)


def entered(path: Path, recording: Recording, config: Config = AT_THE_END) -> LivingMap:
    """A recording entered into a stored map, as `evermap map enter` does."""
    with open_store(path, create=True) as store:
        em.enter_session(store, recording, config).commit(store, config)
        return store.load()


def stored(path: Path) -> LivingMap:
    """The newest map of a file."""
    with open_store(path) as store:
        return store.load()


def assert_equal(one: LivingMap, other: LivingMap) -> None:
    """Bit by bit."""
    for table in ("members", "sites", "places", "stays"):
        ours, theirs = getattr(one, table), getattr(other, table)
        for name in ours.__dataclass_fields__:
            column, same = getattr(ours, name), getattr(theirs, name)
            if isinstance(column, np.ndarray):
                np.testing.assert_array_equal(column, same, err_msg=f"{table}.{name}")
    np.testing.assert_array_equal(one.covariance_m2, other.covariance_m2)
    assert (one.stamp_s, one.class_names) == (other.stamp_s, other.class_names)
