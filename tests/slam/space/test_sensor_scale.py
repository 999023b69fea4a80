"""One of several sensors in space that measures in another scale than the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap import run_slam
from evermap.explain.causes.sizes import has_scale
from evermap.explain.seeds import find_sensor_scales
from evermap.metrics.summary import compare_with_truth
from evermap.types import VerdictKind

from .test_range_noise import LAWS, field


def with_scale(recording, scale: float, turn_rad: float = 0.0):
    seen, own = recording.detections, recording.detections.sensor == 1
    at = seen.position_sensor_m.copy()
    at[own] = Rotation.from_euler("z", turn_rad).apply(scale * at[own]) + [turn_rad, 0.0, 0.0]
    return replace(recording, detections=replace(seen, position_sensor_m=at))


@pytest.mark.parametrize("laws", [("lidar", "lidar"), ("lidar", "stereo"), ("constant", "sizes")])
def test_distances_of_landmarks_tell_the_scale_whatever_the_mount(laws):
    given = field(12, *[LAWS[law] for law in laws], n_frames=150)
    asked = has_scale(given)
    assert asked.all()
    assert find_sensor_scales(with_scale(given, 1.0, 0.2), asked) == pytest.approx([0.0, 0.0])
    off = np.log(1.08)
    assert find_sensor_scales(with_scale(given, 1.08, 0.2), asked) == pytest.approx([off, -off], abs=0.01)
    assert not find_sensor_scales(with_scale(given, 1.08), np.array([True, False])).any()


def test_of_three_sensors_the_odd_one_is_off():
    given = field(11, *[LAWS["lidar"]] * 3, n_frames=150)
    found = find_sensor_scales(with_scale(given, 1.08), has_scale(given))
    assert found == pytest.approx([0.0, -np.log(1.08), 0.0], abs=0.01)


@pytest.mark.slow
def test_the_sensor_is_named_and_the_run_is_solved_under_it():
    given = field(11, LAWS["lidar"], LAWS["lidar"], n_frames=100)
    right, wrong = with_scale(given, 1.0), with_scale(given, 1.08)
    usual, result = run_slam(right), run_slam(wrong)
    assert usual.verdict is not None
    assert usual.verdict.kind is VerdictKind.SOUND
    assert not usual.causes
    assert [(one.code, one.subject) for one in result.causes] == [("sensor-scale", "sensor1")]
    assert result.causes[0].value == pytest.approx(1.0 / 1.08, abs=0.003)
    assert "1.08 times too long" in result.causes[0].message
    assert compare_with_truth(wrong, result).poses.rmse_m < 1.5 * compare_with_truth(right, usual).poses.rmse_m
