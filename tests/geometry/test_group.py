"""The laws of rigid motions, in the plane and in space, and their equality with gtsam and matrix exponentials."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from groups import CASES, HALF, PLANE_CASE, SPACE_CASE, TINY, Case, any_angle, axes, central, short_of_half
from hypothesis import given
from hypothesis import strategies as st

from evermap.geometry import se2, se3
from evermap.geometry.group import accumulate

both = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
data = st.data()
# gtsam takes (1 - cos w) / w literally, which leaves it few digits at tiny angles; scipy covers those
turning = st.floats(1e-3, 3.1)


def assert_same(case: Case, actual: np.ndarray, expected: np.ndarray, atol: float = 1e-9) -> None:
    """Positions to `atol` metres, rotations to 1e-12, as matrices; and the pose in the form that the group promises."""
    matrix, d = case.matrix(actual), case.group.point_dim
    assert matrix[:d, d] == pytest.approx(expected[:d, d], rel=1e-12, abs=atol)
    assert matrix[:d, :d] == pytest.approx(expected[:d, :d], abs=1e-12)
    assert_normalised(case, actual)


def assert_normalised(case: Case, pose: np.ndarray) -> None:
    if case.name == "plane":
        assert -np.pi < pose[2] <= np.pi
    else:
        assert np.linalg.norm(pose[3:]) == pytest.approx(1.0, abs=1e-15)
        assert [x for x in pose[3:] if x != 0.0][-1] > 0.0


@both
@given(data)
def test_products_are_those_of_gtsams_matrices(case, data):
    a, b = data.draw(case.poses()), data.draw(case.poses())
    a_peer, b_peer, g = case.as_peer(a), case.as_peer(b), case.group
    assert_same(case, g.compose(a, b), a_peer.compose(b_peer).matrix())
    assert_same(case, g.inverse(a), a_peer.inverse().matrix())
    assert_same(case, g.between(a, b), a_peer.between(b_peer).matrix())
    assert g.rotation_of(a) == pytest.approx(a_peer.matrix()[:-1, :-1], abs=1e-14)
    point = data.draw(case.points())
    assert g.transform(a, point) == pytest.approx(a_peer.transformFrom(point), rel=1e-12, abs=1e-9)
    order = case.order
    assert g.adjoint(a)[np.ix_(order, order)] == pytest.approx(a_peer.AdjointMap(), rel=1e-12, abs=1e-9)


@both
@given(data)
def test_products_associate_and_the_identity_and_inverses_are_such(case, data):
    a, b, c = (data.draw(case.poses(length=30.0)) for _ in range(3))
    g = case.group
    assert_same(case, g.compose(g.compose(a, b), c), case.matrix(g.compose(a, g.compose(b, c))))
    assert_same(case, g.compose(a, g.inverse(a)), np.eye(g.point_dim + 1))
    assert_same(case, g.compose(a, g.identity()), case.matrix(a))
    assert_same(case, g.compose(a, g.between(a, b)), case.matrix(b))
    point = data.draw(case.points(30.0))
    assert g.transform(g.compose(a, b), point) == pytest.approx(g.transform(a, g.transform(b, point)), abs=1e-11)


@both
@given(data)
def test_exp_is_the_matrix_exponential(case, data):
    twist = data.draw(case.twists())
    expected = scipy.linalg.expm(case.hat(twist))
    pose = case.group.exp(twist)
    assert case.matrix(pose) == pytest.approx(expected, rel=1e-11, abs=1e-9)
    assert_normalised(case, pose)


@both
@given(data)
def test_exp_and_log_are_gtsams(case, data):
    twist = data.draw(case.twists(turning))
    peer = case.peer.Expmap(twist[case.order])
    assert_same(case, case.group.exp(twist), peer.matrix())
    assert case.group.log(case.group.exp(twist))[case.order] == pytest.approx(
        case.peer.Logmap(peer), rel=1e-9, abs=1e-8
    )


@both
@given(data)
def test_log_undoes_exp(case, data):
    twist = data.draw(case.twists())
    assert case.group.log(case.group.exp(twist)) == pytest.approx(twist, rel=1e-9, abs=1e-9)


@both
@given(data)
def test_exp_undoes_log_and_log_takes_the_shorter_way(case, data):
    pose = data.draw(case.poses(st.one_of(any_angle, st.sampled_from(HALF))))
    twist = case.group.log(pose)
    assert_same(case, case.group.exp(twist), case.matrix(pose))
    assert np.linalg.norm(twist[case.group.point_dim :]) <= np.pi * (1 + 1e-15)


@both
@pytest.mark.parametrize("short", [1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14])
def test_log_loses_nothing_near_half_a_turn(case, short):
    axis = np.array([1.0]) if case.name == "plane" else np.array([2.0, -1.0, 2.0]) / 3.0
    twist = np.concatenate([np.arange(1.0, case.group.point_dim + 1), (np.pi - short) * axis])
    assert case.group.log(case.group.exp(twist)) == pytest.approx(twist, abs=1e-14)


@both
@pytest.mark.parametrize("turn", [1e-160, 1e-12, 1e-9, 1e-8, 1e-7, 9.9e-7, 1.1e-6, 1.9e-6, 2.1e-6, 1e-5, 1e-3])
def test_exp_and_log_of_tiny_turns_lose_no_digit(case, turn):
    """Against the power series, whose first terms are exact here."""
    d = case.group.point_dim
    twist = np.zeros(case.group.dim)
    twist[:2], twist[-1] = [1.0, 0.0], turn
    pose = case.group.exp(twist)
    x, y = 1 - turn**2 / 6 + turn**4 / 120, turn / 2 - turn**3 / 24 + turn**5 / 720
    assert pose[:2] == pytest.approx([x, y], rel=1e-15)
    assert pose[d:] == pytest.approx([turn] if d == 2 else [0, 0, np.sin(turn / 2), np.cos(turn / 2)], rel=1e-15)
    assert case.group.log(pose) == pytest.approx(twist, rel=1e-14, abs=1e-15)


@both
@given(data)
def test_local_undoes_retract_and_retract_undoes_local(case, data):
    a, b, twist = (
        data.draw(case.poses(length=30.0)),
        data.draw(case.poses(length=30.0)),
        data.draw(case.twists(length=9)),
    )
    g = case.group
    assert g.local(a, g.retract(a, twist)) == pytest.approx(twist, abs=1e-11)
    assert_same(case, g.retract(a, g.local(a, b)), case.matrix(b))
    assert_same(case, g.retract(a, twist), case.matrix(a) @ scipy.linalg.expm(case.hat(twist)))
    assert_same(case, g.retract(a, np.zeros(g.dim)), case.matrix(a))


@both
@given(data)
def test_adjoint_carries_a_twist_to_the_other_side(case, data):
    a, b, twist = data.draw(case.poses(length=10)), data.draw(case.poses(length=10)), data.draw(case.twists(length=3))
    g = case.group
    assert_same(case, g.retract(a, twist), case.matrix(g.compose(g.exp(g.adjoint(a) @ twist), a)))
    assert g.adjoint(g.compose(a, b)) == pytest.approx(g.adjoint(a) @ g.adjoint(b), abs=1e-11)


@both
@given(data)
def test_bracket_is_the_commutator_and_its_exponential_the_adjoint(case, data):
    a, b = data.draw(case.twists(length=3)), data.draw(case.twists(length=3))
    g = case.group
    commutator = case.hat(a) @ case.hat(b) - case.hat(b) @ case.hat(a)
    assert case.hat(g.bracket(a) @ b) == pytest.approx(commutator, abs=1e-13)
    assert scipy.linalg.expm(g.bracket(a)) == pytest.approx(g.adjoint(g.exp(a)), abs=1e-11)


def integral(matrix: np.ndarray) -> np.ndarray:
    """`int_0^1 expm(s matrix) ds`, as a block of one exponential (Van Loan 1978)."""
    n = len(matrix)
    return scipy.linalg.expm(np.block([[matrix, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


@both
@given(data)
def test_right_jacobian_inverse_is_that_of_the_integral_of_adjoints(case, data):
    """Turns beside 1 rad too, where a series ends; and of more than half a turn."""
    around = st.sampled_from([0.1 - 1e-9, 0.1 + 1e-9, 1 - 1e-9, 1.0, 1 + 1e-9, np.pi, 4.0, 6.0])
    twist = data.draw(case.twists(st.one_of(around, short_of_half), length=10))
    g = case.group
    expected = integral(-g.bracket(twist))
    assert g.right_jacobian_inverse(twist) @ expected == pytest.approx(np.eye(g.dim), abs=1e-10)


@both
@given(data)
def test_right_jacobian_inverse_is_the_derivative_of_log(case, data):
    twist = data.draw(case.twists(length=10))
    g = case.group
    pose = g.exp(twist)
    by_pose = central(lambda d: g.log(g.retract(pose, d)), np.zeros(g.dim), step=1e-5)
    assert g.right_jacobian_inverse(twist) == pytest.approx(by_pose, rel=1e-5, abs=1e-5)


@both
@given(data)
def test_jacobians_are_gtsams(case, data):
    twist = data.draw(case.twists(st.floats(0.03, 3.1), length=10))  # gtsam's lose digits with the square of the turn
    at = np.ix_(case.order, case.order)
    mine = twist[case.order]
    by_log = case.peer.LogmapDerivative(case.peer.Expmap(mine))
    assert case.group.right_jacobian_inverse(twist)[at] == pytest.approx(by_log, abs=1e-7)


@both
@given(data)
def test_normalised_poses_are_the_same_motions_in_one_form(case, data):
    pose = data.draw(case.poses())
    found = case.group.normalise_poses(pose)
    assert_same(case, found, case.matrix(pose))
    assert case.group.normalise_poses(found) == pytest.approx(found, abs=3e-16)
    if case.name == "space":
        other = case.group.normalise_poses([*pose[:3], *(-3.0 * pose[3:])])
        assert other == pytest.approx(found, abs=3e-16)


@both
@given(data)
def test_rigid_directions_are_derivatives_of_points_that_move_together(case, data):
    g = case.group
    points = np.array([data.draw(case.points(50.0)) for _ in range(4)])
    moved = central(lambda xi: g.transform(g.exp(xi), points).ravel(), np.zeros(g.dim))
    assert g.rigid_directions(points) == pytest.approx(moved, rel=1e-8, abs=1e-7)


@both
def test_functions_broadcast_over_leading_axes(case):
    g, rng = case.group, np.random.default_rng(0)
    twist = rng.normal(size=(5, g.dim))
    a, b = g.exp(rng.normal(size=(4, 1, g.dim))), g.exp(twist)
    for function in (g.compose, g.between, g.local):
        all_pairs = function(a, b)
        assert all_pairs.shape[:2] == (4, 5)
        rows = [[function(a[i, 0], b[j]) for j in range(5)] for i in range(4)]
        np.testing.assert_array_equal(all_pairs, rows)
    for function in (g.inverse, g.log, g.adjoint, g.rotation_of, g.normalise_poses):
        np.testing.assert_array_equal(function(b), [function(row) for row in b])
    for function in (g.exp, g.bracket, g.right_jacobian_inverse):
        np.testing.assert_allclose(function(twist), [function(row) for row in twist], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(g.retract(a, twist), g.compose(a, g.exp(twist)))
    points = rng.normal(size=(5, g.point_dim))
    rows = [g.transform(row, point) for row, point in zip(b, points, strict=True)]
    np.testing.assert_array_equal(g.transform(b, points), rows)
    assert g.transform(a, points).shape == (4, 5, g.point_dim)
    assert g.identity(2, 3).shape == (2, 3, g.size)
    assert g.identity().shape == (g.size,)
    assert g.compose(np.zeros((0, g.size)), b[:1]).shape == (0, g.size)


def in_space(pose: np.ndarray) -> np.ndarray:
    """A planar pose as one of space."""
    return np.array([pose[0], pose[1], 0.0, 0.0, 0.0, np.sin(pose[2] / 2), np.cos(pose[2] / 2)])


FLAT = [0, 1, 5]
"""Rows of a twist in space that are those of a planar one."""


@both
@pytest.mark.parametrize("count", [0, 1, 2, 3, 15, 16, 17, 1000])
def test_motions_accumulate_to_their_products(case, count):
    group, rng = case.group, np.random.default_rng(count)
    motion = group.exp(rng.normal(size=(count, group.dim)))
    expected = group.identity(count + 1)
    for k in range(count):
        expected[k + 1] = group.compose(expected[k], motion[k])
    found = accumulate(motion)
    assert found.shape == expected.shape
    for one, other in zip(found, expected, strict=True):
        assert_same(case, one, case.matrix(other))


@given(PLANE_CASE.poses(), PLANE_CASE.poses(), PLANE_CASE.twists())
def test_the_plane_lies_in_space(a, b, twist):
    lifted = np.zeros(6)
    lifted[FLAT] = twist
    for actual, expected in (
        (se3.compose(in_space(a), in_space(b)), se2.compose(a, b)),
        (se3.between(in_space(a), in_space(b)), se2.between(a, b)),
        (se3.inverse(in_space(a)), se2.inverse(a)),
        (se3.exp(lifted), se2.exp(twist)),
    ):
        assert_same(SPACE_CASE, actual, SPACE_CASE.matrix(in_space(expected)))
    at = np.ix_(FLAT, FLAT)
    assert se3.adjoint(in_space(a))[at] == pytest.approx(se2.adjoint(a), rel=1e-12, abs=1e-9)
    assert se3.right_jacobian_inverse(lifted)[at] == pytest.approx(
        se2.right_jacobian_inverse(twist), rel=1e-12, abs=1e-9
    )
    assert se3.log(se3.exp(lifted))[FLAT] == pytest.approx(twist, rel=1e-9, abs=1e-9)


@given(axes)
def test_a_half_turn_is_the_same_about_an_axis_and_its_opposite(axis):
    one, other = se3.exp([0, 0, 0, *(np.pi * axis)]), se3.exp([0, 0, 0, *(-np.pi * axis)])
    assert se3.rotation_of(one) == pytest.approx(se3.rotation_of(other), abs=4e-15)
    assert se3.rotation_of(one) == pytest.approx(2 * np.outer(axis, axis) - np.eye(3), abs=4e-15)


@pytest.mark.parametrize("angle", TINY)
def test_neither_tiny_nor_denormal_turns_make_a_warning(angle):
    for axis in np.eye(3):
        twist = np.array([1.0, 2.0, 3.0, *(angle * axis)])
        with np.errstate(all="raise", under="ignore"):
            assert se3.log(se3.exp(twist)) == pytest.approx(twist, rel=1e-15, abs=1e-300)


def test_an_angle_that_is_rounded_to_the_open_end_is_at_the_closed_one():
    turn = 0.0013888888917217457
    there = se2.compose([0.0, 0.0, turn], [0.0, 0.0, -np.pi])
    back = se2.compose([0.0, 0.0, -turn], there)
    assert -np.pi < back[2] <= np.pi
    assert abs(se2.wrap(np.nextafter(-np.pi, -4.0))) <= np.pi
