"""`evermap persist`: the folder it writes, what it prints, and how it refuses."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.runs.folder import MANIFEST
from evermap.runs.persist.table import read_looks
from evermap.types import landmark_id_of

PNG = b"\x89PNG"


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["persist", *(str(argument) for argument in arguments)])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table that `evermap init looks` writes."""
    path = tmp_path_factory.mktemp("example") / "looks.csv"
    assert run("--init", path).exit_code == 0
    return path


@pytest.fixture(scope="module")
def done(example: Path) -> tuple[Path, dict[str, Any]]:
    """A run of the example: its folder and what --json printed."""
    out = example.parent / "out"
    result = run(example, "--out", out, "--json", "--prior", "cart=0.9*exponential:half-life=12h+0.1*never-leaves")
    assert result.exit_code == 0, result.stderr
    assert "class 'cart': 10 % of the features never leave, by the prior" in result.stderr
    return out, json.loads(result.stdout)


def test_the_summary_is_printed_as_it_is_written_and_lists_every_file(done: tuple[Path, dict[str, Any]]) -> None:
    out, summary = done
    assert summary == json.loads((out / "summary.json").read_text())
    there = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    assert summary["outputs"] == there
    assert {"beliefs.csv", "changes.jsonl", "forecasts.csv", "report.html", "figures/overview.png"} <= set(there)
    assert "figures/feature-cart-3.png" in there
    assert all((out / name).read_bytes().startswith(PNG) for name in there if name.endswith(".png"))
    assert summary["schema_version"] == "3"
    assert summary["never_leave_share"] == pytest.approx({"all": 0.0, "cart": 0.1})
    assert summary["detector"]["p_miss"] == {"least": 0.1, "most": 0.1}
    assert summary["model"] == {"all": "one-stay", "cart": "one-stay"}


def test_beliefs_are_one_a_row_in_the_order_of_the_input(done: tuple[Path, dict[str, Any]], example: Path) -> None:
    out, summary = done
    looks = read_looks(example)
    beliefs = rows_of(out / "beliefs.csv")
    assert list(beliefs[0]) == ["stamp_s", "feature_id", "p_exists"]
    assert [row["feature_id"] for row in beliefs] == [looks.names[k] for k in looks.feature]
    np.testing.assert_array_equal([float(row["stamp_s"]) for row in beliefs], looks.stamp_s)
    given = [float(row["p_exists"]) for row in beliefs if row["p_exists"]]
    assert summary["counts"]["beliefs"] == len(given)
    assert summary["counts"]["rows"] == len(beliefs)
    # scores again, from the files alone
    assert looks.present is not None
    truth = dict(enumerate(looks.present.tolist()))
    pairs = [(float(row["p_exists"]), truth[k]) for k, row in enumerate(beliefs) if row["p_exists"]]
    pairs = [(p, y) for p, y in pairs if not math.isnan(y)]
    assert summary["metrics"]["count"] == len(pairs)
    assert summary["metrics"]["brier"] == pytest.approx(sum((p - y) ** 2 for p, y in pairs) / len(pairs))
    assert sum(summary["reliability"]["count"]) == len(pairs)


def test_changes_tell_what_happened(done: tuple[Path, dict[str, Any]]) -> None:
    out, summary = done
    changes = [json.loads(line) for line in (out / "changes.jsonl").read_text().splitlines()]
    assert summary["counts"]["vanished"] + summary["counts"]["returned"] == len(changes)
    gone = [change for change in changes if change["names"] == ["pallet-7"]]
    assert [change["kind"] for change in gone] == ["vanished"]
    assert gone[0]["landmarks"] == [landmark_id_of("pallet-7")]
    left_s = 2.6 * 86400.0  # as the example has it
    assert gone[0]["stamp_from_s"] <= left_s <= gone[0]["stamp_to_s"] <= gone[0]["decided_s"]
    assert gone[0]["stamp_from_s"] <= gone[0]["stamp_s"] <= gone[0]["stamp_to_s"]
    assert 0.9 <= gone[0]["probability"] <= 1.0
    assert not [change for change in changes if change["names"][0].startswith("pillar")]


