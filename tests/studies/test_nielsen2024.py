"""The experiment on a made-up recording, and its plan, scores, promises and tables on made-up runs."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from evermap.errors import ConfigError, InputError, NumericalError
from evermap.io.shifts import Shift
from evermap.types import ChangeKind, Landmarks, MapChange, Trajectory
from evermap_studies import commands
from evermap_studies.nielsen2024 import plan as nielsen2024_plan
from evermap_studies.nielsen2024 import study as nielsen2024
from evermap_studies.nielsen2024.expected import OTHERS_NAME, PROMISES, verdicts
from evermap_studies.nielsen2024.figures import draw_all
from evermap_studies.nielsen2024.runs import NOTHING, Job, inputs_of, places_of, recording_of, reference_of, run_job
from evermap_studies.nielsen2024.scores import change_scores, run_scores

FEW = nielsen2024.Settings(
    parts=("recordings", "during"), datasets=(6,), robots=(2,), methods=("nohyp",), deltas_m=(0.0, 0.5)
)
GROUP = (10, 11)


@pytest.fixture(scope="module")
def made(made_up_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(nielsen2024_plan.GROUP, 6, GROUP)
        patch.setattr(nielsen2024_plan, "DURING_DELTAS_M", (0.5,))
        out = tmp_path_factory.mktemp("results") / "nielsen2024"
        return nielsen2024.reproduce(made_up_data, out, FEW), out


def row_of(table: dict[str, Any], **wanted: Any) -> dict[str, Any]:
    (row,) = [row for row in table["runs"] if all(row[key] == value for key, value in wanted.items())]
    return row


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_a_right_map_places_the_robot_and_a_wrong_one_drags_it_along(made: tuple[dict[str, Any], Path]) -> None:
    right = row_of(made[0], part="recordings", sensor="ours", delta_m=0.0)
    wrong = row_of(made[0], part="recordings", sensor="ours", delta_m=0.5)
    assert right["placed"]
    assert right["pose_rmse_m"] < 0.06
    assert right["landmark_rmse_m"] < 0.03
    assert right["exact"]
    assert wrong["pose_rmse_m"] > 2 * right["pose_rmse_m"]
    assert wrong["landmark_rmse_m"] > 0.1  # two of six, half a metre off
    assert not wrong["exact"]
    assert wrong["recall"] == 0.0


def test_a_change_at_half_time_is_a_smaller_error_than_one_before(made: tuple[dict[str, Any], Path]) -> None:
    before = row_of(made[0], part="recordings", sensor="ours", delta_m=0.5)
    during = row_of(made[0], part="during", delta_m=0.5)
    still = row_of(made[0], part="recordings", sensor="ours", delta_m=0.0)
    assert still["pose_rmse_m"] < during["pose_rmse_m"] != before["pose_rmse_m"]


def test_older_rows_stay_and_what_is_run_again_is_replaced(
    made: tuple[dict[str, Any], Path], made_up_data: Path, tmp_path: Path
) -> None:
    table, out = made
    old = json.loads((out / "summary.json").read_text())
    assert old == table
    assert sorted(path.name for path in out.iterdir()) == table["outputs"]
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in out.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(nielsen2024_plan.GROUP, 6, GROUP)
        again = nielsen2024.reproduce(
            made_up_data, copy, replace(FEW, parts=("recordings",), deltas_m=(0.0, 0.2), robots=(2,))
        )
    deltas = [row["delta_m"] for row in again["runs"] if row["part"] == "recordings" and row["sensor"] == "ours"]
    assert deltas == [0.0, 0.2, 0.5]
    assert [row["part"] for row in again["runs"]].count("during") == 1
    timings = {"wall_s", "cpu_s", "step_p99_ms"}
    first, second = (row_of(t, part="recordings", sensor="ours", delta_m=0.0) for t in (table, again))
    assert {key: first[key] for key in first.keys() - timings} == {key: second[key] for key in second.keys() - timings}


def test_markdown_is_made_of_whole_tables(made: tuple[dict[str, Any], Path]) -> None:
    table, out = made
    text = nielsen2024.as_markdown(table)
    assert (out / "table.md").read_text(encoding="utf-8") == text + "\n"
    blocks = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    for block in blocks:
        assert len({line.count("|") for line in block}) == 1
        assert re.fullmatch(r"\| ---( \| ---:)+ \|", block[1])
    numbers = row_of(table, part="recordings", sensor="ours", delta_m=0.5)
    assert f"{numbers['pose_rmse_m']:.3f} / {numbers['landmark_rmse_m']:.3f}" in text
    assert not re.search(r"\bnan\b|None", text)


def test_figures_are_drawn_of_whatever_was_run(made: tuple[dict[str, Any], Path], tmp_path: Path) -> None:
    runs = made[0]["runs"]
    path = {"estimate_m": [[0.0, 0.0], [1.0, 0.0]], "reference_m": [[0.0, 0.1], [1.0, 0.1]], "landmarks_m": []}
    for name, rows, drawn, wanted in (
        ("nothing", [], {}, set()),
        ("paper", [r for r in runs if r["sensor"] == "paper"], {"group paper em dataset 6 robot 2": path},
         {"fig8", "fig9"}),
        ("ours", [r for r in runs if r["sensor"] == "ours"], {"group ours joint dataset 6 robot 2": path},
         {"fig8", "fig9"}),
    ):  # fmt: skip
        folder = tmp_path / name
        folder.mkdir()
        draw_all([], rows, drawn, lambda file, folder=folder: folder / file)
        assert {file.name.partition("-")[0] for file in folder.iterdir()} == wanted


def test_what_was_ended_goes_on_from_its_rows(
    made: tuple[dict[str, Any], Path], made_up_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in its second run, with half a line written: the first is not run again, and nothing is lost."""
    monkeypatch.setitem(nielsen2024_plan.GROUP, 6, GROUP)
    settings = replace(FEW, parts=("recordings",), sensors=("ours",))
    first = row_of(made[0], part="recordings", sensor="ours", delta_m=0.0)
    ran: list[float] = []

    def fake(job: Job, *_: Any) -> tuple[dict[str, Any], None]:
        if len(ran) == 1:
            raise SystemExit  # as good as a signal: nothing of ours is asked
        ran.append(job.delta_m)
        return {**first, **job.key}, None

    monkeypatch.setattr(nielsen2024, "run_job", fake)
    out, rows = tmp_path / "out", tmp_path / "out.rows.jsonl"
    with pytest.raises(SystemExit):
        nielsen2024.reproduce(made_up_data, out, settings)
    assert not out.exists()
    assert len(rows.read_text(encoding="utf-8").splitlines()) == 1
    rows.write_text(rows.read_text(encoding="utf-8") + '{"row": {"part', encoding="utf-8")
    ran.clear()
    table = nielsen2024.reproduce(made_up_data, out, settings)
    assert ran == [0.5]
    assert [row["delta_m"] for row in table["runs"]] == [0.0, 0.5]
    assert not rows.exists()


