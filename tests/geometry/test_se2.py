"""What the plane has and space has not: angles. Its motions are tested with those of space, in `test_group.py`."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from groups import any_angle as angles
from hypothesis import given
from hypothesis import strategies as st

from evermap.geometry import se2


@given(angles)
def test_wrap_keeps_the_direction_and_the_half_open_interval(angle: float) -> None:
    wrapped = float(se2.wrap(angle))
    assert -np.pi < wrapped <= np.pi
    turns = (angle - wrapped) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-12)


@given(angles)
def test_rotation_is_gtsams(angle: float) -> None:
    assert se2.rotation(angle) == pytest.approx(gtsam.Rot2(angle).matrix(), abs=1e-14)


def test_rotations_broadcast() -> None:
    angle = np.random.default_rng(0).normal(size=5)
    np.testing.assert_array_equal(se2.rotation(angle), [se2.rotation(one) for one in angle])


@given(st.floats(-np.pi, np.pi), st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array))
def test_what_moves_together_keeps_its_shape_and_can_be_moved_back(turn: float, displacement: np.ndarray) -> None:
    point = np.random.default_rng(3).normal(size=(4, 2))
    moved = se2.move_together(point, displacement, turn)
    assert moved.mean(axis=0) - point.mean(axis=0) == pytest.approx(displacement, abs=1e-12)
    sides, before = moved[1:] - moved[0], point[1:] - point[0]
    as_complex = (sides @ [1, 1j]) / (before @ [1, 1j])
    assert as_complex == pytest.approx(np.full(3, np.exp(1j * turn)), abs=1e-9)
    assert se2.move_together(moved, -displacement, -turn) == pytest.approx(point, abs=1e-12)