def test_forecasts_never_rise_without_a_look_and_say_how_long(done: tuple[Path, dict[str, Any]]) -> None:
    forecasts = rows_of(done[0] / "forecasts.csv")
    assert list(forecasts[0]) == [
        "stamp_s", "feature_id", "p_exists", "median_stay_s", "mean_stay_s", "mean_absence_s",
    ]  # fmt: skip
    for name in ("pillar-1", "cart-3"):
        mine = [row for row in forecasts if row["feature_id"] == name]
        assert len(mine) == 11
        p = [float(row["p_exists"]) for row in mine]
        assert p == sorted(p, reverse=True)
        assert float(mine[0]["median_stay_s"]) > 0.0
        assert not any(row["median_stay_s"] for row in mine[1:])


def test_the_same_input_gives_the_same_bytes(example: Path, done: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    again = tmp_path / "again"
    result = run(example, "--out", again, "--prior", "cart=0.9*exponential:half-life=12h+0.1*never-leaves")
    assert result.exit_code == 0
    for name in done[1]["outputs"]:
        if name not in ("summary.json", "report.html", MANIFEST):  # these say when and how fast
            assert (again / name).read_bytes() == (done[0] / name).read_bytes(), name
    assert "vanished" in result.stdout
    assert str(again / "report.html") in result.stdout


def test_the_report_needs_nothing_else(done: tuple[Path, dict[str, Any]]) -> None:
    page = (done[0] / "report.html").read_text()
    assert "http" not in page.replace("http-equiv", "")
    assert "<script" not in page
    for text in ("cart-3", "pallet-7", "never leave", "Brier score", "data:image/png"):
        assert text in page


def test_without_truth_there_is_no_score(tmp_path: Path) -> None:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected\n" + "".join(f"{k},3,1\n{k},10,0\n" for k in range(9)))
    result = run(
        path, "--out", tmp_path / "out", "--json", "--set", "figures=1", "--set", "query=grid", "--set", "step_s=2"
    )
    summary = json.loads(result.stdout)
    assert summary["metrics"] is None
    assert not (tmp_path / "out" / "figures" / "calibration.png").exists()
    assert summary["counts"]["features_detected"] == 1
    beliefs = rows_of(tmp_path / "out" / "beliefs.csv")
    assert [(row["stamp_s"], row["feature_id"]) for row in beliefs[:6]] == [
        *((str(k), "3") for k in (0, 2, 4, 6, 8)), ("0", "10"),
    ]  # fmt: skip
    assert {row["p_exists"] for row in beliefs[5:]} == {""}  # never detected: nothing is believed


def test_truth_may_come_from_a_file(tmp_path: Path) -> None:
    looks, truth = tmp_path / "looks.csv", tmp_path / "truth.csv"
    looks.write_text("stamp_s,feature_id,detected\n0,a,1\n10,a,1\n20,a,0\n")
    truth.write_text("stamp_s,feature_id,present\n0,a,1\n15,a,0\n30,a,0\n")
    result = run(looks, "--truth", truth, "--out", tmp_path / "out", "--json")
    metrics = json.loads(result.stdout)["metrics"]
    assert metrics["count"] == 3
    assert metrics["share_present"] == pytest.approx(2 / 3)


def test_ids_that_are_numbers_stay_numbers(tmp_path: Path) -> None:
    path = tmp_path / "looks.csv"
    hits = [1] * 5 + [0] * 9
    path.write_text("stamp_s,feature_id,detected\n" + "".join(f"{k},12,{hit}\n" for k, hit in enumerate(hits)))
    assert run(path, "--out", tmp_path / "out").exit_code == 0
    change = json.loads((tmp_path / "out" / "changes.jsonl").read_text())
    assert (change["landmarks"], change["names"]) == ([12], None)
    assert change["kind"] == "vanished"


def test_a_learned_model_is_kept_and_gives_the_same_beliefs_again(example: Path, tmp_path: Path) -> None:
    learned = run(example, "--set", "recurrent=two-state", "--out", tmp_path / "one", "--json", "--set", "figures=0")
    summary = json.loads(learned.stdout)
    assert summary["learning"]["per"] == "class"
    assert {model["kind"] for model in summary["learning"]["models"].values()} == {"two-state"}
    assert not summary["counts"]["rows"] - summary["counts"]["beliefs"]
    model = tmp_path / "one" / "model.json"
    again = run(example, "--set", f"model={model}", "--out", tmp_path / "two", "--json", "--set", "figures=0")
    assert json.loads(again.stdout)["learning"] is None
    first, second = (rows_of(tmp_path / name / "beliefs.csv") for name in ("one", "two"))
    for a, b in zip(first, second, strict=True):
        assert float(a["p_exists"]) == pytest.approx(float(b["p_exists"]), abs=1e-9)


def refuse(result: Result) -> str:
    assert result.exit_code == 2, result.stderr
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    return result.stderr


def broken(tmp_path: Path) -> Path:
    path = tmp_path / "looks.csv"
    path.write_text("stamp_s,feature_id,detected\n0,a,1\n1,a,5\n")
    return path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (lambda path: [], "field 'INPUT': a table is needed (try: evermap init looks looks.csv"),
        (lambda path: [path.parent / "none.csv"], "none.csv: no such file"),
        (lambda path: [broken(path.parent)], "looks.csv:3: field 'detected': '5' is neither 1 nor 0"),
        (lambda path: [path, "--prior", "exponential:half-life=2"], "field '--prior': prior 'exponential:half-life=2'"),
        (lambda path: [path, "--prior", "carts=never-leaves"], "field '--prior': no feature is of class 'carts'"),
        (lambda path: [path, "--set", "horizon_s=3h"], "field 'persist.horizon_s': input should be a valid number"),
        (lambda path: [path, "--set", "recurrent=often"], "field 'recurrent': unknown kind of model 'often'"),
        (
            lambda path: [path, "--set", "p_miss=1.2"],
            "field 'persist.p_miss': input should be less than or equal to 1, not 1.2",
        ),
        (
            lambda path: [path, "--set", "model=m.json", "--prior", "never-leaves"],
            "field '--prior': a lifetime prior is for",
        ),
        (lambda path: ["--init", path], "looks.csv: exists already (try: another name)"),
    ],
)
def test_mistakes_are_one_line(
    example: Path, tmp_path: Path, arguments: Callable[[Path], list[Any]], message: str
) -> None:
    path = tmp_path / "looks.csv"
    path.write_bytes(example.read_bytes())
    assert message in refuse(run(*arguments(path), "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_not_ours_is_left_alone(example: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("precious")
    assert "contains 'thesis.tex', which no evermap run wrote" in refuse(run(example, "--out", tmp_path / "out"))
    assert run(example, "--out", tmp_path / "out", "--force", "--set", "figures=0").exit_code == 0
    refuse(run(example, "--out", tmp_path / "out", "--set", "figures=0"))
    assert run(example, "--out", tmp_path / "out", "--set", "figures=0", "--force").exit_code == 0
    assert (tmp_path / "out" / "thesis.tex").read_text() == "precious"


@pytest.mark.data
def test_a_real_recording_scores_as_its_truth_says(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "presence" / "room_test.csv.gz"
    result = run(path, "--out", tmp_path / "out", "--json", "--set", "figures=0")
    summary = json.loads(result.stdout)
    assert summary["counts"]["rows"] == 172_800
    assert summary["counts"]["features"] == 8
    looks = read_looks(path)
    beliefs = rows_of(tmp_path / "out" / "beliefs.csv")
    assert looks.present is not None
    errors = [
        (float(row["p_exists"]) - y) ** 2 for row, y in zip(beliefs, looks.present, strict=True) if row["p_exists"]
    ]
    assert summary["metrics"]["brier"] == pytest.approx(sum(errors) / len(errors))
    # what never leaves is never reported as gone
    changed = {json.loads(line)["landmarks"][0] for line in (tmp_path / "out" / "changes.jsonl").open()}
    assert changed <= {0, 2, 4, 6}
