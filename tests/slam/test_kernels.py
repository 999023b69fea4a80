"""Measurement equations and their derivatives against matrix exponentials, differences and sampled drives."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from problems import (
    default_prior,
    integrated,
    slow_detection,
    slow_increment,
    true_velocity,
    wandering_drive,
)

from evermap.geometry import se2
from evermap.slam.kernels import (
    FLOOR_FORWARD_M,
    FLOOR_TURN_RAD,
    FLOOR_VARIANCE,
    NOISE_NAMES,
    detection_residual,
    find_from,
    invert_3x3,
    multiply,
    odometry_residual,
    sandwich,
)
from evermap.slam.problem import USUAL, Drive

ONCE = FLOOR_VARIANCE * np.eye(3)
"""What every window has, however short."""


lengths = st.floats(-20.0, 20.0)
angles = st.floats(-np.pi, np.pi)
poses = st.tuples(lengths, lengths, angles).map(np.array)
points = st.tuples(lengths, lengths).map(np.array)
states = st.tuples(
    st.floats(-0.2, 0.2),
    st.floats(-0.1, 0.1),
    st.floats(-0.3, 0.3),
    st.floats(-0.6, 0.3),
    st.floats(-0.2, 0.2),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(-0.4, 0.6),
    st.floats(0.8, 1.2),
    st.floats(0.8, 1.2),
    st.floats(-0.1, 0.1),
).map(np.array)
mounts = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), angles).map(np.array)
speeds = st.sampled_from([0.0, 1e-7, 1e-5, 9e-4, 1.1e-3, -0.02, 0.4, -2.0])
rows = st.tuples(st.floats(-2.0, 2.0), st.floats(-0.5, 0.5), st.one_of(speeds, st.floats(-2.0, 2.0)))


@st.composite
def drives(draw):
    """A handful of velocities at uneven stamps, shorter and longer than the kernel's own step."""
    gaps = draw(st.lists(st.floats(0.02, 0.45), min_size=3, max_size=8))
    stamps = np.concatenate([[0.0], np.cumsum(gaps)])
    velocity = np.array([draw(rows) for _ in stamps])
    turning = draw(st.floats(0.0, 1.0)) * velocity[:, 2]
    return Drive(stamps, np.column_stack([velocity, turning]), np.zeros(len(stamps)))


def central(function, at, step=1e-6):
    """Derivatives of a vector function by central differences, one column an argument."""
    columns = []
    for k in range(len(at)):
        d = np.zeros(len(at))
        d[k] = step
        columns.append((np.asarray(function(at + d)) - np.asarray(function(at - d))) / (2 * step))
    return np.stack(columns, axis=-1)


def detected(pose, landmark, states, mount, reading=(3.0, 0.2)):
    e, jx, jl, jc = np.full(2, 7.0), np.full((2, 3), 7.0), np.full((2, 2), 7.0), np.full((2, 7), 7.0)
    detection_residual(pose, landmark, states, mount, *reading, e, jx, jl, jc)
    return e, jx, jl, jc


def away_from_corners(pose, landmark, mount, reading):
    """Not on top of the sensor, and neither bearing nor its residual at half a turn."""
    seen = se2.transform(se2.inverse(se2.compose(pose, mount)), landmark)
    bearing = np.arctan2(seen[1], seen[0])
    assume(np.hypot(*seen) > 0.3)
    assume(abs(abs(bearing) - np.pi) > 1e-3)
    assume(abs(abs(se2.wrap(reading - bearing)) - np.pi) > 0.3)


@given(poses, points, states, mounts, st.floats(0.1, 20.0), angles)
def test_detection_is_the_range_law(pose, landmark, states, mount, range_m, bearing_rad):
    away_from_corners(pose, landmark, mount, bearing_rad)
    e, *_ = detected(pose, landmark, states, mount, (range_m, bearing_rad))
    expected = [range_m, bearing_rad] - slow_detection(pose, landmark, states, mount)
    assert e[0] == pytest.approx(expected[0], abs=1e-10)
    assert e[1] == pytest.approx(se2.wrap(expected[1]), abs=1e-10)


