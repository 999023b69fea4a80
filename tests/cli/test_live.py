"""`evermap live MAP INPUT`: the map is that of `evermap map enter`, the lines are those of `--localize`."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import evermap as em
from evermap.cli.main import app
from evermap.io import read_recording, write_native
from evermap.maps.store import open_store
from evermap.maps.store.measured import RECORDING, unpack_recording
from evermap_studies.sim import BuildingConfig, simulate_building

QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("sessions")
    found = simulate_building(BuildingConfig(days=3, patrol_s=30.0), 3).sessions
    return [write_native(recording, folder / f"day{k}") for k, recording in enumerate(found[:3])]


@pytest.mark.slow
def test_a_replay_enters_what_slam_enters_and_tells_poses_and_changes(tmp_path: Path, sessions: list[Path]) -> None:
    live, slam = tmp_path / "live.evermap", tmp_path / "slam.evermap"
    for number, path in enumerate(sessions):
        result = run("live", live, path)
        assert result.exit_code == 0, result.stderr
        assert f"revision {number + 1}" in result.stdout
        assert run("map", "enter", slam, path, "--out", tmp_path / f"out{number}", *QUICK).exit_code == 0
    with open_store(live) as one, open_store(slam) as other:
        ours, theirs = one.load(), other.load()
        assert set(one.changes(3)) == set(other.changes(3))
    np.testing.assert_array_equal(ours.landmarks().position_m, theirs.landmarks().position_m)
    np.testing.assert_array_equal(ours.landmarks().p_exists, theirs.landmarks().p_exists)

    result = run("live", live, sessions[2], "--localize", "--json")
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
        (["live", "m.evermap", "none"], "none"),
        (["live", "m.evermap", "{0}", "--localize"], "no such"),
        (["live", "m.evermap", "{0}", "--set", "live.reorder=1"], "live.reorder_s"),
        (["live", "m.evermap", "{0}", "--set", "reorder_s=-1"], "live.reorder_s"),
        (["live"], "MAP"),
        (["play"], "INPUT"),
        (["play", "{0}"], "no connection (try: --zenoh tcp/localhost:7447"),
        (["live", "m.evermap", "--foxglove", "0", "--robot", "1"], "'--robot': is for a replay"),
        (["live", "m.evermap", "--foxglove", "0", "--realtime"], "'--realtime': is for a replay"),
        (["live", "m.evermap"], "no robot (try: --zenoh tcp/localhost:7447"),
        (["live", "m.evermap", "--zenoh", "tcp/localhost:7447"], "--sensor sensor.toml"),
        (["live", "m.evermap", "--zenoh", "nonsense", "--sensor", "{0}/sensor.toml"], "--zenoh"),
        (["live", "m.evermap", "--zenoh", "z.json5", "--sensor", "{0}/sensor.toml"], "z.json5: 1:"),
        (["live", "m.evermap", "--zenoh", "none.json5", "--sensor", "{0}/sensor.toml"], "none.json5: No such file"),
        (["live", "m.evermap", "{0}", "--sensor", "none.toml"], "omit --sensor"),
        (["live", "m.evermap", "{0}", "--topics", "none.toml"], "omit --topics"),
        (["live", "z.json5", "{0}"], "z.json5: is not an evermap map"),
        (["live", "m.evermap", "--foxglove", "nonsense", "--sensor", "{0}/sensor.toml"], "no server at nonsense"),
        (["live", "m.evermap", "--foxglove", "0", "--sensor", "none.toml"], "none.toml"),
        (
            ["live", "m.evermap", "--foxglove", "0", "--sensor", "{0}/sensor.toml", "--topics", "none.toml"],
            "none.toml",
        ),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], told: str, sessions: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("z.json5").write_text("{ junk", encoding="utf-8")
    result = run(*(argument.format(*sessions) for argument in arguments))
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert told in result.stderr
    assert not Path("z.json5.live").exists()


@pytest.mark.parametrize("others", [["live", "m.evermap", "uwb"], ["play", "uwb", "--zenoh", "tcp/localhost:7447"]])
def test_ranges_without_bearings_are_refused(
    others: list[str], sessions: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    recording = read_recording(sessions[0])
    assert isinstance(recording, em.Recording)
    unsaid = np.full(len(recording.detections), np.nan)
    seen = replace(recording.detections, bearing_rad=unsaid, sigma_bearing_rad=unsaid)
    write_native(replace(recording, detections=seen), tmp_path / "uwb")
    result = run(*others)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "INPUT" in result.stderr
    assert "has ranges without bearings, which are located by what is seen later" in result.stderr
    assert "(try: evermap map enter)" in result.stderr
    assert not Path("m.evermap").exists()


def started(*arguments: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "evermap", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_a_robot_over_zenoh_and_the_end_of_the_bridge(tmp_path: Path, sessions: list[Path], end: int) -> None:
    """By the defaults: a kill costs ten seconds at most, and a polite end nothing."""
    pytest.importorskip("zenoh", reason="the extra live is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    path = tmp_path / "site.evermap"
    for session in sessions[:2]:
        assert run("live", path, session).exit_code == 0
    bridge = started("live", path, "--sensor", sessions[2] / "sensor.toml", "--zenoh", f"listen={where}", "--json")
    robot = started("play", sessions[2], "--zenoh", where)
    assert bridge.stdout is not None
    told = [json.loads(bridge.stdout.readline()) for _ in range(110)]
    last_s = max(line["stamp_s"] for line in told if "stamp_s" in line)
    bridge.send_signal(end)
    robot.send_signal(signal.SIGTERM)
    _, said = bridge.communicate(timeout=120)
    assert robot.wait(timeout=20) == 0
    assert bridge.returncode == (0 if end == signal.SIGTERM else -end)
    if end == signal.SIGTERM:
        assert "entering the drive" in said
    else:
        with open_store(path) as store:
            assert store.head() == 2
        (brought,) = em.recover(path)
        assert brought.revision == 3
    with open_store(path) as store:
        assert store.head() == 3
        kept = {item.revision: item for item in store.attachments() if item.name == RECORDING}
        entered = unpack_recording(store.attached(kept[3]))
    assert entered.frames.stamp_s[-1] > last_s - (10.0 if end == signal.SIGKILL else 0.5)
    assert entered.frames.stamp_s[0] < read_recording(sessions[2]).frames.stamp_s[0] + 3.0
