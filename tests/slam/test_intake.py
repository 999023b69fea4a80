"""Input of the estimator: what detections say together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from evermap import run_slam
from evermap.slam.intake import most_of, prepare, prepare_alike
from evermap.types import UNKNOWN, Measurements, Recording
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


def patrol() -> Recording:
    return simulate_building(BuildingConfig(days=1, patrol_s=30.0), seed=1).sessions[0]


def with_frames_later(given: Recording, by_s: float) -> Recording:
    return replace(given, frames=replace(given.frames, stamp_s=given.frames.stamp_s + by_s))


ALIKE: dict[str, Callable[[Recording], Recording]] = {
    "late frames": lambda given: with_frames_later(given, 1e-3),
    "faster odometry": lambda given: replace(
        given, odometry=replace(given.odometry, forward_mps=1.1 * given.odometry.forward_mps)
    ),
    "odometry that begins earlier": lambda given: replace(
        given, odometry=replace(given.odometry, stamp_s=given.odometry.stamp_s - 1e-3)
    ),
    "longer ranges": lambda given: replace(
        given,
        detections=replace(
            given.detections, range_m=1.1 * given.detections.range_m, sigma_range_m=np.full(len(given.detections), 0.2)
        ),
    ),
    "another mount": lambda given: replace(
        given, sensor=replace(given.sensor, mount_robot_sensor=(0.1, 0.2, 0.3))
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ALIKE)
def test_a_recording_like_another_is_prepared_from_that(name: str) -> None:
    given = patrol()
    given = replace(given, frames=given.frames[(given.frames.stamp_s < given.odometry.stamp_s[-1] - 0.01)])
    kept = given.detections.frame < len(given.frames)
    given = replace(given, detections=given.detections[kept])
    other = ALIKE[name](given)
    found, expected = prepare_alike(prepare(given), given, other), prepare(other)
    assert found is not None
    assert found.start_s == expected.start_s
    for of in ("used", "pose_frame", "landmark_id"):
        np.testing.assert_array_equal(getattr(found, of), getattr(expected, of))
    for of in ("stamp_s", "pose_row", "landmark_row", "reading", "sigma_given", "mount"):
        np.testing.assert_array_equal(getattr(found.problem, of), getattr(expected.problem, of))
    assert found.problem.drive.is_alike(expected.problem.drive)


def test_a_recording_of_which_other_detections_are_used_is_not_alike() -> None:
    given = patrol()
    prepared = prepare(given)
    assert prepare_alike(prepared, given, with_frames_later(given, 5.0)) is None
    landmark_id = given.detections.landmark_id.copy()
    landmark_id[prepared.used[0]] = UNKNOWN
    nameless = replace(given, detections=replace(given.detections, landmark_id=landmark_id))
    assert prepare_alike(prepared, given, nameless) is None


def test_a_recording_with_other_frames_between_its_measurements_is_not_alike() -> None:
    given = patrol()
    blind = np.setdiff1d(np.arange(1, len(given.frames) - 1), given.detections.frame)
    at_s = given.frames.stamp_s[blind[:1]] + 1e-4  # by a frame that has a pose for it alone
    columns = {name: np.zeros(1) for name in ("x_m", "y_m", "sigma_m")}
    given = replace(given, measurements=(Measurements("gnss", at_s, columns, np.full(1, UNKNOWN)),))
    prepared = prepare(given)
    assert blind[0] in prepared.pose_frame
    assert prepare_alike(prepared, given, given) is not None
    assert prepare_alike(prepared, given, with_frames_later(given, 1e-3)) is None