@given(poses, points, states, mounts, angles)
def test_detection_derivatives(pose, landmark, states, mount, bearing_rad):
    away_from_corners(pose, landmark, mount, bearing_rad)
    reading = (3.0, bearing_rad)
    _, jx, jl, jc = detected(pose, landmark, states, mount, reading)
    by_pose = central(
        lambda xi: detected(se2.compose(pose, se2.exp(xi)), landmark, states, mount, reading)[0], np.zeros(3)
    )
    by_landmark = central(lambda at: detected(pose, at, states, mount, reading)[0], landmark)
    by_states = central(lambda at: detected(pose, landmark, at, mount, reading)[0], states)
    assert jx == pytest.approx(by_pose, rel=1e-5, abs=1e-6)
    assert jl == pytest.approx(by_landmark, rel=1e-5, abs=1e-6)
    assert jc == pytest.approx(by_states[:, :7], rel=1e-5, abs=1e-6)
    assert by_states[:, 7:] == pytest.approx(0.0)


def test_landmark_on_the_sensor_stays_finite():
    e, *parts = detected(np.array([1.0, 2.0, 0.3]), np.array([1.0, 2.0]), default_prior().mean, np.zeros(3))
    assert np.isfinite(e).all()
    assert all(np.isfinite(part).all() for part in parts)


def odometry(pose, following, increment):
    e, j1, j2 = np.full(3, 7.0), np.full((3, 3), 7.0), np.full((3, 3), 7.0)
    odometry_residual(pose, following, increment, e, j1, j2)
    return e, j1, j2


@given(poses, poses, poses)
def test_odometry_residual_is_gtsams_and_its_derivatives_too(pose, following, increment):
    e, j1, j2 = odometry(pose, following, increment)
    a, b, u = gtsam.Pose2(*pose), gtsam.Pose2(*following), gtsam.Pose2(*increment)
    expected = u.between(a.between(b))
    assert e[:2] == pytest.approx(expected.translation(), abs=1e-9)
    assume(abs(abs(e[2]) - np.pi) > 1e-3)
    assert e[2] == pytest.approx(expected.theta(), abs=1e-9)
    by_pose = central(lambda xi: odometry(se2.compose(pose, se2.exp(xi)), following, increment)[0], np.zeros(3))
    by_following = central(lambda xi: odometry(pose, se2.compose(following, se2.exp(xi)), increment)[0], np.zeros(3))
    assert j1 == pytest.approx(by_pose, rel=1e-5, abs=1e-6)
    assert j2 == pytest.approx(by_following, rel=1e-5, abs=1e-6)


@given(poses, poses)
def test_odometry_residual_by_the_increment_is_minus_identity_where_it_is_small(pose, increment):
    following = se2.compose(pose, increment)
    by_increment = central(lambda xi: odometry(pose, following, se2.compose(increment, se2.exp(xi)))[0], np.zeros(3))
    assert by_increment == pytest.approx(-np.eye(3), abs=1e-6)


@given(drives(), states, st.floats(-0.5, 2.0), st.floats(1e-3, 2.5))
def test_increment_is_a_product_of_matrix_exponentials(drive, states, start, passed):
    out = integrated(drive, start, start + passed, states)
    expected = slow_increment(drive, start, start + passed, states)
    assert out.increment == pytest.approx(expected, abs=1e-9)


@given(drives(), states, st.floats(-0.5, 2.0), st.floats(1e-2, 2.5))
def test_increment_derivatives(drive, states, start, passed):
    """By delay, forward scale, turn scale and slip, as right perturbations of the increment."""
    edges = np.array([start, start + passed])[:, None] + states[7] - drive.stamp_s
    assume(np.abs(edges).min() > 1e-4)  # a corner of the delay's derivative
    out = integrated(drive, start, start + passed, states)

    def perturbation(values):
        moved = states.copy()
        moved[7:] = values
        return se2.log(se2.between(out.increment, slow_increment(drive, start, start + passed, moved)))

    assert out.jacobian == pytest.approx(central(perturbation, states[7:]), rel=1e-4, abs=1e-6)


