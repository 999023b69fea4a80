"""Fixes and accelerations in a bag are worth as much as the same ones in tables beside the recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import START_S, STEPS, Ros, path_of, write, write_floor
from typer.testing import CliRunner

from evermap import run_slam
from evermap.cli.main import app
from evermap.estimate.kind import MeasurementKind, MessageRows
from evermap.estimate.measurements import _ADDED, add_kind, find_kinds
from evermap.geometry import se2, se3
from evermap.io import read_native, write_native
from evermap.io.bag import bag_settings, read_bag, settings_path
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.types import UNKNOWN, Measurements, SpatialRecording
from evermap_studies.sim import BuildingConfig, simulate_building

pytest.importorskip("rosbags", reason="the extra ros is not installed")

ORIGIN = np.radians([48.1, 11.6]), 520.0
LEVER = np.array([0.3, -0.1, 1.2])
ANTENNA = np.append(LEVER, [0.0, 0.0, 0.0, 1.0])
UPSIDE_DOWN = np.array([0.1, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
UP = np.array([0.1, -0.05, np.sqrt(1.0 - 0.1**2 - 0.05**2)])
"""The vertical in the frame of the odometry, which starts on a slope."""
STAND = 30


def geodetic(at: np.ndarray) -> np.ndarray:
    """(K, 3) latitude, longitude [deg] and altitude of points to the east, to the north and above the origin, by
    Newton's method on the ellipsoid.
    """

    def earth(lat: float, lon: float, height: float) -> np.ndarray:
        e2 = 6.69437999014e-3
        normal = 6378137.0 / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
        flat = (normal + height) * np.cos(lat)
        return np.array([flat * np.cos(lon), flat * np.sin(lon), (normal * (1.0 - e2) + height) * np.sin(lat)])

    (lat, lon), height = ORIGIN
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    axes = np.array([east, np.cross(up, east), up])
    found = []
    for point in at:
        wanted, guess = earth(lat, lon, height) + point @ axes, np.array([lat, lon, height])
        for _ in range(8):
            steps = np.diag([1e-6, 1e-6, 1.0])
            slope = np.column_stack([(earth(*(guess + s)) - earth(*(guess - s))) / (2.0 * s.sum()) for s in steps])
            guess = guess - np.linalg.solve(slope, earth(*guess) - wanted)
        found.append([*np.degrees(guess[:2]), guess[2]])
    return np.array(found)


def measured(kind: str, stamp_s: np.ndarray, **columns: np.ndarray) -> Measurements:
    count = len(stamp_s)
    full = {name: np.full(count, value) for name, value in find_kinds()[kind].optional.items()} | columns
    return Measurements(kind, stamp_s, full, np.full(count, UNKNOWN))


def fixes(stamp_s: np.ndarray, antenna: np.ndarray, sigma_m: tuple[float, float]) -> Measurements:
    """The table of the same fixes: relative to the first of them."""
    axes = {f"{name}_m": column for name, column in zip("xyz", (antenna - antenna[0]).T.copy(), strict=True)}
    levers = {f"lever_{name}_m": np.full(len(stamp_s), part) for name, part in zip("xyz", LEVER, strict=True)}
    sigmas = {
        name: np.full(len(stamp_s), sigma) for name, sigma in zip(("sigma_xy_m", "sigma_z_m"), sigma_m, strict=True)
    }
    return measured("gnss", stamp_s, **axes, **levers, **sigmas)


def drive() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (N,), poses (N, 7) by the odometry and places (N, 3) of the antenna, to the east, north and up."""
    stamp_s = START_S + 0.1 * np.arange(STEPS + STAND)
    pose = np.array([path_of(min(k, STEPS - 1)) for k in range(STEPS + STAND)])
    level = se3.exp(np.append(np.zeros(3), np.cross(UP, [0.0, 0.0, 1.0]) / np.sin(np.arccos(UP[2])) * np.arccos(UP[2])))
    turned = se3.compose(se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.7])), level)
    np.testing.assert_allclose(se3.transform(turned, UP), [0.0, 0.0, 1.0], atol=1e-12)
    noise = np.random.default_rng(3).normal(0.0, [0.05, 0.05, 0.1], (len(pose), 3))
    return stamp_s, pose, se3.transform(se3.compose(turned, pose), LEVER) + noise


