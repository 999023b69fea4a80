"""A box where one stood is that one or another, with one probability: days on a street with much coming and going."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from evermap.pipeline import run_session
from evermap.types import ChangeKind, MapChange
from evermap.viz.change_words import what
from evermap_studies.worlds.parking import StreetConfig, simulate_street

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


def test_others_in_the_same_place_are_told_and_what_stands_is_not(told) -> None:
    another = np.array([row[0] for row in told])
    p = np.array([np.nan if row[1] is None else row[1] for row in told])
    assert np.count_nonzero(another) >= 12
    assert np.count_nonzero(~another) >= 40
    assert (p[another] >= 0.5).mean() >= 0.9
    assert (p[~another] < 0.5).mean() >= 0.95
    sure = p[p >= 0.5]
    assert another[p >= 0.5].mean() >= sure.mean() - 2.0 * np.sqrt((sure * (1.0 - sure)).mean() / len(sure))


def test_what_was_replaced_is_not_told_as_two_facts(told) -> None:
    assert all(row[1] is not None for row in told)
    assert max(max(row[2].values(), default=0) for row in told) <= 1
    changes = [one for row in told for one in row[3]]
    assert all(len(one.landmark_ids) == 2 for one in changes)
    assert all(np.hypot(*one.displacement_m[:2]) < 1.5 for one in changes)
    assert max(one.probability for one in changes) < 1.0
    assert "was replaced or is the same" in what(changes[0])
