"""Scores of probabilities against closed forms and plain loops."""

from __future__ import annotations

import math

import numpy as np
import pytest

from evermap.errors import InputError
from evermap.metrics.belief import SURE, belief_scores, reliability


def sample(seed: int, n: int = 400) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    belief = np.concatenate([rng.random(n), [0.0, 1.0, 0.5, 0.1, 0.3]])
    return belief, (rng.random(len(belief)) < 0.6).astype(float)


def test_scores_equal_plain_loops() -> None:
    belief, there = sample(1)
    scores = belief_scores(belief, there)
    pairs = list(zip(belief.tolist(), there.tolist(), strict=True))
    n = len(pairs)
    assert scores.count == n
    assert scores.share_present == pytest.approx(sum(y for _, y in pairs) / n)
    assert scores.brier == pytest.approx(sum((p - y) ** 2 for p, y in pairs) / n)
    assert scores.mae == pytest.approx(sum(abs(p - y) for p, y in pairs) / n)
    inside = [(min(max(p, SURE), 1.0 - SURE), y) for p, y in pairs]
    expected = -sum(math.log(p) if y else math.log(1.0 - p) for p, y in inside) / n
    assert scores.log_loss == pytest.approx(expected)
    right = [(p >= 0.5) == bool(y) for p, y in pairs]
    assert scores.accuracy == pytest.approx(sum(right) / n)
    sensitivity = [r for r, (_, y) in zip(right, pairs, strict=True) if y]
    specificity = [r for r, (_, y) in zip(right, pairs, strict=True) if not y]
    expected = (sum(sensitivity) / len(sensitivity) + sum(specificity) / len(specificity)) / 2.0
    assert scores.balanced_accuracy == pytest.approx(expected)


def test_bins_equal_plain_loops() -> None:
    belief, there = sample(2)
    found = reliability(belief, there)
    total = 0.0
    for k in range(10):
        low, high = found.edge[k], found.edge[k + 1]
        mine = [(p, y) for p, y in zip(belief, there, strict=True) if low <= p < high or (k == 9 and p == 1.0)]
        assert found.count[k] == len(mine)
        assert found.belief[k] == pytest.approx(np.mean([p for p, _ in mine]))
        assert found.present[k] == pytest.approx(np.mean([y for _, y in mine]))
        total += len(mine) * abs(np.mean([p for p, _ in mine]) - np.mean([y for _, y in mine]))
    assert found.error == pytest.approx(total / len(belief))
    assert belief_scores(belief, there).calibration_error == found.error


def test_closed_forms() -> None:
    half = belief_scores([0.5, 0.5], [1, 0])
    assert (half.brier, half.mae, half.calibration_error, half.balanced_accuracy) == (0.25, 0.5, 0.0, 0.5)
    assert half.log_loss == pytest.approx(math.log(2.0))
    perfect = belief_scores([1.0, 0.0], [1, 0])
    assert (perfect.brier, perfect.mae, perfect.accuracy, perfect.balanced_accuracy) == (0.0, 0.0, 1.0, 1.0)
    assert perfect.log_loss == pytest.approx(0.0, abs=1e-8)
    assert belief_scores([1.0], [0]).log_loss == pytest.approx(-math.log(SURE))


def test_the_proper_scores_are_smallest_for_the_true_rate() -> None:
    there = np.array([1.0] * 7 + [0.0] * 3)
    for score in ("brier", "log_loss"):
        values = {p: getattr(belief_scores(np.full(10, p), there), score) for p in (0.5, 0.6, 0.7, 0.8, 0.9)}
        assert min(values, key=values.__getitem__) == 0.7


def test_what_cannot_be_scored_is_nan() -> None:
    nothing = belief_scores([], [])
    assert nothing.count == 0
    assert math.isnan(nothing.brier)
    assert math.isnan(nothing.calibration_error)
    assert math.isnan(reliability([], []).error)
    assert math.isnan(belief_scores([0.7, 0.2], [1, 1]).balanced_accuracy)


@pytest.mark.parametrize(
    ("belief", "there", "message"),
    [
        ([0.5, 1.5], [1, 0], r"row 1: 1\.5 is not a probability"),
        ([np.nan], [1], "row 0: nan is not a probability"),
        ([0.5], [2], r"row 0: 2\.0 is not a truth value"),
        ([0.5], [1, 0], "shape"),
    ],
)
def test_bad_input_is_named(belief: list[float], there: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        belief_scores(belief, there)
