"""`evermap convert` and `evermap simulate`: what they write reads back as what it was."""

from __future__ import annotations

import csv
import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.geometry import se3
from evermap.io import read_recording
from evermap.maps.store.measured import pack_recording, unpack_recording
from evermap.types import Recording
from evermap_studies.sim import CLUTTER, DEFAULT_CLASSES, ROOM_DOORS, BuildingConfig, looked_at, simulate_building

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


def test_a_street_is_written_with_who_stood_where(tmp_path: Path) -> None:
    out = tmp_path / "street"
    result = run("simulate", "street", out, "--days", "2", "--sessions-per-day", "2", "--seed", "5", "--json")
    assert result.exit_code == 0, result.stderr
    names = json.loads(result.stdout)["sessions"]
    assert names == ["day00_session00", "day00_session01", "day01_session00", "day01_session01"]
    with (out / "stays_truth.csv").open(encoding="utf-8", newline="") as file:
        stays = list(csv.DictReader(file))
    spans = np.array([[float(stay["from_s"]), float(stay["until_s"])] for stay in stays])
    places = np.array([[float(stay["x_m"]), float(stay["y_m"])] for stay in stays])
    one_of_each = {stay["slot"] for stay in stays}
    for slot in one_of_each:  # one at a time, in turn
        mine = spans[[stay["slot"] == slot for stay in stays]]
        assert (mine[1:, 0] >= mine[:-1, 1]).all()
    for name in names:
        recording = read_recording(out / name)
        assert recording.truth is not None
        assert recording.class_names == ("Car", "Van")
        np.testing.assert_array_equal(recording.truth.stamp_s, recording.frames.stamp_s)
        pose = recording.truth.pose_world_robot[recording.detections.frame]
        at = se3.transform(pose, recording.detections.position_sensor_m)[:, :2]
        there = (spans[:, 0] <= recording.frames.stamp_s[0]) & (spans[:, 1] > recording.frames.stamp_s[-1])
        off = np.linalg.norm(at[:, None] - places[None, there], axis=2).min(axis=0)
        assert off.max() < 0.6  # a parked car is detected at its slot
    assert run("simulate", "street", tmp_path / "no", "--with", "doors").exit_code == 2
    assert run("simulate", "stret", tmp_path / "no").exit_code == 2


def test_a_yard_is_written_with_its_bodies(tmp_path: Path) -> None:
    out = tmp_path / "yard"
    result = run("simulate", "yard", out, "--days", "1", "--moving", "3", "--seed", "2", "--json")
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["sessions"] == ["day00_session00"]
    recording = read_recording(out / "day00_session00")
    with (out / "bodies_truth.csv").open(encoding="utf-8", newline="") as file:
        bodies = list(csv.DictReader(file))
    moved = {int(row["object_id"]) for row in bodies if row["moves"] == "1"}
    assert moved == {0, 1, 2}
    assert set(recording.objects[:, 1].tolist()) == {0, 1, 2, 3, 4, 5}
    np.testing.assert_array_equal(unpack_recording(pack_recording(recording)).objects, recording.objects)
    standing = tmp_path / "standing"
    same = ("--days", "1", "--moving", "3", "--seed", "2")
    assert run("simulate", "yard", standing, *same, "--with", "standing").exit_code == 0
    with (standing / "bodies_truth.csv").open(encoding="utf-8", newline="") as file:
        places = {(row["object_id"], row["x_m"], row["y_m"]) for row in csv.DictReader(file)}
    assert len(places) == 6
    flat = tmp_path / "plane"
    assert run("simulate", "yard", flat, *same, "--with", "plane").exit_code == 0
    seen = read_recording(flat / "day00_session00")
    assert isinstance(seen, Recording)
    assert (flat / "bodies_truth.csv").read_text("utf-8") == (out / "bodies_truth.csv").read_text("utf-8")
    np.testing.assert_array_equal(seen.objects, recording.objects)
    pose = seen.truth.pose_world_robot[seen.detections.frame]
    angle = pose[:, 2] + seen.detections.bearing_rad
    at = pose[:, :2] + seen.detections.range_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    on_walls = ~np.isin(seen.detections.landmark_id, seen.objects[:, 0])
    for name in np.unique(seen.detections.landmark_id[on_walls]):
        assert np.ptp(at[seen.detections.landmark_id == name], axis=0).max() < 2.0
    assert run("simulate", "street", tmp_path / "no", "--plane").exit_code == 2
    assert run("simulate", "street", tmp_path / "no", "--with", "standing").exit_code == 2
    assert run("simulate", "yard", tmp_path / "no", "--with", "doors").exit_code == 2


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


def test_a_building_of_partial_views_says_what_was_looked_at(tmp_path: Path) -> None:
    """The options reach the simulation, and the table is its truth."""
    lengths = ["--patrol-s", "20", "--patrol-s", "30"]
    hard = ["--wing-opens-day", "2", "--with", "doors", "--with", "clutter", "--days", "3", "--seed", "2"]
    assert run("simulate", tmp_path / "hard", *lengths, *hard).exit_code == 0
    config = BuildingConfig(
        days=3, patrol_s=30.0, patrol_lengths_s=(20.0, 30.0), doors=ROOM_DOORS, wing_opens_day=2,
        classes=(*DEFAULT_CLASSES, CLUTTER),
    )  # fmt: skip
    simulation = simulate_building(config, seed=2)
    looks = looked_at(simulation)
    with (tmp_path / "hard" / "looks_truth.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == looks.present.size
    for row, (k, place) in zip(rows, np.ndindex(looks.present.shape), strict=True):
        assert row["session"] == f"day{k:02d}_session00"
        assert int(row["landmark_id"]) == looks.landmark_id[place]
        assert [float(row["x_m"]), float(row["y_m"])] == looks.position_m[place].tolist()
        assert [row["present"], row["looked_at"]] == [str(int(x[k, place])) for x in (looks.present, looks.looked_at)]
        assert float(row["p_seen"]) == pytest.approx(looks.p_seen[k, place], abs=1e-6)
    for folder, expected in zip(sorted((tmp_path / "hard").glob("day*")), simulation.sessions, strict=True):
        np.testing.assert_array_equal(read_recording(folder).detections.range_m, expected.detections.range_m)
