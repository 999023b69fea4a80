"""Found changes against true ones, on cases whose answers can be counted by hand."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_run import make_run

from evermap.types import Alternative, ChangeKind, MapChange
from evermap_studies.changes import compare_changes, rank_of_truth, time_of_change

NAN = math.nan


def moved(*ids: int, by: tuple[float, float] = (1.0, 0.0), turn: float = 0.0, when: tuple[float, float] = (NAN, 0.0)):
    kind = ChangeKind.ROTATED if turn else ChangeKind.MOVED
    return MapChange(ids, kind, *when, by, turn, 0.9)


def test_exact_is_the_same_groups_in_any_order():
    true = [moved(11, 12, 13), moved(5, 6, by=(0.0, 0.3))]
    assert compare_changes([moved(5, 6), moved(13, 12, 11)], true).exact
    assert not compare_changes([moved(5, 6, 11, 12, 13)], true).exact, "one group is not two"
    assert not compare_changes([moved(11, 12, 13)], true).exact
    assert not compare_changes([*true, moved(20)], true).exact
    assert not compare_changes([moved(11, 12), moved(5, 6, 13)], true).exact
    assert compare_changes([], []).exact


def test_an_exchange_of_identities_is_another_finding_than_a_move():
    swapped = replace(moved(11, 17), kind=ChangeKind.SWAPPED)
    assert not compare_changes([moved(11, 17)], [swapped]).exact
    assert compare_changes([swapped], [swapped]).exact
    assert compare_changes([moved(1, 2)], [moved(1, 2, turn=0.1)]).exact, "a turn is an error, not another group"


def test_precision_and_recall_count_landmarks():
    errors = compare_changes([moved(1, 2), moved(8)], [moved(1, 2, 3, 4)])
    assert errors.precision == pytest.approx(2 / 3)
    assert errors.recall == pytest.approx(2 / 4)
    nothing = compare_changes([], [moved(1)])
    assert (nothing.precision, nothing.recall) == (None, 0.0)
    invented = compare_changes([moved(1)], [])
    assert (invented.precision, invented.recall) == (0.0, None)


def test_errors_are_those_of_the_matched_groups():
    true = [moved(1, 2, 3, by=(1.0, 0.0), when=(50.0, 50.0)), moved(7, 8, by=(0.0, -0.5), turn=3.1)]
    found = [moved(7, 8, by=(0.3, -0.1), turn=-3.1), moved(9), moved(1, 2, by=(1.0, 0.2), when=(40.0, 66.0))]
    errors = compare_changes(found, true)
    np.testing.assert_array_equal(errors.true_row, [0, 1])
    np.testing.assert_array_equal(errors.found_row, [2, 0])
    assert errors.displacement_error_m == pytest.approx([0.2, 0.5])
    assert errors.rotation_error_rad == pytest.approx([0.0, 2 * np.pi - 6.2])
    assert errors.time_error_s == pytest.approx([3.0, 0.0])


def test_a_change_before_the_session_is_at_its_first_stamp():
    assert time_of_change(moved(1, when=(NAN, 100.0))) == 100.0
    errors = compare_changes([moved(1, when=(NAN, 100.0))], [moved(1, when=(340.0, 350.0))])
    assert errors.time_error_s == pytest.approx([245.0])


def test_a_group_that_moved_twice_is_matched_move_by_move():
    out_and_back = [moved(1, 2, by=(1.0, 0.0)), moved(1, 2, by=(-1.0, 0.0))]
    errors = compare_changes(out_and_back[::-1], out_and_back)
    assert errors.exact
    assert errors.displacement_error_m == pytest.approx([0.0, 0.0])


groups = st.lists(st.sets(st.integers(0, 7), min_size=1, max_size=4), max_size=4).map(
    lambda drawn: [moved(*sorted(group)) for group in drawn]
)


@given(groups, groups)
def test_matching_has_as_many_landmarks_in_common_as_trying_all(found, true):
    def common(a, b):
        return len({*a.landmark_ids} & {*b.landmark_ids})

    errors = compare_changes(found, true)
    got = [common(true[t], found[f]) for t, f in zip(errors.true_row, errors.found_row, strict=True)]
    assert all(got), "groups without a common landmark are not matched"
    fewer, more = sorted([found, true], key=len)
    tries = (sum(map(common, fewer, order)) for order in itertools.permutations(more, len(fewer)))
    assert sum(got) == max(tries)


def test_the_rank_of_the_truth_looks_at_the_alternatives_too():
    result = make_run(duration_s=20.0)[1]
    complement = Alternative((moved(4, 5, by=(-1.0, 0.0)),), 0.3, result.landmarks)
    nothing = Alternative((), 0.1, result.landmarks)
    result = replace(result, changes=(moved(1, 2, 3),), alternatives=(complement, nothing))
    assert rank_of_truth(result, [moved(1, 2, 3)]) == 0
    assert rank_of_truth(result, [moved(4, 5)]) == 1
    assert rank_of_truth(result, []) == 2
    assert rank_of_truth(result, [moved(4)]) is None
