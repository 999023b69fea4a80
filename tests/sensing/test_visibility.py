"""What should have been seen: against geometry in plain trigonometry, and misses counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from evermap.sensing.visibility import (
    BEARING_MARGIN_RAD,
    RANGE_MARGIN_M,
    WORTH_A_LOOK,
    NominalField,
    find_misses,
)
from evermap.types import UNKNOWN, Detections, Landmarks, Sensor

CAMERA = Sensor(
    range_min_m=0.5,
    range_max_m=5.0,
    bearing_min_rad=-0.4,
    bearing_max_rad=0.9,
    p_detect=0.8,
    mount_robot_sensor=(0.3, -0.1, 0.5),
)


def seen_from(pose, point, mount):
    """Range and bearing, one landmark and one pose at a time."""
    x, y, theta = pose
    sensor_x = x + math.cos(theta) * mount[0] - math.sin(theta) * mount[1]
    sensor_y = y + math.sin(theta) * mount[0] + math.cos(theta) * mount[1]
    bearing = math.atan2(point[1] - sensor_y, point[0] - sensor_x) - theta - mount[2]
    return math.dist(point, (sensor_x, sensor_y)), math.remainder(bearing, 2 * math.pi)


def test_probability_is_brute_force_geometry():
    rng = np.random.default_rng(0)
    pose = np.column_stack([rng.uniform(-5, 5, (40, 2)), rng.uniform(-20, 20, 40)])
    position = rng.uniform(-6, 6, (30, 2))
    found = NominalField(CAMERA).p_detect(pose, position)
    assert found.shape == (40, 30)
    clear = 0
    for i in range(40):
        for j in range(30):
            r, b = seen_from(pose[i], position[j], CAMERA.mount_robot_sensor)
            expected = CAMERA.p_detect
            for value, low, high, margin in ((r, 0.5, 5.0, RANGE_MARGIN_M), (b, -0.4, 0.9, BEARING_MARGIN_RAD)):
                expected *= stats.norm.cdf((value - low) / margin) * stats.norm.cdf((high - value) / margin)
            assert found[i, j] == pytest.approx(expected, abs=1e-12)
            inside = 0.5 + 0.8 < r < 5.0 - 0.8 and -0.4 + 0.2 < b < 0.9 - 0.2
            outside = r > 5.0 + 0.8 or b < -0.4 - 0.2 or b > 0.9 + 0.2
            if inside or outside:
                clear += 1
                assert found[i, j] == pytest.approx(CAMERA.p_detect if inside else 0.0, abs=1e-3)
    assert clear > 600


def test_edge_of_the_range_halves_the_probability():
    wide = Sensor(range_max_m=4.0, p_detect=0.9)
    found = NominalField(wide).p_detect(np.zeros((1, 3)), np.array([[4.0, 0.0], [0.0, -4.0], [1.0, 1.0]]))
    assert found[0] == pytest.approx([0.45, 0.45, 0.9])


def test_all_round_sensor_has_no_edge_behind():
    found = NominalField(Sensor()).p_detect(np.zeros((1, 3)), np.array([[-2.0, 1e-9], [-2.0, -1e-9], [0.0, 2.0]]))
    assert found[0] == pytest.approx(0.9)


def detections(rows):
    """From (frame, landmark id)."""
    frame, identity = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    count = len(frame)
    return Detections(
        frame=frame,
        landmark_id=identity,
        range_m=np.ones(count),
        bearing_rad=np.zeros(count),
        class_id=np.full(count, UNKNOWN),
        sigma_range_m=np.full(count, np.nan),
        sigma_bearing_rad=np.full(count, np.nan),
        source_line=np.zeros(count, dtype=np.int64),
    )


def tiny_scene():
    """A robot on the x axis that looks ahead; landmarks 10 and 20 before it, 30 behind, 40 far away."""
    landmarks = Landmarks.at([10, 20, 30, 40], [[3.0, 0.0], [4.0, 0.5], [-3.0, 0.0], [50.0, 0.0]])
    landmarks.first_seen_s[:] = [100.0, 102.0, 100.0, 100.0]
    sensor = Sensor(range_max_m=8.0, bearing_min_rad=-1.0, bearing_max_rad=1.0, p_detect=0.7)
    stamps = 100.0 + np.arange(5.0)
    pose = np.column_stack([0.1 * np.arange(5), np.zeros(5), np.zeros(5)])
    pose[4, 2] = np.pi  # at last it turns around
    return landmarks, sensor, stamps, pose


def as_pairs(misses):
    return list(zip(misses.frame.tolist(), misses.landmark_id.tolist(), strict=True))


def test_misses_of_a_tiny_scene_are_those_counted_by_hand():
    landmarks, sensor, stamps, pose = tiny_scene()
    seen = detections([(0, 10), (2, 10), (2, 20), (2, 99), (3, UNKNOWN)])
    misses = find_misses(np.arange(5), pose, seen, landmarks, stamps, sensor)
    # frame 0: 10 seen, others not met yet or not in view; 1: 10 missed; 2: all seen; 3: both missed; 4: 30 missed
    assert as_pairs(misses) == [(1, 10), (3, 10), (3, 20), (4, 30)]
    assert misses.p_detect == pytest.approx(0.7, abs=1e-6)


def test_only_frames_with_a_pose_count():
    landmarks, sensor, stamps, pose = tiny_scene()
    seen = detections([(0, 10), (2, 10)])
    misses = find_misses(np.array([1, 2]), pose[1:3], seen, landmarks, stamps, sensor)
    assert as_pairs(misses) == [(1, 10)]


def test_at_the_edge_of_the_view_nothing_is_missed():
    landmarks, sensor, stamps, _ = tiny_scene()
    # 0.3 of the best is half a standard deviation of the edge beyond the limit: 0.105 m
    for x, expected in ((3.0 - 8.0 - 0.12, []), (3.0 - 8.0 - 0.09, [(1, 10)])):
        pose = np.array([[x, 0.0, 0.0]])
        misses = find_misses(np.array([1]), pose, detections([]), landmarks, stamps, sensor)
        assert [pair for pair in as_pairs(misses) if pair[1] == 10] == expected
        assert np.all(misses.p_detect >= WORTH_A_LOOK * sensor.p_detect)


def test_no_frames_no_misses():
    landmarks, sensor, stamps, _ = tiny_scene()
    misses = find_misses(np.array([], dtype=np.int64), np.empty((0, 3)), detections([]), landmarks, stamps, sensor)
    assert len(misses) == 0
