"""`evermap map enter` and `localize`: sessions into a file, localisation in it, and what is refused."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.config import Config
from evermap.errors import DataError
from evermap.geometry import se2
from evermap.geometry.rigid import rigid
from evermap.io import read_native, read_tum, write_native
from evermap.io.landmarks import write_map_csv
from evermap.maps.store import open_store
from evermap.runs.sessions import enter_session
from evermap.types import Verdict, VerdictKind
from evermap_studies.sim import BuildingConfig, BuildingSimulation, SimulatedSensor, simulate_building

# pictures have tests of their own, and take most of the time
QUICK = ["--set", "output.figures=false", "--set", "output.report=false", "--set", "output.rerun=false"]
KNOWN_METRE = ["--set", "slam.calibration.fix.range_slope=0.0"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def enter(recording: Path, map_file: Path, out: Path, *more: str | Path) -> Result:
    return run("map", "enter", map_file, recording, "--out", out, "--json", *more, *KNOWN_METRE, *QUICK)


def localize(recording: Path, map_file: Path, out: Path, *more: str | Path) -> Result:
    return run("localize", map_file, recording, "--out", out, "--json", *more, *KNOWN_METRE, *QUICK)


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def one_line(result: Result) -> str:
    """What a user reads who did something wrong."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("evermap: error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.fixture(scope="module")
def building() -> BuildingSimulation:
    return simulate_building(
        BuildingConfig(
            days=3,
            patrol_s=60.0,
            length_m=14.0,
            depth_m=13.0,
            rooms_per_side=1,
            sensor=SimulatedSensor(range_slope=0.0, rate_hz=2.0),
        ),
        seed=4,
    )


