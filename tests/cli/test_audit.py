"""`evermap audit` from the command line, and maps in the formats of others by `evermap map export`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.io import read_landmarks, write_template
from evermap.io.map_formats import MAP_FORMATS, format_of


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with an older map, in which a cart of three landmarks is at another position."""
    folder = tmp_path_factory.mktemp("audit")
    write_template(folder / "rec")
    return folder


def test_an_older_map_is_put_right(place: Path) -> None:
    survey, corrected = place / "rec" / "survey.csv", place / "corrected.csv"
    done = run("audit", survey, place / "rec", "--out", place / "out", "--write", corrected)
    assert done.exit_code == 4, done.output
    assert "wrong" in done.stdout
    before, after, true = (read_landmarks(path) for path in (survey, corrected, place / "rec" / "landmarks.csv"))
    moved = (before.position_m != after.position_m).any(axis=1)
    at = dict(zip(true.landmark_id.tolist(), true.position_m, strict=True))
    for name, old, new, changed in zip(
        before.landmark_id.tolist(), before.position_m, after.position_m, moved.tolist(), strict=True
    ):
        assert (abs(old - at[name]).max() > 0.3) == changed
        assert abs(new - at[name]).max() < 0.1
    for name in ("report.html", "report.md", "summary.json", "figures/audit.png", "corrected/survey.csv"):
        assert (place / "out" / name).is_file()
    again = run("audit", corrected, place / "rec", "--out", place / "again", "--json")
    assert again.exit_code == 0, again.output
    found = json.loads(again.stdout)
    assert found["verdict"] == "right"
    assert (place / "again" / "corrected" / "corrected.csv").read_bytes() == corrected.read_bytes()


def test_mistakes_are_one_line(place: Path, tmp_path: Path) -> None:
    survey = place / "rec" / "survey.csv"
    (tmp_path / "graph.g2o").write_text("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    (tmp_path / "other.csv").write_text("id,x,y\n7001,0,0\n7002,1,0\n")
    (tmp_path / "there").write_text("mine")
    for arguments, line in (
        ((tmp_path / "graph.g2o", place / "rec"), "is a pose graph (g2o, TORO or PyFG), not a map of landmarks"),
        ((tmp_path / "other.csv", place / "rec"), "no landmark of the map was ever seen: the map has 7001, 7002"),
        ((survey, place / "rec", "--write", tmp_path / "there"), "is there already"),
        ((survey, place / "rec", "--write", survey), "survey.csv"),
        ((survey, tmp_path / "nothing"), "no such file or folder"),
    ):
        done = run("audit", *arguments, "--out", tmp_path / "out")
        assert done.exit_code == 2
        assert line in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert (tmp_path / "there").read_text() == "mine"


def test_maps_are_exported_in_formats_of_others(place: Path) -> None:
    write_template(place / "flight", in_space=True)
    assert run("map", "enter", place / "site.evermap", place / "flight", "--out", place / "flown").exit_code == 0
    for kind in MAP_FORMATS:
        out = place / f"{kind.name}{kind.ending}"
        done = run("map", "export", place / "site.evermap", "--out", out, "--format", kind.name)
        if kind.name == "wpilib-csv":  # in which the tags of a camera's own frame cannot be told
            assert done.exit_code == 2
            assert "turned by" in done.stderr
            continue
        assert done.exit_code == 0, done.output
        assert format_of(out.read_bytes(), out).name == kind.name
        assert len(read_landmarks(out)) > 0
    assert run("map", "export", place / "site.evermap", "--out", place / "a.json", "--format", "g2o").exit_code == 2


def test_a_survey_that_begins_a_map_is_not_corrected_in_silence(place: Path) -> None:
    survey, out = place / "rec" / "survey.csv", place / "begun"
    done = run("map", "enter", place / "begun.evermap", place / "rec", "--prior-map", survey, "--out", out)
    assert done.exit_code == 0, done.output
    mapped = json.loads(run("map", "show", place / "begun.evermap", "--json").stdout)["landmarks"]
    at = {item["landmark"]: (item["x_m"], item["y_m"]) for item in mapped}
    before = read_landmarks(survey)
    far = [
        name
        for name, (x, y) in zip(before.landmark_id.tolist(), before.position_m.tolist(), strict=True)
        if max(abs(at[name][0] - x), abs(at[name][1] - y)) > 0.3
    ]
    assert far == [4]
    assert "landmark 4 moved" in done.stdout or "survey has 4 (1.1" in done.stderr


def test_a_map_of_other_landmarks_is_not_used_in_silence(place: Path, tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("id,x,y\n7001,0,0\n7002,1,0\n")
    given = (place / "rec", "--out", tmp_path / "out", "--prior-map", tmp_path / "other.csv")
    alone = run("slam", *given, "--json")
    assert alone.exit_code == 3, alone.output  # a result that can't be trusted: the map is another
    said = [text for text in json.loads(alone.stdout)["warnings"] if "no landmark of the map was ever seen" in text]
    assert len(said) == 1
    begun = run("map", "enter", tmp_path / "new.evermap", *given)
    assert begun.exit_code == 2
    assert "no landmark of the map was ever seen: the map has 7001, 7002, the recording has 1, 2" in begun.stderr
    assert not (tmp_path / "new.evermap").exists()
