"""Measurement equations in space and their derivatives against gtsam's factors and differences."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from groups import PLANE_CASE, SPACE_CASE, central
from hypothesis import assume, given
from hypothesis import strategies as st

from evermap.geometry import se2, se3
from evermap.slam import kernels
from evermap.slam.kernels3d import (
    axis_residual,
    compose,
    odometry_residual,
    point_residual,
    pose_residual,
    retract,
)

LENGTH = 20.0
turns = st.one_of(st.sampled_from([0.0, 1e-300, 1e-9, 1e-4, 0.22, 0.23, np.pi]), st.floats(-3.1, 3.1))
small_turns = st.one_of(st.sampled_from([0.0, 1e-9, 1e-4, 0.2236, 0.2237]), st.floats(-3.0, 3.0))
poses = SPACE_CASE.poses(turns, LENGTH)
points = SPACE_CASE.points(LENGTH)
residuals = SPACE_CASE.twists(small_turns, 5.0)
"""Neither at half a turn, where logarithms jump, nor so near that differences do."""
as_gtsam, order = SPACE_CASE.as_peer, SPACE_CASE.order


def called(kernel, given, *shapes):
    """What a kernel writes into arrays of these shapes, which held something else before."""
    out = [np.full(shape, 7.0) for shape in shapes]
    kernel(*given, *out)
    return out


def odometry(pose, following, increment):
    return called(odometry_residual, (pose, following, increment), 6, (6, 6), (6, 6))


def by(function, pose):
    """Derivatives by a right perturbation of a pose."""
    return central(lambda xi: function(se3.retract(pose, xi)), np.zeros(6))


@given(poses, poses, residuals)
def test_odometry_is_gtsams_factor_and_its_derivatives_are_differences(pose, increment, residual):
    following = se3.compose(pose, se3.compose(increment, se3.exp(residual)))
    e, j1, j2 = odometry(pose, following, increment)
    assert e == pytest.approx(residual, abs=1e-11)
    assert e == pytest.approx(se3.local(increment, se3.between(pose, following)), abs=1e-11)
    values = gtsam.Values()
    values.insert(0, as_gtsam(pose))
    values.insert(1, as_gtsam(following))
    factor = gtsam.BetweenFactorPose3(0, 1, as_gtsam(increment), gtsam.noiseModel.Unit.Create(6))
    assert e[order] == pytest.approx(factor.unwhitenedError(values), abs=1e-8)
    assert j1 == pytest.approx(by(lambda at: odometry(at, following, increment)[0], pose), rel=1e-5, abs=1e-5)
    assert j2 == pytest.approx(by(lambda at: odometry(pose, at, increment)[0], following), rel=1e-5, abs=1e-5)


@given(poses, poses, SPACE_CASE.twists(st.floats(0.05, 3.0), 5.0))
def test_derivatives_of_odometry_are_gtsams(pose, increment, residual):
    following = se3.compose(pose, se3.compose(increment, se3.exp(residual)))
    values = gtsam.Values()
    values.insert(0, as_gtsam(pose))
    values.insert(1, as_gtsam(following))
    factor = gtsam.BetweenFactorPose3(0, 1, as_gtsam(increment), gtsam.noiseModel.Unit.Create(6))
    expected = factor.linearize(values).jacobian()[0]
    e, *found = odometry(pose, following, increment)
    at = np.ix_(order, order)
    assert np.hstack([j[at] for j in found]) == pytest.approx(expected, rel=1e-7, abs=1e-6)
    assert found[1] == pytest.approx(se3.right_jacobian_inverse(e), abs=1e-10)


@given(poses, poses)
def test_without_error_odometry_has_no_residual_and_the_derivatives_of_a_chain(pose, increment):
    e, j1, j2 = odometry(pose, se3.compose(pose, increment), increment)
    assert e == pytest.approx(0.0, abs=1e-12)
    assert j2 == pytest.approx(np.eye(6), abs=1e-12)
    assert j1 == pytest.approx(-se3.adjoint(se3.inverse(increment)), abs=1e-10)
    # of either sign, a quaternion is the same rotation
    other = increment * [1, 1, 1, -1, -1, -1, -1]
    assert odometry(pose, se3.compose(pose, increment), other)[0] == pytest.approx(0.0, abs=1e-12)


def point_seen(pose, landmark, mount, measured):
    return called(point_residual, (pose, landmark, mount, measured), 3, (3, 6), (3, 3), (3, 6))


@given(poses, points, poses, points)
def test_points_are_gtsams_and_derivatives_are_differences(pose, landmark, mount, measured):
    e, j_pose, j_landmark, j_mount = point_seen(pose, landmark, mount, measured)
    sensor = as_gtsam(pose).compose(as_gtsam(mount))
    assert e == pytest.approx(measured - sensor.transformTo(landmark), abs=1e-10)
    by_pose = by(lambda at: point_seen(at, landmark, mount, measured)[0], pose)
    by_mount = by(lambda at: point_seen(pose, landmark, at, measured)[0], mount)
    by_landmark = central(lambda at: point_seen(pose, at, mount, measured)[0], landmark)
    assert j_pose == pytest.approx(by_pose, rel=1e-6, abs=1e-6)
    assert j_mount == pytest.approx(by_mount, rel=1e-6, abs=1e-6)
    assert j_landmark == pytest.approx(by_landmark, rel=1e-6, abs=1e-6)
    assert j_pose == pytest.approx(j_mount @ se3.adjoint(se3.inverse(mount)), abs=1e-10)


def pose_seen(pose, landmark, mount, measured):
    return called(pose_residual, (pose, landmark, mount, measured), 6, (6, 6), (6, 6), (6, 6))


@given(poses, poses, poses, points, SPACE_CASE.twists(small_turns))
def test_poses_of_landmarks_are_gtsams_and_derivatives_are_differences(pose, landmark, mount, position, turn):
    """The measured orientation is the predicted one, turned about an axis that is given in the sensor's frame."""
    sensor = as_gtsam(pose).compose(as_gtsam(mount))
    seen = sensor.between(as_gtsam(landmark))
    measured_rotation = gtsam.Rot3.Expmap(turn[3:]).compose(seen.rotation()).toQuaternion()
    w, x, y, z = (measured_rotation.w(), measured_rotation.x(), measured_rotation.y(), measured_rotation.z())
    measured = np.array([*position, x, y, z, w])
    e, j_pose, j_landmark, j_mount = pose_seen(pose, landmark, mount, measured)
    assert e[:3] == pytest.approx(position - seen.translation(), abs=1e-10)
    assert e[3:] == pytest.approx(turn[3:], abs=1e-10)
    by_pose = by(lambda at: pose_seen(at, landmark, mount, measured)[0], pose)
    by_mount = by(lambda at: pose_seen(pose, landmark, at, measured)[0], mount)
    by_landmark = by(lambda at: pose_seen(pose, at, mount, measured)[0], landmark)
    assert j_pose == pytest.approx(by_pose, rel=1e-5, abs=1e-5)
    assert j_mount == pytest.approx(by_mount, rel=1e-5, abs=1e-5)
    assert j_landmark == pytest.approx(by_landmark, rel=1e-5, abs=1e-5)


