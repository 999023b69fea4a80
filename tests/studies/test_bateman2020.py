"""Bateman 2020 again: scores against counts, the thesis' table, what is told, and the command."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.metrics.belief import reliability
from evermap_studies.bateman2020 import study as bateman2020
from evermap_studies.bateman2020.expected import PROMISED, verdicts
from evermap_studies.bateman2020.filters import beliefs
from evermap_studies.bateman2020.published import THESIS, TRIAL, orderings, pairs
from evermap_studies.bateman2020.runs import Stack, simulate
from evermap_studies.bateman2020.scores import METRICS, Scored, score, sweep, sweep_points
from evermap_studies.bateman2020.settings import IN_THE_TABLE, LEARNED, NOMINAL, READINGS, SENSORS, default_settings

from .bateman2020_small import P_MISS, small

pytestmark = pytest.mark.slow
"""Whole studies: `make test-slow` runs them, and the nightly part."""

PAPER = Path(__file__).resolve().parents[3] / "shared" / "papers" / "001_c5df7cde2102ba6a.txt"

METRICS_PROMISED = ("accuracy", "survival_ratio", "brier", "delay_mean")


@pytest.fixture(scope="module", params=list(SENSORS))
def runs(request: pytest.FixtureRequest) -> Stack:
    return simulate(small().world_of(NOMINAL, request.param), 3, seed=5)


# the scores


def test_scores_of_landmarks_share_the_weight_of_their_clique(runs: Stack) -> None:
    """Counted one by one: every possible detection of a landmark weighs one over the landmarks of its clique."""
    assumed = default_settings().filters
    belief, clique = beliefs("iff-observable", runs, assumed, None)
    row, drawn = score(belief, clique, runs, assumed, draws=4, seed=0)
    right = total = 0.0
    for column, c in enumerate(clique.tolist()):
        weight = 1.0 / clique.tolist().count(c)
        for step in range(int(runs.first[c]), len(belief)):
            if runs.in_view[step, c]:
                there = step - runs.first[c] <= runs.survival_steps[c]
                total += weight
                right += weight * ((belief[step, column] >= 0.9) == there)
    assert row["accuracy"] == pytest.approx(right / total)
    assert set(row) == {*METRICS, *(f"{name}_se" for name in METRICS)}
    assert row["accuracy_se"] == pytest.approx(np.std(drawn["accuracy"], ddof=1))


def test_the_sweep_computes_anew_all_that_a_parameter_changes() -> None:
    """At every point the same as without any short cut; where all stands as in the file, the file's own scores."""
    few = {
        "world": {"fading_m": [6.4, 11.2]},
        "filters": {
            "p_miss": [0.8],
            "observed_m": [3.0],
            "suppression_share": [0.4],
            "rho_high": [0.5],
            "p_false": [0.01],
        },
    }
    settings = small(sweep=few)
    points: list[None] = []
    rows = list(sweep(settings, "lidar", lambda: points.append(None)))
    assert len(points) == len(sweep_points(settings)) == 7
    assert len(rows) == 7 * len(IN_THE_TABLE)
    for row in rows:
        varied = settings.varied(row["section"], row["parameter"], row["value"])
        runs = simulate(varied.world_of(NOMINAL, "lidar"), 2, settings.seed)
        found, _ = score(*beliefs(row["filter"], runs, varied.filters, None), runs, varied.filters, draws=2, seed=0)
        assert {name: row[name] for name in METRICS} == {name: found[name] for name in METRICS}


# beside the thesis


@pytest.mark.skipif(not PAPER.exists(), reason=f"no {PAPER}")
def test_the_thesis_table_is_that_of_its_text() -> None:
    text = PAPER.read_text(encoding="utf-8")
    rows = re.findall(r"^(Lidar|Luai|Liuai|Camera)\t(Accuracy|MES/S)\t([\d.\t]+)$", text, flags=re.MULTILINE)
    assert len(rows) == 4
    for sensor, metric, numbers in rows:
        names = "camera" if sensor == "Camera" else "lidar", {"Accuracy": "accuracy"}.get(metric, "survival_ratio")
        found = [THESIS[names[0], name, names[1]] for name in IN_THE_TABLE]
        assert found == [float(number) for number in numbers.split()]
    assert TRIAL.keys() == THESIS.keys()


