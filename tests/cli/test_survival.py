"""`evermap survival`: the numbers it prints, the figure it writes, the forms its help lists."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.survival.text import FORMS


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["survival", *(str(argument) for argument in arguments)])


def test_help_lists_every_form_as_the_parser_knows_it() -> None:
    shown = [" ".join(line.split()) for line in run("plot", "--help").stdout.splitlines()]
    for form in FORMS.values():
        assert f"{form.example} {form.meaning}" in shown


def test_numbers_are_those_of_the_prior(tmp_path: Path) -> None:
    mixture = "0.3*exponential:half-life=1h+0.7*never-leaves"
    result = run("plot", "exponential:half-life=2d", mixture, "--out", tmp_path / "a.png", "--json")
    assert result.exit_code == 0, result.stderr
    priors = json.loads(result.stdout)["priors"]
    day_s = 86400.0
    assert priors["exponential:half-life=2d"] == pytest.approx(
        {
            "quarter_gone_s": 2 * day_s * math.log(4 / 3) / math.log(2),
            "half_gone_s": 2 * day_s,
            "three_quarters_gone_s": 4 * day_s,
            "mean_stay_s": 2 * day_s / math.log(2),
            "p_never_leaves": 0.0,
        }
    )
    assert priors[mixture]["half_gone_s"] is None
    assert priors[mixture]["quarter_gone_s"] == pytest.approx(3600 * math.log2(6))
    assert priors[mixture]["p_never_leaves"] == pytest.approx(0.7)


def test_figure_is_written_whole_and_the_same_every_time(tmp_path: Path) -> None:
    for name, start in (("a.png", b"\x89PNG"), ("a.svg", b"<?xml")):
        for folder in ("one", "two"):
            (tmp_path / folder).mkdir(exist_ok=True)
            assert run("plot", "unknown:1h..30d", "--until", "60d", "--out", tmp_path / folder / name).exit_code == 0
        content = (tmp_path / "one" / name).read_bytes()
        assert content.startswith(start)
        assert content == (tmp_path / "two" / name).read_bytes()


def test_people_read_durations(tmp_path: Path) -> None:
    result = run("plot", "0.5*never-leaves+0.5*uniform:limit=2d", "--out", tmp_path / "a.png")
    assert "a quarter is gone after  1 d" in result.stdout
    assert "never leave              50 %" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["uknown:1h..30d"], "try: unknown"),
        (["never-leaves", "--until", "3"], "'--until': '3' has no unit"),
        (["never-leaves", "--out", "a.gif"], "cannot draw a '.gif' file"),
        (["never-leaves", "--out", "no/such/folder/a.png"], "cannot be written"),
        ([], "Missing argument"),
    ],
)
def test_mistake_is_one_line_and_2(
    arguments: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("plot", *arguments)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert named in result.stderr
    assert not list(tmp_path.iterdir())
