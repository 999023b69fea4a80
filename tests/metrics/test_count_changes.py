"""Changes by landmark and kind, counted by hand."""

from __future__ import annotations

from evermap.types import ChangeKind, MapChange
from evermap_studies.changes import ChangeCounts, count_changes

NAN = float("nan")


def change(kind: ChangeKind, *landmark_ids: int) -> MapChange:
    return MapChange(landmark_ids, kind, NAN, 0.0, (0.0, 0.0), 0.0, 1.0)


TRUE = [change(ChangeKind.MOVED, 1), change(ChangeKind.MOVED, 2), change(ChangeKind.VANISHED, 3)]
FOUND = [change(ChangeKind.ROTATED, 1, 4), change(ChangeKind.VANISHED, 2), change(ChangeKind.VANISHED, 3)]


def test_right_is_the_landmark_with_its_kind_and_a_turn_is_a_move() -> None:
    assert count_changes(FOUND, TRUE) == ChangeCounts(n_found=4, n_true=3, n_right=2)
    assert count_changes(FOUND, TRUE, ChangeKind.MOVED) == ChangeCounts(2, 2, 1)
    assert count_changes(FOUND, TRUE, ChangeKind.VANISHED) == ChangeCounts(2, 1, 1)
    assert count_changes(FOUND, TRUE, ChangeKind.APPEARED) == ChangeCounts(0, 0, 0)


def test_shares_of_sums_and_of_nothing() -> None:
    total = count_changes(FOUND, TRUE) + count_changes([], TRUE)
    assert total.precision == 0.5
    assert total.recall == 2 / 6
    assert count_changes([], TRUE).precision is None
    assert count_changes(FOUND, []).recall is None
