"""Nothing is suspected of a camera that is as stated, where steps are uncertain by as much as they are long."""

from __future__ import annotations

import math

import numpy as np
import pytest

from evermap.config import Config
from evermap.explain.causes.suspect import Inputs
from evermap.explain.scores import score_session
from evermap.maps.sessions import solve
from evermap.pipeline import run_slam
from evermap.slam.check import CLOCKWISE, read_corners
from evermap.types import VerdictKind

from .corridors import tagged_corridor


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("seed", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_a_coarse_odometry_makes_no_sensor_suspect(seed: int, mapped: bool) -> None:
    """By steps as they were measured, tags 20 % smaller would gain 70 nats, and mounts 12."""
    world = tagged_corridor(seed, n_tags=16, n_frames=300, drift=0.02)
    # the corridor's tags face their walls; alone, that would be a mistake in the order of their corners
    recording = world.recording if mapped else read_corners(world.recording, CLOCKWISE)
    verdict = run_slam(recording, prior_map=world.tags.as_prior(0.01) if mapped else None).verdict
    assert verdict is not None
    assert verdict.kind is VerdictKind.SOUND
    (held,) = [symptom for symptom in verdict.symptoms if symptom.code == "held"]
    assert held.value == 0.0


def test_scores_of_lengths_are_zero_in_the_mean() -> None:
    """Noise of the odometry makes a drive longer, and shows in its steps and in what is left of them alike."""
    config = Config.model_validate({"slam": {"explain": {"on": False}}})
    found: dict[str, list[float]] = {}
    seeds = range(6)
    for seed in seeds:
        world = tagged_corridor(seed, n_tags=16, n_frames=200, drift=0.03)
        solution = solve.explain_session(Inputs.of(world.recording, None), config, ()).best.solution
        result, asked = solution.result, solution.asked
        for one in score_session(asked, result.trajectory).calibrations:
            score = math.copysign(math.sqrt(2.0 * one.gain), one.value)
            found.setdefault(f"{one.suspect.code} {one.suspect.subject}", []).append(score)
    for name in ("tag-size all tags", "mount left x", "mount left yaw", "clock-drift clocks"):
        assert abs(np.mean(found[name])) < 3.5 / math.sqrt(len(seeds)), (name, found[name])