def readings(imu_frames: tuple[str, ...] = ("imu",), mounted: bool = True) -> Callable[[Ros], list[Any]]:
    """Fixes at 10 Hz and an inertial unit at 50 Hz, with frames, and what a filter made of both."""
    stamp_s, pose, antenna = drive()
    at = geodetic(antenna)

    def further(ros: Ros) -> list[Any]:
        found = [
            ("/fix", "sensor_msgs/NavSatFix", stamp, ros.fix(stamp, tuple(one), (0.05**2, 0.05**2, 0.1**2)))
            for stamp, one in zip(stamp_s, at, strict=True)
        ]
        found += [
            (
                "/fix",
                "sensor_msgs/NavSatFix",
                stamp_s[4] + 0.05,
                ros.fix(stamp_s[4] + 0.05, (0, 7, 0), (1, 1, 1), status=-1),
            )
        ]
        found += [(topic.replace("fix", "gps/filtered"), *rest) for topic, *rest in found]
        for k in range(5 * len(stamp_s)):
            stamp, row = stamp_s[0] + 0.02 * k, k // 5
            driving = row < STEPS
            up = se3.rotation_of(pose[row]).T @ UP
            force = 9.81 * up + (np.array([0.5, 0.3, 0.1]) if driving else 0.0)
            rate = np.array([0.0, 0.0, 0.1 if driving else 0.003])
            turn = se3.rotation_of(UPSIDE_DOWN).T
            for frame in imu_frames:
                one = ros.imu(stamp, turn @ force, turn @ rate, frame)
                found.append((f"/{frame}/data", "sensor_msgs/Imu", stamp, one))
        for frame, mount in [("gps", ANTENNA), *((frame, UPSIDE_DOWN) for frame in imu_frames)] if mounted else ():
            tf = ros.transform(stamp_s[0], "base_link", frame, mount)
            found.append(("/more/tf_static", "tf2_msgs/TFMessage", stamp_s[0], tf))
        return found

    return further


def bag(folder: Path, name: str = "drive", **how: Any) -> Path:
    return write(folder / name, "aruco", stand=STAND, further=readings(**how))


def tables(read: SpatialRecording) -> SpatialRecording:
    """The session of the drive as tables, with the measurements worked out apart."""
    stamp_s, pose, antenna = drive()
    force = 9.81 * (se3.rotation_of(pose[-1]).T @ UP)
    (gravity,) = (table for table in read.measurements if table.kind == "gravity")
    assert len(gravity) == 1
    assert stamp_s[STEPS - 1] < gravity.stamp_s[0] < stamp_s[-1]
    columns = {name: np.array([part]) for name, part in zip(("ax_mps2", "ay_mps2", "az_mps2"), force, strict=True)}
    given = (fixes(stamp_s, antenna, (0.05, 0.1)), measured("gravity", gravity.stamp_s, **columns))
    return replace(read, measurements=given)


@pytest.mark.parametrize("name", ["drive", "drive.bag"])
def test_a_bag_measures_what_the_tables_say(name: str, tmp_path: Path) -> None:
    read = read_bag(bag(tmp_path, name))
    by_kind = {table.kind: table for table in read.measurements}
    assert set(by_kind) == {"gnss", "gravity"}
    for wanted in tables(read).measurements:
        found = by_kind[wanted.kind]
        np.testing.assert_allclose(found.stamp_s, wanted.stamp_s, atol=1e-6)
        assert set(found.columns) == set(wanted.columns)
        for column, values in wanted.columns.items():
            np.testing.assert_allclose(found.columns[column], values, atol=1e-6, err_msg=column)
    (remark,) = (line for line in read.warnings if line.startswith("gnss of /fix"))
    assert "of latitude 48.0999" in remark
    assert "gnss /fix; gravity /imu/data" in read.warnings[0]


def test_a_bag_in_space_and_its_tables_give_the_same_result(tmp_path: Path) -> None:
    read = read_bag(bag(tmp_path))
    write_native(tables(read), tmp_path / "tables")
    found, wanted = run_slam(read), run_slam(read_native(tmp_path / "tables"))
    assert found.trajectory.frame == wanted.trajectory.frame == "gnss"
    np.testing.assert_allclose(found.trajectory.pose_world_robot, wanted.trajectory.pose_world_robot, atol=1e-5)
    np.testing.assert_allclose(found.landmarks.position_m, wanted.landmarks.position_m, atol=1e-5)
    leans = se3.rotation_of(found.trajectory.pose_world_robot[-1])[2] - se3.rotation_of(path_of(STEPS - 1)).T @ UP
    assert np.linalg.norm(leans) < 0.02


def test_a_bag_in_the_plane_and_its_tables_give_the_same_result(tmp_path: Path) -> None:
    recording = simulate_building(BuildingConfig(days=1, patrol_s=60.0), seed=5).sessions[0]
    truth = recording.truth
    assert truth is not None
    stamp_s, pose = truth.stamp_s[::20], truth.pose_world_robot[::20]
    antenna = np.column_stack([se2.transform(pose, LEVER[:2]), np.full(len(pose), LEVER[2])])
    antenna += np.random.default_rng(0).normal(0.0, 0.3, antenna.shape)
    at = geodetic(antenna)

    def further(ros: Ros) -> list[Any]:
        said = [ros.fix(stamp, tuple(one), (0.09, 0.09, 0.09)) for stamp, one in zip(stamp_s, at, strict=True)]
        tf = ros.transform(stamp_s[0], "base_link", "gps", ANTENNA)
        found = [("/fix", "sensor_msgs/NavSatFix", stamp, one) for stamp, one in zip(stamp_s, said, strict=True)]
        return [("/more/tf_static", "tf2_msgs/TFMessage", stamp_s[0], tf), *found]

    by_bag = run_slam(read_bag(write_floor(tmp_path / "floor", recording, further=further)))
    by_tables = run_slam(replace(recording, measurements=(fixes(stamp_s, antenna, (0.3, 0.3)),)))
    assert by_bag.trajectory.frame == by_tables.trajectory.frame == "gnss"
    assert by_bag.trajectory.pose_world_robot.shape[1] == 3
    errors = [evaluate_trajectory(one.trajectory, truth) for one in (by_bag, by_tables)]
    assert errors[0] is not None
    assert errors[1] is not None
    assert errors[0].rmse_m == pytest.approx(errors[1].rmse_m, rel=0.05)
    np.testing.assert_allclose(by_bag.landmarks.position_m, by_tables.landmarks.position_m, atol=0.03)


