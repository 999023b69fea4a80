"""The demonstration's numbers against a second computation from the files that it writes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from evermap.errors import ConfigError
from evermap.pipeline import run_session
from evermap.runs.folder import check_replaceable
from evermap.viz.style import NamedFigure
from evermap_studies.demo.methods import METHODS, method_named
from evermap_studies.demo.run import run_demo
from evermap_studies.demo.scenario import Scenario
from evermap_studies.demo.story import demo_sections
from evermap_studies.demo.study import run_study
from evermap_studies.demo.truth import truth_of

pytestmark = pytest.mark.slow
"""Whole studies: `make test-slow` runs them, and the nightly part."""

SCENARIO = Scenario(days=2, patrol_lengths_s=(40.0, 60.0), wing_opens_day=1, change_rate=3.0)
SEED = 3
FILES = ("trajectory.tum", "map.geojson", "true_events.jsonl", "changes.jsonl")


@pytest.fixture(scope="module", autouse=True)
def nothing_is_timed() -> Iterator[None]:
    """Kernels need not be compiled before the first session: a slow test below looks at that, in its own process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("evermap_studies.demo.study._compile", lambda: None)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "out"
    run_demo(out, seed=SEED, scenario=SCENARIO)
    return out


@pytest.fixture(scope="module")
def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def building():
    return SCENARIO.simulate(SEED)


def aligned(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift of least squares, by the singular value decomposition (Kabsch)."""
    u, _, vt = np.linalg.svd((source - source.mean(0)).T @ (target - target.mean(0)))
    rotation = vt.T @ np.diag([1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return rotation, target.mean(0) - rotation @ source.mean(0)


def at_half_seconds(stamp_s, x_m, y_m, truth) -> tuple[np.ndarray, np.ndarray]:
    """Positions of a path and of the truth at every half second of the latter (50 Hz, scored at 2 Hz)."""
    tick = np.arange(np.searchsorted(truth.stamp_s, stamp_s[0]), len(truth), 25)
    tick = tick[truth.stamp_s[tick] <= stamp_s[-1]]
    at = truth.stamp_s[tick]
    return np.column_stack([np.interp(at, stamp_s, x_m), np.interp(at, stamp_s, y_m)]), truth.pose_world_robot[tick, :2]


@pytest.fixture(scope="module")
def map_in_truth(building) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and shift from the map's frame to the truth, by the path of the first session."""
    first = building.sessions[0]
    blind = replace(first, truth=None, true_landmarks=None)
    path = run_session(blind, None, method_named("evermap").config()).slam.trajectory
    return aligned(*at_half_seconds(path.stamp_s, *path.pose_world_robot[:, :2].T, first.truth))


def test_pose_errors_are_those_of_the_trajectory_file(folder: Path, summary, building, map_in_truth) -> None:
    stamp, x, y, *_ = np.loadtxt(folder / "trajectory.tum").T
    estimate, truth = at_half_seconds(stamp, x, y, building.sessions[-1].truth)
    told = summary["demo"]["methods"]["evermap"]["sessions"][-1]
    for key, (rotation, shift) in {
        "pose_rmse_m": map_in_truth,
        "pose_rmse_own_alignment_m": aligned(estimate, truth),
    }.items():
        error = np.linalg.norm(estimate @ rotation.T + shift - truth, axis=1)
        # the file has linear steps of 0.1 s where the evaluation follows the arc
        assert told[key] == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.02), key
    assert told["pose_rmse_own_alignment_m"] == pytest.approx(summary["metrics"]["pose_rmse_m"], rel=1e-9)


def test_precision_and_recall_are_those_of_the_map_file(folder: Path, summary, building, map_in_truth) -> None:
    table = pq.read_table(folder / "map.parquet").to_pydict()
    rotation, shift = map_in_truth
    there = building.sessions[-1].true_landmarks
    where = dict(zip(there.landmark_id.tolist(), there.position_m, strict=True))
    columns = zip(table["landmark_id"], table["x_m"], table["y_m"], strict=True)
    right = [
        name in where and np.linalg.norm(rotation @ [x, y] + shift - where[name]) <= 0.25 for name, x, y in columns
    ]
    told = summary["demo"]["methods"]["evermap"]["sessions"][-1]
    assert told["precision"] == pytest.approx(np.mean(right))
    known = truth_of(building).known[-1]
    recalled = [name for name, is_right in zip(table["landmark_id"], right, strict=True) if is_right and known[name]]
    assert told["recall"] == pytest.approx(len(recalled) / known.sum())
    assert len(recalled) > 15