def test_all_selectors_make_many_modes_of_data_set_1_and_the_window_is_left_out_of_data_set_2() -> None:
    planned = {}
    for dataset in (1, 2, 6):
        rows = nielsen2024_plan._compared(
            nielsen2024.Settings(deltas_m=(0.3,)), dataset, partial(Job, dataset=dataset, robot=1)
        )
        planned[dataset] = {(job.scenario, job.sensor, job.method) for job in rows}
    many = {method for scenario, _, method in planned[1] if scenario == "many modes"}
    assert many == {"max-mixture", "nn", "em", "mcts", "viterbi", "joint"}
    assert {one for one in planned[2] if one[0] == "no window"} == {("no window", "paper-no-window", "mcts")}
    assert {scenario for scenario, _, _ in planned[6]} == {"group"}
    with_window = Job("recordings", "group", 2, 1, "paper", "mcts").config().slam.modes
    without = Job("recordings", "no window", 2, 1, "paper-no-window", "mcts").config().slam.modes
    assert with_window.mcts_window_s == 40.0
    assert without.mcts_window_s > 1e5
    assert replace_window(without) == replace_window(with_window)


def replace_window(modes: Any) -> Any:
    return modes.model_copy(update={"mcts_window_s": None})


def test_places_are_those_that_the_changes_of_a_landmark_lead_through() -> None:
    landmarks = Landmarks.at([1, 2, 3], [(1.0, 0.0), (5.0, 5.0), (2.0, 2.0)])
    moves = [change((1,)), replace(change((1,)), displacement_m=(-0.3, 0.0)), change((1,)), change((3,))]
    result = replace(SimpleResult(changes=tuple(moves)), landmarks=landmarks)
    assert [(row["landmark"], row["at_m"]) for row in places_of(result)] == [
        (1, [0.7, 0.0]), (1, [1.0, 0.0]), (3, [1.7, 2.0]), (3, [2.0, 2.0]),
    ]  # fmt: skip


