"""GOSPA against its definition, by brute force over all assignments."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from evermap_score.episodes import FloatArray
from evermap_score.gospa import gospa

from .worlds import table, values


def by_definition(x: FloatArray, y: FloatArray, c: float) -> float:
    """Definition 1 of the paper, the smaller set first, with p = alpha = 2."""
    if len(x) > len(y):
        x, y = y, x
    least = min(
        sum(min(float(np.linalg.norm(x[i] - y[j])), c) ** 2 for i, j in enumerate(chosen))
        for chosen in itertools.permutations(range(len(y)), len(x))
    )
    return math.sqrt(least + c**2 / 2 * (len(y) - len(x)))


@pytest.mark.parametrize("seed", range(12))
def test_it_is_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(0, 2, (int(rng.integers(0, 5)), 2 + seed % 2)) for _ in range(2))
    total, *parts = gospa(x, y, 0.8)
    assert total == pytest.approx(by_definition(x, y, 0.8))
    assert total**2 == pytest.approx(sum(parts))


def test_its_parts_by_hand() -> None:
    # one pair .3 m apart, one missed (farther than 1 m), two false: .09 + 1 / 2 + 2 / 2
    total, localisation, missed, false = gospa(
        np.array([[0.0, 0.0], [5.0, 5.0]]), np.array([[0.3, 0.0], [8.0, 0.0], [0.0, 9.0]])
    )
    assert (localisation, missed, false) == pytest.approx((0.09, 0.5, 1.0))
    assert total == pytest.approx(math.sqrt(1.59))


def test_over_a_world_it_is_the_root_of_the_mean_square() -> None:
    # truth: a always, b until 10. Instants 9 and 11. Estimate: a .2 m off, b never ends.
    truth = table(("a", None, None, 0, 0), ("b", None, 10, 5, 0))
    found = values(truth, table(("a", None, None, 0.2, 0), ("b", None, None, 5, 0)))
    assert found["gospa/localisation"] == pytest.approx(0.04)
    assert found["gospa/missed"] == 0.0
    assert found["gospa/false"] == pytest.approx(0.25)  # at one of two instants one false: 1 / 2
    assert found["gospa/total"] == pytest.approx(math.sqrt(0.29))
