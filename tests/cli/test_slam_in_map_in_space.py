"""`evermap map enter` and `localize` in space: sessions into a file, a late one too, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.geometry import se3
from evermap.io import read_landmarks, write_native
from evermap.maps.store import open_store
from evermap.types import Frames, SpatialDetections, SpatialOdometry, SpatialRecording, SpatialSensor, landmark_code

QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]
N_TAGS, N_FRAMES = 10, 50
SIGMA = np.array([0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
UP_M = 0.8


def recording(day: int, *, moved: bool) -> SpatialRecording:
    """A round through a room with tags at its walls, all of which are seen; tag 3 hangs higher once it was moved."""
    rng = np.random.default_rng(day)
    angle = 2.0 * np.pi * np.arange(N_TAGS) / N_TAGS
    facing = se3.exp(np.column_stack([np.zeros((N_TAGS, 3)), 0.3 * np.sin(angle), 0.3 * np.cos(angle), angle]))
    tags = np.column_stack([5.0 * np.cos(angle), 4.0 * np.sin(angle), 1.0 + 0.7 * np.sin(3.0 * angle), facing[:, 3:]])
    tags[3, 2] += UP_M * moved
    way = np.linspace(0.0, 2.0 * np.pi, N_FRAMES)
    twist = np.column_stack([np.zeros((N_FRAMES, 5)), way])
    pose = np.column_stack([2.0 * np.sin(way), 2.0 - 2.0 * np.cos(way), 0.1 * np.sin(way), se3.exp(twist)[:, 3:]])
    frame, tag = (pairs.ravel() for pairs in np.meshgrid(np.arange(N_FRAMES), np.arange(N_TAGS), indexing="ij"))
    seen = se3.retract(se3.between(pose[frame], tags[tag]), rng.normal(size=(len(frame), 6)) * SIGMA)
    stamp_s = 86_400.0 * day + 0.5 * np.arange(N_FRAMES)
    unsaid, count = np.full(len(frame), np.nan), len(frame)
    detections = SpatialDetections(
        frame=frame,
        sensor=np.zeros(count, dtype=np.int64),
        landmark_id=tag,
        position_sensor_m=seen[:, :3],
        rotation=seen[:, 3:],
        covariance_sensor_m2=np.tile(SIGMA[0] ** 2 * np.eye(3), (count, 1, 1)),
        sigma_rad=np.full(count, SIGMA[3]),
        corner_px=np.full((count, 4, 2), np.nan),
        tag_size_m=unsaid,
        size_m=np.full((count, 3), np.nan),
        class_id=np.zeros(count, dtype=np.int64),
        score=unsaid,
        source_line=np.zeros(count, dtype=np.int64),
    )
    drifting = se3.retract(pose, np.cumsum(0.2 * rng.normal(size=(N_FRAMES, 6)) * SIGMA, axis=0))
    odometry = SpatialOdometry(stamp_s, drifting, np.full((N_FRAMES, 6), np.nan))
    sensor = SpatialSensor(range_max_m=12.0, sigma_m=SIGMA[0], sigma_rad=SIGMA[3])
    return SpatialRecording(f"day {day}", odometry, Frames(stamp_s), detections, (sensor,), class_names=("tag",))


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Recordings of three days, before the last of which a tag was moved."""
    folder = tmp_path_factory.mktemp("days")
    return [write_native(recording(day, moved=day == 2), folder / f"day{day}") for day in range(3)]


def run(*arguments: str | Path | int) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def enter(*arguments: str | Path) -> dict[str, Any]:
    result = run("map", "enter", *arguments, "--json", *QUICK)
    assert result.exit_code == 0, result.stderr
    return dict(json.loads(result.stdout))


def refused(*arguments: str | Path) -> str:
    """What a user reads who did something wrong."""
    result = run(*arguments, *QUICK)
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.mark.slow
def test_sessions_in_space_of_which_one_is_late(days: list[Path], tmp_path: Path) -> None:
    site, out = tmp_path / "site.evermap", tmp_path / "out"
    first = enter(site, days[0], "--out", out)
    assert (first["counts"]["landmarks_grown"], first["changes"]) == (N_TAGS, [])
    last = enter(site, days[2], "--out", out)
    (change,) = last["changes"]
    assert (change["landmarks"], change["kind"]) == ([3], "moved")
    np.testing.assert_allclose(change["displacement_m"], [0.0, 0.0, UP_M], atol=0.05)
    assert [json.loads(line) for line in (out / "changes.jsonl").read_text().splitlines()] == [change]
    mapped = read_landmarks(out / "map.parquet")
    assert mapped.position_m.shape == (N_TAGS, 3)
    assert mapped.rotation is not None

    late = run("map", "enter", site, days[1], "--out", tmp_path / "late", *QUICK)
    assert late.exit_code == 0, late.stderr
    assert "a late session" in late.stderr
    told = json.loads(run("map", "diff", site, 1, "--json").stdout)
    (change,) = told["changes"]
    assert change["landmarks"] == [3]
    assert run("map", "why", site, 3).exit_code == 0
    with open_store(site) as store:
        assert [item.provenance.recording for item in store.log()] == ["day 0", "day 2", "day 1"]
        stays = store.load().stays
    ended = stays.last_s[np.isfinite(stays.gone_s)]
    np.testing.assert_allclose(ended, [86_400.0 + 0.5 * (N_FRAMES - 1)])  # there on the second day


