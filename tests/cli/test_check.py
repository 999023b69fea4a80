"""`evermap check` and `evermap slam` are one judgement: the same exit code, whatever is wrong with a recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.io import write_native
from evermap.types import FloatArray, Recording, rows_of
from evermap_studies.sim import BuildingConfig, simulate_building

QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]
Spoil = Callable[[Recording], Recording]


@cache
def patrol() -> Recording:
    return simulate_building(BuildingConfig(days=1, patrol_s=60.0), seed=1).sessions[0]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def mounted(one: Recording) -> Recording:
    x_m, y_m, theta_rad = one.sensor.mount_robot_sensor
    return replace(one, sensor=replace(one.sensor, mount_robot_sensor=(x_m + 0.8, y_m, theta_rad)))


def short_wheels(one: Recording) -> Recording:
    return replace(one, odometry=replace(one.odometry, forward_mps=0.8 * one.odometry.forward_mps))


def mixed(one: Recording) -> Recording:
    ids = np.random.default_rng(0).permutation(one.detections.landmark_id)
    return replace(one, detections=replace(one.detections, landmark_id=ids))


def one_frame(one: Recording) -> Recording:
    return replace(one, detections=rows_of(one.detections, one.detections.frame == one.detections.frame[0]))


def nameless(one: Recording) -> Recording:
    return replace(one, detections=replace(one.detections, landmark_id=np.full(len(one.detections), -1)))


def own_ids(one: Recording) -> Recording:
    return replace(one, detections=replace(one.detections, landmark_id=np.arange(len(one.detections))))


def in_millimetres(one: Recording) -> Recording:
    return replace(one, detections=replace(one.detections, range_m=1e3 * one.detections.range_m))


SPOILS: dict[str, tuple[Spoil, int, str]] = {
    "nothing": (lambda one: one, 0, "sound"),
    "mount .8 m off": (mounted, 3, "mount"),
    "wheels .8": (short_wheels, 3, "length of the drive"),
    "mixed identities": (mixed, 3, "not static"),
    "one frame": (one_frame, 2, "at least 2 needed"),
    "no identities": (nameless, 2, "--unknown-ids"),
    "own identities": (own_ids, 2, "must identify the landmark"),
    "ranges in mm": (in_millimetres, 3, "millimetres"),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(one, marks=pytest.mark.slow) if one in ("mixed identities", "mount .8 m off") else one
        for one in SPOILS
    ],
)
def test_check_ends_as_slam_does(name: str, tmp_path: Path) -> None:
    spoil, code, words = SPOILS[name]
    folder = write_native(spoil(patrol()), tmp_path / "recording")
    checked, solved = run("check", folder), run("slam", folder, "--out", tmp_path / "out", *QUICK)
    assert (checked.exit_code, solved.exit_code) == (code, code), (checked.output, solved.output)
    assert words in checked.output
    assert checked.stderr.count("error:") <= 1
    assert code == 0 or "no problems found" not in checked.stderr
    assert code != 2 or run("check", folder, "--quick").exit_code == 2


def test_what_the_readings_alone_do_not_tell_is_said(tmp_path: Path) -> None:
    folder = write_native(mounted(patrol()), tmp_path / "recording")
    quick = run("check", folder, "--quick")
    assert (quick.exit_code, "verdict" in quick.stdout) == (0, False)
    assert "not asked by --quick: mounts" in quick.stderr
    assert run("check", folder, "--quick", "--set", "slam.seed=1").exit_code == 2
    whole = json.loads(run("check", folder, "--json").stdout)
    assert (whole["usable"], whole["verdict"]["kind"]) == (False, "sensor suspect")
    assert json.loads(run("check", folder, "--quick", "--json").stdout)["verdict"] is None


def with_stamps(one: Recording, seen: Callable[[FloatArray], FloatArray], driven: float = 1.0) -> Recording:
    begin_s = one.odometry.stamp_s[0]
    frames = replace(one.frames, stamp_s=seen(one.frames.stamp_s - begin_s))
    return replace(
        one, frames=frames, odometry=replace(one.odometry, stamp_s=driven * (one.odometry.stamp_s - begin_s))
    )


@pytest.mark.parametrize("verb", ["check", "slam"])
@pytest.mark.parametrize(
    ("seen", "driven", "wrong", "unit"),
    [(1e3, 1.0, "frames and detections", "milli"), (1e6, 1.0, "frames", "micro"), (1.0, 1e3, "odometry", "milli")],
)
def test_stamps_in_another_unit_are_named(
    verb: str, seen: float, driven: float, wrong: str, unit: str, tmp_path: Path
) -> None:
    spoilt = with_stamps(patrol(), lambda stamp_s: seen * stamp_s, driven)
    options: list[str | Path] = ["--out", tmp_path / "out", *QUICK] if verb == "slam" else []
    refused = run(verb, write_native(spoilt, tmp_path / "recording"), *options)
    assert refused.exit_code == 2
    assert f"stamps of the {wrong}" in refused.stderr
    assert f"in {unit}seconds" in refused.stderr


def test_rows_that_all_lie_far_apart_are_told(tmp_path: Path) -> None:
    spoilt = with_stamps(patrol(), lambda stamp_s: 1e3 * stamp_s, 1e3)
    told = run("check", write_native(spoilt, tmp_path / "recording"), "--quick")
    assert "stamp_s may be in milliseconds" in told.stderr


def test_a_camera_that_was_on_for_a_moment_has_no_other_unit(tmp_path: Path) -> None:
    """By its length the odometry would be in milliseconds, by its steps it is not."""
    seen_s = np.linspace(0.0, 0.02 * (len(patrol().frames) - 1), len(patrol().frames))
    driven = rows_of(patrol().odometry, np.arange(10_000) % len(patrol().odometry))
    driven = replace(driven, stamp_s=np.linspace(0.0, 1e3 * seen_s[-1], len(driven)))
    burst = replace(patrol(), frames=replace(patrol().frames, stamp_s=seen_s), odometry=driven)
    told = run("check", write_native(burst, tmp_path / "recording"), "--quick")
    assert "stamps of the" not in told.stderr


@pytest.mark.parametrize("verb", ["check", "slam"])
def test_ranges_alone_are_detections(verb: str, tmp_path: Path) -> None:
    folder = write_native(patrol(), tmp_path / "uwb")
    rows = [row.split(",")[:3] for row in (folder / "detections.csv").read_text("utf-8").splitlines()]
    assert rows[0] == ["stamp_s", "landmark_id", "range_m"]
    (folder / "ranges.csv").write_text("\n".join(map(",".join, rows)), encoding="utf-8")
    (folder / "detections.csv").unlink()
    options: list[str | Path] = ["--out", tmp_path / "out"] if verb == "slam" else []
    refused = run(verb, folder, *options)
    assert refused.exit_code == 2
    assert "ranges are detections where nothing else is seen" in refused.stderr
    assert "kind = 'uwb'" in refused.stderr
