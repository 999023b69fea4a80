"""Planar motions against gtsam's Pose2 and scipy's matrix exponential."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from evermap.geometry import se2

# the places where planar motions go wrong: no turn, hardly any turn, half a turn, just short of it and just beyond
DELICATE = [0.0, -0.0, *(s * d for s in (1, -1) for d in (5e-324, 1e-300, 1e-16, 1e-9, 9.9e-7, 1.1e-6, 2e-6, 1e-4))]
DELICATE += [s * (np.pi + d) for s in (1, -1) for d in (0.0, 1e-15, -1e-15, 1e-9, -1e-9, 1e-6, -1e-6)]

lengths = st.floats(-1e3, 1e3)
angles = st.one_of(st.sampled_from(DELICATE), st.floats(-np.pi, np.pi), st.floats(-50.0, 50.0))
poses = st.tuples(lengths, lengths, angles).map(np.array)
# half a turn, where the log jumps, has a test of its own
twists = st.tuples(lengths, lengths, st.one_of(st.sampled_from(DELICATE[:18]), st.floats(-3.1, 3.1))).map(np.array)
# gtsam takes (1 - cos w) / w literally, which leaves it few digits at tiny angles; scipy covers those
turning = twists.filter(lambda twist: abs(twist[2]) > 1e-3)


def as_gtsam(pose: np.ndarray) -> gtsam.Pose2:
    return gtsam.Pose2(*pose)


def as_matrix(pose: np.ndarray) -> np.ndarray:
    return as_gtsam(pose).matrix()


def hat(twist: np.ndarray) -> np.ndarray:
    forward, left, turn = twist
    return np.array([[0.0, -turn, forward], [turn, 0.0, left], [0.0, 0.0, 0.0]])


def assert_same_pose(actual: np.ndarray, expected: gtsam.Pose2, atol: float = 1e-9) -> None:
    """Positions to `atol` metres; headings compared on the circle."""
    assert actual[:2] == pytest.approx(expected.translation(), rel=1e-12, abs=atol)
    assert np.cos(actual[2]) == pytest.approx(np.cos(expected.theta()), abs=1e-12)
    assert np.sin(actual[2]) == pytest.approx(np.sin(expected.theta()), abs=1e-12)
    assert -np.pi < actual[2] <= np.pi


@given(poses, poses)
def test_compose_is_gtsams(a: np.ndarray, b: np.ndarray) -> None:
    assert_same_pose(se2.compose(a, b), as_gtsam(a).compose(as_gtsam(b)))


@given(poses)
def test_inverse_is_gtsams(a: np.ndarray) -> None:
    assert_same_pose(se2.inverse(a), as_gtsam(a).inverse())


@given(poses, poses)
def test_between_is_gtsams(a: np.ndarray, b: np.ndarray) -> None:
    assert_same_pose(se2.between(a, b), as_gtsam(a).between(as_gtsam(b)))


@given(poses, lengths, lengths)
def test_transform_is_gtsams(a: np.ndarray, x: float, y: float) -> None:
    expected = as_gtsam(a).transformFrom(np.array([x, y]))
    assert se2.transform(a, [x, y]) == pytest.approx(expected, rel=1e-12, abs=1e-9)


@given(twists)
def test_exp_is_the_matrix_exponential(twist: np.ndarray) -> None:
    matrix = as_matrix(se2.exp(twist))
    assert matrix == pytest.approx(scipy.linalg.expm(hat(twist)), rel=1e-11, abs=1e-9)


@given(turning)
def test_exp_is_gtsams(twist: np.ndarray) -> None:
    assert_same_pose(se2.exp(twist), gtsam.Pose2.Expmap(twist))


@given(twists)
def test_log_undoes_exp(twist: np.ndarray) -> None:
    assert se2.log(se2.exp(twist)) == pytest.approx(twist, rel=1e-9, abs=1e-9)


@given(turning)
def test_log_is_gtsams(twist: np.ndarray) -> None:
    pose = se2.exp(twist)
    assert se2.log(pose) == pytest.approx(gtsam.Pose2.Logmap(as_gtsam(pose)), rel=1e-9, abs=1e-8)


@given(lengths, lengths, st.sampled_from(DELICATE[18:]))
def test_log_at_half_a_turn(x: float, y: float, angle: float) -> None:
    pose = np.array([x, y, se2.wrap(angle)])
    assert_same_pose(se2.exp(se2.log(pose)), as_gtsam(pose), atol=1e-9)


@pytest.mark.parametrize("turn", [1e-12, 1e-9, 1e-7, 9.9e-7, 1.1e-6, 1.9e-6, 2.1e-6, 1e-5, 1e-3])
def test_exp_and_log_of_tiny_turns_lose_no_digit(turn: float) -> None:
    """Against the power series, whose first three terms are exact here."""
    x = 1 - turn**2 / 6 + turn**4 / 120
    y = turn / 2 - turn**3 / 24 + turn**5 / 720
    assert se2.exp([1.0, 0.0, turn]) == pytest.approx([x, y, turn], rel=1e-15)
    assert se2.log([x, y, turn]) == pytest.approx([1.0, 0.0, turn], rel=1e-14, abs=1e-15)


@given(poses)
def test_adjoint_is_gtsams(a: np.ndarray) -> None:
    assert se2.adjoint(a) == pytest.approx(as_gtsam(a).AdjointMap(), rel=1e-12, abs=1e-9)


@given(st.tuples(st.floats(-10, 10), st.floats(-10, 10), angles).map(np.array), twists)
def test_adjoint_carries_a_twist_to_the_other_side(a: np.ndarray, twist: np.ndarray) -> None:
    right = se2.compose(a, se2.exp(twist / 100))
    left = se2.compose(se2.exp(se2.adjoint(a) @ twist / 100), a)
    assert right[:2] == pytest.approx(left[:2], abs=1e-9)
    assert se2.wrap(right[2] - left[2]) == pytest.approx(0.0, abs=1e-12)


@given(angles)
def test_wrap_keeps_the_direction_and_the_half_open_interval(angle: float) -> None:
    wrapped = float(se2.wrap(angle))
    assert -np.pi < wrapped <= np.pi
    turns = (angle - wrapped) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-12)


@given(angles)
def test_rotation_is_gtsams(angle: float) -> None:
    assert se2.rotation(angle) == pytest.approx(gtsam.Rot2(angle).matrix(), abs=1e-14)


def test_functions_broadcast_over_leading_axes() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(4, 1, 3)), rng.normal(size=(5, 3))
    for function in (se2.compose, se2.between):
        both = function(a, b)
        assert both.shape == (4, 5, 3)
        rows = [[function(a[i, 0], b[j]) for j in range(5)] for i in range(4)]
        np.testing.assert_array_equal(both, rows)
    for function in (se2.inverse, se2.exp, se2.log, se2.adjoint):
        np.testing.assert_array_equal(function(b), [function(row) for row in b])
    points = rng.normal(size=(5, 2))
    np.testing.assert_array_equal(
        se2.transform(b, points), [se2.transform(row, point) for row, point in zip(b, points, strict=True)]
    )
    np.testing.assert_array_equal(se2.rotation(b[:, 2]), [se2.rotation(angle) for angle in b[:, 2]])


@given(st.floats(-np.pi, np.pi), st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array))
def test_what_moves_together_keeps_its_shape_and_can_be_moved_back(turn: float, displacement: np.ndarray) -> None:
    point = np.random.default_rng(3).normal(size=(4, 2))
    moved = se2.move_together(point, displacement, turn)
    assert moved.mean(axis=0) - point.mean(axis=0) == pytest.approx(displacement, abs=1e-12)
    sides, before = moved[1:] - moved[0], point[1:] - point[0]
    as_complex = (sides @ [1, 1j]) / (before @ [1, 1j])
    assert as_complex == pytest.approx(np.full(3, np.exp(1j * turn)), abs=1e-9)
    assert se2.move_together(moved, -displacement, -turn) == pytest.approx(point, abs=1e-12)
