"""Looks left out at the border of the sensor's field, against the thesis' three conditions said clique by clique."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evermap.errors import ConfigError, InputError
from evermap_studies.bateman2020.clique_range import nearest_per_clique, range_degraded_miss
from evermap_studies.bateman2020.suppression import suppressed

LIMITS = {"observed_m": 6.0, "range_max_m": 16.0, "share": 0.25}


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 25),
    nearest=st.sampled_from([3.0, 6.0, 15.0]),
    hits=st.sampled_from([0.1, 0.3]),
)
def test_the_three_conditions(seed: int, count: int, nearest: float, hits: float) -> None:
    rng = np.random.default_rng(seed)
    clique = rng.integers(0, 4, count)
    range_m = rng.integers(int(nearest), 18, count).astype(float)  # whole metres: limits are hit exactly
    detected, expected = rng.random(count) < hits, rng.random(count) < 0.7
    found = suppressed(range_m, detected, expected, clique, 4, **LIMITS)
    for c in range(4):
        members = [k for k in range(count) if clique[k] == c]
        asked = [k for k in members if expected[k]]
        far = all(range_m[k] > 6.0 for k in members)
        near_enough = any(range_m[k] < 16.0 for k in members)
        few = bool(asked) and sum(detected[k] for k in asked) / len(asked) < 0.25
        assert found[c] == (far and near_enough and few)


def test_detections_that_were_not_expected_do_not_count() -> None:
    range_m, clique = np.full(4, 10.0), np.zeros(4, dtype=np.int64)
    detected = np.array([True, True, False, False])
    assert not suppressed(range_m, detected, np.ones(4, np.bool_), clique, 1, **LIMITS)[0]
    assert suppressed(range_m, detected, ~detected, clique, 1, **LIMITS)[0]


def test_nothing_is_left_out_at_a_share_of_zero() -> None:
    nothing, clique = np.zeros(3, np.bool_), np.zeros(3, dtype=np.int64)
    assert not suppressed(np.full(3, 10.0), nothing, ~nothing, clique, 1, **{**LIMITS, "share": 0.0})[0]


@given(ranges=st.lists(st.tuples(st.floats(0.0, 50.0), st.integers(0, 3)), max_size=20))
def test_the_nearest_landmark(ranges: list[tuple[float, int]]) -> None:
    range_m = np.array([r for r, _ in ranges])
    clique = np.array([c for _, c in ranges], dtype=np.int64)
    expected = [min((r for r, c in ranges if c == wanted), default=math.inf) for wanted in range(4)]
    np.testing.assert_array_equal(nearest_per_clique(range_m, clique, 4), expected)


def test_the_miss_rate_grows_with_range_within_its_bounds() -> None:
    assert range_degraded_miss(9.0, 9.0) == pytest.approx(1.0 - math.exp(-1.0), rel=1e-15)
    assert range_degraded_miss(1e-12, 10.0) == pytest.approx(1e-13, rel=1e-12, abs=0.0)
    bounded = range_degraded_miss([0.0, 5.0, np.inf], 9.0, least=0.4, most=0.98)
    np.testing.assert_allclose(bounded, [0.4, 1.0 - math.exp(-5.0 / 9.0), 0.98], rtol=1e-15)


GOOD: dict[str, Any] = {
    "range_m": np.array([8.0, 9.0]),
    "detected": np.array([True, False]),
    "expected": np.array([True, True]),
    "clique": np.array([0, 1]),
    "n_cliques": 2,
    **LIMITS,
}
BAD = {
    "share": ({"share": 1.2}, ConfigError, r"field 'share': must lie in \[0, 1\], not 1.2"),
    "observed": ({"observed_m": math.nan}, ConfigError, "field 'observed_m': must be positive, not nan"),
    "most": ({"range_max_m": 0.0}, ConfigError, "field 'range_max_m': must be positive, not 0.0"),
    "clique": ({"n_cliques": 1}, InputError, "field 'clique': row 1: clique 1 of 1 does not exist"),
    "range": ({"range_m": np.array([8.0, -1.0])}, InputError, "field 'range_m': row 1: -1.0 m is no distance"),
    "nan": ({"range_m": np.array([8.0, np.nan])}, InputError, "field 'range_m': row 1: nan m is no distance"),
    "length": ({"range_m": np.ones(3)}, InputError, r"field 'clique': shape \(2,\) for ranges of shape \(3,\)"),
    "detected": ({"detected": np.ones(2)}, InputError, r"field 'detected': float64 of shape \(2,\), not bool"),
    "expected": ({"expected": np.ones(3, np.bool_)}, InputError, r"field 'expected': bool of shape \(3,\), not bool"),
}


@pytest.mark.parametrize(("change", "kind", "words"), BAD.values(), ids=BAD)
def test_bad_input_is_named(change: dict[str, Any], kind: type[Exception], words: str) -> None:
    with pytest.raises(kind, match=words):
        suppressed(**{**GOOD, **change})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"length_m": 0.0}, "field 'length_m': must be positive and finite"),
        ({"least": 0.9, "most": 0.4}, "field 'least': 0.9 and 0.4 are no probabilities in order"),
    ],
)
def test_bad_miss_rates_are_named(change: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        range_degraded_miss(**{"nearest_m": 5.0, "length_m": 9.0, **change})
