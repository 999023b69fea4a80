"""CPU seconds of everyday work: reading tables, a recording from its tables to its result, a whole command.

`python -m benchmarks.reading` prints a table; rows whose recordings are not in `../shared/data` are left out. What is
read or run in this process is so once before, and takes the least of `TURNS`; a command is a process of its own, with
its imports, and is run once before, so that its kernels are compiled.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import evermap as em
from benchmarks.scale import DLR, dlr_recording, spent
from evermap.geometry import se2
from evermap.geometry.group import accumulate
from evermap.io import write_native
from evermap.io.spatial import spatial_detections
from evermap.types import UNKNOWN, Recording, SpatialOdometry, SpatialRecording, SpatialSensor
from evermap_studies.sim import WarehouseConfig, simulate_warehouse

LANDMARKS = 4_000
"""In the warehouse whose tables are read: 27 MB as CSV."""
TURNS = 3
TAGS = DLR.parent / "tagslam" / "test_11"


class Row(NamedTuple):
    """What was done, CPU seconds, and at most how many are wanted; None for no bound."""

    name: str
    cpu_s: float
    bound_s: float | None = None


def in_space(recording: Recording) -> SpatialRecording:
    """Return a recording of a robot on a floor as one in space: points ahead of the sensor, poses by odometry."""
    seen, driven = recording.detections, recording.odometry
    at = np.column_stack([seen.range_m * np.cos(seen.bearing_rad), seen.range_m * np.sin(seen.bearing_rad)])
    twist = np.column_stack([driven.forward_mps, driven.lateral_mps, driven.angular_radps])
    x, y, heading = accumulate(se2.exp(twist[:-1] * np.diff(driven.stamp_s)[:, None])).T
    pose = np.zeros((len(driven), 7))
    pose[:, 0], pose[:, 1], pose[:, 5], pose[:, 6] = x, y, np.sin(heading / 2.0), np.cos(heading / 2.0)
    detections = spatial_detections(
        seen.frame, landmark_id=seen.landmark_id, position_sensor_m=np.column_stack([at, np.zeros(len(at))])
    )
    odometry = SpatialOdometry(driven.stamp_s, pose, np.full((len(pose), 6), np.nan))
    return SpatialRecording("in space", odometry, recording.frames, detections, (SpatialSensor(),))


def tables(n_landmarks: int = LANDMARKS) -> Iterator[Row]:
    """Yield what reading the tables of a warehouse takes: CSV, gzipped CSV and Parquet, in the plane and in space."""
    planar = simulate_warehouse(WarehouseConfig(n_landmarks=n_landmarks))
    with tempfile.TemporaryDirectory() as temporary:
        for where, recording in (("plane", planar), ("space", in_space(planar))):
            for kind in ("csv", "csv.gz", "parquet"):
                folder = Path(temporary) / f"{where}-{kind}"
                write_native(recording, folder, "parquet" if kind == "parquet" else "csv")
                size_mb = sum(file.stat().st_size for file in folder.iterdir()) / 1e6
                if kind == "csv.gz":
                    subprocess.run(["gzip", "-1", *folder.glob("*.csv")], check=True)
                cpu_s = _least(partial(em.read_recording, folder))
                yield Row(f"read {size_mb:.0f} MB, {where}, {kind}", cpu_s, None if kind == "parquet" else 0.6)


def dlr() -> Iterator[Row]:
    """Yield what DLR takes with its identities, and without."""
    if not DLR.is_dir():
        return
    recording = dlr_recording()
    yield Row("DLR: read", _least(dlr_recording))
    yield Row("DLR: run_slam, identities given", _least(lambda: em.run_slam(recording)), 1.5)
    unknown = np.full(len(recording.detections), UNKNOWN)
    nameless = replace(recording, detections=replace(recording.detections, landmark_id=unknown))
    config = em.Config(slam={"unknown_ids": True})
    yield Row("DLR: run_slam, identities unknown", _least(lambda: em.run_slam(nameless, config), turns=1))


def whole_command(folder: Path = TAGS) -> Iterator[Row]:
    """Yield what `evermap slam` of a TagSLAM recording takes, from the start of Python to the last figure."""
    if not folder.is_dir():
        return
    with tempfile.TemporaryDirectory() as temporary:

        def command(name: str) -> float:
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            words = [sys.executable, "-m", "evermap", "slam", str(folder), "--out", str(Path(temporary) / name)]
            subprocess.run(words, check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

        command("first")
        yield Row(f"evermap slam {folder.name}", command("second"), 5.0)


def _least(work: Callable[[], Any], turns: int = TURNS) -> float:
    """CPU seconds."""
    work()
    return min(spent(work).cpu_s for _ in range(turns))


if __name__ == "__main__":
    print("| work | CPU seconds | wanted |\n|---|---:|---:|")
    for row in chain(tables(), dlr(), whole_command()):
        wanted = "" if row.bound_s is None else f"≤ {row.bound_s:g}"
        print(f"| {row.name} | {row.cpu_s:.2f} | {wanted} |", flush=True)
