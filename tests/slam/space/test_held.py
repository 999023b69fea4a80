"""Nothing is suspected of a camera that is as stated, where poses are uncertain beside the steps between them."""

from __future__ import annotations

import pytest

from evermap.pipeline import run_slam
from evermap.types import VerdictKind

from .corridors import tagged_corridor


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("seed", [1, 4])
def test_a_coarse_odometry_makes_no_sensor_suspect(seed: int, mapped: bool) -> None:
    """Shorter lengths would fit the best such poses better (tags 20 % smaller: 70 nats), and so would mounts (12)."""
    world = tagged_corridor(seed, n_tags=16, n_frames=300, drift=0.02)
    verdict = run_slam(world.recording, prior_map=world.tags.as_prior(0.01) if mapped else None).verdict
    assert verdict is not None
    assert verdict.kind is VerdictKind.SOUND
    (held,) = [symptom for symptom in verdict.symptoms if symptom.code == "held"]
    assert held.value == 0.0
