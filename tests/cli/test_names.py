r"""Names of classes and features are shown as they are: `$\foo$` is no formula, `[/red]` no colour, `_x` no secret."""

from __future__ import annotations

import csv
import json
import os
import pty
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.errors import InputError, printable

NAMES = [r"$\foo$", "[/red]", "_hidden", "<b>&amp;", ":smile:", "%s{x}", "a$b", "100 %"]
"""Mathematics that cannot be typeset, markup that closes nothing, and what else a library may want to interpret."""
ESCAPE = "\x1b[31m"


def run(*arguments: str | Path) -> Result:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.stderr
    return result


def on_a_terminal(*arguments: str | Path) -> str:
    """What a person sees: the same command with a terminal of 250 columns on both streams."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": "250", "TERM": "xterm"}
    command = [sys.executable, "-m", "evermap", *map(str, arguments)]
    child = subprocess.Popen(command, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    parts = []
    try:
        while part := os.read(ours, 65536):
            parts.append(part)
    except OSError:  # the other end is closed
        pass
    os.close(ours)
    text = b"".join(parts).decode()
    assert child.wait() == 0, text
    return text


def bare(text: str) -> str:
    """Without what colours a terminal."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)


def columns(table: Path) -> dict[str, list[str]]:
    """The cells of a table by column."""
    lines = [line for line in table.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    return {name: [row[name] for row in rows] for name in rows[0]}


def renamed(table: Path, column: str, old: list[str], new: list[str]) -> None:
    """Other names in a column of a table."""
    cells = columns(table)
    names = dict(zip(old, new, strict=False))
    cells[column] = [names.get(cell, cell) for cell in cells[column]]
    with table.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([list(cells), *zip(*cells.values(), strict=True)])


@pytest.fixture(scope="module")
def building(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short session whose classes have such names."""
    folder = tmp_path_factory.mktemp("names") / "b"
    run("simulate", folder, "--patrol-s", "30", "--days", "1", "--seed", "1")
    for day in ("day00_session00",):
        sensor = folder / day / "sensor.toml"
        kinds = tomllib.loads(sensor.read_text())["recording"]["class_names"]
        lines = [
            f"class_names = {json.dumps(NAMES)}" if line.startswith("class_names") else line
            for line in sensor.read_text().splitlines()
        ]
        sensor.write_text("\n".join(lines))
        for table in ("landmarks.csv", "detections.csv"):
            renamed(folder / day / table, "class_id", kinds, NAMES)
    return folder


@pytest.fixture(scope="module")
def site(building: Path) -> Path:
    """The map, made by the real command; every name is in it, whatever the robot happened to see."""
    from dataclasses import replace

    import numpy as np

    from evermap.maps.store import Provenance, open_store

    path = building.parent / "site.evermap"
    run("map", "enter", path, building / "day00_session00", "--out", building.parent / "out")
    with open_store(path) as store:
        living = store.load()
        count = len(living.members)
        kinds = np.arange(count, dtype=np.int64) % len(NAMES)
        living = replace(living, members=replace(living.members, class_id=kinds), class_names=tuple(NAMES))
        assert count >= len(NAMES)
        store.commit(living, Provenance(recording="[/red] $\\foo$ " + ESCAPE), parent=store.head())
    return path


def test_slam_and_its_report(building: Path, site: Path) -> None:
    out = building.parent / "out"
    assert site.is_file()
    assert (out / "report.html").is_file()
    assert list((out / "figures").glob("*.png"))


def test_tables_of_a_map(site: Path) -> None:
    shown = bare(on_a_terminal("map", "show", site, "--all"))
    piped = run("map", "show", site, "--all").stdout
    for name in NAMES:
        assert f" {name} " in shown
        assert f" {name} " in piped
    log = on_a_terminal("map", "log", site)
    assert "[/red] $\\foo$ \\x1b[31m" in bare(log)
    assert ESCAPE not in run("map", "log", site).stdout


def test_why_and_diff_of_a_map(site: Path, tmp_path: Path) -> None:
    told = json.loads(run("map", "show", site, "--all", "--json").stdout)["landmarks"]
    for name in NAMES:
        landmark = next(item["landmark"] for item in told if item["class"] == name)
        figure = tmp_path / "why.png"
        assert f"landmark {landmark} ({name})" in run("map", "why", site, str(landmark), "--figure", figure).stdout
        assert figure.is_file()
    assert bare(on_a_terminal("map", "diff", site, "1"))
    run("map", "show", site, "--figure", tmp_path / "map.png")
    run("map", "export", site, "--out", tmp_path / "map.geojson")
    document = json.loads((tmp_path / "map.geojson").read_text())
    shown = {value for item in document["features"] for value in item["properties"].values()}
    assert len(shown & set(NAMES)) > 3


@pytest.mark.slow
def test_objects_and_their_lifetimes(tmp_path: Path) -> None:
    table = tmp_path / "detections.csv"
    run("init", "detections", table)
    renamed(table, "class_id", sorted(set(columns(table)["class_id"])), NAMES)
    assert on_a_terminal("track", table, "--range-m", "12", "--out", tmp_path / "out")
    lifetimes = tmp_path / "out" / "lifetimes.csv"
    assert lifetimes.is_file()
    text = bare(on_a_terminal("survival", "fit", lifetimes, "--by", "class", "--figure", tmp_path / "fit.png"))
    assert any(name in text for name in NAMES)


def test_features_of_a_table_of_looks(tmp_path: Path) -> None:
    table = tmp_path / "looks.csv"
    run("init", "looks", table)
    for column in ("feature_id", "class_id"):
        renamed(table, column, sorted(set(columns(table)[column])), NAMES)
    assert on_a_terminal("persist", table, "--out", tmp_path / "out")
    report = (tmp_path / "out" / "report.html").read_text()
    assert "<b>&amp;</" not in report
    assert any(name in report for name in NAMES[:2])


def test_the_legend_of_a_map_has_every_name(tmp_path: Path) -> None:
    import numpy as np

    from evermap.types import Landmarks
    from evermap.viz.living_map_figures import MapView, plot_living_map

    count = len(NAMES)
    place = np.random.default_rng(0).normal(size=(count, 2))
    landmarks = Landmarks.at(np.arange(count), place, class_id=np.arange(count), class_names=tuple(NAMES))
    figure = plot_living_map(MapView(landmarks, np.zeros(count, np.bool_)), title=r"[/red] $\foo$")
    texts = [text.get_text().strip("\N{ZERO WIDTH SPACE}") for text in figure.legends[0].get_texts()]
    assert set(NAMES) <= set(texts)
    assert not any(text.get_parse_math() for text in figure.legends[0].get_texts())


def test_powers_of_ten_are_written_without_mathematics() -> None:
    from evermap.viz.style import house_style, new_figure, settle

    with house_style():
        figure = new_figure(4.0, 3.0)
        axes = figure.subplots()
        axes.plot([1e-4, 1.0, 1e3], [11.0, 20.0, 50.0])
        axes.set_xscale("log")
        axes.set_yscale("log")
        settle(figure)
    labels = [text.get_text() for text in axes.get_xticklabels()]
    assert "10⁻⁴" in labels
    assert "10³" in labels
    assert not any("$" in text or "\\" in text for text in labels)
    assert "2×10¹" in [text.get_text().replace(" ", "") for text in axes.get_yticklabels(minor=True)]


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("plain $\\foo$ [/red] é 日本 _x", "plain $\\foo$ [/red] é 日本 _x"),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("a\nb\tc\x7f\x9b", r"a\nb\tc\x7f\x9b"),
        ("right\u202eleft\u2066", r"right\u202eleft\u2066"),
        ("half\ud800", r"half\ud800"),
    ],
)
def test_what_a_terminal_would_obey_is_escaped(text: str, seen: str) -> None:
    assert printable(text) == seen


def test_a_message_stays_short_whatever_is_in_it() -> None:
    error = InputError("x" * 9000 + ESCAPE, path="p" * 9000, field="f\n" * 900, hint="h" * 9000)
    line = error.one_line()
    assert len(line) < 2000
    assert "\x1b" not in line
    assert "\n" not in line
    assert line.startswith("ppp")
    assert r"\x1b[31m (try: hhh" in line
