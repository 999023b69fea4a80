"""Ranges and bearings of posts beside wheel odometry, in a given exact map: neither is taken for exact."""

from __future__ import annotations

import pytest

from evermap.pipeline import run_slam

from .yards import layout, position_error_m, yard


@pytest.mark.parametrize("noise", [0.03, 0.1, 0.3])
def test_an_odometry_of_another_scale_does_not_make_readings_noise(noise: float) -> None:
    recording = yard(0, noise=noise, scale=1.02)
    found = run_slam(recording, prior_map=layout(recording, 0.01))
    assert found.trajectory.frame == "prior_map"
    assert position_error_m(recording, found.trajectory) < {0.03: 0.02, 0.1: 0.03, 0.3: 0.06}[noise]
    assert not found.changes
