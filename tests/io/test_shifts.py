"""Maps that are wrong on purpose: the text of `--shift`, and what becomes of the map."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import ConfigError
from evermap.io import Shift, parse_shift, shifted
from evermap.types import ChangeKind, Landmarks, MapChange
from evermap_studies.changes import compare_changes

MAP = Landmarks.at([3, 5, 8, 11], [[0, 0], [2, 0], [2, 2], [-4, 1]], sigma_m=[[0.1, 0.3]] * 4)


@pytest.mark.parametrize(
    ("text", "shift"),
    [
        ("11,12,13:+1.0", Shift((11, 12, 13), (1.0, 0.0))),
        ("11:-1,0.5", Shift((11,), (-1.0, 0.5))),
        (" 3 , 5 : 0 , 0 , -90 ", Shift((3, 5), (0.0, 0.0), -math.pi / 2)),
        ("3:1e-3", Shift((3,), (0.001, 0.0))),
    ],
)
def test_the_text_is_ids_and_one_to_three_numbers(text: str, shift: Shift) -> None:
    assert parse_shift(text) == shift


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("11,12", "has no ':'"),
        (":1.0", "lists no landmark"),
        ("11,:1.0", "'' is not a landmark id"),
        ("eleven:1.0", "'eleven' is not a landmark id"),
        ("11.0:1.0", "'11.0' is not a landmark id"),
        ("11,12,11:1.0", "lists landmark 11 twice"),
        ("11:", "one to three numbers after ':', not 0"),
        ("11:1,2,3,4", "one to three numbers after ':', not 4"),
        ("11:1,", "'' is not a number"),
        ("11:one", "'one' is not a number"),
        ("11:1:2", "'1:2' is not a number"),
        ("11:nan", "'nan' is not finite"),
        ("11:1,inf", "'inf' is not finite"),
        ("11:0,0,20", "rotates a single landmark"),
    ],
)
def test_anything_else_is_one_line(text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_shift(text)
    line = caught.value.one_line()
    assert line.startswith("field 'shift': ")
    assert problem in line
    assert "\n" not in line


def test_only_the_listed_landmarks_move_and_the_given_map_stays_as_it_was() -> None:
    before = MAP.position_m.copy()
    moved = shifted(MAP, [parse_shift("5,11:+1.0,-0.5")])
    np.testing.assert_array_equal(moved.position_m - before, [[0, 0], [1, -0.5], [0, 0], [1, -0.5]])
    np.testing.assert_array_equal(MAP.position_m, before)
    np.testing.assert_array_equal(moved.covariance_m2, MAP.covariance_m2)


def test_a_turn_is_about_the_centroid_and_takes_the_covariance_along() -> None:
    moved = shifted(MAP, [parse_shift("3,5:0,0,90")])
    assert moved.position_m == pytest.approx(np.array([[1, -1], [1, 1], [2, 2], [-4, 1]]), abs=1e-12)
    assert moved.covariance_m2[:2] == pytest.approx(np.array([np.diag([0.09, 0.01])] * 2), abs=1e-12)
    np.testing.assert_array_equal(moved.covariance_m2[2:], MAP.covariance_m2[2:])


def test_shifts_add_up_one_after_the_other() -> None:
    moved = shifted(MAP, [parse_shift("3,5:1"), parse_shift("5,8:0,2")])
    np.testing.assert_array_equal(moved.position_m - MAP.position_m, [[1, 0], [1, 2], [0, 2], [0, 0]])
    assert shifted(MAP, []) is MAP


def test_an_unknown_landmark_is_named_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"'shift': no landmark 4 in the prior map \(try: one of 3, 5, 8, 11\)"):
        shifted(MAP, [parse_shift("3,4:1")])


@given(st.lists(st.sampled_from([3, 5, 8, 11]), min_size=2, unique=True), st.floats(-3, 3), st.floats(-3, 3))
def test_what_an_estimate_should_find_brings_the_map_back(ids: list[int], x: float, turn: float) -> None:
    shift = Shift(tuple(ids), (x, 0.5), turn)
    wrong = shifted(MAP, [shift])
    wanted = shift.undone(first_stamp_s=7.0)
    assert isinstance(wanted, MapChange)
    back = shifted(wrong, [Shift(wanted.landmark_ids, wanted.displacement_m, wanted.rotation_rad)])
    assert back.position_m == pytest.approx(MAP.position_m, abs=1e-12)
    assert math.isnan(wanted.stamp_from_s)
    assert wanted.stamp_to_s == 7.0
    assert wanted.kind is (ChangeKind.ROTATED if turn else ChangeKind.MOVED)
    assert compare_changes([wanted], [wanted]).exact
