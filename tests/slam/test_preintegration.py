"""Intervals are integrated once and never served for others than were asked for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from problems import default_prior, integrated, wandering_drive

from evermap.slam import preintegration

STATES = default_prior().mean
STAMPS = np.array([0.21, 0.5, 0.97, 1.0, 2.3, 3.1])


def is_that_of(intervals, drive, stamps, states):
    for i, (start, stop) in enumerate(pairwise(stamps)):
        alone = integrated(drive, start, stop, states)
        assert np.array_equal(intervals.increment[i], alone.increment)
        assert np.array_equal(intervals.by_states[i], alone.jacobian)
        assert np.array_equal(intervals.noise[i], alone.noise)
        assert np.array_equal(intervals.floor[i], alone.floor)
    assert len(intervals.increment) == len(stamps) - 1


@pytest.fixture
def counted(monkeypatch):
    """How often anything was integrated."""
    calls = []
    integrate = preintegration._integrate
    monkeypatch.setattr(preintegration, "_integrate", lambda *a: calls.append(0) or integrate(*a))
    return calls


def test_the_same_poses_and_parts_of_them_are_integrated_once(counted):
    drive = wandering_drive(np.random.default_rng(0), 4.0)
    detection_states = STATES.copy()
    detection_states[:7] += 0.1  # no matter of the odometry
    is_that_of(drive.between(STAMPS, STATES), drive, STAMPS, STATES)
    is_that_of(drive.between(STAMPS, detection_states), drive, STAMPS, STATES)
    for part in (STAMPS[:4], STAMPS[2:], STAMPS[1:3], STAMPS[3:4]):
        is_that_of(drive.between(part, STATES), drive, part, STATES)
    assert len(counted) == 1


@pytest.mark.parametrize("state", [5, 6, 7, 8])
def test_any_other_calibration_is_integrated_anew(state):
    drive = wandering_drive(np.random.default_rng(0), 4.0)
    drive.between(STAMPS, STATES)
    moved = STATES.copy()
    moved[state] += 1e-9
    is_that_of(drive.between(STAMPS, moved), drive, STAMPS, moved)


def test_other_poses_are_integrated_anew():
    drive = wandering_drive(np.random.default_rng(0), 4.0)
    drive.between(STAMPS[:4], STATES)
    later = STAMPS.copy()
    later[3] += 1e-6
    for others in (STAMPS, STAMPS[2:], later, STAMPS[[0, 2, 3]], STAMPS - 1e-3, STAMPS[:2]):
        is_that_of(drive.between(others, STATES), drive, others, STATES)


def test_states_changed_in_place_are_noticed():
    drive = wandering_drive(np.random.default_rng(0), 4.0)
    states = STATES.copy()
    drive.between(STAMPS, states)
    states[8] *= 1.1
    is_that_of(drive.between(STAMPS, states), drive, STAMPS, states)
