"""Whole runs: the same numbers again, whatever the order of detections; bad input in one line."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import TrackerConfig
from evermap.errors import ConfigError, InputError
from evermap.survival import Exponential
from evermap.tracking.record import Recorder, Tracks
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import TrackState
from evermap.tracking.views import View

ONE = np.array([[1.0, 2.0, 0.5]])


def crossing(seed: int, n: int = 60, n_frames: int = 60) -> list[np.ndarray]:
    """Detections of objects that move through each other, with misses and false alarms."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(0.0, 15.0, (n, 3)), rng.uniform(-1.0, 1.0, (n, 3))
    frames = []
    for k in range(n_frames):
        seen = rng.random(n) < 0.9
        false = rng.uniform(0.0, 15.0, (rng.poisson(3), 3))
        frames.append(np.vstack([(start + 0.1 * k * velocity)[seen] + rng.normal(0.0, 0.2, (seen.sum(), 3)), false]))
    return frames


def run(frames: list[np.ndarray], order: np.random.Generator | None = None) -> tuple[Tracks, list[np.ndarray]]:
    tracker, recorder, ids = Tracker(TrackerConfig(clutter_per_m3=1e-3)), Recorder(), []
    for k, points in enumerate(frames):
        shuffle = np.arange(len(points)) if order is None else order.permutation(len(points))
        tracks, events = tracker.step(0.1 * k, points[shuffle])
        recorder.add(tracker.followed(), events)
        back = np.empty_like(tracks)
        back[shuffle] = tracks
        ids.append(back)
    return recorder.tracks(), ids


def test_the_order_of_detections_changes_nothing() -> None:
    frames = crossing(0)
    (first, ids), (second, again) = run(frames), run(frames, np.random.default_rng(5))
    for a, b in zip(ids, again, strict=True):
        np.testing.assert_array_equal(a, b)
    for name in Tracks.__slots__:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_the_same_frames_give_the_same_bytes() -> None:
    frames = crossing(1)
    first, second = run(frames)[0], run(frames)[0]
    for name in Tracks.__slots__:
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_errors_are_as_large_as_their_covariances_say() -> None:
    """Normalised squares of a hundred filters of constant velocity: chi-square with 3 degrees of freedom, no less."""
    rng = np.random.default_rng(2)
    n = 100
    start = np.arange(n)[:, None] * [20.0, 0.0, 0.0]
    velocity = rng.normal(0.0, 1.0, (n, 3))
    tracker = Tracker(TrackerConfig(motion_density=1e-9))
    root = rng.normal(0.0, 0.3, (n, 3, 3))
    noise = root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3)  # long in one direction, another for each
    half = np.linalg.cholesky(noise)
    for k in range(100):
        truth = start + 0.1 * k * velocity
        ids, _ = tracker.step(
            0.1 * k, truth + np.einsum("nij,nj->ni", half, rng.normal(size=(n, 3))), covariance_m2=noise
        )
    followed = tracker.followed()
    row = np.array([np.flatnonzero(followed.track_id == i)[0] for i in ids])
    error = followed.position_m[row] - truth
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(followed.position_covariance_m2[row]), error)
    assert 2.4 < squared.mean() < 3.6  # 3 plus or minus 2.4 standard deviations


def test_rows_before_the_confirmation_are_kept_and_guesses_at_the_end_are_not() -> None:
    tracker, recorder = Tracker(), Recorder()
    for k in range(60):
        points = ONE if 5 <= k < 40 and k != 20 else np.empty((0, 3))
        _, events = tracker.step(0.1 * k, points)
        recorder.add(tracker.followed(), events)
    tracks = recorder.tracks()
    assert tracks.stamp_s[[0, -1]] == pytest.approx([0.5, 3.9])
    assert len(tracks) == 35  # the miss in between too
    assert tracks.state[0] == TrackState.BIRTH


