"""Compiled arithmetic against mpmath and against the generic road."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from evermap.errors import InputError
from evermap.existence import single
from evermap.existence.batch import CHUNK_ROWS
from evermap.existence.elementary import exp, expm1
from evermap.existence.kernels import general_purpose_gap, scaled_survival
from evermap.existence.lifetimes import log_death_odds
from evermap.survival import Exponential, GeneralPurpose

from .rows import look_exponential, look_general_purpose


def test_exponentials_to_the_last_digits() -> None:
    for x in np.concatenate([np.logspace(-300, 2.84, 500), -np.logspace(-300, 2.84, 500), [0.0]]):
        assert expm1(float(x)) == pytest.approx(float(np.expm1(x)), rel=5e-16, abs=0.0)
        assert exp(float(x)) == pytest.approx(float(np.exp(x)), rel=5e-16, abs=0.0)


def test_exponential_integral_to_the_last_digits() -> None:
    """It is the scaled survival of a lifetime whose highest rate is past every time."""
    with mpmath.workdps(30):
        for x in np.concatenate([np.logspace(-90, 8, 300), [1.0, np.nextafter(1.0, 0.0)]]):
            exact = mpmath.e1(x) * (mpmath.exp(x) if x >= 1.0 else 1)
            assert scaled_survival(float(x), 1e30, 1.0)[0] == pytest.approx(float(exact), rel=2e-15, abs=0.0)


def test_scaled_survival_of_the_young_and_of_narrow_ranges() -> None:
    """Relative to E1 itself, of which it is a difference: both below 1, astride, both above, hardly apart."""
    with mpmath.workdps(40):
        for low in np.logspace(-8, 2, 60):
            for ratio in (1.02, 3.0, 1e4):
                x, y = mpmath.mpf(float(low)), mpmath.mpf(float(low * ratio))
                scale = mpmath.exp(x) if low >= 1.0 else mpmath.mpf(1)
                survival, decay = scaled_survival(float(low), float(low * ratio), 1.0)
                exact = float(scale * (mpmath.e1(x) - mpmath.e1(y)))
                assert survival == pytest.approx(exact, rel=2e-15, abs=4e-15 * min(1.0, float(scale * mpmath.e1(x))))
                assert decay == pytest.approx(float(scale * mpmath.exp(-y)) - 1.0, rel=2e-15, abs=2e-15)


def exact_odds(low: float, high: float, a: float, b: float) -> float:
    """`(1 - q) / q` with 60 digits."""
    with mpmath.workdps(60):

        def survival(t: float):
            at = mpmath.mpf(t)
            return mpmath.e1(low * at) - mpmath.e1(high * at) if t > 0.0 else mpmath.log(mpmath.mpf(high) / low)

        return float(survival(a) / survival(b) - 1)


def test_death_odds_of_an_unknown_rate_keep_their_digits() -> None:
    """From a nanosecond to thousands of years, gaps from a billionth of the age up, from birth too."""
    random = np.random.default_rng(1)
    for _ in range(300):
        low = 10 ** random.uniform(-9, 0)
        high = low * 10 ** random.uniform(0.5, 8)
        start = 0.0 if random.random() < 0.2 else 10 ** random.uniform(-9, 2) / low
        stop = start + max(start, 1e-6 / high) * 10 ** random.uniform(-9, 1)
        if low * (stop - start) < 600.0 and stop > start:
            exact = exact_odds(low, high, float(start), float(stop))
            assert general_purpose_gap(low, high, start, stop) == pytest.approx(exact, rel=1e-10, abs=0.0)


@pytest.mark.parametrize("threads", [False, True])
@pytest.mark.parametrize("horizon_s", [0.0, 40.0])
def test_kernels_are_the_generic_filter(threads: bool, horizon_s: float) -> None:
    random = np.random.default_rng(2)
    n = 40
    rate, low, high = (10 ** random.uniform(a, b, n) for a, b in ((-6, 0), (-6, -3), (-2, 2)))
    kinds = {
        "exponential": ([Exponential(float(r)) for r in rate], look_exponential, (rate,)),
        "general": (
            [GeneralPurpose(float(a), float(b)) for a, b in zip(low, high, strict=True)],
            look_general_purpose,
            (low, high),
        ),
    }
    for priors, look, parameters in kinds.values():
        state = single.init(n, priors, prior_of_row=np.arange(n))
        odds, stamp = np.zeros(n), np.zeros(n)
        for _ in range(30):
            time = stamp + random.choice([0.0, 1e-3, 1.0, 100.0], n)
            seen, miss, false = random.random(n) < 0.5, random.random(n), random.random(n)
            state = state.update(time, seen, miss, false)
            answer = look(odds, stamp, *parameters, time, seen, miss, false, horizon_s=horizon_s, threads=threads)
            odds, stamp = answer.inverse_odds, time
            np.testing.assert_allclose(odds, state.inverse_odds, rtol=1e-9)
            np.testing.assert_allclose(answer.probability, state.predict(time + horizon_s), rtol=1e-9)


def test_threads_change_no_digit() -> None:
    random = np.random.default_rng(3)
    n = 2 * CHUNK_ROWS + 17
    state, low, high = (random.random(n), random.random(n)), 0.5 * random.random(n), 0.5 + random.random(n)
    looks = (1.0 + random.random(n), random.random(n) < 0.5, random.uniform(0.1, 0.9, n), random.uniform(0.1, 0.9, n))
    for look, parameters in ((look_exponential, (low,)), (look_general_purpose, (low, high))):
        serial, spread = (look(*state, *parameters, *looks, threads=threads) for threads in (False, True))
        np.testing.assert_allclose(serial.inverse_odds, spread.inverse_odds, rtol=1e-13)
        np.testing.assert_allclose(serial.probability, spread.probability, rtol=1e-15)


def test_threads_name_the_row_too() -> None:
    n = 2 * CHUNK_ROWS
    ones, time = np.ones(n), np.full(n, 2.0)
    time[n - 3] = 0.5
    with pytest.raises(InputError, match=f"row {n - 3}: time 0.5 s lies before"):
        look_exponential(ones, ones, ones, time, ones > 0.0, 0.5 * ones, 0.5 * ones, threads=True)


def test_certainties_pass_through_the_kernels() -> None:
    """Proof of presence, proof of absence, and a lifetime that never ends."""
    stamp, time, rate = np.zeros(4), np.ones(4), np.array([1.0, 1.0, 0.0, 1e9])
    odds, seen = np.array([3.0, 3.0, 0.0, 0.5]), np.array([True, False, False, False])
    look = look_exponential(
        odds, stamp, rate, time, seen, np.array([0.5, 0.0, 0.5, 0.5]), np.array([0.0, 0.5, 0.5, 0.5])
    )
    np.testing.assert_array_equal(look.inverse_odds, [0.0, np.inf, 0.0, 1e300])
    np.testing.assert_array_equal(look.probability, [1.0, 0.0, 1.0, 1e-300])


def test_the_short_road_of_an_unknown_rate_agrees_with_the_prior_itself() -> None:
    random = np.random.default_rng(4)
    prior = GeneralPurpose(1e-5, 0.5)
    start = np.where(random.random(200) < 0.1, 0.0, 10 ** random.uniform(-6, 6, 200))
    stop = start + 10 ** random.uniform(-4, 6, 200)
    expected = prior.log_conditional_death(start, stop) - prior.log_conditional_survival(start, stop)
    odds = log_death_odds((prior,), np.zeros(200, dtype=np.int64), start, stop)
    np.testing.assert_allclose(odds, expected, rtol=1e-10, atol=1e-10)
