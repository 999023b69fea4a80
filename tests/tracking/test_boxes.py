"""Boxes through the tracker: size, heading, and scores; nothing depends on where the world's axes point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from evermap.config import TrackerConfig
from evermap.errors import EvermapError
from evermap.tracking.frame import p_real_of
from evermap.tracking.kalman import noise_of_centres, noise_of_shapes
from evermap.tracking.record import EventKind, Followed
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import TrackState
from evermap.tracking.views import View

CAR, PERSON = np.array([4.0, 1.7, 1.5]), np.array([0.7, 0.6, 1.75])
STEP_S = 0.1


def passing_cars(rng: np.random.Generator, n_frames: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Frames of (M, 3) centres and (M, 4) boxes: two cars that pass each other, one that parks, a person."""
    frames = []
    for k in range(n_frames):
        t = STEP_S * k
        centre = np.array(
            [[10.0 * t, 0.0, 0.8], [40.0 - 8.0 * t, 3.0, 0.8], [12.0, -3.0, 0.8], [5.0, 1.2 * t - 6, 0.9]]
        )
        box = np.column_stack([[CAR, CAR, 1.1 * CAR, PERSON], [0.0, np.pi, 0.2, np.pi / 2]])
        centre += rng.normal(0.0, 0.05, centre.shape)
        box += rng.normal(0.0, 1.0, box.shape) * [0.1, 0.05, 0.05, 0.03]
        frames.append((centre, box))
    return frames


def follow(frames: list[tuple[np.ndarray, np.ndarray]]) -> tuple[list[list[int]], Followed]:
    tracker = Tracker(boxes=True)
    ids = [tracker.step(STEP_S * k, centre, box=box)[0].tolist() for k, (centre, box) in enumerate(frames)]
    return ids, tracker.followed()


def test_objects_keep_their_identities_sizes_and_headings() -> None:
    ids, followed = follow(passing_cars(np.random.default_rng(0), 40))
    assert len({tuple(row) for row in ids}) == 1
    found = followed.box[np.argsort(followed.track_id)][np.argsort(np.argsort(ids[0]))]
    np.testing.assert_allclose(found[:, :3], [CAR, CAR, 1.1 * CAR, PERSON], atol=0.1)
    np.testing.assert_allclose(np.cos(found[:, 3] - [0.0, np.pi, 0.2, np.pi / 2]), 1.0, atol=0.01)


@given(st.floats(-3.1, 3.1), st.floats(-500.0, 500.0), st.integers(0, 1000))
def test_a_turned_world_has_turned_tracks(turn: float, shift_m: float, seed: int) -> None:
    frames = passing_cars(np.random.default_rng(seed), 12)
    rotation = Rotation.from_euler("z", turn).as_matrix()
    shift = np.array([shift_m, -0.3 * shift_m, 0.0])
    turned = [(centre @ rotation.T + shift, box + [0.0, 0.0, 0.0, turn]) for centre, box in frames]
    ids, followed = follow(frames)
    turned_ids, moved = follow(turned)
    # ids are given in the order of places, which turn
    assert [[row.index(i) for i in row] for row in ids] == [[row.index(i) for i in row] for row in turned_ids]
    order = [int(np.flatnonzero(followed.track_id == i)[0]) for i in ids[-1]]
    other = [int(np.flatnonzero(moved.track_id == i)[0]) for i in turned_ids[-1]]
    np.testing.assert_allclose(moved.position_m[other], followed.position_m[order] @ rotation.T + shift, atol=1e-6)
    np.testing.assert_allclose(moved.velocity_mps[other], followed.velocity_mps[order] @ rotation.T, atol=1e-6)
    np.testing.assert_allclose(moved.box[other, :3], followed.box[order, :3], atol=1e-6)
    np.testing.assert_allclose(np.cos(moved.box[other, 3] - followed.box[order, 3] - turn), 1.0, atol=1e-9)
    np.testing.assert_allclose(moved.p_exists[other], followed.p_exists[order], rtol=1e-6)


def test_headings_that_are_detected_the_wrong_way_round_do_not_turn_a_car() -> None:
    rng, tracker = np.random.default_rng(1), Tracker(boxes=True)
    for k in range(60):
        yaw = 0.3 + np.pi * (k % 5 == 4) + rng.normal(0.0, 0.02)
        tracker.step(STEP_S * k, np.array([[10.0, 5.0, 0.8]]), box=np.array([[*CAR, yaw]]))
        if k > 2:
            assert np.cos(tracker.followed().box[0, 3] - 0.3) > 0.99, k
    assert len(tracker) == 1


