"""`evermap demo` at the terminal, with the work itself replaced."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import evermap.cli.demo
import evermap.demo
from evermap.cli.main import app


def outcome(what: str, *, holds: bool) -> dict[str, Any]:
    return {"what": what, "value": 0.5, "least": 0.98, "most": None, "holds": holds}


def fake_summary() -> dict[str, Any]:
    week = {
        "pose_rmse_m": 0.1234,
        "precision": 0.75,
        "recall": 0.5,
        "existence_brier": 0.125,
        "forecast_skill_over_as_is": None,
    }
    worse = {"weeks": [{**week, "precision": 1.0}, week], "sessions": [{"places": 60}, {"places": 77}]}
    return {
        "demo": {
            "methods": {"static": {"label": "static SLAM", **worse}},
            "expected": {"recall": outcome("recall of the map", holds=False)},
        },
        "timing": {
            "demo": {
                "session_cpu_s": {"static": [0.9, 0.25, 0.1]},
                "expected": {"flat_cost": outcome("cost of a session", holds=True)},
            }
        },
        "warnings": [],
    }


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    seen: dict[str, Any] = {}

    def run_demo(out: Path, **options: Any) -> dict[str, Any]:
        seen.update(options, out=out)
        time.sleep(seen.get("lasts_s", 0.0))
        options["progress"](1.0, 2.0)
        return fake_summary()

    monkeypatch.setattr(evermap.demo, "run_demo", run_demo)
    return seen


def test_prints_the_last_week_of_every_method(called, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["demo", "--out", str(out), "--seed", "9", "--days", "3", "--processes", "64"])
    assert result.exit_code == 0, result.stderr
    assert called["seed"] == 9
    assert called["out"] == out
    assert called["scenario"] == evermap.demo.Scenario(days=3)
    assert called["processes"] == os.cpu_count()
    line = next(line for line in result.stdout.splitlines() if "static SLAM" in line)
    assert line.split()[-9:] == ["12.3", "cm", "0.750", "0.500", "0.125", "–", "77", "250", "ms"]
    assert "recall of the map" in result.stdout
    assert "cost of a session" not in result.stdout
    assert result.stderr == ""


def test_prints_json(called, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "out"), "--json"])
    assert json.loads(result.stdout) == fake_summary()


def test_says_why_the_first_run_takes_long(called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called["lasts_s"] = 0.3
    monkeypatch.setattr(evermap.cli.demo, "PATIENCE_S", 0.01)
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "out")])
    assert result.stderr.count("compiles") == 1


def test_refuses_before_it_works(called, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "notes.txt" in result.stderr
    assert not called
