"""Kinds of sensors and data sheets in space set the priors of mounts and scales, and the noise of positions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evermap import read_recording, run_slam
from evermap.config import Config, SensorConfig
from evermap.errors import ConfigError, InputError
from evermap.geometry import se3
from evermap.io import write_native, write_template
from evermap.slam.space.intake import prepare_space, scale_between
from evermap.types import SensorKind, SlamResult, SpatialRecording, SpatialSensor

from .halls import hall


def driven(seed: int = 2, *, odometry: float = 1.0, ranges: float = 1.0, **sheet: object) -> SpatialRecording:
    """A hall with a laser; odometry and ranges with a wrong scale."""
    given = hall(seed, n_frames=300, drift=0.01)
    assert given.odometry is not None
    pose = given.odometry.pose_world_robot * np.array([odometry] * 3 + [1.0] * 4)
    seen = given.detections
    unsaid = np.full_like(seen.covariance_sensor_m2, np.nan)
    return replace(
        given,
        odometry=replace(given.odometry, pose_world_robot=pose),
        detections=replace(seen, position_sensor_m=ranges * seen.position_sensor_m, covariance_sensor_m2=unsaid),
        sensors=tuple(replace(one, **sheet) for one in given.sensors),  # type: ignore[arg-type]
    )


def rmse(recording: SpatialRecording, result: SlamResult) -> float:
    """Position error after the best rigid alignment."""
    assert recording.truth is not None
    rows = np.searchsorted(recording.truth.stamp_s, result.trajectory.stamp_s - 1e-6)
    found, true = result.trajectory.pose_world_robot[:, :3], recording.truth.pose_world_robot[rows, :3]
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, v = np.linalg.svd(found.T @ true)
    return float(np.sqrt(((found @ (u @ v) - true) ** 2).sum(axis=1).mean()))


def told(result: SlamResult, name: str) -> tuple[float, float, float]:
    [one] = [one for one in result.parameters if one.name == name]
    return one.value, one.sigma, one.prior_sigma


@pytest.mark.slow
def test_the_odometers_scale_is_found_with_a_laser() -> None:
    """Without a kind the odometry's metre is trusted where it is 4 % too short."""
    trusting, stated = (run_slam(driven(odometry=1.0 / 1.04, **sheet)) for sheet in ({}, {"kind": SensorKind.LASER}))
    assert rmse(driven(), trusting) > 0.06  # .086: noise that grows with the range takes a part of what it does wrong
    assert rmse(driven(), stated) < 0.02  # .024 where the wrong metre is taken for errors of detections that persist
    value, sigma, _ = told(stated, "odometry_scale")
    assert abs(value - 1.04) < 2.5 * sigma < 0.01


def test_of_a_known_odometer_and_an_unknown_range_sensor_the_odometers_metre_holds() -> None:
    found = run_slam(driven(ranges=1.04, sigma_scale=0.05, sigma_odometer_scale=0.001))
    assert rmse(driven(), found) < 0.03
    value, sigma, prior = told(found, "range_scale")
    assert abs(value - 1.04) < 2.5 * sigma < 0.01
    assert prior == pytest.approx(0.05, rel=1e-3)
    meaning = next(one.meaning for one in found.parameters if one.name == "range_scale")
    assert "sigma_scale" in meaning
    assert "sigma_odometer_scale" in meaning


def test_lengths_that_are_not_known_are_in_every_covariance() -> None:
    sure, unsure = (run_slam(driven(sigma_scale=s, sigma_odometer_scale=s)) for s in (1e-5, 0.02))
    far = np.linalg.norm(sure.landmarks.position_m, axis=1)
    grown = np.trace(unsure.landmarks.covariance_m2 - sure.landmarks.covariance_m2, axis1=1, axis2=2)
    assert np.sqrt(grown[far > 5.0]) == pytest.approx(0.02 / np.sqrt(2.0) * far[far > 5.0], rel=0.1)
    last = [np.trace(run.trajectory.covariance[150, :3, :3]) for run in (sure, unsure)]
    assert last[1] > last[0]


@pytest.mark.slow
def test_a_data_sheet_frees_the_mount() -> None:
    off = np.array([0.1, -0.1, 0.0, 0.02, 0.03, 0.05])
    stated = tuple(se3.exp(off).tolist())
    trusted = run_slam(driven(mount_robot_sensor=stated))
    freed = run_slam(driven(mount_robot_sensor=stated, sigma_position_m=0.1, sigma_angle_rad=0.05))
    right = run_slam(driven(sigma_position_m=0.1, sigma_angle_rad=0.05))
    assert rmse(driven(), freed) < 0.5 * rmse(driven(), trusted)
    assert rmse(driven(), right) < 1.2 * rmse(driven(), run_slam(driven()))
    for axis, true in zip("xyz", -off[3:], strict=True):
        value, sigma, prior = told(freed, f"sensor_mount_r{axis}_rad")
        assert abs(value - true) < 3.0 * sigma
        assert prior == 0.05