def test_the_way_a_car_goes_tells_its_front() -> None:
    tracker = Tracker(boxes=True)
    for k in range(20):  # always detected backwards
        tracker.step(STEP_S * k, np.array([[STEP_S * k * 8.0, 0.0, 0.8]]), box=np.array([[*CAR, np.pi]]))
    assert np.cos(tracker.followed().box[0, 3]) > 0.99


def test_size_is_the_filter_of_a_constant() -> None:
    """Against the closed form of a weighted mean, as far as sizes may change."""
    rng, tracker = np.random.default_rng(2), Tracker(boxes=True)
    lengths = 4.0 + rng.normal(0.0, 0.1, 15)
    for k, length in enumerate(lengths):
        tracker.step(STEP_S * k, np.array([[0.0, 0.0, 0.8]]), box=np.array([[length, 1.7, 1.5, 0.0]]))
    s = TrackerConfig()
    mean = variance = 0.0
    for k, length in enumerate(lengths):
        noise = 2.0 * (s.sigma_face_m + s.sigma_face_share * length) ** 2
        before = np.inf if k == 0 else variance + (0.01 * mean) ** 2 * STEP_S
        gain = 1.0 if k == 0 else before / (before + noise)
        mean, variance = mean + gain * (length - mean), noise if k == 0 else (1.0 - gain) * before
    followed = tracker.followed()
    assert followed.box[0, 0] == pytest.approx(mean, rel=1e-12)
    assert followed.box_variance[0, 0] == pytest.approx(variance, rel=1e-12)


def test_noise_is_that_of_faces_turned_with_the_box() -> None:
    box, face = np.array([[*CAR, 0.7]]), np.array([[0.2, 0.1, 0.05]])
    rotation = Rotation.from_euler("z", 0.7).as_matrix()
    expected = rotation @ np.diag(face[0] ** 2 / 2.0) @ rotation.T
    np.testing.assert_allclose(noise_of_centres(box, face)[0], expected, atol=1e-15)
    np.testing.assert_allclose(noise_of_shapes(box, face)[0], [*(2.0 * face[0] ** 2), 2.0 * 0.2**2 / 4.0**2])


def test_the_shape_tells_neighbours_apart() -> None:
    """A person beside a car: both detected in the middle between their places."""
    tracker = Tracker(boxes=True)
    box = np.array([[*CAR, 0.0], [*PERSON, 0.0]])
    for k in range(10):
        first, _ = tracker.step(STEP_S * k, np.array([[0.0, 0.0, 0.8], [0.0, 1.2, 0.8]]), box=box)
    ids, _ = tracker.step(1.0, np.array([[0.0, 0.65, 0.8], [0.0, 0.55, 0.8]]), box=box)
    assert ids.tolist() == first.tolist()


def test_a_box_found_beside_its_place_is_of_the_same_object_and_moves_it_little() -> None:
    tracker = Tracker(boxes=True)
    for k in range(20):
        first, _ = tracker.step(STEP_S * k, np.array([[0.0, 0.0, 0.8]]), box=np.array([[*CAR, 0.0]]))
    ids, _ = tracker.step(2.0, np.array([[1.1, 0.0, 0.8]]), box=np.array([[*CAR, 0.0]]))
    assert ids.tolist() == first.tolist()
    assert abs(tracker.followed().position_m[0, 0]) < 0.2


def test_detections_without_a_score_are_followed_as_ever() -> None:
    rng = np.random.default_rng(3)
    plain, scored = Tracker(), Tracker(scored=True)
    for k in range(60):
        seen = rng.normal([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.1 * k, 9.0, 0.0]], 0.2)[rng.random(3) < 0.8]
        a = plain.step(STEP_S * k, seen)
        b = scored.step(STEP_S * k, seen, p_real=np.full(len(seen), np.nan))
        assert a[0].tolist() == b[0].tolist()
        assert a[1] == b[1]
    for name in ("position_m", "velocity_mps", "p_exists", "state", "static"):
        np.testing.assert_array_equal(getattr(plain.followed(), name), getattr(scored.followed(), name))


def test_scores_confirm_at_once_or_never() -> None:
    tracker = Tracker(scored=True)
    places = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
    for k in range(10):
        _, events = tracker.step(STEP_S * k, places, p_real=np.array([0.95, 0.02]))
        followed = tracker.followed()
        p = followed.p_exists[np.argsort(followed.position_m[:, 0])]
        if k == 0:
            assert [event.kind for event in events] == [EventKind.BORN]
            np.testing.assert_allclose(p, [0.95, 0.02], rtol=1e-9)
    assert sorted(followed.state.tolist()) == [TrackState.BIRTH, TrackState.ALIVE]
    odds = p / (1.0 - p)  # ten detections weigh a little more than one
    np.testing.assert_allclose(odds, 10.0 ** TrackerConfig().seen_nats * np.array([19.0, 1.0 / 49.0]), rtol=1e-6)


