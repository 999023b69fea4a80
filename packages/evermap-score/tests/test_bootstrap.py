"""Intervals: against the formula, and what is the same in all draws."""

from __future__ import annotations

import math

import numpy as np
import pytest

from evermap_score import Episodes, score
from evermap_score.bootstrap import draw_weights, interval, list_units, resample
from evermap_score.metric import metric_of_rows, ratio

from .worlds import looks_at, table


def mean_of(values: list[float], units: list[int]) -> np.ndarray:
    rows = [(unit, f"l{unit}", (value, 1.0)) for value, unit in zip(values, units, strict=True)]
    metric = metric_of_rows("mean", "", rows, 2, of_sums=ratio([0], [1]))
    names = list_units([metric], over_sessions=True)
    return resample(metric, names, draw_weights(len(names), 4000, 1), over_sessions=True)


def test_the_interval_of_a_mean_is_that_of_the_formula() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(3.0, 2.0, 200)
    low, high = interval(mean_of(values.tolist(), list(range(200))))
    sigma = values.std() / math.sqrt(200)
    assert (low, high) == pytest.approx((values.mean() - 1.96 * sigma, values.mean() + 1.96 * sigma), abs=0.15 * sigma)


def test_items_of_one_unit_are_drawn_together() -> None:
    # ten units of twenty equal items: the standard deviation of the mean is that of ten values, not of two hundred
    values = np.random.default_rng(0).normal(size=10)
    drawn = mean_of(np.repeat(values, 20).tolist(), np.repeat(np.arange(10), 20).tolist())
    assert drawn.std() == pytest.approx(values.std() / math.sqrt(10), rel=0.05)


def test_items_of_no_unit_are_in_every_draw() -> None:
    metric = metric_of_rows("mean", "", [(-1, "", (5.0, 1.0))], 2, of_sums=ratio([0], [1]))
    assert resample(metric, np.array(["0", "1"]), draw_weights(2, 7, 0), over_sessions=True).tolist() == [5.0] * 7


def world(n: int = 12) -> tuple[Episodes, Episodes, Episodes]:
    """n landmarks that move; one estimate misses every third, the other the same and one more."""
    truth, one, other = [], [], []
    for k in range(n):
        rows = [(f"m{k}", None, 10.0, 3.0 * k, 0.0), (f"m{k}", 10.0, None, 3.0 * k, 1.0)]
        still = [(f"m{k}", None, None, 3.0 * k, 0.0)]
        truth += rows
        one += still if k % 3 == 0 else rows
        other += still if k % 3 == 0 or k == 1 else rows
    return table(*truth), table(*one), table(*other)


def test_a_difference_is_paired() -> None:
    truth, one, other = world()
    report = score(truth, {"one": one, "other": other, "again": one})
    name = "changes/all/any_looks/recall"
    first, second, third = report.estimates
    assert first.minus_first == {}
    assert second.minus_first[name].value == pytest.approx(-1 / 12)
    # with the same draws the difference is -k / 12 where landmark 1 is drawn k times, though each alone varies more
    assert second.minus_first[name].high == 0.0
    assert first.values[name].high - first.values[name].low > 0.3
    assert second.minus_first[name].low > -0.3
    same = third.minus_first[name]
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0)


def test_the_seed_decides() -> None:
    truth, one, _ = world()
    reports = [score(truth, one, seed=seed) for seed in (1, 1, 2)]
    numbers = [[(each.low, each.high) for each in report.estimates[0].values.values()] for report in reports]
    assert repr(numbers[0]) == repr(numbers[1])
    assert repr(numbers[0]) != repr(numbers[2])


def test_it_is_over_sessions_where_there_are_several() -> None:
    truth, one, _ = world()
    assert score(truth, one, draws=5).resampled == "landmarks"
    assert score(truth, one, looks=looks_at([5.0, 15.0], {"m0": [1.0]}), draws=5).resampled == "sessions"
    assert score(truth, one, looks=looks_at([15.0], {"m0": [1.0]}), draws=5).resampled == "landmarks"


def test_no_draws_are_no_intervals() -> None:
    truth, one, _ = world()
    assert math.isnan(score(truth, one, draws=0)["changes/all/any_looks/f1"].low)


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Of 300 worlds of 40 landmarks, each found with probability .7, 95 % intervals of the recall hold .7."""
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(300):
        found = rng.random(40) < 0.7
        rows = [(0, f"l{k}", (float(hit), 1.0)) for k, hit in enumerate(found)]
        metric = metric_of_rows("recall", "", rows, 2, of_sums=ratio([0], [1]))
        names = list_units([metric], over_sessions=False)
        low, high = interval(
            resample(metric, names, draw_weights(40, 400, int(rng.integers(1 << 30))), over_sessions=False)
        )
        held += low <= 0.7 <= high
    assert 0.88 <= held / 300 <= 0.985
