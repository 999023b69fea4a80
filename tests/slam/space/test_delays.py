"""Odometry led back by delays of stamps, and its derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.geometry import se3
from evermap.slam.space.problem import OdometryPath

STEP = 1e-6


def a_path(seed: int, jitter: float = 0.0) -> OdometryPath:
    random = np.random.default_rng(seed)
    twist = np.array([0.8, 0.1, 0.0, 0.05, -0.1, 0.4]) + random.normal(0.0, 0.1, 6)
    pose = se3.identity(400)
    for row in range(1, len(pose)):
        pose[row] = se3.retract(pose[row - 1], 0.02 * twist + random.normal(0.0, jitter, 6))
    return OdometryPath(0.02 * np.arange(len(pose)), pose)


@pytest.mark.parametrize(("delay_s", "whole_s"), [(0.0, 0.0), (0.13, 0.12), (-0.3, -0.3), (0.1, 0.0)])
def test_a_robot_at_constant_velocity_was_where_that_led_it(delay_s, whole_s):
    path, stamp_s = a_path(1), np.linspace(1.0, 7.0, 20)
    back, by_delay = path.earlier(stamp_s, delay_s, whole_s, 0.1)
    there = se3.interpolate(path.stamp_s, path.pose, stamp_s - delay_s)
    assert se3.retract(path.at(stamp_s), back) == pytest.approx(there, abs=1e-9)
    assert by_delay == pytest.approx(np.tile(by_delay[:1], (20, 1)), abs=1e-9)


def test_the_derivative_by_a_delay_is_that_of_differences():
    path, stamp_s = a_path(2, jitter=0.003), np.linspace(1.0, 7.0, 20)
    _, by_delay = path.earlier(stamp_s, 0.113, 0.12, 0.06)
    less, more = (
        se3.retract(path.at(stamp_s), path.earlier(stamp_s, 0.113 + by, 0.12, 0.06)[0]) for by in (-STEP, STEP)
    )
    assert se3.local(less, more) / (2.0 * STEP) == pytest.approx(by_delay, abs=1e-6)


def test_jitter_is_what_was_added_at_random():
    assert a_path(3, jitter=0.003).jitter == pytest.approx(np.full(6, 0.003**2 / 0.02), rel=0.3)
    assert a_path(3).jitter == pytest.approx(np.zeros(6), abs=1e-20)
