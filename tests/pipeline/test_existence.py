"""Beliefs of one recording are those of a map's first session."""

from __future__ import annotations

import numpy as np
import pytest
from judged import recording_of

from evermap.config import CalibrationConfig, Config, LivingConfig, SlamConfig
from evermap.pipeline import run_session, run_slam

STATIC = Config(slam=SlamConfig(method="nohyp", calibration=CalibrationConfig(fix={"range_slope": 0.0})))


def test_misses_of_a_recording_and_of_the_first_session_of_a_map_are_counted_by_one_rule():
    """Almost the same: landmarks that were seen once, which a map leaves out, say a little of lines of sight."""
    recording = recording_of(0)
    alone, first = run_slam(recording, STATIC), run_session(recording, None, STATIC).slam
    for result in (alone, first):
        counted = [int((result.misses.landmark_id == name).sum()) for name in result.landmarks.landmark_id]
        assert result.landmarks.n_misses.tolist() == counted
    row = np.searchsorted(alone.landmarks.landmark_id, first.landmarks.landmark_id)
    assert 0.5 < alone.landmarks.n_misses[row].sum() / first.landmarks.n_misses.sum() <= 1.0


def test_a_recording_believes_what_the_first_session_of_a_map_believes():
    recording = recording_of(0)
    alone = run_slam(recording, STATIC).landmarks
    first = run_session(recording, None, STATIC).living.landmarks(p_least=0.0)
    assert np.isin(first.landmark_id, alone.landmark_id).all()  # a map has no landmark that was seen once
    row = np.searchsorted(alone.landmark_id, first.landmark_id)
    np.testing.assert_allclose(alone.p_exists[row], first.p_exists, atol=1e-3)


def test_without_existence_every_landmark_is_certain():
    config = Config(living=LivingConfig(existence=False))
    assert run_slam(recording_of(0), config).landmarks.p_exists == pytest.approx(1.0)
