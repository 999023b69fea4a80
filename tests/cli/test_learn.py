"""`evermap survival learn`: a model learned from a table, kept in a file, and used by `evermap persist`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.existence.models import KINDS, model_of
from evermap.existence.protocol import Looks

P_ERROR = 0.05
STEP_S = 10.0


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cart that stays five minutes and is away for ten, memoryless, and a wall; looked at every ten seconds."""
    rng = np.random.default_rng(3)
    time_s = np.arange(0.0, 6 * 3600.0, STEP_S)
    changes = np.cumsum(np.concatenate([[0.0], rng.exponential(np.tile([300.0, 600.0], 60))]))
    cart = (np.searchsorted(changes, time_s, side="right") % 2 == 1).astype(int)
    lines = ["stamp_s,feature_id,class_id,detected"]
    for name, kind, present in (("cart", "vehicle", cart), ("wall", "wall", np.ones(len(time_s), dtype=int))):
        seen = np.where(rng.random(len(time_s)) < P_ERROR, 1 - present, present)
        lines += [f"{t},{name},{kind},{d}" for t, d in zip(time_s, seen, strict=True)]
    path = tmp_path_factory.mktemp("learn") / "looks.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def errors() -> tuple[str, ...]:
    return ("--p-miss", str(P_ERROR), "--p-false", str(P_ERROR))


def keys() -> tuple[str, ...]:
    return ("--set", f"p_miss={P_ERROR}", "--set", f"p_false={P_ERROR}")


@pytest.fixture(scope="module")
def model(table: Path) -> Path:
    """What is learned of both."""
    path = table.parent / "m.json"
    result = run("survival", "learn", table, "--recurrent", "two-state", *errors(), "--out", path)
    assert result.exit_code == 0, result.stderr
    return path


def test_rates_of_a_cart_and_of_a_wall(model: Path) -> None:
    data = json.loads(model.read_text())
    assert data["per"] == "class"
    cart, wall = data["models"]["vehicle"], data["models"]["wall"]
    rates = np.array(cart["rates_hz"])
    there = int(np.argmax(cart["present"]))
    # some 24 stays: a relative standard error of a fifth
    assert rates[there, 1 - there] == pytest.approx(1 / 300.0, rel=0.6)
    assert rates[1 - there, there] == pytest.approx(1 / 600.0, rel=0.6)
    there = int(np.argmax(wall["present"]))
    assert np.array(wall["rates_hz"])[there, 1 - there] < 1e-4


def test_persist_uses_the_model_of_each_class(table: Path, model: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run("persist", table, "--set", f"model={model}", *keys(), "--out", out, "--set", "figures=0")
    assert result.exit_code == 0, result.stderr
    rows = np.genfromtxt(table, delimiter=",", names=True, dtype=None, encoding="utf-8")
    beliefs = np.genfromtxt(out / "beliefs.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    for name, kind in (("cart", "vehicle"), ("wall", "wall")):
        mine = rows["feature_id"] == name
        looks = Looks.from_rows(
            np.zeros(mine.sum(), dtype=int), rows["stamp_s"][mine], rows["detected"][mine], P_ERROR, P_ERROR
        )
        expected = model_of(json.loads(model.read_text())["models"][kind]).track(looks).p_present
        np.testing.assert_allclose(beliefs["p_exists"][mine], expected, atol=1e-6)


def test_what_is_printed_for_machines(table: Path, tmp_path: Path) -> None:
    result = run(
        "survival", "learn", table, "--recurrent", "two-state", "--per", "all", "--out", tmp_path / "m.json", "--json",
        "--figure", tmp_path / "m.png",
    )  # fmt: skip
    content = json.loads(result.stdout)
    assert content["per"] == "all"
    assert content["models"]["all"]["kind"] == "two-state"
    assert (tmp_path / "m.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "m.json").read_text())["kind"] == "phase-type"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--recurrent", "markov"), "field '--recurrent': unknown kind of model 'markov'"),
        (("--per", "robot"), "field '--per': input should be"),
        (("--recurrent", "two-state", "--figure", "a.gif"), "cannot draw a '.gif' file"),
    ],
)
def test_wrong_choices_are_one_line_and_write_nothing(
    table: Path, tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    result = run("survival", "learn", table, *options, "--out", tmp_path / "m.json")
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "m.json").exists()


def test_a_model_that_lacks_a_feature_says_which(model: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.csv"
    other.write_text("stamp_s,feature_id,class_id,detected\n0,tree,plant,1\n1,tree,plant,1\n")
    result = run("persist", other, "--set", f"model={model}", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "feature 'tree' of class 'plant'" in result.stderr


def test_help_of_persist_lists_every_kind() -> None:
    shown = run("persist", "--help").stdout.partition("Features that return")[2].partition("Examples")[0]
    listed = {word.rstrip(",") for line in shown.splitlines() for word in line.split("  ")[1:] for word in word.split()}
    assert {*KINDS, "auto"} <= listed