@given(drives(), states, st.floats(-0.5, 1.0), st.floats(1e-2, 1.5), st.floats(0.05, 0.95))
def test_two_adjacent_windows_make_the_whole(drive, states, start, passed, share):
    middle, stop = start + share * passed, start + passed
    first, second = integrated(drive, start, middle, states), integrated(drive, middle, stop, states)
    whole = integrated(drive, start, stop, states)
    assert se2.between(whole.increment, se2.compose(first.increment, second.increment)) == pytest.approx(0.0, abs=1e-9)
    carry = se2.adjoint(se2.inverse(second.increment))
    jacobian = carry @ first.jacobian + second.jacobian
    edges = np.array([start, middle, stop])[:, None] + states[7] - drive.stamp_s
    if np.abs(edges).min() > 1e-9:
        assert whole.jacobian == pytest.approx(jacobian, rel=1e-7, abs=1e-9)
    # a cut within a step changes where in the step the noise is thought to come: of second order in its length
    for kind in range(len(NOISE_NAMES)):
        both = carry @ first.noise[kind] @ carry.T + second.noise[kind]
        assert whole.noise[kind] == pytest.approx(both, rel=1e-2, abs=1e-2 * both.max())
    both = carry @ (first.floor - ONCE) @ carry.T + second.floor
    assert whole.floor == pytest.approx(both, rel=1e-2, abs=1e-2 * both.max())


def test_windows_cut_at_odometry_stamps_make_the_whole_exactly():
    drive = wandering_drive(np.random.default_rng(1), 5.0)
    states = default_prior().mean
    first, second = integrated(drive, 0.3, drive.stamp_s[35], states), integrated(drive, drive.stamp_s[35], 4.1, states)
    whole = integrated(drive, 0.3, 4.1, states)
    carry = se2.adjoint(se2.inverse(second.increment))
    assert whole.noise == pytest.approx(carry @ first.noise @ carry.T + second.noise, rel=1e-10, abs=1e-13)
    both = carry @ (first.floor - ONCE) @ carry.T + second.floor
    assert whole.floor == pytest.approx(both, rel=1e-10, abs=1e-13)


def test_empty_window_is_no_motion_and_hardly_any_noise():
    out = integrated(wandering_drive(np.random.default_rng(0), 3.0), 1.234, 1.234, default_prior().mean)
    assert not out.increment.any()
    assert not out.noise.any()
    assert out.floor == pytest.approx(ONCE)


def sampled_drives(drive, start, stop, states, sigma, rng, count, pieces=4):
    """True motions behind one reported drive: every kind of noise is white, with the drivers that its name says."""
    per_m, per_rad, lateral_per_m, per_s, turn_per_rad = np.square(sigma)
    at = np.sort(np.concatenate([[start, stop], drive.stamp_s[(drive.stamp_s > start) & (drive.stamp_s < stop)]]))
    pose = np.zeros((count, 3))
    for low, high in pairwise(at):
        row = np.searchsorted(drive.stamp_s, 0.5 * (low + high), side="right") - 1
        forward, lateral, turn, _ = drive.velocity[row]
        speed = np.hypot(forward, lateral)
        per_second = np.array(
            [
                per_m * speed + per_rad * abs(turn) + FLOOR_FORWARD_M**2,
                lateral_per_m * speed + FLOOR_FORWARD_M**2,
                per_s + turn_per_rad * abs(turn) + FLOOR_TURN_RAD**2,
            ]
        )
        per_second += drive.unknown[row]
        fine = max(pieces, int((high - low) / 0.02))
        h = (high - low) / fine
        for _ in range(fine):
            noise = np.sqrt(per_second * h) * rng.normal(size=(count, 3))
            pose = se2.compose(pose, se2.exp(true_velocity(drive.velocity[row], states) * h + noise))
    return pose


