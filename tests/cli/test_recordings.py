"""`evermap convert` and `evermap simulate`: what they write reads back as what it was."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.io import read_recording
from evermap.sim import BuildingConfig, simulate_building

SIMULATION = ["--days", "2", "--sessions-per-day", "2", "--patrol-s", "20", "--seed", "3"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "building"
    result = run("simulate", folder, *SIMULATION, "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["sessions"] == [
        f"day{day:02d}_session{session:02d}" for day in range(2) for session in range(2)
    ]
    return folder


def test_sessions_read_back_as_they_were_simulated(building: Path) -> None:
    config = BuildingConfig(days=2, sessions_per_day=2, patrol_s=20.0)
    simulation = simulate_building(config, seed=3)
    for folder, expected in zip(sorted(building.glob("day*")), simulation.sessions, strict=True):
        recording = read_recording(folder)
        for part in ("odometry", "detections"):
            for column in fields(getattr(expected, part)):
                if column.name != "source_line":
                    np.testing.assert_array_equal(
                        getattr(getattr(recording, part), column.name), getattr(getattr(expected, part), column.name)
                    )
    lines = (building / "changes_truth.jsonl").read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["stamp_s"] for line in lines] == [event.stamp_s for event in simulation.events]
    assert [json.loads(line)["kind"] for line in lines] == [event.kind.value for event in simulation.events]


def test_same_seed_gives_the_same_bytes(building: Path, tmp_path: Path) -> None:
    assert run("simulate", tmp_path / "again", *SIMULATION).exit_code == 0
    assert files(tmp_path / "again") == files(building)
    assert run("simulate", tmp_path / "other", *SIMULATION[:-1], "4").exit_code == 0
    assert files(tmp_path / "other") != files(building)


def test_force_writes_again_and_keeps_what_it_did_not_write(building: Path, tmp_path: Path) -> None:
    assert run("simulate", tmp_path / "out", *SIMULATION).exit_code == 0
    (tmp_path / "out" / "notes.txt").write_text("mine", encoding="utf-8")
    assert run("simulate", tmp_path / "out", *SIMULATION).exit_code == 2
    assert run("simulate", tmp_path / "out", *SIMULATION, "--force").exit_code == 0
    assert files(tmp_path / "out") == files(building) | {"notes.txt": b"mine"}


@pytest.mark.parametrize("table_format", ["csv", "parquet"])
def test_convert_keeps_every_number(building: Path, tmp_path: Path, table_format: str) -> None:
    source = building / "day00_session00"
    result = run("convert", source, tmp_path / "copy", "--format", table_format, "--json")
    assert result.exit_code == 0, result.stderr
    original, copy = read_recording(source), read_recording(tmp_path / "copy")
    assert json.loads(result.stdout)["detections"] == len(original.detections)
    assert (tmp_path / "copy" / f"odometry.{table_format}").is_file()
    np.testing.assert_array_equal(copy.odometry.forward_mps, original.odometry.forward_mps)
    np.testing.assert_array_equal(copy.detections.range_m, original.detections.range_m)
    assert copy.sensor == original.sensor


@pytest.mark.data
def test_convert_of_a_public_recording(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "mrclam" / "MRCLAM_Dataset6.zip"
    result = run("convert", source, tmp_path / "robot1", "--robot", "1")
    assert result.exit_code == 0, result.stderr
    original, copy = read_recording(source, robot=1), read_recording(tmp_path / "robot1")
    np.testing.assert_array_equal(copy.detections.range_m, original.detections.range_m)
    result = run("convert", source, tmp_path / "robot9", "--robot", "9")
    assert result.exit_code == 2
    assert not (tmp_path / "robot9").exists()
