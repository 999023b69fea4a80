"""Rosen 2016 again: scores against brute force over every grid time, numbers against the reference."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.errors import ConfigError, InputError
from evermap.existence.one_stay import PersistenceFilter
from evermap.runs.folder import MANIFEST
from evermap.survival import GeneralPurpose, LifetimePrior, Uniform, never_leaves
from evermap_studies.rosen2016 import study as rosen2016
from evermap_studies.rosen2016.examples import QUIET_S, example_looks, example_priors
from evermap_studies.rosen2016.reference import Reference, compare, key_of, read_reference
from evermap_studies.rosen2016.scores import Estimate, Stretches, empirical, filtered, l1_error, removal
from evermap_studies.rosen2016.table import verdict
from evermap_studies.worlds.revisits import RevisitConfig, Revisits, simulate_revisits

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden"
needs_golden = pytest.mark.skipif(not (GOLDEN / "rosen2016.json").exists(), reason=f"no {GOLDEN}/rosen2016.json")
GRID_S = np.arange(300, dtype=np.float64) * 0.1
CONFIG = RevisitConfig(horizon_s=30.0, revisit_rate_hz=0.2, p_miss=0.2, p_false=0.1)


def on_the_grid() -> Revisits:
    """Looks and a change at grid times exactly, sequences of one look and of none."""
    return Revisits(
        survival_s=np.array([GRID_S[50], 12.34, 40.0, 0.0]),
        first=np.array([0, 3, 4, 4, 6]),
        stamp_s=np.array([GRID_S[10], GRID_S[50], GRID_S[120], 20.0, 29.9, 29.95]),
        detected=np.array([True, False, False, False, True, False]),
        visit=np.zeros(6, dtype=np.int64),
    )


def looks_of(data: Revisits, k: int) -> list[tuple[float, bool]]:
    rows = slice(data.first[k], data.first[k + 1])
    return list(zip(data.stamp_s[rows].tolist(), data.detected[rows].tolist(), strict=True))


def filter_beliefs(data: Revisits, k: int, prior: LifetimePrior) -> np.ndarray:
    """The one-feature filter, asked at every grid time."""
    belief, waiting, asked = PersistenceFilter(prior), looks_of(data, k), []
    for time_s in GRID_S.tolist():
        while waiting and waiting[0][0] <= time_s:
            belief.update(*waiting.pop(0), CONFIG.p_miss, CONFIG.p_false)
        asked.append(belief.predict(time_s))
    return np.array(asked)


def empirical_beliefs(data: Revisits, k: int, *, as_coded: bool) -> np.ndarray:
    looks = looks_of(data, k)
    asked = []
    for time_s in GRID_S.tolist():
        outputs = [1.0, *(float(hit) for stamp_s, hit in looks if stamp_s <= time_s)]
        past_the_last = as_coded and len(outputs) == len(looks) + 1 and len(looks) > 0
        asked.append(outputs[-2] if past_the_last else outputs[-1])
    return np.array(asked)


PRIORS = {"uniform": Uniform(30.0), "general_purpose": GeneralPurpose(0.01, 1.0), "never": never_leaves()}


@pytest.mark.parametrize("data", [simulate_revisits(25, CONFIG, 2), on_the_grid()], ids=["random", "on the grid"])
@pytest.mark.parametrize("estimator", [*PRIORS, "empirical", "empirical_as_coded"])
def test_scores_equal_brute_force(data: Revisits, estimator: str) -> None:
    cut = Stretches.of(data, GRID_S)
    if estimator in PRIORS:
        estimate = filtered(data, cut, PRIORS[estimator], CONFIG.p_miss, CONFIG.p_false)
        beliefs = [filter_beliefs(data, k, PRIORS[estimator]) for k in range(len(data))]
    else:
        as_coded = estimator == "empirical_as_coded"
        estimate = empirical(data, cut, as_coded=as_coded)
        beliefs = [empirical_beliefs(data, k, as_coded=as_coded) for k in range(len(data))]
    truth = data.survival_s[:, None] >= GRID_S
    asked = np.array(beliefs)
    errors = np.trapezoid(np.abs(truth - asked), GRID_S, axis=1) / GRID_S[-1]
    np.testing.assert_allclose(l1_error(estimate, cut), errors, rtol=1e-7, atol=1e-9)
    for threshold in (0.01, 0.3, 0.5, 0.9):
        removed = asked < threshold
        with np.errstate(invalid="ignore"):
            precision = (removed & ~truth).sum(axis=1) / removed.sum(axis=1)
            recall = (removed & ~truth).sum(axis=1) / (~truth).sum(axis=1)
        found = removal(estimate, cut, threshold)
        np.testing.assert_allclose(found[0], precision, rtol=1e-12)
        np.testing.assert_allclose(found[1], recall, rtol=1e-12)


def test_perfect_and_worst_beliefs_have_errors_0_and_1() -> None:
    data = simulate_revisits(5, CONFIG, 0)
    always = Revisits(np.full(5, 99.0), data.first, data.stamp_s, data.detected, data.visit)
    cut = Stretches.of(always, GRID_S)
    ones = np.ones(len(cut.sequence))
    np.testing.assert_allclose(l1_error(Estimate(ones, np.ones(len(GRID_S))), cut), 0.0, atol=1e-12)
    np.testing.assert_allclose(l1_error(Estimate(0.0 * ones, np.ones(len(GRID_S))), cut), 1.0, rtol=1e-12)
    precision, recall = removal(Estimate(0.0 * ones, np.ones(len(GRID_S))), cut, 0.5)
    np.testing.assert_array_equal(precision, 0.0)
    assert np.all(np.isnan(recall))


def test_settings_are_those_of_the_paper() -> None:
    paper = rosen2016.Settings()
    base = paper.base
    assert (base.horizon_s, base.revisit_rate_hz, base.look_rate_hz, base.p_leave) == (1000.0, 1 / 50, 1.0, 0.2)
    assert (base.p_miss, base.p_false, paper.low_hz, paper.high_hz) == (0.1, 0.1, 0.001, 1.0)
    assert len(list(paper.cells())) == 81 + 5 + 1
    assert (len(paper.grid_s), paper.grid_s[0], paper.grid_s[-1]) == (10_000, 0.0, pytest.approx(999.9))


def test_every_setting_has_its_own_stream_and_the_seed_decides() -> None:
    few: dict[str, Any] = {"detector_errors": (0.1,), "revisit_rates_hz": (1 / 50,), "sequences": 20}
    one, two, other = (rosen2016.compute(rosen2016.Settings(**few, seed=seed)) for seed in (4, 4, 5))
    assert one == two
    assert one != other
    looks = [value["value"] for value in one if value["metric"] == "looks"]
    assert looks[0] != looks[1], "figures 3 a to c and 3 d must not share their sequences"


@pytest.mark.slow
@needs_golden
def test_some_reference_numbers_are_met() -> None:
    settings = rosen2016.Settings(detector_errors=(0.1, 0.4), revisit_rates_hz=(1 / 50, 1 / 5), sequences=2000)
    values = rosen2016.compute(settings)
    compare(values, read_reference(GOLDEN))
    assert len(values) == 4 * 5 + 2 * 5 + 24 * 4
    assert [value for value in values if abs(value["z"]) > 3.0] == []


@pytest.mark.experiment
@pytest.mark.slow
@needs_golden
def test_all_reference_numbers_are_met(tmp_path: Path) -> None:
    table = rosen2016.reproduce(tmp_path / "out", data=GOLDEN)
    assert table["verdict"]["compared"] == table["verdict"]["in_reference"] == len(table["values"]) == 526
    assert table["verdict"]["outside_values"] == []
    assert 0.8 < table["verdict"]["z_rms"] < 1.2


def value(**changes: Any) -> dict[str, Any]:
    plain = {
        "figure": "4",
        "metric": "recall",
        "estimator": "uniform",
        "p_miss": 0.1,
        "p_false": 0.1,
        "revisit_rate_hz": 1 / 50,
        "threshold": 0.1,
        "n": 400,
        "value": 0.8,
        "se": 0.03,
    }
    return plain | changes


def test_z_is_the_difference_over_its_standard_error() -> None:
    ours = [value(), value(metric="looks", se=0.5, value=95.0), value(metric="recall_known", value=0.9)]
    reference = {
        key_of(ours[0]): Reference(0.7, 0.04, 100),
        key_of(ours[1]): Reference(94.0, None, 100),
        key_of(ours[2]): Reference(0.8, None, 100),
    }
    compare(ours, reference)
    assert ours[0]["z"] == pytest.approx(0.1 / 0.05)
    assert ours[1]["reference_se"] == pytest.approx(1.0)  # the same spread, a quarter of the sequences
    assert ours[1]["z"] == pytest.approx(1.0 / np.hypot(0.5, 1.0))
    pooled = (400 * 0.9 + 100 * 0.8) / 500
    assert ours[2]["z"] == pytest.approx(0.1 / np.sqrt(pooled * (1 - pooled) * (1 / 400 + 1 / 100)))


def test_verdict_counts_what_is_outside_and_what_chance_expects() -> None:
    values = [value(z=z) for z in (0.1, -3.1, 2.9, None)] + [value()]
    judged = verdict(values, in_reference=7)
    assert (judged["compared"], judged["outside"], judged["in_reference"]) == (4, 2, 7)
    assert judged["expected_outside"] == pytest.approx(4 * 0.0026998, rel=1e-4)
    assert judged["z_largest"] == -3.1


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "cannot be read"),
        ("{", "not what is expected"),
        ("{}", "fig3_grid"),
        ('{"fig3_grid": [{"P_M": 0.1}], "fig3d": [], "fig4": []}', "field 'uniform'"),
        ('{"fig3_grid": 3}', "fig3d"),
    ],
)
def test_damaged_reference_is_one_line(tmp_path: Path, content: str | None, named: str) -> None:
    if content is not None:
        (tmp_path / "rosen2016.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=named):
        read_reference(tmp_path)


def test_examples_show_what_the_paper_says_of_figures_1_and_2() -> None:
    stamp_s, detected = example_looks(0)
    assert not np.any((stamp_s > QUIET_S[0]) & (stamp_s < QUIET_S[1]))
    assert len(stamp_s) == len(detected) > 30
    red, blue, _ = example_priors().values()
    assert red.hazard(2.9) > 100 * red.hazard(5.0)
    assert 0.0 < red.p_never_leaves < 0.1
    np.testing.assert_array_equal(blue.hazard([0.25, 0.75, 3.25, 3.75]) > 0.0, [True, False, True, False])


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["reproduce", "rosen2016", *(str(argument) for argument in arguments)])


def test_command_works_without_reference_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("--sequences", "3", "--seed", "7", "--json", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    assert "compared with nothing" in result.stderr
    table = json.loads(result.stdout)
    assert table == json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert (table["settings"]["seed"], table["settings"]["sequences"], table["verdict"]) == (7, 3, None)
    figures = ["fig1-belief", "fig2-priors", "fig3-error", "fig4-removal"]
    names = {f"{name}.{kind}" for name in figures for kind in ("png", "svg")} | {"table.md", "summary.json", MANIFEST}
    assert set(table["outputs"]) == names == {path.name for path in (tmp_path / "out").iterdir()}
    assert "Compared with nothing" in (tmp_path / "out" / "table.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--data", "nowhere"], "nowhere/rosen2016.json: cannot be read"),
        (["--sequences", "1"], "field '--sequences'"),
        (["--seed", "-1"], "field '--seed'"),
        (["--all"], "No such option: --all"),
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


def test_reproduction_never_replaces_foreign_files(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"notes\.txt"):
        rosen2016.reproduce(tmp_path)
