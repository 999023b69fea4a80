"""Who is who after an absence: by place, class and appearance."""

from __future__ import annotations

import numpy as np
import pytest

from evermap.config import TrackerConfig
from evermap.survival import Exponential
from evermap.tracking.tracker import Tracker
from evermap.tracking.tracklets import EventKind

from .observer import kinds, look

NOTHING = np.empty((0, 3))
TWO = np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0]])
LOOKS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def watched(tracker: Tracker, position: np.ndarray = TWO, **given: object) -> np.ndarray:
    """Ids of objects that were seen for three seconds and are in the working set now."""
    look(tracker, 0.0, 30, position, **given)
    ids, _ = tracker.step(3.0, position, **given)  # type: ignore[arg-type]
    look(tracker, 3.1, 11, NOTHING)
    assert len(tracker.working_set) == len(position)
    return ids


def test_a_hundred_objects_that_return_keep_their_identity() -> None:
    rng = np.random.default_rng(0)
    place = np.stack(np.meshgrid(np.arange(10), np.arange(10), [0.0], indexing="ij"), axis=-1).reshape(-1, 3) * 10.0
    tracker = Tracker()
    for k in range(40):
        before, _ = tracker.step(0.1 * k, place + rng.normal(0.0, 0.3, place.shape))
    look(tracker, 4.0, 11, NOTHING)
    order = rng.permutation(100)
    after, _ = tracker.step(1000.0, place[order] + rng.normal(0.0, 0.3, place.shape))
    assert np.mean(after == before[order]) >= 0.99


def test_one_that_is_too_far_from_its_place_is_another() -> None:
    tracker = Tracker()
    ids = watched(tracker)
    after, _ = tracker.step(100.0, TWO + [0.0, 3.0, 0.0])
    assert not np.isin(after, ids).any()


def test_swapped_objects_are_not_confused_when_they_look_different() -> None:
    for given, confused in (({}, True), ({"appearance": LOOKS}, False)):
        tracker = Tracker(n_appearance=3)
        ids = watched(tracker, **given)
        swapped = {"appearance": LOOKS[::-1]} if given else {}
        after, _ = tracker.step(100.0, TWO, **swapped)
        assert np.any(after == ids) == confused


def test_objects_that_may_be_moved_are_found_where_they_are_now() -> None:
    tracker = Tracker(TrackerConfig(moved_reach_m=20.0), n_appearance=3)
    ids = watched(tracker, appearance=LOOKS)
    after, events = tracker.step(100.0, TWO, appearance=LOOKS[::-1])
    assert after.tolist() == ids[::-1].tolist()
    assert kinds(events) == [EventKind.REIDENTIFIED] * 2
    spells = tracker.static_spells()
    assert spells.gone_s.tolist() == [100.0, 100.0]
    assert spells.last_s.tolist() == [3.0, 3.0]


def test_the_class_tells_two_objects_in_one_place_apart() -> None:
    tracker = Tracker(TrackerConfig(p_off_class=1e-6), n_classes=2)
    ids = watched(tracker, class_id=[0, 1])
    after, _ = tracker.step(100.0, TWO, [1, 1])
    assert after[1] == ids[1]
    assert after[0] not in ids


def test_a_confusion_matrix_says_which_mistakes_are_likely() -> None:
    """Class 0 is often taken for 1, and never for 2."""
    confusion = np.array([[0.6, 0.4, 1e-9], [1e-9, 1.0 - 2e-9, 1e-9], [1e-9, 1e-9, 1.0 - 2e-9]])
    for seen, same in ((1, True), (2, False)):
        tracker = Tracker(n_classes=3, confusion=confusion)
        ids = watched(tracker, TWO[:1], class_id=[0])
        after, _ = tracker.step(100.0, TWO[:1], [seen])
        assert (after[0] == ids[0]) == same


def test_the_class_posterior_is_bayes_rule() -> None:
    confusion = np.array([[0.7, 0.2, 0.1], [0.1, 0.8, 0.1], [0.3, 0.3, 0.4]])
    tracker = Tracker(n_classes=3, confusion=confusion)
    seen = [0, 2, 2, -1, 0, 1]
    for k, label in enumerate(seen):
        tracker.step(0.1 * k, TWO[:1], [label])
    expected = np.prod([confusion[:, label] for label in seen if label >= 0], axis=0)
    np.testing.assert_allclose(tracker.followed().class_p[0], expected / expected.sum(), rtol=1e-12)


def test_lifetimes_are_forgotten_by_what_is_known_of_them() -> None:
    """After many mean lifetimes whoever stands in a place is probably somebody else."""
    for mean_life_s, same in ((1e9, True), (100.0, False)):
        tracker = Tracker(priors=Exponential(1.0 / mean_life_s))
        ids = watched(tracker, TWO[:1])
        after, _ = tracker.step(5000.0, TWO[:1])
        assert (after[0] == ids[0]) == same


def test_the_nearest_of_several_is_found_jointly() -> None:
    """One detection lies between two places, the other fits only one of them: both find theirs."""
    tracker = Tracker()
    places = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])
    ids = watched(tracker, places)
    after, _ = tracker.step(100.0, np.array([[0.7, 0.0, 0.0], [-0.2, 0.0, 0.0]]))
    assert after.tolist() == ids[::-1].tolist()


@pytest.mark.parametrize("motion", ["acceleration", "velocity"])
def test_an_object_found_again_is_followed_when_it_drives_off(motion: str) -> None:
    tracker = Tracker(TrackerConfig(motion=motion))  # type: ignore[arg-type]
    ids = watched(tracker, TWO[:1])
    for k in range(50):
        after, _ = tracker.step(100.0 + 0.1 * k, TWO[:1] + [0.005 * k**2, 0.0, 0.0])  # 1 m/s^2
        assert after[0] == ids[0]
