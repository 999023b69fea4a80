"""No verb takes away what its user owns, `--force` or not: what it reads, and what evermap did not write."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.io import read_recording, write_template
from evermap.runs.examples import write_looks
from evermap.runs.folder import MANIFEST


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def snapshot(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two recordings, a table of looks, a configuration, a map and a model of the user's, and the working folder."""
    home = tmp_path / "home"
    for folder in ("rec", "parent/rec"):
        (home / folder).parent.mkdir(parents=True, exist_ok=True)
        write_template(home / folder)
    for folder in ("d", "conf", "out", "empty"):
        (home / folder).mkdir()
    write_looks(home / "d" / "looks.csv")
    (home / "conf" / "mine.toml").write_text("[slam]\nseed = 1\n")
    (home / "out" / "map.parquet").write_bytes(b"a prior map")
    (home / "link").symlink_to(home / "rec")
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    return home


@pytest.mark.parametrize(
    "command",
    [
        "slam {h}/rec --out {h}/rec --force",
        "slam {h}/parent/rec --out {h}/parent --force",
        "slam {h}/rec --out {h}/parent/../rec --force",
        "slam {h}/link --out {h}/rec --force",
        "slam {h}/rec --out {h}/link --force",
        "slam {h}/rec --out {h} --force",
        "slam {r}/rec --out {r}/rec/. --force",
        "slam {h}/rec --config {h}/conf/mine.toml --out {h}/conf --force",
        "slam {h}/rec --prior-map {h}/out/map.parquet --out {h}/out --force",
        "map enter {h}/run/site.evermap {h}/rec --out {h}/run --force",
        "map enter {h}/run/site.evermap {h}/rec --out {h}/run",
        "map enter {h}/empty/site.evermap {h}/rec --out {h}/empty",
        "persist {h}/d/looks.csv --out {h}/d --force",
        "persist {h}/d/looks.csv --set model={h}/out/model.json --out {h}/out --force",
        "persist {h}/d/looks.csv --truth {h}/out/truth.csv --out {h}/out --force",
        "init looks {h}/d/looks.csv",
        "track {h}/d/looks.csv --out {h}/d --force",
        "track {h}/rec/detections.csv --confusion {h}/out/confusion.csv --out {h}/out --force",
        "init detections {h}/d/looks.csv",
        "convert {h}/rec {h}/rec --force",
        "convert {h}/parent/rec {h}/parent --force",
        "reproduce mrclam --data {h}/rec --out {h}/rec --force",
        "reproduce presence --data {h}/d --out {h}/d --force",
        "reproduce rosen2016 --data {h}/d --out {h} --force",
        "survival learn {h}/d/looks.csv --out {h}/d/looks.csv",
        "survival learn {h}/d/looks.csv --out {h}/rec/sensor.toml",
        "survival fit {h}/d/looks.csv --out {h}/d/looks.csv",
        "init recording {h}/rec",
        "simulate {h}/rec",
        "convert {h}/rec {h}/d",
    ],
)
def test_what_is_read_or_the_user_s_is_refused_in_one_line(command: str, home: Path) -> None:
    before = snapshot(home)
    result = run(*command.format(h=home, r=os.path.relpath(home)).split())
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1), result.stderr
    assert snapshot(home) == before
    assert list(Path.cwd().iterdir()) == []


def test_a_recording_of_the_user_is_never_converted_away(home: Path) -> None:
    before = snapshot(home / "parent" / "rec")
    result = run("convert", home / "rec", home / "parent" / "rec", "--force")
    assert result.exit_code == 2
    assert "which evermap did not write" in result.stderr
    assert snapshot(home / "parent" / "rec") == before
    assert len(read_recording(home / "parent" / "rec-2").frames)  # what was made is not thrown away


def test_what_evermap_converted_is_replaced_and_notes_beside_it_stay(home: Path) -> None:
    out = home / "converted"
    assert run("convert", home / "rec", out).exit_code == 0
    (out / "notes.txt").write_text("mine")
    refused = run("convert", home / "rec", out, "--format", "parquet")
    assert (refused.exit_code, "is not empty" in refused.stderr) == (2, True)
    assert run("convert", home / "rec", out, "--format", "parquet", "--force").exit_code == 0
    assert (out / "notes.txt").read_text() == "mine"
    assert {name.rpartition(".")[2] for name in snapshot(out)} == {"toml", "parquet", "txt", "json"}
    assert len(read_recording(out).frames)
    (out / "frames.parquet").write_bytes((out / "frames.parquet").read_bytes() + b"edited")
    assert "frames.parquet', which was changed since" in run("convert", home / "rec", out, "--force").stderr


def test_simulated_buildings_are_replaced_whole_on_request(home: Path) -> None:
    out = home / "building"
    assert run("simulate", out, "--days", "2", "--patrol-s", "20").exit_code == 0
    (out / "run").mkdir()
    (out / "run" / "site.evermap").write_text("mine")
    assert run("simulate", out, "--days", "1", "--patrol-s", "20").exit_code == 2
    assert run("simulate", out, "--days", "1", "--patrol-s", "20", "--force").exit_code == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(
        [MANIFEST, "changes_truth.jsonl", "day00_session00", "looks_truth.csv", "run"]
    )
    assert (out / "run" / "site.evermap").read_text() == "mine"