def test_figures_10_and_11_are_of_the_robots_that_have_all(tmp_path: Path) -> None:
    """Two places too many for a landmark that did not move, one for one that did; robot 2 is half done."""
    places = [{"landmark": one, "at_m": [0.1 * k, 0.0]} for one, n in ((7, 3), (11, 2)) for k in range(n)]
    base = {
        **NOTHING, "part": "recordings", "scenario": "many modes", "dataset": 1, "sensor": "many-modes", "placed": True,
        "pose_rmse_m": 0.1, "landmark_rmse_m": 0.2, "cpu_s": 21.0, "commit": "abc1234, 2020-01-01",
    }  # fmt: skip
    rows = [
        {**base, "robot": 1, "method": method, "delta_m": 1.0, "places": places if method == "em" else []}
        for method in ("em", "mcts")
    ]
    rows.append({**base, "robot": 2, "method": "em", "delta_m": 1.0, "pose_rmse_m": 9.0})
    text = nielsen2024.as_markdown(
        {"simulation": [], "runs": rows, "expected": verdicts([], rows), "evermap": "0",
         "machine": {"versions": {"python": "3"}, "processor": "x"}, "settings": {"seed": 0, "processes": 1}}
    )  # fmt: skip
    section = text.partition("### Dataset 1, many modes (figures 10 and 11)")[2]
    assert "Rows of commit `abc1234`, 2020-01-01." in section
    assert "mean of one robot:" in section
    cells = [line for line in section.splitlines() if line.startswith("| em")]
    assert cells == ["| em | 0.100 / 0.200 |", "| em | 21.0 |", "| em | 2.0 |", "| em | 1.0 |"]
    path = {"estimate_m": [[0.0, 0.0], [1.0, 0.0]], "reference_m": [[0.0, 0.1], [1.0, 0.1]], "landmarks_m": [],
            "delta_m": 1.0, "true_landmarks": {"7": [0.0, 0.0], "11": [0.1, 0.0]}}  # fmt: skip
    drawn = {f"many modes many-modes {method} dataset 1 robot 1": path for method in ("em", "mcts")}
    draw_all([], rows, drawn, lambda file: tmp_path / file)
    assert {file.name.partition("-")[0] for file in tmp_path.iterdir()} == {"fig10", "fig11"}


