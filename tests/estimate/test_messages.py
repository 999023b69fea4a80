"""Messages of a bag as rows of measurements: what is read of each, and what is a rest of the robot."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from evermap.estimate.kind import Messages
from evermap.estimate.measurements import gnss, gravity
from evermap.geometry import se3
from evermap.types import FloatArray, SpatialOdometry

MOUNT = np.array([0.3, 0.1, 0.5, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
"""A quarter of a turn about the vertical."""
UP = np.array([0.3, -0.2, 9.8])
"""Specific force at rest, in the frame of the sensor."""


def imu(forces: FloatArray, rates: FloatArray, hz: float = 20.0, odometry: SpatialOdometry | None = None) -> Messages:
    stamp_s = 100.0 + np.arange(len(forces)) / hz
    return Messages(stamp_s, np.hstack([forces, rates]), MOUNT, odometry)


def at_rest(seconds: float, hz: float = 20.0) -> tuple[FloatArray, FloatArray]:
    count = int(seconds * hz)
    return np.tile(UP, (count, 1)), np.zeros((count, 3))


def driven(until_s: float, speed_mps: float) -> SpatialOdometry:
    stamp_s = np.arange(99.0, until_s, 0.1)
    pose = np.tile([0.0, 0.0, 0.0, *se3.NO_TURN], (len(stamp_s), 1))
    pose[:, 0] = speed_mps * (stamp_s - 99.0)
    return SpatialOdometry(stamp_s, pose, np.full((len(stamp_s), 6), np.nan))


def test_the_mean_of_every_rest_is_a_row_in_the_frame_of_the_robot() -> None:
    """Three seconds at rest, two of a turn, two at rest with another force: one row each, in the middle of it."""
    (first, still), (second, also) = at_rest(3.0), at_rest(2.0)
    second = second + [0.2, 0.0, 0.0]
    forces, rates = np.vstack([first, first[:40], second]), np.vstack([still, still[:40] + [0.0, 0.0, 0.3], also])
    found = gravity.make_rows(imu(forces, rates))
    np.testing.assert_allclose(found.stamp_s, [100.0 + 2.95 / 2, 105.0 + 1.95 / 2])
    read = np.column_stack([found.columns[name] for name in gravity.KIND.columns])
    np.testing.assert_allclose(read, np.array([UP, UP + [0.2, 0.0, 0.0]]) @ se3.rotation_of(MOUNT).T)
    assert found.remark == ""


def test_without_a_transform_an_accelerometer_says_no_direction() -> None:
    found = gravity.make_rows(imu(*at_rest(2.0))._replace(mount=None))
    assert (len(found.stamp_s), found.columns.keys()) == (0, {*gravity.KIND.columns})
    assert "not used" in found.remark


@pytest.mark.parametrize(
    ("force", "rate", "hz", "rests"),
    [
        pytest.param([0.0, 0.0, 0.0], [0.0, 0.0, 0.04], 20.0, 1, id="the bias of a gyroscope"),
        pytest.param([0.0, 0.0, 0.0], [0.0, 0.0, 0.06], 20.0, 0, id="a turn"),
        pytest.param([0.0, 0.0, 0.45], [0.0, 0.0, 0.0], 20.0, 1, id="an accelerometer that is a little off"),
        pytest.param([0.0, 0.0, 0.6], [0.0, 0.0, 0.0], 20.0, 0, id="one that is far off"),
        pytest.param([0.0, 0.0, -9.8], [0.0, 0.0, 0.0], 20.0, 0, id="gravity was taken off"),
        pytest.param([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 11.0, 1, id="eleven readings a second"),
        pytest.param([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 9.0, 0, id="nine readings a second"),
        pytest.param([0.0, 0.0, 0.0], [np.nan] * 3, 20.0, 0, id="neither gyroscope nor odometry"),
    ],
)
def test_a_rest_has_gravity_and_no_turn(force: list[float], rate: list[float], hz: float, rests: int) -> None:
    forces, rates = at_rest(2.0, hz)
    assert len(gravity.make_rows(imu(forces + force, rates + rate, hz)).stamp_s) == rests


@pytest.mark.parametrize(
    ("until_s", "speed_mps", "rests"),
    [(103.0, 0.0, 1), (103.0, 0.015, 1), (103.0, 0.03, 0), (101.5, 0.0, 1), (100.5, 0.0, 0)],
)
def test_odometry_says_what_is_a_rest_as_far_as_it_reaches(until_s: float, speed_mps: float, rests: int) -> None:
    """Of a robot that drives on evenly neither the gyroscope nor the accelerometer shows anything."""
    forces, rates = at_rest(2.0)
    found = gravity.make_rows(imu(forces, rates + np.nan, odometry=driven(until_s, speed_mps)))
    assert len(found.stamp_s) == rests
    if until_s == 101.5:  # of the second one nothing is known
        assert found.stamp_s[0] < 101.0


def test_without_odometry_a_rest_is_steady() -> None:
    forces, rates = at_rest(2.0)
    shaken = np.random.default_rng(0).normal(0.0, 0.4, forces.shape)
    assert len(gravity.make_rows(imu(forces + 0.2 * shaken, rates)).stamp_s) == 1
    assert len(gravity.make_rows(imu(forces + shaken, rates)).stamp_s) == 0


def vector(*values: float) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip("xyz", values, strict=True)))


def test_an_imu_says_itself_what_it_does_not_have() -> None:
    message = SimpleNamespace(
        linear_acceleration=vector(1.0, 2.0, 3.0), angular_velocity=vector(4.0, 5.0, 6.0),
        linear_acceleration_covariance=[0.0] * 9, angular_velocity_covariance=[0.0] * 9,
    )  # fmt: skip
    assert gravity.read_imu(message) == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    message.angular_velocity_covariance = [-1.0, *[0.0] * 8]
    np.testing.assert_array_equal(gravity.read_imu(message), [1.0, 2.0, 3.0, np.nan, np.nan, np.nan])
    message.linear_acceleration_covariance = [-1.0, *[0.0] * 8]
    assert gravity.read_imu(message) is None


def fix(**other: object) -> SimpleNamespace:
    usual = {
        "latitude": 48.0, "longitude": 11.0, "altitude": 520.0, "status": SimpleNamespace(status=0),
        "position_covariance": [1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 9.0], "position_covariance_type": 2,
    }  # fmt: skip
    return SimpleNamespace(**(usual | other))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, (48.0, 11.0, 520.0, 1.0, 2.0, 9.0)),
        ({"position_covariance_type": 0}, (48.0, 11.0, 520.0, np.nan, np.nan, np.nan)),
        ({"position_covariance": [1.0, 0, 0, 0, -1.0, 0, 0, 0, np.inf]}, (48.0, 11.0, 520.0, 1.0, np.nan, np.nan)),
        ({"altitude": np.nan}, (48.0, 11.0, np.nan, 1.0, 2.0, 9.0)),
        ({"latitude": 0.0}, (0.0, 11.0, 520.0, 1.0, 2.0, 9.0)),
    ],
)
def test_a_fix_has_the_variances_that_it_states(given: dict[str, object], expected: tuple[float, ...]) -> None:
    np.testing.assert_array_equal(gnss.read_fix(fix(**given)), expected)


@pytest.mark.parametrize(
    "given", [{"status": SimpleNamespace(status=-1)}, {"latitude": np.nan}, {"latitude": 0.0, "longitude": 0.0}]
)
def test_no_fix_is_none(given: dict[str, object]) -> None:
    assert gnss.read_fix(fix(**given)) is None


def test_fixes_are_east_and_north_of_the_first() -> None:
    """A degree of latitude at 48 degrees is 111.2 km, one of longitude 74.6 km, by the radii of curvature."""
    values = np.array([[48.0, 11.0, 500.0, 4.0, 4.0, 9.0], [48.001, 11.0, np.nan, 4.0, 4.0, 9.0],
                       [48.0, 11.001, 503.0, 1.0, 3.0, 16.0]])  # fmt: skip
    found = gnss.make_rows(Messages(np.arange(3.0), values, MOUNT, None))
    e2, a, s = 6.69437999014e-3, 6378137.0, np.sin(np.radians(48.0))
    across = a / np.sqrt(1.0 - e2 * s**2)
    along = across * (1.0 - e2) / (1.0 - e2 * s**2)
    np.testing.assert_allclose(found.columns["y_m"][:2], [0.0, np.radians(0.001) * (along + 500.0)], atol=1e-3)
    east = np.radians(0.001) * (across + 503.0) * np.cos(np.radians(48.0))
    np.testing.assert_allclose(found.columns["x_m"], [0.0, 0.0, east], atol=1e-3)
    np.testing.assert_allclose(found.columns["z_m"], [0.0, np.nan, 3.0], atol=1e-3)
    np.testing.assert_allclose(found.columns["sigma_xy_m"], np.sqrt([4.0, 4.0, 2.0]))
    np.testing.assert_allclose(found.columns["sigma_z_m"], [3.0, 3.0, 4.0])
    for axis, part in zip("xyz", MOUNT[:3], strict=True):
        np.testing.assert_array_equal(found.columns[f"lever_{axis}_m"], part)