def test_only_misses_in_view_make_an_object_less_real() -> None:
    tracker, car = Tracker(scored=True), np.array([[10.0, 0.0, 0.0]])
    ahead = View.sector(np.zeros(3), 50.0, 0.9, 0.0, np.radians(80.0))
    aside = View.sector(np.zeros(3), 50.0, 0.9, np.pi / 2, np.radians(80.0))
    for k in range(10):
        tracker.step(STEP_S * k, car, p_real=np.array([0.8]), view=ahead)
    before = tracker.followed().p_exists[0]
    tracker.step(1.0, np.empty((0, 3)), p_real=np.empty(0), view=aside)
    assert tracker.followed().p_exists[0] == pytest.approx(before, abs=1e-3)
    tracker.step(1.1, np.empty((0, 3)), p_real=np.empty(0), view=ahead)
    odds, then = before / (1.0 - before), tracker.followed().p_exists[0]
    assert then / (1.0 - then) == pytest.approx(odds * np.exp(-TrackerConfig().missed_nats), rel=0.02)


def test_scores_of_any_scale_become_probabilities() -> None:
    np.testing.assert_array_equal(p_real_of(np.array([0.1, 1.0, np.nan]), 3.0, 1.0), [0.1, 1.0, np.nan])
    np.testing.assert_allclose(p_real_of(np.array([3.0, 4.2, -9.0]), 3.0, 1.2)[:2], [0.5, 1.0 / (1.0 + np.exp(-1.0))])


@pytest.mark.parametrize(
    ("box", "p_real", "named"),
    [
        (np.ones((1, 3)), np.ones(1), "field 'box': shape (1, 3) instead of (1, 4)"),
        (np.array([[4.0, -1.0, 1.0, 0.0]]), np.ones(1), "is not a box (try: positive sizes [m] and a heading [rad])"),
        (np.ones((1, 4)), np.ones(2), "field 'p_real': shape (2,) instead of (1,)"),
        (np.ones((1, 4)), np.full(1, 1.5), "field 'p_real': detection 0: 1.5 is not a probability"),
        (None, np.ones(1), "field 'box'"),
    ],
)
def test_malformed_boxes_are_named(box: np.ndarray | None, p_real: np.ndarray, named: str) -> None:
    with pytest.raises(EvermapError) as error:
        Tracker(boxes=True, scored=True).step(0.0, np.zeros((1, 3)), box=box, p_real=p_real)
    assert named in error.value.one_line()


def test_a_parked_box_whose_centre_wanders_rests_and_a_creeping_one_does_not() -> None:
    """As the car drives by, another side is seen, and the centre of what is parked shifts by 0.25 m."""
    rng, tracker = np.random.default_rng(5), Tracker(boxes=True)
    for k in range(80):
        t = STEP_S * k
        parked, creeping = [0.25 * np.tanh(t - 4.0), 0.0, 0.8], [0.9 * t, 8.0, 0.8]
        centre = np.array([parked, creeping]) + rng.normal(0.0, 0.05, (2, 3))
        tracker.step(t, centre, box=np.array([[*CAR, 0.0], [*CAR, 0.0]]))
    followed = tracker.followed()
    order = np.argsort(followed.position_m[:, 1])
    assert followed.static[order].tolist() == [True, False]
    assert tracker.p_static()[order][0] > 0.9
    assert tracker.p_static()[order][1] < 0.3


def test_standing_still_is_a_bayes_factor() -> None:
    """Against densities by scipy, of a filter that has seen two detections; and the prior moves the odds."""
    from scipy.stats import multivariate_normal

    s, tracker = TrackerConfig(), Tracker(boxes=True)
    for k in range(2):
        tracker.step(STEP_S * k, np.array([[0.1 * k, 0.0, 0.8]]), box=np.array([[*CAR, 0.4]]))
    followed = tracker.followed()
    yaw = followed.box[0, 3]
    ahead = s.speed_per_length_hz * followed.box[0, 0] * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    before = s.sigma_velocity_mps**2 * np.eye(3) + np.outer(ahead, ahead)
    after = multivariate_normal(followed.velocity_mps[0], followed.velocity_covariance_m2ps2[0]).logpdf(np.zeros(3))
    factor = np.exp(after - multivariate_normal(np.zeros(3), before).logpdf(np.zeros(3)))
    np.testing.assert_allclose(tracker.p_static(), factor / (1.0 + factor), rtol=1e-9)
    np.testing.assert_allclose(tracker.p_static(0.8), 4.0 * factor / (1.0 + 4.0 * factor), rtol=1e-9)