def axis_seen(axis, pose, landmark, mount, measured):
    return called(axis_residual, (pose, landmark, mount, measured, axis), 6, (6, 6), (6, 6), (6, 6))


@given(st.integers(0, 2), poses, poses, poses, SPACE_CASE.twists(small_turns), st.floats(-3.0, 3.0))
def test_axes_of_landmarks_are_turned_the_shortest_way_and_derivatives_are_differences(
    axis, pose, landmark, mount, turn, about
):
    """By the angle between the axes alone; a turn of the landmark about its axis changes nothing."""
    predicted = se3.between(se3.compose(pose, mount), landmark)
    measured = se3.compose(se3.exp(turn), predicted)
    assume(se3.rotation_of(predicted)[:, axis] @ se3.rotation_of(measured)[:, axis] > -0.99)
    e, j_pose, j_landmark, j_mount = axis_seen(axis, pose, landmark, mount, measured)
    ours, theirs = (se3.rotation_of(at)[:, axis] for at in (predicted, measured))
    assert np.linalg.norm(e[3:]) == pytest.approx(np.arccos(np.clip(ours @ theirs, -1.0, 1.0)), abs=2e-7)
    assert se3.rotation_of(se3.exp(np.append(np.zeros(3), e[3:]))) @ ours == pytest.approx(theirs, abs=1e-9)
    assert e[:3] == pytest.approx(pose_seen(pose, landmark, mount, measured)[0][:3], abs=1e-12)
    spun = se3.retract(landmark, about * np.eye(6)[3 + axis])
    assert axis_seen(axis, pose, spun, mount, measured)[0] == pytest.approx(e, abs=1e-9)
    assert j_landmark[:, 3 + axis] == pytest.approx(0.0, abs=1e-12)
    assert j_pose == pytest.approx(
        by(lambda at: axis_seen(axis, at, landmark, mount, measured)[0], pose), rel=1e-4, abs=1e-4
    )
    assert j_mount == pytest.approx(
        by(lambda at: axis_seen(axis, pose, landmark, at, measured)[0], mount), rel=1e-4, abs=1e-4
    )
    assert j_landmark == pytest.approx(
        by(lambda at: axis_seen(axis, pose, at, mount, measured)[0], landmark), rel=1e-4, abs=1e-4
    )


def test_an_axis_upside_down_is_half_a_turn_off():
    still = se3.identity()
    e, *slopes = axis_seen(2, still, still, still, se3.exp([0, 0, 0, np.pi, 0, 0]))
    assert np.linalg.norm(e[3:]) == pytest.approx(np.pi)
    assert all(np.isfinite(slope).all() for slope in slopes)


