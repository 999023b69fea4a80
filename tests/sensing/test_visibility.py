"""What should have been seen: against geometry in plain trigonometry, and misses counted by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from evermap.sensing import visibility
from evermap.sensing.visibility import (
    USUAL,
    NominalField,
)
from evermap.types import Sensor

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
            for value, low, high, margin in (
                (r, 0.5, 5.0, USUAL.range_margin_m),
                (b, -0.4, 0.9, USUAL.bearing_margin_rad),
            ):
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


def tiny_scene():
    """A robot on the x axis that looks ahead; landmarks 0 and 1 before it, 2 behind, 3 far away."""
    position = np.array([[3.0, 0.0], [4.0, 0.5], [-3.0, 0.0], [50.0, 0.0]])
    sensor = Sensor(range_max_m=8.0, bearing_min_rad=-1.0, bearing_max_rad=1.0, p_detect=0.7)
    pose = np.column_stack([0.1 * np.arange(5), np.zeros(5), np.zeros(5)])
    pose[4, 2] = np.pi  # at last it turns around
    return sensor, pose, position


def looked_at(sensor, pose, position, seen):
    """Hits and misses as pairs, of detections (frame, landmark)."""
    looks = NominalField(sensor).looks(pose, position, tuple(np.array(seen, dtype=np.int64).reshape(-1, 2).T))
    pairs = list(zip(looks.pose.tolist(), looks.landmark.tolist(), strict=True))
    hits, misses = ([pair for pair, hit in zip(pairs, looks.hit, strict=True) if hit == kind] for kind in (True, False))
    return hits, misses, looks


def test_looks_of_a_tiny_scene_are_those_counted_by_hand():
    seen = [(0, 0), (2, 1), (2, 0), (3, 3)]
    hits, misses, looks = looked_at(*tiny_scene(), seen)
    assert hits == [(0, 0), (2, 0), (2, 1), (3, 3)]  # the last one is far out of view
    # frame 0: 0 seen; 1: both missed; 2: both seen; 3: both missed; 4: turned around, what was behind is missed
    assert misses == [(0, 1), (1, 0), (1, 1), (3, 0), (3, 1), (4, 2)]
    assert looks.p_detect[~looks.hit] == pytest.approx(0.7, abs=1e-6)
    assert looks.p_detect[-2] < 1e-12
    some = looks.rows(looks.hit)
    assert some.hit.all()
    assert some.landmark.tolist() == [0, 0, 1, 3]


def test_beyond_the_edge_of_the_view_nothing_is_looked_at():
    sensor, _, position = tiny_scene()
    # 0.3 of the best is half a standard deviation of the edge beyond the limit: 0.105 m
    for x, expected in ((3.0 - 8.0 - 0.12, []), (3.0 - 8.0 - 0.09, [(0, 0)])):
        _, misses, looks = looked_at(sensor, np.array([[x, 0.0, 0.0]]), position[:1], [])
        assert misses == expected
        assert np.all(looks.p_detect >= USUAL.worth_a_look * sensor.p_detect)


def test_no_frames_and_no_landmarks_no_looks():
    sensor, pose, position = tiny_scene()
    assert len(looked_at(sensor, pose[:0], position, [])[2].hit) == 0
    assert len(looked_at(sensor, pose, position[:0], [])[2].hit) == 0


def test_many_pairs_are_taken_in_parts(monkeypatch):
    whole = looked_at(*tiny_scene(), [(0, 0), (3, 1)])
    monkeypatch.setattr(visibility, "AT_ONCE", 5)
    parts = looked_at(*tiny_scene(), [(0, 0), (3, 1)])
    assert parts[:2] == whole[:2]
