"""What a map says is there, counted by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap.geometry import se2
from evermap.metrics.belief import belief_scores
from evermap.types import Landmarks
from evermap_studies.worlds.scores import Existence, existence_score, p_near, stands_at, statement_score

TRUTH = Landmarks.at([1, 2, 3, 5], [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)])
MAP = replace(
    Landmarks.at([1, 2, 3, 4], [(0.2, 0.0), (1.0, 0.3), (2.0, 0.1), (4.0, 0.0)]),
    p_exists=np.array([0.9, 0.9, 0.4, 0.8]),
)
"""1 is right, 2 is too far off, 3 is not believed, 4 is not there; 5 is not known."""


def test_claims_by_hand() -> None:
    score = existence_score(MAP, TRUTH)
    assert (score.n_claims, score.n_right, score.n_there) == (3, 1, 4)
    assert score.precision == pytest.approx(1 / 3)
    assert score.recall == pytest.approx(1 / 4)
    assert score.brier is None
    wider = existence_score(MAP, TRUTH, within_m=0.31, p_least=0.3)
    assert (wider.n_claims, wider.n_right) == (4, 3)


def test_nothing_claimed_and_nothing_there_are_no_numbers() -> None:
    nothing = Landmarks.at([], np.zeros((0, 2)))
    assert existence_score(nothing, TRUTH).precision is None
    assert existence_score(nothing, TRUTH).recall == 0.0
    assert existence_score(MAP, nothing).recall is None
    assert existence_score(MAP, nothing).precision == 0.0


def test_a_map_in_another_frame_is_scored_in_that_of_the_truth() -> None:
    pose = np.array([3.0, -2.0, 0.8])
    elsewhere = replace(MAP, position_m=se2.transform(se2.inverse(pose), MAP.position_m))
    assert existence_score(elsewhere, TRUTH, pose_truth_map=pose) == existence_score(MAP, TRUTH)
    assert existence_score(elsewhere, TRUTH).n_right == 0
    np.testing.assert_array_equal(stands_at(elsewhere, TRUTH, pose), [True, False, True, False])


def test_the_probability_of_a_statement_is_that_of_all_places_nearby() -> None:
    place_id = np.array([1, 1, 1, 2, 9, 5])
    place_m = np.array([(0.1, 0.0), (-0.1, 0.1), (1.0, 0.0), (1.0, 0.0), (0.0, 0.0), (3.0, 1.0)])
    p_here = np.array([0.5, 0.2, 0.3, 0.6, 1.0, 1.0])
    found = p_near(TRUTH, place_id, place_m, p_here)
    np.testing.assert_allclose(found, [0.7, 0.6, 0.0, 0.0])
    now = Landmarks.at([1, 3], [(0.0, 0.0), (2.0, 1.0)])
    score = statement_score(TRUTH, now, place_id, place_m, p_here)
    assert score.brier == pytest.approx(belief_scores(found, [1, 0, 0, 0]).brier)
    assert score.n_statements == 4
    assert score.precision is None


def test_two_nearly_equal_places_are_no_more_than_certain() -> None:
    asked = Landmarks.at([1], [(0.0, 0.0)])
    assert p_near(asked, np.array([1, 1]), np.zeros((2, 2)), np.array([0.8, 0.7])) == 1.0


def test_counts_of_sessions_add_up() -> None:
    score = existence_score(MAP, TRUTH)
    total = score + score + Existence(n_statements=4, squared_error=1.0)
    assert total == Existence(6, 2, 8, 4, 1.0)
    assert total.precision == score.precision
    assert total.brier == 0.25
