"""The demonstration's numbers against a second computation from the files that it writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from evermap.demo import Scenario, run_demo
from evermap.demo.numbers import demo_dict, drift
from evermap.demo.story import NOT_YET, demo_section
from evermap.demo.study import SERIES, run_study
from evermap.errors import ConfigError
from evermap.runfolder import check_replaceable
from evermap.types import Landmarks

SCENARIO = Scenario(sessions=2, patrol_s=40.0, change_rate=5.0)
SEED = 3
FILES = ("trajectory.tum", "online.tum", "map.geojson", "true_events.jsonl", "changes.jsonl")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "out"
    run_demo(out, seed=SEED, scenario=SCENARIO)
    return out


@pytest.fixture(scope="module")
def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def worlds():
    return SCENARIO.simulate(SEED)


def aligned(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift of least squares, by the singular value decomposition (Kabsch)."""
    u, _, vt = np.linalg.svd((source - source.mean(0)).T @ (target - target.mean(0)))
    rotation = vt.T @ np.diag([1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return rotation, target.mean(0) - rotation @ source.mean(0)


def placed(offset: np.ndarray, x: float, y: float, theta: float) -> np.ndarray:
    """Points of a body that stands at a pose."""
    c, s = np.cos(theta), np.sin(theta)
    return offset @ np.array([[c, s], [-s, c]]) + [x, y]


@pytest.fixture(scope="module")
def last_path(folder: Path, worlds) -> dict[str, np.ndarray]:
    """The last session's poses at every half second of the truth, as the file has them."""
    truth = worlds[0].sessions[-1].truth
    stamp, x, y, _, _, _, qz, qw = np.loadtxt(folder / "trajectory.tum").T
    tick = np.arange(np.searchsorted(truth.stamp_s, stamp[0]), len(truth), 25)  # 50 Hz truth, scored at 2 Hz
    tick = tick[truth.stamp_s[tick] <= stamp[-1]]
    at = truth.stamp_s[tick]
    heading = np.interp(at, stamp, np.unwrap(2 * np.arctan2(qz, qw)))
    return {
        "estimate": np.column_stack([np.interp(at, stamp, x), np.interp(at, stamp, y)]),
        "heading": heading,
        "truth": truth.pose_world_robot[tick],
    }


def test_pose_errors_are_those_of_the_trajectory_file(summary, last_path) -> None:
    rotation, shift = aligned(last_path["estimate"], last_path["truth"][:, :2])
    error = np.linalg.norm(last_path["estimate"] @ rotation.T + shift - last_path["truth"][:, :2], axis=1)
    turn = last_path["heading"] + np.arctan2(rotation[1, 0], rotation[0, 0]) - last_path["truth"][:, 2]
    wrapped = np.angle(np.exp(1j * turn))
    told = summary["demo"]["sessions"][-1]["changed"]
    # the file has linear steps of 0.1 s where the evaluation follows the arc
    assert told["pose_rmse_m"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.01)
    assert told["pose_p10_m"] == pytest.approx(np.percentile(error, 10), abs=2e-3)
    assert told["pose_p90_m"] == pytest.approx(np.percentile(error, 90), abs=2e-3)
    assert told["heading_rmse_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(wrapped**2))), rel=0.02)
    assert told["pose_rmse_m"] == summary["metrics"]["pose_rmse_m"]


def test_landmark_errors_are_those_of_the_map_file(folder, summary, worlds, last_path) -> None:
    rotation, shift = aligned(last_path["estimate"], last_path["truth"][:, :2])
    table = pq.read_table(folder / "map.parquet").to_pydict()
    truth = worlds[0].sessions[-1].true_landmarks
    where = dict(zip(truth.landmark_id.tolist(), truth.position_m, strict=True))
    columns = zip(table["landmark_id"], table["x_m"], table["y_m"], table["n_hits"], strict=True)
    error = [
        np.linalg.norm(rotation @ [x, y] + shift - where[name])
        for name, x, y, hits in columns
        if hits >= 10 and name in where
    ]
    told = summary["demo"]["sessions"][-1]["changed"]
    assert len(error) > 3
    assert told["landmark_rmse_m"] == pytest.approx(np.sqrt(np.mean(np.square(error))), rel=0.01)
    assert told["landmark_median_m"] == pytest.approx(np.median(error), abs=5e-3)


def test_outlier_share_is_that_of_the_innovations_file(folder, summary) -> None:
    p_inlier = np.array(pq.read_table(folder / "innovations.parquet")["p_inlier"])
    told = summary["demo"]["sessions"][-1]["changed"]["outlier_share"]
    assert told == pytest.approx(np.mean(p_inlier < 0.5), abs=1e-12)


def test_changes_are_what_the_true_events_add_up_to(folder, summary, worlds) -> None:
    """Replays the events between the two sessions, object by object."""
    session = worlds[0].truths
    then = set(worlds[0].sessions[0].true_landmarks.landmark_id.tolist())
    events = [json.loads(line) for line in (folder / "true_events.jsonl").read_text(encoding="utf-8").splitlines()]
    assert all(event["truth"] is True for event in events)
    before: dict[int, Any] = {}
    after: dict[int, Any] = {}
    landmarks: dict[int, list[int]] = {}
    for event in events:
        name = event["object_id"]
        landmarks[name] = event["landmark_ids"]
        if event["stamp_s"] <= session[0].start_s:
            after[name] = before[name] = event["pose_after"]
        elif event["stamp_s"] <= session[1].start_s:
            before.setdefault(name, event["pose_before"])
            after[name] = event["pose_after"]
    counts = {"moved": 0, "vanished": 0, "appeared": 0}
    for name, ids in landmarks.items():
        old, new = before.get(name), after.get(name)
        if old is None and new is not None:
            counts["appeared"] += len(ids)
        elif old is not None and new is None:
            counts["vanished"] += len(ids)
        elif old is not None:
            # a turn on the spot may leave one landmark of an object where it was
            offset = worlds[0].objects[name].offset_m
            gap = np.linalg.norm(placed(offset, *new) - placed(offset, *old), axis=1)
            counts["moved"] += int((gap > 0.05).sum())
    told = summary["demo"]["sessions"][1]["changes"]
    assert {name: told[name] for name in counts} == counts
    assert counts["moved"] > 0
    assert counts["vanished"] > 0
    assert told["landmarks_mapped_then"] == len(then)
    assert summary["demo"]["sessions"][0]["changes"]["moved"] == 0


def test_detections_of_moved_landmarks(folder, summary, worlds) -> None:
    table = pq.read_table(folder / "innovations.parquet")
    name, rejected = np.array(table["landmark_id"]), np.array(table["p_inlier"]) < 0.5
    then, now = (
        dict(zip(s.true_landmarks.landmark_id.tolist(), s.true_landmarks.position_m, strict=True))
        for s in worlds[0].sessions
    )
    gap = {k: np.linalg.norm(now[k] - then[k]) for k in then if k in now}
    of_moved = np.array([gap.get(k, 0.0) > 0.05 for k in name])
    told = summary["demo"]["sessions"][-1]["changes"]
    assert told["moved_detection_share"] == pytest.approx(of_moved.mean())
    assert told["moved_rejected_share"] == pytest.approx(rejected[of_moved].mean())
    believed = [k for k in set(name[of_moved]) if rejected[name == k].mean() < 0.5]
    assert told["moved_believed"] == len(believed)
    assert told["moved_believed"] + told["moved_rejected"] == len(set(name[of_moved]))
    if believed:
        assert told["believed_displacement_m"] == pytest.approx(np.median([gap[k] for k in believed]))


def test_drift_of_a_handmade_world() -> None:
    then = Landmarks.at([1, 2, 3, 4], [[0, 0], [1, 0], [2, 0], [3, 0]])
    now = Landmarks.at([1, 2, 4, 7], [[0, 0.04], [1, 0.3], [3, 0], [9, 9]])
    change = drift(then, now)
    assert change.stayed.tolist() == [1, 4]
    assert change.moved.tolist() == [2]
    assert change.displacement_m == pytest.approx([0.3])
    assert change.vanished.tolist() == [3]
    assert change.appeared.tolist() == [7]


def test_same_seed_same_numbers_in_one_process_and_in_two(folder: Path, summary, tmp_path: Path) -> None:
    again = run_demo(tmp_path / "again", seed=SEED, scenario=SCENARIO, processes=2)
    changing = ("timing", "versions")
    told = json.loads(json.dumps({key: value for key, value in again.items() if key not in changing}))
    assert told == {key: value for key, value in summary.items() if key not in changing}
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


def test_the_unchanged_building_does_not_know_of_the_change_rate(summary) -> None:
    scenario = Scenario(sessions=2, patrol_s=SCENARIO.patrol_s, change_rate=1.0)
    other = demo_dict(run_study(scenario, SEED, scenario.estimator()), SEED)
    pairs = list(zip(summary["demo"]["sessions"], other["sessions"], strict=True))
    for mine, theirs in pairs:
        assert mine["unchanged"] == theirs["unchanged"]
    assert pairs[1][0]["changed"] != pairs[1][1]["changed"]


def test_robot_and_noise_are_the_same_in_both_buildings(worlds) -> None:
    for changed, unchanged in zip(worlds[0].sessions, worlds[1].sessions, strict=True):
        np.testing.assert_array_equal(changed.truth.pose_world_robot, unchanged.truth.pose_world_robot)
        np.testing.assert_array_equal(changed.odometry.forward_mps, unchanged.odometry.forward_mps)
        np.testing.assert_array_equal(changed.frames.stamp_s, unchanged.frames.stamp_s)


def test_the_first_session_has_no_memory_in_any_case(summary) -> None:
    first = summary["demo"]["sessions"][0]
    assert first["changed"] == first["from_scratch"]


def test_the_folder_is_a_run_with_the_story_on_top(folder: Path, summary) -> None:
    there = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    assert summary["outputs"] == there
    assert {"figures/demo.png", "report.html", "true_events.jsonl", *FILES} <= set(there)
    assert (folder / "changes.jsonl").read_bytes() == b""  # changes are not estimated yet, and truth is no estimate
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert NOT_YET[:60] in page
    assert page.index(NOT_YET[:60]) < page.index("Where it was")
    check_replaceable(folder)  # by the next demo, without --force


def test_the_estimator_sees_no_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    import evermap.pipeline

    real, seen = evermap.pipeline.run_slam, []

    def spy(recording, config, *, prior_map):
        seen.append((recording.truth, recording.true_landmarks, prior_map is None))
        return real(recording, config, prior_map=prior_map)

    monkeypatch.setattr(evermap.pipeline, "run_slam", spy)
    scenario = Scenario(sessions=2, patrol_s=20.0)
    study = run_study(scenario, SEED, scenario.estimator())
    assert set(study.visits) == set(SERIES)
    assert all(truth is None and landmarks is None for truth, landmarks, _ in seen)
    assert [alone for _, _, alone in seen] == [True, True, True, False, False]


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: float, total: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path / "out", seed=SEED, scenario=SCENARIO, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_a_run_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"notes\.txt"):
        run_demo(tmp_path, seed=SEED, scenario=SCENARIO)


def test_progress_ends_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[float, float]] = []
    scenario = Scenario(sessions=2, patrol_s=20.0)
    run_study(scenario, SEED, scenario.estimator(), progress=lambda done, total: told.append((done, total)))
    assert [done for done, _ in told] == [20.0, 40.0, 60.0, 80.0, 100.0]
    assert {total for _, total in told} == {100.0}


@pytest.mark.parametrize(("factor", "expected"), [(2.5, "2.5 times as much"), (1.02, "hardly hurt")])
def test_the_story_claims_no_more_than_the_numbers(summary, folder, factor: float, expected: str) -> None:
    from evermap.viz.style import NamedFigure

    numbers = json.loads(json.dumps(summary["demo"]))
    for session in numbers["sessions"]:
        session["unchanged"]["pose_rmse_m"] = 0.04
        session["changed"]["pose_rmse_m"] = 0.04 * factor
    section = demo_section(numbers, NamedFigure("demo", None, "", ""))
    assert expected in section.html
    assert "does nothing about it yet" in section.html
