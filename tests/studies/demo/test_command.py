"""`evermap demo` at the terminal, with the work itself replaced."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import evermap_studies.demo.command
import evermap_studies.demo.run
from evermap.cli.main import app
from evermap_studies.demo.scenario import Scenario


def outcome(what: str, *, holds: bool) -> dict[str, Any]:
    return {"what": what, "value": 0.5, "least": 0.98, "most": None, "holds": holds}


def fake_summary() -> dict[str, Any]:
    whole = {
        "pose_rmse_m": 0.1234,
        "precision": 0.75,
        "recall": 0.5,
        "forecast_skill_over_base_rate": None,
        "changes": {"told": 20, "false": 8, "false_certain": 3},
    }
    return {
        "demo": {
            "scenario": {"days": 28},
            "methods": {
                "static": {"label": "static SLAM", "whole": whole},
                "oracle": {"label": "oracle", "whole": {**whole, "changes": None}},
            },
            "expected": {"recall": outcome("recall of the map", holds=False)},
        },
        "timing": {
            "demo": {
                "cpu_s_per_minute": {"static": [0.9, 0.25, 0.1], "oracle": [1.0]},
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

    monkeypatch.setattr(evermap_studies.demo.run, "run_demo", run_demo)
    return seen


def test_prints_what_every_method_tells_and_what_of_it_is_false(called, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = CliRunner().invoke(app, ["demo", "--out", str(out), "--seed", "9", "--days", "3", "--processes", "64"])
    assert result.exit_code == 0, result.stderr
    assert called["seed"] == 9
    assert called["out"] == out
    assert called["scenario"] == Scenario(days=3)
    assert called["processes"] == os.cpu_count()
    line = next(line for line in result.stdout.splitlines() if "static SLAM" in line)
    assert line.split()[-10:] == ["12.3", "cm", "0.750", "0.500", "20", "8", "3", "–", "250", "ms"]
    line = next(line for line in result.stdout.splitlines() if "oracle" in line)
    assert line.split()[-10:] == ["12.3", "cm", "0.750", "0.500", "–", "–", "–", "–", "1000", "ms"]
    assert "recall of the map" in result.stdout
    assert "cost of a session" not in result.stdout
    assert result.stderr == ""


def test_prints_json(called, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "out"), "--json"])
    assert json.loads(result.stdout) == fake_summary()


def test_says_why_the_first_run_takes_long(called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called["lasts_s"] = 0.3
    monkeypatch.setattr(evermap_studies.demo.command, "PATIENCE_S", 0.01)
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "out")])
    assert result.stderr.count("compiles") == 1


def test_refuses_before_it_works(called, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "notes.txt" in result.stderr
    assert not called
