"""Bateman 2020 again: the stack against single runs, filters against plain recursions, scores against counts."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from evermap.cli.main import app
from evermap.errors import ConfigError
from evermap.experiments import bateman2020
from evermap.experiments.bateman2020_expected import PROMISED, verdicts
from evermap.experiments.bateman2020_filters import beliefs
from evermap.experiments.bateman2020_published import THESIS, TRIAL, orderings, pairs
from evermap.experiments.bateman2020_runs import TUNING, Stack, miss_rate, simulate, stack
from evermap.experiments.bateman2020_scores import METRICS, Scored, score, sweep, sweep_points
from evermap.experiments.bateman2020_settings import (
    FILTERS,
    IN_THE_TABLE,
    LEARNED,
    NOMINAL,
    READINGS,
    SENSORS,
    SUPPRESSION,
    UNIFORM,
    WORLDS,
    Settings,
    default_settings,
)
from evermap.metrics.belief import reliability
from evermap.persistence.one import PersistenceFilter
from evermap.sim.cliques import named_world
from evermap.survival import Exponential

PAPER = Path(__file__).resolve().parents[3] / "shared" / "papers" / "001_c5df7cde2102ba6a.txt"
P_MISS = 0.8
METRICS_PROMISED = ("accuracy", "survival_ratio", "brier", "delay_mean")


def small(**changes: Any) -> Settings:
    """A run of 80 steps, two laps, with a sweep of three points."""
    settings = default_settings(
        sweep={"world": {"viewing_angle_deg": [60.0, 85.0]}, "filters": {"rho_low": [0.05]}},
        runs=3,
        tuning_runs=1,
        sweep_runs=2,
        bootstrap_draws=10,
        worlds=(*READINGS, "occlusion"),
    )
    world = settings.world | {"steps": 80, "period": 40, "mean_survival_steps": 40.0}
    return replace(settings, world=world, **changes)


@pytest.fixture(scope="module", params=list(SENSORS))
def runs(request: pytest.FixtureRequest) -> Stack:
    return simulate(small().world_of(NOMINAL, request.param), 3, seed=5)


# what is run


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("world", WORLDS)
def test_worlds_of_the_file_are_those_known_by_name(world: str, sensor: str) -> None:
    assert default_settings().world_of(world, sensor) == named_world(world, SENSORS[sensor])


def test_a_harsher_world_keeps_what_the_file_says_of_the_rest() -> None:
    world = small().world_of("false-alarms", "camera")
    assert (world.steps, world.p_false, world.field) == (80, 0.03, SENSORS["camera"])


def test_every_value_of_the_sweep_can_be_set_and_the_files_own_is_among_them() -> None:
    settings = default_settings()
    values: dict[tuple[str, str], list[float]] = {}
    for section, name, value in sweep_points(settings):
        varied = settings.varied(section, name, value)
        assert varied.value_of(section, name) == value
        varied.world_of(NOMINAL, "lidar")
        values.setdefault((section, name), []).append(value)
    for (section, name), given in values.items():
        assert settings.value_of(section, name) in given


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"worlds": ("mars",)}, "field 'world': there is no 'mars' .*nominal, uniform"),
        ({"chosen": ("jcf", "kalman")}, "field 'filters': there is no 'kalman' .*iff, jff"),
        ({"runs": 1}, "field 'runs': must be 2 at least"),
        ({"seed": -1}, "field 'seed'"),
    ],
)
def test_settings_that_cannot_be_run_are_one_line(change: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        default_settings(**change)


# many runs as one


def test_the_stack_is_its_runs_side_by_side(runs: Stack) -> None:
    clique = 0
    for number, run in enumerate(runs.runs):
        expected = run.expected()
        for c in range(len(run.first)):
            on_it = runs.clique == clique
            np.testing.assert_array_equal(runs.detected[:, on_it], run.detected[:, run.clique == c])
            seen = expected[:, run.clique == c].any(axis=1)
            seen[: run.first[c]] = False
            np.testing.assert_array_equal(runs.in_view[:, clique], seen)
            ages = runs.looks()[:, clique]
            np.testing.assert_array_equal(np.flatnonzero(seen) - run.first[c], ages[~np.isnan(ages)])
            away = run.landmark_m[run.clique == c] - run.pose_position_m[7]
            np.testing.assert_allclose(runs.range_m[7, on_it] ** 2, (away**2).sum(axis=1))
            assert runs.run[clique] == number
            clique += 1
    assert clique == runs.cliques


def test_worlds_share_their_trajectories_objects_and_lifetimes() -> None:
    settings = small()
    plain, harsh = (simulate(settings.world_of(name, "lidar"), 2, seed=3) for name in (NOMINAL, "angle60"))
    np.testing.assert_array_equal(plain.landmark_m, harsh.landmark_m)
    np.testing.assert_array_equal(plain.range_m, harsh.range_m)
    np.testing.assert_array_equal(plain.survival_steps, harsh.survival_steps)
    other = simulate(settings.world_of(NOMINAL, "lidar"), 2, seed=3, stream=TUNING)
    assert not np.isin(other.survival_steps, plain.survival_steps).any()


def test_tracked_landmarks_face_the_sensor_most_and_observable_ones_at_all(runs: Stack) -> None:
    world = runs.world
    tracked, observable = runs.tracked(), set(runs.observable().tolist())
    offset = 0
    for run in runs.runs:
        steps = np.zeros((len(run.position_m), len(run.landmark_m)), dtype=bool)
        for f, (position, rotation) in enumerate(zip(run.position_m, run.rotation, strict=True)):
            to_sensor = position - run.landmark_m
            angle = np.arccos((to_sensor * run.normal).sum(axis=1) / np.linalg.norm(to_sensor, axis=1))
            steps[f] = (angle <= world.viewing_angle_rad) & world.field.contains(-to_sensor @ rotation)
        for k in range(len(run.landmark_m)):
            assert (k + offset in observable) == steps[: world.period, k].any()
        for c in range(len(run.first)):
            chosen = tracked[np.flatnonzero(runs.run == run_number(runs, run))[c]] - offset
            assert run.clique[chosen] == c
            assert steps[:, chosen].sum() == steps[:, run.clique == c].sum(axis=0).max()
        offset += len(run.landmark_m)


def run_number(runs: Stack, run: Any) -> int:
    return next(number for number, one in enumerate(runs.runs) if one is run)


def test_detections_come_as_often_as_the_true_probability_says() -> None:
    world = replace(small().world_of(NOMINAL, "lidar"), mean_survival_steps=1e9)
    one = simulate(world, 3, seed=1)
    chance = one.p_detect()
    for low, high in ((0.0, 0.01), (0.2, 0.4), (0.4, 0.9)):
        mine = (chance > low) & (chance < high)
        spread = math.sqrt((chance[mine] * (1.0 - chance[mine])).sum())
        assert abs(one.detected[mine].sum() - chance[mine].sum()) < 4.0 * spread
    assert not one.detected[chance == 0.0].any()


def test_the_miss_rate_counts_expected_landmarks_of_what_is_there(runs: Stack) -> None:
    misses = looks = 0
    for run in runs.runs:
        expected = run.expected()
        for f in range(len(expected)):
            for k in np.flatnonzero(expected[f]):
                age = f - run.first[run.clique[k]]
                if 0 <= age <= run.survival_steps[run.clique[k]]:
                    looks += 1
                    misses += not run.detected[f, k]
    assert miss_rate(runs) == pytest.approx(misses / looks)


def test_the_other_reading_differs_in_its_lifetimes_alone() -> None:
    from scipy.stats import kstest

    settings = small()
    plain, uniform = (simulate(settings.world_of(name, "lidar"), 40, seed=3) for name in READINGS)
    np.testing.assert_array_equal(plain.range_m, uniform.range_m)
    assert kstest(uniform.survival_steps / 80.0, "uniform").pvalue > 0.01
    assert kstest(plain.survival_steps / 40.0, "expon").pvalue > 0.01
    assert settings.world_of(UNIFORM, "lidar") == replace(settings.world_of(NOMINAL, "lidar"), uniform_survival=True)


# the filters


@pytest.mark.parametrize("name", FILTERS)
def test_a_run_in_a_stack_is_the_run_alone(name: str, runs: Stack) -> None:
    assumed = default_settings().filters
    together, clique = beliefs(name, runs, assumed, P_MISS)
    assert np.all((together >= 0.0) & (together <= 1.0))
    for number in range(len(runs.runs)):
        alone, _ = beliefs(name, stack([runs.runs[number]]), assumed, P_MISS)
        np.testing.assert_allclose(together[:, runs.run[clique] == number], alone, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", ["jff-mixture", "jff-mixture" + SUPPRESSION])
def test_the_mixture_lies_between_the_two_that_it_mixes(name: str, runs: Stack) -> None:
    assumed = replace(default_settings().filters, pairwise_own=1.0)  # the landmarks alone
    tail = SUPPRESSION if name.endswith(SUPPRESSION) else ""
    mixed, clique = beliefs(name, runs, assumed, None)
    alone, _ = beliefs("jff" + tail, runs, assumed, None)
    joint = beliefs("jcf" + tail, runs, assumed, None)[0][:, clique]
    assert np.all(mixed >= np.minimum(alone, joint) - 1e-12)
    assert np.all(mixed <= np.maximum(alone, joint) + 1e-12)


def test_the_independent_filter_is_the_one_feature_filter_on_the_tracked_landmark(runs: Stack) -> None:
    assumed = default_settings().filters
    found, clique = beliefs("iff", runs, assumed, None)
    np.testing.assert_array_equal(clique, np.arange(runs.cliques))
    for c, landmark in enumerate(runs.tracked().tolist()):
        one = PersistenceFilter(Exponential(1.0 / 300.0))
        for step in range(len(found)):
            age = float(step - runs.first[c])
            if runs.in_view[step, c]:
                one.update(age, bool(runs.detected[step, landmark]), 0.5, 0.001)
            assert found[step, c] == pytest.approx(one.predict(age) if age >= 0.0 else 1.0, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", ["jcf", "jcf" + SUPPRESSION, "jcfr", "jcf-tuned", "jcf-tuned" + SUPPRESSION, "oracle"])
def test_clique_filters_are_plain_recursions(name: str, runs: Stack) -> None:
    """Rosen's recursion in odds, the thesis' rules written out; one clique after the other."""
    assumed = default_settings().filters
    found, _ = beliefs(name, runs, assumed, P_MISS)
    chance = runs.p_detect()
    for c in range(runs.cliques):
        mine = np.flatnonzero(runs.clique == c)
        p, last = 1.0, int(runs.first[c])
        for step in range(last, len(found)):
            stay = math.exp(-(step - last) / 300.0)
            expected = [k for k in mine if runs.expected[step, k]]
            if not expected:
                assert found[step, c] == pytest.approx(p * stay, rel=1e-9, abs=1e-12)
                continue
            nearest = runs.range_m[step, mine].min()
            if not name.startswith(("jcf-tuned", "oracle")):
                expected = list(mine)
            hits = sum(bool(runs.detected[step, k]) for k in expected)
            skip = name.endswith(SUPPRESSION) and 6.4 < nearest < 16.0 and hits / len(expected) < 0.1
            if not skip:
                p, last = p * stay, step
                there = gone = 1.0
                for k in expected:
                    miss, false = 0.5, 0.001
                    if name.startswith("jcfr"):
                        miss = min(max(1.0 - math.exp(-nearest / (1.4 * 6.4)), 0.4), 0.98)
                    elif name.startswith("jcf-tuned"):
                        miss, false = P_MISS, 0.005
                    elif name == "oracle":
                        miss, false = 1.0 - chance[step, k], 0.005
                    there *= 1.0 - miss if runs.detected[step, k] else miss
                    gone *= false if runs.detected[step, k] else 1.0 - false
                p = p * there / (p * there + (1.0 - p) * gone)
                stay = 1.0
            assert found[step, c] == pytest.approx(p * stay, rel=1e-8, abs=1e-12)


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


def test_the_all_knowing_filter_is_the_chain_of_free_hidden_and_gone() -> None:
    """The forward algorithm over three states, one clique and one step at a time."""
    settings = small()
    runs = simulate(settings.world_of("occlusion", "camera"), 2, seed=2)
    belief, clique = beliefs("oracle", runs, settings.filters, None)
    world, chance = runs.world, runs.p_detect()
    reveal = 1.0 / world.occluded_steps
    hide = reveal * world.occluded_share / (1.0 - world.occluded_share)
    stays = math.exp(-1.0 / settings.filters.prior_mean_steps)
    moves = np.array(
        [
            [stays * (1 - hide), stays * hide, 1 - stays],
            [stays * reveal, stays * (1 - reveal), 1 - stays],
            [0.0, 0.0, 1.0],
        ]
    )
    for c in clique:
        state = np.array([1.0 - world.occluded_share, world.occluded_share, 0.0])
        rows = np.flatnonzero(runs.clique == c)
        for step in range(runs.first[c], len(belief)):
            if step > runs.first[c]:
                state = state @ moves
            if runs.in_view[step, c]:
                p = chance[step, rows]
                p, hit = p[p > 0.0], runs.detected[step, rows][p > 0.0]
                absent = np.prod(np.where(hit, world.p_false, 1.0 - world.p_false))
                state = state * [np.prod(np.where(hit, p, 1.0 - p)), absent, absent]
                state /= state.sum()
            assert belief[step, c] == pytest.approx(1.0 - state[2], rel=1e-9, abs=1e-12)


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


def test_command_runs_what_it_is_asked_for(tmp_path: Path) -> None:
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
        (["--world", "mars"], "field 'world': there is no 'mars' (try: nominal, uniform-lifetimes, angle60,"),
        (["--filters", "jcf,kalman"], "field 'filters': there is no 'kalman' (try: iff, jff,"),
        (["--runs", "1"], "field 'runs': must be 2 at least"),
        (["--seed", "-1"], "field 'seed'"),
        (["--data", "here"], "field '--data': bateman2020 has no such option"),
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
