"""The MRCLAM table against a second computation from the files, which shares no code with the first."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from evermap.errors import ConfigError, InputError
from evermap_studies import commands
from evermap_studies.mrclam import study as mrclam

Table = dict[str, Any]


@pytest.fixture(scope="module")
def made(made_up_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Table, Path]:
    out = tmp_path_factory.mktemp("results") / "mrclam"
    return mrclam.reproduce(made_up_data, out), out


def row_of(table: Table, robot: int, setting: str) -> dict[str, Any]:
    (row,) = [row for row in table["rows"] if (row["robot"], row["setting"]) == (robot, setting)]
    return row


def load(folder: Path, name: str) -> np.ndarray:
    return np.loadtxt(folder / "MRCLAM_Dataset6" / name)


def turned(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def fitted(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation, shift and angle that bring points onto others: complex least squares."""
    a = (source - source.mean(axis=0)) @ [1, 1j]
    b = (target - target.mean(axis=0)) @ [1, 1j]
    angle = float(np.angle(np.vdot(a, b)))
    return turned(angle), target.mean(axis=0) - turned(angle) @ source.mean(axis=0), angle


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def scored(path: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Errors of a path (stamp, x, y, theta) at 2 Hz stamps of the truth, by linear interpolation."""
    inside = truth[(truth[:, 0] >= path[0, 0]) & (truth[:, 0] <= path[-1, 0])]
    ticks = np.arange(inside[0, 0], inside[-1, 0] + 1e-6, 0.5)
    truth = inside[np.unique([np.argmin(np.abs(inside[:, 0] - tick)) for tick in ticks])]
    at = np.column_stack([np.interp(truth[:, 0], path[:, 0], path[:, k]) for k in (1, 2)])
    heading = np.interp(truth[:, 0], path[:, 0], np.unwrap(path[:, 3]))
    rotation, shift, angle = fitted(at, truth[:, 1:3])
    off = at @ rotation.T + shift - truth[:, 1:3]
    turn = np.angle(np.exp(1j * (heading + angle - truth[:, 3])))
    return {"stamp": truth[:, 0], "off": np.hypot(*off.T), "turn": turn, "rotation": rotation, "shift": shift}


def tum(path: Path) -> np.ndarray:
    rows = np.loadtxt(path)
    return np.column_stack([rows[:, 0], rows[:, 1], rows[:, 2], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])])


@pytest.mark.parametrize("setting", ["calibrated", "plain", "true_map"])
@pytest.mark.parametrize("robot", [1, 2])
def test_errors_are_those_of_the_files(made: tuple[Table, Path], made_up_data: Path, robot: int, setting: str) -> None:
    table, out = made
    row, run = row_of(table, robot, setting), out / "runs" / f"dataset6-robot{robot}-{setting}"
    found = scored(tum(run / "trajectory.tum"), load(made_up_data, f"Robot{robot}_Groundtruth.dat"))
    assert row["pose_rmse_m"] == pytest.approx(rms(found["off"]), rel=2e-3)
    assert row["heading_rmse_deg"] == pytest.approx(np.degrees(rms(found["turn"])), rel=2e-3)

    seen = np.unique(load(made_up_data, f"Robot{robot}_Measurement.dat")[:, 0])
    near = np.min(np.abs(found["stamp"][:, None] - seen), axis=1) <= 1.0
    assert row["in_view_share"] == pytest.approx(near.mean())
    assert row["heading_in_view_deg"] == pytest.approx(np.degrees(rms(found["turn"][near])), rel=2e-3)
    assert row["longest_blind_s"] == pytest.approx(np.diff(seen).max())

    survey = {int(k): at for k, *at in load(made_up_data, "Landmark_Groundtruth.dat")[:, :3]}
    mapped = pq.read_table(run / "map.parquet").to_pydict()
    off = [
        np.linalg.norm(found["rotation"] @ [x, y] + found["shift"] - survey[landmark])
        for landmark, x, y, hits in zip(*(mapped[k] for k in ("landmark_id", "x_m", "y_m", "n_hits")), strict=True)
        if hits >= 10
    ]
    assert row["landmark_rmse_m"] == pytest.approx(rms(np.array(off)), rel=2e-3)
    assert row["landmarks_scored"] == len(off)


@pytest.mark.parametrize("robot", [1, 2])
def test_odometry_row_is_the_odometry_integrated(made: tuple[Table, Path], made_up_data: Path, robot: int) -> None:
    odometry = load(made_up_data, f"Robot{robot}_Odometry.dat")
    start = load(made_up_data, f"Robot{robot}_Measurement.dat")[0, 0]
    odometry = odometry[odometry[:, 0] >= start - 1e-6]
    step = np.diff(odometry[:, 0])
    theta = np.concatenate([[0.0], np.cumsum(step * odometry[:-1, 2])])
    middle = 0.5 * (theta[1:] + theta[:-1])
    x, y = (np.concatenate([[0.0], np.cumsum(step * odometry[:-1, 1] * f(middle))]) for f in (np.cos, np.sin))
    path = np.column_stack([odometry[:, 0], x, y, theta])
    path = path[path[:, 0] <= load(made_up_data, f"Robot{robot}_Measurement.dat")[-1, 0] + 1e-6]
    found = scored(path, load(made_up_data, f"Robot{robot}_Groundtruth.dat"))
    row = row_of(made[0], robot, "odometry")
    assert row["pose_rmse_m"] == pytest.approx(rms(found["off"]), rel=1e-2)
    assert row["heading_rmse_deg"] == pytest.approx(np.degrees(rms(found["turn"])), rel=1e-2)


def test_means_and_verdicts(made: tuple[Table, Path]) -> None:
    table = made[0]
    for mean in table["means"]:
        group = [row for row in table["rows"] if row["setting"] == mean["setting"]]
        assert mean["robots"] == [1, 2]
        for key in ("pose_rmse_m", "heading_rmse_deg", "in_view_share"):
            assert mean[key] == pytest.approx(0.5 * (group[0][key] + group[1][key]))
    verdict = {(row["setting"], row["key"], row["statistic"]): row for row in table["expected"]}
    poses = [row_of(table, robot, "calibrated")["pose_rmse_m"] for robot in (1, 2)]
    assert verdict["calibrated", "pose_rmse_m", "max"]["measured"] == max(poses)
    assert verdict["calibrated", "pose_rmse_m", "mean"]["measured"] == pytest.approx(sum(poses) / 2)
    for row in table["expected"]:
        if "at_most" in row:
            assert row["met"] is (row["measured"] <= row["at_most"])
        else:
            assert row["met"] is (row["measured"] >= row["at_least"])


def test_made_up_robots_are_found(made: tuple[Table, Path]) -> None:
    """Sanity of the whole: mapping beats odometry, the given map beats mapping, sightings beat blindness."""
    table = made[0]
    for robot in (1, 2):
        default, given = row_of(table, robot, "calibrated"), row_of(table, robot, "true_map")
        assert default["pose_rmse_m"] < 0.15
        assert default["pose_rmse_m"] < 0.5 * row_of(table, robot, "odometry")["pose_rmse_m"]
        assert given["landmark_rmse_m"] < 0.04
        assert default["bound_pose_rmse_m"] < default["pose_rmse_m"]
        assert default["bound_heading_rmse_deg"] < default["heading_rmse_deg"] + 0.2
    assert row_of(table, 1, "calibrated")["longest_blind_s"] > 11.0


def test_markdown_is_made_of_whole_tables_with_the_numbers_in_them(made: tuple[Table, Path]) -> None:
    table, out = made
    text = mrclam.as_markdown(table)
    assert (out / "table.md").read_text(encoding="utf-8") == text + "\n"
    blocks = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert len(blocks) == 4
    for block in blocks:
        assert len({line.count("|") for line in block}) == 1
        assert re.fullmatch(r"\| ---( \| ---:)+ \|", block[1])
        assert all(line.startswith("| ") and line.endswith(" |") for line in block)
    errors = [line.split(" | ") for line in blocks[1] if line.startswith("| unknown map | 2 |")]
    assert [cells[2] for cells in errors] == [f"{row_of(table, 2, 'calibrated')['pose_rmse_m']:.3f}"]
    assert "nan" not in text
    assert "None" not in text


def test_the_folder_tells_the_same(made: tuple[Table, Path]) -> None:
    table, out = made
    assert json.loads((out / "summary.json").read_text()) == table
    there = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert there == table["outputs"]
    assert (out / "mrclam.png").read_bytes().startswith(b"\x89PNG")
    for row in table["rows"]:
        if row["setting"] != "odometry":
            run = out / "runs" / f"dataset6-robot{row['robot']}-{row['setting']}"
            assert json.loads((run / "summary.json").read_text())["metrics"]["pose_rmse_m"] == row["pose_rmse_m"]
    assert table["machine"]["cores_used"] > 0.0


def test_missing_recordings_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no MRCLAM_Dataset6.zip.*--data"):
        mrclam.reproduce(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_foreign_files_stay(made_up_data: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(ConfigError, match=r"thesis\.tex"):
        mrclam.reproduce(made_up_data, tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "precious"


def test_interrupt_leaves_the_older_reproduction(
    made: tuple[Table, Path], made_up_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (made[1] / "summary.json").read_bytes()
    calls: list[tuple[float, float]] = []

    def stop(done_s: float, total_s: float) -> None:
        calls.append((done_s, total_s))
        if len(calls) > 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="nothing was written"):
        mrclam.reproduce(made_up_data, made[1], progress=stop)
    assert (made[1] / "summary.json").read_bytes() == before
    assert all(0.0 <= done_s <= total_s for done_s, total_s in calls)


@pytest.mark.slow
@pytest.mark.data
def test_one_real_robot(shared_data: Path, tmp_path: Path) -> None:
    """Robot 3 of the real data set 6, from an unknown map: the limits that every robot must keep."""
    with zipfile.ZipFile(shared_data / "mrclam" / "MRCLAM_Dataset6.zip") as archive:
        for member in archive.namelist():
            if not re.search(r"Robot[1245]_", member):
                archive.extract(member, tmp_path)
    table = mrclam.reproduce(tmp_path, tmp_path / "out")
    default, given = row_of(table, 3, "calibrated"), row_of(table, 3, "true_map")
    assert default["pose_rmse_m"] < 0.13
    assert default["landmark_rmse_m"] < 0.08
    assert default["pose_rmse_m"] < 0.5 * row_of(table, 3, "plain")["pose_rmse_m"]
    assert given["pose_rmse_m"] < 0.045
    assert row_of(table, 3, "odometry")["pose_rmse_m"] > 10 * default["pose_rmse_m"]
    assert default["heading_in_view_deg"] < default["heading_rmse_deg"]


def test_command_prints_the_table(
    made_up_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = {"rows": [], "means": [], "expected": []}
    asked: dict[str, Any] = {}

    def fake(data: Path, out: Path, **options: Any) -> dict[str, Any]:
        asked.update(data=data, out=out, **options)
        return table

    monkeypatch.setattr(mrclam, "reproduce", fake)
    commands.mrclam(made_up_data, tmp_path / "out", everything=True, as_json=True)
    assert json.loads(capsys.readouterr().out) == table
    assert asked["everything"] is True
    assert asked["data"] == made_up_data