def test_inputs_are_a_wrong_map_or_an_edited_recording(made_up_data: Path) -> None:
    recording = recording_of(made_up_data, 6, 2)
    reference = reference_of(made_up_data, 6, 2)
    assert reference.trajectory is recording.truth
    assert reference.range_law[2] == pytest.approx(0.0, abs=0.2)  # the made-up camera reports distance
    job = Job("recordings", "group", 6, 2, "ours", "nohyp", (Shift(GROUP, (0.3, 0.0)),), 0.3)
    same, prior, truth = inputs_of(job, recording, reference)
    assert same is recording
    moved = np.isin(truth.landmark_id, GROUP)
    np.testing.assert_allclose(prior.position_m - truth.position_m, np.where(moved, 0.3, 0.0)[:, None] * [1.0, 0.0])
    edited, before, after = inputs_of(replace(job, during=True), recording, reference)
    np.testing.assert_array_equal(before.position_m, truth.position_m)
    np.testing.assert_allclose(after.position_m, prior.position_m)
    half_s = recording.frames.stamp_s[[0, -1]].mean()
    kept = np.isin(recording.detections.source_line, edited.detections.source_line)
    differs = recording.detections.range_m[kept] != edited.detections.range_m
    late = recording.frames.stamp_s[edited.detections.frame] >= half_s
    np.testing.assert_array_equal(differs, late & np.isin(edited.detections.landmark_id, GROUP))
    paper, _, _ = inputs_of(replace(job, sensor="paper"), recording, reference)
    assert np.abs(paper.detections.bearing_rad).max() <= 0.4
    assert paper.detections.range_m.max() <= 5.0


