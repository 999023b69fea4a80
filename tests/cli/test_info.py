"""`evermap info`: the same numbers as the readers have, of everything that evermap reads or writes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from evermap.cli.main import app
from evermap.io import read_landmarks, read_recording, write_template
from evermap.maps.store import open_store

QUICK = ["--set", "output.figures=false", "--set", "output.report=false"]


def run(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording, its run, its map, and what verbs write as examples."""
    folder = tmp_path_factory.mktemp("info")
    write_template(folder / "rec")
    write_template(folder / "flight", in_space=True)
    for arguments in (
        ("map", "enter", folder / "site.evermap", folder / "rec", "--out", folder / "run"),
        ("slam", folder / "flight", "--out", folder / "flown", "--set", "output.mcap=true", *QUICK),
        ("map", "export", folder / "site.evermap", "--out", folder / "map.geojson", "--lifetimes", folder / "l.json"),
        ("init", "looks", folder / "looks.csv"),
        ("init", "detections", folder / "detections.csv"),
    ):
        done = run(*arguments)
        assert done.exit_code == 0, done.output
    return folder


def told(path: Path) -> dict[str, Any]:
    done = run("info", path, "--json")
    assert done.exit_code == 0, done.output
    content: dict[str, Any] = json.loads(done.stdout)
    shown = run("info", path)
    assert shown.exit_code == 0, shown.output
    assert len(shown.stdout.splitlines()) < 45
    assert max(map(len, shown.stdout.splitlines())) < 200
    return content


def test_recordings(place: Path) -> None:
    for name, fmt in (("rec", "native"), ("flight", "native")):
        found, recording = told(place / name), read_recording(place / name)
        assert (found["kind"], found["format"]) == ("recording", fmt)
        assert found["detections"]["count"] == len(recording.detections)
        assert found["frames"]["count"] == len(recording.frames)
        assert recording.truth is not None
        assert found["truth_poses"] == len(recording.truth)


def test_a_bag_and_its_topics(place: Path) -> None:
    found = told(place / "flown" / "run.mcap")
    assert found["kind"] == "bag"
    assert found["topics"]["/odom"] == {"type": "nav_msgs/msg/Odometry", "messages": found["odometry"]["rows"]}
    assert found["warnings"][0].startswith("topics as guessed")


def test_a_run_tells_what_its_summary_says(place: Path) -> None:
    found = told(place / "run")
    summary = json.loads((place / "run" / "summary.json").read_text())
    assert found["kind"] == "run"
    assert found["metrics"] == summary["metrics"]
    assert sorted(found["files"]) == [name for name in summary["outputs"] if (place / "run" / name).is_file()]
    assert found["missing"] == []
    assert told(place / "run" / "summary.json")["metrics"] == summary["metrics"]


def test_a_living_map(place: Path) -> None:
    found = told(place / "site.evermap")
    with open_store(place / "site.evermap") as store:
        living = store.load()
    assert (found["kind"], found["revisions"], found["sessions"]) == ("living map", 1, 1)
    landmarks = living.landmarks(p_least=0.5)
    assert found["landmarks"] == len(landmarks) == sum(found["classes"].values())
    assert found["from_m"] == pytest.approx(landmarks.position_m.min(axis=0))


def test_landmarks_tables_lifetimes_and_trajectories(place: Path) -> None:
    for name in ("map.geojson", "run/map.parquet", "rec/landmarks.csv"):
        found = told(place / name)
        assert found["kind"] == "landmarks", name
        assert found["landmarks"] == len(read_landmarks(place / name))
    assert "evermap persist" in told(place / "looks.csv")["table"]
    assert "evermap track" in told(place / "detections.csv")["table"]
    assert told(place / "l.json")["kind"] == "lifetimes"
    assert told(place / "run" / "trajectory.tum")["poses"] > 10


def test_a_grid(place: Path) -> None:
    assert run("map", "export", place / "site.evermap", "--out", place / "keep.yaml").exit_code == 0
    found = told(place / "keep.yaml")
    assert (found["kind"], found["cell_m"], found["mode"]) == ("grid", 0.05, "scale")
    assert found["width"] * found["height"] == len((place / "keep.pgm").read_bytes().split(b"\n", 3)[3])


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none", None, "no such file"),
        ("a.bin", b"\0\1\2", "is not a file that evermap reads"),
        ("a.csv", b"", "a.csv"),
        ("a.json", b"{", "is not JSON"),
        ("a.evermap", b"SQLite format 3\0" + b"x" * 100, "a.evermap"),
        ("summary.json", b"[]", "not a summary written by evermap"),
        ("a.yaml", b"image: nothing.pgm\nresolution: 0.1\n", "a grid whose image cannot be read"),
        ("b.yaml", b"a: [\n", "b.yaml"),
        ("a.bag", b"#ROSBAG V2.0\n", "cannot be read as a bag"),
    ],
)
def test_a_mistake_is_one_line(name: str, content: bytes | None, words: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    done = run("info", tmp_path / name)
    assert done.exit_code == 2, done.output
    assert len(done.stderr.splitlines()) == 1
    assert words in done.stderr


def test_a_run_is_told_without_loading_numbers(place: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from evermap.cli.info import _ask\n"
        f"_ask(Path({str(place / 'run')!r}), None)\n"
        "print(sorted({'numpy', 'scipy', 'numba', 'pyarrow'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