def test_false_changes_are_those_of_a_second_count(folder: Path, summary, building, map_in_truth) -> None:
    """What the map's file says of each session, held against the simulation's own stays, by other means."""
    from evermap.maps.store import open_store

    store, starts = open_store(folder / "map.evermap"), [truth.start_s for truth in building.truths]
    stays = {
        name: [(s.start_s, s.end_s) for s in building.stays if s.object_id == item.object_id]
        for item in building.objects
        for name in item.landmark_ids
    }

    def pose_of(name: int, k: int) -> tuple[float, float] | None:
        return next(((a, b) for a, b in stays[name] if a <= starts[k] < b), None)

    told = never = 0
    for k, revision in enumerate(store.log()):
        for change in store.changes(revision.number):
            told += len(change.landmark_ids)
            never += sum(len({pose_of(name, j) for j in range(k + 1)}) == 1 for name in change.landmark_ids)
    numbers = summary["demo"]["methods"]["evermap"]["whole"]["changes"]
    assert (numbers["told"], numbers["never_changed"]) == (told, never)
    assert never <= numbers["false"] <= told
    assert told > 10


def test_the_map_file_has_a_revision_a_session(folder: Path, summary, building) -> None:
    from evermap.maps.store import open_store

    store = open_store(folder / "map.evermap")
    log = store.log()
    assert [revision.provenance.recording for revision in log] == [session.name for session in building.sessions]
    newest, table = store.load().landmarks(p_least=0.5), pq.read_table(folder / "map.parquet")
    assert newest.landmark_id.tolist() == table["landmark_id"].to_pylist()
    np.testing.assert_allclose(newest.position_m[:, 0], table["x_m"].to_numpy(), atol=1e-6)
    sizes = [session["landmarks"] for session in summary["demo"]["methods"]["evermap"]["sessions"]]
    assert [len(store.load(revision.number).landmarks()) for revision in log] == sizes


def test_the_world_is_that_of_the_simulation(summary, building) -> None:
    first = building.sessions[0].true_landmarks
    for told, session in zip(summary["demo"]["sessions"], building.sessions, strict=True):
        there = session.true_landmarks
        _, mine, theirs = np.intersect1d(first.landmark_id, there.landmark_id, return_indices=True)
        still = np.all(first.position_m[mine] == there.position_m[theirs], axis=1)
        assert told["landmarks"] == len(there)
        assert told["where_first_mapped"] == still.sum()
        assert told["patrol_s"] == round(session.truth.stamp_s[-1] - session.truth.stamp_s[0])
        assert told["wing_shut"] == (told["day"] == 1)
    assert sum(session["changed"] for session in summary["demo"]["sessions"]) > 20


@pytest.mark.slow
def test_same_seed_same_numbers_in_one_process_and_in_two(folder: Path, summary, tmp_path: Path) -> None:
    again = run_demo(tmp_path / "again", seed=SEED, scenario=SCENARIO, processes=2)
    changing = ("timing", "versions")
    told = json.loads(json.dumps({key: value for key, value in again.items() if key not in changing}))
    assert told == {key: value for key, value in summary.items() if key not in changing}
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