def test_a_thousand_at_once_grow_the_arrays() -> None:
    points = np.arange(1000)[:, None] * [10.0, 0.0, 0.0]
    tracker = Tracker()
    first, _ = tracker.step(0.0, points)
    second, _ = tracker.step(0.1, points)
    assert sorted(first) == list(range(1000))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"position_m": [[0.0, 1.0]]}, "field 'position_m': shape (1, 2) instead of (M, 3)"),
        ({"position_m": [[0.0, 1.0, np.nan]]}, "field 'position_m': detection 0: [0.0, 1.0, nan] is not finite"),
        ({"position_m": "here"}, "field 'position_m': not numbers (try: three coordinates a detection)"),
        (
            {"class_id": [3]},
            "field 'class_id': detection 0: class 3 of 2 does not exist (try: 0 to 1, or -1 for unknown)",
        ),
        ({"class_id": [0, 1]}, "field 'class_id': shape (2,) instead of (1,)"),
        ({"class_id": [0.5]}, "field 'class_id': classes are whole numbers"),
        ({"covariance_m2": np.eye(3)}, "field 'covariance_m2': shape (3, 3) instead of (1, 3, 3)"),
        (
            {"covariance_m2": -np.eye(3)[None]},
            "field 'covariance_m2': detection 0: the matrix is not symmetric and positive definite",
        ),
        ({"appearance": np.ones((1, 3))}, "field 'appearance': shape (1, 3) instead of (1, 2)"),
        (
            {"stamp_s": 1.0},
            (
                "field 'stamp_s': frame at 1.0 s does not come after the one at 1.0 s "
                "(try: frames in the order of their stamps, all detections of one instant in one frame)"
            ),
        ),
        ({"view": View(np.zeros(3), 9.0, lambda p: p)}, "field 'p_detect': shape (1, 3) instead of (1,)"),
        (
            {"view": View(np.zeros(3), 9.0, lambda p: 2.0 * np.ones(len(p)))},
            "field 'p_detect': position 0: 2.0 is not a probability",
        ),
    ],
)
def test_bad_input_is_told_in_one_line(given: dict[str, object], says: str) -> None:
    tracker = Tracker(n_classes=2, n_appearance=2)
    tracker.step(1.0, ONE, [0])
    before = tracker.followed()
    with pytest.raises(InputError) as error:
        tracker.step(**{"stamp_s": 2.0, "position_m": ONE, **given})  # type: ignore[arg-type]
    assert str(error.value) == says
    if "view" not in given:  # a frame that was refused has changed nothing
        np.testing.assert_array_equal(tracker.followed().position_m, before.position_m)
        tracker.step(2.0, ONE)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: TrackerConfig(p_detect=1.0),
            "field 'p_detect': input should be less than 1, not 1.0",
        ),
        (lambda: TrackerConfig(warm_up=0), "field 'warm_up': input should be greater than or equal to 1, not 0"),
        (lambda: TrackerConfig(chunk_m=0.0), "field 'chunk_m': input should be greater than 0, not 0.0"),
        (
            lambda: TrackerConfig(motion="jerk"),  # type: ignore[arg-type]
            (
                "field 'motion': input should be 'acceleration' or 'velocity', not 'jerk' "
                "(try: one of acceleration, velocity)"
            ),
        ),
        (lambda: Tracker(n_classes=0), "field 'n_classes': 0 classes (try: at least 1)"),
        (
            lambda: Tracker(n_classes=2, confusion=np.eye(3)),
            "field 'confusion': shape (3, 3) instead of (2, 2)",
        ),
        (
            lambda: Tracker(n_classes=2, confusion=np.array([[0.5, 0.6], [0.0, 1.0]])),
            (
                "field 'confusion': row 0 is not a distribution over detected classes (sum 1.1) "
                "(try: rows are true classes and sum to 1)"
            ),
        ),
        (
            lambda: Tracker(n_classes=3, priors=[Exponential(1.0)] * 2),
            "field 'priors': 2 lifetime priors for 3 classes",
        ),
        (
            lambda: Tracker(TrackerConfig(class_speed_mps=(1.0, 2.0)), n_classes=3),
            "field 'class_speed_mps': 2 speeds for 3 classes",
        ),
    ],
)
def test_bad_settings_are_told_in_one_line(make: object, says: str) -> None:
    with pytest.raises(ConfigError) as error:
        make()  # type: ignore[operator]
    assert str(error.value) == says