MIXES = {
    **{
        name: np.eye(5)[k] * level
        for k, (name, level) in enumerate(zip(NOISE_NAMES, (0.02, 0.03, 0.02, 0.01, 0.03), strict=True))
    },
    "all": np.array([0.01, 0.01, 0.01, 0.01, 0.01]),
    "floor": np.zeros(5),
}


@pytest.mark.parametrize("name", MIXES)
def test_covariance_is_that_of_thousands_of_sampled_drives(name):
    sigma, count = MIXES[name], 8000
    rng = np.random.default_rng(42)
    drive = wandering_drive(rng, 4.0)
    states = np.array([0.0, 0, 0, 0, 0, 0, 0, 0.0, 1.05, 0.95, 0.02])
    start, stop = 0.03, 3.47
    out = integrated(drive, start, stop, states)
    samples = sampled_drives(drive, start, stop, states, sigma, rng, count)
    errors = se2.log(se2.between(out.increment, samples))
    found = errors.T @ errors / count
    expected = out.covariance(sigma**2)
    # entries of a sampled covariance scatter like this
    scatter = np.sqrt((np.outer(np.diag(expected), np.diag(expected)) + expected**2) / count)
    z = (found - expected) / scatter
    assert np.abs(z).max() < 4.0, f"covariance off by {z} standard errors"
    # and the mean is that of the drive as reported
    assert np.abs(errors.mean(axis=0) / np.sqrt(np.diag(expected) / count)).max() < 4.5


def test_noise_counts_reported_distance_angle_and_time():
    """Straight and in place, where the sums are known in closed form."""
    stamps = np.arange(0.0, 3.0, 0.1)
    straight = Drive(stamps, np.tile([2.0, 0.0, 0.0, 0.0], (len(stamps), 1)), np.zeros(len(stamps)))
    out = integrated(straight, 0.5, 2.5, default_prior().mean)
    assert out.noise[0] == pytest.approx(np.diag([4.0, 0.0, 0.0]))
    assert out.noise[1] == pytest.approx(0.0)
    assert out.noise[2] == pytest.approx(np.diag([0.0, 4.0, 0.0]))
    # int (v (T - t))^2 dt = v^2 T^3 / 3, and its covariance with the angle v T^2 / 2
    assert out.noise[3][1:, 1:] == pytest.approx(np.array([[4 * 8 / 3, 4.0], [4.0, 2.0]]), rel=1e-3)
    assert out.noise[4] == pytest.approx(0.0)
    turning = Drive(stamps, np.tile([0.0, 0.0, -1.5, -1.5], (len(stamps), 1)), np.zeros(len(stamps)))
    out = integrated(turning, 0.5, 2.5, default_prior().mean)
    assert np.trace(out.noise[1]) == pytest.approx(3.0, rel=1e-2)
    assert out.noise[4] == pytest.approx(np.diag([0.0, 0.0, 3.0]), abs=1e-12)


def test_silences_become_standing_still_without_knowing():
    silence_s, silent = USUAL.silence_s, USUAL.silent_variance
    stamps = np.array([0.0, 0.1, 0.2, 5.2, 5.3, 5.3 + silence_s])
    velocity = np.arange(18.0).reshape(6, 3) + 1.0
    drive = Drive.from_rows(stamps, velocity)
    assert np.all(np.diff(drive.stamp_s) > 0)
    inside = (
        np.searchsorted(drive.stamp_s, [0.15, 0.2 + 0.45 * silence_s, 3.0, 5.25, 5.9, 5.9 + silence_s], "right") - 1
    )
    expected = [velocity[1], velocity[2], np.zeros(3), velocity[3], velocity[4], np.zeros(3)]
    assert np.array_equal(drive.velocity[inside, :3], expected)
    onwards = (velocity[2] ** 2).sum() * 5.0  # after 5 s: as far as the last speed would have led
    assert drive.unknown[inside] == pytest.approx([0.0, 0.0, silent + onwards, 0.0, 0.0, silent])


