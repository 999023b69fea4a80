"""`evermap view`: runs and maps as rerun and MCAP show them, by their own readers; what it says without a viewer."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.io import read_landmarks, read_tum, write_template
from evermap.maps.store import open_store

QUICK = ["--set", "output.figures=false", "--set", "output.report=false"]
"""What is shown is made of the other files of a run."""


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view")
    for name, in_space in (("rec", False), ("flight", True)):
        write_template(folder / name, in_space=in_space)
        files = (folder / f"{name}.evermap", folder / name, "--out", folder / f"run-{name}")
        made = run("map", "enter", *files, *QUICK)
        assert made.exit_code == 0, made.output
    return folder


def save(what: Path, out: Path) -> str:
    done = run("view", what, "--save", out, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["out"] == str(out)
    return str(done.stderr)


def entities(path: Path) -> dict[str, int]:
    reader = pytest.importorskip("rerun.chunk")
    found: dict[str, int] = {}
    for chunk in reader.RrdReader(str(path)).stream():
        found[chunk.entity_path] = found.get(chunk.entity_path, 0) + chunk.num_rows
    return found


def messages(path: Path) -> dict[str, int]:
    reader = pytest.importorskip("mcap.reader")
    with path.open("rb") as file:
        summary = reader.make_reader(file).get_summary()
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts.get(number, 0) for number, channel in summary.channels.items()}


@pytest.mark.parametrize("name", ["rec", "flight"])
def test_a_run_is_shown_from_its_files(name: str, place: Path, tmp_path: Path) -> None:
    assert "warning" not in save(place / f"run-{name}", tmp_path / "a.rrd")
    shown = entities(tmp_path / "a.rrd")
    poses = read_tum(place / f"run-{name}" / "trajectory.tum", in_space=True)
    assert shown["/world/robot"] == len(poses)
    marks = [one for one in shown if one.startswith("/world/landmarks/") and one.count("/") == 3]
    assert len(marks) == len(read_landmarks(place / f"run-{name}" / "map.parquet"))
    assert "/world/detections" in shown
    save(place / f"run-{name}", tmp_path / "a.mcap")
    assert messages(tmp_path / "a.mcap")["/pose"] == len(poses)


@pytest.mark.parametrize("name", ["rec", "flight"])
def test_a_map_is_shown_with_its_beliefs(name: str, place: Path, tmp_path: Path) -> None:
    with open_store(place / f"{name}.evermap") as store:
        landmarks = store.load().landmarks()
    save(place / f"{name}.evermap", tmp_path / "a.rrd")
    marks = [one for one in entities(tmp_path / "a.rrd") if one.startswith("/world/landmarks/") and one.count("/") == 3]
    assert len(marks) == len(landmarks)
    save(place / f"{name}.evermap", tmp_path / "a.mcap")
    assert messages(tmp_path / "a.mcap")["/landmarks"] == len(landmarks)


def test_changes_are_those_of_the_run(place: Path, tmp_path: Path) -> None:
    """Back from the summary, with what is null."""
    from evermap.runs.summary import change_dict, change_of
    from evermap.types import ChangeKind, MapChange

    for change in (
        MapChange((3, 4), ChangeKind.MOVED, 1.0, 2.0, (0.5, -1.0), 0.1, 0.9, 3, 4, ("a", "4")),
        MapChange((7,), ChangeKind.VANISHED, float("nan"), 2.0, (float("nan"), float("nan")), 0.0, 0.7),
    ):
        content = json.loads(json.dumps(change_dict(change)))
        assert change_dict(change_of(content)) == content


def test_a_run_whose_recording_is_gone_is_shown_without_it(place: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    copy.mkdir()
    for name in ("trajectory.tum", "map.parquet", "innovations.parquet"):
        (copy / name).write_bytes((place / "run-rec" / name).read_bytes())
    summary = json.loads((place / "run-rec" / "summary.json").read_text())
    summary["recording"]["source"] = str(tmp_path / "nowhere")
    (copy / "summary.json").write_text(json.dumps(summary))
    assert "shown without detections and truth" in save(copy, tmp_path / "a.rrd")
    assert "/world/detections" not in entities(tmp_path / "a.rrd")


def test_what_the_run_has_written_is_taken(place: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "scene.rrd").write_bytes(b"as it was")
    save(tmp_path / "run", tmp_path / "a.rrd")
    assert (tmp_path / "a.rrd").read_bytes() == b"as it was"


def test_the_viewer_is_opened(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    opened = []

    def start(command: list[str], **_: Any) -> None:
        opened.append((command[:3], Path(command[3]).read_bytes()[:4]))

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr("evermap.cli.view.subprocess.run", start)
    done = run("view", place / "rec.evermap")
    assert done.exit_code == 0, done.output
    assert opened == [([sys.executable, "-m", "rerun"], opened[0][1])]
    assert opened[0][1].startswith(b"RR")


def test_without_a_screen_there_is_a_way(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    done = run("view", place / "rec.evermap")
    assert done.exit_code == 2
    assert "no screen to open a viewer on (try: --save scene.rrd)" in done.stderr


@pytest.mark.parametrize("out", [None, "a.rrd"])
def test_without_rerun_it_says_what_to_install(
    out: str | None, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = run("view", place / "rec.evermap", *(() if out is None else ("--save", tmp_path / out)))
    assert done.exit_code == 2
    assert done.stderr.strip().endswith("rerun-sdk, which is not installed (try: pip install 'evermap[rerun]')")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("what", "out", "words"),
    [
        ("nope", "a.rrd", "no such map or run"),
        ("rec", "a.rrd", "is not a run of `slam`"),
        ("rec/odometry.csv", "a.rrd", "is not an evermap map"),
        ("run-rec", "a.png", "cannot write a '.png' file"),
    ],
)
def test_a_mistake_is_one_line(what: str, out: str, words: str, place: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    done = run("view", place / what, "--save", tmp_path / out)
    assert done.exit_code == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_doubt_is_faint(tmp_path: Path) -> None:
    """Colours go from the class's to paper with the probability to exist."""
    reader = pytest.importorskip("rerun.chunk")
    from evermap.runs.view import _nothing, _result
    from evermap.types import Clock, Landmarks, Trajectory
    from evermap.viz.rerun_scene import rgb, write_scene
    from evermap.viz.style import PAPER

    nowhere = Trajectory(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    landmarks = Landmarks.at([1, 2], [[0.0, 0.0], [1.0, 0.0]])
    landmarks.p_exists[:] = [1.0, 0.0]
    write_scene(_nothing("map", Clock.RECORDING), _result(nowhere, nowhere, landmarks), tmp_path / "a.rrd")
    colours = {}
    for chunk in reader.RrdReader(str(tmp_path / "a.rrd")).stream():
        batch = chunk.to_record_batch()
        if "Points3D:colors" in batch.schema.names:
            colours[chunk.entity_path] = batch.column("Points3D:colors").to_pylist()[0][0]
    red, green, blue = rgb(PAPER)
    assert colours["/world/landmarks/2"] == (red << 24) + (green << 16) + (blue << 8) + 255
    assert colours["/world/landmarks/1"] != colours["/world/landmarks/2"]


def test_a_drive_is_kept_for_rerun_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh", reason="the extra live is not installed")
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["view", "tcp/localhost:7447", "--save", "drive.mcap"])
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    assert ".rrd" in result.stderr