@pytest.mark.slow
def test_a_replay_in_space_enters_what_slam_enters(days: list[Path], tmp_path: Path) -> None:
    live, site = tmp_path / "live.evermap", tmp_path / "slam.evermap"
    for day in days[:2]:
        assert run("live", live, day).exit_code == 0
        enter(site, day, "--out", tmp_path / day.name)
    with open_store(live) as one, open_store(site) as other:
        ours, theirs = one.load().landmarks(), other.load().landmarks()
    np.testing.assert_allclose(ours.position_m, theirs.position_m, atol=1e-6)
    np.testing.assert_allclose(ours.p_exists, theirs.p_exists, atol=0.02)
    result = run("live", live, days[1], "--localize", "--json")
    poses = [json.loads(line) for line in result.stdout.splitlines() if "qw" in line]
    assert len(poses) > 0.9 * N_FRAMES
    assert poses[-1]["frame"] == "prior_map"


def test_what_does_not_fit_is_one_line(days: list[Path], tmp_path: Path) -> None:
    site, out = tmp_path / "site.evermap", tmp_path / "out"
    enter(site, days[0], "--out", out)
    before = site.read_bytes()
    line = refused("map", "enter", site, days[0], "--out", tmp_path / "again")
    assert "is in the map already, as revision 1" in line
    line = refused("localize", site, days[1], "--realtime", "--out", tmp_path / "where")
    assert "solved when it ends" in line
    assert run("init", "recording", tmp_path / "planar").exit_code == 0
    line = refused("map", "enter", site, tmp_path / "planar", "--out", tmp_path / "mixed")
    assert "a recording in the plane, the map is of space" in line
    assert site.read_bytes() == before
    found = run("localize", site, days[2], "--out", tmp_path / "where", "--json", *QUICK)
    assert json.loads(found.stdout)["changes"] == []  # as in the plane: they come when it enters
    assert site.read_bytes() == before


@pytest.mark.parametrize("in_space", [False, True])
def test_a_new_map_may_begin_with_a_survey(in_space: bool, tmp_path: Path) -> None:
    folder, file = tmp_path / "mine", tmp_path / "site.evermap"
    assert run("init", "flight" if in_space else "recording", folder).exit_code == 0
    given = ["map", "enter", file, folder, "--prior-map", "truth"]
    assert run(*given, "--out", tmp_path / "first", *QUICK).exit_code == 0
    told = json.loads(run("map", "log", file, "--json").stdout)
    assert [row["kind"] for row in told["revisions"]] == ["edit", "session"]
    assert told["revisions"][0]["note"].endswith("surveyed landmarks")
    assert "has landmarks already" in refused(*given, "--out", tmp_path / "second")


def test_sessions_in_space_without_identities(tmp_path: Path) -> None:
    """A fixed map keeps its ids, though the frame of the recording says nothing of them."""
    folder, file = tmp_path / "flight", tmp_path / "map.evermap"
    assert run("init", "flight", folder).exit_code == 0
    nameless = "--set", "unknown_ids=true"
    assert run("map", "enter", file, folder, *nameless, "--out", tmp_path / "one", *QUICK).exit_code == 0
    with open_store(file) as store:
        first = store.load()
    prior = "--prior-map", tmp_path / "one" / "map.parquet"
    assert run("slam", folder, "--unknown-ids", *prior, "--out", tmp_path / "two", *QUICK).exit_code == 0
    found = read_landmarks(tmp_path / "two" / "map.parquet")
    np.testing.assert_array_equal(np.sort(found.landmark_id), first.members.landmark_id)
    assert all(first.label(one) == landmark_code(one) for one in found.landmark_id.tolist())
    assert all(text.startswith("landmark-") for text in first.landmark_texts)
