"""The field of a sensor: against rotations of scipy and plain projection, one point at a time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evermap.errors import ConfigError
from evermap.sensing.profile import Field, Projection
from evermap_studies.worlds.sensors import CAMERA, LIDAR, angles, contains, outline


def in_annulus(point, sensor: Field) -> bool:
    """By the angle to the sensor's vertical axis and the one about it."""
    distance = math.hypot(*point)
    from_vertical = math.acos(point[2] / distance)
    turn = math.atan2(point[1], point[0])
    level = abs(math.pi / 2 - from_vertical) <= sensor.half_elevation_rad
    return distance <= sensor.range_max_m and level and abs(turn) <= sensor.half_azimuth_rad


def in_pyramid(point, sensor: Field) -> bool:
    """By where the point falls on the image plane at unit distance."""
    if point[0] <= 0.0:
        return False
    u, v = point[1] / point[0], point[2] / point[0]
    on_image = abs(u) <= math.tan(sensor.half_azimuth_rad) and abs(v) <= math.tan(sensor.half_elevation_rad)
    return math.hypot(*point) <= sensor.range_max_m and on_image


FIELDS = {
    "lidar": (LIDAR, in_annulus),
    "lidar that looks ahead": (Field(9.0, 1.2, 0.4, Projection.SPHERICAL), in_annulus),
    "camera": (CAMERA, in_pyramid),
    "narrow camera": (Field(9.0, 0.7, 0.3, Projection.PINHOLE), in_pyramid),
}


@pytest.mark.parametrize("name", FIELDS)
def test_field_is_brute_force_geometry(name):
    sensor, plain = FIELDS[name]
    rng = np.random.default_rng(3)
    position, point = rng.uniform(-8.0, 8.0, (2, 60, 3))
    turned = Rotation.random(60, rng=rng)
    seen = np.stack([turned.inv().apply(p - position) for p in point], axis=1)
    expected = [[plain(seen[pose, k], sensor) for k in range(60)] for pose in range(60)]
    found = contains(sensor, seen)
    np.testing.assert_array_equal(found, expected)
    assert 50 < found.sum() < 3500


@pytest.mark.parametrize("sensor", [LIDAR, CAMERA])
def test_angles_turn_the_axis_onto_the_point(sensor):
    point = Rotation.random(200, rng=np.random.default_rng(1)).apply([4.0, 0.0, 0.0])
    if sensor.projection is Projection.PINHOLE:
        point = point[point[:, 0] > 0.1]
    azimuth, elevation = angles(sensor, point)
    np.testing.assert_allclose(np.tan(azimuth) * point[:, 0], point[:, 1], atol=1e-9)
    if sensor.projection is Projection.SPHERICAL:
        turn = Rotation.from_euler("ZY", np.column_stack([azimuth, -elevation]))
        np.testing.assert_allclose(turn.apply([4.0, 0.0, 0.0]), point, atol=1e-9)
    else:
        np.testing.assert_allclose(np.tan(elevation) * point[:, 0], point[:, 2], atol=1e-9)


@pytest.mark.parametrize(
    ("sensor", "point", "inside"),
    [
        (LIDAR, (16.0, 0.0, 0.0), True),
        (LIDAR, (16.001, 0.0, 0.0), False),
        (LIDAR, (-5.0, -1e-9, 0.0), True),  # no seam behind
        (LIDAR, (0.0, 0.0, 3.0), False),  # blind above
        (LIDAR, (1.0, 1.0, 0.81), True),  # 29.8 degrees up
        (LIDAR, (1.0, 1.0, 0.83), False),  # 30.4 degrees
        (CAMERA, (1.0, 0.99, 0.99), True),  # a corner of the image, 44.5 degrees from the axis' diagonal
        (CAMERA, (1.0, 1.01, 0.0), False),
        (CAMERA, (-5.0, 0.0, 0.0), False),  # behind
        (CAMERA, (0.0, 0.0, 1.0), False),
    ],
)
def test_borders_by_hand(sensor, point, inside):
    assert bool(contains(sensor, np.array(point))) is inside


@given(
    st.floats(0.01, 15.0),
    st.floats(-math.pi, math.pi),
    st.floats(-math.pi / 2, math.pi / 2),
    st.floats(0.01, 1.0),
    st.sampled_from([LIDAR, CAMERA]),
)
def test_a_point_in_the_field_stays_in_it_when_it_comes_nearer(distance_m, azimuth, elevation, share, sensor):
    across = math.cos(elevation)
    ray = np.array([across * math.cos(azimuth), across * math.sin(azimuth), math.sin(elevation)])
    far, near = contains(sensor, np.stack([distance_m * ray, share * distance_m * ray]))
    angle = np.abs(angles(sensor, ray))
    on_the_edge = np.isclose(angle, [sensor.half_azimuth_rad, sensor.half_elevation_rad], atol=1e-6).any()
    assert far == near or on_the_edge


def test_shapes_are_kept():
    point = np.ones((2, 5, 3))
    assert contains(LIDAR, point).shape == (2, 5)
    assert [a.shape for a in angles(CAMERA, point)] == [(2, 5), (2, 5)]
    assert contains(LIDAR, np.ones(3)).shape == ()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0.0, 1.0, 0.5, Projection.SPHERICAL), "range_max_m"),
        ((math.inf, 1.0, 0.5, Projection.SPHERICAL), "range_max_m"),
        ((math.nan, 1.0, 0.5, Projection.SPHERICAL), "range_max_m"),
        ((9.0, 3.2, 0.5, Projection.SPHERICAL), "half_azimuth_rad"),
        ((9.0, 1.6, 0.5, Projection.PINHOLE), "half_azimuth_rad"),
        ((9.0, 1.0, 0.0, Projection.PINHOLE), "half_elevation_rad"),
        ((9.0, 1.0, 1.6, Projection.SPHERICAL), "half_elevation_rad"),
    ],
)
def test_a_field_that_cannot_be_is_said_in_one_line(arguments, said):
    with pytest.raises(ConfigError, match=said) as error:
        Field(*arguments)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", FIELDS)
def test_outline_lies_on_the_border_of_the_field(name):
    sensor, _ = FIELDS[name]
    lower, upper, *slices = outline(sensor, 3.0)
    for edge, sign in ((lower, -1.0), (upper, 1.0)):
        azimuth, elevation = angles(sensor, edge)
        np.testing.assert_allclose(np.linalg.norm(edge, axis=1), 3.0)
        np.testing.assert_allclose(elevation, sign * sensor.half_elevation_rad)
        np.testing.assert_allclose(azimuth[[0, -1]], [-sensor.half_azimuth_rad, sensor.half_azimuth_rad])
    for line, share in zip(slices, np.linspace(-1.0, 1.0, 5), strict=True):
        np.testing.assert_array_equal(line[[0, -1]], 0.0)
        azimuth, elevation = angles(sensor, line[1:-1])
        np.testing.assert_allclose(azimuth, share * sensor.half_azimuth_rad, atol=1e-12)
        assert np.all(np.diff(elevation) > 0.0)
        assert np.all(np.abs(elevation) < sensor.half_elevation_rad)
