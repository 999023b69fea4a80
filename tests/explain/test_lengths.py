"""Odometry and ranges that differ on lengths: told which where a map says so; else the metre is that of the ranges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap import run_slam
from evermap.metrics.trajectory import evaluate_trajectory
from evermap.types import ChangeKind, Landmarks, Recording, SlamResult

from .worlds import World

LONG = 0.85
"""True over reported speeds: beyond what is sound, within four standard deviations of wheels."""


def error_m(result: SlamResult, recording: Recording) -> float:
    assert recording.truth is not None
    found = evaluate_trajectory(result.trajectory, recording.truth)
    assert found is not None
    return float(found.rmse_m)


@pytest.mark.parametrize("wheels", [LONG, 1.0 / LONG])
def test_a_map_says_that_it_is_the_odometry(wheels: float) -> None:
    world = World(seed=6, wheels=wheels)
    result = run_slam(world.plane(), prior_map=world.map_in_plane())
    (cause,) = result.causes
    assert (cause.code, cause.subject) == ("odometry-scale", "odometry")
    assert cause.value == pytest.approx(wheels, abs=0.01)
    assert result.verdict is not None
    assert result.verdict.message.startswith(cause.message)


@pytest.mark.parametrize("wheels", [pytest.param(LONG, marks=pytest.mark.slow), 1.0 / LONG, 0.7])
def test_without_a_map_lengths_are_those_of_the_ranges(wheels: float) -> None:
    """That ranges are off explains as much, and would stretch everything."""
    recording = World(seed=6, wheels=wheels).plane()
    result = run_slam(recording)
    assert error_m(result, recording) < 1.5 * error_m(run_slam(World(seed=6).plane()), World(seed=6).plane())
    assert "range-scale" not in {cause.code for cause in result.causes}
    assert result.verdict is not None
    assert result.verdict.kind in ("weak", "sensor suspect")


def test_a_data_sheet_says_that_it_is_the_ranges() -> None:
    """A wheel that is known to a per cent, and ranges of which nothing is."""
    recording = World(seed=6, seconds=40.0, longer=1.17).plane()
    sensor = replace(recording.sensor, sigma_odometer_scale=0.01)
    result = run_slam(replace(recording, sensor=sensor))
    assert {cause.code for cause in result.causes} == {"range-scale"}
    assert error_m(result, recording) < 0.1


@pytest.mark.parametrize("gone", [(), (5, 11)])
def test_what_is_in_a_map_and_nowhere_is_told_as_vanished(gone: tuple[int, ...]) -> None:
    """Only what is seen between others, from several sides, and missed."""
    world = World(seed=8, seconds=60.0)
    recording, survey = world.plane(), world.map_in_plane()
    there = ~np.isin(recording.detections.landmark_id, gone)
    result = run_slam(replace(recording, detections=recording.detections[there]), prior_map=survey)
    told = [change for change in result.changes if change.kind is ChangeKind.VANISHED]
    assert {one.landmark_ids[0] for one in told} == set(result.gone.landmark_id.tolist())
    assert {one.landmark_ids[0] for one in told} <= set(gone)
    assert all(one.n_misses > 0 and one.n_hits == 0 for one in told)
    assert all(0.5 < one.probability < 0.95 for one in told)
    assert bool(told) == bool(gone)


def test_where_much_of_a_map_was_not_seen_it_is_not_all_gone() -> None:
    """As of rooms that were not entered."""
    world = World(seed=8, seconds=60.0)
    recording = world.plane()
    there = recording.detections.landmark_id >= 8
    result = run_slam(replace(recording, detections=recording.detections[there]), prior_map=world.map_in_plane())
    assert not result.gone.landmark_id.size
    assert ChangeKind.VANISHED not in {change.kind for change in result.changes}


def test_what_is_missed_from_few_positions_says_nothing() -> None:
    """A landmark that comes into view at one place of the drive may be hidden from there."""
    world = World(seed=8, seconds=60.0)
    recording, survey = world.plane(), world.map_in_plane()
    far = Landmarks.at([99], [[14.6, 4.0]])  # beyond a wall, in nominal view from the end of the field
    result = run_slam(recording, prior_map=survey.joined(far))
    assert not result.gone.landmark_id.size
