"""What is no table of lifetimes is refused, with row and field."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evermap.errors import DataError
from evermap.survival.censored import CensoredLifetimes, lifetimes_of_sightings

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"left_s": [1, 3], "right_s": [2, 2]}, "right_s.*before its left_s.*row 1"),
        ({"left_s": [1, -1], "right_s": [2, 2]}, "left_s.*row 1"),
        ({"left_s": [INF], "right_s": [INF]}, "left_s.*finite.*row 0"),
        ({"left_s": [NAN], "right_s": [2]}, "left_s.*nan, row 0"),
        ({"left_s": [1], "right_s": [NAN]}, "right_s.*nan, row 0"),
        ({"left_s": [0], "right_s": [0]}, "right_s.*positive.*row 0"),
        ({"left_s": [1, 2], "right_s": [1, 2], "entry_s": [0.5, 2]}, "entry_s.*at or after its right_s.*row 1"),
        ({"left_s": [1], "right_s": [2], "entry_s": [-1]}, "entry_s.*row 0"),
        ({"left_s": [1], "right_s": [2], "entry_s": [NAN]}, "entry_s.*row 0"),
        ({"left_s": [1, 2], "right_s": [1, 2], "weight": [1, -1]}, "weight.*row 1"),
        ({"left_s": [1, 2], "right_s": [1, 2], "weight": [1, INF]}, "weight.*row 1"),
        ({"left_s": [1, 2], "right_s": [1, 2], "weight": [0, 0]}, "weight.*all weights are 0"),
        ({"left_s": [1, 2], "right_s": [1]}, "right_s.*as long as"),
        ({"left_s": [1, 2], "right_s": [1, 2], "weight": [1, 2, 3]}, "weight.*as long as"),
        ({"left_s": [[1, 2]], "right_s": [[1, 2]]}, "left_s.*one dimension"),
        ({"left_s": [], "right_s": []}, "no lifetimes"),
    ],
)
def test_mistakes(columns: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        CensoredLifetimes.of(**columns)


def test_defaults_and_kinds() -> None:
    data = CensoredLifetimes.of([1, 0, 2, 3], [1, 2, INF, 4])
    np.testing.assert_array_equal(data.exact, [True, False, False, False])
    np.testing.assert_array_equal(data.entry_s, np.zeros(4))
    np.testing.assert_array_equal(data.weight, np.ones(4))


def test_a_stay_began_at_any_instant_since_the_look_before_it() -> None:
    """Two instants of arrival each, in the middle of halves; what was there at the first look is left out."""
    samples, stay = lifetimes_of_sightings(
        [90.0, -np.inf, 200.0, 300.0], [100.0, 0.0, 208.0, 304.0],
        [150.0, 50.0, 240.0, 305.0], [180.0, 60.0, np.inf, 310.0],
        instants=2, least_stay_s=10.0,
    )  # fmt: skip
    np.testing.assert_array_equal(stay, [0, 0, 2, 2])
    arrival = np.array([92.5, 97.5, 202.0, 206.0])
    np.testing.assert_allclose(samples.left_s, np.array([150.0, 150.0, 240.0, 240.0]) - arrival)
    np.testing.assert_allclose(samples.right_s, np.array([180.0, 180.0, np.inf, np.inf]) - arrival)
    np.testing.assert_allclose(samples.entry_s, np.array([110.0, 110.0, 218.0, 218.0]) - arrival)
    np.testing.assert_array_equal(samples.weight, 0.5)
