"""When a group moved, against made-up sightings whose instant of change is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import QUIET, World, make_world, slow_detection
from scipy.stats import binom

from evermap.geometry import se2
from evermap.slam.changes.explain import parting_time
from evermap.slam.problem import Problem

MEMBERS = np.array([1, 3])
WHOLE = (0.0, 100.0)
"""Nothing is known beforehand."""


def sightings(world: World, at_s: float, by: np.ndarray, rng: np.random.Generator | None) -> Problem:
    """The world's detections, of members at their new places from `at_s` on; with noise if there is an `rng`."""
    problem, truth = world.problem, world.truth
    place = truth.landmark[problem.landmark_row]
    gone = np.isin(problem.landmark_row, MEMBERS) & (problem.stamp_s[problem.pose_row] >= at_s)
    place[gone] += by
    reading = slow_detection(truth.pose[problem.pose_row], place, truth.states, problem.mount)
    if rng is not None:
        reading += QUIET.detection * rng.normal(size=reading.shape)
    reading[:, 1] = se2.wrap(reading[:, 1])
    return replace(problem, reading=reading)


def timed(world: World, problem: Problem, by: np.ndarray) -> tuple[float, tuple[float, float]]:
    old = world.truth.landmark[MEMBERS]
    return parting_time(problem, world.truth, QUIET, MEMBERS, old, old + by, WHOLE, 0.95)


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 4))])
def test_exact_without_noise(seed: int) -> None:
    world = make_world(seed, n_poses=60, n_landmarks=5, noisy=0.0, p_seen=0.5, turn_radps=0.4, reach=0.4)
    at_s, by = 20.0 + 3.7 * seed, np.array([0.8, -0.6])
    problem = sightings(world, at_s, by, None)
    stamps = problem.stamp_s[problem.pose_row[np.isin(problem.landmark_row, MEMBERS)]]
    since_s, between_s = timed(world, problem, by)
    assert since_s == stamps[stamps >= at_s].min()
    assert between_s == (stamps[stamps < at_s].max(), since_s)


@pytest.mark.parametrize("distance_m", [0.15, 0.5])
def test_interval_holds_the_instant_in_95_percent(distance_m: float) -> None:
    """Of many instants and noises; a short way takes several sightings to see, so that intervals are wide."""
    world = make_world(7, n_poses=60, n_landmarks=5, noisy=0.0, p_seen=0.5, turn_radps=0.4, reach=0.4)
    stamps = world.problem.stamp_s[world.problem.pose_row[np.isin(world.problem.landmark_row, MEMBERS)]]
    rng = np.random.default_rng(0)
    inside, trials, widths = 0, 400, []
    for _ in range(trials):
        at_s = rng.uniform(stamps[0], stamps[-1])
        direction = rng.normal(size=2)
        by = distance_m * direction / np.linalg.norm(direction)
        since_s, (low, high) = timed(world, sightings(world, at_s, by, rng), by)
        assert low <= since_s <= high
        inside += low <= at_s <= high
        widths.append(high - low)
    # stamps are coarse, so the interval holds at least 95 %; where it is much wider than their distance, not much more
    assert inside >= binom.ppf(0.001, trials, 0.95)
    if np.median(widths) > 8.0 * np.diff(stamps).mean():
        assert inside <= binom.ppf(0.999, trials, 0.98)
