"""Presence by Khronos' rules: cells by hand, and all of them by a literal second count."""

from __future__ import annotations

import numpy as np
import pytest

from evermap_score import Episodes

from .test_changes import join
from .worlds import table, values

TRUTH = table(("a", None, None, 0, 0), ("b", None, 15, 5, 0), ("c", 25, None, 0, 5))
AT_10 = table(("a", None, None, 0.1, 0), ("b", None, None, 5, 0), robot_time_s=10.0)
AT_20 = table(("a", None, None, 0.1, 0), ("b", None, None, 5, 0), ("x", 12, None, 9, 9), robot_time_s=20.0)
AT_30 = table(("a", None, None, 0.1, 0), ("b", None, 14, 5, 0), ("c", 26, None, 0, 5.4), robot_time_s=30.0)


def test_cells_by_hand() -> None:
    # (robot, query): detected, hallucinated, missed
    # (10, 10): a, b                         2 0 0  f1 1
    # (20, 10): a, b; x is not there yet     2 0 0  f1 1
    # (20, 20): a; b and x hallucinated      1 2 0  f1 2 / 4
    # (30, 10), (30, 20): a, b; a            f1 1, 1
    # (30, 30): a, c (.4 m off)              2 0 0  f1 1
    found = values(TRUTH, join(AT_10, AT_20, AT_30))
    assert found["presence/f1"] == pytest.approx((1 + 1 + 0.5 + 1 + 1 + 1) / 6)
    assert found["presence/precision"] == pytest.approx((5 + 1 / 3) / 6)
    assert found["presence/recall"] == 1.0
    assert found["presence/f1_online"] == pytest.approx((1 + 0.5 + 1) / 3)


def test_a_miss_and_half_a_metre() -> None:
    # instants 14, 20, 26; one map, three cells. c is .6 m off: at 26 one hallucinated, one missed, a detected
    found = values(TRUTH, table(("a", None, None, 0, 0), ("b", None, 15, 5, 0), ("c", 25, None, 0, 5.6)))
    assert found["presence/f1"] == pytest.approx((1 + 1 + 2 / 4) / 3)
    assert found["presence/recall"] == pytest.approx((1 + 1 + 1 / 2) / 3)


def test_a_match_needs_no_presence_and_no_name() -> None:
    # the estimate has b at its place, but at another time: at 14 b is missed, at 20 and 26 it is hallucinated
    found = values(TRUTH, table(("q", 16, None, 5, 0), ("a", None, None, 0, 0)))
    assert found["presence/precision"] == pytest.approx((1 + 1 / 2 + 1 / 2) / 3)


def test_what_is_improbable_is_not_stated() -> None:
    rows = (("a", None, None, 0, 0), ("b", None, 15, 5, 0), ("c", 25, None, 0, 5))
    assert values(TRUTH, table(*rows, ("x", None, None, 9, 9, 0.49)))["presence/precision"] == 1.0
    # one of three at 14, one of two at 20, one of three at 26 is hallucinated
    found = values(TRUTH, table(*rows, ("x", None, None, 9, 9, 0.5)))
    assert found["presence/precision"] == pytest.approx((2 / 3 + 1 / 2 + 2 / 3) / 3)


def test_fragments_count_once() -> None:
    truth = table(("a", None, None, 0, 0), ("b", None, 15, 5, 0))
    fragments = table(("a", None, None, 0, 0), ("a2", None, None, 0.3, 0), ("b", None, 15, 5, 0))
    assert values(truth, fragments)["presence/f1"] == 1.0


def test_what_returns_to_its_place_is_one_object() -> None:
    truth = table(("a", None, 15, 0, 0), ("a", 25, None, 0, 0), ("b", None, None, 5, 5))
    estimate = table(("a", None, 15, 0, 0), ("b", None, None, 5, 5))
    # at 26 a is missed: 2 * 1 / (2 + 1)
    assert values(truth, estimate)["presence/f1"] == pytest.approx((1 + 1 + 2 / 3) / 3)


def count_literally(truth: Episodes, estimate: Episodes, stamps: list[float]) -> float:
    """The rules once more, row by row, for worlds in which each row is an object."""

    def partner(of: Episodes, row: int, to: Episodes) -> int | None:
        away = [float(np.hypot(*(of.position_m[row] - place)[:2])) for place in to.position_m]
        best = int(np.argmin(away)) if away else -1
        return best if away and away[best] <= 0.5 else None

    f1 = []
    for stamp_s in stamps:
        there, stated = truth.is_present(stamp_s), estimate.is_present(stamp_s)
        detected = hallucinated = missed = 0
        visited: set[int] = set()
        for row in range(len(estimate)):
            to = partner(estimate, row, truth)
            if to is not None:
                if to in visited:
                    continue
                visited.add(to)
            if stated[row]:
                detected += int(to is not None and there[to])
                hallucinated += int(to is None or not there[to])
        visited = set()
        for row in range(len(truth)):
            to = partner(truth, row, estimate)
            if to is not None:
                if to in visited:
                    continue
                visited.add(to)
            missed += int(there[row] and (to is None or not stated[to]))
        if detected + hallucinated + missed:
            f1.append(2 * detected / (2 * detected + hallucinated + missed))
    return float(np.mean(f1))


@pytest.mark.parametrize("seed", range(6))
def test_random_worlds_are_counted_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = [(f"t{n}", float(rng.integers(0, 5)), float(rng.integers(6, 12)), *rng.uniform(0, 4, 2)) for n in range(8)]
    off = [
        (f"e{n}", row[1] + rng.normal(0, 1), row[2] + rng.normal(0, 1), *(np.array(row[3:]) + rng.normal(0, 0.3, 2)))
        for n, row in enumerate([*rows, *rows[:3]])
        if rng.random() < 0.8
    ]
    truth, estimate = table(*rows), table(*(row for row in off if row[1] < row[2]))
    from .worlds import world_of

    world = world_of(truth, estimate)
    assert values(truth, estimate)["presence/f1"] == pytest.approx(
        count_literally(truth, estimate, world.instants_s.tolist())
    )
