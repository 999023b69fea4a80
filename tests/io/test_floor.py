"""A bag of a robot on a floor is worth as much as the tables of the same session, and what is no robot on a floor."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import TILTED, write_floor

from evermap import check_recording, run_localization, run_session, run_slam
from evermap.config import Config
from evermap.errors import ConfigError, DataError
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.slam.orientations import without_unmeasured
from evermap.slam.plane import in_its_space
from evermap.types import UNKNOWN, Measurements, Recording, SlamResult, SpatialRecording
from evermap_studies.sim import BuildingConfig, simulate_building

pytest.importorskip("rosbags", reason="the extra ros is not installed")

DEFAULT = Config().slam


@cache
def days() -> tuple[Recording, ...]:
    return simulate_building(BuildingConfig(days=3, patrol_s=60.0), seed=5).sessions


def measured(recording: Recording, sigma_rad: float = 0.05) -> Callable[[int, int], np.ndarray]:
    """Orientations of tags that stand still, in the frame of the camera, with noise."""
    random, truth = np.random.default_rng(1), recording.truth
    assert truth is not None
    columns = (truth.pose_world_robot[:, 0], truth.pose_world_robot[:, 1], np.unwrap(truth.pose_world_robot[:, 2]))
    at = np.column_stack([np.interp(recording.frames.stamp_s, truth.stamp_s, column) for column in columns])
    eye = se3.compose(se3.from_plane(at), TILTED)
    heading = random.uniform(-3.0, 3.0, 1000)

    def rotation(frame: int, row: int) -> np.ndarray:
        tag = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, heading[recording.detections.landmark_id[row]]]))
        seen = se3.compose(se3.inverse(eye[frame]), tag)
        return se3.compose(seen, se3.exp(np.append(np.zeros(3), random.normal(0.0, sigma_rad, 3))))[3:]

    return rotation


def bag(folder: Path, day: int = 0, **how: Any) -> SpatialRecording:
    recording = read_recording(write_floor(folder / f"bag{day}", days()[day], **how))
    assert isinstance(recording, SpatialRecording)
    return recording


def error_m(result: SlamResult, day: int) -> float:
    truth = days()[day].truth
    assert truth is not None
    errors = evaluate_trajectory(result.trajectory, truth)
    assert errors is not None
    return errors.rmse_m


@pytest.mark.parametrize(("day", "kind"), [(0, "objects"), (1, "tags")])
def test_a_bag_is_worth_as_much_as_the_tables(day: int, kind: str, tmp_path: Path) -> None:
    how = {"rotation": measured(days()[day])} if kind == "tags" else {}
    found = run_slam(bag(tmp_path, day, kind=kind, **how))
    tables = run_slam(days()[day])
    assert error_m(found, day) == pytest.approx(error_m(tables, day), rel=0.05)
    assert any("estimated in the plane" in line for line in found.warnings)


def test_sessions_of_bags_and_tables_share_a_map(tmp_path: Path) -> None:
    first = run_session(days()[0])
    second = run_session(bag(tmp_path, 1), first.living)
    assert second.found
    assert second.recording.dim == 2
    by_tables = run_session(days()[1], first.living)
    assert [one.landmark_ids for one in second.changes] == [one.landmark_ids for one in by_tables.changes]
    here = run_localization(bag(tmp_path, 2), second.living)
    there = run_localization(days()[2], second.living)
    np.testing.assert_allclose(here.trajectory.pose_world_robot[-1], there.trajectory.pose_world_robot[-1], atol=0.02)


def test_orientations_that_nobody_measured_are_left_out_with_one_line(tmp_path: Path) -> None:
    with_robot = {
        "default": (None, r"all \d+ are the default"),
        "constant": (lambda _, __: np.array([0.5, -0.5, 0.5, 0.5]), r"all \d+ are the same"),
        "noisy": (
            lambda frame, row: se3.exp(np.append(np.zeros(3), 0.02 * np.sin([frame, row, frame + row])))[3:],
            "turn with the robot",
        ),
    }
    for name, (rotation, words) in with_robot.items():
        found = without_unmeasured(bag(tmp_path / name, rotation=rotation), DEFAULT.check)
        assert np.isnan(found.detections.rotation).all(), name
        assert [line for line in found.warnings if "orientations" in line] == [found.warnings[-1]]
        assert re.search(words, found.warnings[-1]), found.warnings
    for sigma_rad in (0.05, 0.3):
        honest = bag(tmp_path / f"honest{sigma_rad}", kind="tags", rotation=measured(days()[0], sigma_rad))
        assert without_unmeasured(honest, DEFAULT.check) is honest


def with_floor(recording: SpatialRecording, **columns: np.ndarray) -> SpatialRecording:
    """Return a recording with heights, and tilts, that were measured beside, once a second; a few are wrong."""
    count = len(columns["z_m"])
    stamp_s = recording.frames.stamp_s[0] + np.arange(count)
    columns["z_m"] = columns["z_m"] + np.where(np.arange(count) % 30 == 7, 3.0, 0.0)
    table = Measurements("floor", stamp_s, columns, np.full(count, UNKNOWN))
    return replace(recording, measurements=(table,))


def test_only_a_robot_on_a_floor_is_in_the_plane(tmp_path: Path) -> None:
    recording = bag(tmp_path)
    odometry = recording.odometry
    assert odometry is not None
    assert isinstance(in_its_space(recording, DEFAULT), Recording)
    assert isinstance(in_its_space(recording, DEFAULT, dim=3), SpatialRecording)
    assert isinstance(in_its_space(recording, Config(slam={"plane": False}).slam), SpatialRecording)
    beside = {"z_m": 0.7 + 0.01 * np.sin(np.arange(60.0))}
    assert isinstance(in_its_space(with_floor(recording, **beside), DEFAULT), Recording)
    for ramp in (beside["z_m"] + 0.01 * np.arange(60.0), np.full(60, 0.7)):
        leaning = {"up_x": 0.1 * np.sin(0.2 * np.arange(60.0))} if np.ptp(ramp) == 0.0 else {}
        assert isinstance(in_its_space(with_floor(recording, z_m=ramp, **leaning), DEFAULT), SpatialRecording)
    sway = 0.05 * np.sin(np.arange(len(odometry)))
    climbs = odometry.pose_world_robot + 0.01 * np.arange(len(odometry))[:, None] * np.eye(7)[2]
    rolls = se3.compose(odometry.pose_world_robot, se3.exp(sway[:, None] * np.eye(6)[3]))
    for pose in (climbs, rolls):
        other = replace(recording, odometry=replace(odometry, pose_world_robot=pose))
        assert isinstance(in_its_space(other, DEFAULT), SpatialRecording)
    lying = replace(recording.sensors[0], mount_robot_sensor=(0.0, 0.0, 0.0, 0.5, -0.5, 0.5, 0.5))
    assert isinstance(in_its_space(replace(recording, sensors=(lying,)), DEFAULT), SpatialRecording)
    assert isinstance(in_its_space(replace(recording, odometry=None), DEFAULT), SpatialRecording)
    with pytest.raises(ConfigError, match=r"slam\.plane.*without odometry"):
        in_its_space(replace(recording, odometry=None), Config(slam={"plane": True}).slam)


@pytest.mark.parametrize(
    ("how", "unit"),
    [({"unit": 1e3}, "millimetres"), pytest.param({"odometry_unit": 1e3}, "millimetres", marks=pytest.mark.slow)],
)
def test_units_of_a_bag_are_checked(how: dict[str, float], unit: str, tmp_path: Path) -> None:
    recording = bag(tmp_path, 0, **how)
    check = check_recording(recording)
    assert not check.usable
    assert unit in check.findings[0].message
    first = run_session(days()[1])
    for living in (None, replace(first.living, session_start_s=-np.inf)):
        with pytest.raises(DataError, match=unit):
            run_session(recording, living)
