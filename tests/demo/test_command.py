"""`evermap demo` at the terminal, with the work itself replaced."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import evermap.cli.demo
import evermap.demo
from evermap.cli.main import app


def fake_summary() -> dict[str, Any]:
    errors = {"pose_rmse_m": 0.1234}
    changes = {"moved": 5, "vanished": 2, "landmarks_mapped_then": 70}
    session = {
        "day": 4,
        "changes": changes,
        "changed": errors,
        "unchanged": errors,
        "from_scratch": {"pose_rmse_m": None},
    }
    return {"demo": {"sessions": [session]}, "warnings": []}


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


def test_prints_one_line_a_day(called, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "out"), "--seed", "9"])
    assert result.exit_code == 0, result.stderr
    assert called["seed"] == 9
    assert called["out"] == tmp_path / "out"
    day = next(line for line in result.stdout.splitlines() if line.strip().startswith("4 "))
    assert day.split("  ")[-1].strip() == "7 of 70"
    assert day.count("12.3 cm") == 2
    assert "–" in day
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