@pytest.fixture(scope="module")
def recordings(building: BuildingSimulation, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    for day, recording in enumerate(building.sessions):
        write_native(recording, folder / f"day{day}")
    return [folder / f"day{day}" for day in range(len(building.sessions))]


@pytest.fixture(scope="module")
def kept(recordings: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A map of the first two days, and the summaries."""
    folder = tmp_path_factory.mktemp("kept")
    printed = []
    for day in (0, 1):
        result = enter(recordings[day], folder / "building.evermap", folder / f"day{day}")
        assert result.exit_code == 0, result.stderr
        printed.append(json.loads(result.stdout))
    return folder / "building.evermap", printed


@pytest.fixture
def copy(kept: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> Path:
    path = tmp_path / "building.evermap"
    path.write_bytes(kept[0].read_bytes())
    return path


def test_a_session_is_one_more_revision_and_has_its_folder(
    kept: tuple[Path, list[dict[str, Any]]], building: BuildingSimulation
) -> None:
    path, printed = kept
    for day in (0, 1):
        out = path.parent / f"day{day}"
        assert printed[day] == json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert printed[0]["frames"]["map"].startswith("first_pose")
    assert printed[1]["frames"]["map"].startswith("prior_map")
    with open_store(path) as store:
        living = store.load(store.head())
    assert living.stamp_s == pytest.approx(building.sessions[1].frames.stamp_s[-1], abs=1.0)
    seen = np.unique(np.concatenate([one.detections.landmark_id for one in building.sessions[:2]]))
    assert set(living.members.landmark_id.tolist()) <= set(seen.tolist())
    assert len(living.members) > 0.8 * len(seen)


def test_the_history_of_the_map_and_the_folders_say_the_same(kept: tuple[Path, list[dict[str, Any]]]) -> None:
    path, printed = kept
    result = run("map", "log", path, "--json")
    assert result.exit_code == 0, result.stderr
    revisions = json.loads(result.stdout)["revisions"]
    assert len(revisions) == 2
    for revision, summary, folder in zip(revisions, printed, ("day0", "day1"), strict=True):
        kinds = Counter(change["kind"] for change in summary["changes"])
        assert revision["changes"] == dict(kinds)
        lines = (path.parent / folder / "changes.jsonl").read_text(encoding="utf-8").splitlines()
        assert Counter(json.loads(line)["kind"] for line in lines) == kinds
        assert revision["source"] == summary["source"]
        assert (revision["seed"], revision["kind"]) == (0, "session")
        assert tomllib.loads(revision["config"])["slam"]["calibration"]["fix"] == {"range_slope": 0.0}
    assert not revisions[0]["changes"]
    assert revisions[1]["changes"]["moved"] > 1


def test_localising_finds_the_robot_and_leaves_the_map(
    copy: Path, recordings: list[Path], building: BuildingSimulation, tmp_path: Path
) -> None:
    before = digest(copy)
    result = localize(recordings[2], copy, tmp_path / "run")
    assert result.exit_code == 0, result.stderr
    assert digest(copy) == before
    path = read_tum(tmp_path / "run" / "trajectory.tum")
    # the truth in the map's frame, by the landmarks that stand where they stood on the first day
    with open_store(copy) as store:
        landmarks = store.load(store.head()).landmarks(p_least=0.9)
    truth = building.sessions[1].true_landmarks
    assert truth is not None
    names, here, there = np.intersect1d(landmarks.landmark_id, truth.landmark_id, return_indices=True)
    assert len(names) > 10
    motion = rigid(truth.position_m[there], landmarks.position_m[here])
    driven = building.sessions[2].truth
    assert driven is not None
    late = path.stamp_s > path.stamp_s[0] + 10.0
    at = np.column_stack([np.interp(path.stamp_s[late], driven.stamp_s, driven.pose_world_robot[:, k]) for k in (0, 1)])
    gap = np.linalg.norm(se2.transform(motion, at) - path.pose_world_robot[late, :2], axis=1)
    assert np.sqrt(np.mean(gap**2)) < 0.3


def test_the_next_session_goes_into_the_same_map(copy: Path, recordings: list[Path], tmp_path: Path) -> None:
    with open_store(copy) as store:
        before = store.load(store.head())
    result = enter(recordings[2], copy, tmp_path / "run")
    assert result.exit_code == 0, result.stderr
    with open_store(copy) as store:
        after = store.load(store.head())
    assert after.stamp_s > before.stamp_s
    assert (tmp_path / "run" / "summary.json").is_file()
    again = np.intersect1d(before.members.landmark_id, after.members.landmark_id)
    assert len(again) > 0.8 * len(before.members)


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (["--prior-map", "truth"], "--prior-map"),
        (["--set", "living.search=guess"], "living.search"),
    ],
)
def test_options_that_contradict_a_map(
    more: list[str], problem: str, copy: Path, recordings: list[Path], tmp_path: Path
) -> None:
    before = digest(copy)
    assert problem in one_line(enter(recordings[2], copy, tmp_path / "run", *more))
    causal = localize(recordings[2], copy, tmp_path / "run", "--set", "unknown_ids=true")
    assert "is not causal" in one_line(causal)
    assert digest(copy) == before
    assert not (tmp_path / "run").exists()


def test_a_session_that_is_in_the_map_is_refused(copy: Path, recordings: list[Path], tmp_path: Path) -> None:
    """It would be counted twice; localising in the map by it leaves the map as it is."""
    before = digest(copy)
    problem = one_line(enter(recordings[0], copy, tmp_path / "run"))
    assert "is in the map already, as revision 1" in problem
    assert not (tmp_path / "run").exists()
    result = localize(recordings[0], copy, tmp_path / "run")
    assert result.exit_code == 0, result.stderr
    assert digest(copy) == before


def test_several_sessions_in_one_call(
    kept: tuple[Path, list[dict[str, Any]]], recordings: list[Path], tmp_path: Path
) -> None:
    """One that cannot be read stops none of the others; each has its folder; the map is that of single calls."""
    map_file, out = tmp_path / "building.evermap", tmp_path / "week"
    given = (map_file, recordings[0], tmp_path / "nothing", recordings[1], "--out", out)
    result = run("map", "enter", *given, *KNOWN_METRE, *QUICK)
    assert result.exit_code == 2
    assert "nothing: no such file or folder" in result.stderr
    assert "1 of 3 sessions were refused" in result.stderr
    assert sorted(folder.name for folder in out.iterdir()) == ["day0", "day1"]
    with open_store(map_file) as store, open_store(kept[0]) as single:
        assert store.load(store.head()).places.position_m == pytest.approx(single.load(2).places.position_m, abs=1e-12)
    result = run("slam", recordings[0], recordings[1])
    assert result.exit_code == 2
    assert "several recordings need a map (try: evermap map enter MAP INPUT..." in result.stderr


def test_of_several_sessions_the_first_that_is_read_begins_with_the_survey(
    recordings: list[Path], building: BuildingSimulation, tmp_path: Path
) -> None:
    survey = building.sessions[0].true_landmarks
    assert survey is not None
    write_map_csv(survey, tmp_path / "survey.csv")
    map_file = tmp_path / "building.evermap"
    given = (map_file, tmp_path / "nothing", *recordings[:2], "--prior-map", tmp_path / "survey.csv")
    result = run("map", "enter", *given, "--out", tmp_path / "week", *KNOWN_METRE, *QUICK)
    assert "1 of 3 sessions were refused" in result.stderr
    with open_store(map_file) as store:
        assert [len(store.load(number).places) >= len(survey) for number in (1, 2, 3)] == [True] * 3


@pytest.mark.parametrize("slam", [enter, localize])
def test_ranges_in_millimetres_leave_the_map_as_it_is(
    copy: Path, building: BuildingSimulation, tmp_path: Path, slam: Callable[..., Result]
) -> None:
    """As without a map: exit code 3, and what is wrong."""
    other = building.sessions[2]
    detections = replace(other.detections, range_m=1e3 * other.detections.range_m)
    write_native(replace(other, detections=detections), tmp_path / "long")
    before = digest(copy)
    result = slam(tmp_path / "long", copy, tmp_path / "run")
    assert result.exit_code == 3, result.output
    assert "sensor suspect: ranges seem to be in millimetres" in result.stderr.splitlines()[-1]
    assert digest(copy) == before
    assert run("slam", tmp_path / "long", "--out", tmp_path / "alone", *QUICK).exit_code == 3


def test_a_session_that_is_refused_reports_no_change(copy: Path, building: BuildingSimulation, tmp_path: Path) -> None:
    """Its ranges are 15 % long: what it says has moved, and that one landmark more is there, is believed as little."""
    other, seen = building.sessions[2], building.sessions[2].detections
    names = np.where(seen.landmark_id == np.bincount(seen.landmark_id[seen.landmark_id >= 0]).argmax(), 7000, -1)
    names = np.where(names < 0, seen.landmark_id, names)
    detections = replace(seen, range_m=1.15 * seen.range_m, landmark_id=names)
    write_native(replace(other, detections=detections, true_landmarks=None), tmp_path / "long")
    result = enter(tmp_path / "long", copy, tmp_path / "run", "--set", "slam.explain.on=false")  # as quickly
    assert result.exit_code == 3
    assert "the session was set aside, the map is unchanged: " in result.stderr.splitlines()[-1]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    assert (summary["accepted"], summary["changes"], summary["alternatives"]) == (False, [], [])
    assert summary["counts"]["landmarks_grown"] == 0
    assert not (tmp_path / "run" / "changes.jsonl").read_text(encoding="utf-8")


def test_which_verdicts_enter_is_set(recordings: list[Path], kept: tuple[Path, list[dict[str, Any]]]) -> None:
    """A weak session with 'weak' or 'any', others with 'any'; a commit in spite of it leaves the map as it is."""
    before = digest(kept[0])
    with open_store(kept[0]) as store:
        entered = enter_session(store, read_native(recordings[2]), Config())
        entering = {kind: set[str]() for kind in VerdictKind}
        for kind in VerdictKind:
            judged = replace(entered.session.slam, verdict=Verdict(kind, "why"))
            one = replace(entered, session=replace(entered.session, slam=judged))
            for accept in ("sound", "weak", "any"):
                config = Config.model_validate({"living": {"accept": accept}})
                if not one.refusal(config):
                    entering[kind].add(accept)
                    continue
                with pytest.raises(DataError, match="does not enter the map"):
                    one.commit(store, config)
    assert entering.pop(VerdictKind.SOUND) == {"sound", "weak", "any"}
    assert entering.pop(VerdictKind.WEAK) == {"weak", "any"}
    assert all(accept == {"any"} for accept in entering.values())
    assert digest(kept[0]) == before


def test_a_session_of_another_place_is_refused(copy: Path, building: BuildingSimulation, tmp_path: Path) -> None:
    """Its folder is written, for it was driven and solved; the map stays as it was."""
    other = building.sessions[2]
    names = np.where(other.detections.landmark_id >= 0, other.detections.landmark_id + 1000, -1)
    detections = replace(other.detections, landmark_id=names)
    write_native(replace(other, detections=detections, true_landmarks=None), tmp_path / "elsewhere")
    before = digest(copy)
    result = enter(tmp_path / "elsewhere", copy, tmp_path / "run")
    assert result.exit_code == 3
    problem = result.stderr.splitlines()[-1]
    assert "was set aside, the map is unchanged: too few of the detected landmarks" in problem
    assert "begin another map" in problem
    assert digest(copy) == before
    summary = json.loads((tmp_path / "run" / "summary.json").read_text(encoding="utf-8"))
    assert (summary["accepted"], summary["verdict"]["kind"]) == (False, "map outdated")
    assert summary["frames"]["map"].startswith("first_pose")


def test_localising_needs_a_map_with_something_in_it(recordings: list[Path], tmp_path: Path) -> None:
    assert "INPUT" in one_line(run("localize", recordings[0], "--out", tmp_path / "run"))
    missing = tmp_path / "none.evermap"
    assert str(missing) in one_line(localize(recordings[0], missing, tmp_path / "run"))
    assert not missing.exists()
    empty = tmp_path / "empty.evermap"
    open_store(empty, create=True).close()
    before = digest(empty)
    assert "empty" in one_line(localize(recordings[0], empty, tmp_path / "run"))
    assert digest(empty) == before
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("content", [b"landmark_id,x_m,y_m\n1,0.0,0.0\n", b"SQLite format 3\0" + bytes(4000)])
def test_a_file_that_is_no_map_is_left_alone(content: bytes, recordings: list[Path], tmp_path: Path) -> None:
    path = tmp_path / "something.csv"
    path.write_bytes(content)
    for slam in (enter, localize):
        assert str(path) in one_line(slam(recordings[0], path, tmp_path / "run"))
        assert path.read_bytes() == content
        assert not (tmp_path / "run").exists()


def test_a_recording_that_cannot_be_read_makes_no_map(tmp_path: Path) -> None:
    one_line(enter(tmp_path / "nothing", tmp_path / "new.evermap", tmp_path / "run"))
    assert not (tmp_path / "new.evermap").exists()
