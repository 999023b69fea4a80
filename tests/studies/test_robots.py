"""Robots of many makes: the recordings are what is said of them, and the study's tables hold what was measured."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evermap.errors import ConfigError
from evermap.geometry import se2
from evermap_studies.robots import study
from evermap_studies.worlds.robots import ODOMETRY_HZ, draw_robot, simulate_robot


def test_readings_follow_the_law_of_the_robots_states() -> None:
    drawn = replace(
        draw_robot(7), sigma_range_m=1e-9, sigma_range_share=0.0, sigma_bearing_rad=1e-9, p_wrong=0.0, askew_rad=0.03
    )
    recording = simulate_robot(drawn, 7)
    truth, seen, frames = recording.truth, recording.detections, recording.frames.stamp_s
    assert truth is not None
    assert recording.true_landmarks is not None
    at = np.column_stack([np.interp(frames, truth.stamp_s, column) for column in truth.pose_world_robot.T])
    place = recording.true_landmarks.position_m[seen.landmark_id - 1]
    local = se2.transform(se2.inverse(at[seen.frame]), place) - drawn.states[5:7]
    r, b = np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])
    a0, a1, a2, a3, b0 = drawn.states[:5]
    assert seen.range_m == pytest.approx(a0 + r * (1 + a1 + a2 * b + a3 * b**2), abs=2e-3)
    assert np.abs(se2.wrap(seen.bearing_rad - b - b0)).max() < 5e-3


def test_odometry_reports_the_motion_by_the_robots_states() -> None:
    drawn = replace(draw_robot(8), sigma_forward=0.0, sigma_sideways=0.0, sigma_turn=0.0, askew_rad=0.0)
    recording = simulate_robot(drawn, 8)
    assert recording.truth is not None
    pose, odometry = recording.truth.pose_world_robot, recording.odometry
    step = se2.between(pose[:-1], pose[1:])
    assert recording.truth.stamp_s == pytest.approx(odometry.stamp_s - drawn.states[7])
    turn = step[:, 2] * ODOMETRY_HZ
    assert odometry.angular_radps[:-1] * drawn.states[9] == pytest.approx(turn, abs=0.025)
    forward = odometry.forward_mps[:-1] * drawn.states[8] - drawn.states[10] * np.abs(turn)
    # the floor of the noise, 2 mm and 1 mrad a root of a second, stays
    assert np.abs(forward - step[:, 0] * ODOMETRY_HZ).max() < 0.06
    assert np.abs(forward - step[:, 0] * ODOMETRY_HZ).mean() < 0.015


def test_same_seed_same_recording() -> None:
    first, again = (simulate_robot(draw_robot(3), 3) for _ in range(2))
    assert np.array_equal(first.detections.range_m, again.detections.range_m)


@pytest.mark.slow
def test_study_writes_what_it_measured(tmp_path: Path) -> None:
    content = study.reproduce(tmp_path / "out", study.Settings(robots=2, seed=19))
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["robots"] == content["robots"]
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| range_bias_m |" in table
    assert "calibrated over plain" in table
    assert (tmp_path / "out" / "errors.png").stat().st_size > 1000
    with pytest.raises(ConfigError, match="robots"):
        study.Settings(robots=1)