def test_the_kind_sets_the_noise_of_positions() -> None:
    settings = Config().slam.space
    laser, camera = (prepare_space(driven(kind=kind), settings).problem for kind in ("laser", "camera"))
    ratio = np.linalg.norm(laser.measured_root, axis=(1, 2)) / np.linalg.norm(camera.measured_root, axis=(1, 2))
    assert ratio.min() > 1.0
    of_kinds = {kind: scale_between((SpatialSensor(kind=kind),), settings, 0.0)[0] for kind in SensorKind}
    assert of_kinds[SensorKind.LASER] < of_kinds[SensorKind.TAG] < of_kinds[SensorKind.CAMERA]
    other = Config(slam={"space": {"kinds": {"laser": [0.1, 0.02, 0.001, 0.003]}}}).slam.space
    assert scale_between((SpatialSensor(kind=SensorKind.LASER),), other, 0.0)[0] > 0.1
    assert set(other.kinds) == set(SensorKind)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_template(tmp_path / "walk", in_space=True)


def with_lines(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(path.read_text("utf-8") + text, encoding="utf-8")
    return folder


def test_kinds_are_read_and_written(folder: Path, tmp_path: Path) -> None:
    with_lines(folder, "sensor.toml", '\n[sensor]\nkind = "camera"\nsigma_scale = 0.01\nsigma_position_m = 0.02\n')
    with_lines(folder, "sensor.toml", "\n[odometry]\nsigma_odometer_scale = 0.03\n")
    with_lines(folder, "camera.toml", '\n[camera.lidar]\nkind = "laser"\nsigma_angle_rad = 0.01\n')
    rows = (folder / "detections.csv").read_text("utf-8").splitlines()
    named = [
        row if row.startswith("#") else f"{row},{'sensor' if row.startswith('stamp') else 'front'}" for row in rows
    ]
    (folder / "detections.csv").write_text("\n".join(named), encoding="utf-8")
    recording = read_recording(folder)
    assert isinstance(recording, SpatialRecording)
    front, lidar = recording.sensors
    assert (front.kind, front.sigma_scale, front.sigma_angle_rad) == (SensorKind.CAMERA, 0.01, None)
    assert (lidar.kind, lidar.sigma_position_m, lidar.sigma_angle_rad) == (SensorKind.LASER, 0.02, 0.01)
    assert {one.sigma_odometer_scale for one in recording.sensors} == {0.03}
    write_native(recording, tmp_path / "again")
    again = read_recording(tmp_path / "again")
    assert isinstance(again, SpatialRecording)
    assert again.sensors == recording.sensors


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "sensor.toml",
            '[sensor]\nkind = "lidar"\n',
            ["sensor.kind", "unknown kind of sensor 'lidar'", "try: laser"],
        ),
        ("sensor.toml", "[sensor]\nsigma_offset_m = 0.1\n", ["sensor.sigma_offset_m", "not used in space", "subtract"]),
        ("sensor.toml", "[odometry]\nsigma_askew_rad = 0.1\n", ["odometry.sigma_askew_rad", "sigma_angle_rad"]),
        ("sensor.toml", "[sensor]\nsigma_scale = -1\n", ["sensor.sigma_scale", "outside"]),
        ("camera.toml", '[camera.b]\nkind = "sonar"\n', ["camera.b.kind", "sonar"]),
        ("camera.toml", "[camera.b]\nsigma_odometer_scale = 0.1\n", ["camera.b.sigma_odometer_scale", "unknown key"]),
    ],
)
def test_what_means_nothing_in_space_is_told(folder: Path, name: str, text: str, words: list[str]) -> None:
    with pytest.raises(InputError) as error:
        read_recording(with_lines(folder, name, f"\n{text}"))
    assert error.value.line is not None
    assert [word for word in (name, *words) if word not in error.value.one_line()] == []


@pytest.mark.slow
def test_settings_of_the_sensor_hold_in_space() -> None:
    given = (SpatialSensor(), SpatialSensor("other", range_max_m=3.0))
    changed = SensorConfig(kind="laser", range_max_m=5.0, sigma_position_m=0.1).apply_in_space(given)
    assert {(one.kind, one.range_max_m, one.sigma_position_m) for one in changed} == {(SensorKind.LASER, 5.0, 0.1)}
    config = Config(sensor={"kind": "laser"})
    assert told(run_slam(driven(odometry=1.0 / 1.04), config), "odometry_scale")[0] == pytest.approx(1.04, abs=0.01)
    for name in ("bearing_max_rad", "sigma_range_m", "sigma_offset_m", "sigma_askew_rad"):
        with pytest.raises(ConfigError, match=rf"sensor\.{name}.*not used for a recording in space \(try: "):
            SensorConfig(**{name: 0.1}).apply_in_space(given)
    with pytest.raises(ConfigError, match=r"mount_robot_sensor.*\[mount\]"):
        run_slam(driven(), Config(sensor={"mount_robot_sensor": (0.0, 0.0, 0.0)}))
    with pytest.raises(ConfigError, match=r"range_min_m.*7 is not below range_max_m = 3"):
        SensorConfig(range_min_m=7.0).apply_in_space(given)