def test_silence_makes_the_covariance_grow_with_its_length():
    stamps = np.concatenate([np.arange(0.0, 2.0, 0.1), np.arange(22.0, 24.0, 0.1)])
    drive = Drive.from_rows(stamps, np.tile([0.5, 0.0, 0.1], (len(stamps), 1)))
    states = default_prior().mean
    across = integrated(drive, 1.0, 23.0, states)
    silent = 22.0 - 1.9 - 0.5 * USUAL.silence_s
    rate = USUAL.silent_variance + (0.5**2 + 0.1**2) * (22.0 - 1.9)
    assert across.floor[2, 2] == pytest.approx(rate * silent + 22.0 * FLOOR_TURN_RAD**2 + FLOOR_VARIANCE)
    assert across.increment == pytest.approx(slow_increment(drive, 1.0, 23.0, states), abs=1e-9)
    assert across.increment[2] == pytest.approx(0.1 * (22.0 - silent))
    eigenvalues = np.linalg.eigvalsh(across.covariance(np.full(5, 1e-4)))
    assert eigenvalues.min() > 0


@given(st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6), st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3))
def test_inverse_of_three_by_three_is_numpys(below, log_scale):
    root = np.zeros((3, 3))
    root[np.tril_indices(3)] = below
    root[np.diag_indices(3)] = 0.5 + np.abs(np.diag(root))
    scale = np.diag(10.0 ** np.array(log_scale))
    matrix = scale @ root @ root.T @ scale
    expected = np.linalg.inv(scale) @ np.linalg.inv(root @ root.T) @ np.linalg.inv(scale)
    found = np.full((3, 3), 7.0)
    invert_3x3(matrix, found)
    assert scale @ found @ scale == pytest.approx(scale @ expected @ scale, rel=1e-9, abs=1e-9)
    invert_3x3(matrix, matrix)
    assert np.array_equal(matrix, found)


@pytest.mark.parametrize("turn", [-2.0, -0.05, 0.0499, 1e-3, 1e-7, 0.0, 0.0501, 3.0])
def test_increment_of_a_turn_by_series_and_by_sines_is_the_exponential(turn):
    drive = Drive(np.array([0.0, 1.0]), np.tile([0.7, -0.2, turn / 0.1, turn / 0.1], (2, 1)), np.zeros(2))
    out = integrated(drive, 0.2, 0.3, default_prior().mean)
    assert out.increment == pytest.approx(se2.exp(np.array([0.07, -0.02, turn])), abs=1e-14)


@pytest.mark.parametrize(("rows", "columns"), [(3, 3), (2, 10), (3, 41)])
def test_products_in_place_are_numpys(rows, columns):
    rng = np.random.default_rng(0)
    a, b, out = rng.normal(size=(rows, 3)), rng.normal(size=(3, columns)), np.full((rows, columns), 7.0)
    multiply(a, b, out)
    assert out == pytest.approx(a @ b)
    root, j, squared = rng.normal(size=(columns, columns)), rng.normal(size=(rows, columns)), np.full((rows, rows), 7.0)
    sandwich(j, root @ root.T, np.full((rows, columns), 7.0), squared)
    assert squared == pytest.approx(j @ root @ root.T @ j.T)


@pytest.mark.parametrize("count", [1, 2, 5, 300])
def test_a_row_is_found_from_wherever_the_search_begins(count: int) -> None:
    random = np.random.default_rng(count)
    for stamp_s in (np.linspace(0.0, 1.0, count), np.sort(random.normal(size=count).round(1))):
        for at_s in (*random.normal(size=20), *random.choice(stamp_s, 5), -np.inf, np.inf):
            for near in (*random.uniform(-5.0, count + 5.0, 3), np.nan, 1e300):
                assert find_from(stamp_s, at_s, near) == np.searchsorted(stamp_s, at_s)
