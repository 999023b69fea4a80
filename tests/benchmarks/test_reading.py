"""What the benchmark of reading lifts into space is the same drive. No time is asserted."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import evermap as em
from evermap.cli.bench import load_benchmarks
from evermap.geometry import se2, se3
from evermap.geometry.group import accumulate
from evermap.io import write_native
from evermap.types import SpatialRecording
from evermap_studies.sim import WarehouseConfig, simulate_warehouse


def test_a_drive_in_space_sees_the_same_places_and_is_read_back(tmp_path: Path) -> None:
    load_benchmarks()
    from benchmarks.reading import in_space

    planar = simulate_warehouse(WarehouseConfig(n_landmarks=30))
    spatial = in_space(planar)
    seen, driven = planar.detections, planar.odometry
    twist = np.column_stack([driven.forward_mps, driven.lateral_mps, driven.angular_radps])
    pose = accumulate(se2.exp(twist[:-1] * np.diff(driven.stamp_s)[:, None]))
    row = np.searchsorted(driven.stamp_s, planar.frames.stamp_s[seen.frame] - 1e-9)
    ray = seen.range_m[:, None] * np.column_stack([np.cos(seen.bearing_rad), np.sin(seen.bearing_rad)])
    assert spatial.odometry is not None
    place = se3.transform(spatial.odometry.pose_world_robot[row], spatial.detections.position_sensor_m)
    np.testing.assert_allclose(place[:, :2], se2.transform(pose[row], ray), atol=1e-9)
    np.testing.assert_array_equal(place[:, 2], 0.0)
    read = em.read_recording(write_native(spatial, tmp_path / "space"))
    assert isinstance(read, SpatialRecording)
    np.testing.assert_array_equal(read.detections.position_sensor_m, spatial.detections.position_sensor_m)
    assert read.odometry is not None
    np.testing.assert_array_equal(read.odometry.pose_world_robot, spatial.odometry.pose_world_robot)
