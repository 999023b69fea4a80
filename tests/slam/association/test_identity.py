"""Landmarks under their own numbers, compared with the recording's."""

from __future__ import annotations

import numpy as np
import pytest
from identity_scores import identity_scores

from evermap.types import UNKNOWN


def test_one_landmark_split_and_two_in_one() -> None:
    true = np.array([5, 5, 5, 5, 6, 6, 7, 7])
    found = np.array([1, 1, 1, 2, 3, 3, 3, UNKNOWN])
    scores = identity_scores(found, true)
    assert scores.purity == pytest.approx(6 / 7)
    assert scores.completeness == pytest.approx((3 + 2 + 1) / 8)
    assert (scores.n_landmarks, scores.n_identities) == (3, 3)


def test_other_numbers_are_as_good() -> None:
    true = np.repeat([3, 9, 4], 5)
    scores = identity_scores(100 - true, true)
    assert (scores.purity, scores.completeness) == (1.0, 1.0)


def test_nothing_given() -> None:
    assert identity_scores(np.full(3, UNKNOWN), np.full(3, UNKNOWN)).n_landmarks == 0
