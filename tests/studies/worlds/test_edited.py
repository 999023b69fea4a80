"""A recording of landmarks that moved half way, against one that was made of moved landmarks in the first place."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.types import Detections, Frames, Landmarks, Odometry, Recording, Sensor
from evermap_studies.worlds.edited import DEPTH_LAW, edited, later, limited

SENSOR = Sensor(
    range_min_m=0.3, range_max_m=6.0, bearing_min_rad=-0.8, bearing_max_rad=0.8, mount_robot_sensor=(0.2, 0.1, 0.3)
)
BEFORE = Landmarks.at([3, 5, 9], [(3.0, 0.5), (2.5, 2.0), (4.0, -0.5)])
AFTER = Landmarks.at([3, 5, 9], [(3.0, 0.5), (2.9, 1.7), (4.0, -0.5)])
STAMPS = np.arange(40) * 0.5
NOISE = np.random.default_rng(0).normal(size=(40, 3, 2)) * [0.02, 0.01]
BIAS_M = 0.05


def poses() -> np.ndarray:
    return np.column_stack([0.02 * STAMPS, 0.03 * np.sin(STAMPS), 0.2 * np.cos(0.3 * STAMPS)])


def reading(pose: np.ndarray, at: np.ndarray, law: tuple[float, float, float]) -> tuple[float, float]:
    """Range and bearing by complex numbers."""
    sensor = complex(*pose[:2]) + complex(*SENSOR.mount_robot_sensor[:2]) * np.exp(1j * pose[2])
    seen = (complex(*at) - sensor) * np.exp(-1j * (pose[2] + SENSOR.mount_robot_sensor[2]))
    r, b = abs(seen), float(np.angle(seen))
    return BIAS_M + r * (1.0 + law[0] + law[1] * b + law[2] * b * b), b


def made(places: list[Landmarks], law: tuple[float, float, float]) -> Recording:
    """All landmarks in every frame, each frame with its own map; two detections of an unknown one."""
    rows = []
    for frame, (pose, landmarks) in enumerate(zip(poses(), places, strict=True)):
        for identity, at in zip(landmarks.landmark_id, landmarks.position_m, strict=True):
            r, b = reading(pose, at, law)
            k = BEFORE.landmark_id.tolist().index(identity)  # every landmark has its own noise
            rows.append((frame, identity, r + NOISE[frame, k, 0], b + NOISE[frame, k, 1]))
    rows.append((39, 77, 2.0, 0.1))
    frame, identity, r, b = np.array(rows).T
    count = len(rows)
    return Recording(
        name="made",
        odometry=Odometry(STAMPS, *np.zeros((3, 40))),
        frames=Frames(STAMPS),
        detections=Detections(
            frame.astype(np.int64), identity.astype(np.int64), r, b, np.full(count, -1), np.full(count, np.nan),
            np.full(count, np.nan), np.arange(count),
        ),
        sensor=SENSOR,
    )  # fmt: skip


@pytest.mark.parametrize("law", [DEPTH_LAW, (0.01, 0.05, -0.4), (0.0, 0.0, 0.0)])
def test_edited_is_what_would_have_been_seen(law: tuple[float, float, float]) -> None:
    at_s = float(STAMPS[20])
    found = edited(made([BEFORE] * 40, law), poses(), BEFORE, AFTER, at_s, law).detections
    wanted = made([BEFORE] * 20 + [AFTER] * 20, law).detections
    kept = np.isin(wanted.source_line, found.source_line)
    np.testing.assert_allclose(found.range_m, wanted.range_m[kept], atol=1e-12)
    np.testing.assert_allclose(found.bearing_rad, wanted.bearing_rad[kept], atol=1e-12)
    gone = ~kept
    out_of_view = (np.abs(wanted.bearing_rad) > 0.8) | (wanted.range_m > 6.0)
    moved = (wanted.landmark_id == 5) & (wanted.frame >= 20)
    np.testing.assert_array_equal(gone, moved & out_of_view)
    assert found.landmark_id[-1] == 77


def test_who_leaves_the_view_is_not_seen() -> None:
    far = Landmarks.at([3, 5, 9], [(3.0, 0.5), (2.5, 9.0), (4.0, -0.5)])
    recording = made([BEFORE] * 40, DEPTH_LAW)
    found = edited(recording, poses(), BEFORE, far, float(STAMPS[20]))
    assert np.all(found.detections.frame[found.detections.landmark_id == 5] < 20)
    assert np.sum(found.detections.landmark_id == 3) == 40


def test_who_vanishes_is_not_seen_and_the_looks_stay() -> None:
    recording = made([BEFORE] * 40, DEPTH_LAW)
    some = Landmarks.at([3, 9], [(3.0, 0.5), (4.0, -0.5)])
    found = edited(recording, poses(), BEFORE, some, float(STAMPS[20]))
    kept = (recording.detections.landmark_id != 5) | (recording.detections.frame < 20)
    np.testing.assert_array_equal(found.detections.source_line, recording.detections.source_line[kept])
    np.testing.assert_array_equal(found.detections.range_m, recording.detections.range_m[kept])
    np.testing.assert_array_equal(found.frames.stamp_s, recording.frames.stamp_s)
    empty = Landmarks.at([], np.zeros((0, 2)))
    nothing = edited(recording, poses(), BEFORE, empty, -np.inf)
    np.testing.assert_array_equal(nothing.detections.landmark_id, [77])


def test_moved_vanished_and_back_are_what_would_have_been_seen() -> None:
    now = Landmarks.at([3, 9], [(3.3, 0.1), (4.0, -0.5)])
    found = edited(made([BEFORE] * 40, DEPTH_LAW), poses(), BEFORE, now, -np.inf).detections
    wanted = made([now] * 40, DEPTH_LAW).detections
    kept = np.isin(10 * wanted.frame + wanted.landmark_id, 10 * found.frame + found.landmark_id)
    np.testing.assert_allclose(found.range_m, wanted.range_m[kept], atol=1e-12)
    np.testing.assert_allclose(found.bearing_rad, wanted.bearing_rad[kept], atol=1e-12)
    assert np.all((np.abs(wanted.bearing_rad) > 0.8)[~kept] | (wanted.range_m > 6.0)[~kept])


def test_later_is_the_same_recording_with_all_its_stamps_moved() -> None:
    recording = made([BEFORE] * 40, DEPTH_LAW)
    moved = later(recording, 86_400.0)
    np.testing.assert_array_equal(moved.frames.stamp_s, STAMPS + 86_400.0)
    np.testing.assert_array_equal(moved.odometry.stamp_s, STAMPS + 86_400.0)
    assert moved.truth is None
    assert moved.detections is recording.detections


def test_no_move_is_no_edit() -> None:
    recording = made([BEFORE] * 40, DEPTH_LAW)
    found = edited(recording, poses(), BEFORE, BEFORE, 0.0)
    np.testing.assert_array_equal(found.detections.range_m, recording.detections.range_m)
    np.testing.assert_array_equal(found.detections.bearing_rad, recording.detections.bearing_rad)


def test_limits_cut_ranges_and_bearings() -> None:
    recording = made([BEFORE] * 40, DEPTH_LAW)
    kept = limited(recording, 3.0, 0.4).detections
    old = recording.detections
    inside = (old.range_m <= 3.0) & (np.abs(old.bearing_rad) <= 0.4)
    np.testing.assert_array_equal(kept.source_line, old.source_line[inside])
    assert 0 < len(kept) < len(old)
