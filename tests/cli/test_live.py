"""`evermap live --replay`: the map is that of `evermap slam --map`, the lines are those of `--localize`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.io import write_native
from evermap.maps.store import open_store
from evermap_studies.sim import BuildingConfig, simulate_building

QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("sessions")
    found = simulate_building(BuildingConfig(days=3, patrol_s=30.0), 3).sessions
    return [write_native(recording, folder / f"day{k}") for k, recording in enumerate(found[:3])]


def test_a_replay_enters_what_slam_enters_and_tells_poses_and_changes(tmp_path: Path, sessions: list[Path]) -> None:
    live, slam = tmp_path / "live.evermap", tmp_path / "slam.evermap"
    for number, path in enumerate(sessions):
        result = run("live", "--replay", path, "--map", live)
        assert result.exit_code == 0, result.stderr
        assert f"revision {number + 1}" in result.stdout
        assert run("slam", path, "--map", slam, "--out", tmp_path / f"out{number}", *QUICK).exit_code == 0
    with open_store(live) as one, open_store(slam) as other:
        ours, theirs = one.load(), other.load()
        assert set(one.changes(3)) == set(other.changes(3))
    np.testing.assert_array_equal(ours.landmarks().position_m, theirs.landmarks().position_m)
    np.testing.assert_array_equal(ours.landmarks().p_exists, theirs.landmarks().p_exists)

    result = run("live", "--replay", sessions[2], "--map", live, "--localize", "--json")
    assert result.exit_code == 0, result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    poses = [line for line in lines if "x_m" in line]
    assert len(poses) > 100
    assert poses[-1]["frame"] == "prior_map"
    assert all(0.0 <= p <= 1.0 for line in poses for p in line["in_view"].values())
    assert {line["change"] for line in lines if "change" in line} <= {"moved", "vanished", "returned", "appeared"}
    with open_store(live) as store:
        assert store.head() == 3


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--replay", "none", "--map", "m.evermap"], "none"),
        (["--replay", "{0}", "--map", "m.evermap", "--localize"], "no such"),
        (["--replay", "{0}", "--map", "m.evermap", "--set", "live.reorder=1"], "live.reorder_s"),
        (["--replay", "{0}", "--map", "m.evermap", "--set", "reorder_s=-1"], "live.reorder_s"),
        (["--replay", "{0}"], "--map"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], told: str, sessions: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("live", *(argument.format(*sessions) for argument in arguments))
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert told in result.stderr
