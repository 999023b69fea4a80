"""Sessions in other orders: a difference is found where there is one, and there is none."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from benchmarks.orders import ANONYMOUS, compare, differences, orders_of, sessions_of


@pytest.mark.slow
@pytest.mark.parametrize("anonymous", [False, True], ids=["named", "half of them anonymous"])
def test_a_map_tells_the_same_in_other_orders(anonymous: bool) -> None:
    config = ANONYMOUS if anonymous else None
    found = compare(sessions_of(4, 35.0, 3, anonymous=anonymous), [(1, 3, 0, 2), (3, 2, 1, 0)], config)
    assert (found["orders"], found["differing"]) == (2, {})
    assert found["changes"] > 5
    assert found["landmarks"] > 30
    assert found["refused"] == 0


def test_what_differs_is_named() -> None:
    told = {("told by", 5.0): [("moved", ["3"], [0.5, np.nan])], ("called", 0.0): ["3", "chair 12"]}
    nearly = {("told by", 5.0): [("moved", ["3"], [0.5 + 5e-7, np.nan])], ("called", 0.0): ["3", "chair 12"]}
    assert differences(told, nearly) == []
    less = {("told by", 5.0): [("moved", ["3"], [0.5 + 5e-6, np.nan])], ("called", 0.0): ["3", "chair 13"]}
    assert differences(told, less) == ["('called', 0.0)", "('told by', 5.0)"]
    assert differences({}, told) == ["('called', 0.0)", "('told by', 5.0)"]


def test_orders_are_drawn_without_repetition() -> None:
    assert orders_of(3, 6) == list(permutations(range(3)))
    drawn = orders_of(5, 40, seed=1)
    assert len(set(drawn)) == 40
    assert drawn == orders_of(5, 40, seed=1)
    assert all(sorted(order) == [0, 1, 2, 3, 4] for order in drawn)
