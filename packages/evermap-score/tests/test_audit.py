"""Audit of the key: rows that every estimate contradicts."""

from __future__ import annotations

import math

import pytest

from evermap_score import score

from .worlds import looks_at, table

STILL = (("s", None, None, 5, 5), ("t", None, None, 2, 8), ("u", None, None, 8, 2), ("v", None, None, -3, 2))
"""What is right in all, and keeps the frame."""
TRUTH = table(*STILL, ("a", None, None, 0, 0), ("b", None, None, 5, 0), ("c", None, 15, 0, 5), ("d", None, None, 9, 9))
ONE = table(
    *STILL, ("a", None, None, 0.9, 0), ("b", None, None, 5, 0), ("c", None, None, 0, 5), ("d", None, None, 9, 9)
)
TWO = table(*STILL, ("a", None, None, 0.8, 0), ("b", None, None, 6, 0), ("c", None, None, 0, 5))


def test_only_what_all_contradict_is_listed() -> None:
    # a is elsewhere in both; b and d in one only; c is where the key has it, if longer
    found = score(TRUTH, {"one": ONE, "two": TWO}, draws=0).contradictions
    assert [(each.row, each.landmark_id) for each in found] == [(4, "a")]
    # a and b pull at the frame by less than a tenth of a metre
    assert found[0].distance_m == pytest.approx({"one": 0.9, "two": 0.8}, abs=0.1)


def test_what_no_estimate_has_is_listed_unless_it_was_never_looked_at() -> None:
    assert [each.landmark_id for each in score(TRUTH, TWO, draws=0).contradictions] == ["a", "b", "d"]
    assert score(TRUTH, TWO, draws=0).contradictions[2].distance_m["estimate"] == math.inf
    looks = looks_at([5.0, 20.0], {"a": [1.0], "b": [1.0], "c": [1.0]})
    assert [each.landmark_id for each in score(TRUTH, TWO, looks=looks, draws=0).contradictions] == ["a", "b"]


def test_by_place_anything_near_agrees() -> None:
    estimate = table(*STILL, ("x", None, None, 0.1, 0), ("y", None, None, 5, 0), ("z", None, None, 0, 5))
    found = score(TRUTH, estimate, match="place", draws=0).contradictions
    assert [each.landmark_id for each in found] == ["d"]


def test_rows_that_hold_at_no_instant_contradict_nothing() -> None:
    truth = table(("a", None, 6, 0, 0), ("a", 6, 7, 3, 3), ("a", 7, None, 0, 0))
    looks = looks_at([5.0, 20.0], {"a": [1.0]})
    assert score(truth, table(("a", None, None, 0, 0)), looks=looks, draws=0).contradictions == ()