def test_of_several_sensors_that_measure_the_same_the_settings_name_one(tmp_path: Path) -> None:
    path = bag(tmp_path, imu_frames=("imu", "other"))
    read = read_bag(path)
    assert [table.kind for table in read.measurements] == ["gnss"]
    assert any("gravity of several sensors not read: /imu/data, /other/data" in line for line in read.warnings)
    text = bag_settings(path)
    assert 'gravity = ""' in text
    settings_path(path).write_text(text.replace('gravity = ""', 'gravity = "/other/data"').replace('"/fix"', '""'))
    assert [table.kind for table in read_bag(path).measurements] == ["gravity"]
    settings_path(path).write_text(text.replace('gravity = ""', 'gravity = "/fix"'))
    with pytest.raises(Exception, match=r"'measurements\.gravity': no topic with gravity: '/fix'"):
        read_bag(path)


def test_sensors_without_a_transform_are_told(tmp_path: Path) -> None:
    read = read_bag(bag(tmp_path, mounted=False))
    (gnss,) = read.measurements
    assert gnss.columns["lever_z_m"] == pytest.approx(0.0)
    assert any("no fixed transform to the antenna" in line for line in read.warnings)
    assert any("gravity of /imu/data: no fixed transform" in line for line in read.warnings)


def test_fixes_of_unknown_covariance_have_that_of_the_table(tmp_path: Path) -> None:
    def further(ros: Ros) -> list[Any]:
        stamps = START_S + np.arange(2)
        said = [ros.fix(stamps[0], (48.0, 11.0, np.nan), (9.0, 9.0, 9.0), kind=0)]
        said += [ros.fix(stamps[1], (48.0, 11.0, 500.0), (9.0, 16.0, 25.0), kind=3)]
        return [("/fix", "sensor_msgs/NavSatFix", stamp, one) for stamp, one in zip(stamps, said, strict=True)]

    (gnss,) = read_bag(write(tmp_path / "drive", "aruco", further=further)).measurements
    usual = find_kinds()["gnss"].optional
    assert gnss.columns["sigma_xy_m"] == pytest.approx([usual["sigma_xy_m"], np.sqrt(12.5)])
    assert gnss.columns["sigma_z_m"] == pytest.approx([usual["sigma_z_m"], 5.0])
    assert np.isnan(gnss.columns["z_m"]).tolist() == [True, False]
    assert gnss.columns["x_m"] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_map_keeps_the_measurements_of_a_session(tmp_path: Path) -> None:
    read = read_bag(bag(tmp_path))
    kept = unpack_recording(pack_recording(read))
    assert [table.kind for table in kept.measurements] == ["gnss", "gravity"]
    for found, wanted in zip(kept.measurements, read.measurements, strict=True):
        np.testing.assert_array_equal(found.stamp_s, wanted.stamp_s)
        np.testing.assert_array_equal(found.landmark_id, wanted.landmark_id)
        assert found.columns.keys() == wanted.columns.keys()
        assert all(np.array_equal(found.columns[name], wanted.columns[name]) for name in wanted.columns)
    plain = replace(read, measurements=())
    assert unpack_recording(pack_recording(plain)).measurements == ()


def test_a_check_of_a_bag_counts_its_measurements(tmp_path: Path) -> None:
    checked = CliRunner().invoke(app, ["check", str(bag(tmp_path))])
    assert checked.exit_code == 0, checked.output
    assert f"measurements   {STEPS + STAND} gnss, 1 gravity" in checked.stdout


def test_a_kind_of_a_script_is_read_from_the_messages_that_it_names(tmp_path: Path) -> None:
    def further(ros: Ros) -> list[Any]:
        stamps = START_S + np.array([0.2, 0.1])
        return [
            ("/height", "std_msgs/Float64", stamp, ros.make("std_msgs/Float64", stamp - START_S)) for stamp in stamps
        ]

    of = find_kinds()["floor"]
    add_kind(MeasurementKind(
        "altimeter", "", ("z_m",), of.sigma, "pose", of.linearise, of.optional,
        messages=MessageRows(("Float64",), lambda message: (message.data,)),
    ))  # fmt: skip
    try:
        (read,) = read_bag(write(tmp_path / "drive", "aruco", further=further)).measurements
    finally:
        _ADDED.pop("altimeter")
    assert read.kind == "altimeter"
    assert read.stamp_s == pytest.approx(START_S + np.array([0.11, 0.21]), abs=1e-6)  # when they were recorded
    assert read.columns["z_m"] == pytest.approx([0.1, 0.2])
