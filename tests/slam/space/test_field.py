"""Tags as poses beside wheel odometry, in an exact map: neither is taken for exact, whatever the other is worth."""

from __future__ import annotations

import pytest

from evermap.pipeline import run_slam

from .fields import field, position_error_m

BOUND_M = {0.03: 0.02, 0.1: 0.03, 0.3: 0.06}
"""Most that positions may be off by the noise of the odometry [m]."""
SEEDS = [(0, 1.01), (1, 1.02), (2, 1.03)]
MORE = [(seed, (1.01, 1.02, 1.03)[seed % 3]) for seed in range(3, 10)]


@pytest.mark.parametrize("noise", [0.03, pytest.param(0.1, marks=pytest.mark.slow), 0.3])
@pytest.mark.parametrize(
    ("seed", "scale"), [SEEDS[0], *(pytest.param(*one, marks=pytest.mark.slow) for one in [*SEEDS[1:], *MORE])]
)
def test_an_odometry_of_another_scale_does_not_make_detections_noise(seed: int, scale: float, noise: float) -> None:
    recording, layout = field(seed, noise=noise, scale=scale)
    found = run_slam(recording, prior_map=layout.as_prior(0.01))
    assert found.trajectory.frame == "prior_map"
    assert position_error_m(recording, found.trajectory.pose_world_robot) < BOUND_M[noise]
    assert not found.changes
