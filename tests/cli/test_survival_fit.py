"""`evermap survival fit`: prints what the estimators find, and keeps it as a prior that filters take."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.runs.track.lifetimes import estimators
from evermap.survival import Weibull, parse_prior

GOLDEN = Path(__file__).resolve().parents[3] / "shared" / "golden" / "npmle.json"
FEW = """\
left,right,class_id,x_m,y_m
10,20,car,1,1
30,,car,1,1
5,5,car,12,1
50,60,pallet,1,1
70,,pallet,1,1
0,12,pallet,-1,1
"""


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["survival", "fit", *(str(argument) for argument in arguments)])


def numbers(*arguments: str | Path) -> Any:
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture
def few(tmp_path: Path) -> Path:
    path = tmp_path / "lifetimes.csv"
    path.write_text(FEW)
    return path


def golden_cases() -> list[dict[str, Any]]:
    return json.loads(GOLDEN.read_text())["cases"] if GOLDEN.is_file() else []


@pytest.mark.parametrize("case", golden_cases() or [{}], ids=lambda case: case.get("name", "missing"))
def test_golden_cases_through_the_command_line(case: dict[str, Any], tmp_path: Path) -> None:
    if not case:
        pytest.skip(f"{GOLDEN} is missing")
    columns = {"left": case["left"], "right": case["right"]}
    columns |= {name: case[name] for name in ("entry", "weight") if case.get(name)}
    rows = zip(*columns.values(), strict=True)
    text = "\n".join(",".join("" if cell is None else repr(cell) for cell in row) for row in rows)
    path = tmp_path / "golden.csv"
    path.write_text(",".join(columns) + "\n" + text + "\n")
    found = numbers(path)
    assert found["loglik"] == pytest.approx(case["loglik"], rel=1e-8)
    assert found["kkt_violation"] < 1e-6
    assert len(found["mass"]) == len(found["support_left"]) == len(found["support_right"])


def test_groups_are_fitted_by_themselves(few: Path, tmp_path: Path) -> None:
    groups = numbers(few, "--by", "class", "--estimator", "exponential")["groups"]
    assert [group["class_id"] for group in groups] == ["car", "pallet"]
    for group in groups:
        alone = tmp_path / "alone.csv"
        lines = FEW.splitlines()
        alone.write_text("\n".join([lines[0], *(line for line in lines if group["class_id"] in line)]) + "\n")
        assert numbers(alone, "--estimator", "exponential")["loglik"] == group["loglik"]


def test_chunks_are_squares_of_the_ground(few: Path) -> None:
    groups = numbers(few, "--by", "class,chunk", "--chunk-m", "10")["groups"]
    assert [(g["class_id"], g["chunk"], g["samples"]) for g in groups] == [
        ("car", [0, 0], 2),
        ("car", [1, 0], 1),
        ("pallet", [-1, 0], 1),
        ("pallet", [0, 0], 2),
    ]
    assert [g["samples"] for g in numbers(few, "--by", "chunk", "--chunk-m", "100")["groups"]] == [1, 5]


def test_null_is_infinity(few: Path) -> None:
    found = numbers(few)
    assert found["support_left"] == [5.0, 10.0, 50.0, 70.0]
    assert found["support_right"] == [5.0, 12.0, 60.0, None]
    np.testing.assert_allclose(found["mass"], 0.25, atol=1e-9)
    assert found["mean_stay_s"] is None


def test_families_are_those_of_scipy(tmp_path: Path) -> None:
    """Scipy fits censored data of its own accord (`CensoredData`)."""
    rng = np.random.default_rng(4)
    stay_s = 3600.0 * rng.weibull(0.8, 400)
    watched_s = rng.uniform(1000.0, 6000.0, 400)
    gone = stay_s <= watched_s
    left = np.minimum(stay_s, watched_s)
    path = tmp_path / "a.csv"
    rows = "\n".join(f"{t!r},{t if g else ''}" for t, g in zip(left.tolist(), gone.tolist(), strict=True))
    path.write_text(f"left,right\n{rows}\n")
    shape, _, scale = stats.weibull_min.fit(stats.CensoredData.right_censored(left, ~gone), floc=0)
    found = parse_prior(numbers(path, "--estimator", "weibull")["prior"])
    assert isinstance(found, Weibull)
    assert (found.shape, found.scale_s) == pytest.approx((shape, scale), rel=1e-3)


@pytest.mark.parametrize("name", ["npmle", "exponential", "best", "gp"])
def test_the_text_is_the_prior_that_was_found(few: Path, name: str) -> None:
    found = numbers(few, "--estimator", name)
    prior = parse_prior(found["prior"])
    assert float(prior.quantile(0.5)) == pytest.approx(found["half_gone_s"])
    assert prior.p_never_leaves == pytest.approx(found["p_never_leaves"])


def test_persist_takes_what_was_kept(few: Path, tmp_path: Path) -> None:
    priors = tmp_path / "priors.json"
    assert run(few, "--by", "class", "--estimator", "exponential", "--out", priors).exit_code == 0
    looks = tmp_path / "looks.csv"
    looks.write_text("stamp_s,feature_id,class_id,detected\n0,a,car,1\n0,b,pallet,1\n40,a,car,\n40,b,pallet,\n")
    result = CliRunner().invoke(
        app, ["persist", str(looks), "--set", f"model={priors}", "--out", str(tmp_path / "out"), "--set", "figures=0"]
    )
    assert result.exit_code == 0, result.stderr
    beliefs = np.genfromtxt(tmp_path / "out" / "beliefs.csv", delimiter=",", names=True)["p_exists"]
    groups = numbers(few, "--by", "class", "--estimator", "exponential")["groups"]
    expected = [math.exp(parse_prior(group["prior"]).log_survival(40.0)) for group in groups]
    np.testing.assert_allclose(beliefs[2:], expected, rtol=1e-6)


def test_one_sample_and_nobody_gone_have_defined_answers(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("left,right\n3,7\n")
    one = numbers(path)
    assert (one["support_left"], one["support_right"], one["mass"]) == ([3.0], [7.0], [1.0])
    path.write_text("left,right\n3,\n9,\n")
    result = run(path, "--json")
    endless = json.loads(result.stdout)
    assert (endless["loglik"], endless["p_never_leaves"]) == (0.0, 1.0)
    assert "no end was observed" in result.stderr


def test_pooled_hazards_tell_where_nothing_was_at_risk(tmp_path: Path) -> None:
    """Two classes, one of which nobody saw end; both met at an hour of age."""
    path = tmp_path / "a.csv"
    rows = [f"{3600 * (2 + k)},{3600 * (3 + k)},3600,cart" for k in range(20)] + ["90000,,3600,wall"] * 5
    path.write_text("\n".join(["left,right,entry,class_id", *rows]) + "\n")
    cart, wall = numbers(path, "--estimator", "pooled", "--by", "class")["groups"]
    assert cart["seen_from_s"] <= 3600.0 < 20 * 3600.0 < cart["seen_to_s"]
    assert cart["half_gone_s"] < 0.2 * (wall["half_gone_s"] or np.inf)
    curve = list(zip(wall["lower_95"], wall["survives"], wall["upper_95"], strict=True))
    assert all(low - 1e-9 <= s <= high + 1e-9 for low, s, high in curve if high > 0.01)  # a mean of few is far out
    assert sum(high > 0.01 for _, _, high in curve) > 40


@pytest.mark.parametrize(
    "estimator", ["npmle", "exponential", pytest.param("best", marks=pytest.mark.slow), "gp", "pooled"]
)
def test_what_truncation_leaves_unknown_is_told_by_every_estimator(estimator: str, tmp_path: Path) -> None:
    """Half live for hours, half for a month, and all are met at a day or later: no estimate knows of the hours."""
    rng, day = np.random.default_rng(4), 86400.0
    age = np.where(rng.random(3000) < 0.5, rng.exponential(2 * 3600.0, 3000), rng.exponential(30 * day, 3000))
    entry = rng.uniform(day, 5 * day, 3000)
    met = np.flatnonzero(age > entry)[:60]
    left = entry[met] + np.floor((age - entry)[met] / day) * day
    ends = left < 12 * day
    rows = [
        f"{a:.0f},{f'{a + day:.0f}' if end else ''},{e:.0f}"
        for a, end, e in zip(left.tolist(), ends.tolist(), entry[met].tolist(), strict=True)
    ]
    path = tmp_path / "late.csv"
    path.write_text("\n".join(["left,right,entry", *rows]) + "\n")
    found = numbers(path, "--estimator", estimator)
    stretch = 1.8 if estimator == "pooled" else 1.0  # its hazards are constant over stretches of age
    first, last = float(np.rint(entry[met]).min()), float(np.rint(np.where(ends, left + day, left)).max())
    assert first / stretch <= found["seen_from_s"] <= first
    assert last <= found["seen_to_s"] + 1.0 <= last * stretch + 1.0
    before = 100.0 * -math.expm1(parse_prior(found["prior"]).log_survival(found["seen_from_s"]))
    (line,) = [line for line in run(path, "--estimator", estimator).stdout.splitlines() if "ages with data" in line]
    assert f"that {before:.3g} % leave before is supposed, not seen" in line
    path.write_text("left,right\n3600,7200\n7200,9000\n5000,\n")
    few = numbers(path, "--estimator", estimator)
    assert few["seen_from_s"] == 0.0
    assert 9000.0 <= few["seen_to_s"] <= 9000.0 * stretch
    assert "supposed" not in run(path, "--estimator", estimator).stdout


def write_nights(path: Path, began: bool) -> None:
    """Carts that leave at night only, pallets that leave at any hour, looked at six times a day for four weeks."""
    rng, day, start = np.random.default_rng(1), 86400.0, 1_693_440_000.0  # a Thursday, 00:00
    grid = np.arange(0.0, 56 * day, 60.0)
    look_s = np.sort(rng.uniform(0.0, 28 * day, 168))
    rows = []
    for name, n in (("cart", 200), ("pallet", 120)):
        phase = grid % day
        night = np.where((phase < 6 * 3600.0) | (phase >= 20 * 3600.0), 2.4, 0.0)
        counted = np.cumsum(60.0 * night) if name == "cart" else grid
        came = rng.uniform(0.0, 25 * day, n)
        left = grid[np.searchsorted(counted, np.interp(came, grid, counted) + rng.exponential(0.5 * day, n))]
        first, after = np.searchsorted(look_s, came), np.searchsorted(look_s, left)
        for at, seen, gone in zip(came.tolist(), first.tolist(), after.tolist(), strict=True):
            if seen < gone:
                right = f"{look_s[gone] - at:.1f}" if gone < len(look_s) else ""
                when = f",{start + at:.1f}" if began else ""
                rows.append(f"{look_s[gone - 1] - at:.1f},{right},{look_s[seen] - at:.1f},{name}{when}")
    path.write_text("\n".join(["left,right,entry,class_id" + (",began" if began else ""), *rows]) + "\n")


def test_pooled_hazards_tell_the_hours_at_which_things_leave(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write_nights(path, began=False)
    plain = numbers(path, "--estimator", "pooled", "--by", "class")["groups"]
    assert all("hours" not in group for group in plain)
    write_nights(path, began=True)
    cart, pallet = numbers(path, "--estimator", "pooled", "--by", "class")["groups"]
    factor = np.array(cart["hours"]["factor"]).reshape(7, 24).mean(axis=0)
    assert factor[8:18].max() < 0.15
    assert factor[[21, 22, 23, 0, 1, 2, 3, 4]].min() > 1.0
    half_s = 0.5 * 86400.0 * np.log(2.0)
    assert cart["half_gone_s"] == pytest.approx(half_s, rel=0.06)  # by age on the wall a quarter more
    assert pallet["hours"]["factor"] is None
    assert pallet["hours"]["evidence_nats"] == cart["hours"]["evidence_nats"] > 20.0
    assert "do not follow the hours" in run(path, "--estimator", "pooled", "--by", "class").stdout
    assert "00 UTC (" in run(path, "--estimator", "pooled", "--by", "class").stdout.replace("\n", " ")


def test_help_lists_every_estimator() -> None:
    shown = run("--help").stdout.partition("Estimators:")[2].partition("Every result")[0]
    listed = {word.rstrip(",") for line in shown.splitlines() for word in line.split()}
    assert set(estimators()) <= listed


@pytest.mark.parametrize(
    ("content", "options", "named"),
    [
        ("left,right\n5,7\n9,3\n", (), ":3: field 'right': ends at 3 s, before its left at 9 s"),
        ("left,right,entry\n5,7,8\n", (), ":2: field 'entry': first observed at age 8 s, but gone by 7 s"),
        ("left,right,weight\n5,7,0\n5,8,0\n", (), "field 'weight': all weights are 0"),
        ("left,right,weight\n5,7,-1\n", (), ":2: field 'weight': -1 is outside"),
        ("left,entry\n5,7\n", (), "field 'right': missing column"),
        ("left,rigth\n5,7\n", (), "field 'rigth': unknown column (try: right)"),
        ("left,right\n", (), "has no rows below its header"),
        ("left,right\n-1,7\n", (), ":2: field 'left': -1 is outside"),
        ("left,right\n,7\n", (), ":2: field 'left': is empty"),
        ("left,right\n5,soon\n", (), ":2: field 'right': 'soon' is not a number"),
        ("left,right\n5,inf\n", (), "empty where it was never seen gone"),
        ("left,right,x_m\n5,7,0\n", (), "field 'y_m': missing column"),
        ("left,right\n5,7\n", ("--by", "class"), "field '--by': the table names no classes"),
        ("left,right\n5,7\n", ("--by", "chunk"), "field '--by': the table has no places"),
        ("left,right,x_m,y_m\n5,7,,1\n", ("--by", "chunk"), ":2: field 'x_m': is empty"),
        ("left,right\n5,7\n", ("--by", "robot"), "unknown grouping 'robot'"),
        ("left,right\n5,7\n", ("--estimator", "coxph"), "unknown estimator 'coxph'"),
        ("left,right\n5,7\n", ("--estimator", "kaplan-meier"), "neither exact nor right censored"),
        ("left,right\n5,\n", ("--estimator", "weibull"), "no lifetime has an end"),
        ("left,right\n5,7\n", ("--figure", "a.gif"), "cannot draw a '.gif' file"),
        ("left,right,x_m,y_m\n5,7,1,1\n", ("--by", "chunk", "--out", "a.json"), "a model file has no places"),
        ("left,right\n5,7\n", ("--by", "class", "--chunk-m", "0"), "field '--chunk-m': input should be greater than 0"),
    ],
)
def test_mistake_is_one_line_and_2(
    content: str, options: tuple[str, ...], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lifetimes.csv").write_text(content)
    result = run("lifetimes.csv", *options)
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1
    assert "lifetimes.csv" in result.stderr or options
    assert named in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["lifetimes.csv"]
