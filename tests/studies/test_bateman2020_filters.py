"""Bateman 2020 again: what is run, the stack against single runs, and filters against plain recursions."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.existence.one_stay import PersistenceFilter
from evermap.survival import Exponential
from evermap_studies.bateman2020.filters import beliefs
from evermap_studies.bateman2020.runs import TUNING, Stack, miss_rate, simulate, stack
from evermap_studies.bateman2020.scores import sweep_points
from evermap_studies.bateman2020.settings import (
    FILTERS,
    NOMINAL,
    READINGS,
    SENSORS,
    SUPPRESSION,
    UNIFORM,
    WORLDS,
    default_settings,
)
from evermap_studies.worlds.cliques import named_world
from evermap_studies.worlds.sensors import contains

from .bateman2020_small import P_MISS, small


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
            steps[f] = (angle <= world.viewing_angle_rad) & contains(world.field, -to_sensor @ rotation)
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
