"""Looks at features that leave and return, against the closed form, the persistence filter, and in its limits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from evermap.errors import InputError, NumericalError
from evermap.existence.batch import Looked

from .rows import look_exponential, look_two_state

N = 500


def test_one_look_is_the_closed_form_to_the_last_digits() -> None:
    """Kolmogorov's solution for two states, with 50 digits, from certainty to certainty."""
    random = np.random.default_rng(1)
    leave, comes = (10 ** random.uniform(-9, 1, N) for _ in range(2))
    before, gap, horizon = 10 ** random.uniform(-200, 200, N), 10 ** random.uniform(-6, 7, N), 30.0
    seen, miss, false = random.random(N) < 0.5, random.uniform(1e-6, 1, N), random.uniform(1e-6, 1, N)
    found = look_two_state(before, np.zeros(N), leave, comes, gap, seen, miss, false, horizon_s=horizon)
    with mpmath.workdps(50):
        for i in range(N):
            a, b, p = mpmath.mpf(leave[i]), mpmath.mpf(comes[i]), 1 / (1 + mpmath.mpf(before[i]))
            share = b / (a + b)
            predicted = share + (p - share) * mpmath.exp(-(a + b) * mpmath.mpf(gap[i]))
            there, gone = (1 - mpmath.mpf(miss[i]), mpmath.mpf(false[i]))
            if not seen[i]:
                there, gone = mpmath.mpf(miss[i]), 1 - mpmath.mpf(false[i])
            odds = (1 - predicted) * gone / (predicted * there)
            after = 1 / (1 + odds)
            later = share + (after - share) * mpmath.exp(-(a + b) * horizon)
            assert found.inverse_odds[i] == pytest.approx(float(odds), rel=1e-13)
            assert found.probability[i] == pytest.approx(float(later), rel=1e-13)


@pytest.mark.parametrize("horizon_s", [0.0, 40.0])
def test_without_return_it_is_the_persistence_filter(horizon_s: float) -> None:
    random = np.random.default_rng(2)
    rate = 10 ** random.uniform(-6, 0, N)
    stamp = np.zeros(N)
    recurrent, once = Looked(np.zeros(N), np.ones(N)), Looked(np.zeros(N), np.ones(N))
    for _ in range(30):
        time = stamp + random.choice([0.0, 1e-3, 1.0, 100.0], N)
        look = (time, random.random(N) < 0.5, random.uniform(0.01, 0.99, N), random.uniform(0.01, 0.99, N))
        recurrent = look_two_state(recurrent.inverse_odds, stamp, rate, np.zeros(N), *look, horizon_s=horizon_s)
        once = look_exponential(once.inverse_odds, stamp, rate, *look, horizon_s=horizon_s)
        stamp = time
        sure = once.inverse_odds < 1e15  # beyond, a belief of 1e-16 is all the same
        np.testing.assert_allclose(recurrent.inverse_odds[sure], once.inverse_odds[sure], rtol=1e-12)
        np.testing.assert_allclose(recurrent.probability, once.probability, rtol=1e-12, atol=1e-15)


def test_splitting_a_gap_changes_nothing() -> None:
    """A look that tells nothing (P_M = 1 - P_F) in between."""
    random = np.random.default_rng(3)
    leave, comes = (10 ** random.uniform(-6, 0, N) for _ in range(2))
    half, whole, start = np.full(N, 7.0), np.full(N, 20.0), 10 ** random.uniform(-3, 3, N)
    seen, even, look = random.random(N) < 0.5, np.full(N, 0.5), (random.random(N), random.random(N))
    once = look_two_state(start, np.zeros(N), leave, comes, whole, seen, *look)
    first = look_two_state(start, np.zeros(N), leave, comes, half, seen, even, even)
    twice = look_two_state(first.inverse_odds, half, leave, comes, whole, seen, *look)
    np.testing.assert_allclose(twice.inverse_odds, once.inverse_odds, rtol=1e-12)


def test_certainties() -> None:
    """Gone for certain and never returning stays so; who returns is doubted again; no gap, no change."""
    one = np.ones(3)
    after = look_two_state(
        np.array([np.inf, np.inf, 0.0]), 0 * one, one, np.array([0.0, 1.0, 1.0]), np.array([5.0, 5.0, 0.0]),
        np.zeros(3, dtype=bool), 0.5 * one, 0.5 * one,
    )  # fmt: skip
    np.testing.assert_allclose(after.inverse_odds, [np.inf, 1.0, 0.0], rtol=1e-3)


@pytest.mark.parametrize(("field", "value"), [("leave_hz", -1.0), ("return_hz", np.nan), ("p_false", 1.5)])
def test_refusals_name_row_and_field(field: str, value: float) -> None:
    columns = {name: np.full(4, 0.5) for name in ("inverse_odds", "stamp_s", "leave_hz", "return_hz")}
    columns |= {name: np.full(4, 0.5) for name in ("time_s", "p_miss", "p_false")}
    columns[field] = columns[field].copy()
    columns[field][2] = value
    with pytest.raises(InputError, match="row 2") as refused:
        look_two_state(**columns, detected=np.ones(4, dtype=bool))
    assert refused.value.field == field


def test_impossible_look() -> None:
    one = np.ones(1)
    with pytest.raises(NumericalError, match="row 0"):
        look_two_state(0 * one, 0 * one, one, one, one, np.zeros(1, dtype=bool), 0 * one, one)
