"""A box where one stood is that one or another, with one probability: days on a street with much coming and going."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from evermap.geometry import se3
from evermap.pipeline import run_session
from evermap.types import ChangeKind, MapChange
from evermap.viz.change_words import what
from evermap_studies.worlds.parking import Faults, Parking, StreetConfig, simulate_street

ALONE = (ChangeKind.APPEARED, ChangeKind.RETURNED, ChangeKind.VANISHED)


@pytest.fixture(scope="module")
def told() -> list[tuple[bool, float | None, Counter[int], list[MapChange]]]:
    """Of each slot that was taken on two days: whether by another one, and how probably that was told; and facts."""
    run, living, last, found = simulate_street(StreetConfig(days=4), 0), None, dict[int, int](), []
    known = dict[int, int]()
    for drive in run.drives:
        session = run_session(drive, living)
        living = session.living
        assert session.found
        at_s = float(drive.frames.stamp_s[0]) + 20.0
        now = {one.slot: k for k, one in enumerate(run.street.spells) if one.from_s <= at_s < one.until_s}
        marks = living.landmarks()
        slots = run.street.find_slots(marks.position_m[:, :2]).tolist()
        slot = dict(zip(marks.landmark_id.tolist(), slots, strict=True))
        replaced = {slot[one.landmark_ids[1]]: one for one in session.changes if one.kind is ChangeKind.REPLACED}
        facts = Counter(slot[one.landmark_ids[0]] for one in session.changes if one.kind in ALONE)
        stands = {slot[name]: name for name in marks.landmark_id[marks.p_exists >= 0.5].tolist()}
        for one in stands.keys() & known.keys() & now.keys() & last.keys():
            same = known[one] == stands[one]
            p = replaced[one].probability if one in replaced else 0.0 if same else None
            found.append((now[one] != last[one], p, facts, list(replaced.values())))
        last, known = now, stands
    return found


@pytest.mark.slow
def test_others_in_the_same_place_are_told_and_what_stands_is_not(told) -> None:
    another = np.array([row[0] for row in told])
    p = np.array([np.nan if row[1] is None else row[1] for row in told])
    assert np.count_nonzero(another) >= 12
    assert np.count_nonzero(~another) >= 40
    assert (p[another] >= 0.5).mean() >= 0.9
    assert (p[~another] < 0.5).mean() >= 0.95
    sure = p[p >= 0.5]
    assert another[p >= 0.5].mean() >= sure.mean() - 2.0 * np.sqrt((sure * (1.0 - sure)).mean() / len(sure))


@pytest.mark.slow
def test_what_was_replaced_is_not_told_as_two_facts(told) -> None:
    assert all(row[1] is not None for row in told)
    assert max(max(row[2].values(), default=0) for row in told) <= 1
    changes = [one for row in told for one in row[3]]
    assert all(len(one.landmark_ids) == 2 for one in changes)
    assert all(np.hypot(*one.displacement_m[:2]) < 1.5 for one in changes)
    assert max(one.probability for one in changes) < 1.0
    assert "was replaced or is the same" in what(changes[0])


def test_a_detector_may_see_wrong_sizes_for_a_whole_drive() -> None:
    """The share of boxes that look like any car, as `benchmarks.same_or_other` draws it; one drive sees one size."""
    parking = Parking.of(0)
    for slot in range(36):
        parking.park(np.random.default_rng(slot), slot, -1.0, 1e9)
    right, wrong = (parking.drive(1, 0.0, faults=Faults(odd=odd), moving=0) for odd in (0.0, 0.5))
    true_m = np.array([one.size_m[0] for one in parking.spells])
    shares = []
    for drive in (right, wrong):
        assert drive.truth is not None
        at = se3.transform(drive.truth.pose_world_robot[drive.detections.frame], drive.detections.position_sensor_m)
        away_m = np.linalg.norm(at[:, None, :2] - parking.slot[None, :, :2], axis=2)
        near = (away_m.min(axis=1) < 1.0) & (np.linalg.norm(drive.detections.position_sensor_m, axis=1) < 20.0)
        slot, length_m = away_m.argmin(axis=1)[near], drive.detections.size_m[near, 0]
        seen_m = np.array([np.median(length_m[slot == one]) for one in np.unique(slot)])
        shares.append(float((np.abs(seen_m - true_m[np.unique(slot)]) > 0.15).mean()))
    assert shares[0] < 0.1
    assert 0.2 < shares[1] < 0.6