def test_the_estimator_sees_no_truth_and_the_oracle_nothing_but_what_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What goes into the engine is looked at on its way."""
    import evermap.pipeline

    solve, bring_in = evermap.pipeline.solve_alone, evermap.pipeline.bring_in
    seen, brought = [], []

    def watch_solve(recording, living, config):
        seen.append((recording.truth, recording.true_landmarks))
        return solve(recording, living, config)

    def watch_bring_in(alone, living, config):
        after = bring_in(alone, living, config)
        brought.append((living.members.landmark_id, after.living.members.landmark_id))
        return after

    monkeypatch.setattr(evermap.pipeline, "solve_alone", watch_solve)
    monkeypatch.setattr(evermap.pipeline, "bring_in", watch_bring_in)
    told: list[tuple[float, float]] = []
    scenario = replace(SCENARIO, patrol_lengths_s=(20.0,))
    study = run_study(scenario, SEED, progress=lambda done, total: told.append((done, total)))
    # progress ends at all
    assert [done for done, _ in told] == pytest.approx([6 * 2 * 19.5, 6 * 4 * 19.5])
    assert [total for _, total in told] == pytest.approx([6 * 4 * 19.5] * 2)
    assert seen == [(None, None)] * scenario.sessions
    assert [method.name for method in METHODS if method.is_told] == ["oracle"]
    before, after = (brought[len(METHODS) - 1 :: len(METHODS)][k : k + 3] for k in (1, 0))
    moves = 0
    for k in range(3):
        then, now = study.truth.position_m[k], study.truth.position_m[k + 1]
        moved = [n for n in range(len(now)) if not np.array_equal(then[n], now[n], equal_nan=True)]
        forgotten = set(after[k][1].tolist()) - set(before[k][0].tolist())
        assert forgotten == set(moved) & set(after[k][1].tolist())
        moves += len(forgotten)
    assert moves > 5
    # the others keep what they have
    for row in range(len(METHODS) - 1):
        series = brought[row :: len(METHODS)]
        assert all(np.array_equal(series[k][1], series[k + 1][0]) for k in range(3))


def test_the_first_session_has_no_past(summary) -> None:
    """Methods differ in what they do with a map."""
    first = [method["sessions"][0]["pose_rmse_m"] for method in summary["demo"]["methods"].values()]
    assert np.ptp(first) == 0.0


def test_the_folder_is_a_run_with_the_story_on_top(folder: Path, summary, building) -> None:
    there = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    assert summary["outputs"] == there
    names = ("demo_weeks", "demo", "demo_claims", "demo_scores", "demo_lifetimes")
    figures = {f"figures/{name}.png" for name in names}
    assert {"report.html", "map.evermap", *figures, *FILES} <= set(there)
    page = (folder / "report.html").read_text(encoding="utf-8")
    for method in METHODS:
        assert page.count(f"<td>{method.label}</td>") >= 2
    parts = [page.index(f'<figure id="{name}">') for name in names]
    assert parts == sorted(parts)
    assert page.index("<h1>Four weeks in one map</h1>") < parts[0]
    # all of the last session comes below
    assert (
        parts[-1]
        < page.index(f"<h2>{building.sessions[-1].name}</h2>")
        < page.index('class="cards"')
        < page.index("<h2>Accuracy</h2>")
    )
    check_replaceable(folder)  # by the next demo, without --force


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: float, total: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_demo(tmp_path / "out", seed=SEED, scenario=Scenario(days=2, patrol_lengths_s=(20.0,)), progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_a_run_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"notes\.txt"):
        run_demo(tmp_path, seed=SEED, scenario=SCENARIO)


@pytest.mark.parametrize("holds", [True, False])
def test_the_story_says_what_fell_short(summary, holds: bool) -> None:
    numbers, cost = (json.loads(json.dumps(part)) for part in (summary["demo"], summary["timing"]["demo"]))
    for outcome in (*numbers["expected"].values(), *cost["expected"].values()):
        outcome["holds"] = True
    numbers["expected"]["told_recall"]["holds"] = holds
    *_, scores = demo_sections(numbers, cost, [NamedFigure(name, None, "", "") for name in "abcde"])
    assert scores.html.count("falls short") == (not holds)


def test_the_table_says_what_each_method_tells_falsely(summary) -> None:
    numbers, cost = summary["demo"], summary["timing"]["demo"]
    *_, false, _ = demo_sections(numbers, cost, [NamedFigure(name, None, "", "") for name in "abcde"])
    for method in numbers["methods"].values():
        row = false.html[false.html.index(f"<td>{method['label']}</td>") :].partition("</tr>")[0]
        told = method["whole"]["changes"]
        if told is None:
            assert method["label"] == "oracle"
            assert row.count("–") == 9
        else:
            assert f">{told['told']}<" in row
            assert f"<strong>{told['false']}</strong>" in row
            by_length = method["by_patrol_s"].values()
            for key in ("told", "false", "false_certain", "never_changed", "knowable", "recalled"):
                assert sum(part["changes"][key] for part in by_length) == told[key], key


@pytest.mark.slow
def test_nothing_is_compiled_while_sessions_are_timed() -> None:
    """In a process of its own: what numba compiles, or loads where it was compiled, it does before the first day."""
    code = """
import sys
from evermap_studies.demo import study
from evermap_studies.demo.scenario import Scenario


def ready():
    return sum(
        len(kernel.overloads)
        for name, module in list(sys.modules.items())
        for kernel in vars(module).values()
        if name.startswith("evermap") and hasattr(kernel, "overloads") and kernel.py_func.__module__ == name
    )


if __name__ == "__main__":
    live, compiled = study._live, []

    def watched(day):
        before = ready()
        answer = live(day)
        compiled.append(ready() - before)
        return answer

    study._live = watched
    study.run_study(Scenario(days=4, wing_opens_day=2), 3)
    print(compiled)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, *days = json.loads(done.stdout)
    assert first > 0
    assert days == [0] * 4


@pytest.mark.slow
@pytest.mark.experiment
@pytest.mark.parametrize("seed", [0, 1])
def test_four_weeks_show_what_they_were_built_to_show(tmp_path: Path, seed: int) -> None:
    """What follows from what the methods do, but for times: those are no property of the code."""
    numbers = run_demo(tmp_path / "out", seed=seed, processes=2)["demo"]
    whole = {name: method["whole"] for name, method in numbers["methods"].items()}
    assert len(numbers["methods"]["static"]["weeks"]) == 4
    # a map without existence estimates is wrong about what has gone; the oracle is not
    assert whole["static"]["precision"] < 0.6 < 0.98 < whole["oracle"]["precision"]
    # sessions that are not found in it are not in its error: how much worse it is depends on how many are
    assert whole["static"]["pose_rmse_m"] > whole["oracle"]["pose_rmse_m"]
    others = [name for name in whole if name not in ("evermap", "oracle")]
    for score in ("existence_brier", "forecast_brier"):
        assert whole["evermap"][score] < min(whole[name][score] for name in others)
    # no method finds everything that can be known, or is asked what cannot
    for name in (*others, "evermap"):
        assert 0 < whole[name]["changes"]["knowable"] < numbers["true_events"]
        assert whole[name]["changes"]["recalled"] <= whole[name]["changes"]["knowable"]
