"""Input of the estimator: what detections say together."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.slam.intake import most_of
from evermap.types import UNKNOWN


@pytest.mark.parametrize("seed", range(5))
def test_the_class_of_a_place_is_that_of_most_detections(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place, class_id = rng.integers(0, 9, 40), rng.integers(UNKNOWN, 4, 40)
    found = most_of(place, class_id, 10)
    for row in range(10):
        own = class_id[(place == row) & (class_id != UNKNOWN)]
        assert found[row] == (np.argmax(np.bincount(own)) if len(own) else UNKNOWN)


def test_places_without_classes_are_of_none() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    assert most_of(nothing, nothing, 3).tolist() == [UNKNOWN] * 3
    assert most_of(np.zeros(2, dtype=np.int64), np.full(2, UNKNOWN), 1).tolist() == [UNKNOWN]
