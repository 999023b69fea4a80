"""What decides on a detection: being in the field against noisy poses of scipy, the rest by its formula."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evermap.errors import ConfigError
from evermap.sensing.profile import Field, Projection
from evermap_studies.worlds.sensors import (
    CAMERA,
    LIDAR,
    Fading,
    InField,
    SpatialModel,
    ViewGeometry,
    ViewingAngle,
    contains,
    sight,
)

DRAWS = 100_000
FIELDS = {
    "lidar": LIDAR,
    "lidar that looks ahead": Field(9.0, 1.2, 0.4, Projection.SPHERICAL),
    "lidar with a blind wedge": Field(9.0, 2.5, 0.4, Projection.SPHERICAL),
    "camera": CAMERA,
    "narrow camera": Field(9.0, 0.7, 0.3, Projection.PINHOLE),
}


def seen_from(point_sensor_m) -> ViewGeometry:
    """Points (K, 3) that face a sensor which stands at the origin and looks along x."""
    point = np.atleast_2d(np.asarray(point_sensor_m, dtype=float))
    outward = -point / np.linalg.norm(point, axis=1, keepdims=True)
    return sight(point, outward, np.zeros(3), np.eye(3))


def near_an_edge(field: Field, n: int, rng: np.random.Generator):
    """(n, 3) points of which each range and angle is likely to be at the limit."""
    range_m = np.where(
        rng.random(n) < 0.5,
        field.range_max_m + 0.1 * rng.normal(size=n),
        rng.uniform(2.0, field.range_max_m, n),
    )
    most = [field.half_azimuth_rad, field.half_elevation_rad]
    edge = np.array(most) + 0.03 * rng.normal(size=(n, 2))
    azimuth, elevation = np.where(rng.random((n, 2)) < 0.5, edge, rng.uniform(-1.3, 1.3, (n, 2))).T
    if field.projection is Projection.PINHOLE:
        ray = np.column_stack([np.ones(n), np.tan(azimuth), np.tan(elevation)])
    else:
        ray = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    return range_m[:, None] * ray / np.linalg.norm(ray, axis=1, keepdims=True)


@pytest.mark.parametrize("name", FIELDS)
def test_in_field_is_the_share_of_noisy_poses_that_see_the_point(name):
    field = FIELDS[name]
    rng = np.random.default_rng(8)
    point = near_an_edge(field, 40, rng)
    model = InField(field, sigma_position_m=0.05, sigma_attitude_rad=math.radians(1.0))
    found = model.probability(seen_from(point))

    turned = Rotation.from_rotvec(model.sigma_attitude_rad * rng.normal(size=(DRAWS, 3)))
    moved_m = model.sigma_position_m * rng.normal(size=(DRAWS, 3))
    share = np.array([contains(field, turned.apply(p) + moved_m).mean() for p in point])

    range_m = np.linalg.norm(point, axis=1)
    softness = np.hypot(model.sigma_position_m / range_m, model.sigma_attitude_rad)
    curved = 0.4 * softness  # surfaces bend by this share of the softness, times the normal's largest density
    tolerance = 4.0 * np.sqrt(np.maximum(share * (1.0 - share), 1.0 / DRAWS) / DRAWS) + curved
    pinhole = field.projection is Projection.PINHOLE
    rho = math.sin(field.half_azimuth_rad) * math.sin(field.half_elevation_rad) if pinhole else 0.0
    assert (found <= share + tolerance).all()
    assert (found >= share - tolerance - math.asin(rho) / (2.0 * math.pi)).all()
    assert ((share > 0.05) & (share < 0.95)).sum() >= 10


@pytest.mark.parametrize("name", FIELDS)
def test_a_pose_that_is_known_leaves_the_field_itself(name):
    field = FIELDS[name]
    rng = np.random.default_rng(2)
    point = rng.uniform(-10.0, 10.0, (4000, 3)) * [1.0, 1.0, 0.3]
    sharp = InField(field, sigma_position_m=1e-9, sigma_attitude_rad=0.0)
    inside = contains(field, point)
    np.testing.assert_allclose(sharp.probability(seen_from(point)), inside, atol=1e-12)
    assert 100 < inside.sum() < 3900


@pytest.mark.parametrize("half_azimuth_rad", [3.14, math.radians(179.0), math.pi])
def test_what_is_ahead_is_far_from_a_wedge_behind(half_azimuth_rad):
    """Also where the two edges of the wedge, carried on through the sensor, pass close by."""
    field = Field(16.0, half_azimuth_rad, 0.5, Projection.SPHERICAL)
    ahead = [[10.0, 0.0, 0.0], [10.0, 0.2, 0.0], [2.0, -0.01, 0.0]]
    np.testing.assert_allclose(InField(field).probability(seen_from(ahead)), 1.0, atol=1e-9)


def test_what_is_behind_is_far_from_a_narrow_field():
    field = Field(16.0, 0.05, 0.5, Projection.SPHERICAL)
    np.testing.assert_allclose(InField(field).probability(seen_from([[-10.0, 0.0, 0.0]])), 0.0, atol=1e-12)


def test_sight_is_geometry_one_landmark_at_a_time():
    rng = np.random.default_rng(5)
    landmark = rng.normal(0.0, 5.0, (30, 3))
    outward = Rotation.random(30, rng=rng).apply([0.0, 0.0, 1.0])
    position, turn = rng.normal(size=3), Rotation.random(rng=rng)
    found = sight(landmark, outward, position, turn.as_matrix())
    for k in range(30):
        to_sensor = position - landmark[k]
        distance = math.sqrt(sum(to_sensor**2))
        np.testing.assert_allclose(found.point_sensor_m[k], turn.inv().apply(-to_sensor), atol=1e-12)
        assert found.range_m[k] == pytest.approx(distance)
        np.testing.assert_allclose(found.direction[k], to_sensor / distance, atol=1e-12)
        between, _ = Rotation.align_vectors(to_sensor[None] / distance, outward[k][None])
        assert math.acos(found.facing[k]) == pytest.approx(between.magnitude(), abs=1e-6)


def test_causes_multiply():
    landmark = [[4.0, 0.0, 0.0], [0.0, 8.0, 0.0]]
    outward = [[-1.0, 0.0, 0.0], [0.0, -0.5, math.sqrt(0.75)]]
    view = sight(np.array(landmark), np.array(outward), np.zeros(3), np.eye(3))
    fading = [math.exp(-4.0 / 10.0), math.exp(-8.0 / 10.0)]
    # 60 degrees are the edge of the second; the first is seen head-on
    angle = [1.0 / (1.0 + math.exp(-(1.0 - 0.5) / 0.1)), 0.5]
    np.testing.assert_allclose(Fading(10.0).probability(view), fading)
    np.testing.assert_allclose(ViewingAngle(math.radians(60.0)).probability(view), angle)
    both = SpatialModel((Fading(10.0), ViewingAngle(math.radians(60.0))), p_0=0.9)
    np.testing.assert_allclose(both.probability(view), 0.9 * np.multiply(fading, angle))
    np.testing.assert_array_equal(SpatialModel((), p_0=0.25).probability(view), 0.25)
    np.testing.assert_array_equal(Fading(math.inf).probability(view), 1.0)


def test_a_sharper_edge_has_the_same_middle():
    view = replace(seen_from(np.ones((3, 3))), facing=np.array([0.2, 0.3, 0.4]))
    soft, sharp = (ViewingAngle(math.acos(0.3), edge).probability(view) for edge in (0.1, 1e-3))
    np.testing.assert_allclose(sharp, [0.0, 0.5, 1.0], atol=1e-12)
    # odds of a logistic edge, one scale from its middle
    np.testing.assert_allclose(soft / (1.0 - soft), [math.exp(-1.0), 1.0, math.e])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Fading(0.0), "length_m"),
        (lambda: Fading(math.nan), "length_m"),
        (lambda: ViewingAngle(0.0), "largest_rad"),
        (lambda: ViewingAngle(3.2), "largest_rad"),
        (lambda: ViewingAngle(1.0, 0.0), "edge"),
        (lambda: ViewingAngle(1.0, math.inf), "edge"),
        (lambda: InField(LIDAR, 0.0), "sigma_position_m"),
        (lambda: InField(LIDAR, math.inf), "sigma_position_m"),
        (lambda: InField(LIDAR, 0.05, -0.1), "sigma_attitude_rad"),
        (lambda: InField(LIDAR, 0.05, math.nan), "sigma_attitude_rad"),
        (lambda: SpatialModel((), p_0=1.1), "p_0"),
        (lambda: SpatialModel((), p_0=math.nan), "p_0"),
    ],
)
def test_models_that_cannot_be_are_said_in_one_line(make, said):
    with pytest.raises(ConfigError, match=said) as error:
        make()
    assert "\n" not in str(error.value)
