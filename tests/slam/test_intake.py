"""Input of the estimator: what detections say together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evermap import run_slam
from evermap.slam.intake import most_of
from evermap.types import UNKNOWN
from evermap_studies.sim import BuildingConfig, simulate_building


@pytest.mark.parametrize("seed", range(5))
def test_the_class_of_a_place_is_that_of_most_detections(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place, class_id = rng.integers(UNKNOWN, 9, 40), rng.integers(UNKNOWN, 4, 40)
    found = most_of(place, class_id, 10)
    for row in range(10):
        own = class_id[(place == row) & (class_id != UNKNOWN)]
        assert found[row] == (np.argmax(np.bincount(own)) if len(own) else UNKNOWN)


def test_places_without_classes_are_of_none() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    assert most_of(nothing, nothing, 3).tolist() == [UNKNOWN] * 3
    assert most_of(np.zeros(2, dtype=np.int64), np.full(2, UNKNOWN), 1).tolist() == [UNKNOWN]
    assert most_of(np.full(2, UNKNOWN), np.zeros(2, dtype=np.int64), 0).tolist() == []  # boxes of no stay


def test_a_class_that_was_misread_at_last_is_not_the_landmarks() -> None:
    recording = simulate_building(BuildingConfig(days=1, patrol_s=30.0), seed=1).sessions[0]
    landmark_id = recording.detections.landmark_id
    names, count = np.unique(landmark_id[landmark_id != UNKNOWN], return_counts=True)
    misread = names[count > 5]
    class_id = np.where(landmark_id == UNKNOWN, UNKNOWN, landmark_id % 2)
    for name, wrong in zip(misread.tolist(), (UNKNOWN, 2) * len(misread), strict=False):
        class_id[np.flatnonzero(landmark_id == name)[-1]] = wrong
    detections = replace(recording.detections, class_id=class_id)
    found = run_slam(replace(recording, detections=detections, class_names=("one", "two", "three"))).landmarks
    assert np.isin(misread, found.landmark_id).sum() > 3
    np.testing.assert_array_equal(found.class_id, found.landmark_id % 2)
