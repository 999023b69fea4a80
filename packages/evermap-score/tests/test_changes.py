"""Changes that are derived from episodes, and their scores, worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from evermap_score import Episodes
from evermap_score.changes import derive_changes

from .worlds import looks_at, table, values, world_of

ENDS_S = [10.0, 20.0, 30.0, 40.0]
# a stays; b moves at 15; c vanishes at 15 and returns at 35; d appears at 25; e and f swap at 25; g leaves its place at
# 35, which h takes
TRUTH = table(
    ("a", None, None, 0, 0),
    ("b", None, 15, 5, 0), ("b", 15, None, 6, 0),
    ("c", None, 15, 0, 5), ("c", 35, None, 0, 5),
    ("d", 25, None, 9, 9),
    ("e", None, 25, 2, 2), ("e", 25, None, 3, 3),
    ("f", None, 25, 3, 3), ("f", 25, None, 2, 2),
    ("g", None, 35, 7, 7), ("h", 35, None, 7, 7),
)  # fmt: skip
KINDS = {
    ("b", "moved", 1), ("c", "vanished", 1), ("c", "returned", 3), ("d", "appeared", 2), ("e", "exchanged", 2),
    ("f", "exchanged", 2), ("g", "exchanged", 3), ("h", "exchanged", 3),
}  # fmt: skip


def kinds(episodes: Episodes, *, sessions: bool = True) -> set[tuple[str, str, int]]:
    world = world_of(TRUTH, episodes, looks_at(ENDS_S, {}) if sessions else None)
    return {(each.landmark_id, each.kind, each.session) for each in derive_changes(episodes, world)}


def test_every_kind_is_derived_once() -> None:
    assert kinds(TRUTH) == KINDS


def test_without_sessions_the_same_changes_are_derived() -> None:
    # instants are 14, 20, 30, 36: before 15, between 15 and 25, between 25 and 35, after 35
    assert kinds(TRUTH, sessions=False) == KINDS


def test_the_order_of_rows_does_not_matter() -> None:
    assert kinds(TRUTH[np.arange(len(TRUTH))[::-1]]) == KINDS


def test_what_comes_and_goes_between_two_sessions_is_no_change() -> None:
    assert kinds(table(("x", 21, 24, 1, 1))) == set()
    assert kinds(table(("x", 21, 24, 1, 1)), sessions=False) == {("x", "appeared", 2), ("x", "vanished", 2)}


def test_a_gap_without_a_session_is_the_time_that_a_move_took() -> None:
    assert kinds(table(("b", None, 12, 5, 0), ("b", 18, None, 6, 0))) == {("b", "moved", 1)}
    assert kinds(table(("b", None, 12, 5, 0), ("b", 28, None, 6, 0))) == {("b", "vanished", 1), ("b", "returned", 2)}


def test_a_small_move_is_none() -> None:
    assert kinds(table(("b", None, 15, 5, 0), ("b", 15, None, 5.09, 0))) == set()


def test_a_late_claim_is_derived_after_the_last_change_of_the_truth() -> None:
    assert kinds(table(("b", None, 99, 5, 0), ("b", 99, None, 6, 0)), sessions=False) == {("b", "moved", 3)}


def test_scores_by_kind() -> None:
    # b is found, 3 s late; c's absence is not; d is found; z, which is in no key, vanishes; a moves by .3 m: false
    estimate = table(
        ("a", None, 15, 0, 0), ("a", 15, None, 0.3, 0),
        ("b", None, 18, 5, 0), ("b", 18, None, 6, 0.1),
        ("c", None, None, 0, 5),
        ("d", 25, None, 9, 9),
        ("e", None, None, 2, 2), ("f", None, None, 3, 3), ("g", None, None, 7, 7),
        ("z", None, 25, 4, 9),
    )  # fmt: skip
    found = values(TRUTH, estimate)
    # claims: a moved, b moved, d appeared, z vanished: 2 of 4 true; changes: 8, of which 2 are found
    assert found["changes/all/any_looks/precision"] == pytest.approx(2 / 4)
    assert found["changes/all/any_looks/recall"] == pytest.approx(2 / 8)
    assert found["changes/all/any_looks/f1"] == pytest.approx(2 * 2 / (4 + 8))
    assert found["changes/moved/any_looks/precision"] == pytest.approx(1 / 2)
    assert found["changes/moved/any_looks/recall"] == 1.0
    assert found["changes/vanished/any_looks/precision"] == 0.0
    assert found["changes/vanished/any_looks/recall"] == 0.0
    assert found["changes/appeared/any_looks/f1"] == 1.0
    assert math.isnan(found["changes/exchanged/any_looks/precision"])
    assert found["changes/exchanged/any_looks/recall"] == 0.0
    assert found["changes/time_error"] == pytest.approx(3 / 2)  # of b 3 s, of d none
    assert found["displacement/rmse"] == pytest.approx(0.1)  # of b alone


def test_by_place_names_do_not_matter_but_places_do() -> None:
    estimate = table(
        ("q", None, 15, 5, 0.3), ("q", 15, None, 6, 0.3),  # b, .3 m beside
        ("r", None, 15, 0, 5.6),  # c vanishes, but .6 m beside
        ("s", 25, None, 9.4, 9.4),  # d, but .57 m beside
    )  # fmt: skip
    found = values(TRUTH, estimate)
    assert found["changes/moved/any_looks/f1"] == 1.0
    assert found["changes/vanished/any_looks/f1"] == 0.0
    assert found["changes/appeared/any_looks/f1"] == 0.0
    assert found["changes/all/any_looks/precision"] == pytest.approx(1 / 3)


def test_by_place_classes_must_agree_where_both_are_known() -> None:
    truth = table(("b", None, 15, 5, 0), ("b", 15, None, 6, 0), class_id="tag")
    for name, f1 in (("tag", 1.0), ("", 1.0), ("cone", 0.0)):
        estimate = table(("q", None, 15, 5, 0), ("q", 15, None, 6, 0), class_id=name)
        assert values(truth, estimate)["changes/moved/any_looks/f1"] == f1


LOOKS = looks_at(ENDS_S, {"b": [20, 30, 40], "c": [20], "d": [12, 22], "e": [30], "f": [30], "g": [], "h": [40]})
"""Since their changes: b 3 looks, c 1 while absent and 0 since it is back, d 0, e and f 1, g 0, h 1."""


def test_what_was_never_looked_at_is_scored_apart() -> None:
    # the estimate claims everything, as it is
    found = values(TRUTH, TRUTH, LOOKS)
    # never looked at: c's return, d, g: three claims, which are false
    assert found["changes/never_looked/count"] == 3.0
    assert found["changes/never_looked/claimed"] == 1.0
    # with one look: b, c's end, e, f, h are true
    assert found["changes/all/1_looks/precision"] == pytest.approx(5 / 8)
    assert found["changes/all/1_looks/recall"] == 1.0
    # with three looks: b; the others are neither true nor false, the three stay false
    assert found["changes/all/3_looks/precision"] == pytest.approx(1 / 4)
    assert found["changes/all/3_looks/recall"] == 1.0
    assert found["changes/all/10_looks/precision"] == 0.0
    assert math.isnan(found["changes/all/10_looks/recall"])


def test_silence_about_what_was_never_looked_at_costs_nothing() -> None:
    silent = TRUTH[~np.isin(TRUTH.landmark_id, ["d"])]
    found = values(TRUTH, silent, LOOKS)
    assert found["changes/never_looked/claimed"] == pytest.approx(2 / 3)
    assert found["changes/all/1_looks/recall"] == 1.0
    assert found["changes/all/1_looks/precision"] == pytest.approx(5 / 7)


def test_a_column_of_looks_counts_for_the_whole_landmark() -> None:
    truth = table(("b", None, 15, 5, 0), ("b", 15, None, 6, 0), n_looks=2)
    found = values(truth, truth)
    assert found["changes/moved/1_looks/recall"] == 1.0
    assert math.isnan(found["changes/moved/3_looks/recall"])


def test_sigmas_and_squared_errors_by_covariance() -> None:
    # the place after is off by (.2, .1); covariances: (.01, .04) before, (.03, .06) after
    truth = table(("b", None, 15, 5, 0), ("b", 15, None, 6, 0), ("c", None, 15, 9, 9), ("c", 15, None, 8, 9))
    before = table(("b", None, 15, 5, 0), cov_xx_m2=0.01, cov_xy_m2=0.0, cov_yy_m2=0.04)
    after = table(("b", 15, None, 6.2, 0.1), cov_xx_m2=0.03, cov_xy_m2=0.0, cov_yy_m2=0.06)
    # c is off by .2 m where it is, with a sigma of .05 m: four sigma
    other = table(("c", None, 15, 9, 9), ("c", 15, None, 8.2, 9), cov_xx_m2=0.0025, cov_xy_m2=0.0, cov_yy_m2=0.0025)
    estimate = join(before, after, other)
    found = values(truth, estimate)
    assert found["changes/all/any_looks/f1"] == 1.0
    assert found["changes/all/any_looks/f1_within_3_sigma"] == pytest.approx(0.5)
    assert found["displacement/rmse"] == pytest.approx(math.sqrt((0.05 + 0.04) / 2))
    # b: .04 / .04 + .01 / .1 = 1.1, by two dimensions .55; c: .04 / .005 = 8, by two 4
    assert found["displacement/nees_by_dof"] == pytest.approx((0.55 + 4.0) / 2)


def test_a_wide_covariance_does_not_make_a_far_claim_good() -> None:
    # .8 m off, with a sigma of 1 m: within 3 sigma, and not within .5 m
    truth = table(("b", None, 15, 5, 0), ("b", 15, None, 6, 0))
    estimate = table(("b", None, 15, 5, 0), ("b", 15, None, 6.8, 0), cov_xx_m2=1.0, cov_xy_m2=0.0, cov_yy_m2=1.0)
    found = values(truth, estimate)
    assert found["changes/all/any_looks/f1"] == 1.0
    assert found["changes/all/any_looks/f1_within_3_sigma"] == 0.0


def join(*tables: Episodes) -> Episodes:
    from evermap_score.episodes import episodes_from_rows, rows_of

    return episodes_from_rows(row for each in tables for row in rows_of(each))


def test_delay_is_until_the_first_map_that_states_a_change() -> None:
    truth = table(("b", None, 15, 5, 0), ("b", 15, None, 6, 0), ("c", None, 15, 0, 5), ("d", None, None, 9, 9))
    old = (("b", None, None, 5, 0), ("c", None, None, 0, 5), ("d", None, None, 9, 9))
    estimate = join(
        table(*old, robot_time_s=10.0),
        table(*old, robot_time_s=20.0),
        # at 30 the move is known, at 40 that c is gone, too
        table(("b", None, 16, 5, 0), ("b", 16, None, 6, 0), *old[1:], robot_time_s=30.0),
        table(("b", None, 16, 5, 0), ("b", 16, None, 6, 0), ("c", None, 14, 0, 5), old[2], robot_time_s=40.0),
    )
    looks = looks_at(ENDS_S, {"b": [11, 18, 19, 29], "c": [20, 21, 39, 40]})
    found = values(truth, estimate, looks)
    assert found["changes/delay"] == pytest.approx((15 + 25) / 2)
    assert found["changes/delay_in_looks"] == pytest.approx((3 + 4) / 2)
    assert found["changes/all/1_looks/f1"] == 1.0  # by the last map


def test_of_a_landmark_that_moves_twice_claims_go_to_the_nearest_in_time() -> None:
    truth = table(("b", None, 15, 5, 0), ("b", 15, 35, 6, 0), ("b", 35, None, 7, 0))
    estimate = table(("b", None, 36, 5, 0), ("b", 36, None, 7, 0))
    assert values(truth, estimate)["changes/time_error"] == pytest.approx(1.0)


def test_rows_below_one_half_state_nothing() -> None:
    estimate = table(("b", None, 15, 5, 0), ("b", 15, None, 6, 0, 0.4))
    assert kinds(estimate) == {("b", "vanished", 1)}
