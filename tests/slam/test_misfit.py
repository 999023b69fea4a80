"""Errors that no calibration state holds: how far they move the states, and what then is learned of a sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from problems import default_prior, make_world

from evermap.config import Config
from evermap.metrics.summary import compare_with_truth
from evermap.pipeline import run_slam
from evermap.slam.misfit import CURVED, build_curves, variance_by_curves
from evermap.slam.smoother import Smoother
from evermap.types import Recording, SensorKind, SlamResult
from evermap_studies.worlds.lasers import LaserWorld, simulate_laser

PLAIN = Config.model_validate({"slam": {"sensor_model": "plain"}})


def errors(recording: Recording, result: SlamResult) -> np.ndarray:
    found = compare_with_truth(recording, result)
    assert found.poses is not None
    assert found.landmarks is not None
    return np.array([found.poses.rmse_m, found.landmarks.rmse_m])


def test_curves_have_no_mean_and_no_slope_by_range():
    reading = np.column_stack([np.linspace(1.0, 9.0, 4001), np.linspace(-1.0, 2.0, 4001)])
    curves = build_curves(reading, np.ones(4001, dtype=np.bool_))
    by_range = curves.value[:, curves.argument == 0]
    assert by_range.shape[1] == 4
    assert np.abs(by_range.T @ np.column_stack([np.ones(4001), reading[:, 0] / 9.0])).max() / 4001 < 0.02
    # the straight line from -1 at the near end to 1 at the far end
    assert curves.straight[0] + curves.straight[1] * np.array([1.02, 8.98]) == pytest.approx([-1.0, 1.0], abs=0.01)
    assert curves.value[:, curves.argument == 1].shape[1] == 4


def test_ranges_without_bearings_have_curves_by_range_alone():
    reading = np.column_stack([np.linspace(1.0, 9.0, 50), np.zeros(50)])
    assert np.all(build_curves(reading, np.ones(50, dtype=np.bool_)).argument == 0)
    assert build_curves(reading, np.zeros(50, dtype=np.bool_)).value.shape == (50, 0)


def test_information_of_curves_is_that_of_the_states_they_equal():
    world = make_world(43, n_poses=60, prior=default_prior(range_slope=0.0))
    smoother = Smoother(world.problem, world.noise, robust=False)
    found = smoother.optimum(world.near_truth(np.random.default_rng(0)), tolerance=1e-9)
    constant = np.ones((len(world.problem.reading), 1))
    information, right = smoother.information_of_curves(found, constant)
    assert information[-1, :-1] == pytest.approx(information[0, :-1])
    assert information[-1, -1] == pytest.approx(information[0, 0])
    assert right[-1] == pytest.approx(right[0])
    free = np.flatnonzero(world.problem.prior.free)
    posterior = information[:-1, :-1] + np.diag(1.0 / smoother.states_sigma**2)
    states = smoother.marginals(found).states[np.ix_(free, free)]
    assert np.linalg.inv(posterior[np.ix_(free, free)]) == pytest.approx(states, rel=1e-6, abs=1e-12)


def test_mean_square_of_what_curves_moved_an_offset_by():
    """Ranges whose distance is known: offsets that were estimated beside a curve are as far off as is said."""
    rng = np.random.default_rng(0)
    range_m, sigma_m = rng.uniform(0.0, 10.0, 2000), 0.02
    reading = np.column_stack([range_m, np.zeros(2000)])
    curves = build_curves(reading, np.ones(2000, dtype=np.bool_))
    design = np.column_stack([np.ones(2000), range_m, curves.value]) / sigma_m
    prior, square, said = np.array([0.1, 0.05]) ** -2.0, 0.0, 0.0
    for _ in range(60):
        bend = 0.02 * rng.normal(size=4) / curves.degree**2
        line = 0.02 * rng.normal() * (curves.straight[0] + curves.straight[1] * range_m)
        residual = (line + curves.value @ bend) / sigma_m + rng.normal(size=2000)
        information = design.T @ design
        off = np.linalg.solve(information[:2, :2] + np.diag(prior), design[:, :2].T @ residual)
        right = design.T @ (residual - design[:, :2] @ off)
        said += variance_by_curves(information, right, prior, off, 1.0, curves)[0]
        square += off[0] ** 2
    assert 0.5 < said / square < 2.0


def test_independent_residuals_show_no_curves():
    rng = np.random.default_rng(1)
    reading = np.column_stack([rng.uniform(0.0, 10.0, 2000), rng.uniform(-2.0, 2.0, 2000)])
    curves = build_curves(reading, np.ones(2000, dtype=np.bool_))
    design = np.column_stack([np.ones(2000), reading[:, 0], curves.value]) / 0.02
    found = [
        variance_by_curves(design.T @ design, design.T @ rng.normal(size=2000), np.ones(2), np.zeros(2), 1.0, curves)[0]
        for _ in range(40)
    ]
    assert np.mean(np.array(found) > 0.0) < np.exp(-CURVED) + 0.1


@pytest.mark.parametrize("kind", [pytest.param(None, marks=pytest.mark.slow), SensorKind.LASER])
def test_a_range_that_bends_is_taken_for_no_offset(kind):
    """An offset of -12 mm +- 1 is found if the law of ranges is taken for exact, and everything is off by 1.7 times.

    Where the sensor sits is stated: not to know it costs more than the bend.
    """
    recording = simulate_laser(LaserWorld(incidence_m=0.03), 0)
    recording = replace(recording, sensor=replace(recording.sensor, kind=kind, sigma_position_m=0.0))
    result = run_slam(recording, Config())
    assert np.all(errors(recording, result) < 1.1 * errors(recording, run_slam(recording, PLAIN)))
    found = {one.name: one for one in result.parameters}["range_bias_m"]
    assert abs(found.value) < 0.003


def test_poles_that_are_thick_are_an_offset_with_an_honest_sigma():
    """The near side is measured. Each pole is as thick as it is all the time: 25 poles are 25 errors."""
    recording = simulate_laser(LaserWorld(radius_m=0.06, radius_spread_m=0.03), 0)
    result = run_slam(recording, Config())
    assert np.all(errors(recording, result) < 0.6 * errors(recording, run_slam(recording, PLAIN)))
    found = {one.name: one for one in result.parameters}["range_bias_m"]
    assert found.value < -0.03
    assert abs(found.value + 0.06) < 2.5 * found.sigma
