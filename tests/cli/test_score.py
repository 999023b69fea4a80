"""`evermap score`: the package evermap-score behind a verb, and what is said where it is not installed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app

TABLE = "landmark_id,t_from_s,t_to_s,x_m,y_m\na,,10,0,0\na,10,,1,0\n"


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, ["score", *map(str, words)])


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    (tmp_path / "truth.csv").write_text(TABLE, encoding="utf-8")
    return tmp_path / "truth.csv"


def test_arguments_and_options_are_passed_on(truth: Path) -> None:
    result = run(truth, truth, "--json", "--seed", "7", "--draws=5")
    assert result.exit_code == 0, result.stderr
    printed = json.loads(result.stdout)
    assert printed["bootstrap"] == {"over": "landmarks", "draws": 5, "seed": 7, "level": 0.95}
    assert printed["estimates"][0]["metrics"]["changes/moved/any_looks/f1"]["value"] == 1.0


def test_help_is_that_of_the_package() -> None:
    result = run("--help")
    assert result.exit_code == 0
    assert result.stdout.startswith("usage: evermap score [-h] [--looks FILE]")


def test_a_mistake_is_one_line(truth: Path) -> None:
    result = run(truth, truth.parent / "none.csv")
    assert result.exit_code == 2
    assert result.stderr == f"evermap: error: {truth.parent}/none.csv: no such file or folder\n"


def test_without_the_package_a_line_says_how_to_get_it(truth: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "evermap_score"]:
        monkeypatch.delitem(sys.modules, name)

    class Missing:
        @staticmethod
        def find_spec(name: str, *_: object) -> None:
            if name.partition(".")[0] == "evermap_score":
                raise ModuleNotFoundError(f"No module named '{name}'", name=name)

    monkeypatch.setattr(sys, "meta_path", [Missing, *sys.meta_path])
    result = run(truth, truth)
    assert result.exit_code == 2
    assert result.stderr == (
        "evermap: error: evermap score needs the package evermap-score "
        "(try: pip install evermap-score, or from a clone: pip install ./packages/evermap-score)\n"
    )