def made_up(name: str, accuracy: float, spread: float, sensor: str = "lidar") -> Scored:
    """A filter whose MES/S nobody knows apart from others'."""
    noise = np.random.default_rng(len(name)).normal(size=50)
    row = {"world": NOMINAL, "sensor": sensor, "filter": name, "accuracy": accuracy, "survival_ratio": 0.5}
    draws = {"accuracy": accuracy + spread * noise, "survival_ratio": 0.5 + 0.1 * noise}
    return Scored(row, draws, reliability([0.5], [1.0]), np.empty((0, 3)))


def test_orderings_hold_are_reversed_or_open() -> None:
    scored = [
        made_up("jff", 0.7, 0.01),
        made_up("jcf", 0.9, 0.01),
        made_up("jcfr", 0.8, 0.01),
        made_up("iff", 0.69, 0.03),
    ]
    found = {(row["worse"], row["better"]): row["verdict"] for row in orderings(scored) if row["metric"] == "accuracy"}
    assert found == {
        ("jff", "jcf"): "holds",
        ("jff", "jcfr"): "holds",
        ("jcf", "jcfr"): "reversed",
        ("jff", "iff"): "open",
        ("iff", "jcf"): "holds",
        ("iff", "jcfr"): "holds",
    }
    assert {row["verdict"] for row in orderings(scored) if row["metric"] == "survival_ratio"} == {"open"}
    assert orderings([replace(one, row=one.row | {"world": "angle60"}) for one in scored]) == []
    assert len(list(pairs())) == len(set(pairs())) == 16


def test_promises_are_met_missed_or_not_measured() -> None:
    row = {"world": NOMINAL, "sensor": "lidar", "filter": LEARNED}
    row |= {"accuracy": 0.9971, "survival_ratio": 0.97, "brier": 0.001, "delay_mean": 2.4}
    row |= {"own_accuracy": 0.9, "own_survival_ratio": 0.99, "own_brier": 0.001, "own_delay_mean": 1.4}
    found = [r for r in verdicts([row]) if (r["world"], r["sensor"]) == (NOMINAL, "lidar")]
    by_column = {column: {r["metric"]: r["met"][column] for r in found} for column in found[0]["met"]}
    assert by_column == {
        "learned": {"accuracy": True, "survival_ratio": False, "brier": True, "delay_mean": False},
        "learned, own decisions": {"accuracy": False, "survival_ratio": True, "brier": True, "delay_mean": True},
        "learned-warm, own decisions": dict.fromkeys(METRICS_PROMISED),
        "oracle": dict.fromkeys(METRICS_PROMISED),
        "oracle, own decisions": dict.fromkeys(METRICS_PROMISED),
    }
    others = [r for r in verdicts([row]) if (r["world"], r["sensor"]) != (NOMINAL, "lidar")]
    assert len(others) == sum(map(len, PROMISED.values())) - 4
    assert all(value is None for r in others for value in r["met"].values())


# the whole


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("bateman2020") / "out"
    told: list[tuple[float, float]] = []
    result = bateman2020.reproduce(out, small(), progress=lambda done, total: told.append((done, total)))
    assert told[-1][0] == told[-1][1] > 0.0
    assert result == json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert {path.name for path in out.iterdir()} == set(result["outputs"])
    return result


def test_the_whole_has_every_filter_in_every_world(table: dict[str, Any]) -> None:
    found = [(row["sensor"], row["world"], row["filter"]) for row in table["rows"]]
    settings = small()
    expected = [(s, w, f) for s in SENSORS for w in settings.worlds for f in settings.filters_in(w)]
    assert found == expected
    assert len(table["orderings"]) == 2 * 64
    assert len(table["sweep"]) == 2 * 3 * len(IN_THE_TABLE)
    names = ("scene", "beliefs", "sensitivity-lidar", "sensitivity-camera", "calibration")
    assert {f"{name}.{kind}" for name in names for kind in ("png", "svg")} <= set(table["outputs"])