@given(poses, poses, poses, poses)
def test_the_position_of_a_pose_is_a_point(pose, landmark, mount, measured):
    as_pose = pose_seen(pose, landmark, mount, measured)
    as_point = point_seen(pose, landmark[:3], mount, measured[:3])
    for k in (0, 1, 3):
        assert np.array_equal(as_pose[k][:3], as_point[k])
    assert as_pose[2][:3, :3] == pytest.approx(as_point[2] @ se3.rotation_of(landmark), abs=1e-12)
    assert not as_pose[2][:3, 3:].any()


@given(*[PLANE_CASE.poses(st.floats(-3.1, 3.1), 5.0)] * 2, PLANE_CASE.twists(st.floats(-1.0, 1.0), 1.0))
def test_a_planar_drive_has_the_planar_residual_but_for_the_logarithm(pose, increment, residual):
    following = se2.compose(pose, se2.compose(increment, se2.exp(residual)))
    e, j1, j2 = called(kernels.odometry_residual, (pose, following, increment), 3, (3, 3), (3, 3))
    assume(abs(e[2]) < 3.0)
    flat = [0, 1, 5]
    in_space = [np.array([x, y, 0, 0, 0, np.sin(t / 2), np.cos(t / 2)]) for x, y, t in (pose, following, increment)]
    e3, j1_3, j2_3 = odometry(*in_space)
    assert e3[flat] == pytest.approx(se2.log(e), abs=1e-12)
    assert e3[[2, 3, 4]] == pytest.approx(0.0, abs=1e-12)
    # the plane's residual is a pose, whose right perturbation has the rows turned by its heading
    turned = np.eye(3)
    turned[:2, :2] = se2.rotation(e[2])
    for mine, planar in ((j1_3, j1), (j2_3, j2)):
        expected = se2.right_jacobian_inverse(se2.log(e)) @ turned.T @ planar
        assert mine[np.ix_(flat, flat)] == pytest.approx(expected, abs=1e-10)


@given(poses, poses, SPACE_CASE.twists(turns, 5.0))
def test_steps_are_those_of_the_group(a, b, twist):
    (product,), (stepped,) = called(compose, (a, b), 7), called(retract, (a, twist), 7)
    for found, expected in ((product, se3.compose(a, b)), (stepped, se3.retract(a, twist))):
        assert found[:3] == pytest.approx(expected[:3], abs=1e-12)
        # at half a turn the sign is that of rounding
        sign = np.sign(found[3:] @ expected[3:]) if abs(expected[6]) < 1e-15 else 1.0
        assert found[3:] == pytest.approx(sign * expected[3:], abs=1e-15)
    place = a.copy()
    retract(place, twist, place)
    assert np.array_equal(place, stepped)
    place = b.copy()
    compose(a, place, place)
    assert np.array_equal(place, product)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 3))])
def test_gauss_newton_on_these_kernels_ends_at_gtsams_optimum(seed):
    """A closed loop with inconsistent increments, from a start that is off; the first pose is held."""
    rng = np.random.default_rng(seed)
    count = 7
    true = se3.exp(np.concatenate([rng.normal(0, 3, (count, 3)), rng.normal(0, 1, (count, 3))], axis=1))
    edges = [(i, (i + 1) % count) for i in range(count)] + [(0, 3), (2, 5)]
    increments = [se3.retract(se3.between(true[i], true[j]), rng.normal(0, 0.05, 6)) for i, j in edges]
    start = se3.retract(true, rng.normal(0, 0.2, (count, 6)))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for (i, j), increment in zip(edges, increments, strict=True):
        graph.add(gtsam.BetweenFactorPose3(i, j, as_gtsam(increment), gtsam.noiseModel.Unit.Create(6)))
    graph.add(gtsam.NonlinearEqualityPose3(0, as_gtsam(start[0])))
    for i, pose in enumerate(start):
        values.insert(i, as_gtsam(pose))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    found = start.copy()
    for _ in range(20):
        normal, gradient = np.zeros((6 * count, 6 * count)), np.zeros(6 * count)
        for (i, j), increment in zip(edges, increments, strict=True):
            e, *jacobians = odometry(found[i], found[j], increment)
            rows = np.r_[6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
            both = np.hstack(jacobians)
            normal[np.ix_(rows, rows)] += both.T @ both
            gradient[rows] += both.T @ e
        step = np.linalg.solve(normal[6:, 6:], gradient[6:])
        for i in range(1, count):
            retract(found[i], -step[6 * i - 6 : 6 * i], found[i])
    for i in range(count):
        assert SPACE_CASE.matrix(found[i]) == pytest.approx(optimum.atPose3(i).matrix(), abs=1e-8)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_have_one_sign(axis):
    half = np.zeros(7)
    half[3 + axis] = -1.0
    (found,) = called(compose, (se3.identity(), half), 7)
    assert np.array_equal(found, np.abs(half))
    assert np.array_equal(se3.normalise_poses(half), found)