def test_a_method_that_fails_leaves_a_row(made_up_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reference = reference_of(made_up_data, 6, 2)
    job = Job("recordings", "group", 6, 2, "ours", "nohyp")

    def fail(*_: Any, **__: Any) -> None:
        raise NumericalError("no finite optimum")

    monkeypatch.setattr("evermap.pipeline.run_slam", fail)
    row, result = run_job(job, made_up_data, reference)
    assert result is None
    assert row["failure"] == "no finite optimum"
    assert not row["placed"]
    text = nielsen2024.as_markdown(
        {"simulation": [], "runs": [row], "expected": verdicts([], [row]), "evermap": "0",
         "machine": {"versions": {"python": "3"}, "processor": "x"}, "settings": {"seed": 0, "processes": 1}}
    )  # fmt: skip
    assert "– / – (0 of 1)" in text


def change(ids: tuple[int, ...], probability: float = 0.9, at: tuple[float, float] = (np.nan, 0.0)) -> MapChange:
    return MapChange(ids, ChangeKind.MOVED, *at, (0.3, 0.0), 0.0, probability)


def test_changes_are_scored_as_sets(made_up_data: Path) -> None:
    recording = recording_of(made_up_data, 6, 2)
    result: Any = SimpleResult(changes=(change((8, 10)),))
    row = change_scores([change((10,)), change((8,))], result, recording, False)
    assert not row["exact"]
    assert (row["precision"], row["recall"]) == (1.0, 1.0)
    assert [(c["landmarks"], c["right"]) for c in row["changes"]] == [([8, 10], False)]
    result = SimpleResult(changes=(change((8,)), change((10,))))
    row = change_scores([change((10,)), change((8,))], result, recording, False)
    assert row["exact"]
    assert row["truth_rank"] == 0
    others = (SimpleAlternative(changes=(change((6,)),)), SimpleAlternative(changes=(change((10,)),)))
    row = change_scores([change((10,))], SimpleResult(alternatives=others), recording, False)  # type: ignore[arg-type]
    assert not row["exact"]
    assert row["truth_rank"] == 2


def test_the_time_of_a_change_is_judged_by_the_window_that_sightings_leave(made_up_data: Path) -> None:
    recording = recording_of(made_up_data, 6, 2)
    stamps = recording.frames.stamp_s[recording.detections.frame]
    at_s = float(recording.frames.stamp_s[[0, -1]].mean())
    seen = stamps[recording.detections.landmark_id == 10]
    opens, closes = seen[seen < at_s].max(), seen[seen >= at_s].min()
    for found, off in ((opens + 0.4 * (closes - opens), 0.0), (opens - 3.0, 3.0), (closes + 7.0, 7.0)):
        result: Any = SimpleResult(changes=(change((10,), at=(found - 1.0, found + 1.0)),))
        row = change_scores([change((10,), at=(at_s, at_s))], result, recording, True)
        assert row["time_off_window_s"] == pytest.approx(off, abs=1e-6)
        outside = max(found - 1.0 - at_s, at_s - found - 1.0, 0.0)
        assert row["time_off_interval_s"] == pytest.approx(outside, abs=1e-6)
    missed = change_scores([change((10,), at=(at_s, at_s))], SimpleResult(), recording, True)  # type: ignore[arg-type]
    assert missed["time_off_window_s"] is None


def SimpleResult(changes: tuple[MapChange, ...] = (), alternatives: tuple[Any, ...] = ()) -> Any:
    from evermap.types import SlamResult

    blank: Any = None
    return SlamResult(blank, blank, blank, (), blank, blank, blank, blank, changes=changes, alternatives=alternatives)


def SimpleAlternative(changes: tuple[MapChange, ...]) -> Any:
    from evermap.types import Alternative

    blank: Any = None
    return Alternative(changes, 0.1, blank)


def test_errors_are_not_aligned() -> None:
    stamps = np.arange(21) * 0.5
    truth = np.column_stack([stamps, np.sin(stamps), np.zeros(21)])
    zero = np.zeros((21, 3, 3))
    shifted = Trajectory(stamps, truth + [0.3, -0.4, 0.0], zero, frame="prior_map")
    landmarks = Landmarks.at([1, 2, 3], [(0.0, 0.0), (1.0, 0.0), (0.0, 2.0)])
    mapped = replace(
        landmarks, position_m=landmarks.position_m + [[0.1, 0.0], [0.0, 0.0], [9.0, 9.0]], n_hits=np.array([10, 30, 9])
    )
    recording: Any = SimpleNamespace(
        frames=SimpleNamespace(stamp_s=stamps), detections=SimpleNamespace(frame=np.array([0, 1]))
    )
    result: Any = SimpleNamespace(trajectory=shifted, landmarks=mapped)
    row = run_scores(recording, result, Trajectory(stamps, truth, zero, frame="truth"), None, landmarks)
    assert row["pose_rmse_m"] == pytest.approx(0.5)
    assert row["pose_seen_rmse_m"] == pytest.approx(0.5)
    assert row["landmark_rmse_m"] == pytest.approx(rms(np.array([0.1, 0.0])))  # the third was seen too seldom
    assert row["pose_true_rmse_m"] is None
    lost: Any = SimpleNamespace(trajectory=replace(shifted, frame="first_pose"), landmarks=mapped)
    assert run_scores(recording, lost, shifted, None, landmarks)["pose_rmse_m"] is None


def test_random_changes_are_disjoint_groups_of_neighbours(made_up_data: Path) -> None:
    recording = recording_of(made_up_data, 6, 2)
    counts = []
    for seed in range(60):
        shifts = nielsen2024_plan.random_shifts(recording, np.random.default_rng(seed))
        again = nielsen2024_plan.random_shifts(recording, np.random.default_rng(seed))
        assert shifts == again
        members = [identity for shift in shifts for identity in shift.landmark_ids]
        assert len(members) == len(set(members))
        assert all(0.05 <= np.hypot(*shift.displacement_m) <= 1.0 for shift in shifts)
        counts.append(len(shifts))
    assert set(counts) == {0, 1, 2}


def test_unknown_parts_and_methods_are_one_line() -> None:
    with pytest.raises(ConfigError, match="no part figure9"):
        nielsen2024.Settings(parts=("figure9",))
    with pytest.raises(ConfigError, match="no dataset 4"):
        nielsen2024.Settings(datasets=(4,))
    with pytest.raises(ConfigError, match="no method jcbb"):
        nielsen2024.Settings(methods=("jcbb",))


def test_missing_recordings_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no MRCLAM_Dataset6.zip"):
        nielsen2024.reproduce(tmp_path, tmp_path / "out", FEW)
    assert not (tmp_path / "out").exists()


def joint_row(delta: float, robot: int, **values: Any) -> dict[str, Any]:
    base = {
        "part": "recordings", "scenario": "group", "sensor": "ours", "method": "joint", "dataset": 6,
        "delta_m": delta, "robot": robot, "placed": True, "pose_rmse_m": 0.04, "landmark_rmse_m": 0.01,
        "exact": True, "truth_rank": 0, "changes": [], "recording_s": 900.0, "cpu_s": 3.0, "step_p99_ms": 9.0,
        "frames": 2000,
    }  # fmt: skip
    return base | values


def test_promises_are_measured_at_their_worst() -> None:
    nothing = verdicts([], [])
    assert len(nothing) == len(PROMISES)
    assert all(row["measured"] is None and row["met"] is None for row in nothing)
    rows = [joint_row(delta, robot) for delta in (0.0, 0.2, 0.3, 1.0) for robot in (1, 2)]
    rows[2] |= {"pose_rmse_m": 0.07, "exact": False, "truth_rank": None}  # 0.2 m, robot 1
    rows[7] |= {"pose_rmse_m": None, "placed": False}  # 1 m, robot 2 is lost
    static = [joint_row(0.2, robot, method="nohyp", pose_rmse_m=0.05) for robot in (1, 2)]
    found = {row["what"]: row for row in verdicts([], rows + static)}
    assert found["data set 6, joint: position error, nothing moved"]["met"] is True
    assert found["data set 6, joint: position error from 0.2 m on"]["measured"] > 1.0
    assert found["data set 6, joint: exact set at 0.2 m"]["measured"] == 0.5
    assert found["data set 6, joint: exact set where nothing moved, and from 0.3 m on"]["met"] is True
    assert found["data set 6, joint: no worse than the static map"]["measured"] == 0.5
    assert found["viterbi and joint, slowest recording"]["measured"] == pytest.approx(300.0)
    assert found[f"{OTHERS_NAME}, joint: landmark error"]["met"] is None


def test_command_runs_what_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, Any] = {}

    def fake(data: Path, out: Path, settings: nielsen2024.Settings, **options: Any) -> dict[str, Any]:
        asked.update(data=data, settings=settings, **options)
        return {"runs": []}

    monkeypatch.setattr(nielsen2024, "reproduce", fake)
    commands.nielsen2024(tmp_path, tmp_path / "out", part=["search"], only=["dataset=3"], as_json=True)
    assert json.loads(capsys.readouterr().out) == {"runs": []}
    assert asked["settings"] == replace(nielsen2024.Settings(), parts=("search",), datasets=(3,))
    commands.nielsen2024(tmp_path, tmp_path / "out", only=["method=em"], quick=True, jobs=3, as_json=True)
    assert asked["settings"] == replace(nielsen2024.QUICK, methods=("em",), processes=3)


@pytest.mark.experiment
@pytest.mark.slow
@pytest.mark.data
def test_one_real_robot(shared_data: Path, tmp_path: Path) -> None:
    """Robot 3 of data set 6: the whole in small, and what it must keep."""
    table = nielsen2024.reproduce(shared_data / "mrclam", tmp_path / "out", nielsen2024.QUICK)
    for delta in (0.0, 0.3, 1.0):
        joint = row_of(table, part="recordings", sensor="ours", method="joint", delta_m=delta)
        static = row_of(table, part="recordings", sensor="ours", method="nohyp", delta_m=delta)
        assert joint["exact"]
        assert joint["pose_rmse_m"] < 0.052
        assert joint["pose_rmse_m"] <= static["pose_rmse_m"] + 0.001
    simulated = {row["what"]: row["met"] for row in table["expected"] if row["what"].startswith("simulation")}
    assert simulated["simulation: sequences of which mcts' objective is above viterbi's"] is True