def test_the_text_tells_what_is_in_the_table(table: dict[str, Any]) -> None:
    text = bateman2020.as_markdown(table)
    rows = {row["world"]: row for row in table["rows"] if (row["sensor"], row["filter"]) == ("camera", "jcfr")}
    cells = [f"{rows[world]['accuracy']:.3f} ± {rows[world]['accuracy_se']:.3f}" for world in READINGS]
    assert f"| `jcfr` | {cells[0]} | {cells[1]} | 0.844 | 0.887 |" in text
    for world, sensor in ((world, sensor) for world in READINGS for sensor in SENSORS):
        where = world, sensor, "accuracy"
        own = [r["verdict"] for r in table["orderings"] if (r["world"], r["sensor"], r["metric"]) == where]
        assert f"| {world} | {sensor} | accuracy | {own.count('holds')} of 16 |" in text
    occluded = [line for line in text.splitlines() if line.startswith("| occlusion | `oracle` |")]
    assert len(occluded) == 2 * len(SENSORS)  # by the decisions of the thesis, and by the own ones
    angles = [
        r for r in table["sweep"] if (r["sensor"], r["filter"], r["parameter"]) == ("lidar", "jcf", "viewing_angle_deg")
    ]
    low, high = sorted(r["accuracy"] for r in angles)
    assert f"{low:.3f}–{high:.3f}" in next(line for line in text.splitlines() if line.startswith("| viewing angle"))


def test_the_seed_decides(table: dict[str, Any]) -> None:
    few = {"chosen": ("jcf", "iff"), "worlds": (NOMINAL,)}
    one, two, other = (
        bateman2020.compute(small(seed=seed, **few), dict.fromkeys(SENSORS, P_MISS)) for seed in (0, 0, 1)
    )
    assert [scored.row for scored in one[0]] == [scored.row for scored in two[0]]
    assert [scored.row for scored in one[0]] != [scored.row for scored in other[0]]
    assert one[1] == []
    whole = [row for row in table["rows"] if row["world"] == NOMINAL and row["filter"] in few["chosen"]]
    assert [scored.row for scored in one[0]] == whole


@pytest.mark.slow
def test_knowing_more_is_better() -> None:
    """The order of what the filters know is that of their scores, whatever the parameters of the world."""
    settings = default_settings(runs=20, worlds=(NOMINAL,), chosen=("jff", "jcf", "jcfr", "jcf-tuned", "oracle"))
    scored, _ = bateman2020.compute(settings, {"lidar": 0.82, "camera": 0.83})
    for sensor in SENSORS:
        rows = {one.row["filter"]: one.row for one in scored if one.row["sensor"] == sensor}
        accuracy = [rows[name]["accuracy"] for name in ("jff", "jcf", "jcfr", "jcf-tuned", "oracle")]
        assert accuracy == sorted(accuracy)
        assert rows["oracle"]["brier"] < rows["jcf-tuned"]["brier"] < rows["jcf"]["brier"]
        assert rows["oracle"]["calibration_error"] < 0.01


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["reproduce", "bateman2020", *(str(argument) for argument in arguments)])


def test_command_runs_what_it_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bateman2020, "default_settings", small)
    chosen = ("--world", "pose-noise", "--filters", "oracle, jcf", "--runs", "2", "--seed", "3")
    result = run(*chosen, "--json", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert [(row["world"], row["filter"]) for row in found["rows"]] == 2 * [
        ("pose-noise", "jcf"),
        ("pose-noise", "oracle"),
    ]
    assert (found["settings"]["runs"], found["settings"]["seed"], found["sweep"]) == (2, 3, [])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--world", "mars"], "field '--world': there is no 'mars' (try: nominal, uniform-lifetimes, angle60,"),
        (["--filters", "jcf,kalman"], "field '--filters': there is no 'kalman' (try: iff, jff,"),
        (["--runs", "1"], "field '--runs': must be 2 at least"),
        (["--seed", "-1"], "field '--seed'"),
        (["--data", "here"], "No such option: --data"),
    ],
)
def test_mistake_of_the_command_is_one_line(
    arguments: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.exit_code == 2
    assert named in result.stderr
    assert result.stderr.splitlines()[-1].startswith("evermap: error: ")
    assert not list(tmp_path.iterdir())
